"""ARX models: least squares of the next reading on past readings and drives.

    y[k] = sum_i A_i y[k - i] + sum_l B_l w[k - n_k - l] + c + e[k],     i, l = 1..n or 0..n-1,  n_k >= 1,

w are inputs, disturbances and products of inputs (``|drive|``: a Peltier element heats and cools unequally;
``drive*drive``: Joule heat).  Noise on the *regressors* pulls the poles towards fast ones, the more the finer
the sampling: hence block averages first, and a choice by free run.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.order_selection import (
    Structure,
    column_sizes,
    default_terms,
    drives,
    held,
    polynomial_model,
)
from thermogrip.sysid.models.state_space import StateSpaceModel, first_readings
from thermogrip.sysid.plant.log_grid import Grid


@dataclass(frozen=True, eq=False)
class Regression:
    """Normal equations of the largest structure, columns [y lags | w lags | 1], every lag from 1 to one
    depth; those of all smaller ones are a part of them."""

    gram: Array  # X'X over standardised columns
    cross: Array  # X'Y
    size: Array  # norms of the columns of X
    lag: Array  # of each column; 0: the constant
    signal: Array  # of each column: an output, or a drive after them

    @classmethod
    def of(cls, outputs: Sequence[Array], drives: Sequence[Array], deep: int) -> Regression | None:
        """Return those of segments (n, n_y) and (n, n_w); None where too few rows are whole."""
        # several logs only add rows; one that would reach across a gap or use a lost reading is left out
        blocks, targets = [], []
        for y, w in zip(outputs, drives):
            n = len(y)
            if n <= deep:
                continue
            past = [signals[deep - i : n - i] for signals in (y, w) for i in range(1, deep + 1)]
            X = np.hstack([*past, np.ones((n - deep, 1))])
            whole = np.isfinite(X).all(axis=1) & np.isfinite(y[deep:]).all(axis=1)
            blocks.append(X[whole])
            targets.append(y[deep:][whole])
        if not blocks or sum(map(len, blocks)) < 2 * blocks[0].shape[1]:
            return None
        X, Y = np.concatenate(blocks), np.concatenate(targets)
        size = column_sizes(np.linalg.norm(X, axis=0))
        n_y, n_w, lags = outputs[0].shape[1], drives[0].shape[1], np.arange(1, deep + 1)
        signal = np.concatenate([np.tile(np.arange(n_y), deep), np.tile(n_y + np.arange(n_w), deep), [-1]])
        lag = np.concatenate([np.repeat(lags, n_y), np.repeat(lags, n_w), [0]])
        return cls((X / size).T @ (X / size), (X / size).T @ Y, size, lag, signal)

    def columns(self, output: int, poles: int, late: Sequence[int], *, coupled: bool) -> NDArray[np.intp]:
        """Return which columns the equation of an output has: lags of the outputs, or its own alone where
        these are not coupled, up to ``poles``, those of the drives in ``late``, and the constant."""
        n_y = self.cross.shape[1]
        is_past = (self.lag <= poles) & ((self.signal < n_y) if coupled else (self.signal == output))
        is_drive = (self.signal >= n_y) & np.isin(self.lag, late)
        return np.flatnonzero(is_past | is_drive | (self.lag == 0))

    def solve(self, output: int, poles: int, late: Sequence[int], *, coupled: bool = True) -> Array:
        """Return the weights of one output's equation, 0 for a column that it has not."""
        columns = self.columns(output, poles, late, coupled=coupled)
        weights = np.zeros(len(self.size))
        gram, cross = self.gram[np.ix_(columns, columns)], self.cross[columns, output]
        weights[columns] = np.linalg.lstsq(gram, cross, rcond=1e-13)[0] / self.size[columns]
        return weights


def arx_family(
    grid: Grid,
    *,
    # an arm that bends errs 25 times as much with three poles as with eight; fewer rows of the drives than
    # poles and delays of four rows changed no choice on 14 public logs
    poles: Sequence[int] = (1, 2, 3, 4, 6, 8),
    delays: Sequence[int] = (1, 2),
    terms: Sequence[tuple[str, ...]] | None = None,
    only: Collection[Structure] | None = None,
) -> Mapping[Structure, StateSpaceModel]:
    """Return an ARX model for each structure that gives a stable one, delays n_k in rows."""
    out = {}
    n_y, n_drive = len(grid.outputs), len(grid.inputs) + len(grid.disturbances)
    couplings = (False, True) if n_y > 1 else (True,)
    deep = max(poles) + max(delays) - 1
    for products in default_terms(grid) if terms is None else terms:
        w = drives(grid, products)
        regression = Regression.of([segment.y for segment in grid.segments], w, deep)
        if regression is None:
            continue
        for n, delay, coupled in product(poles, delays, couplings):
            own_and_driven = (n_y if coupled else 1) + n_drive + len(products)
            label = f"na {n}, nb {n}, delay {delay}" + (", coupled" if coupled and n_y > 1 else "")
            label += f", with {', '.join(products)}" if products else ""
            structure = Structure(label, n_y * (n * own_and_driven + 1), products)
            if only is not None and structure not in only:
                continue
            late = range(delay, delay + n)  # of an equation, and its rows of the drives
            equations = [regression.solve(k, n, late, coupled=coupled) for k in range(n_y)]
            model = _arx_model(grid, np.transpose(equations), w, late[-1], products)
            if model.stable:
                out[structure] = model
    return out


def _arx_model(
    grid: Grid, weights: Array, w: Sequence[Array], n: int, terms: tuple[str, ...]
) -> StateSpaceModel:
    """Return the model of weights (columns, n_y), whose lags beyond n are 0."""
    n_y, n_w = weights.shape[1], w[0].shape[1]
    deep = len(weights) // (n_y + n_w)
    A = weights[: n_y * deep].reshape(deep, n_y, n_y).swapaxes(1, 2)[:n]
    B = weights[n_y * deep : -1].reshape(deep, n_w, n_y).swapaxes(1, 2)[:n]
    starts = []
    for segment, drive in zip(grid.segments, w):
        # its first reading and first drives have always stood
        first = np.nan_to_num(first_readings(segment.y), nan=0.0)
        starts.append(np.vstack([first, held(A @ first + B @ drive[0])[1:]]))
    return polynomial_model(grid, A, B, weights[-1], starts, terms=terms)
