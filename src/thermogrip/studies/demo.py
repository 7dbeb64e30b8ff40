"""Everything once, on the bundled example data: identify, validate, tune, run, grasp, compare, one report.

The example logs and grasps come from a simulated rig that shares no code with thermogrip; sessions run on a
twin whose plant is a draw of the posterior, so the controller's model is not the truth.  The budgets are
small, so that two cores need about a minute and a half; the report says what that costs.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from thermogrip.datasets.parallel import sub_progress
from thermogrip.report.classification import (
    comparison_sections,
    review_section,
    session_section,
    touch_section,
)
from thermogrip.report.control import tuning_section
from thermogrip.report.html import Commands, Section, write_report
from thermogrip.report.plant import free_run_section, identification_section, parameters_section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermogrip.classify.estimators.base import GraspClassifier
    from thermogrip.classify.evaluation.comparison import Comparison
    from thermogrip.datasets.parallel import Progress, Workers
    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc.tuning.tune import Tuning
    from thermogrip.rig.session.session import Session
    from thermogrip.sysid.greybox.posterior import Posterior
    from thermogrip.sysid.identification import Identification
    from thermogrip.sysid.plant.plant import Plant
    from thermogrip.sysid.validation.free_run import FreeRun

SPLIT_S = 1350  # the first seconds of pump_on_off are fitted, the rest is held out
MODELS = ("arx", "oe", "sindy", "network")
STEPS = ((28.0, 18.0), (18.0, 43.0))  # where controllers differ: from 28 to 38 all take the drive's own time
DRAW = 3  # the twin's plant, a draw of the posterior
T_OBJECT, T_GRIPPER = 18.0, 38.0  # degC
CANDIDATES = ("copper", "iron", "wood")  # as in the condition at these temperatures
TOUCHED = ("copper", "wood", "copper", "wood", "glass")  # by the twin; glass is none of the candidates
COMPARED = ("exp1A_obj43_grip23", "exp2_dT10", "exp2_dT20", "exp3A_obj43_grip23", "exp3B_obj28_grip48")
CLASSIFIERS = ("posterior", "bayes", "lstm")


@dataclass(frozen=True)
class DemoResult:
    """The page of the demo, and its sections with verdicts in words."""

    report: Path
    sections: tuple[Section, ...]


def run_demo(
    out: Path, *, seed: int = 0, workers: Workers = 2, progress: Progress | None = None
) -> DemoResult:
    """Run every stage once and write files and a report into an existing folder, in place of what an earlier
    demo left there."""
    # to compare classifiers needs no plant: the workers do it while this process identifies one
    with ThreadPoolExecutor(1) as beside:
        compare = partial(_compare, out, seed, workers)
        compared = None if workers == 1 else beside.submit(copy_context().run, compare, None)
        identified = _identify(out, seed, sub_progress(progress, 0.0, 0.6, "identify"))
        plant = identified.plant
        tuning = _tune(out, plant, seed, workers, sub_progress(progress, 0.6, 0.73, "tune"))
        sessions = _grasp_on_twin(out, tuning, plant, seed, sub_progress(progress, 0.73, 0.76, "run"))
        share = sub_progress(progress, 0.76, 0.98, "compare")
        if compared is not None and share is not None:
            share(0.0, "train and test")
        comparison, classifier = compare(share) if compared is None else compared.result()
    touched = [session.grasps for _, session in sessions if session.grasps is not None]
    sections = [
        identification_section(identified.identification),
        free_run_section(identified.held_out, title="Does it predict the half of a log that was held out?"),
        parameters_section(plant, identified.posterior),
        replace(tuning_section(tuning), shown=1),
        replace(review_section(tuning.checks), shown=0),
        session_section(sessions, f"the twin (posterior draw {DRAW})"),
        _touch(out, classifier, touched),
        *comparison_sections("shipped", comparison),
        _how_to_repeat(),
    ]
    path = out / "report.html"
    lead = (
        "Every stage once, on logs and grasps of a simulated rig that shares no code with thermogrip. These "
        "are not measurements on hardware."
    )
    write_report(path, "thermogrip, the demo", lead, sections)
    if progress is not None:
        progress(1.0, "done")
    return DemoResult(path, tuple(sections))


def compared_models(seed: int) -> tuple[dict[str, GraspClassifier], tuple[str, ...]]:
    """Return the classifiers that the demo compares, and a line for each that cannot be trained here."""
    from thermogrip.classify.estimators.registry import trainable

    models, missing = trainable(CLASSIFIERS, quick=True, seed=seed)
    return models, tuple(f"left out: {error}" for error in missing)


@dataclass(frozen=True)
class _Identified:
    """The plant of the demo, and how it was found and tested."""

    identification: Identification
    plant: Plant  # with the posterior's draws
    posterior: Posterior
    held_out: FreeRun


def _identify(out: Path, seed: int, progress: Progress | None) -> _Identified:
    """Fit three logs and half of the fourth, sample the posterior, and run freely over the held-out half."""
    from thermogrip.datasets.examples import EXAMPLE_LOGS, example_path
    from thermogrip.datasets.log_files import read_log
    from thermogrip.sysid.greybox.posterior import sample_posterior
    from thermogrip.sysid.identification import identify
    from thermogrip.sysid.validation.free_run import free_run

    cuts = {name: f"@:{SPLIT_S}" if name == "pump_on_off" else "" for name in EXAMPLE_LOGS}
    logs = [read_log(f"{example_path(name)}{cut}") for name, cut in cuts.items()]
    share = sub_progress(progress, 0.0, 0.6)
    identification = identify(logs, network="gripper", models=MODELS, draws=0, seed=seed, progress=share)
    share = sub_progress(progress, 0.6, 1.0, "posterior")
    plant, record = sample_posterior(identification.plant, logs, seed=seed, progress=share)
    plant.save(out / "plant.json")
    whole = read_log(example_path("pump_on_off"))
    return _Identified(identification, plant, record, free_run(plant, whole, score_from=SPLIT_S))


def _tune(out: Path, plant: Plant, seed: int, workers: Workers, progress: Progress | None) -> Tuning:
    """Tune on few whole draws with few evaluations."""
    from thermogrip.mpc.design.spec import Spec
    from thermogrip.mpc.tuning.tune import tune

    spec = Spec(steps=list(STEPS), evaluations=6, search_draws=1, check_draws=2)
    tuning = tune(plant, spec, seed=seed, progress=progress)
    tuning.save(out / "controller.json")
    return tuning


def _grasp_on_twin(
    out: Path, tuning: Tuning, plant: Plant, seed: int, progress: Progress | None
) -> list[tuple[str, Session]]:
    """Bring the twin to the grasping temperature and grasp, once for each block."""
    from thermogrip.rig.records.run_folder import RunFolder
    from thermogrip.rig.session.session import run_session
    from thermogrip.rig.simulation.twin import Twin

    sessions = []
    for k, name in enumerate(TOUCHED):
        about = {
            "twin": "plant.json",
            "draw": DRAW,
            "target_degC": T_GRIPPER,
            "material": name,
            "seed": seed + k,
        }
        rig = Twin(plant.draw(DRAW), seed=seed + k, t_start=28.0)
        share = sub_progress(progress, k / len(TOUCHED), (k + 1) / len(TOUCHED), name)
        with RunFolder(_fresh(out / f"run{k + 1}-{name}"), about) as recorder:
            session = run_session(
                rig, tuning.controller, T_GRIPPER, grasp=(name, T_OBJECT), recorder=recorder, progress=share
            )
            recorder.finish(session)
        rig.close()
        sessions.append((f"28 to {T_GRIPPER:g} degC, then {name} at {T_OBJECT:g} degC", session))
    return sessions


def _compare(
    out: Path, seed: int, workers: Workers, progress: Progress | None
) -> tuple[Comparison, GraspClassifier]:
    """Compare on bundled grasps, and train one posterior classifier for the twin's grasps."""
    from thermogrip.classify.estimators.registry import make_classifier, save_classifier
    from thermogrip.classify.evaluation.harness import evaluate
    from thermogrip.datasets.examples import load_example_grasps

    examples = load_example_grasps()
    models, left_out = compared_models(seed)
    conditions = [examples[name] for name in COMPARED]
    share = sub_progress(progress, 0.0, 0.85)
    comparison = evaluate(models, conditions, seed=seed, workers=workers, probe=False, progress=share)
    comparison = replace(comparison, notes=(*left_out, *comparison.notes))
    comparison.save(out / "comparison")
    if progress is not None:
        progress(0.85, "calibrating for the twin's grasps")
    labelled = [examples[name] for name in (*COMPARED, "exp3C_obj18_grip38")]
    training = [record.isel(grasp=record["split"].values == "train") for record in labelled]
    classifier = make_classifier("posterior", seed=seed).fit(training)
    save_classifier(classifier, out / "classifier")
    return comparison, classifier


def _touch(out: Path, classifier: GraspClassifier, touched: Sequence[Grasps]) -> Section:
    from thermogrip.classify.decisions.predict import answer, write_predictions

    rows = [one_answer.row() for one_answer in answer(classifier, list(touched), CANDIDATES)]
    if rows:
        write_predictions(rows, out / "predictions.csv")
    truth = [str(name) for grasps in touched for name in grasps["material"].values]
    shown = [row | {"true": name, "why": row.get("deviates", "")} for row, name in zip(rows, truth)]
    return touch_section(touched, shown, CANDIDATES)


def _how_to_repeat() -> Section:
    lines = (
        "thermogrip init examples                       # the files of this page, to try it on",
        "thermogrip identify LOG... --network gripper --posterior --out plant.json --report plant.html",
        "thermogrip validate plant.json LOG",
        "thermogrip tune plant.json --out controller.json --report loops.html",
        "thermogrip review controller.json",
        "thermogrip run controller.json --target 38 --from 28 --twin plant.json --draw 3 \\",
        "    --object 18 --material copper --out run1",
        "thermogrip train GRASPS... --classifier posterior --out model",
        "thermogrip classify model run1/grasps.csv --out predictions.csv",
        "thermogrip compare GRASPS... --out comparison",
    )
    return Section("The same with your files", (Commands(lines),))


def _fresh(folder: Path) -> Path:
    """Return the folder without the run that an earlier demo left there."""
    from thermogrip.rig.records.run_folder import NAMES

    if (folder / "run.json").exists():
        for name in NAMES:
            (folder / name).unlink(missing_ok=True)
    return folder
