"""What a plant's residual still obeys: candidate terms, with what they explain on logs held out.

Let r = y - v be the error of the free run.  A heat flow that the equations lack moves it like

    tau dr/dt = -r + sum_j xi_j phi_j(u, d, v)          (tau infinite: a flow that is only stored),

phi_j products of inputs, magnitudes of signed inputs, disturbances and simulated outputs.  So r is regressed
on every phi_j filtered by 1 / (1 + tau s), for a ladder of tau; simulated outputs stand in the terms, not
measured ones, for the noise of a regressor would bias its coefficient.  Terms enter one at a time, the one
that explains most of the residual's variance on stretches *not* fitted (each log in turn, or each of four
blocks of a single one), and the search stops when the best adds less than :data:`LEAST`.  Levels are taken
out of each stretch, since sensors have offsets of their own.  A term that helps only the logs that it was
fitted to never appears.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, columns, log_name

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["ResidualTerm", "residual_terms"]

Array = NDArray[np.float64]

LEAST = 0.02  # of the residual's variance on held-out rows
ROWS = 400  # of the longest log: a residual is slow
BLOCKS = 4


@dataclass(frozen=True)
class ResidualTerm:
    """One candidate for what the plant lacks."""

    output: str  # whose residual
    term: str  # product of signals, such as ``"drive*|drive|"``; a simulated output has its own name
    coefficient: float  # static gain beside the terms before it [unit of the output per unit of the term]
    tau: float  # time constant of the response [s]
    share: float  # part of the residual's held-out variance that it explains beyond the terms before it


def residual_terms(
    plant: Plant, logs: Sequence[Log], *, warmup: float = 5.0, most: int = 4
) -> tuple[ResidualTerm, ...]:
    """Search the residuals of a plant's free runs for terms that its equations lack."""
    longest = max(float(np.ptp(log["time"].values)) for log in logs)
    step = max(plant.dt, longest / ROWS)
    runs = [_rows(plant, log, step, warmup) for log in logs]
    parts = _parts([len(time) for time, _, _ in runs])
    signs = np.concatenate([signals for _, signals, _ in runs])
    labels = _labels(plant, signs)
    taus = np.geomspace(2 * step, longest, 24)
    features = np.stack([_filtered(runs, labels, plant, tau) for tau in taus])  # (n_tau, rows, terms)
    residual = np.concatenate([r for _, _, r in runs])
    out: list[ResidualTerm] = []
    for i, name in enumerate(plant.outputs):
        out += _grow(residual[:, i], features, parts, labels, taus, name, most)
    return tuple(out)


def _rows(plant: Plant, log: Log, step: float, warmup: float) -> tuple[Array, Array, Array]:
    """Return block means: times, signals [inputs, disturbances, simulated outputs], residuals."""
    run = plant.simulate(log, warmup=warmup)
    time = np.asarray(log["time"].values, dtype=float)
    simulated = columns(run, plant.outputs)
    residual = np.where(run["scored"].values[:, None] > 0, columns(log, plant.outputs) - simulated, np.nan)
    signals = np.hstack([columns(log, plant.inputs), columns(log, plant.disturbances), simulated])
    cell = ((time - time[0]) / step).astype(int)
    if cell[-1] < 10 * BLOCKS:
        raise UserError("is too short to learn from its residual", file=log_name(log), hint="leave it out")
    return time[0] + step * np.unique(cell), _means(signals, cell), _means(residual, cell)


def _means(values: Array, cell: NDArray[np.int_]) -> Array:
    """Return means (n_cell, n) of the finite values in each cell that has rows; NaN where none is finite."""
    _, place = np.unique(cell, return_inverse=True)
    known = np.isfinite(values)
    total, count = np.zeros((place[-1] + 1, values.shape[1])), np.zeros((place[-1] + 1, values.shape[1]))
    np.add.at(total, place, np.where(known, values, 0.0))
    np.add.at(count, place, known.astype(float))
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1.0), np.nan))


def _parts(lengths: Sequence[int]) -> NDArray[np.int_]:
    """Return which stretch each row belongs to: its log, or with fewer than three its block of a log."""
    per = 1 if len(lengths) >= 3 else BLOCKS
    return np.concatenate([at * per + np.arange(n) * per // n for at, n in enumerate(lengths)])


def _labels(plant: Plant, signals: Array) -> list[str]:
    """Return single signals, magnitudes of signed inputs, and all products of two."""
    names = [*plant.inputs, *plant.disturbances, *plant.outputs]
    moving = [n for i, n in enumerate(names) if np.ptp(signals[:, i]) > 1e-9 * np.abs(signals[:, i]).max()]
    signed = [n for n in moving if n in plant.inputs and signals[:, names.index(n)].min() < 0]
    single = [*moving, *(f"|{n}|" for n in signed)]
    return [*single, *("*".join(pair) for pair in combinations_with_replacement(single, 2))]


def _filtered(
    runs: Sequence[tuple[Array, Array, Array]], labels: Sequence[str], plant: Plant, tau: float
) -> Array:
    """Return the terms (rows, n_term), filtered by a first-order lag log by log."""
    from thermogrip.sysid.models.lti import evaluate_terms

    names = (*plant.inputs, *plant.disturbances, *plant.outputs)
    out = []
    for time, signals, _ in runs:
        phi = evaluate_terms(labels, names, signals)
        keep = np.exp(-np.diff(time) / tau)
        lagged = np.empty_like(phi)
        lagged[0] = phi[0]
        for k in range(1, len(phi)):
            lagged[k] = keep[k - 1] * lagged[k - 1] + (1 - keep[k - 1]) * phi[k - 1]
        out.append(lagged)
    return np.concatenate(out)


def _grow(
    residual: Array,
    features: Array,
    parts: NDArray[np.int_],
    labels: Sequence[str],
    taus: Array,
    name: str,
    most: int,
) -> list[ResidualTerm]:
    """Return the terms of one output, each the best next one on held-out stretches."""
    known = np.isfinite(residual)
    r, X, where = residual[known], features[:, known], parts[known]
    r = _levelled(r[:, None], where)[:, 0]
    X = np.stack([_levelled(some, where) for some in X])
    chosen: list[tuple[int, int]] = []
    out: list[ResidualTerm] = []
    reached = 0.0
    while len(chosen) < most:
        best, at = reached + LEAST, None
        for tau in range(len(taus)):
            for term in range(len(labels)):
                some = np.column_stack([X[i, :, j] for i, j in (*chosen, (tau, term))])
                explained = _explained(some, r, where)
                if explained > best:
                    best, at = explained, (tau, term)
        if at is None:
            break
        chosen.append(at)
        some = np.column_stack([X[i, :, j] for i, j in chosen])
        value = float(np.linalg.lstsq(some, r, rcond=None)[0][-1])
        out.append(ResidualTerm(name, labels[at[1]], value, float(taus[at[0]]), best - reached))
        reached = best
    return out


def _levelled(values: Array, where: NDArray[np.int_]) -> Array:
    out = values.copy()
    for part in np.unique(where):
        out[where == part] -= out[where == part].mean(axis=0)
    return out


def _explained(X: Array, r: Array, where: NDArray[np.int_]) -> float:
    """Return 1 - (held-out squares) / (squares of r), each stretch predicted from the others."""
    grams = [(X[rows].T @ X[rows], X[rows].T @ r[rows]) for rows in (where == p for p in np.unique(where))]
    gram, cross = sum(g for g, _ in grams), sum(c for _, c in grams)
    ridge = 1e-9 * np.trace(gram) * np.eye(len(cross))
    left = 0.0
    for g, c in grams:
        value = np.linalg.solve(gram - g + ridge, cross - c)
        left += float(value @ g @ value - 2 * value @ c)
    return -left / max(float(r @ r), 1e-300)
