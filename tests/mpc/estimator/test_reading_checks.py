"""Readings that cannot be, and what is reported of a plant that the model no longer explains."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from thermogrip.mpc.estimator.reading_checks import ReadingMonitor, follows, is_off

NAN = float("nan")
EXPECTED = np.array([30.0, 20.0])
SPIKE = np.array([6.0, 6.0])


@pytest.mark.parametrize(
    ("readings", "kept", "stays"),
    [
        ([36.0, 24.0], "11", "00"),  # 6 degC off is no jump
        ([36.1, 36.2, 36.3, 36.4, 36.5, 36.6, 36.7, 36.8], "00010001", "00010001"),
        ([23.9, 36.2, 23.7, 36.4], "0001", "0001"),
        ([36.1, 36.2, 30.0, 36.4, 36.5, 36.6, 36.7], "0010001", "0000001"),  # one that fits begins anew
        ([36.1, 36.2, NAN, 36.4, 36.5], "00001", "00001"),  # a lost one does not
    ],
)
def test_a_jump_is_left_out_three_times_and_counts_at_the_fourth(
    readings: list[float], kept: str, stays: str
):
    monitor = ReadingMonitor(2)
    monitor.forget(EXPECTED)
    for at, value in enumerate(readings):
        other = 20.0 + 0.1 * at
        y, jumped = monitor.screen(np.array([value, other]), EXPECTED)
        np.testing.assert_array_equal(y, [value if kept[at] == "1" else NAN, other])
        assert jumped.tolist() == [stays[at] == "1", False]
    monitor.screen(np.array([37.0, 20.0]), EXPECTED)
    monitor.forget(EXPECTED)
    counted = [monitor.screen(np.array([37.0 + at, 20.0]), EXPECTED)[1][0] for at in range(4)]
    assert counted == [False, False, False, True]


def test_a_reading_that_stays_while_two_degrees_are_expected_of_it_is_stuck_until_it_moves():
    monitor = ReadingMonitor(2)
    monitor.forget(np.array([30.0, 20.0]))
    seen = []
    for change, y in (
        ([1.5, -1.5], [30.0, 20.0]),
        ([0.5, -0.5], [30.0, 20.0]),  # 2 degC: not yet
        ([0.1, -0.1], [30.0, 20.0]),
        ([0.1, -0.1], [NAN, NAN]),  # nothing is read, and nothing is known to have moved
        ([-0.5, -0.1], [30.0, 20.0]),  # what is expected may come back
        ([0.5, -0.1], [30.0, 20.1]),
        ([0.5, -1.9], [30.1, 20.1]),
        ([1.9, -0.2], [30.1, 20.1]),
    ):
        monitor.expect(np.array(change))
        seen.append("".join("01"[int(np.isfinite(v))] for v in monitor.screen(np.array(y), EXPECTED)[0]))
    assert seen == ["11", "11", "00", "00", "10", "01", "11", "10"]
    assert monitor.stuck.tolist() == [False, True]
    monitor.forget(np.array([30.1, 20.1]))
    assert monitor.stuck.tolist() == [False, False]


def test_of_a_wide_range_more_is_expected_of_a_reading_before_it_is_stuck():
    monitor = ReadingMonitor(2, spike=np.array([22.5, 6.0]))
    monitor.forget(np.array([30.0, 20.0]))
    monitor.expect(np.array([7.4, 2.1]))
    assert monitor.screen(np.array([30.0, 20.0]), EXPECTED)[0] == pytest.approx([30.0, NAN], nan_ok=True)
    monitor.expect(np.array([0.2, 0.0]))
    assert monitor.stuck.all()


@pytest.mark.parametrize(
    ("bias", "offsets", "switches", "said"),
    [
        (0.29, [1.9, -1.9], ("pump",), ""),
        (0.3, [0.0, 0.0], (), "skin does not follow the drive: is it another plant?"),
        (-0.9, [9.0, 0.0], ("pump",), "skin does not follow the drive: does the pump run?"),
        (0.0, [1.0, -2.0], (), "skin is far from the model: is the sensor in place?"),
        (
            0.0,
            [9.0, 1.0],
            ("pump",),
            "tank is far from the model: does the pump run, is the sensor in place?",
        ),
    ],
)
def test_what_the_model_does_not_explain_is_reported_of_the_drive_first(
    bias: float, offsets: list[float], switches: tuple[str, ...], said: str
) -> None:
    model = SimpleNamespace(model=SimpleNamespace(switches=switches), outputs=("tank", "skin"), spike=SPIKE)
    off = SimpleNamespace(disturbance=SimpleNamespace(on_drive=np.eye(1)), model=model, w=np.array([bias]))
    off.offset = np.array([0.25, -0.5])
    off.output_bias = off.offset + offsets
    assert follows(off, ("skin",)) == said  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("reading", "off"),
    [
        ({"a": 0, "b": 1}, True),
        ({"a": 1, "b": 0.49}, True),
        ({"a": 0.5, "b": 1}, False),
        ({"b": None}, False),
    ],
)
def test_a_switch_is_off_below_a_half_and_only_where_it_is_read(reading: dict[str, float], off: bool):
    assert is_off(("a", "b"), reading) == off
