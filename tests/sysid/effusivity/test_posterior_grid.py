"""The grid's quantiles, and what Laplace's method leaves out, against sums that know no mode."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity import posterior_grid
from thermogrip.sysid.effusivity.data import touches, whiten
from thermogrip.sysid.effusivity.laplace_approximation import EFFUSIVITY, fit_candidates
from thermogrip.sysid.effusivity.posterior_grid import (
    LN_E_RANGE,
    free_evidence,
    grid_posteriors,
    mixture_quantiles,
)

LEVELS = (0.05, 0.5, 0.95)


@pytest.mark.parametrize("seed", range(6))
def test_the_mixture_has_its_levels_below_its_quantiles(seed):
    rng = np.random.default_rng(seed)
    weight, mean = rng.dirichlet(np.full(60, 0.3)), np.sort(10 + 2 * rng.standard_normal(60))
    sd = np.exp(rng.normal(-2, 1.5, 60))
    x = np.array(mixture_quantiles(weight, mean, sd, LEVELS))
    np.testing.assert_allclose((weight * ndtr((x[:, None] - mean) / sd)).sum(axis=1), LEVELS, atol=1e-5)


@pytest.mark.usefixtures("one_grade")
def test_a_spoiled_record_is_answered_as_by_laplaces_method(device):
    """A sensor that runs away: no effusivity fits, no mode settles, and nothing breaks."""
    record = load_example_grasps()["exp3C_obj18_grip38"].isel(grasp=[0])
    y = record["t_surface"].values.copy()
    y += 9.0 * np.maximum(record["time"].values - 2, 0.0)
    posterior = grid_posteriors(device, touches(record.assign(t_surface=(("grasp", "time"), y))))[0]
    assert posterior.log_evidence < -1e4
    assert posterior.mass.sum() == pytest.approx(1.0)


def test_a_refinement_keeps_off_the_points_that_there_are():
    """Of thirteen cells over two the seventh has its middle on a point of before."""
    x = np.arange(6.0)
    got = posterior_grid.refined(x, np.array([-20.0, 0, -20, -30, -40, -40]), 12.0, 13)
    assert np.abs(got[:, None] - x).min() > 0.1 * 2 / 13
    assert ((got > 0) & (got < 2)).all()
    assert got.size == 13


def test_the_posterior_of_a_normal_density_is_that_density():
    """Far tails belong to no mixture."""
    x = np.linspace(6.0, 12.0, 121)
    value = 5.0 - 0.5 * ((x - 9.1) / 0.3) ** 2
    found = posterior_grid.posterior_of(x, value, 2 * x, 0.1 * x, 3 * x)
    range_ = np.log(1.0e5 / 17.0)
    assert found.log_evidence == pytest.approx(5.0 + np.log(0.3 * np.sqrt(2 * np.pi) / range_), abs=1e-3)
    assert found.mass.sum() == pytest.approx(1.0)
    assert found.mass @ found.x == pytest.approx(9.1, abs=1e-4)
    assert found.mass @ (found.x - 9.1) ** 2 == pytest.approx(0.09, rel=1e-3)
    # 20 nats are 6.32 sd, and the grid goes on to the next point; 1e-9 of the peak is at 6.44 sd
    assert (found.x[0], found.x[-1], found.x.size) == pytest.approx((7.2, 11.0, 160))
    assert (found.t_object.min() / 2, found.t_object.max() / 2) == pytest.approx((7.2, 11.0))
    assert found.weight @ found.t_object / 2 == pytest.approx(9.1, abs=1e-3)
    np.testing.assert_allclose(found.t_object_sd, found.t_object / 20)
    np.testing.assert_allclose(found.ln_h, 1.5 * found.t_object)


def test_half_of_all_objects_are_near_a_material_of_the_table():
    x = np.linspace(*posterior_grid.LN_E_RANGE, 4000)
    density = np.exp(posterior_grid.log_listed(x)) / (x[-1] - x[0])
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=0.01)
    wood, between, far = np.exp(posterior_grid.log_listed(np.log([367.0, 4700.0, 1e5])))
    assert far == pytest.approx(0.5, abs=0.02)
    assert wood > 2 * between > 1.0


@pytest.mark.parametrize(
    ("material", "start"),
    [("copper", "copper"), ("copper", "iron"), ("copper", LN_E_RANGE[1]), ("iron", "iron"),
     ("iron", "copper"), ("iron", LN_E_RANGE[1]), ("wood", "wood"), ("wood", LN_E_RANGE[0])],
)  # fmt: skip
@pytest.mark.usefixtures("one_grade")
def test_the_evidence_of_a_free_effusivity_is_the_integral_of_many_points(device, material, start):
    """Copper's density ends at the range's edge, wood's lies between two coarse points."""
    record = load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=np.flatnonzero(record["material"].values == material)[:3]))
    near = fit_candidates(device, data, [material]).mode.u
    near[:, EFFUSIVITY] = device.blocks[start].ln_effusivity if isinstance(start, str) else start
    found = free_evidence(device, data, near, whiten(data, device.noise))
    want = []
    for posterior in grid_posteriors(device, data):
        # intervals stand under the log-uniform law; objects are likeliest of materials of the table
        listed = posterior_grid.log_listed(posterior.x - device.effusivity_scale(posterior.x)[0])
        want.append(posterior.log_evidence + np.log(posterior.mass @ np.exp(listed)))
    np.testing.assert_allclose(found, want, atol=0.5)  # of odds that have ten nats and more
