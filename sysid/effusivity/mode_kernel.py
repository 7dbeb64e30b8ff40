"""Search for the mode of a grasp under a hypothesis:
:mod:`thermogrip.sysid.effusivity.laplace_approximation`, many pairs at once.

Each pair takes damped Gauss-Newton steps on the responses of :mod:`thermogrip.sysid.contact.time_stepping`
until the next one would gain less than 0.005 nat; that last step is taken on the quadratic model alone, and
its predicted decrease counted.  What costs is compiled, in functions that call no other; the rest is
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
# and where the object's temperature is stated: of the points and candidates of the example conditions that
# ended within 25 nats none was farther than 147 behind before a step, 54 after any number; what is left
# at less than 300 is a start for finer points beside, which then end elsewhere
_HOPELESS_STATED = {0: 500.0} | dict.fromkeys(range(1, 99), 300.0)
_LEAST_DECREASE = 0.01  # of -2 ln posterior: smaller predicted decreases end the search
_H, _BUILD_UP, _ONSET, _LEVEL, _T, _E, _C = range(7)
_LEFT = 7  # the column of what is left, after those of the derivatives
_FEW = 3  # columns
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
    """Return the bin means (n, n_bin) that ``u`` (n, 7) predicts, and their derivatives (n, n_bin, 8), zero
    where not ``vary`` (n, 7), with a last column for the caller's use; ``alike`` says that many contacts are
    the same but for onset and temperatures."""
    data, row = asked.data, asked.row
    wanted = np.ones((row.size, RATE + 1), dtype=bool)
    wanted[:, 1:] = vary[:, _CURVES]
    onset = np.clip(u[:, _ONSET], EARLIEST_ONSET, LATEST_ONSET)
    wanted[:, RATE] &= onset == u[:, _ONSET]  # past the range nothing moves
    numbers, which = np.ascontiguousarray(u[:, (_E, _C, _H, _BUILD_UP)]), np.arange(row.size)
    stepped = wanted[:, :N_STEPPED]
    if alike:
        key = numbers.view(f"V{numbers.itemsize * numbers.shape[1]}").ravel()
        _, first, which = np.unique(key, return_index=True, return_inverse=True)
        numbers, every = numbers[first], np.zeros((first.size, N_STEPPED), dtype=bool)
        np.logical_or.at(every, which, stepped)
        stepped = every
    means = _means(asked, numbers, np.ascontiguousarray(stepped), which, onset, wanted)
    room = data.t_ambient[row]
    known = np.isfinite(room)
    late = np.exp(2.0 * (u[:, _C] - u[:, _E])) / 6.0
    # the block goes to the room by its far face at ``rate`` [1/s], ``way`` [K]
    far, leak = asked.gripper.numbers[:, 5], np.where(known, asked.gripper.numbers[:, 6], 0.0)
    rate, way = np.where(known, far * np.exp(-u[:, _C]), 0.0), np.where(known, room - u[:, _T], 0.0)
    n_bin, away = data.y.shape[1], np.where(known, leak * (room - u[:, _LEVEL]), 0.0)
    y, slopes = np.empty((row.size, n_bin)), np.empty((row.size, n_bin, _LEFT + 1))
    late, leak = np.where(rate > 0.0, late, -1.0), np.broadcast_to(leak, row.size)
    loss, scratch = np.stack([late, rate, way, away, leak], axis=1), np.empty((16, n_bin))
    predicted(
        means, wanted, row, data.count, data.t, data.ramp, asked.beyond, u, vary, loss, scratch, y, slopes
    )
    return y, slopes


def _means(
    asked: Asked, numbers: Array, stepped: Mask, which: NDArray[np.int64], onset: Array, wanted: Mask
) -> Array:
    """Return the bin means (n, 6, n_bin) of the ``wanted`` curves of contacts of logarithms ``numbers`` (k,
    4), ``which`` of these belongs to each pair; before contact zero."""
    nodes, gripper, data, row, _, table = asked
    out = np.empty((row.size, RATE + 1, data.y.shape[1]))
    common = np.zeros(row.size, dtype=bool)
    if table is not None and data.common is not None:
        common = data.common[row] & table.inside(numbers)[which]
    if common.all():
        table.bin_means(data.sample_t, data.sample_bin, row, numbers, stepped, which, onset, wanted, out)
        return out
    if common.any():
        for own in (common, ~common):
            used, at = np.unique(which[own], return_inverse=True)
            out[own] = _means(asked.take(own), numbers[used], stepped[used], at, onset[own], wanted[own])
        return out
    contact = np.exp(numbers)
    rise, slope = (
        contacts(nodes, gripper, contact, stepped)[:2] if table is None else table.curves(contact, stepped)
    )
    room = np.empty((7, data.sample_t.shape[1]))
    bin_means(
        nodes[2],
        rise,
        slope,
        wanted,
        which,
        onset,
        row,
        data.sample_t,
        data.sample_bin,
        data.count,
        room,
        out,
    )
    return out


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def bin_means(
    nodes: Array, rise: Array, slope: Array, wanted: Mask, which: NDArray[np.int64], onset: Array,
    row: NDArray[np.int64], times: Array, bins: NDArray[np.int64], count: Array, room: Array, means: Array,
) -> None:  # fmt: skip
    """Fill ``means`` (n, 6, n_bin) of the ``wanted`` curves, ``which`` of these belongs to each pair, the
    last of them the slope of the first."""
    last, n_curve, n_bin = nodes.size - 1, wanted.shape[1], count.shape[1]
    for p in range(row.size):
        i, k, begin = row[p], 0, times.shape[1]
        means[p] = 0.0
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
                    means[p, c, bins[i, j]] += one
            for m in range(n_bin):
                if count[i, m] > 0.0:
                    means[p, c, m] /= count[i, m]


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def predicted(
    means: Array, wanted: Mask, row: NDArray[np.int64], count: Array, t: Array, ramp: Array, beyond: Array,
    u: Array, vary: Mask, loss: Array, room: Array, y: Array, slopes: Array,
) -> None:  # fmt: skip
    """Fill ``y`` (n, n_bin) and ``slopes`` (n, n_bin, 8) of :func:`readings` from the ``means`` (n, 6, n_bin)
    of ``wanted`` curves, the last of them the slope of the first.

    Where ``late``, first of ``loss`` (n, 5), is not negative, a curve's integral up to ``late`` before, and
    its value there, count too: by straight lines between the bins with a ``count``, zero before them.  The
    others of ``loss`` are rate, way, drift of the level and leak."""
    n_curve, n_bin = wanted.shape[1], t.shape[1]
    # bins on either side, -1 before the first, and integrals
    before, after, whole = room[0], room[1], room[2]
    delayed, shifted = room[4:10], room[10:16]
    for p in range(row.size):
        i, late, own = row[p], loss[p, 0], means[p]
        delayed[:], shifted[:] = 0.0, 0.0
        if late >= 0.0:
            low = high = -1
            for m in range(n_bin):
                before[m] = -1.0
                if count[i, m] <= 0.0:
                    continue
                if high < 0:
                    high = m
                while t[i, high] <= t[i, m] - late:
                    low = high
                    if high == m:
                        break
                    high += 1
                    while count[i, high] <= 0.0:
                        high += 1
                before[m], after[m] = low, high
            for c in range(n_curve):
                if not wanted[p, c]:
                    continue
                summed, k = 0.0, -1
                for m in range(n_bin):
                    if count[i, m] > 0.0:
                        if k >= 0:
                            summed += 0.5 * (t[i, m] - t[i, k]) * (own[c, m] + own[c, k])
                        whole[m], k = summed, m
                for m in range(n_bin):
                    if before[m] >= 0.0:
                        low, high = int(before[m]), int(after[m])
                        ahead, bend = t[i, m] - late - t[i, low], 0.0
                        if high != low:
                            bend = (own[c, high] - own[c, low]) / (t[i, high] - t[i, low])
                        delayed[c, m] = whole[low] + ahead * (own[c, low] + 0.5 * bend * ahead)
                        shifted[c, m] = own[c, low] + bend * ahead
        rate, way, difference = loss[p, 1], loss[p, 2], u[p, _T] - u[p, _LEVEL]
        for m in range(n_bin):
            f, lost = own[VALUE, m] + beyond[p, 1, m], rate * delayed[VALUE, m]
            y[p, m] = u[p, _LEVEL] + difference * f + way * lost + loss[p, 3] * ramp[i, m] + beyond[p, 0, m]
            slopes[p, m, _T] = f - lost if vary[p, _T] else 0.0
            slopes[p, m, _LEVEL] = 1.0 - f - loss[p, 4] * ramp[i, m] if vary[p, _LEVEL] else 0.0
            slopes[p, m, _LEFT] = 0.0
        for c in range(1, n_curve):
            at, by_late = _CURVES[c - 1], 0.0
            if at == _E:  # a denser or less conducting block passes the loss on later
                by_late = 2.0 * late
            elif at == _C:
                by_late = -2.0 * late
            if not (vary[p, at] and wanted[p, c]):
                for m in range(n_bin):
                    slopes[p, m, at] = 0.0
                continue
            sign = -1.0 if at == _ONSET else 1.0
            scale, passed = sign * difference, sign * rate * way
            for m in range(n_bin):
                extra = delayed[c, m] + by_late * shifted[VALUE, m]
                if at == _C:
                    extra -= delayed[VALUE, m]
                slopes[p, m, at] = scale * own[c, m] + passed * extra


def products(
    asked: Asked, whitener: Any, u: Array, sd: Array, *, alike: bool = False
) -> Array:  # fmt: skip
    """Return J' J, and J' r and r' r in the last row and column, (n, 8, 8): J in units of ``sd`` (n, 7), r
    the readings less those that ``u`` predicts, both whitened."""
    y, columns = readings(asked, u, sd > 0.0, alike=alike)
    np.subtract(asked.data.y[asked.row], y, out=columns[:, :, _LEFT])
    scale, matrix = np.ones((len(u), _LEFT + 1)), np.zeros((len(u), _LEFT + 1, _LEFT + 1))
    scale[:, :_LEFT] = sd
    used = np.flatnonzero((scale > 0.0).any(axis=0))
    if used.size > _FEW:
        matrix = squares(whitener, asked.row, columns)
    else:
        matrix[:, used[:, None], used] = squares(whitener, asked.row, columns[:, :, used])
    matrix *= scale[:, :, None]
    matrix *= scale[:, None, :]
    return matrix


def squares(whitener: Any, row: NDArray[np.int64], columns: Array) -> Array:
    """Return the products (n, m, m) of ``columns`` (n, n_bin, m) of touches ``row``, whitened by a
    :class:`~thermogrip.sysid.effusivity.data.Whitener` or by a matrix a touch."""
    alone = isinstance(whitener, np.ndarray)
    kinds, kind = (whitener, row) if alone else (whitener.kinds, whitener.kind[row])
    out = np.empty((row.size, columns.shape[2], columns.shape[2]))
    for k in np.unique(kind):
        at: Any = slice(None) if (kind == k).all() else kind == k
        own = columns[at]
        if own.shape[2] > _FEW:
            white = np.matmul(kinds[k], own)
        else:  # one product of large matrices is quicker than many of few columns
            across = own.transpose(0, 2, 1)
            white = np.matmul(across.reshape(-1, across.shape[2]), kinds[k].T)
            white = white.reshape(across.shape).transpose(0, 2, 1)
        if not alone:
            white *= whitener.scale[row[at], :, None]
        out[at] = np.matmul(white.transpose(0, 2, 1), white)
    return out


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
    asked: Asked, whitener: Any, law: Array, u: Array, max_steps: int, *, rivals: bool = False
) -> tuple[Array, Array, Array, Mask]:
    """Move ``u`` (n, 7) to the mode of each pair; return covariance (n, 7, 7), objective, misfit and where
    the search settled.

    The prior of each is its ``law`` (n, 3, 7): mean, sd, degrees of freedom.  The objective is -2 ln
    (likelihood x prior density relative to its peak) + ln det of its curvature in units of sd.  Where pairs
    of one row are ``rivals``, one that is hopeless beside the best of them is left there, unsettled.
    """
    n, (mean, sd, dof) = len(u), law.transpose(1, 0, 2)
    trial, damping = u.copy(), np.full(n, 1e-2)
    at, settled, diagonal = np.arange(n), np.zeros(n, dtype=bool), np.arange(_LEFT)
    cost, matrix, slope, bound = np.full(n, np.inf), np.zeros((n, 8, 8)), np.zeros((n, 7)), np.ones((n, 7))
    best, ahead, stated = np.empty(asked.data.level.size), cost.copy(), np.isfinite(asked.data.t_object)
    for step in range(max_steps + 1):
        there = _products_of(asked, at, whitener, trial, sd, alike=step == 0)
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
        if rivals:
            best.fill(np.inf)
            ahead[at] = cost[at] - np.where(near, 0.0, decrease)  # of those near it is taken off
            np.minimum.at(best, asked.row, ahead)
            limit = np.where(stated, _HOPELESS_STATED[step], _HOPELESS.get(step, np.inf))
            left &= ahead[at] < (best + limit)[asked.row[at]]
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


def _products_of(
    asked: Asked, at: NDArray[np.int64], whitener: Any, u: Array, sd: Array, *, alike: bool
) -> Array:
    """Return :func:`products` of some pairs, so many at once that they stay in the processor's cache."""
    out = np.empty((at.size, _LEFT + 1, _LEFT + 1))
    for begin in range(0, at.size, _AT_ONCE):
        part = at[begin : begin + _AT_ONCE]
        out[begin : begin + _AT_ONCE] = products(asked.take(part), whitener, u[part], sd[part], alike=alike)
    return out


def marginals(asked: Asked, whitener: Any, u: Array, sd: Array) -> Array:
    """Return ln p(y | u) up to a constant for points ``u`` (n, 7), integrated over level and T_obj, whose
    prior means are in ``u``; ``sd`` (m, n, 2) are their sds, each with a row of the answer (m, n)."""
    at, out = [_LEVEL, _T], np.empty((len(sd), len(u)))
    for begin in range(0, len(u), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        n = len(u[part])
        unit = np.zeros((n, 7))
        unit[:, at] = 1.0
        some = asked.take(part)
        known = products(some, whitener, u[part], unit, alike=bool((some.row == some.row[0]).all()))
        (a, b), d = (known[:, k, k] for k in at), known[:, _LEVEL, _T]
        (g, h), square = (known[:, k, _LEFT] for k in at), known[:, _LEFT, _LEFT]
        for row, (s, t) in zip(out, sd[:, part].transpose(0, 2, 1)):
            p, q, r = 1.0 + s * s * a, 1.0 + t * t * b, s * t * d
            det = p * q - r * r
            x, y = s * g, t * h
            row[part] = -0.5 * (square - (q * x * x - 2.0 * r * x * y + p * y * y) / det + np.log(det))
    return out
