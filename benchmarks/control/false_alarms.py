"""What is said of loops that are well, and how soon of ones that are not.

    python benchmarks/control/false_alarms.py --keep PLANTS [--seed 5]

Four plants of ``eight_truths.py`` with their default designs and a :class:`LoopMonitor` beside.  For three
hours at one target their loads come and go (a draw, a door, a draught, cold granulate) and the supply dips by
5 % for a minute now and then, and for three hours among targets that change every ten minutes: the share of
samples with a status or a word but ok.  Then faults, each for an
hour from a quarter of one on, among targets that change every ten minutes: the first word, and when it came.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
from eight_plants import identified, read
from eight_truths import TRADES, Trade

from thermogrip.mpc.controllers.loop_monitor import LoopMonitor
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design

#: How often a load comes, and how long it stays [s].
PLANTS = {
    "espresso": (600.0, 30.0),
    "kiln": (2700.0, 300.0),
    "bed": (900.0, 120.0),
    "extruder": (1800.0, 300.0),
}
DIP_EVERY, DIP_S, DIP = 1000.0, 60.0, 0.95
FAULTS = ("heater is dead", "gain -40 %", "sensor lags", "sensor is stuck")
BEGINS = 900.0  # s


def watch(
    trade: Trade, keep: Path, hours: float, fault: str = "", *, moves: bool = False, seed: int = 5
) -> list[tuple[float, str, str]]:
    """Return time [s], status and words of each sample; with a fault the target always ``moves``."""
    case, plant = trade.case, trade.case.make()
    model = identified(trade, keep)
    design = default_design(model, controlled=tuple(s.name for s in case.outputs))
    controller, monitor = Controller(model, design), LoopMonitor(model, design)
    every, lasts = PLANTS[case.name]
    rng, now, seen = np.random.default_rng(seed), 0.0, list[tuple[float, str, str]]()
    plant.settle(case.rest, 100 * case.hold[1])
    shown: dict[str, float] = {}
    delay = controller.dt * 4
    for k in range(round(3600.0 * hours / controller.dt)):
        after = fault and now >= BEGINS
        fresh = read(trade, plant, rng)
        if after and fault == "sensor lags":
            share = controller.dt / (controller.dt + delay)
            fresh = {name: shown[name] + share * (value - shown[name]) for name, value in fresh.items()}
        shown = shown if after and fault == "sensor is stuck" else fresh
        reading = {**shown, "time_s": now}
        if not k:
            controller.reset(reading | dict(zip((s.name for s in case.inputs), case.rest, strict=True)))
        begin, far = case.targets
        target = begin if not (fault or moves) else begin + 0.5 * (far - begin) * (int(now // 600.0) % 2)
        move = controller.step(reading, target)
        said = monitor.note(reading, move, target)
        seen.append((now, move.status, said if move.status == "ok" else move.advice))
        u = np.array(move.drives([s.name for s in case.inputs]))
        if after:
            u = u * {"heater is dead": 0.0, "gain -40 %": 0.6}.get(fault, 1.0)
        elif not fault:
            plant.changes.disturbed = now % every > every - lasts
            u = u * (DIP if now % DIP_EVERY < DIP_S else 1.0)
        steps = round(controller.dt / case.log_dt)
        for _ in range(steps):
            plant.run(u.tolist(), case.log_dt)
        now += steps * case.log_dt
    return seen


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keep", type=Path, required=True, help="folder of identified plants")
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=5)
    given = parser.parse_args()
    for trade in TRADES:
        if trade.case.name not in PLANTS:
            continue
        for moves in (False, True):
            seen = watch(trade, given.keep, given.hours, moves=moves, seed=given.seed)
            wrong = [(status, words) for _, status, words in seen if status != "ok" or words]
            most = Counter(wrong).most_common(1)
            where = "moving targets" if moves else "one target"
            share = 100 * len(wrong) / len(seen)
            print(f"{trade.case.name}, {where}: {share:.2f} % of {len(seen)} samples {most}", flush=True)
        for fault in FAULTS:
            run = watch(trade, given.keep, 1.25, fault, seed=given.seed)
            told = [(t, s, w) for t, s, w in run if s != "ok" or w]
            after = [row for row in told if row[0] >= BEGINS]
            first = f"{after[0][0] - BEGINS:.0f} s: {after[0][1]}, {after[0][2]}" if after else "never"
            print(f"  {fault}: {first} ({len(told) - len(after)} words before)", flush=True)


if __name__ == "__main__":
    main()
