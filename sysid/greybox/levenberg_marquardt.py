"""Bounded least squares for models with long curved valleys: Levenberg-Marquardt with geodesic acceleration.

    min |r(z)|^2,  low <= z <= high.

A thermal network has combinations of parameters that its logs hardly determine, so the cost is a narrow
curved valley and plain Gauss-Newton steps, which are straight, leave it at once. With J the Jacobian, the
step

    v = -(J'J + lambda)^-1 J'r            is followed by half of
    a = -(J'J + lambda)^-1 J' r_vv,       r_vv = (2 / h^2) (r(z + h v) - r(z) - h J v),

which bends with the valley (Transtrum and Sethna [1]_). Several lambda are tried at once, straight and
bent, each set of trials in one batch: for a simulator that runs many parameter sets side by side they are
cheaper than the Jacobian. A coordinate on its bound whose step would leave the box is held there.

References
----------
.. [1] M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear
   least-squares minimization", arXiv 1201.5885 (2012).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DAMPINGS = np.array([1e-2, 0.1, 1.0, 10.0, 100.0])  # times the damping that last succeeded
_PROBE = 0.1  # of the step, for the second derivative along it
_HUGE = 1e150  # residuals beyond it would overflow when squared


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the fit ended."""

    z: Array  # (n,)
    cost: float  # |r|^2 there
    residual: Array  # (m,)
    jacobian: Array  # (m, n)
    iterations: int
    converged: bool  # False: the iterations ran out


class _Trial(NamedTuple):
    z: Array
    cost: float
    damping: float


def levenberg_marquardt(
    linearise: Callable[[Array], tuple[Array, Array]],
    residuals: Callable[[Array], Array],
    z0: Array,
    *,
    low: Array,
    high: Array,
    iterations: int = 60,
    tolerance: float = 1e-5,
    callback: Callable[[int, float], None] | None = None,
) -> Solution:
    """Minimise |r|^2 inside a box, from ``z0`` (n,).

    ``linearise`` returns r (m,) and J (m, n) at a point, ``residuals`` r (k, m) at k points.  It has
    converged where a step lowers |r|^2 by less than ``tolerance`` of it, or no damping lowers it any more;
    else it ends after ``iterations`` linearisations.  ``callback`` gets the number and the cost of each step.
    """
    z, damping = np.clip(z0, low, high), 1.0
    residual, jacobian = linearise(z)
    cost = float(residual @ residual)
    for iteration in range(iterations):
        trial = _best_trial(residuals, z, residual, jacobian, low, high, damping)
        if not trial.cost < cost:
            if damping >= 1e8:
                return Solution(z, cost, residual, jacobian, iteration, True)
            damping *= 1e4
            continue
        fall, z, damping = cost - trial.cost, trial.z, float(np.clip(trial.damping, 1e-6, 1e8))
        residual, jacobian = linearise(z)
        cost = float(residual @ residual)
        if callback is not None:
            callback(iteration, cost)
        if fall < tolerance * trial.cost:
            return Solution(z, cost, residual, jacobian, iteration + 1, True)
    return Solution(z, cost, residual, jacobian, iterations, False)


def _best_trial(
    residuals: Callable[[Array], Array], z: Array, r: Array, J: Array, low: Array, high: Array, damping: float
) -> _Trial:
    """Return the best of several damped steps, straight and bent."""
    gradient, normal = J.T @ r, J.T @ J
    held = ((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0))
    free = np.flatnonzero(~held)
    if free.size == 0:
        return _Trial(z, np.inf, damping)
    size, axes = np.linalg.eigh(normal[np.ix_(free, free)])
    inverse = 1.0 / (np.maximum(size, 0.0) + damping * _DAMPINGS[:, None])  # (n_damping, n_free)

    def solve(right: Array) -> Array:
        """Return -(J'J + lambda)^-1 right for each lambda; right (n_damping or 1, n)."""
        out = np.zeros((len(_DAMPINGS), len(z)))
        out[:, free] = -(inverse * (right[:, free] @ axes)) @ axes.T
        return out

    step = solve(gradient[None])
    probe = _bounded(residuals(np.clip(z + _PROBE * step, low, high)))
    curvature = 2.0 / _PROBE**2 * (probe - r - _PROBE * step @ J.T)
    bend = solve(curvature @ J)
    # a bend longer than the step: the expansion is not valid there
    longer = np.linalg.norm(bend, axis=1) > 1.5 * np.linalg.norm(step, axis=1)
    bend[longer] = 0.0
    trials = np.clip(np.concatenate([z + step, z + step + bend / 2]), low, high)
    cost = (_bounded(residuals(trials)) ** 2).sum(axis=1)
    at = int(np.argmin(cost))
    return _Trial(trials[at], float(cost[at]), float(damping * _DAMPINGS[at % len(_DAMPINGS)]))


def _bounded(r: Array) -> Array:
    """Replace what is not finite by a huge residual, so that it never wins and never overflows."""
    return np.asarray(np.clip(np.nan_to_num(r, nan=_HUGE, posinf=_HUGE, neginf=-_HUGE), -_HUGE, _HUGE))
