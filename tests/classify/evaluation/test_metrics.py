"""Scores against hand calculations and independent implementations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest
from sklearn.metrics import brier_score_loss, roc_auc_score
from sklearn.metrics import log_loss as sklearn_log_loss

from thermogrip.classify.evaluation import metrics as s


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_clopper_pearson_is_scipys_exact_interval(k_n: tuple[int, int]) -> None:
    k, n = k_n
    low, high = binomtest(k, n).proportion_ci(0.95, method="exact")
    np.testing.assert_allclose(s.clopper_pearson(k, n), (low, high), atol=1e-9)


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(3, 3, 0.29, 1.0), (2, 3, 0.09, 0.99), (5, 5, 0.48, 1.0), (2, 5, 0.05, 0.85)],
)
def test_the_papers_counts_have_these_intervals(k: int, n: int, low: float, high: float) -> None:
    np.testing.assert_allclose(s.clopper_pearson(k, n), (low, high), atol=0.005)


def test_clopper_pearson_covers_at_least_its_level() -> None:
    for p in (0.05, 0.3, 0.83, 0.99):
        k = np.arange(16)
        inside = [s.clopper_pearson(int(i), 15)[0] <= p <= s.clopper_pearson(int(i), 15)[1] for i in k]
        mass = [math.comb(15, int(i)) * p ** int(i) * (1 - p) ** (15 - int(i)) for i in k]
        assert np.dot(inside, mass) >= 0.95


def test_a_count_outside_its_range_is_refused() -> None:
    with pytest.raises(ValueError, match="0 <= k <= n"):
        s.clopper_pearson(4, 3)


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
    assert s.expected_calibration_error(confidence, correct) == pytest.approx(expected)


def test_a_calibrated_forecast_has_a_small_calibration_error() -> None:
    rng = np.random.default_rng(0)
    c = rng.uniform(0.3, 1.0, 20_000)
    right = rng.uniform(size=c.size) < c
    assert s.expected_calibration_error(c, right) < 0.02
    assert s.expected_calibration_error(c, rng.uniform(size=c.size) < c - 0.2) == pytest.approx(0.2, abs=0.02)


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


def test_the_cluster_bootstrap_has_the_standard_error_of_independent_grasps() -> None:
    v = np.random.default_rng(2).normal(0.7, 0.2, 80)
    low, high = s.cluster_bootstrap(v, draws=4000)
    half = 1.96 * v.std() / np.sqrt(80)
    assert (high - low) / 2 == pytest.approx(half, rel=0.1)
    assert (high + low) / 2 == pytest.approx(v.mean(), abs=0.1 * half)


@given(
    st.lists(st.integers(0, 9), min_size=1, max_size=20), st.lists(st.integers(0, 9), min_size=1, max_size=20)
)
def test_auroc_is_scikit_learns(low: list[int], high: list[int]) -> None:
    expected = roc_auc_score([0] * len(low) + [1] * len(high), low + high)
    assert s.auroc(low, high) == pytest.approx(expected)
