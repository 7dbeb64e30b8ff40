"""Tuning: what it finds, and how it goes about it on a search whose trials are formulas."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import FrozenInstanceError, dataclass, field, replace
from functools import partial
from math import inf, nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import Design, PILoop, default_design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning import objective
from thermogrip.mpc.tuning import tune as tuner
from thermogrip.mpc.tuning.figures import closed_loop_figure
from thermogrip.mpc.tuning.objective import (
    LQR_PARAMETERS,
    MPC_PARAMETERS,
    PI_OF_UNSEEN_DELAY,
    PI_PARAMETERS,
    Search,
    StepResult,
    Trial,
    bounds_of,
    meets_spec,
    parameters_of,
    scaled_loops,
    score,
    surroundings_of,
)
from thermogrip.mpc.tuning.tune import Row, Tuning, _simpler, rows_of, tune, verdict_of
from thermogrip.sysid.plant.fit_record import PlantScores

QUICK = Spec(steps=[(28, 36)], hold_s=200.0, evaluations=3, sample_time_s=4.0, settle_within_s=200.0)


@pytest.fixture(scope="module")
def tuning(tank):
    return tune(tank, QUICK)


def test_in_the_trials_the_sensor_of_a_room_of_any_name_is_off():
    units = {"t_room": "degC", "t_ambient_block": "degC"}
    plant: Any = SimpleNamespace(
        disturbances=("t_room",), valid={}, scores=PlantScores(), is_room=lambda name: units[name] == "degC"
    )
    offset = surroundings_of(QUICK, ("t_ambient_block",), plant).offset
    assert offset["t_room"] == 1.5 * offset["t_ambient_block"] != 0
    assert len(offset) == 2


def test_no_settling_time_is_below_what_full_drive_needs(tuning):
    assert any(row.settle_mean_s >= row.bound_s for row in tuning.rows)
    for row in tuning.rows:
        assert not row.settle_mean_s < row.bound_s  # NaN where it did not settle


def test_the_file_says_what_was_found_and_can_be_used(tuning, tmp_path):
    loaded = Controller.load(tuning.save(tmp_path / "controller.json"))
    assert loaded.notes["verdict"] == tuning.verdict
    assert loaded.notes["spec"]["steps"] == [[28.0, 36.0]]
    assert loaded.design == tuning.controller.design


def test_the_same_seed_finds_the_same_controller(tank, tuning):
    again = tune(tank, QUICK)
    assert again.controller.design == tuning.controller.design
    assert again.scores == tuning.scores


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two processors")
def test_two_processes_find_the_same_to_the_last_bit(tank, tuning):
    both = tune(tank, QUICK, workers=2)
    for part in ("history", "rows", "scores", "pareto", "sensitivity", "finding"):
        assert repr(getattr(both, part)) == repr(getattr(tuning, part)), part  # NaN and every digit too
    assert both.controller.design == tuning.controller.design
    for title, run in tuning.runs.items():
        assert run.drive.keys() == both.runs[title].drive.keys()
        assert all(np.array_equal(run.drive[name], both.runs[title].drive[name]) for name in run.drive)


def test_a_target_out_of_reach_is_refused(tank):
    with pytest.raises(UserError, match="does not reach"):
        tune(tank, QUICK.model_copy(update={"steps": [(28.0, 140.0)], "evaluations": 1}))


def test_the_score_charges_overshoot_bias_and_not_settling():
    good = StepResult(28, 38, 1, 100.0, 0.1, 0.01, 0.0, 100.0, 2.0, 0.9, 600.0)
    bounds = {(28, 38, 1): 100.0}
    spec = Spec(energy_weight=0.5, moves_weight=0.25)
    assert score([good], spec, bounds) == pytest.approx(1 + 0.5 + 0.5)
    assert score([replace(good, overshoot=0.37)], spec, bounds) == pytest.approx(2.0 + 1.0)
    assert score([replace(good, bias=-0.145)], spec, bounds) == pytest.approx(2.0 + 1.0)
    never = replace(good, settle_s=float("nan"), last_error=2.0)
    assert score([never], spec, bounds) == pytest.approx(6 + 4 + 0.5 + 0.5)


def test_the_runs_can_be_drawn(tuning):
    for title, run in tuning.runs.items():
        figure = closed_loop_figure(run, title, limits={"t_tank": (2, 65)}, slew_per_s={"drive": 0.25})
        assert len(figure.axes) == 4


SPEC = Spec(
    steps=[(28, 36), (28, 20)], hold_s=260.0, evaluations=17, sample_time_s=4.0, settle_within_s=250.0
)
STEPS = [(28.0, 36.0), (28.0, 20.0)]
UNSEEN = [101, 102, 103]
BEST = {"move": 6.0, "terminal": 3.0, "horizon": 57.0}  # the baseline's: 1, 10, 38
BEST_PI = {"Kc": 2.5, "Ti": 0.5}
BEST_LQR = {"move": 0.3, "drive": 0.3}


def valley(parameters: dict[str, float], best: dict[str, float], lowest: float) -> float:
    return lowest + sum(float(np.log(parameters[name] / value)) ** 2 for name, value in best.items())


@dataclass
class Paper:
    """What a :class:`Search` does, without a plant: scores are valleys about known parameters."""

    plant: Any
    spec: Spec
    baseline: Design
    seed: int
    draws: tuple[int, ...] = (1, 2)
    unseen: tuple[int, ...] = tuple(UNSEEN)
    lacking: tuple[int, ...] = (1001, 2001, 3001)
    certain: bool = False
    pi: tuple[tuple[str, float, float], ...] = PI_PARAMETERS
    capped: float = 1.0  # score at full length of 75 % of the drive, over that of all of it
    pi_at_length: float = 5.0
    creeps: float = 0.0  # up to this gain a PI does not settle
    ramped: float = 1.0  # score of a ramp of 1.3, over that of none
    overshoots: float = 0.1
    evaluate_check: Callable[[str, int], StepResult] | None = None
    checked: list[tuple[str, Design, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.check_seed = self.seed + 7
        self.bounds = {(*step, draw): 100.0 for step in STEPS for draw in (*self.draws, *self.unseen)}
        self.at_once, self.pi_moves, self.travel = ["t_surface"], {}, 10.0
        self._ramps = partial(Search._ramps, self)  # type: ignore[arg-type]

    def design(self, parameters: dict[str, float]) -> Design:
        return Search.design(self, parameters)  # type: ignore[arg-type]

    def at_length(self, trial: Trial) -> bool:
        return False

    def evaluate(self, parameters: dict[str, float], name: str = "MPC", *, noises: int = 3) -> Trial:
        best, lowest = {"MPC": (BEST, 1.0), "PI": (BEST_PI, 1.5), "LQR": (BEST_LQR, 1.2)}[name]
        ramp = {1.3: self.ramped}.get(parameters.get("ramp", 0.0), 1.0)
        return self.trial(name, parameters, ramp * valley(parameters, best, lowest))

    def evaluate_each(self, name: str, several: Any, progress: Any = None, *, what: str) -> list[Trial]:
        found = []
        for parameters in several:
            found.append(self.evaluate(parameters, name))
            if progress is not None:
                progress(len(found) / len(several), what)
        return found

    def evaluate_at_length(self, item: tuple[str, dict[str, float]]) -> Trial:
        name, parameters = item
        if name != "MPC":
            return self.trial(name, parameters, self.pi_at_length)
        caps = {0.75: self.capped, 1.0: 1.0}
        return self.trial(
            name,
            parameters,
            caps.get(parameters.get("drive_share", 1.0), 1.5)
            * {1.3: self.ramped, 1.7: 1.5}.get(parameters.get("ramp", 0.0), 1.0)
            * valley(parameters, BEST, 1.0),
        )

    def evaluate_in_other_noise(self, item: tuple[dict[str, float], int]) -> Trial:
        return self.evaluate_at_length(("MPC", item[0]))

    def trial(self, name: str, parameters: dict[str, float], value: float) -> Trial:
        if parameters.get("Kc", np.inf) <= self.creeps:
            return Trial(name, dict(parameters), value + 5.0, np.nan, 0.1, 50.0)
        return Trial(name, dict(parameters), value, 100.0 * value, self.overshoots, 50.0)

    def check(self, item: tuple[str, Design, int]) -> list[StepResult]:
        name, _, draw = item
        self.checked.append(item)
        made = self.evaluate_check or (lambda name, draw: step_result(name, draw))
        return [replace(made(name, draw), start=a, target=b) for a, b in STEPS]

    def made(self, name: str, design: Design) -> Any:
        return SimpleNamespace(name=name, design=design)


SETTLES = {"baseline": 180.0, "tuned": 140.0, "PI": 220.0, "LQR": 160.0}


def step_result(name: str, draw: int, **changes: Any) -> StepResult:
    usual = StepResult(28.0, 36.0, draw, SETTLES[name], 0.1, 0.01, 0.0, 50.0, 2.0, 0.9, 260.0)
    return replace(usual, **changes)


@dataclass
class Done:
    tuning: Tuning
    search: Paper
    ran: list[dict[str, Any]]
    shares: list[float]

    def tried(self, name: str) -> list[Trial]:
        return [trial for trial in self.tuning.history if trial.controller == name]

    def best(self, name: str) -> Trial:
        return min(self.tried(name), key=lambda trial: trial.score)

    def pi(self) -> Trial:
        """The one that bears most of those that score within 5 % of the best."""
        tried, least = self.tried("PI"), self.best("PI").score
        near = [trial for trial in tried if trial.score <= 1.05 * least]
        return min(near, key=lambda trial: trial.parameters["Kc"] / trial.parameters["Ti"])


def tuned(tank: Any, spec: Spec = SPEC, **changes: Any) -> Done:
    made: list[Paper] = []
    ran: list[dict[str, Any]] = []
    shares: list[float] = []

    def search(*items: Any, workers: int) -> Paper:
        made.append(Paper(*items, **changes))
        return made[-1]

    def run(controller: Any, **given: Any) -> Any:
        ran.append({"controller": controller, **given})
        return SimpleNamespace(of=controller)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuner, "Search", search)
        patch.setattr(tuner, "trial", run)
        patch.setattr(tuner, "worst_sensitivity", lambda plant, loops, dt: loops[0].Kc / loops[0].Ti)
        found = tune(tank, spec, seed=4, progress=lambda share, what: shares.append(share))
    return Done(found, made[0], ran, shares)


@pytest.fixture(scope="module")
def done(tank: Any) -> Done:
    return tuned(tank)


def test_moves_filters_and_horizons_are_looked_at_and_the_best_is_searched_from(done: Done):
    start = parameters_of(done.search.baseline, SPEC)
    first, rest = done.tried("MPC")[:13], done.tried("MPC")[13:]
    assert first[0].parameters == start
    assert [trial.parameters["move"] for trial in first] == [1.0, 10.0, 100.0, 1000.0, *[10.0] * 9]  # best: 6
    shares = [trial.parameters.get("still") for trial in first]
    assert shares == [*[None] * 4, 0.03, 0.1, 0.3, *[None] * 6]  # the price of travel does nothing here
    walks = [trial.parameters["state_walk"] for trial in first[6:11]]
    assert walks == pytest.approx([1.0, 0.3, 0.1, 1.0, 1.0])  # it does nothing here
    walk = start["output_walk"]
    trusts = [trial.parameters["output_walk"] for trial in first[8:]]
    assert trusts == pytest.approx([walk, 3 * walk, 10 * walk, walk, walk])
    assert [trial.parameters["horizon"] for trial in first[10:]] == [38.0, 27.0, 57.0]
    assert {trial.parameters["horizon"] for trial in rest} == {57.0}
    assert rest[0].parameters == pytest.approx(
        first[12].parameters
    )  # the search begins where the look was best
    assert not any("ramp" in trial.parameters for trial in done.tried("MPC"))  # nothing overshoots


def test_where_the_best_look_overshoots_targets_that_ramp_are_looked_at_and_searched_from(tank: Any):
    done = tuned(tank, ramped=0.5, overshoots=0.28)
    first, rest = done.tried("MPC")[13:15], done.tried("MPC")[15:]
    assert [trial.parameters["ramp"] for trial in first] == [1.3, 1.7]
    assert {trial.parameters["ramp"] for trial in rest} == {1.3}
    design = done.tuning.controller.design
    assert design.ramp_per_s == {"t_surface": pytest.approx((8 - 0.25) / 130)}
    assert "Targets ramp, which spares overshoot: t_surface by 0.06 degC/s." in done.tuning.finding
    assert "ramp" in {found.knob for found in done.tuning.sensitivity}
    assert not any("ramp" in t.parameters for t in tuned(tank, ramped=1.5, overshoots=0.28).tried("MPC")[15:])


def test_every_controller_has_as_many_trials_and_keeps_to_its_ranges(done: Done):
    for name, parameters in {"MPC": MPC_PARAMETERS, "PI": PI_PARAMETERS, "LQR": LQR_PARAMETERS}.items():
        tried = done.tried(name)
        sturdier = 11 if name == "PI" else 0  # beside the best: 3 gains, 4 integral times
        assert len(tried) == (3 if name == "PI" else 1) * SPEC.evaluations + sturdier
        for parameter, low, high in parameters:
            values = np.array([trial.parameters[parameter] for trial in tried])
            assert np.all((values >= low) & (values <= high)), parameter


@pytest.mark.parametrize(("name", "most"), [("MPC", 0.3), ("PI", 0.1), ("LQR", 0.1)])
def test_the_search_goes_down_its_valley(tank: Any, name: str, most: float):
    long = tuned(tank, SPEC.model_copy(update={"evaluations": 60}))
    lowest = {"MPC": 1.0, "PI": 1.5, "LQR": 1.2}[name]
    first = long.tried(name)[0].score - lowest
    assert long.best(name).score - lowest < most * first
    for parameter, _, _ in {"MPC": MPC_PARAMETERS, "PI": PI_PARAMETERS, "LQR": LQR_PARAMETERS}[name]:
        assert len({trial.parameters[parameter] for trial in long.tried(name)}) > 5, (
            parameter
        )  # none is left out


def test_the_pi_starts_from_its_rule_and_the_regulator_from_the_baseline(done: Done):
    rule = {"Kc": 1.0, "Ti": 1.0, "setpoint": 1.0, "feedforward": 0.99}
    assert [trial.parameters for trial in done.tried("PI")[:2]] == [rule, rule | {"feedforward": 0.05}]
    start = parameters_of(done.search.baseline, SPEC)
    assert done.tried("LQR")[0].parameters == {**start, "drive": 1e-2}


def test_what_is_compared_is_the_best_of_each_on_draws_that_the_search_has_not_seen(done: Done):
    base, designs = done.search.baseline, {name: design for name, design, _ in done.search.checked}
    for name in ("baseline", "tuned", "PI", "LQR"):
        assert [draw for of, _, draw in done.search.checked if of == name] == [*UNSEEN, 1101, 2101, 3101]
    assert designs["baseline"] == base
    assert designs["tuned"] == done.search.design(done.best("MPC").parameters)
    loops = scaled_loops(base.loops, done.pi().parameters)
    assert designs["PI"] == replace(designs["tuned"], loops=loops)
    assert designs["LQR"] == done.search.design(done.best("LQR").parameters)
    assert "on unseen draws" in done.tuning.finding
    assert done.tuning.verdict == "improved"


def test_the_kept_design_falls_back_to_the_tuned_pi(done: Done):
    loops = scaled_loops(done.search.baseline.loops, done.pi().parameters)
    assert done.tuning.controller.design == replace(
        done.search.design(done.best("MPC").parameters), loops=loops
    )
    assert loops != done.search.baseline.loops


def test_where_the_search_won_nothing_the_default_is_kept_and_is_what_is_reported(tank: Any):
    def evaluate(name: str, draw: int) -> StepResult:
        settle = {"baseline": 140.0, "tuned": 141.0}.get(name, 200.0)
        return step_result(name, draw, settle_s=settle, bias=0.2 if name == "tuned" else 0.01)

    done = tuned(tank, evaluate_check=evaluate)
    base, loops = done.search.baseline, scaled_loops(done.search.baseline.loops, done.pi().parameters)
    assert done.tuning.controller.design == replace(base, loops=loops)
    assert done.tuning.verdict == "flat"
    assert "yours takes 140 s" in done.tuning.finding
    assert done.tuning.meets_spec  # of the default; the tuned one is off target
    start = parameters_of(base, SPEC)
    for found in done.tuning.sensitivity:
        assert found.value == start[found.knob]
        assert found.settle_s == pytest.approx(100 * valley(start, BEST, 1.0))


def test_of_the_tuned_design_each_parameter_is_reported(done: Done):
    best = done.best("MPC")
    values = {found.knob: found.value for found in done.tuning.sensitivity}
    assert values == pytest.approx({parameter: best.parameters[parameter] for parameter in values})
    assert set(values) == {*(name for name, _, _ in MPC_PARAMETERS), "horizon", "blocks"}
    # of score = 1 + ln^2(k / best) + ...: the central difference over a factor 1.3 either way
    (move,) = [found for found in done.tuning.sensitivity if found.knob == "move"]
    slope = 2 * np.log(best.parameters["move"] / BEST["move"]) / best.score
    assert move.elasticity == pytest.approx(slope, abs=1e-9)


def test_one_run_off_target_is_a_spec_that_is_not_met(tank: Any):
    def evaluate(name: str, draw: int) -> StepResult:
        late = {("tuned", 102): 251.0}.get((name, draw), 140.0)
        return step_result(name, draw, settle_s=245.0 if name == "baseline" else late)

    done = tuned(tank, evaluate_check=evaluate)
    assert (
        done.tuning.controller.design.move == done.best("MPC").parameters["move"]
    )  # it is kept all the same
    assert not done.tuning.meets_spec
    assert done.tuning.controller.notes["meets_spec"] is False
    assert tuned(tank).tuning.meets_spec


@pytest.mark.parametrize(("capped", "taken"), [(0.97, True), (0.995, False), (1.02, False)])
def test_less_drive_is_taken_where_the_specs_own_score_gains_by_more_than_a_hundredth(
    tank: Any, capped: float, taken: bool
):
    done = tuned(tank, capped=capped)
    best = done.best("MPC")
    share = 0.75 if taken else 1.0
    assert done.tuning.controller.design.drive_range == {"drive": (-share, share)}
    assert done.tuning.controller.design.move == best.parameters["move"]
    first = done.tuning.pareto
    assert first.trials[0].parameters == best.parameters
    named = [name for name in first.names if name.startswith("tuned") or name == "found by the search"]
    assert named == (["found by the search", "tuned: 75 % of the drive"] if taken else ["tuned"])
    # what is reported of it is at the search's length, not at that of the trade-offs
    assert done.tuning.sensitivity[0].settle_s == pytest.approx(100 * best.score)


@pytest.mark.parametrize(
    ("others", "still", "taken"),
    [
        ((1.008, 1.008, 1.008), 0.1, 10.0),
        ((1.012, 1.012, 1.012), 0.1, 1.0),
        ((1.02, 1.09, 0.98), 0.1, 10.0),  # a mean of 3 %, its standard error is 3.2 %
        ((1.02, 1.04, 1.03), 0.1, 1.0),  # 0.6 %
        ((1.05, 1.3, 0.9), 0.1, 1.0),  # 8 and 12 %: too much to be a tie, however noisy
        ((1.008, 1.008, 1.008), 0.96, 1.0),  # it hardly moves less
    ],
)
def test_of_designs_that_trials_cannot_tell_apart_the_one_that_moves_least_is_taken(
    others: tuple[float, float, float], still: float, taken: float
):
    """With as much of the drive as the best."""
    scores = {0.1: 1.0, 0.3: 1.0, 1.0: 1.0, 3.0: 1.3, 10.0: others[0], 30.0: 1.4, 100.0: 1.5}
    travels = {0.1: 10.0, 0.3: 5.0, 1.0: 1.0, 3.0: 1.0, 10.0: still, 30.0: 0.1, 100.0: 0.1}

    def at_length(item: tuple[str, dict[str, float]], noise: int = 0) -> Trial:
        name, parameters = item
        move = parameters["move"]
        travel = 0.01 if "drive_share" in parameters or name != "MPC" else travels[move]
        value = others[noise] if move == 10.0 else scores[move]
        return Trial(name, parameters, value, 100.0, 0.1, 50.0, travel)

    search: Any = SimpleNamespace(
        at_once=[],
        plant=SimpleNamespace(dt=0.0),
        spec=SPEC,
        baseline=SimpleNamespace(controlled=("t",)),
        at_length=lambda trial: False,
        evaluate_at_length=at_length,
        evaluate=lambda parameters: at_length(("MPC", parameters)),
        evaluate_in_other_noise=lambda item: at_length(("MPC", item[0]), item[1]),
    )
    found = {name: [at_length((name, {"move": 1.0}))] for name in ("MPC", "PI", "LQR")}
    _, best = tuner._trade(search, found, found["PI"][0], 1, None)
    assert best.parameters == {"move": taken}


def test_trials_of_the_search_that_were_at_full_length_are_not_run_again():
    def trial(name: str, move: float) -> Trial:
        return Trial(name, {"move": move}, 2.0 if move > 1 else 1.0, 100.0, 0.1, 50.0, 1 / move)

    asked: list[tuple[str, float]] = []

    def at_length(item: tuple[str, dict[str, float]]) -> Trial:
        asked.append((item[0], item[1]["move"]))
        return trial(item[0], item[1]["move"])

    search: Any = SimpleNamespace(
        at_once=[],
        plant=SimpleNamespace(dt=0.0),
        spec=SPEC,
        baseline=SimpleNamespace(controlled=("t",)),
        at_length=lambda tried: tried.controller != "LQR",
        evaluate_at_length=at_length,
        evaluate_in_other_noise=lambda item: trial("MPC", item[0]["move"]),
    )
    found = {name: [trial(name, 1.0), trial(name, 10.0)] for name in ("MPC", "PI", "LQR")}
    pareto, _ = tuner._trade(search, found, found["PI"][0], 1, None)
    again = [move for name, move in asked if name == "MPC" and move in (1.0, 10.0)]
    assert again == [1.0] * 7  # four with less drive, three with a price of travel
    assert [name for name, _ in asked if name != "MPC"] == ["LQR"]
    shown = dict(zip(pareto.names, pareto.trials, strict=True))
    assert shown["moves 10 times as dear"].score == 2.0
    assert shown["PI, tuned"] is found["PI"][0]


@pytest.mark.parametrize(
    ("later", "overshoot", "taken"),
    [(29.0, 0.26, 1), (31.0, 0.1, 0), (29.0, 0.28, 0)],  # of 60 s a reading and 0.3 degC allowed
)
def test_half_a_reading_of_settling_is_no_difference_where_nothing_overshoots(later, overshoot, taken):
    def trials(score: float, settle: float, over: float, travel: float) -> list[Trial]:
        return [Trial("MPC", {"move": travel}, score, settle, over, 50.0, travel)] * 3

    found = [trials(1.0, 1320.0, 0.1, 4.0), trials(1.04, 1320.0 + later, overshoot, 1.5)]
    assert tuner._stillest(found, 60.0, 0.3) == taken
    assert tuner._stillest(found) == 0


def test_a_default_that_scores_alike_and_moves_more_is_not_kept(tank: Any):
    def evaluate(name: str, draw: int) -> StepResult:
        late, travel = {"tuned": (181.0, 1.0)}.get(name, (180.0, 2.0))
        return step_result(name, draw, settle_s=late, travel=travel)

    done = tuned(tank, evaluate_check=evaluate)
    assert done.tuning.controller.design.move == done.best("MPC").parameters["move"]


def test_a_pi_that_is_better_at_length_is_shown_and_not_taken_for_an_mpc(tank: Any):
    done = tuned(tank, pi_at_length=0.5)
    assert done.tuning.controller.design.move == done.best("MPC").parameters["move"]
    shown = dict(zip(done.tuning.pareto.names, done.tuning.pareto.trials, strict=True))
    assert shown["PI, tuned"].parameters == done.pi().parameters
    assert shown["LQR, tuned"].parameters == done.best("LQR").parameters
    assert done.tuning.pareto.best[done.tuning.pareto.names.index("PI, tuned")]


def test_the_runs_for_figures_are_of_the_kept_controller_on_the_first_unseen_draw(done: Done):
    assert list(done.tuning.runs) == [
        f"28 to {end}, {name}" for end in (36, 20) for name in ("MPC", "PI", "LQR")
    ]
    kept = done.tuning.controller
    for title, run in done.tuning.runs.items():
        of = run.of  # type: ignore[attr-defined]
        if title.endswith("MPC"):
            assert (type(of), of.plant, of.design) == (Controller, kept.plant, kept.design)
        elif title.endswith("PI"):
            assert (of.name, of.design) == ("PI", kept.design)
        else:
            assert (of.name, of.design) == ("LQR", done.search.design(done.best("LQR").parameters))
    for at, given in enumerate(done.ran):
        assert (given["draw"], given["seed"], given["length_s"]) == (101, 11, 260.0)
        assert given["step"] == STEPS[at // 3]
        assert given["plant"] is done.search.plant


def test_a_spec_faster_than_full_drive_is_called_actuator_limited(tank: Any):
    found = tuned(tank, SPEC.model_copy(update={"settle_within_s": 90.0})).tuning
    assert found.verdict == "actuator-limited"
    assert "28 to 36 degC cannot settle under 100 s" in found.finding
    assert not found.meets_spec


def test_a_plant_without_uncertainty_is_compared_under_fresh_noise(tank: Any):
    done = tuned(
        tank, draws=(0,), unseen=(0,), lacking=(1000, 2000, 3000), certain=True, pi=PI_PARAMETERS[:-1]
    )
    assert "under fresh noise (the plant has no uncertainty)" in done.tuning.finding
    # its PI does without the drive that the plant has for a target
    assert {trial.parameters["feedforward"] for trial in done.tried("PI")} == {0.05}


@pytest.mark.parametrize(("creeps", "wider"), [(0.5, False), (1.0, True)])
def test_a_pi_of_an_unseen_delay_goes_beyond_its_limits_only_where_it_does_not_settle_inside(
    tank: Any, creeps: float, wider: bool
):
    done = tuned(tank, pi=PI_OF_UNSEEN_DELAY, creeps=creeps)
    assert (done.best("PI").parameters["Kc"] > 1.0) == wider
    assert max(trial.parameters["Kc"] for trial in done.tried("PI")) <= (5.0 if wider else 1.0)


@pytest.mark.parametrize(
    ("rise", "low", "taken"),
    [
        (0.02, 0.2, (0.7, 0.8)),  # 2 % for each step off the best; of three steps it would be 6 %
        (0.03, 0.2, (0.85, 0.5 * 1.25)),  # 5 % are 1.7 steps; of two apart the one of less gain bears as much
        (0.03, 0.9, (1.0, 0.5 * 1.25)),  # no gain below what may be searched
        (0.2, 0.2, (1.0, 0.5)),
    ],
)
def test_of_pis_that_score_alike_the_one_is_taken_that_bears_most(
    monkeypatch: pytest.MonkeyPatch, rise: float, low: float, taken: tuple[float, float]
):
    best = {"Kc": 1.0, "Ti": 0.5, "setpoint": 0.3, "feedforward": 0.1}

    def evaluate(parameters: dict[str, float], name: str) -> Trial:
        assert (name, parameters["setpoint"], parameters["feedforward"]) == ("PI", 0.3, 0.1)
        off = max(
            np.log(1 / parameters["Kc"]) / np.log(1 / 0.85), np.log(parameters["Ti"] / 0.5) / np.log(1.25)
        )
        return Trial("PI", parameters, 2.0 * (1 + rise * float(off)), 50.0, 0.1, 5.0)

    def bears(plant: str, loops: Any, dt: float) -> float:
        assert (plant, dt) == ("plant", 2.0)
        return float(loops[0].Kc / loops[0].Ti)

    monkeypatch.setattr(tuner, "worst_sensitivity", bears)
    base = SimpleNamespace(loops=(PILoop("q", "t", 4.0, 30.0),), dt=2.0)
    ranges = (("Kc", low, 5.0), *PI_PARAMETERS[1:])

    def evaluate_each(name: str, several: Any, *, what: str) -> list[Trial]:
        return [evaluate(parameters, name) for parameters in several]

    search: Any = SimpleNamespace(evaluate_each=evaluate_each, plant="plant", baseline=base, pi=ranges)
    worse = replace(evaluate(best, "PI"), score=5.0, parameters=best | {"Ti": 9.0})
    tried, found = tuner._sturdiest(search, [worse, evaluate(best, "PI")])
    assert (found.parameters["Kc"], found.parameters["Ti"]) == pytest.approx(taken)
    assert {**found.parameters, "Kc": 1.0, "Ti": 0.5} == best
    # none beyond what leaves half more of a load's integrated error than SIMC
    assert all(trial.parameters["Ti"] <= 1.5 * trial.parameters["Kc"] + 1e-12 for trial in tried[1:])


def test_pis_and_regulators_are_searched_for_while_the_mpc_is_looked_about(monkeypatch: pytest.MonkeyPatch):
    sturdy, regulated, spec = threading.Event(), threading.Event(), SimpleNamespace(evaluations=2)
    one = Trial("MPC", {}, 1.0, 50.0, 0.1, 5.0)

    def look(search: Any, workers: int, progress: Any) -> list[Trial]:
        assert sturdy.wait(20)
        assert regulated.wait(20)
        return [one]

    def optimise(item: Any) -> list[Trial]:
        if item[1] == "LQR":
            regulated.set()
        return [replace(one, controller=item[1])]

    def sturdiest(search: Any, tried: list[Trial]) -> tuple[list[Trial], str]:
        sturdy.set()
        return tried, "sturdy"

    monkeypatch.setattr(tuner, "_looked_about", look)
    monkeypatch.setattr(tuner, "_optimise", optimise)
    monkeypatch.setattr(tuner, "_sturdiest", sturdiest)
    monkeypatch.setattr(tuner, "parameters_of", lambda *_: {})
    search: Any = SimpleNamespace(spec=spec, pi=PI_PARAMETERS, certain=False, baseline=None)
    found, pi = tuner._search_all(search, 2, None)
    each = {name: [trial.controller for trial in tried] for name, tried in found.items()}
    assert (pi, each) == ("sturdy", {"MPC": ["MPC", "MPC"], "PI": ["PI"], "LQR": ["LQR"]})


def test_the_file_holds_what_was_found(done: Done):
    found, notes = done.tuning, done.tuning.controller.notes
    assert notes["scores"] == found.scores
    assert notes["seed"] == found.seed == 4
    assert [row["controller"] for row in notes["rows"]] == [
        name for name in ("baseline", "tuned", "PI", "LQR") for _ in STEPS
    ]
    # settling over the bound of 100 s, alike in all runs, so that the worst is the mean
    own = {name: settle / 100 + 0.01 * 2.0 for name, settle in SETTLES.items()}
    assert found.scores == pytest.approx({name: 1.05 * value for name, value in own.items()})
    assert [found["draw"] for found in notes["lacking"]] == [1101, 1101, 2101, 2101, 3101, 3101]
    assert "with sensors slower by " in notes["finding"]
    assert "A step moves the drives by 2.0 times full drive, 2.0 with the default design." in notes["finding"]
    assert done.shares == sorted(done.shares)
    assert done.shares[-1] == 1.0
    # what comes before the first trial counts, and each of the PI's starts is reported: no step is long
    assert done.shares[0] > 0.05
    assert np.diff(done.shares).max() < 0.05


STEP = Spec(steps=((28.0, 36.0),), settle_within_s=100.0, overshoot_degC=0.5, bias_degC=0.2)
BETTER, SAME = {"baseline": 100.0, "tuned": 60.0}, {"baseline": 100.0, "tuned": 100.0}


def result(settle: float = 80.0, overshoot: float = 0.1, bias: float = 0.0, draw: int = 1) -> StepResult:
    return StepResult(28.0, 36.0, draw, settle, overshoot, bias, 0.0, 10.0 * draw, 1.0, 0.5, 200.0)


def rows(bound: float, *results: StepResult) -> list[Row]:
    return rows_of("tuned", results, STEP, {(28.0, 36.0, one.draw): bound for one in results})


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
        (BETTER | {"PI": 60.0, "LQR": 90.0}, 80.0, 50.0, "improved", "PI, tuned with no fewer trials"),
        (BETTER | {"PI": 60.42}, 80.0, 50.0, "improved", "scores 0.7 % worse on this spec."),
        (BETTER | {"PI": 61.2}, 80.0, 50.0, "improved", "scores 2.0 % worse on this spec."),
        (BETTER | {"PI": 61.2, "LQR": 54.0}, 80.0, 50.0, "improved", "trials, scores 10.0 % better"),
        (BETTER | {"LQR": 54.0}, 80.0, 50.0, "improved", "on this spec, and does not know limits of outputs"),
    ],
)  # fmt: skip
def test_the_verdict_and_its_sentence(
    scores: dict[str, float], settle: float, bound: float, verdict: str, words: str
) -> None:
    given, finding = verdict_of(STEP, scores, rows(bound, result(settle)))
    assert given == verdict
    assert words in finding


@pytest.mark.parametrize(
    ("scores", "first"), [({"PI": 54.0}, "PI, "), ({"LQR": 54.0}, "LQR, "), ({}, "Score ")]
)
def test_the_first_sentence_names_the_best_of_all_kinds(scores: dict[str, float], first: str) -> None:
    _, finding = verdict_of(STEP, BETTER | {"PI": 60.5, "LQR": 60.5} | scores, rows(50.0, result()))
    assert finding.startswith(first)
    assert ("The MPC is what is saved" in finding) == bool(scores)


def test_a_simpler_controller_that_is_plainly_worse_is_not_named() -> None:
    _, finding = verdict_of(STEP, BETTER | {"PI": 61.9, "LQR": 62.0}, rows(50.0, result()))
    assert finding.endswith("yours takes 80 s.")


@pytest.mark.parametrize(
    ("change", "met"),
    [({}, True), ({"settle": 100.0}, True), ({"settle": 100.1}, False), ({"settle": nan}, False),
     ({"overshoot": 0.5}, True), ({"overshoot": 0.51}, False), ({"bias": 0.2}, True), ({"bias": -0.2}, True),
     ({"bias": -0.21}, False), ({"bias": 0.21}, False)],
)  # fmt: skip
def test_a_run_meets_the_spec_up_to_its_numbers(change: dict[str, float], met: bool) -> None:
    assert meets_spec(result(**change), STEP) is met


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
    missing = ", and does not know limits of outputs or where a gain turns over" if name == "LQR" else ""
    said = f"{name}, tuned with no fewer trials, scores {how} on this spec{missing}."
    assert _simpler(scores, STEP) == (said if name else "")
    priced = STEP.model_copy(update={"zones": {"t": 1.0}, "energy_price": 0.1})
    joined = ", " if name == "LQR" else " or "
    assert not name or f"does not know zones{joined}energy prices" in _simpler(scores, priced)


def test_a_step_whose_target_ramps_is_bounded_by_its_ramp(tank, monkeypatch) -> None:
    plain = default_design(tank)
    ramped = replace(plain, ramp_per_s={"t_surface": 0.02})
    (free,), (bound,) = (bounds_of(tank, design, STEP, [0]).values() for design in (plain, ramped))
    (start, target), band = STEP.steps[0], STEP.band_degC
    assert bound == pytest.approx((target - start - band) / 0.02)
    assert bound > 2 * free
    monkeypatch.setattr(objective, "wanted", lambda: False)  # in C a trial lasts as long as a step is held
    search = Search(tank, STEP.model_copy(update={"hold_s": 900.0}), ramped, 0)
    assert search.lengths[0] == pytest.approx(1.35 * bound + 40)  # a trial sees it settle
