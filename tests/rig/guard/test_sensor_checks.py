"""One sensor by itself: what is forgiven, what is remembered, and what is forgotten again."""

from __future__ import annotations

from math import erf, inf, log, nan, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermogrip.rig.guard.sensor_checks import SensorMonitor, repeats_needed
from thermogrip.rig.guard.settings import SensorSettings
from thermogrip.rig.guard.trip import Trip


def monitor(name: str = "t", **settings: object) -> SensorMonitor:
    made = SensorMonitor(SensorSettings(**settings))
    made.start(0.0, {name: 25.0})
    return made


@pytest.mark.parametrize(("value", "accepted"), [(-5.0, True), (-5.01, False), (75.0, True), (75.01, False)])
def test_water_between_five_below_and_seventy_five_is_plausible(value: float, accepted: bool) -> None:
    made = SensorMonitor()
    assert made.plausible(value) == accepted
    made.start(0.0, {"t": value})
    assert made.last_good() == ({"t": value} if accepted else {})
    assert made.check(1.0, {"t": value})[1] == ({} if accepted else {"t": "lost"})
    assert not any(made.plausible(lost) for lost in (nan, inf, -inf))


def test_bad_readings_are_counted_in_a_row() -> None:
    made = monitor()
    for k, value in enumerate((nan, nan, 25.0, nan, 200.0), start=1):
        assert made.check(float(k), {"t": value})[2] is None
    trip = made.check(6.0, {"t": nan})[2]
    assert (trip.kind, trip.time_s) == ("lost", 6.0)


@pytest.mark.parametrize("dt", [0.1, 1.0, 2.0])
@pytest.mark.parametrize(
    ("lost", "of", "after"), [(2, 3, 28.0), (1, 3, 83.0), (2, 7, 125.0), (1, 5, inf), (1, 60, inf)]
)
def test_a_sensor_that_is_lost_for_a_quarter_of_the_time_trips_however_often_it_is_read(
    lost: int, of: int, after: float, dt: float
) -> None:
    """An average over a minute comes from 0 to 1/4 in -60 s ln(1 - (1/4) / share)."""
    made, rooms = monitor(), monitor()
    trips = []
    for k in range(1, round(600 / dt)):
        values = {"t": nan if k % of < lost else 25.0 + 0.0625 * (k % 2)}
        trips += [trip] if (trip := made.check(k * dt, values)[2]) else []
        assert rooms.check(k * dt, values, rooms=frozenset("t"))[2] is None
    if after == inf:
        assert trips == []
    else:
        assert trips[0].kind == "lost"
        assert trips[0].time_s == pytest.approx(after, rel=0.05, abs=3 * of * dt)
        assert trips[0].measured == "nan degC, and suspect for 25% of the last minute" or dt > 0.1


def test_a_change_may_be_the_slack_and_the_rate_since_the_last_good_reading() -> None:
    for change, why in ((0.55, {}), (0.65, {"t": "jump"}), (-0.55, {}), (-0.65, {"t": "jump"})):
        assert monitor().check(0.02, {"t": 25.0 + change})[1] == why  # 0.5 K and 5 K/s
        assert monitor().check(0.02, {"t": 25.0 + change}, touching=frozenset("t"))[1] == {}
    made = monitor()
    for k in range(1, 101):
        assert made.check(float(k), {"t": 25.0})[1] == {}
    assert made.check(100.1, {"t": 35.0})[1] == {"t": "jump"}  # fast, however long it stood
    made.check(101.0, {"t": nan})
    assert made.check(103.0, {"t": 39.0})[1] == {}  # 3 s after the last good one
    assert made.last_good() == {"t": 39.0}


def stands_after(changes: list[float], rooms: frozenset[str] = frozenset()) -> float:
    """Return after how many equal readings a sensor that has moved so counts as stuck."""
    made, value, name = monitor(), 25.0, "t"
    for k, change in enumerate(changes, start=1):
        value = round(value + change, 6)
        assert made.check(float(k), {name: value}, rooms=rooms)[2] is None
    for same in range(1, 200):
        trip = made.check(float(len(changes) + same), {name: value}, rooms=rooms)[2]
        if trip is not None:
            assert trip.kind == "stuck"
            assert trip.measured.endswith(f", for {same} s")  # since it last moved
            assert made.same_for(name) == (same, pytest.approx(same - 1, abs=1))
            return same
    return inf


def test_a_sensor_is_stuck_by_the_smallest_step_that_it_has_shown_in_twenty_changes() -> None:
    fine, coarse = [1 / 16, -1 / 16] * 15, [1 / 16, -1 / 16] + [0.5, -0.5] * 14
    assert stands_after(fine) == stands_after(coarse) == 37  # measured in its documentation
    assert stands_after(fine[:20]) == 37
    assert stands_after(fine[:19]) == inf
    assert stands_after(fine, frozenset("t")) == inf  # rooms may stand still


def test_twins_that_agree_in_between_begin_anew() -> None:
    made = SensorMonitor()
    made.start(0.0, {"t": 25.0, "t_2": 25.0})

    def apart(begin: int, end: int, off: float) -> list[str]:
        noise = [0.0625, 0.0]
        said = [
            made.check(float(k), {"t": 25.0 + noise[k % 2], "t_2": 25.0 + off + noise[k % 2]})[2]
            for k in range(begin, end)
        ]
        return [trip.kind for trip in said if trip is not None]

    for off in (4.4, -4.4):
        assert apart(1, 21, off) == []
        assert apart(21, 31, 0.0) == []
        assert apart(31, 61, off) == []  # 29 s
        assert apart(61, 62, off) == ["disagree"]
        made.start(0.0, {"t": 25.0, "t_2": 25.0})


@given(st.floats(0.005, 0.2), st.floats(0.01, 0.2), st.sampled_from([1e-6, 1e-9]))
def test_repeats_are_as_unlikely_as_stated(quantum: float, noise: float, alpha: float) -> None:
    assert repeats_needed(0.3223, 0.04, 1e-9) == inf  # of a coarse converter no number of repeats proves it
    n = repeats_needed(quantum, noise, alpha)
    p = erf(quantum / (2 * sqrt(2) * noise))
    assert n >= 10
    if np.isfinite(n) and n > 10:
        assert n * log(p) <= log(alpha) * (1 - 1e-9)
        assert (n - 1) * log(p) > log(alpha) * (1 + 1e-9)


def test_a_healthy_sensor_is_not_called_stuck_in_a_day_and_a_stuck_one_is_in_a_minute() -> None:
    rng = np.random.default_rng(0)
    made = monitor()
    readings = np.round((25.0 + 0.04 * rng.standard_normal(86_400)) * 16) / 16  # the middle of a quantum
    for k, value in enumerate(readings.tolist(), start=1):
        assert made.check(float(k), {"t": value})[2] is None
    trips = [made.check(86_400.0 + k, {"t": value})[2] for k in range(1, 60)]
    first = next(k for k, trip in enumerate(trips, start=1) if trip is not None)
    assert first <= 38


def said(trip: Trip) -> tuple[str, str, str, str]:
    return trip.kind, trip.subject, trip.expected, trip.measured


def test_each_trip_of_a_sensor_has_its_two_numbers() -> None:
    made, trips, near = monitor(), [], "near the last good 25.00 degC"
    for value in (80.0, 80.0, 80.0, 25.0, 40.0, 41.0, 42.0):
        trips.append(made.check(1.0, {"t": value})[2])
    for at, kind, value, expected in ((2, "lost", 80.0, "-5 to 75 degC"), (6, "jump", 42.0, near)):
        assert said(trips[at]) == (kind, "t", expected, f"{value:g} degC, 3 readings in a row")
    made = monitor(alpha=1e-3, noise_K=5.0)  # ten repeats are enough then
    for k in range(1, 31):
        trip = made.check(float(k), {"t": 25.0 + 0.125 * (k % 2 if k < 22 else 1)})[2]
        assert trip is None
    said_ = ("a change of 0.125 degC every few readings", "25.125 degC 11 times in a row, for 10 s")
    assert said(made.check(31.0, {"t": 25.125})[2])[2:] == said_
    made = SensorMonitor(SensorSettings(pair_limit_K=1.0))
    made.start(0.0, {"a": 20.0, "a_2": 20.0})
    assert made.check(1.0, {"a": 20.0, "a_2": 21.0})[2] is None  # the limit itself
    for time, value in ((2.0, 21.25), (31.9, 21.5)):
        assert made.check(time, {"a": 20.0, "a_2": value})[2] is None
    assert made.check(31.95, {"a": 20.0})[2] is None  # the other is not read
    pair = ("disagree", "a and a_2", "within 1 K of each other", "20.00 and 21.50 degC for 30 s")
    assert said(made.check(32.0, {"a": 20.0, "a_2": 21.5})[2]) == pair


def test_a_reading_that_jumped_against_the_model_is_suspect_and_a_new_sensor_begins_where_it_reads() -> None:
    made = monitor()
    assert made.check(1.0, {"t": 25.1}, jumped=frozenset("t"))[:2] == ({}, {"t": "jump"})
    assert made.check(1.1, {"t": 25.1, "new": 60.0})[1] == {}
    assert made.last_good() == {"t": 25.1, "new": 60.0}
    assert (made.same_for("nobody"), made.same_for("new")) == ((0, 0.0), (1, 0.0))
    trips = [made.check(2.0 + k, {"t": 90.0}, rooms=frozenset("t"))[2] for k in range(5)]
    assert trips == [None] * 5  # a room may be lost
