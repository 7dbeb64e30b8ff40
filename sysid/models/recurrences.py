"""Simulations of linear and of polynomial difference equations, compiled.

This file and :mod:`thermogrip.sysid.models.neural_kernel` alone of the models import numba, so nothing pays
for the compiler before a model is simulated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.compiled import numba


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
def run_polynomial(
    exponents: NDArray[np.int_], coefficients: Array, x0: Array, w: Array, times: int
) -> tuple[Array, Array]:
    """Return the outputs (B, N + 1, n_y) of y+ = coefficients m(x, w) with each row of w (1 or B, N, m)
    ``times`` times, m the monomials of x, the outputs from the newest on, and the last states (B, n_x)."""
    n_batch, n_x = x0.shape
    n_y, n_term = coefficients.shape
    rows = w.shape[1]
    y, last = np.empty((n_batch, rows + 1, n_y)), x0.copy()
    variables, after = np.empty(n_x + w.shape[2]), np.empty(n_y)
    for b in range(n_batch):
        y[b, 0] = x0[b, :n_y]
        variables[:n_x] = x0[b]
        for k in range(rows):
            variables[n_x:] = w[min(b, len(w) - 1), k]
            for _ in range(times):
                after[:] = 0.0
                for term in range(n_term):
                    product = 1.0
                    for i in range(len(variables)):
                        for _power in range(exponents[term, i]):
                            product *= variables[i]
                    for i in range(n_y):
                        if coefficients[i, term] != 0.0:  # 0 times what has overflowed is no number
                            after[i] += coefficients[i, term] * product
                for i in range(n_x - 1, n_y - 1, -1):
                    variables[i] = variables[i - n_y]
                variables[:n_y] = after
            y[b, k + 1] = variables[:n_y]
        last[b] = variables[:n_x]
    return y, last
