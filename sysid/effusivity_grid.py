"""The posterior of ln e on a grid that finds its own place.

Given ln e every other unknown is close to Gaussian, so Laplace's method serves there; ln e itself is not
(copper's posterior runs into the prior's edge, wood's is narrower than any fixed grid), so it gets a grid:
coarse over the prior, then twice refined where the mass is.  Between points the log density is interpolated
by a monotone cubic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import logsumexp, ndtr

from thermogrip.sysid.grasp_data import Touches
from thermogrip.sysid.grasp_hypotheses import fit_pairs, free_hypotheses
from thermogrip.sysid.grasp_laplace import T_OBJECT, H
from thermogrip.sysid.gripper_device import Device

__all__ = ["LN_E_RANGE", "N_COARSE", "WIDEN", "GridPosterior"]
__all__ += ["grid_posteriors", "mixture_quantiles", "posterior_of", "refined"]

Array = NDArray[np.float64]

LN_E_RANGE = (float(np.log(40.0)), float(np.log(1.6e5)))  # on the gripper's scale; any solid lies inside
N_COARSE, _FINE = 26, 18
_FIRST_STEPS = 8
WIDEN = (12.0, 7.0)  # nats below the best point that a refinement still covers


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


def grid_posteriors(device: Device, data: Touches) -> list[GridPosterior]:
    """Return every grasp's posterior of ln e: log-uniform prior over :data:`LN_E_RANGE`, finish unknown."""
    n = data.level.size
    grid = np.tile(np.linspace(*LN_E_RANGE, N_COARSE), (n, 1))
    x, value, u, sd = _evaluate(device, data, grid, None)
    for widen in WIDEN:
        grid = np.stack([refined(x[i], value[i], widen) for i in range(n)])
        nearest = np.abs(grid[:, :, None] - x[:, None, :]).argmin(axis=2)
        start = np.take_along_axis(u, nearest[:, :, None], axis=1)
        parts = _evaluate(device, data, grid, start)
        x, value = np.concatenate([x, parts[0]], axis=1), np.concatenate([value, parts[1]], axis=1)
        u, sd = np.concatenate([u, parts[2]], axis=1), np.concatenate([sd, parts[3]], axis=1)
    return [posterior_of(x[i], value[i], u[i, :, T_OBJECT], sd[i], u[i, :, H]) for i in range(n)]


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


def _evaluate(
    device: Device, data: Touches, grid: Array, start: Array | None
) -> tuple[Array, Array, Array, Array]:
    n, m = grid.shape
    row = np.repeat(np.arange(n), m)
    begin = None if start is None else start.reshape(n * m, -1)
    # a far start is hopeless where it does not settle soon
    steps = 20 if start is not None else _FIRST_STEPS
    mode = fit_pairs(device, data, row, free_hypotheses(device, grid), start=begin, max_steps=steps)
    sd = np.sqrt(mode.covariance[:, T_OBJECT, T_OBJECT])
    return grid, mode.log_evidence.reshape(n, m), mode.u.reshape(n, m, -1), sd.reshape(n, m)


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
