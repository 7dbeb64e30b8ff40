"""The ring in which a device keeps the readings that it took by its own clock, until the host has them.

Ticks are numbered from 0, one every period.  A tick has a reading, or none if the device itself came too late
for it.  The ring holds the newest; an older one is overwritten, and its number is then missing before the
first, so a loss always shows.  The size is what an Arduino Uno has room for: 120 numbers, of which a reading
takes one for its time and one for each drive and sensor.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from thermogrip.rig.serial.protocol import Kept

__all__ = ["CELLS", "MAX_PERIOD_MS", "MIN_PERIOD_MS", "Ring"]

CELLS = 120
MIN_PERIOD_MS, MAX_PERIOD_MS = 10, 1000
_WRAP = 2**32


@dataclass(frozen=True)
class _Slot:
    """One tick's reading: the clock then [ms], and what is told of it."""

    at_ms: int
    pump: int
    drive: tuple[int, ...]
    temperatures: tuple[int | str, ...]


class Ring:
    """Readings by number; not running before :meth:`start`.

    Parameters
    ----------
    n_numbers : int
        Drives and sensors of the device.

    Examples
    --------
    >>> ring = Ring(4)
    >>> ring.start(10, now_ms=500)
    >>> for now in range(500, 790, 10):
    ...     assert ring.due(now)
    ...     ring.keep(now, 1, (2500,), (31250, 30812, 25000))
    >>> ring.first, ring.next
    (5, 29)
    >>> ring.forget(28), ring.at(0, 785).age_ms
    (True, 5)
    """

    def __init__(self, n_numbers: int) -> None:
        self._slots: deque[_Slot | None] = deque(maxlen=CELLS // (1 + n_numbers))
        self.period_ms, self.first, self._due_ms = 0, 0, 0

    @property
    def next(self) -> int:
        """Number of the tick that is still to come."""
        return (self.first + len(self._slots)) % _WRAP

    @property
    def due_ms(self) -> int | None:
        """When the next tick is, None where none comes."""
        return self._due_ms if self.period_ms else None

    def start(self, period_ms: int, now_ms: int) -> None:
        """Forget everything and take a reading every so many ms from now on; 0 takes none."""
        self._slots.clear()
        self.period_ms, self.first, self._due_ms = period_ms, 0, now_ms

    def due(self, now_ms: int) -> bool:
        """Say whether a reading is to be taken now."""
        return self.period_ms > 0 and (now_ms - self._due_ms) % _WRAP < _WRAP // 2

    def keep(
        self, now_ms: int, pump: int, drive: tuple[int, ...], temperatures: tuple[int | str, ...]
    ) -> None:
        """Keep the reading of the newest tick that is due; those before it have none."""
        late = (now_ms - self._due_ms) % _WRAP // self.period_ms
        for _ in range(self._skip(late)):
            self._push(None)
        self._push(_Slot(now_ms, pump, drive, temperatures))

    def forget(self, number: int) -> bool:
        """Forget everything before this number; False if that has not come yet."""
        ahead = (self.next - number) % _WRAP
        if ahead >= _WRAP // 2:
            return False
        while len(self._slots) > ahead:
            self._slots.popleft()
            self.first = (self.first + 1) % _WRAP
        return True

    def at(self, place: int, now_ms: int) -> Kept | None:
        """Return the reading at a place from the first, with its age; None where the tick has none."""
        slot = self._slots[place]
        if slot is None:
            return None
        age = (now_ms - slot.at_ms) % 2**16  # of the clock only so much is kept
        return Kept(age, slot.pump, slot.drive, slot.temperatures)

    def __len__(self) -> int:
        return len(self._slots)

    def _skip(self, late: int) -> int:
        """Return how many ticks without a reading are worth keeping; the rest only count."""
        most = CELLS  # more than fit
        if late > most:
            self.first = (self.next + late - most) % _WRAP
            self._due_ms += (late - most) * self.period_ms
            self._slots.clear()
        return min(late, most)

    def _push(self, slot: _Slot | None) -> None:
        full = len(self._slots) == self._slots.maxlen
        self.first = (self.first + full) % _WRAP
        self._slots.append(slot)
        self._due_ms += self.period_ms
