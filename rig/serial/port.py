"""Serial ports: open, read what there is, write, and reopen when the cable is back.

``/dev/ttyACM0``, a pty and ``socket://HOST:PORT`` look alike through pyserial, but fail differently: a pulled
cable is a ``SerialException`` on reading and a plain ``OSError`` on asking how many bytes wait, a closed
socket reads as an exception, a frozen one as nothing.  All of them are one :class:`PortError` here.

**Locks.**  pyserial's ``exclusive`` stops only programs that ask for it too, so a port is also
locked by a file of its own, which dies with the process that holds it (``flock``) and names it.  These
files are in a folder of the user's own: nothing in the system's temporary folder that somebody else made is
used, changed or followed.  Another user's program is stopped by ``exclusive`` alone.  A program that asks for
neither can still open the port and steal bytes; the protocol's checks then see damage and silence. Windows
lets nobody open a serial port twice, and has no such lock.

**Coming back.**  A lost port is opened again after 0.1 s, then after twice as long each time, up to 5 s.  USB
devices may return under another number: a name of ``/dev/serial/by-id`` stays the same.  Whether it is the
same device the driver has to ask; :attr:`Port.usb` is what USB says of it.

Clock and sleep are arguments.  What pyserial itself waits for is real time: a serial line has no other.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import select
import stat
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from thermogrip.datasets.errors import UserError
from thermogrip.rig.clock import BackOff

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
    """The port is ``absent``, ``taken`` or was ``lost`` (its ``kind``)."""

    def __init__(self, kind: str, problem: str, *, file: str, hint: str) -> None:
        self.kind = kind
        super().__init__(problem, file=file, hint=hint)


class PortLock:
    """A lock on a port's name (links to one device are one lock) that dies with its process; PortError where
    another program, or another Port of this one, holds it."""

    def __init__(self, url: str, folder: str | Path | None = None) -> None:
        name = url if "://" in url else os.path.realpath(url)
        place = _own_folder(url) if folder is None else Path(folder)
        # the readable part may be the same for two ports, the digest is not
        readable = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")[-40:]
        self.path = place / f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:8]}.lock"
        self._file = _lock(self.path, url)

    def release(self) -> None:
        """Let the port go; may be called twice.  The file stays: removing it would race with the next."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


class Port:
    """A serial port, pty or socket that is opened, lost and found again.

    ``url`` is ``/dev/ttyACM0``, ``COM3`` or ``socket://127.0.0.1:5000``; a change of ``opened``, which
    counts, shows that the connection is a new one.  ``usb`` are vendor, product and serial number of the USB
    device that was opened last, None where it is none (or has no serial number).
    """

    usb: tuple[int, int, str] | None = None

    def __init__(
        self,
        url: str,
        *,
        baudrate: int = BAUDRATE,
        clock: Callable[[], float] = time.monotonic,
        lock_folder: str | Path | None = None,
    ) -> None:
        self.url, self.baudrate, self.opened = url, baudrate, 0
        self._lock_folder = lock_folder
        self._serial: Any = None
        self._lock: PortLock | None = None
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
        lock = PortLock(self.url, self._lock_folder)
        try:
            options = {} if "://" in self.url else {"exclusive": sys.platform != "win32" or None}
            self._serial = serial.serial_for_url(
                self.url, baudrate=self.baudrate, timeout=0, write_timeout=1.0, **options
            )
        except _NOT_OPENED as error:
            lock.release()
            raise port_error(self.url, error) from error
        self._lock = lock
        self.usb = _usb_identity(self.url)
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
        if self._lock is not None:
            self._lock.release()
            self._lock = None

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

    def __enter__(self) -> Port:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _opened(self) -> Any:
        if self._serial is None:
            raise PortError("lost", "is not open", file=self.url, hint="plug the cable in")
        return self._serial

    def _lost(self, error: Exception) -> PortError:
        if isinstance(error, PortError):
            return error
        self.close()
        return PortError("lost", f"was lost ({error})", file=self.url, hint="check cable and power")


def port_error(url: str, error: Exception) -> PortError:
    """Return the error of a port that could not be opened, with what to do about it."""
    text = str(error)
    code = getattr(error, "errno", None)
    if code == 16 or "exclusively lock" in text or "busy" in text.lower():
        return PortError("taken", "is used by another program", file=url, hint="close that program")
    if code == 13:
        return PortError("taken", "may not be opened by you", file=url, hint="join the group dialout")
    if isinstance(error, ValueError):
        hint = "write /dev/ttyACM0 or socket://HOST:PORT"
        return PortError("absent", f"is no port ({text})", file=url, hint=hint)
    return PortError("absent", f"cannot be opened ({text})", file=url, hint="check name, cable and power")


def _usb_identity(url: str) -> tuple[int, int, str] | None:
    """Return vendor, product and serial number of the USB device behind a port, None where it has none."""
    from serial.tools.list_ports import comports

    name = os.path.realpath(url)
    for port in comports():
        if os.path.realpath(port.device) == name and port.serial_number:
            return port.vid, port.pid, port.serial_number
    return None


def _own_folder(url: str) -> Path:
    """Return the folder of this user's locks, made where absent, which nobody else may write to."""
    base, user_id = Path(tempfile.gettempdir()), getattr(os, "getuid", None)
    if user_id is None:  # Windows, where there are no locks either
        return base
    place = base / f"thermogrip-ports-{user_id()}"
    with contextlib.suppress(OSError):  # it is there, or what is asked next finds nothing
        place.mkdir(mode=0o700)
    try:
        found = place.lstat()
        own = stat.S_ISDIR(found.st_mode) and found.st_uid == user_id() and not found.st_mode & 0o022
    except OSError:
        own = False
    if not own:
        text = f"cannot be locked ({place} is not a folder of yours alone)"
        raise PortError("taken", text, file=url, hint="remove it, or have its owner do it")
    return place


def _lock(path: Path, url: str) -> int | None:
    """Return the open, locked file; None where the system has no such lock."""
    if sys.platform == "win32" or find_spec("fcntl") is None:
        return None
    import fcntl

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        text = f"cannot be locked ({error.strerror}: {path})"
        raise PortError("taken", text, file=url, hint="remove that file, or have its owner do it") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        holder = os.pread(file, 20, 0).decode("ascii", "replace").strip()
        os.close(file)
        text = f"is used by process {holder}" if holder else "is used by another program"
        raise PortError("taken", text, file=url, hint="end that program first") from error
    with contextlib.suppress(OSError):  # a full disk: the lock holds, it only says no name
        os.truncate(file, 0)
        os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
    return file
