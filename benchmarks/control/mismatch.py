"""Right when the model is not: closed loops on plants that differ from the controller's in structure.

    python benchmarks/control/mismatch.py --markdown mismatch.md

The controller has the reference model, with the default design; the plant is ``simulator.py``'s, with one
thing that the model does not know.  From rest at 25 degC the skin is sent to 38, 23, 45 and 20 degC, five
minutes each, with 0.02 degC of noise on every sensor.  Figures are of what the skin's sensor shows without
its noise:

* settling: the last time outside 0.25 degC of the target, over the time that full drive alone needs from
  the same state to reach the band, both to 0.1 s; mean and worst of targets and seeds;
* overshoot beyond the target, worst; offset: mean error of the last 60 s of a target, worst;
* status: the first one other than ``ok``, when, and what was said.

A target that full drive does not reach does not count.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from simulator import OUTPUTS, SKIN, Plant, Truth, full_drive_time

sys.path.insert(0, str(Path(__file__).parents[1] / "mpc"))
from problem import MODEL, ReferenceModel  # the equations, as the package takes a class of one's own

from thermogrip.mpc.closed_loop.simulate import RecordedController
from thermogrip.mpc.controllers.loop_monitor import LoopMonitor
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.interface import Move
from thermogrip.sysid.models.jit_rollout import Kernel
from thermogrip.sysid.models.model import Sizes
from thermogrip.sysid.plant.plant import Plant as Model

TARGETS, SECONDS = (38.0, 23.0, 45.0, 20.0), 300.0
BAND, NOISE, CURRENT = 0.25, 0.02, 5.0
GRID = 0.1  # s, of what is evaluated
OFFSET, OVERSHOOT = 0.05, 0.5  # degC: what may be left, how far beyond a target a skin may go


@dataclass(frozen=True)
class Case:
    """A row: a plant, and the overshoot that is allowed it [degC]."""

    name: str
    truth: Truth
    overshoot: float = OVERSHOOT


CASES = (
    Case("model is right", Truth()),
    Case("every number off", Truth(0.0465, 2.15, 0.60, 20.0, 1.85, 0.18, 0.2, 7.2, room=26.5, delay=2.1)),
    Case("gain -30 %", Truth(seebeck=0.035)),
    Case("gain +30 %", Truth(seebeck=0.065)),
    Case("delay -50 %", Truth(delay=1.0)),
    Case("delay +50 %", Truth(delay=3.0)),
    Case("delay +100 %", Truth(delay=4.0), 1.0),
    Case("lag +3 s", Truth(sensor_lag=3.0)),
    Case("lag +8 s", Truth(sensor_lag=8.0)),
    Case("lag +15 s", Truth(sensor_lag=15.0), 1.0),
    Case("second layer inside", Truth(layer=15.0)),
    Case("second layer outside", Truth(layer=5.0, outside=True)),
    Case("fouling 5 % a minute", Truth(fouling=0.05)),
    Case("dead zone 0.3 A", Truth(dead_zone=0.3)),
    Case("Peltier fades by 17 %", Truth(fading=0.17)),
)


#: What is not known of the model's numbers, as standard deviations of their logarithms.
POSTERIOR = {"S": 0.07, "R": 0.07, "K": 0.07, "F": 0.05, "k_fs": 0.05, "G_h": 0.1, "G_c": 0.2, "G_s": 0.2}


class InRoom(ReferenceModel):
    """The reference equations with the room as a measured disturbance, and numbers that are not certain."""

    disturbances, parameters = ("t_ambient",), tuple(POSTERIOR)

    def step(self, x, u, d, p, dt):  # type: ignore[no-untyped-def]
        """Return the state one step later."""
        here = ReferenceModel({**self.numbers, "a": d[0]}, dt=self.dt)
        here.numbers |= zip(self.parameters, list(p), strict=True)
        return here.step(x, u, (0.0, 0.0), p, dt)

    def rollout(self, x0, u, d, p, dt):  # type: ignore[no-untyped-def]
        """Simulate a batch in machine code."""
        if not hasattr(self, "_kernel"):
            sizes = Sizes(self.n_x, 1, 1, len(self.parameters))
            self._kernel = Kernel(self.step, self.output, sizes)
        return self._kernel.rollout(*(np.ascontiguousarray(v, dtype=float) for v in (x0, u, d, p)), dt)


@dataclass(frozen=True)
class Run:
    """One closed loop; rows of samples, and of the skin ``GRID`` apart."""

    time_s: np.ndarray
    skin: np.ndarray  # what its sensor shows, without noise, from the first sample on
    target: np.ndarray
    current: np.ndarray
    moves: tuple[Move, ...]
    bounds: tuple[float, ...]  # s, by target

    def segments(self) -> list[tuple[float, float, float]]:
        """Return settling time [s], overshoot and offset [degC] of each target that can be reached."""
        found, before, each = [], float(self.skin[0]), round(SECONDS / GRID)
        for at, bound in enumerate(self.bounds):
            goal, skin = TARGETS[at], self.skin[at * each : (at + 1) * each]
            outside = np.flatnonzero(np.abs(skin - goal) > BAND)
            last = outside[-1] + 1 if outside.size else 0
            settled = last * GRID if last < len(skin) else np.inf
            beyond = max(0.0, float(np.max(np.sign(goal - before) * (skin - goal))))
            offset = float(np.mean(skin[-round(60.0 / GRID) :] - goal))
            before = goal
            if np.isfinite(bound):
                found.append((settled, beyond, offset))
        return found

    def reached(self) -> list[float]:
        """Return the times of full drive [s] of those targets."""
        return [bound for bound in self.bounds if np.isfinite(bound)]

    def first_word(self) -> tuple[float, Move] | None:
        """Return when [s] the first status other than ok came, and with what."""
        for time_s, move in zip(self.time_s, self.moves, strict=True):
            if move.status != "ok":
                return float(time_s), move
        return None


def model_of() -> Model:
    """Return the controller's plant."""
    return Model(
        InRoom(MODEL),
        {name: MODEL[name] for name in POSTERIOR},
        dt=0.5,
        units={"current": "A"},
        noise=dict.fromkeys(OUTPUTS, NOISE),
        valid={"current": (-CURRENT, CURRENT), "t_surface": (5.0, 50.0)},
        free=tuple(POSTERIOR),
        scales=dict.fromkeys(POSTERIOR, "log"),
        covariance=np.diag(np.square(list(POSTERIOR.values()))),
    )


def close_loop(
    controller: Controller, truth: Truth, seed: int = 0, targets: Sequence[float] = TARGETS
) -> Run:
    """Return a closed loop on a plant."""
    rng, plant, dt = np.random.default_rng(seed), Plant(truth), controller.dt
    slew = controller.design.slew_per_s["current"]
    rows, skin, moves, bounds, current = [], [], [], [], 0.0
    for k in range(round(len(targets) * SECONDS / dt)):
        at = int(k * dt // SECONDS)
        shown = plant.read()
        if k * dt >= len(bounds) * SECONDS:
            bounds.append(full_drive_time(plant, targets[at], BAND, current=CURRENT, slew=slew, now=current))
        noisy = shown + NOISE * rng.standard_normal(3)
        reading = dict(zip(OUTPUTS, noisy.tolist(), strict=True)) | {"time_s": k * dt}
        reading["t_ambient"] = truth.room + NOISE * rng.standard_normal()
        if not k:
            controller.reset(reading)
        moves.append(controller.step(reading, targets[at]))
        current = float(moves[-1].drive)
        rows.append((k * dt, targets[at], current))
        for _ in range(round(dt / GRID)):
            skin.append(plant.read()[SKIN])
            plant.run(current, GRID)
    time_s, target, drive = np.array(rows).T
    return Run(time_s, np.array(skin), target, drive, tuple(moves), tuple(bounds))


def line(case: Case, runs: list[Run]) -> str:
    """Return a row of the table over the runs of one case."""
    ratio = over = offset = 0.0
    for run in runs:
        for (settled, beyond, left), bound in zip(run.segments(), run.reached(), strict=True):
            ratio, over = max(ratio, settled / bound), max(over, beyond)
            offset = max(offset, abs(left))
    words = [run.first_word() for run in runs]
    seen = [w for w in words if w is not None]
    late = max((w[0] for w in seen), default=np.inf) if len(seen) == len(runs) else np.inf
    said = f"{late:.0f} s: {seen[0][1].status}, {seen[0][1].advice}" if np.isfinite(late) else "ok"
    if seen and not np.isfinite(late):
        said = f"{len(seen)} of {len(runs)} runs: {seen[0][1].status}, {seen[0][1].advice}"
    good = np.isfinite(ratio) and over <= case.overshoot and offset <= OFFSET
    mean = np.mean([s[0] / b for run in runs for s, b in zip(run.segments(), run.reached())])
    shown = f"{mean:.2f}, {ratio:.2f}" if np.isfinite(ratio) else "never"
    return f"| {case.name} | {shown} | {over:.2f}, {offset:.3f} | {said} | {'yes' if good else 'no'} |"


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="0,1", help="of the noise, by commas")
    parser.add_argument("--only", default="", help="rows whose name has this in it")
    parser.add_argument("--markdown", type=Path, help="also write the table here")
    given, model = parser.parse_args(), model_of()
    controller = Controller(model, default_design(model))
    controller = RecordedController(controller, LoopMonitor(model, controller.design))
    lines = [
        "| plant | settling / full drive: mean, worst | overshoot, offset [degC] | first status | good |",
        "|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    for case in CASES:
        if given.only in case.name:
            runs = [close_loop(controller, case.truth, int(seed)) for seed in given.seeds.split(",")]
            lines.append(line(case, runs))
            print(lines[-1], flush=True)
    if given.markdown is not None:
        given.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
