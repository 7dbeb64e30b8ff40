r"""The rig's protocol, with no port and no clock.

The host asks and the device answers once, with the number of the question (without the check):

    7 drive 2000 1 2500            ->   7 ok armed 81204 power 17 - 1 0 2500 31250,30812,25000
    8 drive 2000 0 2500            ->   8 err interlock
                                        0 boot watchdog 18 0.1.0

Questions: ``hello`` (its identity; switches everything off), ``read``, ``drive TTL_MS PUMP D[,D]``, ``grip
0|1``, ``off``, ``clear`` (the latch), ``sample PERIOD_MS`` (take readings by your own clock) and ``take N``.
A drive holds for its time to live and no longer, at most 2000 ms, and is refused after a reset until the host
has said hello again, so that no reset passes unseen.  Every answer but those of hello and take is the whole
state, so one exchange a sample both drives and reads.

Everything is an integer, so that the same bytes mean the same on both sides: temperatures in thousandths of a
degC (``open`` or ``short`` for a lost sensor), drives in ten-thousandths of their unit, times in
milliseconds.

A question that got no answer is asked again with the same number; the device repeats its answer and does
nothing twice.  An answer to anything but the question that is open is reported and never used.

The page ``docs/reference/protocol.md`` is the specification; its vectors are tests of this module and of the
firmware.

**Readings by the device's own clock.**

    7 take 118            ->   7 ok 82310 118 121 24,1,2500,31250,30812,25000 14,1,2500,31262,30812,25000 -

are three ticks.  The first has the number 118 and was 24 ms old when the device answered, at 82 310 ms of its
own; for the last one (``-``) the device itself came too late.  121 is the number of the tick that is still to
come.  A reading is its age [ms], pump, drives and temperatures, as in a state.

``take N`` confirms that everything before N has arrived, so asking again, with the same number of the
question or with another, can lose nothing: what did not fit or did not arrive is in the next answer.  An
answer that begins after N shows how many ticks were overwritten.

Numbers are whole, in one spelling, so that the same value is the same bytes on both sides.

Bytes to lines and back: framing and checks, so that nothing corrupt is taken for a message
-------------------------------------------------------------------------------------------

A line is ASCII, made of words with one space between them, and closed by a check:

    SEQ WORD WORD...*LLCCCCRRRR\n        e.g.  7 read*06EC819405

``SEQ`` is 0 to 65535 without leading zeros, ``LL`` the number of bytes before the star, ``CCCC`` the CRC-16
of everything up to and with ``LL`` and ``RRRR`` that of the same bytes backwards, all in upper-case
hexadecimal.  The CRC is CCITT (polynomial 0x1021, start 0xFFFF; ``123456789`` gives 29B1), which
:func:`binascii.crc_hqx` computes in C.

**What the check detects.**  One CRC-16 finds every error of up to three bits and every burst of up to 16,
and lets 2**-16 of all others through: too many where numbers stand, since a digit that becomes another leaves
the line well formed. Backwards the same code has the reciprocal polynomial; the two share only the factor x +
1, so together they are a check of 31 bits.  The length is there for the usual damage of a serial line, an
overrun that drops bytes so that the head of one line meets the tail of the next, and the grammar (single
spaces, no leading zeros, printable words) finds most of the rest.

The parser knows no port and no clock: bytes go in, in pieces of any size, and events come out.  A line that
is cut, damaged or overlong becomes a :class:`Damaged` event; after it the parser goes on at the next end of
line. Empty lines mean nothing: a host sends one to end what the other side has received by half.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

#: Most bytes before the star.
MAX_BODY = 160
_CHECK = 11  # bytes of *LLCCCCRRRR
_CRC_START = 0xFFFF

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
    return crc_hqx(data, _CRC_START)


def encode_line(seq: int, *words: str) -> bytes:
    """Return the bytes of a line, its end included; ValueError where the words make no line."""
    body = " ".join([str(seq), *words]).encode("ascii")
    whole = _BODY.fullmatch(body) and body.count(b" ") == len(words)
    if seq > 0xFFFF or not whole or len(body) > MAX_BODY:
        raise ValueError(f"these words make no line: {body!r}")
    checked = body + b"*%02X" % len(body)
    return checked + b"%04X%04X\n" % (crc16(checked), crc16(checked[::-1]))


def decode_line(data: bytes) -> Line | Damaged:
    """Return the line that these bytes are (without the end of line), or why they are none."""
    if len(data) > MAX_BODY + _CHECK:
        return Damaged("overlong", data[: MAX_BODY + _CHECK])
    body, trailer = data[:-_CHECK], _TRAILER.fullmatch(data[-_CHECK:])
    if trailer is None:
        return Damaged("check", data)
    if int(trailer[1], 16) != len(body):
        return Damaged("length", data)
    checked = data[:-8]
    if int(trailer[2], 16) != crc16(checked) or int(trailer[3], 16) != crc16(checked[::-1]):
        return Damaged("crc", data)
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
        *ended, rest = data.split(b"\n")
        for piece in ended:
            self._add(piece)
            events += self._end()
        self._add(rest)
        return events

    def reset(self) -> None:
        """Forget a line whose end has not come: the connection is a new one."""
        self._pending.clear()

    def _add(self, piece: bytes) -> None:
        """Keep at most one byte more than the longest line."""
        room = MAX_BODY + _CHECK + 1 - len(self._pending)
        self._pending += piece[:room]

    def _end(self) -> list[Line | Damaged]:
        data = bytes(self._pending)
        self.reset()
        return [decode_line(data)] if data else []


_INT = re.compile(r"0|-?[1-9][0-9]{0,9}")


def integer(text: str) -> int | None:
    """Return a 32-bit integer, signed or not, in its one spelling; None for anything else."""
    value = int(text) if _INT.fullmatch(text) else None
    return value if value is not None and -(2**31) <= value <= 0xFFFFFFFF else None


def integers(text: str) -> tuple[int, ...] | None:
    """Return integers with commas between them, None if one is none."""
    values = [integer(word) for word in text.split(",")]
    whole = tuple(value for value in values if value is not None)
    return whole if len(whole) == len(values) else None


def join(values: Sequence[int | str]) -> str:
    """Return the values with commas between them."""
    return ",".join(str(value) for value in values)


LOST = ("open", "short")
_HOLE = "-"


@dataclass(frozen=True)
class Kept:
    """One reading of the device's own."""

    age_ms: int  # how long before the answer it was taken
    pump: int
    drive: tuple[int, ...]  # applied then [1e-4 of the unit]
    temperatures: tuple[int | str, ...]  # thousandths of a degC, ``open`` or ``short``

    def word(self) -> str:
        """Return it as a word of a line."""
        return join((self.age_ms, self.pump, *self.drive, *self.temperatures))


@dataclass(frozen=True)
class Taken:
    """Readings of consecutive ticks."""

    uptime_ms: int  # the device's clock at the answer, modulo 2**32
    first: int  # number of the first tick here, modulo 2**32
    next: int  # number of the tick that is still to come; more wait where this answer does not reach it
    readings: tuple[Kept | None, ...]  # none where the device came too late for a tick

    @property
    def waiting(self) -> int:
        """How many ticks wait on the device after these."""
        return (self.next - self.first - len(self.readings)) % 2**32

    def words(self) -> tuple[str, ...]:
        """Return the words after ``ok``."""
        kept = (_HOLE if reading is None else reading.word() for reading in self.readings)
        return (str(self.uptime_ms), str(self.first), str(self.next), *kept)


def parse_taken(words: Sequence[str], n_drives: int) -> Taken | None:
    """Return the readings of the words after ``ok``, None where they are malformed."""
    head = integers(join(words[:3]))
    if head is None or len(words) < 3 or min(head) < 0:
        return None
    uptime_ms, first, to_come = head
    readings = [None if word == _HOLE else _kept(word, n_drives) for word in words[3:]]
    if any(reading is None and word != _HOLE for reading, word in zip(readings, words[3:])):
        return None
    ticks = (to_come - first) % 2**32
    stuck = ticks > 0 and not readings  # would be requested for ever
    sound = len(readings) <= ticks < 2**31 and not stuck
    return Taken(uptime_ms, first, to_come, tuple(readings)) if sound else None


def _kept(word: str, n_drives: int) -> Kept | None:
    parts = word.split(",")
    numbers = integers(join(parts[: 2 + n_drives]))
    values = [part if part in LOST else integer(part) for part in parts[2 + n_drives :]]
    known = tuple(value for value in values if value is not None)
    if numbers is None or not values or len(known) < len(values):
        return None
    age, pump, *drive = numbers
    return Kept(age, pump, tuple(drive), known) if age >= 0 and pump in (0, 1) else None


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
    "idle": "the device takes no readings of its own; it was reset, or never asked to",
    "active": "the fault is still there, so it cannot be cleared",
    "syntax": "the question has the wrong words",
    "unknown": "the device does not know this question",
    "corrupt": "the device received a damaged line",
}

_NAME = re.compile(r"[a-z][a-z0-9_]{0,15}")
_FAULT = re.compile(rf"pump|(over|under|open|short):{_NAME.pattern}")
_VERSION = re.compile(r"[0-9A-Za-z.+-]{1,16}")


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


@dataclass(frozen=True)
class Sample:
    """Take a reading every ``period_ms`` (10 to 1000) from now on, numbered from 0; 0 takes none."""

    period_ms: int


@dataclass(frozen=True)
class Take:
    """Ask for those readings from this number on; all before it have arrived."""

    number: int


Request: TypeAlias = Hello | Read | Drive | Grip | Off | Clear | Sample | Take
_BARE: dict[str, Request] = {"hello": Hello(), "read": Read(), "off": Off(), "clear": Clear()}


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

    version: str  # of the firmware
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
    boot: int  # how many resets there were, modulo 2**16
    faults: tuple[str, ...]  # the latch: ``over:t_tank``, ``open:t_surface``, ``pump``,
    pump: int  # 1 on or closed
    grip: int  # 1 on or closed
    drive: tuple[int, ...]  # what is applied at the pins now [1e-4 of the unit]
    # in thousandths of a degC, ``open`` or ``short`` where a sensor is lost
    temperatures: tuple[int | str, ...]

    def words(self) -> tuple[str, ...]:
        """Return the words after ``ok``."""
        numbers = (str(self.pump), str(self.grip), join(self.drive), join(self.temperatures))
        faults = ",".join(self.faults) or "-"
        return (self.mode, str(self.uptime_ms), self.cause, str(self.boot), faults, *numbers)


@dataclass(frozen=True)
class Answer:
    """The device answered the open question."""

    request: Request
    content: Identity | State | Taken


@dataclass(frozen=True)
class Refused:
    """The device refused the open question; ``code`` is one of :data:`REFUSALS`."""

    request: Request | None
    code: str


@dataclass(frozen=True)
class Boot:
    """The device was reset: why, the count of resets, and its firmware."""

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

    @property
    def open(self) -> Request | None:
        """The question that waits for its answer."""
        return self._open

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
        kind, rest = line.words[0], line.words[1:]
        if line.seq == 0:
            return _announcement(line)
        if kind not in ("ok", "err"):
            return Unexpected("echo", line)
        if self._open is None or line.seq != self._seq:
            return Unexpected("duplicate" if line.seq == self._seq else "late", line)
        answered: Event
        if kind == "err":
            known = len(rest) == 1 and rest[0] in REFUSALS
            answered = Refused(self._open, rest[0]) if known else Unexpected("content", line)
        else:
            content = self._content(rest)
            answered = Unexpected("content", line) if content is None else Answer(self._open, content)
        if not isinstance(answered, Unexpected):
            self._open = None
        return answered

    def _content(self, words: Sequence[str]) -> Identity | State | Taken | None:
        if isinstance(self._open, Hello):
            heard = parse_identity(words)
            self.identity = heard or self.identity
            return heard
        if isinstance(self._open, Take):
            taken = parse_taken(words, len(self.identity.drives)) if self.identity else None
            return taken if taken and all(self._fits(kept) for kept in taken.readings if kept) else None
        state = parse_state(words)
        return state if state is None or self._fits(state) else None

    def _fits(self, heard: State | Kept) -> bool:
        """Say whether it has as many numbers as the device has drives and sensors, where known."""
        known = self.identity
        shape = (len(heard.drive), len(heard.temperatures))
        return known is None or shape == (len(known.drives), len(known.sensors))


def request_words(request: Request) -> tuple[str, ...]:
    """Return the words of a question."""
    if isinstance(request, Drive):
        return ("drive", str(request.ttl_ms), str(request.pump), join(request.drive))
    if isinstance(request, Grip):
        return ("grip", str(request.closed))
    if isinstance(request, Sample):
        return ("sample", str(request.period_ms))
    if isinstance(request, Take):
        return ("take", str(request.number))
    return (next(word for word, bare in _BARE.items() if bare == request),)


def parse_request(words: Sequence[str]) -> Request | str:
    """Return the question that the words are, or the code to refuse them with."""
    word, rest = words[0], words[1:]
    if word in _BARE:
        return "syntax" if rest else _BARE[word]
    if word == "grip":
        return Grip(int(rest[0])) if len(rest) == 1 and rest[0] in ("0", "1") else "syntax"
    if word in ("sample", "take"):
        number = integer(rest[0]) if len(rest) == 1 else None
        return "syntax" if number is None else Sample(number) if word == "sample" else Take(number)
    if word == "drive" and len(rest) == 3:
        ttl, drive = integer(rest[0]), integers(rest[2])
        if ttl is not None and drive is not None and rest[1] in ("0", "1"):
            return Drive(ttl, int(rest[1]), drive)
    return "syntax" if word == "drive" else "unknown"


def parse_identity(words: Sequence[str]) -> Identity | None:
    """Return the identity that the words after ``ok`` are, None where they are none."""
    if len(words) != 5 or words[0] != PROTOCOL or not _VERSION.fullmatch(words[1]):
        return None
    channels = [_channel(text) for text in words[2].split(",")]
    sensors = tuple(words[4].split(","))
    if words[3] not in ("pump", "-") or not all(_NAME.fullmatch(name) for name in sensors):
        return None
    drives = tuple(channel for channel in channels if channel is not None)
    return Identity(words[1], drives, words[3] == "pump", sensors) if len(drives) == len(channels) else None


def parse_state(words: Sequence[str]) -> State | None:
    """Return the state that the words after ``ok`` are, None where they are none."""
    if len(words) != 9:
        return None
    mode, uptime, cause, boot, faults, pump, grip, drive, temperatures = words
    uptime_ms, boots, applied = integer(uptime), integer(boot), integers(drive)
    read = [text if text in LOST else integer(text) for text in temperatures.split(",")]
    latched = () if faults == "-" else tuple(faults.split(","))
    known = mode in MODES and cause in CAUSES and pump in ("0", "1") and grip in ("0", "1")
    faulty = all(_FAULT.fullmatch(text) for text in latched)
    if not known or not faulty or bool(latched) != (mode == "latched"):
        return None
    if uptime_ms is None or boots is None or applied is None or uptime_ms < 0 or not 0 <= boots <= 0xFFFF:
        return None
    values = tuple(value for value in read if value is not None)
    if len(values) != len(read):
        return None
    return State(mode, uptime_ms, cause, boots, latched, int(pump), int(grip), applied, values)


def _announcement(line: Line) -> Event:
    """Return the event of a line that answers no question: a reset, or damage that the device saw."""
    if line.words == ("err", "corrupt"):
        return Refused(None, "corrupt")
    boots = integer(line.words[2]) if len(line.words) == 4 else None
    if line.words[0] != "boot" or boots is None or not 0 <= boots <= 0xFFFF:
        return Unexpected("content", line)
    if line.words[1] not in CAUSES or not _VERSION.fullmatch(line.words[3]):
        return Unexpected("content", line)
    return Boot(line.words[1], boots, line.words[3])


def _channel(text: str) -> Channel | None:
    parts = text.split(":")
    if len(parts) != 4 or not _NAME.fullmatch(parts[0]) or not parts[1]:
        return None
    low, high = integer(parts[2]), integer(parts[3])
    return None if low is None or high is None or low > high else Channel(parts[0], parts[1], low, high)
