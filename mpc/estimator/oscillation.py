r"""Loops that swing about their targets, found from readings alone: no model is asked.

Between two crossings of its target an output that swings by a sin(2 pi t / T) has the integrated absolute
error

    IAE = a T / pi,

and the mean error 2 a / pi.  After Haegglund [1]_ a half swing counts whose IAE exceeds that of the least
amplitude at the shortest period: 6 samples.  The least amplitude is what the output may overshoot, or
three standard deviations of the noise of its readings.  Besides, the mean error must be that of this
amplitude, for a slow stray has IAE enough, and a half swing of more than 2.5 ultimate periods is none: a
loop swings with one of these by its delay, and with some by its integral, and what takes longer is a load.
The ultimate period of a loop with an apparent delay L (2 samples at least) is 4 L.  A loop swings where six
half swings, side by turns, follow each other with less than a period of quiet between, of which the last has
half the IAE of the first at least: the damping ratio is below 0.044.

* One load, or a step, rings out sooner: the approach to a new target does not count.
* Noise is read off fourth differences of readings, whose variance is 70 times that of white noise, as if of
  the last 30; of a swing of 6 samples a period they show 8 % of its amplitude, of 4 samples 34 %.
* White noise of standard deviation s exceeds 18 s / pi in a sum of n <= 3 readings with mean 6 s / pi, all
  on one side, with a probability of 5e-4 at most; six times by turns, with 1e-20.
* Slow disturbances by turns beyond what is allowed are swings too.

References
----------
.. [1] T. Haegglund, "A control-loop performance monitor", Control Engineering Practice 3(11), 1995.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite, pi, sqrt
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array

SWINGS = 6  # half swings in a row
LAST_SWING = 0.5  # of the IAE of the first, that the last must have
SHORTEST_PERIOD = 6.0  # samples, of a period
_LONGEST = 2.5  # ultimate periods, of a half swing
NOISE_SD = 3.0  # standard deviations of a reading that are no swing
NOISE_READINGS = 30  # of which the noise is the mean
SPIKE_VARIANCES = 10.0  # variances, as much as one value may show


class _Half(NamedTuple):
    side: float  # +1 above, -1 below
    iae: float
    begin: float  # s
    end: float


class Oscillation:
    """One signal whose loop swings in ``shortest`` [s] a period or slower; a half swing lasts ``longest`` [s]
    at most, and ``allowed`` is the amplitude that does not count.

    >>> from math import sin
    >>> signal = Oscillation(shortest=6.0, longest=100.0, allowed=0.3)
    >>> found = [signal.note(sin(0.2 * k), 1.0) for k in range(120)]
    >>> sum(found) > 0, round(signal.amplitude), round(signal.period)
    (True, 1, 31)
    """

    def __init__(self, shortest: float, longest: float, allowed: float) -> None:
        self._shortest, self._longest, self._allowed = shortest, longest, allowed
        self.forget()

    def forget(self) -> None:
        """Begin anew, as with other readings."""
        self._last: tuple[float, ...] = ()  # four values
        self._variance, self._seen = 0.0, 0
        self.restart()

    def restart(self) -> None:
        """Begin anew, as towards a new target; the noise stays."""
        self.now, self._arrived = 0.0, False
        self._halves: list[_Half] = []
        self._open = _Half(0.0, 0.0, 0.0, 0.0)

    def break_off(self) -> None:
        """Forget the last values: the next one is no neighbour of theirs."""
        self._last = ()

    @property
    def least(self) -> float:
        """Amplitude from which on a swing counts."""
        return max(self._allowed, NOISE_SD * sqrt(self._variance))

    @property
    def period(self) -> float:
        """Of the last swings [s]."""
        halves = self._counted()[-SWINGS:]
        n = len(halves)
        return 2.0 * (halves[-1].begin - halves[0].begin) / (n - 1) if n > 1 else inf

    @property
    def amplitude(self) -> float:
        """Of the last swings."""
        halves = self._counted()[-SWINGS:]
        seconds = sum(half.end - half.begin for half in halves)
        return 0.5 * pi * sum(half.iae for half in halves) / seconds if halves else 0.0

    def note(self, error: float, seconds: float, value: float | None = None) -> bool:
        """Note an error, so many seconds after the last, of which the noise is that of ``value``; return
        whether the signal swings."""
        self.now += seconds
        if not isfinite(error):
            self.break_off()
            return self._swings()
        self._note_noise(error if value is None else value)
        side = float(error > 0) - float(error < 0) or self._open.side
        if side != self._open.side:
            self._close(side, self.now - seconds)
        half = self._open
        self._open = half._replace(iae=half.iae + abs(error) * seconds, end=self.now)
        counted = self._counted()
        if counted and self.now - counted[-1].end > 2.0 * (counted[-1].end - counted[-1].begin):
            self._halves.clear()
        return self._swings()

    def _note_noise(self, value: float) -> None:
        if len(self._last) == 4:
            self._seen = min(self._seen + 1, NOISE_READINGS)
            a, b, c, d = self._last
            fourth = a - 4.0 * b + 6.0 * c - 4.0 * d + value
            known = self._seen == NOISE_READINGS
            most = max(known * SPIKE_VARIANCES * self._variance, self._allowed * self._allowed)
            self._variance += (min(fourth * fourth / 70.0, most) - self._variance) / self._seen
        self._last = (*self._last[-3:], value)

    def _close(self, side: float, begin: float) -> None:
        """Keep the half swing that ends where it counts, and begin one on this side."""
        self._halves = self._counted()[-SWINGS:]
        self._arrived = self._arrived or self._open.side != 0.0
        self._open = _Half(side, 0.0, begin, begin)

    def _counted(self) -> list[_Half]:
        """Return the half swings until now, the open one too where it counts already; two on one side, which
        noise cuts, are one."""
        half, least = self._open, self.least
        seconds = half.end - half.begin
        counts = half.iae >= least * self._shortest / pi and half.iae >= 2.0 / pi * least * seconds
        if not (counts and self._arrived and seconds <= self._longest):
            return self._halves
        if self._halves and self._halves[-1].side == half.side:
            before = self._halves[-1]
            return [*self._halves[:-1], half._replace(iae=before.iae + half.iae, begin=before.begin)]
        return [*self._halves, half]

    def _swings(self) -> bool:
        """Return whether it swings: by the half swing that is open, or before it."""
        both = self._counted()[-SWINGS:], self._halves[-SWINGS:]
        return any(len(last) == SWINGS and last[-1].iae >= LAST_SWING * last[0].iae for last in both)


def longest_half_swings(delays: Sequence[float], dt: float) -> list[float]:
    """Return how long half swings of outputs may last whose apparent ``delays`` these are [s]."""
    return [_LONGEST * 4.0 * max(delay, 2.0 * dt) for delay in delays]


class OscillationMonitor:
    """Controlled outputs, ``names``, whose loops have apparent ``delays`` [s] and may be ``allowed`` (n,) off
    their targets."""

    def __init__(
        self, names: Sequence[str], dt: float, delays: Sequence[float], allowed: Sequence[float]
    ) -> None:
        self.names = tuple(names)
        longest = longest_half_swings(delays, dt)
        self._signals = [
            Oscillation(SHORTEST_PERIOD * dt, *both) for both in zip(longest, allowed, strict=True)
        ]
        self._target: list[float] = []

    @property
    def least(self) -> Array:
        """Amplitudes (n,) from which on swings count."""
        return np.array([signal.least for signal in self._signals])

    def forget(self) -> None:
        """Begin anew, as with other readings."""
        self._target = []
        for signal in self._signals:
            signal.forget()

    def note(self, y: Array, target: Array, seconds: float, zone: Sequence[float] | None = None) -> str:
        """Note readings y and targets (n,), so many seconds after the last; return which output swings."""
        goals = target.tolist()
        if goals != self._target:
            self._target = goals
            for signal in self._signals:
                signal.restart()
        said, most = "", 0.0
        for i, (signal, value, goal) in enumerate(zip(self._signals, y.tolist(), goals)):
            error = value - goal
            if zone is not None and zone[i] > 0 and isfinite(error):
                error = max(0.0, abs(error) - zone[i]) * (1.0 if error > 0 else -1.0)
            if signal.note(error, seconds, value) and signal.amplitude / signal.least > most:
                most = signal.amplitude / signal.least
                said = (
                    f"{self.names[i]} swings about its target by {signal.amplitude:.2g} with a period of "
                    f"about {signal.period:.2g} s: the plant is not the model, its valve or relay sticks, "
                    "or a load comes and goes"
                )
        return said
