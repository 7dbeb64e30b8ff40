"""Files that version 0.2.0 wrote load and answer as they did, or name the verb that makes them anew."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import classify_grasps, load_classifier
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps, load_example_logs
from thermogrip.mpc import Controller
from thermogrip.mpc.design.spec import read_spec
from thermogrip.rig.guard.settings import read_guard
from thermogrip.sysid import Plant
from thermogrip.sysid.models.network import load_network

OLD = Path(__file__).parents[1] / "files_of_0_2_0"
EXPECTED = json.loads((OLD / "expected.json").read_text())


def test_a_plant_predicts_the_same() -> None:
    simulated = Plant.load(OLD / "plant_linear.json").simulate(load_example_logs()["multisine"])
    for output, values in EXPECTED["plant_linear"].items():
        np.testing.assert_allclose(np.asarray(simulated[output])[[0, 1000, 6000, -1]], values, atol=1e-6)


def test_a_network_s_plant_and_settings_load() -> None:
    assert Plant.load(OLD / "plant_network.json").values["G_amb"] == pytest.approx(0.01)
    assert load_network(OLD / "network.toml").outputs
    assert read_spec(OLD / "spec.toml").steps[0] == (28.0, 38.0)


@pytest.mark.parametrize("name", ["pca-lda", "posterior"])
def test_a_classifier_names_copper(name: str) -> None:
    grasps = load_example_grasps()["exp1B_obj43_grip38"]
    assert classify_grasps(load_classifier(OLD / name), grasps)[0]["material"] == "copper"


@pytest.mark.parametrize(
    ("load", "file", "words"),
    [
        (Controller.load, "controller.json", "tune again"),
        (read_guard, "guard.toml", "`thermogrip init guard` shows every key"),
    ],
)
def test_what_is_made_anew_names_its_verb(load: Callable[[Path], object], file: str, words: str) -> None:
    with pytest.raises(UserError) as refused:
        load(OLD / file)
    assert words in f"{refused.value} {refused.value.hint}"


def test_a_run_folder_is_whole(tmp_path: Path) -> None:
    shutil.copytree(OLD / "run", tmp_path / "run")
    assert main(["recover", str(tmp_path / "run"), "--json"]) == 0
