"""Sparse nonlinear difference equations with control (SINDy), by pysindy.

With z the outputs, their last values (``memory``), inputs and disturbances, each scaled to zero mean and
unit spread,

    y[k+1] = y[k] + Xi' Theta(z[k]),

Theta all monomials up to a degree, and Xi sparse: sequentially thresholded least squares (STLSQ; Brunton,
Proctor, Kutz) drops what is smaller than a threshold, refits, and repeats.

Degree, threshold and memory are chosen by held-out free run; an equation whose simulation leaves ten times
the range of the data is refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import comb

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.order_selection import Structure, state_spread
from thermogrip.sysid.models.polynomial import SindyModel
from thermogrip.sysid.models.state_space import first_readings
from thermogrip.sysid.plant.log_grid import Grid, whole_readings


def sindy_family(
    grid: Grid,
    *,
    degrees: Sequence[int] = (1, 2),
    thresholds: Sequence[float] = (0.0, 0.01, 0.05),
    memories: Sequence[int] = (1, 2),
    only: Collection[Structure] | None = None,
) -> Mapping[Structure, SindyModel]:
    """Return a model for each degree, threshold (a share of the largest coefficient) and memory (values of
    each output) whose simulation stays bounded."""
    out: dict[Structure, SindyModel] = {}
    n_y, outside = len(grid.outputs), len(grid.inputs) + len(grid.disturbances)
    for degree, memory in product(degrees, memories):
        n_term = comb(memory * n_y + outside + degree, degree, exact=True)
        wanted: dict[Structure, float] = {}
        for rank, threshold in enumerate(sorted(thresholds)):
            # the same on every fold, however many terms survive there: all terms, less for each threshold
            label = f"degree {degree}, memory {memory}, threshold {threshold:g}"
            structure = Structure(label, max(1, n_y * n_term - rank))
            if only is None or structure in only:
                wanted[structure] = threshold
        terms = _features(grid, degree, memory) if wanted else None
        if terms is None:
            continue
        for structure, threshold in wanted.items():
            model = _fit_terms(grid, terms, threshold)
            if model is not None:
                out[structure] = model
    return out


@dataclass(frozen=True, eq=False)
class _Features:
    """Monomials and increments of every run of whole rows, and what they were scaled with."""

    theta: Array
    move: Array
    powers: NDArray[np.int_]
    middle: Array
    size: Array
    memory: int


def _features(grid: Grid, degree: int, memory: int) -> _Features | None:
    """Return the terms of one degree and memory, None where too few rows are whole."""
    import pysindy

    lagged = []
    for segment, y in zip(grid.segments, whole_readings(grid.segments, memory + 5)):
        now = max(len(y) - memory, 0)  # rows that have a past and a next one
        states = [y[memory - 1 - lag :][:now] for lag in range(memory)]
        outside = [each[memory - 1 :][:now] for each in (segment.u, segment.d)]
        lagged.append(np.hstack([*states, *outside, np.diff(y, axis=0)[memory - 1 :]]))
    rows = np.concatenate(lagged)
    rows = rows[np.isfinite(rows).all(axis=1)]
    n_y = len(grid.outputs)
    if len(rows) < 3 * memory * n_y + 20:
        return None
    variables, move = rows[:, :-n_y], rows[:, -n_y:]
    middle, size = variables.mean(axis=0), variables.std(axis=0)
    size = np.where(size > 1e-9, size, 1.0)
    library = pysindy.PolynomialLibrary(degree=degree)
    theta = np.asarray(library.fit_transform((variables - middle) / size), dtype=float)
    return _Features(
        theta=theta,
        move=move,
        powers=np.asarray(library.powers_, dtype=int),
        middle=middle,
        size=size,
        memory=memory,
    )


def _fit_terms(grid: Grid, terms: _Features, threshold: float) -> SindyModel | None:
    import pysindy

    # the increment and not the next value: so the threshold weighs what moves the plant, not its persistence
    theta, move = terms.theta, terms.move
    weight = np.maximum(move.std(axis=0), 1e-12)
    if len(theta) < 2 * theta.shape[1]:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pysindy warns of every term that it drops
        scaled = pysindy.STLSQ(threshold=0.0, alpha=1e-6).fit(theta, move / weight).coef_
        if threshold:
            relative = threshold * float(np.abs(scaled).max())
            scaled = pysindy.STLSQ(threshold=relative, alpha=1e-6).fit(theta, move / weight).coef_
    # the coefficients of polynomials of v, of those of (v - middle) / size
    powers, fewer = terms.powers, terms.powers[:, None]
    expanded = comb(powers, fewer) * (-terms.middle) ** np.maximum(powers - fewer, 0) / terms.size**powers
    natural = (np.asarray(scaled, dtype=float) * weight[:, None]) @ np.prod(expanded, axis=2).T
    # the increment was fitted
    natural += (powers[:, : len(natural)].T == 1) & (powers.sum(axis=1) == 1)
    return _bounded_model(grid, powers, natural, terms.memory)


def _bounded_model(grid: Grid, exponents: NDArray[np.int_], natural: Array, memory: int) -> SindyModel | None:
    """Return the model, or None where its simulation of the training data diverges."""
    y = np.concatenate([segment.y for segment in grid.segments])
    low, high = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
    if not np.isfinite(natural).all() or not np.all(high > low):
        return None
    labels = (grid.inputs, grid.disturbances, grid.outputs, grid.dt, grid.switches)
    model = SindyModel(*labels, memory, exponents, natural, low, high)
    starts = [model.rest(first_readings(segment.y), (), (), ())[None] for segment in grid.segments]
    runs = [model.states(x0, s.u[None], s.d[None])[0] for x0, s in zip(starts, grid.segments)]
    x = np.concatenate([run[memory - 1 :] for run in runs])
    return replace(model, spread=state_spread(x)) if np.isfinite(x).all() else None
