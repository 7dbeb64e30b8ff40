"""How often does the guard cry wolf?  Long runs in which nothing is wrong but the model.

    python benchmarks/rig/nominal.py --plant plant.json --controller controller.json --minutes 15

Sessions on twins whose plants are posterior draws of the known one, rooms of 18 to 32 degC, targets of 15 to
48 degC, five materials, four grasps in a row on each rig with one guard.  The controller and the guard know
the fit alone.  Prints hours, grasps, trips (all are false alarms), and for each window and output the largest
residual beyond ``share`` of the swing: what the floors of
:class:`~thermogrip.rig.model_watch.WatchSettings` must exceed.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from thermogrip.mpc import Controller
from thermogrip.rig.guard import Guard, GuardSettings
from thermogrip.rig.model_watch import ModelWatch, Surprise
from thermogrip.rig.session import run_session
from thermogrip.rig.twin import Twin
from thermogrip.sysid.plant import Plant

MATERIALS = ("copper", "iron", "wood", "aluminium", "glass")


class Measured(ModelWatch):
    """A watch that keeps how far each residual is beyond the share of the swing."""

    beyond: dict[tuple[float, str], list[float]]

    def compare(self) -> list[Surprise]:
        """Return what the watch compares now, and keep it."""
        found, floors = super().compare(), dict(zip(self.settings.windows, self.settings.floors))
        for one in found:
            beyond = one.off - (one.allowed - floors[one.window])
            self.beyond.setdefault((one.window, one.subject), []).append(beyond)
        return found


def main() -> None:
    """Run until the time is over and print what was seen."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plant", type=Path, required=True)
    parser.add_argument("--controller", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    plant, controller = Plant.load(options.plant), Controller.load(options.controller)
    rng, begun = np.random.default_rng(options.seed), time.monotonic()
    beyond: dict[tuple[float, str], list[float]] = {}
    hours, grasps, trips = 0.0, 0, 0
    while time.monotonic() - begun < 60 * options.minutes:
        real = plant.draw(int(rng.integers(options.draws)))
        rig = Twin(real, ambient=float(rng.uniform(18, 32)), seed=int(rng.integers(1 << 30)))
        guard = Guard(controller.plant, GuardSettings())
        guard.model = Measured(controller.plant)
        guard.model.beyond = beyond
        for _ in range(4):
            thing = (str(rng.choice(MATERIALS)), float(rng.choice([18.0, 28.0, 43.0])))
            session = run_session(
                rig, controller, float(rng.uniform(15, 48)), hold=float(rng.uniform(0, 120)),
                grasp=thing, guard=guard,
            )  # fmt: skip
            del rig.history[:-2]
            grasps += session.grasps is not None
            hours += float(np.ptp(session.log["time"].values)) / 3600
            if session.trip is not None:
                trips += 1
                print(session.trip.line(), flush=True)
    print(f"{hours:.1f} h, {grasps} grasps, {trips} trips")
    for (length, name), values in sorted(beyond.items()):
        usual = np.quantile(values, 0.999)
        print(f"{length:4.0f} s {name:10s} 99.9 % {usual:.3f} K, largest {max(values):.3f} K")


if __name__ == "__main__":
    main()
