"""Two plants on relays: time-proportioning beside a thermostat, both under the same least times.

    python benchmarks/rig/relays.py

The plants are explicit equations that share nothing with the package, stepped by 0.5 s:

* bath: 6 l of water, a 1200 W element of 600 J/K behind 15 W/K, a sensor of 15 s; its relay stays on and off
  for 10 s.  To 57 degC from 22, then 150 W of load for half an hour.
* chamber: 12 kJ/K of air and walls, a 60 W heater of 300 J/K behind 3 W/K, a compressor of -80 W that comes
  with 40 s, a sensor of 30 s; the compressor stays on for 60 s and off for 180 s, the heater likewise, and
  60 s are between them.  To 18 degC from 24, then the room goes from 24 to 8 degC.

Each is identified from one log of pulses that relays can play, and controlled by a PI of that plant, by the
MPC's default design, and by what a tuning with these relays makes of it, through
:class:`~thermogrip.rig.drivers.relays.RelayRig`.  A thermostat switches at its half width about the target.
A line has: settled within the band [s], overshoot [K], rms at rest and under the load [K], switchings an
hour.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np

from thermogrip.datasets.schema import make_log
from thermogrip.mpc import Controller, PIController, Spec, tune
from thermogrip.mpc.design.relays import Relay
from thermogrip.mpc.interface import Move
from thermogrip.rig.drivers.relays import RelayRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.settings import GuardSettings, RuleSettings, SensorSettings
from thermogrip.rig.interface import Reading
from thermogrip.rig.session.profile import Profile
from thermogrip.rig.session.session import play, run_session
from thermogrip.sysid import identify
from thermogrip.sysid.experiment.schedules import excite

STEP_S = 0.5


class Plant:
    """A rig by its own equations: one temperature, a heater, perhaps a cooler."""

    expires_s, has_pump, closed = 0.0, False, False
    room, load = 22.0, 0.0
    relay = Relay("heat", on_s=10.0, off_s=10.0)
    units: Mapping[str, str] = {"heat": "percent"}
    begin, target, band, hold_s, bit_s = 22.0, 57.0, 0.25, 3600.0, 90.0
    full = (0.0, 100.0)

    def __init__(self, seed: int) -> None:
        self.rng, self.time = np.random.default_rng(seed), 0.0
        self.t = self.element = self.sensor = self.begin
        self.cold = 0.0
        self.drive = dict.fromkeys(self.units, 0.0)
        self.switchings = 0

    def rates(self, dt: float) -> None:
        """Go on by a step: water, element, sensor."""
        flow = 15.0 * (self.element - self.t)
        self.element += dt * (1200.0 * self.drive["heat"] / 100 - flow) / 600.0
        self.t += dt * (flow - 6.0 * (self.t - self.room) - self.load) / (6.0 * 4186.0)
        self.sensor += dt * (self.t - self.sensor) / 15.0

    def wait(self, seconds: float) -> None:
        """Let time pass in steps of at most half a second."""
        steps = int(np.ceil(seconds / STEP_S - 1e-9))
        for _ in range(steps):
            self.rates(seconds / steps)
        self.time += seconds

    def read(self) -> Reading:
        """Return a reading of a 12-bit thermometer, noise of 0.03 K."""
        value = round((self.sensor + 0.03 * self.rng.standard_normal()) * 16) / 16
        return Reading(self.time, {"t": value}, dict(self.drive), 1)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Switch."""
        self.switchings += sum(drive[name] != value for name, value in self.drive.items())
        self.drive = dict(drive)

    def disturb(self) -> None:
        """Let the load come."""
        self.load = 150.0

    def release(self) -> None: ...
    def close(self) -> None: ...
    def grasp(self, material: str, t_object: float) -> None: ...
    def notices(self) -> list[Any]:
        return []


class Chamber(Plant):
    """The chamber; its drive goes from -1, the compressor, to 1, the heater."""

    room = 24.0
    relay = Relay("heat", "cool", on_s=60.0, off_s=180.0, dead_s=60.0)
    units: Mapping[str, str] = {"heat": "percent", "cool": "percent"}
    begin, target, band, hold_s, bit_s = 24.0, 18.0, 0.5, 7200.0, 720.0
    full = (-1.0, 1.0)

    def rates(self, dt: float) -> None:
        """Go on by a step: air, element, compressor, sensor."""
        flow = 3.0 * (self.element - self.t)
        self.element += dt * (60.0 * self.drive["heat"] / 100 - flow) / 300.0
        self.cold += dt * (80.0 * self.drive["cool"] / 100 - self.cold) / 40.0
        self.t += dt * (flow - self.cold - 3.5 * (self.t - self.room)) / 12e3
        self.sensor += dt * (self.t - self.sensor) / 30.0

    def disturb(self) -> None:
        """Let the night come."""
        self.room = 8.0


class Thermostat:
    """On below the target by half a width, off above it, and the other sign likewise."""

    dt = 1.0

    def __init__(self, half: float, low: float, name: str) -> None:
        self.half, self.low, self.name, self.u = half, low, name, 0.0

    def reset(self, reading: Mapping[str, float]) -> None: ...

    def step(self, reading: Mapping[str, float], target: Any) -> Move:
        error = target["t"][0] - reading["t"]
        if abs(error) > self.half:
            self.u = (1.0 if error > 0 else self.low) * (1.0 if self.low < 0 else 100.0)
        elif self.low < 0 and self.u * error <= 0:
            self.u = 0.0
        return Move(drive={self.name: self.u})


def relayed(plant: Plant) -> RelayRig:
    """Return the plant with its relays under the name of one drive."""
    name = "drive" if plant.relay.cooler else "heat"
    return RelayRig(plant, {name: plant.relay}, lambda: plant.time)  # type: ignore[arg-type]


def guard() -> Guard:
    """Return a guard with room for a bath, whose rules, made for a finger, are off."""
    wide, rule = (-20.0, 80.0), RuleSettings(full_drive_s=3600.0, far_K=0.5)
    sensors = SensorSettings(believable_degC=wide)
    settings = GuardSettings(skin_degC=wide, others_degC=wide, sensors=sensors, no_model=rule)
    return Guard(None, settings, skin="t")


def identified(kind: type[Plant], seed: int) -> Any:
    """Return the plant found in one log of pulses several least times long."""
    rig = relayed(kind(seed))
    [name] = rig.units
    unit, low = rig.units[name], min(kind.full[0], 0.0)
    minutes, times = 0.4 * kind.bit_s, {"tau_fast": kind.bit_s, "tau_slow": 4 * kind.bit_s}
    pulses = excite("prbs", minutes, dt=kind.bit_s / 18, low=low, high=1.0, **times, seed=seed)
    drive = pulses["drive"].values * (1.0 if unit == "1" else 60.0)
    schedule = make_log(pulses["time"].values, {name: (drive, unit, "input")}, name="pulses")
    log, ended = play(rig, schedule, dt=kind.bit_s / 18, guard=guard())  # type: ignore[arg-type]
    assert not ended, ended
    return identify([log], models=("arx", "oe", "subspace"), seed=seed).plant


def closed_loop(kind: type[Plant], controller: Any, seed: int) -> list[float]:
    """Return the figures of a controller on the plant."""
    plant = kind(seed + 100)
    rig = relayed(plant)
    seconds = 2.5 * kind.hold_s

    def watch(snapshot: Any) -> None:
        if snapshot.time_s > 1.5 * kind.hold_s:
            plant.disturb()

    profile = Profile(np.array([0.0, seconds]), {"t": np.full(2, kind.target)})
    session = run_session(
        rig, controller, {"t": kind.target}, output="t", profile=profile, guard=guard(), listener=watch
    )  # type: ignore[arg-type]
    assert session.trip is None, session.advice
    time, error = session.log["time"].values, session.log["t"].values - kind.target
    step, rest = time < kind.hold_s, (time >= kind.hold_s) & (time < 1.5 * kind.hold_s)
    smooth = np.convolve(error, np.ones(15) / 15, "same")
    outside = np.flatnonzero(step & (np.abs(smooth) > kind.band))
    settled = time[outside[-1] + 1] if outside.size and outside[-1] + 1 < step.sum() else np.nan
    side = np.sign(kind.target - kind.begin)
    rms = [float(np.sqrt(np.mean(error[part] ** 2))) for part in (rest, time > 1.5 * kind.hold_s)]
    return [settled, float(np.max(side * smooth[step])), *rms, 3600.0 * plant.switchings / seconds]


def main() -> None:
    """Print a table of both plants."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    seed: int = parser.parse_args().seed
    print(f"{'plant':9}{'controller':18}{'settled':>9}{'over':>7}{'rest':>7}{'load':>7}{'per hour':>10}")
    for kind in (Plant, Chamber):
        found = identified(kind, seed)
        name = found.inputs[0]
        tuning = tune(found, Spec.of(found).model_copy(update={"relays": {name: kind.relay}}), seed=seed)
        of_kind = "PI" if isinstance(tuning.controller, PIController) else "MPC"
        loops: dict[str, Any] = {"PI by SIMC": PIController(found), "default MPC": Controller(found)}
        loops[f"tuned: {of_kind}"] = tuning.controller
        for half in (0.1, 0.5):
            loops[f"thermostat +-{half:g}"] = Thermostat(half, kind.full[0], name)
        for title, controller in loops.items():
            settled, over, rest, load, switched = closed_loop(kind, controller, seed)
            name = "bath" if kind is Plant else "chamber"
            print(f"{name:9}{title:18}{settled:9.0f}{over:7.2f}{rest:7.3f}{load:7.3f}{switched:10.1f}")


if __name__ == "__main__":
    main()
