"""A contact that has said enough ends: from training grasps to a session, through files."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from tests.end_to_end.conftest import small_plant
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.mpc import Controller


@pytest.fixture
def finger(bench):
    """A classifier with a stop rule, from 15 grasps at a difference of 20 degC; the other nine are a file."""
    grasps = load_example_grasps()["exp2_dT20"]
    for name in ("train", "test"):
        there = np.flatnonzero(grasps["split"].values == name)
        write_grasps(grasps.isel(grasp=there), bench.path / f"{name}.csv")
    words = ["train", "train.csv", "--classifier", "posterior", "--stop-error", "0.15", "--out", "finger"]
    done = bench.run(*words, "--json")
    assert done.code == 0, done.err
    assert 0.5 <= json.loads(done.out)["stop_sure"] <= 1
    return bench


def test_early_predictions_say_when_they_were_sure(finger):
    assert finger.run("classify", "finger", "test.csv", "--early", "--out", "p.csv").code == 0
    with (finger.path / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    times = np.array([float(row["decided_at_s"]) for row in rows])
    assert times.mean() < 5.0
    # p_unknown is asked of the same readings
    assert all(0 <= float(row["p_unknown"]) <= 1 for row in rows)
    assert finger.run("classify", "finger", "test.csv", "--out", "whole.csv").code == 0
    with (finger.path / "whole.csv").open() as file:
        assert {row["decided_at_s"] for row in csv.DictReader(file)} == {"10"}
    # a contact ends when the classifier's stop rule is met, though the session knows nothing of it
    Controller(small_plant()).save(finger.path / "c.json")
    words = ["run", "c.json", "--target", "34", "--from", "28", "--twin", "plant.json", "--out", "r"]
    grasp = ["--object", "18", "--material", "wood", "--stop-early", "finger"]
    done = finger.run(*words, *grasp)
    assert done.code == 0, done.err
    events = [json.loads(line) for line in (finger.path / "r/events.jsonl").read_text().splitlines()]
    assert any("stopped" in str(event) for event in events)
    (finger.path / "finger/stop_rule.json").unlink()
    for command in (["classify", "finger", "test.csv", "--early", "--out", "q.csv"], [*words, *grasp]):
        refused = finger.run(*command)
        assert refused.code == 2
        assert "has no stop rule" in refused.said[0]
    assert "without a grasp" in finger.run(*words, "--stop-early", "finger").said[0]
