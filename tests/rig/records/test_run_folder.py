"""A run folder after a kill, a power cut and a full disk: every measured row is there, and none is wrong.

A folder that is somebody else's, and a disk that is really full: a small file system is mounted, filled.

Where nothing may be mounted (only root may) the made-up disk of the run folder's tests has to do.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.rig.fault_injection.drills import drill_plants
from tests.rig.makers import Bench, Constant
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import read_json
from thermogrip.datasets.schema import names
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import Event
from thermogrip.rig.records import run_folder
from thermogrip.rig.records.run_folder import RunFolder, export_run, mark_bad, read_run, recover, sums_agree
from thermogrip.rig.session.session import Session, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.studies.demo import _fresh
from thermogrip.sysid.plant.plant import Plant

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="no mount here")


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


@POSIX
def test_a_full_disk_ends_a_session_with_power_off_and_all_rows_but_the_last_on_disk(
    disk: Path, plant: Plant, controller: Any
) -> None:
    path, twin = disk / "run", Twin(plant, seed=1)
    folder = RunFolder(path)
    filler = fill(disk, leave=8192)
    session = run_session(twin, controller, 38.0, hold=2000.0, recorder=folder)
    more = fill(disk, name="more")
    folder.finish(session)  # the session has said it
    folder.close()
    assert session.trip.kind == "disk"
    assert "No space left on device" in session.advice
    assert "free some space" in session.advice
    assert not any(twin.read().drive.values())
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


@POSIX
@pytest.mark.parametrize("disk", ["tmpfs"], indirect=True)
def test_a_device_is_off_when_its_hosts_disk_is_full(disk: Path) -> None:
    bench = Bench(drill_plants()[1], ambient=25.0, seed=1)
    device, rig, clock = bench.device, bench.rig, bench.clock
    with RunFolder(disk / "run", clock=clock) as folder:
        fill(disk, leave=12 * 1024)
        session = run_session(rig, Constant(0.8, dt=0.5), 45.0, clock=clock, recorder=folder)
        folder.finish(session)
    assert session.trip.kind == "disk"
    assert "free some space" in session.advice
    assert device.truth().drive == {"drive": 0.0}
    rows = session.log["time"].values
    on = [moment.time_s for moment in device.trace if any(moment.drive.values())]
    assert len(on) > 5
    assert on[-1] <= on[0] + (rows[-1] - rows[0])  # not a sample longer than the row that did not fit
    assert_all_on_disk(disk / "run", session.log, but=2)
    rig.close()


@POSIX
@pytest.mark.parametrize("name", ["run.json", "samples.csv", "grasps.csv", "events.jsonl", "SHA256SUMS"])
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


@POSIX
@pytest.mark.parametrize(
    "name", ["run.json", "samples.csv", "events.jsonl", "grasps.csv", "SHA256SUMS", "notes.txt"]
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


@POSIX
@pytest.mark.parametrize("name", ["samples.csv", "events.jsonl"])
def test_a_link_that_appears_after_the_check_is_not_followed_either(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere, run = tmp_path / "elsewhere", tmp_path / "run"
    elsewhere.write_text("somebody's night\n")
    monkeypatch.setattr(run_folder, "refuse_used", lambda folder: (folder / name).symlink_to(elsewhere))
    with pytest.raises(UserError, match="exists already"):
        RunFolder(run)
    assert reached(elsewhere) == "somebody's night\n"
    assert [path.name for path in run.iterdir()] == [name]  # what was begun is taken back


@POSIX
def test_a_run_is_not_put_where_a_link_leads(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "home")
    with pytest.raises(UserError, match="is a link"):
        RunFolder(tmp_path / "run")
    assert not list((tmp_path / "home").iterdir())


@POSIX
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


@POSIX
def test_a_row_has_the_columns_of_the_first_and_a_lost_number_is_an_empty_cell(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as folder:
        folder.sample({"time_s": 0.1 + 0.2, "a,b": float("nan"), "t": 1234.567891234})
        with pytest.raises(ValueError, match="columns changed"):
            folder.sample({"time_s": 1.0, "t": 2.0, "a,b": 3.0})
        folder.event(Event(1.5, "lost", "t", {"k": None}))
        folder.event(Event(2.0, "mood", "\u00b0C"))
        folder.event(Event(3.0, "bad", "half \ud800 a pair"))
    folder.close()
    assert (tmp_path / "run" / "samples.csv").read_text() == 'time_s,"a,b",t\n0.3,,1234.56789\n'
    assert (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8").splitlines() == [
        '{"time_s": 1.5, "kind": "lost", "text": "t", "data": {"k": null}}',
        '{"time_s": 2.0, "kind": "mood", "text": "\u00b0C"}',
        '{"time_s": 3.0, "kind": "bad", "text": "half ? a pair"}',
    ]
    sums = (tmp_path / "run" / "SHA256SUMS").read_text().splitlines()
    assert [line[64:] for line in sums] == ["  run.json", "  samples.csv", "  events.jsonl"]
    assert sums[1][:64] == sha256((tmp_path / "run" / "samples.csv").read_bytes()).hexdigest()
    with pytest.raises(OSError, match="the run folder is closed"):
        folder.sample({"time_s": 1.0, "a,b": 1.0, "t": 2.0})


@POSIX
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


@POSIX
@pytest.mark.parametrize(("ended", "verdict"), [("", "played"), ("lost: t", "tripped")])
def test_a_schedule_was_played_or_tripped(tmp_path: Path, ended: str, verdict: str) -> None:
    with RunFolder(tmp_path / "run") as folder:
        folder.played(ended)
    about = read_run(tmp_path / "run").about
    assert (about["verdict"], about["advice"]) == (verdict, ended)


@POSIX
@pytest.mark.parametrize("trip", [None, Trip("lost", 4.0, "t", "a", "b")])
def test_a_verdict_has_its_figures_and_nothing_that_is_no_json(tmp_path: Path, trip: Trip | None) -> None:
    session = Session(None, None, (), "settled", "go on", 12.5, 0.25, -0.125, trip=trip)
    with RunFolder(tmp_path / "run") as folder:
        folder.finish(session)
    about = read_run(tmp_path / "run").about
    figures = {
        key: about[key] for key in ("verdict", "advice", "settle_time", "overshoot", "bias", "contact_s")
    }
    assert list(figures.values()) == ["settled", "go on", 12.5, 0.25, -0.125, None]
    assert about.get("trip") == (None if trip is None else asdict(trip))


WRITER = """
import os, sys, threading, time
from thermogrip.rig.records import run_folder
from thermogrip.rig.records.run_folder import RunFolder
from thermogrip.rig.interface import Event
folder = RunFolder(sys.argv[1], {"who": "a process that will be killed"})
run_folder._AT_ONCE_S = 60.0  # this computer may be busy
def stuck(file):
    if threading.current_thread() is threading.main_thread():
        sys.exit("the caller waits for the disk")
    time.sleep(600.0)
if sys.argv[2] == "stuck":
    os.fsync = stuck
folder.event(Event(0.0, "phase", "settle"))
k = 0
while True:
    folder.sample({"time_s": 0.1 * k, "drive": 0.5, "pump": 1.0, "t_surface_degC": 20 + 0.01 * k})
    k += 1
    if k % 50 == 0:
        sys.stdout.write(f"{k}\\n")
        sys.stdout.flush()
"""


def write(path: Path, n: int = 20, *, close: bool = False) -> RunFolder:
    folder = RunFolder(path, {"seed": 3})
    folder.event(Event(0.0, "phase", "settle"))
    for k in range(n):
        folder.sample({"time_s": float(k), "drive": 0.25, "pump": 1.0, "t_surface_degC": 20.0 + k})
    if close:
        folder.close()
    return folder


@pytest.mark.parametrize("disk", ["well", "stuck"])
def test_kill_9_loses_no_row_even_where_nothing_is_forced_to_disk_any_more(disk: str, tmp_path: Path) -> None:
    words = [sys.executable, "-c", WRITER, str(tmp_path / "run"), disk]
    writer = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    reported = 0
    while reported < 1000:
        reported = int(writer.stdout.readline())
    os.kill(writer.pid, signal.SIGKILL)
    rest = writer.communicate()[0].split()
    reported = int(rest[-1]) if rest else reported
    assert writer.returncode == -signal.SIGKILL
    run = read_run(tmp_path / "run")
    assert run.log.sizes["time"] >= reported
    np.testing.assert_allclose(run.log["t_surface"].values, 20 + 0.01 * np.arange(run.log.sizes["time"]))
    assert run.about["verdict"] == "running"
    done = recover(tmp_path / "run")
    assert done.changed
    assert done.run.about["verdict"] == "interrupted"
    assert sums_agree(tmp_path / "run") == []


@settings(max_examples=20, deadline=None)
@given(cut=st.integers(1, 700), zeros=st.integers(0, 40))
def test_whatever_a_power_cut_leaves_reads_as_the_whole_rows_before_it(
    tmp_path_factory: pytest.TempPathFactory, cut: int, zeros: int
) -> None:
    once = tmp_path_factory.getbasetemp() / "whole"
    if not once.exists():
        write(once, 40).close()
    path = tmp_path_factory.mktemp("run")
    for name in ("run.json", "samples.csv", "events.jsonl"):
        shutil.copy(once / name, path)
    whole = (path / "samples.csv").read_bytes()
    left = whole[: max(60, len(whole) - cut)] + b"\0" * zeros
    (path / "samples.csv").write_bytes(left)
    lines = whole.split(b"\n")
    n_whole = left.rstrip(b"\0").count(b"\n") - 1
    run = read_run(path)
    assert run.log.sizes["time"] == n_whole
    recover(path)
    assert (path / "samples.csv").read_bytes() == b"\n".join(lines[: n_whole + 1]) + b"\n"
    if left != (path / "samples.csv").read_bytes():
        assert (path / "samples.csv.damaged").read_bytes() == left  # nothing is thrown away


CUT = "bytes are no whole line (cut off while it was written)"
HEAD = "time_s,t_surface_degC,phase\n"


@pytest.mark.parametrize(
    ("rows", "times", "lost"),
    [("0,20,0\n1,,0\n2,-inf,1e-05\n,22,0\n3,nan,0\n4,1.,0\n5,21\n6,21,0,9\n7,21.5,4\n", [0, 1, 2, 7],
      [f"samples.csv, line {at}: is damaged ({n} bytes); left out"
       for at, n in ((5, 5), (6, 7), (7, 6), (8, 4), (9, 8))]),
     ("0,20,0\n1,21,0\n+1,20,0\n8,2", [0, 1], [f"samples.csv: the last 11 {CUT}"]),
     ("0,20,0\n1,21,0\n\n", [0, 1], [f"samples.csv: the last 1 {CUT}"]),
     ("0,20,0\n", None, []), ("0,20,0\n1,21,0\n", [0, 1], [])],
)  # fmt: skip
def test_a_line_counts_if_it_is_whole_and_the_others_are_named(
    tmp_path: Path, rows: str, times: list[int] | None, lost: list[str]
) -> None:
    write(tmp_path / "run", 0).close()
    (tmp_path / "run" / "SHA256SUMS").unlink()
    (tmp_path / "run" / "samples.csv").write_text(HEAD + rows)
    run = read_run(tmp_path / "run")
    assert (None if run.log is None else run.log["time"].values.tolist()) == times
    assert list(run.lost) == lost
    assert [run.log.attrs["repairs"]] == ["\n".join(lost)] if times else not lost
    done = recover(tmp_path / "run")
    kept = ["samples.csv as it was found is kept as samples.csv.damaged"] if lost else []
    n = len(times or ())
    last = [
        "the run did not end by itself: its verdict is now interrupted",
        f"{n} rows and 1 events are whole",
    ]
    assert list(done.findings) == [*lost, *kept, *last]
    assert done.run.about["about"] == {"seed": 3}
    if lost:
        (tmp_path / "run" / "SHA256SUMS").unlink()
        (tmp_path / "run" / "samples.csv").write_text(HEAD + rows)
        again = recover(tmp_path / "run").findings
        assert "samples.csv as it was found is kept as samples.csv.damaged-2" in again
        assert len(again) == len(lost) + 2  # its verdict is interrupted already


@pytest.mark.parametrize(
    ("samples", "lost"),
    [("", []), ("t,x\n0,1\n", ["samples.csv, line 1: is damaged (3 bytes); left out"]),
     ("t,x\n\0\n", [f"samples.csv: the last 6 {CUT}"])],
)  # fmt: skip
def test_samples_without_their_header_are_none(tmp_path: Path, samples: str, lost: list[str]) -> None:
    write(tmp_path / "run", 0).close()
    (tmp_path / "run" / "samples.csv").write_text(samples)
    run = read_run(tmp_path / "run")
    assert (run.log, run.grasps) == (None, None)
    assert list(run.lost) == lost


def test_events_that_make_no_sense_are_left_out_and_a_lost_run_json_is_a_run_that_did_not_end(
    tmp_path: Path,
) -> None:
    write(tmp_path / "run", 3).close()
    lines = ['{"time_s": 1, "kind": "bad", "text": ""}', '{"time_s": "x", "kind": "a", "text": "b"}', "[1]",
             '{"time_s": 2, "text": "b"}', '{"time_s": 1e999, "kind": "a", "text": "b"}',
             '{"time_s": 2, "kind": "a", "text": "half \\ud800 a pair"}',
             '{"time_s": 3, "kind": "closed", "text": "b", "data": {"k": 1}}']  # fmt: skip
    (tmp_path / "run" / "events.jsonl").write_text("\n".join(lines) + "\n")
    (tmp_path / "run" / "run.json").unlink()
    run = read_run(tmp_path / "run")
    assert run.about == {"about": {}, "verdict": "running"}
    assert run.events == (Event(1.0, "bad", ""), Event(3.0, "closed", "b", {"k": 1}))
    assert run.bad == "bad"
    assert [line.split(":")[0] for line in run.lost] == [f"events.jsonl, line {at}" for at in range(2, 7)]
    (tmp_path / "run" / "samples.csv").unlink()
    with pytest.raises(UserError, match="is no run folder"):
        read_run(tmp_path / "run")


@pytest.mark.parametrize(
    ("data", "role"),
    [(None, "disturbance"), ({"rooms": []}, "output"), ({"rooms": ["t_ambient", "t_gone"]}, "disturbance"),
     ({"rooms": [["t_ambient"], {}]}, "output"),
     ({"rooms": "all"}, "disturbance")],
)  # fmt: skip
def test_the_rooms_are_those_that_the_session_wrote_else_by_name(
    tmp_path: Path, data: Any, role: str
) -> None:
    with RunFolder(tmp_path / "run") as folder:
        folder.event(Event(0.0, "phase", "settle", data or {}))
        for k in range(2):
            folder.sample({"time_s": float(k), "t_ambient_degC": 20.0})
    assert read_run(tmp_path / "run").log["t_ambient"].attrs["role"] == role


def test_a_clean_run_is_left_as_it_is_and_a_changed_one_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "run", close=True)
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    assert not recover(tmp_path / "run").changed
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
    text = (tmp_path / "run" / "samples.csv").read_text()
    (tmp_path / "run" / "samples.csv").write_text(text.replace("25", "26"))
    with pytest.raises(UserError, match="changed after the run ended"):
        recover(tmp_path / "run")


class Disk:
    """A disk with so many bytes left."""

    def __init__(self, room: int) -> None:
        self.room = room

    def write(self, file: int, data: memoryview) -> int:
        part = data[: self.room]
        if not part:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = os.write(file, part)
        self.room -= written
        return written


@pytest.mark.parametrize("room", [425, 426, 442, 458])
def test_a_line_that_fits_by_half_is_cut_off_again(
    plant: Plant, controller: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    path = tmp_path / "run"
    monkeypatch.setattr(run_folder, "_write_bytes", Disk(room).write)
    twin = Twin(plant, seed=1)
    with RunFolder(path) as folder:
        session = run_session(twin, controller, 38.0, recorder=folder)
        folder.finish(session)
    assert session.trip.kind == "disk"
    assert not any(twin.read().drive.values())
    run = read_run(path)
    assert not run.lost
    assert session.log.sizes["time"] - 2 <= run.log.sizes["time"]
    assert run.about["trip"]["kind"] == "disk"


def test_a_disk_without_room_for_the_last_words_keeps_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write(tmp_path / "run", 5)

    def full(file: int, data: memoryview) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run_folder, "_write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        folder.sample({"time_s": 5.0, "drive": 0.0, "pump": 1.0, "t_surface_degC": 25.0})
    run = read_run(tmp_path / "run")
    assert run.log.sizes["time"] == 5
    assert not run.lost


def test_the_run_reads_back_as_the_session_that_it_was(plant: Plant, controller: Any, tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run", {"seed": 1}) as folder:
        session = run_session(Twin(plant, seed=1), controller, 38.0, grasp=("copper", 18.0), recorder=folder)
        folder.finish(session)
    run = read_run(tmp_path / "run")
    assert run.log is not None
    for role in ("input", "disturbance", "output", "other"):
        assert names(run.log, role) == names(session.log, role)
    assert [e.kind for e in run.events] == [e.kind for e in session.events]
    np.testing.assert_allclose(run.grasps["t_surface"].values, session.grasps["t_surface"].values, atol=1e-6)
    assert sums_agree(tmp_path / "run") == []


def test_run_json_says_what_was_run_and_when(tmp_path: Path) -> None:
    RunFolder(tmp_path / "run", {"seed": 7}).close()
    about = read_json(tmp_path / "run" / "run.json", "thermogrip.run", 1)
    assert about["about"] == {"seed": 7}
    assert about["began"].startswith(time.strftime("%Y", time.gmtime()))


@pytest.mark.parametrize(("n", "at"), [(20, 19.0), (0, 0.0)])
def test_a_trial_that_is_marked_bad_keeps_every_byte_of_its_samples(
    tmp_path: Path, n: int, at: float
) -> None:
    write(tmp_path / "run", n, close=True)
    before, events = ((tmp_path / "run" / name).read_bytes() for name in ("samples.csv", "events.jsonl"))
    mark_bad(tmp_path / "run", "the block slipped")
    mark_bad(tmp_path / "run", "half \udcff a pair")  # what a command line has for a byte that is no text
    mark_bad(tmp_path / "run", "twice, by 3 \u00b0C")
    run = read_run(tmp_path / "run")
    assert run.bad == "twice, by 3 \u00b0C"
    assert run.events[-3:-1] == (Event(at, "bad", "the block slipped"), Event(at, "bad", "half ? a pair"))
    assert (tmp_path / "run" / "events.jsonl").read_bytes().startswith(events)
    assert (tmp_path / "run" / "samples.csv").read_bytes() == before
    assert sums_agree(tmp_path / "run") == []
    (tmp_path / "run" / "SHA256SUMS").unlink()
    mark_bad(tmp_path / "run", "again")
    assert sums_agree(tmp_path / "run") is None


@pytest.mark.parametrize(
    ("line", "wrong"),
    [(f"{'0' * 64}  ../../etc/passwd", "../../etc/passwd"),
     ("no sum at all", "SHA256SUMS"), ("0  " + "x" * 99, "x" * 80),
     (f"{'0' * 64}  grasps.csv", "grasps.csv"), (f"{'0' * 64}  run.json", "run.json")],
)  # fmt: skip
def test_sums_that_do_not_agree_are_named_and_open_no_other_file(
    tmp_path: Path, line: str, wrong: str
) -> None:
    write(tmp_path / "run", close=True)
    (tmp_path / "run" / "SHA256SUMS").write_text(f"{line}\n")
    assert sums_agree(tmp_path / "run") == [wrong]
    with pytest.raises(
        UserError, match=r"was changed after the run ended .*; restore that file, or remove SHA256SUMS"
    ):
        recover(tmp_path / "run")


def test_the_folder_of_an_earlier_demo_takes_the_next_one(tmp_path: Path) -> None:
    write(tmp_path / "run", close=True)
    write(_fresh(tmp_path / "run"), 3, close=True)
    assert sums_agree(tmp_path / "run") == []


def test_a_run_without_two_rows_is_not_exported(tmp_path: Path) -> None:
    write(tmp_path / "run", 1).close()
    with pytest.raises(UserError, match="fewer than two rows"):
        export_run(tmp_path / "run", tmp_path / "log.csv")
