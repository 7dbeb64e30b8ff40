"""Rigs of one kind: against exact formulas, known populations, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.sysid.greybox.makers import BOARD, N_FREE, OFF, OWN, SPREAD, WIDTH, fits, plant_at
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox import population as kernel
from thermogrip.sysid.greybox.population import Population, check_population, pool_rigs, pooled_plant
from thermogrip.sysid.models.network import load_network


def standard(theta):
    own = slice(None) if np.shape(theta)[-1] == N_FREE else OWN
    return (theta - BOARD.theta[own]) / WIDTH[own]


def test_a_known_population_is_found_and_its_intervals_cover_new_rigs():
    rng, inside, spreads, errors = np.random.default_rng(0), [], [], []
    for _ in range(20):
        z, plants = fits(12, rng)
        found, rigs = pool_rigs(plants)
        spreads.append(np.array(found.spread) / WIDTH[OWN])
        half = kernel.t_law.ppf(0.95, 11) * found.sd / WIDTH[OWN]
        new = (OFF + SPREAD * rng.normal(size=(100, N_FREE)))[:, OWN]
        inside.append(np.abs(new - standard(np.array(found.mean))) < half)
        alone = [standard(plant.theta) for plant in plants.values()]
        errors.append([np.square(alone - z), np.square([standard(rig.pooled) for rig in rigs] - z)])
    assert 0.87 < np.mean(inside) < 0.95
    np.testing.assert_allclose(np.mean(spreads, axis=0), SPREAD[OWN], rtol=0.35)
    alone, pooled = np.mean(errors, axis=(0, 2, 3))
    assert pooled < 0.8 * alone


def test_rigs_that_are_known_exactly_have_their_own_values_and_spread():
    z = np.random.default_rng(1).normal(size=(9, N_FREE)) * SPREAD
    found, rigs = pool_rigs({f"r{i}": plant_at(row, 1e-8 * np.eye(N_FREE)) for i, row in enumerate(z)})
    # N - 1 of the prior on the spread, and one more that the mean takes
    want = np.square(z - z.mean(axis=0)).sum(axis=0)[OWN] / 7
    np.testing.assert_allclose((np.array(found.spread) / WIDTH[OWN]) ** 2, want, rtol=0.02)
    np.testing.assert_allclose([standard(rig.pooled) for rig in rigs], z, atol=1e-5)


def test_given_the_spread_mean_and_rigs_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(5, 3, 3)) + 2 * np.eye(3)
    precision, m, T = roots @ roots.transpose(0, 2, 1), rng.normal(size=(5, 3)), np.array([0.3, 1.0, 0.1])
    found = kernel._given(kernel.Told(precision, np.einsum("nij,nj->ni", precision, m)), T)
    weights = np.linalg.inv(np.linalg.inv(precision) + np.diag(T))
    unsure = np.linalg.inv(np.eye(3) + weights.sum(axis=0))
    mean = unsure @ np.einsum("nij,nj->i", weights, m)
    np.testing.assert_allclose(found.unsure, unsure)
    np.testing.assert_allclose(found.mean, mean)
    shrunk = mean + np.einsum("ij,njk,nk->ni", np.diag(T), weights, m - mean)
    np.testing.assert_allclose(found.rigs, shrunk)


def test_a_rig_whose_log_says_nothing_is_as_the_others():
    _, plants = fits(10, np.random.default_rng(3))
    found, rigs = pool_rigs(plants | {"silent": plant_at(np.zeros(N_FREE), np.eye(N_FREE))})
    silent = rigs[-1]
    np.testing.assert_allclose(silent.pooled[OWN], found.mean, rtol=1e-6)
    assert (silent.distance, silent.ill) == (1.0, False)
    assert (np.sqrt(np.diag(silent.covariance))[OWN] >= found.spread).all()


@pytest.mark.parametrize("off", [0.0, 2.0])
def test_a_rig_with_one_parameter_far_off_is_ill_and_the_others_are_not(off):
    _, plants = fits(15, np.random.default_rng(4))
    one = plants["r3"]
    plants["r3"] = replace(one, values=one.values | {"G_amb": one.values["G_amb"] * np.exp(off * WIDTH[0])})
    _, rigs = pool_rigs(plants)
    assert [rig.name for rig in rigs if rig.ill] == (["r3"] if off else [])
    assert np.abs(rigs[3].deviation).argmax() == 0 or not off


def test_the_population_is_of_the_healthy_and_an_ill_rig_keeps_what_its_own_logs_say():
    _, plants = fits(12, np.random.default_rng(10))
    one = plants["r3"]
    off = replace(one, values=one.values | {"G_amb": one.values["G_amb"] * np.exp(3 * WIDTH[0])})
    found, rigs = pool_rigs(plants | {"r3": off})
    healthy, _ = pool_rigs({name: plant for name, plant in plants.items() if name != "r3"})
    assert (rigs[3].ill, found.rigs) == (True, healthy.rigs)
    np.testing.assert_allclose(found.spread, healthy.spread, rtol=1e-2)
    np.testing.assert_allclose(rigs[3].pooled, off.theta)
    np.testing.assert_allclose(rigs[3].covariance, off.covariance)
    three = {f"r{i}": plant_at(np.zeros(N_FREE) + 1e-4 * i**2, 1e-9 * np.eye(N_FREE)) for i in range(4)}
    found, rigs = pool_rigs(
        dict(list(three.items())[:2]) | {"odd": plant_at(np.ones(N_FREE), three["r0"].covariance)}
    )
    assert len(found.rigs) == 3  # two make no population


def test_a_warm_room_makes_no_rig_ill_and_no_rig_is_drawn_to_the_others_room():
    rng, sure = np.random.default_rng(11), 1e-3 * np.eye(N_FREE)
    sure[0, ~OWN] = sure[~OWN, 0] = 0.9e-3  # what a log says of the room says something of the loss
    plants = {f"r{i}": plant_at(0.1 * rng.normal(size=N_FREE) * OWN, sure) for i in range(10)}
    cold, _ = pool_rigs(plants)
    in_sun = replace(plants["r4"], values=plants["r4"].values | {"t_room": 32.0})
    warm, rigs = pool_rigs(plants | {"r4": in_sun})
    assert not any(rig.ill for rig in rigs)
    assert "t_room" not in warm.parameters
    assert pooled_plant(in_sun, rigs[4]).values["t_room"] == pytest.approx(32.0, abs=0.1)
    np.testing.assert_allclose(warm.mean, cold.mean, atol=0.02)
    model = load_network("tclab")
    assert warm.prior_of(model).specs["t_room"] == model.specs["t_room"]
    # a file of before still has it
    old = replace(
        warm, parameters=(*warm.parameters, "t_room"), scales=(*warm.scales, "linear"),
        mean=(*warm.mean, 30.0), spread=(*warm.spread, 0.1), mean_sd=(*warm.mean_sd, 0.1),
    )  # fmt: skip
    assert old.prior_of(model).specs["t_room"] == model.specs["t_room"]


def test_healthy_fleets_raise_few_alarms():
    rng = np.random.default_rng(5)
    alarms = sum(rig.ill for _ in range(15) for rig in pool_rigs(fits(8, rng)[1])[1])
    assert alarms <= 2


def test_the_pooled_plant_has_the_pooled_numbers():
    _, plants = fits(5, np.random.default_rng(6))
    _, rigs = pool_rigs(plants)
    plant = pooled_plant(plants["r2"], rigs[2])
    np.testing.assert_allclose(plant.theta, rigs[2].pooled)
    assert (np.diag(plant.covariance) < np.diag(plants["r2"].covariance)).all()


def test_the_file_and_the_prior_are_the_population(tmp_path):
    found, _ = pool_rigs(fits(6, np.random.default_rng(7))[1])
    path = found.save(tmp_path / "population.json")
    assert Population.load(path) == found
    check_population(path)
    model = found.prior_of(load_network("tclab"))
    for name, theta, sd in zip(found.parameters, found.mean, found.sd):
        spec = model.specs[name]
        log = spec.scale == "log"
        assert spec.value == pytest.approx(np.exp(theta) if log else theta)
        # the variance of Student's t with five degrees of freedom
        assert (spec.sd_log if log else spec.sd) == pytest.approx(sd * np.sqrt(5 / 3))
    assert model.specs["C_heater"] == BOARD.model.specs["C_heater"]
    with pytest.raises(UserError, match="'room' differs in"):
        found.prior_of(load_network("room"))


@pytest.mark.parametrize(
    "broken",
    [
        {"mean": [1.0]},
        {"spread": [-1.0] * N_FREE},
        {"rigs": ["a"]},
        {"scales": ["x"] * N_FREE},
        {"mean": None},
    ],
)
def test_a_broken_file_is_refused(tmp_path, broken):
    path = pool_rigs(fits(6, np.random.default_rng(8))[1])[0].save(tmp_path / "population.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | broken))
    with pytest.raises(UserError, match="no whole population"):
        Population.load(path)


def test_rigs_that_make_no_population_are_refused():
    plants = fits(3, np.random.default_rng(9))[1]
    with pytest.raises(UserError, match="2 rigs"):
        pool_rigs(dict(list(plants.items())[:2]))
    with pytest.raises(UserError, match="rig r1"):
        pool_rigs(plants | {"r1": replace(plants["r1"], covariance=None)})
