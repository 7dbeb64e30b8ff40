"""The posterior of ln e on a grid that finds its own place.

Given ln e every other unknown is close to Gaussian, so Laplace's method serves there; ln e itself is not
(copper's posterior runs into the prior's edge, wood's is narrower than any fixed grid), so it gets a grid:
coarse over the prior, then twice refined where the mass is.  Between points the log density is interpolated
by a monotone cubic.

Close is not equal: where a touch bounds a heat capacity from one side alone, Laplace's method moves the ends
of the interval by a tenth of a standard deviation.  What it leaves out changes slowly with ln e, so it is
integrated (:func:`~thermogrip.sysid.effusivity_marginal.log_integrals`) at seven of the points, and the rest
interpolated.  Its mean over the posterior is left to Laplace's method: the candidates that the evidence is
compared with carry the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import logsumexp, ndtr

from thermogrip.sysid.effusivity_marginal import LN_E_RANGE, log_integrals
from thermogrip.sysid.grasp_data import Touches
from thermogrip.sysid.grasp_hypotheses import fit_pairs, free_hypotheses
from thermogrip.sysid.grasp_laplace import T_OBJECT, H
from thermogrip.sysid.gripper_device import Device

__all__ = ["LN_E_RANGE", "N_COARSE", "WIDEN", "GridPosterior"]
__all__ += ["grid_posteriors", "mixture_quantiles", "posterior_of", "refined"]

Array = NDArray[np.float64]

N_COARSE, _FINE = 26, 18
_FIRST_STEPS = 8
WIDEN = (12.0, 7.0)  # nats below the best point that a refinement still covers
_KNOTS, _REACH = 7, 8.0  # points to integrate at, and how far below the best they go [nat]


class GridPosterior(NamedTuple):
    """One grasp's posterior.

    ``x`` (n,) fine grid of ln e on the gripper's scale and ``mass`` (n,) of each point; ``log_evidence``
    under the log-uniform prior; at the m fitted points ``weight``, mean and sd of T_obj [degC], and ln h.
    """

    x: Array
    mass: Array
    log_evidence: float
    weight: Array
    t_object: Array
    t_object_sd: Array
    ln_h: Array


class _Fitted(NamedTuple):
    """Points ``x`` (n, m), log evidence, modes (n, m, 7), their covariances and whether they settled."""

    x: Array
    value: Array
    u: Array
    covariance: Array
    settled: NDArray[np.bool_]


def grid_posteriors(device: Device, data: Touches) -> list[GridPosterior]:
    """Return every grasp's posterior of ln e: log-uniform prior over :data:`LN_E_RANGE`, finish unknown."""
    n = data.level.size
    found = _evaluate(device, data, np.tile(np.linspace(*LN_E_RANGE, N_COARSE), (n, 1)), None)
    for widen in WIDEN:
        grid = np.stack([refined(found.x[i], found.value[i], widen) for i in range(n)])
        nearest = np.abs(grid[:, :, None] - found.x[:, None, :]).argmin(axis=2)
        start = np.take_along_axis(found.u, nearest[:, :, None], axis=1)
        more = _evaluate(device, data, grid, start)
        found = _Fitted(*(np.concatenate(pair, axis=1) for pair in zip(found, more)))
    return [_finished(device, data, found, i) for i in range(n)]


def _finished(device: Device, data: Touches, found: _Fitted, i: int) -> GridPosterior:
    x, u = found.x[i], found.u[i]
    value = found.value[i] + _left_out(device, data.take(np.array([i])), *(part[i] for part in found))
    sd = np.sqrt(found.covariance[i, :, T_OBJECT, T_OBJECT])
    return posterior_of(x, value, u[:, T_OBJECT], sd, u[:, H])


def _left_out(
    device: Device, data: Touches, x: Array, value: Array, u: Array, covariance: Array, settled: Array
) -> Array:
    """Return what Laplace's method left out at ``x`` (m,), less its mean over the posterior."""
    near = np.flatnonzero(settled & (value > value.max() - _REACH))
    near = near[np.argsort(x[near])]
    # with the gripper in doubt Laplace's method answers for its numbers too, and is left alone
    if near.size < _KNOTS or device.in_doubt:
        return np.zeros(x.size)
    wanted = np.linspace(x[near[0]], x[near[-1]], _KNOTS)
    at = near[np.unique(np.abs(x[near] - wanted[:, None]).argmin(axis=1))]
    missing = log_integrals(device, data, x[at], u[at], covariance[at]) - value[at]
    everywhere = PchipInterpolator(x[at], missing)(np.clip(x, x[at[0]], x[at[-1]]))
    order = np.argsort(x)
    weight = np.exp(value[order] - value.max()) * np.gradient(x[order])
    return np.asarray(everywhere - (weight * everywhere[order]).sum() / weight.sum())


def mixture_quantiles(weight: Array, mean: Array, sd: Array, levels: tuple[float, ...]) -> Array:
    """Return quantiles of a mixture of normals, (n_level,), by bisection of its distribution function.

    Examples
    --------
    >>> mixture_quantiles(np.array([1.0]), np.array([2.0]), np.array([1.0]), (0.05, 0.5)).round(3)
    array([0.355, 2.   ])
    """
    low = np.full(len(levels), (mean - 9 * sd).min())
    high = np.full(len(levels), (mean + 9 * sd).max())
    for _ in range(34):
        middle = 0.5 * (low + high)
        below = (weight * ndtr((middle[:, None] - mean) / sd)).sum(axis=1) < np.asarray(levels)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high))


def _evaluate(device: Device, data: Touches, grid: Array, start: Array | None) -> _Fitted:
    n, m = grid.shape
    row = np.repeat(np.arange(n), m)
    begin = None if start is None else start.reshape(n * m, -1)
    # a far start is hopeless where it does not settle soon
    steps = 20 if start is not None else _FIRST_STEPS
    mode = fit_pairs(device, data, row, free_hypotheses(device, grid), start=begin, max_steps=steps)
    u, covariance = mode.u.reshape(n, m, -1), mode.covariance.reshape(n, m, *mode.covariance.shape[1:])
    value, settled = mode.log_evidence.reshape(n, m), mode.converged.reshape(n, m)
    return _Fitted(grid, value, u, covariance, settled)


def refined(x: Array, value: Array, widen: float) -> Array:
    """Return new points where log densities ``value`` at ``x`` are within ``widen`` of their best."""
    order = np.argsort(x)
    x, value = x[order], value[order]
    inside = np.flatnonzero(value > value.max() - widen)
    low = x[max(inside[0] - 1, 0)]
    high = x[min(inside[-1] + 1, x.size - 1)]
    # midpoints of cells, so that a refinement never repeats a point of the one before
    return np.asarray(low + (high - low) * (np.arange(_FINE) + 0.5) / _FINE)


def posterior_of(x: Array, value: Array, t_object: Array, sd: Array, ln_h: Array) -> GridPosterior:
    """Return the posterior of log densities ``value`` at points ``x``, in any order; all arguments (m,)."""
    order = np.argsort(x)
    order = order[np.concatenate([[True], np.diff(x[order]) > 1e-9])]
    x, value, t_object, sd, ln_h = (v[order] for v in (x, value, t_object, sd, ln_h))
    curve = PchipInterpolator(x, value)
    inside = np.flatnonzero(value > value.max() - 20)
    low, high = x[max(inside[0] - 1, 0)], x[min(inside[-1] + 1, x.size - 1)]
    fine = np.linspace(low, high, 500)
    log_density = np.asarray(curve(fine))
    log_total = float(logsumexp(log_density)) + np.log(fine[1] - fine[0])
    mass = np.exp(log_density - logsumexp(log_density))
    weight = np.exp(value - value.max()) * np.gradient(x)
    # tails that carry nothing need no part in the mixtures
    use = weight > 1e-9 * weight.max()
    return GridPosterior(
        fine,
        mass,
        log_total - np.log(LN_E_RANGE[1] - LN_E_RANGE[0]),
        weight[use] / weight[use].sum(),
        t_object[use],
        sd[use],
        ln_h[use],
    )
