r"""The posterior of ln e on a grid that finds its own place.

Given ln e every other unknown is close to Gaussian, so Laplace's method serves there; ln e itself is not
(copper's posterior runs into the prior's edge, wood's is narrower than any fixed grid), so it gets a grid:
coarse over the prior, then twice refined where the mass is.  Between points the log density is interpolated
by a monotone cubic.

**What Laplace's method leaves out** changes slowly with ln e, so it is integrated (:func:`log_integrals`) at
seven of the points, and the rest interpolated.  Its mean over the posterior is left to Laplace's method: the
evidence of the candidates has the same.  With y = X(u) beta + c(u) + noise, beta = (b, T_obj) ~ N(beta0, S)
and whitener W, the residual r = W (y - X beta0 - c) has covariance I + V V', V = W X S^1/2, so

    ln p(y | u) = -1/2 (r' r - r' V (I + V' V)^-1 V' r) - 1/2 ln det(I + V' V) + const.

Four nuisances are left, (ln C, ln h, ln tau_b, t0), of which ln C is the one that is not nearly normal: a
touch often knows only that it is not below some value.  With the posterior N(m, Sigma) of Laplace's method,
Sigma = L L', ln C first, and u = m + L z, z_0 moves ln C and takes the others along, so that

    int p(u) du = |L| sum_i dz sum_k w_k p(m + L (z_0i, s_k)) exp(s_k' s_k / 2) (2 pi)^(3/2)

with z_0 on a regular grid, whose sum is exact but for terms of exp(-2 pi^2 / dz^2), and s_k = +-sqrt(3) times
the unit vectors, w_k = 1/6, the rule that is exact for all cubics of three normal variables.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.special import gammaln, logsumexp, ndtr

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.sysid.effusivity.data import Touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    ONSET,
    SLIPS,
    T_OBJECT,
    H,
    doubted,
    fit_pairs,
    free_hypotheses,
    nodes_for,
    pairs_asked,
    prior_of,
    slip_of,
)

# On the gripper's scale.  Of solids at room temperature plastic foams have least (expanded polystyrene, 32),
# diamond most (6.3e4, of one isotope 7.7e4); that far from its blocks a calibration's scale is known to 0.30
# and 0.16 in the logarithm, and two of these are left on either side.
LN_E_RANGE = (float(np.log(17.0)), float(np.log(1.1e5)))
SAMPLED = [EFFUSIVITY, H, BUILD_UP, ONSET, CAPACITY]

_REST = np.array([CAPACITY, H, BUILD_UP, ONSET])  # ln C first
_BACK = [1, 2, 3, 0]  # from there to the order of SAMPLED
_FIRST, _STEP = 1.15 * np.arange(-3.0, 4.0), 1.15  # of z_0
_OTHERS = np.sqrt(3.0) * np.concatenate([np.eye(3), -np.eye(3)])
_Z = np.column_stack([np.repeat(_FIRST, 6), np.tile(_OTHERS, (_FIRST.size, 1))])
# of each point, step exp(3/2) / 6; of 2 pi the power 3/2 from here, -2 from the constants of four priors
_LOG_WEIGHT = 1.5 - np.log(6.0) - 0.5 * np.log(2 * np.pi) + np.log(_STEP)


def slipped(
    gripper: GripperModel, data: Touches, whitener: Array, beyond: Array, sd: Array, u: Array
) -> Array:
    """Return ln p(y | u) up to a constant for n points ``u`` (n, 7) of one grasp, integrated over level and
    T_obj (prior means in ``u``, sds in ``sd`` (7,)), the latter a slip with a probability of ``SLIPS`` where
    it is stated."""
    from thermogrip.sysid.effusivity.mode_kernel import marginals

    asked = pairs_asked(gripper.stack, nodes_for(data), data, np.zeros(len(u), dtype=np.int64), beyond)
    stated, t_sd = np.isfinite(data.t_object[0]), sd[T_OBJECT]
    sds = [[sd[LEVEL], t_sd], [sd[LEVEL], t_sd * float(slip_of(t_sd))]]
    found = marginals(asked, whitener, u, np.array(sds[: 1 + stated]))
    return np.asarray(np.logaddexp(np.log1p(-SLIPS) + found[0], np.log(SLIPS) + found[1]) if stated else found[0])


class MarginalPosterior:
    """Log posterior of (ln e, ln h, ln tau_b, t0, ln C), up to a constant, of many points at once."""

    n = len(SAMPLED)

    def __init__(
        self, gripper: GripperModel, data: Touches, noise: tuple[Array, Array] | None = None
    ) -> None:
        gripper.require_known("an integral over one grasp's nuisances")
        self.gripper, self.data = gripper, data
        whitener, log_det = whiten(data, gripper.noise) if noise is None else noise
        self.whitener, self.log_det = whitener, float(log_det[0])
        # of the prior only what depends on ln e is computed again
        self._prior = prior_of(gripper, data, free_hypotheses(gripper, [9.0]))

    def __call__(self, points: Array) -> Array:
        """Return the log posterior (n_point,) at points (n_point, 5); -inf outside the prior's range."""
        points = np.atleast_2d(points)
        inside = (points[:, 0] >= LN_E_RANGE[0]) & (points[:, 0] <= LN_E_RANGE[1])
        value = np.full(points.shape[0], -np.inf)
        if inside.any():
            value[inside] = self._log_posterior(points[inside])
        return value

    def _log_posterior(self, points: Array) -> Array:
        free, common, data = free_hypotheses(self.gripper, points[:, 0]), self._prior, self.data
        u = np.repeat(common.mean, points.shape[0], axis=0)
        u[:, SAMPLED] = points
        log_prior = _log_student(points[:, 1], free.ln_h, free.ln_h_sd)
        ln_length = np.log(self.gripper.block_length * self.gripper.depth_share)
        log_prior += _log_student(points[:, 4], free.ln_rho_c + ln_length, free.ln_rho_c_sd)
        for column, k in ((2, BUILD_UP), (3, ONSET)):
            dof = np.inf if common.dof is None else common.dof[0, k]
            log_prior += _log_student(points[:, column], common.mean[0, k], common.sd[0, k], dof)
        beyond = self.gripper.beyond(data.t, points[:, 0])
        likelihood = slipped(self.gripper, data, self.whitener, beyond, common.sd[0], u)
        return np.asarray(log_prior + likelihood)


def log_integrals(
    gripper: GripperModel, data: Touches, x: Array, mode: Array, covariance: Array, *,
    noise: tuple[Array, Array] | None = None,
) -> Array:  # fmt: skip
    """Return ln p(y | ln e), every nuisance integrated, at effusivities ``x``."""
    target = MarginalPosterior(gripper, data, noise)
    root = np.linalg.cholesky(covariance[:, _REST[:, None], _REST[None, :]])
    rest = mode[:, None, _REST] + np.einsum("nij,kj->nki", root, _Z)
    points = np.column_stack([np.repeat(x, _Z.shape[0]), rest.reshape(-1, 4)[:, _BACK]])
    total = logsumexp(target(points).reshape(x.size, -1), axis=1)
    volume = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(total + volume + _LOG_WEIGHT - 0.5 * target.log_det)


def _log_student(x: Array, mean: Array | float, sd: Array | float, dof: float = np.inf) -> Array:
    w = (x - mean) / sd
    if np.isinf(dof):
        return np.asarray(-0.5 * w**2 - np.log(sd))
    norm = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(0.5 * dof)
    return np.asarray(norm - 0.5 * (dof + 1) * np.log1p(w**2 / dof) - np.log(sd))


N_COARSE, _FINE = 26, 18
_FIRST_STEPS, _STEPS = 3, 20
_NEAR = 500.0  # nats below the best point within which a search that has not settled goes on
WIDEN = (12.0, 7.0)  # nats below the best point that a refinement still covers
_KNOTS, _REACH = 7, 8.0  # points to integrate at, and how far below the best they go [nat]


class GridPosterior(NamedTuple):
    """One grasp's posterior."""

    x: Array  # (n,), fine grid of ln e on the gripper's scale
    mass: Array  # (n,), of each point
    log_evidence: float  # under the log-uniform prior
    weight: Array  # (m,), of the fitted points
    t_object: Array  # (m,), mean of T_obj there [degC]
    t_object_sd: Array  # (m,) [K]
    ln_h: Array  # (m,)


class _Fitted(NamedTuple):
    """Points ``x`` (n, m), log evidence, modes (n, m, 7), their covariances and whether they settled."""

    x: Array
    value: Array
    u: Array
    covariance: Array
    settled: Mask


def grid_posteriors(gripper: GripperModel, data: Touches) -> list[GridPosterior]:
    """Return the posteriors of ln e: log-uniform prior over :data:`LN_E_RANGE`, h_c unknown."""
    n, noise = data.level.size, whiten(data, gripper.noise)
    coarse = np.tile(np.linspace(*LN_E_RANGE, N_COARSE), (n, 1))
    found = _evaluate(gripper, data, noise, coarse, np.ones(coarse.shape, dtype=bool), None, _FIRST_STEPS)
    near = ~found.settled & (found.value > found.value.max(axis=1, keepdims=True) - _NEAR)
    if near.any():
        again = _evaluate(gripper, data, noise, coarse, near, found.u, _STEPS)
        for old, new in zip(found, again):
            old[near] = new[near]
    for widen in WIDEN:
        grid = np.stack([refined(found.x[i], found.value[i], widen) for i in range(n)])
        start = np.stack([_between(grid[i], found.x[i], found.u[i]) for i in range(n)])
        more = _evaluate(gripper, data, noise, grid, np.ones(grid.shape, dtype=bool), start, _STEPS)
        found = _Fitted(*(np.concatenate(pair, axis=1) for pair in zip(found, more)))
    return [_finished(gripper, data, noise, found, i) for i in range(n)]


def _finished(
    gripper: GripperModel, data: Touches, noise: tuple[Array, Array], found: _Fitted, i: int
) -> GridPosterior:
    x, u = found.x[i], found.u[i]
    one, own = data.take(np.array([i])), (noise[0][i : i + 1], noise[1][i : i + 1])
    value = found.value[i] + _left_out(gripper, one, own, _Fitted(*(part[i] for part in found)))
    sd = np.sqrt(found.covariance[i, :, T_OBJECT, T_OBJECT])
    return posterior_of(x, value, u[:, T_OBJECT], sd, u[:, H])


def _left_out(gripper: GripperModel, data: Touches, noise: tuple[Array, Array], found: _Fitted) -> Array:
    """Return what Laplace's method left out of one grasp's points, (m,), less its mean over the posterior."""
    x, value, u, covariance, settled = found
    near = np.flatnonzero(settled & (value > value.max() - _REACH))
    near = near[np.argsort(x[near])]
    # for an uncertain gripper Laplace's method integrates over its parameters too, with a discrepancy the
    # evidence counts less than the integral says
    other = gripper.uncertain or gripper.discrepancy is not None
    if near.size < _KNOTS or other or (gripper.second is not None and data.second is not None):
        return np.zeros(x.size)
    wanted = np.linspace(x[near[0]], x[near[-1]], _KNOTS)
    at = near[np.unique(np.abs(x[near] - wanted[:, None]).argmin(axis=1))]
    missing = log_integrals(gripper, data, x[at], u[at], covariance[at], noise=noise) - value[at]
    everywhere = PchipInterpolator(x[at], missing)(np.clip(x, x[at[0]], x[at[-1]]))
    order = np.argsort(x)
    weight = np.exp(value[order] - value.max()) * np.gradient(x[order])
    return np.asarray(everywhere - (weight * everywhere[order]).sum() / weight.sum())


def mixture_quantiles(weight: Array, mean: Array, sd: Array, levels: tuple[float, ...]) -> Array:
    """Return quantiles of a mixture of normals, (n_level,), by Newton's method between bounds."""
    wanted = np.asarray(levels)
    low = np.full(wanted.size, (mean - 9 * sd).min())
    high = np.full(wanted.size, (mean + 9 * sd).max())
    order = np.argsort(mean)
    # narrow parts in a row: their means' own quantiles are near
    x = np.interp(wanted, np.cumsum(weight[order]) - 0.5 * weight[order], mean[order])
    least = 1e-10 * (high[0] - low[0])
    for _ in range(60):
        z = (x[:, None] - mean) / sd
        over = (weight * ndtr(z)).sum(axis=1) - wanted
        low, high = np.where(over < 0, x, low), np.where(over < 0, high, x)
        density = (weight / sd * np.exp(-0.5 * z**2)).sum(axis=1) / np.sqrt(2 * np.pi)
        newton = x - over / np.maximum(density, 1e-300)
        # one that has arrived is itself a bound, and stays
        before, x = x, np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        if np.abs(x - before).max() < least:
            break
    return np.asarray(x)


def _evaluate(
    gripper: GripperModel, data: Touches, noise: tuple[Array, Array], grid: Array, wanted: Mask,
    start: Array | None, steps: int,
) -> _Fitted:  # fmt: skip
    """Return the fits at the ``wanted`` points of a grid (n, m), zeros elsewhere."""
    n, m = grid.shape
    row = np.broadcast_to(np.arange(n)[:, None], (n, m))[wanted]
    begin = None if start is None else start[wanted]
    hypotheses = free_hypotheses(gripper, grid[wanted])
    each = data.take(row)
    prior = prior_of(gripper, each, hypotheses)
    mode = fit_pairs(gripper, data, row, hypotheses, start=begin, max_steps=steps, noise=noise, prior=prior)
    mode = doubted(gripper, each, prior, mode)
    out = _Fitted(
        grid, np.zeros((n, m)), np.zeros((n, m, 7)), np.zeros((n, m, 7, 7)), np.zeros((n, m), dtype=bool)
    )
    values = (mode.log_evidence, mode.u, mode.covariance, mode.converged)
    for part, value in zip(out[1:], values):
        part[wanted] = value
    return out


def _between(x: Array, knots: Array, values: Array) -> Array:
    """Return values (n_knot, 7) at knots in any order, linear between them, at x (n,)."""
    order = np.argsort(knots)
    return np.stack([np.interp(x, knots[order], column) for column in values[order].T], axis=1)


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
    # tails without mass need no part in the mixtures
    use = weight > 1e-9 * weight.max()
    return GridPosterior(
        fine, mass, log_total - np.log(LN_E_RANGE[1] - LN_E_RANGE[0]), weight[use] / weight[use].sum(),
        t_object[use], sd[use], ln_h[use],
    )  # fmt: skip
