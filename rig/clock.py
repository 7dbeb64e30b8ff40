"""Clocks to hand in where a port, a device or a session needs one.

Nothing in the rig asks the computer's clock of its own accord; it is given ``clock()`` and
``sleep(seconds)``. Hardware gets :func:`time.monotonic` and :func:`time.sleep`; a test gets one of these.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

__all__ = ["BackOff", "Metronome", "ScaledClock", "SteppedClock"]

_LATE_S = 0.5


class SteppedClock:
    """A clock that moves only when somebody sleeps on it, at once.

    Host and virtual device on one stepped clock run a day in minutes, the same way each time.

    Examples
    --------
    >>> clock = SteppedClock()
    >>> clock.sleep(2.5)
    >>> clock()
    2.5
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now, self._lock = start, threading.Lock()

    def __call__(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        """Let so many seconds pass; rounded to a nanosecond, so that sums of tenths stay tenths."""
        with self._lock:
            self._now = round(self._now + max(0.0, seconds), 9)


class ScaledClock:
    """The computer's clock, so many times faster.

    Parameters
    ----------
    speed : float, optional
        Seconds of this clock a second.
    """

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
    """When waits end that follow each other: on a grid, whatever the work between them takes.

    A loop that works 3 ms and then waits 10 ms would sample every 13 ms.  Work of less than the wait itself
    (and than half a second) is taken off the next wait; after more the grid starts anew, and nothing is
    caught up.

    Examples
    --------
    >>> clock = SteppedClock()
    >>> beat = Metronome(clock)
    >>> ends = []
    >>> for work in (0.003, 0.002, 0.0, 3.0):
    ...     clock.sleep(work)
    ...     ends.append(beat.next(0.010))
    ...     clock.sleep(ends[-1] - clock())
    >>> ends
    [0.013, 0.023, 0.033, 3.043]
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._last = -float("inf")

    def next(self, seconds: float) -> float:
        """Return when a wait of so many seconds that begins now is to end."""
        now = self._clock()
        begin = self._last if 0 <= now - self._last < min(seconds, _LATE_S) else now
        self._last = round(begin + seconds, 9)
        return self._last


class BackOff:
    """When something that was lost is to be tried again: ever later, and at once after it was there.

    Examples
    --------
    >>> clock = SteppedClock()
    >>> back_off = BackOff(clock, first=0.1, longest=5.0)
    >>> waits = []
    >>> for _ in range(8):
    ...     assert back_off.due()
    ...     back_off.failed()
    ...     waits.append(round(back_off.next_try - clock(), 3))
    ...     clock.sleep(5.0)
    >>> waits
    [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    """

    def __init__(self, clock: Callable[[], float], *, first: float, longest: float) -> None:
        self._clock, self._first, self._longest = clock, first, longest
        self._wait, self.next_try = first, -float("inf")

    def due(self) -> bool:
        """Say whether it may be tried now."""
        return self._clock() >= self.next_try

    def failed(self) -> None:
        """Wait, and twice as long the next time."""
        self.next_try = self._clock() + self._wait
        self._wait = min(2 * self._wait, self._longest)

    def succeeded(self) -> None:
        """Begin anew."""
        self._wait, self.next_try = self._first, -float("inf")
