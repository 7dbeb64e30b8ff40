"""The linear-quadratic regulator: its gain by another way, its limits, its freedom from offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
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
        assert segment.overshoot < 0.3


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
