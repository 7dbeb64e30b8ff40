"""autotune: from a port to a tuned loop, in one command and one folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from thermogrip.cli import options as cli
from thermogrip.cli.rig import GuardOption, RigOptions, ShowOptions, targets_of
from thermogrip.report.console import Console
from thermogrip.rig.session.signals import stop_signals

if TYPE_CHECKING:
    from thermogrip.report.html import Section
    from thermogrip.rig.records.autotune import Autotune


@stop_signals()
@cli.grouped
def autotune(
    target: Annotated[str, cli.opt("--target", "DEGC", "Where to; of several outputs t1=40,t2=35.")],
    out: Annotated[Path, cli.opt("--out", "DIR", "Folder of everything; the same one again goes on.")],
    rig: RigOptions,
    show: ShowOptions,
    limit: Annotated[
        float | None, cli.opt("--limit", "DEGC", "No sensor above this [default: as the guard has it].")
    ] = None,
    minutes: Annotated[
        float, cli.opt("--minutes", "M", "On the rig before it is tuned, at most.", min=1, max=1440)
    ] = 30.0,
    spec: Annotated[
        Path | None,
        cli.opt("--spec", "SPEC.toml", "What is wanted [default: the step from here to the target]."),
    ] = None,
    guard: GuardOption = None,
    workers: cli.Workers = 1,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Go from a port to a tuned loop.

    A step test of minutes makes a PI; under it a log is recorded until identify calls the plant good or the
    time is over; then tune, and a session to the target. DIR has the runs, plant.json, controller.json and
    report.html. Stopped by Ctrl-C or a power cut, the same command goes on; controller.json is the best so
    far. Drive and pump are off between sessions and on every way out.
    """
    wanted = targets_of(target)
    rig.check()
    from thermogrip.mpc.design.spec import read_spec
    from thermogrip.rig.records.autotune import Autotune, Tripped

    console, pace = Console(as_json), rig.pace(show)
    requested = None if spec is None else read_spec(spec)
    relays = rig.switched(None if requested is None else requested.relays)
    clock, watch = rig.clock(pace), show.watch("autotune", console, out, pace)
    says = iter([console.say])  # at the first session
    work = Autotune(
        cli.new_folder(out),
        wanted,
        lambda: rig.open(clock, None, pace=pace, seed=seed, relays=relays, say=next(says, None)),
        lambda plant: rig.guard(guard, plant, limit=limit),
        minutes=minutes,
        spec=requested,
        relays=relays,
        about={"limit": limit, "twin": rig.about().get("twin")},  # a port may be called otherwise
        clock=None if rig.port is None else clock,
        progress=watch.progress,
        shown={"listener": watch.listen, "operator": watch.operator},
        say=console.say,
        workers=workers,
        seed=seed,
    )
    verdict = "interrupted"
    try:
        with watch:
            try:
                work.run()
                verdict = work.known["checked"]["verdict"]
            except Tripped as tripped:
                verdict = "tripped"
                console.say(str(tripped))
            finally:
                watch.ended(verdict)
    except KeyboardInterrupt:
        console.say(f"The same command goes on; what is known so far is in {out}.")
        raise
    page = out / "report.html"
    if work.session is not None:
        write_page(work, page, str(rig.port or rig.twin))
    head, rows = _stage_table(work)
    console.table(f"{rig.port or rig.twin}, to {target} degC", head, rows)
    console.say(f"wrote {page if page.exists() else out}")
    console.answer({"verdict": verdict, **work.known, "out": out})
    good = verdict == "settled" and work.known["tuned"]["good"]
    return 0 if good else cli.ANSWER_IS_NO


def _stage_table(work: Autotune) -> tuple[list[str], list[list[Any]]]:
    """Return the stages: time on the rig until then, and what the loop did."""
    rows = []
    for name, begin, loop in (("first PI", "first", "pi"), ("tuned", "tuned", "checked")):
        if begin in work.known:
            figures = work.known.get(loop, {})
            rows.append(
                [name, work.known[begin]["minutes"], figures.get("settle_s"), figures.get("overshoot")]
            )
    return ["loop", "after [min]", "settles in [s]", "overshoot [K]"], rows


def write_page(work: Autotune, page: Path, rig: str) -> None:
    """Write the one page: the stages, the session under the tuned loop, the tuning, the plant."""
    from thermogrip.report.control import session_sections, tuning_sections
    from thermogrip.report.html import Section, Table, write_report
    from thermogrip.report.plant import identification_sections

    assert work.session is not None
    assert work.tuning is not None
    head, rows = _stage_table(work)
    table = Table(tuple(head), tuple(map(tuple, rows)), "Time on the rig, and what the loops did there")
    stages = Section("What came of it?", (table,), work.found.verdict, "good" if work.found.good else "warn")
    sections: list[Section] = [
        stages,
        *session_sections(work.session, work.moves, work.tuning.controller, rig),
        *tuning_sections(work.tuning),
        *identification_sections(work.found, work.logs(), work.found.plant, None),
    ]
    write_report(page, "Autotune", f"From {rig} to a loop at {work.target} degC.", sections)
