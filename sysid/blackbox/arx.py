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

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.order_selection import (
    Structure,
    as_state_space,
    column_sizes,
    default_terms,
    drives,
    with_spread,
)
from thermogrip.sysid.models.state_space import StateSpaceModel, first_readings
from thermogrip.sysid.plant.log_grid import Grid


@dataclass(frozen=True)
class _Orders:
    poles: int  # and as many rows of the drives
    delay: int
    coupled: bool  # whether an output's past is in the equations of the others


@dataclass(frozen=True, eq=False)
class _Regression:
    """Normal equations of the largest structure; every smaller one is a part of them."""

    gram: Array  # X'X over standardised columns
    cross: Array  # X'Y
    size: Array  # norms of the columns of X
    deep: int


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
    for products in default_terms(grid) if terms is None else terms:
        regression = _regress(grid, products, max(poles) + max(delays) - 1)
        if regression is None:
            continue
        for n, delay, coupled in product(poles, delays, couplings):
            own_and_driven = (n_y if coupled else 1) + n_drive + len(products)
            label = f"na {n}, nb {n}, delay {delay}" + (", coupled" if coupled and n_y > 1 else "")
            label += f", with {', '.join(products)}" if products else ""
            structure = Structure(label, n_y * (n * own_and_driven + 1), products)
            if only is not None and structure not in only:
                continue
            model = _solve(grid, products, regression, _Orders(n, delay, coupled))
            if model is not None:
                out[structure] = model
    return out


def _regress(grid: Grid, terms: tuple[str, ...], deep: int) -> _Regression | None:
    """Form X'X and X'Y, columns [y lags | w lags | 1], every lag from 1 to one depth."""
    # the normal equations of the largest structure hold those of all smaller ones; several logs only add
    # rows, and rows that would reach across a gap or use a lost reading are left out
    blocks, targets = [], []
    for segment, w in zip(grid.segments, drives(grid, terms)):
        y, n = segment.y, len(segment.y)
        if n <= deep:
            continue
        past_y = [y[deep - i : n - i] for i in range(1, deep + 1)]
        past_w = [w[deep - i : n - i] for i in range(1, deep + 1)]
        X = np.hstack([*past_y, *past_w, np.ones((n - deep, 1))])
        whole = np.isfinite(X).all(axis=1) & np.isfinite(y[deep:]).all(axis=1)
        blocks.append(X[whole])
        targets.append(y[deep:][whole])
    if not blocks or sum(map(len, blocks)) < 2 * blocks[0].shape[1]:
        return None
    X, Y = np.concatenate(blocks), np.concatenate(targets)
    size = column_sizes(np.linalg.norm(X, axis=0))
    return _Regression((X / size).T @ (X / size), (X / size).T @ Y, size, deep)


def _solve(
    grid: Grid, terms: tuple[str, ...], regression: _Regression, orders: _Orders
) -> StateSpaceModel | None:
    """Solve one structure from the normal equations; None where the model is unstable."""
    n_y, n_w = len(grid.outputs), len(grid.inputs) + len(grid.disturbances) + len(terms)
    solution = np.zeros((regression.gram.shape[0], n_y))
    for output in range(n_y):
        columns = _structure_columns(orders, regression.deep, n_y, n_w, output)
        gram, cross = regression.gram[np.ix_(columns, columns)], regression.cross[columns, output]
        solution[columns, output] = np.linalg.lstsq(gram, cross, rcond=1e-13)[0] / regression.size[columns]
    lags = solution[:-1].T
    A = [lags[:, i * n_y : (i + 1) * n_y] for i in range(orders.poles)]
    first = regression.deep * n_y
    B = [lags[:, first + i * n_w : first + (i + 1) * n_w] for i in range(orders.delay + orders.poles - 1)]
    model = _arx_realisation(grid, terms, A, B, solution[-1])
    if not model.stable:
        return None
    starts = []
    for segment, w in zip(grid.segments, drives(grid, terms)):
        # its first reading and first drives have always stood
        middle = np.nan_to_num(first_readings(segment.y), nan=0.0)
        past_drives = np.tile(w[0], orders.delay + orders.poles - 2)
        starts.append(np.concatenate([np.tile(middle, orders.poles), past_drives]))
    return with_spread(model, grid, starts)


def _structure_columns(orders: _Orders, deep: int, n_y: int, n_w: int, output: int) -> list[int]:
    """Return the columns of the full regression that this structure uses for one output."""
    outputs = range(n_y) if orders.coupled else [output]
    past_y = [lag * n_y + j for lag in range(orders.poles) for j in outputs]
    first = deep * n_y
    late = range(orders.delay - 1, orders.delay + orders.poles - 1)
    return [*past_y, *(first + lag * n_w + j for lag in late for j in range(n_w)), first + deep * n_w]


def _arx_realisation(
    grid: Grid, terms: tuple[str, ...], A: Sequence[Array], B: Sequence[Array], c: Array
) -> StateSpaceModel:
    """Return the model with state [y[k], ..., y[k-n+1], w[k-1], ..., w[k-m]], m = len(B) - 1."""
    n_y = len(grid.outputs)
    n_w = B[0].shape[1]
    m = len(B) - 1
    n = len(A) * n_y + m * n_w
    matrix = np.zeros((n, n))
    matrix[:n_y] = np.hstack([*A, *B[1:]])
    matrix[n_y : len(A) * n_y, : (len(A) - 1) * n_y] = np.eye((len(A) - 1) * n_y)
    push = np.zeros((n, n_w))
    push[:n_y] = B[0]
    if m:
        low = len(A) * n_y
        push[low : low + n_w] = np.eye(n_w)
        matrix[low + n_w :, low : n - n_w] = np.eye((m - 1) * n_w)
    matrices = matrix, push, np.eye(n_y, n), np.concatenate([c, np.zeros(n - n_y)])
    return as_state_space(grid, *matrices, terms=terms, origin="arx")
