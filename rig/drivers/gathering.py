"""What a device measured by its own clock: which readings have arrived, and when they were, by the host's.

An answer that says "my clock is u" was made between the moment its question was sent and the moment it was
heard, so the host's time less the device's, the offset o, is bounded by each exchange:

    t_sent - u <= o <= t_heard - u.

The offset stays where it is while it agrees with that, else it moves to the nearer bound, as little as will
do.  A slow exchange has wide bounds and moves nothing; a resonator that runs 0.5 % fast is followed; a reset,
or the wrap of the device's clock, moves it at once.  A time is off by no more than the quickest exchange
lately took; how far apart two readings are is the device's own measure.
"""

from __future__ import annotations

from thermogrip.rig.serial.protocol import Kept, Taken

__all__ = ["DeviceClock", "Gathering"]


class DeviceClock:
    """The device's clock, as the host's.

    Examples
    --------
    >>> clock = DeviceClock()
    >>> clock.see(10.000, 10.080, 500)  # an answer that was held up on its way back
    >>> clock.see(10.100, 10.102, 551)
    >>> round(clock.time(551), 3), round(clock.time(551, age_ms=51), 3)
    (10.102, 10.051)
    """

    def __init__(self) -> None:
        self._offset = float("inf")

    def see(self, sent_s: float, heard_s: float, uptime_ms: int) -> None:
        """Take an answer: when it was asked for and when it came [s], and what it says [ms]."""
        low, high = sent_s - (uptime_ms + 1) / 1000, heard_s - uptime_ms / 1000
        self._offset = min(max(self._offset, low), high)

    def time(self, uptime_ms: int, age_ms: int = 0) -> float:
        """Return the host's time of something that was so old at an answer [s]."""
        return self._offset + (uptime_ms - age_ms) / 1000


class Gathering:
    """What has arrived of the readings that a device takes by its own clock.

    Parameters
    ----------
    period_ms : int

    Attributes
    ----------
    number : int
        Of the reading to ask for next.
    lost : int
        Ticks of which no reading will ever come.

    Examples
    --------
    >>> clock, gathering = DeviceClock(), Gathering(10)
    >>> clock.see(0.0, 0.0, 500)
    >>> kept = Kept(20, 0, (0,), (25000,))
    >>> [round(time, 3) for time, _ in gathering.take(Taken(500, 2, 5, (kept,)), clock)]
    [-0.02]
    >>> gathering.number, gathering.lost
    (3, 2)
    """

    def __init__(self, period_ms: int) -> None:
        self.period_ms, self.number, self.lost = period_ms, 0, 0
        self._last: float | None = None
        self._begins_anew = False

    def begin_anew(self) -> None:
        """The device was reset and counts from 0 again."""
        self.number, self._begins_anew = 0, True

    def take(self, taken: Taken, clock: DeviceClock) -> list[tuple[float, Kept]]:
        """Return the readings of an answer with their time [s], which never goes back."""
        lost = (taken.first - self.number) % 2**32 + sum(kept is None for kept in taken.readings)
        there = []
        for kept in taken.readings:
            if kept is None:
                continue
            time = clock.time(taken.uptime_ms, kept.age_ms)
            if self._begins_anew and self._last is not None:
                lost = max(lost, round(1000 * (time - self._last) / self.period_ms) - 1)
            if self._last is not None:
                time = max(time, self._last + 1e-6)  # a quicker exchange may have moved the offset back
            self._begins_anew, self._last = False, time
            there.append((time, kept))
        self.lost += lost
        self.number = (taken.first + len(taken.readings)) % 2**32
        return there
