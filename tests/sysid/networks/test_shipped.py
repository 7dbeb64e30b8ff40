"""Shipped networks: each is found again, with its gains, from a log of a plant that is not its prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.export.dynamics import plant_dynamics
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.network_spec import builtin_networks
from thermogrip.sysid.plant.linearise import linearise_plant
from thermogrip.sysid.validation.free_run import free_run

# rows, seconds between them, rows that an input is held, levels of each input, course of each disturbance
LOGS = {
    "room": (1500, 600.0, 24, {"heater": (0, 2000)}, {"solar": (350, 350), "t_outdoor": (8.0, 6.0)}),
    "hotend": (1600, 1.0, 100, {"heater": (10, 70)}, {}),
    "furnace": (2000, 20.0, 60, {"power": (10, 70)}, {}),
    "tank": (1500, 2.0, 75, {"heater": (0, 90), "valve": (0, 1)}, {"t_inlet": (14, 1), "t_ambient": (22, 1)}),
    "thermal_chamber": (2000, 10.0, 40, {"heater": (0, 100), "compressor": (0, 1)}, {"t_ambient": (22, 2)}),
}  # fmt: skip


def plant_and_log(name):
    """Return a plant a factor of up to 1.4 off the prior in every number, and a noisy log of it."""
    rng, prior = np.random.default_rng(7), plant_from_prior(load_network(name))
    values = {n: v * np.exp(rng.uniform(-0.35, 0.35)) for n, v in prior.values.items() if n in prior.free}
    plant = replace(prior, values=prior.values | values)
    n, step, held, levels, courses = LOGS[name]
    time = step * np.arange(n)
    signals = {}
    for input_, (low, high) in levels.items():
        level = rng.uniform(low, high, n // held + 1) if high > 1 else rng.integers(0, 2, n // held + 1)
        level[0] = 0.0  # from rest
        signals[input_] = (np.repeat(level, held)[:n].astype(float), plant.units[input_], "input")
    for number, (room, (mean, swing)) in enumerate(courses.items()):
        course = mean + swing * np.sin(time / time[-1] * (9 + 4 * number))
        signals[room] = (course, plant.units[room], "disturbance")
    cold = dict.fromkeys(levels, 0.0), {room: mean for room, (mean, _) in courses.items()}
    for output, rest in zip(plant.outputs, linearise_plant(plant, inputs=cold[0], disturbances=cold[1]).y):
        signals[output] = (np.full(n, rest), "degC", "output")
    log = make_log(time, signals, name=name)
    seen = plant.simulate(log, warmup=step)
    for output in plant.outputs:
        noise = plant.noise[output] * rng.standard_normal(n)
        log[output].values[:] = seen[output].values + noise
    return plant, log


@pytest.mark.parametrize("name", LOGS)
def test_a_network_is_identified_from_a_log_of_another_plant_of_its_kind(name):
    truth, log = plant_and_log(name)
    half = log.sizes["time"] // 2
    fitted = fit_network(load_network(name), [log.isel(time=slice(0, half))])
    # from the log's start: a wall that is warm and unseen at half time is in no reading
    warmup = 30 * LOGS[name][1]
    run = free_run(fitted, log, warmup=warmup, score_from=float(log["time"][half]), tests=False)
    for output, score in run.scores.items():
        sd = truth.noise[output]
        assert score.rmse < 1.2 * sd, f"{output}: {score.rmse:.3g} with noise of {sd:g}"
    point = {u: 0.5 * sum(ends) for u, ends in LOGS[name][3].items()}
    want, found = (plant_dynamics(p, inputs=point, draws=0) for p in (truth, fitted))
    heaters = [want.linear.inputs.index(u) for u in want.linear.inputs if u in truth.inputs]
    np.testing.assert_allclose(found.gain.value[:, heaters], want.gain.value[:, heaters], rtol=0.1)


def test_a_log_that_begins_warm_and_has_slow_rows_is_fitted_as_well():
    truth, log = plant_and_log("room")
    second = log.isel(time=slice(log.sizes["time"] // 2, None))
    second = second.assign_coords(time=second["time"] - float(second["time"][0]))
    fitted = fit_network(load_network("room"), [second])
    assert fitted.noise["t_room"] < 1.1 * truth.noise["t_room"]
    assert fitted.values["G_outside"] == pytest.approx(truth.values["G_outside"], rel=0.15)


def test_every_network_settles_where_its_kind_does():
    rest = {
        "gripper": (40, 60), "peltier_chamber": (40, 70), "tclab": (40, 60), "room": (20, 60),
        "hotend": (150, 300), "furnace": (400, 900), "tank": (25, 60), "thermal_chamber": (-20, 40),
    }  # fmt: skip
    assert set(rest) == set(builtin_networks())
    for name, (low, high) in rest.items():
        settled = plant_dynamics(plant_from_prior(load_network(name)), draws=0).linear.y
        assert np.all((low < settled) & (settled < high)), f"{name} settles at {settled}"
