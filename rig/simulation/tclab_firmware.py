"""The TCLab's firmware 2.0.1, its faults included.

One line a command, ``WORD [ARG]`` ended by a carriage return or a line feed; one line back, ended by both
(``SCAN`` gives four).  An empty command gives nothing, so the usual ``\\r\\n`` gives one answer.  Words that
end in ``B`` (four bytes, a little-endian float), which no client here uses, are left out.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from thermogrip.rig.firmware.reference import Board, Outputs, Value

TCLAB_VERSION = "TCLab Firmware 2.0.1 Arduino Leonardo/Micro"
LSB = 0.322265625  # degC a count of the converter, whose zero is at -50 degC
CEILINGS = (200.0, 100.0)  # of the pulse widths at the start, for which the plant was identified
_LONGEST_COMMAND = 64


class TCLabCore:
    """A TCLab's firmware since its last reset; called as
    :class:`~thermogrip.rig.firmware.reference.DeviceCore` is."""

    expires_ms: int | None = None
    mode = "armed"  # nothing ever ends
    faults: tuple[str, ...] = ()

    def __init__(self, board: Board | None = None) -> None:
        self.board = board
        self._pending = b""
        self._power, self._ceilings = [0.0, 0.0], list(CEILINGS)
        self._values: Sequence[Value] = (25_000, 25_000)

    @property
    def outputs(self) -> Outputs:
        """Heaters in 1e-4 of a percent, as seen by a plant that was identified at the first ceilings."""
        drives = (p * now / first for p, now, first in zip(self._power, self._ceilings, CEILINGS))
        return Outputs(1, tuple(round(1e4 * min(p, 100.0)) for p in drives), 0, 0)

    def announcement(self) -> bytes:
        """Return nothing: a TCLab does not announce a reset."""
        return b""

    def sample(self, values: Sequence[Value], *, flow: bool, now_ms: int) -> None:
        """Take one sample of both sensors; there is nothing that it would trip."""
        self._values = tuple(values)

    def receive(self, data: bytes, now_ms: int) -> bytes:
        """Take what came over the line and return what goes back."""
        *commands, unended = (self._pending + data.replace(b"\r", b"\n")).split(b"\n")
        self._pending = unended[-_LONGEST_COMMAND:]
        return b"".join(self._answer(command[:_LONGEST_COMMAND]) for command in commands if command.strip())

    def _answer(self, command: bytes) -> bytes:
        text = command.decode("ascii", errors="replace").strip().upper()
        word, _, argument = text.partition(" ")
        return b"".join(line.encode() + b"\r\n" for line in self._lines(word, _to_float(argument)))

    def _lines(self, word: str, value: float) -> list[str]:
        match word:
            case "A" | "X":
                self._power = [0.0, 0.0]
                return ["Start" if word == "A" else "Stop"]
            case "Q1" | "Q2" | "R1" | "R2":  # set, or ask for, a heater in percent of its ceiling
                heater = int(word[1]) - 1
                self._power[heater] = _clip(value, 100.0) if word[0] == "Q" else self._power[heater]
                return [f"{self._power[heater]:.3f}"]
            case "P1" | "P2":  # the ceiling, of 255
                self._ceilings[int(word[1]) - 1] = _clip(value, 255.0)
                return [f"{self._ceilings[int(word[1]) - 1]:.2f}"]
            case "T1" | "T2":
                return [f"{self._temperature(int(word[1]) - 1):.3f}"]
            case "SCAN":
                temperatures = [self._temperature(0), self._temperature(1)]
                return [f"{number:.3f}" for number in (*temperatures, *self._power)]
            case "LED":
                return [f"{_clip(value, 100.0):.2f}"]
            case "VER":
                return [TCLAB_VERSION]
            case _:  # what is no word switches off, too
                self._power = [0.0, 0.0]
                return [word]

    def _temperature(self, channel: int) -> float:
        """Return what the converter makes of a sensor: an open one floats up, a short one is 0."""
        value = self._values[channel]
        if isinstance(value, str):
            return 1023 * LSB - 50.0 if value == "open" else -50.0
        counts = round((value / 1000 + 50.0) / LSB * 10) / 10  # a mean of ten
        return min(max(counts, 0.0), 1023.0) * LSB - 50.0


def _to_float(text: str) -> float:
    """Return the number that a text begins with, 0 for none, as the Arduino's toFloat does."""
    try:
        return float(re.split(r"(?<!^)[+-]|[^0-9.+-]", text.strip())[0])
    except ValueError:
        return 0.0


def _clip(value: float, highest: float) -> float:
    return min(max(value, 0.0), highest)
