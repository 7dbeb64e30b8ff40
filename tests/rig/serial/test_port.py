"""The one door to ports: locks, losses, and coming back."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.rig.makers import PATIENCE_S, SteppedClock, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.rig.serial.port import FIRST_WAIT_S, LONGEST_WAIT_S, Port, PortError, PortLock, port_error
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


def test_bytes_go_both_ways_and_old_input_can_be_thrown_away(
    link: PtyLink | SocketLink, tmp_path: Path
) -> None:
    with Port(link.url, lock_folder=tmp_path) as port:
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On Windows a serial port is waited for by its own time-out."""
    link = PtyLink()
    link.plug()
    with Port(link.url, lock_folder=tmp_path) as port:
        monkeypatch.setattr("thermogrip.rig.serial.port.sys", SimpleNamespace(platform="win32"))
        assert port.read(0.01) == b""
        link.write(b"answer\r\n\0\xff")
        assert port.read(PATIENCE_S) == b"answer\r\n\0\xff"
        assert port.read(0.0) == b""
    link.close()


def test_a_pulled_cable_is_one_error_and_the_port_comes_back_under_the_same_name(
    link: PtyLink | SocketLink, tmp_path: Path
) -> None:
    port = Port(link.url, lock_folder=tmp_path)
    accept(link, port)
    link.pull()
    with pytest.raises(PortError, match="lost") as lost:
        use(port)
    assert lost.value.kind == "lost"
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
    port = Port(str(tmp_path / "nothing"), clock=clock, lock_folder=tmp_path)
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


def test_a_second_port_is_refused_with_its_holder(tmp_path: Path) -> None:
    link = PtyLink()
    link.plug()
    with (
        Port(link.url, lock_folder=tmp_path),
        pytest.raises(PortError, match=f"process {os.getpid()}") as taken,
    ):
        Port(link.url, lock_folder=tmp_path).open()
    assert taken.value.kind == "taken"
    Port(link.url, lock_folder=tmp_path).open()
    link.close()


def test_two_names_of_one_port_are_one_port(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    lock = PortLock(str(tmp_path / "ttyACM0"), tmp_path)
    with pytest.raises(PortError, match="process"):
        PortLock(str(tmp_path / "by-id"), tmp_path)
    lock.release()
    lock.release()
    PortLock(str(tmp_path / "by-id"), tmp_path).release()


def test_a_killed_program_leaves_no_lock(tmp_path: Path) -> None:
    code = (
        "import os, sys; from thermogrip.rig.serial.port import PortLock\n"
        "lock = PortLock('socket://somewhere:1', sys.argv[1]); print('locked', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-P", "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout.readline() == "locked\n"
    with pytest.raises(PortError, match=f"process {other.pid}"):
        PortLock("socket://somewhere:1", tmp_path)
    other.kill()
    other.communicate()
    PortLock("socket://somewhere:1", tmp_path).release()


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A temporary folder of the system, which everybody may write to."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


@pytest.mark.skipif(sys.platform == "win32", reason="there is no such lock")
def test_locks_are_in_a_folder_of_the_users_own_whatever_the_umask(temporary: Path) -> None:
    mask = os.umask(0)
    try:
        lock = PortLock("/dev/ttyACM0")
    finally:
        os.umask(mask)
    assert lock.path.parent.parent == temporary
    assert lock.path.parent.stat().st_mode & 0o7777 == 0o700
    assert lock.path.stat().st_mode & 0o7777 == 0o600
    lock.release()


@pytest.mark.skipif(sys.platform == "win32", reason="there is no such lock")
@pytest.mark.parametrize("there", ["a link", "a folder for all", "a file"])
def test_what_somebody_else_put_in_the_way_is_neither_followed_nor_changed(
    there: str, temporary: Path, tmp_path: Path
) -> None:
    usual, home = PortLock("/dev/ttyACM0"), tmp_path / "home"
    usual.release()
    place = usual.path.parent
    shutil.rmtree(place)
    home.mkdir(mode=0o755)
    if there == "a link":
        place.symlink_to(home)
        (temporary / "thermogrip-ports").symlink_to(home)
    elif there == "a folder for all":
        place.mkdir()
        place.chmod(0o1777)
    else:
        place.touch(mode=0o644)
    before = place.lstat().st_mode
    with pytest.raises(PortError, match=f"cannot be locked .*{place.name} is not a folder of yours alone"):
        PortLock("/dev/ttyACM0")
    assert place.lstat().st_mode == before
    assert home.stat().st_mode & 0o7777 == 0o755
    assert not list(home.iterdir())


def test_another_user_who_has_locks_elsewhere_is_refused_by_the_device_itself(tmp_path: Path) -> None:
    link = PtyLink()
    link.plug()
    with (
        Port(link.url, lock_folder=tmp_path / "ours"),
        pytest.raises(PortError, match="another program") as taken,
    ):
        Port(link.url, lock_folder=tmp_path / "theirs").open()
    assert taken.value.kind == "taken"
    link.close()


def test_a_lock_that_cannot_be_made_says_where(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(PortError, match="cannot be locked"):
        PortLock("COM3", tmp_path / "file")


BUSY = ("taken", "is used by another program", "close that program")
ABSENT = ("check name, cable and power", "write /dev/ttyACM0 or socket://HOST:PORT")


@pytest.mark.parametrize(
    ("error", "want"),
    [(OSError(errno.ENOENT, "gone"), ("absent", "cannot be opened ([Errno 2] gone)", ABSENT[0])),
     (OSError(errno.EACCES, "no"), ("taken", "may not be opened by you", "join the group dialout")),
     (OSError(errno.EBUSY, "no"), BUSY), (OSError("Busy"), BUSY),
     (OSError("Could not exclusively lock port"), BUSY),
     (ValueError("invalid URL"), ("absent", "is no port (invalid URL)", ABSENT[1]))],
)  # fmt: skip
def test_every_way_not_to_open_says_what_to_do(error: Exception, want: tuple[str, str, str]) -> None:
    found = port_error("/dev/ttyACM0", error)
    assert isinstance(found, UserError)
    assert (found.kind, found.problem, found.hint) == want


@pytest.mark.parametrize("url", ["/dev/there-is-none", "socket://127.0.0.1:1", "magic://x"])
def test_an_absent_port_is_one_line(url: str, tmp_path: Path) -> None:
    with pytest.raises(PortError) as absent:
        Port(url, lock_folder=tmp_path).open()
    assert url in str(absent.value)


def test_a_device_that_goes_while_it_is_opened_is_absent_and_its_lock_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    termios = pytest.importorskip("termios")

    def gone(*args: object, **options: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")  # no OSError

    monkeypatch.setattr("serial.serial_for_url", gone)
    port = Port("/dev/ttyACM0", lock_folder=tmp_path)
    with pytest.raises(PortError, match="cannot be opened"):
        port.open()
    assert not port.try_open()
    PortLock("/dev/ttyACM0", tmp_path).release()


def test_a_port_knows_the_usb_device_that_was_opened_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = PtyLink()
    link.plug()
    name, there = os.path.realpath(link.url), []
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: there)
    port, found = Port(link.url, lock_folder=tmp_path), []
    for device, serial_number in (("/dev/ttyS7", "A"), (name, None), (name, "A"), (name, "B")):
        there[:] = [SimpleNamespace(device=device, vid=0x2341, pid=0x43, serial_number=serial_number)]
        port.open()
        found.append(port.usb)
        port.close()
    assert found == [None, None, (0x2341, 0x43, "A"), (0x2341, 0x43, "B")]
    link.close()


def test_a_full_disk_keeps_no_port_shut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.pwrite", full)
    lock = PortLock("/dev/ttyACM0", tmp_path)
    with pytest.raises(PortError, match="another program"):
        PortLock("/dev/ttyACM0", tmp_path)
    lock.release()


def test_a_virtual_devices_port_is_gone_with_it() -> None:
    with VirtualDevice(make_lab(), protocol="tclab") as device:
        name = device.port
        assert Path(name).exists()
    assert not Path(name).parent.exists()
