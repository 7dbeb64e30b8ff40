"""Files that version 0.1.0 wrote load, and answer as they did then (``files_of_0_1_0/expected.json``)."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import classify_grasps, load_classifier
from thermogrip.cli.main import main
from thermogrip.datasets import read_grasps
from thermogrip.datasets.examples import load_example_logs
from thermogrip.mpc import Controller
from thermogrip.sysid import Plant

OLD = Path(__file__).parents[1] / "files_of_0_1_0"
EXPECTED = json.loads((OLD / "expected.json").read_text())


@pytest.mark.parametrize("name", ["plant_network", "plant_linear"])
def test_a_plant_of_0_1_0_predicts_the_same(name: str) -> None:
    log = load_example_logs()["multisine"]
    simulated = Plant.load(OLD / f"{name}.json").simulate(log)
    for output, values in EXPECTED[name].items():
        np.testing.assert_allclose(np.asarray(simulated[output])[[0, 1000, 6000, -1]], values, atol=1e-6)


def test_a_controller_of_0_1_0_moves_the_same() -> None:
    controller = Controller.load(OLD / "controller.json")
    reading = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
    controller.reset(reading)
    moves = [controller.step({**reading, "t_surface": 25.0 + 0.1 * k}, 30.0) for k in range(4)]
    assert [str(move.status) for move in moves] == EXPECTED["controller"]["status"]
    np.testing.assert_allclose([move.drive for move in moves], EXPECTED["controller"]["drive"], atol=1e-6)


# bayes of today divides each grasp's features by its own difference of temperature; posterior knows that a
# stated temperature of an object may be a slip, and that of this grasp is 1.3 K off
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("bayes", 0.02), ("features-lda", 1e-6), ("pca-lda", 1e-6), ("posterior", 0.08), ("lstm", 1e-4)],
)
def test_a_classifier_of_0_1_0_answers_the_same(name: str, tolerance: float) -> None:
    row = classify_grasps(load_classifier(OLD / name), read_grasps(OLD / "run" / "grasps.csv"))[0]
    expected = dict(EXPECTED[name])
    assert row["material"] == expected.pop("material")
    if name == "bayes":  # it had no model of other materials
        assert expected.pop("p_unknown") is None
        assert 0 < row["p_unknown"] < 0.5
    for key, value in expected.items():
        assert row[key] == (None if value is None else pytest.approx(value, abs=tolerance)), key


def test_a_run_folder_of_0_1_0_is_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(OLD / "run", tmp_path / "run")
    assert main(["recover", str(tmp_path / "run"), "--json"]) == 0
    assert main(["validate", str(OLD / "plant_network.json"), str(tmp_path / "run" / "samples.csv")]) == 0
    capsys.readouterr()


def test_the_code_in_an_fmu_of_0_1_0_finds_its_runtime(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pythonfmu")
    shutil.copy(OLD / "fmu" / "thermogrip_slave_plant.py", tmp_path)
    shutil.copy(OLD / "plant_network.json", tmp_path / "plant.json")
    monkeypatch.syspath_prepend(str(tmp_path))
    slave = __import__("thermogrip_slave_plant").plant(instance_name="plant", resources=str(tmp_path))
    slave.exit_initialization_mode()
    assert slave.do_step(0.0, 1.0)
    assert slave.core.get("t_surface") == pytest.approx(slave.core.get("t_tank"), abs=5.0)
    del sys.modules["thermogrip_slave_plant"]
