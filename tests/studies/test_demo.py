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
from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.mpc.interface import Move
from thermogrip.report.html import Section, Table
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


@pytest.mark.parametrize(("workers", "compared"), [(1, (0.87, "x")), (3, (0.76, "train and test"))])
def test_every_stage_has_its_share_of_the_progress_and_its_section(
    workers: int, compared: tuple[float, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[float, str]] = []
    asked: dict[str, tuple[Any, ...]] = {}
    session = SimpleNamespace(grasps="a grasp")
    results = {
        "_identify": SimpleNamespace(
            identification="found", plant="plant", posterior="record", held_out="run"
        ),
        "_tune": ("tuning", "checks"),
        "_grasp_on_twin": [("one", session), ("two", SimpleNamespace(grasps=None))],
        "_compare": ("comparison", "model"),
    }  # fmt: skip
    for name, result in results.items():

        def stage(*args: Any, name: str = name, result: Any = result) -> Any:
            asked[name] = args[:-1]
            if args[-1] is not None:  # while this process identifies, others compare
                args[-1](0.5, "x")
            return result

        monkeypatch.setattr(demo, name, stage)
    for name in ("identification", "free_run", "parameters", "tuning", "review", "session"):
        monkeypatch.setattr(
            demo, f"{name}_section",
            lambda *args, name=name, **_: Section(f"{name} of {' '.join(map(str, args))}", ()),
        )  # fmt: skip
    monkeypatch.setattr(
        demo, "_touch", lambda out, model, touched: Section(f"touch of {model} {touched}", ())
    )
    monkeypatch.setattr(demo, "comparison_sections", lambda *args: [Section(" ".join(args), ())])
    done = demo.run_demo(
        tmp_path, seed=SEED, workers=workers, progress=lambda fraction, what: seen.append((fraction, what))
    )
    assert seen == [
        (pytest.approx(0.3), "identify: x"), (pytest.approx(0.665), "tune: x"),
        (pytest.approx(0.745), "run: x"), (pytest.approx(compared[0]), f"compare: {compared[1]}"),
        (1.0, "done"),
    ]  # fmt: skip
    assert asked == {
        "_identify": (tmp_path, SEED), "_tune": (tmp_path, "plant", SEED, workers),
        "_grasp_on_twin": (tmp_path, "tuning", "plant", SEED), "_compare": (tmp_path, SEED, workers),
    }  # fmt: skip
    assert [section.title for section in done.sections] == [
        "identification of found", "free_run of run", "parameters of plant record",
        "tuning of tuning", "review of checks",
        f"session of {results['_grasp_on_twin']} the twin (posterior draw 3)", "touch of model ['a grasp']",
        "shipped comparison", "The same with your files",
    ]  # fmt: skip
    assert done.report == tmp_path / "report.html"
    assert "identification of found" in done.report.read_text()


def test_a_plant_is_fitted_to_three_logs_and_the_first_half_of_the_fourth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[float, str]] = []
    calls: dict[str, Any] = {}
    fitted, sampled = (
        SimpleNamespace(plant="a plant"),
        SimpleNamespace(save=lambda path: calls.update(saved=path)),
    )

    def identify(logs: Any, *, progress: Any, **options: Any) -> Any:
        progress(0.5, "x")
        calls["identify"] = (
            [log.attrs["name"] for log in logs],
            [log.sizes["time"] for log in logs],
            options,
        )
        return fitted

    def sample(plant: Any, logs: Any, *, seed: int, progress: Any) -> Any:
        progress(0.5, "y")
        calls["sample"] = (plant, len(logs), seed)
        return sampled, "a record"

    monkeypatch.setattr("thermogrip.sysid.identification.identify", identify)
    monkeypatch.setattr("thermogrip.sysid.greybox.posterior.sample_posterior", sample)
    monkeypatch.setattr(
        "thermogrip.sysid.validation.free_run.free_run",
        lambda plant, log, *, score_from: (plant, log.sizes["time"], score_from),
    )
    found = demo._identify(tmp_path, SEED, lambda fraction, what: seen.append((fraction, what)))
    names, rows, options = calls["identify"]
    assert (len(names), options) == (
        4, {"network": "gripper", "models": ("arx", "oe", "sindy", "network"), "draws": 0, "seed": SEED},
    )  # fmt: skip
    plant, n, score_from = found.held_out
    assert (plant is sampled, score_from) == (True, 1350)
    [cut] = [rows for name, rows in zip(names, rows) if name.startswith("pump_on_off")]
    assert 0.4 < cut / n < 0.6
    assert (calls["sample"], calls["saved"]) == (
        ("a plant", 4, SEED),
        tmp_path / "plant.json",
    )
    assert (found.identification, found.plant, found.posterior) == (fitted, sampled, "a record")
    assert seen == [(pytest.approx(0.3), "x"), (pytest.approx(0.8), "posterior: y")]
