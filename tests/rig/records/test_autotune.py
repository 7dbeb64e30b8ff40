"""From a rig that nobody has seen to its tuned loop: what it drives, what it keeps, and that it goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.end_to_end.drawn import faults_of
from tests.rig.makers import DirectPort, SteppedClock, make_lab
from thermogrip.cli.autotune import write_page
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import column
from thermogrip.mpc import PIController, Spec, load_controller
from thermogrip.rig.drivers.tclab import TCLabRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.interface import Rig
from thermogrip.rig.records.autotune import Autotune, Tripped
from thermogrip.rig.records.run_folder import read_run
from thermogrip.rig.simulation.virtual_device import VirtualDevice

ROOM, TARGET, LIMIT = 23.0, 38.0, 44.0
#: The least that tune can do.
SPEC = Spec(
    steps=[(ROOM, TARGET)], output=["t1", "t2"], sample_time_s=5.0, hold_s=400.0, settle_within_s=300.0,
    evaluations=1, search_draws=1, check_draws=1,
)  # fmt: skip


class Desk:
    """A virtual TCLab on a desk: one board on a stepped clock, opened anew for each session."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.clock, self.folder, self.options = SteppedClock(), folder, options
        self.device = VirtualDevice(
            make_lab(), protocol="tclab", link="none", clock=self.clock, ambient=ROOM, t_start=ROOM, seed=3
        )
        self.said: list[str] = []

    def open(self) -> Rig:
        self.clock.sleep(100.0)  # of work between sessions, in which it cools
        return TCLabRig(DirectPort(self.device), clock=self.clock, sleep=self.clock.sleep)

    def autotune(self, target: float = TARGET, **options: Any) -> Autotune:
        guard = GuardSettings().below(LIMIT)
        return Autotune(
            self.folder, target, self.open, lambda plant: Guard(plant, guard, skin="t1"), clock=self.clock,
            minutes=20.0, spec=SPEC, models=("arx",), say=self.said.append, **{**self.options, **options},
        )  # fmt: skip


def stop_at(when: str, fraction: float) -> Callable[[float, str], None]:
    """Return a progress that is stopped by Ctrl-C in the middle of something, "" for whatever it is."""

    def progress(done: float, what: str) -> None:
        if when in ("", what) and done >= fraction:
            raise KeyboardInterrupt

    return progress


def tear(run: Path) -> None:
    """Leave a run as a power cut does: half a line at the end, no verdict, no sums."""
    samples, about = run / "samples.csv", run / "run.json"
    samples.write_text(samples.read_text() + "12")
    about.write_text(about.read_text().replace('"interrupted"', '"running"'))
    (run / "SHA256SUMS").unlink()


@dataclass
class Done:
    """What an autotune left that was stopped in its step test, its loop and its tuning."""

    desk: Desk
    work: Autotune
    stopped: list[list[str]]  # the runs that were there at each stop
    first_controller: PIController


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Done:
    desk, stopped = Desk(tmp_path_factory.mktemp("autotune") / "board"), []
    for when, fraction in (("playing the schedule", 0.02), ("following the profile", 0.27), ("", 0.5)):
        with pytest.raises(KeyboardInterrupt):
            desk.autotune(progress=stop_at(when, fraction)).run()
        assert desk.device.truth().drive == {"q1": 0.0, "q2": 0.0}
        stopped.append(sorted(path.name for path in desk.folder.glob("0*")))
        if when:
            tear(desk.folder / stopped[-1][-1])
    first = load_controller(desk.folder / "controller.json")
    work = desk.autotune()
    work.run()
    return Done(desk, work, stopped, first)


def test_a_board_that_nobody_has_seen_is_brought_to_its_target(tuned: Done) -> None:
    known = tuned.work.known
    assert known["first"]["minutes"] < 10.0  # what was stopped counts
    assert known["tuned"]["minutes"] <= 20.0
    assert known["checked"]["verdict"] == "settled"
    assert known["checked"]["settle_s"] < 200.0
    assert known["checked"]["overshoot"] < 0.6
    assert tuned.desk.device.truth().drive == {"q1": 0.0, "q2": 0.0}
    assert max(max(moment.temperatures.values()) for moment in tuned.desk.device.trace) < LIMIT
    assert load_controller(tuned.desk.folder / "controller.json").notes["verdict"]


def test_what_was_stopped_goes_on_with_what_is_there(tuned: Done) -> None:
    begun, in_loop, in_tuning = tuned.stopped
    assert begun == ["01-step"]  # a step test that was not played out is played again
    assert in_loop == ["01-step", "02-step", "03-loop"]
    assert in_tuning == in_loop  # its first step was over, and the plant is good
    assert len([line for line in tuned.desk.said if line.startswith("goes on after")]) == 3
    rows = read_run(tuned.desk.folder / "03-loop")
    assert rows.about["verdict"] == "interrupted"
    assert rows.log is not None
    assert tuned.work.known["tuned"]["minutes"] > np.ptp(rows.log["time"].values) / 60


def test_there_is_a_controller_before_it_is_tuned(tuned: Done) -> None:
    assert tuned.first_controller.controlled == ("t1", "t2")
    assert not tuned.first_controller.notes


def test_the_step_test_moves_one_heater_at_a_time_to_half_of_the_way(tuned: Done) -> None:
    log = read_run(tuned.desk.folder / "02-step").log
    assert log is not None
    q1, q2, t1 = (column(log, name) for name in ("q1", "q2", "t1"))
    assert not np.any((q1 > 0) & (q2 > 0))
    assert {*q1.tolist(), *q2.tolist()} == {0.0, 100.0}
    first_off = int(np.argmax(q1 == 0))
    assert t1[first_off] == pytest.approx(0.5 * (t1[0] + TARGET), abs=0.5)


def test_targets_of_the_loop_are_moved_and_stay_below_the_limit(tuned: Done) -> None:
    log = read_run(tuned.desk.folder / "03-loop").log
    assert log is not None
    targets = np.stack([column(log, f"target_{name}") for name in ("t1", "t2")])
    assert targets[:, 0].tolist() == [TARGET, TARGET]
    assert targets.max() <= LIMIT - 2.0
    moved = targets[:, targets[0] != TARGET]
    assert all(np.unique(row).size == 2 for row in moved)
    assert abs(np.corrcoef(moved)[0, 1]) < 0.7


def test_its_page_is_drawn_at_the_size_of_the_outputs(tuned: Done, tmp_path: Path) -> None:
    write_page(tuned.work, tmp_path / "page.html", "a board")
    assert list(faults_of((tmp_path / "page.html").read_text(encoding="utf-8"))) == []


def test_done_is_done(tuned: Done) -> None:
    again, before = tuned.desk.autotune(), tuned.desk.clock()
    again.run()
    assert again.known == tuned.work.known
    assert tuned.desk.clock() == before


def test_a_folder_of_another_target_or_of_something_else_is_refused(tuned: Done, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="another autotune, with target 38"):
        tuned.desk.autotune(41.0).run()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match="holds something else"):
        Desk(tmp_path).autotune().run()


def test_a_trip_ends_it_and_the_rows_stay(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "board")

    def fails(done: float, what: str) -> None:
        if done > 0.02:
            desk.device.fault("sensor_open", sensor="t2")

    with pytest.raises(Tripped, match="lost: t2"):
        desk.autotune(progress=fails).run()
    assert desk.device.truth().drive == {"q1": 0.0, "q2": 0.0}
    assert read_run(desk.folder / "01-step").about["verdict"] == "tripped"


def test_a_heater_that_heats_nothing_is_named(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "board")
    desk.device.fault("driver_stuck", share=0.0)
    with pytest.raises(Tripped, match="driver"):
        desk.autotune().run()
