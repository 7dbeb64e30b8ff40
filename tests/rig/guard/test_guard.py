"""The guard in words: what trips, what does not, and that a trip says what an operator needs."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import pytest

from thermogrip.rig.guard.guard import Findings, Guard, GuardSettings
from thermogrip.rig.guard.rule_checks import RuleMonitor
from thermogrip.rig.guard.trip import KINDS, Trip
from thermogrip.rig.interface import Reading
from thermogrip.rig.simulation.twin import Twin
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
    return guard.check(one, one.time_s if now is None else now, planned=1.0, **options)


def kind(found: Findings) -> str:
    return "" if found.trip is None else found.trip.kind


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_trip_says_what_to_check_and_how_to_clear_it(name: str) -> None:
    line = Trip(name, 1.0, "t_tank", "30 degC", "40 degC").line()
    assert "expected 30 degC, measured 40 degC" in line
    assert KINDS[name][0] in line
    assert "to clear" in line
    assert "\n" not in line


def test_a_trip_is_plain_json_even_where_a_number_is_not_finite() -> None:
    found = Trip("lost", 1.0, "t", "a", "b", figures={"x": nan, "y": 2.0, "z": -inf}).as_dict()
    assert found["figures"] == {"x": None, "y": 2.0, "z": None}
    with pytest.raises(ValueError, match="no kind of trip"):
        Trip("gremlins", 0.0, "t", "a", "b")


def test_a_program_that_was_frozen_longer_than_the_devices_time_to_live_trips() -> None:
    assert kind(check(guard_at(), reading(2.9, 25.0), now=2.9)) == ""
    assert kind(check(guard_at(), reading(3.1, 25.0), now=3.1)) == "frozen"


def test_readings_that_stop_coming_trip() -> None:
    guard = guard_at()
    check(guard, reading(1.0, 25.0))
    kinds = [kind(check(guard, reading(1.0, 25.0), now=1.0 + 0.5 * k)) for k in range(1, 9)]
    assert kinds[:4] == ["", "", "", ""]
    assert "stale" in kinds
    assert not check(guard, reading(1.0, 25.0), now=5.5).fresh


@pytest.mark.parametrize("jump", [-0.5, 3600.0, 5.0])
def test_a_rigs_clock_that_jumps_trips(jump: float) -> None:
    guard = guard_at()
    check(guard, reading(1.0, 25.0))
    assert kind(check(guard, reading(2.0 + jump - (1.0 if jump < 0 else 0.0), 25.0), now=2.0)) == "clock"


@pytest.mark.parametrize(
    ("applied", "expected"),
    [((50.0, 30.0), ""), ((47.6, 32.4), ""), ((47.4, 30.0), "driver"), ((50.0, 32.6), "driver"),
     ((0.0, 30.0), "driver"), ((0.0, 0.0), "device")],
)  # fmt: skip
def test_of_two_heaters_each_may_differ_by_the_slack_and_only_both_off_is_the_device(
    applied: tuple[float, float], expected: str
) -> None:
    """The slack is 5 % of half the range: 2.5 of 0 to 100 percent."""

    def at(time: float) -> Reading:
        return Reading(time, {"t_surface": 25.0}, dict(zip(("q1", "q2"), applied)), 1)

    guard = Guard()
    guard.start(at(0.0), 0.0, {"q1": "percent", "q2": "percent"})
    guard.asked({"q1": 50.0, "q2": 30.0}, 1)
    assert kind(check(guard, at(1.0))) == ""
    assert kind(check(guard, at(2.0))) == expected


def test_no_drive_while_the_pump_is_off() -> None:
    guard = guard_at()
    assert guard.refuse({"drive": 0.0}, 0, 1.0) is None
    assert guard.refuse({"drive": 0.5}, 1, 1.0) is None
    for value, expected in ((0.01, "interlock"), (-0.5, "interlock"), (nan, "drive")):
        trip = guard.refuse({"drive": value}, 0, 1.0)
        assert trip.kind == expected


@pytest.mark.parametrize(("skin", "trips"), [(54.9, False), (55.1, True), (3.1, False), (2.9, True)])
def test_the_second_reading_beyond_a_limit_trips(skin: float, trips: bool) -> None:
    guard = guard_at(skin)
    assert kind(check(guard, reading(1.0, skin))) == ""
    assert kind(check(guard, reading(2.0, skin))) == ("limit" if trips else "")


def test_a_hot_object_in_the_gripper_is_not_the_rigs_fault() -> None:
    guard = guard_at(50.0)
    for k in range(1, 6):
        assert kind(check(guard, reading(float(k), 50.0 + 2 * k, tank=50.0, pump=0), touching=True)) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("slope", "expected"), [(0.05, None), (0.0, "driver"), (-0.05, "reversed")])
def test_without_a_model_the_wrong_way_and_nowhere_trip_for_heating_and_cooling(
    sign: float, slope: float, expected: str | None
) -> None:
    rules, found = RuleMonitor(), {}
    for k in range(120):
        tank = 25.0 + sign * slope * k
        if trip := rules.check(float(k), 0.8 * sign, {"t_tank": tank}, room=25.0, target={}):
            found.setdefault(trip.kind, k)
    assert found == ({expected: 57} if expected else {})  # 95 % of a window of 60 s


def test_a_rig_at_the_end_of_its_reach_may_stand_still() -> None:
    monitor = RuleMonitor()
    assert all(
        monitor.check(float(k), 0.9, {"t_tank": 48.0}, room=25.0, target={}) is None for k in range(300)
    )


def test_leaving_a_target_that_was_reached_trips_by_its_area() -> None:
    monitor, at = RuleMonitor(), 0
    for k in range(400):
        skin = 38.0 if k < 100 else 38.0 - 8.0
        if monitor.check(float(k), 0.0, {"t_surface": skin}, room=25.0, target={"t_surface": 38.0}):
            at = k
            break
    assert at == 100 + 40  # 3 K beyond 5 K, 120 K s


def test_between_sessions_the_guard_keeps_what_it_knows(plant: Plant) -> None:
    guard = Guard(plant)
    rig = Twin(plant)
    guard.start(rig.read(), 0.0, UNITS)
    for _ in range(100):
        guard.asked({"drive": 0.5}, 1)
        rig.apply({"drive": 0.5}, 1)
        rig.wait(1.0)
        assert guard.check(rig.read(), rig.time, planned=1.0).trip is None

    def expected() -> dict[str, float]:
        return dict(zip(plant.outputs, guard.model._filter.expected.tolist()))

    known = expected()
    guard.start(rig.read(), rig.time, UNITS)
    assert expected()["t_tank"] == pytest.approx(known["t_tank"], abs=0.3)
    assert guard.model.compared_from == 0.0  # no new warm-up


@pytest.mark.parametrize(
    ("time", "ready"), [(10.0, False), (38.9, False), (39.0, True), (48.9, True), (1e4, True)]
)
def test_the_skin_is_ready_a_shortest_window_after_the_comparison_began(
    plant: Plant, time: float, ready: bool
) -> None:
    guard = Guard(plant)
    guard.start(Twin(plant).read(), 0.0, UNITS)
    guard.model.compared_from = 29.0
    assert guard.ready(time) is ready


def test_the_skin_is_ready_once_the_last_touch_is_forgotten_and_at_once_without_a_model(plant: Plant) -> None:
    rig, guard = Twin(plant), Guard(plant)
    guard.start(rig.read(), 0.0, UNITS)
    for time in range(1, 31):  # touched from 5 s to 20 s; released by the reading of 21 s
        rig.wait(1.0)
        check(guard, rig.read(), touching=5 <= time <= 20)
        if 5 <= time <= 20:
            assert not guard.ready(1e4)
    released, window = rig.time - 9.0, guard.settings.model.windows[0]
    assert not guard.ready(released + guard.settings.forget_s + window - 0.1)
    assert guard.ready(released + guard.settings.forget_s + window)
    assert guard_at().ready(0.0)
