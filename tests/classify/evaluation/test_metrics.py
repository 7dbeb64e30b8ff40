"""Scores against independent implementations; intervals over grasps cover the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, bootstrap
from sklearn.metrics import brier_score_loss, roc_auc_score
from sklearn.metrics import log_loss as sklearn_log_loss

from thermogrip.classify.evaluation import metrics as s
from thermogrip.classify.evaluation.metrics import calibration_interval, grasp_counts, mean_intervals


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_clopper_pearson_is_scipys_exact_interval(k_n: tuple[int, int]) -> None:
    k, n = k_n
    low, high = binomtest(k, n).proportion_ci(0.95, method="exact")
    np.testing.assert_allclose(s.clopper_pearson(k, n), (low, high), atol=1e-9)
    with pytest.raises(ValueError, match="0 <= k <= n"):
        s.clopper_pearson(n + 1, n)


def test_log_loss_and_brier_by_hand_and_by_scikit_learn() -> None:
    p = np.array([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8], [0.3, 0.4, 0.3]])
    true = [0, 2, 0]
    np.testing.assert_allclose(s.log_loss(p, true), [-math.log(0.7), -math.log(0.8), -math.log(0.3)])
    np.testing.assert_allclose(s.brier(p, true), [0.09 + 0.04 + 0.01, 0.01 + 0.01 + 0.04, 0.49 + 0.16 + 0.09])
    assert s.log_loss(p, true).mean() == pytest.approx(sklearn_log_loss(true, p, labels=[0, 1, 2]))
    assert s.brier([[0.3, 0.7]], [1])[0] == pytest.approx(2 * brier_score_loss([1], [0.7]))


def test_a_certain_mistake_costs_much_but_not_everything() -> None:
    assert s.log_loss([[0.0, 1.0]], [0])[0] == pytest.approx(34.5, abs=0.1)


def test_calibration_by_hand() -> None:
    confidence, correct = [0.55, 0.58, 0.95, 0.99, 0.93, 0.97], [1, 0, 1, 1, 1, 0]
    low, high = s.calibration_bins(confidence, correct)
    assert (low.n, low.accuracy, high.n, high.accuracy) == (2, 0.5, 4, 0.75)
    assert (low.confidence, high.confidence) == (pytest.approx(0.565), pytest.approx(0.96))
    expected = (2 * 0.065 + 4 * 0.21) / 6
    found = s.calibration_interval(confidence, correct, np.arange(6), draws=20)
    assert found.value == pytest.approx(expected)


def test_mcnemar_by_hand() -> None:
    first = np.array([1] * 8 + [0] * 2 + [1] * 5, dtype=bool)
    second = np.array([0] * 8 + [1] * 2 + [1] * 5, dtype=bool)
    found = s.mcnemar(first, second)
    by_hand = 2 * (1 + 10 + 45) / 2**10  # two-sided: 0, 1 or 2 of 10
    assert (found.only_first, found.only_second) == (8, 2)
    assert found.p_value == pytest.approx(by_hand)
    assert found.p_value == pytest.approx(binomtest(8, 10).pvalue)


def test_classifiers_that_never_differ_have_p_one() -> None:
    assert s.mcnemar([1, 0, 1], [1, 0, 1]) == (0, 0, 1.0)
    with pytest.raises(ValueError, match="tested on 3 and 2 grasps"):
        s.mcnemar([1, 0, 1], [1, 0])


def test_sign_flips_of_whole_disagreements_are_mcnemar() -> None:
    first, second = np.array([1, 1, 1, 1, 1, 1, 0, 1]), np.array([0, 0, 0, 0, 0, 1, 1, 1])
    assert s.sign_flip_p(first - second) == pytest.approx(s.mcnemar(first, second).p_value)


def test_drawn_sign_flips_count_what_was_seen_as_one_of_the_draws() -> None:
    assert s.sign_flip_p(np.ones(40), draws=999) == 1 / 1000  # of 2**40 patterns two are as far out


def test_the_drawn_sign_flips_agree_with_all_of_them() -> None:
    d = np.random.default_rng(1).normal(0.25, 1.0, 14)
    exact = s.sign_flip_p(d)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(50_000, 14))
    assert exact == pytest.approx(np.mean(abs(signs @ d) >= abs(d.sum()) - 1e-12), abs=0.01)
    many = np.concatenate([d, 1e-9 * np.ones(6)])  # too many to enumerate, the same question
    assert s.sign_flip_p(many) == pytest.approx(exact, abs=0.015)


@given(
    st.lists(st.integers(0, 9), min_size=1, max_size=20), st.lists(st.integers(0, 9), min_size=1, max_size=20)
)
def test_auroc_is_scikit_learns(low: list[int], high: list[int]) -> None:
    expected = roc_auc_score([0] * len(low) + [1] * len(high), low + high)
    assert s.auroc(low, high) == pytest.approx(expected)


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


# many draws leave an end uncertain by less than 0.01 of the width
@pytest.mark.parametrize(("shape", "n", "draws"), [(0.7, 60, 20_000), (0.3, 12, 60_000)])
def test_the_interval_of_a_skewed_mean_is_scipys(shape: float, n: int, draws: int) -> None:
    v = np.random.default_rng(3).gamma(shape, size=n)
    [mine] = mean_intervals(v[:, None], np.arange(n), draws=draws)
    other = bootstrap((v,), np.mean, n_resamples=draws, method="BCa", rng=np.random.default_rng(1))
    low, high = other.confidence_interval
    np.testing.assert_allclose([mine.low, mine.high], [low, high], atol=0.03 * (high - low))


def test_an_interval_moves_with_its_values_and_turns_over_with_them() -> None:
    rng = np.random.default_rng(4)
    of = np.repeat(np.arange(20), rng.integers(1, 6, 20))  # some grasps are tested more often than others
    v = rng.gamma(0.5, size=of.size)
    plain, moved, turned = mean_intervals(np.column_stack([v, v + 10.0, 3.0 - 2.0 * v]), of)
    assert moved == pytest.approx([end + 10.0 for end in plain])
    value, low, high = plain
    assert turned == pytest.approx((3.0 - 2.0 * value, 3.0 - 2.0 * high, 3.0 - 2.0 * low), rel=1e-3)


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


@pytest.mark.slow
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


def test_calibrated_forecasters_show_the_predicted_error_and_are_not_accused() -> None:
    rng = np.random.default_rng(4)
    value, predicted, p = [], [], []
    for k in range(SIMULATED):
        c = rng.uniform(0.4, 1.0, 40)
        found = calibration_interval(c, rng.uniform(size=40) < c, np.arange(40), draws=50, seed=k)
        value.append(found.value)
        predicted.append(found.if_calibrated)
        p.append(found.p_value)
    error = 4 * np.std(value) / np.sqrt(SIMULATED)
    assert np.mean(predicted) == pytest.approx(np.mean(value), abs=error)
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


def test_grasps_that_all_say_the_same_leave_a_point() -> None:
    [found] = mean_intervals(np.ones((9, 1)), np.arange(9))
    assert found == (1.0, 1.0, 1.0)
