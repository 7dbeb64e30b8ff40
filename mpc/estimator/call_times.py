r"""When a controller is called: the seconds that passed, and whether a move is due.

Estimate, plan and slew limit count each second once, whatever the rate (``docs/explanation/mpc.md``).  A move
is due at the call that is nearest to a sample time after the last one,

    since >= dt - interval / 2,

where ``interval`` is that of the last call, and at once where a target is another one after a sample or more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.interface import number

#: A longer silence than this and the past is unknown [s].
RESTART_S = 30.0
#: Of a sample time: what is nearer than this is the same time.
SAME = 1e-6


class CallTimes:
    """The times of the calls of a controller of sample time ``dt`` [s]: ``seconds`` since the last call (0
    where the reading is ``stale``), ``since`` the last move that a fresh reading led to, ``stood`` since one
    that had other targets than the one before."""

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.reset()

    def reset(self) -> None:
        """Forget all calls."""
        self._time = self._back = math.nan
        self._interval = self.dt
        self._repeats = 0
        self.seconds = self.since = self.stood = self._assumed = self._spent = 0.0
        self._before = 0.0  # seconds of the sample that had passed at a move between two samples
        self._unspent = 0.0  # seconds of its slew limit that the last move left
        self.stale = self.early = False

    def call(self, reading: Mapping[str, float]) -> None:
        """Note a call with this reading."""
        now, before = number(reading, "time_s"), self._time
        self.seconds = 0.0
        self.stale = self.early = False
        if not math.isfinite(now):
            self.seconds, self._time = self.dt, before + self.dt
        elif not math.isfinite(before):
            self.seconds, self._time = self.dt, now
        elif now > before:
            self.seconds, self._time = now - before, now
        elif before - now > RESTART_S and now > self._back:  # never where there is no time gone back to
            # a clock that went back by so much and goes on from there has begun anew
            self.seconds, self._time = now - self._back + self._interval, now
        else:
            self.stale = True
        self._back = now if self.stale else math.nan
        if self.stale:
            # its time has not moved on: it is taken to be as far from the last as calls usually are
            self._repeats += 1
            self._assumed += self._interval
        else:
            self._interval, self._repeats = self.seconds / (1 + self._repeats), 0
            self.since += self.seconds
            self.stood += self.seconds

    def moves(self, *, new_target: bool) -> bool:
        """Return whether this call is to move the drives, where the target is another one or not."""
        # a target that changes at every call is followed at the sample time: it never stood for a sample
        stood = self.stood >= self.dt * (1 - SAME)
        self.early = new_target and stood and not self.stale and not self.due
        moves = self.due or self.early
        if moves and new_target:
            self.stood = 0.0
        return moves

    @property
    def due(self) -> bool:
        """Whether a sample time is over."""
        passed = self.since + (self._assumed - self._spent if self.stale else self._before)
        return passed >= self.dt * (1 - SAME) - 0.5 * self._interval

    @property
    def waited_s(self) -> float:
        """Seconds since the last move, of which none counted at a move before."""
        if self.stale:
            return self.since + self._assumed - self._spent
        return max(self.since - self._spent, min(self.since, self.dt))

    @property
    def slew_s(self) -> float:
        """Seconds for which the slew limit counts: no more than a sample where they are not known."""
        if self.early:  # what the last move left counts: over any T seconds a drive changes by slew (T + dt)
            return min(self.waited_s + self._unspent, self.dt)
        unknown = self.stale or self.seconds > RESTART_S + self.dt
        return min(self.waited_s, self.dt) if unknown else self.waited_s

    def moved(self, used_s: float) -> None:
        """Note that the drives were moved by what the slew limit allows in so many seconds."""
        self._unspent = max(self.slew_s - used_s, 0.0)
        # after a move between two samples the next is due where it was before: there the estimate is on its
        # grid, where no state is interpolated
        self._before = 0.0 if self.stale or self.due else self._before + self.since
        if self.stale:
            self._spent = self.since + self._assumed
        else:
            self.since = self._assumed = self._spent = 0.0


def shifted(plan: Array, samples: float) -> Array:
    """Return what is ahead of a plan (N, n_u) after so many samples, its last row staying; between two
    samples a row is the mean of the drives that were planned for those seconds."""
    whole, rows = math.floor(samples + SAME), np.arange(len(plan))
    if samples - whole <= SAME:
        return np.asarray(plan[np.minimum(rows + whole, len(plan) - 1)], dtype=float)
    return np.column_stack([np.interp(rows + samples, rows, drive) for drive in plan.T])


def opening(plan: Array, samples: float) -> Array:
    """Return the mean drives (n_u,) of a plan (N, n_u) over its first so many samples, at least one: held
    until the next late call, they do to a slow plant what the plan would have done one after the other."""
    if samples <= 1:
        return np.asarray(plan[0])
    shares = np.clip(samples - np.arange(len(plan)), 0.0, 1.0)  # of each sample
    return np.asarray(shares @ plan / shares.sum())
