"""The plant behind a virtual device, with sensors, drivers, pump and gripper that can fail.

The plant is a :class:`~thermogrip.rig.simulation.twin.Twin`.  A fault sits where the real one would: a
sensor's between the true temperature and the device, a stuck driver's between the device and the plant (only
the supply cuts it), a stalled pump's in the pump, whatever was commanded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from thermogrip.rig.firmware.reference import Board, Outputs, Sensor, Value
from thermogrip.rig.guard.sensor_checks import room_disturbances
from thermogrip.rig.serial.protocol import Channel
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

__all__ = ["SENSOR_FAULTS", "Bench", "Moment", "board_of"]

#: Faults of one sensor, and the option that each takes.
SENSOR_FAULTS = {
    "sensor_open": "the wire is broken",
    "sensor_short": "the wires touch",
    "sensor_stuck": "it repeats its last value",
    "sensor_drift": "it leaves the truth by `rate` K/s",
    "sensor_lag": "it shows what was `seconds` ago",
    "sensor_offset": "it is off by `kelvin` at once",
    "sensor_nan": "the device itself reports nonsense (-273.15 degC)",
}
_LIMITS = {"t_tank": (2_000, 60_000), "t_surface": (3_000, 55_000)}
_ABSOLUTE_ZERO = -273_150


@dataclass(frozen=True)
class Moment:
    """The truth at one moment: what drives the plant and how warm everything is [degC]."""

    time_s: float
    drive: Mapping[str, float]
    pump: int
    temperatures: Mapping[str, float]


@dataclass(frozen=True)
class _SensorFault:
    kind: str
    since: float
    held: Value
    rate: float = 0.02
    seconds: float = 5.0
    kelvin: float = 3.0


class Bench:
    """A plant that device outputs drive and whose sensors a device reads; options are those of the twin."""

    def __init__(self, plant: Plant, **twin_options: Any) -> None:
        Twin(plant, **twin_options).wait(plant.dt)  # compiles the equations: no host shall wait for it
        self.twin = Twin(plant, **twin_options)
        self.board = board_of(self.twin)
        self.stuck: float | None = None  # share of full range at which every driver is stuck
        self.pump_stalled = False
        self.placed: tuple[str, float] | None = None
        self._faults: dict[str, _SensorFault] = {}
        self._grip = 0
        self._shown: dict[str, Value] = {}
        self._past: deque[tuple[float, dict[str, int]]] = deque(maxlen=3000)
        self._outputs = Outputs(0, (0,) * len(self.board.drives), 0, 0)

    @property
    def time(self) -> float:
        """The bench's time [s]."""
        return self.twin.time

    @property
    def flow(self) -> bool:
        """Whether the pump turns."""
        return bool(self._outputs.pump) and not self.pump_stalled

    def moment(self) -> Moment:
        """Return the truth now."""
        drive = self._driven()
        return Moment(self.time, drive, int(self.flow), self.twin.truth())

    def set_fault(self, kind: str, sensor: str | None, **options: Any) -> None:
        """Let a sensor fail, by default the one that touches, else the first; ValueError if unknown."""
        names = [s.name for s in self.board.sensors]
        default = self.twin.skin if self.twin.skin in names else names[0]
        name = default if sensor is None else sensor
        known = set(options) <= {"rate", "seconds", "kelvin"}
        if kind not in SENSOR_FAULTS or name not in names or not known:
            raise ValueError(f"no fault {kind!r} of {name!r} with {options}; sensors are {', '.join(names)}")
        fault = _SensorFault(kind, self.time, held=self._shown.get(name, 0))
        self._faults[name] = replace(fault, **options)

    def clear_fault(self, kind: str | None) -> None:
        """Clear this fault of all sensors, or all faults."""
        self._faults = {n: f for n, f in self._faults.items() if kind is not None and f.kind != kind}

    def apply(self, outputs: Outputs) -> None:
        """Let the pins drive the plant from now on."""
        self._outputs = outputs
        self.twin.apply(self._driven(), int(self.flow))
        if outputs.grip != self._grip:
            self._grip = outputs.grip
            if not self._grip:
                self.twin.release()
            elif self.placed is not None:
                self.twin.grasp(*self.placed)

    def advance(self, time_s: float) -> None:
        """Simulate up to this time."""
        if time_s > self.twin.time:
            self.twin.wait(time_s - self.twin.time)
            del self.twin.history[:-2]  # a day of them would fill the memory

    def sample(self) -> tuple[Value, ...]:
        """Return the readings, faults included [1e-3 degC], and keep the true ones for late sensors."""
        self._past.append((self.time, self._true_readings()))
        return self.readings()

    def readings(self) -> tuple[Value, ...]:
        """Return the readings, faults included [1e-3 degC]."""
        self._shown = {name: self._show(name, value) for name, value in self._true_readings().items()}
        return tuple(self._shown.values())

    def _true_readings(self) -> dict[str, int]:
        reading = self.twin.read().values
        return {s.name: round(1000 * reading[s.name]) for s in self.board.sensors}

    def _driven(self) -> dict[str, float]:
        """Return what drives the plant: the pins, or a stuck driver while it has a supply."""
        pins = {c.name: value / 1e4 for c, value in zip(self.board.drives, self._outputs.drive)}
        if self.stuck is None or not self._outputs.enable:
            return pins
        full = {c.name: (c.high if self.stuck > 0 else c.low) / 1e4 for c in self.board.drives}
        return {name: abs(self.stuck) * value for name, value in full.items()}

    def _show(self, name: str, true: int) -> Value:
        fault = self._faults.get(name)
        if fault is None:
            return true
        match fault.kind:
            case "sensor_open" | "sensor_short":
                return fault.kind.removeprefix("sensor_")
            case "sensor_stuck":
                return fault.held
            case "sensor_drift":
                return true + round(1000 * fault.rate * (self.time - fault.since))
            case "sensor_offset":
                return true + round(1000 * fault.kelvin)
            case "sensor_lag":
                return self._earlier(name, self.time - fault.seconds, true)
            case _:
                return _ABSOLUTE_ZERO

    def _earlier(self, name: str, time_s: float, otherwise: int) -> int:
        """Return what the sensor showed at an earlier time."""
        for moment, values in reversed(self._past):
            if moment <= time_s + 1e-9:
                return values[name]
        return self._past[0][1][name] if self._past else otherwise


def board_of(twin: Twin) -> Board:
    """Return the device that fits a plant: its drives, its temperatures, a pump where the plant has one."""
    units = twin.units
    drives = tuple(
        Channel(name, units[name], round(1e4 * twin.limits[name][0]), round(1e4 * twin.limits[name][1]))
        for name in units
    )
    guarded = tuple(Sensor(name, *_LIMITS.get(name, (2_000, 80_000))) for name in twin.plant.outputs)
    sensors = guarded + tuple(Sensor(name, guarded=False) for name in room_disturbances(twin.plant))
    pump = "pump" in twin.plant.inputs
    return Board(drives, sensors, pump, tachometer=pump)
