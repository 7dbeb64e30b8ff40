"""tune, review, export: from a plant to a controller, its design looked through, and into C."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.mpc.controllers.mpc import Controller
    from thermogrip.mpc.controllers.pi import PIController
    from thermogrip.mpc.tuning.tune import Tuning

ControllerFile = Annotated[Path, cli.arg("CONTROLLER", "controller.json of tune.")]


def tune(
    plant: cli.PlantFile,
    out: Annotated[Path, cli.opt("--out", "FILE.json", "Where the controller goes.")],
    spec: Annotated[
        Path | None,
        cli.opt(
            "--spec",
            "SPEC.toml",
            "What is wanted; `init spec --like PLANT` writes one to edit [default: that one].",
        ),
    ] = None,
    report: cli.Report = None,
    network: cli.OwnNetwork = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Find the best controller for what you want, MPC or PI.

    You say settling time, overshoot, energy. Runs closed loops on posterior draws of the plant, steps and
    loads; shows baseline, tuned and PI side by side. Ctrl-C keeps the best so far.
    """
    cli.new_file(out, (".json",))
    from thermogrip.mpc.design.spec import Spec, read_spec
    from thermogrip.mpc.tuning.tune import tune as search

    loaded = cli.load_plant(plant, network)
    wanted = (Spec() if spec is None else read_spec(spec)).completed(loaded)
    console = Console(as_json)
    if spec is None:
        regulated = " and ".join(wanted.design(loaded).controlled)
        steps = ", ".join(f"{start:g} to {target:g}" for start, target in wanted.steps)
        console.say(
            f"No --spec: {regulated} in steps {steps}, each within {wanted.band_degC:g} after "
            f"{wanted.settle_within_s:g} s; "
            f"'thermogrip init spec --like {plant} --out spec.toml' writes what was taken, to edit"
        )
    if taken := wanted.surroundings_in_words(loaded):
        console.say(
            f"In the trials, and where nobody reads it: {taken}; 'disturbances' in the spec replaces it"
        )
    with console.progress("tune") as progress, _naming(spec, tuple(Spec.model_fields)):
        tuning = search(loaded, wanted, progress=progress, seed=seed)
    console.answer(_written(console, tuning, plant.name, out, report))
    if tuning.interrupted:
        raise KeyboardInterrupt
    return 0 if tuning.meets_spec else cli.ANSWER_IS_NO


def _written(console: Console, found: Tuning, plant: str, out: Path, report: Path | None) -> dict[str, Any]:
    """Write and show what a search found; return the answer."""
    from thermogrip.report.control import kind_of, spec_answer, tuning_caption, tuning_sections, tuning_table
    from thermogrip.report.html import write_report

    found.save(out)
    kind = kind_of(found.controller)
    if report is not None:
        best = "a PI" if kind == "PI" else "an MPC"
        lead = f"The best controller for {plant} is {best}, by simulations on its draws."
        write_report(report, "Tuning", lead, tuning_sections(found))
    console.table(tuning_caption(found), *tuning_table(found))
    console.say(f"{found.verdict}: {found.finding}")
    console.say(f"{spec_answer(found)}; wrote {out}")
    keys = ("verdict", "finding", "meets_spec", "checks", "interrupted", "scores", "rows")
    return {"kind": kind} | {key: getattr(found, key) for key in keys} | {"out": out, "report": report}


@contextmanager
def _naming(spec: Path | None, keys: tuple[str, ...]) -> Iterator[None]:
    """Name the spec's file in an error about one of its keys that only the plant could refuse."""
    try:
        yield
    except UserError as error:
        if spec is None or error.file is not None or re.split(r"\W", error.problem)[0] not in keys:
            raise
        raise UserError(error.problem, file=spec, hint=error.hint) from error


def review(
    controller: ControllerFile,
    report: cli.Report = None,
    network: cli.OwnNetwork = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Check a controller's design.

    Each check passes, warns or fails, and says the fix; one that had nothing to try says so.
    """
    loaded = load_controller(controller, network)  # first: a design that cannot be is refused sooner
    from thermogrip.mpc.tuning.design_review import review as check
    from thermogrip.report.classification import review_section
    from thermogrip.report.html import write_report

    console = Console(as_json)
    checks = check(loaded)
    if report is not None:
        lead = f"The design of {controller.name}, checked without the rig."
        write_report(report, "Design review", lead, [review_section(checks)])
    rows = [(c.name, c.verdict, c.finding, c.fix) for c in checks]
    console.table(f"Review of {controller.name}", ("check", "verdict", "finding", "fix"), rows)
    if report is not None:
        console.say(f"wrote {report}")
    failed = any(c.verdict == "fail" for c in checks)
    console.answer({"passed": not failed, "checks": checks, "report": report})
    return cli.ANSWER_IS_NO if failed else 0


def export(
    controller: ControllerFile,
    out: Annotated[Path, cli.opt("--out", "DIR", "Folder of the C files.")],
    check: Annotated[
        bool, cli.flag("--check", "Build it (gcc) and compare it with Python in random loops.")
    ] = False,
    states: Annotated[int, cli.opt("--states", None, "Samples of --check.", min=1)] = 3_000,
    arduino: Annotated[bool, cli.flag("--arduino", "Write it as a library of the Arduino IDE.")] = False,
    ros2: Annotated[bool, cli.flag("--ros2", "Write it as a ROS 2 node in Python, not as C.")] = False,
    network: cli.OwnNetwork = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Write a controller as C99 without malloc, or as a ROS 2 node.

    The folder of C needs a compiler and nothing of thermogrip: library, example, Makefile, README. The node
    needs thermogrip; topics.toml in its folder says which topic is what.
    """
    if ros2:
        if arduino or check:
            raise UserError("--ros2 writes a node, no C", hint="leave --arduino and --check out")
        from thermogrip.mpc.controllers.ros2_node import write_node

        console = Console(as_json)
        files = write_node(load_controller(controller, network), cli.new_folder(out))
        console.say(f"Wrote {', '.join(files)} to {out}: edit topics.toml, then python3 thermogrip_node.py")
        console.answer({"out": out, "files": files})
        return 0
    from thermogrip.mpc.controllers.export import check_export, export_controller
    from thermogrip.mpc.controllers.export_pi import check_pi, export_pi
    from thermogrip.mpc.controllers.pi import PIController

    if arduino and check:
        raise UserError("--check builds a plain export", hint="check it without --arduino first")
    console = Console(as_json)
    loaded = load_controller(controller, network)
    if isinstance(loaded, PIController):
        if arduino:
            hint = "leave --arduino out, and put its three files of C beside the sketch"
            raise UserError("a PI needs no library", hint=hint)
        written = export_pi(loaded, cli.new_folder(out))
    else:
        written = export_controller(loaded, cli.new_folder(out), arduino=arduino)
    console.say(f"Wrote {len(written.files)} files to {out}.")
    result: dict[str, Any] = {"out": out}
    if not check:
        console.answer(result)
        return 0
    with console.progress("check") as progress:
        about: dict[str, Any] = {"states": states, "seed": seed, "progress": progress}
        if isinstance(loaded, PIController):
            agreement, how = check_pi(written, loaded, **about), "samples of random readings"
        else:
            agreement = check_export(written, loaded, **about)
            how = "samples of random loops under the sanitizers"
    console.say(
        f"{agreement.states} {how}: drives differ by at most {agreement.difference:.1e} "
        f"of their range ({agreement.free} of them at no limit), same status in {agreement.same_status}. "
        f"RAM of a controller {agreement.ram} bytes, constants {agreement.constants}, "
        f"flash {agreement.flash}, largest stack frame {agreement.stack}."
    )
    console.say(f"C and Python {'do the same' if agreement.passed else 'differ'}.")
    console.answer({**result, **asdict(agreement), "passed": agreement.passed})
    return 0 if agreement.passed else cli.ANSWER_IS_NO


def load_controller(path: Path, network: str | None) -> Controller | PIController:
    """Return a controller; ``network`` is the class of its plant, where that is the user's own."""
    from thermogrip.mpc.controllers.mpc import load_controller as load

    return load(path, model=None if network is None else cli.find_network(network))
