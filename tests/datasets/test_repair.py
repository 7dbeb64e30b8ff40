"""What is mended in a log, what is left alone, and that it is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.repair import (
    check_plausible,
    describe_gaps,
    describe_steps,
    drop_repeated,
    fill_disturbance,
    fill_input,
    find_spikes,
    gap_rows,
    reject_spikes,
)

RNG = np.random.default_rng(3)


def quantised(values):
    return np.round((values + 0.05 * RNG.standard_normal(values.size)) * 16) / 16


def test_one_loose_plug_is_one_spike():
    values = quantised(30 + np.sin(np.arange(500) / 40))
    values[[100, 300]] = 127.9, -3.5
    assert np.flatnonzero(find_spikes(values, floor=0.6)).tolist() == [100, 300]


@pytest.mark.parametrize("length", [1, 2, 3])
def test_a_run_of_up_to_three_samples_is_a_spike(length):
    values = np.full(100, 25.0)
    values[50 : 50 + length] = 60.0
    assert find_spikes(values, floor=0.6).sum() == length


def test_a_longer_visit_is_not_a_spike():
    values = np.full(100, 25.0)
    values[50:54] = 60.0
    assert not find_spikes(values, floor=0.6).any()


def test_a_spike_beside_lost_samples_is_found():
    values = np.full(100, 25.0)
    values[49], values[50], values[51] = np.nan, 90.0, np.nan
    assert np.flatnonzero(find_spikes(values, floor=0.6)).tolist() == [50]


def test_a_step_stays_whole():
    values = np.where(np.arange(200) < 100, 20.0, 45.0)
    assert not find_spikes(values, floor=0.6).any()
    assert not find_spikes(quantised(values), floor=0.6).any()


@pytest.mark.parametrize("way_in", [50.0, 90.0625])
def test_the_first_sample_of_a_longer_visit_is_not_a_spike(way_in):
    values = np.full(100, 20.0)
    values[50], values[51:57] = way_in, 90.0
    assert not find_spikes(values, floor=0.6).any()


@pytest.mark.parametrize("slope", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("half", [3, 8, 30])
def test_the_tips_of_a_triangle_stay(slope, half):
    values = slope * np.abs((np.arange(400) % (2 * half)) - half)
    assert not find_spikes(values, floor=0.6).any()


def test_a_lively_stretch_of_a_quiet_log_stays():
    burst = 2.0 * np.abs((np.arange(120) % 8) - 4)
    values = np.concatenate([np.full(300, 20.0), 20 + burst, np.full(300, 20.0)])
    assert not find_spikes(values, floor=0.6).any()
    values[361] += 60.0
    assert np.flatnonzero(find_spikes(values, floor=0.6)).tolist() == [361]


def test_the_jump_of_a_touch_stays():
    t = np.arange(200) * 0.1
    values = np.where(t < 5, 23.0, 23.0 + 12 * (1 - np.exp(-np.maximum(t - 5, 0) / 0.3)))
    assert not find_spikes(values, floor=0.6).any()


def test_without_a_floor_the_rule_scales_with_the_channel():
    values = np.sin(np.arange(600) / 50)
    values[200] += 0.9
    small, large = find_spikes(1e-3 * values, floor=None), find_spikes(1e3 * values, floor=None)
    assert np.flatnonzero(small).tolist() == np.flatnonzero(large).tolist() == [200]


def test_a_noisy_channel_raises_its_own_threshold():
    values = 30 + 0.5 * RNG.standard_normal(2000)
    assert find_spikes(values, floor=0.6).sum() <= 2


def test_a_spike_stands_out_from_what_the_channel_does_within_the_window():
    # over a whole period the median is 0 and |sin| has the median sin(pi/4), so the threshold is
    # 6 * 1.4826 * 0.7071 = 6.29 amplitudes; the wave itself moves by 0.31 of one beside the spike
    wave = np.sin(2 * np.pi * np.arange(400) / 20)
    for size, found in ((5.9, []), (6.9, [200])):
        values = wave.copy()
        values[200] += size
        assert np.flatnonzero(find_spikes(values, floor=0.01)).tolist() == found


def test_without_a_floor_a_spike_is_two_per_cent_of_the_range():
    for size, found in ((1.8, []), (2.2, [500])):
        values = 20 + np.arange(1000) / 10  # 2 % of its 1st to 99th percentile is 1.96
        values[500] += size
        assert np.flatnonzero(find_spikes(values, floor=None)).tolist() == found
        values[200] += 1000  # a spike is no part of the range
        assert np.flatnonzero(find_spikes(values, floor=None)).tolist() == [200, *found]


def test_without_a_floor_a_blip_of_a_few_steps_of_the_converter_stays():
    values = np.full(400, 20.0)
    values[100], values[200], values[300] = 20.32, 20 + 4 * 0.32, 20 + 6 * 0.32
    assert np.flatnonzero(find_spikes(values, floor=None)).tolist() == [300]


@pytest.mark.parametrize("length", [1, 2, 3])
def test_a_jump_at_either_end_may_be_a_step_and_stays(length):
    for rows in (np.s_[:length], np.s_[-length:]):
        values = np.full(100, 25.0)
        values[rows] = 60.0
        assert not find_spikes(values, floor=0.6).any()


def test_the_flicker_of_a_coarse_converter_stays():
    values = 20 + 0.32 * RNG.integers(0, 2, 1000)
    assert not find_spikes(values, floor=0.6).any()


@settings(max_examples=50)
@given(st.integers(12, 80), st.floats(5.0, 100.0), st.sampled_from([-1, 1]))
def test_what_is_rejected_is_lost_and_the_rest_is_untouched(at, size, sign):
    clean = 25 + np.sin(np.arange(100) / 15)
    values = clean.copy()
    values[at] += sign * size
    got, said = reject_spikes("t", values, np.arange(100.0), floor=0.6)
    assert np.isnan(got[at])
    np.testing.assert_array_equal(np.delete(got, at), np.delete(clean, at))
    assert "1 spike sample rejected" in said[0]
    again, said = reject_spikes("t", got, np.arange(100.0), floor=0.6)
    assert said == []
    np.testing.assert_array_equal(again, got)


def test_a_short_channel_has_no_spikes():
    assert not find_spikes(np.array([1.0, 90.0, 1.0]), floor=0.6).any()


def test_repeated_stamps_keep_their_first_row():
    time, lines = np.array([0.0, 1.0, 1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.arange(2, 11)
    keep, said = drop_repeated(time, lines, "a.csv")
    assert np.flatnonzero(~keep).tolist() == [2, 3]
    assert said == ["2 repeated time stamps dropped (rows 4, 5)"]


def test_time_that_runs_back_is_refused_with_its_row():
    with pytest.raises(UserError, match=r"a\.csv, row 4: time runs back from 2 s to 1 s"):
        drop_repeated(np.array([0.0, 2.0, 1.0]), np.array([2, 3, 4]), "a.csv")


def test_a_missing_time_is_refused_with_its_row():
    with pytest.raises(UserError, match="row 3"):
        drop_repeated(np.array([0.0, np.nan, 1.0]), np.array([2, 3, 4]), "a.csv")


def test_a_clock_that_is_too_coarse_is_refused():
    with pytest.raises(UserError, match="more digits"):
        drop_repeated(np.floor(np.arange(100) / 10), np.arange(100), "a.csv")


def test_even_stamps_are_not_worth_a_line_and_uneven_ones_are():
    assert describe_steps(np.arange(50) * 0.1) == []
    jitter = np.cumsum(0.2 + 0.03 * RNG.uniform(-1, 1, 100))
    assert "median step 0.2" in describe_steps(np.concatenate([jitter, jitter[-1] + [0.2]]))[0]


def test_a_gap_is_longer_than_ten_seconds_and_five_steps():
    assert gap_rows(np.array([0.0, 1.0, 2.0, 11.9, 12.9])).tolist() == []
    assert gap_rows(np.array([0.0, 1.0, 2.0, 12.1, 13.1])).tolist() == [2]
    assert gap_rows(np.arange(10) * 60.0).tolist() == []
    assert gap_rows(np.array([5.0])).tolist() == []


def test_a_gap_is_said_with_the_inputs_around_it():
    said = describe_gaps(np.array([0.0, 1.0, 2.0, 40.0]), {"drive": np.array([0.0, 0.0, -0.04, -0.96])})
    assert said == ["gap of 38.00 s from 2.00 to 40.00 s (drive -0.04 before, -0.96 after)"]


def test_an_input_is_held_and_never_taken_from_later():
    values, said = fill_input("drive", np.array([np.nan, 0.5, np.nan, np.nan, 0.7]))
    np.testing.assert_array_equal(values, [np.nan, 0.5, 0.5, 0.5, 0.7])
    assert "3 lost values held" in said[0]


def test_a_disturbance_is_interpolated_in_time():
    values, said = fill_disturbance("room", np.array([20.0, np.nan, 23.0]), np.array([0.0, 1.0, 3.0]))
    np.testing.assert_allclose(values, [20.0, 21.0, 23.0])
    assert "1 lost value interpolated" in said[0]


def test_temperatures_in_the_wrong_unit_are_noticed():
    assert "t_tank_K" in check_plausible("t_tank", np.full(3, 298.0), "a.csv")[0]
    assert "kelvin" in check_plausible("t_tank", np.full(3, 25.0 - 273.15), "a.csv")[0]
    assert check_plausible("t_tank", np.full(3, 25.0), "a.csv") == []
    with pytest.raises(UserError, match="absolute zero"):
        check_plausible("t_tank", np.full(3, -300.0), "a.csv")


@pytest.mark.parametrize("celsius", [-80.0, 0.0, 200.0, 400.0])
def test_a_freezer_and_an_oven_are_no_mistake(celsius):
    assert check_plausible("t_tank", np.full(3, celsius), "a.csv") == []


@pytest.mark.parametrize("room", [0.0, 25.0, 60.0])
def test_a_laboratory_is_noticed_with_kelvin_added_and_taken_off(room):
    assert "is kelvin" in check_plausible("t_tank", np.full(3, room + 273.15), "a.csv")[0]
    assert "in kelvin" in check_plausible("t_tank", np.full(3, room - 273.15), "a.csv")[0]


def test_spikes_close_to_each_other_are_all_found():
    values = quantised(30 + np.sin(np.arange(200) / 20))
    values[[100, 103, 108]] = 90.0, -10.0, 127.9
    assert np.flatnonzero(find_spikes(values, floor=0.6)).tolist() == [100, 103, 108]
