"""The guard: checks every reading and every move, and ends a session that is not safe any more.

It asks, in this order:

    time      was the drive renewed in time, do readings keep up with our clock?  (frozen, stale, clock)
    driver    does the rig apply what was asked?  (driver, device)
    sensors   is each reading plausible?  (lost, jump, stuck, disagree)
    limits    is everything inside its limits?  (limit)
    model     does the rig follow its model or, without one, the rule below?  (model, stuck, driver, drift)
    operator  has somebody asked to stop?  (operator)

and of a move, before it goes out: is it finite, and does it pump heat into standing water?  (drive,
interlock)
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from thermogrip.datasets.errors import UserError
from thermogrip.rig.guard.model_checks import ModelMonitor, Residual
from thermogrip.rig.guard.sensor_checks import SensorMonitor, room_disturbances, room_sensors
from thermogrip.rig.guard.settings import GuardSettings, RuleSettings
from thermogrip.rig.guard.trip import KINDS, Trip
from thermogrip.rig.interface import Reading, range_of
from thermogrip.sysid.plant.plant import Plant

#: A limit is not exceeded by more than this before power is off [K].
# It trips on the second accepted reading beyond it: a rig that changes by at most r K/s is then at most
# 2 r LOOK_S beyond, and three times its noise, 0.35 K + 0.1 K for a TCLab at full power.  What is in a heater
# by then still comes: the same TCLab goes on by 1.3 K from 40 degC (docs/reference/faults.md has more).
LIMIT_MARGIN = 2.0


class RuleMonitor:
    """Apply the rule that needs no model; pure: times are passed in."""

    def __init__(self, settings: RuleSettings | None = None) -> None:
        self.settings = RuleSettings() if settings is None else settings
        self.start()

    def start(self) -> None:
        """Forget the past."""
        self._ranges: dict[str, tuple[float, float]] = {}  # of each output in this session [degC]
        self._time = self._begun = float("nan")
        self._energy = 0.0  # since it was ``_begun``
        self._since = dict(self._ranges)
        self._moved: dict[str, tuple[float, float]] = {}  # largest rise and fall since then [K]

    def check(self, time: float, drive: float, accepted: Mapping[str, float], *, room: float) -> Trip | None:
        """Return the trip, if any; ``drive`` is what was applied since the last call, -1...1 of its range,
        positive heats; temperatures are in degC."""
        passed = time - self._time if isfinite(self._time) else 0.0
        self._time = time
        if not isfinite(self._begun) or drive * self._energy < 0:
            self._begin(time, accepted)
        self._energy += drive * passed
        for name, value in accepted.items():
            for ranges in (self._ranges, self._since):
                low, high = ranges.get(name, (value, value))
                ranges[name] = min(low, value), max(high, value)
            (low, high), (rise, fall) = self._since[name], self._moved.get(name, (0.0, 0.0))
            self._moved[name] = max(rise, value - low), max(fall, high - value)
        if not accepted or abs(self._energy) < self.settings.full_drive_s:
            return None
        trip = self._no_answer(time, accepted, room)
        self._begin(time, accepted)
        return trip

    def _begin(self, time: float, accepted: Mapping[str, float]) -> None:
        self._begun, self._energy = time, 0.0
        self._since = {name: (value, value) for name, value in accepted.items()}
        self._moved = {}

    def _no_answer(self, time: float, outputs: Mapping[str, float], room: float) -> Trip | None:
        # the rule of 3-D printers (Klipper's ``verify_heater``, Marlin's ``WATCH_TEMP``), with a sign,
        # because a Peltier drive does both, and by energy, because what heats slowly burns as well:
        # the drive has come to ``full_drive_s`` without a change of sign: an output must have moved by
        # ``least_K`` with it, or one must stand where such a drive holds it, on its side of the room,
        #     |T - T_room| >= far_K min(1, 2 |mean drive|) - least_K
        # by ``least_K`` sensors may disagree as well: a drive that holds no more than that is not judged
        s, seconds = self.settings, time - self._begun
        mean = self._energy / seconds
        heats, holds = mean > 0, s.far_K * min(1.0, 2 * abs(mean))
        with_drive, against = {}, {}
        for name in outputs:
            rise, fall = self._moved[name]
            with_drive[name], against[name] = (rise, fall) if heats else (fall, rise)
        most = max(with_drive, key=with_drive.__getitem__)
        beyond = max(self._beyond_room(name, value, room, heats) for name, value in outputs.items())
        stands = beyond >= (holds - s.least_K if isfinite(room) else s.least_K)
        if with_drive[most] >= s.least_K or stands or holds <= s.least_K:
            return None
        kind = "reversed" if against[most] >= s.least_K else "driver"
        change = -against[most] if kind == "reversed" else with_drive[most]
        change = change if heats else -change
        way = f"{s.least_K:g} K {'warmer' if heats else 'colder'}"
        expected = f"at least {way} in {seconds:.0f} s of drive {mean:+.2f}"
        return Trip(kind, time, most, expected, f"{change:+.1f} K", check=_to_check(["drift", kind]))

    def _beyond_room(self, name: str, value: float, room: float, heats: bool) -> float:
        """Return how far an output is from the room on the drive's side [K]."""
        low = high = room
        if not isfinite(room):  # beyond what the output read before in the session, then
            coldest, warmest = self._ranges[name]
            lowest_room, highest_room = self.settings.usual_room
            low, high = min(coldest, highest_room), max(warmest, lowest_room)
        return value - low if heats else high - value


@dataclass(frozen=True)
class Findings:
    """What the guard finds in one reading."""

    # the reading [degC], with the last good value in place of a suspect one
    values: dict[str, float]
    suspect: dict[str, str]  # why, by sensor
    fresh: bool  # a new reading, of which every sensor but the room's is accepted
    trip: Trip | None


@dataclass(frozen=True)
class Heard:
    """The times of a reading by this computer's clock [s]."""

    asked_s: float  # when it was asked for
    at_s: float  # when it was there


class Guard:
    """The checks of a session.

    Parameters
    ----------
    plant : Plant, optional
        The identified rig; without it the fixed rules stand in for the model.
    settings : GuardSettings, optional
    skin : str, optional
        The output that touches objects.

    Attributes
    ----------
    target : dict of str to float
        What is regulated to which temperature [degC].
    trips : list of Trip
        Of this session.
    margin, nearest : float, str
        How far the sensor that is nearest to its limit is from it [K], and which one that is.

    Examples
    --------
    >>> guard = Guard()
    >>> guard.start(Reading(0.0, {"t_surface": 25.0}, {"drive": 0.0}, 1), 0.0, {"drive": "1"})
    >>> guard.applied({"drive": 0.4}, 1, 0.0)
    >>> guard.check(Reading(1.0, {"t_surface": 25.1}, {"drive": 0.4}, 1), 1.0).trip
    >>> print(guard.check(Reading(2.0, {"t_surface": 25.2}, {"drive": 0.4}, 1), 12.0).trip.kind)
    clock
    >>> print(guard.refuse({"drive": 0.4}, 0, 2.0).kind)
    interlock
    """

    def __init__(
        self, plant: Plant | None = None, settings: GuardSettings | None = None, *, skin: str = "t_surface"
    ) -> None:
        self.settings = GuardSettings.of(plant, skin) if settings is None else settings
        self.skin = skin
        self._logged = {} if plant is None else plant.valid
        self.model = None if plant is None else ModelMonitor(plant, self.settings.model)
        self.sensors = SensorMonitor(self.settings.sensors)
        self.rules = RuleMonitor(self.settings.no_model)
        self.target: dict[str, float] = {}
        self.trips: list[Trip] = []
        self._time_s = float("-inf")  # of the newest reading, by the rig's clock
        self._released_s = float("-inf")  # when a touch was over
        self._touched = False
        self.margin, self.nearest = float("inf"), ""

    def start(
        self, reading: Reading, now: float, units: Mapping[str, str], *, asked: float | None = None
    ) -> None:
        """Begin a session at a reading, with its times as in :meth:`check` and the drives' units."""
        age_s = reading.time_s - self._time_s
        # the model still knows the rig from a session that ended well a few minutes ago
        continues = not self.trips and 0 <= age_s <= self.settings.known_s
        self._ranges = {
            name: range_of(unit, self._logged.get(name)) or (-1.0, 1.0) for name, unit in units.items()
        }
        self._time_s = reading.time_s
        self._checked_s = now  # by this computer's clock, as the next two
        self._renewed_s = now
        self._heard = Heard(now if asked is None else asked, now)
        self._seen_s = float("nan")
        self._drive = dict.fromkeys(units, 0.0)
        self._pump = reading.pump
        self._mean_drive = self._drive_before = self._drive
        self._pump_before = self._pump
        self._changed_s = 0.0  # when the drive changed, after the newest reading
        self._n_differs = 0
        self._n_beyond = dict.fromkeys(reading.values, 0)
        if not continues:
            self._released_s = float("-inf")
        elif self._touched:
            self._released_s = self._time_s
        self._touched = False
        self._repeated: dict[str, int] = {}
        self.trips = []
        self.sensors.start(reading.time_s, reading.values)
        self.rules.start()
        if self.model is not None and continues:
            self.model.predict(reading.time_s, dict.fromkeys(units, 0.0), 0, self._plausible(reading.values))
        elif self.model is not None:
            self.model.reset(reading.time_s, self._plausible(reading.values))

    def applied(self, drive: Mapping[str, float], pump: int, now: float) -> None:
        """Note what was applied at the host's time ``now`` [s]."""
        applied = {name: float(value) for name, value in drive.items()}
        if applied != self._drive or int(pump) != self._pump:
            self._drive_before = self._drive
            self._pump_before = self._pump
            self._changed_s = now - self._heard.at_s
        self._drive = applied
        self._pump = int(pump)
        self._renewed_s = now

    def late(self, now: float) -> Trip | None:
        """Return the trip of a drive that has stood without being renewed until the host's time [s]."""
        # a device that ends its drives itself knows better whether that one has held: the loop asks it then
        silence_s = now - self._renewed_s
        if not any(self._drive.values()) or silence_s <= self.settings.expiry_s:
            return None
        expected = f"a drive renewed within {self.settings.expiry_s:g} s"
        return Trip("frozen", self._time_s, "this program", expected, f"after {silence_s:.1f} s")

    def refuse(self, drive: Mapping[str, float], pump: int, time: float) -> Trip | None:
        """Return the trip of a move that must not go out, None where it may."""
        has_pump = self.model is None or "pump" in self.model.plant.inputs
        for name, value in drive.items():
            if not isfinite(value):
                return Trip("drive", time, name, "a number", f"{value}")
            if pump == 0 and value != 0.0 and has_pump:
                expected = "no drive while the pump is off"
                return Trip("interlock", time, name, expected, f"{value:g} with the pump off")
        return None

    @property
    def model_share(self) -> float:
        """The largest deviation from the plant, as a share of what is allowed; NaN without a plant."""
        return float("nan") if self.model is None else self.model.share

    def ready(self, time: float) -> bool:
        """Say whether the skin has been compared with the model for long enough to be grasped with."""
        if self.model is None:
            return True
        since_s = max(self.model.compared_from, self._released_s + self.settings.forget_s)
        return not self._touched and time >= since_s + self.settings.model.windows_s[0]

    def check(
        self,
        reading: Reading,
        now: float,
        *,
        asked: float | None = None,
        touching: bool = False,
        stop_asked: str = "",
    ) -> Findings:
        """Return the accepted values of a reading, and whether to go on; it was asked for at the host's time
        ``asked`` [s] and there at ``now``; ``stop_asked`` is who asks for an end."""
        heard = Heard(now if asked is None else asked, now)
        trip = self._clocks(reading, heard)
        if trip is None and stop_asked:
            trip = Trip("operator", reading.time_s, "the operator", "to go on", f"a stop from {stop_asked}")
        already_checked = self._seen_s == reading.time_s
        late = now > self._checked_s
        self._checked_s = now
        if trip is None and already_checked and not late:
            return self._last
        if trip is not None or already_checked:
            return self._findings(reading, {}, {}, trip)
        self._seen_s = reading.time_s
        self._heard = heard
        if self._touched and not touching:
            self._released_s = reading.time_s
        self._touched = touching
        # an object determines the skin, or did lately
        recent = touching or reading.time_s - self._released_s < self.settings.forget_s
        recent |= self.model is not None and reading.time_s < self.model.compared_from
        masked = frozenset((self.skin, f"{self.skin}_2")) if recent else frozenset()
        rooms = self.rooms(reading.values)
        self._mean_drive = self._drive | dict(reading.mean_drive or {})
        jumped = self._predict(reading)
        checked = self.sensors.check(
            reading.time_s, reading.values, touching=masked, jumped=jumped, rooms=rooms
        )
        room = next((v for n, v in reading.values.items() if n in rooms), float("nan"))
        outputs = {name: value for name, value in checked.accepted.items() if name not in rooms}
        trip = self._driver(reading) or checked.trip or self._limits(reading.time_s, outputs)
        trip = trip or self._behaviour(reading.time_s, outputs, masked, room)
        self._time_s = reading.time_s
        return self._findings(reading, checked.accepted, checked.suspect, trip)

    def _findings(
        self, reading: Reading, accepted: dict[str, float], suspect: dict[str, str], trip: Trip | None
    ) -> Findings:
        if trip is not None:
            self.trips.append(trip)
        fresh = bool(accepted) and self.rooms(reading.values).issuperset(suspect)
        # a suspect reading never reaches the controller: the last good one takes its place, for two looks
        values = {**reading.values, **self.sensors.last_good(), **accepted}
        self._last = Findings(values, suspect, fresh, trip)
        return self._last

    def _clocks(self, reading: Reading, heard: Heard) -> Trip | None:
        """Return the trip of a reading that is not new, or whose time cannot be."""
        # by the computer's clock a reading is of a moment between when it was asked for and when it was
        # there: the rig's clock is wrong where no two such moments allow what it says
        rig_s = reading.time_s - self._time_s  # since the last reading, by the rig's clock
        least_s = heard.asked_s - self._heard.at_s  # by this computer's
        most_s = heard.at_s - self._heard.asked_s
        if rig_s == 0 and least_s > self.settings.stale_s:
            expected = f"a new one within {self.settings.stale_s:g} s"
            return Trip("stale", reading.time_s, "readings", expected, f"none for {least_s:.1f} s")
        host_s = min(max(rig_s, least_s), most_s)
        if rig_s < 0 or (rig_s > 0 and abs(rig_s - host_s) > self.settings.clock_slack_s):
            expected = f"{host_s:+.2f} s since the last reading"
            return Trip("clock", reading.time_s, "the rig's clock", expected, f"{rig_s:+.2f} s")
        return None

    def _driver(self, reading: Reading) -> Trip | None:
        """Return the trip of a drive that is applied otherwise than asked, twice in a row."""
        wrong = ""
        for name, requested in self._drive.items():
            low, high = self._ranges.get(name, (-1.0, 1.0))
            applied = reading.drive.get(name, requested)
            if abs(applied - requested) > self.settings.drive_slack * 0.5 * (high - low):
                wrong = name
        self._n_differs = self._n_differs + 1 if wrong else 0
        if self._n_differs < 2:
            return None
        expected = f"{self._drive[wrong]:+.3g}, as asked"
        if not any(reading.drive.values()):
            return Trip("device", reading.time_s, wrong, expected, "0: the device has switched off")
        return Trip("driver", reading.time_s, wrong, expected, f"{reading.drive[wrong]:+.3g}")

    def _limits(self, time: float, outputs: Mapping[str, float]) -> Trip | None:
        driven = any(self._drive.values())
        self.margin, self.nearest = float("inf"), ""
        for name, value in outputs.items():
            low, high = self.limits_of(name)
            if (margin := min(value - low, high - value)) < self.margin:
                self.margin, self.nearest = margin, name
            beyond = not low <= value <= high
            self._n_beyond[name] = self._n_beyond.get(name, 0) + 1 if beyond else 0
            if self._n_beyond[name] >= 2 and (driven or not self._touched):
                return Trip("limit", time, name, f"{low:g} to {high:g} degC", f"{value:.2f} degC")
        return None

    def rooms(self, names: Collection[str]) -> frozenset[str]:
        """Return which of these sensors read the room; what touches or is regulated never does."""
        plant = None if self.model is None else self.model.plant
        outputs = (self.skin, f"{self.skin}_2", *self.target)
        return room_sensors(names, plant, stated=self.settings.room_sensors, outputs=outputs)

    def guessed_rooms(self, names: Collection[str]) -> list[str]:
        """Return the sensors that are taken for the room's by their names alone."""
        stated = () if self.model is None else room_disturbances(self.model.plant)
        return sorted(self.rooms(names).difference(stated)) if self.settings.room_sensors is None else []

    def unread(self, names: Collection[str]) -> dict[str, float]:
        """Return the plant's disturbances that no sensor reads, rooms aside, and what they are taken for."""
        if self.model is None:
            return {}
        plant = self.model.plant
        taken = zip(plant.disturbances, plant.undisturbed(0.0).tolist(), strict=True)
        return {name: value for name, value in taken if name not in names and not plant.is_room(name)}

    def limits_of(self, name: str) -> tuple[float, float]:
        """Return between which temperatures a sensor may read [degC]."""
        s, skin = self.settings, name in (self.skin, f"{self.skin}_2")
        return s.limits.get(name, s.skin_degC if skin else s.others_degC)

    def check_target(self, name: str, value: float) -> None:
        """Raise UserError where a target [degC] of a sensor is beyond its limits."""
        low, high = self.limits_of(name)
        if not low <= value <= high:
            problem = f"target {value:g} degC is unsafe"
            hint = f"choose one from {low:g} to {high:g} degC, or state the limits of {name} in a guard file"
            raise UserError(problem, file=self.settings.file, hint=hint)

    def _predict(self, reading: Reading) -> frozenset[str]:
        """Predict with the model and return the sensors whose innovation is too large."""
        if self.model is None:
            return frozenset()
        values = self._plausible(reading.values)
        if reading.mean_drive is None and self._changed_s > 0:
            changed_s = min(self._time_s + self._changed_s, reading.time_s)
            self.model.predict(changed_s, self._drive_before, self._pump_before, values)
        self._changed_s = 0.0
        self.model.predict(reading.time_s, self._mean_drive, self._pump, values)
        jumps = [n for n, v in reading.values.items() if isfinite(v) and self.model.is_jump(n, v)]
        return frozenset(jumps)

    def _behaviour(
        self, time: float, outputs: Mapping[str, float], masked: frozenset[str], room: float
    ) -> Trip | None:
        if self.model is None:
            outputs = {n: v for n, v in outputs.items() if n not in masked}
            full = {name: max(map(abs, self._ranges.get(name, (-1.0, 1.0)))) for name in self._mean_drive}
            shares = [value / full[name] for name, value in self._mean_drive.items()]
            return self.rules.check(time, max(shares, key=abs, default=0.0), outputs, room=room)
        alarms = self.model.update(time, outputs, masked)
        if not self.model.compared_now:  # a grasp is sampled faster than the model steps
            return None
        again = {}
        for alarm in alarms:
            again[alarm.subject] = self._repeated.get(alarm.subject, 0) + 1
        self._repeated = again
        confirmed = [alarm for alarm in alarms if again[alarm.subject] >= 2 or alarm.excess > 1.5]
        return self._against_model(time, max(confirmed, key=lambda a: a.excess)) if confirmed else None

    def _against_model(self, time: float, alarm: Residual) -> Trip:
        name, off = alarm.subject, f"{alarm.measured:+.2f}"
        is_drive = name in self._drive
        repeats, seconds = self.sensors.same_for(name)
        if alarm.kind == "bias":
            unit = "of its range" if is_drive else "K"
            kind = "driver" if is_drive else "drift"
            expected, measured = f"within {alarm.allowed:.2g} {unit} of the model", f"{off} {unit}"
        else:
            kind, measured = "model", f"{off} K"
            expected = f"{name} {alarm.expected:+.2f} +- {alarm.allowed:.2f} K in {alarm.window:.0f} s"
            if repeats >= 4 and abs(alarm.measured) < abs(alarm.expected):
                kind, measured = "stuck", f"{measured} (bit for bit the same for {seconds:.0f} s)"
        # a sensor may drift, whichever bias shows it
        check = _to_check([kind, "drift"]) if alarm.kind == "bias" else ""
        return Trip(kind, time, name, expected, measured, check=check)

    def _plausible(self, values: Mapping[str, float]) -> dict[str, float]:
        return {name: value for name, value in values.items() if self.sensors.plausible(value)}


def _to_check(kinds: Sequence[str]) -> str:
    """Return what to check, of several kinds of trips."""
    return "; or ".join(KINDS[kind][0] for kind in dict.fromkeys(kinds))
