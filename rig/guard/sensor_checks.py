r"""What one sensor can be caught at without any model: lost, jumping, stuck, or against its twin.

*Lost.*  Open and shorted sensors read as not a number, or as the end of the converter's range.  A reading
that is not finite, or outside what a water loop can be, is not believed; the third in a row trips, for one
spike (a loose plug) must not end a night's work.

*Jump.*  Water cannot change faster than ``rate``; a reading that does is not believed either.  A skin that
touches an object may.

*Stuck.*  A reading that repeats bit for bit has stopped.  How many repeats prove it depends on the noise:
with white noise of standard deviation s about the middle of a quantum q, a healthy sensor repeats itself with

    p = erf(q / (2 sqrt(2) s)),

so n = ln(alpha) / ln(p) repeats are a false alarm with probability alpha.  No test of repeats can be faster
at that alpha; for q = 1/16 K and s = 0.04 K it takes 37 samples at 1e-9, and for a converter of 0.3 K with
the same noise no number of repeats proves anything (the model has to).  q is learnt as the smallest step
seen.

*Against its twin.*  Two sensors of one temperature may differ by ``pair_limit`` for ``pair_s``, no longer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil, erf, isfinite, log, sqrt

from thermogrip.rig.guard.room_sensors import room_sensors
from thermogrip.rig.guard.trip import Trip

__all__ = ["SensorSettings", "SensorWatch", "repeats_needed"]


@dataclass(frozen=True)
class SensorSettings:
    """What a sensor may do.

    Attributes
    ----------
    believable : (float, float)
        Readings outside are not believed [degC].
    rate : float
        Fastest change of water [K/s].
    slack : float
        Noise allowance of a change [K].
    bad_in_a_row : int
        So many readings that cannot be believed trip.
    noise : float
        White noise of a reading, standard deviation [K]; the smallest that is to be expected.
    alpha : float
        Probability that a healthy sensor repeats itself until it counts as stuck.
    pairs : mapping of (str, str) to float
        Sensors of one temperature, and by how much they may differ [K]; ``x`` and ``x_2`` without asking.
    pair_s : float
        For how long they may differ by more [s].
    """

    believable: tuple[float, float] = (-5.0, 75.0)
    rate: float = 5.0
    slack: float = 0.5
    bad_in_a_row: int = 3
    noise: float = 0.04
    alpha: float = 1e-9
    pairs: Mapping[tuple[str, str], float] = field(default_factory=dict)
    pair_limit: float = 4.0
    pair_s: float = 30.0


@dataclass
class _Memory:
    """What is known of one sensor."""

    good: float
    time: float
    bad: int = 0
    same: int = 0
    since: float = 0.0
    last: float = 0.0
    quantum: float = float("inf")
    changes: int = 0


def repeats_needed(quantum: float, noise: float, alpha: float) -> float:
    """Return how many equal readings in a row a healthy sensor gives with probability ``alpha``.

    Examples
    --------
    >>> [repeats_needed(quantum, 0.04, 1e-9) for quantum in (1 / 16, 0.001, 0.322)]
    [37, 10, inf]
    """
    p = erf(quantum / (2 * sqrt(2) * noise))
    needed = log(alpha) / log(p) if 0 < p < 1 else float("inf")
    return max(10, ceil(needed)) if needed < 2000 else float("inf")


class SensorWatch:
    """Watch every sensor of a rig; pure: times are passed in.

    Parameters
    ----------
    settings : SensorSettings, optional

    Examples
    --------
    >>> watch = SensorWatch()
    >>> watch.start(0.0, {"t": 25.0})
    >>> [watch.check(float(k), {"t": float("nan")})[1] for k in (1, 2)]
    [{'t': 'lost'}, {'t': 'lost'}]
    >>> watch.check(3.0, {"t": float("nan")})[2].measured
    'nan degC, 3 readings in a row'
    """

    def __init__(self, settings: SensorSettings | None = None) -> None:
        self.settings = SensorSettings() if settings is None else settings
        self._memory: dict[str, _Memory] = {}
        self._apart: dict[tuple[str, str], float] = {}

    def start(self, time: float, values: Mapping[str, float]) -> None:
        """Forget the past."""
        self._memory = {
            name: _Memory(value if self.plausible(value) else float("nan"), time, since=time, last=value)
            for name, value in values.items()
        }
        self._apart = {}

    def plausible(self, value: float) -> bool:
        """Say whether a value is finite and inside the believable range."""
        low, high = self.settings.believable
        return isfinite(value) and low <= value <= high

    def last_good(self) -> dict[str, float]:
        """Return the newest value that was believed, by sensor."""
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
        doubted: frozenset[str] = frozenset(),
        rooms: frozenset[str] | None = None,
    ) -> tuple[dict[str, float], dict[str, str], Trip | None]:
        """Return what is believed, why the rest is not, and the trip, if any.

        Parameters
        ----------
        time : float
            Of the reading [s].
        values : mapping of str to float
            Readings [degC].
        touching : frozenset of str
            Sensors that may jump now.
        doubted : frozenset of str
            Sensors that the model does not believe.
        rooms : frozenset of str, optional
            Sensors of the room, which may jump, stand still and be lost; by default those called so.
        """
        rooms = room_sensors(values) if rooms is None else rooms
        believed: dict[str, float] = {}
        why: dict[str, str] = {}
        trip: Trip | None = None
        for name, value in values.items():
            memory = self._memory.setdefault(name, _Memory(value, time, since=time, last=value))
            doubt = self._doubt(name, value, time, memory, touching | rooms, doubted)
            if doubt:
                why[name] = doubt
                memory.bad += 1
                if memory.bad >= self.settings.bad_in_a_row and name not in rooms:
                    trip = trip or self._lost(name, value, time, memory, doubt)
            else:
                believed[name] = value
                memory.bad = 0
                stuck = self._stuck(name, value, time, memory)
                trip = trip or (None if name in rooms else stuck)
                memory.good, memory.time = value, time
        return believed, why, trip or self._pairs(time, believed)

    def _doubt(
        self,
        name: str,
        value: float,
        time: float,
        memory: _Memory,
        touching: frozenset[str],
        doubted: frozenset[str],
    ) -> str:
        if not self.plausible(value):
            return "lost"
        allowed = self.settings.rate * max(time - memory.time, 0.0) + self.settings.slack
        jumped = isfinite(memory.good) and abs(value - memory.good) > allowed
        return "jump" if name in doubted or (jumped and name not in touching) else ""

    def _lost(self, name: str, value: float, time: float, memory: _Memory, doubt: str) -> Trip:
        low, high = self.settings.believable
        expected = f"{low:g} to {high:g} degC"
        if doubt == "jump":
            expected = f"near the last good {memory.good:.2f} degC"
        measured = f"{value:g} degC, {memory.bad} readings in a row"
        return Trip(doubt, time, name, expected, measured, figures={"measured": value, "last": memory.good})

    def _stuck(self, name: str, value: float, time: float, memory: _Memory) -> Trip | None:
        if value != memory.last:
            memory.quantum = min(memory.quantum, abs(value - memory.last))
            memory.changes += 1
            memory.same, memory.since, memory.last = 0, time, value
            return None
        memory.same += 1
        if memory.changes < 20:
            return None
        if memory.same < repeats_needed(memory.quantum, self.settings.noise, self.settings.alpha):
            return None
        seconds = time - memory.since
        return Trip(
            "stuck",
            time,
            name,
            f"a change of {memory.quantum:.3g} degC every few readings",
            f"{value:g} degC {memory.same + 1} times in a row, for {seconds:.0f} s",
            figures={"measured": value, "seconds": seconds},
        )

    def _pairs(self, time: float, believed: Mapping[str, float]) -> Trip | None:
        pairs = dict(self.settings.pairs)
        pairs |= {
            (name, f"{name}_2"): self.settings.pair_limit for name in believed if f"{name}_2" in believed
        }
        for (first, second), limit in pairs.items():
            if first not in believed or second not in believed:
                continue
            apart = believed[first] - believed[second]
            if abs(apart) <= limit:
                self._apart.pop((first, second), None)
                continue
            since = self._apart.setdefault((first, second), time)
            if time - since >= self.settings.pair_s:
                return Trip(
                    "disagree",
                    time,
                    f"{first} and {second}",
                    f"within {limit:g} K of each other",
                    f"{believed[first]:.2f} and {believed[second]:.2f} degC for {time - since:.0f} s",
                    figures={"apart": apart},
                )
        return None
