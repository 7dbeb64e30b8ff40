"""The problem behind a fit: its box, its bins, its weights and its starts, each done again by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tests.sysid.greybox.makers import TwoGains, a_log, heater, made
from thermogrip.sysid.greybox.problem import Problem, make_problem, prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.network_spec import Parameter


def problem_of(model: Any, *logs: Any, average: float = 4.0, **more: Any) -> Problem:
    return make_problem(model, logs, average=average, independent=60.0, **more)


class Mixed(TwoGains):
    """One gain on a logarithmic scale, one on a plain one."""

    specs = {  # noqa: RUF012
        "a": Parameter(unit="K", value=4.0, sd_log=0.5, low=0.8, high=9.0),
        "b": Parameter(unit="K", value=4.0, sd=2.0, low=-1.0, high=7.0),
    }


def test_the_ends_of_the_box_are_the_bounds_of_the_parameters():
    problem = problem_of(Mixed(), a_log(1, seconds=200))
    low, high = problem.box
    np.testing.assert_allclose(
        problem.parameters(np.array([low, high, [0.0, 0.0]])), [[0.8, -1], [9, 7], [4, 4]]
    )
    np.testing.assert_allclose(problem.parameters(np.ones((1, 2))), [[4 * np.exp(0.5), 6.0]])
    np.testing.assert_allclose(problem.standard({"a": 6.0, "b": -0.5}), [np.log(6 / 4) / 0.5, -4.5 / 2])
    np.testing.assert_allclose(problem.standard({"a": -3.0, "b": 70.0}), [low[0], high[1]])  # inside the box
    assert problem.width.tolist() == [0.5, 2.0]


def test_a_residual_is_an_error_in_sensor_sd_divided_by_the_root_of_tau():
    problem = problem_of(Mixed(), a_log(1), a_log(2))
    assert problem.tau.tolist() == [15.0]  # bins of 4 s in a minute
    z = np.array([0.2, -0.3])
    for tau, scaled in ((15.0, problem), (2.0, replace(problem, tau=np.array([2.0])))):
        residual, jacobian = scaled.residual(z), scaled.jacobian(z)
        errors = np.concatenate([stretch[0] for log in scaled.errors(z) for stretch in log])
        np.testing.assert_allclose(residual[:-2], errors / (0.1 * np.sqrt(tau)))
        assert residual[-2:].tolist() == z.tolist()
        np.testing.assert_array_equal(jacobian[-2:], np.eye(2))
    # the model less the reading: more gain, more of it
    more = problem.errors(z + [1.0, 0.0])[0][0][0] - problem.errors(z)[0][0][0]
    assert more.mean() > 0


def test_a_slope_on_a_bound_is_taken_from_inside():
    asked: list[float] = []

    class Recorded(Mixed):
        def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Any:
            asked.append(float(np.max(np.asarray(p, float)[:, 0])))
            return super().rollout(x0, u, d, p, dt)

    problem = problem_of(Recorded(), a_log(1, seconds=200))
    z = np.array([problem.box[1][0], 0.0])
    ((_, slopes),) = problem.by_log(z)
    assert max(asked) <= 9.0 * (1 + 1e-12)
    ((_, central),) = problem.by_log(z - [1e-3, 0.0], central=True)
    np.testing.assert_allclose(slopes, central, rtol=2e-3, atol=1e-6)


def test_what_a_start_explains_of_a_slope_is_no_knowledge_of_a_parameter():
    warm = made(0, seconds=900.0).isel(time=slice(300, None))
    problem = problem_of(heater(), warm)
    z = np.full(len(problem.free), 0.1)
    starts, ((_, slopes),) = problem.start(z), problem.by_log(z)
    assert starts[0][0].level is None
    held = problem.residuals(np.vstack([z, z + 1e-4 * np.eye(len(z))]), starts)[0]
    step = np.sqrt(np.diag(problem.model.spread))
    by_start = problem.residuals(z[None], [[starts[0][0].moved(0.1 * step)]])[0][0] - held[0]
    explained = [by_start @ slope / np.linalg.norm(by_start) for slope in slopes.T]
    before = [by_start @ (r - held[0]) / 1e-4 / np.linalg.norm(by_start) for r in held[1:]]
    assert np.abs(explained).max() < 0.05 * np.abs(before).max()


def test_bins_are_whole_steps_and_hold_the_means_of_their_rows():
    log = a_log(1, seconds=203)
    log["t"].values[[3, 17, 40, 41, 42, 43]] = np.nan
    problem = problem_of(TwoGains(), log, average=4.2)
    assert problem.average == 4.0
    (cells,) = problem.logs[0][1]
    t, y = log["time"].values, log["t"].values
    cell = np.minimum(t, 201.0).astype(int) // 4  # the last row ends the last step
    want = [np.nanmean(y[cell == k]) for k in range(51) if k != 10]  # of 40 to 43 s none is left
    np.testing.assert_allclose(cells.means[0], want)
    np.testing.assert_array_equal(cells.places[0], np.delete(np.arange(51), 10))
    line = 3.0 * np.arange(203.0) + 1.0  # of a run on the grid, at the times of the same rows
    at = [np.mean((3.0 * t + 1.0)[(cell == k) & np.isfinite(y)]) for k in range(51) if k != 10]
    np.testing.assert_allclose(cells.operators[0] @ line, at)


def test_a_stretch_without_a_reading_is_no_reason_to_refuse_a_log():
    log = made(0, seconds=300.0)
    t = log["time"].values
    log["t"].values[(t > 120) & (t < 150)] = np.nan
    cut = log.isel(time=np.flatnonzero((t < 100) | ((t > 121) & (t < 149)) | (t > 170)))
    problem = problem_of(heater(), cut)
    assert [bool(cells.means[0].size) for cells in problem.logs[0][1]] == [True, False, True]


def test_a_prior_as_a_plant_has_all_that_the_model_states():
    model = load_network("gripper")
    plant = prior_plant(model)
    assert plant.noise == dict(model.sensor_sd) != {}
    assert plant.nuisance == model.nuisance
    assert any(plant.nuisance.values())
    assert plant.reference == model.reference is not None
    for name in plant.free:
        spec = model.specs[name]
        assert (plant.values[name], plant.bounds[name]) == (spec.value, spec.bounds)
        assert plant.scales[name] == ("log" if spec.sd_log is not None else "linear")
    fixed = [name for name, spec in model.specs.items() if spec.fixed]
    assert fixed
    assert set(plant.free).isdisjoint(fixed)
