r"""Scores of predictions, each with the interval that its sample size allows.

- **Accuracy** k/n: Clopper-Pearson, the interval that covers at least the stated share whatever the truth.
- **Repeated random splits** test the same few grasps again and again.  With :math:`c_i` the share of its test
  rounds in which grasp i was right, the mean :math:`\hat p` of m grasps has variance
  :math:`\mathrm{var}(c_i)/m \le \hat p (1 - \hat p) / m`: Clopper-Pearson with n = m distinct grasps (and k =
  m p, which need not be whole) is conservative, and does not collapse to a point where all were right.
- **Log loss** :math:`-\ln p_{true}` and **Brier** :math:`\sum_k (p_k - y_k)^2` judge probabilities.
- **Calibration**: confidence beside accuracy in bins; their mean absolute gap, weighted by bin, is the ECE.
- **Two classifiers on the same grasps**: exact McNemar (b and c grasps where only one was right; under the
  null b is
  Binomial(b + c, 1/2)); for repeated splits a sign-flip test on each grasp's mean difference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv
from scipy.stats import binom, rankdata

__all__ = [
    "Bin",
    "McNemar",
    "auroc",
    "brier",
    "calibration_bins",
    "clopper_pearson",
    "cluster_bootstrap",
    "expected_calibration_error",
    "log_loss",
    "mcnemar",
    "sign_flip_p",
]

Floats = NDArray[np.float64]

_LEAST_PROBABILITY = 1e-15


class Bin(NamedTuple):
    """Grasps whose confidence is in (low, high]: how many, their mean confidence and their accuracy."""

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
    """Return the exact binomial interval of k right of n.

    ``k`` may be fractional: a mean over repeated tests of n distinct grasps.

    Raises
    ------
    ValueError
        If k is not within 0...n, or n is not positive.

    Examples
    --------
    >>> low, high = clopper_pearson(3, 3)  # three of three is not 100 %
    >>> round(low, 3), high
    (0.292, 1.0)
    """
    if n < 1 or not -1e-9 <= k <= n + 1e-9:
        raise ValueError(f"need 0 <= k <= n and n >= 1, got {k=}, {n=}")
    k = min(max(k, 0.0), float(n))
    tail = (1 - level) / 2
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    return low, high


def log_loss(p: ArrayLike, true: ArrayLike) -> Floats:
    """Return -ln p of the true class, shape (n,); ``p`` (n, K), ``true`` (n,) column numbers.

    Examples
    --------
    >>> log_loss([[0.5, 0.5], [0.9, 0.1]], [0, 1]).round(3)
    array([0.693, 2.303])
    """
    rows = np.asarray(p, dtype=float)
    at = rows[np.arange(rows.shape[0]), np.asarray(true, dtype=int)]
    return np.asarray(-np.log(np.maximum(at, _LEAST_PROBABILITY)))


def brier(p: ArrayLike, true: ArrayLike) -> Floats:
    """Return the squared distance of each row of p to the truth, shape (n,); 0 is perfect, 2 is worst.

    Examples
    --------
    >>> brier([[0.5, 0.5], [1.0, 0.0]], [0, 1])
    array([0.5, 2. ])
    """
    rows = np.asarray(p, dtype=float)
    truth = np.eye(rows.shape[1])[np.asarray(true, dtype=int)]
    return np.asarray(np.sum((rows - truth) ** 2, axis=1))


def calibration_bins(
    confidence: ArrayLike, correct: ArrayLike, *, edges: ArrayLike | None = None
) -> list[Bin]:
    """Return confidence beside accuracy in bins of confidence; empty bins are left out.

    Parameters
    ----------
    confidence : (n,) array_like
        Probability of the predicted class.
    correct : (n,) array_like of bool
    edges : array_like, optional
        Bin edges, by default every 0.1.

    Examples
    --------
    >>> [bin] = calibration_bins([0.95, 0.97], [True, False])
    >>> bin.n, round(bin.confidence, 2), bin.accuracy
    (2, 0.96, 0.5)
    """
    c, ok = np.asarray(confidence, dtype=float), np.asarray(correct, dtype=float)
    cuts = np.linspace(0, 1, 11) if edges is None else np.asarray(edges, dtype=float)
    of = np.clip(np.searchsorted(cuts, c, side="left") - 1, 0, cuts.size - 2)
    return [
        Bin(
            low=float(cuts[b]),
            high=float(cuts[b + 1]),
            n=int((of == b).sum()),
            confidence=float(c[of == b].mean()),
            accuracy=float(ok[of == b].mean()),
        )
        for b in np.unique(of)
    ]


def expected_calibration_error(confidence: ArrayLike, correct: ArrayLike) -> float:
    """Return the mean gap between confidence and accuracy over the ten bins, weighted by their counts."""
    bins = calibration_bins(confidence, correct)
    total = sum(b.n for b in bins)
    return float(sum(b.n * abs(b.confidence - b.accuracy) for b in bins) / total)


def mcnemar(first: ArrayLike, second: ArrayLike) -> McNemar:
    """Return the exact McNemar test of two classifiers on the same grasps.

    Parameters
    ----------
    first, second : (n,) array_like of bool
        Whether each was right.

    Examples
    --------
    >>> mcnemar([1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0])
    McNemar(only_first=5, only_second=0, p_value=0.0625)
    """
    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ValueError(f"the classifiers were tested on {a.size} and {b.size} grasps")
    only_a, only_b = int(np.sum(a & ~b)), int(np.sum(~a & b))
    tail = float(binom.cdf(min(only_a, only_b), only_a + only_b, 0.5)) if only_a + only_b else 0.5
    return McNemar(only_a, only_b, min(1.0, 2 * tail))


def sign_flip_p(difference: ArrayLike, *, draws: int = 20_000, seed: int = 0) -> float:
    """Return the two-sided p-value of a mean difference, by flipping the sign of each grasp's.

    Examples
    --------
    >>> sign_flip_p([0.0, 0.0])
    1.0
    """
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


def cluster_bootstrap(
    values: ArrayLike, *, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Return the percentile interval of a mean over grasps, drawing whole grasps anew.

    Parameters
    ----------
    values : (m,) array_like
        One mean value a grasp (over all rounds in which it was tested).

    Examples
    --------
    >>> low, high = cluster_bootstrap([0.0, 1.0] * 20)
    >>> 0.3 < low < 0.5 < high < 0.7
    True
    """
    v = np.asarray(values, dtype=float)
    rng = np.random.default_rng(seed)
    means = v[rng.integers(0, v.size, size=(draws, v.size))].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def auroc(negative: ArrayLike, positive: ArrayLike) -> float:
    """Return the probability that a positive scores above a negative, ties counting half.

    Examples
    --------
    >>> auroc([0.1, 0.2], [0.2, 0.9])
    0.875
    """
    low, high = np.asarray(negative, dtype=float), np.asarray(positive, dtype=float)
    ranks = rankdata(np.concatenate([low, high]))[low.size :]
    return float((ranks.sum() - high.size * (high.size + 1) / 2) / (low.size * high.size))
