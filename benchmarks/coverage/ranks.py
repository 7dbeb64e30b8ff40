"""Simulation-based calibration of emcee on a small network: are the ranks of truths among samples uniform?

    python benchmarks/coverage/ranks.py run --count 100
    python benchmarks/coverage/ranks.py figure ranks.svg

A heated block with a lagging sensor; three parameters, all sampled, drawn from their prior; three logs of 15
minutes, simulated exactly here (no code shared with the fit), with an AR(1) error of 40 s, white noise and a
bias of the ambient in each log.  Nothing is missing in the model.  One line a replication in
``results/ranks.csv``: the rank of the truth among 99 samples spread over the chain, and whether the 90 per
cent interval of the samples holds it.  Replications that are there are not run again.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from study import RESULTS, read

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.posterior import sample_posterior
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import network_from_dict

Array = NDArray[np.float64]

BLOCK: dict[str, Any] = {
    "schema": "thermogrip.network", "version": 1, "name": "block", "dt": 1.0,
    "inputs": {"q": {"unit": "1", "range": [0.0, 1.0]}},
    "disturbances": {"air": {"log_sd": 0.2}},
    "outputs": {"t": {"node": "block", "lag": "lag", "sd": 0.05, "reference": True}},
    "nodes": {"block": {"capacity": "C", "start_sd": 0.1}},
    "links": {"loss": {"between": ["block", "air"], "conductance": "G"}},
    "heaters": {"h": {"node": "block", "input": "q", "power": "P"}},
    "parameters": {
        "C": {"unit": "J/K", "value": 50.0, "fixed": True},
        "G": {"unit": "W/K", "value": 0.5, "sd_log": 0.4},
        "P": {"unit": "W", "value": 10.0, "sd_log": 0.4},
        "lag": {"unit": "s", "value": 8.0, "sd_log": 0.4},
    },
}  # fmt: skip
FREE = ("G", "P", "lag")
SAMPLES, STEPS = 99, 1500


def make(truth: dict[str, float], rng: np.random.Generator) -> Log:
    """Simulate 15 minutes of the block, exactly, in steps of half a second."""
    dt, n = 0.5, 1800
    q = np.repeat(rng.random(n // 60 + 1) < 0.5, 60)[:n] * (np.arange(n) >= 20)
    tau, lag = 50.0 / truth["G"], truth["lag"]
    keep, slow = np.exp(-dt / tau), np.exp(-dt / lag)
    block, seen = np.zeros(n), np.zeros(n)
    for k in range(n - 1):
        end = truth["P"] * q[k] / truth["G"]
        # the sensor follows end + (block - end) exp(-t / tau), itself a first-order lag
        part = (block[k] - end) * tau / (tau - lag)
        seen[k + 1] = end + part * keep + (seen[k] - end - part) * slow
        block[k + 1] = end + (block[k] - end) * keep
    memory, error = np.exp(-dt / 40.0), np.zeros(n)
    kick = 0.05 * np.sqrt(1 - memory**2) * rng.standard_normal(n)
    error[0] = 0.05 * rng.standard_normal()
    for k in range(1, n):
        error[k] = memory * error[k - 1] + kick[k]
    room = rng.uniform(19.0, 25.0)
    air = np.full(n, room + 0.1 * rng.standard_normal())
    read_ = room + seen + error + 0.05 * rng.standard_normal(n)
    columns = {
        "q": (q.astype(float), "1", "input"),
        "air": (air, "degC", "disturbance"),
        "t": (read_, "degC", "output"),
    }
    return make_log(dt * np.arange(n), columns)


def run(count: int) -> None:
    """Do the replications that are not there yet."""
    path = RESULTS / "ranks.csv"
    RESULTS.mkdir(exist_ok=True)
    done = {int(row["seed"]) for row in read(path)}
    model = NetworkModel(network_from_dict(BLOCK))
    for seed in sorted(set(range(count)) - done):
        rng = np.random.default_rng([seed, 77])
        truth = {
            n: BLOCK["parameters"][n]["value"] * float(np.exp(0.4 * rng.standard_normal())) for n in FREE
        }
        logs = [make(truth, rng).assign_attrs(name=f"log{k}") for k in range(3)]
        plant = fit_network(model, logs)
        _, record = sample_posterior(plant, logs, free=FREE, max_steps=STEPS, n_samples=SAMPLES, seed=seed)
        row: dict[str, float] = {"seed": seed, "converged": float(record.converged)}
        for i, name in enumerate(FREE):
            low, _, high = record.quantiles[name]
            row[f"{name}.rank"] = float((record.samples[:, i] < truth[name]).sum())
            row[f"{name}.inside"] = float(low <= truth[name] <= high)
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)


def figure(path: Path) -> None:
    """Draw the ranks of each parameter with the band that 99 of 100 uniform histograms keep to."""
    from matplotlib.figure import Figure
    from scipy.stats import binom

    rows, bins = read(RESULTS / "ranks.csv"), 10
    drawn = Figure(figsize=(7.2, 2.4), layout="constrained")
    low, high = binom.ppf([0.0005, 0.9995], len(rows), 1 / bins)
    for ax, name in zip(drawn.subplots(1, len(FREE), sharey=True), FREE):
        ax.axhspan(low, high, color="0.9")
        ax.hist(
            [row[f"{name}.rank"] for row in rows],
            bins=np.linspace(0, SAMPLES + 1, bins + 1),
            color="tab:blue",
        )
        held = np.mean([row[f"{name}.inside"] for row in rows])
        ax.set_title(f"{name}: 90 % hold {held:.0%} of {len(rows)}", fontsize=9)
        ax.set_xlabel("rank of the truth among 99 samples", fontsize=8)
    drawn.savefig(path)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Ranks of truths among samples of emcee.")
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("run").add_argument("--count", type=int, default=100)
    verbs.add_parser("figure").add_argument("path", type=Path)
    given = parser.parse_args()
    if given.verb == "run":
        run(given.count)
    else:
        figure(given.path)


if __name__ == "__main__":
    main()
