r"""Training of a one-layer LSTM with a linear readout, compiled: the same steps as PyTorch's, sooner.

One row of a batch at one time is :math:`a_t = [h_{t-1}, x_t, 1]` and the sums of its gates are :math:`z_t =
a_t W`, with :math:`W` the stacked transposes of U, the input weights and the sum of both biases.  Backwards,
with :math:`\delta_t = \partial L / \partial z_t`,

.. math:: \frac{\partial L}{\partial W} = \sum_t a_t^T \delta_t, \qquad
          \frac{\partial L}{\partial h_{t-1}} = \delta_t U,

so a step is three small matrix products, which BLAS does, and elementwise loops, which numba turns into
vector instructions.  For these the logistic function is :math:`\sigma(x) = (1 + \tanh(x / 2)) / 2`, and

.. math:: \tanh x \approx x\, p(x^2) / q(x^2), \qquad |x| \le 8,

with p and q of degree 5, fitted to the least largest error (7e-12; single precision rounds to 4e-7).

A batch is cut into pieces of 50 series.  Each piece has gradients of its own, which are added in order, so
that a seed gives the same numbers on any number of threads.  Adam is that of Kingma and Ba, as PyTorch
writes it:

.. math:: m \leftarrow m + (1 - \beta_1)(g - m), \quad v \leftarrow \beta_2 v + (1 - \beta_2) g^2, \quad
          p \leftarrow p - \frac{\eta}{1 - \beta_1^k} \frac{m}{\sqrt{v / (1 - \beta_2^k)} + \epsilon}.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.compiled import numba

Reals: TypeAlias = NDArray[Any]
Rows: TypeAlias = NDArray[np.int64]

_PIECE = 50  # series; the arrays of a piece stay in the cache
_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8
_CURVE = (
    0.999999999961891, 0.141326880310313, 0.00447073633347869,
    4.34432993018181e-05, 1.18083527909079e-07, 4.12633229733103e-11,
    1.0, 0.474660213444082, 0.0293574744510156,
    0.000509493393128057, 2.71382146857782e-06, 3.21269610168264e-09,
)  # fmt: skip
"""The coefficients of p, then those of q."""


def train_network(
    weights: Mapping[str, Reals],
    x: Reals,
    target: Rows,
    epochs: Sequence[Sequence[Rows]],
    *,
    learning_rate: float,
    threads: int = 1,
) -> tuple[dict[str, Reals], NDArray[np.float64]]:
    """Return the trained weights, named, shaped and as precise as PyTorch's ``weights``, and the mean cross
    entropy of each epoch, from series ``x`` (n_series, n_time, S), their classes and the rows of each
    batch."""
    sizes = np.cumsum([value.size for value in weights.values()])
    flat = np.concatenate([value.ravel() for value in weights.values()])
    real = flat.dtype.type

    def named(vector: Reals) -> dict[str, Reals]:
        parts = np.split(vector, sizes[:-1])
        return {key: part.reshape(weights[key].shape) for key, part in zip(weights, parts)}

    p, total = named(flat), np.zeros_like(flat)
    slopes, mean, square = named(total), np.zeros_like(flat), np.zeros_like(flat)
    recurrent, readout = p["lstm.weight_hh_l0"], p["readout.weight"]
    hidden, sensors, batch = recurrent.shape[1], x.shape[2], max((rows.size for rows in epochs[0]), default=0)
    curve = tuple(map(real, _CURVE))
    halved = np.repeat(np.array([0.5, 0.5, 1.0, 0.5], real), hidden)  # i, f, g, o
    series = np.ascontiguousarray(x.transpose(1, 0, 2), dtype=real)
    work = [_work(len(series), min(_PIECE, batch), hidden, sensors, real) for _ in range(0, batch, _PIECE)]
    losses = np.zeros(len(epochs))
    step = 0
    with ThreadPoolExecutor(threads) if threads > 1 else nullcontext() as pool:
        for k, batches in enumerate(epochs):
            for rows in batches:
                step += 1
                bias = p["lstm.bias_ih_l0"] + p["lstm.bias_hh_l0"]
                matrix = np.vstack([recurrent.T, p["lstm.weight_ih_l0"].T, bias]) * halved

                def piece(first: int, rows: Rows = rows, matrix: Reals = matrix) -> tuple[Any, ...]:
                    mine, share = rows[first : first + _PIECE], real(1 / rows.size)
                    given = (matrix, recurrent, readout, p["readout.bias"], curve)
                    return _piece(series, target, mine, given, work[first // _PIECE], share)  # type: ignore[no-any-return]

                found = list((pool.map if pool else map)(piece, range(0, rows.size, _PIECE)))
                own, heads, offsets = (sum(part) for part in list(zip(*found))[1:])
                slopes["lstm.weight_hh_l0"][...] = own[:hidden].T
                slopes["lstm.weight_ih_l0"][...] = own[hidden:-1].T
                slopes["lstm.bias_ih_l0"][...] = slopes["lstm.bias_hh_l0"][...] = own[-1]
                slopes["readout.weight"][...], slopes["readout.bias"][...] = heads, offsets
                losses[k] += sum(loss for loss, *_ in found)
                mean += real(1 - _BETA_1) * (total - mean)
                square += real(1 - _BETA_2) * (total * total - square)
                rate, root = learning_rate / (1 - _BETA_1**step), np.sqrt(1 - _BETA_2**step)
                flat -= real(rate) * mean / (np.sqrt(square) / real(root) + real(_EPSILON))
            losses[k] /= sum(rows.size for rows in batches)
    return named(flat), losses


def _work(n_time: int, piece: int, hidden: int, sensors: int, real: Any) -> tuple[Reals, ...]:
    """Return what a piece writes to, made once: inputs, gates, cells, their tanh, slopes by state and
    cell."""
    inputs = np.zeros((n_time + 1, piece, hidden + sensors + 1), real)
    inputs[:, :, -1] = 1.0
    shapes = [(n_time, piece, 4 * hidden), (n_time + 1, piece, hidden), (n_time, piece, hidden)]
    return (inputs, *(np.zeros(shape, real) for shape in [*shapes, (piece, hidden), (piece, hidden)]))


def _compiled(function: Callable[..., Any]) -> Any:
    may = {"contract", "nsz", "arcp"}  # sums keep their order, what is not a number stays so
    return numba.njit(cache=True, nogil=True, fastmath=may, error_model="numpy")(function)


@_compiled
def _piece(
    x: Reals, target: Rows, rows: Rows, given: tuple[Any, ...], work: tuple[Reals, ...], share: Any
) -> Any:
    """Return the sum of the losses of some series, and the slopes of ``share`` times it by W and readout, to
    which rows of the work beyond the piece's add nothing."""
    matrix, recurrent, readout, offset, curve = given
    inputs, gates, cells, tanhs, by_state, by_cell = work
    hidden = recurrent.shape[1]
    for t in range(x.shape[0]):
        for r in range(rows.size):
            for s in range(x.shape[2]):
                inputs[t, r, hidden + s] = x[t, rows[r], s]
    _forward(matrix, curve, inputs, gates, cells, tanhs)
    by_state.fill(0)
    by_cell.fill(0)
    heads, offsets = np.zeros_like(readout), np.zeros_like(offset)
    loss = _read_out(inputs[-1], target, rows, readout, offset, share, heads, offsets, by_state)
    return loss, _backward(recurrent, inputs, gates, cells, tanhs, by_state, by_cell), heads, offsets


@_compiled
def _to_tanh(a: Reals, curve: tuple[Any, ...]) -> None:
    """Replace numbers by their tanh."""
    edge = a.dtype.type(8)
    p0, p1, p2, p3, p4, p5, q0, q1, q2, q3, q4, q5 = curve
    for r in range(a.shape[0]):
        for j in range(a.shape[1]):
            x = a[r, j]
            x = edge if x > edge else x
            x = -edge if x < -edge else x
            y = x * x
            above = p0 + y * (p1 + y * (p2 + y * (p3 + y * (p4 + y * p5))))
            a[r, j] = x * above / (q0 + y * (q1 + y * (q2 + y * (q3 + y * (q4 + y * q5)))))


# The loops over j below are short on purpose: LLVM makes vectors of a loop of few arrays only.


@_compiled
def _forward(
    matrix: Reals, curve: tuple[Any, ...], inputs: Reals, gates: Reals, cells: Reals, tanhs: Reals
) -> None:
    half, n = gates.dtype.type(0.5), tanhs.shape[2]
    for t in range(gates.shape[0]):
        g, tanh, old, new, state = gates[t], tanhs[t], cells[t], cells[t + 1], inputs[t + 1]
        np.dot(inputs[t], matrix, g)
        _to_tanh(g, curve)
        for r in range(g.shape[0]):
            for j in range(2 * n):
                g[r, j] = half + half * g[r, j]
            for j in range(3 * n, 4 * n):
                g[r, j] = half + half * g[r, j]
            for j in range(n):
                new[r, j] = g[r, n + j] * old[r, j] + g[r, j] * g[r, 2 * n + j]
            for j in range(n):
                tanh[r, j] = new[r, j]
        _to_tanh(tanh, curve)
        for r in range(g.shape[0]):
            for j in range(n):
                state[r, j] = g[r, 3 * n + j] * tanh[r, j]


@_compiled
def _read_out(
    states: Reals, target: Rows, rows: Rows, readout: Reals, offset: Reals, share: Any,
    heads: Reals, offsets: Reals, by_state: Reals,
) -> Any:  # fmt: skip
    """Add slopes by the readout and by the last states; return the sum of cross entropies."""
    classes, n = readout.shape
    logits = np.empty_like(offset)
    loss = 0.0
    for r in range(rows.size):
        for k in range(classes):
            logits[k] = offset[k]
            for j in range(n):
                logits[k] += readout[k, j] * states[r, j]
        top, total = logits[0], offset.dtype.type(0)
        for k in range(1, classes):
            top = max(top, logits[k])
        for k in range(classes):
            total += np.exp(logits[k] - top)
        y = target[rows[r]]
        loss += np.log(total) - (logits[y] - top)
        for k in range(classes):
            slope = (np.exp(logits[k] - top) / total - (1.0 if k == y else 0.0)) * share
            offsets[k] += slope
            for j in range(n):
                heads[k, j] += slope * states[r, j]
                by_state[r, j] += slope * readout[k, j]
    return loss


@_compiled
def _backward(
    recurrent: Reals, inputs: Reals, gates: Reals, cells: Reals, tanhs: Reals, by_state: Reals, by_cell: Reals
) -> Reals:
    """Return the slopes by W; gates become the slopes by their sums."""
    one, n = gates.dtype.type(1), tanhs.shape[2]
    step = np.empty((inputs.shape[2], 4 * n), gates.dtype)
    total = np.zeros_like(step)
    for t in range(gates.shape[0] - 1, -1, -1):
        g, tanh, old = gates[t], tanhs[t], cells[t]
        for r in range(g.shape[0]):
            for j in range(n):
                by_cell[r, j] += by_state[r, j] * g[r, 3 * n + j] * (one - tanh[r, j] * tanh[r, j])
            for j in range(n):
                o = g[r, 3 * n + j]
                g[r, 3 * n + j] = by_state[r, j] * tanh[r, j] * o * (one - o)
            for j in range(n):
                i, q = g[r, j], g[r, 2 * n + j]
                g[r, j] = by_cell[r, j] * q * i * (one - i)
                g[r, 2 * n + j] = by_cell[r, j] * i * (one - q * q)
            for j in range(n):
                f, c = g[r, n + j], by_cell[r, j]
                g[r, n + j] = c * old[r, j] * f * (one - f)
                by_cell[r, j] = c * f
        np.dot(inputs[t].T, g, step)
        for r in range(step.shape[0]):
            for j in range(4 * n):
                total[r, j] += step[r, j]
        if t > 0:
            np.dot(g, recurrent, by_state)
    return total
