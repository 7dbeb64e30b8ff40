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
LOOPS = (PILoop("q2", "a", Kc=3.0, Ti=20.0), PILoop("q1", "b", Kc=2.0, Ti=40.0))
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
    controller = pi()  # its start is held by no drive, found to 1e-5 of a range
    for now, a, b, q1, q2, of_a, of_b in (
        # q2: 3 * 8, of which it may go 25; q1: 2 * 7.5 = 15, of which 8, and its integrator stands
        (0.0, 22.0, 22.0, 8.0, 24.0, 2 * 1.2, 0.0),
        (2.0, 24.0, 22.0, 15.0, 18 + 2.4, 2.4 + 2 * 0.9, 2 * 0.375),
        # q1 goes back by 12 and not to 2 * 0.5 + 0.75: its integrator brings it back
        (5.0, 26.0, 29.0, 3.0, 12 + 4.2, 4.2 + 3 * 0.6, 0.75 + 3 * 0.025),
    ):
        move = controller.step({"a": a, "b": b, "room": 22.0, "time_s": now}, TARGET)
        assert (move.status, move.advice, move.pump, move.seconds) == ("ok", "", 1, 1)
        assert move.drive == pytest.approx({"q1": q1, "q2": q2}, abs=1e-3)
        assert pytest.approx([of_a, of_b], abs=1e-3) == controller.integral
    assert controller._unread_s.tolist() == [0.0, 0.0]
    held = controller.step({"a": 40.0, "b": 40.0, "room": 22.0, "time_s": 5.5}, TARGET)
    assert (held.drive, held.advice) == (move.drive, "called before its sample time: the move is held")
    assert held.seconds == 1
    lost = [controller.step({"a": 30.0, "b": NAN, "time_s": now}, TARGET) for now in (7.0, 9.0, 11.0, 13.0)]
    said = {(each.status, each.advice) for each in lost}
    assert said == {("fallback_plan", "b: no usable reading, the others go on")}
    drives = [each.drive["q1"] for each in lost]
    assert drives == pytest.approx([3.0, 0.0, 0.0, 0.0], abs=1e-3)  # held for 3 s, then to rest
    assert controller.integral[1] == pytest.approx(0.825, abs=1e-3)
    assert lost[0].drive["q2"] == pytest.approx(6.0, abs=1e-3)
    controller.reset({"a": 23.0, "b": 24.0})
    assert controller.integral.tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    assert controller._unread_s.tolist() == [0.0, 0.0]
    assert controller._target.tolist() == [24.0, 23.0]


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


def test_a_take_over_starts_from_the_drives_that_are_applied():
    controller = pi()
    y, target = np.array([27.0, 26.0]), np.array([29.5, 30.0])
    controller.follow(np.array([33.0, 61.0]), y, target)
    assert pytest.approx([61 - 12, 33 - 5]) == controller.integral
    np.testing.assert_allclose(controller.propose(y, target), [33.0, 61.0])
    np.testing.assert_allclose(controller.integral, [49 + 2 * 0.6, 28 + 2 * 0.125])


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
    assert again["q2"] == pytest.approx(3.0 * 4.0)
    # taken over it starts from the drive, and answers half of a new target
    y, target = np.array([27.0, 26.0]), np.array([29.5, 30.0])
    weighted.follow(np.array([33.0, 61.0]), y, target)
    np.testing.assert_allclose(weighted.propose(y, target), [33.0, 61.0])


def test_where_nothing_holds_a_start_it_is_no_drive():
    model = StateSpaceModel(("q",), (), ("t",), A=[[1.0]], B=[[0.0]], C=[[1.0]], dt=1.0)
    plant = Plant(model, {}, dt=1.0, units={"q": "1", "t": "degC"}, valid={"q": (0.0, 1.0)})
    far = StateSpaceModel(("q",), (), ("t",), A=[[1.02]], B=[[0.0]], C=[[1.0]], c=[1.0], dt=1.0)
    for made in (model, far):
        u = held_drive(PredictionModel(Plant(made, {}, dt=1.0, units=plant.units)), ("t",), (30.0,), ())
        assert u.tolist() == [0.0]


def test_from_rest_the_drive_that_holds_the_reading_goes_on():
    controller = pi(slew_per_s={"q1": 100.0, "q2": 100.0})
    here = {"a": 30.0, "b": 29.5, "room": 22.0}
    controller.reset(here)
    for _ in range(3):
        assert controller.step(here, TARGET).drive == pytest.approx({"q1": 30.0, "q2": 40.0}, abs=1e-4)


def test_a_start_under_a_drive_that_is_told_goes_on_from_it():
    """The plant's own drive holds 30 and 29.5 degC at 25 and 35 % in place of the model's 30 and 40."""
    controller = pi(slew_per_s={"q1": 2.0, "q2": 2.0})
    here, told = {"a": 30.0, "b": 29.5, "room": 22.0}, {"q1": 25.0, "q2": 35.0}
    controller.reset(here | told)
    for _ in range(3):
        assert controller.step(here, TARGET).drive == pytest.approx(told, abs=1e-4)
    controller.reset(here | told)
    # 2 a second from there on, up and down
    moved = controller.step(here, {"a": 60.0, "b": 20.0}).drive
    assert moved == pytest.approx({"q1": 21.0, "q2": 39.0}, abs=1e-4)
