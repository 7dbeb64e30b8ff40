"""Ten plants from logs to a loop: identified, tuned for and run on the truth with defaults, beside peers.

    python benchmarks/control/ten_plants.py --plants delay,tanks --keep FOLDER --markdown ten.md

For each plant of ``truths.py``: two logs -> ``identify`` -> ``tune`` with the spec of its user -> the
controller on the truth that made the logs, beside the PI that ``tune`` found, PI by SIMC from the same logs
and do-mpc (``opponents.py``).  From rest two targets, then at the second the plant changes and nobody
measures it. Figures are of what the sensors show without their noise, the worst of controlled outputs and
seeds:

* settling of both targets [s], the last time outside the band; overshoot beyond a target;
* offset: mean error of the last fifth of the time after the change; IAE of all three parts [s times unit];
* energy: integral of the squared drives [s at full drive]; moves: sum of changes in whole ranges.

With ``--keep`` plants and controllers are read from there where they are there already; with ``--default``
nothing is tuned, the MPC is the default design under the spec.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from more_truths import MORE_CASES
from opponents import DoMPC, SimcPI, first_order
from truths import CASES, Array, Case, Signal, record

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import Spec, spec_from_dict
from thermogrip.mpc.interface import Controller as Loop
from thermogrip.mpc.tuning.design_review import review
from thermogrip.mpc.tuning.tune import tune
from thermogrip.sysid.identification import identify
from thermogrip.sysid.plant.plant import Plant

OFFSET, RANGE_SHARE, OVERSHOOT, MOVES, NEAR = 0.05, 0.005, 0.3, 1.5, 1.05


class Player(Protocol):
    """What stands in a row."""

    dt: float

    def reset(self, reading: Mapping[str, float]) -> None: ...
    def step(self, reading: Mapping[str, float], target: float) -> tuple[list[float], str]: ...


class Ours:
    """A controller of the package; inputs that stay are put beside its drives."""

    def __init__(self, case: Case, loop: Loop) -> None:
        self.case, self.loop, self.dt = case, loop, case.log_dt

    def reset(self, reading: Mapping[str, float]) -> None:
        self.loop.reset(reading)

    def step(self, reading: Mapping[str, float], target: float) -> tuple[list[float], str]:
        move = self.loop.step(reading, target)
        moved = [s.name for s in self.case.inputs if s.name not in self.case.switches]
        given = iter(move.drives(moved))
        return [self.case.switches.get(s.name) or next(given) for s in self.case.inputs], move.status


@dataclass(frozen=True)
class Result:
    """The figures of one run."""

    settle: tuple[float, ...]  # s, of each target
    overshoot: float
    offset: float
    iae: float
    energy: float
    moves: float
    limited: bool  # whether a drive stood at its limit at the end
    status: str


def run(case: Case, player: Player, seed: int) -> Result:
    """Close the loop on the truth."""
    plant, rng = case.make(), np.random.default_rng([seed, 7])
    plant.rng = np.random.default_rng([seed, 8])
    plant.settle(case.rest, 40 * case.hold[1])
    plant.changes.running = True
    n, dt = round(case.seconds / player.dt), player.dt
    wanted = [output for _, output in case.pairs]
    rows = [[s.name for s in case.outputs].index(name) for name in wanted]
    goals = [case.targets[0], case.targets[1], case.targets[1]]
    shown, applied, statuses = [plant.read()[rows]], [list(case.rest)], Counter[str]()
    for k in range(3 * n):
        if k == 2 * n:
            plant.disturb()
        reading = {"time_s": k * dt}
        for s, value in zip(
            (*case.outputs, *case.disturbances), (*plant.read(), *plant.outside()), strict=True
        ):
            reading[s.name] = float(value + s.noise * rng.standard_normal())
        for s, value in zip(case.inputs, applied[-1], strict=True):
            reading[s.name] = value
        if not k:
            player.reset(reading)
        u, status = player.step(reading, goals[k // n])
        statuses[status] += 1
        if len(u) < len(case.inputs):
            u = [*u, *case.switches.values()]
        plant.run(u, dt)
        shown.append(plant.read()[rows])
        applied.append(u)
    moved = [j for j, s in enumerate(case.inputs) if s.name not in case.switches]
    drives = [case.inputs[j] for j in moved]
    return figures(case, np.array(shown), np.array(applied)[:, moved], drives, n, dt, statuses)


def figures(
    case: Case, y: Array, u: Array, drives: Sequence[Signal], n: int, dt: float, statuses: Counter[str]
) -> Result:
    """Return the figures of a run: outputs (3 n + 1, n_y), drives (3 n + 1, n_u), the first at rest."""
    settle, over = [], 0.0
    for at, goal in enumerate(case.targets):
        part = y[at * n : (at + 1) * n + 1]
        outside = np.flatnonzero(np.any(np.abs(part - goal) > case.band, axis=1))
        last = outside[-1] + 1 if outside.size else 0
        settle.append(last * dt if last <= n else float("inf"))
        side = np.sign(goal - part[0])
        over = max(over, float(np.max(side * (part - goal))))
    goals = np.repeat([case.targets[0], case.targets[1], case.targets[1]], n)[:, None]
    low, high = np.array([[s.low for s in drives], [s.high for s in drives]])
    span = high - low
    end = u[-max(1, n // 5) :]
    full = np.maximum(np.abs(low), np.abs(high))
    words = ", ".join(f"{name} {100 * count / (3 * n):.0f} %" for name, count in statuses.most_common(2))
    return Result(
        tuple(settle),
        over,
        float(np.max(np.abs(np.mean(y[-max(1, n // 5) :] - goals[-1], axis=0)))),
        float(np.sum(np.max(np.abs(y[1:] - goals), axis=1)) * dt),
        float(np.sum((u[1:] / full) ** 2) * dt),
        float(np.sum(np.abs(np.diff(u, axis=0)) / span)),
        bool(np.any(np.mean((end <= low + 1e-6) | (end >= high - 1e-6), axis=0) > 0.5)),
        words,
    )


def logs_of(case: Case) -> list[tuple[Array, dict[str, Array]]]:
    """Return the logs of a case."""
    return [record(case, seed) for seed in range(case.logs)]


def as_log(case: Case, at: int, time_s: Array, columns: Mapping[str, Array]) -> Log:
    """Return a log as the package has it."""
    roles = [(case.inputs, "input"), (case.outputs, "output"), (case.disturbances, "disturbance")]
    variables = {s.name: (columns[s.name], s.unit, role) for group, role in roles for s in group}
    return make_log(time_s, variables, name=f"{case.name}{at}")


def identified(case: Case, logs: list[tuple[Array, dict[str, Array]]], keep: Path | None) -> Plant:
    """Return the plant of the logs."""
    path = None if keep is None else keep / f"{case.name}.plant.json"
    if path is not None and path.exists():
        return Plant.load(path)
    began = time.process_time()
    found = identify([as_log(case, at, *log) for at, log in enumerate(logs)], case.network)
    errors = ", ".join(f"{name} {value:.3f}" for name, value in found.errors().items())
    print(
        f"{case.name}: identify kept {found.model} ({found.plant.scores.structure}), good {found.good}; "
        f"held out: {errors}; {time.process_time() - began:.0f} s",
        flush=True,
    )
    if path is not None:
        found.plant.save(path)
    return found.plant


def tuned(case: Case, plant: Plant, spec: Spec, keep: Path | None) -> Controller:
    """Return the tuned controller, and print what was found."""
    path = None if keep is None else keep / f"{case.name}.controller.json"
    if path is not None and path.exists():
        return Controller.load(path)
    began = time.process_time()
    found = tune(plant, spec)
    spent = time.process_time() - began
    scores = ", ".join(f"{name} {value:.2f}" for name, value in found.scores.items())
    print(f"{case.name}: tune {found.verdict}, meets {found.meets_spec}; {scores}; {spent:.0f} s", flush=True)
    for check in review(found.controller):
        if check.verdict != "pass":
            print(f"{case.name}: review {check.verdict}, {check.name}: {check.finding}", flush=True)
    if path is not None:
        found.save(path)
    return found.controller


HEAD = (
    "| plant | controller | settling [s] | overshoot | offset | IAE | energy [s] | moves | status |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def row(case: Case, name: str, results: Sequence[Result]) -> str:
    """Return a line of the table."""
    settle = [max(r.settle[at] for r in results) for at in range(len(case.targets))]
    times = ", ".join(f"{s:.0f}" if np.isfinite(s) else "never" for s in settle)
    worst = max(results, key=lambda r: abs(r.offset))
    figures = [max(r.overshoot for r in results), worst.offset]
    means = [np.mean([getattr(r, key) for r in results]) for key in ("iae", "energy", "moves")]
    said = " | ".join(f"{v:.3g}" for v in (*figures, *means))
    limited = " (drive at its limit)" if worst.limited else ""
    return f"| {case.name} | {name} | {times} | {said} | {results[0].status}{limited} |"


def evaluate(case: Case, found: Mapping[str, list[Result]]) -> str:
    """Return which musts of the MPC hold."""
    ours, simc = found["mpc"], found.get("simc", [])
    said = []
    offset = max((r.offset for r in ours if not r.limited), default=0.0)
    said.append(f"offset {'yes' if offset <= OFFSET else 'no'}")
    over = max(r.overshoot for r in ours)
    said.append(f"overshoot {'yes' if over <= max(OVERSHOOT, RANGE_SHARE * case.range) else 'no'}")
    peers = [_total(found[key]) for key in ("simc", "do-mpc") if found.get(key)]
    if peers:
        said.append(f"settling {'yes' if _total(ours) <= NEAR * min(peers) else 'no'}")
    if simc:
        moves = [np.mean([r.moves for r in part]) for part in (ours, simc)]
        said.append(f"moves {'yes' if moves[0] <= MOVES * moves[1] else 'no'} ({moves[0] / moves[1]:.2f})")
    if simc and "pi" in found:
        said.append(f"own PI {'yes' if _total(found['pi']) <= NEAR * _total(simc) else 'no'}")
    return f"{case.name}: " + ", ".join(said)


def _total(results: Sequence[Result]) -> float:
    return float(np.mean([sum(r.settle) for r in results]))


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", default=",".join(case.name for case in CASES), help="by commas")
    parser.add_argument("--seeds", default="0", help="of noise and clouds in the loop, by commas")
    parser.add_argument("--without", default="", help="controllers to leave out: mpc, pi, simc, do-mpc")
    parser.add_argument("--keep", type=Path, help="folder of plants and controllers")
    parser.add_argument(
        "--default", action="store_true", help="the default design, untuned, and no PI of tune"
    )
    parser.add_argument("--markdown", type=Path, help="also write the table here")
    given = parser.parse_args()
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
    by_name = {case.name: case for case in (*CASES, *MORE_CASES)}
    lines, marks = [HEAD], []
    print(HEAD)
    for name in given.plants.split(","):
        case = by_name[name]
        found: dict[str, list[Result]] = {}
        without = [*given.without.split(","), *(["pi"] if given.default else [])]
        for player_name, player in players(case, without, given.keep, default=given.default):
            found[player_name] = [run(case, player, int(seed)) for seed in given.seeds.split(",")]
            lines.append(row(case, player_name, found[player_name]))
            print(lines[-1], flush=True)
        if "mpc" in found:
            marks.append(evaluate(case, found))
            print(marks[-1], flush=True)
    if given.markdown is not None:
        given.markdown.write_text("\n".join([*lines, "", *marks, ""]), encoding="utf-8")


def players(
    case: Case, without: Sequence[str], keep: Path | None, *, default: bool = False
) -> list[tuple[str, Player]]:
    """Return who plays; a stage that refuses is printed."""
    logs = logs_of(case)
    found: list[tuple[str, Player]] = []
    spec = spec_from_dict(case.spec)
    try:
        plant = identified(case, logs, keep)
        wide = spec.widened(plant)
        controller = Controller(wide, spec.design(wide)) if default else tuned(case, plant, spec, keep)
        if "mpc" not in without:
            found.append(("mpc", Ours(case, controller)))
        if "pi" not in without:
            # under the limits of the spec, as it was tuned: the MPC may have been given less of a drive
            wide = replace(spec.design(controller.plant), loops=controller.design.loops)
            found.append(("pi", Ours(case, PIController(plant, wide))))
        if "do-mpc" not in without and importlib.util.find_spec("do_mpc") is not None:
            found.append(("do-mpc", DoMPC(controller.plant, spec.design(controller.plant), case.rest)))
    except UserError as error:
        print(f"{case.name}: refused: {error}", flush=True)
    if "simc" not in without:
        models = {output: first_order(case, logs, output)[drive] for drive, output in case.pairs}
        print(f"{case.name}: {models}", flush=True)
        found.append(("simc", SimcPI(case, models, case.log_dt)))
    return found


if __name__ == "__main__":
    warnings.simplefilter("default")
    sys.exit(main())
