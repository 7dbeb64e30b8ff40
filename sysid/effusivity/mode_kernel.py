"""Search for the mode of a grasp under a hypothesis:
:mod:`thermogrip.sysid.effusivity.laplace_approximation`, many pairs at once.

Each pair takes damped Gauss-Newton steps on the responses of :mod:`thermogrip.sysid.contact.time_stepping`
until the next one would gain less than 0.005 nat; that last step is taken on the quadratic model alone, and
its predicted decrease counted.  What costs is compiled, in two functions that call no other; the rest is
NumPy's, for some hundred pairs at once, whose arrays stay in the processor's cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.compiled import numba
from thermogrip.sysid.contact.time_stepping import COMPILED, N_STEPPED, VALUE, Gripper, contacts

_AT_ONCE = 1024  # pairs
_LONGEST = 1.5
# after so many steps, -2 ln posterior behind the best by the quadratic model: of 943 points of a free
# effusivity that ended within 25 nats of the best, none was farther than 1734 after one, 356 after two and
# 378 after three
_HOPELESS = {1: 6000.0, 2: 2000.0, 3: 1000.0, 4: 1000.0, 5: 1000.0} | dict.fromkeys(range(6, 99), 120.0)
_LEAST_DECREASE = 0.01  # of -2 ln posterior: smaller predicted decreases end the search
_H, _BUILD_UP, _ONSET, _LEVEL, _T, _E, _C = range(7)
_LEFT = 7  # the column of what is left, after those of the derivatives
RATE = 5  # the row of the slope, after the stepped curves
_CURVES = (_H, _BUILD_UP, _E, _C, _ONSET)  # by which the curves after the value are derivatives
EARLIEST_ONSET, LATEST_ONSET = -1.5, 0.8  # s after the closed message

Nodes = tuple[Array, NDArray[np.int64], Array]


class Asked(NamedTuple):
    """``n`` pairs, each of a row of ``data`` and a hypothesis."""

    nodes: Nodes
    gripper: Gripper
    data: Any  # Touches; kernels import nothing that is not in the digest of their sources
    row: NDArray[np.int64]  # (n,)
    beyond: (
        Array  # (n, 2, n_bin), the gripper's discrepancy: always [K], and per degree between object and skin
    )
    table: Any = None  # ResponseTable of the gripper, where its responses are interpolated

    def take(self, index: Any) -> Asked:
        """Return some of the pairs, of one gripper."""
        return self._replace(row=self.row[index], beyond=self.beyond[index])


def readings(asked: Asked, u: Array, vary: Mask, *, alike: bool = False) -> tuple[Array, Array]:
    """Return the bin means (n, n_bin) that ``u`` (n, 7) predicts, and their derivatives (n, 8, n_bin), zero
    where not ``vary`` (n, 7), with a last row for the caller's use; ``alike`` says that many contacts are the
    same but for onset and temperatures."""
    nodes, gripper, data, row, beyond, table = asked
    wanted = np.ones((row.size, RATE + 1), dtype=bool)
    wanted[:, 1:] = vary[:, _CURVES]
    contact, which = np.ascontiguousarray(np.exp(u[:, (_E, _C, _H, _BUILD_UP)])), np.arange(row.size)
    stepped = wanted[:, :N_STEPPED]
    if alike:
        key = contact.view(f"V{contact.itemsize * contact.shape[1]}").ravel()
        _, first, which = np.unique(key, return_index=True, return_inverse=True)
        contact, every = contact[first], np.zeros((first.size, N_STEPPED), dtype=bool)
        np.logical_or.at(every, which, stepped)
        stepped = every
    if table is None:
        rise, slope, _ = contacts(nodes, gripper, contact, np.ascontiguousarray(stepped))
    else:
        rise, slope = table.curves(contact, stepped)
    room = data.t_ambient[row]
    known = np.isfinite(room)
    late = np.exp(2.0 * (u[:, _C] - u[:, _E])) / 6.0
    # the block goes to the room by its far face at ``rate`` [1/s], ``way`` [K]
    far, leak = gripper.numbers[:, 5], np.where(known, gripper.numbers[:, 6], 0.0)
    rate, way = np.where(known, far * np.exp(-u[:, _C]), 0.0), np.where(known, room - u[:, _T], 0.0)
    onset = np.clip(u[:, _ONSET], EARLIEST_ONSET, LATEST_ONSET)
    wanted[:, RATE] &= onset == u[:, _ONSET]  # past the range nothing moves
    n_bin, away = data.y.shape[1], np.where(known, leak * (room - u[:, _LEVEL]), 0.0)
    y, slopes = np.empty((row.size, n_bin)), np.zeros((row.size, _LEFT + 1, n_bin))
    late, leak = np.where(rate > 0.0, late, -1.0), np.broadcast_to(leak, row.size)
    loss = np.stack([late, rate, way, away, leak], axis=1)
    bin_means(
        nodes[2], rise, slope, wanted, which, onset, row, data.sample_t, data.sample_bin, data.count, data.t,
        data.ramp, beyond, u, vary, loss, np.empty((7, data.sample_t.shape[1])),
        np.empty((3, RATE + 1, n_bin)), y, slopes,
    )  # fmt: skip
    return y, slopes


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def bin_means(
    nodes: Array, rise: Array, slope: Array, wanted: Mask, which: NDArray[np.int64], onset: Array,
    row: NDArray[np.int64], times: Array, bins: NDArray[np.int64], count: Array, t: Array, ramp: Array,
    beyond: Array, u: Array, vary: Mask, loss: Array, room: Array, parts: Array, y: Array, slopes: Array,
) -> None:  # fmt: skip
    """Fill ``y`` (n, n_bin) and ``slopes`` (n, 8, n_bin) of :func:`readings`.

    Bin means (6, n_bin) of the ``wanted`` curves ``which`` belong to n pairs, the last of them the slope of
    the first; and where ``late``, first of ``loss`` (n, 5), is not negative the integrals of the means up to
    ``late`` before, and the means there, by straight lines between the bins with a ``count``, zero before
    them.  The others of ``loss`` are rate, way, drift of the level and leak."""
    means, delayed, shifted = parts[0], parts[1], parts[2]
    last, n_curve, n_bin = nodes.size - 1, wanted.shape[1], t.shape[1]
    for p in range(row.size):
        i, k, begin, late = row[p], 0, times.shape[1], loss[p, 0]
        parts[:] = 0.0
        # the node before each sample, -1 before contact, and the weights of values and slopes there and at
        # the next one, by cubic Hermite interpolation
        for j in range(times.shape[1]):
            since = times[i, j] - onset[p]
            room[0, j] = -1.0
            if bins[i, j] >= 0 and since > 0.0:
                begin = min(begin, j)
                while k < last - 1 and nodes[k + 1] < since:
                    k += 1
                while k > 0 and nodes[k] > since:
                    k -= 1
                dt = nodes[k + 1] - nodes[k]
                s = min((since - nodes[k]) / dt, 1.0)
                room[0, j], room[1, j] = k, s * s * (3.0 - 2.0 * s)
                room[2, j], room[3, j] = s * (1.0 - s) * (1.0 - s) * dt, -s * s * (1.0 - s) * dt
                room[4, j], room[5, j] = 6.0 * s * (1.0 - s) / dt, (1.0 - s) * (1.0 - 3.0 * s)
                room[6, j] = s * (3.0 * s - 2.0)
        for c in range(n_curve):
            if not wanted[p, c]:
                continue
            rates, values = c == n_curve - 1, 0 if c == n_curve - 1 else c
            r, v = rise[which[p], values], slope[which[p], values]
            for j in range(begin, times.shape[1]):
                if room[0, j] >= 0.0:
                    k = int(room[0, j])
                    high = r[k + 1] - r[k]
                    if rates:
                        one = room[4, j] * high + room[5, j] * v[k] + room[6, j] * v[k + 1]
                    else:
                        one = r[k] + room[1, j] * high + room[2, j] * v[k] + room[3, j] * v[k + 1]
                    means[c, bins[i, j]] += one
            for m in range(n_bin):
                if count[i, m] > 0.0:
                    means[c, m] /= count[i, m]
            if late < 0.0:
                continue
            curve, summed = means[c], 0.0  # the integral up to ``before``
            before = after = -1  # the bins on either side
            for m in range(n_bin):
                if count[i, m] <= 0.0:
                    continue
                if after < 0:
                    after = m
                x = t[i, m] - late
                while t[i, after] <= x:
                    if before >= 0:
                        summed += 0.5 * (t[i, after] - t[i, before]) * (curve[after] + curve[before])
                    before = after
                    if after == m:
                        break
                    after += 1
                    while count[i, after] <= 0.0:
                        after += 1
                if before >= 0:
                    ahead, bend = x - t[i, before], 0.0
                    if after != before:
                        bend = (curve[after] - curve[before]) / (t[i, after] - t[i, before])
                    delayed[c, m] = summed + ahead * (curve[before] + 0.5 * bend * ahead)
                    shifted[c, m] = curve[before] + bend * ahead
        rate, way, difference = loss[p, 1], loss[p, 2], u[p, _T] - u[p, _LEVEL]
        for m in range(n_bin):
            f, lost = means[VALUE, m] + beyond[p, 1, m], rate * delayed[VALUE, m]
            y[p, m] = u[p, _LEVEL] + difference * f + way * lost + loss[p, 3] * ramp[i, m] + beyond[p, 0, m]
            if vary[p, _T]:
                slopes[p, _T, m] = f - lost
            if vary[p, _LEVEL]:
                slopes[p, _LEVEL, m] = 1.0 - f - loss[p, 4] * ramp[i, m]
        for c in range(1, n_curve):
            at = _CURVES[c - 1]
            if vary[p, at]:
                by_late = 0.0
                if at == _E:  # a denser or less conducting block passes the loss on later
                    by_late = 2.0 * late
                elif at == _C:
                    by_late = -2.0 * late
                sign = -1.0 if at == _ONSET else 1.0
                for m in range(n_bin):
                    extra = delayed[c, m] + by_late * shifted[VALUE, m]
                    if at == _C:
                        extra -= delayed[VALUE, m]
                    slopes[p, at, m] = sign * (difference * means[c, m] + rate * way * extra)


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def normal_equations(
    row: NDArray[np.int64], whitener: Array, columns: Array, scale: Array, white: Array, matrix: Array
) -> None:
    """Fill products (n, 8, 8) of the ``columns`` (n, 8, n_bin), scaled by ``scale`` (n, 8) and whitened by
    the lower triangles ``whitener`` (n_row, n_bin, n_bin); what has no scale is left out."""
    n_bin = columns.shape[2]
    for p in range(row.size):
        for a in range(columns.shape[1]):
            if scale[p, a] > 0.0:
                for i in range(n_bin):
                    total = 0.0
                    for k in range(i + 1):
                        total += whitener[row[p], i, k] * columns[p, a, k]
                    white[a, i] = total * scale[p, a]
                for b in range(a + 1):
                    if scale[p, b] > 0.0:
                        total = 0.0
                        for i in range(n_bin):
                            total += white[a, i] * white[b, i]
                        matrix[p, a, b] = matrix[p, b, a] = total


def products(asked: Asked, whitener: Array, u: Array, sd: Array, *, alike: bool = False) -> Array:
    """Return J' J, and J' r and r' r in the last row and column, (n, 8, 8): J in units of ``sd`` (n, 7), r
    the readings less those that ``u`` predicts, both whitened."""
    y, columns = readings(asked, u, sd > 0.0, alike=alike)
    np.subtract(asked.data.y[asked.row], y, out=columns[:, _LEFT])
    matrix = np.zeros((len(u), _LEFT + 1, _LEFT + 1))
    scale = np.ones((len(u), _LEFT + 1))
    scale[:, :_LEFT] = sd
    normal_equations(asked.row, whitener, columns, scale, np.empty(columns.shape[1:]), matrix)
    return matrix


class Penalty(NamedTuple):
    """The prior's -2 ln density relative to its peak (n,), and by u / sd its halved slopes and curvatures."""

    value: Array
    slope: Array
    bound: Array  # positive, bounds the curvature from above, so that a step on it cannot overshoot
    own: Array  # the curvature, kept from turning negative far out in the tail


def penalty(u: Array, mean: Array, sd: Array, dof: Array) -> Penalty:
    """Return the penalty of points ``u`` (n, 7): normal where ``dof`` is infinite, else Student's t; none and
    curvature 1 where ``sd`` is zero."""
    vary = sd > 0.0
    w = np.divide(u - mean, sd, out=np.zeros(u.shape), where=vary)
    square, slope, one = w * w, w, np.ones(u.shape)
    heavy = vary & np.isfinite(dof)
    if not heavy.any():
        return Penalty(square.sum(axis=1), slope, one, one)
    nu = np.where(heavy, dof, 1.0)
    bound = np.where(heavy, (nu + 1.0) / (nu + square), 1.0)
    own = np.where(heavy, np.maximum(bound * (nu - square) / (nu + square), 1e-3), 1.0)
    value = np.where(heavy, (nu + 1.0) * np.log1p(square / nu), square)
    return Penalty(value.sum(axis=1), slope * bound, bound, own)


def modes(
    asked: Asked, whitener: Array, law: Array, u: Array, max_steps: int, *, rivals: bool = False
) -> tuple[Array, Array, Array, Mask]:
    """Move ``u`` (n, 7) to the mode of each pair; return covariance (n, 7, 7), objective, misfit and where
    the search settled.

    The prior of each is its ``law`` (n, 3, 7): mean, sd, degrees of freedom.  The objective is -2 ln
    (likelihood x prior density relative to its peak) + ln det of its curvature in units of sd.  Where pairs
    of one row are ``rivals``, one that is hopeless beside the best of them is left there, unsettled.
    """
    n = len(u)
    covariance, objective, misfit = np.zeros((n, 7, 7)), np.empty(n), np.empty(n)
    settled, begin = np.zeros(n, dtype=bool), 0
    ends = np.append(np.flatnonzero(np.diff(asked.row)) + 1, n) if rivals else np.arange(1, n + 1)
    while begin < n:  # rivals at once
        end = int(
            ends[
                max(
                    np.searchsorted(ends, begin + _AT_ONCE, "right") - 1,
                    np.searchsorted(ends, begin, "right"),
                )
            ]
        )
        part, begin = slice(begin, end), end
        found = _settle(asked.take(part), whitener, law[part], u[part], max_steps, rivals)
        covariance[part], objective[part], misfit[part], settled[part] = found
    return covariance, objective, misfit, settled


def _settle(
    asked: Asked, whitener: Array, law: Array, u: Array, max_steps: int, rivals: bool
) -> tuple[Array, Array, Array, Mask]:
    n, (mean, sd, dof) = len(u), law.transpose(1, 0, 2)
    trial, damping = u.copy(), np.full(n, 1e-2)
    at, settled, diagonal = np.arange(n), np.zeros(n, dtype=bool), np.arange(_LEFT)
    cost, matrix, slope, bound = np.full(n, np.inf), np.zeros((n, 8, 8)), np.zeros((n, 7)), np.ones((n, 7))
    best = np.empty(asked.data.level.size)
    for step in range(max_steps + 1):
        there = products(asked.take(at), whitener, trial[at], sd[at], alike=step == 0)
        off = penalty(trial[at], mean[at], sd[at], dof[at])
        tried = there[:, _LEFT, _LEFT] + off.value
        better = (tried < cost[at]) | (step == 0)
        new = at[better]
        u[new], cost[new], matrix[new] = trial[new], tried[better], there[better]
        slope[new], bound[new] = off.slope[better], off.bound[better]
        damping[at] = np.where(better, np.maximum(damping[at] * 0.1, 1e-9), damping[at] * 10.0)
        at = at[damping[at] <= 1e9]
        if step == max_steps or not at.size:
            break
        rhs, curved = matrix[at, :_LEFT, _LEFT] - slope[at], matrix[at, :_LEFT, :_LEFT]
        curved[:, diagonal, diagonal] += bound[at]
        last = np.linalg.solve(curved, rhs[:, :, None])[:, :, 0]
        decrease = (last * rhs).sum(axis=1)
        near = decrease < _LEAST_DECREASE
        u[at[near]] += last[near] * sd[at[near]]
        cost[at[near]] -= decrease[near]
        settled[at[near]] = True
        left = ~near
        if rivals and step in _HOPELESS:
            best.fill(np.inf)
            np.minimum.at(best, asked.row, cost)
            left &= cost[at] - decrease < best[asked.row[at]] + _HOPELESS[step]
        at, curved, rhs = at[left], curved[left], rhs[left]
        if not at.size:
            break
        curved[:, diagonal, diagonal] *= 1.0 + damping[at, None]
        move = np.linalg.solve(curved, rhs[:, :, None])[:, :, 0] * sd[at]
        longest = np.abs(move[:, (_H, _BUILD_UP, _E, _C)]).max(axis=1)  # no logarithm moves too far
        trial[at] = u[at] + np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-300))[:, None] * move
    curved = matrix[:, :_LEFT, :_LEFT]
    curved[:, diagonal, diagonal] += penalty(u, mean, sd, dof).own
    inverse = np.linalg.inv(curved)
    covariance = 0.5 * (inverse + inverse.transpose(0, 2, 1)) * (sd[:, :, None] * sd[:, None, :])
    return covariance, cost + np.linalg.slogdet(curved)[1], matrix[:, _LEFT, _LEFT], settled


def marginals(asked: Asked, whitener: Array, u: Array, sd: Array) -> Array:
    """Return ln p(y | u) up to a constant for points ``u`` (n, 7), integrated over level and T_obj, whose
    prior means are in ``u``; ``sd`` (m, 2) are their sds, each pair with a row of the answer (m, n)."""
    at, out = [_LEVEL, _T], np.empty((len(sd), len(u)))
    for begin in range(0, len(u), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        n = len(u[part])
        unit = np.zeros((n, 7))
        unit[:, at] = 1.0
        known = products(asked.take(part), whitener, u[part], unit, alike=True)
        (a, b), d = (known[:, k, k] for k in at), known[:, _LEVEL, _T]
        (g, h), square = (known[:, k, _LEFT] for k in at), known[:, _LEFT, _LEFT]
        for row, (s, t) in zip(out, sd):
            p, q, r = 1.0 + s * s * a, 1.0 + t * t * b, s * t * d
            det = p * q - r * r
            x, y = s * g, t * h
            row[part] = -0.5 * (square - (q * x * x - 2.0 * r * x * y + p * y * y) / det + np.log(det))
    return out
