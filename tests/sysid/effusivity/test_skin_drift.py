"""A skin that still moves when it touches is told; one that only is noisy is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.posterior import material_fit
from thermogrip.sysid.effusivity.quality import BIAS_S, level_slope, unsettled
from thermogrip.sysid.effusivity.simulation import simulate_grasps

TIME = np.round(np.arange(-20, 101) / 10, 1)


def noisy(slope, n=400, quantum=1 / 16, seed=0):
    y = 30.0 + slope * TIME + np.random.default_rng(seed).normal(0.0, 0.045, (n, TIME.size))
    y = np.round(y / quantum) * quantum if quantum else y
    return make_grasps(TIME, y, [f"g{i}" for i in range(n)])


def test_the_slope_is_known_as_well_as_it_says():
    """t-distributed with 14 degrees of freedom: 16 readings before -0.4 s."""
    slope, sd = level_slope(noisy(0.03, quantum=0.0))
    assert kstest((slope - 0.03) / sd, "t", args=(14,)).pvalue > 0.01
    assert np.median(sd) == pytest.approx(0.045 / np.sqrt(16 * (16**2 - 1) / 12 * 0.1**2), rel=0.1)


def test_noise_alone_is_not_told_and_a_fast_drift_is():
    assert not unsettled(noisy(0.0)).any()
    assert unsettled(noisy(-0.3)).all()
    assert 0.2 < unsettled(noisy(0.17)).mean() < 0.8  # where the docstring says that it begins


def test_no_bundled_grasp_is_told():
    told = {name: int(unsettled(g).sum()) for name, g in load_example_grasps().items()}
    assert not any(told.values()), told


def test_contacts_made_before_the_message_are_no_drift():
    y = 30.0 + 0.0 * TIME + np.where(TIME > -0.35, 8.0 * (TIME + 0.35), 0.0) + 0.05 * ((TIME * 10) % 2)
    assert not unsettled(make_grasps(TIME, y[None], ["early"])).any()


def test_readings_of_one_value_know_no_better_than_their_step():
    flat = np.full((2, TIME.size), 30.0)
    flat[1, TIME > -0.55] += 0.0625  # one rounding that turns over
    assert not unsettled(make_grasps(TIME, flat, ["a", "b"])).any()


def test_lost_readings_are_left_out_and_too_few_tell_nothing():
    y = 30.0 + 0.5 * np.broadcast_to(TIME, (2, TIME.size)) + 0.05 * ((TIME * 10) % 2)
    y = y.copy()
    y[0, 3:6], y[1, 5:20] = np.nan, np.nan
    record = make_grasps(TIME, y, ["some", "few"])
    slope, sd = level_slope(record)
    assert slope[0] == pytest.approx(0.5, abs=3 * sd[0])
    assert np.isnan([slope[1], sd[1]]).all()
    assert unsettled(record).tolist() == [True, False]


@pytest.mark.parametrize(("name", "seconds"), [("copper", 12.0), ("iron", 17.0)])
def test_a_drift_that_lasts_moves_a_metal_by_so_many_seconds_of_it(name, seconds):
    """The drift as the object lets it be: less the integral of the response, by trapezes."""
    device, rate = load_default_gripper(), 0.05
    block = device.blocks[name]
    one = {"ln_e": [block.ln_effusivity], "ln_h": [block.ln_h], "ln_rho_c": [np.log(block.heat_capacity)]}
    grasps, _ = simulate_grasps(device, t_gripper=23.0, t_object=43.0, seed=4, **one)
    y, t = grasps["t_surface"].values, grasps["time"].values
    rise = (y[0] - y[0, t < -0.2].mean()) / 20.0  # the response itself, nearly
    answered = np.concatenate([[0.0], np.cumsum(0.5 * (rise[1:] + rise[:-1]) * np.diff(t))])
    moved = grasps.assign(t_surface=grasps["t_surface"] + rate * (t - np.where(t > 0, answered, 0.0)))
    off = material_fit(device, moved, [name]).t_object - material_fit(device, grasps, [name]).t_object
    assert off[0, 0] == pytest.approx(seconds * rate, rel=0.2)
    assert abs(seconds - BIAS_S) <= 3
