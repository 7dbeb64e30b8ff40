"""Intervals over grasps hold the truth as often as they say; chance is not taken for a calibration error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import bootstrap, norm

from thermogrip.classify.evaluation.metrics import (
    _bca,
    calibration_interval,
    expected_calibration_error,
    grasp_counts,
    mean_intervals,
)

SIMULATED = 400
# of 400 intervals that hold the truth with probability 0.95, at least this many do, but for 1 run in 1000
LEAST_HELD = 0.95 - 3.1 * np.sqrt(0.95 * 0.05 / SIMULATED)


def _tests(rng: np.random.Generator, m: int, rounds: int) -> np.ndarray:
    """Return which grasp is tested in each of the random rounds that hold out three eighths of them."""
    return np.concatenate([rng.permutation(m)[: 3 * m // 8] for _ in range(rounds)])


def test_draws_are_of_whole_grasps() -> None:
    counts = grasp_counts(12, draws=50)
    assert (counts.sum(axis=1) == 12).all()
    assert counts.std() == pytest.approx(np.sqrt(11 / 12), rel=0.1)


def test_the_interval_of_a_mean_is_scipys() -> None:
    v = np.random.default_rng(0).gamma(0.7, size=60)
    [mine] = mean_intervals(v[:, None], np.arange(60), draws=20_000)
    other = bootstrap((v,), np.mean, n_resamples=20_000, method="BCa", rng=np.random.default_rng(1))
    width = other.confidence_interval.high - other.confidence_interval.low
    # 20 000 draws leave an end uncertain by about 0.006 of the width
    assert mine.low == pytest.approx(other.confidence_interval.low, abs=0.03 * width)
    assert mine.high == pytest.approx(other.confidence_interval.high, abs=0.03 * width)


def test_the_interval_of_a_very_skewed_mean_of_few_grasps_is_scipys() -> None:
    v = np.random.default_rng(3).gamma(0.3, size=12)
    [mine] = mean_intervals(v[:, None], np.arange(12), draws=60_000)
    other = bootstrap((v,), np.mean, n_resamples=60_000, method="BCa", rng=np.random.default_rng(1))
    width = other.confidence_interval.high - other.confidence_interval.low
    assert mine.low == pytest.approx(other.confidence_interval.low, abs=0.015 * width)
    assert mine.high == pytest.approx(other.confidence_interval.high, abs=0.015 * width)


def test_an_interval_moves_with_its_values_and_turns_over_with_them() -> None:
    rng = np.random.default_rng(4)
    of = np.repeat(np.arange(20), rng.integers(1, 6, 20))  # some grasps are tested more often than others
    v = rng.gamma(0.5, size=of.size)
    plain, moved, turned = mean_intervals(np.column_stack([v, v + 10.0, 3.0 - 2.0 * v]), of)
    assert moved == pytest.approx([end + 10.0 for end in plain])
    value, low, high = plain
    assert turned == pytest.approx((3.0 - 2.0 * value, 3.0 - 2.0 * high, 3.0 - 2.0 * low), rel=1e-3)


def test_right_and_wrong_have_the_same_interval_turned_over() -> None:
    """Of nine grasps many draws have exactly the share that was found: half of them count as below it."""
    right = (np.arange(9) < 6).astype(float)
    yes, no = mean_intervals(np.column_stack([right, 1 - right]), np.arange(9))
    assert no == pytest.approx((1 - yes.value, 1 - yes.high, 1 - yes.low), abs=1e-12)


def test_intervals_of_repeated_tests_hold_the_mean_over_all_grasps() -> None:
    """Twenty rounds reuse 40 grasps; the truth is that of grasps never seen."""
    rng = np.random.default_rng(1)
    held = np.zeros(2)
    for k in range(SIMULATED):
        right = rng.uniform(size=40) < 0.8
        loss = rng.gamma(2.0, 0.2, size=40)
        of = _tests(rng, 40, 20)
        values = np.column_stack([right[of], loss[of] + 0.05 * rng.standard_normal(of.size)])
        for j, (found, truth) in enumerate(zip(mean_intervals(values, of, draws=500, seed=k), (0.8, 0.4))):
            held[j] += found.low <= truth <= found.high
    # forty grasps: the bootstrap's own error is of the order 1/40 (Efron's BCa is second-order)
    assert (held / SIMULATED > LEAST_HELD - 1 / 40).all()


def test_counting_tests_as_grasps_would_miss_the_truth() -> None:
    rng = np.random.default_rng(2)
    of = _tests(rng, 40, 20)
    right = (rng.uniform(size=40) < 0.8)[of].astype(float)[:, None]
    [grasps] = mean_intervals(right, of)
    [tests] = mean_intervals(right, np.arange(of.size))
    assert grasps.high - grasps.low > 2 * (tests.high - tests.low)


@pytest.mark.parametrize("boast", [0.0, 0.1, 0.25])
def test_the_interval_of_the_calibration_error_holds_the_truth(boast: float) -> None:
    rng = np.random.default_rng(3)
    held, plain = 0, []
    for k in range(SIMULATED):
        c = rng.uniform(0.4, 1.0, 60)
        right = rng.uniform(size=60) < c - boast
        found = calibration_interval(c, right, np.arange(60), draws=300, seed=k)
        held += found.low <= boast <= found.high  # the gap is the boast in every bin
        plain.append(found.value)
    assert held / SIMULATED > LEAST_HELD
    # what one reads is too large, most where chance can turn the sign of a bin's gap
    assert np.mean(plain) > boast + {0.0: 0.05, 0.1: 0.02, 0.25: 0.0}[boast]


@pytest.mark.parametrize("wrong", [3, 37])
def test_in_one_bin_the_ends_are_those_of_the_reversed_draws(wrong: int) -> None:
    """There the error is the size of one mean gap: boasting where most are wrong, modest where few are."""
    c, right = np.full(40, 0.75), np.arange(40) >= wrong
    found = calibration_interval(c, right, np.arange(40), level=0.9, draws=500, seed=3)
    gap = c - right
    drawn = np.sign(gap.mean()) * grasp_counts(40, draws=500, seed=3) @ gap / 40
    assert found.value == pytest.approx(abs(gap.mean()))
    assert found.high == pytest.approx(2 * found.value - np.quantile(drawn, 0.05))
    assert found.low == pytest.approx(found.value - np.quantile(np.abs(drawn - found.value), 0.95))


def test_calibrated_forecasters_show_what_is_foretold_and_are_not_accused() -> None:
    rng = np.random.default_rng(4)
    value, foretold, p = [], [], []
    for k in range(SIMULATED):
        c = rng.uniform(0.4, 1.0, 40)
        found = calibration_interval(c, rng.uniform(size=40) < c, np.arange(40), draws=50, seed=k)
        value.append(found.value)
        foretold.append(found.if_calibrated)
        p.append(found.p_value)
    error = 4 * np.std(value) / np.sqrt(SIMULATED)
    assert np.mean(foretold) == pytest.approx(np.mean(value), abs=error)
    # a p-value of a true hypothesis is uniform: 20 of 400 below 0.05, spread 4.4
    assert 5 < np.sum(np.array(p) < 0.05) < 36


def test_tests_of_one_grasp_are_not_new_evidence() -> None:
    rng = np.random.default_rng(5)
    c = rng.uniform(0.4, 1.0, 30)
    right = rng.uniform(size=30) < c
    once = calibration_interval(c, right, np.arange(30))
    twenty = calibration_interval(np.tile(c, 20), np.tile(right, 20), np.tile(np.arange(30), 20))
    assert twenty == pytest.approx(once)
    loss = rng.gamma(0.5, size=30)[:, None]
    [once] = mean_intervals(loss, np.arange(30))
    [twenty] = mean_intervals(np.tile(loss, (20, 1)), np.tile(np.arange(30), 20))
    assert twenty == pytest.approx(once)


def test_a_boast_is_found_out() -> None:
    rng = np.random.default_rng(6)
    c = rng.uniform(0.8, 1.0, 200)
    found = calibration_interval(c, rng.uniform(size=200) < c - 0.3, np.arange(200))
    assert found.low > 0.1
    assert found.p_value < 0.002
    assert found.if_calibrated < 0.05


@given(st.lists(st.tuples(st.floats(0.2, 1.0), st.booleans()), min_size=3, max_size=30))
def test_the_value_is_the_expected_calibration_error(rows: list[tuple[float, bool]]) -> None:
    c, right = (np.array(column) for column in zip(*rows))
    found = calibration_interval(c, right, np.arange(c.size) // 2, draws=20)
    assert found.value == pytest.approx(expected_calibration_error(c, right))
    assert 0 <= found.low <= found.value <= found.high <= 1


def test_grasps_that_all_say_the_same_leave_a_point() -> None:
    [found] = mean_intervals(np.ones((9, 1)), np.arange(9))
    assert found == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_draws_all_on_one_side_of_the_value_count_as_all_but_one_in_a_thousand(sign: float) -> None:
    """The median bias of the draws is at most that: a share of 0 or 1 would shift the interval infinitely."""
    ends = []
    for below in (0, 1, 2):
        draws = np.linspace(0.0, 1.0, 1000)
        draws[:below] = -1e-6
        ends.append(_bca(sign * draws, sign * -1e-9, np.array([1.0, -1.0]), 1 - 1e-6))
    none, one, two = (max(abs(low), abs(high)) for low, high in ends)
    # at this level the far end is the 10 % quantile, not the least draw: 2 ppf(0.001) + 4.89 = -1.29
    assert none == pytest.approx(norm.cdf(2 * norm.ppf(1e-3) - norm.ppf(5e-7)), abs=0.002)
    assert none == pytest.approx(one, abs=1e-9)
    assert two > one + 0.01
