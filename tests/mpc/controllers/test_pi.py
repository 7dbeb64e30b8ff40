"""The PI baseline by hand: its moves and integrators, what is lost, and how it takes over."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from tests.mpc.makers import crossed
from thermogrip.mpc.controllers.pi import PIController, held_drive
from thermogrip.mpc.design.design import PILoop, default_design
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

PLANT, NAN = crossed(), float("nan")
LOOPS = (
    PILoop("q2", "a", Kc=3.0, Ti=20.0, feedforward=0.5),
    PILoop("q1", "b", Kc=2.0, Ti=40.0),
)
TARGET = {"a": 30.0, "b": 29.5}  # held by 40 % of q2 and 30 % of q1 in a room of 22 degC


SLOW, WIDE = {"q1": 4.0}, {"q1": (0.0, 100.0)}


def pi(*, loops=LOOPS, slew_per_s=SLOW, drive_range=WIDE) -> PIController:
    limits = {
        "slew_per_s": {"q1": 12.5, "q2": 12.5} | slew_per_s,
        "drive_range": {"q1": (0.0, 100.0), "q2": (0.0, 100.0)} | drive_range,
    }
    design = default_design(PLANT, dt=2.0, controlled=("b", "a"), patience_s=3.0, loops=loops, **limits)
    made = PIController(PLANT, design, clock=count().__next__)
    made.reset({"a": 22.0, "b": 22.0, "room": 22.0})
    return made


def test_its_moves_and_its_integrators_are_those_of_the_equations():
    controller = pi()
    for now, a, b, q1, q2, of_a, of_b in (
        # q2: 20 + 3 * 8 = 44, of which 12.5 a second; q1: 30 + 2 * 7.5 = 45, of which 4: both stand
        (0.0, 22.0, 22.0, 8.0, 25.0, 0.0, 0.0),
        # 20 + 3 * 6 is within; 30 - 2 * 0.4 is limited, and its integrator brings it back
        (2.0, 24.0, 29.9, 16.0, 38.0, 2 * 0.9, 2 * -0.02),
        (5.0, 26.0, 31.0, 26.96, 33.8, 1.8 + 3 * 0.6, -0.04 - 3 * 0.075),
    ):
        move = controller.step({"a": a, "b": b, "room": 22.0, "time_s": now}, TARGET)
        assert (move.status, move.advice, move.pump, move.seconds) == ("ok", "", 1, 1)
        assert move.drive == pytest.approx({"q1": q1, "q2": q2}, abs=2e-4)
        assert pytest.approx([of_a, of_b], abs=2e-4) == controller.integral
    assert controller._unread_s.tolist() == [0.0, 0.0]
    held = controller.step({"a": 40.0, "b": 40.0, "room": 22.0, "time_s": 5.5}, TARGET)
    assert (held.drive, held.advice) == (move.drive, "called before its sample time: the move is held")
    assert held.seconds == 1
    lost = [controller.step({"a": 30.0, "b": NAN, "time_s": now}, TARGET) for now in (7.0, 9.0, 11.0, 13.0)]
    said = {(each.status, each.advice) for each in lost}
    assert said == {("fallback_plan", "b: no usable reading, the others go on")}
    drives = [each.drive["q1"] for each in lost]
    assert drives == pytest.approx([26.96, 18.96, 10.96, 2.96], abs=1e-4)  # held for 3 s, then to rest
    assert controller.integral[1] == pytest.approx(-0.265, abs=1e-4)
    assert lost[0].drive["q2"] == pytest.approx(20.0 + 3.6, abs=2e-4)
    controller.reset({"a": 23.0, "b": 24.0})
    assert controller.integral.tolist() == pytest.approx(controller._unread_s.tolist()) == [0.0, 0.0]
    assert controller._target.tolist() == [24.0, 23.0]
    assert np.isnan(controller._room).all()


@pytest.mark.parametrize(
    ("target", "wrong"),
    [(TARGET, ""), ({"a": 30.0}, "target of b is missing or absurd: the last good one is kept")],
)
def test_a_pi_without_readings_holds_then_switches_off(target: dict[str, float], wrong: str):
    controller = pi()
    first = controller.step({"a": 22.0, "b": 22.0, "room": 22.0}, TARGET)
    moves = [controller.step({}, target) for _ in range(4)]
    assert [move.status for move in moves] == ["fallback_plan", "off", "off", "off"]
    assert {moves[0].advice} == {wrong or "reading lost: the drive is held"}
    assert {move.advice for move in moves[1:]} == {wrong or "reading lost: drive to zero"}
    assert [move.drive for move in moves[:2]] == [first.drive, {"q1": 0.0, "q2": 0.0}]
    assert [move.pump for move in moves] == [1, 0, 0, 0]
    again = controller.step({"a": 22.0, "b": 22.0}, target)
    assert (again.status, again.advice) == ("ok", wrong)


def test_patience_is_ten_seconds_or_five_samples():
    for dt, seconds in ((1.0, 10.0), (2.0, 10.0), (4.0, 20.0)):
        made = PIController(PLANT, dt=dt, loops=LOOPS, controlled=("a", "b"))
        assert made._patience_s == pytest.approx(seconds * (1 + 1e-6), rel=1e-9)
    found = PIController(PLANT, controlled=("b", "a"))
    assert [(loop.drive, loop.output) for loop in found.loops] == [("q1", "b"), ("q2", "a")]
    assert made.drives.slew.tolist() == [50.0, 50.0]  # an eighth of the range a second


@pytest.mark.parametrize(
    ("share", "narrow", "q1"), [(0.5, 100.0, 30.0), (0.0, 100.0, 0.0), (0.5, 20.0, 20.0)]
)
def test_a_drive_without_a_loop_gets_what_is_fed_forward(share: float, narrow: float, q1: float):
    loop = PILoop("q2", "a", Kc=3.0, Ti=20.0, feedforward=share)
    controller = pi(loops=(loop,), drive_range={"q1": (0.0, narrow)}, slew_per_s={})
    for _ in range(3):
        u = controller.propose(np.array([22.0, 29.0]), np.array([29.504, 30.0]), np.array([22.2]))
        controller.hold(u)
    assert u[0] == pytest.approx(q1, abs=1e-4)  # a room of 22.2 degC is one of 22, and 29.504 is 29.5


def test_an_unknown_room_is_one_of_25_degrees_and_the_last_that_was_read_stays():
    controller = pi(slew_per_s={"q1": 100.0})
    for room, ahead in ((NAN, 18.0), (23.6, 24.0), (NAN, 24.0)):  # (29.5 - room) / 0.25
        controller.integral[:] = 0.0
        move = controller.step({"a": 30.0, "b": 29.5, "room": room}, TARGET)
        assert move.drive["q1"] == pytest.approx(ahead, abs=1e-4)


def test_a_take_over_starts_from_the_drives_that_are_applied():
    controller = pi()
    y, target, d = np.array([27.0, 26.0]), np.array([29.5, 30.0]), np.array([22.0])
    controller.follow(np.array([33.0, 61.0]), y, target, d)
    assert pytest.approx([61 - 20 - 12, 33 - 30 - 5], abs=1e-4) == controller.integral
    np.testing.assert_allclose(controller.propose(y, target, d), [33.0, 61.0])
    np.testing.assert_allclose(controller.integral, [29 + 2 * 0.6, -2 + 2 * 0.125], atol=1e-4)


def test_a_setpoint_weight_answers_a_new_target_less_and_a_reading_as_before():
    half = tuple(replace(loop, setpoint=0.5) for loop in LOOPS)
    wide = {"slew_per_s": {"q1": 100.0, "q2": 100.0}}
    whole, weighted = pi(**wide), pi(loops=half, **wide)
    first = {"a": 22.0, "b": 22.0, "room": 22.0}
    one, two = whole.step(first, TARGET).drive, weighted.step(first, TARGET).drive
    # of the steps of 8 and 7.5 degC half is left to the integrator
    assert one["q2"] - two["q2"] == pytest.approx(3.0 * 4.0, abs=1e-4)
    assert one["q1"] - two["q1"] == pytest.approx(2.0 * 3.75, abs=1e-4)
    assert pytest.approx(weighted.integral) == whole.integral
    warmer = {"a": 23.0, "b": 22.5, "room": 22.0}
    one, two = whole.step(warmer, TARGET).drive, weighted.step(warmer, TARGET).drive
    assert (one["q2"] - two["q2"], one["q1"] - two["q1"]) == pytest.approx((12.0, 7.5), abs=1e-4)
    # a loop whose reading was lost at the start begins where it is first read
    weighted.reset({"a": NAN, "b": 22.0, "room": 22.0})
    again = weighted.step(first, TARGET).drive
    assert again["q2"] == pytest.approx(20.0 + 3.0 * 4.0, abs=1e-4)
    # taken over it starts from the drive, and answers half of a new target
    y, target, d = np.array([27.0, 26.0]), np.array([29.5, 30.0]), np.array([22.0])
    weighted.follow(np.array([33.0, 61.0]), y, target, d)
    np.testing.assert_allclose(weighted.propose(y, target, d), [33.0, 61.0])


def test_where_nothing_holds_a_target_nothing_is_fed_forward():
    model = StateSpaceModel(("q",), (), ("t",), A=[[1.0]], B=[[0.0]], C=[[1.0]], dt=1.0)
    plant = Plant(model, {}, dt=1.0, units={"q": "1", "t": "degC"}, valid={"q": (0.0, 1.0)})
    far = StateSpaceModel(("q",), (), ("t",), A=[[1.02]], B=[[0.0]], C=[[1.0]], c=[1.0], dt=1.0)
    for made in (model, far):
        u = held_drive(PredictionModel(Plant(made, {}, dt=1.0, units=plant.units)), ("t",), (30.0,), ())
        assert u.tolist() == [0.0]


def test_from_rest_the_drive_that_holds_the_reading_goes_on_without_feedforward():
    plain = tuple(replace(loop, feedforward=share) for loop, share in zip(LOOPS, (0.0, 0.25)))
    controller = pi(loops=plain, slew_per_s={"q1": 100.0, "q2": 100.0})
    here = {"a": 30.0, "b": 29.5, "room": 22.0}
    controller.reset(here)
    for _ in range(3):
        assert controller.step(here, TARGET).drive == pytest.approx({"q1": 30.0, "q2": 40.0}, abs=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_start_under_a_drive_that_is_told_goes_on_from_it(share: float):
    """The plant's own drive holds 30 and 29.5 degC at 25 and 35 % in place of the model's 30 and 40."""
    loops = tuple(replace(loop, feedforward=share) for loop in LOOPS)
    controller = pi(loops=loops, slew_per_s={"q1": 2.0, "q2": 2.0})
    here, told = {"a": 30.0, "b": 29.5, "room": 22.0}, {"q1": 25.0, "q2": 35.0}
    controller.reset(here | told)
    for _ in range(3):
        assert controller.step(here, TARGET).drive == pytest.approx(told, abs=1e-4)
    controller.reset(here | told)
    # 2 a second from there on, up and down
    moved = controller.step(here, {"a": 60.0, "b": 20.0}).drive
    assert moved == pytest.approx({"q1": 21.0, "q2": 39.0}, abs=1e-4)
