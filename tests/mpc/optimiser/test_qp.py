"""The QP against its optimality conditions, an independent solver, and what it must refuse."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from thermogrip.mpc.optimiser.qp import LEAST_QUADRATIC, CondensedQP


def random_problem(seed: int) -> tuple:
    """Return a feasible QP with hard and soft rows, its unknowns and rows of very unlike size."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 7)), int(rng.integers(1, 12))
    root = rng.normal(size=(n + 2, n)) * 10 ** rng.uniform(-2, 2, size=n)
    H = root.T @ root + 1e-6 * np.diag(np.diag(root.T @ root))
    f = rng.normal(size=n) * np.sqrt(np.diag(H))
    A = rng.normal(size=(m, n)) * 10 ** rng.uniform(-1, 1, size=(m, 1))
    inside = A @ (rng.normal(size=n) / np.sqrt(np.diag(H)))
    lower, upper = inside - rng.uniform(0.01, 1, m), inside + rng.uniform(0.01, 1, m)
    soft = rng.random(m) < 0.5
    shift = np.where(soft, 2 * rng.normal(size=m), 0.0)  # soft rows may contradict each other
    w, q = rng.uniform(0, 3, m), rng.uniform(0, 3, m) * (rng.random(m) < 0.7)
    return H, f, A, lower + shift, upper + shift, soft, w, q


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10**6))
@example(9345)  # a short row whose penalty is linear alone
def test_the_answer_fulfils_the_optimality_conditions(seed):
    H, f, A, lower, upper, soft, w, q = random_problem(seed)
    qp = CondensedQP(soft=soft, linear=w, quadratic=q)
    for _ in range(2):  # cold, then from the active set of the first
        answer = qp.solve(H, f, A, lower, upper)
        assert answer.solved
        unit = np.sqrt(np.diag(H))
        np.testing.assert_allclose((H @ answer.x + f + A.T @ answer.multipliers) / unit, 0, atol=1e-6)
        value, lam = A @ answer.x, answer.multipliers
        length = np.linalg.norm(A / unit, axis=1)
        tolerance = 1e-5 * length + 1e-9
        assert np.all((value <= upper + tolerance) | soft)
        assert np.all((value >= lower - tolerance) | soft)
        # a multiplier is only where its bound is active, and a soft one costs what its slack says
        assert np.all(
            (np.abs(lam) * length < 1e-7)
            | (np.minimum(np.abs(value - upper), np.abs(value - lower)) < tolerance)
            | soft
        )
        assert np.all(lam[value > upper + tolerance] > -1e-9)
        assert np.all(lam[value < lower - tolerance] < 1e-9)
        slack = np.maximum(value - upper, lower - value)
        broken = soft & (slack > 10 * tolerance)
        penalty = w + np.maximum(q, LEAST_QUADRATIC / length**2) * slack
        np.testing.assert_allclose(np.abs(lam)[broken], penalty[broken], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("seed", range(12))
def test_an_independent_solver_finds_the_same_cost(seed):
    H, f, A, lower, upper, soft, w, q = random_problem(seed)
    answer = CondensedQP(soft=soft, linear=w, quadratic=q).solve(H, f, A, lower, upper)
    scale = 1 / np.sqrt(np.diag(H))

    def slack(x):
        return np.maximum(0, np.maximum(A @ x - upper, lower - A @ x))[soft]

    def cost(x):
        s = slack(x)
        return 0.5 * x @ H @ x + f @ x + w[soft] @ s + 0.5 * q[soft] @ s**2

    hard = ~soft
    rules = [
        {"type": "ineq", "fun": lambda z: (upper - A @ (z * scale))[hard]},
        {"type": "ineq", "fun": lambda z: (A @ (z * scale) - lower)[hard]},
    ]
    found = min(
        (
            minimize(
                lambda z: cost(z * scale), start, method="SLSQP", constraints=rules, options={"maxiter": 500}
            )
            for start in (answer.x / scale, answer.x / scale + 0.1, np.zeros(f.size))
        ),
        key=lambda result: result.fun if result.success else np.inf,
    )
    assert cost(answer.x) <= found.fun + 1e-5 * (1 + abs(found.fun))


def test_contradicting_hard_rows_are_infeasible_and_the_next_solve_starts_afresh():
    qp = CondensedQP(soft=[False, False], linear=[0, 0], quadratic=[0, 0])
    A, far = np.array([[1.0], [1.0]]), np.inf
    bad = qp.solve(np.eye(1), np.zeros(1), A, np.array([1.0, -far]), np.array([far, 0.0]))
    assert bad.status == "infeasible"
    assert np.isnan(bad.x).all()
    good = qp.solve(np.eye(1), np.zeros(1), A, np.array([1.0, -far]), np.array([far, 3.0]))
    np.testing.assert_allclose(good.x, [1.0])


@pytest.mark.parametrize(
    ("H", "f", "status"),
    [([[np.nan]], [0.0], "not finite"), ([[1.0]], [np.inf], "not finite"), ([[-1.0]], [0.0], "not convex")],
)
def test_numbers_that_are_none_give_a_status(H, f, status):
    qp = CondensedQP(soft=[False], linear=[0], quadratic=[0])
    answer = qp.solve(np.array(H), np.array(f), np.ones((1, 1)), -np.ones(1), np.ones(1))
    assert answer.status == status


def test_the_iteration_limit_is_a_status():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(30, 30))
    qp = CondensedQP(soft=np.zeros(60, bool), linear=np.zeros(60), quadratic=np.zeros(60), iteration_limit=2)
    A = rng.normal(size=(60, 30))
    answer = qp.solve(
        root @ root.T + np.eye(30), 50 * rng.normal(size=30), A, -np.full(60, 0.1), np.full(60, 0.1)
    )
    assert answer.status == "iteration limit"


def test_soft_rows_are_broken_at_either_end_at_their_price_and_a_hard_one_is_kept():
    """Nearest to (3, -3) with x1 <= 1 and x2 >= -1 at a penalty of half a unit, and x1 + x2 = 0 hard."""
    A = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    solver = CondensedQP(soft=[True, True, False], linear=[0.5, 0.5, 0.0], quadratic=[0.0, 0.0, 0.0])
    answer = solver.solve(
        np.eye(2), np.array([-3.0, 3.0]), A, np.array([-np.inf, -1.0, 0.0]), np.array([1.0, np.inf, 0.0])
    )
    np.testing.assert_allclose(answer.x, [2.5, -2.5], atol=1e-6)
    np.testing.assert_allclose(answer.multipliers[:2], [0.5, -0.5], atol=1e-6)


@pytest.mark.parametrize("soft", [True, False])
def test_a_row_that_contradicts_itself_is_an_answer_with_a_status(soft: bool):
    """x >= 2 and x <= 1: no exception, and the next solve is as any other."""
    solver = CondensedQP(soft=[soft], linear=[1.0], quadratic=[0.0])
    ask = (np.eye(1), np.array([-1.5]), np.ones((1, 1)))
    for _ in range(2):
        assert solver.solve(*ask, np.array([2.0]), np.array([1.0])).status == "infeasible"
        found = solver.solve(*ask, np.array([-1.0]), np.array([1.0]))
        np.testing.assert_allclose(found.x, [1.0], atol=1e-6)


@pytest.mark.parametrize(("soft", "status"), [(True, "solved"), (False, "infeasible")])
def test_ends_that_cross_by_a_rounding_are_infeasible_where_the_row_is_hard(soft: bool, status: str):
    solver = CondensedQP(soft=[soft], linear=[1.0], quadratic=[1.0])
    ends = np.array([1.0 + 1e-13]), np.array([1.0])
    answer = solver.solve(np.eye(1), np.array([-3.0]), np.ones((1, 1)), *ends)
    assert answer.status == status
    if soft:  # 0.5 (x - 3)^2 + s + 0.5 s^2 with s = x - 1
        np.testing.assert_allclose(answer.x, [1.5], atol=1e-9)


def test_a_hard_row_of_nothing_is_not_overlooked():
    """0 x >= 1 is infeasible; the same at a penalty is paid whatever x is."""
    H, f, A = np.eye(2), np.array([-1.0, 0.0]), np.zeros((1, 2))
    for soft, status in ((False, "infeasible"), (True, "solved")):
        solver = CondensedQP(soft=[soft], linear=[1.0], quadratic=[0.0])
        answer = solver.solve(H, f, A, np.array([1.0]), np.array([np.inf]))
        assert answer.status == status
    np.testing.assert_allclose(answer.x, [1.0, 0.0], atol=1e-9)


FLAGS = {
    2: "solved", 0: "solver flag 0", -1: "infeasible", -2: "cycling", -3: "unbounded", -4: "iteration limit",
    -5: "not convex", -6: "bad start", -7: "time limit", -8: "solver flag -8",
}  # fmt: skip


@pytest.mark.parametrize(("flag", "status"), FLAGS.items())
@pytest.mark.parametrize("z", [0.5, np.nan])
def test_a_flag_of_the_solver_is_a_status_and_no_number_is_no_solution(monkeypatch, flag, status, z):
    solver = CondensedQP(soft=[False], linear=[0.0], quadratic=[0.0])
    answer = np.full(1, z), 0.0, flag, {"lam": np.full(1, 6.0), "iterations": 7}
    done = SimpleNamespace(setup=lambda *_: (1, 0.0), soft_weights=lambda *_: None, solve=lambda: answer)
    monkeypatch.setattr("daqp.Model", lambda: done)
    found = solver.solve(np.array([[4.0]]), np.zeros(1), np.array([[3.0]]), -np.ones(1), np.ones(1))
    solved = flag > 0 and np.isfinite(z)
    assert found.status == ("not finite" if flag > 0 and not solved else status)
    assert (found.solved, found.iterations) == (solved, 7)
    # x = z / 2; a row of length 3 / 2
    np.testing.assert_equal([found.x, found.multipliers], [[0.25], [4]] if solved else [[np.nan], [0]])


def test_rows_of_another_shape_are_refused():
    solver = CondensedQP(soft=[True, False], linear=[0.0, 0.0], quadratic=[0.0, 0.0])
    with pytest.raises(ValueError, match=r"A is \(1, 1\), not \(2, 1\)"):
        solver.solve(np.eye(1), np.zeros(1), np.eye(1), np.zeros(1), np.zeros(1))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_breaking_a_row_costs_is_in_its_own_units(side):
    """2 x^2 - 12 x + s + 1.5 s^2 with s = 2 x - 2 is least at x = 22/16."""
    solver = CondensedQP(soft=[True], linear=[1.0], quadratic=[3.0])
    far = np.array([np.inf])
    lower, upper = (-far, np.array([2.0])) if side > 0 else (np.array([-2.0]), far)
    found = solver.solve(np.array([[4.0]]), np.array([-12.0 * side]), np.array([[2.0]]), lower, upper)
    np.testing.assert_allclose(found.x, [1.375 * side], rtol=1e-8)
    np.testing.assert_allclose(found.multipliers, [3.25 * side], rtol=1e-7)
    assert found.iterations > 0
