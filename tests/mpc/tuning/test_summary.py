"""The verdict on a tuning and the sentences that give its numbers."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from math import inf, nan

import pytest

from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.objective import StepResult
from thermogrip.mpc.tuning.summary import Row, _simpler, meets_spec, rows_of, verdict_of

SPEC = Spec(steps=((28.0, 36.0),), settle_within_s=100.0, overshoot_degC=0.5, bias_degC=0.2)
BETTER, SAME = {"baseline": 100.0, "tuned": 60.0}, {"baseline": 100.0, "tuned": 100.0}


def result(settle: float = 80.0, overshoot: float = 0.1, bias: float = 0.0, draw: int = 1) -> StepResult:
    return StepResult(28.0, 36.0, draw, settle, overshoot, bias, 0.0, 10.0 * draw, 1.0, 0.5, 200.0)


def rows(bound: float, *results: StepResult) -> list[Row]:
    return rows_of("tuned", results, SPEC, {(28.0, 36.0, one.draw): bound for one in results})


@pytest.mark.parametrize(
    ("scores", "settle", "bound", "verdict", "words"),
    [
        (BETTER, 80.0, 50.0, "improved", "Score 40 % below the default design on unseen draws. 28 to 36"),
        (BETTER, 80.0, 50.0, "improved", "cannot settle under 50 s at this drive, yours takes 80 s."),
        (BETTER, nan, 50.0, "improved", "under 50 s at this drive, yours does not settle on every draw."),
        (BETTER, 80.0, 100.0, "improved", "under 100 s at this drive"),
        (BETTER, 80.0, 101.0, "actuator-limited", "under 101 s at this drive, and 100 s are asked;"),
        (BETTER, nan, 101.0, "actuator-limited", "100 s are asked; yours does not settle; no weight"),
        (BETTER, nan, inf, "actuator-limited", "28 to 36 degC cannot be reached at this drive; no weight"),
        (SAME, 80.0, 64.0, "actuator-limited", "Weights win 0.0 %: the drive is the limit. 28 to 36"),
        (SAME, 1.9, 1.5, "flat", "the 3 % that count. 28 to 36"),
        (SAME, 1.2, 0.1, "actuator-limited", "the drive is the limit"),  # a bound counts as 1 s at least
        (SAME, 80.0, 63.9, "flat", "Weights win 0.0 %, less than the 3 % that count. 28 to 36"),
        ({"baseline": 100.0, "tuned": 97.5}, 80.0, 50.0, "flat", "Weights win 2.5 %"),
        ({"baseline": 100.0, "tuned": 96.5}, 80.0, 50.0, "improved", "Score 4 % below"),
        ({"baseline": 100.0, "tuned": 110.0}, 80.0, 50.0, "flat", "Weights win 0.0 %"),
        (BETTER | {"PI": 60.0, "LQR": 90.0}, 80.0, 50.0, "improved", "PI, tuned with as many trials, scores"),
        (BETTER | {"PI": 60.42}, 80.0, 50.0, "improved", "scores 0.7 % worse on this spec."),
        (BETTER | {"PI": 61.2}, 80.0, 50.0, "improved", "scores 2.0 % worse on this spec."),
        (BETTER | {"PI": 61.2, "LQR": 54.0}, 80.0, 50.0, "improved", "trials, scores 10.0 % better"),
        (BETTER | {"LQR": 54.0}, 80.0, 50.0, "improved", "on this spec, and knows neither limits of outputs"),
    ],
)  # fmt: skip
def test_the_verdict_and_its_sentence(
    scores: dict[str, float], settle: float, bound: float, verdict: str, words: str
) -> None:
    given, finding = verdict_of(SPEC, scores, rows(bound, result(settle)))
    assert given == verdict
    assert words in finding


def test_a_simpler_controller_that_is_plainly_worse_is_not_named() -> None:
    _, finding = verdict_of(SPEC, BETTER | {"PI": 61.9, "LQR": 62.0}, rows(50.0, result()))
    assert finding.endswith("yours takes 80 s.")


@pytest.mark.parametrize(
    ("change", "met"),
    [({}, True), ({"settle": 100.0}, True), ({"settle": 100.1}, False), ({"settle": nan}, False),
     ({"overshoot": 0.5}, True), ({"overshoot": 0.51}, False), ({"bias": 0.2}, True), ({"bias": -0.2}, True),
     ({"bias": -0.21}, False), ({"bias": 0.21}, False)],
)  # fmt: skip
def test_a_run_meets_the_spec_up_to_its_numbers(change: dict[str, float], met: bool) -> None:
    assert meets_spec(result(**change), SPEC) is met


def test_a_row_is_the_mean_and_the_worst_of_its_draws() -> None:
    (row,) = rows(50.0, result(80.0, 0.1, 0.1), result(90.0, 0.3, -0.3, draw=2))
    assert (row.controller, row.start, row.target) == ("tuned", 28.0, 36.0)
    assert (row.settle_mean_s, row.settle_worst_s) == (85.0, 90.0)
    assert (row.overshoot_mean, row.overshoot_worst) == (0.2, 0.3)
    assert (row.bias_mean, row.bias_worst) == (0.2, -0.3)
    assert (row.energy_mean_s, row.energy_worst_s) == (15.0, 20.0)
    assert (row.travel_mean, row.full_share, row.bound_s) == (1.0, 0.5, 50.0)
    never = replace(row, settle_mean_s=nan, bound_s=inf)
    assert never.to_dict() == vars(row) | {"settle_mean_s": None, "bound_s": None}
    with pytest.raises(FrozenInstanceError):
        row.target = 3.0


@pytest.mark.parametrize(
    ("scores", "name", "how"),
    [
        ({"tuned": 1.0, "baseline": 1.2, "PI": 1.04, "LQR": 2.0}, "", ""),
        ({"tuned": 1.0, "baseline": 0.9}, "", ""),
        ({"tuned": 100.0, "baseline": 120.0, "PI": 103.0}, "", ""),
        ({"tuned": 1.2, "baseline": 1.0, "PI": 1.02}, "PI", "2.0 % worse"),
        ({"tuned": 1.0, "baseline": 1.2, "PI": 0.9, "LQR": 0.95}, "PI", "10.0 % better"),
        ({"tuned": 1.0, "baseline": 1.2, "PI": 1.5, "LQR": 1.004}, "LQR", "as well"),
    ],
)
def test_a_simpler_controller_that_is_as_good_is_named_with_what_it_does_not_know(scores, name, how):
    missing = ", and knows neither limits of outputs nor where a gain turns over" if name == "LQR" else ""
    said = f"{name}, tuned with as many trials, scores {how} on this spec{missing}."
    assert _simpler(scores) == (said if name else "")
