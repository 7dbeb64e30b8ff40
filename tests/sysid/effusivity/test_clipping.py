"""A sensor at the end of its range: its readings there are left out, and what is said stays true."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.posterior import material_posterior
from thermogrip.sysid.effusivity.posterior_grid import grid_posteriors, mixture_quantiles
from thermogrip.sysid.effusivity.priors import free_hypotheses
from thermogrip.sysid.effusivity.quality import (
    clipped_from,
    clipped_samples,
    in_range,
    spiked_samples,
    unread_samples,
)
from thermogrip.sysid.effusivity.simulation import simulate_blocks, simulate_grasps

STEP = 0.0625


def bounded(grasps: Grasps, high: float = np.inf, low: float = -np.inf) -> Grasps:
    """Return what a sensor of sixteenths of a degree reads between two rails."""
    return grasps.assign(t_surface=np.clip(STEP * np.round(grasps["t_surface"] / STEP), low, high))


def test_no_example_grasp_is_clipped_however_coarse_its_sensor() -> None:
    for grasps in load_example_grasps().values():
        for step in (STEP, 0.1, 0.25, 0.5, 1.0):
            coarse = grasps.assign(t_surface=step * np.round(grasps["t_surface"] / step))
            assert not unread_samples(coarse).any()


@pytest.mark.parametrize("rail", [44.0, 41.0, 38.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_all_samples_at_a_rail_are_found(rail: float, mirrored: bool) -> None:
    grasps = load_example_grasps()["exp2_dT20"]  # the gripper is 20 K warmer
    cut = bounded(grasps, low=rail)
    at_rail = cut["t_surface"].values == rail
    if mirrored:
        cut = cut.assign(t_surface=80.0 - cut["t_surface"])
    found = clipped_samples(cut)
    assert found[at_rail].all()
    assert found.sum() < 1.02 * at_rail.sum()
    when, reading = clipped_from(cut)
    hit = found.any(axis=1)
    assert set(reading[hit].tolist()) == {80.0 - rail if mirrored else rail}
    assert np.isnan(when[~hit]).all()
    assert np.isnan(in_range(cut)["t_surface"].values).sum() == found.sum()


def test_a_slow_skin_falls_silent_at_a_rail() -> None:
    """Jitter that is gone tells it, where the last second before does not."""
    t = np.arange(-20, 101) / 10
    rng = np.random.default_rng(0)
    rise = 4.0 * (1 - np.exp(-np.maximum(t, 0) / 3))
    skin = 23.0 + np.stack([rise + 0.08 * rng.standard_normal(t.size) for _ in range(20)])
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=range(20), time=slice(0, t.size))
    grasps = grasps.assign(t_surface=(("grasp", "time"), skin))
    assert not clipped_samples(bounded(grasps)).any()
    assert clipped_samples(bounded(grasps, high=26.0)).any(axis=1).all()


def test_a_stuck_sensor_clips_its_own_grasp_alone() -> None:
    grasps = bounded(load_example_grasps()["exp2_dT20"])
    skin = grasps["t_surface"].values.copy()
    stuck = 10  # copper: 20 K warmer than it, the skin falls for seconds
    skin[stuck, 26:] = skin[stuck, 26]
    found = clipped_samples(grasps.assign(t_surface=(("grasp", "time"), skin)))
    assert np.flatnonzero(found.any(axis=1)).tolist() == [stuck]


def test_spikes_are_found_wherever_they_stand_and_hide_no_rail() -> None:
    grasps = bounded(load_example_grasps()["exp2_dT20"], low=41.0)
    skin = grasps["t_surface"].values.copy()
    at = ([0, 3, 3, 8, 9, 9, 9], [0, 60, 61, 24, 118, 119, 120])
    skin[at] = [85.0, -127.0, -127.0, 0.0, 85.0, 85.0, 85.0]
    spoilt = grasps.assign(t_surface=(("grasp", "time"), skin))
    assert [row.tolist() for row in np.nonzero(spiked_samples(spoilt))] == list(at)
    lost = clipped_samples(grasps)
    lost[at] = False
    np.testing.assert_array_equal(clipped_samples(spoilt) & ~spiked_samples(spoilt), lost)


def test_clipped_samples_reach_no_average() -> None:
    cut = bounded(load_example_grasps()["exp2_dT20"], low=41.0)
    whole, lost = touches(cut), touches(in_range(cut))
    np.testing.assert_array_equal(whole.count, lost.count)
    np.testing.assert_array_equal(whole.y[whole.count > 0], lost.y[lost.count > 0])


def test_stated_confidence_is_earned_by_clipped_grasps() -> None:
    """Taken for readings, the samples at this rail make all 120 grasps wood or iron with confidence 1.00."""
    device = load_default_gripper()
    names = sorted(device.blocks)
    grasps = simulate_blocks(device, names, repeats=30, t_gripper=23.0, t_object=43.0, seed=3)
    cut = bounded(grasps, high=31.0)
    metals = clipped_samples(cut).any(axis=1)
    assert metals.sum() == 120
    p = material_posterior(device, cut, names)[metals]
    right = np.asarray(names)[p.argmax(axis=1)] == grasps["material"].values[metals]
    # three standard errors of a share of 120
    assert abs(p.max(axis=1).mean() - right.mean()) < 3 * np.sqrt(0.25 / 120)
    assert right.mean() > 0.45


def test_intervals_of_clipped_grasps_cover() -> None:
    """Taken for readings, the samples at this rail leave 0.29 of the effusivities in their 90 % intervals."""
    device, rng, n = load_default_gripper(), np.random.default_rng(5), 60
    x = rng.uniform(np.log(2000), np.log(50000), n)
    block = free_hypotheses(device, x)
    grasps, _ = simulate_grasps(
        device,
        ln_e=x,
        ln_h=block.ln_h + block.ln_h_sd * rng.standard_normal(n),
        ln_rho_c=block.ln_rho_c + block.ln_rho_c_sd * rng.standard_normal(n),
        t_gripper=23.0,
        t_object=43.0,
        seed=7,
    )
    cut = bounded(grasps, high=30.0)
    assert clipped_samples(cut).any(axis=1).mean() > 0.75
    ends = [
        mixture_quantiles(p.mass, p.x, np.full(p.x.size, 1e-4), (0.05, 0.95))
        for p in grid_posteriors(device, touches(cut))
    ]
    within = [low < true < high for true, (low, high) in zip(x, ends)]
    assert 0.9 - 3 * np.sqrt(0.09 / n) < np.mean(within)
