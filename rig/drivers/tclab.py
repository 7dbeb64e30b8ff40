"""The TCLab as a rig: a driver that checks every answer, of a board that checks nothing.

The TCLab's protocol has no number, no checksum, no time to live and no trip, so what can be done is done
here: to know which answer is whose, what is plausible, and which board it is.

What cannot be done: **nothing ends the heaters when the program is dead or the cable out**; they stay as they
were until the board loses its power.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from statistics import median

from thermogrip.datasets.errors import UserError
from thermogrip.rig.interface import Reading, check_order
from thermogrip.rig.serial.port import Port, PortError, SerialRig

HEATERS, SENSORS = ("q1", "q2"), ("t1", "t2")
_DECIMAL_LINE = re.compile(rb"(-?(?:0|[1-9][0-9]{0,3})\.[0-9]{3})\r?\n")
_VERSION_LINE = re.compile(rb"TCLab Firmware [ -~]+\r?\n")
_STOP_LINE = re.compile(rb"Stop\r?\n")


@dataclass(frozen=True)
class BoardSettings:
    """What a scan of the board may be."""

    # degC: outside, the converter (-50 degC, 1023 counts of 0.32 K) is at its end, the sensor open or short
    lowest: float = -49.9
    ceiling: float = 130.0
    timeout_s: float = 0.5  # of a line
    fresh_s: float = 10.0  # age of a scan from which a jump is counted: a heater does 0.35 K/s
    same: float = 0.002  # percent: the board answers with three digits


BOARD = BoardSettings()


class TCLabRig(SerialRig):
    """A TCLab behind the rig's interface; inputs ``q1``, ``q2`` in percent, outputs ``t1``, ``t2``.

    A ``jump`` [K] between two scans is asked again; ``timeout`` of a line and ``greeting`` are real seconds.
    """

    expires_s = float("inf")  # nothing on the board ends its heaters
    has_pump = False

    def __init__(
        self,
        port: Port,
        *,
        jump: float = 3.0,
        timeout: float = BOARD.timeout_s,
        greeting: float = 6.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(port, timeout, clock, sleep)
        self.jump = jump
        self.units = dict.fromkeys(HEATERS, "percent")
        self._set = [0.0, 0.0]
        self._pump = 0
        self._last: tuple[float, list[float]] | None = None
        self._known_at, self._heard = 0, 0  # the connection whose board is known; bytes so far
        self.version = self._greet(greeting)

    def read(self) -> Reading:
        """Return the newest scan; NaN where a sensor is lost, everywhere while the board does not answer (its
        heaters are then what they were set to: nothing there ends them)."""
        try:
            temperatures, heaters = self._checked_scan()
        except PortError:
            temperatures, heaters = [float("nan")] * 2, list(self._set)
        drive = dict(zip(HEATERS, heaters))
        return Reading(self._now(), dict(zip(SENSORS, temperatures)), drive, self._pump)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Set both heaters and have the board confirm them; there is no pump, its state is only kept.

        PortError where the board does not confirm: a heater may be as it was.
        """
        check_order(drive, pump, dict.fromkeys(HEATERS, (0.0, 100.0)))
        if self.closed:
            if any(drive.values()) or pump:
                raise RuntimeError("the rig is closed")
            return
        self._set_heaters([float(drive[name]) for name in HEATERS])
        self._pump = pump

    def grasp(self, material: str, t_object: float) -> None:
        """Raise UserError: a TCLab has no gripper."""
        raise UserError("a TCLab cannot grasp", hint="leave --object and --material away")

    def release(self) -> None:
        """Do nothing: nothing was grasped."""

    def close(self) -> None:
        """Switch both heaters off and let the port go; never raises, and may be called twice."""
        if self.closed:
            return
        with suppress(PortError):  # whatever the back-off of a lost port says: this is the last chance
            self.port.open()
        with suppress(PortError):  # one that is not confirmed must not keep the other on: the stop ends both
            self._set_heaters([0.0, 0.0])
        try:
            self._ask(b"X", 1, _STOP_LINE, known=False)  # whatever board it is
            self._set = [0.0, 0.0]
        except PortError as error:
            self._note("link", f"could not be switched off: {error}; PULL THE PLUG, the heaters stay on")
        self.closed = True
        self._last = None
        self._pump = 0
        self.port.close()

    def _greet(self, seconds: float) -> str:
        """Ask for the version until the board answers, and switch the heaters off."""
        for _ in range(max(1, round(seconds / self.timeout))):
            self._wait_for_silence()
            lines = self._once(b"VER", 1, _VERSION_LINE)
            if lines:
                self._known_at = self.port.opened
                self._set_heaters([0.0, 0.0])
                return lines[0].decode("ascii").strip()
        self.port.close()
        hint = "check that it is a TCLab with firmware 2, or give --protocol"
        raise PortError("no TCLab answers here", file=self.port.url, hint=hint)

    def _set_heaters(self, power: list[float]) -> None:
        """Set both heaters; each answer is the value that the board took."""
        for channel, value in enumerate(power):
            text = f"Q{channel + 1} {value:.3f}".encode()
            took = float(self._ask(text, 1, _DECIMAL_LINE)[0])
            if abs(took - value) > BOARD.same:
                self._wait_for_silence()
                took = float(self._ask(text, 1, _DECIMAL_LINE)[0])  # an answer that slipped, or was spoilt
            if abs(took - value) > BOARD.same:
                problem = f"took {took:g} % where q{channel + 1} = {value:g} %"
                raise PortError(problem, file=self.port.url, hint="check cable and power")
            self._set[channel] = round(value, 3)

    def _checked_scan(self) -> tuple[list[float], list[float]]:
        """Return temperatures and heaters, of three scans where one jumps or is not what was set."""
        numbers = self._scan()
        if self._suspect(numbers):
            self._wait_for_silence()
            # without a checksum a flipped digit is as good as any other: each of three scans must be whole,
            # and a single spoilt one loses against two that agree
            scans = [numbers, self._scan(), self._scan()]
            numbers = [median(column) for column in zip(*scans)]
            self._note("damaged", "a scan that could not be right was asked again")
        temperatures, heaters = numbers[:2], numbers[2:]
        if any(abs(now - then) > BOARD.same for now, then in zip(heaters, self._set)):
            was = ", ".join(f"{value:g} %" for value in self._set)
            self._note("reset", f"the heaters are not what was set ({was}): the board was reset")
            self._set = list(heaters)
        self._last = (self._clock(), temperatures)
        lost = [not BOARD.lowest < value < BOARD.ceiling for value in temperatures]
        return [float("nan") if bad else value for bad, value in zip(lost, temperatures)], heaters

    def _suspect(self, numbers: list[float]) -> bool:
        if any(abs(now - then) > BOARD.same for now, then in zip(numbers[2:], self._set)):
            return True
        if self._last is None or self._clock() - self._last[0] > BOARD.fresh_s:
            return any(not BOARD.lowest < value < BOARD.ceiling for value in numbers[:2])
        return any(abs(now - then) > self.jump for now, then in zip(numbers[:2], self._last[1]))

    def _scan(self) -> list[float]:
        return [float(line) for line in self._ask(b"SCAN", 4, _DECIMAL_LINE)]

    def _check_board(self) -> None:
        """Raise PortError where another board than before may answer now."""
        version = self._once(b"VER", 1, _VERSION_LINE)
        if not version or not (scan := self._once(b"SCAN", 4, _DECIMAL_LINE)):
            raise PortError("does not answer", file=self.port.url, hint="check cable and power")
        # the same board where a heater that was on still is, to the last digit; with the heaters off nothing
        # tells one board from another
        heaters_as_set = all(abs(float(now) - then) <= BOARD.same for now, then in zip(scan[2:], self._set))
        same = any(self._set) and heaters_as_set
        if not same or version[0].decode("ascii").strip() != self.version:
            problem = "may be another board now, or was reset: no serial number and no heater tells"
            raise PortError(problem, file=self.port.url, hint="start anew")
        self._known_at = self.port.opened

    def _ask(self, command: bytes, count: int, form: re.Pattern[bytes], *, known: bool = True) -> list[bytes]:
        """Return the lines that answer a command, each of the form; three attempts, of a board that is
        ``known`` or, for what switches off, of any."""
        with self._answering("; nothing on the board ends its heaters"):
            if known and self._known_at != self.port.opened:
                self._check_board()
            before = self._heard
            lines: list[bytes] = []
            for _ in range(1 if self._lost else 3):
                if lines := self._once(command, count, form):
                    break
                self._note("repeated", f"no whole answer to {command.decode()}; asked again")
                self._wait_for_silence()
            if not lines:
                self._known_at = self._known_at if self._heard > before else 0  # the cable may be elsewhere
                raise PortError("does not answer", file=self.port.url, hint="check cable and power")
        return lines

    def _wait_for_silence(self) -> None:
        """Let late answers come, and throw them away; of what never falls silent, those of four lines."""
        # after an answer that did not come, or was not what it had to be: a late one would count for the next
        # who waits longer for answers need not wait longer for none
        silence = min(self.timeout, BOARD.timeout_s)
        end = time.monotonic() + 4 * silence
        while time.monotonic() < end and self.port.read(silence):
            pass

    def _once(self, command: bytes, count: int, form: re.Pattern[bytes]) -> list[bytes]:
        """Ask once; empty unless so many whole lines of the form came, and nothing else."""
        self.port.drop_input()
        self.port.write(command + b"\r\n")
        heard, end = b"", time.monotonic() + count * self.timeout  # real time, as on any serial line
        while heard.count(b"\n") < count:
            piece = self.port.read(min(self.timeout, max(0.0, end - time.monotonic())))
            if not piece:
                return []
            heard += piece
            self._heard += len(piece)
        lines = heard.splitlines(keepends=True)
        return lines if len(lines) == count and all(form.fullmatch(line) for line in lines) else []
