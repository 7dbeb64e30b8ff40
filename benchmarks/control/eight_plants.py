"""Default design and tuned controllers on eight plants of other trades, beside do-mpc and PI.

    PYTHONPATH=FOLDER-OF-DO-MPC python benchmarks/control/eight_plants.py --keep PLANTS --markdown eight.md

Each plant of ``eight_truths.py`` is identified from one log.  From rest at its first target it goes to the
second, meets an unmeasured load, which goes again, and returns; the plate follows its profile.  What plays:

* ours: the default design, or with ``--tuned`` what ``tune`` saves, beside the default design and, where that
  is an MPC, the PI that ``tune`` found;
* do-mpc: the same plant, weights, horizon, range and slew, IPOPT, and :class:`opponents.PlainFilter` with
  one bias for each drive;
* simc: a PI with Skogestad's settings for the first-order model of the same identified plant's step;
* simple-pid: the package of that name with these settings, clamped.

IAE, settling (last time outside of the band, from the start of a step or a load), overshoot and offset in
bands, moves as the sum of changes in whole ranges; of the true outputs, the worst of several.  Steps are both
steps, loads are a load's coming and its going.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from eight_truths import TRADES, Trade
from opponents import DoMPC, FirstOrder, SimcPI
from ten_plants import Ours, Player, as_log
from truths import Array, Plant, record

from thermogrip.mpc.controllers.mpc import Controller, load_controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.plant.prediction import step_response
from thermogrip.mpc.tuning.tune import tune
from thermogrip.sysid.identification import identify
from thermogrip.sysid.plant.plant import Plant as Model

# of the best, by default and tuned; of do-mpc's moves
NEAR, NEAR_TUNED, MOVES = 1.10, 1.05, 1.5


class SimplePID:
    """The package simple-pid with the settings of a :class:`opponents.SimcPI`."""

    def __init__(self, pi: SimcPI) -> None:
        self.pi, self.dt = pi, pi.dt

    def reset(self, reading: Mapping[str, float]) -> None:
        """Begin at the drives that hold the start."""
        from simple_pid import PID

        self.loops = []
        for at, name, Kc, Ti, low, high in self.pi.loops:
            usual = {"sample_time": None, "output_limits": (low, high)}
            self.loops.append((at, name, PID(Kc, Kc / Ti, starting_output=self.pi.case.rest[at], **usual)))

    def step(self, reading: Mapping[str, float], target: float) -> tuple[list[float], str]:
        """Return the inputs and a status."""
        u = list(self.pi.case.rest)
        for at, name, loop in self.loops:
            loop.setpoint = target
            u[at] = float(loop(reading[name], dt=self.dt))
        return u, "ok"


@dataclass(frozen=True)
class Part:
    """What a run shows in its steps, or in its loads; settling and IAE are sums."""

    iae: float
    settle: float  # s
    beyond: float  # bands, of a target or in a load
    offset: float  # bands, at the end
    moves: float


@dataclass(frozen=True)
class Result:
    """The figures of a run."""

    steps: Part
    loads: Part
    words: str  # statuses
    ms: float  # a call


def read(trade: Trade, plant: Plant, rng: np.random.Generator) -> dict[str, float]:
    """Return what the sensors show."""
    shown = zip(trade.case.outputs, plant.read(), strict=True)
    values = ((s.name, v + s.noise * rng.standard_normal()) for s, v in shown)
    return {name: float(np.round(v / trade.quantum) * trade.quantum) for name, v in values}


def run(trade: Trade, player: Player, seed: int) -> Result:
    """Close the loop on the truth."""
    case, dt = trade.case, trade.case.log_dt
    parts: list[tuple[Array, Array, Array]] = []  # errors, inputs and what was aimed at, by phase
    words, spent, calls, first = Counter[str](), 0.0, 0, True
    begin, far = case.targets
    phases = [(far, case.seconds, False), (far, trade.load_s, True), (far, case.seconds, False)]
    phases.append((begin, case.seconds, False))
    if trade.profile is not None:
        phases = [(begin, case.seconds, False), (begin, case.seconds, True)]
    for at, (goal, seconds, load) in enumerate(phases):
        if at == 0 or trade.profile is not None:
            plant, rng, u, now = case.make(), np.random.default_rng([seed, 11]), list(case.rest), 0.0
            plant.settle(case.rest, 100 * case.hold[1])
            due, first = 0.0, True
        plant.changes.disturbed = load and trade.profile is None
        errors, inputs, goals = [], [list(u)], []
        for _ in range(round(seconds / dt)):
            every = getattr(player, "loop", player).dt  # ours is called at every reading
            line = [goal if trade.profile is None else trade.profile(now + i * every) for i in range(200)]
            plant.changes.disturbed = load and (trade.profile is None or now >= 70.0)
            reading = read(trade, plant, rng) | {"time_s": now}
            reading |= {s.name: v for s, v in zip(case.inputs, u, strict=True)}
            if first:
                player.reset(reading)
                first = False
            if now >= due - 1e-9:
                began = time.perf_counter()
                u, status = player.step(reading, aim(trade, player, line))
                spent, calls = spent + time.perf_counter() - began, calls + 1
                words[status] += 1
                due = now + player.dt
            errors.append(plant.read() - line[0])
            inputs.append(list(u))
            goals.append(line[0])
            plant.run(u, dt)
            now += dt
        parts.append((np.array(errors), np.array(inputs), np.array(goals)))
    half = [[0, 3], [1, 2]] if trade.profile is None else [[0], [1]]
    said = ", ".join(f"{name} {100 * n / calls:.0f} %" for name, n in words.most_common(3))
    steps, loads = (figures(trade, [parts[i] for i in which], i) for i, which in enumerate(half))
    return Result(steps, loads, said, 1e3 * spent / calls)


def aim(trade: Trade, player: Player, line: list[float]) -> Any:
    """Return a target as a player takes it: ours and do-mpc see what is ahead."""
    if trade.profile is None or not isinstance(player, Ours | DoMPC):
        return line[0]
    return line if isinstance(player, DoMPC) else {trade.case.outputs[0].name: line}


def figures(trade: Trade, parts: Sequence[tuple[Array, Array, Array]], loads: int) -> Part:
    """Return the figures of some phases."""
    case, dt = trade.case, trade.case.log_dt
    span = np.array([s.high - s.low for s in case.inputs])
    iae = settle = beyond = offset = moves = 0.0
    for error, inputs, _ in parts:
        size = np.max(np.abs(error), axis=1)
        outside = np.flatnonzero(size > case.band)
        last = outside[-1] + 1 if outside.size else 0
        iae += float(size.sum() * dt)
        if trade.profile is not None:
            settle += outside.size * dt
        else:
            settle += last * dt if last < len(size) else np.inf
        side = np.sign(-error[0])
        if loads or trade.profile is not None:
            beyond = max(beyond, float(size.max()) / case.band)
        else:
            beyond = max(beyond, float(np.max(error * side)) / case.band)
        end = error[-max(1, len(error) // 5) :]
        offset = max(offset, float(np.max(np.abs(end.mean(axis=0)))) / case.band)
        moves += float(np.sum(np.abs(np.diff(inputs, axis=0)) / span))
    return Part(iae, settle, beyond, offset, moves)


def identified(trade: Trade, keep: Path) -> Model:
    """Return the plant of the log, from the folder where it is there."""
    keep.mkdir(parents=True, exist_ok=True)
    path = keep / f"{trade.case.name}.plant.json"
    if not path.exists():
        times, columns = record(trade.case, 0)
        for s in trade.case.outputs:
            columns[s.name] = np.round(columns[s.name] / trade.quantum) * trade.quantum
        identify([as_log(trade.case, 0, times, columns)]).plant.save(path)
    return Model.load(path)


def players(trade: Trade, keep: Path, which: Sequence[str], tuned: bool) -> list[tuple[str, Player]]:
    """Return who plays."""
    case, plant = trade.case, identified(trade, keep)
    design = default_design(plant, controlled=tuple(s.name for s in case.outputs))
    found: list[tuple[str, Player]] = []
    default = Ours(case, Controller(plant, design))
    if "ours" in which and not tuned:
        found.append(("ours", default))
    elif "ours" in which:
        saved = best(trade, plant, keep)
        found += [("ours", Ours(case, saved)), ("default", default)]
        if isinstance(saved, Controller):
            found.append(("PI of tune", Ours(case, PIController(plant, saved.design))))
    if "do-mpc" in which and importlib.util.find_spec("do_mpc") is not None:
        found.append(("do-mpc", DoMPC(plant, design, case.rest)))
    models = {}
    for drive, output in case.pairs:
        answer, signal = step_response(plant, drive, output), next(s for s in case.inputs if s.name == drive)
        lag = max(answer.delay, plant.dt, case.log_dt)
        models[output] = FirstOrder(answer.gain / (signal.high - signal.low), answer.lag, lag)
    pi = SimcPI(case, models, case.log_dt)
    others = [("simc", pi), ("simple-pid", SimplePID(pi))]
    return found + [(name, player) for name, player in others if name in which]


def best(trade: Trade, plant: Model, keep: Path) -> Controller | PIController:
    """Return what ``tune`` saves for the plant with its own spec, from the folder where it is there."""
    path = keep / f"{trade.case.name}.controller.json"
    if not path.exists():
        began = time.process_time()
        found = tune(plant, Spec.of(plant))
        spent = time.process_time() - began
        print(f"{trade.case.name}: {spent:.0f} s of CPU; {found.finding}", flush=True)
        found.save(path)
    return load_controller(path)


HEAD = (
    "| plant, part | controller | IAE | settling [s] | beyond | offset | moves | status; ms |\n"
    "|---|---|---|---|---|---|---|---|"
)


def judge(found: Mapping[str, Sequence[Result]], part: str, most: float) -> tuple[bool, str]:
    """Return whether ours is near the best in IAE and settling, with no more moves, and how near."""
    mean = {
        name: [np.mean([getattr(getattr(r, part), key) for r in runs]) for key in ("iae", "settle", "moves")]
        for name, runs in found.items()
    }
    iae, settle, moves = mean["ours"]
    others = [v for name, v in mean.items() if name != "ours"]
    best = min(v[1] for v in others)
    near = iae / min(v[0] for v in others), 1.0 if settle <= best else settle / best if best else np.inf
    by = moves / mean["do-mpc"][2] if "do-mpc" in mean else float("nan")
    return max(near) <= most and not by > MOVES, f"IAE {near[0]:.2f}, settling {near[1]:.2f}, moves {by:.2f}"


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", default=",".join(t.case.name for t in TRADES), help="by commas")
    parser.add_argument("--seeds", default="0", help="of the noise in the loop, by commas")
    parser.add_argument("--who", default="ours,do-mpc,simc,simple-pid", help="by commas")
    parser.add_argument("--keep", type=Path, required=True, help="folder of identified plants")
    parser.add_argument("--tuned", action="store_true", help="what tune saves, in place of the default")
    parser.add_argument("--markdown", type=Path, help="also write the table here")
    given = parser.parse_args()
    lines, passed = [HEAD], Counter[str]()
    print(HEAD, flush=True)
    for trade in TRADES:
        if trade.case.name not in given.plants.split(","):
            continue
        found: dict[str, list[Result]] = {}
        for name, player in players(trade, given.keep, given.who.split(","), given.tuned):
            found[name] = [run(trade, player, int(seed)) for seed in given.seeds.split(",")]
            for part in ("steps", "loads"):
                lines.append(row(trade, part, name, found[name]))
                print(lines[-1], flush=True)
        if "ours" in found and len(found) > 1:
            for part in ("steps", "loads"):
                good, said = judge(found, part, NEAR_TUNED if given.tuned else NEAR)
                passed[part] += good
                lines.append(f"{trade.case.name}, {part}: {'yes' if good else 'no'}: {said}")
                print(lines[-1], flush=True)
    lines.append(", ".join(f"{part}: {count}" for part, count in passed.items()))
    print(lines[-1])
    if given.markdown is not None:
        given.markdown.write_text("\n".join([*lines, ""]), encoding="utf-8")


def row(trade: Trade, part: str, name: str, results: Sequence[Result]) -> str:
    """Return a line of the table: means, and the worst of what is in bands."""
    parts = [getattr(r, part) for r in results]
    iae, settle, moves = (np.mean([getattr(p, key) for p in parts]) for key in ("iae", "settle", "moves"))
    beyond, offset = (max(getattr(p, key) for p in parts) for key in ("beyond", "offset"))
    shown = f"{settle:.4g}" if np.isfinite(settle) else "never"
    last = f"{results[0].words}; {np.mean([r.ms for r in results]):.2f}"
    figures = f"{iae:.4g} | {shown} | {beyond:.2f} | {offset:.2f} | {moves:.3g}"
    return f"| {trade.case.name}, {part} | {name} | {figures} | {last} |"


if __name__ == "__main__":
    main()
