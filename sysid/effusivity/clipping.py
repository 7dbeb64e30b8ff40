r"""Readings at the end of a sensor's range say "at least this much", and no more.

A skin that is pulled past the last reading of its sensor goes on moving; its trace stands still.  Taken for a
temperature such a stretch tells of a heat flow that stopped, which no contact does: a gripper and an object
come to terms ever slower, as :math:`1 / \sqrt t` at first and exponentially in the end.  So a trace has
**stopped dead** at its highest or lowest reading where it stays for 2 s or more, and

- had moved by more than five of its steps in the second before it got there (an exponential that does this
  and then stays within one step for two seconds has a time constant below 0.6 s: no block has), or
- jitters over three of its steps or more before contact, and not at all for 30 samples there (normal jitter
  of half a step stays in one of its steps for so long once in 100 000 traces).

Where no reading of the record lies beyond, that is the rail of the sensor, and the samples at it are clipped
in every grasp of the record, with those between the first and the last of them: jitter that dips below a
rail is half a jitter.  Of a trace that others pass, the sensor stuck, and its own stretch is clipped alone.

The engine leaves clipped samples out as it leaves out lost ones.  Which samples those are depends on the
readings, and "at least this much" is not used: answers are a little less sure than they could be.

A **spike** (a bus that answered 85 or -127 degC, or 0 for a lost reading) is no reading either: one to three
samples that a trace leaves for and comes back from, by the rule of :mod:`thermogrip.datasets.repair`, or with
which it begins or ends, a leap of 10 K away from the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.repair import SPIKE_FLOOR_K, SPIKE_LENGTH, find_spikes
from thermogrip.datasets.schema import Grasps

__all__ = ["LEAP", "clipped_from", "clipped_samples", "in_range", "spiked_samples", "unread_samples"]
__all__ += ["begins_to_clip", "without_spikes"]

Floats = NDArray[np.float64]

#: No skin moves by so much from one reading to the next [K].
LEAP = 10.0

_STAYS, _MOVING = 2.0, 1.0  # s
_BEGINS = 0.3  # s
_STEPS = 5  # of the trace, in the second before it stops
_FINEST = 1e-3  # K: no thermometer's step is smaller
_SILENT = 30  # samples
_BEFORE = -0.25  # s


def clipped_samples(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which samples stand at the end of their sensor's range, shape (n_grasp, n_time).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8])
    >>> int(clipped_samples(grasps).sum())
    0
    >>> low = grasps.assign(t_surface=np.maximum(grasps["t_surface"], 41.0))
    >>> bool((clipped_samples(low) == (low["t_surface"].values == 41.0)).all())
    True
    """
    return _clipped(grasps, spiked_samples(grasps))


def spiked_samples(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which samples are spikes, shape (n_grasp, n_time).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8])
    >>> grasps["t_surface"][1, 60] = -127.0
    >>> np.argwhere(spiked_samples(grasps)).tolist()
    [[1, 60]]
    """
    data = np.asarray(grasps.variables["t_surface"].values, dtype=float)
    spiked = np.zeros(data.shape, dtype=bool)
    jumps = np.diff(data, axis=1)
    # a contact moves one way, or there and back slowly: only few traces need a closer look
    both_ways = (jumps > SPIKE_FLOOR_K).any(axis=1) & (jumps < -SPIKE_FLOOR_K).any(axis=1)
    for i in np.flatnonzero(both_ways):
        moves = np.abs(jumps[i])
        step = float(moves[moves > 0].min())  # a coarse sensor flickers by one of them
        spiked[i] = find_spikes(data[i], floor=max(SPIKE_FLOOR_K, 2.5 * step))
    for i in np.flatnonzero((np.abs(jumps) > LEAP).any(axis=1)):
        _mark_ends(data[i], spiked[i])
    return spiked


def unread_samples(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which samples are no readings, clipped or spikes, shape (n_grasp, n_time)."""
    spiked = spiked_samples(grasps)
    return np.asarray(spiked | _clipped(grasps, spiked))


def in_range(grasps: Grasps) -> Grasps:
    """Return the record with what is no reading lost (NaN); the record itself where all are."""
    return _without(grasps, unread_samples(grasps))


def without_spikes(grasps: Grasps) -> Grasps:
    """Return the record with its spikes lost (NaN); the record itself where there are none."""
    return _without(grasps, spiked_samples(grasps))


def clipped_from(grasps: Grasps) -> tuple[Floats, Floats]:
    """Return when each grasp first reads the end of its range [s], and what that is [degC]; NaN if never."""
    clipped = clipped_samples(grasps)
    at, row = clipped.argmax(axis=1), np.arange(len(clipped))
    ever = clipped.any(axis=1)
    when = np.where(ever, grasps["time"].values[at], np.nan)
    return when, np.where(ever, grasps["t_surface"].values[row, at], np.nan)


def begins_to_clip(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps have stood still for 0.3 s after full motion: it is too early to tell why, (n,).

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> skin = [23.0, 23.1, 25.0, 27.0, 28.0, 28.0, 28.0, 28.0]
    >>> begins_to_clip(make_grasps([-2.0, -1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [skin], ["g0"]))
    array([ True])
    """
    time = np.asarray(grasps["time"].values, dtype=float)
    data = np.where(spiked_samples(grasps), np.nan, grasps["t_surface"].values)
    stands = np.zeros(len(data), dtype=bool)
    for i, row in enumerate(data):
        seen = row[np.isfinite(row)]
        for sign in (1.0, -1.0):
            top = float(sign * seen[-1])
            if top == (sign * seen).max():
                stands[i] |= _stops_dead(time, sign * row, top, _BEGINS)
    return stands


def _mark_ends(row: Floats, spiked: NDArray[np.bool_]) -> None:
    """Mark the few samples at either end that lie a leap away from the rest, in place."""
    seen = np.flatnonzero(np.isfinite(row))
    for order in (seen, seen[::-1]):
        leaps = np.flatnonzero(np.abs(np.diff(row[order[: SPIKE_LENGTH + 1]])) > LEAP)
        if leaps.size and seen.size > 2 * SPIKE_LENGTH:
            spiked[order[: leaps[-1] + 1]] = True


def _without(grasps: Grasps, samples: NDArray[np.bool_]) -> Grasps:
    return grasps.assign(t_surface=grasps["t_surface"].where(~samples)) if samples.any() else grasps


def _clipped(grasps: Grasps, spiked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    time = np.asarray(grasps.variables["time"].values, dtype=float)
    data = np.where(spiked, np.nan, grasps.variables["t_surface"].values)
    clipped = np.zeros(data.shape, dtype=bool)
    for sign in (1.0, -1.0):
        _clip_above(time, sign * data, clipped)
    return clipped


def _clip_above(time: Floats, data: Floats, clipped: NDArray[np.bool_]) -> None:
    """Mark the samples at an upper end in place."""
    top = np.max(data, axis=1, initial=-np.inf, where=np.isfinite(data))
    at_top = data == top[:, None]
    # seconds at the top are needed: most traces have none, and cost nothing more
    often = (at_top & (time > 0)).sum(axis=1) > 2
    dead = [i for i in np.flatnonzero(often) if _stops_dead(time, data[i], float(top[i]))]
    for i in dead:
        if top[i] < top.max():
            _mark(at_top[i], clipped[i])
    if any(top[i] == top.max() for i in dead):
        for i in np.flatnonzero(top == top.max()):
            _mark(at_top[i], clipped[i])


def _mark(at_end: NDArray[np.bool_], clipped: NDArray[np.bool_]) -> None:
    first, last = np.flatnonzero(at_end)[[0, -1]]
    clipped[first : last + 1] = True


def _stops_dead(time: Floats, row: Floats, top: float, stays_for: float = _STAYS) -> bool:
    """Return whether a trace gets to its highest reading in full motion, or falls silent there."""
    seen = np.isfinite(row)
    t, y = time[seen], row[seen]
    there = (y == top) & (t > 0)
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    runs = edges.reshape(-1, 2)  # from, to (one past the last)
    n, seconds = runs[:, 1] - runs[:, 0], t[runs[:, 1] - 1] - t[runs[:, 0]]
    stays = seconds >= stays_for - 1e-9
    if not stays.any():
        return False
    moves = np.abs(np.diff(y))
    step = max(float(moves[moves > 0].min(initial=np.inf)), _FINEST)
    first = runs[0, 0]
    if y[first] - np.interp(t[first] - _MOVING, t, y) > _STEPS * step:
        return True
    before = y[t < _BEFORE]
    jitter = np.diff(before)
    # two readings in turn are a quiet sensor between two steps
    jitters = min((jitter > 0).sum(), (jitter < 0).sum()) > 1 and np.unique(before).size > 2
    return bool(jitters and (n[stays] >= _SILENT).any())
