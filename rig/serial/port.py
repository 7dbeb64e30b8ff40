"""Serial ports: open, read what there is, write, and reopen when the cable is back.

``/dev/ttyACM0``, a pty and ``socket://HOST:PORT`` look alike through pyserial, but fail differently: a pulled
cable is a ``SerialException`` on reading and a plain ``OSError`` on asking what waits, a closed socket
reads as an exception, a frozen one as nothing.  All of them are one :class:`PortError` here.

USB devices may return under another number: a name of ``/dev/serial/by-id`` stays the same.  Whether it is
the same device the driver has to ask.
"""

from __future__ import annotations

import contextlib
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

from thermogrip.datasets.errors import UserError
from thermogrip.rig.clock import BackOff, Metronome
from thermogrip.rig.interface import Event

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 5.0  # of the back-off
BAUDRATE = 115200
_CHUNK = 4096
_NOT_OPENED: tuple[type[Exception], ...] = (OSError, ValueError)  # SerialException is an OSError
if sys.platform != "win32" and find_spec("termios") is not None:
    import termios

    # pyserial lets it through where a device goes away while its line is set up
    _NOT_OPENED += (termios.error,)
_DROP_S = 0.5


class PortError(UserError):
    """The port is absent or taken, or was lost."""


class Port:
    """A serial port, pty or socket (``socket://127.0.0.1:5000``) that is opened, lost and found again."""

    def __init__(
        self, url: str, *, baudrate: int = BAUDRATE, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.url = url
        self.baudrate = baudrate
        self.opened = 0  # counts: another one shows that the connection is new
        self._serial: Any = None
        self._back_off = BackOff(clock, first=FIRST_WAIT_S, longest=LONGEST_WAIT_S)

    @property
    def is_open(self) -> bool:
        """Whether the port is open; a cable that was pulled shows at the next read or write."""
        return self._serial is not None

    def open(self) -> None:
        """Open the port, or raise PortError where it is absent or taken."""
        import serial

        if self._serial is not None:
            return
        # ``exclusive`` stops every program that asks for it too; one that does not can still open the port
        # and steal bytes, which the protocol's checks see.  Windows lets nobody open a serial port twice
        try:
            options = {} if "://" in self.url else {"exclusive": sys.platform != "win32" or None}
            self._serial = serial.serial_for_url(
                self.url, baudrate=self.baudrate, timeout=0, write_timeout=1.0, **options
            )
        except _NOT_OPENED as error:
            raise port_error(self.url, error) from error
        self.opened += 1
        self._back_off.succeeded()

    def close(self) -> None:
        """Close the port; may be called twice."""
        if self._serial is not None:
            # pyserial forgets a socket whose other end is gone without closing it
            forgotten = getattr(self._serial, "_socket", None)
            with contextlib.suppress(OSError):  # the cable is out: nothing is left to close
                self._serial.close()
            if forgotten is not None:
                forgotten.close()
            self._serial = None

    def try_open(self) -> bool:
        """Open a lost port if its back-off allows another try now; say whether it is open."""
        if self._serial is None and self._back_off.due():
            try:
                self.open()
            except PortError:
                self._back_off.failed()
        return self._serial is not None

    def write(self, data: bytes) -> None:
        """Send the bytes; a port that is lost is closed and raises PortError."""
        try:
            self._opened().write(data)
        except OSError as error:
            raise self._lost(error) from error

    def read(self, seconds: float) -> bytes:
        """Return what has come within so many (real) seconds, empty if nothing did; a port that is lost is
        closed and raises PortError."""
        try:
            port = self._opened()
            # changing pyserial's time-out would set up the whole line anew; Windows can wait for sockets only
            if sys.platform != "win32" or "://" in self.url:
                select.select([port.fileno()], [], [], max(0.0, seconds))
                return bytes(port.read(_CHUNK))
            port.timeout = max(0.0, seconds)
            data = bytes(port.read(1))
            return data + bytes(port.read(port.in_waiting)) if data else data
        except (OSError, TypeError) as error:  # TypeError: pyserial, when another thread closed the port
            raise self._lost(error) from error

    def drop_input(self) -> None:
        """Throw away what has come and was not read."""
        end = time.monotonic() + _DROP_S  # of one that never stops talking no silence is waited for
        while self.read(0.0) and time.monotonic() < end:
            pass

    def _opened(self) -> Any:
        if self._serial is None:
            raise PortError("is not open", file=self.url, hint="plug the cable in")
        return self._serial

    def _lost(self, error: Exception) -> PortError:
        if isinstance(error, PortError):
            return error
        self.close()
        return PortError(f"was lost ({error})", file=self.url, hint="check cable and power")


def port_error(url: str, error: Exception) -> PortError:
    """Return the error of a port that could not be opened, with what to do about it."""
    text = str(error)
    code = getattr(error, "errno", None)
    if code == 16 or "exclusively lock" in text or "busy" in text.lower():
        return PortError("is used by another program", file=url, hint="close that program")
    if code == 13:
        return PortError("may not be opened by you", file=url, hint="join the group dialout")
    if isinstance(error, ValueError):
        hint = "write /dev/ttyACM0 or socket://HOST:PORT"
        return PortError(f"is no port ({text})", file=url, hint=hint)
    return PortError(f"cannot be opened ({text})", file=url, hint="check name, cable and power")


class SerialRig:
    """What drivers share: port, clock (it starts at 0 when the rig is made), notices."""

    def __init__(
        self, port: Port, timeout: float, clock: Callable[[], float], sleep: Callable[[float], None]
    ) -> None:
        self.port = port
        self.timeout = timeout
        self.closed = False
        self._lost = False  # whether the last question was not answered
        self._clock, self._start = clock, clock()
        self._beat = Metronome(clock, sleep)
        self._notices: deque[Event] = deque(maxlen=1000)
        port.open()

    @contextlib.contextmanager
    def _answering(self, consequence: str = "") -> Iterator[None]:
        """Open a lost port if that is due, note that the device does not answer and that it does again."""
        if self.closed:
            raise PortError("is closed", file=self.port.url, hint="open the rig again")
        try:
            if not self.port.try_open():
                raise PortError("is not there", file=self.port.url, hint="check cable and power")
            yield
        except PortError as error:
            if not self._lost:
                self._note("link", f"{error}{consequence}")
            self._lost = True
            raise
        if self._lost:
            self._note("link", "answers again")
        self._lost = False

    def wait(self, seconds: float) -> None:
        """Let time pass; waits that follow each other end on a grid."""
        self._beat.wait(seconds)

    def notices(self) -> list[Event]:
        """Return what happened since the last call, and forget it."""
        happened = list(self._notices)
        self._notices.clear()
        return happened

    def _now(self) -> float:
        return round(self._clock() - self._start, 9)

    def _note(self, kind: str, text: str) -> None:
        self._notices.append(Event(self._now(), kind, text))
