"""The dual active-set method in C: against DAQP, optimality, and what it must refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import solve_in_c
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.runtime import CompiledController, compiler
from thermogrip.mpc.optimiser.qp import CondensedQP

needs_gcc = pytest.mark.skipif(compiler() is None, reason="no gcc here")


def random_problem(seed: int) -> tuple:
    """Return a QP as the controller has it: bounds, slews, soft rows that may contradict each other."""
    rng = np.random.default_rng(seed)
    n, s = int(rng.integers(1, 11)), int(rng.integers(0, 25))
    root = rng.normal(size=(n + 3, n)) * 10 ** rng.uniform(-1, 1, size=n)
    H = root.T @ root + 1e-3 * np.diag(np.diag(root.T @ root))
    f = 5 * rng.normal(size=n) * np.sqrt(np.diag(H))
    A = np.vstack([np.eye(n), np.eye(n) - np.eye(n, k=-1), rng.normal(size=(s, n))])
    lower = np.concatenate([np.full(n, -0.5), np.full(n, -0.15), rng.normal(size=s) - 1])
    upper = np.concatenate([np.full(n, 0.5), np.full(n, 0.15), lower[2 * n :] + rng.uniform(0, 3, s)])
    lower[2 * n :][rng.random(s) < 0.3] = -np.inf
    upper[2 * n :][rng.random(s) < 0.3] = np.inf
    return H, f, A, lower, upper, np.arange(2 * n + s) >= 2 * n, rng.uniform(0, 30), rng.uniform(1, 100)


def by_daqp(H, f, A, lower, upper, soft, linear: float, quadratic: float):
    """Return DAQP's answer, each soft row at the same penalties."""
    weights = np.full(soft.size, linear), np.full(soft.size, quadratic)
    return CondensedQP(soft=soft, linear=weights[0], quadratic=weights[1]).solve(H, f, A, lower, upper)


@pytest.mark.parametrize("seed", range(10))
def test_daqps_answer_is_the_minimiser(seed):
    H, f, A, *ends = random_problem(seed)
    daqp = by_daqp(H, f, A, *ends)
    gradient = (H @ daqp.x + f + A.T @ daqp.multipliers) / np.sqrt(np.diag(H))
    np.testing.assert_allclose(gradient, 0, atol=1e-7)


@pytest.fixture(scope="module")
def in_c(tank_maker) -> CompiledController:
    plant = tank_maker()
    return CompiledController(Controller(plant, default_design(plant)))


@needs_gcc
@pytest.mark.parametrize("seed", range(60))
def test_c_finds_what_daqp_finds(in_c, seed):
    H, f, A, lower, upper, soft, linear, quadratic = random_problem(seed)
    daqp = by_daqp(H, f, A, lower, upper, soft, linear, quadratic)
    rows = A[2 * f.size :]
    x, status, _ = solve_in_c(in_c, H, f, rows, lower, upper, linear=linear, quadratic=quadratic)
    assert status == "solved"
    np.testing.assert_allclose(x, daqp.x, atol=1e-9)


@needs_gcc
def test_a_range_that_a_sum_of_slews_ends_on_is_no_trouble(in_c):
    # ten steps of 0.1 from 0 end on the range's 1.0: eleven rows, ten unknowns
    n = 10
    upper = np.concatenate([np.full(n, 1.0), np.full(n, 0.1)])
    weights = {"linear": 1.0, "quadratic": 1.0}
    x, status, _ = solve_in_c(in_c, np.eye(n), np.full(n, -50.0), np.zeros((0, n)), -upper, upper, **weights)
    assert status == "solved"
    np.testing.assert_allclose(x, 0.1 * np.arange(1, n + 1), atol=1e-9)


@needs_gcc
@pytest.mark.parametrize("seed", range(30))
def test_c_from_the_last_working_set_finds_the_same_answer(in_c, seed):
    H, f, A, lower, upper, _, linear, quadratic = random_problem(seed)
    rows, weights = A[2 * f.size :], {"linear": linear, "quadratic": quadratic}
    solve_in_c(in_c, H, f, rows, lower, upper, **weights)
    near = f * 1.01
    x, status, warm = solve_in_c(in_c, H, near, rows, lower, upper, **weights, warm=True)
    cold, _, iterations = solve_in_c(in_c, H, near, rows, lower, upper, **weights)
    assert status == "solved"
    assert warm <= iterations
    np.testing.assert_allclose(x, cold, atol=1e-9)


@pytest.fixture(scope="module")
def in_c_of_fifty(tank_maker) -> CompiledController:
    plant = tank_maker()
    return CompiledController(Controller(plant, replace(default_design(plant), blocks=(1,) * 50)))


@needs_gcc
@pytest.mark.parametrize("n", [49, 50])
@pytest.mark.parametrize("width", [0.02, 0.6, 1.2])
def test_c_takes_a_long_set_up_again(in_c_of_fifty, n, width):
    """Its factor is made four rows at once, that of H two, and the last of both are not whole groups."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    H, f, rows = root @ root.T / n + np.eye(n), 3 * rng.normal(size=n), rng.normal(size=(90, n)) / 7
    upper = np.concatenate([np.full(n, 0.8), np.full(n, 1.5), np.full(90, width)])
    weights = {"linear": 3.0, "quadratic": 1.0}
    A = np.vstack([np.eye(n), np.eye(n) - np.eye(n, k=-1), rows])
    soft = np.arange(2 * n + 90) >= 2 * n
    solve_in_c(in_c_of_fifty, H, f, rows, -upper, upper, **weights)
    near = 1.001 * f
    daqp = by_daqp(H, near, A, -upper, upper, soft, **weights)
    x, status, warm = solve_in_c(in_c_of_fifty, H, near, rows, -upper, upper, **weights, warm=True)
    assert status == "solved"
    assert warm < daqp.iterations / 4
    np.testing.assert_allclose(x, daqp.x, atol=1e-9)


@needs_gcc
def test_c_refuses_what_python_refuses(in_c):
    H, f, A, lower, upper, _, linear, quadratic = random_problem(3)
    rows, weights = A[2 * f.size :], {"linear": linear, "quadratic": quadratic}
    assert solve_in_c(in_c, H, np.nan * f, rows, lower, upper, **weights)[1] == "not finite"
    assert solve_in_c(in_c, -H, f, rows, lower, upper, **weights)[1] == "not convex"
    crossed = upper.copy()
    crossed[0] = lower[0] - 1
    assert solve_in_c(in_c, H, f, rows, lower, crossed, **weights)[1] == "infeasible"
