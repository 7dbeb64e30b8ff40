"""A plant is a file and a distribution: what is saved comes back, and draws follow what was stated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.fit_record import PlantScores
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture(scope="module")
def plant() -> Plant:
    start = prior_plant(load_network("tclab"))
    rng = np.random.default_rng(0)
    root = 0.1 * rng.standard_normal((len(start.free), len(start.free)))
    return replace(
        start,
        covariance=root @ root.T,
        valid={"q1": (0.0, 80.0)},
        logs=("a", "b"),
        scores=PlantScores(cost=1.5),
        bounds=start.bounds | {"t_room": (-np.inf, 45.0)},
    )


def same(a: Plant, b: Plant) -> None:
    for name in ("values", "units", "free", "scales", "bounds", "noise", "offsets", "nuisance", "reference",
                 "valid", "logs", "scores", "verdict", "dt"):  # fmt: skip
        assert getattr(a, name) == getattr(b, name), name
    np.testing.assert_array_equal(a.p, b.p)
    assert a.model.to_dict() == b.model.to_dict()


def test_a_saved_plant_comes_back_whole(plant: Plant, tmp_path: Path):
    path = plant.save(tmp_path / "plant.json")
    again = Plant.load(path)
    same(plant, again)
    np.testing.assert_array_equal(plant.covariance, again.covariance)
    assert again.samples is None
    assert json.loads(path.read_text())["schema"] == "thermogrip.plant"


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
        lambda c: c.update(covariance=[[1.0]]),
        lambda c: c["model"].update(kind="os.system"),
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
