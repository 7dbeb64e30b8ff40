"""How far a drive is pushed towards a Peltier optimum: not beyond three quarters, if its range goes on."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.native.build import wanted
from thermogrip.mpc.tuning.minimum_time import full_drive_bound

OPTIMUM = -0.55  # of the reversing tank, whose range ends at -1
WAYS = [False, pytest.param(True, marks=pytest.mark.skipif(not wanted(), reason="no gcc here"))]


def lowest_allowed(optimiser, bias: float, effective: float) -> float:
    """Return the lower end for a plan at which drive and bias together are ``effective``."""
    guess = np.full((optimiser.n_b, 1), effective - bias)
    left = np.full((optimiser.n_b, 1), 1 - effective / OPTIMUM)  # of the gain, which fades in proportion
    low, _ = optimiser._range(guess, np.array([bias]), left, np.array([effective - bias]), 0.0)
    return float(low[-1, 0])


@pytest.mark.parametrize("bias", [-0.15, 0.0, 0.15])
def test_a_bias_of_the_drive_does_not_move_the_optimum(reversing_tank, bias):
    # a plant that cools better than its model is no plant whose optimum comes earlier
    optimiser = design_controller(reversing_tank, dt=2.0).optimiser
    assert lowest_allowed(optimiser, bias, -0.4) == pytest.approx(0.75 * OPTIMUM, abs=1e-9)


@pytest.mark.parametrize(
    ("end", "allowed"),
    [(-0.5, -0.5), (OPTIMUM, OPTIMUM), (-0.575, 0.9090909 * OPTIMUM), (-0.62, 0.75 * OPTIMUM)],
)
def test_a_range_that_ends_before_the_optimum_is_had_whole(reversing_tank, end, allowed):
    optimiser = design_controller(reversing_tank, dt=2.0, drive_range={"drive": (end, 1.0)}).optimiser
    assert lowest_allowed(optimiser, 0.0, -0.4) == pytest.approx(allowed, abs=1e-6)


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize(("joule", "coldest"), [(0.05, -1.0), (0.1, 0.75 * OPTIMUM)])
def test_far_below_what_can_be_held_the_drive_stays_where_it_may(tank_maker, compiled, joule, coldest):
    # optima at -1.1, beyond the range, and at -0.55
    plant = tank_maker(heat=0.11, joule=joule)
    controller = Controller(plant, design_controller(plant, dt=2.0).design, compiled=compiled)
    run = simulate_closed_loop(
        controller, plant, [(5.0, 200.0)], start=25.0, surroundings=Surroundings(noise=0.0, quantum=0.0)
    )
    assert np.min(run.drive["drive"][20:]) == pytest.approx(coldest, abs=0.02)


@pytest.mark.parametrize("compiled", WAYS)
def test_a_tank_that_cools_better_than_its_model_arrives_as_soon_as_its_drive_allows(tank_maker, compiled):
    plant, truth = tank_maker(heat=0.11, joule=0.055), tank_maker(heat=0.13, joule=0.045)
    controller = Controller(plant, design_controller(plant, dt=2.0).design, compiled=compiled)
    spec = Spec(steps=[(25.0, 15.0)], hold_s=400.0, sensor_offset_degC=0.0)
    flat_out = full_drive_bound(truth, controller.design, (25.0, 15.0), spec)
    segment = simulate_closed_loop(controller, truth, [(15.0, 400.0)], start=25.0).segments[0]
    assert segment.settle_s <= 1.25 * flat_out  # 1.11; 1.41 where a bias moves the optimum
    assert segment.overshoot <= 0.3
    assert abs(segment.bias) <= 0.05
