"""A run folder on a disk that hangs: the session waits for none of it, and what is lost is as stated."""

from __future__ import annotations

import errno
import os
import stat
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rig.makers import PATIENCE_S, Bench, SteppedClock, make_lab
from tests.rig.session.test_session import steps
from thermogrip.datasets.errors import UserError
from thermogrip.rig.interface import Event
from thermogrip.rig.records import run_folder
from thermogrip.rig.records.batch import Trial, _keep_plan
from thermogrip.rig.records.run_folder import RunFolder, read_run, sums_agree
from thermogrip.rig.session.session import play


class Stuck:
    """A call of the disk that returns once it is let go; in a session's own thread it takes 5 s of the
    session's clock."""

    def __init__(self, clock: SteppedClock, call: Callable[..., Any]) -> None:
        self.clock, self.call, self.let_go = clock, call, threading.Event()

    def __call__(self, *args: Any) -> Any:
        if threading.current_thread() is threading.main_thread():
            self.clock.sleep(5.0)
        else:
            self.let_go.wait(PATIENCE_S)
        return self.call(*args)


@pytest.fixture
def bench() -> Any:
    made = Bench(make_lab(), protocol="tclab")
    yield made
    made.close()


def soon(look: Callable[[], bool]) -> bool:
    """Say whether something comes true."""
    end = time.monotonic() + PATIENCE_S
    while not look() and time.monotonic() < end:
        time.sleep(0.001)
    return look()


@pytest.mark.parametrize(("where", "call"), [(os, "fsync"), (run_folder, "_write_bytes")])
def test_a_disk_that_hangs_costs_no_sample_and_has_every_row_at_last(
    where: Any, call: str, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folder, "_AT_ONCE_S", 0.0)
    looks, read = [], bench.rig.read
    bench.rig.read = lambda: (looks.append(bench.clock()), read())[1]
    with RunFolder(tmp_path / "run", clock=bench.clock) as folder:
        stuck = Stuck(bench.clock, getattr(where, call))
        monkeypatch.setattr(where, call, stuck)
        log, ended = play(bench.rig, steps(10.0), clock=bench.clock, recorder=folder)
        stuck.let_go.set()
        folder.played(ended)
    assert ended == ""
    assert np.diff(looks).max() < 1.5
    run = read_run(tmp_path / "run")
    np.testing.assert_allclose(run.log["t1"].values, log["t1"].values)
    assert (run.lost, sums_agree(tmp_path / "run")) == ((), [])


def test_a_disk_that_takes_nothing_for_minutes_is_a_trip(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folder, "_AT_ONCE_S", 0.0)
    monkeypatch.setattr(run_folder, "MOST_WAITING", 30)
    with RunFolder(tmp_path / "run", clock=bench.clock) as folder:
        stuck = Stuck(bench.clock, run_folder._write_bytes)
        monkeypatch.setattr(run_folder, "_write_bytes", stuck)
        log, ended = play(bench.rig, steps(100.0), clock=bench.clock, recorder=folder)
        assert bench.device.truth().drive == {"q1": 0.0, "q2": 0.0}
        stuck.let_go.set()
        folder.played(ended)
    assert ended.startswith("disk: the run folder: ")
    assert "the disk has not taken the last 30 lines" in ended
    assert 25 < read_run(tmp_path / "run").log.sizes["time"] < log.sizes["time"]
    assert read_run(tmp_path / "run").about["verdict"] == "tripped"


def test_a_disk_that_cannot_be_forced_any_more_is_a_trip_at_the_next_sample(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(file: int) -> None:
        if bench.clock() > 5.0:
            raise OSError(errno.EIO, "Input/output error")

    folder = RunFolder(tmp_path / "run", clock=bench.clock)
    monkeypatch.setattr(os, "fsync", gone)
    _, ended = play(bench.rig, steps(100.0), clock=bench.clock, recorder=folder)
    folder.close()
    assert ended.startswith("disk: the run folder: expected to be written, measured Input/output error")
    assert bench.device.truth().drive == {"q1": 0.0, "q2": 0.0}


def test_a_fault_at_an_event_is_reported_by_the_next_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, faults = RunFolder(tmp_path / "run"), [OSError(errno.EIO, "Input/output error")]

    def once(file: int) -> None:  # as Linux reports what it could not write
        if faults:
            raise faults.pop()

    monkeypatch.setattr(os, "fsync", once)
    folder.event(Event(0.0, "phase", "settle"))
    assert soon(lambda: not faults)
    with pytest.raises(OSError, match="Input/output error"):
        folder.sample({"time_s": 0.0, "t_surface_degC": 25.0})
    folder.sample({"time_s": 1.0, "t_surface_degC": 25.0})
    folder.close()
    assert read_run(tmp_path / "run").log.sizes["time"] == 2


def test_rows_that_the_disk_refuses_after_the_last_sample_are_no_silent_loss(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: int, data: memoryview) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run_folder, "_AT_ONCE_S", 0.0)
    folder = RunFolder(tmp_path / "run")
    stuck = Stuck(bench.clock, full)
    monkeypatch.setattr(run_folder, "_write_bytes", stuck)
    _, ended = play(bench.rig, steps(5.0), clock=bench.clock, recorder=folder)
    assert ended == ""
    stuck.let_go.set()
    with pytest.raises(UserError, match="the disk is full"):
        folder.played(ended)
    folder.close()


def test_a_power_cut_loses_the_rows_of_a_second_and_no_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, forced, path = [0.0], {}, tmp_path / "run"

    def fsync(file: int) -> None:
        forced[os.fstat(file).st_ino] = os.fstat(file).st_size

    monkeypatch.setattr(os, "fsync", fsync)
    folder = RunFolder(path, clock=lambda: now[0])

    def lines(name: str) -> int:
        """Return the lines of a file that a power cut leaves."""
        size = forced.get((path / name).stat().st_ino, 0)
        return (path / name).read_bytes()[:size].count(b"\n")

    for k in range(1, 41):
        now[0] = 0.1 * k
        folder.sample({"time_s": now[0], "t_surface_degC": 25.0})
        if k % 10 == 0:
            assert soon(lambda: lines("samples.csv") == k + 1)  # noqa: B023 (asked at once)
    folder.sample({"time_s": 4.05, "t_surface_degC": 25.0})
    folder.event(Event(4.05, "lost", "t_surface"))
    assert soon(lambda: lines("events.jsonl") == 1)
    assert lines("samples.csv") == 42
    folder.close()


@pytest.mark.skipif(sys.platform == "win32", reason="a folder cannot be forced to disk there")
def test_a_power_cut_leaves_the_folders_and_the_names_of_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forced: dict[int, set[str]] = {}

    def fsync(file: int) -> None:
        if stat.S_ISDIR(os.fstat(file).st_mode):
            forced[os.fstat(file).st_ino] = set(os.listdir(file))

    monkeypatch.setattr(os, "fsync", fsync)
    batch = tmp_path / "campaign" / "night"
    _keep_plan(batch, [Trial("copper", 38.0)])
    RunFolder(batch / "0001").close()
    for folder, name in [
        (tmp_path, "campaign"), (batch.parent, "night"), (batch, "batch.json"), (batch, "0001"),
        (batch / "0001", "run.json"), (batch / "0001", "samples.csv"), (batch / "0001", "events.jsonl"),
    ]:  # fmt: skip
        assert name in forced[folder.stat().st_ino], name
