"""A plant is a file and a distribution: what is saved comes back whole, and draws follow what was stated."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import FitLog, PlantScores, check_plant_file


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
    scores = PlantScores(average_s=1.5, weight_s={"a": 0.5})
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
        ({"values": {"seebeck": float("nan")}}, r"values\.seebeck: Input should be .*, not nan"),
        ({"covariance": [[1.0]]}, "covariance is"),
        ({"draws": [[1.0]]}, "samples are"),
        ({"noise": {"t": -1e-9}}, r"noise\.t: .*, not -1e-09"),
        ({"noise": {"t": 1.01e6}}, r"noise\.t: .* to 1000000, not 1010000"),
        ({"nuisance": {"t": -1e-9}}, r"nuisance\.t: .*, not -1e-09"),
        ({"nuisance": {"t": 1.01e6}}, r"nuisance\.t: .*, not 1010000"),
        ({"offsets": {"t": -1.01e6}}, r"offsets\.t: .*, not -1010000"),
        ({"offsets": {"t": 1.01e6}}, r"offsets\.t: .*, not 1010000"),
        ({"valid": {"t": [2.0, 1.0]}}, r"valid\.t: is 2 to 1"),
        ({"valid": {"t": [-1.1e9, 1.0]}}, r"valid\.t: is -1.1e\+09 to 1"),
        ({"covariance": [[1.0, 0.0], [0.0, -1e-12]]}, "covariance: has a negative variance"),
        ({"covariance": [1.0, 2.0]}, "covariance"),
        ({"scores": {"held_out": [{"log": "a"}]}}, r"scores\.held_out\.0\.output: Field required"),
        ({"scores": {"identifiability": {"told": True}}}, r"scores\.identifiability\.condition: "),
        ({"scores": {"average_s": "long"}}, r"scores\.average_s: .*, not 'long'"),
        ({"free": ["zz"], "covariance": None}, "the model has no parameter zz"),
        ({"fitted_to": [{"name": "a", "sha256": "0"}]}, r"fitted_to\.0\.start_s: Field required"),
        ({"offset_memory": 0.0}, r"offset_memory: .*, not 0\.0"),
    ],
)
def test_what_is_not_a_plant_is_refused_in_one_line(change, says):
    with pytest.raises(UserError, match=says) as refused:
        Plant.from_dict(_plants()[0].to_dict() | change)
    assert "\n" not in str(refused.value)


def test_the_ends_of_what_a_plant_may_hold_are_held(tmp_path: Path):
    bare = _plants()[2]
    edge = {"noise": {"t": 1e6}, "offsets": {"t": -1e6}, "nuisance": {"t": 0.0}}
    edge |= {"valid": {"t": [3.0, 3.0], "q": [-1e9, None]}}
    back = Plant.from_dict(bare.to_dict() | edge)
    assert (back.noise, back.offsets, back.nuisance) == ({"t": 1e6}, {"t": -1e6}, {"t": 0.0})
    assert back.valid == {"t": (3.0, 3.0), "q": (-1e9, np.inf)}
    assert "offset_memory" not in bare.to_dict()
    log = FitLog("a", "0" * 64, -3.0, 7.5)
    more = replace(
        bare, refits=(bare.model, bare.model), inputs_end_at_row=True, fitted_to=(log,), offset_memory=7.5
    )
    again = Plant.load(more.save(tmp_path / "plant.json"))
    assert (len(again.refits), again.inputs_end_at_row, again.fitted_to) == (2, True, (log,))
    bare = Plant.from_dict(bare.to_dict())
    assert (again.offset_memory, bare.offset_memory, bare.inputs_end_at_row) == (7.5, np.inf, False)
    with pytest.raises(ValueError, match=f"no value for {_plants()[0].model.parameters[0]}"):
        replace(_plants()[0], values={})


def test_the_plant_within_another_file_is_looked_through(tmp_path: Path):
    path = tmp_path / "some.json"
    content = {"schema": "thermogrip.controller", "version": 1, "plant": _plants()[0].to_dict()}
    for change, says in (
        ({}, ""),
        ({"plant": None}, r"some\.json: plant is missing; write the file again"),
        ({"plant": content["plant"] | {"dt": -1.0}}, r"some\.json: .*dt: .*, not -1\.0"),
    ):
        path.write_text(json.dumps(content | change))
        if says:
            with pytest.raises(UserError, match=says):
                check_plant_file(path, inside="thermogrip.controller")
        else:
            assert check_plant_file(path, inside="thermogrip.controller") == content


def test_draws_are_thinned_evenly_and_as_many_as_64_stand_in_the_file(plant: Plant, tmp_path: Path):
    samples = np.arange(65.0)[:, None] + np.ones(len(plant.free))
    kept = [row[0] for row in replace(plant, samples=samples[:7]).to_dict(draws=3)["draws"]]
    assert kept == [1.0, 4.0, 7.0]
    assert len(replace(plant, samples=samples[:7]).to_dict(draws=9)["draws"]) == 7
    assert len(replace(plant, samples=samples[:7]).to_dict()["draws"]) == 7
    for n, files in ((64, ["p.json"]), (65, ["p.json", "p.nc"])):
        replace(plant, samples=samples[:n]).save(tmp_path / "p.json")
        assert sorted(path.name for path in tmp_path.iterdir()) == files
    with xr.open_dataset(tmp_path / "p.nc", engine="h5netcdf") as record:
        said = dict(zip(record["parameter"].values.tolist(), record["units"].values.tolist()))
    assert said == {name: plant.units.get(name, "1") for name in plant.free}
    samples[3, 1] = np.nan
    replace(plant, samples=samples).save(tmp_path / "p.json")
    with pytest.raises(UserError, match=r"p\.nc: are no samples of the plant \(a sample is not finite\)"):
        Plant.load(tmp_path / "p.json")
    (tmp_path / "p.nc").write_bytes(b"no samples")
    with pytest.raises(UserError, match=r"p\.nc: "):
        Plant.load(tmp_path / "p.json")


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


def test_draws_are_rows_of_samples_or_refits_at_multiples_of_the_golden_ratio(plant: Plant):
    """0.618, 0.236 and 0.854 of the way along."""
    sampled = replace(plant, samples=np.tile(np.arange(1.0, 101.0)[:, None], (1, len(plant.free))))
    assert [sampled.draw(k).values["G_amb"] for k in (1, 2, 3)] == [62.0, 24.0, 86.0]
    held = next(name for name in plant.model.parameters if name not in plant.free)
    assert sampled.draw(1).values[held] == plant.values[held]
    bare = replace(sampled, covariance=None)
    first = bare.intervals(0.8)["G_amb"]
    assert first == pytest.approx((10.9, 90.1))  # of 1 to 100
    refits = tuple(load_network("tclab") for _ in range(10))
    again = replace(sampled, refits=refits)
    assert [refits.index(again.draw(k).model) for k in (1, 2, 3)] == [6, 2, 8]
    assert [p.uncertain for p in (bare, replace(again, samples=None, covariance=None), plant)] == [True] * 3
    with pytest.raises(UserError, match="draw -1 is negative"):
        plant.draw(-1)


def test_draws_and_intervals_stay_inside_the_bounds(plant: Plant):
    name = next(n for n in plant.free if plant.scales[n] == "linear")
    at, middle = plant.free.index(name), plant.values[name]
    wide = np.diag(np.full(len(plant.free), 4.0))
    open_ended = replace(plant, covariance=wide, bounds={})
    assert open_ended.intervals(0.9)[name] == pytest.approx((middle - 3.28971, middle + 3.28971))
    kept = replace(open_ended, bounds={name: (middle - 0.5, middle + 1.5)})
    assert kept.intervals(0.9)[name] == (middle - 0.5, middle + 1.5)
    drawn = [kept.draw(k).values[name] for k in range(1, 40)]
    assert (min(drawn), max(drawn)) == (middle - 0.5, middle + 1.5)
    assert open_ended.theta[at] == middle
    with pytest.raises(ValueError, match=r"level must lie between 0 and 1, got 0"):
        plant.intervals(0.0)


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
