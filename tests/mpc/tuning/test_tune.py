"""Tuning: which controller is saved, what the finding says, how it searches, and what an interrupt leaves."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller, load_controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.design_review import review
from thermogrip.mpc.tuning.objective import COSTS, Case, Load, Score, StepResult, meets_spec
from thermogrip.mpc.tuning.tune import (
    Row,
    Trial,
    Tuning,
    best_of,
    kept_of,
    may_be_saved,
    minimise,
    rows_of,
    tune,
    verdict_of,
)
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

QUICK = Spec(
    steps=[(28, 36)], hold_s=200.0, evaluations=4, sample_time_s=4.0, settle_within_s=200.0, check_draws=1
)
#: Of a plant whose output is its drive a sample later: a filter that trusts such a model meets loads late.
DULL = Spec(steps=[(30, 40)], ambient_degC=20.0, hold_s=300.0, evaluations=3, settle_within_s=250.0)


def follower() -> Plant:
    model = StateSpaceModel(("q",), ("room",), ("t",), A=[[0.0]], B=[[1.0]], E=[[1.0]], C=[[1.0]], dt=1.0)
    units, valid = {"q": "percent", "room": "degC", "t": "degC"}, {"q": (0.0, 100.0), "t": (0.0, 90.0)}
    return Plant(model, {}, dt=1.0, units=units, valid=valid, noise={"t": 0.05})


@pytest.fixture(scope="module")
def tuning(tank) -> Tuning:
    return tune(tank, QUICK)


@pytest.fixture(scope="module")
def by_pi() -> Tuning:
    return tune(follower(), DULL)


def test_no_settling_time_is_below_what_full_drive_needs(tuning):
    steps = [row for row in tuning.rows if not row.load]
    assert any(row.settle_mean_s >= row.bound_s for row in steps)
    assert not any(row.settle_mean_s < row.bound_s for row in steps)  # NaN where it did not settle


def test_each_controller_is_compared_on_steps_and_on_loads_of_each_drive_and_output(tuning):
    assert [(row.controller, row.load) for row in tuning.rows] == [
        (name, load)
        for name in ("baseline", "tuned", "PI")
        for load in ("", "drive by -0.2", "t_surface by -0.8")
    ]
    assert tuning.scores.keys() == {"baseline", "tuned", "PI"}
    loads = [result for result in tuning.history[0].results if result.case.load]
    of_first = [result.iae for result in loads if result.case == loads[0].case]
    assert len(set(of_first)) == COSTS.noises  # as the steps, each in several noises
    assert list(tuning.runs) == [
        f"{title}, {kind}"
        for title in ("28 to 36", "drive by -0.2", "t_surface by -0.8")
        for kind in ("MPC", "PI")
    ]


def test_the_mpc_is_saved_where_it_is_best_with_the_tuned_pi_behind_it(tuning, tmp_path):
    loaded = load_controller(tuning.save(tmp_path / "controller.json"))
    assert isinstance(loaded, Controller)
    assert loaded.notes["verdict"] == tuning.verdict
    assert loaded.notes["spec"]["steps"] == [[28.0, 36.0]]
    assert loaded.design == tuning.controller.design
    assert min(tuning.scores, key=lambda name: tuning.scores[name]) != "PI"
    assert tuning.scores["tuned"] < tuning.scores["baseline"] < tuning.scores["PI"]  # the search moves it
    assert "MPC is best and is what is saved: it scores" in tuning.finding


def test_the_pi_is_saved_where_it_is_best_and_the_first_sentence_names_it(by_pi, tmp_path):
    assert min(by_pi.scores, key=lambda name: by_pi.scores[name]) == "PI"
    assert isinstance(by_pi.controller, PIController)
    first = by_pi.finding.split(". ")[0]
    assert first.startswith("The PI is best and is what is saved: it scores ")
    mpc = min(by_pi.scores["baseline"], by_pi.scores["tuned"])
    assert f"scores {100 * (1 - by_pi.scores['PI'] / mpc):.0f} % better than the best MPC" in first
    assert "which loses most on loads (" in first
    loaded = load_controller(by_pi.save(tmp_path / "controller.json"))
    assert isinstance(loaded, PIController)
    assert (loaded.loops, loaded.dt) == (by_pi.controller.loops, by_pi.controller.dt)
    assert loaded.notes["finding"] == by_pi.finding
    with pytest.raises(UserError, match=r"holds a PI, not an MPC; thermogrip\.mpc\.load_controller"):
        Controller.load(tmp_path / "controller.json")


def test_a_pi_is_not_saved_where_the_spec_asks_for_what_it_does_not_know():
    asked = DULL.model_copy(update={"limits": {"t": (0.0, 60.0)}})
    found = tune(follower(), asked)
    assert isinstance(found.controller, Controller)
    assert "MPC is what is saved: a PI does not know limits of outputs." in found.finding


@pytest.mark.slow
def test_the_same_seed_finds_the_same_controller(tank, tuning):
    again = tune(tank, QUICK)
    assert again.controller.design == tuning.controller.design
    assert again.scores == tuning.scores


def test_a_controller_meets_its_spec_where_its_review_finds_no_fault(tuning, by_pi, tmp_path):
    for found in (tuning, by_pi):
        checks = review(load_controller(found.save(tmp_path / "c.json")))
        assert found.meets_spec == ("fail" not in {check.verdict for check in checks})


def test_a_room_that_neither_spec_nor_logs_have_is_no_fault() -> None:
    plant = follower()
    held = review(PIController(plant, DULL.design(plant)), wanted=(24.0, 40.0), draws=0)[0]
    assert held.verdict == "pass"
    logged = review(
        PIController(replace(plant, valid=plant.valid | {"room": (18.0, 25.0)}), DULL.design(plant)),
        wanted=(24.0, 40.0),
        draws=0,
    )[0]
    assert (logged.verdict, "24 degC in a room of 25 degC" in logged.finding) == ("warn", True)


def test_a_target_out_of_reach_is_refused(tank):
    with pytest.raises(UserError, match="does not reach"):
        tune(tank, QUICK.model_copy(update={"steps": [(28.0, 140.0)], "evaluations": 1}))


@pytest.mark.parametrize(
    ("when", "designs"), [("MPC: design 2", 3), ("PI: design 2", None), ("comparison: tuned", None)]
)
def test_an_interrupt_keeps_the_best_so_far(tank, tuning, tmp_path, when: str, designs: int | None):
    """Ctrl-C at a call boundary: in the search of either kind, and in the comparison."""

    def interrupt(share: float, what: str) -> None:
        if what.startswith(when):
            raise KeyboardInterrupt

    found = tune(tank, QUICK, progress=interrupt)
    assert found.interrupted
    assert designs is None or len(found.history) == designs
    assert found.finding.startswith(f"Interrupted after {len(found.history)} designs; this is the best")
    same = zip(found.history, tuning.history)
    assert [trial.score for trial, _ in same] == [trial.score for trial in tuning.history][
        : len(found.history)
    ]
    assert load_controller(found.save(tmp_path / "c.json")).design == found.controller.design
    assert isinstance(found.controller, Controller)  # the PI is far behind


def test_an_interrupt_before_there_is_an_answer_leaves_none(tank):
    def interrupt(share: float, what: str) -> None:
        if what.startswith("compiling"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(tank, QUICK, progress=interrupt)


def test_progress_starts_at_once_rises_and_names_the_best_so_far(tank):
    seen: list[tuple[float, str]] = []
    tune(tank, QUICK, progress=lambda share, what: seen.append((share, what)))
    assert seen[0] == (0.0, "what the plant can do")
    shares = [share for share, _ in seen]
    assert shares == sorted(shares)
    first = next(what for _, what in seen if what.startswith("PI"))
    assert first.startswith("PI: design 1; best so far: MPC, score")


VALLEY = {"a": 6.0, "b": 0.3, "c": 1.0}


def valley(parameters: Any) -> Trial:
    """A trial whose score is a valley about known factors."""
    cost = sum(float(np.log(parameters[name] / value)) ** 2 for name, value in VALLEY.items())
    return Trial("MPC", dict(parameters), 1.0 + cost)


def test_a_search_goes_down_its_valley_inside_its_limits_and_stops_in_time():
    first = valley(dict.fromkeys(VALLEY, 1.0))
    tried: list[Trial] = []

    def evaluate(parameters: Any) -> Trial:
        tried.append(valley(parameters))
        return tried[-1]

    limits = {"a": (0.1, 5.0), "b": (0.01, 10.0), "c": (0.5, 2.0)}
    minimise(evaluate, first, limits, 100)
    best = min([first, *tried], key=lambda trial: trial.score)
    assert best.parameters["a"] == pytest.approx(5.0, rel=0.1)  # the limit on the way to 6
    assert best.parameters["b"] == pytest.approx(0.3, rel=0.2)
    assert best.parameters["c"] == pytest.approx(1.0, rel=0.2)
    assert all(low <= each.parameters[name] * (1 + 1e-9) and each.parameters[name] <= high * (1 + 1e-9)
               for each in tried for name, (low, high) in limits.items())  # fmt: skip
    for most in (0, 1, 7):
        tried.clear()
        minimise(evaluate, first, limits, most)
        assert len(tried) == most


STEP = Spec(steps=((28.0, 36.0),), settle_within_s=100.0, overshoot_degC=0.5, bias_degC=0.2)


def result(settle: float = 80.0, overshoot: float = 0.1, bias: float = 0.0, draw: int = 1) -> StepResult:
    case = Case(28.0, 36.0, draw)
    return StepResult(case, settle, overshoot, bias, 0.0, 10.0 * draw, 1.0, 0.5, 200.0, iae=9.0)


def rows(bound: float, *results: StepResult) -> list[Row]:
    return rows_of("tuned", results, {(28.0, 36.0, one.case.draw): bound for one in results})


@pytest.mark.parametrize(
    ("kept", "settle", "bound", "verdict", "words"),
    [
        (60.0, 80.0, 50.0, "improved", "Its score is 40 % below the default design's."),
        (85.4, nan, 50.0, "improved", "Its score is 15 % below"),
        (60.0, 80.0, 101.0, "actuator-limited", "28 to 36 takes at least 101 s at this drive, and 100 s are"),
        (60.0, nan, inf, "actuator-limited", "28 to 36 cannot be reached at this drive, and 100 s are asked"),
        (100.0, 80.0, 64.0, "actuator-limited", "Tuning wins 0.0 %: the drive is the limit."),
        (100.0, 1.2, 0.1, "actuator-limited", "the drive is the limit"),  # a bound counts as 1 s at least
        (100.0, 80.0, 63.9, "flat", "Tuning wins 0.0 %, less than the 14 % that count."),
        (86.5, 80.0, 50.0, "flat", "Tuning wins 13.5 %"),
    ],
)  # fmt: skip
def test_the_verdict_and_its_sentence(
    kept: float, settle: float, bound: float, verdict: str, words: str
) -> None:
    given, finding = verdict_of(STEP, kept, 100.0, rows(bound, result(settle)))
    assert given == verdict
    assert words in finding


@pytest.mark.parametrize(
    ("tuned", "pi", "kept"),
    [
        (0.85, 2.0, "tuned"),
        (0.87, 2.0, "baseline"),  # less than the 14 % that count
        (0.98, 0.99, "PI"),  # of the two that may be saved
        (0.85, 0.86, "tuned"),
        (0.85, 0.75, "PI"),
        (1.2, 0.99, "PI"),
    ],
)
def test_the_best_is_kept_and_a_tuned_mpc_where_it_wins_what_counts(tuned, pi, kept) -> None:
    scores = {"baseline": 1.0, "tuned": tuned, "PI": pi}
    assert kept_of(scores, ALL) == kept
    mpc = "tuned" if tuned < 0.86 else "baseline"
    assert kept_of({"baseline": 1.0, "tuned": tuned}, ALL) == mpc
    # what does not settle in every trial takes no place of the default design
    assert kept_of(scores, {"baseline"}) == kept_of(scores, set()) == "baseline"
    assert kept_of(scores, {"baseline", "tuned"}) == mpc


@pytest.mark.parametrize(
    ("settled", "certain", "saved"),
    [("baseline tuned PI", False, "baseline tuned PI"), ("baseline tuned PI", True, "baseline PI"),
     ("tuned", True, "tuned"), ("PI", False, "PI")],
)  # fmt: skip
def test_a_tuned_mpc_is_saved_where_draws_of_the_plant_confirm_it(settled, certain, saved) -> None:
    results = {name: [result(80.0 if name in settled else nan)] for name in ALL}
    assert may_be_saved(results, certain=certain) == set(saved.split())


ALL = {"baseline", "tuned", "PI"}
PARTS = {"baseline": Score(1.4, 1.6), "tuned": Score(1.0, 1.2), "PI": Score(1.1, 1.0)}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {},
            "The PI is best and is what is saved: it scores 5 % better than the best MPC on unseen draws, "
            "which loses most on loads (1.20 for 1.00).",
        ),
        (
            {"PI": Score(2.0, 1.0)},
            "The tuned MPC is best and is what is saved: it scores 27 % better than the best PI on unseen "
            "draws, which loses most on steps (2.00 for 1.00).",
        ),
    ],
)
def test_the_first_sentence_names_the_best_of_all_kinds_and_where_the_other_loses(
    changes: dict[str, Score], said: str
) -> None:
    assert best_of(PARTS | changes, ALL, "on unseen draws") == said


def test_a_pi_that_does_not_settle_is_not_saved_and_the_first_sentence_says_so() -> None:
    said = best_of(PARTS, ALL - {"PI"}, "on unseen draws")
    assert said.startswith("The tuned MPC is what is saved: the PI, which scores less, does not settle")


@pytest.mark.parametrize(
    ("unknown", "why"), [(["zones", "ramps"], "a PI does not know zones, ramps"), ([], "no PI can be made")]
)
def test_without_a_pi_the_first_sentence_says_why(unknown: list[str], why: str) -> None:
    parts = {name: PARTS[name] for name in ("baseline", "tuned")}
    assert best_of(parts, ALL, "on unseen draws", unknown) == f"The tuned MPC is what is saved: {why}."


@pytest.mark.parametrize(
    ("change", "met"),
    [({}, True), ({"settle": 100.0}, True), ({"settle": 100.1}, False), ({"settle": nan}, False),
     ({"overshoot": 0.5}, True), ({"overshoot": 0.51}, False), ({"bias": 0.2}, True), ({"bias": -0.2}, True),
     ({"bias": -0.21}, False), ({"bias": 0.21}, False)],
)  # fmt: skip
def test_a_run_meets_the_spec_up_to_its_numbers(change: dict[str, float], met: bool) -> None:
    assert meets_spec(result(**change), STEP) is met


def test_a_row_is_the_mean_and_the_worst_of_its_draws_and_a_load_has_its_own() -> None:
    results = [result(80.0, 0.1, 0.1), result(90.0, 0.3, -0.3, draw=2)]
    load = replace(result(10.0), case=Case(36.0, 36.0, 1, load=Load("q", 1.0)))
    lacking = replace(result(), case=Case(28.0, 36.0, 1, "a lag"))
    row, loaded = rows(50.0, *results, load, lacking)
    assert (row.controller, row.start, row.target) == ("tuned", 28.0, 36.0)
    assert (row.settle_mean_s, row.settle_worst_s) == (85.0, 90.0)
    assert (row.overshoot_mean, row.overshoot_worst) == (0.2, 0.3)
    assert (row.bias_worst, row.energy_mean_s) == (-0.3, 15.0)
    assert (row.travel_mean, row.full_share, row.bound_s, row.iae_mean) == (1.0, 0.5, 50.0, 9.0)
    assert (loaded.load, loaded.settle_mean_s, np.isnan(loaded.bound_s)) == ("q by 1", 10.0, True)
    never = replace(row, settle_mean_s=nan, bound_s=inf)
    assert never.to_dict() == vars(row) | {"settle_mean_s": None, "bound_s": None}
    with pytest.raises(FrozenInstanceError):
        row.target = 3.0  # type: ignore[misc]
