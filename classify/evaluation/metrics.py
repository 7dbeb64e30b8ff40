r"""Scores of predictions, each with the interval that its sample size allows.

- **Log loss** :math:`-\ln p_{true}` and **Brier** :math:`\sum_k (p_k - y_k)^2` score probabilities.
- **Calibration**: confidence beside accuracy in bins; their mean absolute gap, weighted by bin, is the ECE;
  beside it what a perfectly calibrated forecaster of the same confidences would show.
- **Intervals** are over grasps: whole grasps are drawn anew, each with all of its tests.
- **Two classifiers on the same grasps**: exact McNemar; for repeated splits a sign-flip test on each grasp's
  mean difference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv
from scipy.stats import binom, norm, rankdata

Floats = NDArray[np.float64]

_LEAST_PROBABILITY = 1e-15  # a class that was never expected costs 35 nats, and no mean is infinite


class Bin(NamedTuple):
    """Grasps whose confidence is in (low, high]: their number, mean confidence and accuracy."""

    low: float
    high: float
    n: int
    confidence: float
    accuracy: float


class McNemar(NamedTuple):
    """Grasps that only the first, only the second classifier has right, and the two-sided exact p-value."""

    only_first: int
    only_second: int
    p_value: float


def clopper_pearson(k: float, n: int, *, level: float = 0.95) -> tuple[float, float]:
    """Return the exact binomial interval of k right of n; a mean over repeated tests of n distinct grasps is
    a fractional k."""
    if n < 1 or not -1e-9 <= k <= n + 1e-9:
        raise ValueError(f"need 0 <= k <= n and n >= 1, got {k=}, {n=}")
    # The interval covers at least the stated share whatever the truth.  Repeated random splits test the same
    # few grasps again and again: with c_i the share of its test rounds in which grasp i was right, the mean p
    # of m grasps has variance var(c_i) / m <= p (1 - p) / m, so that n = m distinct grasps and k = m p, which
    # need not be whole, are conservative, and do not collapse to a point where all were right.
    k = min(max(k, 0.0), float(n))
    tail = (1 - level) / 2
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    return low, high


def log_loss(p: ArrayLike, true: ArrayLike) -> Floats:
    """Return -ln p of the true class, shape (n,); ``p`` (n, K), ``true`` (n,) column numbers."""
    rows = np.asarray(p, dtype=float)
    p_true = rows[np.arange(rows.shape[0]), np.asarray(true, dtype=int)]
    return np.asarray(-np.log(np.maximum(p_true, _LEAST_PROBABILITY)))


def brier(p: ArrayLike, true: ArrayLike) -> Floats:
    """Return the squared distance of each row of p to the truth, shape (n,); 0 is perfect, 2 is worst."""
    rows = np.asarray(p, dtype=float)
    truth = np.eye(rows.shape[1])[np.asarray(true, dtype=int)]
    return np.asarray(np.sum((rows - truth) ** 2, axis=1))


def calibration_bins(confidence: ArrayLike, correct: ArrayLike) -> list[Bin]:
    """Return confidence beside accuracy in bins of confidence of 0.1; empty bins are left out."""
    c, ok = np.asarray(confidence, dtype=float), np.asarray(correct, dtype=float)
    of = _bin_of(c)
    return [
        Bin(
            low=float(_CALIBRATION_EDGES[b]),
            high=float(_CALIBRATION_EDGES[b + 1]),
            n=int((of == b).sum()),
            confidence=float(c[of == b].mean()),
            accuracy=float(ok[of == b].mean()),
        )
        for b in np.unique(of)
    ]


def mcnemar(first: ArrayLike, second: ArrayLike) -> McNemar:
    """Return the exact McNemar test of two classifiers on the same grasps."""
    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ValueError(f"the classifiers were tested on {a.size} and {b.size} grasps")
    only_a, only_b = int(np.sum(a & ~b)), int(np.sum(~a & b))
    tail = float(binom.cdf(min(only_a, only_b), only_a + only_b, 0.5)) if only_a + only_b else 0.5
    return McNemar(only_a, only_b, min(1.0, 2 * tail))


def sign_flip_p(difference: ArrayLike, *, draws: int = 20_000, seed: int = 0) -> float:
    """Return the two-sided p-value of a mean difference, by flipping the sign of each grasp's."""
    d = np.asarray(difference, dtype=float)
    d = d[d != 0]
    if d.size == 0:
        return 1.0
    if d.size <= 14:  # all sign patterns
        signs = 1.0 - 2.0 * ((np.arange(2**d.size)[:, None] >> np.arange(d.size)) & 1)
        return float(np.mean(np.abs(signs @ d) >= abs(d.sum()) - 1e-12))
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(draws, d.size))
    hits = int(np.sum(np.abs(signs @ d) >= abs(d.sum()) - 1e-12))
    return (hits + 1) / (draws + 1)  # the observed pattern is one of them


def auroc(negative: ArrayLike, positive: ArrayLike) -> float:
    """Return the probability that a positive scores above a negative, equal scores counting half."""
    low, high = np.asarray(negative, dtype=float), np.asarray(positive, dtype=float)
    ranks = rankdata(np.concatenate([low, high]))[low.size :]
    return float((ranks.sum() - high.size * (high.size + 1) / 2) / (low.size * high.size))


_DRAWS = 2000  # of whole grasps, for an interval
_FORECASTERS = 1000  # perfectly calibrated ones, whose ECE is compared
_N_BINS = 10  # of confidence
_CALIBRATION_EDGES = np.linspace(0, 1, _N_BINS + 1)


class Interval(NamedTuple):
    """A mean over tests and its interval over grasps, NaN where one grasp has none."""

    value: float
    low: float
    high: float


class CalibrationError(NamedTuple):
    """ECE with its interval, the mean ECE of calibrated forecasters, and the share of them that show more."""

    value: float
    low: float
    high: float
    if_calibrated: float
    p_value: float


def grasp_counts(n_grasp: int, *, draws: int = _DRAWS, seed: int = 0) -> Floats:
    """Return how often each grasp is in each draw, shape (draws, n_grasp); rows sum to ``n_grasp``."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.multinomial(n_grasp, np.full(n_grasp, 1 / n_grasp), size=draws), dtype=float)


def mean_intervals(
    values: ArrayLike, grasp: ArrayLike, *, level: float = 0.95, draws: int = _DRAWS, seed: int = 0
) -> list[Interval]:
    """Return the mean of each column of ``values`` (n_test, k), with its BCa interval over grasps, which
    ``grasp`` (n_test,) counts from 0."""
    rows, of = np.asarray(values, dtype=float), np.asarray(grasp, dtype=int)
    sums, tests = _by_grasp(rows, of), np.bincount(of).astype(float)
    # The tests of one grasp in several splits agree with each other more than with those of other grasps, so
    # what is drawn with replacement is the grasp with all its tests: with the sum S_i of a score over the R_i
    # tests of grasp i, and multinomial counts w, a draw is sum w_i S_i / sum w_i R_i.
    counts = grasp_counts(tests.size, draws=draws, seed=seed)
    means = (counts @ sums) / (counts @ tests)[:, None]
    value = rows.mean(axis=0)
    if tests.size < 2:  # one grasp shows nothing of how grasps differ
        return [Interval(float(v), np.nan, np.nan) for v in value]
    influence = sums - value * tests[:, None]
    return [
        Interval(float(value[k]), *_bca(means[:, k], float(value[k]), influence[:, k], level))
        for k in range(rows.shape[1])
    ]


def calibration_interval(
    confidence: ArrayLike,
    correct: ArrayLike,
    grasp: ArrayLike,
    *,
    level: float = 0.95,
    draws: int = _DRAWS,
    seed: int = 0,
) -> CalibrationError:
    """Return the expected calibration error over bins of 0.1, with interval and what chance alone shows, of
    tests whose grasps are counted from 0."""
    c, of = np.asarray(confidence, dtype=float), np.asarray(grasp, dtype=int)
    right = np.asarray(correct, dtype=float)
    bins = np.eye(_CALIBRATION_EDGES.size - 1)[_bin_of(c)]  # (n, 10), one in each row
    tests = np.bincount(of).astype(float)
    gaps = _by_grasp(bins * (c - right)[:, None], of)
    mean_gaps = gaps.sum(axis=0) / c.size
    value = float(np.abs(mean_gaps).sum())
    chance = _ece_of_calibrated(c, of, bins, tests.size, seed)
    p = (1 + int(np.sum(chance >= value - 1e-12))) / (1 + chance.size)
    if tests.size < 2:
        return CalibrationError(value, np.nan, np.nan, float(chance.mean()), p)
    counts = grasp_counts(tests.size, draws=draws, seed=seed)
    # With the mean gaps D_b in bin b the ECE is sum |D_b|, biased upwards, as noise never cancels in an
    # absolute value, and the draws have the noise twice: their quantiles are no interval.  But
    #     found - true <= sum |found D_b - D_b|,   true - found <= sum s_b (D_b - found D_b),  s_b = sign D_b,
    # and the draws have the distribution of the right-hand sides, which hold no absolute value of a mean.
    off = (counts @ gaps) / (counts @ tests)[:, None] - mean_gaps
    tail = (1 + level) / 2
    low = value - float(np.quantile(np.abs(off).sum(axis=1), tail))
    high = value + float(np.quantile(-off @ np.sign(mean_gaps), tail))
    return CalibrationError(value, max(0.0, low), min(1.0, max(high, value)), float(chance.mean()), p)


def _by_grasp(rows: Floats, of: NDArray[np.int64]) -> Floats:
    """Return the sums of each column over the tests of each grasp, (m, k)."""
    return np.stack([np.bincount(of, weights=column) for column in rows.T], axis=1)


def _bca(draws: Floats, value: float, influence: Floats, level: float) -> tuple[float, float]:
    """Return the bias-corrected and accelerated interval; a point where all grasps are alike."""
    # Efron's (J. Am. Stat. Assoc. 82, 1987): quantiles of the draws, shifted for their median bias and their
    # skewness, which log losses have.  Of few grasps it covers less than stated.  Losses that no grasp showed
    # are in no draw: where none was wrong the upper end is too low, and the interval of the accuracy shows by
    # how much.
    power = float(np.sum(influence**2))
    if power < 1e-24:
        return value, value
    below = np.mean(draws < value) + 0.5 * np.mean(draws == value)
    shift = norm.ppf(np.clip(below, 1e-3, 1 - 1e-3))
    skew = float(np.sum(influence**3)) / (6 * power**1.5)
    z = shift + norm.ppf([(1 - level) / 2, (1 + level) / 2])
    low, high = np.quantile(draws, norm.cdf(shift + z / (1 - skew * z)))
    return float(low), float(high)


def _bin_of(confidence: Floats) -> NDArray[np.int64]:
    """Return which bin each confidence is in, (n,)."""
    return np.clip(
        np.searchsorted(_CALIBRATION_EDGES, confidence, side="left") - 1, 0, _CALIBRATION_EDGES.size - 2
    )


def _ece_of_calibrated(c: Floats, of: NDArray[np.int64], bins: Floats, m: int, seed: int) -> Floats:
    """Return the ECE of forecasters whose confidences are true, (n,)."""
    rng = np.random.default_rng(seed + 1)
    stated = c @ bins
    ece = np.empty(_FORECASTERS)
    # Each grasp draws one number and is right in all tests whose confidence exceeds it: to take the tests of
    # a grasp to be right or wrong together overstates the bias a little, on the cautious side.
    for start in range(0, _FORECASTERS, 100):  # a block at a time: a hundred by all tests
        right = (rng.random((100, m))[:, of] < c).astype(float)
        ece[start : start + 100] = np.abs(stated - right @ bins).sum(axis=1) / c.size
    return ece
