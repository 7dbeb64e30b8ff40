"""The guard in words: what trips, what does not, and that a trip says what an operator needs."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest

from tests.rig.conftest import Proportional
from tests.rig.makers import Constant, make_heater
from thermogrip.datasets.errors import UserError
from thermogrip.rig.guard.guard import Findings, Guard, RuleMonitor
from thermogrip.rig.guard.model_checks import Residual
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.guard.trip import KINDS, Trip
from thermogrip.rig.interface import Reading
from thermogrip.rig.session.session import play, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.rig.simulation.virtual_device import example_plant
from thermogrip.sysid import excite
from thermogrip.sysid.plant.plant import Plant

UNITS = {"drive": "1"}


def reading(
    time: float, skin: float, *, tank: float | None = None, drive: float = 0.0, pump: int = 1
) -> Reading:
    values = {"t_tank": skin if tank is None else tank, "t_surface": skin, "t_ambient": 25.0}
    return Reading(time, values, {"drive": drive}, pump)


def guard_at(skin: float = 25.0, **settings: Any) -> Guard:
    guard = Guard(settings=GuardSettings(**settings))
    guard.start(reading(0.0, skin), 0.0, UNITS)
    return guard


def check(guard: Guard, one: Reading, *, now: float | None = None, **options: Any) -> Findings:
    return guard.check(one, one.time_s if now is None else now, **options)


def kind(found: Findings) -> str:
    return "" if found.trip is None else found.trip.kind


def said(trip: Trip | None) -> tuple[str, str, str, str] | None:
    return None if trip is None else (trip.kind, trip.subject, trip.expected, trip.measured)


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_trip_says_what_to_check_and_how_to_clear_it(name: str) -> None:
    line = Trip(name, 1.0, "t_tank", "30 degC", "40 degC").line()
    assert "expected 30 degC, measured 40 degC" in line
    assert KINDS[name][0] in line
    assert "to clear" in line
    assert "\n" not in line


def test_a_trip_is_of_a_known_kind() -> None:
    with pytest.raises(ValueError, match="no kind of trip"):
        Trip("gremlins", 0.0, "t", "a", "b")


def clock(since: float, there: float) -> tuple[str, ...]:
    return "clock", "the rig's clock", f"{since:+.2f} s since the last reading", f"{there:+.2f} s"


@pytest.mark.parametrize(
    ("polls", "want"),
    [([(113.1, 23.1)], None),
     ([(101.0, 11.0), (102.0, 11.0), (103.0, 11.0)], None),
     ([(101.0, 11.0), (102.0, 11.0), (103.5, 11.0)],
      ("stale", "readings", "a new one within 2 s", "none for 2.5 s")),
     ([(101.0, 12.0)], None), ([(102.0, 11.0)], None),  # 1 s of slack either way
     ([(101.0, 12.5)], clock(1.0, 2.5)), ([(102.5, 11.0)], clock(2.5, 1.0)),
     ([(101.0, 9.5)], clock(1.0, -0.5)),
     ([(101.0, 11.0), (102.0, 11.0), (103.0, 13.0)], None)],  # from the last new one
)  # fmt: skip
def test_readings_and_the_programs_clock_move_on_together(
    polls: list[tuple[float, float]], want: tuple[str, ...] | None
) -> None:
    guard = Guard()
    guard.start(reading(10.0, 25.0), 100.0, UNITS)
    *before, trip = [guard.check(reading(t, 25.0), now).trip for now, t in polls]
    assert before == [None] * (len(polls) - 1)
    assert said(trip) == want


@pytest.mark.parametrize(
    ("first", "then", "there", "want"),
    [((100.0, 104.0), (104.1, 104.2), 4.0, None),  # the first came 4 s before the program had it ...
     ((100.0, 104.0), (104.1, 104.2), 0.15, None),  # ... or as it had it
     ((100.0, 100.0), (100.5, 105.0), 0.5, None), ((100.0, 100.0), (100.5, 105.0), 5.0, None),
     ((100.0, 104.0), (104.1, 104.2), 5.5, clock(4.2, 5.5)),
     ((100.0, 100.0), (102.0, 105.0), 0.5, clock(2.0, 0.5))],
)  # fmt: skip
def test_how_late_the_program_is_with_a_reading_is_no_fault_of_the_rigs_clock(
    first: tuple[float, float], then: tuple[float, float], there: float, want: tuple[str, ...] | None
) -> None:
    guard = Guard()
    guard.start(reading(10.0, 25.0), first[1], UNITS, asked=first[0])
    assert said(guard.check(reading(10.0 + there, 25.0), then[1], asked=then[0]).trip) == want


def test_a_drive_that_nobody_renewed_in_its_time_is_the_programs_fault() -> None:
    guard = guard_at()
    assert guard.late(60.0) is None  # a controller may take its time before it first drives
    guard.applied({"drive": 0.4}, 1, 60.0)
    assert guard.late(62.0) is None
    want = ("frozen", "this program", "a drive renewed within 2 s", "after 2.1 s")
    assert said(guard.late(62.1)) == want
    guard.applied({"drive": 0.0}, 1, 62.1)
    assert guard.late(90.0) is None


def test_a_reading_that_was_seen_is_not_checked_again_and_an_old_one_is_not_fresh() -> None:
    guard = guard_at()
    spoilt = Reading(1.0, {"t_tank": nan, "t_surface": 25.5, "t_ambient": nan}, {"drive": 0.0}, 1)
    first = check(guard, spoilt)
    assert first.values == {"t_tank": 25.0, "t_surface": 25.5, "t_ambient": 25.0}
    assert (first.suspect, first.fresh) == ({"t_tank": "lost", "t_ambient": "lost"}, False)
    assert check(guard, spoilt) is first
    again = check(guard, spoilt, now=1.5)
    assert (again.values, again.suspect, again.fresh) == (first.values, {}, False)
    room = Reading(2.0, {"t_tank": 25.0, "t_surface": 25.6, "t_ambient": nan}, {"drive": 0.0}, 1)
    assert check(guard, room).fresh  # the room's alone is lost
    nothing = Reading(3.0, {"t_ambient": nan}, {"drive": 0.0}, 1)
    assert not check(guard, nothing).fresh


@pytest.mark.parametrize(
    ("applied", "want"),
    [((50.0, 30.0), None), ((47.6, 32.4), None), ((47.4, 30.0), ("driver", "q1", "+50, as asked", "+47.4")),
     ((50.0, 32.6), ("driver", "q2", "+30, as asked", "+32.6")),
     ((0.0, 30.0), ("driver", "q1", "+50, as asked", "+0")),
     ((0.0, 0.0), ("device", "q2", "+30, as asked", "0: the device has switched off"))],
)  # fmt: skip
def test_of_two_heaters_each_may_differ_by_the_slack_and_only_both_off_is_the_device(
    applied: tuple[float, float], want: tuple[str, ...] | None
) -> None:
    """The slack is 5 % of half the range: 2.5 of 0 to 100 percent."""

    def at(time: float) -> Reading:
        return Reading(time, {"t_surface": 25.0}, dict(zip(("q1", "q2"), applied)), 1)

    guard = Guard()
    guard.start(at(0.0), 0.0, {"q1": "percent", "q2": "percent"})
    guard.applied({"q1": 50.0, "q2": 30.0}, 1, 0.0)
    assert kind(check(guard, at(1.0))) == ""
    trip = check(guard, at(2.0)).trip
    assert said(trip) == want


@pytest.mark.parametrize("unit", ["1", "V"])
def test_a_driver_that_obeys_in_between_is_not_off_twice(unit: str) -> None:
    guard = Guard()
    guard.start(reading(0.0, 25.0), 0.0, {"drive": unit})
    guard.applied({"drive": 0.5}, 1, 0.0)
    drives = (0.0, 0.5, 0.0, 0.45, 0.44, 0.44)  # 0.05 is the slack of a drive of -1 to 1, or of another unit
    kinds = [kind(check(guard, reading(float(k), 25.0, drive=d))) for k, d in enumerate(drives, start=1)]
    assert kinds == ["", "", "", "", "", "driver"]
    assert kind(check(guard, Reading(7.0, {"t_surface": 25.0}, {}, 1))) == ""  # a rig that does not report it


STANDING = ("interlock", "drive", "no drive while the pump is off")


@pytest.mark.parametrize(
    ("drives", "pump", "want"),
    [({"drive": 0.0}, 0, None), ({"drive": 0.5}, 1, None),
     ({"q": 0.2, "drive": inf}, 1, ("drive", "drive", "a number", "inf")),
     ({"q": 0.0, "drive": 0.01}, 0, (*STANDING, "0.01 with the pump off")),
     ({"drive": -0.5}, 0, (*STANDING, "-0.5 with the pump off"))],
)  # fmt: skip
def test_no_drive_while_the_pump_is_off_and_none_that_is_no_number(
    plant: Plant, drives: dict[str, float], pump: int, want: tuple[str, ...] | None
) -> None:
    for guard in (guard_at(), Guard(plant)):
        trip = guard.refuse(drives, pump, 1.5)
        assert said(trip) == want
    assert Guard(make_heater()).refuse({"q": 0.5}, 0, 0.0) is None  # no pump, no standing water


@pytest.mark.parametrize(
    ("skins", "drive", "touching", "measured"),
    [((54.9, 55.0, 55.0), 0.0, False, ""), ((55.1, 55.2), 0.0, False, "55.20"), ((3.1, 3.0), 0.0, False, ""),
     ((3.1, 2.9, 2.8), 0.0, False, "2.80"), ((55.1, 55.0, 55.1), 0.0, False, ""),
     ((55.1, 55.2), 0.0, True, ""),  # a hot object is not the rig's fault ...
     ((55.1, 55.2), 0.1, True, "55.20")],  # ... unless it is driven
)  # fmt: skip
def test_the_second_reading_beyond_a_limit_trips(
    skins: tuple[float, ...], drive: float, touching: bool, measured: str
) -> None:
    guard = guard_at(skins[0])
    guard.applied({"drive": drive}, 1, 0.0)
    found = [
        check(guard, reading(float(k), skin, drive=drive), touching=touching)
        for k, skin in enumerate(skins, start=1)
    ]
    *before, trip = (one.trip for one in found)
    assert before == [None] * (len(skins) - 1)
    assert said(trip) == (("limit", "t_surface", "3 to 55 degC", f"{measured} degC") if measured else None)


class OffItsPlace(Twin):
    """A rig whose sensors have come off their place: they read the room."""

    def read(self) -> Reading:
        found = super().read()
        noise = 0.04 * np.random.default_rng(round(1000 * self.time)).standard_normal()
        return replace(found, values=dict.fromkeys(found.values, self.ambient + noise))


class LosesTwoOfThree(Twin):
    """A rig two of three readings of whose skin are lost."""

    def read(self) -> Reading:
        found = super().read()
        lost = {"t_surface": nan} if round(self.time) % 3 else {}
        return replace(found, values={**found.values, **lost})


@pytest.mark.parametrize("drive", [1.0, 0.49, 0.2, 0.07, -0.07, -0.49])
def test_heat_without_any_answer_ends_a_session_at_any_drive(plant: Plant, drive: float) -> None:
    rig = OffItsPlace(plant)
    trip = run_session(rig, Constant(drive), 35.0, guard=Guard(), settle_timeout=1800.0).trip
    assert trip.kind == "driver"
    assert trip.expected.startswith("at least 1 K " + ("warmer" if drive > 0 else "colder"))
    assert "come off its place" in trip.check
    assert abs(drive) * rig.time == pytest.approx(60.0, abs=1.0)
    assert abs(rig.truth()["t_tank"] - 25.0) < 0.4 * 60 + 0.5  # what a minute of full drive do, nothing lost


def test_readings_that_are_lost_again_and_again_end_a_session(plant: Plant, controller: Proportional) -> None:
    session = run_session(LosesTwoOfThree(plant), controller, 30.0, guard=Guard(plant))
    assert (session.trip.kind, session.trip.subject) == ("lost", "t_surface")
    assert session.trip.time_s < 32.0


AT_LEAST = "at least 1 K {} in {:.0f} s of drive {}"


@pytest.mark.parametrize("dt", [1.0, 5.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("slope", "drive", "begin", "want"),
    [(0.0200, 0.7, 25.0, None), (0.0100, 0.7, 25.0, ("driver", "b", 0.86)),
     (0.0, 0.50, 31.9, ("driver", "a", 0.0)), (0.0, 0.50, 32.1, None),  # where half of the drive may hold it
     (0.0, 1.00, 32.1, None), (0.0, 0.25, 27.9, ("driver", "a", 0.0)), (0.0, 0.25, 28.1, None),
     (0.0, 0.06, 25.0, None),  # holds less than what sensors disagree by
     (-0.01, 0.7, 25.0, ("driver", "a", 0.0)), (-0.03, 0.7, 25.0, ("reversed", "a", -5.2))],
)  # fmt: skip
def test_without_a_model_each_minute_of_full_drive_is_answered_or_trips(
    slope: float, drive: float, begin: float, want: tuple[str, str, float] | None, sign: float, dt: float
) -> None:
    """The first output goes twice as far as the second where it goes the wrong way, else it stands."""
    rules, room, end = RuleMonitor(), 25.0, dt * np.ceil(60.0 / drive / dt - 1e-9)
    for time in np.arange(0.0, end + dt, dt).tolist():
        moves = {"a": 2 * slope * time if slope < -0.02 else 0.0, "b": max(slope, -0.01) * time}
        values = {name: room + sign * (begin - room + move) for name, move in moves.items()}
        trip = rules.check(time, drive * sign, values, room=room)
        assert time == end or trip is None
    if want is None:
        assert trip is None
    else:
        kind, output, moved = want
        words = AT_LEAST.format("warmer" if sign > 0 else "colder", end, f"{sign * drive:+.2f}")
        assert said(trip)[:3] == (kind, output, words)
        assert float(trip.measured.removesuffix(" K")) == pytest.approx(sign * moved, rel=0.15, abs=0.05)


@pytest.mark.parametrize("start", [21.0, 45.0])
def test_without_a_sensor_of_the_room_a_rig_that_warmed_once_may_stand_still(start: float) -> None:
    def trips(answers: bool, seconds: int = 900) -> bool:
        rules = RuleMonitor()
        at = [start + (8.0 * (1 - np.exp(-k / 170)) if answers else 0.0) for k in range(seconds)]
        found = [rules.check(float(k), 0.25, {"t": t}, room=nan) for k, t in enumerate(at)]
        return any(found)

    assert not trips(answers=True)
    assert trips(answers=False) == (start < 35.0)  # no room is so warm: it was heated before


def test_drives_that_change_sign_and_steps_down_are_no_fault(plant: Plant) -> None:
    """What a schedule of ``record`` does: pulses both ways, then from hot to lukewarm."""
    rules, rig = RuleMonitor(), Twin(plant, ambient=25.0)
    steps = [(0.6, 20), (-0.6, 20)] * 6 + [(0.0, 300), (0.3, 600), (0.05, 1200), (-0.1, 900), (0.02, 1800)]
    for drive, seconds in steps:
        rig.apply({"drive": drive}, 1)
        for _ in range(seconds):
            rig.wait(1.0)
            values = {n: v for n, v in rig.read().values.items() if n != "t_ambient"}
            assert rules.check(rig.time, drive, values, room=25.0) is None


# ---- what the guard makes of what the model says ----


def told(plant: Plant) -> tuple[Guard, Mock]:
    """Return a guard that has started, and the model monitor that is told what to find."""
    guard = Guard(plant)
    guard.model = model = Mock(plant=plant, compared_from=0.0, compared_now=True)
    model.update.return_value = []
    model.is_jump.return_value = False
    guard.start(reading(0.0, 25.0, tank=nan), 0.0, UNITS)
    return guard, model


def test_what_the_model_is_given_and_what_it_finds_suspect(plant: Plant) -> None:
    guard, model = told(plant)
    model.compared_from = 1.5
    guard.applied({"drive": 0.4}, 1, 0.0)
    model.is_jump.side_effect = lambda name, value: name == "t_tank"
    found = check(guard, reading(1.0, 25.0, tank=25.2, drive=0.4))
    assert found.suspect == {"t_tank": "jump"}
    check(guard, reading(2.0, 25.0, tank=nan, drive=0.4))
    given, skins = {"t_surface": 25.0, "t_ambient": 25.0}, {"t_surface", "t_surface_2"}
    assert [one for one in model.mock_calls if one[0] in ("reset", "predict", "update")] == [
        call.reset(0.0, given),
        call.predict(1.0, {"drive": 0.4}, 1, {"t_tank": 25.2, **given}),
        call.update(1.0, {"t_surface": 25.0}, skins),  # nothing of the skin is known before the comparison
        call.predict(2.0, {"drive": 0.4}, 1, given),
        call.update(2.0, {"t_surface": 25.0}, set()),
    ]
    assert [guard.ready(time) for time in (11.4, 11.5)] == [False, True]
    assert guard_at().ready(0.0)


@pytest.mark.parametrize(
    ("gap", "tripped", "known"),
    [(0.0, False, True), (300.0, False, True), (300.5, False, False), (-0.5, False, False),
     (5.0, True, False)],
)  # fmt: skip
def test_what_is_known_is_kept_for_five_minutes_after_a_session_that_ended_well(
    plant: Plant, gap: float, tripped: bool, known: bool
) -> None:
    guard, model = told(plant)
    guard.applied({"drive": 0.4}, 1, 0.0)
    check(guard, reading(1.0, 25.0, drive=0.4), touching=True)
    guard.trips = [Trip("lost", 1.0, "t", "a", "b")] if tripped else []
    begin = 1.0 + gap
    guard.start(reading(begin, 25.0), 50.0, UNITS)
    values = dict.fromkeys(("t_tank", "t_surface", "t_ambient"), 25.0)
    usual = call.predict(begin, {"drive": 0.0}, 0, values) if known else call.reset(begin, values)
    assert model.mock_calls[-1] == usual
    assert guard.trips == []
    # what was touched to the end is released by the start, 60 s are forgotten, and 10 s compared
    for time, ready in ((begin + 69.9, not known), (begin + 70.0, True)):
        assert guard.ready(max(time, 10.0)) == ready
    check(guard, reading(begin + 0.5, 25.0), now=50.5)
    if known:
        guard.start(reading(begin + 5.0, 25.0), 55.0, UNITS)
        assert guard.ready(begin + 70.0)  # a second start without a touch is no second release
    assert not guard._touched


def window(measured: float, subject: str = "t_tank", *, allowed: float = 1.0) -> Residual:
    return Residual("window", subject, 30.0, 4.0, measured, allowed)


ONCE, LARGE, OTHER = window(5.5), window(5.6), window(5.1, "t_surface")


@pytest.mark.parametrize(
    ("script", "at"),
    [([[ONCE], [ONCE]], 2), ([[ONCE], [], [ONCE]], 0), ([[window(2.4)]], 1), ([[LARGE]], 1),
     ([[ONCE], [OTHER], [ONCE]], 0), ([[ONCE], None, [ONCE]], 3)],
)  # fmt: skip
def test_an_alarm_trips_when_it_comes_again_or_is_half_as_large_again(
    plant: Plant, script: list[list[Residual] | None], at: int
) -> None:
    guard, model = told(plant)
    found = []
    for k, alarms in enumerate(script, start=1):
        model.compared_now = alarms is not None  # the model has made no step
        model.update.return_value = alarms or []
        found.append(kind(check(guard, reading(float(k), 25.0))))
    assert [k for k, one in enumerate(found, start=1) if one] == ([at] if at else [])


def test_the_largest_alarm_is_the_trip(plant: Plant) -> None:
    guard, model = told(plant)
    model.update.return_value = [window(5.6), window(6.5, "t_surface"), window(5.7)]
    trip = check(guard, reading(1.0, 25.0)).trip
    assert said(trip) == ("model", "t_surface", "t_surface +4.00 +- 1.00 K in 30 s", "+6.50 K")
    assert trip.check == KINDS["model"][0]


@pytest.mark.parametrize(
    ("bias", "want"),
    [(Residual("bias", "drive", 0.0, 0.0, 0.4, 0.25),
      ("driver", "drive", "within 0.25 of its range of the model", "+0.40 of its range")),
     (Residual("bias", "t_surface", 0.0, 0.0, -3.5, 2.0),
      ("drift", "t_surface", "within 2 K of the model", "-3.50 K"))],
)  # fmt: skip
def test_a_bias_is_of_the_driver_or_of_the_sensor(
    plant: Plant, bias: Residual, want: tuple[str, ...]
) -> None:
    guard, model = told(plant)
    model.update.return_value = [bias]
    trip = check(guard, reading(1.0, 25.0)).trip
    assert said(trip) == want


@pytest.mark.parametrize(
    ("same", "measured", "want"),
    [(3, 0.5, "model"), (4, 0.5, "stuck"), (4, 4.5, "model"), (4, -3.9, "stuck")],
)
def test_a_sensor_that_repeats_itself_where_the_model_moves_on_is_stuck(
    plant: Plant, same: int, measured: float, want: str
) -> None:
    guard, model = told(plant)
    for k in range(1, same + 1):
        check(guard, reading(float(k), 25.0 + 0.1 * k, tank=25.0))
    model.update.return_value = [window(measured, allowed=0.1)]
    trip = check(guard, reading(same + 1.0, 25.5, tank=25.0)).trip
    assert (trip.kind, trip.subject, trip.check) == (want, "t_tank", KINDS[want][0])
    because = " (bit for bit the same for 4 s)" if want == "stuck" else ""
    assert trip.measured == f"{measured:+.2f} K{because}"


def test_without_a_model_the_drive_of_the_rules_is_the_largest_share_of_a_range() -> None:
    guard = Guard()
    guard.start(reading(0.0, 25.0), 0.0, {"a": "percent", "b": "1", "c": "0_255"})
    asked = []
    guard.rules = SimpleNamespace(check=lambda *given, **more: asked.append((given, more)))
    for k, (a, b, c, touching) in enumerate([(60.0, -0.5, 0.0, False), (50.0, -0.6, 51.0, True)], start=1):
        guard.applied({"a": a, "b": b, "c": c}, 1, float(k))
        values = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 20.0}
        check(guard, Reading(float(k), values, {"a": a, "b": b, "c": c}, 1), touching=touching)
    both, tank = {"t_tank": 25.0, "t_surface": 25.0}, {"t_tank": 25.0}
    assert asked == [
        ((1.0, 0.6, both), {"room": 20.0}),
        ((2.0, -0.6, tank), {"room": 20.0}),  # an object determines the skin
    ]


def test_a_skin_is_masked_while_it_touches_and_for_a_minute_after(plant: Plant) -> None:
    guard, model = told(plant)
    for time in [*map(float, range(1, 63)), 62.9, 63.0]:
        check(guard, reading(time, 25.0), touching=time == 2.0)
        assert guard.ready(72.9) == (time < 2.0)
        assert guard.ready(73.0) == (time != 2.0)
    masked = {one.args[0]: bool(one.args[2]) for one in model.update.call_args_list}
    assert [masked[time] for time in (1.0, 2.0, 3.0, 62.9, 63.0)] == [False, True, True, True, False]


@pytest.mark.parametrize("kind", ["prbs", "multisine", "staircase"])
@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-1.0, 0.3), (0.0, 1.0)])
def test_an_experiment_on_a_sound_rig_is_played_to_its_end_without_a_model(
    kind: str, low: float, high: float
) -> None:
    schedule = excite(kind, 15, low=low, high=high, seed=3)
    log, ended = play(Twin(example_plant(), seed=3), schedule, dt=2.0)
    assert ended == ""
    assert float(log["time"][-1]) == pytest.approx(900.0, abs=5.0)


# ---- a computer that is late ----


@pytest.mark.parametrize("late", [0.0, 2.0, 4.0])
def test_a_drive_that_is_applied_late_is_no_fault_of_the_plant(late: float) -> None:
    """Both heaters go on and off every 30 s, each time so long after the reading that they answer."""
    plant = example_plant("tclab")
    twin, guard = Twin(plant, seed=1, ambient=23.0), Guard(plant)
    guard.start(twin.read(), 0.0, twin.units)
    share = 0.0
    for k in range(60):
        assert guard.check(twin.read(), twin.time).trip is None
        share = max(share, guard.model_share)
        twin.wait(late)
        drive = dict.fromkeys(twin.units, 100.0 if k // 6 % 2 == 0 else 0.0)
        twin.apply(drive, 1)
        guard.applied(drive, 1, twin.time)
        twin.wait(5.0 - late)
    assert share < 0.5


# ---- where a target may be ----


@pytest.mark.parametrize(
    ("logged", "settings", "highest"),
    [
        (None, GuardSettings(), 70.0),
        ((20.0, 70.0), None, 60.0),  # where the device switches off
        ((20.0, 96.0), None, 103.6),  # a tenth of the range beyond the logs
        ((20.0, 96.0), GuardSettings.from_dict({}, file="guard.toml"), 70.0),  # a file says what may be
        ((20.0, 96.0), GuardSettings().below(90.0), 90.0),
        (None, GuardSettings().below(850.0), 850.0),
        (None, GuardSettings.from_dict({}, file="guard.toml").below(850.0), 70.0),
    ],
)
def test_a_target_may_be_where_the_logs_went_or_as_somebody_states(
    plant: Plant, logged: tuple[float, float] | None, settings: GuardSettings | None, highest: float
) -> None:
    if logged is not None:
        plant = replace(plant, valid={**plant.valid, "t_tank": logged, "t_surface": logged})
    guard = Guard(plant, settings)
    guard.check_target("t_tank", highest)
    lowest = 2 if highest == 60 else -1
    with pytest.raises(UserError, match=f"unsafe; choose one from {lowest} to {highest:g} degC, or state"):
        guard.check_target("t_tank", highest + 0.1)
    with pytest.raises(UserError, match="choose one from 3 to 55 degC"):
        guard.check_target("t_surface", 56.0)  # what touches has its limits whatever was logged
    assert guard.sensors.plausible(max(70.0, highest) + 4.9)
    assert not guard.sensors.plausible(max(75.1, highest + 5.1))
