"""compare: classifiers on the same splits of the same grasps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from thermogrip.classify.estimators import classifier_names
from thermogrip.cli import options as cli
from thermogrip.cli.classify import Quick, touched_part
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.classify.evaluation.comparison import Comparison
    from thermogrip.datasets.parallel import Progress
    from thermogrip.datasets.schema import Grasps

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

    pool = cli.workers_of(workers, cluster)
    from thermogrip.classify.estimators.registry import trainable
    from thermogrip.classify.evaluation.harness import evaluate
    from thermogrip.cli.grasp_arguments import read_grasp_files

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
    cli.warn_of_contacts(console.warn, [*records, *(tests or ())])
    records = touched_part(console, records)
    tests = None if tests is None else touched_part(console, tests)
    with console.progress("compare") as progress:
        has_given_split = tests is not None or _has_split(records)
        anew = tests is None and repeats > 0
        if has_given_split and anew and (why := _unsplittable(records, repeats, train_per_class, seed)):
            console.warn(f"no random splits: {why}")
            anew = False
        shares = _shares(progress, has_given_split, anew, by is not None)
        again: dict[str, Any] = {"seed": seed, "workers": pool}
        evaluations: dict[str, Callable[[], Comparison]] = {}
        if has_given_split:
            evaluations["files" if tests is not None else "shipped"] = partial(
                evaluate, models, records, test=tests, progress=shares["given"], **again
            )
        if anew:
            some: dict[str, Any] = {"repeats": repeats, "train_per_class": train_per_class}
            evaluations["random"] = partial(
                evaluate, fast, records, split="random", progress=shares["random"], **some, **again
            )
        if by is not None:
            evaluations[by] = partial(evaluate, fast, records, split=by, progress=shares["by"], **again)
        made = {name: compared() for name, compared in evaluations.items()}
        done = {name: replace(each, notes=(*left_out, *each.notes)) for name, each in made.items()}
        found = {name: each for name, each in done.items() if _scored(console, name, each, left_out)}
        if not found:
            raise UserError("nothing to score", hint="test on grasps of the materials that were trained")
    _write_comparisons(console, found, out)
    return 0


def _unsplittable(records: Sequence[Grasps], repeats: int, train_per_class: int, seed: int) -> str:
    """Return why there can be no random splits; empty where there can."""
    from thermogrip.classify.evaluation.splits import plan_folds

    try:
        plan_folds(records, split="random", repeats=repeats, train_per_class=train_per_class, seed=seed)
    except UserError as error:
        return str(error)
    return ""


def _shares(progress: Progress | None, given: bool, random: bool, by: bool) -> dict[str, Progress | None]:
    """Return the progress of each part of the work, by its share of the whole."""
    from thermogrip.datasets.parallel import sub_progress

    weights = {"given split": 3.0 * given, "random splits": 7.0 * random, "held out in turn": 5.0 * by}
    ends = [0.0, *accumulate(weight / sum(weights.values()) for weight in weights.values())]
    titles = zip(("given", "random", "by"), weights, pairwise(ends))
    return {key: sub_progress(progress, start, stop, title) for key, title, (start, stop) in titles}


def _scored(console: Console, name: str, comparison: Comparison, known: Sequence[str]) -> bool:
    """Return whether any test grasp could be scored; where none was, notes that are not known say why."""
    if comparison.scores():
        return True
    for note in comparison.notes[len(known) :]:
        console.warn(f"{name}: {note}")
    return False


def _write_comparisons(console: Console, found: dict[str, Comparison], out: Path) -> None:
    """Print and write the scores of each kind of split, and the report."""
    from thermogrip.report.classification import comparison_sections
    from thermogrip.report.html import write_report

    sections = [part for name, comparison in found.items() for part in comparison_sections(name, comparison)]
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
