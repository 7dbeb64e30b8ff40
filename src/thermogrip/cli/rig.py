"""record, virtual: a schedule played on a rig, and a rig that is not there."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermogrip.cli.options import (
    ANSWER_IS_NO,
    PROTOCOLS,
    AsJson,
    Seed,
    choice,
    existing,
    existing_plant,
    new_file,
    one_of,
)
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console
from thermogrip.rig.session.signals import check_stopped, stop_signals

if TYPE_CHECKING:
    from thermogrip.rig.guard.guard import Guard
    from thermogrip.rig.guard.plant_mismatch import PlantDrift
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["GuardOption", "LearnOption", "guard_of", "record", "virtual"]


GuardOption = Annotated[
    Path | None,
    typer.Option(
        "--guard",
        metavar="GUARD.toml",
        help="What the guard allows; `thermogrip init guard` writes one to edit.",
    ),
]

LearnOption = Annotated[
    Path | None,
    typer.Option(
        "--learn",
        metavar="RIG.json",
        help="Let the guard learn from this rig's first healthy sessions how far it is from the plant.",
    ),
]


@stop_signals()
def record(
    schedule: Annotated[
        str,
        typer.Argument(
            metavar="SCHEDULE", show_default=False, callback=existing, help="schedule.csv of excite."
        ),
    ],
    port: Annotated[
        str,
        typer.Option(
            "--port", metavar="DEV", show_default=False, help="/dev/ttyACM0, COM3, socket://HOST:PORT."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", show_default=False, help="Folder of the run.")],
    protocol: Annotated[
        str | None,
        typer.Option(
            "--protocol",
            metavar="NAME",
            callback=one_of("--protocol", PROTOCOLS),
            help="thermogrip or tclab [default: found out].",
        ),
    ] = None,
    dt: Annotated[float, typer.Option("--sample", metavar="S", min=0.05, help="Seconds a row.")] = 1.0,
    guard: GuardOption = None,
    speed: Annotated[
        float, typer.Option("--speed", metavar="X", min=0.01, help="That of a virtual device of --speed X.")
    ] = 1.0,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Play a schedule on a rig and record the log.

    identify reads samples.csv of the folder. Everything is switched off on every way out, Ctrl-C included.
    """
    from thermogrip.datasets.log_files import read_log
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.drivers.connect import open_rig
    from thermogrip.rig.records.recorder import RunFolder
    from thermogrip.rig.session.schedule_player import Playback, play

    plan = read_log(schedule)
    watch = guard_of(guard, None)
    console = Console(as_json)
    clock = ScaledClock(speed)
    rig = open_rig(port, protocol, clock=clock, sleep=clock.sleep)
    try:
        try:  # what it cannot play is refused before there is a folder
            Playback(plan, rig.units, dt)
        except UserError as error:
            raise UserError(error.problem, file=schedule, hint=error.hint) from error
        about = {"schedule": schedule, "port": port, "sample_s": dt, "seed": seed}
        files = {} if guard is None else {"guard": guard}
        with RunFolder(out, about, files=files) as folder, console.progress("record") as progress:
            log, ended = play(rig, plan, dt=dt, guard=watch, clock=clock, recorder=folder, progress=progress)
            folder.played(ended)
    finally:
        rig.close()
    if ended:
        console.say(ended)
    console.say(f"wrote {log.sizes['time']} rows to {out / 'samples.csv'}")
    console.answer({"rows": log.sizes["time"], "ended": ended, "out": out})
    return ANSWER_IS_NO if ended else 0


def guard_of(path: Path | None, plant: Plant | None, learn: Path | None = None) -> Guard:
    """Return the guard of a rig; what no file says is as by default."""
    from thermogrip.rig.guard.guard import Guard, GuardSettings
    from thermogrip.rig.guard.settings import read_guard

    settings = GuardSettings() if path is None else read_guard(path)
    drift = None if learn is None or plant is None else _drift_of(learn, plant, settings.model.drift)
    return Guard(plant, settings, drift=drift)


def _drift_of(path: Path, plant: Plant, stated: float) -> PlantDrift:
    """Return what a file knows of the rig, nothing yet where it is to be made."""
    from thermogrip.rig.guard.plant_mismatch import USUAL_DRIFT, PlantDrift

    new_file(path, (".json",))
    if not path.exists():
        return PlantDrift.unknown(plant, stated or USUAL_DRIFT, file=path)
    found = PlantDrift.load(path, plant)
    if stated and stated != found.drift:
        problem = f"was learnt with a drift of {found.drift:g}, the guard file says {stated:g}"
        raise UserError(problem, file=path, hint="make them agree, or learn into another file")
    return found


def virtual(
    protocol: Annotated[
        str,
        typer.Option(
            "--protocol",
            metavar="NAME",
            callback=one_of("--protocol", PROTOCOLS),
            help="thermogrip or tclab.",
        ),
    ] = "thermogrip",
    plant: Annotated[
        Path | None,
        typer.Option(
            "--plant",
            metavar="PLANT",
            callback=existing_plant,
            help="plant.json of identify [default: a bundled network].",
        ),
    ] = None,
    pty: Annotated[bool, typer.Option("--pty", help="On a pseudo-terminal, as a serial port.")] = False,
    socket: Annotated[
        int | None,
        typer.Option("--socket", metavar="PORT", min=0, max=65535, help="On a TCP port of this computer."),
    ] = None,
    speed: Annotated[
        float, typer.Option("--speed", metavar="X", min=0.01, help="Its time runs X times as fast.")
    ] = 1.0,
    start: Annotated[
        float | None,
        typer.Option("--from", metavar="DEGC", help="Temperature at the start [default: the room's]."),
    ] = None,
    ambient: Annotated[
        float, typer.Option("--ambient", metavar="DEGC", help="Temperature of the room.")
    ] = 23.0,
    obj: Annotated[
        float | None, typer.Option("--object", metavar="DEGC", help="Temperature of what is grasped.")
    ] = None,
    material: Annotated[
        str | None, typer.Option("--material", metavar="NAME", help="Material of what is grasped.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="S:NAME", help="After S seconds let NAME fail; may be repeated."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", metavar="S", min=0, help="End after this long.")
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Be a device: our firmware or a TCLab, with a simulated plant behind it.

    Prints the name of the port and serves until Ctrl-C. Faults: sensor_open, sensor_short, sensor_stuck,
    sensor_drift, sensor_lag, garbage, silence, reset, pump_stall, driver_stuck, cable_pulled, ...
    """
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.simulation.virtual_device import VirtualDevice
    from thermogrip.sysid.plant.plant import Plant

    if pty and socket is not None:
        raise UserError("--pty and --socket are both given", hint="give one")
    due = sorted(_fault(text) for text in fault or [])
    device = VirtualDevice(
        None if plant is None else Plant.load(plant),
        protocol=protocol,
        link="pty" if socket is None else "socket",
        socket_port=socket or 0,
        clock=ScaledClock(speed),
        seed=seed,
        ambient=ambient,
        t_start=start,
    )
    if material is not None and obj is not None:
        device.place(material, obj)
    console = Console(as_json)
    with stop_signals(), device:  # also a SIGTERM takes the port away
        console.say(device.port)
        console.answer({"port": device.port, "protocol": protocol})
        sys.stdout.flush()  # whoever started this waits for the name
        while seconds is None or device.time < seconds:
            check_stopped()
            while due and device.time >= due[0][0]:
                device.fault(due.pop(0)[1])
            time.sleep(0.05)
    return 0


def _fault(text: str) -> tuple[float, str]:
    """Return when and what, of ``60:sensor_open``."""
    from thermogrip.rig.simulation.virtual_device import FAULTS

    when, _, name = text.partition(":")
    try:
        at = float(when)
    except ValueError:
        at = float("nan")
    if not 0 <= at < float("inf"):
        raise UserError(f"--fault {text!r} has no time", hint="write 60:sensor_open")
    return at, choice("--fault", name, tuple(FAULTS))
