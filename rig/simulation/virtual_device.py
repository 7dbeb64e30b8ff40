"""A device without hardware: either protocol on a pty or a socket, a simulated plant, faults on demand.

The device lives in a thread of its own and moves its plant and its firmware ten times a second of its own
clock.  A fault sits where the real one would: a sensor's between the true temperature and the device, a stuck
driver's between the device and the plant (only the supply cuts it), a stalled pump's in the pump.
"""

from __future__ import annotations

import secrets
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from random import Random
from typing import Any

from thermogrip.rig.clock import ScaledClock
from thermogrip.rig.firmware.reference import SERIALS, Board, DeviceCore, Outputs, Sensor, Value
from thermogrip.rig.guard.sensor_checks import room_disturbances
from thermogrip.rig.guard.settings import DEVICE_LIMITS
from thermogrip.rig.serial.protocol import Channel
from thermogrip.rig.simulation.cable import PtyLink, SocketLink, spoil
from thermogrip.rig.simulation.faults import FAULTS, SENSOR_FAULTS
from thermogrip.rig.simulation.tclab_firmware import TCLabCore
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

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
        options_fit = set(options) <= {"rate", "seconds", "kelvin"}
        if kind not in SENSOR_FAULTS or name not in names or not options_fit:
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
        reading = self.twin.read().values
        true = {s.name: round(1000 * reading[s.name]) for s in self.board.sensors}
        self._past.append((self.time, true))
        self._shown = {name: self._show(name, value) for name, value in true.items()}
        return tuple(self._shown.values())

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
                then = self.time - fault.seconds + 1e-9
                past = [values for time_s, values in self._past if time_s <= then]
                return (past[-1] if past else self._past[0][1])[name]
            case _:
                return _ABSOLUTE_ZERO


def board_of(twin: Twin) -> Board:
    """Return the device that fits a plant: its drives, its temperatures, a pump where the plant has one."""
    units = twin.units
    drives = tuple(
        Channel(name, units[name], round(1e4 * twin.limits[name][0]), round(1e4 * twin.limits[name][1]))
        for name in units
    )
    limits = [(name, DEVICE_LIMITS.get(name, (2.0, 80.0))) for name in twin.plant.outputs]
    guarded = tuple(Sensor(name, round(1e3 * low), round(1e3 * high)) for name, (low, high) in limits)
    sensors = guarded + tuple(Sensor(name, guarded=False) for name in room_disturbances(twin.plant))
    pump = "pump" in twin.plant.inputs
    return Board(drives, sensors, pump, tachometer=pump)


PROTOCOLS = ("thermogrip", "tclab")
_BOARD = {"G_amb": 0.013, "G_between": 0.006, "power_1": 0.86, "power_2": 0.61, "lag_1": 16.0, "lag_2": 19.0}
SAMPLE_MS = 100
_POLL_S = 0.02  # of real time
_HELD_UP_S = 0.05  # of real time, twice and a half a poll: a device that is further behind was held up


class VirtualDevice:
    """A device on a port, for as long as a ``with`` block lasts (or between start and stop).

    Parameters
    ----------
    plant : Plant, optional
        What it drives; :func:`example_plant` of the protocol where absent.
    protocol : {"thermogrip", "tclab"}, optional
    link : {"pty", "socket", "none"}, optional
        Where the host finds it; ``none`` leaves it to :meth:`exchange`.
    socket_port : int, optional
        TCP port on the loopback address; 0 takes a free one.
    clock : callable, optional
        The device's clock [s]; by default the computer's.
    seed : int, optional
        Of sensor noise and spoilt lines.
    keep : int, optional
        Samples that ``trace`` holds (ten a second).
    twin_options
        Handed to :class:`~thermogrip.rig.simulation.twin.Twin`: ``ambient``, ``t_start``, ``noise``,
        ``limits``, ...

    Attributes
    ----------
    bench : Bench
        Plant, sensors and drivers.
    core : DeviceCore or TCLabCore
        The firmware since the last reset.
    trace : deque of Moment
        The truth at each sample.
    ordered : float
        When it last took an order to drive [s, its own time]; -inf where it has none, or its firmware
        knows no time at which a drive ends.

    Examples
    --------
    >>> now = [0.0]
    >>> device = VirtualDevice(protocol="tclab", link="none", clock=lambda: now[0], t_start=23.0)
    >>> device.exchange(b"Q1 100\\r\\n")
    b'100.000\\r\\n'
    >>> now[0] = 60.0
    >>> device.truth().temperatures["t1"] > 30.0
    True
    >>> device.fault("sensor_open", sensor="t1")
    """

    def __init__(
        self,
        plant: Plant | None = None,
        *,
        protocol: str = "thermogrip",
        link: str = "pty",
        socket_port: int = 0,
        clock: Callable[[], float] | None = None,
        seed: int = 0,
        keep: int = 36_000,
        **twin_options: Any,
    ) -> None:
        if protocol not in PROTOCOLS:
            raise ValueError(f"protocol {protocol!r} is none of {', '.join(PROTOCOLS)}")
        self.protocol = protocol
        if protocol == "tclab":  # its converter does the rounding
            twin_options = {"noise": 0.043, "slow_noise": 0.0, "quantum": 0.0} | twin_options
        if plant is None:
            plant = example_plant(protocol, room=twin_options.get("ambient"))
        self.bench = Bench(plant, seed=seed, **twin_options)
        if protocol == "tclab" and len(self.bench.board.drives) != 2:
            raise ValueError("a TCLab has two heaters, this plant has not")
        self.trace: deque[Moment] = deque(maxlen=keep)
        self._clock: Callable[[], float] = ScaledClock() if clock is None else clock
        self._start, self._next_ms = self._clock(), 0
        self.ordered = -float("inf")
        self._rng = Random(seed)
        cables: dict[str, Callable[[], PtyLink | SocketLink | None]]
        cables = {"pty": PtyLink, "socket": partial(SocketLink, socket_port), "none": lambda: None}
        if link not in cables:
            raise ValueError(f"link {link!r} is none of {', '.join(cables)}")
        self._link = cables[link]()
        self._lock = threading.RLock()
        self._cable = threading.Lock()  # of who reads, writes, pulls or plugs
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._garbage = 0.0
        self._lost: set[str] = set()  # what does not get through
        self._answer = b""
        self._serial = secrets.randbelow(SERIALS)
        self.core: DeviceCore | TCLabCore = self._fresh_core("power", 1)
        self._advance()

    @property
    def port(self) -> str:
        """What a host opens: the name of the pty or ``socket://127.0.0.1:PORT``."""
        if self._link is None:
            raise ValueError("this device has no cable: exchange bytes with it")
        return self._link.url

    @property
    def is_pulled(self) -> bool:
        """Whether the cable is out."""
        return "cable_pulled" in self._lost

    @property
    def time(self) -> float:
        """Seconds of the device's clock since it was made."""
        return self._clock() - self._start

    def truth(self) -> Moment:
        """Return what drives the plant now, and how warm everything is, whatever pins and sensors show."""
        with self._lock:
            self._advance()
            return self.bench.moment()

    def fault(self, name: str, *, sensor: str | None = None, **options: Any) -> None:
        """Let something of :data:`FAULTS` fail, at once; ValueError where it is unknown.

        A ``sensor_`` fault is of the sensor that touches where none is named.  Options are ``rate`` of
        ``garbage`` (0 to 1) and of ``sensor_drift`` [K/s], ``seconds`` of ``sensor_lag``, ``kelvin`` of
        ``sensor_offset``, ``share`` of ``driver_stuck`` (-1 to 1) and ``cause`` of ``reset``.
        """
        if name not in FAULTS:
            raise ValueError(f"no fault {name!r}; there are {', '.join(FAULTS)}")
        if name == "cable_pulled":
            self._pull_or_plug(pull=True)
        with self._lock:
            self._advance()
            self._set_fault(name, sensor, options)

    def clear(self, name: str | None = None) -> None:
        """Clear one fault, or all of them; a latch of the device stays."""
        if name in (None, "cable_pulled") and self.is_pulled:
            self._pull_or_plug(pull=False)
        with self._lock:
            self._advance()
            if name is None or name in SENSOR_FAULTS:
                self.bench.clear_fault(name)
            self._lost -= {"silence", "deaf"} if name is None else {name}
            self._garbage = 0.0 if name in (None, "garbage") else self._garbage
            self.bench.pump_stalled &= name not in (None, "pump_stall")
            self.bench.stuck = None if name in (None, "driver_stuck") else self.bench.stuck
            self.bench.apply(self.core.outputs)

    def place(self, material: str, t_object: float) -> None:
        """Lay a block [degC] where the gripper closes; it touches when the host closes the gripper."""
        self.bench.twin.rehearse(material, t_object)
        self.bench.placed = (material, t_object)

    def start(self) -> VirtualDevice:
        """Plug the cable in and serve in a thread."""
        if self._link is None:
            raise ValueError("this device has no cable: exchange bytes with it")
        self._link.plug()
        self._thread = threading.Thread(target=self._serve, name="virtual device", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the thread and take the port away; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._link is not None:
            self._link.close()

    def exchange(self, data: bytes) -> bytes:
        """Take what came over the line and return what goes back."""
        with self._lock:
            self._advance()
            if self._lost & {"deaf", "cable_pulled"}:
                data = b""
            before = self.core.expires_ms
            self._answer += self.core.receive(self._spoilt(data), self._now_ms())
            if self.core.expires_ms is not None and self.core.expires_ms != before:
                self.ordered = self.time
            self.bench.apply(self.core.outputs)
            answer, self._answer = self._answer, b""
            return b"" if self._lost & {"silence", "cable_pulled"} else self._spoilt(answer)

    def __enter__(self) -> VirtualDevice:
        return self.start() if self._link is not None else self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _serve(self) -> None:
        """Answer and let time pass until stopped."""
        assert self._link is not None
        while not self._stop.is_set():
            if self.is_pulled:
                self._stop.wait(_POLL_S)
                self.exchange(b"")
                continue
            patience_s = _POLL_S
            if isinstance(
                self._clock, ScaledClock
            ):  # not beyond the next sample, whose work holds up an answer
                with self._lock:
                    remaining_s = (self._due() / 1000 - self.time) / self._clock.speed
                patience_s = min(_POLL_S, max(0.0, remaining_s))
            with self._cable:
                heard = b"" if self.is_pulled else self._link.read(patience_s)
            answer = self.exchange(heard)
            with self._cable:
                if answer and not self.is_pulled:
                    self._link.write(answer)

    def _pull_or_plug(self, *, pull: bool) -> None:
        """Pull the cable or plug it in, between two reads of the thread that serves."""
        with self._cable:
            if pull:
                self._lost.add("cable_pulled")
            else:
                self._lost.discard("cable_pulled")
            if self._link is not None:
                (self._link.pull if pull else self._link.plug)()

    def _set_fault(self, name: str, sensor: str | None, options: Mapping[str, Any]) -> None:
        if name == "garbage":
            self._garbage = float(options.get("rate", 0.5))
        elif name in ("silence", "deaf", "cable_pulled"):
            self._lost.add(name)
        elif name == "reset":
            boot = self.core.boot + 1 if isinstance(self.core, DeviceCore) else 1
            self.core = self._fresh_core(str(options.get("cause", "external")), boot)
            self._sample(self._now_ms())
            self._answer += self.core.announcement()
        elif name == "pump_stall":
            self.bench.pump_stalled = True
        elif name == "driver_stuck":
            self.bench.stuck = float(options.get("share", 1.0))
        else:
            self.bench.set_fault(name, sensor, **options)
        self.bench.apply(self.core.outputs)

    def _fresh_core(self, cause: str, boot: int) -> DeviceCore | TCLabCore:
        if self.protocol == "tclab":
            return TCLabCore(self.bench.board)
        return DeviceCore(self.bench.board, cause, boot % 2**16, self._now_ms(), serial=self._serial)

    def _now_ms(self) -> int:
        return round(1000 * self.time)

    def _advance(self) -> None:
        """Let plant and firmware catch up with the clock: samples and the end of a drive, in their order."""
        if self._thread is not None and isinstance(self._clock, ScaledClock):
            # its time stands still while the computer has none for it: no board is held up, and what a host
            # sent meanwhile came in time
            behind = self.time - self.bench.time - _HELD_UP_S * self._clock.speed
            self._start += max(0.0, behind)
        now = self._now_ms()
        while (due := self._due()) <= now:
            self.bench.advance(due / 1000)
            if due == self._next_ms:
                self._next_ms += SAMPLE_MS
                self._sample(due)
            else:
                self._answer += self.core.receive(b"", due)
            self.bench.apply(self.core.outputs)
        self.bench.advance(now / 1000)

    def _due(self) -> int:
        """Return when something is to happen next: a sample, or the end of a drive."""
        expires_ms = self.core.expires_ms
        return self._next_ms if expires_ms is None else min(self._next_ms, expires_ms)

    def _sample(self, now_ms: int) -> None:
        self.core.sample(self.bench.sample(), flow=self.bench.flow, now_ms=now_ms)
        self.trace.append(self.bench.moment())

    def _spoilt(self, data: bytes) -> bytes:
        lines = data.splitlines(keepends=True)
        return b"".join(
            spoil(line, self._rng) if self._rng.random() < self._garbage else line for line in lines
        )


def example_plant(protocol: str = "thermogrip", *, room: float | None = None) -> Plant:
    """Return a plant for a device that is given none: the gripper's or the TCLab's network as it is bundled.

    The TCLab's numbers are off the network file's, so that a fit has something to find; as it does not
    measure its ``room`` [degC], that is one of them.
    """
    from thermogrip.sysid.models.network import load_network

    model = load_network("tclab" if protocol == "tclab" else "gripper")
    values = {name: parameter.value for name, parameter in model.tables.parameters.items()}
    if protocol == "tclab":
        values |= _BOARD | ({} if room is None else {"t_room": room})
    return Plant(model, values, dt=model.dt, units=dict(model.units))
