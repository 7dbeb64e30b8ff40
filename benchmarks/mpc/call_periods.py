r"""A controller called at another period than its own: does it settle as soon, and overshoot as little?

    python benchmarks/mpc/call_periods.py --plant plant.json --markdown periods.md

Closes loops around two kinds of plants and calls their controllers every 0.25, 0.5, 1, 2 and 3 s with the
true time of each reading, beside the controllers' own sample times:

* the reference problem (``problem.py``; its own sample time is 0.5 s), 18, 38, 23 and 48 degC for 75 s each;
* five draws of the gripper's posterior (its own sample time is 2 s; ``plant.json`` is what ``identify`` wrote
  of the bundled logs with ``--network gripper``, made here where absent), 38 degC for 400 s, 22 for 600 s.

The plants are simulated in steps of 50 ms by the lines below and in ``problem.py``, which share nothing with
what the controller predicts by.  The gripper has

    C_i dT_i/dt = sum of G_ij (T_j - T_i) + F (T_upstream - T_i)

over heatsink, wall, water, finger, pipe, foam, the cells of two tubes with their walls, and two sensors that
lag; a Peltier element moves S I T_wall + R I^2 / 2 into the wall, -S I T_sink + R I^2 / 2 into the heatsink,
T in kelvin, and K (T_sink - T_wall) besides.  Readings have noise: 0.04 degC, rounded to 1/16 (reference
0.02, not rounded).

Settling is the time after which the temperature of the skin stays inside the band (0.25 degC, reference 0.2),
overshoot the largest excursion beyond a target.  The column "noise" is the range over three seeds of the
noise at the controller's own sample time.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from ours import design_of
from problem import MODEL, TRUE, ReferenceModel, plant_of

from thermogrip.mpc.controllers.lqr import LQRController
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.interface import STATUSES, Move
from thermogrip.mpc.native.runtime import wanted
from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]

FINE = 0.05  # s, of the simulation
PERIODS = (0.25, 0.5, 1.0, 2.0, 3.0)  # s
SEEDS = (0, 1, 2)
KELVIN = 273.15


class Truth(Protocol):
    """A plant in steps of 50 ms."""

    skin: str

    def step(self, u: float) -> None:
        """Let 50 ms pass under a drive."""

    def outputs(self) -> dict[str, float]:
        """Return the temperatures that the sensors feel [degC]."""

    def read(self, rng: np.random.Generator) -> dict[str, float]:
        """Return what they show."""


class Reference:
    """The reference problem's plant."""

    skin = "t_surface"

    def __init__(self) -> None:
        self.model = ReferenceModel(TRUE, dt=FINE)
        self.x: list[float] = [25.0] * self.model.n_x

    def step(self, u: float) -> None:
        self.x = self.model.step(self.x, [u], (0.0, 0.0), (), FINE)

    def outputs(self) -> dict[str, float]:
        return dict(zip(self.model.outputs, self.model.output(self.x, ())))

    def read(self, rng: np.random.Generator) -> dict[str, float]:
        return {name: value + 0.02 * rng.standard_normal() for name, value in self.outputs().items()}


class Gripper:
    """A gripper of these parameters in a room of 25 degC; equations of its own, fourth-order Runge-Kutta."""

    skin, room = "t_surface", 25.0

    def __init__(self, p: dict[str, float]) -> None:
        self.p = p
        names = ["sink", "wall", "water", "finger", "pipe", "foam"]
        tubes = {"supply": 6, "return": 4}
        for tube, n in tubes.items():
            names += [f"{tube}{k}{part}" for k in range(n) for part in ("", "_wall")]
        names += ["sensor_tank", "sensor_skin"]
        self.at = {name: k for k, name in enumerate(names)}
        n = len(names)
        self.M, self.from_room, self.C = np.zeros((n, n)), np.zeros(n), np.ones(n)
        capacities = {
            "sink": p["C_heatsink"],
            "wall": p["C_wall"],
            "water": p["C_water"],
            "finger": p["C_finger"],
            "pipe": p["C_pipe"],
            "foam": p["C_foam"],
            "sensor_tank": p["lag_tank"],
            "sensor_skin": p["lag_surface"],
        }
        for name, value in capacities.items():
            self.C[self.at[name]] = value
        between = {("sink", "wall"): "K_module", ("wall", "water"): "G_wall", ("finger", "pipe"): "G_film"}
        for (a, b), G in {**between, ("pipe", "foam"): "G_foam"}.items():
            self._flow(a, b, p[G])
            self._flow(b, a, p[G])
        losses = {"sink": "G_heatsink", "water": "G_tank", "pipe": "G_pipe", "foam": "G_foam_air"}
        for a, G in losses.items():
            self._lose(a, p[G])
        for tube, source, sink in (("supply", "water", "finger"), ("return", "finger", "water")):
            cells, upstream = tubes[tube], source
            for k in range(cells):
                cell = f"{tube}{k}"
                self.C[self.at[cell]] = p["flow"] * p[f"delay_{tube}"] / cells
                self.C[self.at[cell + "_wall"]] = p["C_tube"] / cells
                self._flow(cell, upstream, p["flow"])
                self._flow(cell, cell + "_wall", p["G_tube_film"] / cells)
                self._flow(cell + "_wall", cell, p["G_tube_film"] / cells)
                self._lose(cell + "_wall", p["G_tube"] / cells)
                upstream = cell
            self._flow(sink, upstream, p["flow"])
        self._flow("sensor_tank", "water", 1.0)
        self._flow("sensor_skin", "pipe", 1.0)
        self.M /= self.C[:, None]
        self.drift = self.from_room * self.room / self.C
        self.x = np.full(n, self.room)

    def _flow(self, to: str, source: str, G: float) -> None:
        self.M[self.at[to], self.at[source]] += G
        self.M[self.at[to], self.at[to]] -= G

    def _lose(self, name: str, G: float) -> None:
        self.M[self.at[name], self.at[name]] -= G
        self.from_room[self.at[name]] += G

    def _slope(self, x: Array, current: float) -> Array:
        p = self.p
        found: Array = self.M @ x + self.drift
        joule = 0.5 * p["resistance"] * current**2
        found[1] += (p["seebeck"] * current * (x[1] + KELVIN) + joule) / self.C[1]
        found[0] += (-p["seebeck"] * current * (x[0] + KELVIN) + joule) / self.C[0]
        return found

    def step(self, u: float) -> None:
        v = u + self.p["drive_offset"]
        current = self.p["current"] * (v if v > 0 else self.p["cooling_gain"] * v)
        k1 = self._slope(self.x, current)
        k2 = self._slope(self.x + FINE / 2 * k1, current)
        k3 = self._slope(self.x + FINE / 2 * k2, current)
        k4 = self._slope(self.x + FINE * k3, current)
        self.x = self.x + FINE / 6 * (k1 + 2 * (k2 + k3) + k4)

    def outputs(self) -> dict[str, float]:
        return {"t_tank": float(self.x[-2]), "t_surface": float(self.x[-1])}

    def read(self, rng: np.random.Generator) -> dict[str, float]:
        shown = {name: value + 0.04 * rng.standard_normal() for name, value in self.outputs().items()}
        return {**{name: round(16 * value) / 16 for name, value in shown.items()}, "t_ambient": self.room}


class InC:
    """The controller as it is exported: every call is one of ``tg_step``."""

    def __init__(self, python: Controller) -> None:
        self.python, self.dt = python, python.dt
        assert python.c is not None
        self.c = python.c

    def _arrays(self, reading: dict[str, float]) -> list[Array]:
        model = self.python.model
        return [
            np.array([reading.get(name, np.nan) for name in names])
            for names in (model.outputs, model.disturbances)
        ]

    def reset(self, reading: dict[str, float]) -> None:
        self.c.reset(*self._arrays(reading))

    def step(self, reading: dict[str, float], target: float) -> Move:
        drive, pump, status = self.c.step(
            *self._arrays(reading), np.array([target]), time_s=reading["time_s"]
        )
        return Move(float(drive[0]), pump, STATUSES[status], self.c.advice)


@dataclass(frozen=True)
class Case:
    """A plant, its targets, and how to make its controllers."""

    name: str
    truth: Callable[[], Truth]
    schedule: tuple[tuple[float, float], ...]  # target [degC], for so long [s]
    band: float
    controllers: dict[str, Callable[[], Any]]


@dataclass(frozen=True)
class Result:
    """One loop: by target, settling [s] and overshoot [degC]."""

    case: str
    controller: str
    period: float  # s; of its own sample time where it is 0
    seed: int
    settling: tuple[float, ...]
    overshoot: tuple[float, ...]
    statuses: str


def closed_loop(case: Case, controller: str, gaps: Iterator[float], period: float, seed: int) -> Result:
    """Close one loop."""
    truth, c, rng = case.truth(), case.controllers[controller](), np.random.default_rng(seed)
    k, next_call, u = 0, 0.0, 0.0
    settling, overshoot, said = [], [], set()
    before = truth.outputs()[truth.skin]
    for at, (target, seconds) in enumerate(case.schedule):
        skin = []
        for _ in range(round(seconds / FINE)):
            now = round(k * FINE, 9)
            if now >= next_call - 1e-9:
                reading = {"time_s": now, **truth.read(rng)}
                if k == 0:
                    c.reset(reading)
                move = c.step(reading, target)
                u = move.drive
                said.add(move.status)
                next_call += next(gaps)
            truth.step(u)
            skin.append(truth.outputs()[truth.skin])
            k += 1
        error = np.array(skin) - target
        outside = np.flatnonzero(np.abs(error) > case.band)
        last = int(outside[-1]) + 1 if outside.size else 0
        settling.append(FINE * last if last < len(skin) else float("nan"))
        side = np.sign(target - (before if at == 0 else case.schedule[at - 1][0]))
        overshoot.append(max(0.0, float(np.max(side * error))))
    return Result(
        case.name,
        controller,
        period,
        seed,
        tuple(settling),
        tuple(overshoot),
        ", ".join(sorted(said - {"ok"})),
    )


def reference_case() -> Case:
    """Return the reference problem."""
    plant, design = plant_of(MODEL), design_of(10)
    made: dict[str, Callable[[], Any]] = {
        "MPC": lambda: Controller(plant, design, compiled=wanted()),
        "PI": lambda: PIController(plant, dt=design.dt, slew_per_s=design.slew_per_s),
        "LQR": lambda: LQRController(plant, design),
    }
    if wanted():
        made["exported C"] = lambda: InC(Controller(plant, design, compiled=True))
    schedule = tuple((target, 75.0) for target in (18.0, 38.0, 23.0, 48.0))
    return Case("reference", Reference, schedule, 0.2, made)


def redesigned(period: float) -> Case:
    """Return the reference problem under an MPC that was designed for this sample time."""
    design, n = design_of(60), round(period / 0.5)
    design = replace(
        design,
        dt=period,
        blocks=(1,) * (60 // n),
        track=design.track * n,
        overshoot=design.overshoot * n,
        drive=design.drive * n,
        move=design.move / n,
    )
    made = {"MPC": lambda: Controller(plant_of(MODEL), design, compiled=wanted())}
    return replace(reference_case(), name=f"reference, designed for {period:g} s", controllers=made)


def gripper_cases(plant: Plant, draws: int) -> list[Case]:
    """Return draws of a posterior, each under the controllers of the plant."""
    design = default_design(plant, deadline_s=60.0)
    made: dict[str, Callable[[], Any]] = {
        "MPC": lambda: Controller(plant, design, compiled=wanted()),
        "PI": lambda: PIController(plant, dt=design.dt),
        "LQR": lambda: LQRController(plant, design),
    }
    if wanted():
        made["exported C"] = lambda: InC(Controller(plant, design, compiled=True))
    schedule = ((38.0, 400.0), (22.0, 600.0))
    values = [dict(plant.draw(k).values) for k in range(1, draws + 1)]
    return [
        Case(f"draw {k}", lambda p=p: Gripper(p), schedule, 0.25, made)  # type: ignore[misc]
        for k, p in enumerate(values, start=1)
    ]


def identified(seed: int) -> Plant:
    """Return the gripper as identified from the bundled logs."""
    from thermogrip.datasets.examples import load_example_logs
    from thermogrip.sysid.identification import identify

    found = identify(list(load_example_logs().values()), "gripper", models=("network",), seed=seed)
    return found.plant


def run_all(cases: Sequence[Case], controllers: Sequence[str]) -> list[Result]:
    """Return every loop: own sample time with three seeds, then every period with the first."""
    results = []
    for case in cases:
        for name in controllers:
            if name not in case.controllers:
                continue
            dt = case.controllers[name]().dt
            for seed in SEEDS:
                results.append(closed_loop(case, name, repeat(dt), 0.0, seed))
            for period in PERIODS:
                results.append(closed_loop(case, name, repeat(period), period, SEEDS[0]))
            print(f"{case.name}, {name}", file=sys.stderr, flush=True)
    return results


def tables(results: Sequence[Result], cases: Sequence[Case], controllers: Sequence[str]) -> str:
    """Return the results as Markdown: a table by controller, settling and overshoot by target."""
    lines = []
    for name in controllers:
        heads = " | ".join(f"every {period:g} s" for period in PERIODS)
        lines += ["", f"{name}: settling [s] / overshoot [degC]", ""]
        lines += [f"| plant, target | at dt | noise | {heads} |", "|---" * (3 + len(PERIODS)) + "|"]
        for case in cases:
            rows = [row for row in results if (row.case, row.controller) == (case.name, name)]
            if rows:
                lines += [row_of(rows, case, at) for at in range(len(case.schedule))]
    odd = {f"{row.case}, {row.controller}: {row.statuses}" for row in results if row.statuses}
    return "\n".join([*lines, "", *(f"- not ok at times: {text}" for text in sorted(odd))]).strip()


def row_of(rows: Sequence[Result], case: Case, at: int) -> str:
    """Return one row of a table."""
    own = [row for row in rows if not row.period]
    spread = [
        f"{np.ptp([getattr(row, what)[at] for row in own]):{form}}"
        for what, form in (("settling", ".1f"), ("overshoot", ".2f"))
    ]
    cells = [f"{row.settling[at]:.1f} / {row.overshoot[at]:.2f}" for row in rows if row.seed == SEEDS[0]]
    first, *others = cells
    return (
        f"| {case.name}, {case.schedule[at][0]:g} | {first} | {' / '.join(spread)} | {' | '.join(others)} |"
    )


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plant", type=Path, help="plant.json of identify; identified where absent")
    parser.add_argument("--draws", type=int, default=5, help="of its posterior")
    parser.add_argument("--controllers", default="MPC,exported C,PI,LQR", help="comma list")
    parser.add_argument("--seed", type=int, default=0, help="of the identification")
    parser.add_argument(
        "--redesigned", action="store_true", help="only: MPCs designed for each period and called at it"
    )
    parser.add_argument("--markdown", type=Path, help="also write the tables here")
    parser.add_argument("--out", type=Path, help="also write every loop here, as JSON")
    given = parser.parse_args()
    if given.redesigned:
        for period in PERIODS[1:]:
            row = closed_loop(redesigned(period), "MPC", repeat(period), period, SEEDS[0])
            cells = [f"{a:.1f} / {b:.2f}" for a, b in zip(row.settling, row.overshoot)]
            print(f"| designed for and called every {period:g} s | {' | '.join(cells)} |")
        return
    cases, controllers = [reference_case()], given.controllers.split(",")
    if given.draws:
        plant = identified(given.seed) if given.plant is None else Plant.load(given.plant)
        cases += gripper_cases(plant, given.draws)
    results = run_all(cases, controllers)
    text = tables(results, cases, controllers)
    print(text)
    if given.markdown is not None:
        given.markdown.write_text(text + "\n", encoding="utf-8")
    if given.out is not None:
        given.out.write_text(json.dumps([row.__dict__ for row in results], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
