"""Bytes to lines and back: framing and checks, so that nothing corrupt is taken for a message.

A line is ASCII, made of words with one space between them, and closed by a check:

    SEQ WORD WORD...*LLCCCCRRRR\\n        e.g.  7 read*06EC819405

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
line. Empty lines mean nothing: a host sends one to end whatever stands half received on the other side.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from dataclasses import dataclass

__all__ = ["MAX_BODY", "Damaged", "Line", "LineParser", "crc16", "decode_line", "encode_line"]

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
    if not 0 <= seq <= 0xFFFF or not whole or len(body) > MAX_BODY:
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
