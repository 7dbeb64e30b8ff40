"""ARX models: least squares of the next reading on past readings and drives.

    y[k] = sum_i A_i y[k - i] + sum_l B_l w[k - n_k - l] + c + e[k],     i = 1..na,  l = 0..nb-1,  n_k >= 1,

w are inputs, disturbances and products of inputs (``|drive|``, ``drive*|drive|``: a Peltier element heats
and cools unequally; ``drive*drive``: Joule heat), and with ``switched`` each A_i differs between a pump that
runs and one that does not.
It is one linear regression: the normal equations of the largest structure hold those of all smaller ones, and
several logs only add rows.  Rows that would reach across a gap or use a lost reading are left out.

Its weakness is known: noise on the *regressors* pulls the poles towards fast ones, the more the finer the
sampling.  Hence block averages first, and a choice by free run and never by the one-step error that is
minimised here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid

#: Poles up to which all numbers of zeros are tried.  An arm that bends errs 25 times as much with three poles
#: as with eight; on slow plants the folds keep one or two.
_EACH = 3


@dataclass(frozen=True)
class _Orders:
    na: int
    nb: int
    delay: int
    coupled: bool
    switched: bool


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
    poles: Sequence[int] = (1, 2, 3, 4, 6, 8),
    zeros: Sequence[int] = (1, 2, 3, 4, 6, 8),
    delays: Sequence[int] = (1, 2, 4),
    terms: Sequence[tuple[str, ...]] | None = None,
    only: Structure | None = None,
) -> Mapping[Structure, StateSpaceModel]:
    """Return an ARX model for each structure that gives a stable one; orders na, nb and delays n_k are in
    rows; above :data:`_EACH` poles only as many zeros, and with products of inputs only the first two of each
    are tried."""
    out = {}
    moving = any(
        np.ptp(np.concatenate([s.u[:, grid.inputs.index(n)] for s in grid.segments])) for n in grid.switches
    )
    couplings = (False, True) if len(grid.outputs) > 1 else (True,)
    for some in default_terms(grid) if terms is None else terms:
        regression, orders = _deepest(grid, some, [poles, zeros, delays])
        if regression is None:
            continue
        # with products of inputs only the smaller half, for their number multiplies the structures
        orders = [part[:2] if some else part for part in orders]
        for (na, nb, nk), coupled in product(product(*orders), couplings):
            if max(na, nb) > _EACH and na != nb and len(poles) > 1 and len(zeros) > 1:
                continue
            for switched in (False, True) if moving and coupled else (False,):
                tried = _Orders(na, nb, nk, coupled, switched)
                structure = _structure(grid, some, tried)
                model = _solve(grid, some, regression, tried) if only in (None, structure) else None
                if model is not None:
                    out[structure] = model
    return out


def _structure(grid: Grid, terms: tuple[str, ...], orders: _Orders) -> Structure:
    n_y, n_drive = len(grid.outputs), len(grid.inputs) + len(grid.disturbances) + len(terms)
    ways = 1 + len(grid.switches) * orders.switched
    size = n_y * (orders.na * (n_y if orders.coupled else 1) * ways + n_drive * orders.nb + 1)
    label = f"na {orders.na}, nb {orders.nb}, delay {orders.delay}"
    label += ", coupled" if orders.coupled and n_y > 1 else ""
    label += f", switched by {' and '.join(grid.switches)}" if orders.switched else ""
    return Structure(label + (f", with {', '.join(terms)}" if terms else ""), size)


def _deepest(
    grid: Grid, terms: tuple[str, ...], orders: list[Sequence[int]]
) -> tuple[_Regression | None, list[Sequence[int]]]:
    """Return the regression of as many lags as the rows allow, and the orders, delays last, that it has: of
    short logs with many signals the longest delays are left out, then the highest orders."""
    while True:
        poles, zeros, delays = orders
        regression = _regress(grid, terms, max(poles), max(zeros) + max(delays) - 1)
        if regression is not None or max(map(len, orders)) == 1:
            return regression, orders
        which = slice(2, 3) if len(delays) > 1 else slice(0, 2)
        orders[which] = [part[:-1] or part for part in orders[which]]


def _regress(grid: Grid, terms: tuple[str, ...], deep_y: int, deep_w: int) -> _Regression | None:
    """Form X'X and X'Y, columns [y lags | switch x y lags | w lags | 1], every lag from 1 to one depth."""
    deep = max(deep_y, deep_w)
    blocks, targets = [], []
    for segment, w in zip(grid.segments, drives(grid, terms)):
        n = len(segment.time)
        if n <= deep + 1:
            continue
        past_y = [segment.y[deep - i : n - i] for i in range(1, deep + 1)]
        on = [segment.u[deep - 1 : n - 1, [grid.inputs.index(name)]] for name in grid.switches]
        switched = [s * past for s in on for past in past_y]
        past_w = [w[deep - i : n - i] for i in range(1, deep + 1)]
        X = np.hstack([*past_y, *switched, *past_w, np.ones((n - deep, 1))])
        whole = np.isfinite(X).all(axis=1) & np.isfinite(segment.y[deep:]).all(axis=1)
        blocks.append(X[whole])
        targets.append(segment.y[deep:][whole])
    if not blocks or sum(map(len, blocks)) < 2 * blocks[0].shape[1]:
        return None
    X, Y = np.concatenate(blocks), np.concatenate(targets)
    size = column_sizes(np.linalg.norm(X, axis=0))
    return _Regression((X / size).T @ (X / size), (X / size).T @ Y, size, deep)


def _solve(
    grid: Grid, terms: tuple[str, ...], regression: _Regression, orders: _Orders
) -> StateSpaceModel | None:
    """Solve one structure from the normal equations; None where the model is unstable."""
    n_y, n_s = len(grid.outputs), len(grid.switches)
    n_w = len(grid.inputs) + len(grid.disturbances) + len(terms)
    deep = regression.deep
    whole = np.zeros((regression.gram.shape[0], n_y))
    for i in range(n_y):
        whole[_columns(orders, deep, n_y, n_s, n_w, i), i] = 1
    solution = np.zeros_like(whole)
    for i in range(n_y):
        pick = np.flatnonzero(whole[:, i])
        part = np.linalg.lstsq(regression.gram[np.ix_(pick, pick)], regression.cross[pick, i], rcond=1e-13)[0]
        solution[pick, i] = part / regression.size[pick]
    lags = solution[:-1].T
    end = deep * n_y
    A = [lags[:, i * n_y : (i + 1) * n_y] for i in range(orders.na)]
    A_s = [
        [lags[:, end * (1 + s) + i * n_y : end * (1 + s) + (i + 1) * n_y] for i in range(orders.na)]
        for s in range(n_s if orders.switched else 0)
    ]
    first = end * (1 + n_s)
    B = [lags[:, first + i * n_w : first + (i + 1) * n_w] for i in range(orders.delay + orders.nb - 1)]
    model = _realise(grid, terms, A, A_s, B, solution[-1])
    return with_spread(model, grid, _at_rest(model, grid, terms, orders)) if model.stable else None


def _at_rest(model: StateSpaceModel, grid: Grid, terms: tuple[str, ...], orders: _Orders) -> list[Array]:
    """Return the state in which each segment's first reading and first drives have always stood."""
    out = []
    for segment, w in zip(grid.segments, drives(grid, terms)):
        first = segment.y[np.argmax(np.isfinite(segment.y), axis=0), np.arange(len(grid.outputs))]
        middle = np.nan_to_num(first, nan=0.0)
        out.append(np.concatenate([np.tile(middle, orders.na), np.tile(w[0], orders.delay + orders.nb - 2)]))
    return out


def _columns(orders: _Orders, deep: int, n_y: int, n_s: int, n_w: int, output: int) -> list[int]:
    """Return the columns of the full regression that this structure uses for one output."""
    seen = range(n_y) if orders.coupled else [output]
    own = [lag * n_y + j for lag in range(orders.na) for j in seen]
    out = list(own)
    for s in range(n_s if orders.switched else 0):
        out += [deep * n_y * (1 + s) + column for column in own]
    first = deep * n_y * (1 + n_s)
    late = range(orders.delay - 1, orders.delay + orders.nb - 1)
    return [*out, *(first + lag * n_w + j for lag in late for j in range(n_w)), first + deep * n_w]


def _realise(
    grid: Grid,
    terms: tuple[str, ...],
    A: Sequence[Array],
    A_s: Sequence[Sequence[Array]],
    B: Sequence[Array],
    c: Array,
) -> StateSpaceModel:
    """Return the model with state [y[k], ..., y[k-na+1], w[k-1], ..., w[k-m]], m = delay + nb - 2."""
    n_y, n_w, m = len(grid.outputs), B[0].shape[1], len(B) - 1
    n = len(A) * n_y + m * n_w
    top = np.hstack([*A, *B[1:]])
    matrix = np.zeros((n, n))
    matrix[:n_y] = top
    matrix[n_y : len(A) * n_y, : (len(A) - 1) * n_y] = np.eye((len(A) - 1) * n_y)
    push = np.zeros((n, n_w))
    push[:n_y] = B[0]
    if m:
        low = len(A) * n_y
        push[low : low + n_w] = np.eye(n_w)
        matrix[low + n_w :, low : n - n_w] = np.eye((m - 1) * n_w)
    switched = {}
    for name, parts in zip(grid.switches, A_s):
        change = np.zeros((n, n))
        change[:n_y, : len(A) * n_y] = np.hstack(parts)
        switched[name] = change
    parts = matrix, push, np.eye(n_y, n), np.concatenate([c, np.zeros(n - n_y)])
    return as_state_space(grid, *parts, terms=terms, origin="arx", A_switch=switched)
