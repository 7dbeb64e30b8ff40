"""SINDy: finds the equation it was simulated by, in natural units; refuses what diverges."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.sindy import SindyModel, sindy_family, sindy_model
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


def test_the_equation_of_the_simulation_is_found_in_degrees():
    model = sindy_model(make_grid([radiating_log()], average=1.0), degree=2, threshold=0.001)
    # expand 1 - 0.02 (t - 25) - 0.0005 (t - 25)^2 in t
    assert coefficient(model, [0, 1]) == pytest.approx(0.5, rel=1e-3)
    assert coefficient(model, [2, 0]) == pytest.approx(-0.0005, rel=1e-2)
    assert coefficient(model, [1, 0]) == pytest.approx(1 - 0.02 + 0.0005 * 50, rel=1e-3)
    assert coefficient(model, [1, 1]) == pytest.approx(0.0, abs=1e-3)
    assert model.equations()[0].startswith("t[k+1] = ")


def test_a_free_run_over_another_log_is_exact():
    model = sindy_model(make_grid([radiating_log()], average=1.0), degree=2, threshold=0.001)
    other = radiating_log(800, seed=5)
    y, _ = model.rollout([[25.0]], other["q"].values[None, :, None], np.zeros((1, 800, 0)), (), 1.0)
    np.testing.assert_allclose(y[0, :-1, 0], other["t"].values, atol=0.05)


def test_a_linear_model_cannot_do_the_same():
    model = sindy_model(make_grid([radiating_log()], average=1.0), degree=1, threshold=0.0)
    other = radiating_log(800, seed=5)
    y, _ = model.rollout([[25.0]], other["q"].values[None, :, None], np.zeros((1, 800, 0)), (), 1.0)
    assert np.sqrt(np.mean((y[0, :-1, 0] - other["t"].values) ** 2)) > 0.1


def test_the_weak_form_is_exact_without_noise():
    model = sindy_model(make_grid([radiating_log()], average=1.0), degree=2, threshold=0.0, width=20)
    assert coefficient(model, [0, 1]) == pytest.approx(0.5, rel=1e-3)
    assert coefficient(model, [2, 0]) == pytest.approx(-0.0005, rel=1e-2)


def test_under_reading_noise_the_weak_form_runs_free_where_single_increments_do_not():
    log = radiating_log(1500)
    log["t"].values[:] += 0.3 * np.random.default_rng(7).standard_normal(1500)
    grid, other = make_grid([log], average=1.0), radiating_log(800, seed=5)
    errors = []
    for width in (0, 36):
        model = sindy_model(grid, degree=2, threshold=0.0, width=width)
        y, _ = model.rollout([[25.0]], other["q"].values[None, :, None], np.zeros((1, 800, 0)), (), 1.0)
        errors.append(np.sqrt(np.mean((y[0, :-1, 0] - other["t"].values) ** 2)))
    assert errors[1] < 0.5 * errors[0]


def test_a_run_shorter_than_the_bump_is_refused():
    with pytest.raises(UserError, match="lack data"):
        sindy_model(make_grid([radiating_log(60)], average=1.0), degree=1, width=100)


def test_a_larger_threshold_keeps_fewer_terms():
    grid = make_grid([radiating_log()], average=1.0)
    sizes = [np.count_nonzero(sindy_model(grid, degree=2, threshold=h).coefficients) for h in (0.0, 0.2)]
    assert sizes[1] <= sizes[0]


def test_several_logs_of_different_length_are_fitted_together():
    logs = [radiating_log(300, seed=1, name="a"), radiating_log(500, seed=2, name="b")]
    model = sindy_model(make_grid(logs, average=1.0), degree=2, threshold=0.001)
    assert coefficient(model, [0, 1]) == pytest.approx(0.5, rel=1e-2)


def test_rollout_is_step_and_casadi_runs_the_same_lines():
    model = sindy_model(make_grid([radiating_log()], average=1.0), degree=2, memory=2)
    rng = np.random.default_rng(0)
    u, x0 = rng.random((1, 30, 1)), np.array([[30.0, 29.5], [26.0, 26.0]])
    _, x_end = model.rollout(x0, u, np.zeros((1, 30, 0)), (), 1.0)
    for b in range(2):
        x = list(x0[b])
        for k in range(30):
            x = model.step(x, u[0, k], [], (), 1.0)
        np.testing.assert_allclose(x_end[b], x, rtol=1e-9)
    xs, us = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    step = ca.Function(
        "step", [xs, us], [ca.vertcat(*model.step(ca.vertsplit(xs), ca.vertsplit(us), [], (), 1.0))]
    )
    np.testing.assert_allclose(
        np.asarray(step(x0[0], 0.3)).ravel(), model.step(x0[0], [0.3], [], (), 1.0), rtol=1e-12
    )


def test_equations_that_diverge_are_infinite_not_wrong_and_are_refused():
    runaway = SindyModel(("q",), (), ("t",), (), 1.0, 1, [[0, 0], [2, 0]], [[0.0, 1.0]], [20.0], [30.0])
    y, _ = runaway.rollout([[25.0], [0.5]], np.zeros((1, 50, 1)), np.zeros((1, 50, 0)), (), 1.0)
    assert np.isinf(y[0, -1])
    assert np.isfinite(y[1]).all()  # each member of the batch for itself
    with pytest.raises(UserError, match="diverge in simulation or lack data"):
        sindy_model(make_grid([radiating_log(30)], average=1.0), degree=3, memory=3)


def test_a_higher_threshold_is_a_smaller_structure_and_a_higher_degree_a_larger_one():
    family = sindy_family(make_grid([radiating_log(600)], average=1.0))
    sizes = {tuple(structure.label.split(", ")[:3]): structure.size for structure in family}
    for kind in {key[:2] for key in sizes}:
        by_threshold = [sizes[key] for key in sorted((k for k in sizes if k[:2] == kind), key=_threshold)]
        assert by_threshold == sorted(by_threshold, reverse=True)
    at_one = {key[0]: size for key, size in sizes.items() if key[1] == "memory 1"}
    assert list(at_one.values()) == sorted(at_one.values())


def _threshold(key):
    return float(key[2].removeprefix("threshold "))


def test_the_family_holds_only_bounded_models():
    grid = make_grid([radiating_log(600)], average=1.0)
    family = sindy_family(grid)
    assert family
    for model in family.values():
        segment = grid.segments[0]
        y, _ = model.rollout(
            model.rest(segment.y[0], (), (), ())[None], segment.u[None], segment.d[None], (), 1.0
        )
        assert np.isfinite(y).all()


def test_a_dict_makes_the_model_again_and_a_broken_one_is_refused():
    model = sindy_model(make_grid([radiating_log(600)], average=1.0))
    again = SindyModel.from_dict(model.to_dict())
    assert again.equations() == model.equations()
    assert model.to_dict()["equations"] == list(model.equations())
    with pytest.raises(UserError, match="not a SINDy model"):
        SindyModel.from_dict(model.to_dict() | {"coefficients": [[1.0]]})
