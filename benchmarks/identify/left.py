"""How often `validate` says that a term is missing: where none is, and where one is.

    python benchmarks/identify/left.py [--logs 100] [--only tclab,rig,power]

``tclab``: logs of a TCLab with the numbers of the virtual board, white noise of 0.043 K, its converter's
steps; 25 min of random pulses.  ``rig``: logs of the gripper's network, fitted to the bundled ones, with
their inputs, white noise of 0.04 K, steps of 1/16 K and a slow error.  ``power``: a TCLab that has what the
fitted network lacks.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from thermogrip.datasets.examples import load_example_logs
from thermogrip.datasets.schema import Log, columns, make_log
from thermogrip.rig.simulation.tclab_firmware import LSB
from thermogrip.rig.simulation.virtual_device import example_plant
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run

Array = NDArray[np.float64]
Case = tuple[Plant, Log, float, float]  # plant, log, warm-up, scored from

SECONDS, CUT = 1500, 1000.0
BOARD = {"G_amb": 0.013, "G_between": 0.006, "power_1": 0.86, "power_2": 0.61, "lag_1": 16.0, "lag_2": 19.0}


def board(model: NetworkModel | None = None) -> Plant:
    """Return a TCLab of this network with the numbers of the virtual board."""
    if model is None:
        return replace(example_plant("tclab", room=23.0), noise={"t1": 0.02, "t2": 0.02})
    plant = prior_plant(model)
    return replace(plant, values=plant.values | BOARD | {"t_room": 23.0})


def changed(
    drop: Mapping[str, str] | None = None, add: Mapping[str, Mapping[str, Any]] | None = None
) -> NetworkModel:
    """Return the TCLab's network without some elements (table: name, or all), or with more."""
    content = load_network("tclab").to_dict()
    tables = content["network"]
    for table, name in (drop or {}).items():
        tables[table] = {k: v for k, v in tables[table].items() if name not in ("all", k)}
    for table, more in (add or {}).items():
        tables[table] = tables[table] | more
    used = str([v for k, v in tables.items() if k != "parameters"])
    tables["parameters"] = {k: v for k, v in tables["parameters"].items() if f"'{k}'" in used}
    return NetworkModel.from_dict(content)


def pulses(rng: np.random.Generator, n: int) -> Array:
    """Return 0 or 39 % by heater, held for 20 to 120 s: (n, 2)."""
    both = [np.repeat(39.0 * rng.integers(0, 2, n), rng.integers(20, 121, n))[:n] for _ in range(2)]
    return np.column_stack(both)


def levels(rng: np.random.Generator, n: int) -> Array:
    """Return 0 to 90 % by heater, held for 600 s: (n, 2)."""
    return np.repeat(rng.uniform(0, 90, (n // 600 + 1, 2)), 600, axis=0)[:n]


def lab_log(plant: Plant, u: Array, rng: np.random.Generator, late: int = 0) -> Log:
    """Return what a board shows that begins at 23 degC, its heaters ``late`` seconds late."""
    x0 = plant.model.rest(np.full(2, 23.0), np.zeros(2), np.zeros(0), plant.p)
    applied = np.vstack([np.zeros((late, 2)), u])[: len(u)]
    y = plant.model.rollout(x0[None], applied[None], np.zeros((1, len(u), 0)), plant.p[None], 1.0)[0][0, :-1]
    y = np.round((y + 0.043 * rng.standard_normal(y.shape) + 50) / LSB * 10) / 10 * LSB - 50
    heaters = {f"q{k + 1}": (u[:, k], "percent", "input") for k in range(2)}
    return make_log(
        np.arange(float(len(u))), heaters | {f"t{k + 1}": (y[:, k], "degC", "output") for k in range(2)}
    )


def of_fits(name: str, model: NetworkModel | str, logs: list[Log]) -> Iterator[tuple[str, list[Case]]]:
    """Yield plants fitted to one log each: on that log, on the next one, on the last third of their own."""
    plants = [fit_network(model, [log]) for log in logs]
    yield f"{name}, its own log", [(p, log, 50.0, 50.0) for p, log in zip(plants, logs)]
    yield f"{name}, another log", [(p, log, 50.0, 50.0) for p, log in zip(plants, logs[1:] + logs[:1])]
    cut = [int(2 / 3 * log.sizes["time"]) for log in logs]
    halves = [fit_network(model, [log.isel(time=slice(0, k))]) for k, log in zip(cut, logs)]
    yield f"{name}, the rest of its log", [(p, log, 50.0, float(k)) for p, log, k in zip(halves, logs, cut)]


def tclab(count: int, rng: np.random.Generator) -> Iterator[tuple[str, list[Case]]]:
    """Yield right models of a TCLab."""
    logs = [lab_log(board(), pulses(rng, SECONDS), rng) for _ in range(count)]
    for warmup in (5.0, 50.0):
        yield f"TCLab, exact plant, warm-up {warmup:g} s", [(board(), log, warmup, warmup) for log in logs]
    yield from of_fits("TCLab, fitted", "tclab", logs)


def rig(count: int, rng: np.random.Generator) -> Iterator[tuple[str, list[Case]]]:
    """Yield right models of the gripper's rig."""
    real = list(load_example_logs().values())
    truth = replace(fit_network("gripper", real), covariance=None)
    for sd, seconds in ((0.018, 4.0), (0.05, 100.0)):
        logs = [rig_log(truth, real[k % 4], rng, sd, seconds) for k in range(count)]
        yield f"rig, exact plant, {sd:g} K over {seconds:g} s", [(truth, log, 5.0, 5.0) for log in logs]
    rigs = [[rig_log(truth, log, rng, 0.05, 100.0) for log in real] for _ in range(max(2, count // 2))]
    plants = [fit_network("gripper", [*logs[:2], logs[3]]) for logs in rigs]
    held = [logs[2] for logs in rigs]
    yield "rig, fitted to three logs, the multisine", [(p, log, 5.0, 5.0) for p, log in zip(plants, held)]
    sure = [replace(plant, covariance=None) for plant in plants]
    yield "the same, numbers taken as exact", [(p, log, 5.0, 5.0) for p, log in zip(sure, held)]


def rig_log(truth: Plant, log: Log, rng: np.random.Generator, sd: float, seconds: float) -> Log:
    """Return the log as this plant would have made it."""
    y, out = columns(truth.simulate(log), truth.outputs), log.copy()
    keep = np.exp(-np.median(np.diff(log["time"].values)) / seconds)
    slow = lfilter(
        [np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal((len(y) + 5000, y.shape[1])), axis=0
    )
    read = np.round((y + sd * slow[5000:] + 0.04 * rng.standard_normal(y.shape)) * 16) / 16
    for k, name in enumerate(truth.outputs):
        out[name] = ("time", np.where(np.isfinite(log[name].values), read[:, k], np.nan), log[name].attrs)
    return out


def power(count: int, rng: np.random.Generator) -> Iterator[tuple[str, list[Case]]]:
    """Yield models of a TCLab that lack something."""
    for late in (1, 2):
        logs = [lab_log(board(), pulses(rng, SECONDS), rng, late) for _ in range(count)]
        yield from of_fits(f"heaters {late} s late", "tclab", logs)
    logs = [lab_log(board(), pulses(rng, SECONDS), rng) for _ in range(count)]
    yield from of_fits(
        "no coupling in the model", changed({"links": "between", "radiation": "between"}), logs
    )
    for conductance in (0.001, 0.003):
        second = {
            "nodes": {"plate": {"capacity": "C_plate", "start_sd": 2.0}},
            "links": {
                f"foot{k}": {"between": [f"heater{k}", "plate"], "conductance": "G_plate"} for k in (1, 2)
            },
            "parameters": {
                "C_plate": {"unit": "J/K", "value": 4.0, "fixed": True},
                "G_plate": {"unit": "W/K", "value": conductance, "fixed": True},
            },
        }
        truth = board(changed(add=second))
        logs = [lab_log(truth, pulses(rng, SECONDS), rng) for _ in range(count)]
        yield from of_fits(f"a plate of 4 J/K, {1e3 * conductance:g} mW/K from each heater", "tclab", logs)
    for drive, n in ((pulses, SECONDS), (levels, 3600)):
        logs = [lab_log(board(), drive(rng, n), rng) for _ in range(count)]
        yield from of_fits(
            f"no radiation in the model, {drive.__name__}", changed({"radiation": "all"}), logs
        )


def row(name: str, cases: Iterable[Case]) -> str:
    """Return the row of one kind of plant and log."""
    runs = [free_run(plant, log, warmup=w, score_from=begin) for plant, log, w, begin in cases]
    rmse = np.median([[s.rmse for s in run.scores.values()] for run in runs], axis=0)
    errors = ", ".join(f"{r:.3f}" for r in rmse)
    said = (np.mean([about(run) for run in runs]) for about in (_named, _told))
    return f"| {name} | {len(runs)} | {errors} | {' | '.join(f'{share:.2f}' for share in said)} |"


def _named(run: FreeRun) -> bool:
    return any(found.significant for row in run.residual.tests.values() for found in row.values())


def _told(run: FreeRun) -> bool:
    return any("is the start" in note for note in run.notes)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--logs", type=int, default=100)
    parser.add_argument("--only", default="tclab,rig,power")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print("| plant and log | logs | RMSE [degC] | by the test | start reported |")
    print("|---|---|---|---|---|")
    kinds = {"tclab": tclab, "rig": rig, "power": power}
    for name in given.only.split(","):
        for what, cases in kinds[name](given.logs, np.random.default_rng(given.seed)):
            print(row(what, cases), flush=True)


if __name__ == "__main__":
    main()
