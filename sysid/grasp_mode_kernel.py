"""Compiled search for the mode of one grasp under one hypothesis: :mod:`thermogrip.sysid.grasp_laplace`, pair
by pair.

Each pair takes damped Gauss-Newton steps on the responses of :mod:`thermogrip.sysid.grasp_response_kernel`
until the next one promises less than 0.005 nat; that last step is taken on the quadratic model alone, and its
promise counted as kept.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.grasp_response_kernel import N_MODE, fill_responses

__all__ = ["marginals", "modes"]

Array = NDArray[np.float64]

_FAST = {"reassoc", "contract", "arcp", "nsz"}
_LONGEST = 1.5
_PROMISE = 0.01  # of -2 ln posterior: smaller promises end the search
_H, _BUILD, _ONSET, _LEVEL, _T, _E, _C = range(7)
_VALUE, _RATE, _BY_H, _BY_BUILD, _BY_E, _BY_C = range(6)


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _normal_equations(
    out: Array, y: Array, ramp: Array, u: Array, sd: Array, leak: float, room: float, whitener: Array,
    columns: Array, white: Array, matrix: Array, gradient: Array,
) -> float:  # fmt: skip
    """Fill J' J and J' r in units of the prior's sd; return |r|^2, r = W (y - f)."""
    n_bin = out.shape[0]
    known = np.isfinite(room)
    difference = u[_T] - u[_LEVEL]
    for m in range(n_bin):
        f = out[m, _VALUE]
        drift = leak * (room - u[_LEVEL]) * ramp[m] if known else 0.0
        columns[m, 7] = y[m] - u[_LEVEL] - difference * f - drift
        columns[m, _H] = difference * out[m, _BY_H] * sd[_H]
        columns[m, _BUILD] = difference * out[m, _BY_BUILD] * sd[_BUILD]
        columns[m, _ONSET] = -difference * out[m, _RATE] * sd[_ONSET]
        columns[m, _LEVEL] = (1.0 - f - (leak * ramp[m] if known else 0.0)) * sd[_LEVEL]
        columns[m, _T] = f * sd[_T]
        columns[m, _E] = difference * out[m, _BY_E] * sd[_E]
        columns[m, _C] = difference * out[m, _BY_C] * sd[_C]
    matrix[:] = 0.0
    gradient[:] = 0.0
    square = 0.0
    for i in range(n_bin):
        white[:] = 0.0
        for k in range(i + 1):
            w = whitener[i, k]
            for c in range(8):
                white[c] += w * columns[k, c]
        square += white[7] * white[7]
        for a in range(7):
            gradient[a] += white[a] * white[7]
            for b in range(a + 1):
                matrix[a, b] += white[a] * white[b]
    return square


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _penalty(u: Array, mean: Array, sd: Array, dof: Array, first: Array, second: Array) -> float:
    """Fill slope and curvature of the prior's -2 ln density, halved, in units of sd; return its value.

    Normal where ``dof`` is infinite, else Student's t.
    """
    total = 0.0
    for a in range(7):
        first[a], second[a] = 0.0, 1.0
        if sd[a] <= 0.0:
            continue
        w = (u[a] - mean[a]) / sd[a]
        if np.isinf(dof[a]):
            first[a] = w
            total += w * w
        else:
            nu = dof[a]
            first[a] = (nu + 1.0) * w / (nu + w * w)
            # positive: it bounds the curvature from above, and a step on it cannot overshoot
            second[a] = (nu + 1.0) / (nu + w * w)
            total += (nu + 1.0) * np.log1p(w * w / nu)
    return total


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _cholesky(matrix: Array, diagonal: Array, low: Array) -> float:
    """Fill the Cholesky factor of matrix + diagonal; return the log determinant."""
    total = 0.0
    for a in range(7):
        for b in range(a + 1):
            value = matrix[a, b]
            if a == b:
                value += diagonal[a]
            for c in range(b):
                value -= low[a, c] * low[b, c]
            if a == b:
                low[a, a] = np.sqrt(max(value, 1e-300))
                total += 2.0 * np.log(low[a, a])
            else:
                low[a, b] = value / low[b, b]
    return total


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _solve(low: Array, rhs: Array, step: Array) -> None:
    for a in range(7):
        value = rhs[a]
        for b in range(a):
            value -= low[a, b] * step[b]
        step[a] = value / low[a, a]
    for a in range(6, -1, -1):
        value = step[a]
        for b in range(a + 1, 7):
            value -= low[b, a] * step[b]
        step[a] = value / low[a, a]


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def modes(
    dts: Array, repeat: NDArray[np.int64], nodes: Array, table: Array, gripper: tuple[Array, float, float],
    contact: tuple[float, float, float], leak: float, row: NDArray[np.int64], times: Array,
    bins: NDArray[np.int64], count: Array, y: Array, ramp: Array, room: Array, whitener: Array, mean: Array,
    sd: Array, dof: Array, u: Array, max_steps: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Move ``u`` (n, 7) to the mode of each pair; return covariance (n, 7, 7), objective, misfit and state.

    Pair p is touch ``row[p]`` under the prior ``mean``, ``sd``, ``dof`` (n, 7).  The objective is
    -2 ln (likelihood x prior density relative to its peak) + ln det of its curvature in units of sd; the
    state is 1 where the search settled.
    """
    n, n_bin = u.shape[0], y.shape[1]
    width = gripper[0].size + N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(N_MODE), np.empty(N_MODE)
    value, rate = np.zeros((n_bin, 3)), np.zeros(n_bin)
    out, columns, white = np.empty((n_bin, 6)), np.empty((n_bin, 8)), np.empty(8)
    here, there = np.empty((7, 7)), np.empty((7, 7))
    grad, grad_new = np.empty(7), np.empty(7)
    first, second, first_new, second_new = np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    low, step, trial, rhs, diagonal = np.zeros((7, 7)), np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    covariance, objective = np.zeros((n, 7, 7)), np.empty(n)
    misfit, settled = np.empty(n), np.zeros(n)
    for p in range(n):
        i = row[p]
        scale = sd[p]
        vary = scale > 0.0
        fill_responses(
            dts, repeat, nodes, table, gripper, contact, u[p], vary, times[i], bins[i], count[i], rise,
            slope, x, coef, lam, weight, value, rate, out,
        )  # fmt: skip
        square = _normal_equations(
            out, y[i], ramp[i], u[p], scale, leak, room[i], whitener[i], columns, white, here, grad
        )
        cost = square + _penalty(u[p], mean[p], scale, dof[p], first, second)
        damping = 1e-3
        for _ in range(max_steps):
            promise = 0.0
            for a in range(7):
                rhs[a] = grad[a] - first[a]
                diagonal[a] = second[a]
            _cholesky(here, diagonal, low)
            _solve(low, rhs, step)
            for a in range(7):
                promise += step[a] * rhs[a]
            if promise < _PROMISE:
                for a in range(7):
                    u[p, a] += step[a] * scale[a]
                cost -= promise
                settled[p] = 1.0
                break
            for a in range(7):
                diagonal[a] += damping * (here[a, a] + second[a])
            _cholesky(here, diagonal, low)
            _solve(low, rhs, step)
            longest = 0.0
            for a in (_H, _BUILD, _E, _C):
                longest = max(longest, abs(step[a] * scale[a]))
            shorten = min(1.0, _LONGEST / max(longest, 1e-300))
            for a in range(7):
                trial[a] = u[p, a] + shorten * step[a] * scale[a]
            fill_responses(
                dts, repeat, nodes, table, gripper, contact, trial, vary, times[i], bins[i], count[i], rise,
                slope, x, coef, lam, weight, value, rate, out,
            )  # fmt: skip
            square_new = _normal_equations(
                out, y[i], ramp[i], trial, scale, leak, room[i], whitener[i], columns, white, there, grad_new
            )
            cost_new = square_new + _penalty(trial, mean[p], scale, dof[p], first_new, second_new)
            if cost_new < cost:
                cost, square = cost_new, square_new
                u[p] = trial
                here[:] = there
                grad[:] = grad_new
                first[:] = first_new
                second[:] = second_new
                damping = max(damping * 0.1, 1e-9)
            else:
                damping = damping * 10.0
                if damping > 1e9:
                    break
        for a in range(7):
            diagonal[a] = second[a]
            if vary[a] and not np.isinf(dof[p, a]):
                w2 = ((u[p, a] - mean[p, a]) / scale[a]) ** 2
                nu = dof[p, a]
                # the density's own curvature, kept from turning negative far out in the tail
                diagonal[a] = max((nu + 1) * (nu - w2) / (nu + w2) ** 2, 1e-3)
        objective[p] = cost + _cholesky(here, diagonal, low)
        misfit[p] = square
        for b in range(7):
            for a in range(7):
                rhs[a] = 1.0 if a == b else 0.0
            _solve(low, rhs, step)
            for a in range(7):
                if vary[a] and vary[b]:
                    covariance[p, a, b] = step[a] * scale[a] * scale[b]
    return covariance, objective, misfit, settled


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def marginals(
    dts: Array, repeat: NDArray[np.int64], nodes: Array, table: Array, gripper: tuple[Array, float, float],
    contact: tuple[float, float, float], leak: float, times: Array, bins: NDArray[np.int64], count: Array,
    y: Array, ramp: Array, room: float, whitener: Array, level_sd: float, t_sd: Array, u: Array,
) -> Array:  # fmt: skip
    """Return ln p(y | u) up to a constant for n points ``u`` (n, 7) of one grasp, level and T_obj integrated.

    Their prior means stand in ``u``, their sds in ``level_sd`` and ``t_sd`` (n,).
    """
    n, n_bin = u.shape[0], y.size
    width = gripper[0].size + N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(N_MODE), np.empty(N_MODE)
    value, rate, out = np.zeros((n_bin, 3)), np.zeros(n_bin), np.empty((n_bin, 6))
    columns, vary, result = np.empty((n_bin, 3)), np.zeros(7, dtype=np.bool_), np.empty(n)
    known = np.isfinite(room)
    for p in range(n):
        fill_responses(
            dts, repeat, nodes, table, gripper, contact, u[p], vary, times, bins, count, rise, slope, x,
            coef, lam, weight, value, rate, out,
        )  # fmt: skip
        level, t_obj = u[p, _LEVEL], u[p, _T]
        for m in range(n_bin):
            f = out[m, _VALUE]
            drift = leak * (room - level) * ramp[m] if known else 0.0
            columns[m, 0] = y[m] - level - (t_obj - level) * f - drift
            columns[m, 1] = (1.0 - f - (leak * ramp[m] if known else 0.0)) * level_sd
            columns[m, 2] = f * t_sd[p]
        rr = r1 = r2 = v11 = v12 = v22 = 0.0
        for i in range(n_bin):
            a = b = c = 0.0
            for k in range(i + 1):
                w = whitener[i, k]
                a += w * columns[k, 0]
                b += w * columns[k, 1]
                c += w * columns[k, 2]
            rr += a * a
            r1 += a * b
            r2 += a * c
            v11 += b * b
            v12 += b * c
            v22 += c * c
        v11 += 1.0
        v22 += 1.0
        det = v11 * v22 - v12 * v12
        gain = (v22 * r1 * r1 - 2.0 * v12 * r1 * r2 + v11 * r2 * r2) / det
        result[p] = -0.5 * (rr - gain) - 0.5 * np.log(det)
    return result
