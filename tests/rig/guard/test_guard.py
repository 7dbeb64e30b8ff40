"""The guard in words: what trips, what does not, and that a trip says what an operator needs."""

from __future__ import annotations

from math import erf, inf, log, nan, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.rig.fault_injection.drills import drill_plants
from thermogrip.rig.guard.guard import Findings, Guard, GuardSettings
from thermogrip.rig.guard.model_checks import ModelWatch
from thermogrip.rig.guard.rule_checks import FixedWatch
from thermogrip.rig.guard.sensor_checks import SensorWatch, repeats_needed
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


# ---- what every trip says ----


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


# ---- time ----


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


# ---- drive and limits ----


def test_a_driver_that_does_not_do_what_is_asked_trips_at_the_second_reading() -> None:
    guard = guard_at()
    guard.asked({"drive": 0.2}, 1)
    assert kind(check(guard, reading(1.0, 25.0, drive=1.0))) == ""
    assert kind(check(guard, reading(2.0, 25.0, drive=1.0))) == "driver"


def test_a_device_that_has_switched_off_is_named() -> None:
    guard = guard_at()
    guard.asked({"drive": 0.2}, 1)
    check(guard, reading(1.0, 25.0, drive=0.0))
    found = check(guard, reading(2.0, 25.0, drive=0.0))
    assert kind(found) == "device"


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
        assert trip is not None
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


# ---- sensors ----


def test_two_bad_readings_are_forgiven_and_the_third_trips_naming_plug_and_wire() -> None:
    guard = guard_at()
    for k in (1, 2):
        found = check(guard, reading(float(k), nan, tank=25.0))
        assert kind(found) == ""
        assert not found.fresh
        assert found.values["t_surface"] == 25.0  # the last good one
    trip = check(guard, reading(3.0, nan, tank=25.0)).trip
    assert trip is not None
    assert trip.kind == "lost"
    assert "plug" in trip.check


def test_a_lost_room_sensor_is_no_reason_to_stop() -> None:
    guard = guard_at()
    for k in range(1, 20):
        one = reading(float(k), 25.0 + 0.01 * k)
        found = check(guard, Reading(one.time_s, {**one.values, "t_ambient": nan}, one.drive, 1))
        assert kind(found) == ""
        assert found.fresh
        assert found.values["t_ambient"] == 25.0


def test_water_cannot_jump_but_a_touched_skin_can() -> None:
    watch = SensorWatch()
    watch.start(0.0, {"t_surface": 25.0})
    assert watch.check(0.1, {"t_surface": 27.0})[1] == {"t_surface": "jump"}
    watch.start(0.0, {"t_surface": 25.0})
    touching = frozenset(["t_surface"])
    assert watch.check(0.1, {"t_surface": 27.0}, touching=touching)[1] == {}


def test_two_sensors_of_one_temperature_may_differ_for_half_a_minute_only() -> None:
    watch = SensorWatch()
    watch.start(0.0, {"t_surface": 25.0, "t_surface_2": 25.0})
    trips = [watch.check(float(k), {"t_surface": 25.0, "t_surface_2": 29.5})[2] for k in range(1, 40)]
    first = next(k for k, trip in enumerate(trips, start=1) if trip is not None)
    assert first == 31
    trip = trips[first - 1]
    assert trip is not None
    assert trip.kind == "disagree"


@given(st.floats(0.005, 0.2), st.floats(0.01, 0.2), st.sampled_from([1e-6, 1e-9]))
def test_repeats_are_as_unlikely_as_promised(quantum: float, noise: float, alpha: float) -> None:
    n = repeats_needed(quantum, noise, alpha)
    p = erf(quantum / (2 * sqrt(2) * noise))
    assert n >= 10
    if np.isfinite(n) and n > 10:
        assert n * log(p) <= log(alpha) * (1 - 1e-9)
        assert (n - 1) * log(p) > log(alpha) * (1 + 1e-9)


def test_a_healthy_sensor_is_not_called_stuck_in_a_day_and_a_stuck_one_is_in_a_minute() -> None:
    rng = np.random.default_rng(0)
    watch = SensorWatch()
    watch.start(0.0, {"t": 25.0})
    readings = np.round((25.0 + 0.04 * rng.standard_normal(86_400)) * 16) / 16  # the middle of a quantum
    for k, value in enumerate(readings.tolist(), start=1):
        assert watch.check(float(k), {"t": value})[2] is None
    trips = [watch.check(86_400.0 + k, {"t": value})[2] for k in range(1, 60)]
    first = next(k for k, trip in enumerate(trips, start=1) if trip is not None)
    assert first <= 38


def test_a_coarse_converter_is_never_called_stuck_by_its_repeats() -> None:
    assert repeats_needed(0.3223, 0.04, 1e-9) == float("inf")


# ---- without a model ----


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_without_a_model_the_wrong_way_and_nowhere_trip_for_heating_and_cooling(sign: float) -> None:
    for slope, expected in ((0.05, ""), (0.0, "driver"), (-0.05, "reversed")):
        watch, kinds = FixedWatch(), set()
        for k in range(120):
            trip = watch.check(
                float(k), 0.8 * sign, {"t_tank": 25.0 + sign * slope * k}, room=25.0, target={}
            )
            kinds.add("" if trip is None else trip.kind)
        assert kinds - {""} == ({expected} - {""})


def test_a_rig_at_the_end_of_its_reach_may_stand_still() -> None:
    watch = FixedWatch()
    assert all(watch.check(float(k), 0.9, {"t_tank": 48.0}, room=25.0, target={}) is None for k in range(300))


def test_leaving_a_target_that_was_reached_trips_by_its_area() -> None:
    watch, at = FixedWatch(), 0
    for k in range(400):
        skin = 38.0 if k < 100 else 38.0 - 8.0
        if watch.check(float(k), 0.0, {"t_surface": skin}, room=25.0, target={"t_surface": 38.0}):
            at = k
            break
    assert at == 100 + 40  # 3 K beyond 5 K, 120 K s


# ---- with a model ----


def follow(watch: ModelWatch, rig: Twin, drive: float, seconds: float, lie: Any = None) -> tuple[float, str]:
    """Drive a twin and return when the watch objects and how it explains it; infinity where it does not."""
    begin = rig.time
    while rig.time - begin < seconds:
        rig.apply({"drive": drive}, 1)
        rig.wait(1.0)
        values = dict(rig.read().values)
        if lie is not None:
            values |= lie(rig.time - begin, values)
        found = watch.follow(rig.time, {"drive": drive}, 1, values)
        if found:
            return rig.time - begin, watch.explain(found[0])
    return np.inf, ""


def watched(plant: Plant, seed: int = 0) -> tuple[ModelWatch, Twin]:
    from thermogrip.sysid.contact.simulation import Grip

    rig = Twin(plant, seed=seed, contact=Grip())
    watch = ModelWatch(plant)
    watch.reset(0.0, rig.read().values)
    return watch, rig


@pytest.mark.parametrize("seed", range(3))
def test_a_rig_that_follows_its_model_is_left_alone(plant: Plant, seed: int) -> None:
    watch, rig = watched(plant, seed)
    for drive in (0.8, -0.6, 0.0, 1.0, -1.0):
        assert follow(watch, rig, drive, 120.0)[0] == np.inf


@pytest.mark.parametrize(("drive", "real"), [(0.8, 0.0), (-0.8, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, -0.6)])
def test_a_driver_that_does_something_else_is_found_for_heating_and_cooling(
    plant: Plant, drive: float, real: float
) -> None:
    watch, rig = watched(plant)
    assert follow(watch, rig, drive, 30.0)[0] == np.inf
    begin = rig.time
    for _ in range(60):
        rig.apply({"drive": real}, 1)
        rig.wait(1.0)
        if found := watch.follow(rig.time, {"drive": drive}, 1, rig.read().values):
            break
    assert rig.time - begin <= 14.0
    assert "driver" in watch.explain(found[0]) or "wrong way" in watch.explain(found[0])


def test_a_pump_that_stands_still_is_told_from_a_driver(plant: Plant) -> None:
    watch, rig = watched(plant)
    follow(watch, rig, 0.8, 40.0)
    for _ in range(60):
        rig.apply({"drive": 0.8}, 0)
        rig.wait(1.0)
        if found := watch.follow(rig.time, {"drive": 0.8}, 1, rig.read().values):
            break
    assert watch.explain(found[0]).startswith("the pump stands still")


@pytest.mark.parametrize("name", ["t_tank", "t_surface"])
def test_a_sensor_that_lies_alone_is_told_from_a_plant_that_changes(plant: Plant, name: str) -> None:
    watch, rig = watched(plant)
    follow(watch, rig, 0.5, 40.0)
    at, because = follow(watch, rig, 0.5, 60.0, lambda t, v: {name: v[name] + 0.15 * t})
    assert at <= 15.0
    assert f"{name} alone is wrong" in because  # a driver that gives more looks alike for a while


def test_a_drift_that_the_filter_follows_ends_at_the_bias_limit(plant: Plant) -> None:
    watch, rig = watched(plant)
    follow(watch, rig, 0.3, 200.0)
    at, _ = follow(watch, rig, 0.3, 2000.0, lambda t, v: {"t_surface": v["t_surface"] + 0.005 * t})
    assert at < 700.0  # 2 K at 5 mK/s is 400 s


def test_a_spike_is_not_believed_but_a_touch_is_not_looked_at(plant: Plant) -> None:
    watch, rig = watched(plant)
    follow(watch, rig, 0.3, 60.0)
    watch.predict(rig.time + 1.0, {"drive": 0.3}, 1, {})
    expected = watch.expected()["t_surface"]
    assert watch.is_jump("t_surface", expected + 4.0)
    assert not watch.is_jump("t_surface", expected + 0.3)


def test_a_sensor_that_the_rig_has_not_makes_nothing_less_known(plant: Plant) -> None:
    """The guard names both sensors that a skin may have; what is known after a touch is the same."""
    spreads = []
    for blind in ({"t_surface"}, {"t_surface", "t_surface_2"}, {"t_surface_2"}):
        watch, rig = watched(plant)
        follow(watch, rig, 0.3, 60.0)
        watch.predict(rig.time + 1.0, {"drive": 0.3}, 1, {})
        watch.update(rig.time + 1.0, {}, frozenset(blind))
        watch.update(rig.time + 1.0, {})
        spreads.append(watch.spread())
    touched, with_a_second, never = spreads
    assert with_a_second == touched
    assert never["t_surface"] < 0.5 * touched["t_surface"]


def test_a_peltier_past_its_optimum_is_noticed_by_the_model() -> None:
    """Q = S T I - R I^2 / 2 - K dT turns over at I = S T / R; the bundled network, 5 R."""
    from dataclasses import replace

    known = drill_plants()[0]
    turned = replace(known, values={**known.values, "resistance": 20.0})
    for plant, drive, past in ((known, -1.0, False), (turned, -1.0, True), (turned, -0.1, False)):
        watch = ModelWatch(plant)
        watch.reset(0.0, {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0})
        for k in range(1, 30):
            watch.predict(float(k), {"drive": drive}, 1, {"t_ambient": 25.0})
        assert bool(watch.past_optimum()) == past


def test_a_rig_that_stood_with_a_warm_tank_is_not_taken_for_one_at_rest() -> None:
    from thermogrip.sysid.contact.simulation import Grip

    known, real = drill_plants()
    rig = Twin(real, contact=Grip(), t_start=25.0)
    while rig.truth()["t_tank"] < 26.8:
        rig.apply({"drive": 0.3}, 0)
        rig.wait(1.0)
    rig.apply({"drive": 0.0}, 0)
    rig.wait(30.0)
    assert rig.truth()["t_tank"] - rig.truth()["t_surface"] > 1.0
    watch = ModelWatch(known)
    watch.reset(rig.time, rig.read().values)
    for drive in (0.8, -0.4):
        assert follow(watch, rig, drive, 150.0)[0] == np.inf


def test_between_sessions_the_guard_keeps_what_it_knows(plant: Plant) -> None:
    guard = Guard(plant)
    rig = watched(plant)[1]
    guard.start(rig.read(), 0.0, UNITS)
    for _ in range(100):
        guard.asked({"drive": 0.5}, 1)
        rig.apply({"drive": 0.5}, 1)
        rig.wait(1.0)
        assert guard.check(rig.read(), rig.time, planned=1.0).trip is None
    assert guard.model is not None
    known = guard.model.expected()
    guard.start(rig.read(), rig.time, UNITS)
    assert guard.model.expected()["t_tank"] == pytest.approx(known["t_tank"], abs=0.3)
    assert guard.model.compared_from == 0.0  # no new warm-up
