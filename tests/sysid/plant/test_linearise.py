"""A plant in the words of other libraries does what the plant does."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox.sindy import SindyModel
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.models.user_model import own_model
from thermogrip.sysid.plant.linearise import linearise_plant
from thermogrip.sysid.plant.plant import Plant


def _black_box() -> Plant:
    """A tank and a skin behind a pump, 300 s and 15 s; the Joule heat of the drive is a product."""
    model = StateSpaceModel(
        ("drive", "pump"),
        ("t_ambient",),
        ("t_tank", "t_surface"),
        A=[[1 - 2 / 300, 0.0], [0.0, 1 - 2 / 2000]],
        B=[[0.8, 0.0], [0.0, 0.0]],
        E=[[2 / 300], [2 / 2000]],
        C=np.eye(2),
        F=[[0.05], [0.0]],
        terms=("drive*drive",),
        dt=2.0,
        switches=("pump",),
        A_switch={"pump": np.array([[0.0, 0.0], [2 / 15, -2 / 15]])},
    )
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_tank": "degC", "t_surface": "degC"}
    return Plant(model, {}, dt=2.0, units=units, valid={"drive": (-1.0, 1.0)})


def _delayed() -> Plant:
    """One sample of delay before a lag: its pole at zero has no continuous equivalent."""
    model = StateSpaceModel(
        ("q",), (), ("t",), A=[[0.9, 4.0], [0.0, 0.0]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], dt=10.0
    )
    return Plant(model, {}, dt=10.0, units={"q": "1", "t": "degC"})


POINTS = {
    "tclab": {"inputs": {"q1": 30.0, "q2": 20.0}},
    "gripper": {"inputs": {"drive": 0.3}, "disturbances": {"t_ambient": 22.0}},
    "peltier_chamber": {"inputs": {"pwm": 80.0}},
}
PLANTS = {name: prior_plant(load_network(name)) for name in POINTS} | {"black box": _black_box()}
POINTS |= {"black box": {"inputs": {"drive": 0.4}, "disturbances": {"t_ambient": 22.0}}}


def _swing(near, size: float, n: int = 200) -> np.ndarray:
    """Return inputs (n, n_w) that step up and down about the operating point."""
    rng = np.random.default_rng(0)
    up = np.repeat(rng.choice([-1.0, 1.0], (n // 10, near.w.size)), 10, axis=0)
    return near.w + size * up * np.maximum(1.0, np.abs(near.w)) * 0.1


def _true(plant: Plant, near, w: np.ndarray, sub: int) -> np.ndarray:
    """Return the plant's own outputs (n + 1, n_y) under the same inputs, from the same state."""
    u = np.ones((len(w), len(plant.inputs)))
    for k, name in enumerate(near.inputs):
        if name in plant.inputs:
            u[:, plant.inputs.index(name)] = w[:, k]
    d = w[:, [near.inputs.index(name) for name in plant.disturbances]]
    u, d = (np.ascontiguousarray(np.repeat(part, sub, axis=0))[None] for part in (u, d))
    y, _ = plant.model.rollout(near.x[None], u, d, plant.p[None], plant.dt)
    return y[0, ::sub]


def _simulated(near, w):
    """Return outputs (N + 1, n_y) of the linear plant from its operating point."""
    dx, out = np.zeros(near.x.size), [near.y]
    for row in np.asarray(w, dtype=float) - near.w:
        dx = near.A @ dx + near.B @ row
        out.append(near.y + near.C @ dx)
    return np.array(out)


@pytest.mark.parametrize("name", PLANTS)
def test_a_linear_plant_is_right_to_second_order_in_the_swing(name):
    plant, sub = PLANTS[name], 3
    near = linearise_plant(plant, dt=sub * plant.dt, **POINTS[name])
    missed = {}
    for size in (1.0, 0.1):
        w = _swing(near, size)
        got, want = _simulated(near, w), _true(plant, near, w, sub)
        missed[size] = np.abs(got - want).max() / np.abs(want - near.y).max()
    assert missed[1.0] < 0.1
    # what a tangent leaves out is quadratic, so relative to the answer it falls with the swing, tenfold here
    assert missed[0.1] < 0.2 * missed[1.0] + 1e-7


@pytest.mark.parametrize("name", PLANTS)
def test_the_operating_point_is_where_the_plant_stays(name):
    plant = PLANTS[name]
    near = linearise_plant(plant, dt=plant.dt, **POINTS[name])
    stays = _true(plant, near, np.tile(near.w, (500, 1)), 1)
    np.testing.assert_allclose(stays, np.tile(near.y, (501, 1)), atol=1e-5)


@pytest.mark.parametrize("name", PLANTS)
def test_continuous_and_discrete_are_one_plant(name):
    plant = PLANTS[name]
    smooth = linearise_plant(plant, **POINTS[name])
    sampled = linearise_plant(plant, dt=4 * plant.dt, **POINTS[name])
    np.testing.assert_allclose(smooth.gain(), sampled.gain(), rtol=1e-4, atol=1e-6)
    n, m = smooth.B.shape
    held = expm(np.block([[smooth.A, smooth.B], [np.zeros((m, n + m))]]) * 4 * plant.dt)
    # a network's own step is of second order, and its fastest pipe cell empties within a few steps
    np.testing.assert_allclose(held[:n, :n], sampled.A, atol=2e-2 if name != "black box" else 1e-9)


def test_python_control_has_the_same_answer_under_the_plants_names():
    control = pytest.importorskip("control")
    plant, point = PLANTS["gripper"], POINTS["gripper"]
    near = linearise_plant(plant, dt=2.0, **point)
    system = plant.to_control(dt=2.0, **point)
    assert system.input_labels == ["drive", "t_ambient"]
    assert system.output_labels == ["t_tank", "t_surface"]
    assert system.state_labels[:3] == ["heatsink", "wall", "water"]
    assert "." not in "".join(system.state_labels)
    w = _swing(near, 1.0)
    answer = control.forced_response(system, inputs=(w - near.w).T, timepts=2.0 * np.arange(len(w)))
    np.testing.assert_allclose(answer.outputs.T + near.y, _simulated(near, w)[:-1], atol=1e-9)
    assert plant.to_control(**point).isctime()


def test_scipy_has_the_same_answer():
    plant, point = PLANTS["tclab"], POINTS["tclab"]
    near = linearise_plant(plant, dt=4.0, **point)
    w = _swing(near, 1.0)
    _, y, _ = signal.dlsim(plant.to_scipy(dt=4.0, **point), w - near.w)
    np.testing.assert_allclose(y + near.y, _simulated(near, w)[:-1], atol=1e-9)
    assert np.linalg.eigvals(plant.to_scipy(**point).A).real.max() < 0.0


@pytest.mark.parametrize("name", PLANTS)
def test_the_casadi_step_is_the_plants_step(name):
    plant = PLANTS[name]
    step = plant.to_casadi(dt=2 * plant.dt)
    assert step.name_in() == ["x", "u", "d", "p"]
    assert step.name_out() == ["x_next", "y"]
    rng = np.random.default_rng(1)
    x = 25.0 + 5.0 * rng.standard_normal((20, plant.model.n_x))
    u, d = (
        rng.uniform(0, 1, (20, 1, len(plant.inputs))),
        rng.uniform(20, 25, (20, 1, len(plant.disturbances))),
    )
    p = plant.p * rng.uniform(0.9, 1.1, (20, plant.p.size))
    y, end = plant.model.rollout(x, np.repeat(u, 2, axis=1), np.repeat(d, 2, axis=1), p, plant.dt)
    for k in range(20):
        x_next, seen = step(x[k], u[k, 0], d[k, 0], p[k])
        np.testing.assert_allclose(np.array(x_next).ravel(), end[k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(np.array(seen).ravel(), y[k, 0], rtol=1e-9, atol=1e-9)


def test_what_has_no_linear_model_is_refused_in_one_line():
    def refused(plant: Plant, says: str, **point) -> None:
        with pytest.raises(UserError, match=says) as found:
            plant.to_scipy(**point)
        assert "\n" not in str(found.value)

    grows = StateSpaceModel(("q",), (), ("t",), A=[[1.02]], B=[[1.0]], C=[[1.0]], dt=10.0)
    unstable = Plant(grows, {}, dt=10.0)
    refused(unstable, "runs away at this point .* e-fold in 505 s")
    integrator = Plant(replace(grows, A=np.eye(1)), {}, dt=10.0)
    refused(integrator, "does not settle")
    system = integrator.to_scipy(state=[20.0], dt=10.0)  # at a state that is given it is a plant like others
    np.testing.assert_allclose(system.A, [[1.0]], rtol=1e-9)
    refused(_delayed(), "a delay .* no continuous model has; export it at its own step, dt=10")
    assert _delayed().to_scipy(dt=10.0).A.shape == (2, 2)
    refused(PLANTS["tclab"], "no whole multiple", dt=1.5)
    refused(PLANTS["tclab"], "no pump there; its inputs and disturbances are q1, q2", inputs={"pump": 1.0})
    refused(PLANTS["tclab"], "state has 2 numbers; give 4", state=[1.0, 2.0])
    with pytest.raises(UserError, match="no whole multiple"):
        PLANTS["tclab"].to_casadi(dt=1.5)


def test_sindy_is_exported_too():
    model = SindyModel(
        ("q",), (), ("t",), exponents=[[0, 0], [1, 0], [0, 1], [2, 0]],
        coefficients=[[0.5, 0.97, 0.2, -1e-4]], low=[0.0], high=[100.0], dt=5.0,
        switches=(), memory=1,
    )  # fmt: skip
    plant = Plant(model, {}, dt=5.0, units={"q": "1", "t": "degC"})
    near = linearise_plant(plant, inputs={"q": 2.0}, dt=5.0)
    t = float(near.y[0])
    assert 0.5 + 0.97 * t + 0.4 - 1e-4 * t**2 == pytest.approx(t, abs=1e-6)
    np.testing.assert_allclose(near.A, [[0.97 - 2e-4 * t]], rtol=1e-6)
    x_next, _ = plant.to_casadi()([30.0], [2.0], [], [])
    assert float(x_next) == pytest.approx(0.5 + 0.97 * 30 + 0.4 - 0.09, abs=1e-9)


def test_a_missing_library_is_one_line_with_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    hint = r"is not installed; pip install 'thermogrip\[control\]', or pip install control$"
    with pytest.raises(UserError, match=hint):
        PLANTS["tclab"].to_control()


class Tanks:
    """Two tanks in a row: level of the second from the pump's voltage."""

    inputs = {"pump": "V"}  # noqa: RUF012
    outputs = {"level": {"unit": "V", "sd": 0.05}}  # noqa: RUF012
    states = {"upper": 0.1, "lower": 0.1}  # noqa: RUF012
    parameters = {  # noqa: RUF012
        "inflow": {"value": 0.05, "sd_log": 0.2, "unit": "1/s"},
        "outflow": {"value": 0.05, "sd_log": 0.2, "unit": "V^0.5/s"},
    }
    dt = 4.0

    def rhs(self, x, u, d, p):
        upper, lower = (p.outflow * np.sqrt(np.maximum(level, 0.0)) for level in x)
        return [p.inflow * u.pump - upper, upper - lower]

    def output(self, x, p):
        return [x.lower]


def test_a_class_of_ones_own_is_exported_too():
    plant = replace(prior_plant(own_model(Tanks)), valid={"pump": (1.0, 5.0)})
    near = linearise_plant(plant, inputs={"pump": 3.0})
    # at rest sqrt(x) = inflow u / outflow = 3, so d rhs/dx = outflow / (2 * 3) and dx/du = 2 * 3
    np.testing.assert_allclose(near.x, [9.0, 9.0], rtol=1e-6)
    np.testing.assert_allclose(near.gain(), [[6.0]], rtol=1e-5)
    np.testing.assert_allclose(near.A, [[-0.05 / 6, 0.0], [0.05 / 6, -0.05 / 6]], atol=1e-8)
    x_next, y = plant.to_casadi()([4.0, 2.0], [3.0], [], plant.p)
    _, end = plant.model.rollout([[4.0, 2.0]], [[[3.0]]], np.zeros((1, 1, 0)), plant.p[None], 4.0)
    np.testing.assert_allclose(np.array(x_next).ravel(), end[0], rtol=1e-9)
    assert float(y) == 2.0
