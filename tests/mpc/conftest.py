"""Plants small enough to reason about: a heater block, and a tank whose water reaches a skin late."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def make_tank(
    *, heat: float = 0.11, joule: float = 0.0, loss: float = 1 / 700, skin: float = 12.0, delay: int = 8
) -> Plant:
    """Return a tank (heated by ``heat`` K/s at full drive), ``delay`` steps of 1 s of tube, a skin that lags.

    ``joule`` K/s grows with the square of the drive, so the gain turns over at drive = -heat / (2 joule).
    """
    a, s = float(np.exp(-loss)), float(np.exp(-1 / skin))
    n = 2 + delay
    A, B, E, F = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((n, 1))
    A[0, 0], A[1, 1], A[1, n - 1] = a, s, 0.98 * (1 - s)
    E[0, 0], E[1, 0] = 1 - a, 0.02 * (1 - s)
    A[2, 0] = 1.0
    for k in range(3, n):
        A[k, k - 1] = 1.0
    B[0, 0], F[0, 0] = heat, joule
    C = np.zeros((2, n))
    C[0, 0] = C[1, 1] = 1.0
    model = StateSpaceModel(
        ("drive", "pump"),
        ("t_ambient",),
        ("t_tank", "t_surface"),
        A=A,
        B=np.hstack([B, np.zeros((n, 1))]),
        C=C,
        dt=1.0,
        E=E,
        switches=("pump",),
        terms=("drive*drive",),
        F=F,
    )
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_tank": "degC", "t_surface": "degC"}
    valid = {"drive": (-1.0, 1.0), "t_tank": (5.0, 60.0), "t_surface": (8.0, 52.0)}
    noise = {"t_tank": 0.06, "t_surface": 0.06}
    return Plant(model, {}, dt=1.0, units=units, valid=valid, noise=noise, logs=("made up",))


@pytest.fixture(scope="session")
def tank() -> Plant:
    return make_tank()


@pytest.fixture(scope="session")
def other_tank() -> Plant:
    """The truth that is not the model: 9 % less power, more loss, a slower skin, a longer tube."""
    return make_tank(heat=0.1, loss=1 / 600, skin=13.5, delay=9)


@pytest.fixture(scope="session")
def weak_tank() -> Plant:
    """The tank with a third less power: a model that is plainly wrong."""
    return make_tank(heat=0.075, joule=0.012, loss=1 / 500)


@pytest.fixture(scope="session")
def reversing_tank() -> Plant:
    """A tank whose cooling turns into heating beyond drive = -0.55."""
    return make_tank(heat=0.11, joule=0.1)


@pytest.fixture(scope="session")
def tank_maker():
    """The function that makes tanks."""
    return make_tank
