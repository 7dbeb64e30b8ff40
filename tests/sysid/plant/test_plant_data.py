"""Scores keep the keys of ``plant.json`` and refuse what is none of theirs."""

from __future__ import annotations

import json

import pytest
from pydantic import TypeAdapter

from thermogrip.datasets.schema import hash_columns, make_log
from thermogrip.sysid.plant.plant_data import TAIL, FitLog, Intervals, PlantScores, fit_logs, said_of_fit

# as version 0.1.0 wrote them for a network and for a black box, shortened
NETWORK = {
    "identifiability": {
        "condition": 3.5e16, "flat": ["loss up, power up"],
        "told": False, "prior_only": ["room"], "on_bound": {"room": "low"},
    },
    "average_s": 10.0, "reading_excess": {"t": 0.048},
    "weight_s": {"t": 24.923176530267202},
    "intervals": {
        "numbers": {"white": [0.13], "tau": [2.97, 10.8], "sd": [[0.05], [0.06]], "correlation": [0.0, 0.0],
                    "spread": [0.9]},
        "between_logs": 6.598, "coarsening": 3.2,
    },
    "held_out": [{"log": "last 30 % of step", "output": "t", "rmse": 0.08, "fit_percent": 98.0,
                  "unit": "degC", "n": 240}],
}  # fmt: skip
BLACK_BOX = {
    "structure": "na 1, nb 1, delay 1", "average_s": 0.5, "average_why": "the logs' own",
    "reading_excess": {"t": 0.0}, "held_out_by_part": {"t": [0.6, 1.1]},
}  # fmt: skip


scores_of = TypeAdapter(PlantScores).validate_python


@pytest.mark.parametrize("content", [NETWORK, BLACK_BOX, {}], ids=["network", "black box", "nothing"])
def test_scores_of_an_older_file_come_back_key_by_key(content):
    again = scores_of(content).to_json()
    assert json.dumps(again) == json.dumps(content).replace("told", "identifiable")
    assert scores_of(again).to_json() == again


def test_what_a_later_version_adds_is_left_out_and_what_an_earlier_one_lacked_has_its_default():
    short = {"intervals": {"hessian": [[1.0]], "pull": [], "error": "slow"}, "cost": 16.127, "mood": "good"}
    intervals = scores_of(short).intervals
    assert (intervals.numbers, intervals.between_logs, intervals.coarsening) == (None, 1.0, 1.0)


def test_rows_of_a_log_are_in_the_fit_where_it_is_the_same_log_at_the_same_time():
    log = make_log([0.0, 1.0, 2.0, 3.0], {"q": ([0, 1, 0, 1], "percent", "input")}, name="a")
    same = hash_columns({"time": log["time"].values, "x": log["q"].values})
    (seen,) = fit_logs([log])
    others = [FitLog("a", "0" * 64, 0.0, 3.0), FitLog("a", same, 3.0, 5.0), FitLog("a", same, -1.0, 0.0)]
    assert said_of_fit(others, seen) == []
    (whole,) = said_of_fit([FitLog("a", same, -1.0, 3.0)], seen)
    assert whole.startswith("all of it is in the fit: the scores")
    (part,) = said_of_fit([FitLog("b", same, 1.0, 9.0)], seen)
    assert part.startswith("1 to 3 s of 0 to 3 s are in the fit (as b): there the scores")
    both = said_of_fit([FitLog("a", same, 0.0, 1.0), *others, FitLog("a", same, 2.0, 9.0)], seen)
    assert [line.split(" in the fit: there the scores say")[0] for line in both] == [
        "0 to 1 s of 0 to 3 s are", "2 to 3 s of 0 to 3 s are"
    ]  # fmt: skip
    assert fit_logs([log, log]) == (FitLog("a", same, 0.0, 3.0),) * 2
    assert fit_logs([log.assign_attrs(sha256="of the file")])[0].sha256 == "of the file"
    assert whole.endswith("the scores say how well the plant is fitted, not how well it predicts")
    assert TAIL == "last 30 % of "


def test_what_a_fit_does_not_know_is_left_out_of_its_scores():
    assert PlantScores().to_json() == {}
    bare = Intervals()
    assert (bare.numbers, bare.between_logs, bare.coarsening) == (None, 1.0, 1.0)
