"""Clocks of ports, devices and sessions.

Nothing in the rig reads the computer's clock of its own accord; it is given ``clock()`` and
``sleep(seconds)``.  Hardware gets :func:`time.monotonic` and :func:`time.sleep`.
"""

from __future__ import annotations

import time
from collections.abc import Callable

_LATE_S = 0.5  # work that took longer than this starts a new grid


class ScaledClock:
    """The computer's clock, ``speed`` times as fast."""

    def __init__(self, speed: float = 1.0) -> None:
        if not speed > 0:
            raise ValueError(f"a clock cannot run {speed:g} times as fast")
        self.speed, self._start = speed, time.monotonic()

    def __call__(self) -> float:
        return (time.monotonic() - self._start) * self.speed

    def sleep(self, seconds: float) -> None:
        """Let so many seconds of this clock pass."""
        time.sleep(max(0.0, seconds) / self.speed)


class Metronome:
    """The ends of consecutive waits, on a grid whatever the work between them takes."""

    def __init__(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        self._clock, self._sleep = clock, sleep
        self._last = -float("inf")

    def wait(self, seconds: float) -> None:
        """Let so many seconds pass, less the work since the last wait."""
        if not seconds >= 0:
            raise ValueError(f"cannot wait {seconds:g} s")
        self._sleep(max(0.0, self.next(seconds) - self._clock()))

    def next(self, seconds: float) -> float:
        """Return when a wait of so many seconds that begins now is to end."""
        now = self._clock()
        # work of less than the wait itself (and than half a second) is taken off the next wait; after more
        # the grid starts anew, and nothing is caught up
        begin = self._last if 0 <= now - self._last < min(seconds, _LATE_S) else now
        self._last = round(begin + seconds, 9)
        return self._last


class BackOff:
    """Retries of what was lost: after ``first`` seconds, then twice as long each time, up to ``longest``."""

    def __init__(self, clock: Callable[[], float], *, first: float, longest: float) -> None:
        self._clock = clock
        self._first = first
        self._longest = longest
        self._wait, self.next_try = first, -float("inf")

    def due(self) -> bool:
        """Say whether a retry is due."""
        return self._clock() >= self.next_try

    def failed(self) -> None:
        """Note a failure: the next retry waits, twice as long each time."""
        self.next_try = self._clock() + self._wait
        self._wait = min(2 * self._wait, self._longest)

    def succeeded(self) -> None:
        """Note a success: the back-off begins anew."""
        self._wait, self.next_try = self._first, -float("inf")
