"""Full drive into a limit with honest sensors: how far beyond it the truth goes."""

from __future__ import annotations

from dataclasses import dataclass

from tests.rig.makers import Bench
from thermogrip.datasets.schema import Log, make_log
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.interface import Rig
from thermogrip.rig.session.session import play
from thermogrip.rig.simulation.twin import Twin
from thermogrip.rig.simulation.virtual_device import example_plant

SAMPLES_S = (1.0, 10.0, 60.0, 600.0, 3600.0)
ROOM = 23.0  # degC, where everything starts
#: Device and limit [degC] of all its sensors.
LIMITS = (("own firmware", 40.0), ("TCLab", 40.0), ("twin", 55.0))


@dataclass(frozen=True)
class Beyond:
    """How far beyond a limit the warmest true temperature was."""

    at_off: float  # when power went off [K]
    highest: float  # in the two minutes after, too: what was in the heater still comes [K]
    driven: float  # for how long it was driven beyond the limit [s]
    log: Log
    ended: str


def drive_into(device: str, limit: float, dt: float) -> Beyond:
    """Play full drive, sampled every ``dt`` [s], on a rig all of whose sensors have this limit [degC]."""
    if device == "twin":
        twin = Twin(example_plant(), ambient=ROOM, seed=1)
        log, ended = _play(twin, limit, dt, twin.plant.outputs, None)
        off = twin.time
        twin.wait(120.0)
        truth = [(row["time_s"], max(row[name] for name in twin.plant.outputs)) for row in twin.history]
    else:
        protocol = "tclab" if device == "TCLab" else "thermogrip"
        bench = Bench(
            example_plant(protocol, room=ROOM), protocol=protocol, ambient=ROOM, t_start=ROOM, seed=1
        )
        log, ended = _play(bench.rig, limit, dt, bench.device.bench.twin.plant.outputs, bench.clock)
        off = bench.device.time
        bench.clock.sleep(120.0)
        bench.device.truth()
        truth = [(moment.time_s, max(moment.temperatures.values())) for moment in bench.device.trace]
        bench.close()
    since = next(time for time, value in truth if value > limit)
    at_off = max(value for time, value in truth if time <= off)
    return Beyond(at_off - limit, max(value for _, value in truth) - limit, off - since, log, ended)


def _play(rig: Rig, limit: float, dt: float, outputs: tuple[str, ...], clock: object) -> tuple[Log, str]:
    full = {"percent": 100.0, "1": 1.0}
    drives = {name: ([full[unit]] * 2, unit, "input") for name, unit in rig.units.items()}
    guard = Guard(settings=GuardSettings(limits=dict.fromkeys(outputs, (5.0, limit))))
    return play(rig, make_log([0.0, 5400.0], drives), dt=dt, guard=guard, clock=clock)  # type: ignore[arg-type]
