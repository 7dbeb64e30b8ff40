"""Search for the mode of a grasp under a hypothesis:
:mod:`thermogrip.sysid.effusivity.laplace_approximation`, many pairs at once.

Each pair takes damped Gauss-Newton steps on the responses of :mod:`thermogrip.sysid.contact.time_stepping`
until the next one would gain less than 0.005 nat; that last step is taken on the quadratic model alone, and
its predicted decrease counted.  What costs is compiled: of one grasp some ten pairs take a step at once, and
NumPy's hundred calls a step cost more than their arithmetic.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.sysid.contact.time_stepping import COMPILED, N_STEPPED, VALUE, Gripper, contacts


class SearchSettings(NamedTuple):  # which kernels take
    """How the search for a mode steps, and when it ends."""

    pairs_at_once: int = 128  # whose arrays stay in the processor's cache
    most_steps: int = 20  # a pair that has not settled by then is hopeless in practice
    longest_step: float = 1.5  # of a logarithm of the contact
    # what even the best leaves unexplained counts more: where none explains the readings yet, as of a
    # late contact, the right one may be that far behind
    unexplained_times: float = 3.0
    bent: float = 1.5  # times the quadratic model's curvature, from which on steps are shorter
    far_bent: float = 4.0  # and from which on they are damped
    first_damping: float = 1e-3
    no_damping: float = 1e-3  # a damping that counts as none
    stale_K: float = 0.01  # that a temperature may move for slopes by the rest to stay
    least_decrease: float = 0.01  # of -2 ln posterior: smaller predicted decreases end the search
    no_part: float = 45.0  # of -2 ln evidence behind the best: e^-22 of a sum


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
    bin_means(nodes[2], rise, slope, wanted, onset, row, data.sample_t, data.sample_bin, data.count, out)
    return out


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def bin_means(
    nodes: Array, rise: Array, slope: Array, wanted: Mask, onset: Array, row: NDArray[np.int64],
    times: Array, bins: NDArray[np.int64], count: Array, means: Array,
) -> None:  # fmt: skip
    """Fill ``means`` (n, 6, n_bin) of the ``wanted`` curves, the last of them the slope of the first."""
    last = nodes.size - 1
    n_curve = wanted.shape[1]
    n_bin = count.shape[1]
    for p in range(row.size):
        i = row[p]
        k = 0
        means[p] = 0.0
        value, rate = rise[p], slope[p]
        for j in range(times.shape[1]):
            since = times[i, j] - onset[p]
            b = bins[i, j]
            if b < 0 or since <= 0.0:  # a sample that is lost, or before contact
                continue
            while k < last - 1 and nodes[k + 1] < since:
                k += 1
            while k > 0 and nodes[k] > since:
                k -= 1
            # cubic Hermite interpolation: the weights of the next value, and of the slopes there and here
            dt = nodes[k + 1] - nodes[k]
            s = min((since - nodes[k]) / dt, 1.0)
            to_next = s * s * (3.0 - 2.0 * s)
            bend, next_bend = s * (1.0 - s) * (1.0 - s) * dt, -s * s * (1.0 - s) * dt
            for c in range(n_curve - 1):
                if wanted[p, c]:
                    high = value[c, k + 1] - value[c, k]
                    means[p, c, b] += (
                        value[c, k] + to_next * high + bend * rate[c, k] + next_bend * rate[c, k + 1]
                    )
            if wanted[p, n_curve - 1]:
                high = (value[VALUE, k + 1] - value[VALUE, k]) / dt
                means[p, n_curve - 1, b] += (
                    6.0 * s * (1.0 - s) * high
                    + (1.0 - s) * (1.0 - 3.0 * s) * rate[VALUE, k]
                    + s * (3.0 * s - 2.0) * rate[VALUE, k + 1]
                )
        for c in range(n_curve):
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


def products(pairs: Pairs, whitener: Array, u: Array, sd: Array, *, alike: bool = False) -> Array:
    """Return J' J, and J' r and r' r in the last row and column, (n, 8, 8): J in units of ``sd`` (n, 7), r
    the readings less those that ``u`` predicts, both whitened.  Where pairs may be ``alike``, of one trace
    and one u, as the grades of a candidate are at first, their readings are predicted once."""
    blocks = []
    for begin in range(0, len(u), SEARCH.pairs_at_once):
        chunk = slice(begin, begin + SEARCH.pairs_at_once)
        some = pairs.take(chunk)
        if alike:
            asked = [pairs.data.trace[some.row], u[chunk], some.beyond.reshape(some.row.size, -1)]
            numbers = np.column_stack(asked)
            keys = numbers.view(f"V{numbers.itemsize * numbers.shape[1]}").ravel().tolist()
            place: dict[bytes, int] = {}
            same = [place.setdefault(key, len(place)) for key in keys]
            first = np.unique(same, return_index=True)[1]
            vary = np.tile((sd[chunk] > 0.0).any(axis=0), (first.size, 1))
            columns = readings(some.take(first), u[chunk][first], vary)[1][same]
        else:
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


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def penalty(w: float, per_dof: float) -> tuple[float, float, float, float]:
    """Return a prior's -2 ln density relative to its peak at ``w`` sds, half its slope there, what bounds its
    curvature from above, so that a step on it cannot overshoot, and the curvature, kept from turning negative
    far out in the tail: of Student's t, of a normal law where ``per_dof`` (1 / degrees of freedom) is 0."""
    if per_dof == 0.0:
        return w * w, w, 1.0, 1.0
    beyond = w * w * per_dof
    bound = (1.0 + per_dof) / (1.0 + beyond)
    value = np.log1p(beyond) * (1.0 + per_dof) / per_dof
    return value, w * bound, bound, max(bound * (1.0 - beyond) / (1.0 + beyond), 1e-3)


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def solve(matrix: Array, right: Array, lower: Array, out: Array) -> float:
    """Fill ``out`` (m,) with the solution of a positive definite system and return its product with the
    ``right`` side; ``lower`` (m, m) is room for L and D of L D L'."""
    m = lower.shape[0]
    for i in range(m):
        out[i] = right[i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k] * lower[k, k]
            lower[i, j] = total if i == j else total / lower[j, j]
        for k in range(i):
            out[i] -= lower[i, k] * out[k]
    for i in range(m - 1, -1, -1):
        out[i] /= lower[i, i]
        for k in range(i + 1, m):
            out[i] -= lower[k, i] * out[k]
    product = 0.0
    for i in range(m):
        product += out[i] * right[i]
    return product


class Law(NamedTuple):
    """Priors of n pairs, (n, 7) each: mean, sd and 1 / degrees of freedom, 0 where these are infinite."""

    mean: Array
    sd: Array
    per_dof: Array


class Search(NamedTuple):
    """Where ``n`` pairs are on their way to the mode: the best point of each, and what to try next."""

    trial: Array  # (n, 7)
    u: Array  # (n, 7), the best point
    matrix: Array  # (n, 8, 8), products there
    slope: Array  # (n, 7), of the prior there, as the next two
    bound: Array  # (n, 7)
    own: Array  # (n, 7)
    cost: Array  # (n,), -2 ln posterior
    ahead: Array  # (n,), what the next step should come to
    log_volume: Array  # (n,), ln det of the curvature at the best point
    damping: Array  # (n,)
    part: Array  # (n,), of the next steps
    slope_gain: Array  # (n,), what the trial's step should gain by its slope, and lose by its bend
    bend: Array  # (n,)
    stale: Mask  # (n,), whether slopes at the best point are those of another temperature
    settled: Mask  # (n,)
    going_on: Mask  # (n,)


def search(pairs: Pairs, noise: tuple[Array, Array], law: Law, start: Array, *, rivals: bool) -> Search:
    """Return where damped Gauss-Newton steps from ``start`` (n, 7) end under priors of a ``law``: where the
    next step would gain less than 0.005 nat, which then counts as taken.

    Where readings are not explained, they may bend along a step twice as much as their slopes say, so that
    whole steps go to and fro across the mode.  So what a step gains tells how much they bend along it, and
    where that is more than 1.5 times the quadratic model's the next step is as much shorter.  Where pairs of
    one question are ``rivals``, one that is hopeless beside the best of them is left there, unsettled;
    ``noise`` is what :func:`~thermogrip.sysid.effusivity.data.whiten` returns.
    """
    n, m = start.shape
    state = Search(
        trial=start.copy(), u=start.copy(), matrix=np.empty((n, m + 1, m + 1)), slope=np.empty((n, m)),
        bound=np.empty((n, m)), own=np.empty((n, m)), cost=np.empty(n), ahead=np.empty(n),
        log_volume=np.empty(n), damping=np.full(n, SEARCH.first_damping), part=np.empty(n),
        slope_gain=np.empty(n), bend=np.empty(n),
        stale=np.zeros(n, dtype=bool), settled=np.zeros(n, dtype=bool), going_on=np.zeros(n, dtype=bool),
    )  # fmt: skip
    # room, as loops: arrays made and copied whole in a kernel take four times as long to compile
    at, room = np.arange(n), np.empty((2 * m + 6, m + 1))
    for step in range(SEARCH.most_steps + 1):
        tried = products(pairs.take(at), noise[0], state.trial[at], law.sd[at], alike=step == 0)
        advance(at, tried, law, state, room, step, SEARCH)
        if rivals:
            state.going_on[at] &= _hopeful(pairs, noise[1][pairs.row], state, step)[at]
        at = at[state.going_on[at]]
        if not at.size:
            break
    return state


def _hopeful(pairs: Pairs, log_det: Array, state: Search, step: int) -> Mask:
    """Return which pairs are worth another step beside the best of their touch, and of their question."""
    best = np.full(pairs.data.level.size, np.inf)
    np.minimum.at(best, pairs.row, state.ahead)
    far, stated = _HOPELESS_COST.get(step, np.inf), np.isfinite(pairs.data.t_object)
    limit = np.where(stated, _HOPELESS_STATED[step], far) + SEARCH.unexplained_times * np.maximum(best, 0.0)
    # of -2 ln evidence the determinant of the noise stays, whatever comes of steps, and that of the
    # posterior's curvature adds to it
    question = pairs.data.question[pairs.row]
    reached = np.full(question.max() + 1, np.inf)
    np.minimum.at(reached, question, state.cost + state.log_volume + log_det)
    no_part = reached[question] + SEARCH.no_part
    may_fall = far + SEARCH.unexplained_times * np.maximum(no_part, 0.0)
    hopeful = log_det + np.maximum(state.ahead - may_fall, 0.0) < no_part
    return np.asarray(hopeful & (state.ahead < (best + limit)[pairs.row]))


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def refitted(there: Array, trial: Array, mean: Array, sd: Array, gone: Array) -> float:
    """Move level and T_obj of a trial, in which readings are linear, and its products to their best, and
    return how far slopes by all else, which go with the difference of object and skin, are from those of
    that difference [K], where it turned or grew much: else they are scaled with it.

    So these two go along with a step in all else, which is larger without bending; ``gone`` (8,) is room.
    """
    m = mean.size
    before = trial[_T] - trial[_LEVEL]
    a, b, d = there[_LEVEL, _LEVEL] + 1.0, there[_T, _T] + 1.0, there[_LEVEL, _T]
    g = there[_LEVEL, m] - ((trial[_LEVEL] - mean[_LEVEL]) / sd[_LEVEL] if sd[_LEVEL] > 0.0 else 0.0)
    h = there[_T, m] - ((trial[_T] - mean[_T]) / sd[_T] if sd[_T] > 0.0 else 0.0)
    level, warmer = (b * g - d * h) / (a * b - d * d), (a * h - d * g) / (a * b - d * d)
    trial[_LEVEL] += level * sd[_LEVEL]
    trial[_T] += warmer * sd[_T]
    for i in range(m + 1):
        gone[i] = level * there[_LEVEL, i] + warmer * there[_T, i]
    there[m, m] += level * gone[_LEVEL] + warmer * gone[_T] - 2.0 * gone[m]
    after = trial[_T] - trial[_LEVEL]
    apart = abs(before) > 0.1
    grown = after / before if apart else np.inf
    scale = min(max(grown, 0.2), 5.0) if apart else 1.0
    for i in range(m):
        there[i, m] -= gone[i]
        there[m, i] = there[i, m]
    for i in range(m):
        if i != _LEVEL and i != _T:
            for j in range(m + 1):
                there[i, j] *= scale
                there[j, i] *= scale
    return 0.0 if 0.2 <= grown <= 5.0 else abs(after - before)


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def advance(
    at: NDArray[np.int64],
    tried: Array,
    law: Law,
    state: Search,
    room: Array,
    step: int,
    settings: SearchSettings,
) -> None:
    """Take up of the pairs ``at`` some rows the products ``tried`` at their trials, and what to try next."""
    m = law.mean.shape[1]
    lower, curved, right, move = room[:m], room[m : 2 * m], room[2 * m], room[2 * m + 1]
    slope, bound, own, gone = room[2 * m + 2], room[2 * m + 3], room[2 * m + 4], room[2 * m + 5]
    for k in range(at.size):
        p = at[k]
        there, trial, mean, sd = tried[k], state.trial[p], law.mean[p], law.sd[p]
        stale = refitted(there, trial, mean, sd, gone) > settings.stale_K
        cost = there[m, m]
        for i in range(m):
            w = (trial[i] - mean[i]) / sd[i] if sd[i] > 0.0 else 0.0
            value, slope[i], bound[i], own[i] = penalty(w, law.per_dof[p, i])
            cost += value
        # whether the trial is better, and how the next steps are made
        better, part = True, 1.0
        if step > 0:
            bent = 0.0
            better = cost < state.cost[p]
            if state.stale[p]:  # of no step none
                better = True
            else:
                bent = (state.slope_gain[p] + cost - state.cost[p]) / max(state.bend[p], 1e-300)
            damping = max(0.1 * state.damping[p], 1e-9) if better else 10.0 * state.damping[p]
            if bent > settings.far_bent:
                damping = max(damping, 0.1 * min(bent, 1e6))
            elif bent > settings.bent:
                part = 1.0 / bent
            state.damping[p] = damping
            if not np.isfinite(cost):
                part = 0.3 * state.part[p]
        state.part[p] = part
        if better:
            state.cost[p], state.stale[p], state.matrix[p, m, m] = cost, stale, there[m, m]
            for i in range(m):
                state.u[p, i], state.matrix[p, i, m] = trial[i], there[i, m]
                state.slope[p, i], state.bound[p, i], state.own[p, i] = slope[i], bound[i], own[i]
                for j in range(m):
                    state.matrix[p, i, j] = there[i, j]
        # the next step, and what it should come to
        matrix, u, damping = state.matrix[p], state.u[p], state.damping[p]
        for i in range(m):
            for j in range(m):
                curved[i, j] = matrix[i, j]
            curved[i, i] += state.bound[p, i]
            right[i] = matrix[i, m] - state.slope[p, i]
        gain, loss = solve(curved, right, lower, move), 0.0
        state.ahead[p], state.log_volume[p] = state.cost[p] - gain, 0.0
        for i in range(m):
            state.log_volume[p] += np.log(lower[i, i])
        last = step == settings.most_steps
        state.settled[p] = gain < settings.least_decrease and not state.stale[p] and not last
        state.going_on[p] = not state.settled[p] and damping <= 1e9 and not last
        if state.settled[p]:
            state.cost[p] = state.ahead[p]
            for i in range(m):
                u[i] += move[i] * sd[i]
                w = (u[i] - mean[i]) / sd[i] if sd[i] > 0.0 else 0.0
                state.own[p, i] = penalty(w, law.per_dof[p, i])[3]
            continue
        if damping > settings.no_damping:
            for i in range(m):
                curved[i, i] *= 1.0 + damping
            gain = solve(curved, right, lower, move)
            for i in range(m):
                loss += damping * curved[i, i] / (1.0 + damping) * move[i] ** 2
        farthest = 1e-300
        for i in _CONTACT:
            farthest = max(farthest, abs(move[i] * sd[i]))
        # no logarithm moves too far; where slopes are stale they are asked for before another step
        share = 0.0 if state.stale[p] else min(part, settings.longest_step / farthest)
        for i in range(m):
            trial[i] = u[i] + share * move[i] * sd[i]
        state.slope_gain[p], state.bend[p] = 2.0 * share * gain, share * share * (gain - loss)


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
