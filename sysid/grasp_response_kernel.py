"""Compiled responses of one contact and their derivatives, in the sensor's bins.

The march of :mod:`thermogrip.sysid.grasp_kernel` is linear in the flux, so a derivative by ln h or ln tau_b
is the same recursion, driven by

    dq = dh (1 - H) / (1 + h Z)^2 - h dH / (1 + h Z),

with H the history of the gap and Z what the new flux adds to it: one march gives the response and both
derivatives without another exponential.  Derivatives by ln e and ln C, which move the block's modes, are
differences.  What the gripper's modes do in a step is common to all pairs and comes in tables.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.grasp_kernel import coefficients

__all__ = ["N_MODE", "binned_responses", "fill_responses", "gripper_responses", "gripper_tables"]

Array = NDArray[np.float64]

_FAST = {"reassoc", "contract", "arcp", "nsz"}
_N_EXACT, _N_GROUPED = 12, 24
N_MODE = _N_EXACT + _N_GROUPED + 1
_FASTEST = 2e3  # 1/s, as in grasp_response
_NODE, _SHARE = (np.ascontiguousarray(v) for v in np.polynomial.legendre.leggauss(_N_GROUPED))
_DIFFERENCE = 1e-4
_LATEST_ONSET = 0.8
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
    lam[N_MODE - 1] = _N_EXACT * _N_EXACT * unit
    weight[N_MODE - 1] = 2 / (24 * c)
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
    n = n_d + N_MODE
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
        for j in range(N_MODE):
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
def fill_responses(
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
    width = gripper[0].size + N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(N_MODE), np.empty(N_MODE)
    value, rate = np.zeros((n_bin, 3)), np.zeros(n_bin)
    for p in range(n):
        fill_responses(
            dts, repeat, nodes, table, gripper, contact, u[p], vary[p], times[p], bins[p], count[p], rise,
            slope, x, coef, lam, weight, value, rate, out[p],
        )  # fmt: skip
    return out


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def gripper_responses(
    dts: Array, repeat: NDArray[np.int64], nodes: Array, lam_d: Array, face: Array, sensor: Array,
    numbers: Array, u: Array, times: Array, bins: NDArray[np.int64], count: Array,
) -> Array:  # fmt: skip
    """Return bin means of the response of n grippers to one contact, (n, n_bin).

    ``lam_d``, ``face``, ``sensor`` (n, n_mode) are their modes; ``numbers`` (n, 5) holds face resistance,
    lag, first, creep and settle of each; ``u`` (7,) the nuisances; ``times``, ``bins`` (n_sample,) and
    ``count`` (n_bin,) the samples.
    """
    n, n_bin = lam_d.shape[0], count.size
    out = np.empty((n, n_bin))
    width = lam_d.shape[1] + N_MODE
    rise, slope = np.zeros((nodes.size, 3)), np.zeros((nodes.size, 3))
    x, coef = np.zeros((3, width)), np.zeros((3, width))
    lam, weight = np.empty(N_MODE), np.empty(N_MODE)
    value, rate = np.zeros((n_bin, 3)), np.zeros(n_bin)
    onset = min(max(u[_ONSET], -_LATEST_ONSET), _LATEST_ONSET)
    r_block = _block(np.exp(u[_E]), np.exp(u[_C]), lam, weight)
    for p in range(n):
        resistance, lag, first, creep, settle = numbers[p]
        table = gripper_tables(dts, lam_d[p], face[p])
        touch = (np.exp(u[_H]), first, np.exp(u[_BUILD]), creep, settle)
        _march(
            dts, repeat, table, sensor[p], resistance + r_block, lag, lam, weight, touch, 0, rise, slope, x,
            coef,
        )  # fmt: skip
        _bin(nodes, rise, slope, 1, onset, times, bins, count, value, rate)
        out[p] = value[:, 0]
    return out
