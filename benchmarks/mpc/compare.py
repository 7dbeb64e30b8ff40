"""The controllers of the reference problem in one run: step times, cost, settling; ours beside the others.

    python -m venv peers && peers/bin/pip install . -r benchmarks/mpc/requirements.txt
    OMP_NUM_THREADS=1 peers/bin/python benchmarks/mpc/compare.py --out mpc.json

Prints Markdown tables.  Times are process CPU time of one call, children included.  In the first table it is
the call that makes a move of an estimate; in the second the public call, ``Controller.step``, whose filter
and checks count, in C and in Python: of the reference problem, a TCLab (4 states, two heaters) and a gripper
(28 states) of the bundled networks.  ``--quick`` leaves the slow ones at 150 samples, GEKKO at 60.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ours import Ours, design_of
from peers import PEERS
from problem import HORIZON, MODEL, TRUE, Answer, Loop, plant_of, run_loop

from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import Design, default_design
from thermogrip.mpc.native.runtime import wanted
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.plant import Plant

OURS: dict[str, Callable[[], Answer]] = {
    "thermogrip, Python, N = 50": Ours,
    "thermogrip, Python, 10 blocks": lambda: Ours(blocks=10),
}
SHORT = {"GEKKO": 60}
SCHEDULE = [(18.0, 75.0), (38.0, 75.0), (23.0, 75.0), (48.0, 75.0)]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="also write the numbers here, as JSON")
    parser.add_argument("--quick", action="store_true", help="150 samples of the slow ones")
    parser.add_argument("--only", default="", help="names to run, by semicolons")
    given = parser.parse_args()
    chosen = PEERS | OURS
    if given.only:
        chosen = {name: make for name, make in chosen.items() if name in given.only.split(";")}
    rows: dict[str, dict[str, Any]] = {}
    for name, make in chosen.items():
        steps = SHORT.get(name, 150 if given.quick and name in PEERS else None)
        rows[name] = measured(make(), steps)
        print(f"{name}: {rows[name]['median_ms']:.3f} ms", flush=True)
    print_steps(rows)
    found: dict[str, Any] = {"steps": rows, "public_steps": public_steps()}
    print_public(found["public_steps"])
    if not given.only:
        found["reversal"] = reversal()
        print_reversal(found["reversal"])
    if given.out is not None:
        given.out.write_text(json.dumps(found, indent=1, default=float), encoding="utf-8")


def measured(answer: Answer, steps: int | None) -> dict[str, Any]:
    """Return the numbers of one closed loop."""
    loop: Loop = run_loop(answer, steps=steps)
    ms = 1e3 * loop.cpu[1:]  # the first call sets things up
    return {
        "samples": len(loop.u),
        "median_ms": float(np.median(ms)),
        "p99_ms": float(np.percentile(ms, 99)),
        "max_ms": float(ms.max()),
        "cost": loop.cost,
        "cost_150": part_cost(loop, 150),
        "settling_s": loop.settling(),
        "overshoot": loop.overshoot(),
        "energy_wh": loop.energy_wh,
        "failed": loop.failed,
    }


def public_steps() -> dict[str, dict[str, float]]:
    """Return CPU times of ``Controller.step`` [ms] in closed loops."""
    model, true = plant_of(MODEL), plant_of(TRUE, dt=0.05)
    around = Surroundings(ambient=0.0, noise=0.02, quantum=0.0)
    cases: dict[str, tuple[Plant, Design, Plant, dict[str, Any]]] = {}
    for blocks in (HORIZON, 10):
        about = {"schedule": SCHEDULE, "start": 25.0, "surroundings": around, "band": 0.2}
        cases[f"reference problem, {blocks} blocks"] = model, design_of(blocks), true, about
    for name, low, high in (("tclab", 0.0, 100.0), ("gripper", -1.0, 1.0)):
        network = load_network(name)
        values = dict(zip(network.parameters, network.prior.tolist(), strict=True))
        valid = dict.fromkeys(network.inputs, (low, high))
        plant = Plant(network, values, dt=network.dt, units=network.units, valid=valid)
        schedule = [(35.0, 600.0), (30.0, 600.0)]
        cases[f"{name}, {network.n_x} states"] = plant, default_design(plant), plant, {"schedule": schedule}
    found = {}
    for name, (plant, design, truth, about) in cases.items():
        makers = (
            {"C": Controller, "Python": ReferenceController} if wanted() else {"Python": ReferenceController}
        )
        for language, make in makers.items():
            controller = make(plant, design)
            seconds: list[float] = []
            vars(controller)["step"] = timed(controller.step, seconds)
            simulate_closed_loop(controller, truth, **about)
            ms = 1e3 * np.array(seconds[1:])  # the first call sets things up
            row = {"median_ms": float(np.median(ms)), "p99_ms": float(np.percentile(ms, 99))}
            found[f"{language}, {name}"] = row
    return found


def timed(call: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    """Return a call that keeps its CPU times."""

    def run(*given: Any, **named: Any) -> Any:
        began = time.process_time()
        answer = call(*given, **named)
        seconds.append(time.process_time() - began)
        return answer

    return run


def part_cost(loop: Loop, n: int) -> float:
    """Return the cost of the first samples, which all runs have."""
    n = min(n, len(loop.u))
    return replace(loop, y=loop.y[:n], u=loop.u[:n], target=loop.target[:n]).cost


def reversal() -> dict[str, Any]:
    """Return the case in which more current ends up heating: 9 A, and a target too cold to be reached."""
    found = {}
    for blocks in (HORIZON, 10):
        answer = Ours(blocks=blocks, current=9.0)
        loop = run_loop(answer, targets=(18.0, 38.0, 8.0, 48.0), current=9.0)
        cold = loop.u[300:450]
        found[f"{blocks} blocks"] = {
            "settling_s": loop.settling(),
            "overshoot": loop.overshoot(),
            "energy_wh": loop.energy_wh,
            "coldest": float(loop.y[300:450, 2].min()),
            "current": [float(cold.min()), float(cold[-1])],
        }
    return found


def print_steps(rows: dict[str, dict[str, Any]]) -> None:
    """Print the table of step times."""
    base = rows.get("do-mpc, defaults")
    print(
        "\n| controller | samples | median ms | p99 | max | times faster | cost of 150 | cost | settling s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, row in rows.items():
        faster = f"{base['median_ms'] / row['median_ms']:.1f}" if base else ""
        settling = " / ".join(f"{value:.1f}" for value in row["settling_s"])
        cost = f"{row['cost']:.1f}" if row["samples"] == 600 else ""
        print(
            f"| {name} | {row['samples']} | {row['median_ms']:.3f} | {row['p99_ms']:.3f} "
            f"| {row['max_ms']:.3f} | {faster} | {row['cost_150']:.2f} | {cost} | {settling} |"
        )


def print_public(rows: dict[str, dict[str, float]]) -> None:
    """Print the table of the public call."""
    print("\n| Controller.step | median ms | p99 |\n|---|---|---|")
    for name, row in rows.items():
        print(f"| {name} | {row['median_ms']:.3f} | {row['p99_ms']:.3f} |")


def print_reversal(found: dict[str, Any]) -> None:
    """Print the case in which more current ends up heating."""
    for name, row in found.items():
        settling = " / ".join(f"{value:.1f}" for value in row["settling_s"])
        low, last = row["current"]
        print(
            f"Reversal, {name}: settling {settling} s, {row['energy_wh']:.2f} Wh, {low:.2f} to {last:.2f} A"
        )


if __name__ == "__main__":
    main()
