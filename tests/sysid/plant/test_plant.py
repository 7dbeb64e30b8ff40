"""A plant is a file and a distribution: what is saved comes back whole, and draws follow what was stated."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import PlantScores
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture(scope="module")
def plant() -> Plant:
    start = prior_plant(load_network("tclab"))
    rng = np.random.default_rng(0)
    root = 0.1 * rng.standard_normal((len(start.free), len(start.free)))
    return replace(start, covariance=root @ root.T)


def _plants() -> list[Plant]:
    fitted = plant_from_prior(load_network("gripper"))
    fitted = replace(fitted, bounds=fitted.bounds | {"t_room": (-np.inf, 45.0)}, logs=("a", "b"))
    middle = np.array([fitted.values[name] for name in fitted.free])
    samples = middle * (1 + 0.05 * np.random.default_rng(0).uniform(-1, 1, (7, middle.size)))
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=10.0)
    black = Plant(block, {}, dt=10.0, units={"q": "1", "t": "degC"}, valid={"q": (-np.inf, 1.0)})
    scores = PlantScores(cost=1.5, per_log={"a": {"bias": (0.5, 0.1)}})
    return [fitted, replace(fitted, samples=samples, scores=scores, verdict="good"), black]


@pytest.mark.parametrize("plant", _plants(), ids=["priors", "sampled", "black box"])
def test_a_plant_survives_json_as_text_and_as_a_file(plant: Plant, tmp_path: Path):
    content = json.loads(json.dumps(plant.to_dict(), allow_nan=False))
    for back in (Plant.from_dict(content), Plant.load(plant.save(tmp_path / "plant.json"))):
        for field in fields(Plant):
            if field.name not in ("model", "covariance", "samples"):
                assert getattr(back, field.name) == getattr(plant, field.name), field.name
        for name in ("covariance", "samples"):
            first, second = getattr(plant, name), getattr(back, name)
            assert (first is None) == (second is None)
            if first is not None:
                np.testing.assert_array_equal(first, second)
        assert back.to_dict() == plant.to_dict()


def test_units_and_covariance_stand_in_the_text_by_name():
    content = _plants()[0].to_dict()
    at = content["free"].index("seebeck")
    assert content["units"]["seebeck"] == "V/K"
    assert content["scales"]["seebeck"] == "log"
    assert content["covariance"][at][at] == pytest.approx(1.4**2)


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


def test_samples_stand_beside_the_plant_and_move_with_it(plant: Plant, tmp_path: Path):
    samples = np.exp(np.random.default_rng(1).normal(size=(80, len(plant.free))))
    replace(plant, samples=samples).save(tmp_path / "plant.json")
    folder = tmp_path / "moved"
    folder.mkdir()
    for name in ("plant.json", "plant.nc"):
        (tmp_path / name).rename(folder / name)
    np.testing.assert_array_equal(Plant.load(folder / "plant.json").samples, samples)
    (folder / "plant.nc").unlink()
    with pytest.raises(UserError, match=r"plant\.json: its samples plant\.nc are missing"):
        Plant.load(folder / "plant.json")


def test_a_few_samples_stand_in_the_file_itself(plant: Plant, tmp_path: Path):
    samples = np.exp(np.random.default_rng(1).normal(size=(20, len(plant.free))))
    replace(plant, samples=samples).save(tmp_path / "plant.json")
    assert [path.name for path in tmp_path.iterdir()] == ["plant.json"]
    np.testing.assert_array_equal(Plant.load(tmp_path / "plant.json").samples, samples)
    content = json.loads((tmp_path / "plant.json").read_text())
    (tmp_path / "plant.json").write_text(json.dumps(content | {"draws": [["a"], 3]}))
    with pytest.raises(UserError, match=r"plant\.json: is not a whole plant"):
        Plant.load(tmp_path / "plant.json")


@pytest.mark.parametrize(
    "damage",
    [
        lambda c: c.pop("values"),
        lambda c: c["values"].pop("G_amb"),
        lambda c: c["values"].update(G_amb="warm"),
        lambda c: c["model"]["network"]["nodes"].update(x={"capacity": "C_heater"}),
        lambda c: c.update(model=7),
        lambda c: c.update(bounds={"G_amb": [1.0]}),
    ],
)
def test_a_damaged_plant_is_refused_in_one_line(plant: Plant, tmp_path: Path, damage):
    path = plant.save(tmp_path / "plant.json")
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"plant\.json: ") as caught:
        Plant.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "garbage", [b"", b"\x80\x04K\x01.", b"[1, 2]", b'{"schema": "thermogrip.controller"}']
)
def test_garbage_is_refused(tmp_path: Path, garbage: bytes):
    (tmp_path / "plant.json").write_bytes(garbage)
    with pytest.raises(UserError):
        Plant.load(tmp_path / "plant.json")


def test_laplace_draws_have_the_stated_covariance(plant: Plant):
    draws = [plant.draw(k) for k in range(1, 1500)]
    theta = np.array([[np.log(d.values[n]) if plant.scales[n] == "log" else d.values[n] for n in plant.free]
                      for d in draws])  # fmt: skip
    assert plant.covariance is not None
    # sd of a sample variance of n draws is var sqrt(2 / n): 5 sd
    np.testing.assert_allclose(np.var(theta, axis=0), np.diag(plant.covariance), rtol=5 * np.sqrt(2 / 1500))
    assert plant.draw(0) is plant
    assert plant.draw(3).values == plant.draw(3).values != plant.draw(4).values


def test_draws_from_samples_visit_the_chain_evenly(plant: Plant):
    samples = np.tile(np.arange(1.0, 101.0)[:, None], (1, len(plant.free)))
    sampled = replace(plant, samples=samples)
    rows = sorted(sampled.draw(k).values["G_amb"] for k in range(1, 51))
    assert np.max(np.diff(rows)) <= 6
    assert len(set(rows)) > 45


def test_an_interval_is_a_factor_for_a_positive_parameter(plant: Plant):
    assert plant.covariance is not None
    low, high = plant.intervals(0.9)["G_amb"]
    sd = np.sqrt(plant.covariance[plant.free.index("G_amb"), plant.free.index("G_amb")])
    assert low * high == pytest.approx(plant.values["G_amb"] ** 2)
    assert np.log(high / low) == pytest.approx(2 * 1.6448536 * sd)
    with pytest.raises(ValueError, match="level"):
        plant.intervals(1.0)


def test_a_plant_without_uncertainty_has_no_draws():
    bare = prior_plant(load_network("tclab"))
    assert bare.intervals() == {}
    with pytest.raises(UserError, match="no uncertainty"):
        bare.draw(1)
    with pytest.raises(ValueError, match="no parameter zz"):
        replace(bare, values=bare.values | {"zz": 1.0})
