"""Kalman filter with lost channels and its smoother, compiled.

One segment of the model

    x+ = A_t x + b_t + v,    y = C x + e,    cov(v, e) = [[Q, S], [S', R]],    x_0 ~ N(x0, P0),

with ``A[at[t]]`` the matrix of row t.  At each row only the channels o that were read count,

    eps = y_o - C_o x,       Sigma = C_o P C_o' + R_oo,       G = (A P C_o' + S_o) Sigma^-1,
    x+ = A x + b + G eps,    P+ = A P A' + Q - G Sigma G',

and -ln p is J = 1/2 sum_t (n_o ln 2 pi + ln det Sigma + eps' Sigma^-1 eps).  What belongs to a lost
channel is zero: its row and column of W = Sigma^-1, its column of G, its entry of eps.  So no later line
has to know which channels were read.

**Smoother.**  With D = A - G C, r = C'f + D'r+ and N = C'W C + D'N+ D, the state given all readings has
mean x + P r and covariance P - P N P (Durbin and Koopman, Time Series Analysis by State Space Methods, 2nd
ed., 2012, section 4.4); P may be singular.

This file alone imports numba, so nothing pays for the compiler before a reading is lost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.compiled import numba

Index = NDArray[np.int64]

_LOG_2PI = float(np.log(2 * np.pi))


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _ab(a: Array, b: Array, out: Array) -> None:
    """Set ``out`` to a b."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _invert(m: Array, n: int) -> float:
    """Invert the first n rows and columns, symmetric and positive, in place; return ln det, inf if not so."""
    total = 0.0
    for k in range(n):
        pivot = m[k, k]
        if not pivot > 0.0:
            return np.inf
        total += np.log(pivot)
        m[k, k] = 1.0
        for j in range(n):
            m[k, j] /= pivot
        for i in range(n):
            if i != k:
                factor = m[i, k]
                m[i, k] = 0.0
                for j in range(n):
                    m[i, j] -= factor * m[k, j]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _read(C: Array, R: Array, y: Array, x: Array, CP: Array, W: Array, e: Array, small: Array) -> float:
    """Set W and e of one row, zero where a channel is lost; return the row's share of J."""
    n, count, read = C.shape[1], 0, np.empty(y.size, np.int64)
    for i in range(y.size):
        if np.isfinite(y[i]):
            read[count] = i
            count += 1
    for a in range(count):
        i = read[a]
        e[i] = y[i]
        for j in range(n):
            e[i] -= C[i, j] * x[j]
        for b in range(count):
            small[a, b] = R[i, read[b]]
            for j in range(n):
                small[a, b] += CP[i, j] * C[read[b], j]
    cost = _invert(small, count) + count * _LOG_2PI
    for a in range(count):
        for b in range(count):
            W[read[a], read[b]] = small[a, b]
            cost += e[read[a]] * small[a, b] * e[read[b]]
    return float(0.5 * cost)


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def run_filter(
    A: Array, at: Index, b: Array, C: Array, y: Array, Q: Array, S: Array, R: Array, x0: Array, P0: Array
) -> tuple[float, Array, Array, Array, Array, Array]:
    """Return J, predicted x (N + 1, n) and P (N + 1, n, n), G (N, n, p), W (N, p, p) and eps (N, p).

    A (k, n, n), at (N,), b (N, n), C (p, n), y (N, p) with NaN where lost; J is infinite where a covariance
    of readings is not positive.
    """
    rows, p = y.shape
    n = x0.shape[0]
    x, P = np.zeros((rows + 1, n)), np.zeros((rows + 1, n, n))
    G, W, e = np.zeros((rows, n, p)), np.zeros((rows, p, p)), np.zeros((rows, p))
    CP, small, M = np.empty((p, n)), np.empty((p, p)), np.empty((n, p))
    AP, APA = np.empty((n, n)), np.empty((n, n))
    cost = 0.0
    for i in range(n):
        x[0, i] = x0[i]
        for j in range(n):
            P[0, i, j] = P0[i, j]
    for t in range(rows):
        Ft = A[at[t]]
        _ab(C, P[t], CP)
        cost += _read(C, R, y[t], x[t], CP, W[t], e[t], small)
        _ab(Ft, CP.T, M)
        for i in range(n):
            for k in range(p):
                M[i, k] += S[i, k]
        _ab(M, W[t], G[t])
        _ab(Ft, P[t], AP)
        _ab(AP, Ft.T, APA)
        for i in range(n):
            x[t + 1, i] = b[t, i]
            for j in range(n):
                x[t + 1, i] += Ft[i, j] * x[t, j]
            for k in range(p):
                x[t + 1, i] += G[t, i, k] * e[t, k]
        for i in range(n):
            for j in range(i + 1):
                total = 0.5 * (APA[i, j] + APA[j, i]) + Q[i, j]
                for k in range(p):
                    total -= 0.5 * (G[t, i, k] * M[j, k] + G[t, j, k] * M[i, k])
                P[t + 1, i, j] = total
                P[t + 1, j, i] = total
    return cost, x, P, G, W, e


@numba.njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def run_smoother(
    A: Array, at: Index, C: Array, x: Array, P: Array, G: Array, W: Array, e: Array
) -> tuple[Array, Array]:
    """Return mean (N, n) and covariance (N, n, n) of the state of each row, given all readings."""
    rows, n, p = G.shape
    mean, covariance = np.empty((rows, n)), np.empty((rows, n, n))
    r, N = np.zeros(n), np.zeros((n, n))
    D, nn, pn, f = np.empty((n, n)), np.empty((n, n)), np.empty((p, n)), np.empty(p)
    for t in range(rows - 1, -1, -1):
        _ab(G[t], C, D)
        for i in range(n):
            for j in range(n):
                D[i, j] = A[at[t], i, j] - D[i, j]
        for i in range(p):
            f[i] = 0.0
            for j in range(p):
                f[i] += W[t, i, j] * e[t, j]
        after = np.zeros(n)
        for i in range(n):
            for j in range(p):
                after[i] += C[j, i] * f[j]
            for j in range(n):
                after[i] += D[j, i] * r[j]
        r = after
        _ab(N, D, nn)
        _ab(D.T, nn, N)
        _ab(W[t], C, pn)
        _ab(C.T, pn, nn)
        for i in range(n):
            mean[t, i] = x[t, i]
            for j in range(n):
                mean[t, i] += P[t, i, j] * r[j]
                N[i, j] += nn[i, j]
        _ab(N, P[t], nn)
        _ab(P[t], nn, D)
        for i in range(n):
            for j in range(n):
                covariance[t, i, j] = P[t, i, j] - 0.5 * (D[i, j] + D[j, i])
    return mean, covariance
