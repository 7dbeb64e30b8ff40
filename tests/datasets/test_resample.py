"""Cuts, gaps and averages."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import column, cut, gaps, make_log
from thermogrip.sysid.plant.log_grid import held_means
from thermogrip.sysid.validation.free_run import block_means


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


def test_the_gap_of_the_example_is_found():
    log = read_log(example_path("prbs_heating_cooling"))
    ((at, before, after),) = gaps(log)
    assert (before, after) == (1129.942, 1168.643)
    assert log["time"].values[at] == before
    assert gaps(read_log(example_path("multisine"))) == []


def blocks_of(time, reading, seconds):
    log = made(time, np.zeros(len(time)))
    starts, means = block_means(log, np.asarray(reading, dtype=float)[:, None], seconds)
    return starts, means[:, 0]


def test_blocks_start_anew_after_every_gap():
    time = np.r_[0:3:0.5, 20:22:0.5, 50.25:52.25:0.5]
    starts, means = blocks_of(time, np.arange(14.0) ** 2, 1.5)
    assert starts.tolist() == [0.0, 1.5, 20.0, 21.5, 50.25, 51.75]
    np.testing.assert_allclose(means, [5 / 3, 50 / 3, 149 / 3, 81.0, 365 / 3, 169.0])


def test_a_block_has_the_mean_of_the_samples_that_are_there():
    starts, means = blocks_of([0.0, 0.2, 1.0, 2.0], [20.0, 24, np.nan, 23], 1.0)
    assert starts.tolist() == [0.0, 1.0, 2.0]
    np.testing.assert_array_equal(means, [22.0, np.nan, 23.0])


@pytest.mark.parametrize("start", [0.0, 0.7, 1 / 3, 1129.942])
def test_rounding_does_not_move_a_row_into_the_block_before(start):
    time = start + np.arange(300) * 0.1  # in binary no two of these differ by 1 s exactly
    np.testing.assert_array_equal(blocks_of(time, np.arange(300) // 10, 1.0)[1], np.arange(30))


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.01, "0.1 s apart"), (100.0, "is not a log"), (-1, "0.1 s")]
)
def test_blocks_that_cannot_be_are_refused(seconds, words):
    time = np.arange(40) * 0.1
    with pytest.raises(UserError, match=words):
        blocks_of(time, time, seconds)
