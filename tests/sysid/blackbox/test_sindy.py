"""SINDy: finds the equation it was simulated by, in natural units; refuses what diverges."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox import sindy
from thermogrip.sysid.blackbox.order_selection import Structure
from thermogrip.sysid.blackbox.sindy import sindy_family
from thermogrip.sysid.models.polynomial import SindyModel
from thermogrip.sysid.plant.log_grid import make_grid


def radiating_log(n: int = 1500, seed: int = 0, name: str = "a"):
    """t+ = t + 0.5 q - 0.02 (t - 25) - 0.0005 (t - 25)^2, no noise."""
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 25 + 1), 25)[:n]
    t = np.empty(n)
    t[0] = 25.0
    for k in range(n - 1):
        t[k + 1] = t[k] + 0.5 * q[k] - 0.02 * (t[k] - 25) - 0.0005 * (t[k] - 25) ** 2
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")}, name=name)


def coefficient(model: SindyModel, powers: list[int]) -> float:
    at = np.flatnonzero((model.exponents == powers).all(axis=1))
    return float(model.coefficients[0, at].sum())


def free_run_error(model: SindyModel) -> np.ndarray:
    """The error of a free run over another log."""
    other = radiating_log(800, seed=5)
    y, _ = model.rollout([[25.0]], other["q"].values[None, :, None], np.zeros((1, 800, 0)), (), 1.0)
    return y[0, :-1, 0] - other["t"].values


@pytest.fixture(scope="module")
def grid():
    return make_grid([radiating_log()], average=1.0)


def test_the_equation_of_the_simulation_is_found_in_degrees_and_runs_free_over_another_log(grid, fit_one):
    model = fit_one("sindy", grid, thresholds=0.001)
    # expand 1 - 0.02 (t - 25) - 0.0005 (t - 25)^2 in t
    assert coefficient(model, [0, 1]) == pytest.approx(0.5, rel=1e-3)
    assert coefficient(model, [2, 0]) == pytest.approx(-0.0005, rel=1e-2)
    assert coefficient(model, [1, 0]) == pytest.approx(1 - 0.02 + 0.0005 * 50, rel=1e-3)
    assert coefficient(model, [1, 1]) == pytest.approx(0.0, abs=1e-3)
    assert np.abs(free_run_error(model)).max() < 0.05
    linear = fit_one("sindy", grid, degrees=1, thresholds=0.0)
    assert np.sqrt(np.mean(free_run_error(linear) ** 2)) > 0.1


def test_several_logs_of_different_length_are_fitted_together(fit_one):
    logs = [radiating_log(300, seed=1, name="a"), radiating_log(500, seed=2, name="b")]
    model = fit_one("sindy", make_grid(logs, average=1.0), thresholds=0.001)
    assert coefficient(model, [0, 1]) == pytest.approx(0.5, rel=1e-2)


def test_casadi_runs_the_same_lines(grid, fit_one):
    model = fit_one("sindy", grid, memories=2)
    x0 = [30.0, 29.5]
    xs, us = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    step = ca.Function(
        "step", [xs, us], [ca.vertcat(*model.step(ca.vertsplit(xs), ca.vertsplit(us), [], (), 1.0))]
    )
    np.testing.assert_allclose(
        np.asarray(step(x0, 0.3)).ravel(), model.step(x0, [0.3], [], (), 1.0), rtol=1e-12
    )


def test_equations_that_diverge_are_infinite_not_wrong_and_no_model(grid):
    runaway = SindyModel(("q",), (), ("t",), 1.0, (), 1, [[0, 0], [2, 0]], [[0.0, 1.0]], [20.0], [30.0])
    y, _ = runaway.rollout([[25.0], [0.5]], np.zeros((1, 50, 1)), np.zeros((1, 50, 0)), (), 1.0)
    assert np.isinf(y[0, -1])
    assert np.isfinite(y[1]).all()  # each member of the batch for itself
    for rise, bounded in ((1.01, False), (0.9, True)):  # a plant that grows leaves the range of its data
        model = sindy._bounded_model(grid, np.array([[1, 0], [0, 0]]), np.array([[rise, 1.0]]), 1)
        assert (model is not None) == bounded


def test_the_structures_are_degrees_thresholds_and_memories(grid, monkeypatch):
    monkeypatch.setattr(sindy, "_features", lambda grid, degree, memory: (degree, memory))
    monkeypatch.setattr(sindy, "_fit_terms", lambda grid, terms, threshold: (*terms, threshold))
    found = sindy_family(grid)
    # monomials of t and q (and of the last t): 3 and 4 of degree 1, 6 and 10 of degree 2
    terms = {(1, 1): 3, (1, 2): 4, (2, 1): 6, (2, 2): 10}
    want = {}
    for (n, m), count in terms.items():
        for at, h in enumerate((0.0, 0.01, 0.05)):
            want[Structure(f"degree {n}, memory {m}, threshold {h:g}", count - at)] = n, m, h
    assert found == want
    (only,) = sindy_family(
        grid,
        degrees=(0,),
        memories=(1,),
        thresholds=(0.3, 0.2),
        only=[Structure("degree 0, memory 1, threshold 0.3", 1)],
    ).values()
    assert only == (0, 1, 0.3)


@pytest.mark.parametrize(("rows", "fits"), [(24, True), (23, False)])  # 3 * 1 + 20 increments
def test_terms_need_rows(rows, fits):
    grid = make_grid([radiating_log(rows)], average=1.0)
    assert bool(sindy_family(grid, degrees=(1,), thresholds=(0.0,), memories=(1,))) == fits
