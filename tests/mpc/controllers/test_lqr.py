"""The linear-quadratic regulator: its gain by another way, its limits, its freedom from offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.mpc.makers import crossed
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers import lqr
from thermogrip.mpc.controllers.lqr import LQRController, regulator_gain
from thermogrip.mpc.design.design import default_design
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


@settings(max_examples=25, deadline=None)
@given(
    pole=st.floats(0.3, 1.0),
    other=st.floats(0.1, 0.9),
    gain=st.floats(0.2, 3.0),
    move=st.floats(0.1, 30.0),
    drive=st.floats(0.01, 3.0),
)
def test_the_gain_is_that_of_a_very_long_horizon_by_dynamic_programming(pole, other, gain, move, drive):
    A, B, C = np.array([[pole, 0.3], [0.0, other]]), np.array([[0.0], [gain]]), np.array([[1.0, 0.0]])
    got = regulator_gain(A, B, C, track=1.0, move=np.array([move]), drive=np.array([drive]))
    whole, into = np.block([[A, B], [np.zeros((1, 2)), np.eye(1)]]), np.vstack([B, np.eye(1)])
    Q, P = np.diag([1.0, 0.0, drive]), np.zeros((3, 3))
    for _ in range(3000):
        K = np.linalg.solve(move + into.T @ P @ into, into.T @ P @ whole)
        P = Q + whole.T @ P @ (whole - into @ K)
    np.testing.assert_allclose(got, K, rtol=1e-6, atol=1e-9)
    how = {"move": np.array([move]), "drive": np.array([drive])}
    weighed = regulator_gain(A, B, np.eye(2), track=np.array([1.0, 4.0]), **how)
    np.testing.assert_allclose(weighed, regulator_gain(A, B, np.diag([1.0, 2.0]), track=1.0, **how))


@pytest.fixture(scope="module")
def run(tank, other_tank):
    design = replace(default_design(tank, dt=2.0), move=5.0, drive=0.01)
    around = Surroundings(offset={"t_surface": 0.2, "t_ambient": 0.3})
    return simulate_closed_loop(
        LQRController(tank, design), other_tank, [(34.0, 400.0), (22.0, 500.0)], surroundings=around, seed=3
    ), design


def test_a_plant_that_is_not_the_model_is_regulated_without_offset(run):
    assert len(run[0].segments) == 2
    for segment in run[0].segments:
        assert abs(segment.bias) < 0.03
        assert np.isfinite(segment.settle_s)
        assert segment.overshoot < 0.4


def test_drives_stay_in_range_and_slew(run):
    loop, design = run
    drive = loop.drive["drive"]
    assert np.abs(drive).max() <= 1.0
    assert np.abs(np.diff(drive, prepend=0.0)).max() <= design.slew_per_s["drive"] * design.dt + 1e-12
    assert set(loop.status) == {"ok"}


def test_without_disturbance_states_an_offset_is_left(tank, weak_tank):
    design = replace(default_design(tank, dt=2.0), move=5.0, offset_free=False)
    loop = simulate_closed_loop(LQRController(tank, design), weak_tank, [(34.0, 600.0)], seed=3)
    assert abs(loop.segments[0].bias) > 0.1


def test_on_its_own_model_the_room_is_fed_forward_exactly(tank):
    # no disturbance states: what is left would be seen; 20.2 is worked out about 20.0
    design = replace(default_design(tank, dt=2.0), move=5.0, offset_free=False)
    quiet = Surroundings(ambient=20.2, noise=0.0, quantum=0.0)
    loop = simulate_closed_loop(LQRController(tank, design), tank, [(34.0, 900.0)], surroundings=quiet)
    assert abs(loop.segments[0].bias) < 1e-3


def test_a_lost_reading_is_predicted_and_then_the_drive_is_off(tank):
    regulator = LQRController(tank, default_design(tank, dt=2.0))
    reading = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
    regulator.reset(reading)
    regulator.step(reading, 35.0)
    lost = {**reading, "t_surface": float("nan")}
    moves = [regulator.step(lost, 35.0) for _ in range(12)]
    assert [move.status for move in moves] == ["fallback_plan"] * 5 + ["off"] * 7
    assert all(np.isfinite(move.drive) for move in moves)
    assert (moves[-1].drive, moves[-1].pump) == (0.0, 0)


def test_no_target_yet_is_off(tank):
    regulator = LQRController(tank, default_design(tank, dt=2.0))
    regulator.reset({"t_surface": 25.0})
    move = regulator.step({"t_surface": 25.0, "t_tank": 25.0}, float("nan"))
    assert (move.status, move.drive) == ("off", 0.0)


def test_a_target_out_of_reach_is_chased_at_the_end_of_the_range(tank):
    regulator = LQRController(tank, default_design(tank, dt=2.0))
    loop = simulate_closed_loop(regulator, tank, [(140.0, 300.0)])
    assert loop.drive["drive"][-1] == 1.0


@pytest.mark.parametrize(("target", "samples"), [(26.0, 2.0), (34.0, 4.0), (34.0, 10.0), (20.0, 2.0)])
def test_the_mean_over_several_samples_is_of_moves_within_limits(tank, target, samples):
    regulator = LQRController(tank, default_design(tank, dt=2.0))
    regulator.reset({"t_surface": 25.0})
    (one,), (several,) = (regulator.propose(np.array([target]), n) for n in (1.0, samples))
    assert abs(one) > 1.0 >= abs(several)  # the first alone is before its limits
    assert samples > 4.0 or several == np.sign(target - 25.0)


def test_a_drive_that_moves_nothing_is_refused(tank):
    model = StateSpaceModel(
        ("q",), (), ("a", "b"), A=np.diag([0.9, 1.0]), B=[[1.0], [0.0]], C=np.eye(2), dt=1.0
    )
    plant = Plant(model, {}, dt=1.0, units={"q": "1"}, valid={"q": (0.0, 1.0)})
    design = replace(default_design(plant, controlled=("a",)), controlled=("b",), offset_free=False)
    with pytest.raises(UserError, match="no linear regulator brings b to rest"):
        LQRController(plant, design)


# ---- two drives and two outputs at rest: a = room + 0.2 q2, b = room + 0.25 q1; b and a are controlled ----

NAN = float("nan")
RANGES = {"q1": (5.0, 100.0), "q2": (0.0, 80.0)}


def make_two(**changes) -> LQRController:
    given = {"controlled": ("b", "a"), "drive_range": RANGES, "patience_s": 6.0} | changes
    two = LQRController(crossed(), default_design(crossed(), **given), clock=lambda: 1.0)
    two.reset({"a": 22.0, "b": 22.0, "room": 22.0})
    return two


def test_the_gain_of_two_loops_apart_is_that_of_each_with_its_own_weights():
    A, B = np.diag([0.9, 0.8]), np.array([[0.0, 0.02], [0.05, 0.0]])
    given = {"track": 2.0, "move": np.array([3.0, 5.0]), "drive": np.array([0.1, 0.7])}
    both = regulator_gain(A, B, np.eye(2), **given)
    for drive, state in ((0, 1), (1, 0)):
        weights = {"track": 2.0, "move": given["move"][[drive]], "drive": given["drive"][[drive]]}
        alone = regulator_gain(A[state:, state:][:1, :1], B[[state]][:, [drive]], np.eye(1), **weights)
        want = np.zeros(4)
        want[[state, 2 + drive]] = alone[0]
        np.testing.assert_allclose(both[drive], want, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("target", "state", "x", "rests"),
    [
        ([27.0, 26.5], {}, [26.5, 27.0], [20.0, 22.5]),
        ([27.0, 26.5], {"w": [0.1, -0.05]}, [26.5, 27.0], [10.0, 27.5]),
        ([27.0, 26.5], {"found_offset": [0.4, 0.7]}, [26.1, 26.3], [17.2, 20.5]),
        ([27.0, 26.5], {"d": 24.1}, [26.5, 27.0], [11.6, 12.0]),  # worked out about a room of 24
        ([60.0, 26.5], {}, [26.5, 60.0], [100.0, 22.5]),  # 152 to hold it
        ([27.0, 40.0], {}, [40.0, 27.0], [20.0, 80.0]),
        ([27.004, 26.5], {}, [26.5, 27.004], [20.016, 22.5]),  # worked out about 27.00
        ([27.0, 26.5], {"lost": [0.0, 6.1]}, [26.5, 27.0], [20.0, 0.0]),
        ([27.0, 26.5], {"lost": [6.1, 6.0]}, [26.5, 27.0], [5.0, 22.5]),
        (
            [27.0, 26.5],
            {"broken": True},
            [26.5, 27.0],
            [20.0, 22.5],
        ),  # about rest: a linear plant has one law
        ([27.0, 26.5], {"broken": True, "lost": [0.0, 6.1]}, [26.5, 27.0], [20.0, 0.0]),
        ([27.0, 26.5], {"lost": [6.1, 6.1]}, [26.5, 27.0], [5.0, 0.0]),
    ],
)
def test_what_is_at_its_target_is_held_by_the_drive_that_holds_it(monkeypatch, target, state, x, rests):
    two = make_two()

    def broken(*args):
        raise np.linalg.LinAlgError

    if "broken" in state:
        monkeypatch.setattr(lqr, "_held_point", broken)
    two._unread_s = np.array(state.get("lost", [0.0, 0.0]))
    observer, two._d, two._u = two.observer, np.array([state.get("d", 22.0)]), np.array(rests)
    observer.x, observer.w = np.array(x), np.array(state.get("w", [0.0, 0.0]))
    observer.found_offset = np.array(state.get("found_offset", [0.0, 0.0]))
    for samples in (1.0, 3.5):
        np.testing.assert_allclose(two.propose(np.array(target), samples), rests, atol=1e-8)
    assert two._law(np.array(target)) is two._law(np.array(target) + 0.0009 * (target[0] == 27.0))
    if "broken" not in state:
        assert two._law(np.array(target)) is not two._law(np.array(target) + 0.006) or "lost" in state


def test_the_mean_of_moves_is_of_those_that_would_be_made_sample_by_sample():
    two, target, moves = make_two(), np.array([27.0, 26.5]), []
    two.observer.x, two._u = np.array([26.2, 26.9]), np.array([22.0, 20.0])
    mean = two.propose(target, 2.5)
    for _ in range(3):
        moves.append(two.propose(target))
        two.observer.x, two._u = two.model.next_state(two.observer.x, moves[-1], two._d), moves[-1]
    assert np.ptp(moves, axis=0).min() > 0.2
    np.testing.assert_allclose(mean, (moves[0] + moves[1] + moves[2] / 2) / 2.5, rtol=1e-9)


@pytest.mark.parametrize(
    ("reading", "target", "unread", "status", "advice"),
    [
        ({}, 30.0, [0.0, 0.0], "ok", ""),
        ({}, {"b": 30.0}, [0.0, 0.0], "off", "target of a is missing or absurd: the last good one is kept"),
        ({"b": NAN}, 30.0, [0.0, 0.0], "fallback_plan", "b: no usable reading, the model replaces it"),
        ({"a": NAN}, 30.0, [0.0, 4.5], "fallback_plan",
         "no reading of a for 6 s: q2 to rest, the others go on"),
        ({"a": NAN, "b": NAN}, 30.0, [4.0, 5.0], "fallback_plan", "reading lost: the state is predicted"),
        ({"a": NAN, "b": NAN}, 30.0, [4.1, 5.0], "off", "reading lost: drive to zero"),
    ],
)  # fmt: skip
def test_a_step_says_what_is_lost(reading, target, unread, status, advice):
    two = make_two()
    two._unread_s = np.array(unread)
    move = two.step({"a": 22.0, "b": 22.0, "room": 22.0} | reading, target)
    assert (move.status, move.advice) == (status, advice)
    assert move.drive["q1"] == (5.0 if status == "off" else 30.0)  # 25 a sample
    if status == "off":
        assert move.drive["q2"] == 0.0


@pytest.mark.parametrize(("seconds", "again"), [(32.0, False), (32.1, True)])
def test_after_a_long_silence_the_estimate_is_that_of_rest(seconds: float, again: bool):
    two = make_two()
    two.step({"a": 22.0, "b": 22.0, "room": 22.0, "time_s": 0.0}, 30.0)
    two.step({"a": 31.0, "b": 37.0, "room": NAN, "time_s": seconds}, 30.0)
    fresh = make_two()
    fresh.reset({"a": 31.0, "b": 37.0, "room": 22.0})
    fresh.observer.update(np.array([31.0, 37.0]))
    assert two._d.tolist() == [22.0]
    assert np.allclose(two.observer.now, fresh.observer.now, atol=1e-9) == again
