"""Cables that can be pulled (the device's end of a pty or of a TCP socket), and lines that damage bytes.

A pty's host side appears under a name that stays the same through pulling and plugging, a link in a folder of
its own, as ``/dev/serial/by-id`` gives real ones.  A socket listens on the loopback address only.  Bad lines
flip bits, lose bytes and change digits: the virtual device does so on demand, and the tests of the parsers.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import socket
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from random import Random

from thermogrip.datasets.errors import UserError

_CABLE_CHUNK = 4096


class PtyLink:
    """A pseudo-terminal; its host side behaves as a serial port does (UserError on Windows)."""

    def __init__(self) -> None:
        if find_spec("termios") is None or not hasattr(os, "openpty"):
            raise _no_ptys()
        self._folder = Path(tempfile.mkdtemp(prefix="thermogrip-virtual-"))
        self._name = self._folder / "port"
        self._master, self._slave = -1, -1

    @property
    def url(self) -> str:
        """The name of the port."""
        return str(self._name)

    def plug(self) -> None:
        """Make the port appear, in raw mode: no echo, no line editing."""
        if sys.platform == "win32":
            raise _no_ptys()
        import tty

        if self._master >= 0:
            return
        # the device holds the host's side open too, else reading fails while no host has it open
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name.symlink_to(os.ttyname(self._slave))

    def pull(self) -> None:
        """Make it vanish while the host uses it."""
        if self._master < 0:
            return
        self._name.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master, self._slave = -1, -1

    def read(self, seconds: float) -> bytes:
        """Return what came."""
        if not select.select([self._master], [], [], seconds)[0]:
            return b""
        try:
            return os.read(self._master, _CABLE_CHUNK)
        except OSError:  # EIO: a host hung up in between
            return b""

    def write(self, data: bytes) -> None:
        """Send; what a full buffer cannot take is lost."""
        with contextlib.suppress(OSError):
            os.write(self._master, data)

    def close(self) -> None:
        """Pull, and remove the folder."""
        self.pull()
        shutil.rmtree(self._folder, ignore_errors=True)


class SocketLink:
    """A TCP server on the loopback address that serves one host at a time."""

    def __init__(self, port: int = 0) -> None:
        self._port = port
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None

    @property
    def url(self) -> str:
        """``socket://127.0.0.1:PORT``."""
        return f"socket://127.0.0.1:{self._port}"

    def plug(self) -> None:
        """Listen, on the same port as before."""
        if self._server is None:
            self._server = socket.create_server(("127.0.0.1", self._port))
            self._port = int(self._server.getsockname()[1])

    def pull(self) -> None:
        """Hang up and listen no more."""
        for end in (self._client, self._server):
            if end is not None:
                end.close()
        self._client = self._server = None

    def read(self, seconds: float) -> bytes:
        """Return what came; a second host waits until the first is gone."""
        waiting = self._client or self._server
        if waiting is None or not select.select([waiting], [], [], seconds)[0]:
            return b""
        if self._client is None:
            assert self._server is not None
            self._client = self._server.accept()[0]
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._client.recv(_CABLE_CHUNK)
        except OSError:
            data = b""
        if not data:  # the host hung up
            self._client.close()
            self._client = None
        return data

    def write(self, data: bytes) -> None:
        """Send; without a host it is lost."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.sendall(data)

    def close(self) -> None:
        """Hang up."""
        self.pull()


def _no_ptys() -> UserError:
    hint = "serve a socket: --socket PORT, or link='socket'"
    return UserError("this system has no pseudo-terminals", hint=hint)


def flip(data: bytes, rng: Random) -> bytes:
    """Return the bytes with one to eight bits turned over."""
    spoilt = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        spoilt[rng.randrange(len(spoilt))] ^= 1 << rng.randrange(8)
    return bytes(spoilt)


def lose(data: bytes, rng: Random) -> bytes:
    """Return the bytes without up to twenty in a row, as an overrun does."""
    start = rng.randrange(len(data))
    return data[:start] + data[start + rng.randint(1, 20) :]


def digit(data: bytes, rng: Random) -> bytes:
    """Return the bytes with up to four digits changed into others: the worst case, since the grammar stays
    right."""
    places = [k for k, byte in enumerate(data) if 48 <= byte <= 57]
    spoilt = bytearray(data)
    for place in rng.sample(places, min(len(places), rng.randint(1, 4))):
        spoilt[place] = rng.choice(b"0123456789")
    return bytes(spoilt)


#: The ways to spoil, by name.
SPOILS = {"flip": flip, "lose": lose, "digit": digit}


def spoil(data: bytes, rng: Random) -> bytes:
    """Return the bytes spoilt in one random way; they may by chance come out as they were."""
    return rng.choice(list(SPOILS.values()))(data, rng) if data else data
