"""compare: classifiers on the same splits of the same grasps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Annotated, Any

from thermogrip.classify.estimators import classifier_names
from thermogrip.cli import options as cli
from thermogrip.cli.classify import Quick, touched_part
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.classify.evaluation.comparison import Comparison
    from thermogrip.datasets.schema import Grasps
    from thermogrip.report.html import Section

BY_DEFAULT = ("lstm", "posterior", "bayes", "features-lda", "pca-lda")
MOST_CONDITIONS = 4  # that are printed one by one
NEEDED = ("thermogrip.classify.evaluation.harness", "thermogrip.sysid.effusivity.mode_kernel")  # by workers


def compare(
    grasps: cli.GraspFiles,
    out: Annotated[Path, cli.opt("--out", "DIR", "Where tables and report go.")],
    test: Annotated[
        list[str] | None,
        cli.opt("--test", "GRASPS", "Test on these grasps, not on a split; may be repeated."),
    ] = None,
    classifiers: Annotated[
        str | None,
        cli.opt(
            "--classifiers",
            "LIST",
            "Those of train, forest, svm-pca, rocket, or module:Class or "
            "module:object of scikit-learn (imported) [default: lstm where PyTorch is installed, posterior, "
            "bayes, features-lda, pca-lda].",
            classifier_names,
        ),
    ] = None,
    repeats: Annotated[
        int, cli.opt("--repeats", None, "Random splits by grasp, beside the shipped split.", min=0)
    ] = 20,
    train_per_class: Annotated[
        int, cli.opt("--train-per-class", None, "Training grasps a material in a random split.", min=1)
    ] = 5,
    by: Annotated[
        str | None,
        cli.opt(
            "--by",
            "session|block",
            "Also hold out whole sessions or blocks in turn.",
            cli.one_of("--by", ("session", "block")),
        ),
    ] = None,
    quick: Quick = False,
    seed: cli.Seed = 0,
    workers: cli.Workers = 1,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Score classifiers on the same splits of the same grasps.

    Each file is one condition; its candidates are the materials of its training grasps. Without --test the
    shipped split (column split) is used where it exists, and then --repeats random splits by grasp, on
    which the LSTM trains for 200 epochs. Grasps that show no contact are left out.
    """
    if both := {*grasps} & {*(test or ())}:
        hint = "give others to --test, or leave it out: a part of each material is then held back"
        raise UserError("is to be trained and tested on", file=min(both), hint=hint)

    pool = cli.workers_of(workers, cluster, *NEEDED)
    from thermogrip.classify.estimators.registry import trainable
    from thermogrip.classify.evaluation.harness import evaluate
    from thermogrip.datasets.grasp_files import read_grasp_files
    from thermogrip.datasets.parallel import joint_progress, run_threads, sub_progress

    names = cli.comma(classifiers)
    models, missing = trainable(names or BY_DEFAULT, quick=quick, seed=seed)
    if not models:
        raise missing[0]
    left_out = tuple(f"left out: {error}" for error in missing)
    fast, _ = trainable(models, quick=True, seed=seed)
    records = read_grasp_files(grasps)
    tests = read_grasp_files(test) if test else None
    if tests is None and not repeats and not by and not _has_split(records):
        raise UserError("nothing to score", hint="give --test, a column split, or --repeats")
    cli.new_folder(out)
    console = Console(as_json)
    for line in left_out:
        console.warn(line)
    cli.warn_of_contacts(console, [*records, *(tests or ())])
    records = touched_part(console, records)
    tests = None if tests is None else touched_part(console, tests)
    with console.progress("compare") as progress:
        given = tests is not None or _has_split(records)
        anew = tests is None and repeats > 0
        if given and anew and (why := _unsplittable(records, repeats, train_per_class, seed)):
            console.warn(f"no random splits: {why}")
            anew = False
        parts = _shares(given, anew, by is not None)
        widths = joint_progress(progress, [share for share, _ in parts.values()])
        shares = {
            name: sub_progress(width, 0.0, 1.0, title)
            for width, (name, (_, title)) in zip(widths, parts.items())
        }
        again: dict[str, Any] = {"seed": seed, "workers": pool}
        asked: dict[str, Callable[[], Comparison]] = {}
        if given:
            asked["files" if tests is not None else "shipped"] = partial(
                evaluate, models, records, test=tests, progress=shares["given"], **again
            )
        if "random" in shares:
            some: dict[str, Any] = {"repeats": repeats, "train_per_class": train_per_class}
            asked["random"] = partial(
                evaluate, fast, records, split="random", progress=shares["random"], **some, **again
            )
        if by is not None:
            asked[by] = partial(evaluate, fast, records, split=by, progress=shares["by"], **again)
        page = _Page(left_out)

        def work(name: str) -> Comparison:
            return page.compared(name, asked[name]())

        # side by side: processes that one of them leaves idle work for another, the page is drawn meanwhile
        done = dict(zip(asked, run_threads(work, list(asked), pool), strict=True))
        found = {name: each for name, each in done.items() if each and _scored(console, name, each, left_out)}
        if not found:
            raise UserError("nothing to score", hint="test on grasps of the materials that were trained")
    _write_comparisons(console, found, out, page.sections(*found))
    return 0


def _unsplittable(records: Sequence[Grasps], repeats: int, train_per_class: int, seed: int) -> str:
    """Return why there can be no random splits; empty where there can."""
    from thermogrip.classify.evaluation.splits import plan_folds

    try:
        plan_folds(records, split="random", repeats=repeats, train_per_class=train_per_class, seed=seed)
    except UserError as error:
        return str(error)
    return ""


def _shares(given: bool, random: bool, by: bool) -> dict[str, tuple[float, str]]:
    """Return the share of the bar of each part of the work, and the part's name."""
    weights = {
        "given": (3.0 * given, "given split"),
        "random": (7.0 * random, "random splits"),
        "by": (5.0 * by, "held out in turn"),
    }
    total = sum(weight for weight, _ in weights.values())
    return {name: (weight / total, title) for name, (weight, title) in weights.items() if weight}


class _Page:
    """Sections of the report, which are made and drawn as soon as they can be, one after the other:
    matplotlib is not for several threads."""

    def __init__(self, notes: Sequence[str]) -> None:
        self._notes, self._lock = tuple(notes), Lock()
        self._sections: dict[str, list[Section]] = {}
        self._faults: dict[str, UserError] = {}

    def add(self, name: str, make: Callable[[], list[Section]]) -> None:
        """Make the sections of a name, and draw them."""
        from thermogrip.report.html import draw

        with self._lock:
            try:
                self._sections[name] = made = make()
                draw(made)
            except UserError as error:  # said where they are asked for
                self._faults[name] = error

    def compared(self, name: str, comparison: Comparison) -> Comparison:
        """Return a comparison with the notes of all of them, its section made."""
        from thermogrip.report.classification import comparison_sections

        comparison = replace(comparison, notes=(*self._notes, *comparison.notes))
        if comparison.scores():
            self.add(name, partial(comparison_sections, name, comparison))
        return comparison

    def sections(self, *names: str) -> list[Section]:
        """Return the sections of these names."""
        for name in names:
            if name in self._faults:
                raise self._faults[name]
        return [section for name in names for section in self._sections[name]]


def _scored(console: Console, name: str, comparison: Comparison, known: Sequence[str]) -> bool:
    """Return whether any test grasp could be scored; where none was, notes that are not known say why."""
    if comparison.scores():
        return True
    for note in comparison.notes[len(known) :]:
        console.warn(f"{name}: {note}")
    return False


def _write_comparisons(
    console: Console, found: dict[str, Comparison], out: Path, sections: Sequence[Section]
) -> None:
    """Print and write the scores of each kind of split, and the report."""
    from thermogrip.report.html import write_report

    for name, comparison in found.items():
        comparison.save(out / name)
        _show(console, name, comparison)
    write_report(out / "report.html", "What was touched", "Classifiers on the same grasps.", sections)
    console.say(f"wrote {out}/report.html and tables beside it")
    splits = {
        name: {"scores": c.scores(), "cautions": c.cautions, "notes": c.notes, "interval": c.interval_note}
        for name, c in found.items()
    }
    console.answer({"splits": splits, "out": out})


def _has_split(records: Sequence[Grasps]) -> bool:
    """Say whether any record marks training and test grasps."""
    return any({"train", "test"} <= set(r["split"].values.astype(str)) for r in records if "split" in r)


def _show(console: Console, name: str, comparison: Comparison) -> None:
    """Print the scores of one kind of split; of many conditions the pooled ones, the page has the others."""
    from thermogrip.classify.evaluation.comparison import POOLED
    from thermogrip.report.classification import score_table

    head, rows = score_table(comparison)
    if len(comparison.conditions) > MOST_CONDITIONS:
        shown = {POOLED, *(str(score["condition"]) for score in comparison.scores() if score["apart"])}
        rows = tuple(row for row in rows if row[head.index("condition")] in shown)
        name += f"; {len(comparison.conditions)} conditions, one by one in the report"
    kept = [k for k, title in enumerate(head) if title not in ("Brier", "fit [s]")]  # the page has them
    console.table(f"Split: {name}", [head[k] for k in kept], [[row[k] for k in kept] for row in rows])
    for line in comparison.caution_lines():
        console.say(f"caution: {line}")
    console.say(comparison.interval_note)
    for note in comparison.notes:
        console.say(f"note: {note}")
