"""The loop of a session: read, guard, ask the controller, apply, record, let time pass.

Time passes in *looks* of at most :data:`LOOK_S`, however long a sample is: at each the rig is read, the guard
checks the reading, the drive is renewed and the session is shown.  The controller's step and the recorded row
alone are of the sample time.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from math import ceil
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.schema import Log, make_log
from thermogrip.datasets.units import join_header, split_header
from thermogrip.mpc.interface import Controller, Move
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.trip import ENDLESS, Trip, TripError
from thermogrip.rig.interface import DeviceRefusedError, Event, Reading, Rig
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.session.profile import Profile
from thermogrip.rig.session.signals import check_stopped, hold_signals, stop_signals
from thermogrip.rig.session.snapshot import MOST_MARKS, Listener, Operator, Snapshot

#: Longest time between two looks at a rig [s].  A drive lives 2 s on the device
#: (:data:`~thermogrip.rig.drivers.thermogrip.TTL_S`): it outlives a computer that comes 1.5 s late, three
#: looks.  A limit takes two looks, in which a TCLab at full power (0.35 K/s) goes 0.35 K.  Klipper's boards
#: look every 0.3 s, and four times.
LOOK_S = 0.5

#: The phases of a session; a log holds their index.
PHASES = ("settle", "hold", "lead_in", "pump_off", "contact", "release")

_SHOWN_EVENTS = 5
Array = NDArray[np.float64]


class Recorder(Protocol):
    """Where samples and events go as they happen, so that a crash loses none."""

    def sample(self, row: Mapping[str, float]) -> None:
        """Take one row of the log, names with their unit suffix."""

    def event(self, event: Event) -> None:
        """Take one event."""


@dataclass
class MeanDrive:
    """The mean of what relays gave, reading by reading."""

    seconds: float = 0.0
    integrals: dict[str, float] = field(default_factory=dict)

    def add(self, mean_drive: Mapping[str, float], seconds: float) -> None:
        """Add what they gave in so many seconds."""
        self.seconds += seconds
        for name, mean in mean_drive.items():
            self.integrals[name] = self.integrals.get(name, 0.0) + mean * seconds

    def take(self) -> dict[str, float]:
        """Return it, and begin anew; empty where no time has passed."""
        means = {name: value / self.seconds for name, value in self.integrals.items() if self.seconds > 0}
        self.seconds, self.integrals = 0.0, {}
        return means


@dataclass
class Loop:
    """The state of a running session: rows, events, the newest reading and the move that is applied."""

    rig: Rig
    controller: Controller
    recorder: Recorder | None
    progress: Callable[[float, str], None] | None
    guard: Guard
    clock: Callable[[], float] | None = None
    listener: Listener | None = None
    operator: Operator = field(default_factory=Operator)
    band: float = np.nan
    rows: list[dict[str, float]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    target: dict[str, float] = field(default_factory=dict)
    touching: bool = False
    fresh: bool = False  # whether the newest reading may be handed to the controller
    disk_fault: str = ""
    status: str = "ok"
    move: Move = field(default_factory=lambda: Move(drive=0.0))
    phase: str = ""
    ends: float = np.inf
    dt: float = np.nan
    trip: Trip | None = None  # what ended it
    cycle_s: float = 0.0  # of the relays, over which their ripple has no mean, where it settled by that
    unwritten: bool = False  # whether the recorder still has to get the newest row
    row_mean: MeanDrive = field(default_factory=MeanDrive)  # since the newest row
    move_mean: MeanDrive = field(default_factory=MeanDrive)

    def __post_init__(self) -> None:
        self.rig.notices()  # what happened before is not of this session
        self.accepted: dict[str, float] = {}
        self._counted_s = np.nan  # the newest reading whose drive is in the means
        self.read(self.rig.read)

    @contextmanager
    def powered(self) -> Iterator[None]:
        """Switch off on every way out of the block, which a trip ends; that is kept, recorded and noted."""
        with stop_signals():
            try:
                yield
            except TripError as tripped:
                self.trip = tripped.trip
            finally:
                self.power_off()
                try:
                    self.end_row()
                except TripError as tripped:
                    self.trip = self.trip or tripped.trip
        if self.trip is not None:
            self.record_last()
            self.note("tripped", self.trip.line(), asdict(self.trip))

    def now(self) -> float:
        """Return the host's time [s]; the rig's own where there is no other, as in a simulation."""
        return self.reading.time_s if self.clock is None else self.clock()

    def read(self, read: Callable[[], Reading]) -> None:
        """Take a reading, with the host's times at which it was asked for and had: how late the loop is with
        it afterwards is no fault of the rig's clock."""
        asked_s = None if self.clock is None else self.clock()
        self.reading: Reading = read()
        self._count(self.reading)
        self.heard = self.now()
        self.asked = self.heard if asked_s is None else asked_s

    def _count(self, reading: Reading) -> None:
        """Add what relays gave until a reading to the means."""
        seconds = reading.time_s - self._counted_s
        if reading.mean_drive is not None and seconds > 0:
            for mean in (self.row_mean, self.move_mean):
                mean.add(reading.mean_drive, seconds)
        self._counted_s = reading.time_s

    @property
    def rooms(self) -> frozenset[str]:
        """The sensors that read the room."""
        return self.guard.rooms(self.reading.values)

    def start(self, target: Mapping[str, float]) -> None:
        """Check the targets and the first reading, open the gripper, and reset guard and controller."""
        self.guard.target = {name: float(value) for name, value in target.items()}
        self.guard.settings.check_sensors(self.reading.values, self.rooms)
        for name, value in target.items():
            self.check_targets(name, [value])
        self.target = self.guard.target
        self.move = Move(drive=self.no_drive(), pump=1)
        for name, value in self.reading.values.items():
            if name not in self.rooms and not self.guard.sensors.plausible(value):
                problem = f"the rig's {name} reads {value:g} degC"
                raise UserError(problem, hint="check the sensor before starting")
        self.operator.take_bad()  # of what was before
        self.open_gripper()  # a session that lost its rig in contact has left it closed on the object
        self.guard.start(self.reading, self.heard, self.rig.units, asked=self.asked)
        if guessed := self.guard.guessed_rooms(self.reading.values):
            text = f"{', '.join(guessed)} by name taken for the room's; state room_sensors in the guard file"
            self.note("room", text)
        if unread := self.guard.unread(self.reading.values):
            taken = ", ".join(f"{name} as {value:.4g}" for name, value in unread.items())
            self.note("room", f"the rig does not read {', '.join(unread)}: the controller takes {taken}")
        self.accepted = {**self.reading.values, **self.guard.sensors.last_good()}
        self.controller.reset(self.controller_reading())
        self.check()

    def check_targets(self, name: str, values: Iterable[float]) -> None:
        """Raise UserError where an output that has targets is none, or one of them is beyond its limits."""
        if name not in self.reading.values:
            hint = known_names(name, self.reading.values, "set a target for one of {}")
            raise UserError(f"the rig has no sensor {name!r}", hint=hint)
        for value in values:
            self.guard.check_target(name, value)

    def regulate(self, phase: str, seconds: float, profile: Profile | None = None) -> Iterator[float]:
        """Run the controller for so long, its targets those of a profile where there is one; yield the time
        passed in this phase at each move."""
        begin = self.reading.time_s
        self.ends, self.dt = begin + seconds, self.controller.dt
        while True:
            passed = self.reading.time_s - begin
            if passed >= seconds:
                return
            target: Any = self.target if len(self.target) != 1 else next(iter(self.target.values()))
            if profile is not None:
                self.target.update(profile.at(passed))
                target = profile.ahead(passed, self.controller.dt)  # which a controller may look at
            if self.fresh:
                means = {f"mean_{name}": mean for name, mean in self.move_mean.take().items()}
                self.move = self.controller.step(self.controller_reading() | means, target)
                if self.move.status != self.status:
                    self.status = self.move.status
                    advice = f": {self.move.advice}" if self.move.advice else ""
                    self.note("controller", self.status + advice)
            self.record(phase)
            self.wait(self.controller.dt)
            yield passed

    def sample(self, phase: str, n: int, dt: float) -> None:
        """Record n fast samples under the present move."""
        self.dt = dt
        for _ in range(n):
            self.record(phase)
            self.wait(dt)

    def check(self) -> None:
        """Have the guard check the newest reading."""
        for why in self.operator.take_bad():
            if sum(event.kind == "bad" for event in self.events) < MOST_MARKS:
                self.note("bad", why)
        findings = self.guard.check(
            self.reading,
            self.heard,
            asked=self.asked,
            touching=self.touching,
            stop_asked=self.operator.stop_asked,
        )
        self.accepted, self.fresh = findings.values, findings.fresh
        for name, why in findings.suspect.items():
            text = f"{name} is suspect ({why}); the last good value is used"
            if not any((event.kind, event.text) == ("lost", text) for event in self.events):
                self.note("lost", text)
        if findings.trip is not None:
            raise TripError(self.of_this_rig(findings.trip))

    def controller_reading(self) -> dict[str, float]:
        """Return the reading for the controller, the last good value where one is lost."""
        return {**self.reading.as_controller_reading(), **self.accepted}

    def apply(self) -> dict[str, float]:
        """Apply the present move, or renew it; return its drive by input."""
        drive = self.move.drive
        if not isinstance(drive, dict):
            if len(inputs := tuple(self.reading.drive)) != 1:
                raise ValueError(f"the controller gave one number for the inputs {', '.join(inputs)}")
            drive = {inputs[0]: float(drive)}
        refused = self.guard.refuse(drive, self.move.pump, self.reading.time_s)
        if refused is not None:
            raise TripError(refused)
        if (late := self.guard.late(self.now())) is not None:
            # a device that ends its drives itself has the last word: it goes on where that one has held
            self._count(self.ask(self.rig.read))
            self._note_notices()
            if self.rig.expires_s == np.inf:
                raise TripError(self.of_this_rig(late))
            self.note("late", f"{late.subject} was late: expected {late.expected}, measured {late.measured}")
        try:
            self.ask(lambda: self.rig.apply(drive, self.move.pump))
        except ValueError as error:
            wanted = ", ".join(f"{name} {value:g}" for name, value in drive.items())
            trip = Trip("drive", self.reading.time_s, wanted, "a drive that the rig can take", str(error))
            raise TripError(trip) from error
        self.guard.applied(drive, self.move.pump, self.now())
        return drive

    def record(self, phase: str) -> None:
        """Apply the present move and write the row; inputs of a row hold from it until the next.  One whose
        drives are switched is written when it is over, for it has what they gave."""
        self.end_row()
        drive = self.apply()
        if phase != self.phase:
            first, self.phase = not self.phase, phase
            self.note("phase", phase, {"rooms": sorted(self.rooms)} if first else None)
        row = {"time_s": self.reading.time_s, **self._orders(drive), **_measured(self.reading)}
        row |= {f"target_{name}_degC": value for name, value in self.target.items()}
        self.rows.append(row | {"phase": float(PHASES.index(phase))})
        self.unwritten = True
        if self.reading.mean_drive is None:
            self.end_row()
        self.show(drive)

    def end_row(self) -> None:
        """Write the newest row, where that is still to be done, with what relays gave since its time."""
        if not self.unwritten:
            return
        self.unwritten = False
        means = self.row_mean.take()
        self.rows[-1] |= {join_header(name, self.rig.units[name]): mean for name, mean in means.items()}
        if self.recorder is not None and not self.disk_fault:
            try:
                self.recorder.sample(self.rows[-1])
            except OSError as error:
                self.disk_fault = error.strerror or str(error)
                trip = Trip("disk", self.reading.time_s, "the run folder", "to be written", self.disk_fault)
                raise TripError(trip) from error

    def show(self, drive: Mapping[str, float], *, verdict: str = "", trip: Trip | None = None) -> None:
        """Hand a snapshot to the listener; one that fails gets nothing more, which is noted."""
        if self.listener is None:
            return
        guard, reading = self.guard, self.reading
        skin = [guard.skin]
        skins = [*self.target, *(skin if guard.skin in reading.values else reading.values), *skin]
        snapshot = Snapshot(
            reading.time_s,
            self.phase,
            self.ends - reading.time_s,
            self.dt,
            skins[0],
            reading.values,
            self.target,
            self.band,
            drive,
            self.rig.units,
            self.move.pump if self.rig.has_pump else None,
            guard.margin,
            guard.nearest,
            guard.model_share,
            self.rig.expires_s,
            tuple(self.events[-_SHOWN_EVENTS:]),
            trip,
            verdict,
        )
        try:
            self.listener(snapshot)
        except Exception as error:  # a view may be anybody's, and ends no session
            self.listener = None
            self.note("view", f"what shows the session failed and gets no more of it ({error})")

    def record_last(self) -> None:
        """Record the reading that ended it, with the drive that is applied from then on: none."""
        if self.phase and self.reading.time_s > self.rows[-1]["time_s"]:
            self.move = Move(drive=self.no_drive(), pump=0)
            self.rows.append(self.rows[-1] | self._orders(self.no_drive()) | _measured(self.reading))
            if self.recorder is not None:
                with suppress(OSError):  # it is being ended already, and the row is in the session's log
                    self.recorder.sample(self.rows[-1])

    def _orders(self, drive: Mapping[str, float]) -> dict[str, float]:
        """Return a row's columns of what is applied: the drives, the requests of those with a relay, and the
        pump of the present move, if any."""
        drives = {join_header(name, self.rig.units[name]): value for name, value in drive.items()}
        switched = self.reading.mean_drive or ()
        requests = {join_header(f"asked_{name}", self.rig.units[name]): drive[name] for name in switched}
        return drives | requests | ({"pump": float(self.move.pump)} if self.rig.has_pump else {})

    def wait(self, seconds: float) -> None:
        """Let time pass, looking at the rig and renewing its drive; the last look is the next sample."""
        looks = max(1, ceil(seconds / LOOK_S - 1e-6))
        begin = self.reading.time_s
        passed = 0
        while True:
            check_stopped()
            self.ask(lambda: self.rig.wait(seconds / looks))
            self.read(lambda: self.ask(self.rig.read))
            self._note_notices()
            self.check()
            # a look that came late by whole ones counts as those: the sample keeps its time
            passed = max(passed + 1, round((self.reading.time_s - begin) / seconds * looks))
            if passed >= looks:
                return
            self.show(self.apply())

    def ask(self, call: Callable[[], Any]) -> Any:
        """Ask the rig; a lost connection, or a device that refuses, is a trip."""
        try:
            return call()
        except DeviceRefusedError as error:
            raise TripError(trip_of_device(error, self.reading)) from error
        except (PortError, OSError) as error:
            trip = Trip("cable", self.reading.time_s, "the rig", "an answer", str(error))
            raise TripError(self.of_this_rig(trip)) from error

    def of_this_rig(self, trip: Trip) -> Trip:
        """Return the trip with how to clear it where nothing on the device ends its drive."""
        endless = self.rig.expires_s == np.inf and trip.kind in ENDLESS
        return replace(trip, clear=ENDLESS[trip.kind]) if endless else trip

    def _note_notices(self) -> None:
        """Note what happened on the rig, the same thing once, since a line full of noise must not fill the
        disk; after a reset or an expired drive the last row's drive is not known, which is a trip."""
        trip = None
        happened = Counter((notice.kind, notice.text) for notice in self.rig.notices())
        for (kind, text), times in happened.items():
            self.note(kind, text if times == 1 else f"{text} ({times} times)")
            time_s = self.reading.time_s
            if kind == "reset":
                trip = Trip("device", time_s, "the device", "to hold the drive", text)
            elif kind == "expired" and trip is None:
                trip = Trip("frozen", time_s, "this program", "a drive renewed within 2 s", text)
        if trip is not None:
            raise TripError(trip)

    def no_drive(self) -> dict[str, float]:
        """Return zero for every input."""
        return dict.fromkeys(self.reading.drive, 0.0)

    def open_gripper(self) -> None:
        """Open the gripper; a rig that cannot be reached keeps it closed, which is noted."""
        self.touching = False
        try:
            self.rig.release()
            self.note("opened", "gripper opened")
        except (PortError, OSError, DeviceRefusedError) as error:
            self.note("opened", f"the gripper could not be opened ({error})")

    def power_off(self) -> None:
        """Switch drive and pump off, whatever signals come; if even that fails, let the rig go, which
        switches off too, and note whether one out of reach ends by itself."""
        with hold_signals():
            try:
                self.rig.apply(self.no_drive(), 0)
            except (PortError, OSError, DeviceRefusedError) as error:
                self.rig.close()
                lives = self.rig.expires_s
                ends = f"the device's own expiry switches it off within {lives:g} s"
                stays = "nothing on the device switches it off: PULL THE PLUG"
                self.note("power", f"not confirmed off ({error}); {stays if lives == np.inf else ends}")
            except BaseException:
                self.rig.close()
                raise

    def note(self, kind: str, text: str, data: Mapping[str, Any] | None = None) -> None:
        """Add an event at the newest reading's time."""
        event = Event(self.reading.time_s, kind, text, dict(data or {}))
        self.events.append(event)
        if self.recorder is not None:  # a full disk has room for the last words
            try:
                self.recorder.event(event)
            except OSError as error:  # the next sample trips on it; a note alone ends nothing
                if not self.disk_fault:
                    self.events.append(Event(self.reading.time_s, "disk", error.strerror or str(error)))

    def report(self, fraction: float, what: str) -> None:
        """Report progress."""
        if self.progress is not None:
            self.progress(min(fraction, 1.0), what)

    def column(self, name: str, *, last: float = np.inf) -> Array:
        """Return one column of the rows so far, or of the ``last`` seconds of them."""
        since = bisect_left(self.rows, self.reading.time_s - last, key=lambda row: row["time_s"])
        return np.array([row[name] for row in self.rows[since:]])

    def log(self) -> Log:
        """Return the rows as a Log."""
        return log_of_rows(self.rows, self.rooms, name="session")


_LATCHES = {
    "open": ("lost", "a temperature", "an open sensor"),
    "short": ("lost", "a temperature", "a shorted sensor"),
    "over": ("limit", "less than the device's own limit", "more"),
    "under": ("limit", "more than the device's own limit", "less"),
    "pump": ("pump", "the pump to turn", "that it has stopped"),
}


def trip_of_device(error: DeviceRefusedError, reading: Reading) -> Trip:
    """Return the trip of a device that refuses a drive: its latched fault, named as ours would be."""
    for fault in error.faults:
        latch, _, name = fault.partition(":")
        if latch in _LATCHES:
            kind, expected, measured = _LATCHES[latch]
            measured += ", latched on the device"
            return Trip(kind, reading.time_s, name or "the pump", expected, measured)
    return Trip("device", reading.time_s, "the device", "to take a drive", str(error))


def _measured(reading: Reading) -> dict[str, float]:
    """Return a row's columns of a reading."""
    return {"time_s": reading.time_s} | {f"{name}_degC": value for name, value in reading.values.items()}


def log_of_rows(
    rows: Sequence[Mapping[str, float]], rooms: Collection[str], *, name: str, repairs: Sequence[str] = ()
) -> Log:
    """Return a session's rows (columns with their unit suffix) as a Log, without what was never read."""
    time, *headers = rows[0]
    variables = {}
    for header in headers:
        variable, unit = split_header(header)
        role = "input"
        if variable == "phase" or variable.startswith(("target_", "asked_")):
            role = "other"
        elif unit == "degC":
            role = "disturbance" if variable in rooms else "output"
        values = np.array([row[header] for row in rows])
        if not np.isnan(values).all():
            variables[variable] = (hold_last_good(values) if role == "disturbance" else values, unit, role)
    log = make_log([row[time] for row in rows], variables, name=name, repairs=repairs)
    if "phase" in log:
        log["phase"].attrs["flag_meanings"] = " ".join(PHASES)
    return log


def hold_last_good(values: Array) -> Array:
    """Return the values with lost ones replaced by the last good one (the first good one at the start)."""
    good = np.flatnonzero(np.isfinite(values))
    last = np.searchsorted(good, np.arange(values.size), "right") - 1
    return values[good[np.maximum(last, 0)]] if good.size else np.zeros_like(values)
