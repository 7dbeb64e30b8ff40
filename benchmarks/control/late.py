"""Drives that act later than the model has it, on truths of other code: does the search for them pay?

    python benchmarks/control/late.py --keep FOLDER [--plants tclab,hotend] [--times 1,1.5,2,3] [--samples 2]

Plants and tuned controllers of ``ten_plants.py --keep FOLDER`` run on the truths of ``truths.py``, whose
drives come later than in the logs: the apparent delay of the controlled outputs so many times as long (1: the
truth as it is), or later by ``--samples`` of the controller besides.  From rest to both targets, with
``mpc/estimator/late_drives.py`` looking and without: settling, overshoot and offset of the last fifth, moves
in ranges of the drives, what was said and from when on.  What is said of the truth as it is is a false alarm.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from ten_plants import identified, logs_of, tuned
from truths import CASES, Case

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.spec import spec_from_dict
from thermogrip.mpc.tuning.objective import apparent_delay

PLANTS = "tclab,hotend,tanks,delay,room,peltier"


def close_loop(case: Case, controller: Controller, later_s: float, seed: int, *, look: bool) -> str:
    """Run both targets on the truth whose drives come so much later; return a line."""
    plant, rng = case.make(), np.random.default_rng([seed, 7])
    plant.rng = np.random.default_rng([seed, 8])
    if later_s:
        plant.late += round(later_s / plant.step)
    plant.settle(case.rest, 40 * case.hold[1])
    plant.changes.running = True
    n, dt = round(case.seconds / case.log_dt), case.log_dt
    wanted = [output for _, output in case.pairs]
    rows = [[s.name for s in case.outputs].index(name) for name in wanted]
    moving = [s.name for s in case.inputs if s.name not in case.switches]
    fresh = Controller(controller.plant, controller.design)
    if not look:
        fresh.lateness.note = lambda *given: False  # type: ignore[method-assign]
    shown, applied, said = [plant.read()[rows]], [list(case.rest)], dict[str, float]()
    for k in range(2 * n):
        reading = {"time_s": k * dt}
        truth = (*plant.read(), *plant.outside())
        for s, value in zip((*case.outputs, *case.disturbances), truth, strict=True):
            reading[s.name] = float(value + s.noise * rng.standard_normal())
        reading |= {s.name: value for s, value in zip(case.inputs, applied[-1], strict=True)}
        if not k:
            fresh.reset(reading)
        move = fresh.step(reading, case.targets[k // n])
        given = iter(move.drives(moving))
        u = [case.switches.get(s.name) or next(given) for s in case.inputs]
        if move.status == "mismatch":
            said.setdefault(move.advice.split(":")[0], k * dt)
        plant.run(u, dt)
        shown.append(plant.read()[rows])
        applied.append(u)
    return figures(case, np.array(shown), np.array(applied), n, said, fresh)


def figures(
    case: Case, y: np.ndarray, u: np.ndarray, n: int, said: dict[str, float], controller: Controller
) -> str:
    """Return the line of a run."""
    settle, over, offset = [], 0.0, 0.0
    for at, goal in enumerate(case.targets):
        part = y[at * n : (at + 1) * n + 1]
        outside = np.flatnonzero(np.any(np.abs(part - goal) > case.band, axis=1))
        last = outside[-1] + 1 if outside.size else 0
        settle.append(f"{last * case.log_dt:.0f}" if last <= n else "never")
        over = max(over, float(np.max(np.sign(goal - part[0]) * (part - goal))))
        offset = max(offset, float(np.max(np.abs(np.mean(part[-n // 5 :] - goal, axis=0)))))
    span = np.array([s.high - s.low for s in case.inputs])
    moves = float(np.sum(np.abs(np.diff(u, axis=0)) / span))
    words = "; ".join(f"{what} ({when:.0f} s)" for what, when in said.items()) or "nothing"
    late = ", ".join(f"{value:.3g}" for value in controller.lateness.late)
    return f"{', '.join(settle)} s; {over:.3g}; {offset:.2g}; {moves:.3g}; late {late} s; {words}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", default=PLANTS, help="by commas")
    parser.add_argument("--times", default="1,1.5,2,3", help="the apparent delay, by commas")
    parser.add_argument("--samples", type=int, default=0, help="also later by so many of the controller's")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--keep", type=Path, required=True, help="folder of plants and controllers")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    by_name = {case.name: case for case in CASES}
    for name in given.plants.split(","):
        case = by_name[name]
        plant = identified(case, logs_of(case), given.keep)
        controller = tuned(case, plant, spec_from_dict(case.spec), given.keep)
        delay = apparent_delay(controller.plant, controller.controlled)
        later = [(float(times) - 1) * delay for times in given.times.split(",")]
        later += [given.samples * controller.dt] if given.samples else []
        print(f"{name}: delay {delay:.3g} s, sample {controller.dt:g} s", flush=True)
        for seconds in later:
            for seed in map(int, given.seeds.split(",")):
                for look in (False, True):
                    line = close_loop(case, controller, seconds, seed, look=look)
                    print(f"  +{seconds:.3g} s, {'looks' if look else 'not  '}: {line}", flush=True)


if __name__ == "__main__":
    main()
