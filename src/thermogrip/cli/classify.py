"""effusivity, train, classify, materials: from grasps to what was touched."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeAlias

from thermogrip.classify.estimators import classifier_names
from thermogrip.cli import grasp_arguments
from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.classify.decisions.stopping_rule import StopRule
    from thermogrip.classify.estimators.base import GraspClassifier
    from thermogrip.classify.estimators.posterior import PosteriorClassifier
    from thermogrip.datasets.schema import Grasps
    from thermogrip.sysid.effusivity import Coupling, GripperModel
    from thermogrip.sysid.effusivity.quality import GraspQuality

NEEDED = (  # by processes that answer
    "thermogrip.classify.decisions.predict",
    "thermogrip.classify.estimators.posterior",
    "thermogrip.sysid.effusivity.mode_kernel",
)
ANSWERS_GO = "Where the table goes (.csv or .parquet), or a folder for a table of each file."
_BUNDLED = 40.0  # s: the longest contacts that taught the bundled gripper


class CalibratedDevice(NamedTuple):
    """A gripper and what its training shows besides."""

    device: GripperModel
    coupling: Coupling | None  # how blocks move between touches, where the grasps identify it
    longest: float  # how long the contacts of the training lasted [s]


def calibrated_device(console: Console, calibrate: Sequence[str], seed: int) -> CalibratedDevice:
    """Return the calibrated gripper, from labelled grasps or the bundled one with a warning."""
    if not calibrate:
        from thermogrip.sysid.effusivity import load_default_gripper

        console.warn(
            "the bundled gripper's calibration is used; give --calibrate with labelled grasps of yours"
        )
        return CalibratedDevice(load_default_gripper(), None, _BUNDLED)
    from thermogrip.datasets.schema import has_touch_groups
    from thermogrip.sysid.effusivity import calibrate_gripper
    from thermogrip.sysid.effusivity.multi_touch import learn_coupling
    from thermogrip.sysid.effusivity.quality import longest_contact

    labelled = grasp_arguments.read_grasp_files(calibrate)
    cli.warn_of_contacts(console.warn, labelled)
    labelled = touched_part(console, labelled)
    with console.progress("calibrate") as progress:
        device = calibrate_gripper(labelled, seed=seed, progress=progress)
    for name in device.unlisted:
        console.warn(f"{name}: not in the materials table, learnt from its grasps")
    coupling = None
    for record in filter(has_touch_groups, labelled):
        coupling = learn_coupling(device, record, start=coupling)
    return CalibratedDevice(device, coupling, longest_contact(labelled))


def touched_part(console: Console, records: Sequence[Grasps]) -> list[Grasps]:
    """Return the grasps to learn from without those that show no contact."""
    from thermogrip.sysid.effusivity.quality import check_grasps

    touched = []
    for record in records:
        quality = check_grasps(record)
        for words in dict.fromkeys(filter(None, quality.reason)):
            console.warn(f"{record.attrs['name']}: {quality.reason.count(words)} left out: {words}")
        usable = quality.usable_grasps(record)
        touched += [] if usable is None else [usable]
    if not touched:
        raise UserError("no grasp shows a contact", hint="give grasps that touched something")
    return touched


def training_part(console: Console, records: Sequence[Grasps], split: str | None) -> list[Grasps]:
    """Return the grasps to learn from: those marked ``train`` where there are any, or all."""
    training = []
    for record in records:
        has_split = "split" in record and bool((record["split"].values != "").any())
        if split == "train" and not has_split:
            raise UserError(
                "has no split", file=record.attrs["name"], hint="fill the column split, or use --split all"
            )
        if split == "all" or not has_split:
            training.append(record)
            continue
        marked = record["split"].values == "train"
        if marked.any():
            training.append(record.isel(grasp=marked))
        else:
            console.warn(f"{record.attrs['name']}: no grasp is marked train, it is left out")
    if not training:
        raise UserError("no grasp is marked train", hint="use --split all")
    return training


SHOWN, ON_A_PAGE = 40, 200  # rows of a long table: printed, and in a report
_HEADS = {"next_touch_degC": "touch at [degC]", "next_touch_accuracy": "then right"}

ObjectRange = Annotated[
    str | None,
    cli.opt(
        "--object-range",
        "A,B",
        "Objects of unknown temperature are between A and B degC [default: 20 K about the room].",
    ),
]
Quick = Annotated[bool, cli.flag("--quick", "200 epochs of the LSTM, at most 2000 without.")]


def effusivity(
    grasps: cli.GraspFiles,
    out: Annotated[Path, cli.opt("--out", "FILE.csv|DIR", ANSWERS_GO)],
    calibrate: Annotated[
        list[str] | None,
        cli.opt("--calibrate", "GRASPS", "Labelled grasps that describe your gripper; may be repeated."),
    ] = None,
    between: ObjectRange = None,
    report: cli.Report = None,
    seed: cli.Seed = 0,
    workers: cli.Workers = 1,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Find the effusivity of what was touched, grasp by grasp.

    Without --calibrate the calibration of the bundled example gripper is used, with a warning. Touches of one
    block (touch_group) share one posterior of the effusivity, which needs no object temperature. A grasp that
    shows no contact, or moves away from its t_object, has none: its numbers are nan. Readings at the end of
    the sensor's range are left out, and of single touches what is later than the calibration's contacts. A
    single touch that the model does not explain is named.

    Files are read one by one, workers share them out. Where --out is a folder each file's table is written
    there when it is done.
    """
    stated = _range(between)
    check_place(out, [*grasps, *(calibrate or ())])
    pool = cli.workers_of(workers, cluster)
    console = Console(as_json)
    ask = _Effusivity(*calibrated_device(console, calibrate or [], seed), stated)
    answers = answer_files(console, "effusivity", grasps, ask.answer, out, pool, "nan")
    rows = [row for of_file in answers for row in of_file["rows"]]
    shown = [
        (r["grasp_id"], r["effusivity"], r["effusivity_p05"], r["effusivity_p95"], r["t_object"])
        for r in rows[:SHOWN]
    ]
    head = ("grasp", "effusivity", "5 %", "95 %", "object [degC]")
    console.table("Effusivity [W s^0.5 m^-2 K^-1], median and quantiles", head, shown)
    _say_more(console, len(rows))
    missed = {name: why for of_file in answers for name, why in of_file["missed"].items()}
    unexplained = {name: why for of_file in answers for name, why in of_file["unexplained"].items()}
    say_names(console, ((f"{why}, so no effusivity", name) for name, why in missed.items()))
    say_names(console, ((why, name) for name, why in unexplained.items()))
    console.say(f"wrote {out}")
    if report is not None:
        from thermogrip.report.classification import effusivity_section
        from thermogrip.report.html import write_report

        noted = [(row, unexplained.get(row["grasp_id"], "")) for row in rows[:ON_A_PAGE]]
        lead = "How fast the touched objects take up heat, grasp by grasp."
        write_report(report, "Effusivity", lead, [effusivity_section(noted, len(rows))])
    if as_json:
        found = {"grasps": rows, "without_contact": [*missed], "unexplained": unexplained}
        console.answer(found | {"out": out, "report": report})
    return 0


def train(
    grasps: cli.GraspFiles,
    classifier: Annotated[
        str,
        cli.opt(
            "--classifier",
            "NAME",
            "posterior, bayes, features-lda, pca-lda, lstm, lstm-paper.",
            classifier_names,
        ),
    ],
    out: Annotated[Path, cli.opt("--out", "MODEL_DIR", "Where the model goes.")],
    split: Annotated[
        str | None,
        cli.opt(
            "--split",
            "train|all",
            "Which grasps to learn from [default: train where the column exists].",
            cli.one_of("--split", ("train", "all")),
        ),
    ] = None,
    stop_error: Annotated[
        float | None,
        cli.opt(
            "--stop-error",
            "SHARE",
            "Also learn when a contact may end, at this share of wrong answers [posterior].",
            min=0.001,
            max=0.5,
        ),
    ] = None,
    quick: Quick = False,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Train one classifier on labelled grasps and save it.

    Grasps that show no contact are left out.
    """
    from thermogrip.classify.decisions.stopping_rule import RULE_FILE
    from thermogrip.classify.estimators.registry import can_be_saved, make_classifier, save_classifier

    model = make_classifier(classifier, quick=quick, seed=seed)
    if not can_be_saved(model):
        raise UserError(
            f"{classifier} cannot be saved as data alone",
            hint="compare it, or train posterior, bayes, features-lda, pca-lda, lstm or lstm-paper",
        )
    model.check_installed()
    console = Console(as_json)
    records = training_part(console, grasp_arguments.read_grasp_files(grasps), split)
    cli.warn_of_contacts(console.warn, records)
    records = touched_part(console, records)
    cli.new_folder(out)
    with console.progress("train") as progress:
        progress(0.0, classifier)
        model.fit(records)
    for words in model.notes_:
        console.warn(words)
    rule = None if stop_error is None else _stop_rule(console, model, records, stop_error)
    save_classifier(model, out)
    if rule is not None:
        rule.save(out / RULE_FILE)
    n = sum(record.sizes["grasp"] for record in records)
    sure = None if rule is None else rule.sure
    if rule is not None:
        console.say(f"a contact ends once a material has probability {rule.sure:.3g} (--early, --stop-early)")
    classes = [str(name) for name in model.classes_]
    console.say(f"trained {classifier} on {n} grasps of {', '.join(classes)}; wrote {out}")
    console.answer(
        {"classifier": classifier, "grasps": n, "materials": classes, "stop_sure": sure, "out": out}
    )
    return 0


def classify(
    model_dir: Annotated[Path, cli.arg("MODEL_DIR", "Folder that train wrote.")],
    paths: Annotated[
        list[str] | None,
        cli.arg(
            "GRASPS...",
            "Grasp files (CSV with its _meta.csv, NetCDF, Parquet), folders or patterns.",
            cli.without_meta_files,
        ),
    ] = None,
    out: Annotated[Path | None, cli.opt("--out", "FILE.csv|DIR", ANSWERS_GO)] = None,
    candidates: Annotated[
        str | None,
        cli.opt(
            "--materials",
            "A,B,C",
            "The candidates, for posterior also others of `thermogrip materials` [default: those that the "
            "model knows].",
        ),
    ] = None,
    early: Annotated[
        bool, cli.flag("--early", "Use of each contact what was read until the stop rule ended it.")
    ] = False,
    next_touch: Annotated[
        bool,
        cli.flag(
            "--next-touch", "Also say at which temperature another touch is worth its time [posterior]."
        ),
    ] = False,
    nearest: Annotated[
        bool, cli.flag("--nearest", "Name the likeliest candidate also where none is likelier [posterior].")
    ] = False,
    known: Annotated[
        list[str] | None,
        cli.opt(
            "--known",
            "GRASPS",
            "Labelled grasps of the gripper that took these, if it is another one of the kind [posterior].",
        ),
    ] = None,
    between: ObjectRange = None,
    serve: Annotated[
        bool, cli.flag("--serve", "Answer grasps that come as lines of JSON, until they end.")
    ] = False,
    port: Annotated[
        int | None,
        cli.opt("--port", "N", "With --serve: answer over HTTP on 127.0.0.1 instead.", min=0, max=65535),
    ] = None,
    seed: cli.Seed = 0,
    workers: cli.Workers = 1,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Name the material of each grasp, with probabilities.

    Touches of one block (touch_group) get one answer from all of them. A grasp that shows no contact gets no
    name, and readings at the end of the sensor's range, or later than contacts of the training lasted, are
    left out: see the column note. With --early the stop rule that train --stop-error learnt says when
    each contact could have ended. --next-touch adds next_touch_degC, empty where no touch gains 0.001 of
    accuracy a second, and the accuracy expected after it. The material is 'unknown' where it is likelier none
    of the candidates, but for --nearest. A model is trained on
    one gripper and its blocks; a grasp unlike those, by another gripper or of another block, is answered
    less surely. --known says what another gripper reads of blocks it knows.

    Files are read one by one, workers share them out. Where --out is a folder each file's table is written
    there when it is done. --serve takes one object a line,
    {"time_s": [...], "t_surface_degC": [...], "t_object_nominal_degC": 28}, and writes its answer; with
    --port it answers over HTTP.
    """
    stated = _range(between)
    if serve == bool(paths) or serve == (out is not None) or (port is not None and not serve):
        raise UserError("give GRASPS and --out, or --serve alone", hint="--port belongs to --serve")
    if out is not None:
        check_place(out, [*(paths or ()), *(known or ())])
    pool = cli.workers_of(workers, cluster)
    from thermogrip.sysid.contact.materials import load_materials

    unlisted = [name for name in cli.comma(candidates) or () if name not in load_materials()]
    cli.choices("--materials", unlisted, model_dir / "classifier.json", "classes")
    console = Console(as_json)
    anywhere = Path.absolute if cluster else Path  # its workers run in other folders
    places = [model_dir, *map(Path, known or ())]
    files = [file for place in places for file in (place, *place.glob("*")) if file.is_file()]
    ask = _Question(
        anywhere(model_dir),
        cli.comma(candidates),
        stated,
        early=early,
        next_touch=next_touch,
        nearest=nearest,
        known=tuple(str(anywhere(Path(path))) for path in known or ()),
        changed_at=max((file.stat().st_mtime_ns for file in files), default=0),
    )
    if serve and pool != 1:
        raise UserError("--serve answers one after the other", hint="leave --workers and --cluster out")
    if serve:
        return _serve(console, ask, port)
    assert out is not None
    _answerer(ask)
    answers = answer_files(console, "classify", paths or [], ask.answer, out, pool)
    rows = [row for of_file in answers for row in of_file["rows"]]
    more = [key for key in ("next_touch_degC", "next_touch_accuracy") if key in rows[0]]
    shown = [
        (
            row["grasp_id"],
            _material_words(row),
            max((row[key] for key in row if _is_candidate(key) and row[key] is not None), default=None),
            row["p_unknown"],
            row["decided_at_s"],
            *(row[key] for key in more),
        )
        for row in rows[:SHOWN]
    ]
    head = ("grasp", "material", "p nearest", "p unknown", "decided at [s]", *(_HEADS[key] for key in more))
    console.table("Materials", head, shown)
    _say_more(console, len(rows))
    say_names(
        console,
        (
            (f"{row['note']}{'' if row['material'] else ', so no name'}", row["grasp_id"])
            for row in rows
            if row.get("note")
        ),
    )
    strange = {row["grasp_id"]: row["deviates"] for row in rows if row.get("deviates")}
    for name, why in [*strange.items()][:SHOWN]:
        console.say(f"{name} is out of distribution: {why}")
    console.say(f"wrote {out}")
    if as_json:
        console.answer({"grasps": rows, "strange": strange, "out": out})
    return 0


def _serve(console: Console, ask: _Question, port: int | None) -> int:
    """Answer single grasps: from stdin, or over HTTP at a port."""
    from thermogrip.classify.decisions.serve import HOST, listen, reply, serve_lines, server

    answer_record = _answerer(ask)

    def answer(record: Grasps) -> list[dict[str, Any]]:
        return answer_record(record)[0]

    if port is None:
        serve_lines(answer, sys.stdin.buffer, sys.stdout.buffer)
        return 0
    if find_spec("uvicorn") is None or find_spec("starlette") is None:
        raise UserError(
            "--port needs the packages starlette and uvicorn", hint='pip install "thermogrip[live]"'
        )
    listening = listen(port)
    sys.stderr.write(f"answers at http://{HOST}:{listening.getsockname()[1]}/\n")
    server(partial(reply, answer), listening).run(sockets=[listening])
    return 0


_Answerer: TypeAlias = "Callable[[Grasps], tuple[list[dict[str, Any]], GraspQuality]]"


@dataclass(frozen=True)
class _Question:
    """Options of an answer about each grasp."""

    model_dir: Path
    candidates: tuple[str, ...] | None = None
    stated: tuple[float, float] | None = None
    early: bool = False
    next_touch: bool = False
    nearest: bool = False
    known: tuple[str, ...] = ()
    changed_at: int = 0  # of the model's files [ns]: a worker of a cluster loads another model then

    def answer(self, record: Grasps) -> dict[str, Any]:
        """Return the rows of a record, and warnings of it."""
        warnings: list[str] = []
        rows, quality = _answerer(self)(record)
        cli.warn_of_contacts(warnings.append, [record], [quality])
        return {"rows": rows, "warnings": warnings}

    def load(self) -> _Answerer:
        """Return what answers a record with a row a grasp."""
        from thermogrip.classify.decisions.predict import answer_record
        from thermogrip.classify.decisions.stopping_rule import load_stop_rule
        from thermogrip.classify.estimators.registry import load_classifier
        from thermogrip.sysid.effusivity.data import with_object_range

        model = load_classifier(self.model_dir)
        rule = load_stop_rule(self.model_dir) if self.early else None
        if self.known:
            model = _with_gripper(model).for_another_gripper(grasp_arguments.read_grasp_files(self.known))

        def rows_of(record: Grasps) -> tuple[list[dict[str, Any]], GraspQuality]:
            answers, quality = answer_record(
                model, record, self.candidates, rule, self.stated, nearest=self.nearest
            )
            rows = [one.row() for one in answers]
            if self.next_touch:  # at which temperature another touch of its block would be worth most
                from thermogrip.classify.decisions.next_touch import advise_touches

                ranged = with_object_range(record, self.stated)
                for row, advice in zip(rows, advise_touches(model, ranged, candidates=self.candidates)):
                    row |= advice
            return rows, quality

        return rows_of


@lru_cache(maxsize=1)
def _answerer(ask: _Question) -> _Answerer:
    """Return what answers a record, loaded once a process."""
    return ask.load()


@dataclass(frozen=True)
class _Effusivity:
    """Options of the effusivity of each grasp."""

    device: GripperModel
    coupling: Coupling | None
    longest: float
    stated: tuple[float, float] | None

    def answer(self, record: Grasps) -> dict[str, Any]:
        """Return the rows of a record, what is not explained or missing, and warnings of it."""
        from thermogrip.classify.decisions.predict import unexplained_effusivities
        from thermogrip.sysid.effusivity import EffusivityRow, effusivity_posterior
        from thermogrip.sysid.effusivity.data import with_object_range
        from thermogrip.sysid.effusivity.multi_touch import rested_long
        from thermogrip.sysid.effusivity.quality import check_grasps

        warnings, ranged = list[str](), with_object_range(record, self.stated)
        quality = check_grasps(ranged, longest=self.longest)
        cli.warn_of_contacts(warnings.append, [record], [quality])
        if (more := quality.shortened).any():
            warnings.append(
                f"{record.attrs['name']}: {int(more.sum())} of {more.size} contacts are read until "
                f"{self.longest:g} s, as long as those lasted that taught the gripper"
            )
        if rested_long(record, self.coupling).any():
            warnings.append(
                f"{record.attrs['name']}: blocks that rested longer than those that taught how they move "
                "between touches: intervals may be too narrow"
            )
        estimates, misfits = list[EffusivityRow](), dict[str, tuple[float, str]]()
        if (touched := quality.read(ranged)) is not None:
            estimates = effusivity_posterior(self.device, touched, coupling=self.coupling)
            misfits = unexplained_effusivities(self.device, touched, estimates)
        names, unread = map(str, record["grasp"].values), iter(estimates)
        # one without contact has no numbers, and no part in its block
        nothing, missed, rows = [float("nan")] * 8, dict[str, str](), list[dict[str, Any]]()
        for name, why in zip(names, quality.reason):
            row = EffusivityRow(name, *nothing) if why else next(unread)
            rows.append(asdict(row) | {"misfit_sd": misfits.get(name, (float("nan"), ""))[0]})
            missed |= {name: why} if why else {}
        unexplained = {name: words for name, (_, words) in misfits.items() if words}
        return {"rows": rows, "unexplained": unexplained, "missed": missed, "warnings": warnings}


def materials(
    name: Annotated[str | None, cli.arg("[NAME]", "One material.")] = None, as_json: cli.AsJson = False
) -> int:
    """List the materials table, or show one row of it."""
    from thermogrip.sysid.contact.materials import find_material, load_materials

    rows = (
        [find_material(name)]
        if name is not None
        else sorted(load_materials().values(), key=lambda m: m.effusivity)
    )
    console = Console(as_json)
    head = ("material", "k [W/mK]", "rho [kg/m3]", "c_p [J/kgK]", "effusivity", "+- %", "kind", "source")
    body = [
        (m.name, m.k, m.rho, m.c_p, m.effusivity, 100 * m.effusivity_sd_ln, m.kind, m.source) for m in rows
    ]
    count = f"{len(rows)} material{'s' if len(rows) > 1 else ''}"
    # for a program that reads lines, such as grep, each material is one
    console.table(f"{count}, effusivity in W s^0.5 m^-2 K^-1", head, body, wrap=sys.stdout.isatty())
    console.answer({"materials": rows})
    return 0


def _range(text: str | None) -> tuple[float, float] | None:
    """Return the ends of a range "A,B" [degC]."""
    if text is None:
        return None
    try:
        low, high = (float(word) for word in text.split(","))
    except ValueError as error:
        raise UserError(f"--object-range {text!r} is no range", hint="write 0,12 for 0 to 12 degC") from error
    if not low < high:
        raise UserError(f"--object-range {text!r} is empty", hint="give the lower end first")
    return low, high


def _stop_rule(console: Console, model: GraspClassifier, records: Sequence[Grasps], error: float) -> StopRule:
    """Learn when a contact may end, from grasps of known object temperature."""
    from thermogrip.classify.decisions.stopping_rule import learn_stop_rule
    from thermogrip.classify.evaluation.splits import scored_apart

    single = [record for record in records if not scored_apart(record)]
    if not single:
        raise UserError("no training grasp has an object temperature", hint="leave --stop-error out")
    with console.progress("stop rule") as progress:
        rule: StopRule = learn_stop_rule(model, single, error=error, progress=progress)
    return rule


def _with_gripper(model: GraspClassifier) -> PosteriorClassifier:
    """Return the model if it has a gripper, which may be another one than took the grasps."""
    from thermogrip.classify.estimators.posterior import PosteriorClassifier

    if not isinstance(model, PosteriorClassifier):
        raise UserError(
            "this model knows no gripper that could be another one", hint="train a posterior classifier"
        )
    return model


def check_place(out: Path, given: Sequence[str]) -> None:
    """Refuse a place for answers that cannot be written, or is among the files that are read."""
    from thermogrip.datasets.files import file_format
    from thermogrip.datasets.grasp_files import meta_path

    if as_folder := out.is_dir() or not out.suffix:
        cli.new_folder(out)
    else:
        cli.new_file(out, (".csv", ".parquet"))
    file, hint = out / "answers.csv" if as_folder else out, "choose another name or folder for --out"
    place = file.resolve()
    for pattern in given:
        read = [Path(name).resolve() for name in grasp_arguments.matching_files(pattern)]
        if place.parent in (path for path in read if path.is_dir()):
            raise UserError("is in a folder that is read", file=file, hint=hint)
        read += [meta_path(path) for path in read if path.is_file() and file_format(path) == "csv"]
        if place in read or (place.match(str(Path(pattern).resolve())) and not Path(pattern).is_dir()):
            raise UserError("is to be read and written", file=file, hint=hint)


def answer_files(
    console: Console,
    verb: str,
    paths: Sequence[str],
    answer: Callable[[Grasps], dict[str, Any]],
    out: Path,
    workers: int | str,
    unknown: str = "",
) -> list[dict[str, Any]]:
    """Return the answers to files of grasps, read one by one, with the ``rows`` of their tables written; CSV
    has ``unknown`` for NaN."""
    from thermogrip.datasets.files import file_stem
    from thermogrip.datasets.parallel import in_order
    from thermogrip.sysid.effusivity.quality import torn_groups

    files = grasp_arguments.list_grasp_files(paths)
    todo = [(file.absolute(), name) for file, name in zip(files, grasp_arguments.distinct_names(files))]
    answers: list[dict[str, Any]] = []
    with console.progress(verb) as progress:
        progress(0.0, "grasps")
        for (file, name), each in zip(todo, in_order(partial(_answer_file, answer), todo, workers)):
            for words in each["warnings"]:
                console.warn(words)
            answers.append(each)
            if out.is_dir():
                table = file_stem((name or file.name).replace("/", "_"))
                write_table(each["rows"], out / f"{table}.csv", unknown)
            progress(len(answers) / len(todo), file.name)
    for words in torn_groups((each["name"], each["groups"]) for each in answers):
        console.warn(words)
    if not out.is_dir():
        write_table([row for each in answers for row in each["rows"]], out, unknown)
    return answers


def _answer_file(answer: Callable[[Grasps], dict[str, Any]], file: tuple[Path, str | None]) -> dict[str, Any]:
    """Return the answer to one file of grasps, with its name and the blocks that were touched."""
    from thermogrip.datasets.grasp_files import read_grasps
    from thermogrip.sysid.effusivity.quality import touched_groups

    path, name = file
    record = read_grasps(path, name=name)
    return answer(record) | {"name": str(record.attrs["name"]), "groups": touched_groups(record)}


def write_table(rows: Sequence[dict[str, Any]], path: Path, unknown: str = "") -> None:
    """Write rows as CSV or, by the ending of ``path``, Parquet, whole or not at all; columns are those of all
    rows, in order of appearance."""
    from thermogrip.classify.decisions.predict import table_csv
    from thermogrip.datasets.files import atomic_path, write_atomic

    if path.suffix.lower() == ".csv":
        write_atomic(path, table_csv(rows, unknown))
        return
    import pandas as pd

    with atomic_path(path) as temporary:
        pd.DataFrame(rows).to_parquet(temporary, index=False)


def say_names(console: Console, said: Iterable[tuple[str, str]]) -> None:
    """Print what is said of some grasps, each of these texts once with the first grasps of which it is."""
    names: dict[str, list[str]] = {}
    for words, name in said:
        names.setdefault(words, []).append(name)
    for words, of in names.items():
        more = f" and {len(of) - SHOWN} more" if len(of) > SHOWN else ""
        console.say(f"{words}: {', '.join(of[:SHOWN])}{more}")


def _material_words(row: Mapping[str, Any]) -> str:
    """Return the name, of an unknown material the candidate that the probability beside it is of, too."""
    if row["material"] != "unknown":
        return str(row["material"])
    p = {key.removeprefix("p_"): row[key] for key in row if _is_candidate(key) and row[key] is not None}
    return f"unknown, nearest {max(p, key=p.__getitem__)}" if p else "unknown"


def _is_candidate(key: str) -> bool:
    return key.startswith("p_") and key != "p_unknown"


def _say_more(console: Console, n: int) -> None:
    if n > SHOWN:
        console.say(f"... and {n - SHOWN} more in the file")
