"""The dual active-set method, in NumPy and in C: against DAQP, optimality, and what it must refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import solve_in_c
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.runtime import CompiledController, compiler
from thermogrip.mpc.optimiser.active_set import ActiveSetQP
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


@pytest.mark.parametrize("seed", range(60))
def test_daqp_finds_the_same_answer(seed):
    H, f, A, lower, upper, soft, linear, quadratic = random_problem(seed)
    own = ActiveSetQP(soft=soft, linear=linear, quadratic=quadratic).solve(H, f, A, lower, upper)
    weights = np.full(soft.size, linear), np.full(soft.size, quadratic)
    daqp = CondensedQP(soft=soft, linear=weights[0], quadratic=weights[1]).solve(H, f, A, lower, upper)
    assert own.solved
    assert daqp.solved
    np.testing.assert_allclose(own.x, daqp.x, atol=1e-9)
    np.testing.assert_allclose(own.slack, daqp.slack, atol=1e-8)
    gradient = (H @ own.x + f + A.T @ own.multipliers) / np.sqrt(np.diag(H))
    np.testing.assert_allclose(gradient, 0, atol=1e-7)


def test_a_range_that_a_sum_of_slews_ends_on_is_no_trouble():
    # ten steps of 0.1 from 0 end on the range's 1.0: eleven rows, ten unknowns
    n = 10
    A = np.vstack([np.eye(n), np.eye(n) - np.eye(n, k=-1)])
    lower = np.concatenate([np.full(n, -1.0), np.full(n, -0.1)])
    qp = ActiveSetQP(soft=np.zeros(2 * n, bool), linear=1.0, quadratic=1.0)
    answer = qp.solve(np.eye(n), np.full(n, -50.0), A, lower, -lower)
    np.testing.assert_allclose(answer.x, 0.1 * np.arange(1, n + 1), atol=1e-9)


def test_hard_rows_that_contradict_each_other_are_infeasible():
    A = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 1.0]])
    lower, upper = np.array([0.5, -1, -1, -0.1]), np.array([1.0, 0.2, 1, 0.1])
    qp = ActiveSetQP(soft=np.zeros(4, bool), linear=1.0, quadratic=1.0)
    assert qp.solve(np.eye(2), np.zeros(2), A, lower, upper).status == "infeasible"


@pytest.mark.parametrize(("gap", "hard"), [(0.0, "solved"), (1e-13, "infeasible"), (1.0, "infeasible")])
def test_a_row_whose_ends_cross_is_infeasible_where_it_is_hard(gap: float, hard: str):
    for soft, status in ((False, hard), (True, "solved")):
        qp = ActiveSetQP(soft=np.array([soft]), linear=1.0, quadratic=1.0)
        ends = np.array([1.0 + gap]), np.array([1.0])
        answer = qp.solve(np.eye(1), np.array([-3.0]), np.ones((1, 1)), *ends)
        assert answer.status == status
    np.testing.assert_allclose([*answer.x, *answer.slack], [1.5, 0.5], atol=1e-9)


def test_what_is_no_number_is_reported_as_no_number():
    qp = ActiveSetQP(soft=np.zeros(1, bool), linear=1.0, quadratic=1.0)
    one = np.ones((1, 1))
    assert qp.solve(one, np.array([np.nan]), one, -np.ones(1), np.ones(1)).status == "not finite"


@pytest.fixture(scope="module")
def in_c(tank_maker) -> CompiledController:
    plant = tank_maker()
    return CompiledController(Controller(plant, default_design(plant)))


@needs_gcc
@pytest.mark.parametrize("seed", range(60))
def test_c_takes_the_same_rows_in_and_out(in_c, seed):
    H, f, A, lower, upper, soft, linear, quadratic = random_problem(seed)
    own = ActiveSetQP(soft=soft, linear=linear, quadratic=quadratic).solve(H, f, A, lower, upper)
    rows = A[2 * f.size :]
    x, status, iterations = solve_in_c(in_c, H, f, rows, lower, upper, linear=linear, quadratic=quadratic)
    assert status == "solved"
    assert iterations == own.iterations
    np.testing.assert_allclose(x, own.x, atol=1e-10)


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
    own = ActiveSetQP(soft=soft, **weights).solve(H, near, A, -upper, upper)
    x, status, warm = solve_in_c(in_c_of_fifty, H, near, rows, -upper, upper, **weights, warm=True)
    assert status == "solved"
    assert warm < own.iterations / 4
    np.testing.assert_allclose(x, own.x, atol=1e-9)


@needs_gcc
def test_c_refuses_what_python_refuses(in_c):
    H, f, A, lower, upper, _, linear, quadratic = random_problem(3)
    rows, weights = A[2 * f.size :], {"linear": linear, "quadratic": quadratic}
    assert solve_in_c(in_c, H, np.nan * f, rows, lower, upper, **weights)[1] == "not finite"
    assert solve_in_c(in_c, -H, f, rows, lower, upper, **weights)[1] == "not convex"
    crossed = upper.copy()
    crossed[0] = lower[0] - 1
    assert solve_in_c(in_c, H, f, rows, lower, crossed, **weights)[1] == "infeasible"


@pytest.mark.parametrize("seed", [3, 11, 27])
def test_the_iterations_that_are_needed_are_enough_and_one_less_is_not(seed):
    H, f, A, lower, upper, soft, linear, quadratic = random_problem(seed)
    given = {"soft": soft, "linear": linear, "quadratic": quadratic}
    need = ActiveSetQP(**given).solve(H, f, A, lower, upper).iterations
    assert need > 2
    assert ActiveSetQP(**given, iteration_limit=need).solve(H, f, A, lower, upper).status == "solved"
    short = ActiveSetQP(**given, iteration_limit=need - 1).solve(H, f, A, lower, upper)
    assert (short.status, short.iterations, np.isnan(short.x).all()) == ("iteration limit", need, True)


@pytest.mark.parametrize(("length", "answer"), [(0.9e-5, 3.0), (1.2e-5, None)])
def test_a_soft_row_too_short_to_be_kept_is_left_out(length, answer):
    """Nearest to 3 with a row that a distance of 1 / length would keep, at any price."""
    qp = ActiveSetQP(soft=np.array([True]), linear=1e9, quadratic=1.0)
    found = qp.solve(np.eye(1), np.array([-3.0]), np.array([[length]]), np.array([1.0]), np.array([np.inf]))
    assert found.solved
    assert (found.x[0] == pytest.approx(3.0)) == (answer is not None)
    assert found.slack[0] == pytest.approx(max(0.0, 1.0 - length * found.x[0]), abs=1e-9)
