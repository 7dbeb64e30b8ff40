"""The one door to ports: locks, losses, and coming back."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.rig.makers import PATIENCE_S, SteppedClock, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.rig.serial.port import FIRST_WAIT_S, LONGEST_WAIT_S, Port, PortError, port_error
from thermogrip.rig.simulation.cable import PtyLink, SocketLink
from thermogrip.rig.simulation.virtual_device import VirtualDevice


@pytest.fixture(params=["pty", "socket"])
def link(request: pytest.FixtureRequest) -> Iterator[PtyLink | SocketLink]:
    made = PtyLink() if request.param == "pty" else SocketLink()
    made.plug()
    yield made
    made.close()


def accept(link: PtyLink | SocketLink, port: Port) -> None:
    """Let a socket's server take the host in."""
    port.open()
    if isinstance(link, SocketLink):
        link.read(PATIENCE_S)


def use(port: Port) -> None:
    """Write and read; a socket takes a write or two before it knows that nobody is there."""
    for _ in range(5):
        port.write(b"x\n")
        port.read(0.2)


def test_bytes_go_both_ways_and_old_input_can_be_thrown_away(link: PtyLink | SocketLink) -> None:
    with closing(Port(link.url)) as port:
        accept(link, port)
        assert port.read(0.01) == b""
        link.write(b"old" * 100)
        assert port.read(PATIENCE_S)
        port.drop_input()
        assert port.read(0.05) == b""
        port.write(b"question\n")
        assert link.read(PATIENCE_S) == b"question\n"
        link.write(b"answer\r\n\0\xff")
        assert port.read(PATIENCE_S) == b"answer\r\n\0\xff"


def test_all_that_waits_is_read_at_once_where_only_sockets_can_be_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On Windows a serial port is waited for by its own time-out."""
    link = PtyLink()
    link.plug()
    with closing(Port(link.url)) as port:
        port.open()
        monkeypatch.setattr("thermogrip.rig.serial.port.sys", SimpleNamespace(platform="win32"))
        assert port.read(0.01) == b""
        link.write(b"answer\r\n\0\xff")
        assert port.read(PATIENCE_S) == b"answer\r\n\0\xff"
        assert port.read(0.0) == b""
    link.close()


def test_a_pulled_cable_is_one_error_and_the_port_comes_back_under_the_same_name(
    link: PtyLink | SocketLink,
) -> None:
    port = Port(link.url)
    accept(link, port)
    link.pull()
    with pytest.raises(PortError, match="lost"):
        use(port)
    assert not port.is_open
    with pytest.raises(PortError, match="not open"):
        port.read(0.0)
    with pytest.raises(PortError, match="not open"):
        port.write(b"x")
    link.plug()
    assert port.try_open()
    assert port.opened == 2
    accept(link, port)
    link.write(b"again\n")
    assert port.read(PATIENCE_S) == b"again\n"
    port.close()


def test_tries_are_ever_farther_apart_up_to_five_seconds(tmp_path: Path) -> None:
    clock, tried = SteppedClock(), []
    port = Port(str(tmp_path / "nothing"), clock=clock)
    opens = port.open

    def note() -> None:
        tried.append(clock())
        opens()

    port.open = note  # type: ignore[method-assign]
    while clock() < 30.0:
        assert not port.try_open()
        clock.sleep(0.001)
    waits = [b - a for a, b in pairwise(tried)]
    assert waits[:7] == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, LONGEST_WAIT_S], abs=0.003)
    assert tried[0] == 0.0
    assert waits[0] == pytest.approx(FIRST_WAIT_S)


def test_a_second_port_is_refused_until_the_first_is_closed() -> None:
    link = PtyLink()
    link.plug()
    with closing(Port(link.url)) as port:
        port.open()
        with pytest.raises(PortError, match="is used by another program"):
            Port(link.url).open()
    Port(link.url).open()
    link.close()


BUSY = ("is used by another program", "close that program")
ABSENT = ("check name, cable and power", "write /dev/ttyACM0 or socket://HOST:PORT")


@pytest.mark.parametrize(
    ("error", "want"),
    [(OSError(errno.ENOENT, "gone"), ("cannot be opened ([Errno 2] gone)", ABSENT[0])),
     (OSError(errno.EACCES, "no"), ("may not be opened by you", "join the group dialout")),
     (OSError(errno.EBUSY, "no"), BUSY), (OSError("Busy"), BUSY),
     (OSError("Could not exclusively lock port"), BUSY),
     (ValueError("invalid URL"), ("is no port (invalid URL)", ABSENT[1]))],
)  # fmt: skip
def test_every_way_not_to_open_says_what_to_do(error: Exception, want: tuple[str, str]) -> None:
    found = port_error("/dev/ttyACM0", error)
    assert isinstance(found, UserError)
    assert (found.problem, found.hint) == want


@pytest.mark.parametrize("url", ["/dev/there-is-none", "socket://127.0.0.1:1", "magic://x"])
def test_an_absent_port_is_one_line(url: str) -> None:
    with pytest.raises(PortError) as absent:
        Port(url).open()
    assert url in str(absent.value)


def test_a_device_that_goes_while_it_is_opened_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    termios = pytest.importorskip("termios")

    def gone(*args: object, **options: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")  # no OSError

    monkeypatch.setattr("serial.serial_for_url", gone)
    port = Port("/dev/ttyACM0")
    with pytest.raises(PortError, match="cannot be opened"):
        port.open()
    assert not port.try_open()


def test_a_virtual_devices_port_is_gone_with_it() -> None:
    with VirtualDevice(make_lab(), protocol="tclab") as device:
        name = device.port
        assert Path(name).exists()
    assert not Path(name).parent.exists()
