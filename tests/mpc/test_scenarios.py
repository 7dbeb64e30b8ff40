"""Closed loops in words: what the skin does, on a plant that is not the model."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.closed_loop.simulate import Surroundings, Truth, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.optimiser.rti import Sample

OFF = Surroundings(offset={"t_surface": 0.2, "t_ambient": 0.3})


@pytest.fixture(scope="module")
def controller(tank) -> Controller:
    return design_controller(tank, dt=2.0)


def run(controller, plant, start, target, seconds=600.0, **more):
    loop = simulate_closed_loop(controller, plant, [(target, seconds)], start=start, surroundings=OFF, **more)
    return loop, loop.segments[0]


@pytest.mark.parametrize(
    ("start", "target", "within"), [(18, 38, 330), (28, 38, 190), (28, 18, 300), (18, 43, 400), (38, 28, 260)]
)
def test_skin_from_start_to_target_settles_stays_and_does_not_overshoot(
    controller, other_tank, start, target, within
):
    loop, segment = run(controller, other_tank, start, target)
    assert segment.settle_s < within
    assert segment.overshoot <= 0.3
    assert abs(segment.bias) <= 0.05
    assert set(loop.status) == {"ok"}
    assert np.all(np.abs(np.diff(loop.drive["drive"])) <= 0.5 + 1e-9)
    assert np.all(np.abs(loop.drive["drive"]) <= 1)


def test_past_the_optimum_of_the_peltier_the_drive_is_never_stuck_there(reversing_tank):
    # 5 degC cannot be held: the coldest is near 8; a controller that froze the sign would sit at -1 and heat
    controller = ReferenceController(reversing_tank, default_design(reversing_tank, dt=2.0))
    schedule = [(18.0, 600.0), (5.0, 600.0), (30.0, 600.0)]
    loop = simulate_closed_loop(controller, reversing_tank, schedule, start=25.0)
    cold = loop.drive["drive"][450:600]  # the last 300 s of the cold segment
    assert cold.min() > -0.75
    assert loop.segments[0].settle_s < 600
    assert loop.segments[2].settle_s < 300
    assert loop.segments[2].overshoot < 0.3


def test_caught_on_the_wrong_side_of_the_optimum_the_plan_comes_back(reversing_tank):
    # at full cooling current more of it heats: from there, heating by the slope alone means staying
    controller = ReferenceController(reversing_tank, default_design(reversing_tank, dt=2.0))
    truth = Truth(reversing_tank, controller.dt, Surroundings(), 12.0, 0)
    controller.reset(truth.reading())
    controller._follows.plan = np.full((sum(controller.design.blocks), 1), -1.0)
    moves = [-1.0]
    for _ in range(15):
        move = controller.step({**truth.reading(), "drive": moves[-1]}, 30.0)
        truth.apply(move)
        moves.append(move.drive)
    assert moves[-1] > 0.9


def test_a_drive_bias_is_not_learnt_where_the_gain_has_turned_over(reversing_tank):
    controller = ReferenceController(reversing_tank, default_design(reversing_tank, dt=2.0))
    controller.reset({"t_tank": 20.0, "t_surface": 20.0, "t_ambient": 25.0})
    controller._follows.plan = np.full((sum(controller.design.blocks), 1), -0.5)
    reading = {"t_tank": 20.0, "t_surface": 20.0, "t_ambient": 25.0, "drive": -0.5}
    controller.step(reading, -10.0)
    before = controller.observer.w.copy()
    controller.observer.update(np.array([23.0, 20.5]))
    assert controller.observer.w[0] == before[0]
    assert controller.observer.w[1] != before[1]


def test_anti_windup_takes_overshoot_away(tank, monkeypatch):
    over = []
    for uncut in (1e-9, np.inf):  # np.inf: the integrator goes on while the drive is limited
        monkeypatch.setattr("thermogrip.mpc.controllers.pi.UNCUT", uncut)
        pi = PIController(tank, dt=2.0)
        over.append(run(pi, tank, 18.0, 43.0, seconds=900.0)[1].overshoot)
    assert over[0] < 0.7 * over[1]


def test_the_room_warms_by_three_degrees_and_the_skin_stays(controller, tank):
    loop = simulate_closed_loop(
        controller, tank, [(33.0, 600.0)], start=33.0, surroundings=Surroundings(ambient=28.0)
    )
    assert loop.segments[0].settle_s < 60


def test_a_tank_limit_is_kept_where_the_skin_would_break_it(tank):
    limited = design_controller(tank, dt=2.0, limits={"t_tank": (5.0, 42.0)})
    loop, segment = run(limited, tank, 28.0, 38.0)
    assert loop.outputs["t_tank"].max() < 42.3
    assert np.isfinite(segment.settle_s)


def test_a_target_beyond_the_tank_limit_is_called_infeasible_and_the_limit_holds(tank):
    limited = design_controller(tank, dt=2.0, limits={"t_tank": (5.0, 40.0)}, price=500.0)
    loop, _ = run(limited, tank, 28.0, 48.0)
    assert loop.outputs["t_tank"].max() < 42
    free, _ = run(design_controller(tank, dt=2.0), tank, 28.0, 48.0)
    assert free.outputs["t_tank"].max() > 48


def test_two_runs_of_one_seed_are_the_same_and_another_seed_is_not(controller, other_tank):
    first, again, other = (run(controller, other_tank, 28.0, 31.0, 60.0, seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first.drive["drive"], again.drive["drive"])
    assert np.any(first.readings["t_surface"] != other.readings["t_surface"])


def follow(controller: Controller, plant, line: np.ndarray, ahead: int) -> tuple[np.ndarray, set[str]]:
    """Return by how much the skin is off a trajectory of which so many samples are told."""
    world, off, statuses = Truth(plant, 2.0, Surroundings(noise=0.02, quantum=0.0), 28.0, 1), [], set()
    controller.reset(world.reading())
    for k in range(250):
        reading = world.reading()
        off.append(reading["t_surface"] - line[k])
        told = line[k : k + ahead + 1].tolist() if ahead else float(line[k])
        move = controller.step(reading, {"t_surface": told})
        statuses.add(move.status)
        world.apply(move)
    return np.array(off[20:]), statuses


def test_a_trajectory_that_is_told_ahead_is_followed_without_lag(tank, other_tank):
    line = np.interp(2.0 * np.arange(400), [0, 60, 260, 400, 600], [28, 28, 38, 38, 30])
    controller = design_controller(tank, dt=2.0)
    late, _ = follow(controller, other_tank, line, 0)
    told, statuses = follow(controller, other_tank, line, 80)
    assert np.sqrt(np.mean(told**2)) < 0.12  # 0.09, and 0.77 where only the target now is known
    assert np.sqrt(np.mean(late**2)) > 0.5
    assert np.max(np.abs(told)) < 0.25
    assert statuses == {"ok"}
    controller.reset({"t_tank": 28.0, "t_surface": 28.0})
    move = controller.step({"t_tank": 28.0, "t_surface": 28.0}, {"t_surface": [float("nan"), 30.0]})
    assert (move.status, move.advice[:19]) == ("off", "target of t_surface")
    x, u, d = controller.model.at_rest(25.0)
    plans = []
    for side in (0.0, 1.0):  # from where it is approached: nothing is beyond a target that moves
        controller.optimiser.forget()
        ahead = np.linspace(40.0, 30.0, controller.optimiser.N)[:, None]
        guess, none = np.zeros((controller.optimiser.n_b, 1)), np.zeros(2)
        about = Sample(x, u, guess, d, np.array([40.0]), np.array([side]), none, np.zeros(1), ahead=ahead)
        plans.append(controller.optimiser.solve(about).plan)
    np.testing.assert_array_equal(plans[0], plans[1])
