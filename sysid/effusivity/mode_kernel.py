"""Search for the mode of a grasp under a hypothesis:
:mod:`thermogrip.sysid.effusivity.laplace_approximation`, many pairs at once.

Each pair takes damped Gauss-Newton steps on the responses of :mod:`thermogrip.sysid.contact.time_stepping`
until the next one would gain less than 0.005 nat; that last step is taken on the quadratic model alone, and
its predicted decrease counted.  What costs is compiled, in functions that call no other; the rest is
NumPy's, for some hundred pairs at once, whose arrays stay in the processor's cache.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.compiled import numba
from thermogrip.sysid.contact.time_stepping import COMPILED, N_STEPPED, VALUE, Gripper, contacts


@dataclass(frozen=True)
class SearchSettings:
    """How the search for a mode steps, and when it ends."""

    pairs_at_once: int = 1024  # whose arrays stay in the processor's cache
    most_steps: int = 20  # a pair that has not settled by then is hopeless in practice
    longest_step: float = 1.5  # of a logarithm of the contact
    # what even the best leaves unexplained counts more: where none explains the readings yet, as of a
    # late contact, the right one may be that far behind
    unexplained_times: float = 3.0
    bent: float = 1.5  # times the quadratic model's curvature, from which on steps are shorter
    far_bent: float = 4.0  # and from which on they are damped
    no_damping: float = 1e-3  # a damping that counts as none
    stale_K: float = 0.01  # that a temperature may move for slopes by the rest to stay
    least_decrease: float = 0.01  # of -2 ln posterior: smaller predicted decreases end the search


SEARCH = SearchSettings()

# after so many steps, -2 ln posterior behind the best by the quadratic model: of 943 points of a free
# effusivity that ended within 25 nats of the best, none was farther than 1734 after one, 356 after two and
# 378 after three
_HOPELESS_COST = {1: 6000.0, 2: 2000.0, 3: 1000.0, 4: 1000.0, 5: 1000.0} | dict.fromkeys(range(6, 99), 120.0)
# and where the object's temperature is stated: of the points and candidates of the example conditions that
# ended within 25 nats none was farther than 147 behind before a step, 54 after any number; what the best
# leaves unexplained comes on top, some 45 times _UNEXPLAINED where the model is right
_HOPELESS_STATED = {0: 300.0} | dict.fromkeys(range(1, 99), 100.0)
_H, _BUILD_UP, _ONSET, _LEVEL, _T, _E, _C = range(7)
_LEFT = 7  # the column of what is left, after those of the derivatives
RATE = 5  # the row of the slope, after the stepped curves
_CURVES = np.array([_H, _BUILD_UP, _E, _C, _ONSET])  # by which the curves after the value are derivatives
_CONTACT = np.array([_E, _C, _H, _BUILD_UP])
# s after the closed message: five sds of what the onset of a grasp unlike the training may be
EARLIEST_ONSET, LATEST_ONSET = -1.5, 1.5

Nodes = tuple[Array, NDArray[np.int64], Array]


class Pairs(NamedTuple):
    """``n`` pairs, each of a row of ``data`` and a hypothesis."""

    nodes: Nodes
    gripper: Gripper
    data: Any  # Touches; kernels import nothing that is not in the digest of their sources
    row: NDArray[np.int64]  # (n,)
    # (n, 2, n_bin), the gripper's discrepancy: always [K], and per degree between object and skin
    beyond: Array

    def take(self, index: Any) -> Pairs:
        """Return some of the pairs, of one gripper."""
        return self._replace(row=self.row[index], beyond=self.beyond[index])


def readings(pairs: Pairs, u: Array, vary: Mask) -> tuple[Array, Array]:
    """Return the bin means (n, n_bin) that ``u`` (n, 7) predicts, and their derivatives (n, 8, n_bin), zero
    where not ``vary`` (n, 7), with what is left of the data in the last row."""
    data, row = pairs.data, pairs.row
    wanted = np.ones((row.size, RATE + 1), dtype=bool)
    wanted[:, 1:] = vary[:, _CURVES]
    onset = np.minimum(np.maximum(u[:, _ONSET], EARLIEST_ONSET), LATEST_ONSET)
    wanted[:, RATE] &= onset == u[:, _ONSET]  # past the range nothing moves
    means = _bin_means(pairs, u.take(_CONTACT, axis=1), onset, wanted)
    n_bin = data.y.shape[1]
    y, slopes = np.empty((row.size, n_bin)), np.empty((row.size, _LEFT + 1, n_bin))
    scratch = np.empty((16, n_bin))
    predicted(
        means, wanted, row, data.count, data.t, data.ramp, data.y, data.t_ambient[row], pairs.gripper.numbers,
        pairs.beyond, u, vary, scratch, y, slopes,
    )  # fmt: skip
    return y, slopes


def _bin_means(pairs: Pairs, numbers: Array, onset: Array, wanted: Mask) -> Array:
    """Return the bin means (n, 6, n_bin) of the ``wanted`` curves of contacts of logarithms ``numbers`` (n,
    4); before contact zero."""
    nodes, gripper, data, row, _ = pairs
    out = np.empty((row.size, RATE + 1, data.y.shape[1]))
    stepped = wanted[:, :N_STEPPED].copy()  # for arrays of another layout kernels are compiled anew
    rise, slope, _ = contacts(nodes, gripper, np.exp(numbers), stepped)
    room = np.empty((7, data.sample_t.shape[1]))
    bin_means(
        nodes[2], rise, slope, wanted, onset, row, data.sample_t, data.sample_bin, data.count, room, out
    )
    return out


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def bin_means(
    nodes: Array, rise: Array, slope: Array, wanted: Mask, onset: Array, row: NDArray[np.int64],
    times: Array, bins: NDArray[np.int64], count: Array, scratch: Array, means: Array,
) -> None:  # fmt: skip
    """Fill ``means`` (n, 6, n_bin) of the ``wanted`` curves, the last of them the slope of the first."""
    last = nodes.size - 1
    n_curve = wanted.shape[1]
    n_bin = count.shape[1]
    for p in range(row.size):
        i = row[p]
        k = 0
        begin = times.shape[1]
        means[p] = 0.0
        # the node before each sample, -1 before contact, and the weights of values and slopes there and at
        # the next value, by cubic Hermite interpolation
        for j in range(times.shape[1]):
            since = times[i, j] - onset[p]
            scratch[0, j] = -1.0
            if bins[i, j] >= 0 and since > 0.0:
                begin = min(begin, j)
                while k < last - 1 and nodes[k + 1] < since:
                    k += 1
                while k > 0 and nodes[k] > since:
                    k -= 1
                dt = nodes[k + 1] - nodes[k]
                s = min((since - nodes[k]) / dt, 1.0)
                scratch[0, j], scratch[1, j] = k, s * s * (3.0 - 2.0 * s)
                scratch[2, j], scratch[3, j] = s * (1.0 - s) * (1.0 - s) * dt, -s * s * (1.0 - s) * dt
                scratch[4, j], scratch[5, j] = 6.0 * s * (1.0 - s) / dt, (1.0 - s) * (1.0 - 3.0 * s)
                scratch[6, j] = s * (3.0 * s - 2.0)
        for c in range(n_curve):
            if not wanted[p, c]:
                continue
            rates, values = c == n_curve - 1, 0 if c == n_curve - 1 else c
            r, v = rise[p, values], slope[p, values]
            for j in range(begin, times.shape[1]):
                if scratch[0, j] >= 0.0:
                    k = int(scratch[0, j])
                    high = r[k + 1] - r[k]
                    if rates:
                        value = scratch[4, j] * high + scratch[5, j] * v[k] + scratch[6, j] * v[k + 1]
                    else:
                        value = r[k] + scratch[1, j] * high + scratch[2, j] * v[k] + scratch[3, j] * v[k + 1]
                    means[p, c, bins[i, j]] += value
            for m in range(n_bin):
                if count[i, m] > 0.0:
                    means[p, c, m] /= count[i, m]


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def predicted(
    means: Array, wanted: Mask, row: NDArray[np.int64], count: Array, t: Array, ramp: Array, read: Array,
    ambient: Array, numbers: Array, beyond: Array, u: Array, vary: Mask, scratch: Array, y: Array,
    slopes: Array,
) -> None:  # fmt: skip
    """Fill ``y`` (n, n_bin) and ``slopes`` (n, 8, n_bin) of :func:`readings` from the ``means`` (n, 6, n_bin)
    of ``wanted`` curves, the last of them the slope of the first; ``read`` are the touches' bin means.

    Where the ``ambient`` temperature is known the block goes to the room by its far face at ``rate`` [1/s],
    ``to_room`` [K], which counts ``delay`` [s] later: a curve's integral up to ``delay`` before, and its
    value there, by straight lines between the bins with a ``count``, zero before them."""
    n_curve, n_bin = wanted.shape[1], t.shape[1]
    # bins on either side, -1 before the first, and integrals
    before = scratch[0]
    after = scratch[1]
    integral = scratch[2]
    delayed, shifted = scratch[4:10], scratch[10:16]
    for p in range(row.size):
        i = row[p]
        curves = means[p]
        k = min(p, numbers.shape[0] - 1)
        room_temperature = ambient[p]
        rate = 0.0
        to_room = 0.0
        sensor_leak = 0.0
        sensor_loss = 0.0
        if np.isfinite(room_temperature):
            rate = numbers[k, 5] * np.exp(-u[p, _C])
            to_room = room_temperature - u[p, _T]
            sensor_leak = numbers[k, 6]
            sensor_loss = sensor_leak * (room_temperature - u[p, _LEVEL])
        delay = np.exp(2.0 * (u[p, _C] - u[p, _E])) / 6.0 if rate > 0.0 else -1.0
        delayed[:], shifted[:] = 0.0, 0.0
        if delay >= 0.0:
            low = high = -1
            for m in range(n_bin):
                before[m] = -1.0
                if count[i, m] <= 0.0:
                    continue
                if high < 0:
                    high = m
                while t[i, high] <= t[i, m] - delay:
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
                            summed += 0.5 * (t[i, m] - t[i, k]) * (curves[c, m] + curves[c, k])
                        integral[m], k = summed, m
                for m in range(n_bin):
                    if before[m] >= 0.0:
                        low, high = int(before[m]), int(after[m])
                        ahead, bend = t[i, m] - delay - t[i, low], 0.0
                        if high != low:
                            bend = (curves[c, high] - curves[c, low]) / (t[i, high] - t[i, low])
                        delayed[c, m] = integral[low] + ahead * (curves[c, low] + 0.5 * bend * ahead)
                        shifted[c, m] = curves[c, low] + bend * ahead
        difference = u[p, _T] - u[p, _LEVEL]
        level = u[p, _LEVEL]
        derivatives = slopes[p]
        by_t, by_level = 1.0 if vary[p, _T] else 0.0, 1.0 if vary[p, _LEVEL] else 0.0
        for m in range(n_bin):
            f, block_loss = curves[VALUE, m] + beyond[p, 1, m], rate * delayed[VALUE, m]
            reading = (
                level + difference * f + to_room * block_loss + sensor_loss * ramp[i, m] + beyond[p, 0, m]
            )
            y[p, m] = reading
            derivatives[_T, m] = by_t * (f - block_loss)
            derivatives[_LEVEL, m] = by_level * (1.0 - f - sensor_leak * ramp[i, m])
            derivatives[_LEFT, m] = read[i, m] - reading
        for c in range(1, n_curve):
            nuisance, by_late = _CURVES[c - 1], 0.0
            if nuisance == _E:  # a denser or less conducting block passes the loss on later
                by_late = 2.0 * delay
            elif nuisance == _C:
                by_late = -2.0 * delay
            if not (vary[p, nuisance] and wanted[p, c]):
                derivatives[nuisance] = 0.0
                continue
            sign = -1.0 if nuisance == _ONSET else 1.0
            less = 1.0 if nuisance == _C else 0.0
            scale, passed = sign * difference, sign * rate * to_room
            for m in range(n_bin):
                extra = delayed[c, m] + by_late * shifted[VALUE, m] - less * delayed[VALUE, m]
                derivatives[nuisance, m] = scale * curves[c, m] + passed * extra


def products(pairs: Pairs, whitener: Array, u: Array, sd: Array) -> Array:
    """Return J' J, and J' r and r' r in the last row and column, (n, 8, 8): J in units of ``sd`` (n, 7), r
    the readings less those that ``u`` predicts, both whitened."""
    blocks = []
    for begin in range(0, len(u), SEARCH.pairs_at_once):
        chunk = slice(begin, begin + SEARCH.pairs_at_once)
        some = pairs.take(chunk)
        columns = readings(some, u[chunk], sd[chunk] > 0.0)[1]
        blocks.append(squares(whitener, some.row, columns))
    matrix = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
    scale = np.ones((len(u), _LEFT + 1))
    scale[:, :_LEFT] = sd
    matrix *= scale[:, :, None]
    matrix *= scale[:, None, :]
    return matrix


def squares(whitener: Array, row: NDArray[np.int64], columns: Array) -> Array:
    """Return the products (n, m, m) of ``columns`` (n, m, n_bin) of touches ``row``, whitened by a matrix a
    touch."""
    white = np.matmul(columns, whitener[row].transpose(0, 2, 1))
    # of two arrays: for one and its own transpose NumPy takes a slower way
    return np.asarray(np.matmul(white, white.copy().transpose(0, 2, 1)))


class Penalty(NamedTuple):
    """The prior's -2 ln density relative to its peak (n,), and by u / sd its halved slopes and curvatures."""

    value: Array
    slope: Array
    bound: Array  # positive, bounds the curvature from above, so that a step on it cannot overshoot
    own: Array  # the curvature, kept from turning negative far out in the tail


class Law(NamedTuple):
    """A prior as the search takes it: mean, 1 / sd, 0 where that is zero, and 1 / degrees of freedom, 0 where
    these are infinite, (n, 7) each; whether some are not."""

    mean: Array
    per_sd: Array
    per_dof: Array
    heavy: bool

    @classmethod
    def of(cls, mean: Array, sd: Array, dof: Array) -> Law:
        """Return the law of means, sds and degrees of freedom."""
        vary = sd > 0.0
        per_dof = np.where(vary, 1.0 / dof, 0.0)
        return cls(mean, vary / np.where(vary, sd, 1.0), per_dof, bool(per_dof.any()))

    def take(self, index: Any) -> Law:
        """Return some of the pairs' laws."""
        return Law(self.mean[index], self.per_sd[index], self.per_dof[index], self.heavy)

    def penalty(self, u: Array) -> Penalty:
        """Return the penalty of points ``u`` (n, 7)."""
        w = (u - self.mean) * self.per_sd
        square = w * w
        if not self.heavy:
            one = np.ones(u.shape)
            return Penalty(square.sum(axis=1), w, one, one)
        k = self.per_dof
        tail_square = square * k
        tail = 1.0 + tail_square
        bound = (1.0 + k) / tail
        curvature = np.maximum(bound * (1.0 - tail_square) / tail, 1e-3)
        value = np.log1p(tail_square) * (1.0 + k) / np.maximum(k, 1e-300)
        return Penalty(np.where(k > 0.0, value, square).sum(axis=1), w * bound, bound, curvature)


class _Search(NamedTuple):
    """Where pairs are on their way to the mode: what was the best point of each, and what to try next."""

    at: NDArray[np.int64]  # which pairs
    law: Law
    sd: Array
    trial: Array
    point: Array
    cost: Array
    matrix: Array
    slope: Array
    bound: Array
    damping: Array
    part: Array  # of the next steps
    slope_gain: Array  # what the trial's step should gain by its slope, and lose by its bend
    bend: Array
    stale: Mask  # whether slopes at the best point are those of another temperature

    def take(self, index: Any) -> _Search:
        """Return some of the pairs."""
        some: Any = (part.take(index) if isinstance(part, Law) else part[index] for part in self)
        return _Search(*some)


class Found(NamedTuple):
    """Where a search ended: points, products and -2 ln posterior there, and where it settled."""

    u: Array
    matrix: Array
    cost: Array
    settled: Mask


def search(pairs: Pairs, whitener: Any, law: Law, sd: Array, u: Array, *, rivals: bool) -> Found:
    """Return where damped Gauss-Newton steps from ``u`` (n, 7) end, under priors of a ``law`` and of ``sd``
    (n, 7): where the next step would gain less than 0.005 nat, which then counts as taken.

    Where readings are not explained, they may bend along a step twice as much as their slopes say, so that
    whole steps go to and fro across the mode.  So what a step gains tells how much they bend along it, and
    where that is more than 1.5 times the quadratic model's the next step is as much shorter.  Where pairs of
    one row are ``rivals``, one that is hopeless beside the best of them is left there, unsettled.
    """
    n, m = u.shape
    diagonal, none = np.arange(m), np.full(n, np.inf)
    ended = Found(u.copy(), np.empty((n, m + 1, m + 1)), none.copy(), np.zeros(n, dtype=bool))
    ahead = none.copy()  # what the next step should come to
    state = _Search(
        at=np.arange(n), law=law, sd=sd, trial=u, point=u, cost=none, matrix=ended.matrix, slope=u, bound=u,
        damping=np.full(n, 1e-2), part=none, slope_gain=none, bend=none, stale=ended.settled,
    )  # fmt: skip
    for step in range(SEARCH.most_steps + 1):
        tried = products(pairs.take(state.at), whitener, state.trial, state.sd)
        state = _search_moved(*_refitted(state, tried), step)
        rhs, curved = state.matrix[:, :m, m] - state.slope, state.matrix[:, :m, :m].copy()
        curved[:, diagonal, diagonal] += state.bound
        last = np.linalg.solve(curved, rhs[:, :, None])[:, :, 0]
        decrease = (last * rhs).sum(axis=1)
        settled = (decrease < SEARCH.least_decrease) & ~state.stale
        going_on = ~settled & (state.damping <= 1e9)
        if step == SEARCH.most_steps:
            settled[:], going_on[:] = False, False
        if rivals:
            ahead[state.at] = state.cost - decrease
            going_on &= _hopeful(pairs, step, ahead)[state.at]
        if not going_on.all():
            done = ~going_on
            finished = state.at[done]
            last_move = np.where(settled[done, None], last[done] * state.sd[done], 0.0)
            ended.u[finished] = state.point[done] + last_move
            ended.cost[finished] = state.cost[done] - np.where(settled[done], decrease[done], 0.0)
            ended.matrix[finished], ended.settled[finished] = state.matrix[done], settled[done]
            if done.all():
                break
            state = state.take(going_on)
            curved = curved[going_on]
            rhs = rhs[going_on]
            decrease = decrease[going_on]
            last = last[going_on]
        gain = decrease
        damping_loss = np.zeros(1)
        move = last
        damped = state.damping > SEARCH.no_damping
        if damped.any():
            own_curvature = curved[:, diagonal, diagonal]
            curved[:, diagonal, diagonal] = own_curvature * (1.0 + state.damping[:, None])
            shorter = np.linalg.solve(curved, rhs[:, :, None])[:, :, 0]
            damping_loss = np.where(damped, state.damping * (own_curvature * shorter**2).sum(axis=1), 0.0)
            move = np.where(damped[:, None], shorter, move)
            gain = np.where(damped, (shorter * rhs).sum(axis=1), gain)
        move = move * state.sd
        # no logarithm moves too far
        step_share = np.minimum(
            state.part, SEARCH.longest_step / np.maximum(np.abs(move[:, _CONTACT]).max(axis=1), 1e-300)
        )
        step_share = np.where(state.stale, 0.0, step_share)  # slopes anew before another step
        state = state._replace(
            trial=state.point + step_share[:, None] * move,
            slope_gain=2.0 * step_share * gain,
            bend=step_share * step_share * (gain - damping_loss),
        )
    return ended


def _hopeful(pairs: Pairs, step: int, ahead: Array) -> Mask:
    """Return which pairs are worth another step beside the best of their touch."""
    best = np.full(pairs.data.level.size, np.inf)
    np.minimum.at(best, pairs.row, ahead)
    stated = np.isfinite(pairs.data.t_object)
    limit = np.where(stated, _HOPELESS_STATED[step], _HOPELESS_COST.get(step, np.inf))
    return np.asarray(ahead < (best + limit + SEARCH.unexplained_times * np.maximum(best, 0.0))[pairs.row])


def _refitted(here: _Search, there: Array) -> tuple[_Search, Array, Mask]:
    """Return the trials and their products with level and T_obj, in which readings are linear, at their best:
    these go along with a step in all else, which is larger without bending; and whether other slopes, which
    go with the difference of object and skin, must be pairs for anew."""
    law = here.law
    trial = here.trial.copy()
    lin = there[:, _LEVEL : _T + 1]
    away = ((trial - law.mean) * law.per_sd)[:, _LEVEL : _T + 1]
    a = lin[:, 0, _LEVEL] + 1.0
    d = lin[:, 0, _T]
    b = lin[:, 1, _T] + 1.0
    g, h = lin[:, 0, -1] - away[:, 0], lin[:, 1, -1] - away[:, 1]
    det, before = a * b - d * d, trial[:, _T] - trial[:, _LEVEL]
    level, warmer = (b * g - d * h) / det, (a * h - d * g) / det
    trial[:, _LEVEL] += level * here.sd[:, _LEVEL]
    trial[:, _T] += warmer * here.sd[:, _T]
    gone = level[:, None] * lin[:, 0] + warmer[:, None] * lin[:, 1]
    there[:, -1, -1] += level * gone[:, _LEVEL] + warmer * gone[:, _T] - 2.0 * gone[:, -1]
    there[:, :-1, -1] -= gone[:, :-1]
    there[:, -1, :-1] = there[:, :-1, -1]
    apart = np.abs(before) > 0.1
    grown = (trial[:, _T] - trial[:, _LEVEL]) / np.where(apart, before, np.inf)
    scale = np.empty(there.shape[:2])
    scale[:] = np.where(apart, np.minimum(np.maximum(grown, 0.2), 5.0), 1.0)[:, None]
    scale[:, _LEVEL : _T + 1] = scale[:, -1:] = 1.0
    there *= scale[:, :, None]
    there *= scale[:, None, :]
    out_of_scale = ~apart | (grown < 0.2) | (grown > 5.0)
    stale = out_of_scale & (np.abs(trial[:, _T] - trial[:, _LEVEL] - before) > SEARCH.stale_K)
    return here._replace(trial=trial), there, stale


def _search_moved(here: _Search, there: Array, stale: Mask, step: int) -> _Search:
    """Return where pairs are after they were tried, and how the next steps are made."""
    off = here.law.penalty(here.trial)
    tried, damping = there[:, -1, -1] + off.value, here.damping
    new = here._replace(
        point=here.trial, cost=tried, matrix=there, slope=off.slope, bound=off.bound, stale=stale
    )
    if step == 0:
        return new._replace(damping=0.1 * damping, part=np.ones(tried.size))
    better = (tried < here.cost) | here.stale
    bend = np.where(here.stale, 1.0, np.maximum(here.bend, 1e-300))  # of no step none
    bent = np.where(here.stale, 0.0, (here.slope_gain + tried - here.cost) / bend)
    strongly_bent = bent > SEARCH.far_bent
    damping = np.where(better, np.maximum(damping * 0.1, 1e-9), damping * 10.0)
    damping = np.where(strongly_bent, np.maximum(damping, 0.1 * np.minimum(bent, 1e6)), damping)
    step_share = np.where((bent > SEARCH.bent) & ~strongly_bent, 1.0 / np.maximum(bent, 1.0), 1.0)
    new = new._replace(damping=damping, part=np.where(np.isfinite(tried), step_share, 0.3 * here.part))
    if better.all():
        return new
    row = better[:, None]
    return new._replace(
        point=np.where(row, here.trial, here.point),
        cost=np.where(better, tried, here.cost),
        matrix=np.where(row[:, :, None], there, here.matrix),
        slope=np.where(row, off.slope, here.slope),
        bound=np.where(row, off.bound, here.bound),
        stale=np.where(better, stale, here.stale),
    )


def curvature(matrix: Array, own: Array) -> tuple[Array, Array]:
    """Return the inverse (n, m, m) of the curvatures of ``matrix`` (n, m + 1, m + 1), the priors' ``own`` (n,
    m) added, and the logarithm of their determinants."""
    curved, diagonal = matrix[:, :-1, :-1].copy(), np.arange(own.shape[1])
    curved[:, diagonal, diagonal] += own
    sign, log_det = np.linalg.slogdet(curved)
    if not ((sign > 0.0) & np.isfinite(log_det)).all():  # not every LAPACK notices a NaN
        raise np.linalg.LinAlgError("the curvature of a grasp's posterior is not positive definite")
    inverse = np.linalg.inv(curved)
    return 0.5 * (inverse + inverse.transpose(0, 2, 1)), log_det
