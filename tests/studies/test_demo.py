"""The demo's stages on a small plant and few grasps: what they run, score and write."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.end_to_end.conftest import small_plant
from tests.end_to_end.drawn import faults_of
from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.mpc.interface import Move
from thermogrip.report.html import Table
from thermogrip.rig import Session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.studies import demo

SEED = 4


class Holding:
    """Proportional on the tank's error, plus what holds the small plant at its target."""

    dt = 1.0

    def reset(self, reading: Mapping[str, float]) -> None:
        """Nothing is remembered."""

    def step(self, reading: Mapping[str, float], target: float) -> Move:
        goal = target + (target - reading["t_ambient"]) * 15.0 / 2000.0  # the skin hangs below the tank
        hold = (goal - reading["t_ambient"]) / (0.4 * 300.0)
        return Move(drive=float(np.clip(hold + 0.2 * (goal - reading["t_tank"]), -1.0, 1.0)))


Sessions = list[tuple[str, Session]]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Sessions, list[tuple[float, str]]]:
    """The folder, the sessions and the progress of two runs into one folder; the second one counts."""
    out, seen = tmp_path_factory.mktemp("demo"), []
    plant = SimpleNamespace(draw=lambda k: small_plant())
    tuning = SimpleNamespace(controller=Holding())
    demo._grasp_on_twin(out, tuning, plant, SEED + 7, None)
    sessions = demo._grasp_on_twin(
        out, tuning, plant, SEED, lambda fraction, what: seen.append((fraction, what))
    )
    return out, sessions, seen


def test_the_twin_settles_and_grasps_each_material(ran: tuple[Path, Sessions, Any]) -> None:
    out, sessions, _ = ran
    assert [title for title, _ in sessions] == [
        f"28 to 38 degC, then {name} at 18 degC" for name in demo.TOUCHED
    ]
    assert set(demo.TOUCHED) - set(demo.CANDIDATES) == {"glass"}
    for k, (name, (_, session)) in enumerate(zip(demo.TOUCHED, sessions)):
        assert session.verdict == "settled"
        assert session.log["t_surface"].values[0] == pytest.approx(28.0, abs=0.3)
        grasp = session.grasps.isel(grasp=0)
        assert (str(grasp["material"].values), float(grasp["t_object"])) == (name, 18.0)
        before = grasp["t_surface"].values[grasp["time"].values < -0.25]
        assert before.mean() == pytest.approx(38.0, abs=0.2)
        about = json.loads((out / f"run{k + 1}-{name}" / "run.json").read_text())["about"]
        assert (about["material"], about["seed"]) == (name, SEED + k)
        again = Twin(small_plant(), seed=about["seed"], t_start=28.0).read()
        assert session.log["t_surface"].values[0] == again.values["t_surface"]


def test_classifiers_are_scored_on_test_grasps_and_trained_for_the_twins_on_training_grasps(
    ran: tuple[Path, Sessions, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[list[Grasps]] = []

    def make(name: str, **params: object) -> GraspClassifier:
        model = make_classifier("bayes" if name == "posterior" else "features-lda")
        learn = model.fit

        def fit(records: list[Grasps]) -> GraspClassifier:
            trained.append(records)
            return learn(records)

        monkeypatch.setattr(model, "fit", fit)
        return model

    monkeypatch.setattr("thermogrip.classify.estimators.registry.make_classifier", make)
    monkeypatch.setattr(demo, "CLASSIFIERS", ("bayes", "features-lda"))
    monkeypatch.setattr(demo, "COMPARED", ("exp2_dT10", "exp2_dT20"))
    seen: list[tuple[float, str]] = []
    comparison, classifier = demo._compare(tmp_path, SEED, 1, lambda *step: seen.append(step))
    assert {row["condition"]: row["n"] for row in comparison.scores()} == {
        "pooled": 18,
        "exp2_dT10": 9,
        "exp2_dT20": 9,
    }
    assert max(seen)[0] == pytest.approx(0.85)
    assert seen[-1] == (0.85, "calibrating for the twin's grasps")
    examples = load_example_grasps()
    names = [record.attrs["name"] for record in trained[-1]]
    assert names == ["exp2_dT10", "exp2_dT20", "exp3C_obj18_grip38"]
    assert all((record["split"].values == "train").all() for record in trained[-1])
    assert [record.sizes["grasp"] for record in trained[-1]] == [
        int((examples[name]["split"].values == "train").sum()) for name in names
    ]
    assert {path.name for path in tmp_path.iterdir()} == {"comparison", "classifier"}

    touched = [session.grasps for _, session in ran[1]]
    section = demo._touch(tmp_path, classifier, touched)
    [table] = [part for part in section.parts if isinstance(part, Table)]
    assert [row[0] for row in table.rows] == [*demo.TOUCHED]
    right = sum(row[0] == row[1] for row in table.rows[:4])
    assert section.verdict.startswith(f"{right} of 4 blocks of copper, iron, wood are named right; ")
    assert len((tmp_path / "predictions.csv").read_text().splitlines()) == 6


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A worker was restarted:UserWarning")  # it grew
def test_the_whole_demo_leaves_a_page_whose_every_question_is_answered(tmp_path: Path) -> None:
    seen: list[tuple[float, str]] = []
    done = demo.run_demo(tmp_path, seed=SEED, workers=2, progress=lambda *step: seen.append(step))
    assert seen[-1] == (1.0, "done")
    stages = list(dict.fromkeys(what.partition(":")[0] for _, what in seen))
    assert stages == ["identify", "tune", "run", "compare", "done"]
    questions = [section for section in done.sections if section.title.endswith("?")]
    assert len(questions) >= 4
    assert all(section.verdict for section in questions)
    page = done.report.read_text(encoding="utf-8")
    assert all(section.title in page for section in done.sections)
    assert list(faults_of(page)) == []
    made = {path.name for path in tmp_path.iterdir()}
    assert made >= {
        "plant.json",
        "controller.json",
        "comparison",
        "classifier",
        "predictions.csv",
        "report.html",
    }
