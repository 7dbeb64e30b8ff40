"""How often does the guard cry wolf?  Long runs in which nothing is wrong but the model.

    python benchmarks/rig/nominal.py --plant plant.json --controller controller.json --hours 24 --out nominal.json

Sessions on twins whose plants are posterior draws of the known one, rooms of 18 to 32 degC, targets of 15 to
48 degC, five materials, four grasps in a row on each rig with one guard.  The controller and the guard know
the fit alone; ``--off 0.05`` makes every parameter of the real plant wrong besides, uniformly within 5 % (a
tube's delay within three times that).

Prints hours, grasps, and trips: all are false alarms.  Of k in T hours the upper end of the rate is
chi2(0.95; 2 (k + 1)) / (2 T), 3 / T where there is none.  And for each window and output the largest residual
beyond ``share`` of the swing, which the floors of :class:`~thermogrip.rig.guard.model_checks.ModelSettings` must
exceed; and in how many sessions lower floors would have tripped: the cost of finding a slow fault sooner.
"""
# ruff: noqa: E501

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from thermogrip.mpc import Controller
from thermogrip.rig.guard.guard import Guard, GuardSettings
from thermogrip.rig.guard.model_checks import ModelMonitor, Residual
from thermogrip.rig.guard.plant_mismatch import PlantDrift
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

MATERIALS = ("copper", "iron", "wood", "aluminium", "glass")


SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4)  # of the floors


class Measured(ModelMonitor):
    """A monitor that keeps how far each residual is beyond the share of the swing."""

    beyond: dict[tuple[float, str], list[float]]
    in_a_row: dict[float, Counter[str]]
    tripped: set[float]

    def begin(self) -> None:
        """Forget the last session."""
        self.in_a_row, self.tripped = {share: Counter() for share in SHARES}, set()

    def compare(self) -> list[Residual]:
        """Return what the monitor compares now, and keep it."""
        found, floors = super().compare(), dict(zip(self.settings.windows, self.settings.floors))
        for one in found:
            beyond = one.off - (one.allowed - floors[one.window])
            self.beyond.setdefault((one.window, one.subject), []).append(beyond)
        for share in SHARES:
            allowed = [(one, one.allowed - (1 - share) * floors[one.window]) for one in found]
            alarmed = {one.subject: one.off / most for one, most in allowed if one.off > most}
            again = Counter({name: self.in_a_row[share][name] + 1 for name in alarmed})
            if any(again[name] >= 2 or excess > 1.5 for name, excess in alarmed.items()):
                self.tripped.add(share)
            self.in_a_row[share] = again
        return found


def spoilt(plant: Plant, off: float, rng: np.random.Generator) -> Plant:
    """Return the plant with every parameter off by a share, delays by three times that."""
    values = {}
    for name, value in plant.values.items():
        share = float(rng.uniform(-1.0, 1.0)) * off
        more = 0.2 * share if name == "drive_offset" else share * value * (3.0 if "delay" in name else 1.0)
        values[name] = value + more  # the driver's offset is next to 0, where a share says nothing
    return replace(plant, values=values)


def drift_of(options: argparse.Namespace, plant: Plant) -> PlantDrift | None:
    """Return the drift that is stated to the guard."""
    if not options.drift:
        return None
    kept = Path(tempfile.mkdtemp()) / "rig.json" if options.learn else None
    return PlantDrift.unknown(plant, options.drift, file=kept)


def main() -> None:
    """Run until the time is over and print what was seen."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plant", type=Path, required=True)
    parser.add_argument("--controller", type=Path, required=True)
    parser.add_argument("--hours", type=float, default=48.0, help="simulated")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this long [real minutes]")
    parser.add_argument("--out", type=Path, help="the same as JSON")
    parser.add_argument("--off", type=float, default=0.0, help="how wrong every parameter is besides")
    parser.add_argument("--drift", type=float, default=0.0, help="what is stated to the guard")
    parser.add_argument("--learn", action="store_true", help="let the guard learn from healthy sessions")
    parser.add_argument("--sessions", type=int, default=4, help="on each rig")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    plant, controller = Plant.load(options.plant), Controller.load(options.controller)
    rng, begun = np.random.default_rng(options.seed), time.monotonic()
    beyond: dict[tuple[float, str], list[float]] = {}
    hours, grasps, rigs, sessions = 0.0, 0, 0, 0
    trips: list[str] = []
    lower: Counter[float] = Counter()
    ended: Counter[int] = Counter()
    while hours < options.hours and time.monotonic() - begun < 60 * options.minutes:
        rigs += 1
        real = spoilt(plant.draw(int(rng.integers(options.draws))), options.off, rng)
        rig = Twin(real, ambient=float(rng.uniform(18, 32)), seed=int(rng.integers(1 << 30)))
        guard = Guard(controller.plant, GuardSettings())
        guard.model = Measured(controller.plant, guard.settings.model, drift_of(options, controller.plant))
        guard.model.beyond = beyond
        for k in range(options.sessions):
            guard.model.begin()
            thing = (str(rng.choice(MATERIALS)), float(rng.choice([18.0, 28.0, 43.0])))
            session = run_session(
                rig, controller, float(rng.uniform(15, 48)), hold=float(rng.uniform(0, 120)),
                grasp=thing, guard=guard,
            )  # fmt: skip
            del rig.history[:-2]
            grasps += session.grasps is not None
            hours += float(np.ptp(session.log["time"].values)) / 3600
            sessions += 1
            lower.update(guard.model.tripped)
            if session.trip is not None:
                trips.append(session.trip.line())
                ended[k + 1] += 1
                print(session.trip.line(), flush=True)
    most = float(chi2.ppf(0.95, 2 * (len(trips) + 1))) / (2 * hours)
    found: dict[str, Any] = {
        "off": options.off,
        "hours": round(hours, 1),
        "grasps": grasps,
        "sessions": sessions,
        "rigs": rigs,
    }
    found |= {
        "drift": options.drift,
        "learns": options.learn,
        "ended_in_session": dict(sorted(ended.items())),
    }
    found |= {"trips": trips, "at_most_a_day": round(24 * most, 2)}
    found["sessions_that_lower_floors_would_end"] = {f"{share:g}": lower[share] for share in SHARES}
    found["beyond_share_of_swing_K"] = [
        {
            "window_s": length, "output": name, "compared": len(values),
            "quantile_0.999": round(float(np.quantile(values, 0.999)), 3), "largest": round(max(values), 3),
        }
        for (length, name), values in sorted(beyond.items())
    ]  # fmt: skip
    print(json.dumps(found, indent=1))
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
