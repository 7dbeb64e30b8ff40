"""Levenberg-Marquardt in a box: against SciPy, an expansion by hand, and what it must not touch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from thermogrip.sysid.greybox.levenberg_marquardt import Solution, levenberg_marquardt

Array = np.ndarray
FAR = 1e6


def solve(r: Callable[[Array], Array], J: Callable[[Array], Array], z0: Any, **options: Any) -> Solution:
    """Minimise r (k, n) -> (k, m) with Jacobian J (n,) -> (m, n)."""
    z0 = np.atleast_1d(np.asarray(z0, float))
    usual: dict[str, Any] = {"low": np.full(z0.size, -FAR), "high": np.full(z0.size, FAR)}
    return levenberg_marquardt(lambda z: (r(z[None])[0], J(z)), r, z0, **usual | options)


@pytest.mark.parametrize("seed", range(6))
def test_the_least_squares_inside_a_box_are_those_of_scipy(seed: int):
    rng = np.random.default_rng(seed)
    M, b = rng.normal(size=(12, 4)), 3.0 * rng.normal(size=12)
    low, high = -rng.uniform(0.1, 1.0, 4), rng.uniform(0.1, 1.0, 4)

    def r(z: Array) -> Array:
        return z @ M.T + 0.1 * z[:, :1] ** 2 - b

    def J(z: Array) -> Array:
        return M + 0.2 * np.outer(np.ones(12), [z[0], 0.0, 0.0, 0.0])

    for start in (low, high, np.zeros(4), np.array([low[0], high[1], 9.0, -9.0])):  # also from outside
        ours = solve(r, J, start, low=low, high=high, tolerance=1e-14, iterations=200)
        theirs = least_squares(
            lambda z: r(z[None])[0], np.zeros(4), bounds=(low, high), xtol=1e-14, ftol=1e-14
        )
        np.testing.assert_allclose(ours.z, theirs.x, atol=1e-5)
        assert ours.cost == pytest.approx(2 * theirs.cost)
        assert np.any((ours.z == low) | (ours.z == high))


@pytest.mark.parametrize(("bend", "y"), [(0.4, 0.1), (-0.6, 0.1), (0.4, -0.2)])
def test_one_step_follows_the_valley_to_third_order(bend: float, y: float):
    """Of z + c z^2 / 2 = y a straight step gives y, one with its acceleration y - c y^2 / 2."""
    steep = 1e4  # so that the damping is nothing beside it

    def r(z: Array) -> Array:
        return steep * (z + bend * z**2 / 2 - y)

    one = solve(r, lambda z: np.array([[steep * (1 + bend * z[0])]]), 0.0, iterations=1)
    assert one.z[0] == pytest.approx(y - bend * y**2 / 2, abs=1e-7)
    assert (one.iterations, one.converged) == (1, False)


def test_no_point_outside_the_box_is_ever_asked_for():
    asked: list[Array] = []
    low, high = np.array([0.5, -2.0]), np.array([3.0, 0.2])

    def r(z: Array) -> Array:
        asked.append(z)
        return np.stack([10 * (z[:, 1] - z[:, 0] ** 2), 1 - z[:, 0], z[:, 1] + 5], axis=1)

    def J(z: Array) -> Array:
        asked.append(z[None])
        return np.array([[-20 * z[0], 10.0], [-1.0, 0.0], [0.0, 1.0]])

    solve(r, J, [9.0, 9.0], low=low, high=high)
    points = np.vstack(asked)
    assert np.all((points >= low) & (points <= high))


def test_what_cannot_be_simulated_never_wins():
    def r(z: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.hstack([np.log(z) - np.log(0.1), 0.01 * z])  # NaN below nought

    found = solve(r, lambda z: np.array([[1 / z[0]], [0.01]]), 5.0, iterations=100)
    assert found.converged
    assert found.z[0] == pytest.approx(0.1, rel=1e-3)


def test_a_direction_that_is_hardly_felt_is_followed_with_less_damping():
    J = np.diag([1.0, 1e-3])
    found = solve(lambda z: (z - 1.0) @ J.T, lambda z: J, [0.0, 0.0], iterations=12, tolerance=1e-12)
    np.testing.assert_allclose(found.z, 1.0, atol=1e-3)


def test_the_callback_gets_every_step_and_its_cost():
    reported: list[tuple[int, float]] = []

    def r(z: Array) -> Array:
        return np.stack([10 * (z[:, 1] - z[:, 0] ** 2), 1 - z[:, 0], 0 * z[:, 0] + 3.0], axis=1)

    def J(z: Array) -> Array:
        return np.array([[-20 * z[0], 10.0], [-1.0, 0.0], [0.0, 0.0]])

    found = solve(r, J, [-1.2, 1.0], callback=lambda at, cost: reported.append((at, cost)), tolerance=1e-8)
    costs = [cost for _, cost in reported]
    assert costs == sorted(costs, reverse=True)
    assert costs[0] < r(np.array([[-1.2, 1.0]]))[0] @ r(np.array([[-1.2, 1.0]]))[0]
    assert found.cost == costs[-1] == found.residual @ found.residual
    assert found.converged
    assert found.iterations == reported[-1][0] + 1  # they count from nought
    np.testing.assert_array_equal(found.jacobian, J(found.z))


def test_a_start_that_cannot_be_improved_is_where_it_ends():
    found = solve(lambda z: z - 2.0, lambda z: np.eye(1), 2.0)
    assert (found.z.tolist(), found.converged) == ([2.0], True)
    held = solve(lambda z: z - 2.0, lambda z: np.eye(1), 1.0, low=np.zeros(1), high=np.ones(1))
    assert (held.z.tolist(), held.converged) == ([1.0], True)


def test_a_step_that_bends_too_far_is_taken_straight():
    """z + c z^2 / 2 = y: half of the bend, -c y^2, is more than 0.75 of the step y from |c y| = 1.5 on."""
    for y, found in ((1.4, 1.4 - 1.4**2 / 2), (1.6, None)):
        asked = []

        def r(z, y=y, asked=asked):
            asked.append(z)
            return 1e4 * (z + z**2 / 2 - y)

        solve(r, lambda z: np.array([[1e4 * (1 + z[0])]]), 0.0, iterations=1)
        bent = asked[2][5:, 0]  # those straight come first
        straight = asked[2][:5, 0]
        np.testing.assert_allclose(asked[1][:, 0], 0.1 * straight)
        if found is None:
            np.testing.assert_array_equal(bent, straight)
        else:
            np.testing.assert_allclose(bent[0], found, rtol=1e-5)
    np.testing.assert_allclose(straight, 1.6 * 1e8 / (1e8 + np.array([1e-2, 0.1, 1.0, 10.0, 100.0])))
