"""Cuts, gaps and averages."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.resample import average, cut, gaps, held_means
from thermogrip.datasets.schema import column, make_log


def made(time, drive, t_a=None):
    t_a = np.full(len(time), 20.0) if t_a is None else t_a
    return make_log(time, {"drive": (drive, "1", "input"), "t_a": (t_a, "degC", "output")})


@st.composite
def staircases(draw):
    steps = draw(st.lists(st.floats(0.05, 3.0), min_size=2, max_size=25))
    time = np.cumsum(steps)
    return made(time, draw(st.lists(st.floats(-1, 1), min_size=time.size, max_size=time.size)))


def brute_mean(time, values, a, b, n=20_001):
    """Mean of the staircase by the midpoint rule."""
    t = a + (b - a) * (np.arange(n) + 0.5) / n
    return values[np.clip(np.searchsorted(time, t, side="right") - 1, 0, None)].mean()


def means_of_drive(log, edges):
    return held_means(log["time"].values, column(log, "drive")[:, None], edges)


@settings(max_examples=50, deadline=None)
@given(staircases(), st.floats(-2, 2), st.lists(st.floats(0.1, 4.0), min_size=1, max_size=6))
def test_a_held_mean_is_the_integral_of_the_staircase(log, start, cells):
    edges = log["time"].values[0] + start + np.concatenate([[0], np.cumsum(cells)])
    got = means_of_drive(log, edges)
    assert got.shape == (len(cells), 1)
    for cell, (a, b) in enumerate(pairwise(edges)):
        want = brute_mean(log["time"].values, column(log, "drive"), a, b)
        assert got[cell, 0] == pytest.approx(want, abs=2 * 26 / 20_001)


def test_an_input_switched_inside_a_cell_counts_by_its_time():
    log = made([0.0, 0.25, 10.0], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(means_of_drive(log, np.array([0.0, 1.0, 2.0])).ravel(), [0.75, 1.0])


def test_a_cut_keeps_the_times_and_the_facts(small_log):
    part = cut(small_log, 1.0, 3.0)
    assert (part["time"].values >= 1.0).all()
    assert (part["time"].values < 3.0).all()
    assert part.attrs == small_log.attrs
    assert part["battery"].attrs == {"units": "V", "role": "other"}


def test_a_cut_leaves_two_rows_at_least():
    log = made([0.5, 1.5, 2.5, 4.0], [0] * 4)
    assert cut(log, 1.5, 4.0)["time"].values.tolist() == [1.5, 2.5]
    assert cut(log, stop=2.0).sizes["time"] == cut(log, start=2.0).sizes["time"] == 2
    said = r"log: the cut 1.5:2.5 s leaves 1 row\(s\); the log goes from 0.5 to 4 s"
    with pytest.raises(UserError, match=said):
        cut(log, 1.5, 2.5)


def test_blocks_start_anew_after_every_gap_and_the_last_row_is_held_for_a_step():
    time = np.r_[0:3:0.5, 20:22:0.5, 50.25:52.25:0.5]
    log = made(time, np.arange(14.0), np.arange(14.0) ** 2)
    got = average(log, 1.5)
    assert got["time"].values.tolist() == [0.0, 1.5, 20.0, 21.5, 50.25, 51.75]
    assert column(got, "drive").tolist() == [1.0, 4.0, 7.0, 9.0, 11.0, 13.0]
    np.testing.assert_allclose(column(got, "t_a"), [5 / 3, 50 / 3, 149 / 3, 81.0, 365 / 3, 169.0])
    assert (got.attrs["averaged_s"], got.attrs["after_gap"]) == (1.5, "20.0 50.25")
    assert gaps(got) == [(1, 1.5, 20.0), (3, 21.5, 50.25)]
    with pytest.raises(UserError, match="log: 1 block of 99 s is not a log; choose a shorter block"):
        average(made([0.0, 1.0, 2.0], [0, 1, 2]), 99.0)
    even = made(np.arange(4) * 0.1, [3.0, 1.0, 4.0, 1.0])
    assert "after_gap" not in average(even, 0.1).attrs  # as long as a step
    np.testing.assert_allclose(column(average(even, 0.1), "drive"), [3.0, 1.0, 4.0, 1.0], atol=1e-12)


def test_the_gap_of_the_example_is_found():
    log = read_log(example_path("prbs_heating_cooling"))
    ((at, before, after),) = gaps(log)
    assert (before, after) == (1129.942, 1168.643)
    assert log["time"].values[at] == before
    assert gaps(log, longer_than=60.0) == []
    assert gaps(read_log(example_path("multisine"))) == []


def test_output_blocks_are_means_of_what_is_there():
    log = made([0.0, 0.5, 1.0, 1.5, 2.0, 2.5], [0] * 6, [20, 21, np.nan, 23, np.nan, np.nan])
    got = average(log, 1.0)
    np.testing.assert_array_equal(got["time"].values, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(column(got, "t_a"), [20.5, 23.0, np.nan])


def test_a_disturbance_is_averaged_as_held_and_an_output_as_sampled():
    room, steps = [20.0, 24.0, 24.0, 24.0], [0.0, 0.2, 1.0, 2.0]
    log = make_log(steps, {"t_room": (room, "degC", "disturbance"), "t_a": (room, "degC", "output")})
    got = average(log, 1.0)
    assert column(got, "t_room")[0] == pytest.approx(0.2 * 20 + 0.8 * 24)
    assert column(got, "t_a")[0] == pytest.approx((20 + 24) / 2)


def test_a_block_length_that_is_no_multiple_of_the_step_keeps_the_integral():
    rng = np.random.default_rng(0)
    time = np.cumsum(0.2 + 0.05 * rng.uniform(-1, 1, 500))
    log = made(time, rng.uniform(-1, 1, 500))
    got = average(log, 1.7)
    edges = np.append(got["time"].values, time[-1] + np.median(np.diff(time)))
    want = means_of_drive(log, edges)[:, 0]
    np.testing.assert_allclose(column(got, "drive"), want, atol=1e-12)


@pytest.mark.parametrize("start", [0.0, 0.7, 1 / 3, 1129.942])
def test_rounding_does_not_move_a_row_into_the_block_before(start):
    time = start + np.arange(300) * 0.1  # in binary no two of these differ by 1 s exactly
    got = average(made(time, np.arange(300) // 10, np.arange(300) // 10), 1.0)
    np.testing.assert_array_equal(column(got, "t_a"), np.arange(30))
    np.testing.assert_allclose(column(got, "drive"), np.arange(30), atol=1e-6)


@pytest.mark.parametrize("seconds", [1.0, 5.0, 20.0, 60.0])
def test_no_block_mixes_both_sides_of_a_gap(seconds):
    log = read_log(example_path("prbs_heating_cooling"))
    got = average(log, seconds)
    ((at, before, after),) = gaps(got)
    assert before <= 1129.942 < before + seconds
    assert after == 1168.643
    drive = column(got, "drive")
    window = (log["time"].values >= before) & (log["time"].values <= 1129.942)
    assert drive[at] == pytest.approx(column(log, "drive")[window].mean(), abs=0.02)
    assert drive[at + 1] < -0.5  # -0.955 after the gap, and never the -0.044 before it


def test_the_gaps_of_an_averaged_log_are_not_lost_on_disk(tmp_path):
    got = average(read_log(example_path("prbs_heating_cooling")), 20.0)
    back = read_log(write_log(got, tmp_path / "a.nc"))
    assert gaps(back) == gaps(got)


def test_an_averaged_log_reports_it(small_log):
    said = average(small_log, 0.5).attrs["repairs"].splitlines()
    assert said == ["one line", "and another", "averaged over 0.5 s"]


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.01, "0.1 s apart"), (100.0, "is not a log"), (-1, "0.1 s")]
)
def test_blocks_that_cannot_be_are_refused(small_log, seconds, words):
    with pytest.raises(UserError, match=words):
        average(small_log, seconds)
