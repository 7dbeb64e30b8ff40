"""What a device does when the program that drives it is stopped, killed or broken.

The host is a process of its own that runs a session on a virtual device over a pty; the device lives here,
its clock ``speed`` times the computer's.  No line of ours runs in a killed or stopped host, so zero drive
within the device's 2 s is the device's own doing (a TCLab's firmware has no such time: it heats on until
somebody switches it off).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.rig.fault_injection.drills import drill_plants
from thermogrip.datasets.errors import UserError
from thermogrip.rig.clock import ScaledClock
from thermogrip.rig.records.run_folder import Run, read_run
from thermogrip.rig.simulation.virtual_device import Moment, VirtualDevice

SPEED = 2.0  # a loaded computer holds up a host for some tenths of a real second
ROWS = 6  # on disk, before anything is done to the host
_READY_S, _END_S = 90.0, 60.0  # real seconds: a computer may be slow
_HOST = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts behind itself ignores Ctrl-C
from pathlib import Path
from thermogrip.mpc.interface import Move
from thermogrip.rig.records import run_folder
from thermogrip.rig.clock import ScaledClock
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.serial.port import Port
from thermogrip.rig.records.run_folder import RunFolder
from thermogrip.rig.session.session import run_session

class Full:
    dt, steps = 0.5, 0
    def reset(self, reading): pass
    def step(self, reading, target):
        self.steps += 1
        if sys.argv[4] == "raise" and self.steps > 8:
            raise ArithmeticError("the controller broke")
        return Move(drive=0.8)

clock = ScaledClock(float(sys.argv[3]))
rig = DeviceRig(Port(sys.argv[1], clock=clock), clock=clock, sleep=clock.sleep)
if sys.argv[4] == "fill":
    write, left = run_folder._write_bytes, [700]
    def full(file, data):
        left[0] -= len(data)
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        return write(file, data)
    run_folder._write_bytes = full
try:
    with RunFolder(sys.argv[2]) as folder:
        session = run_session(rig, Full(), 45.0, guard=Guard(), clock=clock, recorder=folder)
        folder.finish(session)
    sys.exit(3 if session.trip else 0)
finally:
    rig.close()
"""


@dataclass(frozen=True)
class HostDrill:
    """One way in which a host fails."""

    name: str
    act: Callable[[int, str], str] | None  # what is done to the process (its id) and the port; None: nothing
    how: str = ""  # what the host does by itself: ``raise``, ``fill`` (its disk)
    dead: bool = False  # it can do nothing about it


@dataclass(frozen=True)
class HostOutcome:
    """What a drill showed."""

    drill: HostDrill
    off: float  # from the fault, or a later order that reached the device, to zero drive [s, its clock]
    excursion: float  # how much warmer the water got after the fault [K]
    rows: int  # on disk ...
    wrong: int  # ... and of those, not what the device measured
    run: Run
    returned: int  # the host's exit status
    said: str  # by it, or by whoever came second


def _send(number: int) -> Callable[[int, str], str]:
    def act(process: int, port: str) -> str:
        os.kill(process, number)
        return ""

    return act


def _freeze(process: int, port: str) -> str:
    os.kill(process, signal.SIGSTOP)
    time.sleep(5.0 / SPEED)  # its drive lives 2 s
    os.kill(process, signal.SIGCONT)
    return ""


def _second(process: int, port: str) -> str:
    """Open the port as a second program of ours would."""
    from thermogrip.rig.serial.port import Port

    try:
        Port(port).open()
    except UserError as error:
        os.kill(process, signal.SIGINT)
        return str(error)
    return "it was opened twice"


#: Every way that is tried.
HOST_DRILLS: tuple[HostDrill, ...] = (
    HostDrill("host killed (kill -9)", _send(signal.SIGKILL), dead=True),
    HostDrill("host frozen for 5 s (SIGSTOP)", _freeze, dead=True),
    HostDrill("host asked to end (SIGTERM)", _send(signal.SIGTERM)),
    HostDrill("Ctrl-C", _send(signal.SIGINT)),
    HostDrill("controller raises an exception", None, how="raise"),
    HostDrill("disk full", None, how="fill"),
    HostDrill("a second program opens the port", _second),
)


def run_host_drill(drill: HostDrill, folder: Path) -> HostOutcome:
    """Run one drill into a run folder and return what it showed."""
    clock = ScaledClock(SPEED)
    _, real = drill_plants()
    with VirtualDevice(real, clock=clock, ambient=25.0, t_start=25.0, seed=1) as device:
        words = [sys.executable, "-c", _HOST, device.port, str(folder), str(SPEED), drill.how]
        host = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            _wait(lambda: device.truth().drive["drive"] > 0.5, _READY_S, host)
            said = ""
            if drill.act is not None:
                _wait(lambda: (folder / "samples.csv").read_text().count("\n") > ROWS, _READY_S, host)
                at = device.time
                said = drill.act(host.pid, device.port)
            errors = host.communicate(timeout=_END_S)[1]
            _wait(lambda: device.truth().drive["drive"] == 0.0, _END_S, None)
        finally:
            host.kill()
            host.wait()
        trace, ordered = list(device.trace), device.ordered
    on = [m.time_s for m in trace if any(m.drive.values())]
    last_on, run = on[-1], read_run(folder)
    if drill.act is None:  # it failed by itself, after its last row
        at = on[0] + _driven_for(run)
    before = [m for m in trace if m.time_s <= at]
    excursion = max(m.temperatures["t_tank"] for m in trace) - before[-1].temperatures["t_tank"]
    rows = 0 if run.log is None else run.log.sizes["time"]
    lines = errors.strip().splitlines()
    said = said or (run.about.get("advice") or (lines[-1] if lines else ""))
    off = max(0.0, last_on - max(at, ordered))
    return HostOutcome(drill, off, excursion, rows, _wrong(run, trace), run, host.returncode, said)


def _driven_for(run: Run) -> float:
    """Return how long it drove until its last row [s, the host's clock]."""
    if run.log is None:
        return 0.0
    times = run.log["time"].values
    return float(times[-1] - times[run.log["drive"].values > 0][0])


def _wrong(run: Run, trace: list[Moment]) -> int:
    """Return rows whose tank is no temperature that the water had in this session."""
    if run.log is None:
        return 1
    truths = [m.temperatures["t_tank"] for m in trace]
    values = run.log["t_tank"].values
    finite = values[values == values]
    return int(((finite < min(truths) - 0.5) | (finite > max(truths) + 0.5)).sum())


def _wait(done: Callable[[], bool], seconds: float, host: subprocess.Popen[str] | None) -> None:
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end or (host is not None and host.poll() is not None):
            error = "" if host is None or host.poll() is None else host.communicate()[1][-500:]
            raise RuntimeError(f"the drill did not come so far: {error or 'it took too long'}")
        time.sleep(0.02)
