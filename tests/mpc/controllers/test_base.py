"""What every controller does with what it reads, is asked, and proposes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mpc.makers import crossed
from thermogrip.mpc.controllers.base import SampledController, as_drive
from thermogrip.mpc.plant.prediction import PredictionModel

NAN = float("nan")
MODEL = PredictionModel(crossed())


@pytest.fixture
def controller() -> SampledController:
    ranges, slew = {"q1": (10.0, 80.0), "q2": (0.0, 100.0)}, np.array([8.0, 25.0])
    return SampledController(MODEL, ("b", "a"), ranges, slew, 6.0, lambda: 5.0)


@pytest.mark.parametrize(
    ("value", "read"),
    [(25.5, 25.5), ("25.5", 25.5), (-60.0, -60.0), (200.0, 200.0), (-60.1, NAN), (200.1, NAN), (NAN, NAN),
     (None, NAN), ("warm", NAN), ([], NAN)],
)  # fmt: skip
def test_a_reading_is_a_plausible_temperature_or_none(controller, value: object, read: float):
    np.testing.assert_equal(controller._clean({"t": value}, "t"), read)
    assert np.isnan(controller._clean({"other": 25.0}, "t"))
    assert np.isnan(controller._clean(None, "t"))


@pytest.mark.parametrize(
    ("target", "wanted", "wrong"),
    [
        (30.0, [30.0, 30.0], ""),
        ({"a": 31.0, "b": 32.0}, [32.0, 31.0], ""),
        ({"a": 31.0, "b": 32.0, "c": 1.0}, [32.0, 31.0], "target names c, controlled is b, a"),
        ({"b": 32.0}, [32.0, 22.0], "target of a is missing or absurd: the last good one is kept"),
        (
            {"a": 31.0, "b": 900.0},
            [21.0, 31.0],
            "target of b is missing or absurd: the last good one is kept",
        ),
        (NAN, [21.0, 22.0], "target of b is missing or absurd: the last good one is kept"),
    ],
)
def test_the_targets_are_those_given_or_the_last_good_ones(controller, target, wanted, wrong):
    controller._target = np.array([21.0, 22.0])
    found, said = controller._wanted(target)
    assert (found.tolist(), said) == (wanted, wrong)


@pytest.mark.parametrize(
    ("before", "asked", "seconds", "applied"),
    [
        ([20.0, 30.0], [26.0, 20.0], 2.0, [26.0, 20.0]),
        ([20.0, 30.0], [90.0, -50.0], 2.0, [28.0, 5.0]),
        ([20.0, 30.0], [90.0, -50.0], 1.0, [24.0, 17.5]),
        ([20.0, 30.0], [90.0, -50.0], 40.0, [80.0, 0.0]),
        ([20.0, 30.0], [NAN, NAN], 4.0, [10.0, 0.0]),
        ([150.0, -50.0], [NAN, 60.0], 2.0, [72.0, 25.0]),  # what was out of range counts as its end
    ],
)
def test_a_drive_is_in_range_and_within_the_slew_of_the_seconds(controller, before, asked, seconds, applied):
    controller._u = np.array(before)
    assert controller._within(np.array(asked), seconds).tolist() == applied


def test_an_answer_rests_the_pump_only_where_it_is_off_without_a_drive(controller):
    assert controller._move.drive == {"q1": 10.0, "q2": 0.0}  # what is nearest to none
    for u, status, pump in (([0.0, 0.0], "off", 0), ([0.0, 1.0], "off", 1), ([0.0, 0.0], "ok", 1)):
        controller._u = np.array(u)
        controller.times.call({})
        move = controller._answer(status, "why", 2.0)
        assert (move.status, move.advice, move.pump, move.seconds) == (status, "why", pump, 3.0)
        assert controller.times.since == 0.0
    held = controller._held_move(1.0)
    assert (held.seconds, held.advice) == (4.0, "why")


@pytest.mark.parametrize(
    ("unread", "parked", "said"),
    [
        ([0.0, 4.0], [], "a: no usable reading, the model replaces it"),
        ([6.0, 4.0], [], "b, a: no usable reading, the model replaces it"),  # patience is 6 s
        ([7.6, 0.0], ["q1"], "no reading of b for 8 s: q1 to rest, the others go on"),
        ([7.6, 12.2], [], "no reading of b, a for 12 s: the others go on"),
    ],
)
def test_what_becomes_of_lost_loops_is_reported(controller, unread, parked, said):
    assert controller._unseen(parked, np.array(unread)) == said


def test_a_stale_reading_is_none_and_says_so(controller):
    reading = {"a": 25.0, "b": 26.0, "room": 22.0, "time_s": 7.0}
    for stale in (False, True):
        controller.times.call(reading)
        y, d, wanted, wrong = controller._given(reading, 30.0)
        np.testing.assert_array_equal(y, [NAN, NAN] if stale else [25.0, 26.0])
        assert (d.tolist(), wanted.tolist()) == ([22.0], [30.0, 30.0])
        assert wrong == ("reading is stale: its time has not moved on" if stale else "")
    assert controller._target.tolist() == [30.0, 30.0]
    assert controller._given(reading, NAN)[3].startswith("target of b")


def test_a_drive_is_a_number_where_there_is_one():
    assert as_drive(("q",), [3.0]) == 3.0
    assert as_drive(("p", "q"), [3.0, 4.0]) == {"p": 3.0, "q": 4.0}
