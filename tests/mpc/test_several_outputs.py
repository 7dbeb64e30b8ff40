"""Several outputs and drives, closed on plants that share no code with the package."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mpc.makers import network_plant
from thermogrip.mpc.closed_loop.simulate import simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.estimator.reading_checks import follows
from thermogrip.sysid.plant.plant import Plant

from .truths import furnace, linear_model, quadruple_tank

CONTROLLED = ("t2", "t5")
LOOPS = {"controlled": CONTROLLED, "deadline_s": 1e9}  # on a busy computer a second passes


@pytest.fixture(scope="module")
def furnace_plant() -> Plant:
    truth = furnace()
    return linear_model(truth, truth.x, np.zeros(2), dt=10.0)


def test_a_single_number_is_the_target_of_every_controlled_output(furnace_plant):
    design = default_design(furnace_plant, **LOOPS)
    controllers = [
        Controller(furnace_plant, design),
        PIController(furnace_plant, dt=10.0, controlled=CONTROLLED),
    ]
    reading = furnace().reading()
    for controller in controllers:
        moves = []
        for target in (26.0, dict.fromkeys(CONTROLLED, 26.0)):
            controller.reset(reading)
            moves.append(controller.step(reading, target))
        assert [(move.status, move.advice) for move in moves] == [("ok", "")] * 2
        assert moves[0].drive == moves[1].drive


def test_of_two_targets_that_exclude_each_other_the_one_that_weighs_more_is_nearer():
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    off, ends = {}, {"q1": (0.0, 60.0), "q2": (0.0, 0.001)}
    for name, weights in (("alike", {}), ("t2", {"t2": 100.0})):
        controller = Controller(plant, default_design(plant, dt=5.0, weights=weights, drive_range=ends))
        loop = simulate_closed_loop(controller, plant, [({"t1": 60.0, "t2": 27.0}, 1500.0)], start=25.0)
        off[name] = [abs(part.bias) for part in loop.segments]
    assert off["t2"][1] < 0.5 * off["alike"][1]
    assert off["t2"][0] > off["alike"][0]


def run(controller, truth, target, seconds):
    """Close the loop; return the moves and the readings without noise."""
    moves, seen = [], []
    for _ in range(round(seconds / controller.dt)):
        moves.append(controller.step(truth.reading(), target))
        truth.apply(moves[-1].drive, controller.dt)
        seen.append(truth.true + truth.bias)
    return moves, np.array(seen)


@pytest.mark.parametrize("disagree", [0.0, 1.0, 2.0])
def test_sensors_that_disagree_from_the_start_are_off_and_the_plant_is_at_rest(furnace_plant, disagree):
    truth = furnace(disagree=disagree)
    controller = ReferenceController(furnace_plant, default_design(furnace_plant, **LOOPS))
    first = truth.reading()
    controller.reset(first)
    observer, model = controller.observer, controller.model
    moved = model.output(model.next_state(observer.x, np.zeros(2), np.zeros(0))) - model.output(observer.x)
    assert np.abs(moved).max() < 0.2
    np.testing.assert_allclose(observer.reading(), list(first.values()), atol=0.05)
    moves, seen = run(controller, truth, {"t2": 55.0, "t5": 60.0}, 2000.0)
    assert {move.status for move in moves} == {"ok"}
    np.testing.assert_allclose(seen[-50:, [1, 4]].mean(axis=0), [55.0, 60.0], atol=0.05)
    assert (seen[:, [1, 4]] - [55.0, 60.0]).max() < 0.3
    assert bool(follows(observer, ("t2", "t5"))) == (disagree > 1)  # 2 degC and more is a monitor's matter


def test_a_sensor_that_jumps_for_good_is_off_and_the_others_stay(furnace_plant):
    truth = furnace()
    controller = ReferenceController(furnace_plant, default_design(furnace_plant, **LOOPS))
    controller.reset(truth.reading())
    target = {"t2": 45.0, "t5": 45.0}
    run(controller, truth, target, 600.0)
    x = controller.observer.x
    truth.bias = np.array([0.0, 0.0, 0.0, 15.0, 0.0, 0.0])
    moves, seen = run(controller, truth, target, 1000.0)
    said = [move.advice for move in moves]
    assert [("no usable reading" in text) for text in said[:5]] == [True] * 3 + [False] * 2
    assert "t4: a jump that stays, taken for an offset" in said[3]
    assert "t4 is far from the model" in follows(controller.observer, ("t2", "t5"))
    np.testing.assert_allclose(seen[:, [1, 4]], 45.0, atol=0.3)
    np.testing.assert_allclose(controller.observer.x, x, atol=0.5)


def test_when_most_readings_jump_it_is_the_world_that_changed(furnace_plant):
    truth = furnace()
    controller = Controller(furnace_plant, default_design(furnace_plant, **LOOPS))
    controller.reset(truth.reading())
    target = {"t2": 45.0, "t5": 45.0}
    run(controller, truth, target, 600.0)
    truth.x = truth.x - 15.0  # the charge is changed
    moves, seen = run(controller, truth, target, 1000.0)
    assert "a jump that stays, the estimate was started again" in moves[3].advice
    assert {move.status for move in moves[3:]} == {"ok"}
    np.testing.assert_allclose(seen[-20:, [1, 4]].mean(axis=0), 45.0, atol=0.05)


@pytest.mark.parametrize("power", [0.7, 0.5, 0.45])
def test_there_is_no_offset_as_long_as_the_drives_are_inside_their_limits(power):
    design_truth = quadruple_tank()
    plant = linear_model(design_truth, design_truth.x, np.full(2, 30.0), dt=2.0)
    controller = ReferenceController(plant, default_design(plant, controlled=("h1", "h2"), deadline_s=1e9))
    truth = quadruple_tank(power=power)
    controller.reset(truth.reading())
    moves, seen = run(controller, truth, 15.0, 1200.0)
    assert 0 < max(moves[-1].drive.values()) < 99
    np.testing.assert_allclose(seen[-100:].mean(axis=0), 15.0, atol=0.02)
    assert {move.status for move in moves} == {"ok"}
    assert ("h1, h2 do not follow the drive" in follows(controller.observer, ("h1", "h2"))) == (power < 0.6)


def test_one_lost_sensor_is_one_lost_loop(furnace_plant):
    design = default_design(furnace_plant, controlled=CONTROLLED, patience_s=100.0, deadline_s=1e9)
    controller, truth = Controller(furnace_plant, design), furnace()
    controller.reset(truth.reading())
    target, seen = {"t2": 40.0, "t5": 40.0}, []
    moves, _ = run(controller, truth, target, 400.0)
    whole, held = truth.reading, moves[-1].drive
    truth.reading = lambda: {**whole(), "t2": float("nan")}
    moves, seen = run(controller, truth, target, 100.0)
    assert {(move.status, move.advice) for move in moves} == {
        ("fallback_plan", "t2: no usable reading, the model replaces it")
    }
    np.testing.assert_allclose(seen[:, [1, 4]], 40.0, atol=0.2)
    assert abs(moves[-1].drive["q1"] - held["q1"]) < 2
    moves, seen = run(controller, truth, {"t2": 40.0, "t5": 42.0}, 1000.0)
    assert {move.status for move in moves} == {"fallback_plan"}
    assert moves[-1].advice == "no reading of t2 for 1100 s: q1 to rest, the others go on"
    assert {move.drive["q1"] for move in moves[1:]} == {0.0}
    np.testing.assert_allclose(seen[-20:, 4].mean(), 42.0, atol=0.05)
    truth.reading = whole
    moves, seen = run(controller, truth, target, 1000.0)
    assert {move.status for move in moves} == {"ok"}
    np.testing.assert_allclose(seen[-20:, [1, 4]].mean(axis=0), 40.0, atol=0.05)


@pytest.mark.parametrize(("patience_s", "samples"), [(None, 5), (20.0, 2)])
def test_one_lost_sensor_of_two_leaves_the_other_loop_of_a_pi_controller(furnace_plant, patience_s, samples):
    patience = {} if patience_s is None else {"patience_s": patience_s}
    controller = PIController(furnace_plant, dt=10.0, controlled=CONTROLLED, **patience)
    truth = furnace()
    controller.reset(truth.reading())
    moves, _ = run(controller, truth, 40.0, 2000.0)
    whole, held = truth.reading, moves[-1].drive["q1"]
    truth.reading = lambda: {**whole(), "t2": float("nan")}
    moves, seen = run(controller, truth, 40.0, 4000.0)
    assert [move.drive["q1"] for move in moves[:samples]] == [held] * samples
    assert moves[samples].drive["q1"] < held
    assert {move.drive["q1"] for move in moves[12:]} == {0.0}
    assert {move.status for move in moves} == {"fallback_plan"}
    np.testing.assert_allclose(seen[-20:, 4].mean(), 40.0, atol=0.1)
