r"""The posterior of ln e on a grid that finds its own place.

Given ln e every other unknown is close to Gaussian, so Laplace's method serves there; ln e itself is not
(copper's posterior runs into the prior's edge, wood's is narrower than any fixed grid), so it gets a grid:
coarse over the prior, then twice refined where the mass is.  Between points the log density is interpolated
by Akima's cubics.

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

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.materials import load_materials
from thermogrip.sysid.effusivity.data import Touches, Whitened, graded, taken
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
    Mode,
    Prior,
    at_temperature,
    doubted,
    fit_pairs,
    fit_rivals,
    free_hypotheses,
    joined_modes,
    nodes_for,
    over_grades,
    pairs_asked,
    prior_of,
    second_modes,
    slip_of,
    temperatures_by_the_other,
    whitened,
)

# On the gripper's scale.  Of solids at room temperature plastic foams have least (expanded polystyrene, 32),
# diamond most (6.3e4, of one isotope 7.7e4); that far from its blocks a calibration's scale is known to 0.30
# and 0.16 in the logarithm, and two of these are left on either side.
LN_E_RANGE = (float(np.log(17.0)), float(np.log(1.1e5)))
_LISTED_SD = 0.3  # of ln e about a material of the table, where objects are likeliest
SAMPLED = [EFFUSIVITY, H, BUILD_UP, ONSET, CAPACITY]

_REST = np.array([CAPACITY, H, BUILD_UP, ONSET])  # ln C first
_BACK = [1, 2, 3, 0]  # from there to the order of SAMPLED
_FIRST, _STEP = 1.4 * np.arange(-2.0, 3.0), 1.4  # of z_0
_OTHERS = np.sqrt(3.0) * np.concatenate([np.eye(3), -np.eye(3)])
_Z = np.column_stack([np.repeat(_FIRST, 6), np.tile(_OTHERS, (_FIRST.size, 1))])
# of each point, step exp(3/2) / 6; of 2 pi the power 3/2 from here, -2 from the constants of four priors
_LOG_WEIGHT = 1.5 - np.log(6.0) - 0.5 * np.log(2 * np.pi) + np.log(_STEP)


def slipped(
    gripper: GripperModel, data: Touches, whitener: Any, beyond: Array | None, sd: Array, u: Array,
    row: NDArray[np.int64] | None = None,
) -> Array:  # fmt: skip
    """Return ln p(y | u) up to a constant for n points ``u`` (n, 7) of the grasps ``row`` (n,), by default
    the first, integrated over level and T_obj (prior means in ``u``, sds in ``sd``, (7,) or (n, 7)), the
    latter a slip with a probability of ``SLIPS`` where it is stated."""
    from thermogrip.sysid.effusivity.mode_kernel import marginals

    row = np.zeros(len(u), dtype=np.int64) if row is None else row
    asked = pairs_asked(gripper.stack, nodes_for(data), data, row, beyond)
    stated, sd = np.isfinite(data.t_object[row]), np.broadcast_to(sd, u.shape)
    own = np.stack([sd[:, LEVEL], sd[:, T_OBJECT]], axis=1)
    wide = own * np.stack([np.ones(len(u)), slip_of(sd[:, T_OBJECT])], axis=1)
    found = marginals(asked, whitener, u, np.stack([own, wide]) if stated.any() else own[None])
    if not stated.any():
        return np.asarray(found[0])
    either = np.logaddexp(np.log1p(-SLIPS) + found[0], np.log(SLIPS) + found[1])
    return np.asarray(np.where(stated, either, found[0]))


class MarginalPosterior:
    """Log posterior of (ln e, ln h, ln tau_b, t0, ln C), up to a constant, of many points at once."""

    n = len(SAMPLED)

    def __init__(self, gripper: GripperModel, data: Touches, noise: Whitened | None = None) -> None:
        gripper.require_known("an integral over one grasp's nuisances")
        self.gripper, self.data = gripper, data
        whitener, log_det = whitened(gripper, data) if noise is None else noise
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
        row = np.zeros(len(points), dtype=np.int64)
        prior = _rows(self._prior, row)
        return _log_posterior(self.gripper, self.data, self.whitener, prior, points, row)


def _rows(prior: Prior, row: NDArray[np.int64]) -> Prior:
    return Prior(prior.mean[row], prior.sd[row], None if prior.dof is None else prior.dof[row])


def _log_posterior(
    gripper: GripperModel, data: Touches, whitener: Any, common: Prior, points: Array,
    row: NDArray[np.int64],
) -> Array:  # fmt: skip
    """Return the log posterior (n,), up to a constant, of points (n, 5) of the grasps ``row``, of whose
    priors ``common`` has what does not depend on ln e, a row a point."""
    free, mean, sd = free_hypotheses(gripper, points[:, 0]), common.mean, common.sd
    u = mean.copy()
    u[:, SAMPLED] = points
    log_prior = _log_student(points[:, 1], free.ln_h, free.ln_h_sd)
    ln_length = np.log(gripper.block_length * gripper.depth_share)
    log_prior += _log_student(points[:, 4], free.ln_rho_c + ln_length, free.ln_rho_c_sd)
    for column, k in ((2, BUILD_UP), (3, ONSET)):
        dof = np.inf if common.dof is None else common.dof[0, k]  # of the gripper
        log_prior += _log_student(points[:, column], mean[:, k], sd[:, k], dof)
    beyond = None if gripper.discrepancy is None else gripper.beyond(data.t[row], points[:, 0])
    return np.asarray(log_prior + slipped(gripper, data, whitener, beyond, sd, u, row))


def log_integrals(
    gripper: GripperModel, data: Touches, x: Array, mode: Array, covariance: Array, *,
    noise: Whitened | None = None, row: NDArray[np.int64] | None = None,
) -> Array:  # fmt: skip
    """Return ln p(y | ln e), every nuisance integrated, at effusivities ``x`` (n,) of the grasps ``row``
    (n,), by default the first."""
    gripper.require_known("an integral over one grasp's nuisances")
    row = np.zeros(x.size, dtype=np.int64) if row is None else row
    noise = whitened(gripper, data) if noise is None else noise
    common = prior_of(gripper, data, free_hypotheses(gripper, np.full(data.level.size, 9.0)))
    total = _integrals(gripper, data, x, mode, covariance, noise, row, _rows(common, row))
    # effusivities outside the prior's range are none
    return np.asarray(np.where((x >= LN_E_RANGE[0]) & (x <= LN_E_RANGE[1]), total, -np.inf))


def _integrals(
    gripper: GripperModel, data: Touches, x: Array, mode: Array, covariance: Array,
    noise: Whitened, row: NDArray[np.int64], common: Prior,
) -> Array:  # fmt: skip
    """Return :func:`log_integrals` under priors ``common``, a row an effusivity, at any effusivity."""
    whitener, log_det = noise
    root = np.linalg.cholesky(covariance[:, _REST[:, None], _REST[None, :]])
    rest = mode[:, None, _REST] + np.einsum("nij,kj->nki", root, _Z)
    n = _Z.shape[0]
    points = np.column_stack([np.repeat(x, n), rest.reshape(-1, 4)[:, _BACK]])
    wide = _rows(common, np.repeat(np.arange(x.size), n))
    each = _log_posterior(gripper, data, whitener, wide, points, np.repeat(row, n))
    volume = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(logsumexp(each.reshape(x.size, -1), axis=1) + volume + _LOG_WEIGHT - 0.5 * log_det[row])


def _log_student(x: Array, mean: Array | float, sd: Array | float, dof: float = np.inf) -> Array:
    w = (x - mean) / sd
    if np.isinf(dof):
        return np.asarray(-0.5 * w**2 - np.log(sd))
    norm = math.lgamma(0.5 * (dof + 1)) - math.lgamma(0.5 * dof) - 0.5 * np.log(0.5 * dof)
    return np.asarray(norm - 0.5 * (dof + 1) * np.log1p(w**2 / dof) - np.log(sd))


N_COARSE = 26
_LEAST_GRADE = 1e-4  # probability of a grade that has a part in a posterior
REFINEMENTS = ((12.0, 12), (7.0, 14))  # nats below the best point that each covers, and its points
_KNOTS, _REACH = 7, 8.0  # points to integrate at, and how far below the best they go [nat]
_TOGETHER = 4  # grasps whose integrals are computed at once
_ROUGH = 18  # points of a density that is wide


class GridPosterior(NamedTuple):
    """One grasp's posterior."""

    x: Array  # (n,), fine grid of ln e on the gripper's scale
    mass: Array  # (n,), of each point
    log_evidence: float  # under the log-uniform prior
    weight: Array  # (m,), of the fitted points
    t_object: Array  # (m,), mean of T_obj there [degC]
    t_object_sd: Array  # (m,) [K]
    ln_h: Array  # (m,)
    x_sd: Array  # (n,), of the scale of ln e, beside what the gripper's blocks leave open


class _Fitted(NamedTuple):
    """Points ``x`` (n, m), log evidence, modes (n, m, 7), their covariances, whether they settled, and where
    they are if no stated temperature is a slip, from which neighbours start."""

    x: Array
    value: Array
    u: Array
    covariance: Array
    settled: Mask
    plain: Array


def grid_posteriors(gripper: GripperModel, data: Touches) -> list[GridPosterior]:
    """Return the posteriors of ln e: log-uniform prior over :data:`LN_E_RANGE`, h_c unknown."""
    n, n_grade = data.level.size, len(gripper.grades)
    each = _posteriors(gripper, graded(data, gripper.grades))
    if n_grade == 1:
        return each
    evidence = np.array([one.log_evidence for one in each]).reshape(n, n_grade)
    weight = over_grades(gripper, evidence)
    likely = weight > logsumexp(weight, axis=1, keepdims=True) + np.log(_LEAST_GRADE)
    return [
        mixed([each[i * n_grade + k] for k in np.flatnonzero(likely[i])], weight[i, likely[i]])
        for i in range(n)
    ]


def _posteriors(gripper: GripperModel, data: Touches) -> list[GridPosterior]:
    """Return :func:`grid_posteriors` under the grade that each of the touches has."""
    noise = whitened(gripper, data)
    found = _fitted(gripper, data, noise)
    value = found.value + _left_out(gripper, data, noise, found)
    if gripper.discrepancy is not None:  # its evidence counts little, so what objects are made of counts
        value = value + log_listed(found.x - gripper.effusivity_scale(found.x)[0])
    sd = np.sqrt(found.covariance[:, :, T_OBJECT, T_OBJECT])
    return posteriors_of(found.x, value, found.u[:, :, T_OBJECT], sd, found.u[:, :, H])


def free_evidence(
    gripper: GripperModel, data: Touches, near: Array | None = None, *, noise: Whitened | None = None
) -> Array:
    """Return the log evidence of a free effusivity for each touch, (n,), as :func:`grid_posteriors` do;
    ``noise`` is :func:`whitened` of the graded touches where a caller has it.

    Where the modes ``near`` (n, 7) of a likely candidate are given and the object's temperature is stated,
    the density is looked for from there (:func:`_evidence_near`)."""
    n_grade = len(gripper.grades)
    near = None if near is None else np.repeat(near, n_grade, axis=0)
    each = _free_evidence(gripper, graded(data, gripper.grades), near, noise)
    return np.asarray(logsumexp(over_grades(gripper, each.reshape(-1, n_grade)), axis=1))


def _free_evidence(
    gripper: GripperModel, data: Touches, near: Array | None, noise: Whitened | None
) -> Array:
    """Return :func:`free_evidence` under the grade that each of the touches has, none where another grade of
    its touch is far ahead."""
    out, noise = np.full(data.level.size, np.nan), whitened(gripper, data) if noise is None else noise
    by_one = gripper.second is None or data.second is None
    if near is not None and by_one and gripper.discrepancy is None and not gripper.uncertain:
        known = np.isfinite(data.t_object)
        if known.any():
            out[known] = _evidence_of_likely(gripper, data.take(known), near[known], taken(noise, known))
    for rest, fitted in ((data.unlike == 0.0, _fitted), (data.unlike > 0.0, _roughly_fitted)):
        at = np.flatnonzero(rest & np.isnan(out))
        if at.size:
            found = fitted(gripper, data.take(at), taken(noise, at))
            out[at] = log_total(found.x, found.value) - np.log(LN_E_RANGE[1] - LN_E_RANGE[0])
    return out


def _evidence_of_likely(gripper: GripperModel, data: Touches, near: Array, noise: Whitened) -> Array:
    """Return :func:`_evidence_near` of touches under their grades, -inf for a grade that is far behind."""
    mode, n_grade = _free_modes(gripper, data, near, noise), len(gripper.grades)
    away = (mode.u[:, EFFUSIVITY] - near[:, EFFUSIVITY]) / _ANYWHERE
    about = over_grades(gripper, (mode.log_evidence + 0.5 * away**2).reshape(-1, n_grade))
    at = np.flatnonzero(about > about.max(axis=1, keepdims=True) - _GRADE_BEHIND)
    out = np.full(data.level.size, -np.inf)
    parts: Any = (part[at] for part in mode)
    mode = Mode(*parts)
    out[at] = _evidence_near(gripper, data.take(at), near[at], taken(noise, at), mode)
    return out


def _free_modes(gripper: GripperModel, data: Touches, near: Array, noise: Whitened) -> Mode:
    """Return where a search with ln e free ends, a row a touch."""
    free = free_hypotheses(gripper, np.clip(near[:, EFFUSIVITY], *LN_E_RANGE))
    law = prior_of(gripper, data, free._replace(ln_e_sd=np.full(len(near), _ANYWHERE)))
    return fit_pairs(gripper, data, np.arange(len(near)), free, start=near, noise=noise, prior=law)


_AROUND, _SIDE = 9, 4.0  # points about the density's place, and how many of its sds to either side
_INNER = [1, 3, 4, 5, 7]  # of these: the others start between them
_GRADE_BEHIND = 15.0  # nats, by the mode alone, from which on a grade has no part in the sum
_ANYWHERE = 1.0  # of ln e about a candidate's, where its density is looked for
_ENDED, _STEEP = 7.0, 3.0  # nats below the best where a density may end; and that it may fall beside the best
_FEWEST = 7  # points of a density that have not ended
_NARROWEST = 1e-3  # of ln e, between the ends of the first points: a density may lie at an end of the range
_SAME = 1e-9  # of ln e: an end that is so near that of the range is there
_MORE, _ROUNDS = 4, 4  # points at a time, and how often, until that is so
_SURE = 0.008  # nats by which two kinds of cubics may differ
_HALVED = 8  # cells that are halved where they differ by more
_ROUGH_TO = 3.0  # nats behind the best up to which points are found the more roughly


def _evidence_near(
    gripper: GripperModel, data: Touches, near: Array, noise: Whitened, mode: Mode | None = None
) -> Array:
    """Return the log evidence of a free effusivity for each touch of an object of stated temperature, (n,),
    NaN where that is not sure.

    One search with ln e free finds where the density is, how wide, and how the other unknowns go along;
    points about it start there, others between these, and more follow where it has not ended, or falls
    steeply between points."""
    row = np.arange(data.level.size)
    lowest, highest = LN_E_RANGE
    mode = _free_modes(gripper, data, near, noise) if mode is None else mode
    place, spread = mode.u[:, EFFUSIVITY], np.sqrt(mode.covariance[:, EFFUSIVITY, EFFUSIVITY])
    low = np.clip(place - _SIDE * spread, lowest, highest - _NARROWEST)
    high = np.clip(place + _SIDE * spread, low + _NARROWEST, highest)
    grid = _rounded(low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _AROUND))
    along = mode.covariance[:, :, EFFUSIVITY] / spread[:, None] ** 2
    start = mode.u[:, None] + along[:, None] * (grid - place[:, None])[:, :, None]
    outer = np.delete(np.arange(_AROUND), _INNER)
    found = _evaluate(gripper, data, noise, grid[:, _INNER], start[:, _INNER], _ROUGH_TO)
    found = _beside(gripper, data, noise, grid[:, outer], found, _ROUGH_TO)
    out, at, some, white = np.full(row.size, np.nan), row, data, noise
    for again in range(_ROUNDS + 1):
        wanted = [_more(x, value) for x, value in zip(found.x, found.value)]
        done = np.array([more is None for more in wanted])
        if done.any():
            ended, which = _Fitted(*(part[done] for part in found)), np.flatnonzero(done)
            out[at[done]] = _halved_total(gripper, some.take(which), taken(white, which), ended)
        if done.all() or again == _ROUNDS:
            break
        at, found = at[~done], _Fitted(*(part[~done] for part in found))
        some, white = data.take(at), taken(noise, at)
        grid = _rounded(np.stack([more for more in wanted if more is not None]), found.x)
        found = _beside(gripper, some, white, grid, found, _ROUGH_TO)
    return np.asarray(out - np.log(highest - lowest))


def _rounded(grid: Array, beside: Array | None = None) -> Array:
    """Return points (n, m) moved by a sixteenth of the least distance between them, or to those ``beside``,
    or less, to multiples of a power of two, which many touches have in common: what a table sums along ln e
    is the same there.  Those at the ends of the range stay."""
    least = np.diff(grid).min(axis=1, keepdims=True)
    if beside is not None:
        least = np.minimum(least, np.abs(grid[:, :, None] - beside[:, None]).min(axis=(1, 2))[:, None])
    unit = np.exp2(np.floor(np.log2(0.125 * least)))
    lowest, highest = LN_E_RANGE
    inside = (grid > lowest + unit) & (grid < highest - unit)
    return np.asarray(np.where(inside, np.round(grid / unit) * unit, grid))


def _more(x: Array, value: Array) -> Array | None:
    """Return points that a density lacks of which ``value`` is the logarithm at rising ``x``: beyond an end
    where it has not ended, or beside the best where it is steep or has few; None where it lacks none."""
    best = int(value.argmax())
    left = value[0] > value[best] - _ENDED and x[0] > LN_E_RANGE[0] + _SAME
    right = value[-1] > value[best] - _ENDED and x[-1] < LN_E_RANGE[1] - _SAME
    if left or right:
        n = _MORE // (2 if left and right else 1)
        parts, share = [], np.arange(1, n + 1) / n
        if left:
            end = max(x[0] - n * 1.5 * (x[1] - x[0]), LN_E_RANGE[0])
            parts.append(x[0] + (end - x[0]) * share[::-1])
        if right:
            end = min(x[-1] + n * 1.5 * (x[-1] - x[-2]), LN_E_RANGE[1])
            parts.append(x[-1] + (end - x[-1]) * share)
        return np.asarray(np.concatenate(parts))
    beside, many = value[max(best - 1, 0) : best + 2], (value > value[best] - _ENDED).sum() >= _FEWEST
    if many and value[best] - beside.min() <= _STEEP:
        return None
    first = min(max(best - _MORE // 2, 0), x.size - 1 - _MORE)
    return np.asarray(0.5 * (x[first : first + _MORE] + x[first + 1 : first + 1 + _MORE]))


def _halved_total(gripper: GripperModel, data: Touches, noise: Whitened, found: _Fitted) -> Array:
    """Return :func:`_sure_total`, with points between those that count most where that is not sure."""
    total = _sure_total(found)
    rest = np.flatnonzero(np.isnan(total))
    if rest.size:
        left: Any = (part[rest] for part in found)
        some, found = data.take(rest), _Fitted(*left)
        cells = np.sort(np.argsort(found.value[:, :-1] + found.value[:, 1:], axis=1)[:, -_HALVED:], axis=1)
        middles = 0.5 * (found.x[:, :-1] + found.x[:, 1:])
        grid = np.take_along_axis(middles, cells, axis=1)
        total[rest] = _sure_total(_beside(gripper, some, taken(noise, rest), grid, found, _ROUGH_TO))
    return total


def _sure_total(found: _Fitted) -> Array:
    """Return the logarithms of the integrals of densities, (n,), NaN where points that count have not
    settled, or two ways of interpolation differ."""
    x, value, settled = found.x, found.value, found.settled
    counts = value > value.max(axis=1, keepdims=True) - _ENDED
    total = log_total(x, value, smooth_slopes)
    sure = (settled | ~counts).all(axis=1) & (np.abs(total - log_total(x, value)) < _SURE)
    return np.asarray(np.where(sure, total, np.nan))


def rough_evidence(gripper: GripperModel, data: Touches) -> Array:
    """Return :func:`free_evidence` by few points, of a gripper under which densities are wide: within 0.15
    of it."""
    found = _roughly_fitted(gripper, data, whitened(gripper, data))
    return np.asarray(log_total(found.x, found.value) - np.log(LN_E_RANGE[1] - LN_E_RANGE[0]))


def _roughly_fitted(gripper: GripperModel, data: Touches, noise: Whitened) -> _Fitted:
    """Return the fits at few points of densities that are wide."""
    grid = np.tile(np.linspace(*LN_E_RANGE, _ROUGH), (data.level.size, 1))
    return _evaluate(gripper, data, noise, grid, None)


def _fitted(gripper: GripperModel, data: Touches, noise: Whitened) -> _Fitted:
    """Return the fits at the coarse points and at those of the refinements, along which ln e rises."""
    coarse = np.tile(np.linspace(*LN_E_RANGE, N_COARSE), (data.level.size, 1))
    found = _evaluate(gripper, data, noise, coarse, None)
    for widen, n_point in REFINEMENTS:
        grid = np.stack([refined(x, value, widen, n_point) for x, value in zip(found.x, found.value)])
        found = _beside(gripper, data, noise, grid, found)
    return found


def _beside(
    gripper: GripperModel, data: Touches, noise: Whitened, grid: Array, found: _Fitted, rough: float = 0.0
) -> _Fitted:
    """Return fits also at the points of a grid (n, k), along which ln e rises: they start between those
    found."""
    more = _evaluate(gripper, data, noise, grid, _between(grid, found.x, found.plain), rough)
    found = _Fitted(*(np.concatenate(pair, axis=1) for pair in zip(found, more)))
    order = np.argsort(found.x, axis=1)
    row = np.arange(len(order))[:, None]
    return _Fitted(*(part[row, order] for part in found))


def log_listed(ln_e: Array) -> Array:
    """Return by how much an effusivity is likelier a priori than by a log-uniform law, its logarithm, under
    even odds that an object is of some material of the table, each within 30 %, or of any effusivity."""
    listed = np.log([material.effusivity for material in load_materials().values()])
    width = LN_E_RANGE[1] - LN_E_RANGE[0]
    z = (ln_e[..., None] - listed) / _LISTED_SD
    near = np.exp(-0.5 * z**2).mean(axis=-1) / (_LISTED_SD * np.sqrt(2 * np.pi))
    return np.asarray(np.log(0.5 + 0.5 * width * near))


def _left_out(gripper: GripperModel, data: Touches, noise: Whitened, found: _Fitted) -> Array:
    """Return what Laplace's method left out of the points (n, m), less its mean over each posterior."""
    x, value, u, covariance, settled, _ = found
    out = np.zeros(x.shape)
    # for an uncertain gripper Laplace's method integrates over its parameters too, with a discrepancy the
    # evidence counts less than the integral says
    if gripper.uncertain or gripper.discrepancy is not None:
        return out
    near = settled & (value > value.max(axis=1, keepdims=True) - _REACH)
    near[data.unlike > 0.0] = False  # nor for nuisances so wide that a few points of them are no integral
    knots: dict[int, NDArray[np.int64]] = {}
    for i in np.flatnonzero(near.sum(axis=1) >= _KNOTS).tolist():
        at = np.flatnonzero(near[i])
        wanted = np.linspace(x[i, at[0]], x[i, at[-1]], _KNOTS)
        knots[i] = at[np.unique(np.abs(x[i, at] - wanted[:, None]).argmin(axis=1))]
    every = list(knots.items())
    inner = np.zeros(x.shape)
    for some in (every[k : k + _TOGETHER] for k in range(0, len(every), _TOGETHER)):
        row, at = (
            np.repeat([i for i, _ in some], [k.size for _, k in some]),
            np.concatenate([k for _, k in some]),
        )
        there = x[row, at], u[row, at], covariance[row, at]
        if gripper.second is not None and data.second is not None:
            whole = log_integrals_of_two(gripper, data, *there[:2], noise=noise, row=row)
        else:
            whole = log_integrals(gripper, data, *there, noise=noise, row=row)
        inner[row, at] = whole - value[row, at]
    for n_knot in {k.size for _, k in every}:
        which = np.array([i for i, k in every if k.size == n_knot])
        at = np.stack([knots[i] for i in which.tolist()])
        known = np.take_along_axis(x[which], at, axis=1), np.take_along_axis(inner[which], at, axis=1)
        everywhere = monotone(*known, x[which])
        weight = np.exp(value[which] - value[which].max(axis=1, keepdims=True)) * np.gradient(
            x[which], axis=1
        )
        mean = (weight * everywhere).sum(axis=1) / weight.sum(axis=1)
        out[which] = everywhere - mean[:, None]
    return out


def log_integrals_of_two(
    gripper: GripperModel, data: Touches, x: Array, start: Array, *, noise: Whitened,
    row: NDArray[np.int64],
) -> Array:  # fmt: skip
    """Return :func:`log_integrals` of two sensors that touched one object, near the modes ``start`` (n, 7).

    Laplace's method has the evidence of both; what it leaves out of each is integrated under what the other
    one saw of the object's temperature, for a stated temperature that is right and for a slip."""
    assert gripper.second is not None
    assert data.second is not None
    second, touched, hypotheses = gripper.second, data.second, free_hypotheses(gripper, x)
    apart, each = second.bias - gripper.bias, data.known(row)
    prior, alone = prior_of(gripper, each, hypotheses), replace(gripper, second=None)
    first = fit_pairs(alone, data, row, hypotheses, start=start, noise=noise, prior=prior)
    other, own = second_modes(gripper, data, row, hypotheses, first)
    ln_e = second.found_effusivity(x - gripper.effusivity_scale(x)[0])
    white = whitened(second, touched)

    def total(law: Prior) -> Array:
        mine = at_temperature(first, prior, law.mean[:, T_OBJECT], law.sd[:, T_OBJECT] ** 2)
        evidence = joined_modes(mine, law, other, own, apart).log_evidence
        by_other = temperatures_by_the_other(mine, law, other, own, apart)
        for device, seen, at, mode, before, told, w in (
            (gripper, data, x, mine, law, by_other[0], noise),
            (second, touched, ln_e, other, own, by_other[1], white),
        ):
            there = at_temperature(mode, before, *told)
            under = Prior(_with(before.mean, told[0]), _with(before.sd, np.sqrt(told[1])), before.dof)
            unstated = replace(seen, t_object=np.full(seen.t_object.shape, np.nan))
            whole = _integrals(device, unstated, at, there.u, there.covariance, w, row, under)
            evidence = evidence + whole - there.log_evidence
        return np.asarray(evidence)

    stated, right = np.isfinite(each.t_object), total(prior)
    if not stated.any():
        return right
    width = prior.sd[:, T_OBJECT]
    slip = total(prior._replace(sd=_with(prior.sd, slip_of(width) * width)))
    return np.asarray(np.where(stated, np.logaddexp(np.log1p(-SLIPS) + right, np.log(SLIPS) + slip), right))


def _with(values: Array, t_object: Array) -> Array:
    """Return nuisances (n, 7) with other temperatures of the object."""
    out = values.copy()
    out[:, T_OBJECT] = t_object
    return out


def monotone(x: Array, y: Array, at: Array) -> Array:
    """Return curves through ``y`` (n, m) at rising ``x`` (n, m), at points ``at`` (n, k), as at their ends
    beyond them: cubics that turn nowhere but at points, by the slopes of Fritsch and Butland."""
    h = np.diff(x)
    secant, last = np.diff(y) / h, x.shape[1] - 1
    slope = np.zeros(x.shape)
    early, later = secant[:, :-1], secant[:, 1:]
    w1, w2 = h[:, :-1] + 2 * h[:, 1:], 2 * h[:, :-1] + h[:, 1:]
    turn = (early * later <= 0.0) | (early == 0.0)
    safe = np.where(turn, 1.0, early), np.where(turn, 1.0, later)
    slope[:, 1:-1] = np.where(turn, 0.0, (w1 + w2) / (w1 / safe[0] + w2 / safe[1]))
    for end, near, beyond in ((0, 0, 1), (last, last - 1, last - 2)):
        h0, h1, s0, s1 = h[:, near], h[:, beyond], secant[:, near], secant[:, beyond]
        own = ((2 * h0 + h1) * s0 - h0 * s1) / (h0 + h1)
        own = np.where((s0 * s1 < 0.0) & (np.abs(own) > 3 * np.abs(s0)), 3 * s0, own)
        slope[:, end] = np.where(own * s0 <= 0.0, 0.0, own)
    inside = np.clip(at, x[:, :1], x[:, -1:])
    cell = np.clip((x[:, None, :] <= inside[:, :, None]).sum(axis=2) - 1, 0, last - 1)
    x0, y0, d0, width = (np.take_along_axis(part, cell, axis=1) for part in (x, y, slope, h))
    y1, d1 = (np.take_along_axis(part, cell + 1, axis=1) for part in (y, slope))
    s = (inside - x0) / width
    bent = (1 - s) * d0 * width - s * d1 * width + (1 - 2 * s) * (y0 - y1)
    return np.asarray(y0 + s * (y1 - y0) + s * (1 - s) * bent)


def mixed(parts: Sequence[GridPosterior], log_weight: Array) -> GridPosterior:
    """Return the mixture of posteriors of one grasp whose prior odds times evidence are ``log_weight``
    (n_part,)."""
    total = float(logsumexp(log_weight))
    share = np.exp(log_weight - total)

    def joined(arrays: Iterable[Array]) -> Array:
        return np.concatenate([s * array for s, array in zip(share, arrays)])

    x = np.concatenate([p.x for p in parts])
    order = np.argsort(x, kind="stable")
    t_object, sd, ln_h, x_sd = (np.concatenate(rest) for rest in zip(*(p[4:] for p in parts)))
    mass, weight = joined(p.mass for p in parts), joined(p.weight for p in parts)
    return GridPosterior(x[order], mass[order], total, weight, t_object, sd, ln_h, x_sd[order])


def mixture_quantiles(weight: Array, mean: Array, sd: Array, levels: tuple[float, ...]) -> Array:
    """Return quantiles of a mixture of normals (m,), (n_level,), or of several (n, m), (n, n_level), by
    Newton's method between bounds."""
    if weight.ndim == 1:
        return np.asarray(mixture_quantiles(weight[None], mean[None], sd[None], levels)[0])
    wanted, found = np.asarray(levels), np.empty((len(weight), len(levels)))
    for begin in range(0, len(weight), 16):  # whose arrays stay in the processor's cache
        part = slice(begin, begin + 16)
        found[part] = _quantiles(weight[part], mean[part], sd[part], wanted)
    return found


def _quantiles(weight: Array, mean: Array, sd: Array, wanted: Array) -> Array:
    from scipy.special import ndtr

    low = np.repeat((mean - 9 * sd).min(axis=1, keepdims=True), wanted.size, axis=1)
    high = np.repeat((mean + 9 * sd).max(axis=1, keepdims=True), wanted.size, axis=1)
    # narrow parts in a row: their means' own quantiles are near
    order = np.argsort(mean, axis=1, kind="stable")
    w, m = np.take_along_axis(weight, order, axis=1), np.take_along_axis(mean, order, axis=1)
    middle = np.cumsum(w, axis=1) - 0.5 * w
    x = np.stack([np.interp(wanted, at, own) for at, own in zip(middle, m)])
    least = 1e-7 * (high[:, 0] - low[:, 0]).min()
    w, m, s = weight[:, None, :], mean[:, None, :], sd[:, None, :]
    share = w / s / np.sqrt(2 * np.pi)
    for _ in range(60):
        z = (x[:, :, None] - m) / s
        over = (w * ndtr(z)).sum(axis=2) - wanted
        low, high = np.where(over < 0, x, low), np.where(over < 0, high, x)
        density = (share * np.exp(-0.5 * z**2)).sum(axis=2)
        newton = x - over / np.maximum(density, 1e-300)
        # one that has arrived is itself a bound, and stays
        before, x = x, np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        if np.abs(x - before).max() < least:
            break
    return np.asarray(x)


def _evaluate(
    gripper: GripperModel, data: Touches, noise: Whitened, grid: Array, start: Array | None,
    rough: float = 0.0,
) -> _Fitted:  # fmt: skip
    """Return the fits at the points of a grid (n, m), as ``rough`` as
    :func:`~thermogrip.sysid.effusivity.mode_kernel.modes` takes them."""
    n, m = grid.shape
    row = np.repeat(np.arange(n), m)
    hypotheses = free_hypotheses(gripper, grid)
    each = data.known(row)
    prior = prior_of(gripper, each, hypotheses)
    begin = None if start is None else start.reshape(n * m, -1)
    plain = fit_rivals(
        gripper, data, row, hypotheses, start=begin, noise=noise, prior=prior, rough=rough
    )
    mode = doubted(gripper, each, prior, plain)
    found: list[Any] = [mode.log_evidence, mode.u, mode.covariance, mode.converged, plain.u]
    return _Fitted(grid, *(part.reshape(n, m, *part.shape[1:]) for part in found))


def _between(x: Array, knots: Array, values: Array) -> Array:
    """Return ``values`` (n, n_knot, 7) at ``knots`` (n, n_knot), along which these rise, at ``x`` (n, m): by
    the cubic of the four around, beyond the ends by the parabola of the next three, in exp(-x / 2) (what a
    touch says goes with 1 / e where e is large, with ln e where it is small), as far from them as they are
    from each other at most."""
    n_near = 4
    row, inside = np.arange(len(x))[:, None], (x > knots[:, :1]) & (x < knots[:, -1:])
    first = (knots[:, None, :] <= x[:, :, None]).sum(axis=2) - n_near // 2
    first = np.clip(first, 0, knots.shape[1] - n_near)
    at = first[:, :, None] + np.arange(n_near)
    place, near = np.exp(-0.5 * x), np.exp(-0.5 * knots)[row[:, :, None], at]
    # the node that a parabola leaves out: the last one before the first knot, the first beyond the last
    out = np.where(x <= knots[:, :1], n_near - 1, 0)
    total = np.zeros((*x.shape, values.shape[2]))
    for j in range(n_near):
        weight = np.ones(x.shape)
        for k in range(n_near):
            if k != j:
                one = (place - near[:, :, k]) / (near[:, :, j] - near[:, :, k])
                weight *= np.where(inside | (out != k), one, 1.0)
        weight = np.where(inside | (out != j), weight, 0.0)
        total += weight[:, :, None] * values[row, at[:, :, j]]
    low, high = values.min(axis=1, keepdims=True), values.max(axis=1, keepdims=True)
    return np.asarray(np.clip(total, 2 * low - high, 2 * high - low))


def refined(x: Array, value: Array, widen: float, n_point: int) -> Array:
    """Return new points where log densities ``value`` at ``x``, which rises, are within ``widen`` of their
    best."""
    inside = np.flatnonzero(value > value.max() - widen)
    low = x[max(inside[0] - 1, 0)]
    high = x[min(inside[-1] + 1, x.size - 1)]
    # of each cell the middle, or beside it: farthest from the points there are
    cell = (high - low) / n_point
    new = low + cell * (np.arange(n_point) + _PLACES[:, None])
    return np.asarray(new[np.abs(new[:, :, None] - x).min(axis=(1, 2)).argmax()])


_FAR = 30.0  # nats below the best, where nothing counts, and a cubic beside would swing
_PLACES = np.array([0.5, 0.46, 0.54, 0.42, 0.58, 0.38, 0.62])


def slopes(x: Array, value: Array) -> Array:
    """Return Akima's slopes of curves ``value`` (n, m) at ``x`` (n, m): where a curve bends sharply they are
    those of its smooth side, so that no wave is added."""
    secant = np.diff(value) / np.diff(x)
    before, after = 2 * secant[:, :1] - secant[:, 1:2], 2 * secant[:, -1:] - secant[:, -2:-1]
    m = np.concatenate(
        [2 * before - secant[:, :1], before, secant, after, 2 * after - secant[:, -1:]], axis=1
    )
    turn = np.abs(np.diff(m))
    left, right = turn[:, 2:], turn[:, :-2]
    even = left + right <= 1e-9 * turn.max(axis=1, keepdims=True)
    weight = np.where(even, 0.5, left / np.where(even, 1.0, left + right))
    return np.asarray(weight * m[:, 1:-2] + (1 - weight) * m[:, 2:-1])


_GAUSS, _SHARE = (0.5 * v for v in np.polynomial.legendre.leggauss(8))


def smooth_slopes(x: Array, value: Array) -> Array:
    """Return slopes of curves ``value`` (n, m) at ``x`` (n, m), those of the quartics through five points."""
    m = x.shape[1]
    first = np.clip(np.arange(m) - 2, 0, m - 5)
    at, own = first[:, None] + np.arange(5), np.arange(m) - first
    near, same = x[:, at], np.arange(5) == own[:, None]
    apart = near[:, :, :, None] - near[:, :, None, :]
    apart[:, :, np.arange(5), np.arange(5)] = 1.0
    weight = 1.0 / apart.prod(axis=3)
    factor = weight / weight[:, np.arange(m), own][:, :, None]
    share = np.where(same, 0.0, factor / np.where(same, 1.0, x[:, :, None] - near))
    return np.asarray((share * (value[:, at] - value[:, :, None])).sum(axis=2))


def log_total(x: Array, value: Array, slopes_of: Callable[[Array, Array], Array] = slopes) -> Array:
    """Return the logarithms of the integrals of densities whose logarithms are ``value`` (n, m) at ``x``
    (n, m), cubics between them, (n,)."""
    n, m = x.shape
    place = np.broadcast_to((_GAUSS + 0.5)[None, None], (n, m - 1, _GAUSS.size)).reshape(n, -1)
    at = np.repeat(np.arange(m - 1), _GAUSS.size)
    share = (_SHARE * np.diff(x)[:, :, None]).reshape(n, -1)
    return np.asarray(logsumexp(_cubic(x, value, at, place, slopes_of) + np.log(share), axis=1))


def _cubic(
    x: Array, value: Array, at: NDArray[np.int64], share: Array,
    slopes_of: Callable[[Array, Array], Array] = slopes,
) -> Array:  # fmt: skip
    """Return curves (n, m) through ``value`` at ``x``, between points ``at``, (k,) or (n, k), and the next, a
    ``share`` (n, k) of the way."""
    value = np.maximum(value, value.max(axis=1, keepdims=True) - _FAR)
    d, s = slopes_of(x, value), share
    at = np.broadcast_to(at, s.shape)
    y0, d0 = (np.take_along_axis(part, at, axis=1) for part in (value, d))
    y1, d1 = (np.take_along_axis(part, at + 1, axis=1) for part in (value, d))
    width = np.take_along_axis(np.diff(x), at, axis=1)
    bent = (1 - s) * d0 * width - s * d1 * width + (1 - 2 * s) * (y0 - y1)
    return np.asarray(y0 + s * (y1 - y0) + s * (1 - s) * bent)


def posterior_of(x: Array, value: Array, t_object: Array, sd: Array, ln_h: Array) -> GridPosterior:
    """Return the posterior of log densities ``value`` at points ``x``, along which these rise; arguments are
    (m,)."""
    return posteriors_of(*(part[None] for part in (x, value, t_object, sd, ln_h)))[0]


_FINE = 160  # points of a density


def posteriors_of(x: Array, value: Array, t_object: Array, sd: Array, ln_h: Array) -> list[GridPosterior]:
    """Return :func:`posterior_of` of several grasps; arguments are (n, m)."""
    inside, last = value > value.max(axis=1, keepdims=True) - 20, x.shape[1] - 1
    row = np.arange(len(x))
    low = x[row, np.maximum(inside.argmax(axis=1) - 1, 0)]
    high = x[row, np.minimum(last - inside[:, ::-1].argmax(axis=1) + 1, last)]
    fine = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _FINE)
    at = np.stack([np.searchsorted(own, there, "right") - 1 for own, there in zip(x, fine)])
    at = np.clip(at, 0, last - 1)
    before, after = np.take_along_axis(x, at, axis=1), np.take_along_axis(x, at + 1, axis=1)
    log_density = _cubic(x, value, at, (fine - before) / (after - before))
    log_density[:, [0, -1]] -= np.log(2.0)  # by the trapezoidal rule
    total = logsumexp(log_density, axis=1)
    evidence = total + np.log(fine[:, 1] - fine[:, 0]) - np.log(LN_E_RANGE[1] - LN_E_RANGE[0])
    mass = np.exp(log_density - total[:, None])
    weight = np.exp(value - value.max(axis=1, keepdims=True)) * np.gradient(x, axis=1)
    # tails without mass need no part in the mixtures
    use = weight > 1e-9 * weight.max(axis=1, keepdims=True)
    nothing = np.zeros(_FINE)
    return [
        GridPosterior(
            fine[i], mass[i], float(evidence[i]), weight[i, k] / weight[i, k].sum(), t_object[i, k], sd[i, k],
            ln_h[i, k], nothing,
        )
        for i, k in enumerate(use)
    ]  # fmt: skip
