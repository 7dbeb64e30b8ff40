"""Tuning: what it finds, what it says when weights are not the limit, and that it can be repeated."""

from __future__ import annotations

from dataclasses import replace

import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.figures import closed_loop_figure
from thermogrip.mpc.tuning.trials import StepResult, score, surroundings_of
from thermogrip.mpc.tuning.tune import tune

QUICK = Spec(steps=[(28, 36)], hold_s=260.0, evaluations=5, sample_time_s=4.0, settle_within_s=250.0)


@pytest.fixture(scope="module")
def tuning(tank):
    seen = []
    found = tune(tank, QUICK, progress=lambda fraction, what: seen.append((fraction, what)))
    return found, seen


def test_all_controllers_stand_side_by_side_on_every_step(tuning):
    rows = tuning[0].rows
    assert [row.controller for row in rows] == ["baseline", "tuned", "PI", "LQR"]
    assert all((row.start, row.target) == (28, 36) for row in rows)
    assert tuning[0].verdict in ("improved", "flat", "actuator-limited")


def test_mpc_pi_and_lqr_are_tuned_with_as_many_trials(tuning):
    tried = [trial.controller for trial in tuning[0].history]
    assert {name: tried.count(name) for name in ("MPC", "PI", "LQR")} == dict.fromkeys(
        ("MPC", "PI", "LQR"), QUICK.evaluations
    )


def test_in_the_trials_the_sensor_of_a_room_of_any_name_is_off():
    offset = surroundings_of(QUICK, ("t_ambient_block",), ("t_room",)).offset
    assert offset["t_room"] == 1.5 * offset["t_ambient_block"] != 0
    assert len(offset) == 2


def test_no_settling_time_is_below_what_full_drive_needs(tuning):
    assert any(row.settle_mean_s >= row.bound_s for row in tuning[0].rows)
    for row in tuning[0].rows:
        assert not row.settle_mean_s < row.bound_s  # NaN where it did not settle


def test_progress_runs_from_nothing_to_all(tuning):
    fractions = [fraction for fraction, _ in tuning[1]]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0)


def test_the_kept_controller_is_no_worse_than_the_default_one(tuning):
    scores = tuning[0].scores
    kept = min(scores["tuned"], scores["baseline"])
    assert kept <= scores["baseline"]


def test_the_file_says_what_was_found_and_can_be_used(tuning, tmp_path):
    loaded = Controller.load(tuning[0].save(tmp_path / "controller.json"))
    assert loaded.notes["verdict"] == tuning[0].verdict
    assert loaded.notes["spec"]["steps"] == [[28.0, 36.0]]
    assert loaded.design == tuning[0].controller.design


def test_the_same_seed_finds_the_same_controller(tank, tuning):
    again = tune(tank, QUICK)
    assert again.controller.design == tuning[0].controller.design
    assert again.scores == tuning[0].scores


def test_a_spec_faster_than_full_drive_is_called_actuator_limited(tank):
    found = tune(tank, QUICK.model_copy(update={"settle_within_s": 20.0, "evaluations": 1}))
    assert found.verdict == "actuator-limited"
    assert "28 to 36 degC cannot settle under" in found.finding
    assert not found.meets_spec


def test_a_target_out_of_reach_is_refused(tank):
    with pytest.raises(UserError, match="does not reach"):
        tune(tank, QUICK.model_copy(update={"steps": [(28.0, 140.0)], "evaluations": 1}))


def test_the_score_charges_overshoot_bias_and_not_settling():
    good = StepResult(28, 38, 1, 100.0, 0.1, 0.01, 0.0, 100.0, 2.0, 0.9, 600.0)
    bounds = {(28, 38, 1): 100.0}
    spec = Spec(energy_weight=0.5)
    assert score([good], spec, bounds) == pytest.approx(1 + 0.5)
    assert score([replace(good, overshoot=0.37)], spec, bounds) == pytest.approx(1.5 + 1.0)
    assert score([replace(good, bias=-0.145)], spec, bounds) == pytest.approx(1.5 + 1.0)
    never = replace(good, settle_s=float("nan"), last_error=2.0)
    assert score([never], spec, bounds) == pytest.approx(6 + 4 + 0.5)


def test_the_runs_can_be_drawn(tuning):
    for title, run in tuning[0].runs.items():
        figure = closed_loop_figure(run, title, limits={"t_tank": (2, 65)}, slew_per_s={"drive": 0.25})
        assert len(figure.axes) == 4
