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

    def take(self, index: Any) -> Asked:
        """Return some of the pairs, of one gripper."""
        return self._replace(row=self.row[index], beyond=self.beyond[index])


def readings(asked: Asked, u: Array, vary: Mask, *, alike: bool = False) -> tuple[Array, Array]:
    """Return the bin means (n, n_bin) that ``u`` (n, 7) predicts, and their derivatives (n, 8, n_bin), zero
    where not ``vary`` (n, 7), with a last row for the caller's use; ``alike`` says that many contacts are the
    same but for onset and temperatures."""
    nodes, gripper, data, row, beyond = asked
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
    rise, slope, _ = contacts(nodes, gripper, contact, np.ascontiguousarray(stepped))
    room = data.t_ambient[row]
    known, difference = np.isfinite(room), u[:, _T] - u[:, _LEVEL]
    late = np.exp(2.0 * (u[:, _C] - u[:, _E])) / 6.0
    # the block goes to the room by its far face at ``rate`` [1/s], ``way`` [K]
    far, leak = gripper.numbers[:, 5], np.where(known, gripper.numbers[:, 6], 0.0)
    rate, way = np.where(known, far * np.exp(-u[:, _C]), 0.0), np.where(known, room - u[:, _T], 0.0)
    means, delayed, shifted = np.zeros((3, row.size, RATE + 1, data.y.shape[1]))
    onset = np.clip(u[:, _ONSET], EARLIEST_ONSET, LATEST_ONSET)
    wanted[:, RATE] &= onset == u[:, _ONSET]  # past the range nothing moves
    room_for = np.empty((2, data.sample_t.shape[1]))
    bin_means(
        nodes[2], rise, slope, wanted, which, onset, row, data.sample_t, data.sample_bin, data.count, data.t,
        np.where(rate > 0.0, late, -1.0), room_for, means, delayed, shifted,
    )  # fmt: skip
    ramp, slopes = data.ramp[row], np.zeros((row.size, _LEFT + 1, data.y.shape[1]))
    f, lost = means[:, VALUE] + beyond[:, 1], rate[:, None] * delayed[:, VALUE]
    away = np.where(known, leak * (room - u[:, _LEVEL]), 0.0)
    y = (
        u[:, _LEVEL, None]
        + difference[:, None] * f
        + way[:, None] * lost
        + away[:, None] * ramp
        + beyond[:, 0]
    )
    slopes[:, _T], slopes[:, _LEVEL] = f - lost, 1.0 - f - leak[:, None] * ramp
    scale = (rate * way)[:, None]
    for curve, at in enumerate(_CURVES, 1):
        if not vary[:, at].any():
            continue
        extra = delayed[:, curve]
        if at == _E:  # a denser or less conducting block passes the loss on later
            extra = extra + 2.0 * late[:, None] * shifted[:, VALUE]
        elif at == _C:
            extra = extra - 2.0 * late[:, None] * shifted[:, VALUE] - delayed[:, VALUE]
        sign = np.where(vary[:, at], -1.0 if at == _ONSET else 1.0, 0.0)[:, None]
        slopes[:, at] = sign * (difference[:, None] * means[:, curve] + scale * extra)
    slopes[:, :_LEFT][~vary] = 0.0
    return y, slopes


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def bin_means(
    nodes: Array, rise: Array, slope: Array, wanted: Mask, which: NDArray[np.int64], onset: Array,
    row: NDArray[np.int64], times: Array, bins: NDArray[np.int64], count: Array, t: Array, late: Array,
    room: Array, means: Array, delayed: Array, shifted: Array,
) -> None:  # fmt: skip
    """Fill bin means (n, 6, n_bin) of the ``wanted`` curves ``which`` belong to n pairs, the last of them the
    slope of the first; and where ``late`` is not negative the integrals of the means up to ``late`` before,
    and the means there, by straight lines between the bins with a ``count``, zero before them."""
    last, n_curve, n_bin = nodes.size - 1, wanted.shape[1], t.shape[1]
    for p in range(row.size):
        i, k = row[p], 0
        for j in range(
            times.shape[1]
        ):  # the node before each sample, -1 before contact, and the way to the next
            since = times[i, j] - onset[p]
            room[0, j] = -1.0
            if bins[i, j] >= 0 and since > 0.0:
                while k < last - 1 and nodes[k + 1] < since:
                    k += 1
                while k > 0 and nodes[k] > since:
                    k -= 1
                room[0, j], room[1, j] = k, min((since - nodes[k]) / (nodes[k + 1] - nodes[k]), 1.0)
        for c in range(n_curve):
            if not wanted[p, c]:
                continue
            # by cubic Hermite interpolation
            rates, values = c == n_curve - 1, 0 if c == n_curve - 1 else c
            r, v = rise[which[p], values], slope[which[p], values]
            for j in range(times.shape[1]):
                if room[0, j] >= 0.0:
                    k, s = int(room[0, j]), room[1, j]
                    dt, high = nodes[k + 1] - nodes[k], r[k + 1] - r[k]
                    if rates:
                        one = 6.0 * s * (1.0 - s) * high / dt
                        one += (1.0 - s) * (1.0 - 3.0 * s) * v[k] + s * (3.0 * s - 2.0) * v[k + 1]
                    else:
                        one = r[k] + s * s * (3.0 - 2.0 * s) * high
                        one += s * (1.0 - s) * dt * ((1.0 - s) * v[k] - s * v[k + 1])
                    means[p, c, bins[i, j]] += one
            for m in range(n_bin):
                if count[i, m] > 0.0:
                    means[p, c, m] /= count[i, m]
            if late[p] < 0.0:
                continue
            curve, summed = means[p, c], 0.0  # the integral up to ``before``
            before = after = -1  # the bins on either side
            for m in range(n_bin):
                if count[i, m] <= 0.0:
                    continue
                if after < 0:
                    after = m
                x = t[i, m] - late[p]
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
                    delayed[p, c, m] = summed + ahead * (curve[before] + 0.5 * bend * ahead)
                    shifted[p, c, m] = curve[before] + bend * ahead


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
