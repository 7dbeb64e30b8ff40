"""The firmware in Python: the reference that the virtual device runs and the sketch is tested against.

The core owns no pin, no clock and no sensor.  Whoever runs it calls :meth:`DeviceCore.receive` with what came
over the line, :meth:`DeviceCore.sample` with the sensors' values ten times a second, :meth:`DeviceCore.keep`
with them whenever :attr:`DeviceCore.ring` says that a reading is due, and applies :attr:`DeviceCore.outputs`
after each call.

What protects the rig when nobody is there (expiry, latch, interlock, the supply of the drivers, the hello
after a reset) and the ring of readings that the device takes by its own clock are specified in
``docs/reference/protocol.md``.  A ring has what an Arduino Uno has room for: 120 numbers, of which a reading
takes one for its time and one for each drive and sensor.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from thermogrip.rig.serial import protocol

CELLS = 120
MIN_PERIOD_MS, MAX_PERIOD_MS = 10, 1000
_WRAP = 2**32


class Ring:
    """Readings by number; not running before :meth:`start`."""

    def __init__(self, n_numbers: int) -> None:
        self._slots: deque[tuple[int, protocol.Kept] | None] = deque(maxlen=CELLS // (1 + n_numbers))
        self.period_ms, self.first, self._due_ms = 0, 0, 0

    @property
    def next(self) -> int:
        """Number of the tick that is still to come."""
        return (self.first + len(self._slots)) % _WRAP

    @property
    def due_ms(self) -> int | None:
        """When the next tick is, None where none comes."""
        return self._due_ms if self.period_ms else None

    def start(self, period_ms: int, now_ms: int) -> None:
        """Forget everything and take a reading every so many ms from now on; 0 takes none."""
        self._slots.clear()
        self.period_ms, self.first, self._due_ms = period_ms, 0, now_ms

    def due(self, now_ms: int) -> bool:
        """Say whether a reading is to be taken now."""
        return self.period_ms > 0 and (now_ms - self._due_ms) % _WRAP < _WRAP // 2

    def keep(
        self, now_ms: int, pump: int, drive: tuple[int, ...], temperatures: tuple[int | str, ...]
    ) -> None:
        """Keep the reading of the newest tick that is due; those before it have none."""
        late = (now_ms - self._due_ms) % _WRAP // self.period_ms
        for _ in range(self._skip(late)):
            self._push(None)
        self._push((now_ms, protocol.Kept(0, pump, drive, temperatures)))

    def forget(self, number: int) -> bool:
        """Forget everything before this number; False if that has not come yet."""
        ahead = (self.next - number) % _WRAP
        if ahead >= _WRAP // 2:
            return False
        while len(self._slots) > ahead:
            self._slots.popleft()
            self.first = (self.first + 1) % _WRAP
        return True

    def at(self, place: int, now_ms: int) -> protocol.Kept | None:
        """Return the reading at a place from the first, with its age; None where the tick has none."""
        slot = self._slots[place]
        if slot is None:
            return None
        return replace(slot[1], age_ms=(now_ms - slot[0]) % 2**16)  # of the clock only so much is kept

    def __len__(self) -> int:
        return len(self._slots)

    def _skip(self, late: int) -> int:
        """Return how many ticks without a reading are worth keeping; the rest only count."""
        most = CELLS  # more than fit
        if late > most:
            self.first = (self.next + late - most) % _WRAP
            self._due_ms += (late - most) * self.period_ms
            self._slots.clear()
        return min(late, most)

    def _push(self, slot: tuple[int, protocol.Kept] | None) -> None:
        full = len(self._slots) == self._slots.maxlen
        self.first = (self.first + full) % _WRAP
        self._slots.append(slot)
        self._due_ms += self.period_ms


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
    sensors: tuple[Sensor, ...] = (
        Sensor("t_tank"),
        Sensor("t_surface"),
        Sensor("t_ambient", guarded=False),
    )
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
        self._drive, self._pump, self._grip = self._zero, 0, 0
        self._expires_ms, self._flow_ms = 0, 0
        self._bad_counts = [_BadCount() for _ in self.board.sensors]
        self._values: tuple[Value, ...] = ("open",) * len(self.board.sensors)
        self._greeted = False
        self._last: tuple[int, bytes] | None = None  # number of the last question, and its answer
        self.ring = Ring(len(self.board.drives) + len(self.board.sensors))

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
        bad = [
            count.add(_kind(sensor, value))
            for count, sensor, value in zip(self._bad_counts, self.board.sensors, values)
        ]
        latched = [
            f"{count.kind}:{sensor.name}"
            for count, sensor, latch in zip(self._bad_counts, self.board.sensors, bad)
            if latch and not any(fault.endswith(f":{sensor.name}") for fault in self.faults)
        ]
        if flow or not any(self._drive) or not self._pump:
            self._flow_ms = now_ms
        still_ms = (now_ms - self._flow_ms) % 2**32  # the device's clock wraps after 49 days
        stalled = self.board.tachometer and self.board.pump and still_ms >= PUMP_STALL_MS
        if stalled and "pump" not in self.faults:
            latched.append("pump")
        if latched:
            self.faults += tuple(latched)
            self._switch_off("latched")

    def keep(self, values: Sequence[Value], now_ms: int) -> None:
        """Keep the reading that is due, which is not guarded."""
        self._expire(now_ms)
        self._values = tuple(values)
        self.ring.keep(now_ms, self._pump, self._drive, self._values)

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
        elif isinstance(request, protocol.Take):
            answer = protocol.encode_line(line.seq, "ok", *self._taken(line.seq, now_ms).words())
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
            case protocol.Sample(period_ms=period):
                if period and not MIN_PERIOD_MS <= period <= MAX_PERIOD_MS:
                    return "range"
                self.ring.start(period, now_ms)
            case protocol.Take(number=number):
                known = self.ring.due_ms is not None
                return "idle" if not known else "" if self.ring.forget(number) else "range"
        return ""

    def _taken(self, seq: int, now_ms: int) -> protocol.Taken:
        """Return as many of the readings as fit on a line."""
        head = (now_ms - self.started_ms) % 2**32, self.ring.first, self.ring.next
        readings: list[protocol.Kept | None] = []
        room = protocol.MAX_BODY - len(" ".join([str(seq), "ok", *protocol.Taken(*head, ()).words()]))
        for place in range(len(self.ring)):
            reading = self.ring.at(place, now_ms)
            room -= 1 + (1 if reading is None else len(reading.word()))
            if room < 0:
                break
            readings.append(reading)
        return protocol.Taken(*head, tuple(readings))

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
        self._drive, self._pump, self.mode = request.drive, request.pump, "armed"
        self._expires_ms = now_ms + request.ttl_ms
        return ""

    def _expire(self, now_ms: int) -> None:
        if self.mode == "armed" and (now_ms - self._expires_ms) % 2**32 < 2**31:
            self._switch_off("expired")

    def _switch_off(self, mode: str) -> None:
        self._drive, self._pump, self.mode = self._zero, 0, mode


def _kind(sensor: Sensor, value: Value) -> str:
    """Return what is wrong with a guarded sensor's value, empty where nothing is."""
    if not sensor.guarded:
        return ""
    if isinstance(value, str):
        return value
    return "over" if value > sensor.high else "under" if value < sensor.low else ""
