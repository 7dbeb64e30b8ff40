"""run: one session on the rig or on its twin; and the options that every session shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermogrip.cli.control import ControllerFile, load_controller
from thermogrip.cli.options import (
    ANSWER_IS_NO,
    PROTOCOLS,
    AsJson,
    OwnNetwork,
    Report,
    Seed,
    existing_model,
    existing_plant,
    load_plant,
    new_file,
    one_of,
)
from thermogrip.cli.rig import GuardOption, LearnOption, guard_of
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console
from thermogrip.rig.session.signals import stop_signals

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc.closed_loop.simulate import RecordedController
    from thermogrip.mpc.controllers.mpc import Controller
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.interface import Rig
    from thermogrip.rig.session.session import Session
    from thermogrip.rig.simulation.twin import Twin

__all__ = ["files_of", "one_rig", "rig_of", "run"]

LOWEST_TARGET, HIGHEST_TARGET = 10.0, 50.0  # degC, of the skin

TargetOption = Annotated[
    str,
    typer.Option(
        "--target",
        metavar="DEGC",
        show_default=False,
        callback=lambda value: (_targets(value), value)[1],  # refused before a file is looked for
        help="Skin temperature at contact, 10 to 50; of several outputs t1=40,t2=35.",
    ),
]
OutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", show_default=False, help="Folder of the run.")
]
TwinOption = Annotated[
    Path | None,
    typer.Option(
        "--twin", metavar="PLANT", callback=existing_plant, help="Simulate this plant; no hardware is opened."
    ),
]
PortOption = Annotated[
    str | None,
    typer.Option("--port", metavar="DEV", help="The rig: /dev/ttyACM0, COM3, socket://HOST:PORT."),
]
ProtocolOption = Annotated[
    str | None,
    typer.Option(
        "--protocol",
        metavar="NAME",
        callback=one_of("--protocol", PROTOCOLS),
        help="thermogrip or tclab [default: found out].",
    ),
]
SpeedOption = Annotated[
    float,
    typer.Option("--speed", metavar="X", min=0.01, help="With --port: that of a virtual device."),
]
DrawOption = Annotated[
    int, typer.Option("--draw", min=0, help="Posterior draw of the twin's plant (0: the fit).")
]
StartOption = Annotated[
    float | None,
    typer.Option("--from", metavar="DEGC", help="Temperature at the start [default: the room's]."),
]
HoldOption = Annotated[
    float, typer.Option("--hold", metavar="S", min=0, help="Regulate this long after settling.")
]
ObjOption = Annotated[
    float | None, typer.Option("--object", metavar="DEGC", help="Temperature of the object.")
]
MaterialOption = Annotated[
    str | None, typer.Option("--material", metavar="NAME", help="Material of the object.")
]
GraspTimeOption = Annotated[
    float, typer.Option("--grasp-time", metavar="S", min=0.5, help="Recorded time of contact.")
]
StopEarlyOption = Annotated[
    Path | None,
    typer.Option(
        "--stop-early",
        metavar="MODEL_DIR",
        callback=existing_model,
        help="End the contact once this classifier (train --stop-error) has seen enough.",
    ),
]
SettleTimeoutOption = Annotated[
    float, typer.Option("--settle-timeout", metavar="S", min=1, help="Give up settling after this long.")
]


@stop_signals()
def run(
    controller: ControllerFile,
    target: TargetOption,
    out: OutOption,
    port: PortOption = None,
    protocol: ProtocolOption = None,
    speed: SpeedOption = 1.0,
    twin: TwinOption = None,
    draw: DrawOption = 0,
    start: StartOption = None,
    hold: HoldOption = 0.0,
    obj: ObjOption = None,
    material: MaterialOption = None,
    grasp_time: GraspTimeOption = 10.0,
    stop_early: StopEarlyOption = None,
    settle_timeout: SettleTimeoutOption = 900.0,
    guard: GuardOption = None,
    learn: LearnOption = None,
    report: Report = None,
    network: OwnNetwork = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Bring the skin to a temperature, stop the pump, grasp, record.

    Drive and pump are switched off on every way out, Ctrl-C included. With --object and --material it grasps
    after settling; without them it only regulates.
    """
    wanted, grasp = _targets(target), _what_to_grasp(obj, material)
    one_rig(port, twin)
    from thermogrip.mpc.closed_loop.simulate import RecordedController
    from thermogrip.mpc.design_review import beyond_logs
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.records.recorder import RunFolder
    from thermogrip.rig.session.session import run_session

    stop = None if stop_early is None else _stop(stop_early, grasp)
    if report is not None:
        new_file(report, (".html",))
    loaded = load_controller(controller, network)
    regulator, wanted = RecordedController(loaded), _for_outputs(wanted, loaded.controlled)
    watch = guard_of(guard, loaded.plant, learn)
    clock, console = ScaledClock(speed), Console(as_json)
    name = f"{twin.name}, draw {draw}" if twin is not None else str(port)
    about: dict[str, Any] = {"controller": controller.name, "target_degC": wanted}
    about |= {"port": port} if twin is None else {"twin": twin.name, "draw": draw}
    about |= {"from_degC": start, "hold_s": hold, "object_degC": obj, "material": material, "seed": seed}
    files = files_of(learn, controller=controller, plant=twin, guard=guard)
    rig = rig_of(port, protocol, clock, twin, network, draw, loaded, seed=seed, t_start=start)
    try:
        for line in beyond_logs(loaded, wanted, grasps=grasp is not None):
            console.warn(line)
        with RunFolder(out, about, files=files) as folder, console.progress("run") as progress:
            session = run_session(
                rig,
                regulator,
                wanted,
                output=loaded.controlled[0],
                hold=hold,
                grasp=grasp,
                grasp_time=grasp_time,
                stop=stop,
                settle_timeout=settle_timeout,
                guard=watch,
                clock=None if port is None else clock,
                recorder=folder,
                progress=progress,
            )
            folder.finish(session)
    finally:
        rig.close()
    if report is not None:
        _report(report, session, regulator, loaded, name)
    return _show_session(console, session, f"{name}, to {_said(wanted)} degC", out)


def _stop(model_dir: Path, grasp: tuple[str, float] | None) -> Callable[[Grasps], bool]:
    """Return what ends a contact: the rig asks it and knows nothing else of classifiers."""
    from thermogrip.classify.decisions.online import session_stop

    if grasp is None:
        raise UserError("--stop-early without a grasp", hint="give --object and --material too")
    return session_stop(model_dir)


def _show_session(console: Console, session: Session, title: str, out: Path) -> int:
    """Print how a session went and return the exit code."""
    figures = {"settle_time": session.settle_time, "overshoot": session.overshoot, "bias": session.bias}
    head = ["verdict", "settled after [s]", "overshoot [K]", "bias [K]"]
    console.table(title, head, [[session.verdict, *figures.values()]])
    if session.advice:
        console.say(session.advice)
    console.say(f"wrote {out}")
    console.answer({"verdict": session.verdict, "advice": session.advice, **figures, "out": out})
    return 0 if session.verdict == "settled" else ANSWER_IS_NO


def _report(
    path: Path, session: Session, regulator: RecordedController, controller: Controller, rig: str
) -> None:
    """Write the page of a session."""
    from thermogrip.report.control import session_sections
    from thermogrip.report.html import write_report

    lead = f"One session on {rig}: what was read, asked and answered, sample by sample."
    write_report(path, "A session", lead, session_sections(session, regulator.moves, controller, rig))


def one_rig(port: str | None, twin: Path | None) -> None:
    """Raise UserError unless either hardware or a plant to simulate is named."""
    if (twin is None) == (port is None):
        given = "no rig is given" if twin is None else "--port and --twin are both given"
        raise UserError(given, hint="give --port DEV, or --twin PLANT to simulate")


def files_of(learn: Path | None, **named: Path | None) -> dict[str, Path]:
    """Return the files that a run is made from, those that are named; what is learnt may not be there yet."""
    known = learn if learn is not None and learn.exists() else None
    return {name: path for name, path in {**named, "learn": known}.items() if path is not None}


def rig_of(
    port: str | None, protocol: str | None, clock: ScaledClock, twin: Path | None, network: str | None,
    draw: int, controller: Controller, *, seed: int, t_start: float | None,
) -> Rig:  # fmt: skip
    """Return the rig on a port, or the simulated one."""
    from thermogrip.rig.drivers.connect import open_rig

    if twin is not None:
        return _twin(twin, network, draw, controller, seed=seed, t_start=t_start)
    if t_start is not None or draw:
        raise UserError("--from and --draw are of the twin", hint="leave them away with --port")
    rig = open_rig(str(port), protocol, clock=clock, sleep=clock.sleep)
    lacking = set(controller.plant.inputs) - set(rig.units) - {"pump"}
    if lacking:
        rig.close()
        have = ", ".join(rig.units)
        raise UserError(f"the rig drives {have}, not {', '.join(lacking)}", hint="use its own controller")
    return rig


def _twin(
    path: Path, network: str | None, draw: int, controller: Controller, *, seed: int, t_start: float | None
) -> Twin:
    """Return the simulated rig; a drive whose unit says no range has the controller's."""
    from thermogrip.rig.simulation.twin import Twin
    from thermogrip.sysid.plant.plant import Plant

    try:
        plant = Plant.load(path)
    except UserError:
        if network is None:
            raise
        plant = load_plant(path, network)
    known = ("1", "percent", "0_255")
    ranges = controller.design.drive_range
    limits = {name: ends for name, ends in ranges.items() if plant.units.get(name, "1") not in known}
    return Twin(plant.draw(draw), seed=seed, t_start=t_start, limits=limits)


def _targets(target: str) -> float | dict[str, float]:
    """Return one target or targets by output ("38", "t1=40,t2=35"), inside what a skin may be brought to."""
    try:
        if "=" in target:
            pairs = [part.split("=") for part in target.split(",")]
            values: float | dict[str, float] = {name.strip(): float(value) for name, value in pairs}
        else:
            values = float(target)
    except ValueError:
        problem = f"'--target' {target!r} is no temperature"
        raise UserError(problem, hint="write one [degC], or t1=40,t2=35 for several outputs") from None
    if isinstance(values, dict) and len(values) <= target.count(","):
        raise UserError(f"'--target' {target!r} names an output twice", hint="give each one target")
    for value in values.values() if isinstance(values, dict) else (values,):
        if not LOWEST_TARGET <= value <= HIGHEST_TARGET:
            hint = f"choose one from {LOWEST_TARGET:g} to {HIGHEST_TARGET:g} degC"
            raise UserError(f"--target {value:g} degC is outside the rig's range", hint=hint)
    return values


def _for_outputs(target: float | dict[str, float], controlled: tuple[str, ...]) -> float | dict[str, float]:
    """Return the target of each regulated output; a single number is for all of them."""
    if isinstance(target, dict) and set(target) != set(controlled):
        hint = f"give one for each of {', '.join(controlled)}"
        raise UserError(f"--target names {', '.join(target)}", hint=hint)
    if isinstance(target, float) and len(controlled) > 1:
        return dict.fromkeys(controlled, target)
    return target


def _said(target: float | dict[str, float]) -> str:
    """Return targets in words."""
    if isinstance(target, dict):
        return ", ".join(f"{name} {value:g}" for name, value in target.items())
    return f"{target:g}"


def _what_to_grasp(obj: float | None, material: str | None) -> tuple[str, float] | None:
    """Return material and object temperature, checked, None where nothing is grasped."""
    from thermogrip.datasets.materials import find_material

    if (obj is None) != (material is None):
        raise UserError(
            "one of --object and --material is missing", hint="give both, or none to regulate only"
        )
    if obj is None or material is None:
        return None
    return find_material(material).name, obj
