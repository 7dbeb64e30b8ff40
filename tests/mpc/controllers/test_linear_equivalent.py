"""The controller as a linear system: the same first move, the same loop as another library closes it."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.linear_equivalent import linear_law
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.tuning import design_review as checks

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
    law, (loop, *_) = linear_law(controller), checks.loops_of(controller, 0)
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
    (loop, *_) = checks.loops_of(controller, 0)
    plant = control.StateSpace(loop.A, loop.B, loop.C, 0, controller.dt)
    closed = control.feedback(plant, system[0, :2], sign=1)
    ours = np.sort(np.abs(np.linalg.eigvals(loop.matrix)))
    np.testing.assert_allclose(np.sort(np.abs(closed.poles()))[-4:], ours[-4:], atol=1e-6)


def test_a_constant_target_ends_in_a_constant_skin_at_the_target(controller):
    law, (loop, *_) = linear_law(controller), checks.loops_of(controller, 0)
    at_target = law.inputs.index("target_t_surface")
    entry = np.concatenate([loop.B @ law.D[:, at_target], law.B[:, at_target]])
    rest = np.linalg.solve(np.eye(len(entry)) - loop.matrix, entry)
    assert (loop.C @ rest[: len(loop.A)])[1] == pytest.approx(1.0, abs=1e-6)


def test_a_warmer_room_is_answered_before_the_skin_feels_it(controller):
    law = linear_law(controller)
    assert law.D[0, law.inputs.index("t_ambient")] < 0
