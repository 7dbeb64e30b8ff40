"""What a controller is tried on: steps, loads, plants that lack structure, and what each costs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import crossed, make_tank
from thermogrip.mpc.closed_loop.simulate import Surroundings
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.native.runtime import compiler
from thermogrip.mpc.plant.prediction import prediction_model
from thermogrip.mpc.tuning import objective
from thermogrip.mpc.tuning.objective import (
    Case,
    Load,
    Scales,
    StepResult,
    as_tried,
    lacking,
    loads_of,
    result_of,
    run_trials,
    score,
    signal_of,
    steps_on,
    surroundings_of,
    trial,
)
from thermogrip.sysid.plant.plant_data import PlantScores

STEPS = [(28.0, 36.0), (28.0, 20.0)]
SPEC = Spec(steps=STEPS, hold_s=300.0, search_draws=2, check_draws=3, sensor_offset_degC=0.4, band_degC=0.3)
CASE = Case(28.0, 36.0, 1)
ONE = StepResult(CASE, 150.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 300.0)
BOUNDS: Any = {(28.0, 36.0, draw): bound for draw, bound in ((1, 50.0), (2, 40.0), (3, np.inf), (4, 0.2))}
DOUBTED = SPEC.model_copy(update={"extra_lag": 0.5, "extra_delay": 0.6, "lost_gain": 0.15})
FREE_OF_MOVES = SPEC.model_copy(update={"moves_weight": 0.0})


def total(results: list[StepResult], spec: Spec = SPEC, bounds: Any = BOUNDS, **scales: Any) -> float:
    return score(results, spec, Scales(bounds, **{"moves": {}, "iae": {}} | scales)).total


def test_loads_are_a_tenth_of_each_drive_where_it_has_room_and_a_tenth_of_the_first_step(tank):
    design = SPEC.design(tank)
    on_drive, on_output = loads_of(tank, SPEC, design)
    assert (on_drive.on, on_drive.size, on_drive.lag_s) == ("drive", pytest.approx(-0.2), 0.0)
    assert (on_output.on, on_output.size) == ("t_surface", pytest.approx(-0.8))
    assert on_output.lag_s == objective.apparent_delays(tank, ("t_surface",))[0] > 8.0  # its tube's
    cold = SPEC.model_copy(update={"steps": [(28.0, 20.0)]})
    assert [load.size for load in loads_of(tank, cold, design)] == pytest.approx([0.2, 0.8])
    assert on_drive.words == "drive by -0.2"


def test_a_load_on_a_drive_of_a_linear_plant_is_that_drive_moved():
    """Adding the load's signal to the outputs gives what the plant does under so much more of the drive."""
    plant, load = crossed(), Load("q2", 10.0)
    added = signal_of(load, plant, ("a", "b"), 30.0, 25.0, 60)
    assert added[0].tolist() == [0.0, 0.0]
    assert added[-1] == pytest.approx([0.2 * 10.0, 0.0], abs=0.02)  # at rest a = room + 0.2 q2
    lagged = signal_of(Load("b", -2.0, 20.0), plant, ("a", "b"), 30.0, 25.0, 60)
    model = prediction_model(plant, plant.dt)
    assert lagged[:, 1] == pytest.approx(-2.0 * (1 - np.exp(-model.dt * np.arange(60) / 20.0)))
    assert not lagged[:, 0].any()


def test_a_load_comes_after_as_long_at_rest_and_is_met(tank):
    spec = Spec(steps=[(28.0, 36.0)], hold_s=300.0)
    design = as_tried(spec.design(tank), tank)
    case = Case(36.0, 36.0, 0, load=Load("t_surface", -1.0, 10.0))
    run = trial(Controller(tank, design), tank, spec, case)
    result, error = result_of(run, case), np.abs(run.outputs["t_surface"] - 36.0)
    assert run.time[-1] == pytest.approx(600.0)
    assert 0.3 < result.overshoot < 1.0  # the largest error: less than the load, which comes gradually
    assert np.max(error[run.time < 300.0]) < 0.2  # noise alone
    assert np.isfinite(result.settle_s)
    assert abs(result.bias) < 0.05
    assert result.iae == pytest.approx(np.mean(error[run.time >= 300.0]) * 300.0)


def test_a_filter_that_learns_thirty_times_slower_meets_a_load_worse(tank):
    """A trial that began with the load showed it to a filter that has just started, which learns anything."""
    spec, iae = Spec(steps=[(28.0, 36.0)], hold_s=600.0), []
    for slower in (1, 30):
        noise = spec.design(tank).noise
        drive, load = ({name: sd / slower for name, sd in of.items()} for of in (noise.drive, noise.load))
        design = spec.design(tank, noise=replace(noise, drive=drive, load=load))
        made = Controller(tank, as_tried(design, tank))
        (result,) = run_trials(made, tank, spec, [Case(36.0, 36.0, 0, load=Load("drive", -0.2))])
        iae.append(result.iae)
    assert iae[1] > 3 * iae[0]  # .82 times without the rest before


@pytest.mark.skipif(compiler() is None, reason="no gcc here")
def test_c_meets_a_load_as_python_does(tank, monkeypatch):
    design = as_tried(SPEC.design(tank), tank)
    case = Case(36.0, 36.0, 0, load=Load("drive", -0.2), seconds=200.0)
    controller, loops = Controller(tank, design), PIController(tank, design)
    loops.c = controller.c
    monkeypatch.setenv("THERMOGRIP_COMPILED", "0")
    for compiled, plain in ((controller, Controller(tank, design)), (loops, PIController(tank, design))):
        in_c, in_python = (trial(made, tank, SPEC, case) for made in (compiled, plain))
        np.testing.assert_allclose(in_c.drive["drive"], in_python.drive["drive"], atol=1e-8)
        for part in ("outputs", "readings"):
            values = (getattr(run, part)["t_surface"] for run in (in_c, in_python))
            np.testing.assert_allclose(*values, atol=1e-8)


def test_what_a_plant_may_lack_is_tried_in_shares_of_its_apparent_delay_where_it_is_stated(tank):
    (delay,) = objective.apparent_delays(tank, ("t_surface",))
    assert lacking(tank, SPEC, ("t_surface",)) == {}
    assert lacking(tank, DOUBTED, ("t_surface",)) == {
        f"sensors slower by {0.5 * delay:.2g} s": {"sensor_lag_s": 0.5 * delay},
        f"delay longer by {0.6 * delay:.2g} s": {"move_delay_s": 0.6 * delay},
        "drive weaker by 15 %": {"drive_share": 0.85},
    }


def test_an_mpc_is_shown_the_mean_of_the_readings_between_its_moves_and_a_pi_the_last_one():
    # a log of a reading a second whose rows were averaged to 4 s: one of them has twice the noise of the mean
    record = PlantScores(reading_sd={"t_surface": 0.2}, reading_excess={"t_surface": 0.2 * 0.75**0.5})
    plant = replace(make_tank(), dt=4.0, scores=record)
    plant = replace(plant, model=replace(plant.model, dt=4.0))
    assert objective.readings_a_move(plant, "t_surface", 4.0) == pytest.approx(4.0)
    assert objective.readings_a_move(plant, "t_surface", 8.0) == pytest.approx(8.0)
    assert objective.readings_a_move(plant, "t_tank", 8.0) == 2.0  # of which the record says nothing
    raw = surroundings_of(SPEC, ("t_surface",), plant)
    assert (raw.noises, raw.quanta) == ({"t_surface": 0.2}, {"t_surface": 0.0})
    mean = surroundings_of(SPEC, ("t_surface",), plant, filtered_s=8.0)
    assert mean.noises["t_surface"] == pytest.approx(0.2 / 8**0.5)
    assert mean.noises["t_tank"] == pytest.approx(np.hypot(0.04, 0.0625 / 12**0.5) / 2**0.5)
    assert mean.quanta == {"t_surface": 0.0, "t_tank": 0.0}
    design = as_tried(default_design(plant, dt=8.0), plant)
    assert design.noise.reading["t_surface"] == pytest.approx(0.2 / 8**0.5)


def test_in_the_trials_the_sensor_of_a_room_is_off_and_noise_that_is_stated_is_taken(tank):
    offset = surroundings_of(SPEC, ("t_surface",), tank).offset
    assert offset == {"t_surface": 0.4, "t_ambient": pytest.approx(0.6)}
    stated = surroundings_of(Spec(steps=STEPS, noise_degC=0.1), ("t_surface",), tank)
    assert (stated.noise, stated.noises) == (0.1, {})


def test_each_case_has_its_draw_its_length_its_seed_and_what_it_lacks(monkeypatch, tank):
    monkeypatch.setenv("THERMOGRIP_COMPILED", "0")
    seen: list[tuple[Any, ...]] = []

    def loop(controller: Any, plant: Any, schedule: Any, *, surroundings: Surroundings, **given: Any) -> Any:
        seen.append((plant, schedule, given["start"], given["seed"], surroundings.drive_share))
        raise InterruptedError

    monkeypatch.setattr(objective, "simulate_closed_loop", loop)
    monkeypatch.setattr(objective, "drawn", lambda plant, draw: f"draw {draw}")
    made = Controller(tank, SPEC.design(tank))
    weaker = list(lacking(tank, DOUBTED, made.controlled))[2]
    cases = [*steps_on(SPEC, [1, 2]), Case(28.0, 36.0, 3, weaker, seconds=90.0)]
    for case in cases:
        with pytest.raises(InterruptedError):
            run_trials(made, tank, DOUBTED, [case], seed=4)
    own = [(28.0, end, draw) for end in (36.0, 20.0) for draw in (1, 2)]
    assert seen == [
        *((f"draw {draw}", [(end, 300.0)], start, 4000 + draw, 1.0) for start, end, draw in own),
        ("draw 3", [(36.0, 90.0)], 28.0, 4003, 0.85),
    ]


def test_a_step_costs_its_settling_in_bounds_and_what_the_spec_forbids():
    assert total([ONE]) == pytest.approx(3.0)
    # in units of its whole length where nothing reaches it, and of a second at least
    assert total([replace(ONE, case=replace(CASE, draw=3))]) == pytest.approx(0.5)
    assert total([replace(ONE, case=replace(CASE, draw=4))]) == pytest.approx(150.0)
    never = replace(ONE, settle_s=np.nan, last_error=-1.5, bias=5.0)  # its bias is not charged besides
    assert total([never]) == pytest.approx(300 / 50 + 0.5 * 1.5 / 0.3)
    assert total([replace(ONE, overshoot=0.5)]) == pytest.approx(3 + 3 * (0.5 / 0.3 - 0.9))
    assert total([replace(ONE, bias=-0.09)]) == pytest.approx(3 + 0.5 * (0.09 / 0.05 - 0.9))
    dear = SPEC.model_copy(update={"energy_weight": 0.5, "moves_weight": 0.25})
    assert total([replace(ONE, energy_s=100.0, travel=2.0)], dear) == pytest.approx(3 + 1.0 + 0.5)


def test_a_score_is_the_mean_and_half_of_what_the_worst_is_above_it_noises_by_their_mean():
    others = [replace(ONE, case=replace(CASE, draw=2), settle_s=settle) for settle in (30.0, 50.0)]
    assert total([ONE, *others]) == pytest.approx(2.0 + 0.5 * (3.0 - 2.0))


def test_a_load_costs_its_iae_in_that_of_the_reference_and_is_added():
    cases = [Case(36.0, 36.0, draw, load=Load("q", 1.0)) for draw in (1, 2)]
    loads = [replace(ONE, case=case, iae=30.0, settle_s=20.0) for case in cases]
    iae = dict.fromkeys(cases, 20.0)
    assert total(loads, iae=iae) == pytest.approx(1.5)
    assert total([ONE, *loads], iae=iae) == pytest.approx(3.0 + 1.5)
    lost = [replace(loads[0], settle_s=np.nan, last_error=0.6), loads[1]]
    assert total(lost, iae=iae) == pytest.approx(2.0 + 0.5 * 0.5)
    parts = score([ONE, *loads], SPEC, Scales(BOUNDS, {}, iae))
    assert (parts.steps, parts.loads) == pytest.approx((3.0, 1.5))


def test_moves_beyond_the_limit_are_charged_as_overshoot_is():
    """The limit is in moves of the default design in the same trial, where that settles; without, none."""
    moves, one = {CASE: 1.25}, replace(ONE, travel=3.0)
    assert total([one], FREE_OF_MOVES, moves=moves) == pytest.approx(3 + 3 * (3.0 / (1.5 * 1.25) - 0.9))
    assert total([replace(one, travel=1.6)], FREE_OF_MOVES, moves=moves) == pytest.approx(3.0)
    other = replace(one, case=replace(CASE, draw=4), settle_s=0.2)
    assert total([other], FREE_OF_MOVES, moves=moves) == pytest.approx(0.2)
    free = FREE_OF_MOVES.model_copy(update={"moves_limit": 0.0})
    assert total([one], free, moves=moves) == pytest.approx(3.0)


def test_a_run_without_structure_counts_as_any_other_draw():
    found = score(
        [ONE, replace(ONE, case=replace(CASE, lacks="lag"), settle_s=200.0)], SPEC, Scales(BOUNDS, {}, {})
    )
    assert (found.steps, found.loads) == pytest.approx((3.75, 0.0))


def test_a_score_does_not_depend_on_the_unit_of_the_outputs():
    results = [
        StepResult(CASE, 150.0, 0.5, 0.02, 0.1, 3.0, 2.0, 0.5, 300.0),
        StepResult(replace(CASE, draw=2), np.nan, 0.2, 0.5, 0.7, 3.0, 2.0, 0.5, 300.0),
    ]
    sizes = ("overshoot", "bias", "last_error")
    cases = [Case(28e3, 36e3, draw) for draw in (1, 2)]
    milli = [
        replace(r, case=case, **{name: 1000 * getattr(r, name) for name in sizes})
        for case, r in zip(cases, results)
    ]
    small = SPEC.model_copy(update={"band_degC": 300.0, "overshoot_degC": 300.0, "bias_degC": 50.0})
    big = {(1000 * start, 1000 * end, draw): bound for (start, end, draw), bound in BOUNDS.items()}
    for pair in zip(results, milli, strict=True):
        assert total([pair[0]]) == pytest.approx(total([pair[1]], small, big), rel=1e-12)
