"""classify says where another touch is worth its time, and when the answer is "unknown"."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from thermogrip.classify import save_classifier
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

TWO, OTHERS = "exp5_two_touch_unknown_object", "exp6_other_materials_obj43_grip23"


@pytest.fixture
def finger(bench):
    """The bundled gripper; a copper and a wooden block of unknown temperature, and cork at a known one."""
    save_classifier(PosteriorClassifier().with_device(load_default_gripper()), bench.path / "finger")
    files = load_example_grasps()
    write_grasps(files[TWO].isel(grasp=[24, 28]).drop_vars("touch_group"), bench.path / "one.csv")
    cork = np.flatnonzero(files[OTHERS]["material"].values == "cork")
    write_grasps(files[OTHERS].isel(grasp=cork), bench.path / "cork.csv")
    return bench


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_another_touch_is_worth_it_where_metals_are_open(finger):
    done = finger.run("classify", "finger", "one.csv", "--next-touch", "--out", "p.csv", "--json")
    assert done.code == 0, done.err
    copper, wood = table(finger.path / "p.csv")
    assert 10 <= float(copper["next_touch_degC"]) <= 20  # far below the gripper's 40 degC and the block
    best = max(float(copper[f"p_{name}"]) for name in ("brass", "copper", "iron", "wood", "zinc"))
    assert float(copper["next_touch_accuracy"]) > best + 0.07  # seventy seconds at 0.001 each
    assert wood["next_touch_degC"] == ""
    assert json.loads(done.out)["grasps"][1]["next_touch_degC"] is None


def test_unknown_is_an_answer_beside_the_likeliest_material(finger):
    assert finger.run("classify", "finger", "cork.csv", "--or-unknown", "--out", "p.csv").code == 0
    rows = table(finger.path / "p.csv")
    assert {row["answer"] for row in rows} == {"unknown"}
    assert {row["material"] for row in rows} == {"wood"}


def test_without_the_options_the_columns_are_those_of_the_contract(finger):
    words = ["classify", "finger", "cork.csv", "--materials", "iron,wood", "--out", "p.csv"]
    assert finger.run(*words).code == 0
    assert [*table(finger.path / "p.csv")[0]] == [
        "grasp_id", "material", "p_iron", "p_wood", "p_unknown", "decided_at_s",
    ]  # fmt: skip


def test_a_classifier_without_a_model_of_readings_advises_nothing(bench):
    assert bench.run("train", "grasps.csv", "--classifier", "bayes", "--out", "m").code == 0
    refused = bench.run("classify", "m", "grasps.csv", "--next-touch", "--out", "p.csv")
    assert refused.code == 2
    assert "cannot predict readings" in refused.said[0]
    refused = bench.run("classify", "m", "grasps.csv", "--or-unknown", "--out", "p.csv")
    assert refused.code == 2
    assert "p_unknown is missing" in refused.said[0]
    assert not (bench.path / "p.csv").exists()
