"""Compiled search for the mode of one grasp under one hypothesis:
:mod:`thermogrip.sysid.effusivity.laplace_approximation`, pair by pair.

Each pair takes damped Gauss-Newton steps on the responses of :mod:`thermogrip.sysid.contact.time_stepping`
until the next one would gain less than 0.005 nat; that last step is taken on the quadratic model alone, and
its predicted decrease counted.  Two expansions are kept, at the point reached and at the trial, and change
places where the trial is better.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.compiled import numba
from thermogrip.sysid.contact.time_stepping import (
    BY_BUILD_UP,
    BY_C,
    BY_E,
    BY_H,
    INNER,
    N_CURVE,
    OUTER,
    RATE,
    VALUE,
    Gripper,
    Nodes,
    Room,
    delay,
    fill_delayed,
    fill_responses,
    gripper_of,
    room_for,
)

_LONGEST = 1.5
_LEAST_DECREASE = 0.01  # of -2 ln posterior: smaller predicted decreases end the search
_H, _BUILD_UP, _ONSET, _LEVEL, _T, _E, _C = range(7)


class _Scratch(NamedTuple):
    """What one search works in."""

    room: Room  # of the time stepping
    place: NDArray[np.int64]  # (n_sample,) of the samples, as ``share``
    share: Array
    curves: Array  # (6, n_bin) the responses
    far: Array  # (4, n_bin) of the far face: delayed integral and value of F, then those of a derivative
    reading: Array  # (n_bin,) that is predicted
    slopes: Array  # (7, n_bin) its derivatives by u
    left: Array  # (n_bin,) what was read beyond it
    columns: Array  # (8, n_bin) the slopes and, last, what is left, whitened


class _Expansion(NamedTuple):
    """The objective's expansion at a point."""

    u: Array  # (7,)
    matrix: Array  # (7, 7) J' J
    gradient: Array  # (7,) J' r
    slope: Array  # (7,) of the prior, as the next two
    curvature: Array  # its bound
    own: Array  # the curvature itself
    cost: Array  # (2,), the objective and |r|^2


class _Work(NamedTuple):
    """Room for a 7 x 7 system: Cholesky factor, right side, diagonal that is added, solution."""

    low: Array
    rhs: Array
    diagonal: Array
    step: Array


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _expansion() -> _Expansion:
    one = np.zeros((5, 7))
    return _Expansion(one[0], np.zeros((7, 7)), one[1], one[2], one[3], one[4], np.zeros(2))


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _work() -> _Work:
    return _Work(np.zeros((7, 7)), np.zeros(7), np.zeros(7), np.zeros(7))


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _scratch(n_mode: int, n_node: int, n_sample: int, n_bin: int) -> _Scratch:
    return _Scratch(
        room_for(n_mode, n_node), np.empty(n_sample, dtype=np.int64), np.empty(n_sample),
        np.zeros((N_CURVE, n_bin)), np.zeros((4, n_bin)), np.zeros(n_bin), np.zeros((7, n_bin)),
        np.zeros(n_bin), np.zeros((8, n_bin)),
    )  # fmt: skip


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _whiten(whitener: Array, row: Array, scale: float, out: Array) -> None:
    """Fill W row, scaled; W (n, n) is lower triangular."""
    for i in range(row.size):
        total = 0.0
        for k in range(i + 1):
            total += whitener[i, k] * row[k]
        out[i] = total * scale


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _dot(a: Array, b: Array) -> Any:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _predict(
    nodes: Nodes, gripper: Gripper, u: Array, vary: Mask, times: Array, bins: NDArray[np.int64],
    count: Array, t: Array, ramp: Array, room: float, beyond: Array, scratch: _Scratch,
) -> None:  # fmt: skip
    """Fill the bin means that ``u`` predicts, their derivatives by level and T_obj, and those of ``vary``;
    the gripper's discrepancy ``beyond`` (2, n_bin) is always [K], and per degree between object and skin."""
    curves, far, reading, slopes = scratch.curves, scratch.far, scratch.reading, scratch.slopes
    fill_responses(
        nodes, gripper, u, vary, times, bins, count, scratch.room, scratch.place, scratch.share, curves
    )
    known, late, difference = np.isfinite(room), delay(u[_E], u[_C]), u[_T] - u[_LEVEL]
    leak = gripper.numbers[6] if known else 0.0
    away = leak * (room - u[_LEVEL]) if known else 0.0
    # the block goes to the room by its far face at ``rate`` [1/s], ``way`` [K]
    rate = gripper.numbers[5] * np.exp(-u[_C]) if known else 0.0
    way = room - u[_T] if known else 0.0
    fill_delayed(t, count, late, curves[VALUE], far[0], far[1])
    for i in range(t.size):
        f, lost = curves[VALUE, i] + beyond[1, i], rate * far[0, i]
        reading[i] = u[_LEVEL] + difference * f + way * lost + away * ramp[i] + beyond[0, i]
        slopes[_T, i], slopes[_LEVEL, i] = f - lost, 1.0 - f - leak * ramp[i]
    for curve, at in ((BY_H, _H), (BY_BUILD_UP, _BUILD_UP), (RATE, _ONSET), (BY_E, _E), (BY_C, _C)):
        if not vary[at]:
            continue
        fill_delayed(t, count, late, curves[curve], far[2], far[3])
        sign = -1.0 if at == _ONSET else 1.0
        for i in range(t.size):
            extra = far[2, i]
            if at == _E:  # a denser or less conducting block passes the loss on later
                extra += 2.0 * late * far[1, i]
            elif at == _C:
                extra -= 2.0 * late * far[1, i] + far[0, i]
            slopes[at, i] = sign * (difference * curves[curve, i] + rate * way * extra)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _normal_equations(
    whitener: Array, y: Array, sd: Array, scratch: _Scratch, matrix: Array, gradient: Array
) -> Any:
    """Fill J' J and J' r in units of the prior's sd; return |r|^2, r = W (y - f)."""
    columns, left = scratch.columns, scratch.left
    for i in range(y.size):
        left[i] = y[i] - scratch.reading[i]
    _whiten(whitener, left, 1.0, columns[7])
    for a in range(7):
        gradient[a] = 0.0
        if sd[a] > 0.0:
            _whiten(whitener, scratch.slopes[a], sd[a], columns[a])
            gradient[a] = _dot(columns[a], columns[7])
        for b in range(a + 1):
            matrix[a, b] = _dot(columns[a], columns[b]) if sd[a] > 0.0 and sd[b] > 0.0 else 0.0
    return _dot(columns[7], columns[7])


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def penalty(u: Array, mean: Array, sd: Array, dof: Array, first: Array, bound: Array, own: Array) -> float:
    """Return the prior's -2 ln density relative to its peak; fill its halved slopes and curvatures by u / sd.

    Normal where ``dof`` is infinite, else Student's t.  ``bound`` is positive and bounds the curvature from
    above, so that a step on it cannot overshoot; ``own`` is kept from turning negative far out in the tail.
    """
    total = 0.0
    for a in range(7):
        first[a], bound[a], own[a] = 0.0, 1.0, 1.0
        if sd[a] <= 0.0:
            continue
        w = (u[a] - mean[a]) / sd[a]
        if np.isinf(dof[a]):
            first[a] = w
            total += w * w
        else:
            nu, w2 = dof[a], w * w
            first[a] = (nu + 1.0) * w / (nu + w2)
            bound[a] = (nu + 1.0) / (nu + w2)
            own[a] = max((nu + 1.0) * (nu - w2) / (nu + w2) ** 2, 1e-3)
            total += (nu + 1.0) * np.log1p(w2 / nu)
    return total


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _cholesky(matrix: Array, diagonal: Array, low: Array) -> Any:
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


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
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


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _propose(here: _Expansion, sd: Array, damping: float, work: _Work) -> Any:
    """Fill the step of the quadratic model, damped, in units of sd; return the predicted decrease."""
    for a in range(7):
        work.rhs[a] = here.gradient[a] - here.slope[a]
        work.diagonal[a] = here.curvature[a] + damping * (here.matrix[a, a] + here.curvature[a])
    _cholesky(here.matrix, work.diagonal, work.low)
    _solve(work.low, work.rhs, work.step)
    return _dot(work.step, work.rhs)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _shorten(step: Array, sd: Array) -> Any:
    """Return the part of a step that no logarithm moves too far in."""
    longest = 1e-300
    for a in (_H, _BUILD_UP, _E, _C):
        longest = max(longest, abs(step[a] * sd[a]))
    return min(1.0, _LONGEST / longest)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _conclude(here: _Expansion, law: Array, work: _Work, covariance: Array) -> Any:
    """Fill the covariance at the mode; return the log determinant of the curvature in units of sd."""
    sd = law[1]
    penalty(here.u, law[0], sd, law[2], work.rhs, work.step, work.diagonal)
    log_det = _cholesky(here.matrix, work.diagonal, work.low)
    for b in range(7):
        for a in range(7):
            work.rhs[a] = 1.0 if a == b else 0.0
        _solve(work.low, work.rhs, work.step)
        for a in range(7):
            covariance[a, b] = work.step[a] * sd[a] * sd[b]
    return log_det


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def modes(
    nodes: Nodes, gripper: Gripper, row: NDArray[np.int64], times: Array, bins: NDArray[np.int64],
    count: Array, t: Array, y: Array, ramp: Array, room: Array, beyond: Array, whitener: Array, law: Array,
    u: Array, max_steps: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Move ``u`` (n, 7) to the mode of each pair; return covariance (n, 7, 7), objective, misfit and state.

    Pair p is touch ``row[p]`` under the prior ``law`` (n, 3, 7): mean, sd, degrees of freedom.  The objective
    is -2 ln (likelihood x prior density relative to its peak) + ln det of its curvature in units of sd; the
    state is 1 where the search settled.
    """
    n = u.shape[0]
    scratch = _scratch(gripper.sensor.size, nodes[2].size, times.shape[1], y.shape[1])
    here, there, work = _expansion(), _expansion(), _work()
    covariance, objective = np.zeros((n, 7, 7)), np.empty(n)
    misfit, settled, trial = np.empty(n), np.zeros(n), np.empty(7)
    for p in range(n):
        i, sd, damping = row[p], law[p, 1], 1e-2
        vary = sd > 0.0
        for a in range(7):
            trial[a] = u[p, a]
        for step in range(max_steps + 1):  # one place for it all: each would be compiled by itself
            _predict(
                nodes, gripper, trial, vary, times[i], bins[i], count[i], t[i], ramp[i], room[i], beyond[p],
                scratch,
            )  # fmt: skip
            square = _normal_equations(whitener[i], y[i], sd, scratch, there.matrix, there.gradient)
            off = penalty(trial, law[p, 0], sd, law[p, 2], there.slope, there.curvature, there.own)
            there.cost[0], there.cost[1] = square + off, square
            for a in range(7):
                there.u[a] = trial[a]
            if step == 0 or there.cost[0] < here.cost[0]:
                here, there = there, here
                damping = max(damping * 0.1, 1e-9)
            else:
                damping *= 10.0
            if damping > 1e9 or step == max_steps:
                break
            decrease = _propose(here, sd, 0.0, work)
            if decrease < _LEAST_DECREASE:
                for a in range(7):
                    here.u[a] += work.step[a] * sd[a]
                here.cost[0] -= decrease
                settled[p] = 1.0
                break
            _propose(here, sd, damping, work)
            part = _shorten(work.step, sd)
            for a in range(7):
                trial[a] = here.u[a] + part * work.step[a] * sd[a]
        for a in range(7):
            u[p, a] = here.u[a]
        misfit[p] = here.cost[1]
        objective[p] = here.cost[0] + _conclude(here, law[p], work, covariance[p])
    return covariance, objective, misfit, settled


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _integral(r1: float, r2: float, m11: float, m12: float, m22: float) -> float:
    """Return the log of what integrating over two linear unknowns adds to the density at their means."""
    v11, v22 = 1.0 + m11, 1.0 + m22
    det = v11 * v22 - m12 * m12
    found = 0.5 * (v22 * r1 * r1 - 2.0 * m12 * r1 * r2 + v11 * r2 * r2) / det - 0.5 * np.log(det)
    return float(found)


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def marginals(
    nodes: Nodes, gripper: Gripper, times: Array, bins: NDArray[np.int64], count: Array, t: Array, y: Array,
    ramp: Array, room: float, beyond: Array, whitener: Array, level_sd: float, t_sd: float, slips: float,
    slip: float, u: Array,
) -> Array:  # fmt: skip
    """Return ln p(y | u) up to a constant for n points ``u`` (n, 7) of one grasp, integrated over level and
    T_obj (prior means in ``u``, sds ``level_sd`` and ``t_sd``, the latter ``slip`` times that with the
    probability ``slips``)."""
    scratch = _scratch(gripper.sensor.size, nodes[2].size, times.size, y.size)
    vary, sd, result = np.zeros(7, dtype=np.bool_), np.zeros(7), np.empty(u.shape[0])
    matrix, gradient = np.zeros((7, 7)), np.zeros(7)
    sd[_LEVEL], sd[_T] = level_sd, t_sd
    for p in range(u.shape[0]):
        _predict(nodes, gripper, u[p], vary, times, bins, count, t, ramp, room, beyond[p], scratch)
        square = _normal_equations(whitener, y, sd, scratch, matrix, gradient)
        r1, r2 = gradient[_LEVEL], gradient[_T]
        m11, m12, m22 = matrix[_LEVEL, _LEVEL], matrix[_T, _LEVEL], matrix[_T, _T]
        gain = np.log(1.0 - slips) + _integral(r1, r2, m11, m12, m22)
        if slips > 0.0:
            wide = np.log(slips) + _integral(r1, slip * r2, m11, slip * m12, slip**2 * m22)
            gain = np.logaddexp(gain, wide)
        result[p] = gain - 0.5 * square
    return result


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def readings(
    nodes: Nodes, gripper: Gripper, times: Array, bins: NDArray[np.int64], count: Array, t: Array,
    ramp: Array, room: Array, beyond: Array, u: Array, vary: Mask,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the bin means (n, n_bin) that ``u`` (n, 7) predicts of n touches, and their derivatives (n,
    n_bin, 7), zero where not ``vary`` (n, 7)."""
    n, n_bin = count.shape
    y, slopes = np.empty((n, n_bin)), np.empty((n, n_bin, 7))
    scratch = _scratch(gripper.sensor.size, nodes[2].size, times.shape[1], n_bin)
    for p in range(n):
        _predict(
            nodes, gripper, u[p], vary[p], times[p], bins[p], count[p], t[p], ramp[p], room[p], beyond[p],
            scratch,
        )  # fmt: skip
        for i in range(n_bin):
            y[p, i] = scratch.reading[i]
            for a in range(7):
                slopes[p, i, a] = scratch.slopes[a, i] if vary[p, a] else 0.0
    return y, slopes


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def gripper_readings(
    nodes: Nodes, lam: Array, face: Array, sensor: Array, numbers: Array, times: Array,
    bins: NDArray[np.int64], count: Array, t: Array, ramp: Array, room: float, beyond: Array, u: Array,
) -> Array:  # fmt: skip
    """Return the bin means (n, n_bin) that ``u`` (7,) predicts of one touch by n grippers with modes ``lam``,
    ``face``, ``sensor`` (n, n_mode) and contact ``numbers`` (n, 7)."""
    n, vary = lam.shape[0], np.zeros(7, dtype=np.bool_)
    out = np.empty((n, count.size))
    scratch = _scratch(lam.shape[1], nodes[2].size, times.size, count.size)
    for p in range(n):
        one = gripper_of(nodes[0], lam[p], face[p], sensor[p], numbers[p])
        _predict(nodes, one, u, vary, times, bins, count, t, ramp, room, beyond, scratch)
        for i in range(count.size):
            out[p, i] = scratch.reading[i]
    return out
