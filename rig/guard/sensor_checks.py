r"""Faults of a single sensor that show without any model: lost, jumping, stuck, or apart from its pair.

The room's sensors are excepted: losing one is no reason to stop, and no limit holds for it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import ceil, erf, exp, isfinite, log, sqrt
from typing import NamedTuple

from thermogrip.datasets.roles import guess_role
from thermogrip.rig.guard.settings import SensorSettings
from thermogrip.rig.guard.trip import Trip
from thermogrip.sysid.plant.plant import Plant


@dataclass
class _Memory:
    """What is known of one sensor."""

    good: float
    time: float  # of ``good`` [s]
    bad: int = 0  # suspect readings in a row
    lost_share: float = 0.0  # of the last minute
    same: int = 0
    since: float = 0.0
    last: float = 0.0
    quantum: float = float("inf")
    changes: int = 0


def room_disturbances(plant: Plant) -> tuple[str, ...]:
    """Return the disturbances of a plant that are temperatures, in its order."""
    return tuple(name for name in plant.disturbances if plant.units.get(name, "degC") == "degC")


def room_sensors(
    names: Collection[str],
    plant: Plant | None = None,
    *,
    stated: Collection[str] | None = None,
    outputs: Collection[str] = (),
) -> frozenset[str]:
    """Return those of a rig's sensors that read the room; an output never does, whatever its name; sensors
    that the plant does not know are the room's where they are ``stated`` or, without a statement, called
    so."""
    known_signals: set[str] = set(outputs)
    rooms: set[str] = set()
    if plant is not None:
        rooms = set(room_disturbances(plant))
        known_signals |= {*plant.outputs, *plant.inputs, *plant.disturbances}
    unknown = set(names) - known_signals
    if stated is None:
        rooms |= {name for name in unknown if guess_role(name, "degC") == "disturbance"}
    else:
        rooms |= unknown.intersection(stated)
    return frozenset(rooms.intersection(names).difference(outputs))


def repeats_needed(quantum: float, noise: float, alpha: float) -> float:
    """Return the equal readings in a row (10 or more) that a healthy sensor gives with chance ``alpha``."""
    # white noise about the middle of a quantum stays in it with probability p, n times in a row with p^n.
    # For 1/16 K and 0.04 K that takes 37 samples at 1e-9; for a converter of 0.3 K no number proves anything
    p = erf(quantum / (2 * sqrt(2) * noise))
    needed = log(alpha) / log(p) if 0 < p < 1 else float("inf")
    return max(10, ceil(needed)) if needed < 2000 else float("inf")


class CheckedReadings(NamedTuple):
    """What the checks say of one sample."""

    accepted: dict[str, float]
    suspect: dict[str, str]  # why the others are
    trip: Trip | None


class SensorMonitor:
    """Check every sensor of a rig; pure: times are passed in."""

    def __init__(self, settings: SensorSettings | None = None) -> None:
        self.settings = SensorSettings() if settings is None else settings
        self._memory: dict[str, _Memory] = {}
        self._apart_since: dict[str, float] = {}
        self._seen = 0.0  # time of the newest readings [s]

    def start(self, time: float, values: Mapping[str, float]) -> None:
        """Forget the past."""
        self._memory = {
            name: _Memory(value if self.plausible(value) else float("nan"), time, since=time, last=value)
            for name, value in values.items()
        }
        self._seen = time
        self._apart_since = {}

    def plausible(self, value: float) -> bool:
        """Say whether a value [degC] is finite and inside the plausible range."""
        low, high = self.settings.believable_degC
        return isfinite(value) and low <= value <= high

    def last_good(self) -> dict[str, float]:
        """Return the newest accepted value [degC], by sensor."""
        return {name: memory.good for name, memory in self._memory.items() if isfinite(memory.good)}

    def same_for(self, name: str) -> tuple[int, float]:
        """Return how often a sensor has repeated itself, and for how long [s]."""
        memory = self._memory.get(name)
        return (0, 0.0) if memory is None else (memory.same, max(0.0, memory.time - memory.since))

    def check(
        self,
        time: float,
        values: Mapping[str, float],
        *,
        touching: frozenset[str] = frozenset(),
        jumped: frozenset[str] = frozenset(),
        rooms: frozenset[str] = frozenset(),
    ) -> CheckedReadings:
        """Return which readings are accepted, and the trip, if any.

        Those ``touching`` may jump, others have ``jumped`` against the model; ``rooms`` may be lost, too.
        """
        accepted: dict[str, float] = {}
        suspect: dict[str, str] = {}
        trip: Trip | None = None
        newer = 1 - exp((self._seen - time) / self.settings.lost_s)
        self._seen = time
        for name, value in values.items():
            memory = self._memory.setdefault(name, _Memory(value, time, since=time, last=value))
            # one spike (a loose plug) must not end a night's work: three in a row trip, and a quarter of the
            # time without a good reading (three in a row come every 84 readings then anyway)
            memory.lost_share += newer * ((memory.bad > 0) - memory.lost_share)
            # water cannot change faster; a skin that touches an object may
            allowed = self.settings.rate_K_per_s * max(time - memory.time, 0.0) + self.settings.slack_K
            jump = (
                isfinite(memory.good) and abs(value - memory.good) > allowed and name not in touching | rooms
            )
            why = "lost" if not self.plausible(value) else "jump" if jump or name in jumped else ""
            if why:
                suspect[name] = why
                memory.bad += 1
                often = (
                    memory.bad >= self.settings.bad_in_a_row or memory.lost_share >= self.settings.lost_share
                )
                if often and name not in rooms:
                    trip = trip or self._lost(name, value, time, memory, why)
            else:
                accepted[name] = value
                memory.bad = 0
                stuck = self._stuck(name, value, time, memory)
                trip = trip or (None if name in rooms else stuck)
                memory.good, memory.time = value, time
        return CheckedReadings(accepted, suspect, trip or self._pairs(time, accepted))

    def _lost(self, name: str, value: float, time: float, memory: _Memory, why: str) -> Trip:
        low, high = self.settings.believable_degC
        expected = f"{low:g} to {high:g} degC"
        if why == "jump":
            expected = f"near the last good {memory.good:.2f} degC"
        measured = f"{value:g} degC, {memory.bad} readings in a row"
        if memory.bad < self.settings.bad_in_a_row:
            measured = f"{value:g} degC, and suspect for {memory.lost_share:.0%} of the last minute"
        return Trip(why, time, name, expected, measured)

    def _stuck(self, name: str, value: float, time: float, memory: _Memory) -> Trip | None:
        if value != memory.last:
            memory.quantum = min(memory.quantum, abs(value - memory.last))
            memory.changes += 1
            memory.same = 0
            memory.since = time
            memory.last = value
            return None
        memory.same += 1
        needed = repeats_needed(memory.quantum, self.settings.noise_K, self.settings.alpha)
        if memory.changes < 20 or memory.same < needed:
            return None
        seconds = time - memory.since
        expected = f"a change of {memory.quantum:.3g} degC every few readings"
        measured = f"{value:g} degC {memory.same + 1} times in a row, for {seconds:.0f} s"
        return Trip("stuck", time, name, expected, measured)

    def _pairs(self, time: float, accepted: Mapping[str, float]) -> Trip | None:
        limit = self.settings.pair_limit_K
        for name in accepted:
            twin = f"{name}_2"
            if twin not in accepted:
                continue
            apart = accepted[name] - accepted[twin]
            if abs(apart) <= limit:
                self._apart_since.pop(name, None)
                continue
            seconds = time - self._apart_since.setdefault(name, time)
            if seconds >= self.settings.pair_s:
                measured = f"{accepted[name]:.2f} and {accepted[twin]:.2f} degC for {seconds:.0f} s"
                expected = f"within {limit:g} K of each other"
                return Trip("disagree", time, f"{name} and {twin}", expected, measured)
        return None
