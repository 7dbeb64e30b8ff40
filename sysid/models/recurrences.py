"""Simulations of linear and small neural difference equations, compiled.

**Neural.** With the state x (n), the drives w (m) and h units,

    t = tanh(W x + U w + b),        x+ = A x + B w + c + V t,

where the first n_y states are the outputs and are clipped to [low, high] after each step.  The weights are
one vector theta = [B, c, V, W, U, b], each array row by row.

This file alone of the models imports numba, so nothing pays for the compiler before a model is simulated.
"""

from __future__ import annotations

import numba
import numpy as np

from thermogrip.datasets.arrays import Array


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def run_linear(A: Array, on: Array, push: Array, x0: Array, times: int) -> Array:
    """Return the states (B, N + 1, n_x) of x+ = (A[0] + sum_s on_s A[s + 1]) x + push, each row ``times``
    times; ``on`` (1 or B, N, n_s) and ``push`` (1 or B, N, n_x) as one for all where they have one."""
    n_batch, n_x = x0.shape
    rows = push.shape[1]
    x = np.empty((n_batch, rows + 1, n_x))
    after = np.empty(n_x)
    for b in range(n_batch):
        x[b, 0] = x0[b]
        of_on, of_push = min(b, len(on) - 1), min(b, len(push) - 1)
        for k in range(rows):
            x[b, k + 1] = x[b, k]
            for _ in range(times):
                for i in range(n_x):
                    total = push[of_push, k, i]
                    for j in range(n_x):
                        total += A[0, i, j] * x[b, k + 1, j]
                    for s in range(on.shape[2]):
                        if on[of_on, k, s] != 0.0:
                            for j in range(n_x):
                                total += on[of_on, k, s] * A[s + 1, i, j] * x[b, k + 1, j]
                    after[i] = total
                x[b, k + 1] = after
    return x


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _begins(n: int, m: int, h: int) -> tuple[int, int, int, int, int]:
    """Return where c, V, W, U and b begin in theta."""
    c = n * m
    V = c + n
    W = V + n * h
    U = W + h * n
    return c, V, W, U, U + h * m


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _units(p: Array, x: Array, w: Array, t: Array) -> None:
    """Set t to the outputs of the units."""
    n = x.shape[0]
    m = w.shape[0]
    h = t.shape[0]
    _, _, iW, iU, ib = _begins(n, m, h)
    for i in range(h):
        total = p[ib + i]
        for j in range(n):
            total += p[iW + i * n + j] * x[j]
        for j in range(m):
            total += p[iU + i * m + j] * w[j]
        t[i] = np.tanh(total)


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _advance(A: Array, p: Array, x: Array, w: Array, t: Array, after: Array) -> None:
    """Set ``after`` to the next state, not yet clipped."""
    n = x.shape[0]
    m = w.shape[0]
    h = t.shape[0]
    ic, iV, _, _, _ = _begins(n, m, h)
    for i in range(n):
        total = p[ic + i]
        for j in range(n):
            total += A[i, j] * x[j]
        for j in range(m):
            total += p[i * m + j] * w[j]
        for j in range(h):
            total += p[iV + i * h + j] * t[j]
        after[i] = total


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _propagate(A: Array, p: Array, m: int, s: Array, S: Array, after: Array) -> None:
    """Set ``after`` to (A + V diag(s) W) S, of m drives."""
    n, h = A.shape[0], s.shape[0]
    _, iV, iW, _, _ = _begins(n, m, h)
    after.fill(0.0)
    for i in range(n):
        for j in range(n):
            gain = A[i, j]
            for q in range(h):
                gain += p[iV + i * h + q] * s[q] * p[iW + q * n + j]
            for q in range(S.shape[1]):
                after[i, q] += gain * S[j, q]


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_direct(p: Array, x: Array, w: Array, t: Array, s: Array, S: Array) -> None:
    """Add E: what each weight does to the state in this step itself."""
    n = x.shape[0]
    m = w.shape[0]
    h = t.shape[0]
    ic, iV, iW, iU, ib = _begins(n, m, h)
    for i in range(n):
        S[i, ic + i] += 1.0
        for j in range(m):
            S[i, i * m + j] += w[j]
        for q in range(h):
            S[i, iV + i * h + q] += t[q]
            gain = p[iV + i * h + q] * s[q]
            S[i, ib + q] += gain
            for j in range(n):
                S[i, iW + q * n + j] += gain * x[j]
            for j in range(m):
                S[i, iU + q * m + j] += gain * w[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def run_states(A: Array, theta: Array, h: int, x0: Array, w: Array, low: Array, high: Array) -> Array:
    """Return states (k, N + 1, n) for A (k, n, n), theta (k, n_theta), x0 (k, n) and one w (N, m)."""
    x, t = np.empty((theta.shape[0], w.shape[0] + 1, x0.shape[1])), np.empty(h)
    for k in range(theta.shape[0]):
        x[k, 0] = x0[k]
        for row in range(w.shape[0]):
            after = x[k, row + 1]
            _units(theta[k], x[k, row], w[row], t)
            _advance(A[k], theta[k], x[k, row], w[row], t, after)
            for i in range(low.shape[0]):
                after[i] = min(max(after[i], low[i]), high[i])
    return x


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def run_with_slopes(
    A: Array, p: Array, h: int, x0: Array, w: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Return the outputs (N, n_y) and their slopes (N, n_y, n_theta + n) by theta and x0, one member."""
    n = x0.shape[0]
    rows = w.shape[0]
    n_y = low.shape[0]
    n_p = p.shape[0]
    y, slopes = np.empty((rows, n_y)), np.empty((rows, n_y, n_p + n))
    x = x0.copy()
    after = np.empty(n)
    t = np.empty(h)
    s = np.empty(h)
    S, S_after = np.zeros((n, n_p + n)), np.empty((n, n_p + n))
    S[:, n_p:] = np.eye(n)
    for row in range(rows):
        y[row] = x[:n_y]
        slopes[row] = S[:n_y]
        _units(p, x, w[row], t)
        # the sensitivity S = dx/dtheta beside the state: S+ = (A + V diag(s) W) S + E with s = 1 - t^2, E
        # sparse
        for i in range(h):
            s[i] = 1.0 - t[i] * t[i]
        _advance(A, p, x, w[row], t, after)
        _propagate(A, p, w.shape[1], s, S, S_after)
        _add_direct(p, x, w[row], t, s, S_after)
        for i in range(n_y):
            if not low[i] < after[i] < high[i]:  # a clipped state has no slope
                after[i] = min(max(after[i], low[i]), high[i])
                S_after[i].fill(0.0)
        x[:] = after
        for i in range(n):
            for q in range(n_p + n):
                # what has faded away would become numbers too small for fast arithmetic
                S[i, q] = S_after[i, q] if abs(S_after[i, q]) > 1e-60 else 0.0
    return y, slopes
