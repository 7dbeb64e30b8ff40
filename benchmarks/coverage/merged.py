"""Would values at the mode of the hierarchical likelihood predict a left-out log better than merged logs do?

    python benchmarks/coverage/merged.py

Fits the gripper network to three of the four example logs (for the pump log: to the first half of it too),
once as :func:`fit_network` does and once moved to the mode of the likelihood that has missing terms, effects
of each log and slow errors integrated out; prints the RMSE of free runs of the left-out log.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.examples import load_example_logs
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.noise_model import information, learn_error_model
from thermogrip.sysid.greybox.problem import Problem, make_problem
from thermogrip.sysid.greybox.random_effects import linearise_logs
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]


def mode(problem: Problem, z: Array) -> Array:
    """Return the mode of the hierarchical likelihood, three linearisations from the fit at most."""
    for _ in range(3):
        data = linearise_logs(problem, z, problem.by_log(z, central=True))
        width = [1.5] * data.n_responses + [0.7] * (len(data.kinds) - data.n_responses)
        said = information(learn_error_model(data.logs, z, width=width), data.logs, z)
        step = np.clip(said.mean[: z.size] - z, -1.0, 1.0)
        z = np.clip(z + step, *problem.box)
        if np.abs(step).max() < 0.05:
            break
    return z


def error(plant: Plant, log: Log, since: float) -> float:
    """Return the RMSE of a free run of the surface [degC]."""
    run = plant.simulate(log, score_from=since)
    miss = (run["t_surface"].values - log["t_surface"].values)[run["scored"].values > 0]
    return float(np.sqrt(np.nanmean(miss**2)))


def main() -> None:
    """Print a line for each left-out log."""
    logs = load_example_logs()
    for name, test in logs.items():
        train, since = [log for other, log in logs.items() if other != name], 5.0
        if "pump" in name:
            t = test["time"].values - test["time"].values[0]
            since = float(t[-1]) / 2
            train.append(test.isel(time=np.flatnonzero(t <= since)))
        merged = fit_network(load_network("gripper"), train)
        weights = np.array(list(merged.scores.weight_s.values())) / merged.scores.average_s
        bin_s = merged.scores.average_s
        problem = make_problem(load_network("gripper"), train, average=bin_s, independent=60.0)
        z = mode(problem.with_tau(weights), problem.standard(merged.values))
        values = dict(zip(merged.model.parameters, problem.parameters(z[None])[0].tolist()))
        moved = replace(merged, values=values)
        print(
            f"{name:22} merged {error(merged, test, since):.3f}  hierarchical {error(moved, test, since):.3f}"
        )


if __name__ == "__main__":
    main()
