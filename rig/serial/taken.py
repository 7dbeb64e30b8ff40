"""What a device says of the readings that it took by its own clock.

    7 take 118            ->   7 ok 82310 118 121 24,1,2500,31250,30812,25000 14,1,2500,31262,30812,25000 -

are three ticks.  The first has the number 118 and was 24 ms old when the device answered, at 82 310 ms of its
own; for the last one (``-``) the device itself came too late.  121 is the number of the tick that is still to
come.  A reading is its age [ms], pump, drives and temperatures, as in a state.

``take N`` says that everything before N has arrived, so asking again, with the same number of the question or
with another, can lose nothing: what did not fit or did not arrive is in the next answer.  An answer that
begins after N tells how many ticks were overwritten before anybody asked for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from thermogrip.rig.serial.words import integer, integers, join

__all__ = ["LOST", "Kept", "Taken", "parse_taken"]

LOST = ("open", "short")
_HOLE = "-"


@dataclass(frozen=True)
class Kept:
    """One reading of the device's own.

    Attributes
    ----------
    age_ms : int
        How long before the answer it was taken.
    pump : int
    drive : tuple of int
        Applied then [1e-4 of the unit].
    temperatures : tuple of int or str
        Thousandths of a degC, ``open`` or ``short``.
    """

    age_ms: int
    pump: int
    drive: tuple[int, ...]
    temperatures: tuple[int | str, ...]

    def word(self) -> str:
        """Return it as a word of a line."""
        return join((self.age_ms, self.pump, *self.drive, *self.temperatures))


@dataclass(frozen=True)
class Taken:
    """Readings of consecutive ticks.

    Attributes
    ----------
    uptime_ms : int
        The device's clock at the answer, modulo 2**32.
    first : int
        Number of the first tick here, modulo 2**32.
    next : int
        Number of the tick that is still to come; more wait where this answer does not reach it.
    readings : tuple of Kept or None
        None where the device came too late for a tick.

    Examples
    --------
    >>> kept = Kept(4, 1, (2500,), (31250, "open"))
    >>> " ".join(Taken(82310, 118, 120, (kept, None)).words())
    '82310 118 120 4,1,2500,31250,open -'
    """

    uptime_ms: int
    first: int
    next: int
    readings: tuple[Kept | None, ...]

    @property
    def waiting(self) -> int:
        """How many ticks wait on the device after these."""
        return (self.next - self.first - len(self.readings)) % 2**32

    def words(self) -> tuple[str, ...]:
        """Return the words after ``ok``."""
        kept = (_HOLE if reading is None else reading.word() for reading in self.readings)
        return (str(self.uptime_ms), str(self.first), str(self.next), *kept)


def parse_taken(words: Sequence[str], n_drives: int) -> Taken | None:
    """Return what the words after ``ok`` say, None where they make no sense.

    Examples
    --------
    >>> parse_taken("82310 118 119 4,1,2500,31250,open".split(), 1).readings[0].temperatures
    (31250, 'open')
    """
    head = integers(join(words[:3]))
    if head is None or len(words) < 3 or min(head) < 0:
        return None
    uptime_ms, first, to_come = head
    readings = [None if word == _HOLE else _kept(word, n_drives) for word in words[3:]]
    if any(reading is None and word != _HOLE for reading, word in zip(readings, words[3:])):
        return None
    ticks = (to_come - first) % 2**32
    stuck = ticks > 0 and not readings  # would be asked for for ever
    sound = len(readings) <= ticks < 2**31 and not stuck
    return Taken(uptime_ms, first, to_come, tuple(readings)) if sound else None


def _kept(word: str, n_drives: int) -> Kept | None:
    parts = word.split(",")
    numbers = integers(join(parts[: 2 + n_drives]))
    values = [part if part in LOST else integer(part) for part in parts[2 + n_drives :]]
    known = tuple(value for value in values if value is not None)
    if numbers is None or not values or len(known) < len(values):
        return None
    age, pump, *drive = numbers
    return Kept(age, pump, tuple(drive), known) if age >= 0 and pump in (0, 1) else None
