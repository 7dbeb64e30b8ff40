"""Sensors that are off, lost or drift, and targets out of reach: closed loops on an independent simulator.

    python benchmarks/control/faults.py --seeds 4,5,6 --markdown faults.md

The controller has the reference model in its default design; the plant is ``simulator.py``'s, with every
number off (``mismatch.py``'s row of that name) or as the model has it.  From rest at 25 degC the skin is sent
to 38 and then to 23 degC, ten minutes each, with 0.02 degC of noise on every sensor.  Rows:

* every sensor off by +1 or -1 degC from the start, all eight ways;
* one sensor lost for 120 s, a minute after the first target was asked for, and while it is approached;
* one sensor drifts by 1 degC in ten minutes, up or down;
* a target that no drive can hold, 1 and 10 degC below the coldest that a constant current holds;
* six sensors, each off by +1 or -1 degC from the start, in sixteen of the 64 ways (any three of them in all
  eight): the furnace of ``truths.py``, which radiates, with a linear model of it and three of its outputs
  controlled, from 23 to 150 and to 180 degC, within 1 degC.

Figures are of what the sensors of controlled outputs show without noise, worst of the seeds: overshoot
beyond a target, mean error of the last tenth of a target's time, the longest time to stay within 0.25 degC,
shares of samples by status; of targets out of reach, when that was reported first, for how many samples after
it was not, and by how much the reported value is off.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from mismatch import CASES, CURRENT, NOISE, asked, model_of
from scipy.linalg import expm
from simulator import OUTPUTS, SKIN, Plant, Truth
from truths import CASES as PLANTS
from truths import Changes

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.runtime import wanted
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant as Model

SECONDS, BAND = 600.0, 0.25
LOST_AT, LOST_FOR = (10.0, 60.0), 120.0
TRUTHS = {"model is right": Truth(), "every number off": CASES[1].truth}

Fault = Callable[[float, np.ndarray], np.ndarray]  # time [s], readings -> readings


@dataclass(frozen=True)
class Loop:
    """One closed loop; rows of samples."""

    time_s: np.ndarray
    skin: np.ndarray
    target: np.ndarray
    statuses: list[str]
    advices: list[str]


def close_loop(
    controller: Controller, truth: Truth, fault: Fault, targets: tuple[float, ...], seed: int
) -> Loop:
    """Return a closed loop under a fault of the readings."""
    rng, plant, dt = np.random.default_rng(seed), Plant(truth), controller.dt
    rows, statuses, advices = [], [], []
    for k in range(round(len(targets) * SECONDS / dt)):
        target = targets[int(k * dt // SECONDS)]
        shown = fault(k * dt, plant.read() + NOISE * rng.standard_normal(3))
        reading = dict(zip(OUTPUTS, shown.tolist(), strict=True)) | {"time_s": k * dt}
        reading["t_ambient"] = truth.room + NOISE * rng.standard_normal()
        if not k:
            controller.reset(reading)
        move = controller.step(reading, target)
        clean = fault(k * dt, plant.read())[SKIN]
        rows.append((k * dt, clean if np.isfinite(clean) else plant.read()[SKIN], target))
        statuses.append(move.status)
        advices.append(move.advice)
        plant.run(float(move.drive), dt)
    time_s, skin, goal = np.array(rows).T
    return Loop(time_s, skin, goal, statuses, advices)


def off_by(offsets: tuple[float, ...]) -> Fault:
    """Return sensors that are off from the start."""
    return lambda time_s, y: y + np.array(offsets)


def lost(sensor: int, at: float) -> Fault:
    """Return a sensor that is lost for two minutes."""

    def fault(time_s: float, y: np.ndarray) -> np.ndarray:
        y = y.copy()
        if at <= time_s < at + LOST_FOR:
            y[sensor] = np.nan
        return y

    return fault


def drifting(sensor: int, rate: float) -> Fault:
    """Return a sensor that drifts by ``rate`` degC a second for ten minutes."""
    return lambda time_s, y: y + rate * min(time_s, 600.0) * np.eye(3)[sensor]


FAULTS: dict[str, list[Fault]] = {
    "none": [off_by((0.0, 0.0, 0.0))],
    "all sensors off by 1 degC": [off_by(signs) for signs in product((-1.0, 1.0), repeat=3)],
    **{f"{OUTPUTS[i]} lost for 120 s, from {at:g} s on": [lost(i, at)] for at in LOST_AT for i in (0, 1, 2)},
    **{
        f"{name} drifts by 1 degC in 10 min": [drifting(i, rate / 600.0) for rate in (-1.0, 1.0)]
        for i, name in enumerate(OUTPUTS)
    },
}


def figures(loop: Loop, band: float) -> tuple[float, float, float]:
    """Return overshoot [degC], offset [degC] and settling [s], worst of the targets."""
    before, found = float(loop.skin[0]), []
    for goal in dict.fromkeys(loop.target.tolist()):
        rows = loop.target == goal
        skin, time_s = loop.skin[rows], loop.time_s[rows]
        outside = np.flatnonzero(np.abs(skin - goal) > band)
        last = outside[-1] + 1 if outside.size else 0
        settled = float(time_s[last] - time_s[0]) if last < len(skin) else np.inf
        beyond = max(0.0, float(np.max(np.sign(goal - before) * (skin - goal))))
        end = time_s >= time_s[-1] - 0.1 * (time_s[-1] - time_s[0])
        found.append((beyond, abs(float(np.mean(skin[end] - goal))), settled))
        before = goal
    return tuple(np.max(found, axis=0).tolist())  # type: ignore[return-value]


def line(name: str, loops: list[Loop], band: float = BAND) -> str:
    """Return a row of the table of faults."""
    over, offset, settled = np.max([figures(loop, band) for loop in loops], axis=0)
    statuses = [status for loop in loops for status in loop.statuses]
    shares = {status: statuses.count(status) / len(statuses) for status in sorted(set(statuses))}
    text = ", ".join(f"{status} {100 * share:.0f} %" for status, share in shares.items() if status != "ok")
    when = f"{settled:.0f}" if np.isfinite(settled) else "never"
    return f"| {name} | {over:.2f} | {offset:.3f} | {when} | {text or '-'} |"


def coldest(truth: Truth) -> float:
    """Return the lowest temperature of the skin that a constant current holds [degC]."""
    found = []
    for current in np.linspace(-CURRENT, -0.3 * CURRENT, 15):
        plant = Plant(truth)
        plant.run(float(current), 3600.0)
        found.append(float(plant.read()[SKIN]))
    return min(found)


def reach_line(controller: Controller, name: str, truth: Truth, beyond: float, seeds: list[int]) -> str:
    """Return a row of the table of targets out of reach: colder than any current makes it."""
    end = coldest(truth)
    first, gaps, off = [], [], []
    for seed in seeds:
        loop = close_loop(controller, truth, off_by((0.0, 0.0, 0.0)), (end - beyond,), seed)
        told = np.array([status == "infeasible" for status in loop.statuses])
        at = int(np.argmax(told)) if told.any() else len(told)
        first.append(loop.time_s[at] if told.any() else np.inf)
        gaps.append(int(np.sum(~told[at:])))
        values = [re.search(r"(-?[0-9.]+) degC can be held", text) for text in loop.advices]
        last = [float(found[1]) for found in values if found]
        off.append(abs(last[-1] - end) if last else np.inf)
    what = f"{name}, {beyond:g} degC below {end:.1f} degC"
    return f"| {what} | {max(first):.0f} | {max(gaps)} | {max(off):.1f} |"


FURNACE = next(case for case in PLANTS if case.name == "furnace")
LEVEL = 30.0  # percent of each winding, at which the furnace is linearised


def furnace_model(dt: float = 20.0) -> Model:
    """Return the furnace linearised at rest under equal windings: what a user has who knows its numbers."""
    plant, n_u = FURNACE.make(), len(FURNACE.inputs)
    u = np.full(n_u, LEVEL)
    plant.settle(u.tolist(), 60000.0)
    x, n = np.array(plant.x), len(plant.x)

    def rates(z: np.ndarray) -> np.ndarray:
        return np.array(plant.rates(z[:n].tolist(), z[n:].tolist(), [], Changes()))

    at = np.concatenate([x, u])
    slope = np.array([(rates(at + e) - rates(at - e)) / 2e-3 for e in 1e-3 * np.eye(n + n_u)]).T
    whole = np.zeros((n + n_u, n + n_u))
    whole[:n] = slope
    step = expm(whole * dt)[:n]
    C = np.eye(n)[plant.shown]
    A, B = step[:, :n], step[:, n:]
    model = StateSpaceModel(
        tuple(s.name for s in FURNACE.inputs), (), tuple(s.name for s in FURNACE.outputs),
        A=A, B=B, C=C, c=x - A @ x - B @ u, dt=dt, spread=np.diag(np.full(n, 400.0)),
    )  # fmt: skip
    names = [s.name for s in FURNACE.outputs]
    units = {s.name: s.unit for s in (*FURNACE.inputs, *FURNACE.outputs)}
    valid = {s.name: (s.low, s.high) for s in FURNACE.inputs} | dict.fromkeys(names, (20.0, 220.0))
    return Model(model, {}, dt=dt, units=units, valid=valid, noise={s.name: s.noise for s in FURNACE.outputs})


def furnace_loop(controller: Controller, offsets: np.ndarray, seed: int) -> list[Loop]:
    """Return the loops of the controlled outputs whose sensors are off from the start."""
    plant, rng, dt = FURNACE.make(), np.random.default_rng([seed, 3]), controller.dt
    names = [s.name for s in FURNACE.outputs]
    kept = [names.index(name) for name in controller.controlled]
    noise, rows, statuses, advices = np.array([s.noise for s in FURNACE.outputs]), [], [], []
    n = round(FURNACE.seconds / dt)
    for k in range(2 * n):
        shown, target = plant.read() + offsets, FURNACE.targets[k // n]
        noisy = shown + noise * rng.standard_normal(len(names))
        reading = dict(zip(names, noisy.tolist(), strict=True)) | {"time_s": k * dt}
        if not k:
            controller.reset(reading)
        move = controller.step(reading, target)
        rows.append((k * dt, *shown[kept], target))
        statuses.append(move.status)
        advices.append(move.advice)
        plant.run(move.drives([s.name for s in FURNACE.inputs]), dt)
    time_s, *shown_rows, goal = np.array(rows).T
    return [Loop(time_s, values, goal, statuses, advices) for values in shown_rows]


def furnace_rows(seeds: list[int], compiled: bool) -> list[str]:
    """Return the rows of six sensors: that are right, and that are off."""
    model = furnace_model()
    design = default_design(model, controlled=tuple(output for _, output in FURNACE.pairs))
    controller = Controller(model, design, compiled=compiled)
    signs = np.array(list(product((-1.0, 1.0), repeat=4)))
    off = np.column_stack(
        [signs, signs[:, 0] * signs[:, 1] * signs[:, 2], signs[:, 1] * signs[:, 2] * signs[:, 3]]
    )
    lines = []
    for name, ways in {"none": np.zeros((1, 6)), "all six sensors off by 1 degC": off}.items():
        loops = [loop for way in ways for seed in seeds for loop in furnace_loop(controller, way, seed)]
        lines.append(line(f"furnace, {name}", loops, FURNACE.band))
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Run, print, write."""
    given, model = asked(__doc__, "0"), model_of()
    seeds = [int(seed) for seed in given.seeds.split(",")]
    controller = Controller(model, default_design(model), compiled=wanted() and not given.python)
    heads = "| plant, sensors | overshoot [degC] | offset [degC] | settled after [s] | status |"
    lines = [heads, "|---|---|---|---|---|"]
    print(*lines, sep="\n")
    for name, faults in FAULTS.items():
        for plant, truth in TRUTHS.items():
            if given.only in f"{plant}, {name}":
                loops = [close_loop(controller, truth, f, (38.0, 23.0), s) for f in faults for s in seeds]
                lines.append(line(f"{plant}, {name}", loops))
                print(lines[-1], flush=True)
    if given.only in "furnace, all six sensors off by 1 degC":
        lines += furnace_rows(seeds, wanted() and not given.python)
    heads = "| target | reported after [s] | samples not, after that | value off by [degC] |"
    lines += ["", heads, "|---|---|---|---|"]
    print(*lines[-3:], sep="\n")
    for plant, truth in TRUTHS.items():
        for beyond in (1.0, 10.0):
            lines.append(reach_line(controller, plant, truth, beyond, seeds))
            print(lines[-1], flush=True)
    if given.markdown is not None:
        given.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
