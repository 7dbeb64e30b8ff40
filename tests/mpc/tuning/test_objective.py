"""What a search evaluates: lengths of trials, the designs that parameters make, results and their score."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import make_tank
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import Segment, Surroundings
from thermogrip.mpc.design.design import PILoop, make_blocks
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.plant import prediction
from thermogrip.mpc.tuning import objective
from thermogrip.mpc.tuning.objective import Search, StepResult, Trial, parameters_of, scaled_loops, score

STEPS = [(28.0, 36.0), (28.0, 20.0)]
SPEC = Spec(steps=STEPS, hold_s=300.0, search_draws=2, check_draws=3, sensor_offset_degC=0.4, band_degC=0.3)


class _Plant(SimpleNamespace):
    """A plant of which draws are kept."""

    __hash__ = object.__hash__


def search_of(
    bounds: Any,
    *,
    uncertain: bool = True,
    spec: Spec = SPEC,
    dt: float = 1.0,
    coldest: float = 27.0,
    settled: Any = (0.0, 0.0),
    **changes: Any,
) -> Search:
    """Return the search of a tank whose shortest times are a function of (start, target, draw), its skin in
    the logs as cold as that; its default design has settled after so long."""
    logs = {"t_surface": (coldest, 40.0)}
    scores = SimpleNamespace(reading_sd={})
    plant = _Plant(uncertain=uncertain, draw=lambda k: k, dt=dt, valid=logs, units={}, scores=scores)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objective, "full_drive_bound", lambda drawn, design, step, spec: bounds(*step, drawn))
        patch.setattr(objective, "apparent_delay", lambda plant, controlled: 8.0)
        patch.setattr(Search, "_settled", lambda self: list(settled))
        patch.setattr(Search, "_moves_of_pi", lambda self: {})
        patch.setattr(objective, "wanted", lambda: False)  # trials in Python
        return Search(plant, spec, spec.design(make_tank(), **changes), 3)  # type: ignore[arg-type]


def test_trials_last_for_what_the_slowest_draw_needs():
    search = search_of(lambda start, target, draw: (70.0 if target > 30 else 20.0) + draw)
    assert (search.draws, search.unseen, search.certain) == ([1, 2], [101, 102, 103], False)
    assert (search.seed, search.check_seed, search.lacking) == (3, 3, [1001, 2001, 3001])
    assert set(search.bounds) == {(*step, draw) for step in STEPS for draw in (1, 2, 101, 102, 103)}
    assert search.bounds[28.0, 20.0, 102] == 122.0
    assert search.lengths == pytest.approx([1.35 * 72 + 40, 120.0])  # two minutes at least
    long = search_of(lambda *at: 250.0)
    assert long.lengths == [300.0, 300.0]
    short = search_of(lambda *at: 1.0, spec=SPEC.model_copy(update={"hold_s": 90.0}))
    assert short.lengths == [90.0, 90.0]
    late = search_of(lambda *at: 60.0, settled=(160.0, np.inf))
    assert late.lengths == [1.25 * 160 + 40, 300.0]  # as long as the default design takes
    sure = search_of(lambda *at: 50.0, uncertain=False)
    assert (sure.draws, sure.unseen, sure.certain, sure.seed, sure.check_seed) == ([0], [0], True, 3, 4)


def test_the_default_design_is_watched_until_it_has_settled_on_the_slowest_draw(monkeypatch):
    search = search_of(lambda *at: 60.0)
    one = StepResult(*STEPS[0], 1, 50.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 300.0)
    found = [one, replace(one, draw=2, settle_s=70.0)]
    found += [replace(each, start=STEPS[1][0], target=STEPS[1][1], settle_s=np.nan) for each in found]
    monkeypatch.setattr(objective, "run_trials", lambda *given, **named: found)
    monkeypatch.setattr(search, "made", lambda name, design: None)
    assert search._settled() == [70.0, np.inf]


@pytest.mark.parametrize("settling", [1, 2])  # results of a step and draw
def test_what_is_shared_out_comes_back_in_the_order_of_one_process(
    monkeypatch: pytest.MonkeyPatch, settling: int
):
    search, given = search_of(lambda *at: 60.0), []

    def run(controller: Any, plant: Any, spec: Spec, draws: Any, *, seed: int, lengths: Any) -> list[Any]:
        return [(step, draw, k, seed) for step in spec.steps for draw in draws for k in range(settling)]

    def parallel(function: Any, items: Any, workers: Any, *, elsewhere: bool) -> list[Any]:
        given.append((len(items), workers, elsewhere))
        return [function(item) for item in items]

    monkeypatch.setattr(objective, "run_trials", run)
    monkeypatch.setattr(objective, "run_parallel", parallel)
    monkeypatch.setattr(search, "made", lambda name, design: name)
    runs = [(search.draws, 3, True), (search.draws, 5, True), (search.lacking, 3, True)]
    alone = search._results("MPC", {"move": 2.0}, runs, whole=True)
    search.workers = 2
    assert search._results("MPC", {"move": 2.0}, runs, whole=True) == alone
    assert [(step, draw) for step, draw, k, seed in alone if seed == 5 and k == 0] == [
        (step, draw) for step in STEPS for draw in (1, 2)
    ]
    [(parts, workers, elsewhere)] = given
    assert (parts > 1, workers, elsewhere) == (True, 2, True)


def test_a_search_is_unpacked_once_and_brings_where_its_draws_are_at_rest(tank, monkeypatch):
    spec = SPEC.model_copy(update={"hold_s": 200.0, "search_draws": 1, "check_draws": 1})
    search = Search(tank, spec, spec.design(tank), 0)
    for draw in search.draws:
        model = prediction.prediction_model(objective.drawn(tank, draw), tank.dt)
        search._starts[draw] = model.held_starts
        assert model.held_starts
    sent = [pickle.dumps(search) for _ in range(2)]
    there, again = (pickle.loads(each) for each in sent)  # noqa: S301  as a pool does
    assert there is again
    assert there is not search
    assert there.workers == 1
    monkeypatch.setattr(prediction, "_held_start", None)  # nothing is left to be found
    part = objective._Part("MPC", None, False, [(search.draws, 0, True)])
    assert there._run(part) == search._run(part)


@pytest.mark.parametrize(
    ("changes", "early"),
    [({}, 1), ({"moves_limit": 0.0}, 0), ({"settling": {"t_surface": {"within_s": 150.0}}}, 0)],
)
def test_what_several_workers_begin_with_is_what_one_finds(tank, monkeypatch, changes: Any, early: int):
    asked = {"hold_s": 200.0, "search_draws": 1, "check_draws": 1, **changes}
    spec = Spec.model_validate({**SPEC.model_dump(exclude_unset=True), **asked})
    monkeypatch.setattr(objective, "wanted", lambda: False)  # trials in Python
    alone = Search(tank, spec, spec.design(tank), 0)
    known: list[int] = []
    moves = Search._moves_of_pi

    def moves_of_pi(self: Search) -> Any:
        known.append(len(self._by_pi))
        return moves(self)

    monkeypatch.setattr(
        objective, "run_parallel", lambda of, items, workers, **_: [of(item) for item in items]
    )
    monkeypatch.setattr(Search, "_moves_of_pi", moves_of_pi)
    shared = Search(tank, spec, spec.design(tank), 0, workers=2)
    assert known == [early]  # draws of which bounds brought them: not where bounds may pace the design
    for name in ("bounds", "pi_moves", "travel", "baseline", "lengths", "pi"):
        assert getattr(shared, name) == getattr(alone, name)
    assert bool(alone.pi_moves) == (spec.moves_limit > 0)


def test_several_pis_go_to_a_process_at_once(monkeypatch: pytest.MonkeyPatch):
    search, given = search_of(lambda *at: 60.0), []

    def parallel(function: Any, items: Any, workers: Any, progress: Any, **named: Any) -> list[Any]:
        given.append([len(item) for item in items])
        return [function(item) for item in items]

    monkeypatch.setattr(objective, "run_parallel", parallel)
    monkeypatch.setattr(search, "evaluate", lambda parameters, name: (name, parameters["Kc"]))
    several = [{"Kc": float(k)} for k in range(10)]
    for compiled, sizes in ((True, [4, 4, 2]), (False, [1] * 10)):  # in Python one takes seconds
        search._compiled = compiled
        assert search.evaluate_each("PI", several, what="") == [("PI", float(k)) for k in range(10)]
        assert given.pop() == sizes


def test_a_spec_of_which_one_step_can_be_reached_is_searched_and_one_of_which_none_can_is_refused():
    search_of(lambda start, target, draw: np.inf if target < 30 else 50.0)
    with pytest.raises(UserError, match="full drive does not reach 36 degC, nor any other target"):
        search_of(lambda *at: np.inf)


def test_each_controller_is_tried_for_its_own_length(monkeypatch: pytest.MonkeyPatch):
    search = search_of(lambda *at: 60.0)
    seen: list[Any] = []

    def run(
        controller: Any, plant: Any, spec: Spec, draws: Any, *, seed: int, lengths: Any = None
    ) -> list[StepResult]:
        seen.append((controller, draws, lengths, seed))
        assert list(spec.steps) == STEPS
        if draws == search.lacking:
            return [StepResult(28.0, 36.0, 2001, 90.0, 0.3, 0.0, 0.0, 99.0, 0.0, 0.5, 100.0)]
        return [
            StepResult(28.0, 36.0, 1, 80.0, 0.1, 0.0, 0.0, 20.0, 1.0, 0.5, 100.0),
            StepResult(28.0, 20.0, 2, 100.0, 0.2, 0.0, 0.0, 40.0, 1.0, 0.5, 100.0),
        ]

    monkeypatch.setattr(objective, "run_trials", run)
    monkeypatch.setattr(search, "made", lambda name, design: (name, design.move))
    scale = search.baseline.loops[0].Kc
    monkeypatch.setattr(search, "_pi", lambda loops: ("PI", loops[0].Kc / scale))
    pi = {"Kc": 2.0, "Ti": 1.0, "setpoint": 1.0, "feedforward": 0.5}
    tried = [search.evaluate({"move": 7.0}), search.evaluate(pi, "PI"), search.evaluate({"move": 4.0}, "LQR")]
    search.evaluate_at_length(("PI", pi))
    search.evaluate_in_other_noise(({"move": 9.0}, 2))
    own = [(("MPC", 7.0), search.lengths, 3), (("PI", 2.0), None, 3), (("LQR", 4.0), search.lengths, 3)]
    own += [(("PI", 2.0), None, 3), (("MPC", 9.0), None, 6)]  # 4 is what a sure plant is compared with
    wanted = []
    for of, length, seed in own:
        wanted.append((of, [1, 2], length, seed))
        # what lacks structure settles last: for as long as a step is held
        wanted += [(of, [1001, 2001, 3001], None, seed)] if of[0] != "LQR" else []
    assert seen == wanted
    # the mean, and half of what the worst is above it; a move; what lacks structure
    cost = (80 + 100) / 120 + 0.5 * (100 - 90) / 60 + 0.01 + 0.05 * (90 / 60 + 10 * 0.03)
    assert tried[0] == Trial("MPC", {"move": 7.0}, pytest.approx(cost), 90.0, 0.2, 30.0, 1.0)
    assert [trial.controller for trial in tried] == ["MPC", "PI", "LQR"]
    # in C an MPC is tried at full length in three noises, and in three others
    seen.clear()
    search._compiled = True
    search.evaluate({"move": 7.0})
    search.evaluate_in_other_noise(({"move": 7.0}, 1))
    assert {length for _, _, length, _ in seen} == {None}
    assert [seed for _, draws, _, seed in seen if draws == [1, 2]] == [3, 5, 6, 7, 8, 9]
    assert [seed for _, draws, _, seed in seen if draws != [1, 2]] == [3, 7]


def test_what_a_spec_doubts_more_than_the_default_is_tried_and_counts_as_any_draw(monkeypatch):
    assert objective.expected(SPEC) == set()
    doubts = {"extra_lag": 0.0, "extra_delay": 0.6, "lost_gain": 0.15}
    late = SPEC.model_copy(update=doubts)
    assert objective.expected(late) == {1}  # the first of the two that are tried
    assert objective.expected(SPEC.model_copy(update={"lost_gain": 0.2})) == {3}
    assert objective.expected(SPEC.model_copy(update={"lost_gain": 0.1})) == set()

    search = search_of(lambda *at: 60.0, spec=late)
    monkeypatch.setattr(search, "made", lambda name, design: name)
    search._compiled, seen = True, []

    def run(controller: Any, plant: Any, spec: Spec, draws: Any, *, seed: int, lengths: Any = None) -> Any:
        seen.append((controller, tuple(draws), seed))
        return [
            StepResult(28.0, 36.0, at, 60.0, 0.1 + at / 2e4, 0.0, 0.0, 0.0, 0.0, 0.5, 300.0) for at in draws
        ]

    monkeypatch.setattr(objective, "run_trials", run)
    tried = search.evaluate({"move": 7.0})
    own = [(draws, seed) for seed in (3, 5, 6) for draws in ((1, 2), (1001,))]  # in each of three noises
    assert seen == [("MPC", *item) for item in [*own, ((2001,), 3)]]
    # a ramp may help; the overshoot with a weaker drive does not count
    assert tried.overshoot == pytest.approx(0.15005)
    seen.clear()
    search.evaluate({"move": 7.0}, "LQR")
    assert seen == [("LQR", (1, 2), 3), ("LQR", (1001,), 3)]

    results = run("MPC", None, late, [1, 1001, 2001], seed=3)
    results[1] = replace(results[1], settle_s=240.0)
    results[2] = replace(results[2], settle_s=120.0)
    bounds = {(28.0, 36.0, 1): 60.0}
    assert score(results, late, bounds) == pytest.approx(2.5 + 0.5 * 1.5 + 0.05 * 2.0)
    assert score(results, SPEC, bounds) == pytest.approx(1.0 + 0.05 * (4.0 + 2.0) / 2)
    assert objective.counting(results, late) == results[:2]


FAR = SPEC.model_copy(update={"ambient_degC": 20.0})  # 16 degC below the first target, steps are of 8


@pytest.mark.parametrize(
    ("spec", "logs", "unit", "steps"),
    [
        (FAR, (20.2, 40.0), "degC", [(20.0, 36.0)]),  # in the band of the coldest
        (FAR, (20.4, 40.0), "degC", []),
        (FAR, (10.0, 19.0), "degC", []),
        (FAR, (20.0, 40.0), "percent", []),  # a room's temperature says nothing about a level
        (SPEC.model_copy(update={"ambient_degC": 28.0}), (20.0, 40.0), "degC", []),  # no further than a step
    ],
)
def test_a_pi_is_also_tried_from_a_cold_start_where_logs_show_one_and_it_is_further_than_any_step(
    spec, logs, unit, steps
):
    plant: Any = _Plant(valid={"t": logs}, units={"t": unit})
    assert objective.cold_steps(plant, spec, ("t",)) == steps


def test_the_trial_from_a_cold_start_is_of_the_pi_alone(monkeypatch: pytest.MonkeyPatch):
    search = search_of(lambda *at: 60.0, spec=FAR, coldest=20.0)
    assert {key for key in search.bounds if key[0] == 20.0} == {(20.0, 36.0, 1), (20.0, 36.0, 2)}
    seen: list[Any] = []

    def run(controller: Any, plant: Any, spec: Spec, draws: Any, *, seed: int, lengths: Any = None) -> Any:
        if draws == search.lacking:
            return []
        seen.append((list(spec.steps), lengths))
        return [StepResult(*spec.steps[-1], 1, 80.0, 0.1, 0.0, 0.0, 20.0, 1.0, 0.5, 100.0)]

    monkeypatch.setattr(objective, "run_trials", run)
    monkeypatch.setattr(search, "made", lambda name, design: name)
    monkeypatch.setattr(search, "_pi", lambda loops: "PI")
    for name in ("MPC", "PI", "LQR"):
        search.evaluate({"Kc": 1.0, "Ti": 1.0, "setpoint": 1.0, "feedforward": 0.5}, name)
    cold = ([*STEPS, (20.0, 36.0)], None)
    assert seen == [(STEPS, search.lengths), cold, (STEPS, search.lengths)]
    search._compiled = True  # and of an MPC in C, whose trials take no time
    search.evaluate({"move": 3.0})
    assert seen[3:] == [cold] * 3


def test_a_trial_has_a_sensor_that_is_off_and_a_seed_of_its_draw(monkeypatch: pytest.MonkeyPatch):
    seen: list[Any] = []

    def loop(controller: Any, plant: Any, schedule: Any, **given: Any) -> Any:
        seen.append((plant, schedule, given))
        end, rest = schedule[0][0], {"sd": 0.0, "energy_s": 7.0, "travel": 2.0, "full_share": 0.6}
        parts = [
            Segment("a", 28.0, end, 5.0, 105.0, 30.0, 0.2, 0.03, **rest),
            Segment("b", 28.0, end, 5.0, 105.0, 40.0, 0.1, -0.05, **rest),
        ]
        y = {"a": np.array([28.0, end + 0.5]), "b": np.array([28.0, end - 0.7])}
        return SimpleNamespace(segments=parts, outputs=y)

    monkeypatch.setattr(objective, "simulate_closed_loop", loop)
    monkeypatch.setattr(objective, "apparent_delay", lambda plant, controlled: 8.0)
    scores = SimpleNamespace(reading_sd={"b": 0.07, "c": np.inf})
    plant: Any = _Plant(
        disturbances=("room",), draw=lambda k: {"draw": k}, scores=scores, valid={}, is_room=lambda name: True
    )
    controller: Any = SimpleNamespace(controlled=("a", "b"))
    found = objective.run_trials(controller, plant, SPEC, [1, 2], lengths=[50.0, 60.0], seed=4)
    offset = {"a": 0.4, "b": 0.4, "room": pytest.approx(0.6)}
    noises = {"b": 0.07}  # what the logs showed, their quantum included; of the others the usual
    around = Surroundings(25.0, 0.04, noises, quanta={"b": 0.0}, offset=offset, held=("a", "b"))
    assert seen == [
        ({"draw": draw}, [(target, length)],
         {"start": 28.0, "surroundings": around, "band": 0.3, "seed": 4000 + draw})
        for target, length in ((36.0, 50.0), (20.0, 60.0)) for draw in (1, 2)
    ]  # fmt: skip
    last = pytest.approx(-0.7)  # of b: each figure is of the output where it is worst
    assert found[1] == StepResult(28.0, 36.0, 2, 40.0, 0.2, -0.05, last, 7.0, 2.0, 0.6, 100.0)
    objective.run_trials(controller, plant, SPEC, [1])
    assert [given[1][0][1] for given in seen[4:]] == [300.0, 300.0]
    assert seen[4][2]["seed"] == 1
    # draws that lack structure: the third without what is not tried
    found = objective.run_trials(controller, plant, SPEC, [1002, 2002, 3002])
    assert [result.draw for result in found[:3]] == [1002, 2002, 3002]
    assert [(of, given["seed"]) for of, _, given in seen[6:9]] == [({"draw": 2}, 2)] * 3
    changed = [{"sensor_lag_s": 4.0}, {"move_delay_s": 4.0}, {"drive_share": 0.85}]
    assert [given["surroundings"] for _, _, given in seen[6:9]] == [replace(around, **it) for it in changed]
    assert [words for words, _ in objective.lacking(plant, SPEC, ("a",))] == [
        "sensors slower by 4 s", "delay longer by 4 s", "drive weaker by 15 %",
    ]  # fmt: skip
    stated = Spec(steps=STEPS, noise_degC=0.1)
    objective.run_trials(controller, plant, stated, [1])
    around = seen[-1][2]["surroundings"]
    assert (around.noise, around.noises, around.quanta) == (0.1, {}, {"b": 0.0})
    fewer = SPEC.model_copy(update={"extra_lag": 0.0, "lost_gain": 0.0})
    assert len(objective.lacking(plant, fewer, ("a",))) == 1


WALKS = ("drive_walk", "output_walk", "state_walk")


def test_parameters_make_a_design_and_are_read_off_it():
    search = search_of(lambda *at: 60.0)
    base, spec = search.baseline, search.spec
    assert search.design({}) == base
    made = {"move": 3.0, "terminal": 4.0, "overshoot_share": 0.4, "drive_walk": 0.5, "output_walk": 6.0}
    made |= {"state_walk": 0.7, "horizon": 31.0, "blocks": 6.0}
    design = search.design(made | {"drive": 0.7, "drive_share": 0.5})
    # noise is read off as it is: walks are factors of a design's own
    assert parameters_of(design, spec) == pytest.approx(made | dict.fromkeys(WALKS, 1.0))
    assert design.noise.state == pytest.approx(0.7 * base.noise.state)
    assert design.noise.output == pytest.approx(6.0 * base.noise.output)
    assert design.noise.drive == {"drive": pytest.approx(0.5 * base.noise.drive["drive"])}
    assert (design.drive, design.overshoot, design.blocks) == (0.7, pytest.approx(0.12), make_blocks(31, 6))
    assert design.drive_range == {"drive": (-0.5, 0.5)}
    own_noise = {name: getattr(base.noise, name) for name in ("state", "drive", "output")}
    assert replace(design.noise, **own_noise) == base.noise
    least = search.design({"horizon": 3.0, "blocks": 1.0})
    assert least.blocks == make_blocks(10, 2)
    own = sum(base.blocks), len(base.blocks)
    assert search.design({"horizon": own[0] + 0.4, "blocks": own[1] - 0.4}).blocks is base.blocks
    assert search.design({"horizon": own[0]}).blocks is base.blocks
    assert len(search.design({"blocks": own[1] - 1.0}).blocks) == own[1] - 1
    assert sum(search.design({"horizon": own[0] - 1.0}).blocks) == own[0] - 1


@pytest.mark.parametrize(
    ("ends", "capped"),
    [((-1.0, 3.0), (-0.25, 0.75)), ((2.0, 6.0), (2.0, 3.0)), ((-6.0, -2.0), (-3.0, -2.0))],
)
def test_a_share_of_a_drive_is_about_none(ends, capped):
    assert objective._capped({"q": ends}, 0.25) == {"q": pytest.approx(capped)}


def test_a_pi_goes_beyond_its_rules_gain_only_where_the_delay_was_seen():
    seen, unseen = search_of(lambda *at: 60.0), search_of(lambda *at: 60.0, dt=8.0)
    assert [{name: most for name, _, most in of.pi}["Kc"] for of in (seen, unseen)] == [5.0, 1.0]
    assert [name for name, *_ in search_of(lambda *at: 60.0, uncertain=False).pi] == ["Kc", "Ti", "setpoint"]


def test_a_pis_numbers_are_scaled_and_its_feedforward_is_given():
    loop = PILoop("q", "t", 2.0, 30.0, 0.9)
    given = {"setpoint": 0.4, "feedforward": 0.7}
    (made,) = scaled_loops((loop,), {"Kc": 3.0, "Ti": 0.5, **given})
    assert made == PILoop("q", "t", 6.0, 15.0, 0.7, 0.4)
    # a step of the load leaves at most half more than with the loop's own Ti / Kc
    (slow,) = scaled_loops((loop,), {"Kc": 0.5, "Ti": 8.0, **given})
    assert slow.Ti / slow.Kc == pytest.approx(1.5 * loop.Ti / loop.Kc)


def test_a_score_is_the_mean_and_half_of_what_the_worst_is_above_it():
    one = StepResult(28.0, 36.0, 1, 150.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 300.0)
    two = replace(one, draw=2, settle_s=40.0)
    bounds = {(28.0, 36.0, 1): 50.0, (28.0, 36.0, 2): 40.0, (28.0, 36.0, 3): np.inf, (28.0, 36.0, 4): 0.2}
    assert score([one, two], SPEC, bounds) == pytest.approx(2.0 + 0.5 * (3.0 - 2.0))
    # in units of its whole length where nothing reaches it, and of a second at least
    assert score([replace(one, draw=3)], SPEC, bounds) == pytest.approx(0.5)
    assert score([replace(one, draw=4)], SPEC, bounds) == pytest.approx(150.0)
    never = replace(one, settle_s=np.nan, last_error=-1.5, bias=5.0)  # its bias is not charged besides
    assert score([never], SPEC, bounds) == pytest.approx(300 / 50 + 0.5 * 1.5 / 0.3)
    # without structure a run counts a twentieth, beyond 5 by its logarithm
    slow = [replace(one, draw=1001, settle_s=200.0), replace(never, draw=2001)]
    assert score([one, two, *slow], SPEC, bounds) == pytest.approx(
        2.5 + 0.05 * (4.0 + 5 + 5 * np.log(8.5 / 5)) / 2
    )
    slow[1] = replace(slow[1], last_error=80.0)
    assert score([one, two, *slow], SPEC, bounds) == pytest.approx(
        2.5 + 0.05 * (4.0 + 5 + 5 * np.log((6 + 40 / 0.3) / 5)) / 2
    )


def test_moves_beyond_the_limit_are_charged_as_overshoot_is():
    """The limit is in moves of the PI by SIMC on the same draw, where that settles; without any, none."""
    one = StepResult(28.0, 36.0, 1, 150.0, 0.0, 0.0, 0.0, 0.0, 3.0, 0.5, 300.0)
    simc = [replace(one, travel=1.25), replace(one, draw=2, travel=0.1, settle_s=np.nan)]
    bounds, pi = {(28.0, 36.0, draw): 50.0 for draw in (1, 2)}, objective.moves_of(simc)
    spec = SPEC.model_copy(update={"moves_weight": 0.0})
    assert pi == {(28.0, 36.0, 1): 1.25}
    found = [score([result], spec, bounds, pi) for result in (one, replace(one, draw=2))]
    assert found == pytest.approx([3 + 3 * (3.0 / (1.5 * 1.25) - 0.9), 3.0])
    assert score([replace(one, travel=1.6)], spec, bounds, pi) == pytest.approx(3.0)
    free = spec.model_copy(update={"moves_limit": 0.0})
    assert score([one], free, bounds, pi) == pytest.approx(3.0)
    assert objective.moves_of([replace(one, travel=0.0)]) == {}
    assert search_of(lambda *at: 60.0, spec=free)._moves_of_pi() == {}


def test_a_price_of_travel_is_in_shares_of_what_an_allowed_bias_is_worth():
    search = search_of(lambda *at: 60.0)
    vars(search)["travel"] = 40.0
    assert [search.design(p).travel for p in ({}, {"still": 0.25})] == [0.0, 10.0]


def test_a_step_in_several_noises_counts_by_their_mean():
    one = StepResult(28.0, 36.0, 1, 150.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 300.0)
    others = [replace(one, draw=2, settle_s=settle) for settle in (40.0, 60.0)]
    bounds = {(28.0, 36.0, draw): 50.0 for draw in (1, 2)}
    assert score([one, *others], SPEC, bounds) == pytest.approx(2.0 + 0.5 * (3.0 - 2.0))


def test_a_score_does_not_depend_on_the_unit_of_the_outputs():
    results = [
        StepResult(28.0, 36.0, 1, 150.0, 0.5, 0.02, 0.1, 3.0, 2.0, 0.5, 300.0),
        StepResult(28.0, 36.0, 2, np.nan, 0.2, 0.5, 0.7, 3.0, 2.0, 0.5, 300.0),
        StepResult(28.0, 36.0, 3, 90.0, 0.1, -0.09, 0.0, 3.0, 2.0, 0.5, 300.0),
    ]
    sizes = ("start", "target", "overshoot", "bias", "last_error")
    milli = [replace(r, **{name: 1000 * getattr(r, name) for name in sizes}) for r in results]
    small = SPEC.model_copy(update={"band_degC": 300.0, "overshoot_degC": 300.0, "bias_degC": 50.0})
    bounds = {(28.0, 36.0, draw): 50.0 for draw in (1, 2, 3)}
    big = {(1000 * start, 1000 * end, draw): bound for (start, end, draw), bound in bounds.items()}
    for pair in zip(results, milli, strict=True):
        assert score([pair[0]], SPEC, bounds) == pytest.approx(score([pair[1]], small, big), rel=1e-12)
    # three times what is allowed beyond nine tenths of it, and half of it for the bias
    assert score(results[:1], SPEC, bounds) == pytest.approx(3 + 0.02 + 3 * (0.5 / 0.3 - 0.9))
    assert score(results[2:], SPEC, bounds) == pytest.approx(1.8 + 0.02 + 0.5 * (0.09 / 0.05 - 0.9))


def test_a_ramp_lasts_so_many_times_the_minimum_time_of_the_slower_step():
    search = search_of(lambda start, target, draw: (60.0 if target > 30 else 20.0) + draw)
    (rate,) = search.design({"ramp": 1.5}).ramp_per_s.values()
    assert rate == pytest.approx((8 - 0.3) / (1.5 * 61.5))  # of two draws the mean
    assert search.design({}).ramp_per_s == {}
    assert search.at_once == ["t_surface"]
    own = search_of(lambda *at: 60.0, spec=SPEC.model_copy(update={"ramp_per_s": 0.01}))
    assert (own.at_once, own.design({"ramp": 1.5}).ramp_per_s) == ([], {"t_surface": 0.01})
    one = search_of(lambda start, target, draw: np.inf if target > 30 else 20.0)
    assert one.design({"ramp": 1.0}).ramp_per_s == {"t_surface": pytest.approx(7.7 / 20)}


def test_a_note_has_none_for_what_is_no_number():
    record = objective.Record()
    vars(record).update(a=1.5, b=np.nan, c=np.inf, d="nan", e=3)
    assert record.to_dict() == {"a": 1.5, "b": None, "c": None, "d": "nan", "e": 3}
    assert all(kind.__dataclass_params__.frozen for kind in (StepResult, Trial))
