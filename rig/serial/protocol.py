r"""The rig's protocol, with no port and no clock.

The page ``docs/reference/protocol.md`` is the specification; its vectors are tests of this module and of the
firmware.  The host asks and the device answers once, with the number of the question (without the check):

    7 drive 2000 1 2500            ->   7 ok armed 81204 power 17 - 1 0 2500 31250,30812,25000
    8 drive 2000 0 2500            ->   8 err interlock
                                        0 boot watchdog 18 0.2.0+5309

Every answer but that of hello is the whole state, so one exchange a sample both drives and reads.
A question that got no answer is asked again with the same number; the device repeats its answer and does
nothing twice.  An answer to anything but the question that is open is reported and never used.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, get_args

#: Most bytes before the star.
MAX_BODY = 160
_CHECK = 11  # bytes of *LLCCCCRRRR

_BODY = re.compile(rb"(?:0|[1-9][0-9]{0,4})(?: [!-)+-~]+)+")  # words: printable, no space, no star
_TRAILER = re.compile(rb"\*([0-9A-F]{2})([0-9A-F]{4})([0-9A-F]{4})")


@dataclass(frozen=True)
class Line:
    """One whole, checked line."""

    seq: int  # sequence number, 0 to 65535
    words: tuple[str, ...]  # what follows it; at least one


@dataclass(frozen=True)
class Damaged:
    """Bytes that are no line."""

    # ``overlong``, ``check`` (no star, length and CRC at the end), ``length``, ``crc`` or ``grammar``
    why: str
    data: bytes  # what was received, without the end of line; cut at the longest line


def crc16(data: bytes) -> int:
    """Return the CRC-16 of the bytes."""
    return crc_hqx(data, 0xFFFF)


def encode_line(seq: int, *words: str) -> bytes:
    """Return the bytes of a line, its end included; ValueError where the words make no line."""
    body = " ".join([str(seq), *words]).encode("ascii")
    whole = _BODY.fullmatch(body) and body.count(b" ") == len(words)
    if seq > 0xFFFF or not whole or len(body) > MAX_BODY:
        raise ValueError(f"these words make no line: {body!r}")
    # The CRC-16 of what is before it, and that of the same bytes backwards, are a check of 31 bits: the two
    # codes share only the factor x + 1.
    checked = body + b"*%02X" % len(body)
    return checked + b"%04X%04X\n" % (crc16(checked), crc16(checked[::-1]))


def decode_line(data: bytes) -> Line | Damaged:
    """Return the line that these bytes are (without the end of line), or why they are none."""
    if len(data) > MAX_BODY + _CHECK:
        return Damaged("overlong", data[: MAX_BODY + _CHECK])
    body, trailer = data[:-_CHECK], _TRAILER.fullmatch(data[-_CHECK:])
    if trailer is None:
        return Damaged("check", data)
    # the usual damage, an overrun, drops bytes: the head of one line meets the tail of another
    if int(trailer[1], 16) != len(body):
        return Damaged("length", data)
    checked = data[:-8]
    if int(trailer[2], 16) != crc16(checked) or int(trailer[3], 16) != crc16(checked[::-1]):
        return Damaged("crc", data)
    # single spaces, printable words, whole numbers in one spelling: what is left of the damage shows here
    if not _BODY.fullmatch(body):
        return Damaged("grammar", data)
    number, *words = body.decode("ascii").split(" ")
    return Line(int(number), tuple(words)) if int(number) <= 0xFFFF else Damaged("grammar", data)


class LineParser:
    """Cut a stream of bytes into lines."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[Line | Damaged]:
        """Take what was received and return the lines that it completes, in order."""
        events: list[Line | Damaged] = []
        *ended, unended = data.split(b"\n")
        for piece in ended:
            self._add(piece)
            # an empty line means nothing: a host sends one to end what the other side has received by half
            events += [decode_line(bytes(self._pending))] if self._pending else []
            self.reset()
        self._add(unended)
        return events

    def reset(self) -> None:
        """Forget a line whose end has not come: the connection is a new one."""
        self._pending.clear()

    def _add(self, piece: bytes) -> None:
        """Keep at most one byte more than the longest line."""
        room = MAX_BODY + _CHECK + 1 - len(self._pending)
        self._pending += piece[:room]


_INT = re.compile(r"0|-?[1-9][0-9]{0,9}")


def integer(text: str) -> int:
    """Return a 32-bit integer, signed or not, in its one spelling; ValueError for anything else."""
    _check(_INT.fullmatch(text) is not None and -(2**31) <= int(text) <= 0xFFFFFFFF)
    return int(text)


def integers(text: str) -> tuple[int, ...]:
    """Return integers with commas between them."""
    return tuple(map(integer, text.split(",")))


def _switch(text: str) -> int:
    _check(text in ("0", "1"))
    return int(text)


def _check(sound: bool) -> None:
    if not sound:
        raise ValueError("malformed")


def _message_words(message: Request | State) -> tuple[str, ...]:
    """Return the fields of a message in their order, each as a word."""
    values = vars(message).values()
    return tuple((",".join(map(str, v)) or "-") if isinstance(v, tuple) else str(v) for v in values)


LOST = ("open", "short")
MAX_TTL_MS = 2000
PROTOCOL = "thermogrip/1"
MODES = ("off", "armed", "expired", "latched")
CAUSES = ("power", "external", "brownout", "watchdog", "software", "unknown")

#: What a device may refuse with, and what that means.
REFUSALS = {
    "hello": "the device was reset and has not been greeted since",
    "latched": "a fault is latched; repair it, then clear",
    "interlock": "no drive while the pump is off",
    "range": "a number is out of its range",
    "ttl": "the time to live is not 1 to 2000 ms",
    "active": "the fault is still there, so it cannot be cleared",
    "syntax": "the question has the wrong words",
    "unknown": "the device does not know this question",
    "corrupt": "the device received a damaged line",
}

_DEVICE_NAME = re.compile(r"[a-z][a-z0-9_]{0,15}")
_FAULT = re.compile(rf"pump|(over|under|open|short):{_DEVICE_NAME.pattern}")
_VERSION_WORD = re.compile(r"[0-9A-Za-z.+-]{1,16}")


@dataclass(frozen=True)
class Hello:
    """Ask who the device is; it switches everything off."""


@dataclass(frozen=True)
class Read:
    """Ask for the state."""


@dataclass(frozen=True)
class Drive:
    """Drive for ``ttl_ms`` and no longer: pump 0 or 1, one integer a drive (1e-4 of its unit)."""

    ttl_ms: int
    pump: int
    drive: tuple[int, ...]


@dataclass(frozen=True)
class Grip:
    """Close (1) or open (0) the gripper."""

    closed: int


@dataclass(frozen=True)
class Off:
    """Switch drive and pump off; always obeyed."""


@dataclass(frozen=True)
class Clear:
    """Clear the fault latch, if what tripped it is over."""


Request: TypeAlias = Hello | Read | Drive | Grip | Off | Clear
_FORMS: dict[str, tuple[Callable[[str], Any], ...]] = {
    "drive": (integer, _switch, integers),
    "grip": (_switch,),
}
_KINDS: dict[str, type[Request]] = {kind.__name__.lower(): kind for kind in get_args(Request)}


@dataclass(frozen=True)
class Channel:
    """One drive: its name, unit, and range in ten-thousandths of the unit."""

    name: str
    unit: str
    low: int
    high: int


@dataclass(frozen=True)
class Identity:
    """Identity of a device, in the order of every state."""

    version: str  # of the firmware and, behind a plus, the board's serial number
    drives: tuple[Channel, ...]
    pump: bool  # whether a pump is to run before anything is driven
    sensors: tuple[str, ...]  # names of the temperatures, in the order of every state

    def words(self) -> tuple[str, ...]:
        """Return the words after ``ok``."""
        drives = ",".join(f"{c.name}:{c.unit}:{c.low}:{c.high}" for c in self.drives)
        return (PROTOCOL, self.version, drives, "pump" if self.pump else "-", ",".join(self.sensors))


@dataclass(frozen=True)
class State:
    """All that a device knows at one moment."""

    mode: str  # ``off``, ``armed``, ``expired`` (the last drive outlived its time) or ``latched``
    uptime_ms: int  # since the last reset, modulo 2**32
    cause: str  # of the last reset: one of :data:`CAUSES`
    boot: int  # resets so far, modulo 2**16
    faults: tuple[str, ...]  # the latch: ``over:t_tank``, ``open:t_surface``, ``pump``,
    pump: int  # 1 on or closed
    grip: int  # 1 on or closed
    drive: tuple[int, ...]  # what is applied at the pins now [1e-4 of the unit]
    # in thousandths of a degC, ``open`` or ``short`` where a sensor is lost
    temperatures: tuple[int | str, ...]

    def words(self) -> tuple[str, ...]:
        """Return the words after ``ok``."""
        return _message_words(self)


@dataclass(frozen=True)
class Answer:
    """The device answered the open question."""

    request: Request
    content: Identity | State


@dataclass(frozen=True)
class Refused:
    """The device refused the open question; ``code`` is one of :data:`REFUSALS`."""

    request: Request | None
    code: str


@dataclass(frozen=True)
class Boot:
    """The device was reset: why, the count of resets, and its version as in :class:`Identity`."""

    cause: str
    count: int
    version: str


@dataclass(frozen=True)
class Unexpected:
    """A line that answers no open question: ``late``, ``duplicate``, ``echo`` or ``content``."""

    why: str
    line: Line


Event: TypeAlias = Answer | Refused | Boot | Unexpected | Damaged


class HostEnd:
    """The host's side of the conversation: questions out as bytes, bytes in as events."""

    def __init__(self) -> None:
        self._parser = LineParser()
        self._seq = 0
        self._open: Request | None = None
        self._bytes = b""
        self.identity: Identity | None = None

    def ask(self, request: Request) -> bytes:
        """Return the bytes of a new question; an older one that is still open is given up."""
        self._seq = self._seq % 0xFFFF + 1
        self._open, self._bytes = request, encode_line(self._seq, *request_words(request))
        return self._bytes

    def again(self) -> bytes:
        """Return the bytes of the open question once more, after an empty line that ends what was cut."""
        return b"\n" + self._bytes

    def hear(self, data: bytes) -> list[Event]:
        """Take received bytes and return their events, in order."""
        return [self._event(line) for line in self._parser.feed(data)]

    def reset(self) -> None:
        """Forget the open question and half a line: the connection is a new one."""
        self._open = None
        self._parser.reset()

    def _event(self, line: Line | Damaged) -> Event:
        if isinstance(line, Damaged):
            return line
        kind, answer_words = line.words[0], line.words[1:]
        if line.seq == 0:
            return _announcement(line)
        if kind not in ("ok", "err"):
            return Unexpected("echo", line)
        if self._open is None or line.seq != self._seq:
            return Unexpected("duplicate" if line.seq == self._seq else "late", line)
        try:
            if kind == "err":
                _check(len(answer_words) == 1 and answer_words[0] in REFUSALS)
                answered: Event = Refused(self._open, answer_words[0])
            else:
                answered = Answer(self._open, self._content(answer_words))
        except ValueError:
            return Unexpected("content", line)
        self._open = None
        return answered

    def _content(self, words: Sequence[str]) -> Identity | State:
        if isinstance(self._open, Hello):
            self.identity = parse_identity(words)
            return self.identity
        state = parse_state(words)
        if self.identity is not None:
            numbers = (len(state.drive), len(state.temperatures))
            _check(numbers == (len(self.identity.drives), len(self.identity.sensors)))
        return state


def request_words(request: Request) -> tuple[str, ...]:
    """Return the words of a question: its name, and its numbers."""
    return (type(request).__name__.lower(), *_message_words(request))


def parse_request(words: Sequence[str]) -> Request | str:
    """Return the question that the words are, or the code to refuse them with."""
    word, *arguments = words
    if word not in _KINDS:
        return "unknown"
    try:
        return _KINDS[word](*(form(text) for form, text in zip(_FORMS.get(word, ()), arguments, strict=True)))
    except ValueError:
        return "syntax"


def parse_identity(words: Sequence[str]) -> Identity:
    """Return the identity that the words after ``ok`` are, ValueError where they are none."""
    protocol, version, drives, pump, sensors = words
    names = tuple(sensors.split(","))
    _check(protocol == PROTOCOL and _VERSION_WORD.fullmatch(version) is not None and pump in ("pump", "-"))
    _check(all(_DEVICE_NAME.fullmatch(name) for name in names))
    return Identity(version, tuple(map(_channel, drives.split(","))), pump == "pump", names)


def parse_state(words: Sequence[str]) -> State:
    """Return the state that the words after ``ok`` are, ValueError where they are none."""
    mode, uptime, cause, boot, faults, pump, grip, drive, temperatures = words
    latched = () if faults == "-" else tuple(faults.split(","))
    _check(mode in MODES and cause in CAUSES and bool(latched) == (mode == "latched"))
    _check(all(_FAULT.fullmatch(text) for text in latched))
    uptime_ms, boots = integer(uptime), integer(boot)
    _check(uptime_ms >= 0 and 0 <= boots <= 0xFFFF)
    applied = (_switch(pump), _switch(grip), integers(drive))
    readings = tuple(word if word in LOST else integer(word) for word in temperatures.split(","))
    return State(mode, uptime_ms, cause, boots, latched, *applied, readings)


def _announcement(line: Line) -> Event:
    """Return the event of a line that answers no question: a reset, or damage that the device saw."""
    if line.words == ("err", "corrupt"):
        return Refused(None, "corrupt")
    try:
        word, cause, boots, version = line.words
        _check(word == "boot" and cause in CAUSES and 0 <= integer(boots) <= 0xFFFF)
        _check(_VERSION_WORD.fullmatch(version) is not None)
        return Boot(cause, int(boots), version)
    except ValueError:
        return Unexpected("content", line)


def _channel(text: str) -> Channel:
    name, unit, low, high = text.split(":")
    _check(_DEVICE_NAME.fullmatch(name) is not None and bool(unit) and integer(low) <= integer(high))
    return Channel(name, unit, int(low), int(high))
