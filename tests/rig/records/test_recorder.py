"""A disk that is really full: a small file system is mounted where this computer lets us, and filled.

Where nothing may be mounted (only root may) the kernel's limit on the size of a file stands in: it, too,
takes the part of a line that still fits and refuses the rest.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rig.fault_injection.drills import drill_plants
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.clock import SteppedClock
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.records.recorder import RESERVE, RunFolder
from thermogrip.rig.records.run_folder import read_run, recover, sums_agree
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
from thermogrip.sysid.plant.plant import Plant

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no mount and no limits here")

LIMITED = """
import resource, sys
from thermogrip.rig.records.recorder import RESERVE, RunFolder
folder = RunFolder(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
written = 0
try:
    while True:
        folder.sample({"time_s": 0.1 * written, "drive": 0.5, "pump": 1.0, "t_surface_degC": 20.25})
        written += 1
except OSError as error:
    print(written, error.strerror)
"""


def mounted(kind: str, folder: Path) -> None:
    """Mount about a megabyte there, or skip."""
    words = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if kind == "ext4":
        maker = shutil.which("mkfs.ext4") or shutil.which("mkfs.ext4", path="/sbin:/usr/sbin")
        if maker is None:
            pytest.skip("no mkfs.ext4 on this computer")
        image = folder.with_suffix(".img")
        image.write_bytes(bytes(2 << 20))
        subprocess.run([maker, "-q", "-m", "0", str(image)], check=True, capture_output=True)
        words = ["mount", "-o", "loop", str(image), str(folder)]
    if shutil.which("mount") is None:
        pytest.skip("no mount on this computer")
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"nothing may be mounted here: {done.stderr.strip()}")


@pytest.fixture(params=["tmpfs", "ext4"])
def disk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted(request.param, folder)
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(disk: Path, *, leave: int = 0, name: str = "filler") -> Path:
    """Fill a disk but for so many bytes (whole kilobytes) and return the file that does."""
    path, left = disk / name, shutil.disk_usage(disk).free - leave
    with path.open("wb", buffering=0) as file:
        try:
            while leave == 0 or left > 0:
                left -= file.write(os.urandom(1024 if leave == 0 else min(1024, left)))
        except OSError:
            pass
    return path


def assert_all_on_disk(path: Path, log: Any, *, but: int = 0) -> None:
    """Check every row, but for so many of the end."""
    run = read_run(path)
    assert run.log is not None
    assert not run.lost
    n = run.log.sizes["time"]
    assert log.sizes["time"] - but <= n <= log.sizes["time"]
    np.testing.assert_allclose(run.log["t_surface"].values, log["t_surface"].values[:n])


def test_a_session_ends_with_power_off_and_every_row_on_disk(
    disk: Path, plant: Plant, controller: Any
) -> None:
    path, twin = disk / "run", Twin(plant, seed=1)
    with RunFolder(path) as folder:
        fill(disk, leave=8192)
        session = run_session(twin, controller, 38.0, hold=2000.0, recorder=folder)
        folder.finish(session)
    assert session.trip is not None
    assert session.trip.kind == "disk"
    assert "No space left on device" in session.advice
    assert "free some space" in session.advice
    assert not any(twin.read().drive.values())
    assert twin.read().pump == 0
    assert_all_on_disk(path, session.log)
    run = read_run(path)
    assert run.about["verdict"] == "tripped"
    assert run.about["trip"]["kind"] == "disk"
    assert [event.kind for event in run.events][-2:] == ["tripped", "verdict"]
    assert sums_agree(path) == []
    assert not recover(path).changed


def test_a_disk_that_takes_not_even_the_last_words_keeps_every_row(
    disk: Path, plant: Plant, controller: Any
) -> None:
    path, twin = disk / "run", Twin(plant, seed=1)
    folder = RunFolder(path)
    (path / ".reserve").unlink()  # as if another program had been quicker
    filler = fill(disk, leave=8192)
    session = run_session(twin, controller, 38.0, hold=2000.0, recorder=folder)
    more = fill(disk, name="more")
    with pytest.raises(UserError, match="the disk is full; free some space"):
        folder.finish(session)
    folder.close()
    assert session.trip is not None
    assert session.trip.kind == "disk"
    assert twin.read().pump == 0
    assert_all_on_disk(path, session.log, but=2)  # the one at hand, and that of the end
    assert read_run(path).about["verdict"] == "running"
    with pytest.raises(UserError, match="free some space"):
        recover(path)
    assert_all_on_disk(path, session.log, but=2)  # a recovery that had no room broke nothing
    more.unlink()
    filler.unlink()
    assert recover(path).run.about["verdict"] == "interrupted"
    assert_all_on_disk(path, session.log, but=2)
    assert sums_agree(path) == []


def test_a_run_does_not_begin_on_a_disk_without_room_for_its_reserve(disk: Path) -> None:
    fill(disk, leave=RESERVE // 2)
    with pytest.raises(UserError, match="the disk is full; free some space"):
        RunFolder(disk / "run")


class Full:
    """A controller that heats whatever it reads."""

    dt = 0.5

    def reset(self, reading: Readings) -> None: ...

    def step(self, reading: Readings, target: Target) -> Move:
        return Move(drive=0.8)


@pytest.mark.parametrize("disk", ["tmpfs"], indirect=True)
def test_a_device_is_off_when_its_hosts_disk_is_full(disk: Path) -> None:
    clock = SteppedClock()
    device = VirtualDevice(drill_plants()[1], link="none", clock=clock, ambient=25.0, t_start=25.0, seed=1)
    rig = DeviceRig(DirectPort(device), clock=clock, sleep=clock.sleep)
    fill(disk, leave=RESERVE + 12 * 1024)
    with RunFolder(disk / "run", clock=clock) as folder:
        session = run_session(rig, Full(), 45.0, clock=clock, recorder=folder)
        folder.finish(session)
    assert session.trip is not None
    assert session.trip.kind == "disk"
    assert "free some space" in session.advice
    assert device.applied_drive == {"drive": 0.0}
    rows = session.log["time"].values
    on = [moment.time_s for moment in device.trace if any(moment.drive.values())]
    assert len(on) > 5
    assert on[-1] <= on[0] + (rows[-1] - rows[0])  # not a sample longer than the row that did not fit
    assert_all_on_disk(disk / "run", session.log, but=1)
    rig.close()


def test_a_file_that_may_not_grow_keeps_its_whole_rows(tmp_path: Path) -> None:
    words = [sys.executable, "-c", LIMITED, str(tmp_path / "run")]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=600)
    written, *why = done.stdout.split()
    assert " ".join(why) == "File too large", done.stderr
    run = read_run(tmp_path / "run")
    assert run.log is not None
    assert run.lost == ()  # the part of a line that fitted was cut off again
    assert run.log.sizes["time"] == int(written)
    assert recover(tmp_path / "run").run.about["verdict"] == "interrupted"
