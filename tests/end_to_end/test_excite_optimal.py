"""The optimal schedule from the command line: what is predicted, what is refused, what Ctrl-C leaves."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from thermogrip.datasets.log_files import read_log
from thermogrip.sysid.experiment import optimal
from thermogrip.sysid.experiment.information import ExperimentForecast, plant_from_prior
from thermogrip.sysid.models.network import load_network

OPTIMAL = ["excite", "--kind", "optimal", "--minutes", "10", "--highest", "70", "--out", "s.csv"]


def test_an_optimal_schedule_says_beforehand_what_it_will_identify(bench, monkeypatch):
    monkeypatch.setattr(optimal, "EVALUATIONS", 60)
    done = bench.run(*OPTIMAL, "--network", "tclab", "--json")
    assert done.code == 0, done.err
    answer = json.loads(done.out)
    expected = answer["expected"]
    assert set(expected["bits"]) == {"now", "prbs", "multisine", "staircase", "optimal"}
    assert expected["bits"]["optimal"] == max(expected["bits"].values())
    plant = plant_from_prior(load_network("tclab"))
    assert set(expected["widths_90"]["optimal"]) == set(plant.free)
    for name in plant.free:
        assert expected["widths_90"]["optimal"][name] <= expected["widths_90"]["now"][name]
    log = read_log("s.csv", inputs=["q1", "q2"], outputs=[])
    u = np.stack([log[name].values for name in plant.inputs], axis=1)
    assert len(u) == answer["rows"] == 600
    assert u.min() >= 0.0
    assert u.max() <= 100.0
    assert ExperimentForecast(plant, lowest=5.0, highest=70.0).stays(u)


def test_the_table_has_a_column_for_each_schedule(bench, monkeypatch):
    monkeypatch.setattr(optimal, "EVALUATIONS", 5)
    plant_from_prior(load_network("tclab")).save(bench.path / "board.json")
    done = bench.run(*OPTIMAL, "--plant", "board.json", "--hold", "q2", "--slew", "20")
    assert done.code == 0, done.err
    head = next(line for line in done.out.splitlines() if "parameter" in line)
    assert head.split() == ["parameter", "unit", "value", "now", "prbs", "multisine", "staircase", "optimal"]
    assert re.findall(r"^(\w+): [\d.]+ bits", done.out, re.MULTILINE) == head.split()[4:]
    assert done.out.count("bits; after optimal") == 3
    log = read_log("s.csv", inputs=["q1", "q2"], outputs=[])
    assert np.all(log["q2"].values == 0.0)
    assert np.abs(np.diff(log["q1"].values)).max() <= 20.0 + 1e-6


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "--kind optimal needs to know"),
        (["--plant", "plant.json"], "the plant has no covariance"),
        (["--plant", "plant.json", "--network", "tclab"], "exclude each other"),
        (["--network", "tclab", "--hold", "pump"], "cannot hold pump"),
        (["--network", "tclab", "--lowest", "40"], "no schedule keeps the plant"),
        (["--network", "nothing"], "no network 'nothing'"),
    ],
)
def test_what_cannot_be_optimal_is_one_line(bench, words, says):
    done = bench.run(*OPTIMAL, *words)
    assert done.code == 2
    assert len(done.said) == 1
    assert says in done.said[0]
    assert not (bench.path / "s.csv").exists()


def test_ctrl_c_leaves_no_file(bench, monkeypatch):
    def interrupted(*_args: object) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(optimal, "_exchanged", interrupted)
    before = sorted(path.name for path in bench.path.iterdir())
    assert bench.run(*OPTIMAL, "--network", "tclab").code == 130
    assert sorted(path.name for path in bench.path.iterdir()) == before
