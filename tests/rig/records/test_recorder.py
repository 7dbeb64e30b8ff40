"""A folder that is somebody else's, and a disk that is really full: a small file system is mounted, filled.

Where nothing may be mounted (only root may) the made-up disk of the run folder's tests has to do.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rig.fault_injection.drills import drill_plants
from tests.rig.makers import Bench, Constant
from thermogrip.datasets.errors import UserError
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import Event
from thermogrip.rig.records import recorder
from thermogrip.rig.records.recorder import RESERVE, RunFolder
from thermogrip.rig.records.run_folder import mark_bad, read_run, recover, sums_agree
from thermogrip.rig.session.session import Session, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no mount here")


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


@pytest.mark.parametrize("disk", ["tmpfs"], indirect=True)
def test_a_device_is_off_when_its_hosts_disk_is_full(disk: Path) -> None:
    bench = Bench(drill_plants()[1], ambient=25.0, seed=1)
    device, rig, clock = bench.device, bench.rig, bench.clock
    fill(disk, leave=RESERVE + 12 * 1024)
    with RunFolder(disk / "run", clock=clock) as folder:
        session = run_session(rig, Constant(0.8, dt=0.5), 45.0, clock=clock, recorder=folder)
        folder.finish(session)
    assert session.trip.kind == "disk"
    assert "free some space" in session.advice
    assert device.applied_drive == {"drive": 0.0}
    rows = session.log["time"].values
    on = [moment.time_s for moment in device.trace if any(moment.drive.values())]
    assert len(on) > 5
    assert on[-1] <= on[0] + (rows[-1] - rows[0])  # not a sample longer than the row that did not fit
    assert_all_on_disk(disk / "run", session.log, but=1)
    rig.close()


@pytest.mark.parametrize(
    "name", ["run.json", "samples.csv", "grasps.csv", "events.jsonl", ".reserve", "SHA256SUMS"]
)
def test_a_folder_with_a_file_that_would_be_overwritten_is_refused_and_left_alone(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text("somebody's night\n")
    with pytest.raises(UserError, match="holds a run" if name == "run.json" else f"holds a {name}"):
        RunFolder(tmp_path)
    assert (tmp_path / name).read_text() == "somebody's night\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


def reached(path: Path) -> str:
    """Return what a file holds, "" where there is none."""
    return path.read_text() if path.exists() else ""


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


def test_a_row_has_the_columns_of_the_first_and_a_lost_number_is_an_empty_cell(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as folder:
        assert (tmp_path / "run" / ".reserve").stat().st_size == 262_144
        folder.sample({"time_s": 0.1 + 0.2, "a,b": float("nan"), "t": 1234.567891234})
        with pytest.raises(ValueError, match="columns changed"):
            folder.sample({"time_s": 1.0, "t": 2.0, "a,b": 3.0})
        folder.event(Event(1.5, "lost", "t", {"k": None}))
        folder.event(Event(2.0, "mood", "\u00b0C"))
    folder.close()
    assert (tmp_path / "run" / "samples.csv").read_text() == 'time_s,"a,b",t\n0.3,,1234.56789\n'
    assert (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8").splitlines() == [
        '{"time_s": 1.5, "kind": "lost", "text": "t", "data": {"k": null}}',
        '{"time_s": 2.0, "kind": "mood", "text": "\u00b0C"}',
    ]
    sums = (tmp_path / "run" / "SHA256SUMS").read_text().splitlines()
    assert [line[64:] for line in sums] == ["  run.json", "  samples.csv", "  events.jsonl"]
    assert sums[1][:64] == sha256((tmp_path / "run" / "samples.csv").read_bytes()).hexdigest()
    assert not (tmp_path / "run" / ".reserve").exists()
    with pytest.raises(OSError, match="Bad file"):
        folder.sample({"time_s": 1.0, "a,b": 1.0, "t": 2.0})


@pytest.mark.parametrize(
    ("error", "verdict", "advice"),
    [(None, "running", None), (KeyboardInterrupt("SIGTERM"), "interrupted", "KeyboardInterrupt: SIGTERM"),
     (RuntimeError("odd"), "failed", "RuntimeError: odd")],
)  # fmt: skip
def test_what_ends_a_run_is_its_verdict(
    tmp_path: Path, error: BaseException | None, verdict: str, advice: str | None
) -> None:
    with pytest.raises(type(error)) if error else nullcontext(), RunFolder(tmp_path / "run"):
        if error is not None:
            raise error
    about = read_run(tmp_path / "run").about
    assert (about["verdict"], about.get("advice")) == (verdict, advice)


@pytest.mark.parametrize(("ended", "verdict"), [("", "played"), ("lost: t", "tripped")])
def test_a_schedule_was_played_or_tripped(tmp_path: Path, ended: str, verdict: str) -> None:
    with RunFolder(tmp_path / "run") as folder:
        folder.played(ended)
        assert not (tmp_path / "run" / ".reserve").exists()
    about = read_run(tmp_path / "run").about
    assert (about["verdict"], about["advice"]) == (verdict, ended)


@pytest.mark.parametrize("trip", [None, Trip("lost", 4.0, "t", "a", "b", figures={"x": float("nan")})])
def test_a_verdict_has_its_figures_and_nothing_that_is_no_json(tmp_path: Path, trip: Trip | None) -> None:
    session = Session(None, None, (), "settled", "go on", 12.5, 0.25, -0.125, trip=trip)
    with RunFolder(tmp_path / "run") as folder:
        folder.finish(session)
    about = read_run(tmp_path / "run").about
    figures = {
        key: about[key] for key in ("verdict", "advice", "settle_time", "overshoot", "bias", "contact_s")
    }
    assert list(figures.values()) == ["settled", "go on", 12.5, 0.25, -0.125, None]
    assert about.get("trip") == (None if trip is None else trip.as_dict())


@pytest.mark.parametrize(
    ("head", "files", "commit"),
    [("abc123\n", {}, "abc123"), ("ref: refs/heads/main\n", {"refs/heads/main": "d4\n"}, "d4"),
     ("ref: refs/heads/main", {"packed-refs": "# pack\ne0 refs/heads/x-main\ne5 refs/heads/main\n"}, "e5"),
     ("ref: refs/heads/main", {"packed-refs": "e5 refs/heads/other\n"}, ""),
     ("ref: refs/heads/main", {}, ""), (None, {}, "")],
)  # fmt: skip
def test_the_commit_that_is_checked_out_is_read_without_git(
    tmp_path: Path, head: str | None, files: dict[str, str], commit: str
) -> None:
    for name, text in {**({} if head is None else {"HEAD": head}), **files}.items():
        path = tmp_path / ".git" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert recorder._commit(tmp_path / "a" / "b") == commit
