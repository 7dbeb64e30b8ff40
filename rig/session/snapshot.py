"""What a session shows of itself at each look, and what an operator may ask of it meanwhile.

The loop waits for nobody: a listener returns at once, and one that raises gets nothing more.  A snapshot
stands alone, so that whoever missed some shows the present all the same.

A stop of an :class:`Operator` is a trip of the guard, a mark is an event.  Neither is an emergency stop: a
loop that hangs looks at nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import Event


@dataclass(frozen=True)
class Snapshot:
    """A running session at one sample."""

    time_s: float  # the rig's clock
    phase: str  # one of the loop's phases
    left_s: float  # until the phase ends at the latest
    dt: float  # until the next sample [s]
    skin: str  # the sensor that touches; on a rig that has none its first
    values: Mapping[str, float]  # readings by sensor [degC], NaN where one is lost
    target: Mapping[str, float]  # by output [degC]; empty where nothing is regulated
    band: float  # within which a target counts as reached [K]
    drive: Mapping[str, float]  # applied from now on, by input
    units: Mapping[str, str]  # of the drives
    pump: int | None  # None where there is none
    margin: float  # of the sensor that is nearest to its limit [K]
    nearest: str  # that sensor
    model_share: float  # largest deviation from the plant, of what is allowed; NaN where there is no plant
    expires_s: float  # how long a drive outlives this program [s]; infinite where nothing ends it
    events: tuple[Event, ...] = ()  # the last ones, newest last
    trip: Trip | None = None
    verdict: str = ""  # empty while it runs


Listener: TypeAlias = Callable[[Snapshot], None]


MOST_MARKS = 20  # of one session: reasons that a person may give for a trial


class Operator:
    """Requests to a running session, made from any thread."""

    def __init__(self) -> None:
        self.stop_asked = ""  # by whom; empty where nobody did
        self._bad: deque[str] = deque(maxlen=MOST_MARKS)

    def stop(self, by: str) -> None:
        """Ask the guard to end the session at the next look; one that is asked for stays asked for."""
        self.stop_asked = by

    def mark_bad(self, why: str) -> None:
        """Mark the trial that runs as bad; it goes on."""
        self._bad.append(why)

    def take_bad(self) -> list[str]:
        """Return the marks since the last call."""
        return [self._bad.popleft() for _ in range(len(self._bad))]
