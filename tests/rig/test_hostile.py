"""What goes wrong on somebody else's desk: one line each, power off, nothing lost that was there."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.clock import SteppedClock
from thermogrip.rig.drivers.background_sampler import Sampler
from thermogrip.rig.drivers.connect import open_rig, recognise
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.interface import Reading
from thermogrip.rig.records import recorder
from thermogrip.rig.records.recorder import RunFolder
from thermogrip.rig.records.run_folder import mark_bad, recover
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.session.loop import Event
from thermogrip.rig.session.schedule_player import Playback, play
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
from thermogrip.sysid.plant.plant import Plant

SCHEDULE = "time_s,drive,pump\n0,0,1\n5,0.3,1\n10,0,1\n15,0,1\n"


def schedule(folder: Path, change: tuple[str, str] = ("", "")) -> Any:
    path = folder / "schedule.csv"
    path.write_text(SCHEDULE.replace(*change) if change[0] else SCHEDULE)
    return read_log(path)


def opened(plant: Plant) -> tuple[VirtualDevice, DeviceRig, SteppedClock]:
    clock = SteppedClock()
    device = VirtualDevice(plant, link="none", clock=clock, t_start=25.0)
    return device, DeviceRig(DirectPort(device), clock=clock, sleep=clock.sleep), clock


# ---- schedules ----


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("5,0.3", "5,nan"), "not whole .*drive: 1 lost value.*into every row"),
        (("0.3,1", "0.3,"), "not whole .*pump: 1 lost value"),
        (("0,0,1", "0,,1"), "not whole"),
        (("5,0.3", "5,2.0"), "drive is 2 at 5 s; write -1 to 1"),
        (("5,0.3,1", "5,0.3,2"), "pump is 2 at 5 s; write 0 or 1"),
        (("5,0.3,1", "5,0.3,0.5"), "pump is 0.5 at 5 s; write 0 or 1"),
    ],
)
def test_an_order_that_is_not_whole_or_that_no_rig_can_follow_is_refused_before_anything_moves(
    change: tuple[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=said):
        Playback(schedule(tmp_path, change), {"drive": "1"}, 1.0)


def test_a_schedule_that_was_played_says_so_and_is_not_recovered(plant: Plant, tmp_path: Path) -> None:
    _, rig, clock = opened(plant)
    with RunFolder(tmp_path / "run") as folder:
        _, ended = play(rig, schedule(tmp_path), clock=clock, recorder=folder)
        folder.played(ended)
    rig.close()
    assert json.loads((tmp_path / "run" / "run.json").read_text())["verdict"] == "played"
    assert not recover(tmp_path / "run").changed


def test_a_trip_before_there_are_two_rows_is_one_line(plant: Plant, tmp_path: Path) -> None:
    class Full:
        def sample(self, row: Mapping[str, float]) -> None:
            raise OSError(28, "No space left on device")

        def event(self, event: Event) -> None: ...

    device, rig, clock = opened(plant)
    with pytest.raises(UserError, match=r"first reading; disk: .*No space left"):
        play(rig, schedule(tmp_path), clock=clock, recorder=Full())
    assert device.applied_drive == {"drive": 0.0}
    rig.close()


class Greedy:
    """A controller that asks for more than the rig has."""

    dt = 1.0

    def reset(self, reading: Readings) -> None: ...

    def step(self, reading: Readings, target: Target) -> Move:
        return Move(drive=1.0 if reading["time_s"] < 3 else 1.5)


def test_a_drive_that_the_rig_cannot_take_is_a_trip_with_power_off(plant: Plant) -> None:
    device, rig, clock = opened(plant)
    session = run_session(rig, Greedy(), 40.0, clock=clock)
    assert session.trip is not None
    assert session.trip.kind == "drive"
    assert "1.5 is outside -1 to 1" in session.trip.line()
    assert device.applied_drive == {"drive": 0.0}
    rig.close()


# ---- files ----


@pytest.mark.parametrize("name", ["samples.csv", "grasps.csv", "events.jsonl", ".reserve", "SHA256SUMS"])
def test_a_folder_with_a_file_that_would_be_overwritten_is_refused_and_left_alone(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text("somebody's night\n")
    with pytest.raises(UserError, match=f"holds a {name}"):
        RunFolder(tmp_path)
    assert (tmp_path / name).read_text() == "somebody's night\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


def reached(path: Path) -> str:
    """Return what a file holds, "" where there is none."""
    return path.read_text() if path.exists() else ""


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege there")
@pytest.mark.parametrize(
    "name", [".reserve", "run.json", "samples.csv", "events.jsonl", "grasps.csv", "SHA256SUMS", "notes.txt"]
)
@pytest.mark.parametrize("before", ["somebody's night\n", ""])
def test_a_folder_with_a_link_is_refused_and_nothing_is_written_through_it(
    name: str, before: str, tmp_path: Path
) -> None:
    elsewhere, run = tmp_path / "elsewhere", tmp_path / "run"
    run.mkdir()
    if before:
        elsewhere.write_text(before)
    (run / name).symlink_to(elsewhere)
    with pytest.raises(UserError, match=f"{name} is a link"):
        RunFolder(run)
    assert reached(elsewhere) == before
    assert [path.name for path in run.iterdir()] == [name]


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege there")
@pytest.mark.parametrize("name", [".reserve", "samples.csv", "events.jsonl"])
def test_a_link_that_appears_after_the_check_is_not_followed_either(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere, run = tmp_path / "elsewhere", tmp_path / "run"
    elsewhere.write_text("somebody's night\n")
    monkeypatch.setattr(recorder, "refuse_used", lambda folder: (folder / name).symlink_to(elsewhere))
    with pytest.raises(UserError, match="exists already"):
        RunFolder(run)
    assert reached(elsewhere) == "somebody's night\n"
    assert [path.name for path in run.iterdir()] == [name]  # what was begun is taken back


def test_a_run_is_not_put_where_a_link_leads(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "home")
    with pytest.raises(UserError, match="is a link"):
        RunFolder(tmp_path / "run")
    assert not list((tmp_path / "home").iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege there")
@pytest.mark.parametrize("hint", [recover, lambda folder: mark_bad(folder, "slipped")])
@pytest.mark.parametrize("name", ["samples.csv", "events.jsonl", "samples.csv.damaged"])
def test_a_run_with_a_link_is_not_repaired(name: str, hint: Any, tmp_path: Path) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    folder = RunFolder(run)
    folder.sample({"time_s": 0.0, "t_surface_degC": 20.0})
    folder.close()
    (run / "SHA256SUMS").unlink()
    elsewhere.write_text("time_s,t_surface_degC\n0,1\nsomebody's night\n")
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(elsewhere)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    with pytest.raises(UserError, match=f"{name} is a link"):
        hint(run)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


# ---- lines ----


class Flood(DirectPort):
    """A port that never stops talking, and never ends a line."""

    def write(self, data: bytes) -> None: ...

    def read(self, seconds: float) -> bytes:
        return b"\x00" * 64


def test_a_device_that_never_stops_talking_is_not_waited_for_for_ever(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, looks = SteppedClock(), SteppedClock()
    device = VirtualDevice(plant, link="none", clock=clock)
    # what waits for a line asks the computer's clock: here it goes on by a millisecond at each look
    monkeypatch.setattr(time, "monotonic", lambda: looks.sleep(0.001) or looks())
    with pytest.raises(PortError, match="nothing here speaks"):
        DeviceRig(Flood(device), clock=clock, sleep=clock.sleep, timeout=0.02, greeting=0.1)
    with pytest.raises(PortError, match="says only"):
        recognise(Flood(device), seconds=1.0)
    assert looks() < 10.0


def test_readings_that_came_before_a_failure_are_handed_out_first(plant: Plant) -> None:
    class Fails(Twin):
        left = 5

        def read(self) -> Reading:
            self.left -= 1
            if self.left < 0:
                raise OSError("the cable")
            return super().read()

    now = [0.0]
    sampler = Sampler(
        Fails(plant), 0.01, clock=lambda: now[0], sleep=lambda s: now.__setitem__(0, now[0] + s)
    )
    with sampler:
        sampler._thread.join(20.0)
    assert len(sampler.take()) == 5
    with pytest.raises(OSError, match="the cable"):
        sampler.take()


def test_samples_that_the_device_could_not_keep_are_told(plant: Plant, controller: Any) -> None:
    class Late(DeviceRig):
        waits, closed_ = 0, False

        def grasp(self, material: str, t_object: float) -> None:
            super().grasp(material, t_object)
            self.closed_ = True

        def wait(self, seconds: float) -> None:
            super().wait(seconds)
            self.waits += self.closed_
            if self.waits == 50:
                self.waits += 1
                self._sleep(0.6)  # more than 24 readings at 100 Hz

    clock = SteppedClock()
    device = VirtualDevice(plant, link="none", clock=clock, t_start=25.0)
    device.place("copper", 45.0)
    rig = Late(DirectPort(device), clock=clock, sleep=clock.sleep)
    session = run_session(
        rig, controller, 30.0, grasp=("copper", 45.0), grasp_time=2.0, grasp_dt=0.01, clock=clock
    )
    rig.close()
    told = [event.text for event in session.events if event.kind == "lost"]
    assert len(told) == 1
    assert int(told[0].split()[0]) == pytest.approx(60 - 24, abs=4)
    contact = session.log["time"].values[-150:]
    assert np.diff(contact).max() > 0.2  # nothing is made up


def test_a_port_that_vanishes_between_opening_and_reading_is_one_line(plant: Plant) -> None:
    clock = SteppedClock()
    with VirtualDevice(plant, clock=clock) as device:
        rig = open_rig(device.port, clock=clock, sleep=clock.sleep)
    with pytest.raises(UserError) as refused:
        run_session(rig, Greedy(), 30.0, clock=clock)
    assert "\n" not in str(refused.value)
    rig.close()
