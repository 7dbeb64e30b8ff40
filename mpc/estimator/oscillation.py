r"""Loops that swing about their targets, found from readings alone: no model is asked.

Between two crossings of its target an output that swings by a sin(2 pi t / T) has the integrated absolute
error

    IAE = a T / pi,

and the mean error 2 a / pi (T. Haegglund, "A control-loop performance monitor", Control Engineering Practice
3(11), 1995).  A loop swings where half swings, side by turns, follow each other.
"""

from __future__ import annotations

from collections import deque
from math import isfinite, pi
from typing import NamedTuple

NOISE_SD = 3.0  # standard deviations of a reading that are no swing
# White noise of standard deviation s exceeds 18 s / pi in a sum of n <= 3 readings with mean 6 s / pi, all on
# one side, with a probability of 5e-4 at most; six times by turns, with 1e-20.
_SWINGS = 6  # half swings in a row
# the damping ratio is below 0.044
_LAST_TWO = 0.57  # of the IAE of the first two, that the last two must have
_SHORTEST_PERIOD = 6.0  # samples, of a period
# a loop swings with one ultimate period by its delay, and some by its integral; what is slower is a load
_LONGEST_HALF_SWING = 2.5  # ultimate periods, of a half swing


class _Half(NamedTuple):
    side: float  # +1 above, -1 below, 0 before the first
    iae: float
    begin: float  # s
    end: float


class Oscillation:
    """One signal of a loop with an apparent ``delay`` [s], in which swings count from an amplitude on."""

    def __init__(self, dt: float, delay: float, least: float) -> None:
        self._shortest = _SHORTEST_PERIOD * dt
        # the ultimate period of a loop with an apparent delay L, 2 samples at least, is 4 L
        self._longest = _LONGEST_HALF_SWING * 4.0 * max(delay, 2.0 * dt)
        self.least = least
        self.restart()

    def restart(self) -> None:
        """Begin anew, as towards a new target."""
        self._now_s, self._arrived = 0.0, False
        self._halves: deque[_Half] = deque(maxlen=_SWINGS)
        self._open = _Half(0.0, 0.0, 0.0, 0.0)

    @property
    def period(self) -> float:
        """Of the last swings [s]."""
        return 2.0 * (self._halves[-1].begin - self._halves[0].begin) / (_SWINGS - 1)

    @property
    def amplitude(self) -> float:
        """Of the last swings."""
        seconds = sum(half.end - half.begin for half in self._halves)
        return 0.5 * pi * sum(half.iae for half in self._halves) / seconds

    def note(self, error: float, seconds: float) -> bool:
        """Note an error, so many seconds after the last; return whether the signal swings."""
        before_s, self._now_s = self._now_s, self._now_s + seconds
        if isfinite(error):
            side = float(error > 0) - float(error < 0) or self._open.side
            if side != self._open.side:
                half = self._open
                if self._counts(half):
                    # two half swings on one side, which noise cut, are one
                    if self._halves and self._halves[-1].side == half.side:
                        before = self._halves.pop()
                        half = half._replace(iae=before.iae + half.iae, begin=before.begin)
                    self._halves.append(half)
                # one load, or a step, rings out sooner: the approach to a new target does not count
                self._arrived = self._arrived or half.side != 0.0
                self._open = _Half(side, 0.0, before_s, before_s)
            iae = self._open.iae + abs(error) * seconds
            self._open = self._open._replace(iae=iae, end=self._now_s)
            last = self._halves[-1] if self._halves else self._open
            # less than a period of quiet lies between two half swings
            if self._now_s - last.end > 2.0 * (last.end - last.begin) and not self._counts(self._open):
                self._halves.clear()
        if len(self._halves) < _SWINGS:
            return False
        first, second, *_, fifth, sixth = (half.iae for half in self._halves)
        return fifth + sixth >= _LAST_TWO * (first + second)

    def _counts(self, half: _Half) -> bool:
        seconds = half.end - half.begin
        # the IAE of the least amplitude at the shortest period; a slow stray has IAE enough, so that its mean
        # error must be that of this amplitude as well.  Slow disturbances by turns are swings too.
        large = half.iae >= max(self.least * self._shortest / pi, 2.0 / pi * self.least * seconds)
        return self._arrived and large and seconds <= self._longest
