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
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Grasps

__all__ = ["clipped_from", "clipped_samples", "in_range"]

_STAYS, _MOVING = 2.0, 1.0  # s
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
    time = np.asarray(grasps["time"].values, dtype=float)
    data = np.asarray(grasps["t_surface"].values, dtype=float)
    clipped = np.zeros(data.shape, dtype=bool)
    for sign in (1.0, -1.0):
        _clip_above(time, sign * data, clipped)
    return clipped


def in_range(grasps: Grasps) -> Grasps:
    """Return the record with its clipped samples lost (NaN); the record itself where there are none."""
    clipped = clipped_samples(grasps)
    return grasps.assign(t_surface=grasps["t_surface"].where(~clipped)) if clipped.any() else grasps


def clipped_from(grasps: Grasps) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when each grasp first reads the end of its range [s], and what that is [degC]; NaN if never."""
    clipped = clipped_samples(grasps)
    at, row = clipped.argmax(axis=1), np.arange(len(clipped))
    ever = clipped.any(axis=1)
    when = np.where(ever, grasps["time"].values[at], np.nan)
    return when, np.where(ever, grasps["t_surface"].values[row, at], np.nan)


def _clip_above(time: NDArray[np.float64], data: NDArray[np.float64], clipped: NDArray[np.bool_]) -> None:
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


def _stops_dead(time: NDArray[np.float64], row: NDArray[np.float64], top: float) -> bool:
    """Return whether a trace gets to its highest reading in full motion, or falls silent there."""
    seen = np.isfinite(row)
    t, y = time[seen], row[seen]
    there = (y == top) & (t > 0)
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    runs = edges.reshape(-1, 2)  # from, to (one past the last)
    n, seconds = runs[:, 1] - runs[:, 0], t[runs[:, 1] - 1] - t[runs[:, 0]]
    stays = seconds >= _STAYS - 1e-9
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
