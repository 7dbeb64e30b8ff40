"""Prediction: two derivatives that agree, delay, steady states, step responses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.mpc.design.design import make_blocks
from thermogrip.mpc.design.simc import simc
from thermogrip.mpc.estimator.observer import choose_disturbances, detectability_margin
from thermogrip.mpc.plant.prediction import PredictionModel, sample_time, step_response
from thermogrip.mpc.plant.steady_state import holding_drive, steady_curve
from thermogrip.mpc.plant.tangents import Dual
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.plant import Plant

ROOM = np.array([25.0])


def network_plant(name: str) -> Plant:
    model = load_network(name)
    values = dict(zip(model.parameters, model.prior.tolist()))
    valid = dict.fromkeys(model.inputs, (-1.0, 1.0))
    return Plant(model, values, dt=model.dt, units=model.units, reference=model.reference, valid=valid)


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return network_plant("gripper")


@pytest.mark.parametrize("level", [-0.7, 0.0, 0.4])
def test_dual_numbers_and_casadi_sensitivities_give_the_same_linearisation(tank, gripper, level):
    for plant in (tank, gripper):
        model = PredictionModel(plant, dt=2.0)
        x, blocks = model.rest(np.array([30.0, 29.0]), ROOM), make_blocks(20, 5)
        plan = level + 0.05 * np.arange(5)[:, None]
        y, G = model.trajectory(x, plan, ROOM, blocks)
        y_exact, G_exact = model.trajectory_exact(x, plan, ROOM, blocks)
        np.testing.assert_allclose(y, y_exact, atol=1e-9)
        np.testing.assert_allclose(G, G_exact, atol=1e-12 * np.abs(G_exact).max())


@pytest.mark.parametrize("name", ["gripper", "peltier_chamber", "tclab"])
def test_derivatives_of_networks_are_machine_code(name):
    assert PredictionModel(network_plant(name)).by_duals


def test_one_sample_has_the_jacobian_that_casadi_derives(gripper):
    model = PredictionModel(gripper, dt=2.0)
    x, u = model.rest(np.array([35.0, 34.0]), ROOM), np.array([0.3])
    after, A, B, E = model.linearise(x, u, ROOM)
    exact = [np.asarray(value.full()) for value in model.casadi_step()(x, u, ROOM)]
    np.testing.assert_allclose(after, exact[0].ravel(), atol=1e-9)
    for found, derived in zip((A, B, E), exact[1:], strict=True):
        np.testing.assert_allclose(found, derived, atol=1e-12)


def test_numpys_functions_carry_their_derivatives():
    h = 1e-6
    for function in (np.sqrt, np.exp, np.log, np.sin, np.cos, np.tanh, np.square, np.absolute, np.negative):
        exact = function(Dual(0.7, 2.0))
        assert exact.value == pytest.approx(function(0.7))
        assert exact.slope == pytest.approx((function(0.7 + h) - function(0.7 - h)) / h, rel=1e-8)
    assert (Dual(3.0, 1.0) ** 3).slope == 27.0
    assert np.multiply(2.0, Dual(3.0, 1.0)).slope == 2.0


def test_a_step_that_is_more_than_arithmetic_is_linearised_by_casadi(tank):
    class Bent(type(tank.model)):
        """The tank, its drive through an arc tangent."""

        def step(self, x, u, d, p, dt):
            bent = u[0].arctan() if hasattr(u[0], "arctan") else np.arctan(u[0])
            return super().step(x, [bent, *u[1:]], d, p, dt)

    fields = (
        "inputs",
        "disturbances",
        "outputs",
        "A",
        "B",
        "C",
        "dt",
        "E",
        "c",
        "y0",
        "switches",
        "terms",
        "F",
    )
    bent = Bent(**{name: getattr(tank.model, name) for name in fields})
    model = PredictionModel(replace(tank, model=bent), dt=2.0)
    x = model.rest(np.array([25.0, 25.0]), ROOM)
    assert not model.by_duals
    _, _, B, _ = model.linearise(x, np.array([0.5]), ROOM)
    _, _, straight, _ = PredictionModel(tank, dt=2.0).linearise(x, np.array([0.5]), ROOM)
    np.testing.assert_allclose(B, straight / (1 + 0.5**2), rtol=1e-9)


def test_a_coarser_step_is_taken_only_where_it_predicts_the_same(gripper):
    coarse, fine = PredictionModel(gripper, dt=2.0), PredictionModel(gripper, dt=0.5)
    assert coarse.sub < 4
    x = fine.rest(np.array([25.0, 25.0]), ROOM)
    plan = np.where(np.arange(60) < 30, 1.0, -1.0)[None, :, None]
    y, _ = coarse.run(x[None], plan, ROOM)
    y_fine, _ = fine.run(x[None], np.repeat(plan, 4, axis=1), ROOM)
    assert np.max(np.abs(y - y_fine[:, ::4])) < 0.02


def test_nothing_moves_before_the_delay_is_over(tank):
    model = PredictionModel(tank, dt=1.0)
    x = model.rest(np.array([25.0, 25.0]), ROOM)
    _, G = model.trajectory(x, np.zeros((1, 1)), ROOM, (30,))
    skin = np.abs(G[:, 1, 0, 0])
    assert np.all(skin[:8] < 1e-12)
    assert skin[12] > 1e-4


def test_at_steady_state_the_prediction_stays(tank):
    model = PredictionModel(tank, dt=2.0)
    u = np.array([0.2])
    x = model.steady_state(u, ROOM)
    np.testing.assert_allclose(model.next_state(x, u, ROOM), x, atol=1e-6)


def test_the_steady_gain_is_the_slope_of_the_steady_curve(reversing_tank):
    model = PredictionModel(reversing_tank, dt=2.0)
    for level in (-0.8, -0.3, 0.4):
        up, down = (model.steady_output([level + h], ROOM) for h in (1e-4, -1e-4))
        np.testing.assert_allclose(model.dc_gain([level], ROOM)[:, 0], (up - down) / 2e-4, rtol=1e-3)


def test_the_gain_turns_over_where_heat_equals_twice_joule(reversing_tank):
    curve = steady_curve(PredictionModel(reversing_tank, dt=2.0), "drive", "t_surface", ROOM)
    assert len(curve.turns) == 1
    assert curve.turns[0] == pytest.approx(-0.55, abs=0.05)  # heat / (2 joule), on a grid of 0.05
    assert curve.rising == (curve.turns[0], 1.0)


def test_the_holding_drive_holds_and_says_what_it_misses(tank):
    model = PredictionModel(tank, dt=2.0)
    held = holding_drive(model, ("t_surface",), [38.0], ROOM)
    assert held.miss < 1e-6
    assert held.y[1] == pytest.approx(38.0)
    assert holding_drive(model, ("t_surface",), [500.0], ROOM).miss > 100


def test_of_two_drives_that_hold_the_smaller_is_taken(reversing_tank):
    model = PredictionModel(reversing_tank, dt=2.0)
    held = holding_drive(model, ("t_surface",), [18.0], ROOM)
    assert held.miss < 1e-6
    assert held.u[0] > -0.55


def test_delay_and_lag_are_read_off_the_step_response(tank):
    answer = step_response(tank, "drive", "t_surface")
    model = PredictionModel(tank, dt=1.0)
    assert answer.gain == pytest.approx(2 * model.dc_gain([0.0], ROOM)[1, 0], rel=2e-2)
    assert 9 <= answer.delay <= 25  # 9 s of tube, and most of the 12 s lag of the skin
    assert answer.lag == pytest.approx(700, rel=0.1)


def test_the_sample_time_is_a_round_part_of_the_delay(tank, gripper):
    assert sample_time(gripper) == 2.0
    assert sample_time(tank) in (2.0, 5.0)


def test_simc_of_a_first_order_plant_is_its_closed_form(tank):
    answer = step_response(tank, "drive", "t_surface")
    loop = simc(tank, "drive", "t_surface", tau_c=answer.delay)
    assert loop.Kc == pytest.approx(2 * answer.lag / (answer.gain * 2 * answer.delay))
    assert loop.Ti == pytest.approx(min(answer.lag, 8 * answer.delay))


def test_the_disturbances_chosen_are_a_drive_and_the_skin(tank, gripper):
    for plant in (tank, gripper):
        chosen = choose_disturbances(PredictionModel(plant, dt=2.0), ("t_surface",))
        assert chosen.names == ("input drive", "output t_surface")
        assert chosen.margin > 0.1


def test_more_disturbances_than_outputs_cannot_be_told_apart():
    A, C = np.diag([0.9, 0.8]), np.eye(2)
    assert detectability_margin(A, C, np.eye(2), np.zeros((2, 2))) > 1
    assert detectability_margin(A, C, np.eye(2, 3), np.eye(2, 3)) == 0
    same = np.array([[0.1, 0.2], [0.0, 0.0]])  # two heat flows into one state
    assert detectability_margin(A, C, same, np.zeros((2, 2))) == 0


def test_an_unseen_mode_that_does_not_decay_is_not_detectable():
    A, C = np.diag([0.9, 1.0]), np.array([[1.0, 0.0]])
    assert detectability_margin(A, C, np.array([[0.1], [0.0]]), np.zeros((1, 1))) == 0
