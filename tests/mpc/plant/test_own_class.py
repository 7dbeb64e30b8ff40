"""Control of classes whose equations have roots: a tank that runs empty, a plate in still air."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest

from tests.mpc.makers import GCC
from thermogrip.datasets.arrays import Array
from thermogrip.mpc.controllers.export import check_export, export_controller
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.models.user_model import own_model
from thermogrip.sysid.plant.plant import Plant


class Tank:
    """A tank with a hole, whose level is read in volts."""

    inputs: ClassVar[dict[str, Any]] = {"pump": "V"}
    outputs: ClassVar[dict[str, Any]] = {"level": "V"}
    states: ClassVar[dict[str, float]] = {"height": 0.5}
    parameters: ClassVar[dict[str, float]] = {"gain": 0.05, "drain": 0.15}
    dt = 4.0

    def output(self, x: Any, p: Any) -> list[Any]:
        """Return what the sensor reads."""
        return [2.0 * x.height]

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        """Return what flows in less what flows out."""
        return [p.gain * u.pump - p.drain * np.sqrt(np.maximum(x.height, 0))]


class TwoTanks(Tank):
    """The first drains into the second."""

    states: ClassVar[dict[str, float]] = {"upper": 0.5, "height": 0.5}
    limits: ClassVar[dict[str, Any]] = {"upper": (None, 9.0)}

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        """Return what flows in less what flows out."""
        through, out = (p.drain * np.maximum(height, 0) ** 0.5 for height in (x.upper, x.height))
        return [p.gain * u.pump - through, through - out]


class Plate:
    """A heater whose air rises: the loss goes with the difference to the power of 5/4."""

    inputs: ClassVar[dict[str, Any]] = {"heater": "percent"}
    outputs: ClassVar[dict[str, Any]] = {"t": "degC"}
    disturbances: ClassVar[dict[str, Any]] = {"t_ambient": "degC"}
    states: ClassVar[dict[str, float]] = {"t": 20.0}
    parameters: ClassVar[dict[str, float]] = {"power": 60.0, "loss": 0.25}
    dt = 5.0

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        """Return the heat over the capacity."""
        warmer = x.t - d.t_ambient
        return [(p.power * u.heater / 100 - p.loss * np.abs(warmer) ** 0.25 * warmer) / 500.0]


def plant_of(kind: type, **valid: tuple[float, float]) -> Plant:
    model = own_model(kind)
    values = dict(zip(model.parameters, model.prior.tolist(), strict=True))
    noise = dict.fromkeys(model.outputs, 0.02)
    return Plant(model, values, dt=model.dt, units=model.units, valid=valid, noise=noise)


TANK = {"pump": (0.0, 9.0), "level": (0.0, 14.0)}
PLATE = {"heater": (0.0, 100.0), "t": (20.0, 140.0), "t_ambient": (20.0, 25.0)}
PLANTS = [(Tank, TANK), (TwoTanks, TANK), (Plate, PLATE)]


def differences(model: PredictionModel, x: Array, u: Array, d: Array) -> Array:
    """Return the derivative of a sample by its state, by differences."""
    ahead = 1e-5 * np.eye(model.n_x)
    return np.array([model.next_state(x + e, u, d) - model.next_state(x - e, u, d) for e in ahead]).T / 2e-5


@pytest.mark.parametrize(("kind", "valid"), PLANTS)
def test_a_sample_has_its_derivative_and_where_a_slope_is_infinite_one_that_dies_out(kind, valid):
    model = PredictionModel(plant_of(kind, **valid))
    full, room = 0.5 * model.highest, np.full(model.n_d, 25.0)
    for level in (26.5, 80.0) if kind is Plate else (0.8, 3.0):
        x = level - 0.2 * np.arange(model.n_x)
        near = model.linearise(x, full, room)
        np.testing.assert_allclose(near.A, differences(model, x, full, room), rtol=1e-6, atol=1e-8)
    for level in (25.0,) if kind is Plate else (-0.02, 0.0, 1e-6, 0.002, 0.02):
        for u in (0.0 * full, full):
            near = model.linearise(np.full(model.n_x, level), u, room)
            assert np.all(np.abs(np.linalg.eigvals(near.A)) <= 1.0)
            assert np.isfinite(near.B).all()


@pytest.mark.parametrize(("kind", "valid"), PLANTS)
def test_a_controller_goes_from_empty_to_its_target_and_back(kind, valid):
    plant = plant_of(kind, **valid)
    controller, model = Controller(plant, default_design(plant)), plant.model
    start, there, back = (25.0, 60.0, 30.0) if kind is Plate else (0.0, 6.0, 0.4)
    x, room = np.full((1, model.n_x), start / (1.0 if kind is Plate else 2.0)), np.full((1, 1, 1), 25.0)
    reading = {model.outputs[0]: start} | dict.fromkeys(model.disturbances, 25.0)
    controller.reset(reading)
    missed = []
    for k in range(360):
        target = back if k // 120 == 1 else there
        move = controller.step(reading, target)
        assert move.status == "ok"
        u = np.full((1, 1, 1), move.drive)
        y, x = model.rollout(x, u, room[..., : len(model.disturbances)], plant.p[None], model.dt)
        reading[model.outputs[0]] = float(y[0, -1, 0])
        missed.append(abs(y[0, -1, 0] - target) / (there - start))
    # the last step has no empty tank behind it and takes no longer
    assert np.mean(missed[240:]) < 1.1 * np.mean(missed[:120])
    assert max(missed[-10:]) < 0.01


@GCC
@pytest.mark.parametrize(("kind", "valid"), PLANTS)
def test_its_export_does_the_same(kind, valid, tmp_path):
    plant = plant_of(kind, **valid)
    controller = Controller(plant, default_design(plant))
    found = check_export(export_controller(controller, tmp_path), controller, states=600, sanitize=False)
    assert (found.same_status, found.passed) == (600, True), found
