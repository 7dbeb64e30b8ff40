"""The loop by itself, on a rig that does as it is told: what is asked and noted, and what ends it."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.guard.trip import ENDLESS, KINDS, TripError
from thermogrip.rig.interface import DeviceRefusedError, Event, Reading
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.session.loop import Loop, log_of_rows, trip_of_device
from thermogrip.rig.session.snapshot import MOST_MARKS, Snapshot

NONE = call({"q": 0.0}, 0)
LOST = PortError("did not answer", file="COM3", hint="check cable")


def rig_of(**values: float) -> Mock:
    """Return a rig whose time, readings, notices and errors are set."""
    values = {"t_tank": 25.0, "t_surface": 25.5, "t_ambient": 20.0, **values}
    rig = Mock(units={"q": "percent"}, expires_s=2.0, time=10.0, values=values)
    rig.read.side_effect = lambda: Reading(
        rig.time, dict(rig.values), (rig.apply.call_args or NONE).args[0], 1
    )
    rig.wait.side_effect = lambda seconds: setattr(rig, "time", round(rig.time + seconds, 9))
    rig.notices.return_value = []
    return rig


def pass_time(rig: Mock, seconds: float, *, lost: float) -> None:
    """Let time pass on a rig whose tank is lost at one moment."""
    rig.time = round(rig.time + seconds, 9)
    rig.values["t_tank"] = nan if rig.time == lost else 25.0


class Asked:
    """A controller that keeps what it was asked and answers from a script."""

    dt = 0.5

    def __init__(self, *moves: Move) -> None:
        self.moves, self.seen = list(moves), []

    def reset(self, reading: Readings) -> None:
        self.seen.append(("reset", dict(reading)))

    def step(self, reading: Readings, target: Target) -> Move:
        self.seen.append((reading["time_s"], target))
        return self.moves.pop(0) if len(self.moves) > 1 else self.moves[0]


def started(*moves: Move, rig: Mock | None = None, target: Any = None, **more: Any) -> Loop:
    """Return a loop that has started, towards 30 degC of the skin where nothing else is asked."""
    controller = Asked(*(moves or (Move(drive=40.0),)))
    run = Loop(rig_of() if rig is None else rig, controller, Mock(), None, Guard(**more))
    run.start(target or {"t_surface": 30.0})
    return run


def told(run: Loop, kind: str) -> list[tuple[float, str]]:
    """Return when and what was noted of one kind."""
    assert [one.args[0] for one in run.recorder.event.call_args_list] == run.events
    return [(event.time_s, event.text) for event in run.events if event.kind == kind]


def trip_of(call: Any) -> Any:
    with pytest.raises(TripError) as ended:
        call()
    return ended.value.trip


@pytest.mark.parametrize(
    ("values", "target", "said"),
    [({}, {"t_nose": 30.0}, "no sensor 't_nose'; set a target for one of t_tank, t_surface, t_ambient"),
     ({}, {"t_surface": 55.1}, "target 55.1 degC is unsafe; choose one from 3 to 55 degC"),
     ({}, {"t_tank": -1.5}, "target -1.5 degC is unsafe; choose one from -1 to 70 degC"),
     ({"t_tank": 75.1}, {"t_surface": 30.0}, "t_tank reads 75.1 degC; check the sensor before starting"),
     ({"t_tank": nan}, {"t_surface": 30.0}, "the rig's t_tank reads nan degC"),
     ({"t_ambient": nan, "t_tank": 75.0}, {"t_surface": 55.0, "t_tank": -1.0}, "")],
)  # fmt: skip
def test_a_start_is_refused_before_the_rig_is_touched(
    values: dict[str, float], target: dict[str, float], said: str
) -> None:
    rig = rig_of(**values)
    if not said:
        assert started(rig=rig, target=target).target == target
        return
    with pytest.raises(UserError) as refused:
        started(rig=rig, target=target)
    assert said in str(refused.value)
    assert rig.mock_calls == [call.notices(), call.read()]


def test_a_start_opens_the_gripper_and_gives_the_controller_the_first_reading() -> None:
    run = started()
    assert run.rig.mock_calls == [call.notices(), call.read(), call.release()]
    assert told(run, "opened") == [(10.0, "gripper opened")]
    assert "state room_sensors in the guard file" in told(run, "room")[0][1]
    assert run.controller.seen == [("reset", {"time_s": 10.0, **run.rig.values})]
    assert (run.move.drive, run.move.pump) == ({"q": 0.0}, 1)
    run.rig.release.side_effect = LOST
    run.touching = True
    run.open_gripper()
    assert not run.touching
    assert told(run, "opened")[1][1].startswith("the gripper could not be opened (COM3: did not answer")
    assert told(started(settings=GuardSettings(room_sensors=("t_ambient",))), "room") == []


def test_the_controller_is_asked_once_a_sample_time_and_of_fresh_readings_alone() -> None:
    moves = Move(drive=40.0), Move(drive=50.0, status="late", advice="wait"), Move(drive={"q": 60.0})
    run, passed = started(*moves), []
    run.rig.wait.side_effect = lambda seconds: pass_time(run.rig, seconds, lost=11.0)
    for now in run.regulate("settle", 2.0):
        passed.append(now)
    assert passed == [0.0, 0.5, 1.0, 1.5]
    assert run.controller.seen[1:] == [(10.0, 30.0), (10.5, 30.0), (11.5, 30.0)]
    assert told(run, "controller") == [(10.5, "late: wait"), (11.5, "ok")]
    assert run.column("q_percent").tolist() == [40.0, 50.0, 50.0, 60.0]
    assert told(run, "lost") == [(11.0, "t_tank is suspect (lost); the last good value is used")]
    for _ in range(2):
        run.rig.wait.side_effect = lambda seconds: pass_time(run.rig, seconds, lost=run.rig.time + seconds)
        run.wait(0.5)
        assert not run.fresh
        assert run.controller_reading() == {"time_s": run.rig.time, **run.rig.values, "t_tank": 25.0}
    assert len(told(run, "lost")) == 1  # once
    both = started(target={"t_surface": 30.0, "t_tank": 40.0})
    assert list(both.regulate("hold", 0.3)) == [0.0]
    assert both.controller.seen[-1] == (10.0, {"t_surface": 30.0, "t_tank": 40.0})


def test_a_row_is_what_was_read_and_what_holds_from_then_on() -> None:
    run = started(target={"t_surface": 30.0, "t_tank": 40.0})
    run.move = Move(drive=40.0, pump=1)
    run.record("settle")
    run.record("contact")
    row = {
        "time_s": 10.0, "q_percent": 40.0, "pump": 1.0, "t_tank_degC": 25.0, "t_surface_degC": 25.5,
        "t_ambient_degC": 20.0, "target_t_surface_degC": 30.0, "target_t_tank_degC": 40.0, "phase": 0.0,
    }  # fmt: skip
    assert run.rows == [row, {**row, "phase": 4.0}]
    assert list(run.rows[0]) == list(row)
    assert [dict(event.data) for event in run.events if event.kind == "phase"] == [
        {"rooms": ["t_ambient"]},
        {},
    ]
    assert run.rig.apply.call_args == call({"q": 40.0}, 1)
    assert run.guard._drive == {"q": 40.0}
    run.rig.time = 11.0
    run.reading = run.rig.read()
    run.record_last()
    run.record_last()  # of the same reading, nothing
    assert run.rows[2:] == [{**row, "phase": 4.0, "time_s": 11.0, "pump": 0.0, "q_percent": 0.0}]
    assert [one.args[0] for one in run.recorder.sample.call_args_list] == run.rows
    started().record_last()  # nor where nothing was recorded
    for last, times in ((inf, [10.0, 10.0, 11.0]), (1.0, [10.0, 10.0, 11.0]), (0.9, [11.0])):
        assert run.column("time_s", last=last).tolist() == times


def test_a_move_that_must_not_go_out_ends_it_before_it_does() -> None:
    run = started()
    run.move = Move(drive=40.0, pump=0)
    assert trip_of(lambda: run.record("settle")).kind == "interlock"
    assert run.rig.apply.mock_calls == []
    run.rig.apply.side_effect = ValueError("q = 140 is outside 0 to 100")
    run.move = Move(drive=140.0)
    trip = trip_of(lambda: run.record("settle"))
    assert (trip.kind, trip.subject, trip.measured) == ("drive", "q 140", "q = 140 is outside 0 to 100")
    assert run.rows == []
    run.reading = Reading(10.0, run.reading.values, {"a": 0.0, "b": 0.0}, 1)
    with pytest.raises(ValueError, match="one number for the inputs a, b"):
        run.apply()


@pytest.mark.parametrize(
    ("error", "expires", "want"),
    [(LOST, 2.0, ("cable", "an answer", KINDS["cable"][1])),
     (OSError("gone"), inf, ("cable", "an answer", ENDLESS["cable"])),
     (DeviceRefusedError("latched", "", ("open:a",)), inf, ("lost", "a temperature", KINDS["lost"][1]))],
)  # fmt: skip
def test_a_rig_that_does_not_answer_is_a_trip(
    error: Exception, expires: float, want: tuple[str, str, str]
) -> None:
    run = started()
    run.rig.expires_s, run.rig.wait.side_effect = expires, error
    trip = trip_of(lambda: run.wait(0.5))
    assert (trip.kind, trip.expected, trip.clear) == want
    assert trip.time_s == 10.0


@pytest.mark.parametrize(
    ("faults", "want"),
    [((), ("device", "the device", "to take a drive", "the device refuses: no")),
     (("open:a",), ("lost", "a", "a temperature", "an open sensor")),
     (("short:b",), ("lost", "b", "a temperature", "a shorted sensor")),
     (("over:a", "open:b"), ("limit", "a", "less than the device's own limit", "more")),
     (("under:a",), ("limit", "a", "more than the device's own limit", "less")),
     (("odd:a", "pump"), ("pump", "the pump", "the pump to turn", "that it has stopped"))],
)  # fmt: skip
def test_a_fault_that_is_latched_on_the_device_is_named_as_ours(
    faults: tuple[str, ...], want: tuple[str, ...]
) -> None:
    trip = trip_of_device(DeviceRefusedError("latched", "no", faults), Reading(4.0, {}, {}, 0))
    latched = ", latched on the device" if faults else ""
    found = (trip.kind, trip.subject, trip.expected, trip.measured)
    assert found == (*want[:3], want[3] + latched)


HOLD = "to hold the drive"


@pytest.mark.parametrize(
    ("kinds", "kind", "expected"),
    [(("damaged",), "", ""), (("reset",), "device", HOLD), (("expired", "reset"), "device", HOLD),
     (("expired",), "frozen", "a drive renewed within 2 s"), (("reset", "expired"), "device", HOLD)],
)  # fmt: skip
def test_after_a_reset_or_an_expired_drive_the_last_row_is_not_known(
    kinds: tuple[str, ...], kind: str, expected: str
) -> None:
    run = started()
    run.rig.notices.return_value = [Event(1.0, one, f"{one} it was") for one in kinds]
    if not kind:
        run.wait(0.5)
    else:
        trip = trip_of(lambda: run.wait(0.5))
        said = "reset" if kind == "device" else "expired"
        assert (trip.kind, trip.time_s, trip.expected, trip.measured) == (
            kind,
            10.5,
            expected,
            f"{said} it was",
        )
    assert [(e.kind, e.text) for e in run.events[2:]] == [(one, f"{one} it was") for one in kinds]


def test_a_line_full_of_noise_is_one_event_a_look() -> None:
    run = started()
    run.rig.notices.return_value = [Event(1.0, "damaged", "a line came damaged (crc)")] * 700
    run.wait(0.5)
    assert told(run, "damaged") == [(10.5, "a line came damaged (crc) (700 times)")]


def test_of_an_operator_s_marks_so_many_are_kept_as_a_person_may_give() -> None:
    run = started()
    for k in range(5):
        for n in range(1000):
            run.operator.mark_bad(f"{k} {n}")
        run.check()
    assert len(told(run, "bad")) == MOST_MARKS


def test_a_full_disk_is_one_trip_and_the_session_goes_on_in_memory() -> None:
    run, full = started(), OSError(28, "No space left on device")
    run.recorder.sample.side_effect = run.recorder.event.side_effect = full
    run.note("mood", "good")
    assert [(e.kind, e.text) for e in run.events[-2:]] == [("mood", "good"), ("disk", full.strerror)]
    trip = trip_of(lambda: run.record("settle"))
    assert (trip.kind, trip.expected, trip.measured) == ("disk", "to be written", full.strerror)
    run.record("settle")
    run.note("mood", "bad")
    assert run.events[-1].kind == "mood"
    run.rig.time += 1.0
    run.reading = run.rig.read()
    run.record_last()
    assert len(run.rows) == 3


@pytest.mark.parametrize(
    ("error", "expires", "said"),
    [(None, 2.0, ""), (LOST, 2.0, "the device's own expiry switches it off within 2 s"),
     (OSError("gone"), inf, "not confirmed off (gone); nothing on the device switches it off: PULL THE PLUG"),
     (KeyError("odd"), 2.0, None)],
)  # fmt: skip
def test_power_goes_off_or_the_rig_is_let_go(
    error: Exception | None, expires: float, said: str | None
) -> None:
    run = started()
    run.rig.expires_s, run.rig.apply.side_effect = expires, error
    if said is None:
        with pytest.raises(KeyError):
            run.power_off()
    else:
        run.power_off()
    assert run.rig.apply.mock_calls == [call({"q": 0.0}, 0)]
    assert run.rig.close.called == (error is not None)
    assert len(told(run, "power")) == bool(said)
    assert (said or "") in run.events[-1].text


def test_a_log_has_a_role_for_each_column_and_none_for_what_was_never_read() -> None:
    rows = [
        {"time_s": k, "q_percent": 1.0, "t_tank_degC": 25.0, "t_room_degC": room, "t_gone_degC": nan,
         "target_t_tank_degC": 30.0, "phase": 1.0}
        for k, room in ((0.0, nan), (1.0, 20.0), (2.0, nan))
    ]  # fmt: skip
    log = log_of_rows(rows, {"t_room"}, name="one", repairs=["cut"])
    roles = {name: (log[name].attrs["role"], log[name].attrs["units"]) for name in log.data_vars}
    assert roles == {
        "q": ("input", "percent"), "t_tank": ("output", "degC"), "t_room": ("disturbance", "degC"),
        "target_t_tank": ("other", "degC"), "phase": ("other", "1"),
    }  # fmt: skip
    assert log["t_room"].values.tolist() == [20.0] * 3
    assert log["phase"].attrs["flag_meanings"].split()[4] == "contact"
    assert (log.attrs["name"], log.attrs["repairs"]) == ("one", "cut")
    np.testing.assert_array_equal(log["time"].values, [0.0, 1.0, 2.0])


def shown(run: Loop, *, fails: bool = False) -> list[Snapshot]:
    """Let a loop show itself; return what it shows."""
    seen: list[Snapshot] = []

    def listener(snapshot: Snapshot) -> None:
        seen.append(snapshot)
        if fails:
            raise RuntimeError("the view is gone")

    run.listener = listener
    return seen


def test_each_sample_shows_the_session_as_it_is() -> None:
    run = started(Move(drive=40.0))
    run.band, seen = 0.25, shown(run)
    for _ in run.regulate("hold", 1.0):
        pass
    run.sample("lead_in", 1, 0.1)
    first, last = seen[0], seen[-1]
    assert [one.time_s for one in seen] == [10.0, 10.5, 11.0]
    assert (first.phase, first.left_s, first.dt, first.pump) == ("hold", 1.0, 0.5, 1)
    assert (last.phase, last.dt, last.verdict, last.trip) == ("lead_in", 0.1, "", None)
    assert (first.skin, first.target, first.band) == ("t_surface", {"t_surface": 30.0}, 0.25)
    assert first.values == {"t_tank": 25.0, "t_surface": 25.5, "t_ambient": 20.0}
    assert (first.drive, first.units, first.expires_s) == ({"q": 40.0}, {"q": "percent"}, 2.0)
    assert (first.margin, first.nearest) == (22.5, "t_surface")  # to 3 degC
    assert first.model_share != first.model_share
    assert last.events[-1].text == "lead_in"
    assert first.events[-1].text == "hold"


def test_a_rig_without_the_guards_skin_shows_its_first_sensor() -> None:
    run = started(Move(drive=40.0))
    run.target, seen = {}, shown(run)
    run.sample("hold", 1, 0.1)
    run.reading = replace(run.reading, values={"t1": 25.0, "t2": 26.0})
    run.show({"q": 0.0})
    assert [one.skin for one in seen] == ["t_surface", "t1"]


@pytest.mark.parametrize(("has_pump", "pump"), [(True, 1), (False, None)])
def test_a_pump_is_recorded_and_shown_where_there_is_one(has_pump: bool, pump: int | None) -> None:
    run = started(Move(drive=40.0))
    run.rig.has_pump, seen = has_pump, shown(run)
    run.sample("hold", 1, 0.1)
    assert ("pump" in run.rows[-1], seen[-1].pump) == (has_pump, pump)


def test_a_view_that_fails_ends_no_session_and_gets_no_more() -> None:
    run = started(Move(drive=40.0))
    seen = shown(run, fails=True)
    for _ in run.regulate("hold", 2.0):
        pass
    assert len(seen) == 1
    assert len(run.rows) == 4
    assert told(run, "view") == [
        (10.0, "what shows the session failed and gets no more of it (the view is gone)")
    ]


def test_an_operator_marks_a_trial_bad_and_stops_it_through_the_guard() -> None:
    run = started(Move(drive=40.0))
    run.operator.mark_bad("it slipped")
    for _ in run.regulate("hold", 1.0):
        pass
    assert told(run, "bad") == [(10.5, "it slipped")]
    run.operator.stop("the page")
    trip = trip_of(lambda: next(run.regulate("hold", 1.0)))
    assert (trip.kind, trip.measured) == ("operator", "a stop from the page")
    assert run.guard.trips == [trip]
