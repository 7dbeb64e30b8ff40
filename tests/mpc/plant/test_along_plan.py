"""Runs in memory that stays: they are the model's own, whatever was run before."""

import numpy as np
import pytest

from tests.mpc.makers import network_plant
from thermogrip.mpc.plant.prediction import PredictionModel

BLOCKS = (1, 2, 3, 1)


@pytest.fixture(scope="module")
def model() -> PredictionModel:
    return PredictionModel(network_plant("tclab"), dt=10.0)


def plans(model: PredictionModel, n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(model.lowest, model.highest, (n, len(BLOCKS), model.n_u))


@pytest.mark.parametrize("ahead", [False, True])
def test_plans_have_the_outputs_of_the_models_own_run(model: PredictionModel, ahead: bool):
    along, d = model.along(BLOCKS, model.span), np.full(model.n_d, 22.0)
    told = d + np.arange(7.0)[:, None] if ahead else d
    assert along is not None
    for n in (11, 3):  # more than go side by side; fewer, after others
        x = model.rest(np.full(model.n_y, 25.0 + n), d)
        u = np.repeat(plans(model, n), BLOCKS, axis=1)
        y, _ = model.run(np.repeat(x[None], n, axis=0), u, told[None] if ahead else told)
        np.testing.assert_allclose(along.outputs(x, plans(model, n), told), y[:, 1:], rtol=1e-12)


def test_derivatives_are_by_drives_in_the_units_that_are_asked_for(model: PredictionModel):
    d, plan = np.full(model.n_d, 22.0), plans(model, 1)[0]
    x = model.rest(np.full(model.n_y, 25.0), d)
    along = model.along(BLOCKS, model.span)
    assert along is not None
    kept = along.trajectory(x, plan, d)
    first = [each.copy() for each in kept]
    along.trajectory(x + 1.0, 0.5 * plan, d)
    for each, before in zip(kept, first, strict=True):  # not the memory of the next run
        np.testing.assert_array_equal(each, before)
    y, G = model.trajectory(x, plan, d, BLOCKS)
    np.testing.assert_allclose(kept[0], y, rtol=1e-13)
    np.testing.assert_allclose(kept[1], G * model.span, rtol=1e-12, atol=1e-12)
    eps = 1e-4 * model.span[1]
    more, less = plan.copy(), plan.copy()
    more[2, 1], less[2, 1] = plan[2, 1] + eps, plan[2, 1] - eps
    up, down = along.outputs(x, np.stack([more, less]), d)
    np.testing.assert_allclose((up - down) / (2 * eps), G[:, :, 2, 1], atol=1e-8)
