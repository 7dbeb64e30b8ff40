"""What the tests of the rig are made of: a lab's plant, a device with its driver, the simplest controller."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.drivers.tclab import TCLabRig
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.guard.model_checks import ModelMonitor, Residual
from thermogrip.rig.serial.port import Port, PortError
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

PATIENCE_S = 60.0  # of a loaded machine; nothing waits so long that goes as it should
STILL = {"noise": 0.0, "slow_noise": 0.0, "quantum": 0.0}


class SteppedClock:
    """A clock that moves only when somebody sleeps on it, at once. Host and virtual device on one stepped
    clock run a day in minutes, the same way each time."""

    def __init__(self, start: float = 0.0) -> None:
        self.now, self.lock = start, threading.Lock()

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let so many seconds pass; rounded to a nanosecond, so that sums of tenths stay tenths."""
        with self.lock:
            self.now = round(self.now + max(0.0, seconds), 9)


class DirectPort(Port):
    """A port with no cable, to a device with ``link="none"``."""

    def __init__(self, device: VirtualDevice) -> None:
        super().__init__("direct")
        self.device, self.answer = device, b""
        self._serial, self.opened = device, 1

    def open(self) -> None:
        """Open it."""
        if self.device.is_pulled:
            raise PortError("is not there", file=self.url, hint="plug the cable in")
        self.opened += not self.is_open
        self._serial = self.device

    def close(self) -> None:
        """Close it."""
        self._serial, self.answer = None, b""

    def try_open(self) -> bool:
        """Open it if the cable is in; say whether it is open."""
        if not self.device.is_pulled:
            self.open()
        return self.is_open

    def write(self, data: bytes) -> None:
        """Let the device hear the bytes."""
        self.require_open()
        self.answer += self.device.exchange(data)

    def read(self, seconds: float) -> bytes:
        """Return the device's answers; there is nothing to wait for."""
        self.require_open()
        answer, self.answer = self.answer or self.device.exchange(b""), b""
        return answer

    def require_open(self) -> None:
        if not self.is_open or self.device.is_pulled:
            self.close()
            raise PortError("was lost", file=self.url, hint="check cable and power")


def make_lab() -> Plant:
    """Return a TCLab: two heaters of 0.15 K/s at full power and 200 s, that warm each other a little."""
    a = np.array([[1 - 1 / 200, 0.0005], [0.0005, 1 - 1 / 200]])
    room = 1 - a.sum(axis=1, keepdims=True)
    model = StateSpaceModel(
        ("q1", "q2"), ("t_ambient",), ("t1", "t2"), A=a, B=np.eye(2) * 0.0015, E=room, C=np.eye(2), dt=1.0
    )
    units = {"q1": "percent", "q2": "percent", "t_ambient": "degC", "t1": "degC", "t2": "degC"}
    return Plant(model, {}, dt=1.0, units=units)


def make_heater() -> Plant:
    """Return one heater, at rest at 25 degC."""
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    return Plant(block, {}, dt=1.0, units={"q": "1"})


def follow(
    monitor: ModelMonitor, time: float, drive: Mapping[str, float], values: Mapping[str, float]
) -> list[Residual]:
    """Return the alarms of readings under a drive with the pump on."""
    monitor.predict(time, drive, 1, values)
    return monitor.update(time, values)


class Constant:
    """A controller that asks for one drive, whatever it reads."""

    def __init__(self, drive: float | dict[str, float] = 0.0, dt: float = 1.0) -> None:
        self.drive, self.dt = drive, dt

    def reset(self, reading: Readings) -> None: ...

    def step(self, reading: Readings, target: Target) -> Move:
        return Move(drive=self.drive)


class Bench:
    """A virtual device, its driver, and the stepped clock of both."""

    def __init__(
        self,
        plant: Plant,
        *,
        protocol: str = "thermogrip",
        link: str = "none",
        driver: Any = None,
        options: Mapping[str, Any] | None = None,
        **device: Any,
    ) -> None:
        self.clock = SteppedClock()
        device = {"t_start": 25.0, **device}
        self.device = VirtualDevice(plant, protocol=protocol, link=link, clock=self.clock, **device)
        if link != "none":
            self.device.start()
        port = DirectPort(self.device) if link == "none" else Port(self.device.port, clock=self.clock)
        driver = driver or (TCLabRig if protocol == "tclab" else DeviceRig)
        self.rig = driver(port, clock=self.clock, sleep=self.clock.sleep, **(options or {}))

    def kinds(self) -> set[str]:
        """Return the kinds of what happened since the last call."""
        return {notice.kind for notice in self.rig.notices()}

    def close(self) -> None:
        self.rig.close()
        self.device.stop()
