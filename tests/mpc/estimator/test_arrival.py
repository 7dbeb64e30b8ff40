"""Outputs that are not where they should be."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.estimator.arrival import ArrivalMonitor

TARGET = np.array([40.0])
THERE_IN_THREE, NEVER = 6.0, np.inf  # s that are promised


def monitor() -> ArrivalMonitor:
    return ArrivalMonitor(("t",), 2.0, np.array([0.3]))


def note(found: ArrivalMonitor, y: float, promised: float, target=TARGET, zone: float = 0.0) -> str:
    seconds = np.array([2.0])
    return found.expect(np.array([y]), target, np.array([promised]), seconds, np.array([zone]))


def play(found: ArrivalMonitor, readings: list[float], promised: float, target: np.ndarray = TARGET) -> str:
    """Note readings a sample apart; return a 1 for each at which the output was overdue."""
    said = (note(found, y, promised, target) for y in readings)
    return "".join("01"[bool(word)] for word in said)


def test_an_output_is_overdue_after_three_times_the_time_that_was_promised_and_five_samples():
    # 6 s are promised, 3 x 6 + 10 x 2 = 38 s are given
    assert play(monitor(), [30.0] * 22, THERE_IN_THREE) == "0" * 20 + "11"
    assert play(monitor(), [30.0] * 40, NEVER) == "0" * 40
    found = monitor()
    play(found, [35.0] * 20, THERE_IN_THREE)
    said = note(found, 35.0, NEVER)
    where = "t should have been at 40 34 s ago and is 5 off"
    assert said == f"{where}: a load, or another plant than the model"


@pytest.mark.parametrize(("near", "overdue"), [(11, True), (20, False)])
def test_a_swing_through_the_target_is_no_arrival_and_five_samples_there_are(near: int, overdue: bool):
    found = monitor()
    # the mean of the errors is near from the ninth 40.2 on
    seen = play(found, [30.0] * 5 + [40.2] * near + [46.0] * 12, THERE_IN_THREE)
    assert ("1" in seen) == overdue


def test_a_new_target_begins_anew_and_a_lost_reading_says_nothing():
    found = monitor()
    play(found, [30.0] * 19, THERE_IN_THREE)
    assert play(found, [30.0] * 19, THERE_IN_THREE, TARGET - 1e-3) == "0" * 19
    found = monitor()
    assert play(found, [30.0] * 19 + [np.nan, 30.0], THERE_IN_THREE)[-3:] == "001"
    found.restart()
    assert play(found, [30.0] * 19, THERE_IN_THREE) == "0" * 19


def test_noise_that_the_model_does_not_know_of_is_no_delay():
    rng, found = np.random.default_rng(0), monitor()
    readings = (40.0 + 0.2 * rng.standard_normal(2000)).tolist()
    assert "1" not in play(found, [30.0] * 4 + readings, THERE_IN_THREE)


def test_near_is_in_the_zone():
    for zone, said in ((0.0, True), (5.0, False)):
        found = monitor()
        words = [note(found, 35.0, THERE_IN_THREE, zone=zone) for _ in range(25)]
        assert bool(words[-1]) == said
