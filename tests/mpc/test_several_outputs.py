"""Several outputs and drives, closed on plants that share no code with the package."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.controllers.lqr import LQRController
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import default_design
from thermogrip.sysid.plant.plant import Plant

from .truths import furnace, linear_model

CONTROLLED = ("t2", "t5")


@pytest.fixture(scope="module")
def furnace_plant() -> Plant:
    truth = furnace()
    return linear_model(truth, truth.x, np.zeros(2), dt=10.0)


def test_a_single_number_is_the_target_of_every_controlled_output(furnace_plant):
    design = default_design(furnace_plant, controlled=CONTROLLED)
    controllers = [
        Controller(furnace_plant, design),
        LQRController(furnace_plant, design),
        PIController(furnace_plant, dt=10.0, controlled=CONTROLLED),
    ]
    reading = furnace().reading()
    for controller in controllers:
        moves = []
        for target in (26.0, dict.fromkeys(CONTROLLED, 26.0)):
            controller.reset(reading)
            moves.append(controller.step(reading, target))
        assert [(move.status, move.advice) for move in moves] == [("ok", "")] * 2
        assert moves[0].drive == moves[1].drive
