"""demo, paper, init: everything at once, and templates and example files to start from."""

from __future__ import annotations

import time
from importlib import resources
from pathlib import Path
from typing import Annotated

from thermogrip.cli import options as cli
from thermogrip.cli.options import KINDS, TEMPLATES, check_exists, kind_of, template_text
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console


def demo(
    out: Annotated[Path, cli.opt("--out", "DIR", "Where everything goes.")] = Path("thermogrip-demo"),
    seed: cli.Seed = 0,
    workers: cli.Workers = 2,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Do all of the below once on the example data.

    Identify, validate, tune, run on the simulated rig, grasp, compare; with a report. Without PyTorch the
    comparison has no LSTM.
    """
    cli.new_folder(out)
    pool = cli.workers_of(workers, cluster)
    from thermogrip.studies.demo import compared_models, run_demo

    console = Console(as_json)
    for line in compared_models(seed)[1]:
        console.warn(line)
    with console.progress("demo") as progress:
        done = run_demo(out, seed=seed, workers=pool, progress=progress)
    for section in done.sections:
        if section.verdict:
            console.say(section.title)
            console.say(f"    {section.verdict}")
    console.say(f"report: {done.report}")
    verdicts = {section.title: section.verdict for section in done.sections if section.verdict}
    console.answer({"report": done.report, "verdicts": verdicts})
    return 0


def paper(
    out: Annotated[Path, cli.opt("--out", "DIR", "Where everything goes.")],
    quick: Annotated[bool, cli.flag("--quick", "LSTM of 200 epochs instead of 2000.")] = False,
    seed: cli.Seed = 0,
    workers: cli.Workers = 1,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Repeat the paper's experiments, table beside table.

    They train its LSTM, which needs PyTorch: pip install "thermogrip[lstm]".
    """
    cli.new_folder(out)
    pool = cli.workers_of(workers, cluster)
    from thermogrip.report.html import write_report
    from thermogrip.studies.paper import repeat_paper

    console = Console(as_json)
    with console.progress("paper") as progress:
        repeated = repeat_paper(quick=quick, seed=seed, workers=pool, progress=progress)
    repeated.bundled.save(out / "bundled")
    repeated.twin.save(out / "simulated")
    lead = "The experiments of Osawa et al. (arXiv 2111.15344) on simulated grasps, table beside table."
    write_report(out / "report.html", "The paper, repeated", lead, repeated.sections())
    head, rows = repeated.table()
    for row in rows:
        console.say(f"{row[0]}: object {row[1]:g}, gripper {row[2]:g} degC, {row[3]} materials")
        console.say(f"    paper: {row[4]} ({row[5]})")
        for k, name in enumerate(head[6:], start=6):
            console.say(f"    {name}: {row[k]}")
    console.say(repeated.verdict)
    console.say(repeated.copies_verdict)
    console.say(f"wrote {out}/report.html")
    cases = [dict(zip(head, row)) for row in rows]
    console.answer(
        {
            "cases": cases,
            "copies": repeated.copies,
            "epochs": repeated.epochs,
            "verdict": repeated.verdict,
            "out": out,
        }
    )
    return 0


def init(
    what: Annotated[str, cli.arg("spec|network|topics|guard|examples", "What to start from.")],
    like: Annotated[
        str | None,
        cli.opt(
            "--like",
            "PLANT|NAME",
            "Of a network: start from gripper, tclab, peltier_chamber, room, hotend, furnace, tank "
            "or thermal_chamber; of a spec: what tune takes for this plant.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        cli.opt("--out", "FILE.toml|DIR", "Where it goes [default: stdout; of the examples: this folder]."),
    ] = None,
    as_json: cli.AsJson = False,
) -> int:
    """Write a commented template, or the example files, to start from.

    spec: what tune aims at; network: a thermal network for identify --network; topics: which
    topic of a ROS bag or MCAP file is which column of a log; guard: what run and batch allow;
    examples: logs and grasps of a simulated rig, to try every verb on."""
    cli.choice("template", what, (*TEMPLATES, "examples"))
    console = Console(as_json)
    if like is not None and what not in ("network", "spec"):
        raise UserError(f"--like {like} is of a network or a spec, not of {what}", hint="leave it out")
    if what == "examples":
        return _examples(console, out or Path())
    text = _template(what, like)
    if out is None:
        console.say(text.rstrip("\n"))
    else:
        from thermogrip.datasets.files import write_atomic

        cli.new_file(out, (".toml",))
        if out.exists():
            raise UserError("exists already", file=out, hint="remove it or choose another name")
        write_atomic(out, text)
        console.say(f"wrote {out}")
    console.answer({"template": what, "text": text, "out": out})
    return 0


def warm_up(as_json: cli.AsJson = False) -> int:
    """Compile now what grasps need, which their first verb would do.

    For images and new installations. The code is kept beside the package, in the user's cache folder where
    that cannot be written, or in NUMBA_CACHE_DIR.
    """
    from thermogrip.classify.decisions.predict import classify_grasps
    from thermogrip.classify.estimators.posterior import PosteriorClassifier
    from thermogrip.datasets.examples import example_path
    from thermogrip.datasets.grasp_files import read_grasps
    from thermogrip.sysid.contact.time_stepping import step_contacts
    from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    from thermogrip.sysid.effusivity.posterior import effusivity_posterior

    console, began = Console(as_json), time.process_time()
    grasps = read_grasps(example_path("exp2_dT20")).isel(grasp=[0])
    gripper = load_default_gripper()
    classify_grasps(PosteriorClassifier().with_device(gripper), grasps, ["copper", "wood"])
    effusivity_posterior(gripper, grasps)
    seconds, place = time.process_time() - began, step_contacts.stats.cache_path
    console.say(f"compiled in {seconds:.1f} s of CPU, kept in {place}")
    console.answer({"cpu_s": seconds, "kept_in": place})
    return 0


def copy_examples(folder: Path) -> list[Path]:
    """Write the bundled logs into a folder, the grasps into ``grasps`` in it and what each file is into
    ``EXAMPLES.md``, and return their paths; UserError before any is written where another file is there."""
    from thermogrip.datasets.examples import EXAMPLE_LOGS, example_path
    from thermogrip.datasets.files import write_atomic

    source, content = example_path(EXAMPLE_LOGS[0]).parent, {}
    for original in sorted(source.glob("*.csv.xz")):
        is_log = original.name.removesuffix(".csv.xz") in EXAMPLE_LOGS
        content[(folder if is_log else folder / "grasps") / original.name] = original.read_bytes()
    content[folder / "EXAMPLES.md"] = (source / "README.md").read_bytes()
    for path, data in content.items():
        if path.exists() and path.read_bytes() != data:
            raise UserError("another file of this name is here", file=path, hint="choose another folder")
    for path, data in content.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            write_atomic(path, data)
    return list(content)


def _examples(console: Console, folder: Path) -> int:
    """Copy the example files and say what they are."""
    from thermogrip.datasets.examples import EXAMPLE_LOGS, example_grasps

    paths = copy_examples(cli.new_folder(folder))
    logs, grasps = len(EXAMPLE_LOGS), len(example_grasps())
    console.say(f"{logs} logs in {folder}, {grasps} sets of grasps in {folder / 'grasps'}")
    console.say(f"simulated, not measured; described in {folder / 'EXAMPLES.md'}")
    console.answer({"template": "examples", "files": paths, "out": folder})
    return 0


def _template(what: str, like: str | None) -> str:
    """Return the text of a template, or of a shipped network that one is to start from."""
    if like is None:
        return template_text(what)
    if what == "spec":
        check_exists(like)
        if (kind := kind_of(like)) != "plant":
            problem = f"is {KINDS[kind]['words'] if kind else 'no file of ours'}, not a plant"
            raise UserError(problem, file=like, hint="give plant.json of identify")
        from thermogrip.mpc.design.spec import Spec

        return Spec.of(cli.load_plant(Path(like))).in_toml()
    from thermogrip.sysid.models.network_spec import builtin_networks

    name = cli.choice("--like", like, builtin_networks())
    return (resources.files("thermogrip.sysid") / f"networks/{name}.toml").read_text(encoding="utf-8")
