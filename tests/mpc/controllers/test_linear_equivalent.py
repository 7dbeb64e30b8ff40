"""The controller as a linear system: the same first move, the same loop as another library closes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import crossed
from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.linear_equivalent import linear_law, linear_move
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.plant.prediction import PredictionModel


@dataclass(frozen=True)
class Loop:
    """A plant under the linear law, as one linear map; targets 0, no noise."""

    A: Any
    B: Any
    C: Any
    matrix: Any  # of (plant, controller) to the next sample


def loop_of(controller: Controller) -> Loop:
    law, model = linear_law(controller), PredictionModel(controller.plant, dt=controller.dt)
    _, A, B, _ = model.linearise(*model.at_rest(controller.design.ambient))
    by_y = slice(0, model.n_y)
    rows = [[A + B @ law.D[:, by_y] @ model.C, B @ law.C], [law.B[:, by_y] @ model.C, law.A]]
    return Loop(A, B, model.C, np.block(rows))


REST = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}


@pytest.fixture(scope="module")
def controller(tank) -> Controller:
    return design_controller(tank, dt=2.0, overshoot=5.0)


def test_the_first_move_to_a_near_target_is_the_law_s(controller):
    law = linear_law(controller)
    controller.reset(REST)
    controller.observer._P = np.zeros_like(controller.observer._P)  # the law is of the settled filter
    move = controller.step(REST, 25.02)
    assert move.drive == pytest.approx(0.02 * law.D[0, law.inputs.index("target_t_surface")], rel=1e-6)


def test_a_loop_with_the_law_is_the_loop_with_the_controller_while_no_limit_is_near(controller, tank):
    law, loop = linear_law(controller), loop_of(controller)
    quiet = Surroundings(noise=0.0, quantum=0.0)
    run = simulate_closed_loop(controller, tank, [(25.05, 200.0)], start=25.0, surroundings=quiet)
    state, at_target = np.zeros(len(loop.A) + len(law.A)), law.inputs.index("target_t_surface")
    entry = np.concatenate([loop.B @ law.D[:, at_target], law.B[:, at_target]])
    skin = []
    for _ in range(100):
        skin.append(25.0 + (loop.C @ state[: len(loop.A)])[1])
        state = loop.matrix @ state + 0.05 * entry
    # the filter of the run settles to the law's gain in its first seconds
    np.testing.assert_allclose(run.outputs["t_surface"][:-2:2], skin, atol=2e-3)


def test_python_control_closes_the_same_loop(controller, tank):
    control = pytest.importorskip("control")
    system = controller.to_control()
    assert system.dt == controller.dt
    assert system.input_labels == ["t_tank", "t_surface", "target_t_surface", "t_ambient"]
    assert system.output_labels == ["drive"]
    loop = loop_of(controller)
    plant = control.StateSpace(loop.A, loop.B, loop.C, 0, controller.dt)
    closed = control.feedback(plant, system[0, :2], sign=1)
    ours = np.sort(np.abs(np.linalg.eigvals(loop.matrix)))
    np.testing.assert_allclose(np.sort(np.abs(closed.poles()))[-4:], ours[-4:], atol=1e-6)


def test_a_constant_target_ends_in_a_constant_skin_at_the_target(controller):
    law, loop = linear_law(controller), loop_of(controller)
    at_target = law.inputs.index("target_t_surface")
    entry = np.concatenate([loop.B @ law.D[:, at_target], law.B[:, at_target]])
    rest = np.linalg.solve(np.eye(len(entry)) - loop.matrix, entry)
    assert (loop.C @ rest[: len(loop.A)])[1] == pytest.approx(1.0, abs=1e-6)


def test_a_warmer_room_is_answered_before_the_skin_feels_it(controller):
    law = linear_law(controller)
    assert law.D[0, law.inputs.index("t_ambient")] < 0


def test_the_law_of_two_loops_apart_by_hand():
    """One block of one sample: a and b are moved by 5.1 and 5 degC by a whole range of q2 and q1."""
    plant = crossed("0_255")
    weights = {"move": 3.0, "drive": 0.7, "track": 1.5, "terminal": 5.0}
    two = Controller(
        plant, default_design(plant, controlled=("b", "a"), blocks=(1,), ambient=21.0, **weights)
    )
    H, on_free, on_last = linear_move(two)
    # 2 (6.5 * 5^2 + 3 + 0.7) and 2 (6.5 * 5.1^2 + 3.7); the last drive by 2 * 3 / H
    np.testing.assert_allclose(H, np.diag([332.4, 345.53]), rtol=1e-9)
    np.testing.assert_allclose(on_free, [[-100 * 65 / 332.4, 0], [0, -255 * 66.3 / 345.53]], rtol=1e-9)
    np.testing.assert_allclose(on_last, np.diag([6 / 332.4, 6 / 345.53]), rtol=1e-9)
    # of (a, b, bias of q1, bias of q2), biases in ranges
    F = np.array([[0.9, 0, 0, 5.1], [0, 0.8, 5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    B = np.array([[0, 0.02], [0.05, 0], [0, 0], [0, 0]])
    E = np.array([[0.1], [0.2], [0], [0]])
    first, second = on_free[0, 0], on_free[1, 1]  # the free response is that of one sample
    on_z = np.array([[0, 0.8 * first, 5 * first, 0], [0.9 * second, 0, 0, 5.1 * second]])
    on_r, on_d = -np.diag([first, second]), np.array([[0.2 * first], [0.1 * second]])
    law = linear_law(two)
    assert law.inputs == ("a", "b", "target_b", "target_a", "room")
    assert (law.outputs, law.states) == (("q1", "q2"), ("z0", "z1", "z2", "z3", "last_q1", "last_q2"))
    assert law.dt == 2.0
    # one step of the law is one of filter, move and model, from any state
    z, last, y = np.array([1.0, 2.0, 0.1, -0.2]), np.array([7.0, 9.0]), np.array([1.5, 1.8])
    r, d = np.array([3.0, 4.0]), np.array([0.5])
    L = two.observer.settled_gain(F)
    seen = z + L @ (y - z[:2])
    u = on_z @ seen + on_r @ r + on_d @ d + on_last @ last
    given = np.concatenate([y, r, d])
    state = np.concatenate([z, last])
    np.testing.assert_allclose(law.C @ state + law.D @ given, u, rtol=1e-9)
    after = np.concatenate([F @ seen + B @ u + E @ d, u])
    np.testing.assert_allclose(law.A @ state + law.B @ given, after, rtol=1e-9, atol=1e-12)
