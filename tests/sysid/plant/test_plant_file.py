"""A plant as plain JSON: whole, with units and covariance, and refused where it is not."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import PlantScores
from thermogrip.sysid.plant.plant import Plant


def _plants() -> list[Plant]:
    fitted = plant_from_prior(load_network("gripper"))
    middle = np.array([fitted.values[name] for name in fitted.free])
    samples = middle * (1 + 0.05 * np.random.default_rng(0).uniform(-1, 1, (7, middle.size)))
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=10.0)
    black = Plant(block, {}, dt=10.0, units={"q": "1", "t": "degC"}, valid={"q": (-np.inf, 1.0)})
    return [
        fitted,
        replace(fitted, samples=samples, scores=PlantScores(per_log={"a": {"bias": (0.5, 0.1)}})),
        black,
    ]


@pytest.mark.parametrize("plant", _plants(), ids=["priors", "sampled", "black box"])
def test_a_plant_survives_json_as_text(plant):
    back = Plant.from_dict(json.loads(json.dumps(plant.to_dict(), allow_nan=False)))
    for name in ("values", "dt", "units", "free", "scales", "bounds", "noise", "nuisance", "valid", "logs"):
        assert getattr(back, name) == getattr(plant, name)
    for name in ("covariance", "samples"):
        first, second = getattr(plant, name), getattr(back, name)
        assert (first is None) == (second is None)
        if first is not None:
            np.testing.assert_array_equal(first, second)
    assert back.draw(0).values == plant.values
    assert back.to_dict() == plant.to_dict()


def test_units_and_covariance_stand_in_the_text_by_name():
    content = _plants()[0].to_dict()
    at = content["free"].index("seebeck")
    assert content["units"]["seebeck"] == "V/K"
    assert content["scales"]["seebeck"] == "log"
    assert content["covariance"][at][at] == pytest.approx(1.4**2)


def test_the_file_and_the_dictionary_are_the_same_plant(tmp_path):
    plant = _plants()[1]
    assert Plant.load(plant.save(tmp_path / "p.json")).to_dict() == plant.to_dict()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"schema": "thermogrip.controller"}, "schema is 'thermogrip.controller'"),
        ({"version": 99}, "version 99"),
        ({"model": {"kind": "pickle"}}, "kind 'pickle' is unknown"),
        ({"values": {"seebeck": float("nan")}}, "seebeck is nan"),
        ({"covariance": [[1.0]]}, "covariance is"),
        ({"draws": [[1.0]]}, "samples are"),
    ],
)
def test_what_is_not_a_plant_is_refused_in_one_line(change, says):
    with pytest.raises(UserError, match=says) as refused:
        Plant.from_dict(_plants()[0].to_dict() | change)
    assert "\n" not in str(refused.value)
