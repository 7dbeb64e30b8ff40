"""classify for another gripper than the model's: less sure, and learnt from a few known grasps."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from thermogrip.classify import save_classifier
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper


@pytest.fixture
def finger(bench):
    """The bundled gripper; two grasps to name, one of iron that is known, touches of one block."""
    save_classifier(PosteriorClassifier().with_device(load_default_gripper()), bench.path / "finger")
    files = load_example_grasps()
    record = files["exp1A_obj43_grip23"]
    write_grasps(record.isel(grasp=[13, 21]).drop_vars("material"), bench.path / "new.csv")
    iron = np.flatnonzero(record["material"].values == "iron")[:1]
    write_grasps(record.isel(grasp=iron), bench.path / "iron.csv")
    write_grasps(files["exp5_two_touch_unknown_object"].isel(grasp=[0, 6]), bench.path / "pair.csv")
    return bench


def confidence(bench, *options):
    done = bench.run("classify", "finger", "new.csv", *options, "--out", "p.csv")
    assert done.code == 0, done.err
    with (bench.path / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    return np.mean(
        [max(float(row[f"p_{m}"]) for m in ("brass", "copper", "iron", "wood", "zinc")) for row in rows]
    )


def test_another_gripper_is_answered_less_surely_until_it_is_known(finger):
    ours = confidence(finger)
    other = confidence(finger, "--other-gripper")
    learnt = confidence(finger, "--known", "iron.csv")
    assert other < ours - 0.05
    assert other < learnt


def test_what_another_gripper_cannot_be_asked_is_refused(finger):
    for option in ("--next-touch", "--early"):
        refused = finger.run("classify", "finger", "new.csv", "--other-gripper", option, "--out", "p.csv")
        assert refused.code == 2
        words = (
            f"{option} needs a known gripper, and another one is uncertain; leave it out, or train on grasps"
        )
        assert words in refused.said[0]
    refused = finger.run("classify", "finger", "new.csv", "--known", "new.csv", "--out", "p.csv")
    assert refused.code == 2
    assert "no material" in refused.said[0]
    assert not (finger.path / "p.csv").exists()
