"""Predicted widths of an experiment beside those of fits to it, where the prediction may well fail.

    python benchmarks/excite/predicted_precision.py

1. The design is optimal at the plant's present values.  Here the truth is one of eight draws of the prior
   instead: is the schedule still better than the plain ones?
2. The bundled logs come from a program with terms that the network lacks.  From a fit on two of them: what
   does the third log, in which the pump stops, predict, and what does a fit on all three state?
3. Two heaters simulated with correlated noise, PRBS first, then the optimal schedule: what was predicted,
   what do fits state, and how far off are they?  Once as the network says, once on a board of 6 J/K that it
   lacks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from thermogrip.cli.excite import optimal_for, schedule_for
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Log, columns, make_log
from thermogrip.sysid.experiment.information import ExperimentForecast, plant_from_prior
from thermogrip.sysid.experiment.optimal import inputs_of
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.plant.log_grid import held_means
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import PlantScores


def other_truths(name: str, minutes: float, highest: float) -> None:
    """Print the bits of each schedule where the truth is a draw of the prior."""
    plant = plant_from_prior(load_network(name))
    limits = {"lowest": 5.0, "highest": highest}
    best = optimal_for(plant, minutes, **limits, slew=np.inf).log
    kinds = ("prbs", "multisine", "staircase")
    u = {kind: inputs_of(plant, schedule_for(plant, kind, minutes, **limits, seed=0)[0]) for kind in kinds}
    u["optimal"] = inputs_of(plant, best)
    print(f"\n{name}, {minutes:g} min below {highest:g} degC: bits where the truth is draw k of the prior")
    print("k  " + "".join(f"{kind:>11}" for kind in u))
    for k in range(9):
        forecast = ExperimentForecast(plant.draw(k), draws=0)
        print(f"{k:<3}" + "".join(f"{forecast.bits(row):11.1f}" for row in u.values()))


def third_log() -> None:
    """Print what the third log predicts and what the fit with it states."""
    names = ("prbs_heating_cooling", "step_up_down", "pump_on_off")
    logs = [read_log(example_path(name)) for name in names]
    before, after = fit_network("gripper", logs[:2]), fit_network("gripper", logs)
    time = logs[2]["time"].values
    edges = time[0] + before.dt * np.arange(int((time[-1] - time[0]) / before.dt) + 1)
    u = held_means(time, columns(logs[2], before.inputs), edges)
    forecast = ExperimentForecast(before, draws=0)
    predicted = np.sqrt(np.diag(forecast.covariance(u)))
    now, stated = np.sqrt(np.diag(before.covariance)), np.sqrt(np.diag(after.covariance))
    print(f"\npump_on_off after the other two: {forecast.bits(u):.1f} bits predicted; sd of theta")
    print(f"{'parameter':<15}{'now':>10}{'predicted':>10}{'stated':>10}{'stated/predicted':>17}")
    for row in zip(before.free, now, predicted, stated, stated / predicted):
        print("{:<15}{:10.3f}{:10.3f}{:10.3f}{:17.2f}".format(*row))
    ratio = stated / predicted
    print(f"median {np.median(ratio):.2f}, from {ratio.min():.2f} to {ratio.max():.2f}")


TRUTH = {"G_amb": 0.013, "power_1": 1.2, "lag_1": 15.0, "G_between": 0.005}
MEMORY, SD = 20.0, 0.4  # [s], [degC] of the noise


def on_a_board(plant: Plant, u: NDArray[np.float64], loss: float) -> NDArray[np.float64]:
    """Return readings without noise of two heaters that lose so many W/K each to a board of 6 J/K."""
    content = plant.model.to_dict()["network"]
    content["nodes"]["board"] = {"capacity": "C_board"}
    for name, ends in {"first": "heater1", "second": "heater2", "outer": "room"}.items():
        content["links"][name] = {"between": [ends, "board"], "conductance": f"G_{name}"}
    known = {"C_board": 6.0, "G_first": loss, "G_second": loss, "G_outer": 0.01}
    for name, value in known.items():
        unit = "J/K" if name == "C_board" else "W/K"
        content["parameters"][name] = {"unit": unit, "value": value, "fixed": True}
    model = NetworkModel(network_from_dict(content))
    p = np.array([(plant.values | known)[name] for name in model.parameters])
    start, none = np.full((1, model.n_x), 25.0), np.zeros((1, len(u), 0))
    return np.asarray(model.rollout(start, u[None], none, p[None], 1.0)[0][0, :-1])


def noisy(plant: Plant, u: NDArray[np.float64], y: NDArray[np.float64], seed: int) -> Log:
    """Return a log whose readings' noise is AR(1)."""
    rng, phi = np.random.default_rng(seed), (MEMORY - 1) / (MEMORY + 1)
    columns = {name: (u[:, k], "percent", "input") for k, name in enumerate(plant.inputs)}
    for k, name in enumerate(plant.outputs):
        drive = SD * np.sqrt(1 - phi**2) * rng.standard_normal(len(u) + 200)
        columns[name] = (y[:, k] + lfilter([1.0], [1.0, -phi], drive)[200:], "degC", "output")
    return make_log(np.arange(float(len(u))), columns, name=f"run {seed}")


def kept(loss: float, count: int) -> None:
    """Print what was predicted, what was stated and how far off fits were."""
    plant = plant_from_prior(load_network("tclab"))
    seen = PlantScores(average_s=5.0)
    plant = replace(plant, values=plant.values | TRUTH, scores=seen)
    limits = {"lowest": 5.0, "highest": 90.0}
    best = optimal_for(plant, 20.0, **limits, slew=np.inf).log
    prbs, _ = schedule_for(plant, "prbs", 20.0, **limits, seed=0)
    u = [inputs_of(plant, prbs), inputs_of(plant, best)]
    y = [on_a_board(plant, row, loss) for row in u]
    rows = []
    for seed in range(count):
        logs = [noisy(plant, *pair, 2 * seed + k) for k, pair in enumerate(zip(u, y))]
        before, after = fit_network(plant.model, logs[:1]), fit_network(plant.model, logs)
        forecast = ExperimentForecast(before, draws=0)
        predicted_sd = np.sqrt(np.diag(forecast.covariance(u[1])))
        rows.append([after.theta - plant.theta, predicted_sd, np.sqrt(np.diag(after.covariance))])
    error, predicted, stated = np.array(rows).transpose(1, 0, 2)
    off = np.sqrt(np.mean(error**2, axis=0))
    ratio = np.exp(np.mean(np.log(stated / predicted), axis=0))
    print(f"\ntwo heaters, {1000 * loss:.0f} mW/K to a board that the network lacks: {count} experiments")
    print(f"{'parameter':<12}{'true rms':>10}{'predicted':>10}{'stated':>10}{'stated over predicted':>23}")
    for k, name in enumerate(plant.free):
        mean = [np.sqrt(np.mean(sd[:, k] ** 2)) for sd in (predicted, stated)]
        print(f"{name:<12}{off[k]:10.4f}{mean[0]:10.4f}{mean[1]:10.4f}{ratio[k]:23.2f}")


if __name__ == "__main__":
    other_truths("tclab", 30.0, 80.0)
    other_truths("gripper", 30.0, 60.0)
    third_log()
    kept(1e-9, 24)
    kept(0.004, 24)
