"""A schedule is played as it is written, or refused before anything moves."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rig.makers import Bench, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Log, make_log
from thermogrip.rig.interface import Event
from thermogrip.rig.records.run_folder import RunFolder, recover
from thermogrip.rig.session.schedule_player import Playback, play
from thermogrip.sysid.plant.plant import Plant

SCHEDULE = "time_s,drive,pump\n0,0,1\n5,0.3,1\n10,0,1\n15,0,1\n"
UNITS = {"q1": "percent", "q2": "percent"}


def schedule(folder: Path, change: tuple[str, str] = ("", "")) -> Any:
    path = folder / "schedule.csv"
    path.write_text(SCHEDULE.replace(*change) if change[0] else SCHEDULE)
    return read_log(path)


def steps(minutes: float) -> Log:
    """Return steps of a random height and length for both heaters."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 60.0 * minutes)
    drives = {}
    for name in UNITS:
        lengths = rng.integers(20, 200, size=time.size)
        levels = rng.uniform(0.0, 60.0, size=time.size)
        drives[name] = (np.repeat(levels, lengths)[: time.size], "percent", "input")
    return make_log(time, drives, name="schedule")


@pytest.mark.parametrize(
    ("change", "said"),
    [(("5,0.3", "5,nan"), "not whole .*drive: 1 lost value.*into every row"),
     (("0.3,1", "0.3,"), "not whole .*pump: 1 lost value"), (("0,0,1", "0,,1"), "not whole"),
     (("5,0.3", "5,2.0"), "drive is 2 at 5 s; write -1 to 1"),
     (("5,0.3,1", "5,0.3,2"), "pump is 2 at 5 s; write 0 or 1"),
     (("5,0.3,1", "5,0.3,0.5"), "pump is 0.5 at 5 s; write 0 or 1")],
)  # fmt: skip
def test_an_order_that_is_not_whole_or_that_no_rig_can_follow_is_refused_before_anything_moves(
    change: tuple[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=said):
        Playback(schedule(tmp_path, change), {"drive": "1"}, 1.0)


def test_a_row_is_in_force_until_the_next_and_the_last_as_long_as_the_one_before() -> None:
    columns = {"drive": ([0.1, 0.2, 0.3], "1", "input"), "pump": ([1, 1, 0], "1", "input")}
    plan = make_log([100.0, 105.0, 107.0], columns, name="schedule")
    player = Playback(plan, {"drive": "1"}, 0.5)
    player.reset({"time_s": 7.0})
    moves = [player.step({"time_s": 7.0 + t}, 0.0) for t in (0.0, 4.99, 5.0 - 5e-10, 7.0, 50.0)]
    found = [(move.drive["drive"], move.pump) for move in moves]
    assert found == [(0.1, 1), (0.1, 1), (0.2, 1), (0.0, 0), (0.0, 0)]
    assert (player.seconds, player.dt) == (9.0, 0.5)
    assert Playback(plan.isel(time=[0]), {"drive": "1"}, 0.5).seconds == 0.5
    bare = Playback(plan.drop_vars("pump"), {"drive": "1"}, 0.5).step({"time_s": 7.0}, 0.0)
    assert (bare.drive, bare.pump) == ({"drive": 0.3}, 1)


def test_a_schedule_that_was_played_reports_it_and_is_not_recovered(plant: Plant, tmp_path: Path) -> None:
    bench = Bench(plant)
    with RunFolder(tmp_path / "run") as folder:
        _, ended = play(bench.rig, schedule(tmp_path), clock=bench.clock, recorder=folder)
        folder.played(ended)
    bench.close()
    assert json.loads((tmp_path / "run" / "run.json").read_text())["verdict"] == "played"
    assert not recover(tmp_path / "run").changed


def test_a_trip_before_there_are_two_rows_is_one_line(plant: Plant, tmp_path: Path) -> None:
    class Full:
        def sample(self, row: Mapping[str, float]) -> None:
            raise OSError(28, "No space left on device")

        def event(self, event: Event) -> None: ...

    bench = Bench(plant)
    with pytest.raises(UserError, match=r"first reading; disk: .*No space left"):
        play(bench.rig, schedule(tmp_path), clock=bench.clock, recorder=Full())
    assert bench.device.applied_drive == {"drive": 0.0}
    bench.close()


def test_our_device_plays_a_schedule_and_pauses_the_drive_with_the_pump() -> None:
    bench, plan = Bench(make_lab()), steps(1.0)
    plan["pump"] = ("time", np.where(np.arange(60) < 30, 1.0, 0.0))
    log, ended = play(bench.rig, plan, clock=bench.clock)
    assert ended == ""
    assert log.sizes["time"] == 60
    np.testing.assert_allclose(log["q1"].values[:30], plan["q1"].values[:30])
    assert not log["q1"].values[30:].any()
    bench.close()


def test_a_sensor_that_is_lost_while_a_schedule_is_played_ends_it_with_everything_off() -> None:
    bench = Bench(make_lab(), protocol="tclab")

    def progress(done: float, what: str) -> None:
        if done > 0.5:
            bench.device.fault("sensor_open", sensor="t1")

    log, ended = play(bench.rig, steps(2.0), clock=bench.clock, progress=progress)
    assert "t1" in ended
    assert bench.device.applied_drive == {"q1": 0.0, "q2": 0.0}
    assert 60 <= log.sizes["time"] < 90
    bench.close()


@pytest.mark.parametrize("left_out", ["q1", "unit"])
def test_a_schedule_that_does_not_fit_the_rig_is_refused(left_out: str) -> None:
    plan = steps(1.0)
    plan["q1"].attrs["units"] = "1"
    plan = plan.drop_vars("q1") if left_out == "q1" else plan
    with pytest.raises(ValueError, match="no q1 in percent"):
        Playback(plan, UNITS, 1.0)
