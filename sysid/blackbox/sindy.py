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
from math import comb
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
        n_term = comb(memory * n_y + outside + degree, degree)
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

    trajectories = _trajectories(grid, memory)
    if sum(len(run.move) for run in trajectories) < 3 * memory * len(grid.outputs) + 20:
        return None
    variables = np.concatenate([run.variables for run in trajectories])
    middle, size = variables.mean(axis=0), variables.std(axis=0)
    size = np.where(size > 1e-9, size, 1.0)
    library = pysindy.PolynomialLibrary(degree=degree)
    theta = np.asarray(library.fit_transform((variables - middle) / size), dtype=float)
    return _Features(
        theta=theta,
        move=np.concatenate([run.move for run in trajectories]),
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
    coefficients = np.asarray(scaled, dtype=float) * weight[:, None]
    exponents, natural = _natural(terms.powers, coefficients, terms.middle, terms.size)
    for i in range(len(grid.outputs)):  # the increment was fitted
        natural[
            i, int(np.flatnonzero((exponents == np.eye(exponents.shape[1], dtype=int)[i]).all(axis=1))[0])
        ] += 1
    return _bounded_model(grid, exponents, natural, terms.memory)


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


class _Trajectory(NamedTuple):
    """A run of whole rows."""

    variables: Array  # states, then inputs and disturbances
    move: Array  # increments of the outputs


def _trajectories(grid: Grid, memory: int) -> list[_Trajectory]:
    trajectories = []
    readings = whole_readings(grid.segments, memory + 5)
    for segment in (replace(some, y=y) for some, y in zip(grid.segments, readings)):
        is_read = np.r_[0, np.isfinite(segment.y).all(axis=1), 0]
        for begin, end in np.flatnonzero(np.diff(is_read)).reshape(-1, 2).tolist():
            y = segment.y[begin:end]
            if end - begin < memory + 5:
                continue
            now = range(memory - 1, len(y) - 1)
            states = [y[[k - lag for k in now]] for lag in range(memory)]
            outside = np.hstack([segment.u, segment.d])[begin:end][list(now)]
            variables = np.hstack([*states, outside])
            trajectories.append(_Trajectory(variables, np.diff(y, axis=0)[memory - 1 :]))
    return trajectories


def _natural(powers: NDArray[np.int_], coefficients: Array, middle: Array, size: Array) -> tuple[Any, Array]:
    """Expand polynomials of (v - middle) / size into polynomials of v."""
    expanded: dict[tuple[int, ...], Array] = {
        tuple(row): np.zeros(len(coefficients)) for row in powers.tolist()
    }
    for row, column in zip(powers, coefficients.T):
        product_terms: dict[tuple[int, ...], float] = {(0,) * len(row): 1.0}
        for variable, power in enumerate(row):
            for _ in range(power):
                bigger: dict[tuple[int, ...], float] = {}
                for key, value in product_terms.items():
                    up = tuple(k + (i == variable) for i, k in enumerate(key))
                    bigger[up] = bigger.get(up, 0.0) + value / size[variable]
                    bigger[key] = bigger.get(key, 0.0) - value * middle[variable] / size[variable]
                product_terms = bigger
        for key, value in product_terms.items():
            expanded[key] = expanded[key] + value * column
    keys = list(expanded)
    return np.array(keys, dtype=int), np.stack([expanded[key] for key in keys], axis=1)
