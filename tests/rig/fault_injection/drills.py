"""A session against a device that fails on purpose, and how long it takes to be safe.

Each :class:`Drill` brings the skin of a virtual device (:mod:`~thermogrip.rig.simulation.virtual_device`, on
a real pty) to a temperature, lets one thing fail, and notes

    detected   from the fault to the trip [s, the device's clock]
    off        from the trip to zero drive at the module, the device's truth [s]; where the host is dead or
               the cable out, from the fault
    excursion  how far the true temperatures of water and skin went, until the drive was off and half a minute
               after, beyond what the same session does without the fault [K]
    wrong      rows on disk that are not what the device measured (before the fault: the truth within noise),
               and rows that are missing

Host and device share one stepped clock, so a drill of minutes takes a second and is the same each time.  The
device's plant is a few percent off the one that guard and controller know, as a real one is.

A stuck sensor takes its time because a healthy one repeats itself too
(:func:`~thermogrip.rig.guard.sensor_checks.repeats_needed`); a drift of r K/s shows against the model no
earlier than floor / r; a sensor that is late by L seconds is off by L times the rate of change.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.rig.makers import SteppedClock
from thermogrip.mpc.interface import Controller
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.interface import Reading
from thermogrip.rig.records.run_folder import RunFolder, read_run
from thermogrip.rig.serial.port import Port
from thermogrip.rig.session.session import Session, run_session
from thermogrip.rig.simulation.virtual_device import VirtualDevice, example_plant
from thermogrip.sysid.plant.plant import Plant

Fault = Callable[[VirtualDevice], None]

_TARGET, _START, _NEARLY, _ROOM = 36.0, 25.0, 34.5, 25.0
_NEAR_K = 0.5  # of the truth, for a row before the fault: five standard deviations of the noise


@dataclass(frozen=True)
class Drill:
    """One thing that fails: the trips that are right (none: the session is to go on and settle), and when."""

    name: str
    fault: Fault
    at: float = 50.0  # [s]; from a cold start the skin is on its way then, after 150 s from a warm one held
    kinds: tuple[str, ...] = ()
    within: float = 4.0  # [s]
    why: str = ""  # it cannot be faster
    late_clock: float = 0.0  # by how much the rig's own clock jumps at the fault [s]
    start: float = _START


@dataclass(frozen=True)
class Outcome:
    """What a drill showed; see the module."""

    drill: Drill
    session: Session
    detected: float
    off: float
    excursion: float
    wrong: int
    rows: int
    message: str = field(default="", repr=False)


def _fault(name: str, **options: Any) -> Fault:
    return lambda device: device.fault(name, **options)


def _pull_and_plug(device: VirtualDevice) -> None:
    device.fault("cable_pulled")
    device.clear("cable_pulled")


_SLOW_STUCK = "1e-9 chance of a healthy sensor that repeats itself so often"
_MODEL = "a window of 10 s against the model; its floor is 0.55 K"

#: The drills whose host lives; for those of a dead one see :mod:`~tests.rig.fault_injection.host_drills`.
DRILLS: tuple[Drill, ...] = (
    Drill("skin sensor open", _fault("sensor_open"), kinds=("lost",)),
    Drill("tank sensor open", _fault("sensor_open", sensor="t_tank"), kinds=("lost",)),
    Drill("tank sensor short", _fault("sensor_short", sensor="t_tank"), kinds=("lost",)),
    Drill("skin sensor reads nonsense", _fault("sensor_nan"), kinds=("limit", "lost")),
    Drill("skin sensor off by 8 K at once", _fault("sensor_offset", kelvin=8.0), kinds=("jump",),
          within=8),
    Drill("skin sensor stuck, on the way", _fault("sensor_stuck"), kinds=("stuck",), within=20,
          why=_MODEL),
    Drill("tank sensor stuck, on the way", _fault("sensor_stuck", sensor="t_tank"), kinds=("stuck",),
          within=20, why=_MODEL),
    Drill("skin sensor stuck, at rest", _fault("sensor_stuck"), at=150.0, start=_NEARLY,
          kinds=("stuck",), within=60, why=_SLOW_STUCK),
    Drill("skin sensor drifts 0.1 K/s", _fault("sensor_drift", rate=0.1), kinds=("model",), within=30,
          why="it shows beyond the floor of a window: not before 0.55 K / 0.1 K/s, and 3 s of smoothing"),
    Drill("tank sensor drifts 0.03 K/s", _fault("sensor_drift", sensor="t_tank", rate=0.03),
          kinds=("driver", "model"), within=90,
          why="the floor of 90 s is 0.45 K, 15 s of 0.03 K/s, and the filter follows a drift in part"),
    Drill("tank sensor late by 5 s", _fault("sensor_lag", sensor="t_tank", seconds=5.0), at=20.0,
          kinds=("driver", "model"), within=180,
      why="5 s are a floor of 0.35 K where the tank changes by 0.07 K/s; what is slower hides it, unharmed"),
    Drill("pump stops", _fault("pump_stall"), kinds=("pump",), within=6,
          why="the device's tachometer"),
    Drill("driver stuck at full drive", _fault("driver_stuck", share=1.0), at=150.0, start=_NEARLY,
          kinds=("model",), within=20, why=_MODEL),
    Drill("driver stuck at full cooling", _fault("driver_stuck", share=-1.0),
          kinds=("model",), within=20, why=_MODEL),
    Drill("driver gives nothing", _fault("driver_stuck", share=0.0),
          kinds=("model",), within=25, why=_MODEL),
    Drill("1 % of all lines spoilt", _fault("garbage", rate=0.01), start=_NEARLY),
    Drill("50 % of all lines spoilt", _fault("garbage", rate=0.5), kinds=("cable",), within=15),
    Drill("device reset", _fault("reset"), kinds=("device",)),
    Drill("device browned out", _fault("reset", cause="brownout"), kinds=("device",)),
    Drill("cable pulled", _fault("cable_pulled"), kinds=("cable",)),
    Drill("cable pulled and replugged at once", _pull_and_plug, start=_NEARLY),
    Drill("device silent", _fault("silence"), kinds=("cable",)),
    Drill("device deaf", _fault("deaf"), kinds=("cable",)),
    Drill("rig's clock jumps by an hour", lambda device: None, kinds=("clock",), late_clock=3600.0),
)  # fmt: skip


def drill_plants() -> tuple[Plant, Plant]:
    """Return the plant that guard and controller know, and the one that the device is."""
    known = example_plant()
    off = {"seebeck": 1.03, "G_heatsink": 0.95, "G_tank": 1.2, "flow": 0.95, "C_tube": 1.1}
    values = {name: value * off.get(name, 1.0) for name, value in known.values.items()}
    return known, replace(known, values=values)


def run_drill(
    drill: Drill | None,
    controller: Controller,
    folder: Path,
    *,
    hold: float = 600.0,
    link: str = "pty",
    settings: GuardSettings | None = None,
) -> Outcome:
    """Run one drill (none: the session without a fault) into a run folder and return what it showed."""
    clock, (known, real) = SteppedClock(), drill_plants()
    at = np.inf if drill is None else drill.at
    jump, start = (0.0, _NEARLY) if drill is None else (drill.late_clock, drill.start)
    with VirtualDevice(real, link=link, clock=clock, ambient=_ROOM, t_start=start, seed=1) as device:
        rig = _Rig(device, clock, at, drill, jump)
        try:
            with RunFolder(folder) as recorder:  # forced to disk by real seconds, of which there are few
                guard = Guard(known, settings)
                session = run_session(
                    rig, controller, _TARGET, hold=hold, guard=guard, clock=clock, recorder=recorder
                )
                recorder.finish(session)
            ended = clock()
            clock.sleep(30.0)
            device.truth()
        finally:
            rig.close()
        return _outcome(drill, session, device, rig.failed_at, ended, folder)


class _Rig(DeviceRig):
    """The rig whose device fails at a time."""

    def __init__(
        self, device: VirtualDevice, clock: SteppedClock, at: float, drill: Drill | None, jump: float
    ) -> None:
        self.device, self.at, self.drill, self.jump = device, at, drill, jump
        self.failed_at = float("nan")
        super().__init__(Port(device.port, clock=clock), clock=clock, sleep=clock.sleep)
        self.count = clock

    def wait(self, seconds: float) -> None:
        """Wait, and fail in the middle of it."""
        half = 0.5 * seconds
        super().wait(half)
        if self.drill is not None and self.failed_at != self.failed_at and self.count() >= self.at:
            self.failed_at = self.count()
            self.drill.fault(self.device)
        super().wait(seconds - half)

    def read(self) -> Reading:
        """Read, on a clock that may have jumped."""
        reading = super().read()
        late = self.jump if self.failed_at == self.failed_at else 0.0
        return replace(reading, time_s=reading.time_s + late)


def _outcome(
    drill: Drill | None, session: Session, device: VirtualDevice, failed: float, ended: float, folder: Path
) -> Outcome:
    trace = list(device.trace)
    after = [m for m in trace if m.time_s >= (failed if failed == failed else 0.0)]
    detected = off = float("nan")
    if session.trip is not None:
        detected = ended - failed
        off = max(0.0, max((m.time_s for m in after if any(m.drive.values())), default=failed) - ended)
    wrong, rows = _wrong_rows(session, folder, trace, failed)
    beyond, done = _excursion(after, drill), drill or Drill("none", lambda device: None)
    return Outcome(done, session, detected, off, beyond, wrong, rows, session.advice)


def _excursion(after: list[Any], drill: Drill | None) -> float:
    """Return how far the truth went beyond what a session without a fault does [K]."""
    if drill is None or not after:
        return 0.0
    bounds = {"t_surface": (_START - 0.5, _TARGET + 0.5), "t_tank": (_START - 0.5, _TARGET + 4.0)}
    worst = 0.0
    for moment in after:
        for name, (low, high) in bounds.items():
            value = moment.temperatures[name]
            worst = max(worst, value - high, low - value)
    return worst


def _wrong_rows(session: Session, folder: Path, trace: list[Any], failed: float) -> tuple[int, int]:
    """Return rows on disk that are wrong or missing, and how many there are."""
    log, times = read_run(folder).log, [moment.time_s for moment in trace]
    if log is None:
        return session.log.sizes["time"], 0
    n = log.sizes["time"]
    wrong = abs(session.log.sizes["time"] - n)
    same = min(n, session.log.sizes["time"])
    for name in ("t_tank", "t_surface"):
        on_disk, in_memory = log[name].values[:same], session.log[name].values[:same]
        wrong += int(np.sum(~np.isclose(on_disk, in_memory, atol=1e-6, equal_nan=True)))
        for at, value in zip(log["time"].values.tolist(), log[name].values.tolist()):
            if failed == failed and at > failed:
                break
            k = min(max(bisect_right(times, at) - 1, 0), len(trace) - 1)
            wrong += int(abs(value - trace[k].temperatures[name]) > _NEAR_K)
    return wrong, n
