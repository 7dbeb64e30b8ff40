"""A day of the rig: grasps one after another for so many simulated hours, while something fails every ten
minutes.

    python benchmarks/rig/day.py --hours 24 --grasps 1000 --out day/ [--plant plant.json --controller
    controller.json]

The device is virtual (its plant a few percent off the one that is known; or a posterior draw of ``--plant``),
the clock is stepped, the grasps are a batch (:mod:`thermogrip.rig.records.batch`).  Faults come at random,
one per ``--every`` seconds on the average, kind and sensor at random; each is repaired, as an operator would,
when it has tripped the session, or after a minute where it has not.  Four guarantees are checked:

* no wrong temperature accepted: of every good grasp the skin at contact is where the device's truth was,
  within ``--near``;
* no limit exceeded by more than the guard's margin, by the truth;
* memory flat: the resident size after half of the grasps and at the end;
* every completed grasp on disk: good runs in the folder = grasps that a session returned.

A trip with no fault on is a false alarm, unless one that nobody had noticed was repaired within the last two
minutes: a sensor that is right again jumps.

It prints one line an hour and one JSON object at the end; every fault, repair and trip is in
``OUT/faults.jsonl`` with its time and the folder of its session.
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.interface import Controller
from thermogrip.rig.drivers.thermogrip import DeviceRefusedError, DeviceRig
from thermogrip.rig.guard.guard import LIMIT_MARGIN, Guard
from thermogrip.rig.guard.plant_mismatch import PlantDrift
from thermogrip.rig.records.batch import Trial, good_run, next_folder
from thermogrip.rig.records.run_folder import RunFolder, read_run
from thermogrip.rig.session.session import Object, Session, run_session
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.sysid.plant.plant import Plant

sys.path.insert(0, str(Path(__file__).parents[2]))  # the drills are tests
from tests.rig.fault_injection.drills import drill_plants
from tests.rig.makers import DirectPort, SteppedClock

MATERIALS = ("copper", "iron", "wood", "aluminium", "glass")
SENSORS = ("t_surface", "t_tank")
FAULTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("sensor_open", {}), ("sensor_short", {}), ("sensor_nan", {}), ("sensor_stuck", {}),
    ("sensor_drift", {"rate": 0.1}), ("sensor_drift", {"rate": 0.03}), ("sensor_lag", {"seconds": 5.0}),
    ("sensor_offset", {"kelvin": 5.0}), ("garbage", {"rate": 0.01}), ("garbage", {"rate": 0.5}),
    ("silence", {}), ("deaf", {}), ("reset", {}), ("pump_stall", {}), ("driver_stuck", {"share": 1.0}),
    ("driver_stuck", {"share": -1.0}), ("driver_stuck", {"share": 0.0}), ("cable_pulled", {}),
)  # fmt: skip


class Day:
    """The device, its faults, and what is counted."""

    def __init__(self, real: Plant, *, seed: int, every: float, near: float) -> None:
        self.clock = SteppedClock()
        self.device = VirtualDevice(
            real, link="none", clock=self.clock, ambient=25.0, t_start=25.0, seed=seed, keep=2000
        )
        self.rng = np.random.default_rng(seed)
        self.every, self.near = every, near
        self.next_at = float(self.rng.exponential(every)) if every else np.inf
        self.fault, self.since, self.unnoticed = "", 0.0, ("", -np.inf)
        self.reported: list[dict[str, Any]] = []
        self.injected: Counter[str] = Counter()
        self.tripped: Counter[str] = Counter()
        self.false_alarms: list[str] = []
        self.refused: Counter[str] = Counter()
        self.after_mending: Counter[str] = Counter()
        self.beyond = self.worst = 0.0
        self.wrong: list[str] = []
        self.returned = self.sessions = 0
        self.detected: dict[str, list[float]] = {}
        self.accepted_with: Counter[str] = Counter()
        self.at_contact: dict[str, float] = {}

    def open(self) -> DeviceRig:
        """Open the rig anew, as after an operator repaired it."""
        self.repair("operator")
        self.clock.sleep(1.0)  # the device has sampled its sensors anew
        rig = _Rig(self)
        with suppress(DeviceRefusedError):  # nothing was latched
            rig.clear()
        return rig

    def repair(self, who: str) -> None:
        """Let the fault be over."""
        if self.fault:
            self.note("repaired", fault=self.fault, by=who)
            self.device.clear(None)
            if who == "itself":
                self.unnoticed = (self.fault, self.clock())
            self.fault = ""

    def note(self, what: str, **more: Any) -> None:
        """Note what happened."""
        self.reported.append({"time_s": round(self.clock(), 2), "what": what, **more})

    def pass_time(self) -> None:
        """Inject what is due, repair what nobody noticed for a minute, and look at the truth."""
        now = self.clock()
        if self.fault and now - self.since > 60.0:
            self.repair("itself")
        if not self.fault and now >= self.next_at:
            kind, options = FAULTS[int(self.rng.integers(len(FAULTS)))]
            sensor = SENSORS[int(self.rng.integers(2))] if kind.startswith("sensor") else None
            self.device.fault(kind, sensor=sensor, **options)
            self.fault, self.since = f"{kind} {sensor or ''} {options or ''}".strip(), now
            self.injected[kind] += 1
            self.note("fault", fault=self.fault)
            self.next_at = now + float(self.rng.exponential(self.every))
        truth = self.device.true_temperatures
        limits = {"t_surface": (3.0, 55.0), "t_tank": (-1.0, 70.0)}
        if not self.device.core.outputs.grip:  # a hot object is not the rig's doing
            for name, (low, high) in limits.items():
                self.beyond = max(self.beyond, truth[name] - high, low - truth[name])

    def evaluate(self, session: Session, folder: Path) -> None:
        """Count a session, and note whether an accepted grasp began at a wrong temperature."""
        self.sessions += 1
        if session.trip is not None:
            self.note("trip", folder=folder.name, fault=self.fault, line=session.trip.line())
            self.tripped[session.trip.kind] += 1
            if self.fault:
                self.detected.setdefault(self.fault, []).append(self.clock() - self.since)
            elif self.clock() - self.unnoticed[1] < 120.0:
                self.after_mending[self.unnoticed[0]] += 1
            else:
                self.false_alarms.append(session.trip.line())
            return
        if session.grasps is None:
            return
        self.returned += 1
        if self.fault:
            self.accepted_with[self.fault] += 1
        grasp = session.grasps
        before = grasp["t_surface"].values[0][grasp["time"].values < 0]
        off = float(np.median(before[-5:])) - self.at_contact["t_surface"]
        self.worst = max(self.worst, abs(off))
        if abs(off) > self.near:
            self.note("wrong", folder=folder.name, kelvin=off, fault=self.fault)
            self.wrong.append(f"{off:+.2f} K with {self.fault or 'no fault'}")


class _Rig(DeviceRig):
    def __init__(self, day: Day) -> None:
        self.day = day
        super().__init__(
            DirectPort(day.device), clock=day.clock, sleep=day.clock.sleep, timeout=0.004, greeting=0.2
        )

    def wait(self, seconds: float) -> None:
        super().wait(seconds)
        self.day.pass_time()

    def grasp(self, material: str, t_object: float) -> None:
        self.day.device.place(material, t_object)
        self.day.at_contact = self.day.device.true_temperatures
        super().grasp(material, t_object)


def plan_of(n: int, rng: np.random.Generator) -> list[Trial]:
    """Return n trials: materials and temperatures at random, both directions of the heat."""
    conditions = ((43.0, 23.0), (43.0, 33.0), (18.0, 33.0), (18.0, 38.0), (28.0, 40.0))
    trials = []
    for k in range(n):
        t_object, target = conditions[int(rng.integers(len(conditions)))]
        material = MATERIALS[int(rng.integers(len(MATERIALS)))]
        trials.append(Trial(material, target, t_object, 0.4, {"block": material, "repeat": float(k)}))
    return trials


def main() -> int:
    """Run the day and print what it showed."""
    options = _options()
    known, real = drill_plants()
    if options.plant is not None:
        known = Plant.load(options.plant)
        real = known.draw(options.draw)
    controller = _controller(options.controller, known)
    day = Day(real, seed=options.seed, every=options.every, near=options.near)
    drift = PlantDrift.unknown(known, options.drift, file=options.out / "rig.json") if options.drift else None
    options.out.mkdir(parents=True, exist_ok=True)
    plan, guard = plan_of(options.grasps, np.random.default_rng(options.seed)), Guard(known, drift=drift)
    begun, reported, sizes = time.monotonic(), 0, [_resident()]
    rig, done = day.open(), 0
    while done < len(plan) and day.clock() < 3600 * options.hours:
        rig = _one(day, rig, controller, plan[done], done, options.out, guard)
        if good_run(options.out, done) is not None:
            done += 1
            if done % 50 == 0:
                gc.collect()
                sizes.append(_resident())
        if day.clock() // 3600 > reported:
            reported = int(day.clock() // 3600)
            trips = sum(day.tripped.values())
            print(f"{reported} h: {done} grasps, {trips} trips, {_resident():.0f} MB", flush=True)
        if time.monotonic() - begun > options.minutes * 60:
            break
    rig.close()
    lines = "".join(json.dumps(one) + "\n" for one in day.reported)
    (options.out / "faults.jsonl").write_text(lines, encoding="utf-8")
    print(json.dumps(_summary(day, done, options, sizes, time.monotonic() - begun), indent=1))
    return 0


def _one(
    day: Day, rig: DeviceRig, controller: Controller, trial: Trial, k: int, out: Path, guard: Guard
) -> DeviceRig:
    """Do one trial and return the rig to go on with: a new one where it tripped."""
    assert isinstance(trial.t_object, float)
    thing = Object(trial.material, trial.t_object, 0.4, trial.labels, f"{k + 1:04d}")
    tripped, folder = True, next_folder(out, k)
    try:
        with RunFolder(folder, {"trial": k + 1}) as recorder:
            session = run_session(
                rig, controller, trial.target, grasp=thing, guard=guard, clock=day.clock,
                settle_timeout=600.0, recorder=recorder,
            )  # fmt: skip
            recorder.finish(session)
        tripped = session.trip is not None
        day.evaluate(session, folder)
    except (UserError, DeviceRefusedError) as error:  # the fault was there at the very start
        day.note("refused", folder=folder.name, fault=day.fault, line=str(error))
        day.refused[type(error).__name__] += 1
    if not tripped:
        return rig
    rig.close()
    day.clock.sleep(30.0)  # an operator repairs and clears
    return day.open()


def _summary(day: Day, done: int, options: Any, sizes: list[float], wall: float) -> dict[str, Any]:
    """Return what the day showed."""
    on_disk = [k for k in range(done) if good_run(options.out, k) is not None]
    labelled = sum(
        read_run(good_run(options.out, k) or "").grasps is not None for k in on_disk[:: max(1, done // 50)]
    )
    half = len(sizes) // 2
    return {
        "seed": options.seed,
        "draw": options.draw,
        "simulated_h": round(day.clock() / 3600, 2),
        "wall_min": round(wall / 60, 1),
        "grasps": done,
        "good_grasps_on_disk": len(on_disk),
        "returned_by_sessions": day.returned,
        "read_back_of_those_looked_at": labelled,
        "sessions": day.sessions,
        "faults": dict(day.injected),
        "trips": dict(day.tripped),
        "refused_at_start": dict(day.refused),
        "trips_as_an_unnoticed_fault_was_mended": dict(day.after_mending),
        "false_alarms": day.false_alarms,
        "detected_after_s_median_max": {
            fault: [round(float(np.median(times)), 1), round(max(times), 1)]
            for fault, times in sorted(day.detected.items())
        },
        "accepted_while_a_fault_was_on": dict(day.accepted_with),
        "wrong_temperatures_accepted": day.wrong,
        "largest_error_of_an_accepted_grasp_K": round(day.worst, 2),
        "beyond_a_limit_K": round(day.beyond, 2),
        "margin_K": LIMIT_MARGIN,
        "resident_MB_start_half_end": [round(x, 1) for x in (sizes[0], sizes[half], sizes[-1])],
    }


def _controller(path: Path | None, known: Plant) -> Controller:
    if path is None:
        from thermogrip.mpc.controllers.pi import PIController

        return PIController(known, dt=1.0)
    from thermogrip.mpc import Controller as Loaded

    return Loaded.load(path)


def _resident() -> float:
    """Return the memory that this process has now [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--grasps", type=int, default=1000)
    parser.add_argument("--every", type=float, default=600.0, help="mean time between faults [s], 0: none")
    parser.add_argument("--near", type=float, default=1.0, help="what counts as a wrong temperature [K]")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this long [real minutes]")
    parser.add_argument("--drift", type=float, default=0.0, help="let the guard allow for it, and learn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plant", type=Path)
    parser.add_argument("--draw", type=int, default=1)
    parser.add_argument("--controller", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
