"""The review: a sound design passes, and each planted fault is found by the check that is there for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.mpc.checks import review, worst
from thermogrip.mpc.controller import Controller, design_controller
from thermogrip.mpc.design import default_design, make_blocks
from thermogrip.mpc.observer import ObserverNoise


def verdicts(controller, **options) -> dict[str, str]:
    return {check.name: check.verdict for check in review(controller, **options)}


@pytest.fixture(scope="module")
def sound(tank):
    return review(design_controller(tank, dt=2.0), wanted=(18.0, 43.0))


def test_a_sound_design_passes_every_check(sound):
    assert {check.verdict for check in sound} == {"pass"}
    assert worst(sound) == "pass"
    assert len(sound) >= 10


def test_every_finding_has_a_number_and_every_fault_a_fix(sound, reversing_tank):
    faulty = review(design_controller(reversing_tank, dt=2.0), wanted=(2.0, 43.0))
    for check in (*sound, *faulty):
        assert check.verdict == "pass" or check.fix
        assert any(char.isdigit() for char in check.finding) or check.finding == "no limits of outputs"


def test_a_gain_that_turns_over_inside_the_range_warns(tank, reversing_tank):
    name = "gain keeps its sign over the drive"
    assert verdicts(design_controller(reversing_tank, dt=2.0))[name] == "warn"
    inside = design_controller(reversing_tank, dt=2.0, drive_range={"drive": (-0.5, 1.0)})
    assert verdicts(inside)[name] == "pass"


def test_a_temperature_that_no_drive_holds_fails(reversing_tank):
    checks = verdicts(design_controller(reversing_tank, dt=2.0), wanted=(-5.0, 30.0))
    assert checks["targets can be held in steady state"] == "fail"


def test_a_horizon_shorter_than_the_delay_fails(tank):
    short = design_controller(tank, dt=2.0, blocks=(1, 1, 1, 1))
    assert verdicts(short)["horizon covers delay and lag"] == "fail"


def test_no_disturbance_states_fail(tank):
    checks = verdicts(design_controller(tank, dt=2.0, offset_free=False))
    assert checks["disturbances are detectable"] == "fail"


def test_a_loop_with_two_samples_of_horizon_and_no_move_price_is_found_unstable(tank):
    design = replace(
        default_design(tank, dt=2.0),
        blocks=make_blocks(8, 8),
        terminal=0.0,
        move=1e-9,
        noise=ObserverNoise(state=0.5, drive=0.5, output=1e-5),
    )
    checks = {check.name: check for check in review(Controller(tank, design))}
    sound = {check.name: check for check in review(design_controller(tank, dt=2.0))}
    size = [float(c["closed loop is stable"].finding.split()[2]) for c in (checks, sound)]
    assert size[1] < 1
    assert size[0] > size[1]


def test_the_eigenvalue_of_the_review_is_the_rate_at_which_a_small_error_dies(tank):
    from thermogrip.mpc.closed_loop import Surroundings, simulate_closed_loop

    controller = design_controller(tank, dt=2.0)
    finding = next(c.finding for c in review(controller) if c.name == "closed loop is stable")
    rate = float(finding.split()[2])
    quiet = Surroundings(noise=0.0, quantum=0.0, offset={"t_tank": 0.02})
    run = simulate_closed_loop(controller, tank, [(25.0, 1600.0)], start=25.0, surroundings=quiet)
    error = np.abs(run.outputs["t_surface"] - 25.0)[::2]
    late = error[100:] + 1e-15
    # the error is bounded by the slowest mode: over 200 samples it falls at least as fast
    assert late[300] <= 1.5 * late[100] * rate**200 + 1e-6


def test_a_limit_that_the_targets_must_break_fails(tank):
    checks = verdicts(design_controller(tank, dt=2.0, limits={"t_tank": (10.0, 30.0)}), wanted=(18.0, 43.0))
    assert checks["soft limits agree with the targets"] == "fail"


def test_a_drive_that_cannot_be_zero_fails_and_a_crawling_one_warns(tank):
    name = "hard limits leave room"
    assert verdicts(design_controller(tank, dt=2.0, drive_range={"drive": (0.1, 1.0)}))[name] == "fail"
    assert verdicts(design_controller(tank, dt=2.0, slew_per_s={"drive": 1e-4}))[name] == "warn"


def test_targets_beyond_the_logs_warn(tank):
    checks = verdicts(design_controller(tank, dt=2.0), wanted=(18.0, 60.0))
    assert checks["targets lie where the logs were"] == "warn"
