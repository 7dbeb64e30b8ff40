r"""Training of a one-layer LSTM with a linear readout, compiled: the same steps as PyTorch's, sooner.

One row of the batch at one time is :math:`a_t = [h_{t-1}, x_t, 1, 0]` and the sums of its gates are
:math:`z_t = a_t W`, with :math:`W` the stacked transposes of U, the input weights and the biases.  Backwards,
with :math:`\delta_t = \partial L / \partial z_t`,

.. math:: \frac{\partial L}{\partial W} = \sum_t a_t^T \delta_t, \qquad
          \frac{\partial L}{\partial h_{t-1}} = \delta_t U,

so an epoch is three small products a step (:mod:`thermogrip.classify.estimators.lstm_vectors`), and nothing
is allocated.  The hidden units are padded with zeros to whole vectors: a unit without weights stays 0, and so
does its slope.

A batch is cut into pieces of 25 series.  Each piece has gradients of its own, which are added in order, so
that a seed gives the same numbers on any number of threads.  Adam is that of Kingma and Ba, as PyTorch
writes it:

.. math:: m \leftarrow m + (1 - \beta_1)(g - m), \quad v \leftarrow \beta_2 v + (1 - \beta_2) g^2, \quad
          p \leftarrow p - \frac{\eta}{1 - \beta_1^k} \frac{m}{\sqrt{v / (1 - \beta_2^k)} + \epsilon}.

This file and the one beside it alone import numba.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any, TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.estimators.lstm_vectors import (
    LANE_BYTES,
    ROWS,
    VECTORS,
    add_product,
    close_gates,
    open_gates,
    set_product,
)

__all__ = ["train_network"]

Reals: TypeAlias = NDArray[Any]
Rows: TypeAlias = NDArray[np.int64]

_PIECE = 25  # series; two pieces a thread and batch of 100, and their arrays stay in the cache
_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8
_WIDTH_BYTES = VECTORS * LANE_BYTES


def train_network(
    weights: Mapping[str, Reals],
    x: Reals,
    target: Rows,
    epochs: Sequence[Sequence[Rows]],
    *,
    learning_rate: float,
    threads: int = 1,
) -> tuple[dict[str, Reals], NDArray[np.float64]]:
    """Return the trained weights, and the mean cross entropy of each epoch.

    Parameters
    ----------
    weights : dict of str to ndarray
        ``lstm.weight_ih_l0`` (4 H, S), ``lstm.weight_hh_l0`` (4 H, H), ``lstm.bias_ih_l0``,
        ``lstm.bias_hh_l0`` (4 H,), ``readout.weight`` (K, H), ``readout.bias`` (K,), gates in the order i, f,
        g, o.
        Their precision is that of the training.
    x : (n_series, n_time, S) ndarray
        Series.
    target : (n_series,) ndarray of int
        Classes, 0 to K - 1.
    epochs : sequence of sequence of ndarray of int
        The rows of each batch of each epoch.
    learning_rate : float
        Of Adam.
    threads : int, optional
        The numbers do not depend on it.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> made = {"weight_ih_l0": (64, 1), "weight_hh_l0": (64, 16), "bias_ih_l0": (64,), "bias_hh_l0": (64,)}
    >>> made = {f"lstm.{k}": s for k, s in made.items()} | {"readout.weight": (2, 16), "readout.bias": (2,)}
    >>> start = {k: 0.2 * rng.standard_normal(s) for k, s in made.items()}
    >>> x = np.repeat([[[0.0]] * 9, [[1.0]] * 9], 5, axis=0)
    >>> batches = [[np.arange(10)]] * 40
    >>> trained, losses = train_network(start, x, np.repeat([0, 1], 5), batches, learning_rate=0.05)
    >>> losses.shape, bool(losses[-1] < 0.05 < 0.5 < losses[0])
    ((40,), True)
    """
    packed = _Packed(weights)
    work = _Work(packed, x, target, max((rows.size for rows in epochs[0]), default=0))
    losses = np.zeros(len(epochs))
    step = 0
    keep = tuple(map(packed.real, (1 - _BETA_1, _BETA_2, 1 - _BETA_2, _EPSILON)))
    with ThreadPoolExecutor(threads) if threads > 1 else nullcontext() as pool:
        for k, batches in enumerate(epochs):
            for rows in batches:
                step += 1
                losses[k] += work.gradients(np.ascontiguousarray(rows), threads, pool)
                rates = learning_rate / (1 - _BETA_1**step), 1 / np.sqrt(1 - _BETA_2**step)
                _adam(packed.flat, work.total, packed.mean, packed.square, *map(packed.real, rates), keep)
            losses[k] /= sum(rows.size for rows in batches)
    return packed.unpacked(), losses


class _Packed:
    """All weights in one vector: the matrix W with the input's biases, the other biases, the readout."""

    def __init__(self, weights: Mapping[str, Reals]) -> None:
        recurrent, inputs = weights["lstm.weight_hh_l0"], weights["lstm.weight_ih_l0"]
        self.real = recurrent.dtype.type
        self.hidden, self.sensors, self.classes = (
            recurrent.shape[1],
            inputs.shape[1],
            weights["readout.bias"].size,
        )
        width = _WIDTH_BYTES // recurrent.dtype.itemsize
        self.padded = -(-self.hidden // width) * width
        self.depth = -(-(self.padded + self.sensors + 1) // ROWS) * ROWS
        n = self.padded
        sizes = [self.depth * 4 * n, 4 * n, self.classes * n, self.classes]
        self.flat = np.zeros(sum(sizes), self.real)
        self.mean, self.square = np.zeros_like(self.flat), np.zeros_like(self.flat)
        parts = np.split(self.flat, np.cumsum(sizes)[:-1])
        self.matrix, self.bias = parts[0].reshape(self.depth, 4 * n), parts[1]
        self.readout, self.offset = parts[2].reshape(self.classes, n), parts[3]
        for place, values in zip(self._places(), weights_in_order(weights)):
            place[...] = values

    def _places(self) -> list[Reals]:
        """Return where the weights stand, as views in the shapes of :func:`weights_in_order`."""
        h, s, n = self.hidden, self.sensors, self.padded
        gates = self.matrix.reshape(self.depth, 4, n)[:, :, :h]
        return [
            gates[n : n + s].transpose(1, 2, 0),
            gates[:h].transpose(1, 2, 0),
            gates[n + s],
            self.bias.reshape(4, n)[:, :h],
            self.readout[:, :h],
            self.offset,
        ]

    def unpacked(self) -> dict[str, Reals]:
        """Return the weights by name, in the shapes that they came in."""
        flat = [np.ascontiguousarray(place) for place in self._places()]
        rows = 4 * self.hidden
        gated: list[tuple[int, ...]] = [(rows, self.sensors), (rows, self.hidden), (rows,), (rows,)]
        shapes = [*gated, flat[4].shape, flat[5].shape]
        return {name: values.reshape(shape) for name, values, shape in zip(_NAMES, flat, shapes)}


_NAMES = (
    "lstm.weight_ih_l0",
    "lstm.weight_hh_l0",
    "lstm.bias_ih_l0",
    "lstm.bias_hh_l0",
    "readout.weight",
    "readout.bias",
)


def weights_in_order(weights: Mapping[str, Reals]) -> list[Reals]:
    """Return the weights in one order, those of gates with the gate as first axis."""
    gated = [weights[name].reshape(4, -1, *weights[name].shape[1:]) for name in _NAMES[:4]]
    return [*gated, weights[_NAMES[4]], weights[_NAMES[5]]]


class _Work:
    """What a training writes to, made once: gradients of each piece, and the traces of each thread's."""

    def __init__(self, packed: _Packed, x: Reals, target: Rows, batch: int) -> None:
        self.packed = packed
        self.x = np.ascontiguousarray(x, dtype=packed.real)
        self.target = np.ascontiguousarray(target, dtype=np.int64)
        self.pieces = max(1, -(-batch // _PIECE))
        self.each = np.zeros((self.pieces, packed.flat.size), packed.real)
        self.losses = np.zeros(self.pieces)
        self.total = np.zeros_like(packed.flat)
        self.matrix = np.empty_like(packed.matrix)
        self.back = np.empty((4 * packed.padded, packed.padded), packed.real)
        self.traces: dict[int, tuple[Reals, ...]] = {}

    def gradients(self, rows: Rows, threads: int, pool: ThreadPoolExecutor | None) -> float:
        """Set ``total`` to the gradient of the mean loss of a batch; return the sum of its losses."""
        p = self.packed
        _effective(p.matrix, p.bias, p.padded + p.sensors, self.matrix, self.back)
        pieces = -(-rows.size // _PIECE)
        jobs = min(threads, pieces)
        if pool is None or jobs == 1:
            self._some(rows, 0, 1, pieces)
        else:
            list(pool.map(lambda k: self._some(rows, k, jobs, pieces), range(jobs)))
        width = 4 * p.padded
        _added(self.each[:pieces], self.total, (p.padded + p.sensors) * width, p.depth * width, width)
        return float(self.losses[:pieces].sum())

    def _some(self, rows: Rows, first: int, step: int, pieces: int) -> None:
        if first not in self.traces:
            self.traces[first] = self._trace()
        p = self.packed
        share = p.real(1.0 / rows.size)
        for piece in range(first, pieces, step):
            mine = rows[piece * _PIECE : (piece + 1) * _PIECE]
            weights = (self.matrix, self.back, p.readout, p.offset)
            self.losses[piece] = _piece(
                self.x, self.target, mine, weights, self.traces[first], self.each[piece], share
            )

    def _trace(self) -> tuple[Reals, ...]:
        """Return inputs with states, gates, cells, their tanh, and slopes by state and by cell."""
        p, n_time = self.packed, self.x.shape[1]
        inputs = np.zeros((n_time + 1, _PIECE, p.depth), p.real)
        inputs[:, :, p.padded + p.sensors] = 1.0
        gates = np.zeros((n_time, _PIECE, 4 * p.padded), p.real)
        cells, tanhs = (np.zeros((n, _PIECE, p.padded), p.real) for n in (n_time + 1, n_time))
        slopes = (np.zeros((_PIECE, p.padded), p.real) for _ in range(2))
        return (inputs, gates, cells, tanhs, *slopes)


def _compiled(function: Callable[..., Any]) -> Any:
    may = {"contract", "nsz", "arcp"}  # sums keep their order, what is not a number stays so
    return numba.njit(cache=True, nogil=True, fastmath=may, error_model="numpy")(function)


@_compiled
def _effective(matrix: Reals, bias: Reals, bias_row: int, full: Reals, back: Reals) -> None:
    """Set ``full`` to W with both biases, and ``back`` to U."""
    for k in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            full[k, j] = matrix[k, j]
    for j in range(matrix.shape[1]):
        full[bias_row, j] += bias[j]
        for k in range(back.shape[1]):
            back[j, k] = matrix[k, j]


@_compiled
def _added(each: Reals, total: Reals, bias_row: int, bias: int, width: int) -> None:
    """Set ``total`` to the sum of the pieces' gradients; both biases have the same slope."""
    for j in range(total.size):
        total[j] = each[0, j]
    for piece in range(1, each.shape[0]):
        for j in range(total.size):
            total[j] += each[piece, j]
    for j in range(width):
        total[bias + j] = total[bias_row + j]


@_compiled
def _adam(p: Reals, g: Reals, m: Reals, v: Reals, rate: Any, root: Any, keep: tuple[Any, ...]) -> None:
    """Take one step of Adam; ``keep`` is 1 - beta_1, beta_2, 1 - beta_2 and epsilon."""
    new, old_square, new_square, epsilon = keep
    for j in range(p.size):
        m[j] += new * (g[j] - m[j])
        v[j] = old_square * v[j] + new_square * g[j] * g[j]
        p[j] -= rate * m[j] / (np.sqrt(v[j]) * root + epsilon)


@_compiled
def _set(C: Reals, c0: int, A: Reals, a0: int, lda: int, B: Reals, size: tuple[int, int, int]) -> None:
    """Set C = A B of ``size`` (rows, columns, depth); rows of A are ``lda`` apart."""
    rows, columns, depth = size
    for r in range(0, rows, ROWS):
        for j in range(0, columns, _WIDTH_BYTES // C.itemsize):
            set_product(C, c0 + r * columns + j, columns, A, a0 + r * lda, lda, 1, B, j, columns, depth)


@_compiled
def _add_transposed(C: Reals, A: Reals, a0: int, B: Reals, b0: int, size: tuple[int, int, int]) -> None:
    """Add A^T B of ``size`` (rows, columns, depth) to C."""
    rows, columns, depth = size
    for r in range(0, rows, ROWS):
        for j in range(0, columns, _WIDTH_BYTES // C.itemsize):
            add_product(C, r * columns + j, columns, A, a0 + r, 1, rows, B, b0 + j, columns, depth)


@_compiled
def _piece(
    x: Reals,
    target: Rows,
    rows: Rows,
    weights: tuple[Reals, ...],
    trace: tuple[Reals, ...],
    out: Reals,
    share: Any,
) -> Any:
    """Set ``out`` to the gradient of ``share`` times the sum of the losses of some series; return the sum."""
    matrix, back, readout, offset = weights
    inputs, gates, cells, tanhs, by_state, by_cell = trace
    n, depth = back.shape[1], matrix.shape[0]
    many = -(-rows.size // ROWS) * ROWS  # series, filled up with some that are not in the loss
    _fill(x, rows, n, inputs)
    _forward(matrix, inputs, gates, cells, tanhs, many)
    out[:] = 0
    by_state[:] = 0
    by_cell[:] = 0
    first = depth * 4 * n + 4 * n
    loss = _readout(inputs[-1], target, rows, readout, offset, share, out[first:], by_state)
    _backward(back, inputs, gates, cells, tanhs, by_state, by_cell, many, out)
    return loss


@_compiled
def _fill(x: Reals, rows: Rows, n: int, inputs: Reals) -> None:
    """Write the series beside the states."""
    for t in range(x.shape[1]):
        for r in range(rows.size):
            for s in range(x.shape[2]):
                inputs[t, r, n + s] = x[rows[r], t, s]


@_compiled
def _forward(matrix: Reals, inputs: Reals, gates: Reals, cells: Reals, tanhs: Reals, many: int) -> None:
    piece, depth, n = inputs.shape[1], inputs.shape[2], cells.shape[2]
    for t in range(gates.shape[0]):
        g, a, c = t * piece * 4 * n, t * piece * depth, t * piece * n
        _set(gates, g, inputs, a, depth, matrix, (many, 4 * n, depth))
        for r in range(many):
            c_r = c + r * n
            h = a + (piece + r) * depth  # of the next time
            open_gates(gates, g + r * 4 * n, cells, c_r, c_r + piece * n, tanhs, c_r, inputs, h, n)


@_compiled
def _readout(
    states: Reals,
    target: Rows,
    rows: Rows,
    readout: Reals,
    offset: Reals,
    share: Any,
    out: Reals,
    by_state: Reals,
) -> Any:
    """Add the slopes of the readout to ``out`` and by the last states; return the sum of cross entropies."""
    classes, n = readout.shape
    logits = np.empty(classes, readout.dtype)
    loss = 0.0
    for r in range(rows.size):
        for k in range(classes):
            logits[k] = offset[k]
            for j in range(n):
                logits[k] += readout[k, j] * states[r, j]
        top = logits.max()
        total = np.sum(np.exp(logits - top))
        y = target[rows[r]]
        loss += np.log(total) - (logits[y] - top)
        for k in range(classes):
            slope = (np.exp(logits[k] - top) / total - (1.0 if k == y else 0.0)) * share
            out[classes * n + k] += slope
            for j in range(n):
                out[k * n + j] += slope * states[r, j]
                by_state[r, j] += slope * readout[k, j]
    return loss


@_compiled
def _backward(
    back: Reals,
    inputs: Reals,
    gates: Reals,
    cells: Reals,
    tanhs: Reals,
    by_state: Reals,
    by_cell: Reals,
    many: int,
    out: Reals,
) -> None:
    piece, depth, n = inputs.shape[1], inputs.shape[2], cells.shape[2]
    for t in range(gates.shape[0] - 1, -1, -1):
        g, a, c = t * piece * 4 * n, t * piece * depth, t * piece * n
        for r in range(many):
            at, cell = r * n, c + r * n
            close_gates(gates, g + r * 4 * n, cells, cell, tanhs, cell, by_state, at, by_cell, at, n)
        _add_transposed(out, inputs, a, gates, g, (depth, 4 * n, many))
        if t > 0:
            _set(by_state, 0, gates, g, 4 * n, back, (many, n, 4 * n))
