"""classify for more than a name: another touch, "unknown", and another gripper than the model's."""

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

FIVE = ("brass", "copper", "iron", "wood", "zinc")
TWO, OTHERS = "exp5_two_touch_unknown_object", "exp6_other_materials_obj43_grip23"


@pytest.fixture
def finger(bench):
    """The bundled gripper; copper and wood of unknown temperature, cork at a known one, two grasps to
    name and one of iron."""
    save_classifier(PosteriorClassifier().with_device(load_default_gripper()), bench.path / "finger")
    files = load_example_grasps()
    write_grasps(files[TWO].isel(grasp=[24, 28]).drop_vars("touch_group"), bench.path / "one.csv")
    cork = np.flatnonzero(files[OTHERS]["material"].values == "cork")
    write_grasps(files[OTHERS].isel(grasp=cork), bench.path / "cork.csv")
    record = files["exp1A_obj43_grip23"]
    write_grasps(record.isel(grasp=[13, 21]).drop_vars("material"), bench.path / "new.csv")
    iron = np.flatnonzero(record["material"].values == "iron")[:1]
    write_grasps(record.isel(grasp=iron), bench.path / "iron.csv")
    return bench


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_another_touch_is_worth_it_where_metals_are_open(finger):
    done = finger.run("classify", "finger", "one.csv", "--next-touch", "--out", "p.csv", "--json")
    assert done.code == 0, done.err
    copper, wood = table(finger.path / "p.csv")
    assert 10 <= float(copper["next_touch_degC"]) <= 20  # far below the gripper's 40 degC and the block
    best = max(float(copper[f"p_{name}"]) for name in FIVE)
    assert float(copper["next_touch_accuracy"]) > best + 0.07  # seventy seconds at 0.001 each
    assert wood["next_touch_degC"] == ""
    assert json.loads(done.out)["grasps"][1]["next_touch_degC"] is None


def test_a_material_outside_the_candidates_is_unknown_but_for_nearest(finger):
    assert finger.run("classify", "finger", "cork.csv", "--out", "p.csv").code == 0
    assert {row["material"] for row in table(finger.path / "p.csv")} == {"unknown"}
    assert finger.run("classify", "finger", "cork.csv", "--nearest", "--out", "p.csv").code == 0
    assert {row["material"] for row in table(finger.path / "p.csv")} == {"wood"}


def test_known_grasps_of_another_gripper_count(finger):
    def answers(*options):
        done = finger.run("classify", "finger", "new.csv", *options, "--out", "p.csv")
        assert done.code == 0, done.err
        return [float(row["p_iron"]) for row in table(finger.path / "p.csv")]

    assert answers() != answers("--known", "iron.csv")
    refused = finger.run("classify", "finger", "new.csv", "--known", "new.csv", "--out", "q.csv")
    assert (refused.code, "no material" in refused.said[0]) == (2, True)
    assert not (finger.path / "q.csv").exists()
