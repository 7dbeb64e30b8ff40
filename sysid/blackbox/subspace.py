"""Subspace identification (PO-MOESP and CVA) of linear state-space models, several outputs, several logs.

Write w for inputs, disturbances, products of inputs and a constant 1, and stack f rows of the future over f
rows of the past,

    Y_f = Gamma X + H W_f + noise,        X spanned by Z_p = [W_p; Y_p],

with Gamma = [C; CA; ...; CA^(f-1)].  The LQ factorisation of [W_f; Z_p; Y_f] takes the future inputs out, and
the left singular vectors of S L32 span Gamma.  PARSIM-K (Pannocchia and Calosi) regresses each future row on
the past and on drives and *readings* between; PO-MOESP and CVA are biased by feedback.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.order_selection import Structure, as_state_space, default_terms, drives
from thermogrip.sysid.blackbox.output_error import least_squares
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid, whole_readings

DEPENDENT = 1e-8  # of the largest singular value: what is less is none


def subspace_family(
    grid: Grid,
    *,
    orders: Sequence[int] = (1, 2, 3, 4, 5, 6),
    rows: Sequence[int] | None = None,
    terms: Sequence[tuple[str, ...]] | None = None,
    only: Collection[Structure] | None = None,
    weightings: Sequence[str] = ("moesp", "cva"),
) -> Mapping[Structure, StateSpaceModel]:
    """Return a model for each order, number of block rows f and weighting that the data allow."""
    models: dict[Structure, StateSpaceModel] = {}
    longest = max(len(segment.time) for segment in grid.segments)
    n_y, scale = len(grid.outputs), np.maximum(grid.output_spread(), 1e-9)
    n_signal = len(grid.inputs) + len(grid.disturbances) + n_y
    sizes = rows or [f for f in (3, 5, 8, 15, 30) if only is not None or 6 * f < longest]
    for some, f in product(default_terms(grid) if terms is None else terms, sizes):
        products = f", with {', '.join(some)}" if some else ""
        wanted: dict[tuple[str, int], Structure] = {}
        for weighting, n in product(weightings, orders):
            label = f"order {n}, {f} block rows, {weighting}{products}"
            structure = Structure(label, n * (n_signal + len(some) + 1), some)
            if n < f and (only is None or structure in only):
                wanted[weighting, n] = structure
        triangle = _triangle(grid, f, some) if wanted else None
        if triangle is None:
            continue
        for weighting in dict.fromkeys(weighting for weighting, _ in wanted):
            if weighting == "parsim":
                gamma = predictor_observability(triangle, f, n_y)
            else:
                gamma = extended_observability(*_factorise(triangle, f, n_y), weighting=weighting)
            for n in (n for kind, n in wanted if kind == weighting and n < gamma.shape[1]):
                # A follows from the shift of Gamma, C is its first block row
                before, after = gamma[:-n_y, :n], gamma[n_y:, :n]
                shift = np.asarray(np.linalg.lstsq(before, after, rcond=None)[0], dtype=float)
                C = gamma[:n_y, :n] * scale[:, None]
                models[wanted[weighting, n]] = fit_inputs(grid, stabilised(shift, longest), C, some)
    return models


def extended_observability(L32: Array, L33: Array, *, weighting: str) -> Array:
    """Return the columns that span Gamma, scaled by the roots of the singular values."""
    if weighting == "cva":
        # S = (L32 L32' + L33 L33')^(-1/2) (Larimore)
        size, vectors = np.linalg.eigh(L32 @ L32.T + L33 @ L33.T)
        size = np.maximum(size, 1e-10 * size.max())
        weight, back = (vectors * size**-0.5) @ vectors.T, (vectors * size**0.5) @ vectors.T
    else:
        # S = 1, PO-MOESP (Verhaegen)
        weight = back = np.eye(L32.shape[0])
    left_vectors, values, _ = np.linalg.svd(weight @ L32, full_matrices=False)
    return np.asarray(back @ (left_vectors * np.sqrt(values)))


def fit_inputs(grid: Grid, A: Array, C: Array, terms: tuple[str, ...] = ()) -> StateSpaceModel:
    """Return the model with the B, E, constant of the least free-run error, given A and C."""
    n = A.shape[0]
    y0 = np.nanmean(np.concatenate([segment.y for segment in grid.segments]), axis=0)
    scale = np.maximum(grid.output_spread(), 1e-9)
    w = drives(grid, terms)
    centre = np.concatenate(w).mean(axis=0)
    columns, targets = [], []
    for segment, drive in zip(grid.segments, w):
        is_read = np.isfinite(segment.y).T
        columns.append(_unit_responses(drive - centre, A, C / scale[:, None])[is_read].T)
        targets.append(((segment.y - y0) / scale).T[is_read])
    # B, E, the constant and one initial state per segment enter the *simulated* output linearly: a fit of the
    # free run, not of one step
    weights, starts = least_squares(columns, n, targets, DEPENDENT)
    W = weights.reshape(len(centre) + 1, n).T
    c = W[:, -1] - W[:, :-1] @ centre
    return as_state_space(grid, A, W[:, :-1], C, c, list(starts), terms=terms, y0=y0)


def _unit_responses(drive: Array, A: Array, C: Array) -> Array:
    """Simulate outputs for each unit entry of x0, then of [B E F c], drive by drive: (n_y, N, n + n_w n)."""
    # An entry e_k moves output i by C_i A^j e_k after j + 1 rows, which is entry k of A'^j C_i': one run of
    # the transposed system, pushed by the drive along C_i, has the responses to all n entries.
    from thermogrip.sysid.models.recurrences import run_linear  # pulls in numba

    n_y, n = C.shape
    rows = len(drive)
    w = np.vstack([np.zeros(rows), drive.T, np.ones(rows)])  # the first one: a start and no drive
    push = w[None, :, :-1, None] * C[:, None, None, :]
    starts = np.zeros((n_y, len(w), n))
    starts[:, 0] = C
    pushes, nothing = push.reshape(-1, rows - 1, n), np.zeros((1, rows - 1, 0))
    runs = run_linear(np.ascontiguousarray(A.T)[None], nothing, pushes, starts.reshape(-1, n), 1)
    return np.asarray(np.moveaxis(runs.reshape(n_y, len(w), rows, n), 1, 2).reshape(n_y, rows, -1))


def stabilised(A: Array, rows: int) -> Array:
    """Return A with poles beyond exp(-1 / rows) moved onto that circle, along their direction."""
    # a record of so many rows cannot distinguish a slower pole, or a growing one, from one of its own length
    poles, vectors = np.linalg.eig(A)
    beyond = np.abs(poles) > np.exp(-1 / rows)
    if not beyond.any():
        return A
    poles[beyond] *= np.exp(-1 / rows) / np.abs(poles[beyond])
    # of poles that coincide the vectors are dependent; least squares keeps what they span
    return np.asarray(np.real(vectors * poles @ np.linalg.pinv(vectors)))


def _triangle(grid: Grid, f: int, terms: tuple[str, ...]) -> Array | None:
    """Return R of the QR of all windows, signals at zero mean and unit spread; None with too few windows."""
    # Several logs are side by side in the Hankel matrices; a window that touches a gap or a lost reading is
    # left out.  Where less than half of the windows are whole, short holes are lines.
    pairs = zip(drives(grid, terms), whole_readings(grid.segments, 2 * f))
    signals = [np.hstack(pair) for pair in pairs]
    whole = np.concatenate(signals)
    mean, size = np.nanmean(whole, axis=0), np.nanstd(whole, axis=0)
    per_unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    n_w = whole.shape[1] - len(grid.outputs)
    triangles, count = [], 0
    for z in signals:
        if len(z) > 2 * f:
            rows = _windows((z - mean) * per_unit, n_w, f)
            # which has the same inner products
            triangles.append(np.asarray(np.linalg.qr(rows, mode="r")))
            count += len(rows)
    if not triangles or count < 1.5 * triangles[0].shape[1]:
        return None
    return np.asarray(np.linalg.qr(np.concatenate(triangles), mode="r"))


def _factorise(triangle: Array, f: int, n_y: int) -> tuple[Array, Array]:
    """Return L32 and L33 of the LQ factorisation."""
    # [W_f]   [L11          ]
    # [Z_p] = [L21 L22      ] Q',        L32 = Gamma X projected
    # [Y_f]   [L31 L32 L33  ]
    # the triangle has the same inner products; of an input that barely moves columns are dependent, and the
    # directions that a QR gives those are rounding
    window = _window_columns(triangle, f, n_y)
    # of rows that depend on others, as with an input that moves once, what is new
    future_basis = _span(window.future)
    past = window.past - future_basis @ (future_basis.T @ window.past)
    ahead = window.ahead - future_basis @ (future_basis.T @ window.ahead)
    state = _span(past)
    projected = state.T @ ahead
    return projected.T, (ahead - state @ projected).T


class _WindowColumns(NamedTuple):
    future: Array  # [W_f, 1]
    past: Array  # [W_p, Y_p]
    ahead: Array  # Y_f


def _window_columns(triangle: Array, f: int, n_y: int) -> _WindowColumns:
    parts = np.split(triangle, [-f * n_y - (triangle.shape[1] - 1) // 2, -f * n_y], axis=1)
    return _WindowColumns(*parts)


def predictor_observability(triangle: Array, f: int, n_y: int) -> Array:
    """Return the columns that span Gamma, from one-step predictors of every future row."""
    window = _window_columns(triangle, f, n_y)
    n_w, n_z = (window.future.shape[1] - 1) // f, window.past.shape[1]
    by_past, by_readings = np.zeros((f * n_y, n_z)), np.eye(f * n_y)
    constant = window.future[:, -1:]
    for row in range(f):
        # With the innovation e = y - C x and A_K = A - K C, x+ = A_K x + B w + K y, so that
        # Y_f = Gamma_K L Z_p + H_K W_f + G_K Y_f + E, H_K and G_K strictly lower triangular.
        # The e of a row depends on none of what it is regressed on, even where w was fed back from y.
        before = window.ahead[:, : row * n_y]
        regressors = np.hstack([window.past, before, window.future[:, : row * n_w], constant])
        row_outputs = slice(row * n_y, (row + 1) * n_y)
        weights = np.linalg.lstsq(regressors, window.ahead[:, row_outputs], rcond=DEPENDENT)[0].T
        by_past[row_outputs] = weights[:, :n_z]
        by_readings[row_outputs, : row * n_y] = -weights[:, n_z : n_z + row * n_y]
    apart = window.past - constant @ (constant.T @ window.past) / (constant.T @ constant)
    # Gamma L = (I - G_K)^-1 Gamma_K L
    left_vectors, values, _ = np.linalg.svd(
        np.linalg.solve(by_readings, by_past) @ apart.T, full_matrices=False
    )
    return np.asarray(left_vectors * np.sqrt(values))


def _span(columns: Array) -> Array:
    """Return an orthonormal basis of the columns, without what only rounding spans."""
    left_vectors, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left_vectors[:, size > DEPENDENT * size.max(initial=0.0)])


def _windows(z: Array, n_w: int, f: int) -> Array:
    """Return rows [W_f, 1, W_p, Y_p, Y_f] of every window of [w, y] without a lost reading."""
    view = np.lib.stride_tricks.sliding_window_view(z, 2 * f, axis=0)  # (windows, signals, 2 f)
    view = np.moveaxis(view, 2, 1)
    count = view.shape[0]
    past, future = view[:, :f], view[:, f:]
    blocks = [
        future[:, :, :n_w].reshape(count, -1),
        np.ones((count, 1)),
        past[:, :, :n_w].reshape(count, -1),
        past[:, :, n_w:].reshape(count, -1),
        future[:, :, n_w:].reshape(count, -1),
    ]
    rows = np.hstack(blocks)
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


parsim_family = partial(subspace_family, weightings=("parsim",))
