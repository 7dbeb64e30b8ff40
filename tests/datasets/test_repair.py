"""What is repaired in a log, what is left alone, and that it is reported."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.repair import (
    check_plausible,
    describe_steps,
    drop_codes,
    drop_stuck,
    find_spikes,
    gap_rows,
    order_rows,
    reject_spikes,
)

RNG = np.random.default_rng(3)


def quantised(values):
    return np.round((values + 0.05 * RNG.standard_normal(values.size)) * 16) / 16


def level(changes, of=25.0, n=100):
    """Return a constant channel with other values at some rows, or from one row to another."""
    values = np.full(n, of)
    for at, value in changes.items():
        values[slice(*at) if isinstance(at, tuple) else at] = value
    return values


WAVE, STEP = quantised(30 + np.sin(np.arange(500) / 40)), np.repeat([20.0, 45.0], 100)
BURST = np.r_[np.full(300, 20.0), 20 + 2.0 * np.abs(np.arange(120) % 8 - 4), np.full(300, 20.0)]
TOUCH = 23.0 + 12 * -np.expm1(-np.maximum(np.arange(200) * 0.1 - 5, 0) / 0.3)


@pytest.mark.parametrize(
    ("values", "floor", "spikes"),
    [
        pytest.param(
            np.r_[WAVE[:100], 127.9, WAVE[100:300], -3.5, WAVE[300:]], 0.6, [100, 301], id="loose plug"
        ),
        pytest.param(level({50: 60.0}), 0.6, [50], id="one sample"),
        pytest.param(level({(50, 53): 60.0}), 0.6, [50, 51, 52], id="three samples"),
        pytest.param(level({(50, 54): 60.0}), 0.6, [], id="a longer visit"),
        pytest.param(level({50: 50.0, (51, 57): 90.0}, 20.0), 0.6, [], id="half way into a visit"),
        pytest.param(level({49: np.nan, 50: 90.0, 51: np.nan}), 0.6, [50], id="beside lost samples"),
        pytest.param(
            level({100: 90.0, 103: -10.0, 108: 127.9}, n=200), 0.6, [100, 103, 108], id="close together"
        ),
        pytest.param(BURST, 0.6, [], id="lively stretch"),
        pytest.param(BURST + 60.0 * (np.arange(720) == 361), 0.6, [361], id="spike in a lively stretch"),
        pytest.param(STEP, 0.6, [], id="step"),
        pytest.param(quantised(STEP), 0.6, [], id="noisy step"),
        pytest.param(TOUCH, 0.6, [], id="touch"),
        pytest.param(20 + 0.32 * RNG.integers(0, 2, 1000), 0.6, [], id="flicker of a coarse converter"),
        pytest.param(60.0 + np.arange(400) // 80 + (np.arange(400) % 37 == 5), 0.6, [], id="whole degrees"),
        pytest.param(np.array([1.0, 90.0, 1.0]), 0.6, [], id="short"),
        pytest.param(
            level({100: 20.32, 200: 21.28, 300: 21.92}, 20.0, 400), None, [300], id="steps of a converter"
        ),
        pytest.param(level({100: 20.1, 200: 20.4, 300: 20.6}, 20.0, 400), None, [300], id="of a finer one"),
        *(pytest.param(level({(0, n): 60.0}), 0.6, [], id=f"{n} at the start") for n in (1, 2, 3)),
        *(pytest.param(level({(100 - n, 100): 60.0}), 0.6, [], id=f"{n} at the end") for n in (1, 2, 3)),
    ],
)
def test_what_is_a_spike_and_what_is_not(values, floor, spikes):
    assert np.flatnonzero(find_spikes(values, floor=floor)).tolist() == spikes


@pytest.mark.parametrize(("value", "step", "lost"), [(29.9, 59, 1), (29.9, 60, 0), (30.1, 60, 1)])
def test_in_slow_rows_a_spike_lies_beyond_all_others_by_more_than_their_range(value, step, lost):
    hours = np.repeat([20.0, 25.0, 20.0, 22.0], 25)
    hours[60] = value
    rejected, _ = reject_spikes("t", hours, step * np.arange(100.0), floor=0.6)
    assert np.isnan(rejected).sum() == lost


@pytest.mark.parametrize(
    ("celsius", "words"),
    [(-80.0, ""), (200.0, ""), (400.0, ""), (298.0, "name the column t_tank_K if this is kelvin")]
    + [(room + k, says) for room in (0.0, 25.0, 60.0) for k, says in ((273.15, "is k"), (-273.15, "in k"))],
)
def test_a_temperature_in_the_wrong_unit_is_noticed_and_a_freezer_or_an_oven_is_not(celsius, words):
    found = check_plausible("t_tank", np.full(3, celsius), "a.csv")
    assert words in found[0] if words else found == []


@pytest.mark.parametrize("slope", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("half", [3, 8, 30])
def test_the_tips_of_a_triangle_stay(slope, half):
    values = slope * np.abs((np.arange(400) % (2 * half)) - half)
    assert not find_spikes(values, floor=0.6).any()


def test_a_spike_stands_out_from_what_the_channel_does_within_the_window():
    # over a whole period the median is 0 and |sin| has the median sin(pi/4), so the threshold is
    # 6 * 1.4826 * 0.7071 = 6.29 amplitudes; the wave itself moves by 0.31 of one beside the spike
    wave = np.sin(2 * np.pi * np.arange(400) / 20)
    for size, found in ((5.9, []), (6.9, [200])):
        values = wave.copy()
        values[200] += size
        assert np.flatnonzero(find_spikes(values, floor=0.01)).tolist() == found


def test_without_a_floor_a_spike_is_two_per_cent_of_the_range():
    for size, found, scale in ((1.8, [], 1e-3), (2.2, [500], 1e3)):
        values = 20 + np.arange(1000) / 10  # 2 % of its 1st to 99th percentile is 1.96
        values[500] += size
        assert np.flatnonzero(find_spikes(scale * values, floor=None)).tolist() == found
        values[200] += 1000  # a spike is no part of the range
        assert np.flatnonzero(find_spikes(scale * values, floor=None)).tolist() == [200, *found]


@settings(max_examples=50)
@given(st.integers(12, 80), st.floats(5.0, 100.0), st.sampled_from([-1, 1]))
def test_what_is_rejected_is_lost_and_the_rest_is_untouched(at, size, sign):
    clean = 25 + np.sin(np.arange(100) / 15)
    values = clean.copy()
    values[at] += sign * size
    got, lines = reject_spikes("t", values, np.arange(100.0), floor=0.6)
    assert np.isnan(got[at])
    np.testing.assert_array_equal(np.delete(got, at), np.delete(clean, at))
    assert "1 spike sample rejected" in lines[0]
    again, lines = reject_spikes("t", got, np.arange(100.0), floor=0.6)
    assert lines == []
    np.testing.assert_array_equal(again, got)


@pytest.mark.parametrize(
    ("stamps", "time", "rows", "line"),
    [
        ([0, 1, 1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10], range(11), [0, 1, *range(4, 13)],
         "2 repeated time stamps dropped (rows 4, 5)"),
        ([0, 0, 3, 3, 3, 6, 6, 6, 9], range(1, 10), range(9),
         "time has 4 stamps for 9 rows: rows spread evenly between them"),
        ([*range(30), np.nan, *range(30, 39)], range(39), [*range(30), *range(31, 40)],
         "1 row without a time dropped (row 32)"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_single_times_is_repaired(stamps, time, rows, line):
    got, kept, said = order_rows(np.array(stamps, dtype=float), np.arange(2, 2 + len(stamps)), "a.csv")
    np.testing.assert_allclose(got, [*time], rtol=0, atol=1e-12)
    assert kept.tolist() == [*rows]
    assert said == [line]


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        ([0, 1, 2, 0, 1, 2], "row 5: time runs back from 2 s to 0 s; cut the file there in two"),
        ([*range(100), 98.5], "row 102: time runs back from 99 s to 98.5 s"),
        ([0, np.nan, 2, 3], "row 3, column time: has no time"),
    ],
)
def test_times_that_are_wrong_throughout_are_refused(stamps, words):
    with pytest.raises(UserError, match=re.escape(words)):
        order_rows(np.array(stamps, dtype=float), np.arange(2, 2 + len(stamps)), "a.csv")


def test_even_stamps_are_not_worth_a_line_and_uneven_ones_are():
    assert describe_steps(np.arange(50) * 0.1) == []
    uneven = np.cumsum(np.tile([0.18, 0.2, 0.22], 30))
    assert describe_steps(uneven)[0].startswith("time stamps are uneven: median step 0.2 s, 0.18 to 0.22 s")
    assert describe_steps(np.r_[:9000:300, 9000:9900:10])[0].startswith(
        "rows are 300 s apart at first and 10 s"
    )


def test_a_gap_is_longer_than_ten_seconds_and_five_steps():
    assert gap_rows(np.array([0.0, 1.0, 2.0, 11.9, 12.9])).tolist() == []
    assert gap_rows(np.array([0.0, 1.0, 2.0, 12.1, 13.1])).tolist() == [2]
    assert gap_rows(np.arange(10) * 60.0).tolist() == []
    assert gap_rows(np.array([5.0])).tolist() == []


def warm(rows=400, step=0.0625, seed=3):
    """Return a plate that is heated and cools, in steps of a converter."""
    noise = 0.02 * np.random.default_rng(seed).standard_normal(rows)
    return np.round((20 + 30 * np.sin(np.pi * np.arange(rows) / 100) ** 2 + noise) / step) * step


@pytest.mark.parametrize("code", [85.0, -127.0, 999.9, 2000.0, -242.02])
@pytest.mark.parametrize("rows", [slice(50, 51), slice(100, 139), slice(0, 7), slice(390, 400)])
def test_a_sensor_code_is_no_reading_in_however_many_rows(code, rows):
    values = warm()
    values[rows] = code
    kept, lines = drop_codes("t", values)
    assert np.flatnonzero(np.isnan(kept)).tolist() == [*range(400)[rows]]
    assert f"of {code:g} left empty, no reading" in lines[0]
    values[rows] = round(code, 1)  # as a logger of tenths has it
    assert np.isnan(drop_codes("t", np.round(values, 1))[0][rows]).all()


@pytest.mark.parametrize("step", [0.0625, 0.5, 1.0])
def test_a_kettle_that_passes_85_degc_and_what_counts_past_a_code_lose_nothing(step):
    course = np.concatenate([np.linspace(20, 85, 200), np.full(50, 85.0), np.linspace(85, 100, 50)])
    kept, lines = drop_codes("kettle", np.round(course / step) * step)
    assert lines == []
    assert np.isfinite(kept).all()
    assert drop_codes("grasp", np.repeat(np.arange(80.0, 90.0), 40))[1] == []
    assert drop_codes("level", np.repeat([20.0, 85.0, 50.0, 85.0], 40))[1] == []


def test_a_reading_that_stands_still_while_the_heater_swings_is_stuck_and_the_sound_part_stays():
    heater = np.repeat([0.0, 100.0] * 10, 20)
    stuck = warm()
    stuck[200:] = stuck[199]
    kept, lines = drop_stuck("t", stuck, [heater])
    assert np.isnan(kept[201:]).all()
    assert np.isfinite(kept[:199]).all()
    assert "stuck at " in lines[0]
    resting = np.r_[np.zeros(3), warm()[:237] - 20, np.zeros(160)]  # as a drive that no name shows
    noise, drive = np.random.default_rng(5).standard_normal((2, 400))
    cools = np.round(np.where(np.arange(400) < 300, noise, -999 * np.exp(-np.arange(400) / 100)), 1)
    for healthy, moved in ((warm(), heater), (warm(step=2.0), heater), (resting, heater), (cools, drive)):
        assert drop_stuck("t", healthy, [moved]) == (pytest.approx(healthy), [])
    kept, lines = drop_stuck("t", np.r_[warm()[:240], np.full(160, warm()[239])], [heater])  # seven moves
    assert np.isnan(kept[241:]).all()
    still = np.full(400, 23.5)
    assert np.isnan(drop_stuck("t", still, [heater])[0]).all()
    assert drop_stuck("t", still, [np.r_[np.zeros(200), np.ones(200)]])[1] == []  # one step shows no answer
    idle = np.r_[1.0, 0.02 * np.random.default_rng(0).standard_normal(399)]  # nothing that a coarse one shows
    assert drop_stuck("t", np.repeat((np.arange(15.0) + 2) % 3, [10] * 14 + [260]), [idle])[1] == []
