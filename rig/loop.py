"""The loop of a session: read, guard, ask the controller, apply, write down, let time pass.

:class:`Loop` knows how one sample is taken and what is written of it; which phases follow each other stands
in :mod:`~thermogrip.rig.session`.  It keeps no clock: time is the rig's.

The guard here is the last line, not the first: while a reading is not finite or outside the safe range, the
last move is held; the third such reading in a row trips.  A lost room sensor is noted, no more.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.datasets.units import join_header, split_header
from thermogrip.mpc.interface import Controller, Move, Target
from thermogrip.rig.interface import Reading, Rig

__all__ = ["PHASES", "Event", "Loop", "Recorder", "TripError"]

#: The phases of a session; a log holds their index.
PHASES = ("settle", "hold", "lead_in", "pump_off", "contact")
BAD_READINGS_TO_TRIP = 3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Event:
    """Something that happened: when [s, the rig's clock], of which kind, in words."""

    time_s: float
    kind: str
    text: str


class Recorder(Protocol):
    """Where samples and events go as they happen, so that a crash loses none."""

    def sample(self, row: Mapping[str, float]) -> None:
        """Take one row of the log, names with their unit suffix."""
        ...

    def event(self, event: Event) -> None:
        """Take one event."""
        ...


class TripError(Exception):
    """The guard ended the session."""


@dataclass
class Loop:
    """The state of a running session: rows, events, the newest reading and the move that is applied."""

    rig: Rig
    controller: Controller
    recorder: Recorder | None
    progress: Callable[[float, str], None] | None
    safe: tuple[float, float]
    rows: list[dict[str, float]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    target: dict[str, float] = field(default_factory=dict)
    bad_in_a_row: int = 0
    status: str = "ok"
    move: Move = field(default_factory=lambda: Move(drive=0.0))
    phase: str = ""

    def __post_init__(self) -> None:
        self.reading: Reading = self.rig.read()
        self.last_good: dict[str, float] = {}

    def start(self, target: Mapping[str, float]) -> None:
        """Check the targets and the first reading, and reset the controller."""
        for name, value in target.items():
            if name not in self.reading.values:
                have = ", ".join(self.reading.values)
                raise UserError(f"the rig has no sensor {name!r}", mend=f"set a target for one of {have}")
            if not self.safe[0] <= value <= self.safe[1]:
                lo, hi = self.safe
                raise UserError(
                    f"target {value:g} degC is unsafe", mend=f"choose one from {lo:g} to {hi:g} degC"
                )
        self.target = {name: float(value) for name, value in target.items()}
        self.move = Move(drive=self.no_drive(), pump=1)
        for name in self.reading.values:
            if not _is_ambient(name) and not self.believable(name, self.reading.values[name]):
                value = self.reading.values[name]
                raise UserError(
                    f"the rig's {name} reads {value:g} degC", mend="check the sensor before starting"
                )
        self.guard()
        self.controller.reset(self.trusted())

    def regulate(self, phase: str, seconds: float) -> Iterator[float]:
        """Run the controller for so long; yield the time passed in this phase at each move."""
        begin = self.reading.time_s
        while (passed := self.reading.time_s - begin) < seconds:
            if self.guard():
                self.move = self.controller.step(self.trusted(), self.target_of_controller())
                self.note_status()
            self.record(phase)
            self.wait(self.controller.dt)
            yield passed

    def sample(self, phase: str, n: int, dt: float) -> None:
        """Record n fast samples under the present move."""
        for _ in range(n):
            self.guard()
            self.record(phase)
            self.wait(dt)

    def guard(self) -> bool:
        """Say whether the newest reading can be believed; the third in a row that cannot trips."""
        bad = [name for name, value in self.reading.values.items() if not self.believable(name, value)]
        self.last_good.update({name: v for name, v in self.reading.values.items() if name not in bad})
        fatal = [name for name in bad if not _is_ambient(name)]
        if bad and (self.bad_in_a_row == 0 or not fatal):
            self.note_once("lost", f"{', '.join(bad)} cannot be believed; the last good value is used")
        self.bad_in_a_row = self.bad_in_a_row + 1 if fatal else 0
        if self.bad_in_a_row >= BAD_READINGS_TO_TRIP:
            value = self.reading.values[fatal[0]]
            raise TripError(
                f"{fatal[0]} read {value:g} degC, {self.bad_in_a_row} bad readings in a row; check its plug"
            )
        return not fatal

    def believable(self, name: str, value: float) -> bool:
        """Say whether one value is finite and inside the safe range."""
        return bool(np.isfinite(value)) and self.safe[0] <= value <= self.safe[1]

    def trusted(self) -> dict[str, float]:
        """Return the reading for the controller, the last good value where one is lost."""
        return {**self.reading.as_controller_reading(), **self.last_good}

    def target_of_controller(self) -> Target:
        """Return a number for one target, a dict for several."""
        return next(iter(self.target.values())) if len(self.target) == 1 else self.target

    def record(self, phase: str) -> None:
        """Apply the present move and write the row; inputs of a row hold from it until the next."""
        drive = self.move.drive if isinstance(self.move.drive, dict) else self.single(self.move.drive)
        self.rig.apply(drive, self.move.pump)
        if phase != self.phase:
            self.phase = phase
            self.note("phase", phase)
        row = {"time_s": self.reading.time_s}
        row |= {join_header(name, self.rig.units[name]): value for name, value in drive.items()}
        row["pump"] = float(self.move.pump)
        row |= {f"{name}_degC": value for name, value in self.reading.values.items()}
        row |= {f"target_{name}_degC": value for name, value in self.target.items()}
        row["phase"] = float(PHASES.index(phase))
        self.rows.append(row)
        if self.recorder is not None:
            self.recorder.sample(row)

    def wait(self, seconds: float) -> None:
        """Let time pass and read."""
        self.rig.wait(seconds)
        self.reading = self.rig.read()

    def single(self, drive: float) -> dict[str, float]:
        """Return the drive by name where the controller gave a number."""
        inputs = tuple(self.reading.drive)
        if len(inputs) != 1:
            raise ValueError(f"the controller gave one number for the inputs {', '.join(inputs)}")
        return {inputs[0]: float(drive)}

    def no_drive(self) -> dict[str, float]:
        """Return zero for every input."""
        return dict.fromkeys(self.reading.drive, 0.0)

    def power_off(self) -> None:
        """Switch drive and pump off; if even that fails, let the rig go, which switches off too."""
        try:
            self.rig.apply(self.no_drive(), 0)
        except BaseException:
            self.rig.close()
            raise

    def note(self, kind: str, text: str) -> None:
        """Add an event at the newest reading's time."""
        event = Event(self.reading.time_s, kind, text)
        self.events.append(event)
        if self.recorder is not None:
            self.recorder.event(event)

    def note_once(self, kind: str, text: str) -> None:
        """Add an event unless the same one stands there already."""
        if not any(event.kind == kind and event.text == text for event in self.events):
            self.note(kind, text)

    def note_status(self) -> None:
        """Add an event when the controller's status changes."""
        if self.move.status != self.status:
            self.status = self.move.status
            self.note(
                "controller", f"{self.move.status}: {self.move.advice}" if self.move.advice else self.status
            )

    def report(self, fraction: float, what: str) -> None:
        """Tell how far it is."""
        if self.progress is not None:
            self.progress(min(fraction, 1.0), what)

    def column(self, name: str, *, last: float = np.inf) -> Array:
        """Return one column of the rows so far, or of the ``last`` seconds of them."""
        since = bisect_left(self.rows, self.reading.time_s - last, key=lambda row: row["time_s"])
        return np.array([row[name] for row in self.rows[since:]])

    def log(self) -> Log:
        """Return the rows as a Log."""
        variables = {}
        for header in list(self.rows[0])[1:]:
            name, unit = split_header(header)
            values = self.column(header)
            if name in self.reading.values:
                role = "disturbance" if _is_ambient(name) else "output"
            else:
                role = "input" if name == "pump" or name in self.reading.drive else "other"
            variables[name] = (_filled(values) if role == "disturbance" else values, unit, role)
        log = make_log(self.column("time_s"), variables, name="session")
        log["phase"].attrs["flag_meanings"] = " ".join(PHASES)
        return log


def _is_ambient(name: str) -> bool:
    """Say whether a sensor is the room's: losing it is no reason to stop."""
    return "ambient" in name


def _filled(values: Array) -> Array:
    """Return the values with lost ones replaced by the last good one (the first good one at the start)."""
    good = np.flatnonzero(np.isfinite(values))
    last = np.searchsorted(good, np.arange(values.size), "right") - 1
    return values[good[np.maximum(last, 0)]] if good.size else np.zeros_like(values)
