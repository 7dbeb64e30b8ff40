"""A small plant that every test can afford: a driven tank, and a skin that follows it while the pump runs."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

DT = 0.5
HEAT, TANK_S, SKIN_S, AIR_S = 0.4, 300.0, 15.0, 2000.0  # K/s at full drive; time constants


def make_plant() -> Plant:
    """Return the plant: dT_tank = 0.4 u - (T_tank - T_amb)/300, dT_skin = pump (T_tank - T_skin)/15 - ..."""
    a = np.array([[1 - DT / TANK_S, 0.0], [0.0, 1 - DT / AIR_S]])
    couple = np.array([[0.0, 0.0], [DT / SKIN_S, -DT / SKIN_S]])
    model = StateSpaceModel(
        ("drive", "pump"),
        ("t_ambient",),
        ("t_tank", "t_surface"),
        A=a,
        B=np.array([[DT * HEAT, 0.0], [0.0, 0.0]]),
        E=np.array([[DT / TANK_S], [DT / AIR_S]]),
        C=np.eye(2),
        dt=DT,
        switches=("pump",),
        A_switch={"pump": couple},
    )
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_tank": "degC", "t_surface": "degC"}
    return Plant(model, {}, dt=DT, units=units)


class Proportional:
    """The simplest controller that settles: proportional on the tank's error plus the known loss."""

    def __init__(self, gain: float = 0.2, dt: float = 1.0) -> None:
        self.gain, self.dt = gain, dt
        self.resets: list[dict[str, float]] = []
        self.seen: list[dict[str, float]] = []

    def reset(self, reading: Readings) -> None:
        self.resets.append(dict(reading))

    def step(self, reading: Readings, target: Target) -> Move:
        assert isinstance(target, float)
        self.seen.append(dict(reading))
        goal = target + (target - reading["t_ambient"]) * SKIN_S / AIR_S  # the skin hangs below the tank
        hold = (goal - reading["t_ambient"]) / (HEAT * TANK_S)
        return Move(drive=float(np.clip(hold + self.gain * (goal - reading["t_tank"]), -1.0, 1.0)))


@pytest.fixture(scope="session")
def plant() -> Plant:
    return make_plant()


@pytest.fixture
def controller() -> Proportional:
    return Proportional()
