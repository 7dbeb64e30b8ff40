"""The posterior of ln e on a grid that finds its own place.

Given ln e every other unknown is close to Gaussian, so Laplace's method serves there; ln e itself is not
(copper's posterior runs into the prior's edge, wood's is narrower than any fixed grid), so it gets a grid:
coarse over the prior, then twice refined where the mass is.  Between points the log density is interpolated
by Akima's cubics.

The evidence of a free effusivity, beside that of the candidates, needs no such grid: one search with ln e
free finds place and width of the density, and nine points about it, 1.2 standard deviations apart, sum a
normal density to 1e-6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.contact.materials import load_materials
from thermogrip.sysid.effusivity.data import Touches, Whitened, graded, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    EFFUSIVITY,
    T_OBJECT,
    H,
    Mode,
    fit_pairs,
    fit_rivals,
    free_hypotheses,
    over_grades,
    prior_of,
)

# On the gripper's scale.  Of solids at room temperature plastic foams have least (expanded polystyrene, 32),
# diamond most (6.3e4, of one isotope 7.7e4); that far from its blocks a calibration's scale is known to 0.29
# and 0.12 in the logarithm, and two of these are left on either side.
LN_E_RANGE = (float(np.log(17.0)), float(np.log(1.0e5)))


@dataclass(frozen=True)
class GridSettings:
    """Where the density of ln e is looked for, and how finely."""

    listed_sd: float = 0.3  # of ln e about a material of the table, where objects are likeliest
    # over the prior: 0.35 of ln e apart, a third of the narrowest metal's density of one refinement
    coarse_points: int = 26
    fine_points: int = 160  # of a density
    least_grade: float = 1e-4  # probability of a grade that has a part in a posterior
    anywhere_sd: float = 1.0  # of ln e about a candidate's, where a free density is looked for
    # of ln e, between the ends of the points about it: a density may lie at an end of the range
    narrowest: float = 1e-3
    grade_behind: float = 15.0  # nats, by the mode alone, from which on a grade has no part in the sum


GRID = GridSettings()

REFINEMENTS = ((12.0, 12), (7.0, 14))  # nats below the best point that each covers, and its points
_AROUND = 1.2 * np.arange(-4.0, 5.0)  # sds about the free density's place


class GridPosterior(NamedTuple):
    """One grasp's posterior."""

    x: Array  # (n,), fine grid of ln e on the gripper's scale
    mass: Array  # (n,), of each point
    log_evidence: float  # under the log-uniform prior
    weight: Array  # (m,), of the fitted points
    t_object: Array  # (m,), mean of T_obj there [degC]
    t_object_sd: Array  # (m,) [K]
    ln_h: Array  # (m,)


def grid_posteriors(gripper: GripperModel, data: Touches) -> list[GridPosterior]:
    """Return the posteriors of ln e: log-uniform prior over :data:`LN_E_RANGE`, h_c unknown."""
    n, n_grade = data.level.size, len(gripper.grades)
    by_grade = _posteriors(gripper, graded(data, gripper.grades))
    evidence = np.array([one.log_evidence for one in by_grade]).reshape(n, n_grade)
    weight = over_grades(gripper, evidence)
    likely = weight > np.logaddexp.reduce(weight, axis=1, keepdims=True) + np.log(GRID.least_grade)
    return [
        mixed([by_grade[i * n_grade + k] for k in np.flatnonzero(likely[i])], weight[i, likely[i]])
        for i in range(n)
    ]


def _posteriors(gripper: GripperModel, data: Touches) -> list[GridPosterior]:
    """Return :func:`grid_posteriors` under the grade that each of the touches has."""
    noise = whiten(data, gripper.reading_noise)
    x = np.tile(np.linspace(*LN_E_RANGE, GRID.coarse_points), (data.level.size, 1))
    modes = _modes_at(gripper, data, noise, x, None)
    for widen, n_point in REFINEMENTS:
        pairs = zip(x, modes.log_evidence)
        more = np.stack([refined(row, value, widen, n_point) for row, value in pairs])
        nearest = np.abs(more[:, :, None] - x[:, None]).argmin(axis=2)
        start = np.take_along_axis(modes.u, nearest[:, :, None], axis=1)
        start[:, :, EFFUSIVITY] = more
        extra = _modes_at(gripper, data, noise, more, start)
        x = np.concatenate([x, more], axis=1)
        joined: Any = (np.concatenate(pair, axis=1) for pair in zip(modes, extra))
        order = np.argsort(x, axis=1)
        row = np.arange(len(x))[:, None]
        x, modes = x[row, order], Mode(*joined).take((row, order))
    value = modes.log_evidence
    if gripper.discrepancy is not None:  # its evidence counts little, so what objects are made of counts
        value = value + log_listed(x - gripper.effusivity_scale(x)[0])
    sd = np.sqrt(modes.covariance[:, :, T_OBJECT, T_OBJECT])
    columns = zip(x, value, modes.u[:, :, T_OBJECT], sd, modes.u[:, :, H])
    return [posterior_of(*row) for row in columns]


def _modes_at(gripper: GripperModel, data: Touches, noise: Whitened, x: Array, start: Array | None) -> Mode:
    """Return the modes at effusivities ``x`` (n, m), from nuisances ``start`` (n, m, 7); arrays (n, m,
    ...)."""
    n, m = x.shape
    row, hypotheses = np.repeat(np.arange(n), m), free_hypotheses(gripper, x)
    prior = prior_of(gripper, data.known(row), hypotheses)
    begin = None if start is None else start.reshape(n * m, -1)
    mode = fit_rivals(gripper, data, row, hypotheses, start=begin, noise=noise, prior=prior)
    fields: Any = (field.reshape(n, m, *field.shape[1:]) for field in mode)
    return Mode(*fields)


def free_evidence(gripper: GripperModel, data: Touches, near: Array, noise: Whitened) -> Array:
    """Return the log evidence of a free effusivity for each touch, (n,), looked for from the modes ``near``
    (n, 7) of a likely candidate on; ``noise`` whitens the graded touches."""
    n_grade = len(gripper.grades)
    data, near = graded(data, gripper.grades), np.repeat(near, n_grade, axis=0)
    free = free_hypotheses(gripper, np.clip(near[:, EFFUSIVITY], *LN_E_RANGE))
    prior = prior_of(gripper, data, free._replace(ln_e_sd=np.full(len(near), GRID.anywhere_sd)))
    mode = fit_pairs(gripper, data, np.arange(len(near)), free, start=near, noise=noise, prior=prior)
    away = (mode.u[:, EFFUSIVITY] - prior.mean[:, EFFUSIVITY]) / GRID.anywhere_sd
    about = over_grades(gripper, (mode.log_evidence + 0.5 * away**2).reshape(-1, n_grade))
    likely = np.flatnonzero(about > about.max(axis=1, keepdims=True) - GRID.grade_behind)
    out = np.full(data.level.size, -np.inf)
    some_noise = noise[0][likely], noise[1][likely]
    out[likely] = _evidence_about(gripper, data.take(likely), some_noise, mode.take(likely))
    return np.asarray(np.logaddexp.reduce(over_grades(gripper, out.reshape(-1, n_grade)), axis=1))


def _evidence_about(gripper: GripperModel, data: Touches, noise: Whitened, mode: Mode) -> Array:
    """Return the log evidence of a free effusivity near ``mode``, where ln e is free, by the trapezoidal
    rule; points start where the other unknowns go along with ln e."""
    place, variance = mode.u[:, EFFUSIVITY], mode.covariance[:, EFFUSIVITY, EFFUSIVITY]
    lowest, highest = LN_E_RANGE
    low = np.clip(place + _AROUND[0] * np.sqrt(variance), lowest, highest - GRID.narrowest)
    high = np.clip(place + _AROUND[-1] * np.sqrt(variance), low + GRID.narrowest, highest)
    x = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _AROUND.size)
    along = mode.covariance[:, :, EFFUSIVITY] / variance[:, None]
    start = mode.u[:, None] + along[:, None] * (x - place[:, None])[:, :, None]
    # an object of none of the candidates is of something, most likely of a material of the table
    value = _modes_at(gripper, data, noise, x, start).log_evidence
    value += log_listed(x - gripper.effusivity_scale(x)[0])
    value[:, [0, -1]] -= np.log(2.0)
    return np.asarray(np.logaddexp.reduce(value, axis=1) + np.log((x[:, 1] - x[:, 0]) / (highest - lowest)))


def log_listed(ln_e: Array) -> Array:
    """Return by how much an effusivity is likelier a priori than by a log-uniform law, its logarithm, under
    even odds that an object is of some material of the table, each within 30 %, or of any effusivity."""
    listed = np.log([material.effusivity for material in load_materials().values()])
    width = LN_E_RANGE[1] - LN_E_RANGE[0]
    z = (ln_e[..., None] - listed) / GRID.listed_sd
    density = np.exp(-0.5 * z**2).mean(axis=-1) / (GRID.listed_sd * np.sqrt(2 * np.pi))
    return np.asarray(np.log(0.5 + 0.5 * width * density))


def mixed(parts: Sequence[GridPosterior], log_weight: Array) -> GridPosterior:
    """Return the mixture of posteriors of one grasp whose prior odds times evidence are ``log_weight``
    (n_part,)."""
    total = float(np.logaddexp.reduce(log_weight))
    share = np.exp(log_weight - total)
    x = np.concatenate([posterior.x for posterior in parts])
    mass = np.concatenate([s * posterior.mass for s, posterior in zip(share, parts)])
    weight = np.concatenate([s * posterior.weight for s, posterior in zip(share, parts)])
    order = np.argsort(x, kind="stable")
    t_object, sd, ln_h = (np.concatenate(columns) for columns in zip(*(posterior[4:] for posterior in parts)))
    return GridPosterior(x[order], mass[order], total, weight, t_object, sd, ln_h)


def mixture_quantiles(weight: Array, mean: Array, sd: Array, levels: tuple[float, ...]) -> list[float]:
    """Return quantiles of a mixture of normals, of arguments (m,)."""
    from scipy.optimize import brentq
    from scipy.special import ndtr

    low, high = float((mean - 9 * sd).min()), float((mean + 9 * sd).max())

    def beyond(x: float, level: float) -> float:
        return float(weight @ ndtr((x - mean) / sd)) - level

    return [float(brentq(beyond, low, high, args=(level,), xtol=1e-7)) for level in levels]


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


_PLACES = np.array([0.5, 0.46, 0.54, 0.42, 0.58, 0.38, 0.62])


def posterior_of(x: Array, value: Array, t_object: Array, sd: Array, ln_h: Array) -> GridPosterior:
    """Return the posterior of log densities ``value`` at points ``x``, along which these rise; arguments are
    (m,)."""
    from scipy.interpolate import Akima1DInterpolator

    likely = np.flatnonzero(value > value.max() - 20.0)
    fine = np.linspace(x[max(likely[0] - 1, 0)], x[min(likely[-1] + 1, x.size - 1)], GRID.fine_points)
    # 30 nats below the best nothing counts, and a cubic beside would swing
    log_density = Akima1DInterpolator(x, np.maximum(value, value.max() - 30.0))(fine)
    log_density[[0, -1]] -= np.log(2.0)  # by the trapezoidal rule
    total = float(np.logaddexp.reduce(log_density))
    evidence = total + float(np.log((fine[1] - fine[0]) / (LN_E_RANGE[1] - LN_E_RANGE[0])))
    weight = np.exp(value - value.max()) * np.gradient(x)
    counts = weight > 1e-9 * weight.max()  # tails without mass need no part in the mixtures
    weight = weight[counts] / weight[counts].sum()
    mass = np.exp(log_density - total)
    return GridPosterior(fine, mass, evidence, weight, t_object[counts], sd[counts], ln_h[counts])
