"""A small plant that every test can afford: a driven tank, and a skin that follows it while the pump runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.end_to_end.conftest import small_plant
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.sysid.plant.plant import Plant

HEAT, TANK_S, SKIN_S, AIR_S = 0.4, 300.0, 15.0, 2000.0  # K/s at full drive; time constants


def make_plant() -> Plant:
    """Return the small plant of the command line's tests, which knows neither its noise nor its logs."""
    return replace(small_plant(), noise={}, valid={}, logs=())


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
