"""Do loops that do not swing say that they do: hours at rest, targets and loads that come and go, noise.

    python benchmarks/control/swings.py --plants tclab,tanks --keep FOLDER

The plants of ``ten_plants.py`` (its folder has what was identified) under the default design and under PI by
SIMC for the identified plant: each for ``--samples`` samples of the controller

* at rest at the first target, with the noise of the case and with twice as much;
* with targets between the first and the last that change at random times, 0.1 to 2 times as long as the case
  holds one;
* with the case's load coming and going, 0.5 to 2 times as long.

Printed is in how many samples the status is which, and which words were said.  ``--relay`` closes a loop of
each plant by a relay with hysteresis instead, beside which the monitor looks on: how many of its periods pass
before it says so.  ``--random 300000``: how many alarms a PI by SIMC gives under random loads of three
correlation times, whose error has a standard deviation of 0.33, 0.5, 0.75 and 1 of what is allowed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from more_truths import MORE_CASES
from scipy.signal import lfilter
from ten_plants import Ours, identified, logs_of
from truths import CASES, Case

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import spec_from_dict
from thermogrip.mpc.estimator.oscillation import OscillationMonitor
from thermogrip.mpc.plant.prediction import apparent_delays
from thermogrip.sysid.plant.plant import Plant

WAYS = {"rest": 1.0, "rest, twice the noise": 2.0, "targets": 1.0, "loads": 1.0}


def play(
    case: Case, loop: Controller | PIController, way: str, samples: int
) -> tuple[Counter[str], list[str]]:
    """Return how often each status was given, and the words that swings and limits had."""
    plant, rng = case.make(), np.random.default_rng([0, 9])
    plant.rng = np.random.default_rng([0, 8])
    plant.settle(case.rest, 40 * case.hold[1])
    plant.changes.running = True
    player, every = Ours(case, loop), max(1, round(loop.dt / case.log_dt))
    goal, until, applied = case.targets[0], 2.0 * case.seconds, list(case.rest)
    statuses, said = Counter[str](), list[str]()
    for k in range(samples):
        now = k * every * case.log_dt
        if now >= until and not way.startswith("rest"):
            until = now + case.seconds * rng.uniform(0.1 if way == "targets" else 0.5, 2.0)
            if way == "targets":
                goal = rng.uniform(min(case.targets), max(case.targets))
            else:
                plant.changes.disturbed = not plant.changes.disturbed
        reading = {"time_s": now}
        signals = (*case.outputs, *case.disturbances)
        for s, value in zip(signals, (*plant.read(), *plant.outside()), strict=True):
            reading[s.name] = float(value + WAYS[way] * s.noise * rng.standard_normal())
        reading |= dict(zip([s.name for s in case.inputs], applied, strict=True))
        if not k:
            player.reset(reading)
        move = loop.step(reading, goal)
        statuses[move.status] += 1
        if "swings" in move.advice or "at its limit" in move.advice:
            said.append(f"{now:g} s: {move.advice}")
        given = iter(move.drives([s.name for s in case.inputs if s.name not in case.switches]))
        applied = [case.switches.get(s.name) or next(given) for s in case.inputs]
        plant.run(applied, every * case.log_dt)
    return statuses, said


def relay(case: Case, plant: Plant, samples: int) -> str:
    """Return after how many of its periods a relay with hysteresis is said to swing."""
    truth, rng = case.make(), np.random.default_rng(0)
    truth.settle(case.rest, 40 * case.hold[1])
    truth.changes.running = True
    spec = spec_from_dict(case.spec)
    wide = spec.widened(plant)
    design = spec.design(wide)
    drive, output = case.pairs[0]
    allowed, goal = 2.0 * design.overshoot, float(np.mean(case.targets))
    delays = apparent_delays(plant, (drive,), (output,), design.dt)
    monitor = OscillationMonitor((output,), design.dt, delays, (allowed,))
    j, i = (
        [s.name for s in part].index(name) for part, name in ((case.inputs, drive), (case.outputs, output))
    )
    low, high = case.inputs[j].low, case.inputs[j].high
    rising = case.pairs and apparent_gain(plant, drive, output) > 0
    u, switched = list(case.rest), list[float]()
    for k in range(samples):
        y = float(truth.read()[i] + case.outputs[i].noise * rng.standard_normal())
        if abs(y - goal) > 1.5 * allowed:
            wanted = high if (y < goal) == rising else low
            if wanted != u[j]:
                switched.append(k * design.dt)
            u[j] = wanted
        if said := monitor.note(np.array([y]), np.array([goal]), design.dt):
            return f"{(len(switched) - 1) / 2:.1f} periods: {said[:70]}"
        truth.run(u, design.dt)
    return f"not said in {(len(switched) - 1) / 2:.1f} periods"


def apparent_gain(plant: Plant, drive: str, output: str) -> float:
    """Return by how much a whole range of the drive moves the output."""
    from thermogrip.mpc.plant.prediction import step_response

    return step_response(plant, drive, output).gain


def random_loads(samples: int) -> None:
    """Print how often a PI by SIMC is said to swing under loads of three correlation times."""
    dt, delay, lag, gain, integral = 0.5, 2.0, 20.0, 5.0, 16.0
    rng, keep = np.random.default_rng(1), np.exp(-dt / lag)
    for tau in (2.0, 20.0, 200.0):
        load = lfilter([1.0], [1.0, -np.exp(-dt / tau)], rng.standard_normal(samples))
        y, total, line, errors = 0.0, 0.0, [0.0] * round(delay / dt), np.empty(samples)
        for k in range(samples):
            total -= dt * gain / integral * y
            line.append(total - gain * y)
            y = keep * y + (1 - keep) * (line.pop(0) + load[k])
            errors[k] = y
        errors /= np.std(errors[1000:])
        found = []
        for share in (0.33, 0.5, 0.75, 1.0):
            monitor = OscillationMonitor(("y",), dt, (delay,), (1.0,))
            said = [bool(monitor.note(np.array([e]), np.zeros(1), dt)) for e in (share * errors).tolist()]
            found.append(int(np.count_nonzero(np.diff(np.array(said, dtype=int)) > 0)))
        print(f"load over {tau:g} s, {samples * dt / (4 * delay):.0f} ultimate periods: {found}", flush=True)


def main() -> None:
    """Run, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", default="tclab,tanks,integrator,reactor,hotend,delay,peltier")
    parser.add_argument("--keep", type=Path, help="folder of plants")
    parser.add_argument("--samples", type=int, default=4000)
    parser.add_argument("--relay", action="store_true")
    parser.add_argument("--random", type=int, help="samples under random loads instead")
    given = parser.parse_args()
    if given.random:
        random_loads(given.random)
        return
    by_name = {case.name: case for case in (*CASES, *MORE_CASES)}
    for name in given.plants.split(","):
        case = by_name[name]
        plant = identified(case, logs_of(case), given.keep)
        if given.relay:
            print(f"{name}: {relay(case, plant, given.samples)}", flush=True)
            continue
        spec = spec_from_dict(case.spec)
        wide = spec.widened(plant)
        design = spec.design(wide)
        loops = tuple(replace(p, setpoint=1.0) for p in design.loops)
        for player, loop in (
            ("mpc", Controller(wide, design)),
            ("pi", PIController.of(plant, design, loops)),
        ):
            for way in WAYS:
                counts, said = play(case, loop, way, given.samples)
                hours = given.samples * loop.dt / 3600
                words = f"; {len(said)} with words, first {said[0]}" if said else ""
                print(f"{name}, {player}, {way}, {hours:.1f} h: {dict(counts)}{words}", flush=True)


if __name__ == "__main__":
    main()
