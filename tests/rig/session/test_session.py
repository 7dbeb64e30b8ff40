"""Sessions in words: what settles, what does not, what trips, and that power is off afterwards.

A schedule is played as it is written, or refused before anything moves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.rig.conftest import Proportional
from tests.rig.makers import Bench, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Grasps, Log, make_log
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.interface import Event, Reading
from thermogrip.rig.records.run_folder import RunFolder, read_run, recover
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.session.loop import PHASES, hold_last_good
from thermogrip.rig.session.session import Object, Playback, _session_of, grasp_of_rows, play, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip
from thermogrip.sysid.plant.plant import Plant


class Spoilt:
    """A twin whose readings are replaced by ``error`` from a time on."""

    def __init__(self, twin: Twin, error: Mapping[str, float], since: float, until: float = np.inf) -> None:
        self.twin, self.error, self.since, self.until = twin, dict(error), since, until

    def __getattr__(self, name: str) -> Any:
        return getattr(self.twin, name)

    def read(self) -> Reading:
        true = self.twin.read()
        if not self.since <= true.time_s < self.until:
            return true
        return Reading(true.time_s, {**true.values, **self.error}, true.drive, true.pump)


def is_off(twin: Twin) -> bool:
    reading = twin.read()
    return not any(reading.drive.values()) and reading.pump == 0


def test_skin_to_38_settles_holds_and_grasps(plant: Plant, controller: Any) -> None:
    twin = Twin(plant, seed=1)
    session = run_session(twin, controller, 38.0, hold=60.0, grasp=("copper", 18.0))
    assert session.verdict == "settled"
    assert 0 < session.settle_time < 300
    assert abs(session.bias) < 0.15
    assert session.overshoot < 0.25
    assert is_off(twin)


def test_a_settled_verdict_is_true_of_the_real_skin(plant: Plant, controller: Any) -> None:
    for seed in range(3):
        twin, target = Twin(plant, seed=seed), 28.0 + 4 * seed
        assert run_session(twin, controller, target).verdict == "settled"
        assert abs(twin.truth()["t_surface"] - target) < 0.25


def test_a_loop_of_long_samples_settles_over_as_many_readings_as_a_line_takes(plant: Plant) -> None:
    session = run_session(Twin(plant, seed=1), Proportional(gain=0.05, dt=20.0), 30.0)
    assert session.verdict == "settled"
    assert 100 <= session.log["time"].values[-1] < 900


def test_a_loop_that_comes_round_late_settles_as_one_that_does_not(plant: Plant) -> None:
    class Late(Twin):
        """Every wait lasts longer, as on a computer with other work."""

        lateness = np.random.default_rng(7)

        def wait(self, seconds: float) -> None:
            super().wait(round(seconds + self.lateness.uniform(0.0, 1.4), 3))

    mpc = Controller(plant)
    punctual, late = (run_session(kind(plant, seed=1), mpc, 38.0, hold=60.0) for kind in (Twin, Late))
    assert late.verdict == "settled"
    assert late.settle_time == pytest.approx(punctual.settle_time, abs=8.0)
    assert late.overshoot == pytest.approx(punctual.overshoot, abs=0.1)


def test_a_session_opens_a_gripper_that_the_last_one_left_closed(plant: Plant, controller: Any) -> None:
    twin = Twin(plant, seed=1)
    twin.grasp("copper", 5.0)  # and the cable was pulled
    twin.wait(5.0)
    assert twin.truth()["t_surface"] < 22.0
    session = run_session(twin, controller, 30.0)
    assert session.verdict == "settled"
    assert session.events[0].kind == "opened"
    assert abs(twin.truth()["t_surface"] - 30.0) < 0.25


def test_a_gripper_that_does_not_answer_is_a_trip_and_is_opened(plant: Plant, controller: Any) -> None:
    class Deaf(Twin):
        released = 0

        def grasp(self, material: str, t_object: float) -> None:
            raise PortError("did not answer within 0.75 s", file="COM3", hint="check cable")

        def release(self) -> None:
            self.released += 1

    twin = Deaf(plant, seed=1)
    session = run_session(twin, controller, 30.0, grasp=("copper", 18.0))
    assert session.verdict == "tripped"
    assert session.trip.kind == "cable"
    assert twin.released == 2  # at the start, and after the attempt
    assert is_off(twin)


def test_the_grasp_stops_the_pump_one_second_before_and_lasts_ten(plant: Plant, controller: Any) -> None:
    session = run_session(Twin(plant, seed=2), controller, 38.0, grasp=("iron", 18.0))
    g, log = session.grasps, session.log
    np.testing.assert_allclose(g["time"].values, np.round(np.arange(-20, 101) * 0.1, 9), atol=1e-6)
    assert str(g["material"].values[0]) == "iron"
    assert float(g["t_object"].values[0]) == 18.0
    off = log["pump"].values == 0
    assert np.ptp(log["time"].values[off]) == pytest.approx(11.0, abs=1e-6)
    assert np.all(log["drive"].values[off] == 0)
    order = log["phase"].values
    assert np.all(np.diff(order) >= 0)
    assert set(order.astype(int)) == {PHASES.index(p) for p in ("settle", "lead_in", "pump_off", "contact")}


def test_lost_values_of_a_room_are_held() -> None:
    lost = np.array([np.nan, 20.0, np.nan, 21.0, np.inf])
    assert hold_last_good(lost).tolist() == [20.0, 20.0, 20.0, 21.0, 21.0]
    assert hold_last_good(lost[:1]).tolist() == [0.0]


def test_out_of_reach_is_an_answer_not_an_error(plant: Plant, controller: Any) -> None:
    twin = Twin(plant, ambient=20.0)
    controller.gain = 0.001
    session = run_session(twin, controller, 45.0, settle_timeout=100.0)
    assert session.verdict == "not settled"
    assert session.grasps is None
    assert "time" in session.advice
    assert np.isnan(session.settle_time)
    assert session.log["time"].values[-1] <= 100.0
    assert is_off(twin)


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 127.9, -40.0])
def test_the_third_bad_reading_in_a_row_trips(plant: Plant, controller: Any, error: float) -> None:
    twin = Twin(plant)
    session = run_session(Spoilt(twin, {"t_surface": error}, since=50.0), controller, 38.0)
    assert session.verdict == "tripped"
    assert "t_surface" in session.advice
    assert session.log["time"].values[-1] == pytest.approx(51.0)  # the third; the drive is off
    assert session.log["drive"].values[-1] == 0.0
    assert session.trip.kind == "lost"
    assert is_off(twin)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, MemoryError])
def test_power_is_off_whatever_ends_it(plant: Plant, controller: Any, error: type[BaseException]) -> None:
    twin = Twin(plant)

    def break_off(fraction: float, what: str) -> None:
        if twin.time > 20:
            raise error

    with pytest.raises(error):
        run_session(twin, controller, 45.0, progress=break_off)
    assert is_off(twin)


def test_a_grasp_has_its_labels_and_ends_where_that_is_decided(plant: Plant, controller: Any) -> None:
    asked, told = [], []

    def enough(grasp: Grasps) -> bool:
        asked.append(float(grasp["time"].values[-1]))
        return len(asked) == 2

    thing = Object("copper", "t_ambient", 0.3, {"block": "b1", "repeat": 2.0}, "g7")
    report = lambda *given: told.append((round(given[0], 6), given[1]))  # noqa: E731
    options = {"grasp": thing, "grasp_time": 2.0, "stop": enough, "progress": report}
    session = run_session(Twin(plant), controller, 38.0, settle_timeout=400.0, **options)
    assert asked == [0.2, 0.3]  # not of two samples
    events = {event.kind: event for event in session.events}
    assert events["decided"].text == "stopped 0.3 s after contact"
    assert events["closed"].text == "gripper closed on copper at 25 degC"
    about = {"grasp_id": "g7", "material": "copper", "t_object": 25.0, "t_object_sd": 0.3, "t_gripper": 38.0}
    assert events["closed"].data == {**about, "block": "b1", "repeat": 2.0}
    found = session.grasps
    want = {**about, "grasp": about.pop("grasp_id"), "repeat": 2.0, "t_ambient": 25.0, "block": "b1"}
    del want["grasp_id"]
    assert {key: found[key].values.tolist()[0] for key in want} == want
    assert told[:2] == [(0.0, "settling"), (round(0.9 / 400, 6), "settling")]
    assert told[-5:] == [(f, "grasping") for f in (0.9, 0.9, 0.905, 0.91, 0.915)]
    options = {"grasp": ("wood", 38.0), "grasp_time": 2.0, "grasp_dt": 1.0}
    whole = run_session(Twin(plant), controller, 38.0, **options)
    assert whole.grasps["time"].values.tolist() == [-2.0, -1.0, 0.0, 1.0, 2.0]
    assert np.isnan(whole.contact)
    assert "no contact" in [event.kind for event in whole.events]


def test_a_grasp_of_rows_has_what_they_and_its_labels_have() -> None:
    same = {"t_lab_degC": 21.0, "t_skin_2_degC": 31.0}
    rows = [{"time_s": 9.9 + k / 3, "t_skin_degC": 30.0 - k, **same} for k in range(3)]
    about = {"grasp_id": 7, "material": "", "t_object": None, "t_gripper": 38.0, "block": "b", "mood": 1}
    found = grasp_of_rows(rows, 10.0, "t_skin", about, {"t_lab"})
    assert found["time"].values.tolist() == [-0.1, 0.233333, 0.566667]
    assert found["t_surface"].values.tolist() == [[30.0, 29.0, 28.0]]
    assert found["t_surface_2"].values.tolist() == [[31.0] * 3]
    single = {name: found[name].values.tolist()[0] for name in ("grasp", "t_gripper", "block", "t_ambient")}
    assert single == {"grasp": "7", "t_gripper": 38.0, "block": "b", "t_ambient": 21.0}
    assert np.isnan(found["t_object"].values).all()
    assert found.attrs["name"] == " at nan degC"
    assert "t_surface_2" not in grasp_of_rows(rows, 10.0, "t_lab", about, ())


def test_of_several_targets_the_worst_figures_are_the_sessions() -> None:
    """a comes to 30.2 degC at 50 s, b goes 2 K beyond 20 degC; what the contact does counts for neither."""
    t = np.arange(0.0, 201.0)
    columns = {
        "time_s": t, "phase": np.where(t <= 180, t > 100, 4.0), "a_degC": np.where(t < 50, 10.0, 30.2),
        "b_degC": np.where(t < 20, 10.0, np.where(t < 30, 22.0, 19.9)),
    }  # fmt: skip
    columns |= {"target_a_degC": np.full(t.size, 30.0), "target_b_degC": np.full(t.size, 20.0)}
    columns |= {name: np.where(t <= 180, columns[name], 99.0) for name in ("a_degC", "b_degC")}
    run = SimpleNamespace(
        rows=[{}, {}],
        target={"a": 30.0, "b": 20.0},
        column=columns.__getitem__,
        events=[],
        trip=None,
        cycle_s=0.0,
        log=lambda: None,
    )
    found = _session_of(run, "not settled", None, 0.25)
    assert (found.settle_time, found.bias) == (pytest.approx(50, abs=3), pytest.approx(0.2))
    assert found.overshoot == pytest.approx(2.0)
    assert "give it more time" in found.advice
    run.rows = run.rows[:1]
    with pytest.raises(UserError, match="ended at its first reading"):
        _session_of(run, "settled", None, 0.25)


@pytest.mark.parametrize(
    ("target", "text"), [({"t_nose": 30.0}, "no sensor"), (90.0, "unsafe"), (float("nan"), "unsafe")]
)
def test_a_target_that_makes_no_sense_is_refused_before_anything_moves(
    plant: Plant, controller: Any, target: Any, text: str
) -> None:
    twin = Twin(plant)
    with pytest.raises(UserError, match=text):
        run_session(twin, controller, target)
    assert twin.time == 0.0
    assert is_off(twin)


def test_two_targets_must_both_settle(plant: Plant, controller: Any) -> None:
    plain = controller.step
    controller.step = lambda reading, target: plain(reading, target["t_surface"])
    both = {"t_surface": 35.0, "t_tank": 60.0}
    assert run_session(Twin(plant), controller, both, settle_timeout=400.0).verdict == "not settled"


class StuckInContact(Twin):
    """Its driver gives half of its range from when the gripper closes, and says that it gives none."""

    stuck = False

    def grasp(self, material: str, t_object: float) -> None:
        super().grasp(material, t_object)
        self.stuck = True
        self.apply({"drive": 0.0}, 0)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        super().apply({"drive": 0.5} if self.stuck else drive, pump)

    def read(self) -> Reading:
        said = super().read()
        return Reading(said.time_s, said.values, {"drive": 0.0} if self.stuck else said.drive, said.pump)


def test_a_driver_that_sticks_in_a_grasp_is_found_though_samples_are_faster_than_the_model(
    plant: Plant, controller: Any
) -> None:
    """0.2 K/s against the first window's 0.55 K, 0.5 K for the pump and a quarter of the change: 7 s; the
    bias of the drive that the filter finds is sooner too large.

    It is compared once a second, and twice.  Where readings between two comparisons count as one that found
    nothing it takes longer.
    """
    rig = StuckInContact(plant, seed=1, contact=Grip())
    session = run_session(rig, controller, 34.0, grasp=("copper", 18.0), grasp_time=20.0, guard=Guard(plant))
    assert session.trip.kind in ("driver", "pump", "model")
    closed = next(event.time_s for event in session.events if event.kind == "closed")
    assert 4.0 < session.trip.time_s - closed < 9.0


# ---- a program that is held up in a grasp ----

HELD_UP = 0.37


class Held(DeviceRig):
    """A rig whose program is held up now and then while the gripper is closed."""

    waits, closed_ = 0, False

    def grasp(self, material: str, t_object: float) -> None:
        super().grasp(material, t_object)
        self.closed_ = True

    def wait(self, seconds: float) -> None:
        super().wait(seconds)
        self.waits += self.closed_
        if self.closed_ and self.waits % 20 == 7:
            self._clock.sleep(HELD_UP)


def test_a_program_that_is_held_up_in_a_grasp_loses_rows_and_not_the_grasp(
    plant: Plant, controller: Any, tmp_path: Path
) -> None:
    bench = Bench(plant, driver=Held)
    bench.device.place("copper", 45.0)
    rig, clock = bench.rig, bench.clock
    with RunFolder(tmp_path / "run") as folder:
        session = run_session(rig, controller, 30.0, grasp=("copper", 45.0), clock=clock, recorder=folder)
        folder.finish(session)
    rig.close()
    assert session.verdict == "settled"
    assert session.grasps is not None
    contact = session.log["phase"].values == PHASES.index("contact")
    apart = np.diff(session.log["time"].values[contact])
    assert apart.max() > HELD_UP
    assert apart.min() > 0.04
    assert np.ptp(session.log["time"].values[contact]) == pytest.approx(10.0, abs=0.1)
    time, skin = session.grasps["time"].values, session.grasps["t_surface"].values[0]
    assert skin[-1] > 35.0  # it closed on a block of 45 degC
    late = (time > 1.0) & (time < 9.5)  # after the step of the touch all rows are one curve
    smooth = np.polynomial.Polynomial.fit(time[late], skin[late], 6)
    assert np.abs(skin[late] - smooth(time[late])).max() < 0.3  # noise of 0.04 K, a quantum of 0.06 K
    run = read_run(tmp_path / "run")
    np.testing.assert_allclose(run.log["t_surface"].values, session.log["t_surface"].values)
    np.testing.assert_allclose(run.log["time"].values, session.log["time"].values)


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
    assert bench.device.truth().drive == {"drive": 0.0}
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
    assert bench.device.truth().drive == {"q1": 0.0, "q2": 0.0}
    assert 60 <= log.sizes["time"] < 90
    bench.close()


@pytest.mark.parametrize("left_out", ["q1", "unit"])
def test_a_schedule_that_does_not_fit_the_rig_is_refused(left_out: str) -> None:
    plan = steps(1.0)
    plan["q1"].attrs["units"] = "1"
    plan = plan.drop_vars("q1") if left_out == "q1" else plan
    with pytest.raises(ValueError, match="no q1 in percent"):
        Playback(plan, UNITS, 1.0)
