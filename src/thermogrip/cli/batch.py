"""batch, recover: grasps by a plan, run after run; and a run that was cut off, repaired."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermogrip.cli.control import ControllerFile, load_controller
from thermogrip.cli.options import ANSWER_IS_NO, AsJson, OwnNetwork, Seed, existing, new_file, new_folder
from thermogrip.cli.rig import GuardOption, LearnOption, guard_of
from thermogrip.cli.run import (
    DrawOption,
    GraspTimeOption,
    PortOption,
    ProtocolOption,
    SettleTimeoutOption,
    SpeedOption,
    StopEarlyOption,
    TwinOption,
    files_of,
    one_rig,
    rig_of,
)
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console
from thermogrip.rig.session.signals import stop_signals

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps
    from thermogrip.rig.records.batch import Trial
    from thermogrip.rig.session.session import Session

__all__ = ["batch", "recover"]


@stop_signals()
def batch(
    controller: ControllerFile,
    plan: Annotated[
        Path,
        typer.Argument(
            metavar="PLAN.csv",
            callback=existing,
            show_default=False,
            help="A row a grasp: material,t_object_degC,target_degC[,block,repeat,touch_group,...].",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", show_default=False, help="Folder of the batch.")
    ],
    port: PortOption = None,
    protocol: ProtocolOption = None,
    speed: SpeedOption = 1.0,
    twin: TwinOption = None,
    draw: DrawOption = 0,
    grasp_time: GraspTimeOption = 10.0,
    stop_early: StopEarlyOption = None,
    settle_timeout: SettleTimeoutOption = 900.0,
    guard: GuardOption = None,
    learn: LearnOption = None,
    ask: Annotated[
        bool, typer.Option("--ask/--no-ask", help="With --port: ask before and after each grasp.")
    ] = True,
    network: OwnNetwork = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Grasp one object after another by a plan, and record.

    The same command again goes on where it was stopped; trials that tripped or were called bad are done
    again. Drive and pump are off between grasps and on every way out. The good grasps are in DIR/grasps.csv,
    labelled for classify.
    """
    one_rig(port, twin)
    from thermogrip.classify.decisions.online import session_stop
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.interface import Rig
    from thermogrip.rig.records.batch import read_plan, run_batch

    trials, loaded = read_plan(plan), load_controller(controller, network)
    watch = guard_of(guard, loaded.plant, learn)
    clock, console = ScaledClock(speed), Console(as_json)
    asks = ask and port is not None and not as_json

    def opened() -> Rig:
        return rig_of(port, protocol, clock, twin, network, draw, loaded, seed=seed, t_start=None)

    files = files_of(learn, controller=controller, plan=plan, plant=twin, guard=guard)
    with console.progress("batch") as progress:
        done = run_batch(
            opened,
            loaded,
            trials,
            new_folder(out),
            ready=_ready(console, len(trials)) if asks else None,
            judge=_judge(console) if asks else None,
            stop=None if stop_early is None else session_stop(stop_early),
            guard=watch,
            first_touch=_first_touch,
            about={"port": port} if twin is None else {"twin": twin.name, "draw": draw, "seed": seed},
            files=files,
            output=loaded.controlled[0],
            grasp_time=grasp_time,
            settle_timeout=settle_timeout,
            clock=None if port is None else clock,
            progress=progress,
        )
    console.say(f"{len(done.done)} of {len(trials)} grasps are good: {done.verdict}")
    if done.advice:
        console.say(done.advice)
    console.answer(
        {"verdict": done.verdict, "advice": done.advice, "good": len(done.done), "left": done.left}
    )
    return 0 if done.left == 0 else ANSWER_IS_NO


def _ready(console: Console, n: int) -> Callable[[int, Trial], bool]:
    """Return what asks for the next object."""

    def ready(k: int, trial: Trial) -> bool:
        at = "unknown temperature" if trial.t_object is None else f"{trial.t_object} degC"
        what = f"trial {k + 1} of {n}: {trial.material or 'unknown'}, {at}, skin to {trial.target:g} degC"
        return _asked(f"{what}; Enter when it is ready, q to stop").lower() not in ("q", "quit", "n", "no")

    return ready


def _judge(console: Console) -> Callable[[int, Trial, Session], str]:
    """Return what asks whether a grasp was good."""

    def judge(k: int, trial: Trial, session: Session) -> str:
        if session.contact != session.contact:
            console.warn("the skin felt nothing: no object, or one as warm as the skin")
        said = _asked("Enter to keep it, or what was bad")
        return "" if said.lower() in ("y", "yes", "ok") else said

    return judge


def _asked(question: str) -> str:
    """Return what the operator answers, "" for Enter alone."""
    return str(typer.prompt(question, default="", show_default=False)).strip()


def _first_touch(grasps: Grasps) -> tuple[float, float]:
    """Return what a touch identifies of its object's temperature: median and standard deviation [degC]."""
    from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    from thermogrip.sysid.effusivity.posterior import effusivity_posterior

    row = effusivity_posterior(load_default_gripper(), grasps)[0]
    return row.t_object, (row.t_object_p95 - row.t_object_p05) / 3.29


def recover(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            show_default=False,
            callback=existing,
            help="Folder of a run, or of a batch of runs.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Also write the run's log: .nc, .parquet, .csv, or .mcap (with ros).",
        ),
    ] = None,
    bad: Annotated[
        str | None, typer.Option("--bad", metavar="WHY", help="Mark the trial as bad; nothing is removed.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Repair a run that was killed or lost its power.

    Cuts a torn last line, says what was lost, writes the sums. No measured number is changed, and what was
    cut is kept beside it. A folder that is whole is left as it is.
    """
    folders = _run_folders(folder)
    if len(folders) > 1 and (out is not None or bad is not None):
        raise UserError("holds several runs", file=folder, hint="give the folder of one of them")
    if out is not None:
        new_file(out, (".nc", ".parquet", ".csv", ".mcap"))
    from thermogrip.rig.records.export import export_run
    from thermogrip.rig.records.run_folder import mark_bad, recover

    console = Console(as_json)
    results = []
    for each in folders:
        done = recover(each)
        for line in done.findings:
            console.say(f"{each.name}: {line}")
        rows = 0 if done.run.log is None else done.run.log.sizes["time"]
        verdict = done.run.about["verdict"]
        results.append(
            {"run": each, "changed": done.changed, "said": done.findings, "rows": rows, "verdict": verdict}
        )
    if bad is not None:
        mark_bad(folders[0], bad)
        console.say(f"{folders[0].name}: marked bad: {bad}")
    if out is not None:
        export_run(folders[0], out)
        console.say(f"wrote {out}")
    console.answer({"runs": results})
    return 0 if all(result["rows"] for result in results) else ANSWER_IS_NO


def _run_folders(folder: Path) -> list[Path]:
    """Return the runs in a folder by name: itself, or those of a batch; UserError where there is none."""
    tried = (folder, *sorted(folder.glob("*")))
    found = [p for p in tried if (p / "run.json").is_file() or (p / "samples.csv").is_file()]
    if found:
        return found[:1] if found[0] == folder else found
    if (folder / "batch.json").is_file():
        raise UserError("is a batch without a run", file=folder, hint="give the same batch command again")
    raise UserError("is no run folder", file=folder, hint="give the folder of --out")
