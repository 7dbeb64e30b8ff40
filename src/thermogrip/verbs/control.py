"""tune, review, export, run: from a plant to a controller, and through a session on the simulated rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermogrip.console import Console
from thermogrip.datasets.errors import UserError
from thermogrip.verbs.common import (
    ANSWER_IS_NO,
    AsJson,
    Cluster,
    OwnNetwork,
    Report,
    Seed,
    Workers,
    choice,
    crew,
    find_network,
    load_plant,
    new_file,
    new_folder,
)
from thermogrip.verbs.rig import GuardOption, LearnOption, guard_of

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc import Controller
    from thermogrip.mpc.recorded import Watched
    from thermogrip.rig import Rig, Session, Twin
    from thermogrip.rig.clock import ScaledClock

__all__ = ["export", "load_controller", "review", "rig_of", "run", "tune"]

LOWEST_TARGET, HIGHEST_TARGET = 10.0, 50.0  # degC, of the skin

ControllerFile = Annotated[
    Path, typer.Argument(metavar="CONTROLLER", show_default=False, help="controller.json of tune.")
]

TargetOption = Annotated[
    str,
    typer.Option(
        "--target",
        metavar="DEGC",
        show_default=False,
        help="Skin temperature at contact, 10 to 50; of several outputs t1=40,t2=35.",
    ),
]
OutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", show_default=False, help="Folder of the run.")
]
TwinOption = Annotated[
    Path | None,
    typer.Option("--twin", metavar="PLANT", help="Simulate this plant; no hardware is opened."),
]
PortOption = Annotated[
    str | None,
    typer.Option("--port", metavar="DEV", help="The rig: /dev/ttyACM0, COM3, socket://HOST:PORT."),
]
ProtocolOption = Annotated[
    str | None, typer.Option("--protocol", metavar="NAME", help="thermogrip or tclab [default: found out].")
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
        help="End the contact once this classifier (train --stop-error) has seen enough.",
    ),
]
SettleTimeoutOption = Annotated[
    float, typer.Option("--settle-timeout", metavar="S", min=1, help="Give up settling after this long.")
]


def tune(
    plant: Annotated[
        Path, typer.Argument(metavar="PLANT", show_default=False, help="plant.json of identify.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE.json", show_default=False, help="Where the controller goes."),
    ],
    spec: Annotated[
        Path | None,
        typer.Option(
            "--spec", metavar="SPEC.toml", help="What is wanted; `thermogrip init spec` writes one to edit."
        ),
    ] = None,
    report: Report = None,
    network: OwnNetwork = None,
    seed: Seed = 0,
    workers: Workers = 1,
    cluster: Cluster = None,
    as_json: AsJson = False,
) -> int:
    """Find the MPC's weights for what you want.

    You say settling time, overshoot, energy. Runs closed loops on posterior draws of the plant; shows
    baseline, tuned, PI and LQR side by side, what can be traded, and which weights matter.
    """
    from thermogrip.control_pages import TUNING_HEAD, tuning_rows, tuning_sections
    from thermogrip.mpc import Spec, read_spec
    from thermogrip.mpc import tune as search
    from thermogrip.mpc.sensitivity import sensitivity_words
    from thermogrip.report import write_report

    hands = crew(workers, cluster)
    loaded = load_plant(plant, network)
    wanted = Spec() if spec is None else read_spec(spec)
    new_file(out, (".json",))
    if report is not None:
        new_file(report, (".html",))
    console = Console(as_json)
    with console.progress("tune") as progress, _naming(spec, tuple(Spec.model_fields)):
        found = search(loaded, wanted, progress=progress, workers=hands, seed=seed)
    found.save(out)
    if report is not None:
        lead = f"A controller for {plant.name}, tuned in simulation on draws of the plant."
        write_report(report, "Tuning", lead, tuning_sections(found))
    console.table("Closed loops on draws of the plant", TUNING_HEAD, tuning_rows(found))
    console.say(f"{found.verdict}: {found.finding}")
    words = sensitivity_words(found.sensitivity)
    for line in words:
        console.say(line)
    meets = "meets" if found.meets_spec else "does not meet"
    console.say(f"The controller {meets} the spec on every draw; wrote {out}")
    result = {"verdict": found.verdict, "finding": found.finding, "meets_spec": found.meets_spec}
    result |= {"scores": found.scores, "rows": [asdict(row) for row in found.rows]}
    result |= {"sensitivity": [asdict(item) for item in found.sensitivity], "in_words": words}
    console.answer({**result, "pareto": found.pareto.rows(), "out": out, "report": report})
    return 0 if found.meets_spec else ANSWER_IS_NO


@contextmanager
def _naming(spec: Path | None, keys: tuple[str, ...]) -> Iterator[None]:
    """Name the spec's file in an error about one of its keys that only the plant could tell."""
    try:
        yield
    except UserError as error:
        if spec is None or error.file is not None or error.problem.split(":")[0] not in keys:
            raise
        raise UserError(error.problem, file=spec, mend=error.mend) from error


def review(
    controller: ControllerFile,
    report: Report = None,
    network: OwnNetwork = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Check a controller's design.

    Each check passes, warns or fails, and says the fix.
    """
    from thermogrip.mpc import review as check
    from thermogrip.pages import review_section
    from thermogrip.report import write_report

    if report is not None:
        new_file(report, (".html",))
    console = Console(as_json)
    checks = check(load_controller(controller, network))
    if report is not None:
        lead = f"The design of {controller.name}, checked without the rig."
        write_report(report, "Design review", lead, [review_section(checks)])
    rows = [(c.name, c.verdict, c.finding, c.fix) for c in checks]
    console.table(f"Review of {controller.name}", ("check", "verdict", "finding", "fix"), rows)
    if report is not None:
        console.say(f"wrote {report}")
    failed = any(c.verdict == "fail" for c in checks)
    console.answer({"passed": not failed, "checks": [asdict(c) for c in checks], "report": report})
    return ANSWER_IS_NO if failed else 0


def export(
    controller: ControllerFile,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", show_default=False, help="Folder of the C files.")
    ],
    check: Annotated[
        bool, typer.Option("--check", help="Build it (gcc) and compare it with Python on random states.")
    ] = False,
    states: Annotated[int, typer.Option("--states", min=1, help="Random states of --check.")] = 10_000,
    network: OwnNetwork = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Write a controller as C99 without malloc.

    The folder needs a C compiler and nothing of thermogrip: library, example, Makefile, README.
    """
    from thermogrip.mpc.export import check_export, export_controller

    console = Console(as_json)
    loaded = load_controller(controller, network)
    written = export_controller(loaded, new_folder(out))
    console.say(
        f"Wrote {len(written.files)} files to {out}: {written.ram} bytes of RAM a controller, "
        f"{written.constants} of constants."
    )
    result: dict[str, Any] = {"out": out, "ram": written.ram, "constants": written.constants}
    if not check:
        console.answer(result)
        return 0
    with console.progress("check") as progress:
        found = check_export(written, loaded, states=states, seed=seed, progress=progress)
    console.say(
        f"{found.states} random states under the sanitizers: drives differ by at most {found.difference:.1e} "
        f"of their range ({found.free} of them at no limit), same status in {found.same_status}, "
        f"same iterations in {found.same_iterations}. "
        f"Flash {found.flash} bytes, largest stack frame {found.stack} bytes."
    )
    console.say("C and Python do the same." if found.passed else "C and Python differ.")
    console.answer({**result, **asdict(found), "passed": found.passed})
    return 0 if found.passed else ANSWER_IS_NO


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
    from thermogrip.mpc.checks_range import beyond_logs
    from thermogrip.mpc.recorded import Watched
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.recorder import RunFolder
    from thermogrip.rig.session import run_session

    wanted, grasp = _targets(target), _what_to_grasp(obj, material)
    stop = None if stop_early is None else _stop(stop_early, grasp)
    if (twin is None) == (port is None):
        given = "no rig is given" if twin is None else "--port and --twin are both given"
        raise UserError(given, mend="give --port DEV, or --twin PLANT to simulate")
    if report is not None:
        new_file(report, (".html",))
    loaded = load_controller(controller, network)
    regulator, wanted = Watched(loaded), _for_outputs(wanted, loaded.controlled)
    watch = guard_of(guard, loaded.plant, learn)
    clock = ScaledClock(speed)
    rig = rig_of(port, protocol, clock, twin, network, draw, loaded, seed=seed, t_start=start)
    console = Console(as_json)
    for line in beyond_logs(loaded, wanted):
        console.warn(line)
    name = f"{twin.name}, draw {draw}" if twin is not None else str(port)
    about: dict[str, Any] = {"controller": controller.name, "target_degC": wanted}
    about |= {"port": port} if twin is None else {"twin": twin.name, "draw": draw}
    about |= {"from_degC": start, "hold_s": hold, "object_degC": obj, "material": material, "seed": seed}
    try:
        known = learn if learn is not None and learn.exists() else None
        named = {"controller": controller, "plant": twin, "guard": guard, "learn": known}
        files = {name: path for name, path in named.items() if path is not None}
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
    from thermogrip.classify.stream import session_stop

    if grasp is None:
        raise UserError("--stop-early without a grasp", mend="give --object and --material too")
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


def _report(path: Path, session: Session, regulator: Watched, controller: Controller, rig: str) -> None:
    """Write the page of a session."""
    from thermogrip.control_pages import session_sections
    from thermogrip.report import write_report

    lead = f"One session on {rig}: what was read, asked and answered, sample by sample."
    write_report(path, "A session", lead, session_sections(session, regulator.moves, controller, rig))


def load_controller(path: Path, network: str | None) -> Controller:
    """Return a controller; ``network`` is the class of its plant, where that is the user's own."""
    from thermogrip.mpc import Controller

    return Controller.load(path, model=None if network is None else find_network(network))


def rig_of(
    port: str | None, protocol: str | None, clock: ScaledClock, twin: Path | None, network: str | None,
    draw: int, controller: Controller, *, seed: int, t_start: float | None,
) -> Rig:  # fmt: skip
    """Return the rig on a port, or the simulated one."""
    from thermogrip.rig.opening import open_rig

    if twin is not None:
        return _twin(twin, network, draw, controller, seed=seed, t_start=t_start)
    if t_start is not None or draw:
        raise UserError("--from and --draw are of the twin", mend="leave them away with --port")
    spoken = None if protocol is None else choice("--protocol", protocol, ("thermogrip", "tclab"))
    rig = open_rig(str(port), spoken, clock=clock, sleep=clock.sleep)
    lacking = set(controller.plant.inputs) - set(rig.units) - {"pump"}
    if lacking:
        rig.close()
        have = ", ".join(rig.units)
        raise UserError(f"the rig drives {have}, not {', '.join(lacking)}", mend="use its own controller")
    return rig


def _twin(
    path: Path, network: str | None, draw: int, controller: Controller, *, seed: int, t_start: float | None
) -> Twin:
    """Return the simulated rig; a drive whose unit says no range has the controller's."""
    from thermogrip.rig.twin import Twin
    from thermogrip.sysid.plant import Plant

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
        raise UserError(problem, mend="write one [degC], or t1=40,t2=35 for several outputs") from None
    if isinstance(values, dict) and len(values) <= target.count(","):
        raise UserError(f"'--target' {target!r} names an output twice", mend="give each one target")
    for value in values.values() if isinstance(values, dict) else (values,):
        if not LOWEST_TARGET <= value <= HIGHEST_TARGET:
            mend = f"choose one from {LOWEST_TARGET:g} to {HIGHEST_TARGET:g} degC"
            raise UserError(f"--target {value:g} degC is outside the rig's range", mend=mend)
    return values


def _for_outputs(target: float | dict[str, float], controlled: tuple[str, ...]) -> float | dict[str, float]:
    """Return the target of each regulated output; a single number is for all of them."""
    if isinstance(target, dict) and set(target) != set(controlled):
        mend = f"give one for each of {', '.join(controlled)}"
        raise UserError(f"--target names {', '.join(target)}", mend=mend)
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
            "one of --object and --material is missing", mend="give both, or none to regulate only"
        )
    if obj is None or material is None:
        return None
    return find_material(material).name, obj
