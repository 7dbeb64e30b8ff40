"""The mode of the posterior, and how far a coarser simulation moves it.

Gauss-Newton with the covariance C of :mod:`~thermogrip.sysid.discrepancy` held: with residual r and
sensitivity J at z, in units in which the prior is N(0, 1),

    z+ = (1 + J' C^-1 J)^-1 J' C^-1 (r + J z),

halved until the posterior itself, simulated anew, does not fall.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from thermogrip.sysid.discrepancy import Discrepancy, LogResiduals
from thermogrip.sysid.likelihood import Bins, linearise

__all__ = ["find_mode", "mode_shift", "step_change"]

Array = NDArray[np.float64]


def find_mode(
    bins: Bins, z: Array, discrepancy: Discrepancy, linear: Sequence[LogResiduals], *, n_iterations: int = 8
) -> tuple[Array, Array, float]:
    """Return mode (n_free,), posterior covariance (n_free, n_free), and how far it moved.

    Parameters
    ----------
    bins : Bins
    z : (n_free,) ndarray
        Start, in prior units.
    discrepancy : Discrepancy
        Numbers of the covariance, held.
    linear : sequence of LogResiduals
        Linearisation at ``z``.
    n_iterations : int, optional
        Steps at most.

    Returns
    -------
    z, covariance : ndarray
    moved : float
        Largest move in posterior standard deviations.
    """
    roots = [cholesky(discrepancy.covariance(log), lower=True) for log in linear]
    begin, cost = z, _cost(bins, z, roots)
    for _ in range(n_iterations):
        full, spread = _gauss_newton(z, roots, linear)
        shares = 0.5 ** np.arange(8)
        tried = z + shares[:, None] * (full - z)
        costs = _cost(bins, tried, roots)
        best = int(np.argmin(costs))
        if not costs[best] < cost - 1e-3:
            break
        z, cost = tried[best], costs[best]
        linear = linearise(bins, z)
    _, spread = _gauss_newton(z, roots, linear)
    return z, spread, float(np.max(np.abs(z - begin) / np.sqrt(np.diag(spread))))


def step_change(bins: Bins, fine: Bins, z: Array) -> list[Array]:
    """Return what the residuals at z would change by with the step of ``fine``, an array (n,) per log [K].

    Both must have the same width of bins; the last bin of a segment may be in one of them only.
    """
    out = []
    both = zip(bins.keys(), fine.keys(), bins.residuals(z[None]), fine.residuals(z[None]))
    for keys, fine_keys, coarse, exact in both:
        found = dict(zip(fine_keys, exact[0]))
        out.append(np.array([found.get(key, r) - r for key, r in zip(keys, coarse[0])]))
    return out


def mode_shift(
    change: Sequence[Array], discrepancy: Discrepancy, linear: Sequence[LogResiduals], spread: Array
) -> float:
    """Return how far this change of the residuals moves the mode, in posterior standard deviations.

    Of the parameter that moves most; ``spread`` (n_free, n_free) is the posterior covariance.
    """
    pull = np.zeros(len(spread))
    for log, moved in zip(linear, change):
        root = cholesky(discrepancy.covariance(log), lower=True)
        b = solve_triangular(root, log.sensitivity, lower=True)
        pull += b.T @ solve_triangular(root, moved, lower=True)
    return float(np.max(np.abs(spread @ pull) / np.sqrt(np.diag(spread))))


def _cost(bins: Bins, z: Array, roots: Sequence[Array]) -> Array:
    """Return -ln posterior (B,) at z (B, n_free) or (n_free,), up to a constant; inf outside the bounds."""
    z = np.atleast_2d(z)
    cost = 0.5 * np.einsum("bi,bi->b", z, z)
    for root, r in zip(roots, bins.residuals(z)):
        e = solve_triangular(root, r.T, lower=True, check_finite=False)
        cost = cost + 0.5 * np.einsum("ib,ib->b", e, e)
    usable = bins.prior.inside(bins.prior.natural(z)) & np.isfinite(cost)
    return np.where(usable, cost, np.inf)


def _gauss_newton(z: Array, roots: Sequence[Array], linear: Sequence[LogResiduals]) -> tuple[Array, Array]:
    """Return the next estimate and the posterior covariance there."""
    information, pull = np.eye(z.size), np.zeros(z.size)
    for root, log in zip(roots, linear):
        b = solve_triangular(root, log.sensitivity, lower=True)
        information += b.T @ b
        pull += b.T @ solve_triangular(root, log.residual + log.sensitivity @ z, lower=True)
    factor = cho_factor(information)
    return cho_solve(factor, pull), cho_solve(factor, np.eye(z.size))
