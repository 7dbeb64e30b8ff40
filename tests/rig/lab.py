"""A small plant with a TCLab's inputs and outputs, for tests that shall not wait for a network to compile."""

from __future__ import annotations

import numpy as np

from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def make_lab() -> Plant:
    """Return two heaters of 0.15 K/s at full power and 200 s, that warm each other a little."""
    a = np.array([[1 - 1 / 200, 0.0005], [0.0005, 1 - 1 / 200]])
    room = 1 - a.sum(axis=1, keepdims=True)
    model = StateSpaceModel(
        ("q1", "q2"), ("t_ambient",), ("t1", "t2"), A=a, B=np.eye(2) * 0.0015, E=room, C=np.eye(2), dt=1.0
    )
    units = {"q1": "percent", "q2": "percent", "t_ambient": "degC", "t1": "degC", "t2": "degC"}
    return Plant(model, {}, dt=1.0, units=units)
