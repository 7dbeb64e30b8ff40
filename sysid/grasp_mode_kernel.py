"""Compiled search for the mode of one grasp under one hypothesis: :mod:`thermogrip.sysid.grasp_laplace`, pair
by pair.

The march of :mod:`thermogrip.sysid.grasp_kernel` is linear in the flux, so a derivative by ln h or ln tau_b
is the same recursion, driven by

    dq = dh (1 - H) / (1 + h Z)^2 - h dH / (1 + h Z),

with H the history of the gap and Z what the new flux adds to it: one march gives the response and both
derivatives without another exponential.  Derivatives by ln e and ln C, which move the block's modes, are
differences.  What the gripper's modes do in a step is common to all pairs and comes in tables.

Each pair takes damped Gauss-Newton steps until the next one promises less than 0.005 nat; that last step is
taken on the quadratic model alone, and its promise counted as kept.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.grasp_kernel import coefficients

__all__ = ["binned_responses", "gripper_tables", "marginals", "modes"]

Array = NDArray[np.float64]

_FAST = {"reassoc", "contract", "arcp", "nsz"}
_N_EXACT, _N_GROUPED = 12, 24
_N_MODE = _N_EXACT + _N_GROUPED + 1
_FASTEST = 2e3  # 1/s, as in grasp_response
_NODE, _SHARE = (np.ascontiguousarray(v) for v in np.polynomial.legendre.leggauss(_N_GROUPED))
_DIFFERENCE = 1e-4
_LATEST_ONSET = 0.8
_LONGEST = 1.5
_PROMISE = 0.01  # of -2 ln posterior: smaller promises end the search
_H, _BUILD, _ONSET, _LEVEL, _T, _E, _C = range(7)
_VALUE, _RATE, _BY_H, _BY_BUILD, _BY_E, _BY_C = range(6)


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def gripper_tables(dts: Array, lam: Array, face: Array) -> Array:
    """Return decay and flux weights of the gripper's modes for each step length, (n_group, 3, n_mode)."""
    table = np.empty((dts.size, 3, lam.size))
    for g in range(dts.size):
        for j in range(lam.size):
            decay, a, b = coefficients(lam[j], dts[g])
            table[g, 0, j], table[g, 1, j], table[g, 2, j] = decay, a * face[j], b * face[j]
    return table


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _block(e: float, c: float, lam: Array, weight: Array) -> float:
    """Fill the modes of a slab as ``block_modes`` does; return its series resistance."""
    unit = (np.pi * e / c) ** 2
    start = _N_EXACT - 0.5
    top = max(np.sqrt(_FASTEST / unit), 3 * start)
    span = np.log(top / start)
    for j in range(_N_EXACT):
        lam[j] = j * j * unit
        weight[j] = 2.0 / c
    weight[0] = 1.0 / c
    weight[_N_EXACT - 1] *= 1 - 1 / 24
    for i in range(_N_GROUPED):
        j_here = start * np.exp(0.5 * span * (1 + _NODE[i]))
        lam[_N_EXACT + i] = j_here * j_here * unit
        weight[_N_EXACT + i] = span * _SHARE[i] * j_here / c
    lam[_N_MODE - 1] = _N_EXACT * _N_EXACT * unit
    weight[_N_MODE - 1] = 2 / (24 * c)
    resistance: float = 2 / (c * unit * top)
    return resistance


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _march(
    dts: Array, repeat: NDArray[np.int64], table: Array, sensor_w: Array, r: float, lag: float, lam: Array,
    weight: Array, contact: tuple[float, float, float, float, float], n_tangent: int, rise: Array,
    slope: Array, x: Array, coef: Array,
) -> None:  # fmt: skip
    """Fill rise and slope (n_node, 3) of the response and of its derivatives by ln h and ln tau_b.

    ``x`` (3, n_mode) and ``coef`` (3, n_mode) are room to work in; ``r`` is the resistance of both faces.
    """
    h, first, build, creep, settle = contact
    n_d = sensor_w.size
    n = n_d + _N_MODE
    x[:] = 0.0
    q0 = h * first / (1.0 + h * first * r)
    q1, q2 = (q0 / (1.0 + h * first * r), 0.0) if n_tangent else (0.0, 0.0)
    rise[0], slope[0] = 0.0, 0.0
    node0 = node1 = node2 = s0 = s1 = s2 = t = 0.0
    k = 0
    for g in range(dts.size):
        dt = dts[g]
        z = 0.0
        for j in range(n_d):
            coef[0, j], coef[1, j], coef[2, j] = table[g, 0, j], table[g, 1, j], table[g, 2, j]
            z += coef[2, j]
        for j in range(_N_MODE):
            decay, a, b = coefficients(lam[j], dt)
            coef[0, n_d + j], coef[1, n_d + j], coef[2, n_d + j] = decay, a * weight[j], b * weight[j]
            z += b * weight[j]
        keep, a_lag, b_lag = coefficients(1.0 / lag, dt)
        a_lag, b_lag = a_lag / lag, b_lag / lag
        for _ in range(repeat[g]):
            t += dt
            k += 1
            late = np.exp(-t / build)
            grown = 1.0 + creep * (1.0 - np.exp(-t / settle))
            h_now = h * (first + (1.0 - first) * (1.0 - late)) * grown
            short = 1.0 / (1.0 + h_now * (z + r))
            if n_tangent:
                w0 = w1 = w2 = 0.0
                for j in range(n):
                    x[0, j] = coef[0, j] * x[0, j] + coef[1, j] * q0
                    x[1, j] = coef[0, j] * x[1, j] + coef[1, j] * q1
                    x[2, j] = coef[0, j] * x[2, j] + coef[1, j] * q2
                    w0 += x[0, j]
                    w1 += x[1, j]
                    w2 += x[2, j]
                by_build = -h * (1.0 - first) * grown * late * t / build
                gap = (1.0 - w0) * short
                q0 = h_now * gap
                q1 = h_now * gap * short - h_now * w1 * short
                q2 = by_build * gap * short - h_now * w2 * short
                n0 = n1 = n2 = 0.0
                for j in range(n_d):
                    x[0, j] += coef[2, j] * q0
                    x[1, j] += coef[2, j] * q1
                    x[2, j] += coef[2, j] * q2
                    n0 += sensor_w[j] * x[0, j]
                    n1 += sensor_w[j] * x[1, j]
                    n2 += sensor_w[j] * x[2, j]
                for j in range(n_d, n):
                    x[0, j] += coef[2, j] * q0
                    x[1, j] += coef[2, j] * q1
                    x[2, j] += coef[2, j] * q2
                s1 = keep * s1 + a_lag * node1 + b_lag * n1
                s2 = keep * s2 + a_lag * node2 + b_lag * n2
                node1, node2 = n1, n2
                rise[k, 1], rise[k, 2] = s1, s2
                slope[k, 1], slope[k, 2] = (n1 - s1) / lag, (n2 - s2) / lag
            else:
                w0 = 0.0
                for j in range(n):
                    x[0, j] = coef[0, j] * x[0, j] + coef[1, j] * q0
                    w0 += x[0, j]
                q0 = h_now * (1.0 - w0) * short
                n0 = 0.0
                for j in range(n_d):
                    x[0, j] += coef[2, j] * q0
                    n0 += sensor_w[j] * x[0, j]
                for j in range(n_d, n):
                    x[0, j] += coef[2, j] * q0
            s0 = keep * s0 + a_lag * node0 + b_lag * n0
            node0 = n0
            rise[k, 0] = s0
            slope[k, 0] = (n0 - s0) / lag


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _bin(
    nodes: Array, rise: Array, slope: Array, width: int, onset: float, times: Array,
    bins: NDArray[np.int64], count: Array, value: Array, rate: Array,
) -> None:  # fmt: skip
    """Fill bin means (n_bin, 3) of the first ``width`` curves at t - onset, and of the first one's slope."""
    value[:, :width] = 0.0
    rate[:] = 0.0
    last = nodes.size - 1
    k = 0
    for i in range(times.size):
        m = bins[i]
        if m < 0:
            continue
        t = times[i] - onset
        if t <= 0.0:
            continue
        while k < last - 1 and nodes[k + 1] < t:
            k += 1
        while k > 0 and nodes[k] > t:
            k -= 1
        dt = nodes[k + 1] - nodes[k]
        s = min((t - nodes[k]) / dt, 1.0)
        # the weights of cubic Hermite interpolation
        v1 = s * s * (3.0 - 2.0 * s)
        d0, d1 = s * (1.0 - s) * (1.0 - s) * dt, s * s * (s - 1.0) * dt
        for c in range(width):
            value[m, c] += (1.0 - v1) * rise[k, c] + v1 * rise[k + 1, c]
            value[m, c] += d0 * slope[k, c] + d1 * slope[k + 1, c]
        u1 = 6.0 * s * (1.0 - s) / dt
        e0, e1 = (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)
        rate[m] += u1 * (rise[k + 1, 0] - rise[k, 0]) + e0 * slope[k, 0] + e1 * slope[k + 1, 0]
    for m in range(count.size):
        if count[m] > 0.0:
            for c in range(width):
                value[m, c] /= count[m]
            rate[m] /= count[m]


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _responses(
    dts: Array, repeat: NDArray[np.int64], nodes: Array, table: Array, gripper: tuple[Array, float, float],
    contact: tuple[float, float, float], u: Array, vary: NDArray[np.bool_], times: Array,
    bins: NDArray[np.int64], count: Array, rise: Array, slope: Array, x: Array, coef: Array, lam: Array,
    weight: Array, value: Array, rate: Array, out: Array,
) -> None:  # fmt: skip
    """Fill bin means of F, of its slope and of its derivatives by ln h, ln tau_b, ln e, ln C, (n_bin, 6)."""
    sensor_w, r_d, lag = gripper
    first, creep, settle = contact
    n_bin = out.shape[0]
    onset = min(max(u[_ONSET], -_LATEST_ONSET), _LATEST_ONSET)
    touch = (np.exp(u[_H]), first, np.exp(u[_BUILD]), creep, settle)
    tangent = 1 if vary[_H] or vary[_BUILD] else 0
    width = 3 if tangent else 1
    r = r_d + _block(np.exp(u[_E]), np.exp(u[_C]), lam, weight)
    _march(dts, repeat, table, sensor_w, r, lag, lam, weight, touch, tangent, rise, slope, x, coef)
    _bin(nodes, rise, slope, width, onset, times, bins, count, value, rate)
    for m in range(n_bin):
        out[m, _VALUE], out[m, _RATE] = value[m, 0], rate[m]
        out[m, _BY_H] = value[m, 1] if tangent else 0.0
        out[m, _BY_BUILD] = value[m, 2] if tangent else 0.0
        out[m, _BY_E] = out[m, _BY_C] = 0.0
    for column, at in ((_BY_E, _E), (_BY_C, _C)):
        if not vary[at]:
            continue
        e = np.exp(u[_E] + (_DIFFERENCE if at == _E else 0.0))
        c = np.exp(u[_C] + (_DIFFERENCE if at == _C else 0.0))
        r = r_d + _block(e, c, lam, weight)
        _march(dts, repeat, table, sensor_w, r, lag, lam, weight, touch, 0, rise, slope, x, coef)
        _bin(nodes, rise, slope, 1, onset, times, bins, count, value, rate)
        for m in range(n_bin):
            out[m, column] = (value[m, 0] - out[m, _VALUE]) / _DIFFERENCE


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def binned_responses(
    dts: Array, repeat: NDArray[np.int64], nodes: Array, table: Array, gripper: tuple[Array, float, float],
    contact: tuple[float, float, float], u: Array, vary: NDArray[np.bool_], times: Array,
    bins: NDArray[np.int64], count: Array,
) -> Array:  # fmt: skip
    """Return bin means of the response and its derivatives for n pairs, (n, n_bin, 6).

    The last axis is F, its slope in time, and its derivatives by ln h, ln tau_b, ln e and ln C, the last four
    zero where ``vary`` (n, 7) does not ask for them.  ``gripper`` is (weights at the sensor, face resistance,
    lag), ``contact`` (first, creep, settle); ``u`` (n, 7) the nuisances; ``times``, ``bins`` (n, n_sample)
    and ``count`` (n, n_bin) the samples.
    """
    n, n_bin = u.shape[0], count.shape[1]
    out = np.empty((n, n_bin, 6))
    width = gripper[0].size + _N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(_N_MODE), np.empty(_N_MODE)
    value, rate = np.zeros((n_bin, 3)), np.zeros(n_bin)
    for p in range(n):
        _responses(
            dts, repeat, nodes, table, gripper, contact, u[p], vary[p], times[p], bins[p], count[p], rise,
            slope, x, coef, lam, weight, value, rate, out[p],
        )  # fmt: skip
    return out


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
    width = gripper[0].size + _N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(_N_MODE), np.empty(_N_MODE)
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
        _responses(
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
            _responses(
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
    width = gripper[0].size + _N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(_N_MODE), np.empty(_N_MODE)
    value, rate, out = np.zeros((n_bin, 3)), np.zeros(n_bin), np.empty((n_bin, 6))
    columns, vary, result = np.empty((n_bin, 3)), np.zeros(7, dtype=np.bool_), np.empty(n)
    known = np.isfinite(room)
    for p in range(n):
        _responses(
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
