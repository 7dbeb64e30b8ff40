"""Clocks that are handed in: one that moves only in sleep, one that runs faster, one beat."""

from __future__ import annotations

import time

import pytest

from tests.rig.makers import SteppedClock
from thermogrip.rig.clock import BackOff, Metronome, ScaledClock


def test_sums_of_tenths_stay_tenths_a_nanosecond_is_time_and_no_sleep_turns_the_clock_back() -> None:
    clock, seen = SteppedClock(5.0), []
    for _ in range(30):
        clock.sleep(0.1)
        seen.append(clock())
    assert seen == [round(5.0 + k / 10, 1) for k in range(1, 31)]
    clock.sleep(-0.5)
    assert clock() == 8.0
    clock.sleep(1e-9)
    assert clock() == 8.000000001


def test_a_fast_clock_shows_and_sleeps_its_own_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now, slept = [100.0], []
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "sleep", slept.append)
    clock = ScaledClock(20.0)
    now[0] += 3.0
    assert clock() == 60.0
    clock.sleep(10.0)
    clock.sleep(-10.0)
    assert slept == [0.5, 0.0]


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_clock_that_cannot_run_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="cannot run"):
        ScaledClock(speed)


def beats(wait: float, *works: float) -> list[float]:
    """Return when each wait ends, on a clock that starts at 0."""
    clock, ends = SteppedClock(), []
    beat = Metronome(clock, clock.sleep)
    for work in works:
        clock.sleep(work)
        ends.append(beat.next(wait))
        clock.sleep(ends[-1] - clock())
    return ends


def test_work_shorter_than_the_wait_and_half_a_second_is_taken_off_it() -> None:
    assert beats(0.1, 0.0, 0.09, 0.03, 0.0) == [0.1, 0.2, 0.3, 0.4]
    assert beats(2.0, 0.0, 0.49) == [2.0, 4.0]


@pytest.mark.parametrize(("wait", "late"), [(0.1, 0.1), (0.1, 0.25), (2.0, 0.5), (2.0, 1.9)])
def test_after_longer_work_the_grid_starts_anew(wait: float, late: float) -> None:
    ends = beats(wait, 0.0, late, 0.0)
    assert ends == pytest.approx([wait, 2 * wait + late, 3 * wait + late], abs=1e-9)


def test_a_wait_that_begins_before_the_last_has_ended_is_not_put_behind_it() -> None:
    clock = SteppedClock()
    beat = Metronome(clock, clock.sleep)
    assert beat.next(0.4) == 0.4
    clock.sleep(0.1)  # woken early, by a stop for example
    assert beat.next(0.4) == 0.5


def test_a_retry_waits_twice_as_long_each_time_until_one_succeeds() -> None:
    clock = SteppedClock(7.0)
    retry, waits = BackOff(clock, first=0.5, longest=1.7), []
    assert retry.due()
    for k in range(5):
        if k == 4:
            retry.succeeded()
            assert retry.due()
        retry.failed()
        waits.append(round(retry.next_try - clock(), 9))
        clock.sleep(waits[-1] - 0.001)
        assert not retry.due()
        clock.sleep(0.001)
        assert retry.due()
    assert waits == [0.5, 1.0, 1.7, 1.7, 0.5]


def test_a_clock_runs_at_its_own_speed_unless_told() -> None:
    assert (ScaledClock().speed, SteppedClock()()) == (1.0, 0.0)
