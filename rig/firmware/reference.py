"""The firmware in Python: the reference that the virtual device runs and the sketch is tested against.

The core owns no pin, no clock and no sensor.  Whoever runs it calls :meth:`DeviceCore.receive` with what came
over the line, :meth:`DeviceCore.sample` with the sensors' values ten times a second, and applies
:attr:`DeviceCore.outputs` after each call.

What protects the rig when nobody is there (expiry, latch, interlock, the supply of the drivers, the hello
after a reset) is specified in ``docs/reference/protocol.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from thermogrip.rig.serial import protocol

VERSION = "0.2.0"
SERIALS = 100_000_000  # a board's number is below
BAD_SAMPLES = 4  # in a row, to latch
PUMP_STALL_MS = 3000
_WORDS_OF_A_DEVICE = ("ok", "err", "boot")  # come back where a line echoes; answering them would never end

#: A sensor's value: thousandths of a degC, ``open`` or ``short``.
Value: TypeAlias = int | str


@dataclass(frozen=True)
class Sensor:
    """A temperature sensor: its name, and where it may be [1e-3 degC] if it is guarded."""

    name: str
    low: int = 3_000
    high: int = 55_000
    guarded: bool = True


@dataclass(frozen=True)
class Board:
    """What is wired to the device."""

    drives: tuple[protocol.Channel, ...] = (protocol.Channel("drive", "1", -10_000, 10_000),)
    sensors: tuple[Sensor, ...] = (Sensor("t_tank"), Sensor("t_surface"), Sensor("t_ambient", guarded=False))
    pump: bool = True  # whether a pump must run before anything is driven
    tachometer: bool = True  # whether the pump reports that it turns


@dataclass(frozen=True)
class Outputs:
    """The pins: supply of the drivers, drives [1e-4 of the unit], pump, gripper."""

    enable: int
    drive: tuple[int, ...]
    pump: int
    grip: int


@dataclass
class _BadCount:
    """How often in a row a sensor was bad, and of which kind."""

    kind: str = ""
    count: int = 0

    def add(self, kind: str) -> bool:
        """Count one sample's kind (empty: good); say whether it is to latch."""
        self.count = self.count + 1 if kind and kind == self.kind else int(bool(kind))
        self.kind = kind
        return self.count >= BAD_SAMPLES


@dataclass
class DeviceCore:
    """One device since its last reset: ``boot`` resets so far, ``started_ms`` on its clock [ms], the number
    ``serial`` of this one board."""

    board: Board = field(default_factory=Board)
    cause: str = "power"
    boot: int = 1
    started_ms: int = 0
    mode: str = "off"
    faults: tuple[str, ...] = ()
    serial: int = 0

    def __post_init__(self) -> None:
        self._parser = protocol.LineParser()
        self._zero = (0,) * len(self.board.drives)
        self._drive = self._zero
        self._pump = 0
        self._grip = 0
        self._expires_ms, self._flow_ms = 0, 0
        self._bad_counts = [_BadCount() for _ in self.board.sensors]
        self._values: tuple[Value, ...] = ("open",) * len(self.board.sensors)
        self._greeted = False
        self._last: tuple[int, bytes] | None = None  # number of the last question, and its answer

    @property
    def outputs(self) -> Outputs:
        """What the pins are to be now."""
        armed = self.mode == "armed" and (self._pump == 1 or not self.board.pump)
        return Outputs(int(armed), self._drive, self._pump, self._grip)

    @property
    def version(self) -> str:
        """The firmware's version and the board's serial number."""
        return f"{VERSION}+{self.serial}"

    @property
    def identity(self) -> protocol.Identity:
        """The device's identity."""
        names = tuple(sensor.name for sensor in self.board.sensors)
        return protocol.Identity(self.version, self.board.drives, self.board.pump, names)

    @property
    def expires_ms(self) -> int | None:
        """When the drive that is in force ends, None where none is."""
        return self._expires_ms if self.mode == "armed" else None

    def announcement(self) -> bytes:
        """Return the line that a device sends once after a reset."""
        return protocol.encode_line(0, "boot", self.cause, str(self.boot), self.version)

    def state(self, now_ms: int) -> protocol.State:
        """Return the whole state."""
        uptime = (now_ms - self.started_ms) % 2**32
        head = (self.mode, uptime, self.cause, self.boot, self.faults)
        return protocol.State(*head, self._pump, self._grip, self._drive, self._values)

    def receive(self, data: bytes, now_ms: int) -> bytes:
        """Take what came over the line and return what goes back."""
        self._expire(now_ms)
        return b"".join(self._answer(line, now_ms) for line in self._parser.feed(data))

    def sample(self, values: Sequence[Value], *, flow: bool, now_ms: int) -> None:
        """Take one sample of every sensor, and whether the pump turns."""
        self._expire(now_ms)
        self._values = tuple(values)
        latched = []
        for count, sensor, value in zip(self._bad_counts, self.board.sensors, values):
            known = any(fault.endswith(f":{sensor.name}") for fault in self.faults)
            if count.add(_sensor_fault(sensor, value)) and not known:
                latched.append(f"{count.kind}:{sensor.name}")
        if flow or not any(self._drive) or not self._pump:
            self._flow_ms = now_ms
        still_ms = (now_ms - self._flow_ms) % 2**32  # the device's clock wraps after 49 days
        stalled = self.board.tachometer and self.board.pump and still_ms >= PUMP_STALL_MS
        if stalled and "pump" not in self.faults:
            latched.append("pump")
        if latched:
            self.faults += tuple(latched)
            self._switch_off("latched")

    def _answer(self, line: protocol.Line | protocol.Damaged, now_ms: int) -> bytes:
        """Return the answer to one line; a question that is repeated gets its answer repeated."""
        if isinstance(line, protocol.Damaged):
            return protocol.encode_line(0, "err", "corrupt")
        if line.words[0] in _WORDS_OF_A_DEVICE:
            return b""
        if self._last is not None and line.seq == self._last[0] and line.words != ("hello",):
            return self._last[1]
        request = protocol.parse_request(line.words)
        refusal = request if isinstance(request, str) else self._obey(request, now_ms)
        if refusal:
            answer = protocol.encode_line(line.seq, "err", refusal)
        elif isinstance(request, protocol.Hello):
            answer = protocol.encode_line(line.seq, "ok", *self.identity.words())
        else:
            answer = protocol.encode_line(line.seq, "ok", *self.state(now_ms).words())
        self._last = (line.seq, answer)
        return answer

    def _obey(self, request: protocol.Request, now_ms: int) -> str:
        """Execute a request and return nothing, or the code of the refusal."""
        match request:
            case protocol.Hello():
                self._greeted = True
                self._switch_off("latched" if self.faults else "off")
            case protocol.Off():
                self._switch_off("latched" if self.faults else "off")
            case protocol.Grip(closed=closed):
                self._grip = closed
            case protocol.Clear():
                if any(count.kind for count in self._bad_counts):
                    return "active"
                self.faults = ()
                self._switch_off("off")
            case protocol.Drive():
                return self._set_drive(request, now_ms)
        return ""

    def _set_drive(self, request: protocol.Drive, now_ms: int) -> str:
        if not self._greeted:
            return "hello"
        if self.faults:
            return "latched"
        if not 1 <= request.ttl_ms <= protocol.MAX_TTL_MS:
            return "ttl"
        if len(request.drive) != len(self.board.drives):
            return "syntax"
        if not all(c.low <= value <= c.high for c, value in zip(self.board.drives, request.drive)):
            return "range"
        if self.board.pump and not request.pump and any(request.drive):
            return "interlock"
        if not self._pump:
            self._flow_ms = now_ms  # a pump that starts has its time to turn, whatever the last one did
        self._drive = request.drive
        self._pump = request.pump
        self.mode = "armed"
        self._expires_ms = now_ms + request.ttl_ms
        return ""

    def _expire(self, now_ms: int) -> None:
        if self.mode == "armed" and (now_ms - self._expires_ms) % 2**32 < 2**31:
            self._switch_off("expired")

    def _switch_off(self, mode: str) -> None:
        self._drive = self._zero
        self._pump = 0
        self.mode = mode


def _sensor_fault(sensor: Sensor, value: Value) -> str:
    """Return what is wrong with a guarded sensor's value, empty where nothing is."""
    if not sensor.guarded:
        return ""
    if isinstance(value, str):
        return value
    return "over" if value > sensor.high else "under" if value < sensor.low else ""
