"""A heated block whose answer to a step is known in closed form."""

from __future__ import annotations

from tests.sysid.greybox.makers import heater
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.plant.plant import Plant

C, G, POWER, SD, EVERY = 50.0, 0.2, 4.0, 0.1, 60.0  # J/K, W/K, W, degC, s


def heated_block() -> Plant:
    """A heated block of which only the power is unknown: y = (P u / G) (1 - exp(-t G / C)) + room."""
    content = heater().to_dict()["network"]
    content["inputs"]["q"] = {"unit": "percent", "range": [0.0, 100.0]}
    content["outputs"]["t"] = {"node": "block", "sd": SD, "reference": True}
    content["parameters"] = {
        "C": {"unit": "J/K", "value": C, "fixed": True},
        "G": {"unit": "W/K", "value": G, "fixed": True},
        "P": {"unit": "W", "value": POWER, "sd_log": 1.0},
    }
    return plant_from_prior(NetworkModel(network_from_dict(content)))
