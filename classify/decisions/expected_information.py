r"""What readings to come are expected to tell: entropy, information, and the chance of being right.

A :class:`~thermogrip.sysid.effusivity.predictive.PosteriorPredictive` holds, for each candidate m, its
probability p_m now and a normal distribution of the readings y to come.  After y the probabilities are
:math:`p_m(y) \propto p_m N(y; m)`, so that

.. math:: I = H(p) - \sum_m p_m E_{y|m} H(p(y)), \qquad A = \sum_m p_m E_{y|m} \max_k p_k(y)

are the expected information [nat] and the expected accuracy of naming the likeliest candidate.  Both are
averages over draws of y under each candidate.  Accuracy is never lost by reading on: with k* the candidate
that is likeliest now, the gain is :math:`E[\max_k p_k(y) - p_{k*}(y)]`, which no draw makes negative and
which is exactly zero where no reading could change the answer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from thermogrip.sysid.effusivity.predictive import PosteriorPredictive

__all__ = ["Expected", "entropy", "expected_information"]

Floats = NDArray[np.float64]

_NEGLIGIBLE = 1e-4  # of probability: such a candidate's futures are not drawn


class Expected(NamedTuple):
    """``n`` situations: ``information`` [nat], ``accuracy`` after the readings and its ``gain``, (n,)
    each."""

    information: Floats
    accuracy: Floats
    gain: Floats


def entropy(log_p: Floats) -> Floats:
    """Return the entropy [nat] of log probabilities along the last axis.

    Examples
    --------
    >>> entropy(np.log([[0.5, 0.5], [1.0 - 1e-12, 1e-12]])).round(3)
    array([0.693, 0.   ])
    """
    return np.asarray(-(np.exp(log_p) * np.where(np.isfinite(log_p), log_p, 0.0)).sum(axis=-1))


def expected_information(outlook: PosteriorPredictive, *, draws: int = 48, seed: int = 0) -> Expected:
    """Return what the readings of each situation are expected to tell.

    Parameters
    ----------
    outlook : PosteriorPredictive
    draws : int, optional
        Draws a candidate; each is used with both signs.
    seed : int, optional

    Examples
    --------
    Two candidates five standard deviations apart leave nothing open, two that read the same leave all:

    >>> apart = PosteriorPredictive(np.log([[0.5, 0.5]]), np.array([[[0.0], [5.0]]]), np.ones((1, 2, 1, 1)))
    >>> alike = PosteriorPredictive(np.log([[0.5, 0.5]]), np.zeros((1, 2, 1)), np.ones((1, 2, 1, 1)))
    >>> [float(expected_information(o).information[0].round(1)) for o in (apart, alike)]
    [0.7, 0.0]
    """
    rng = np.random.default_rng(seed)
    log_p, mean, covariance = outlook[:3]
    n, m, width = mean.shape
    now = entropy(log_p)
    best = log_p.argmax(axis=1)
    p = np.exp(log_p)
    if width == 0:
        return Expected(np.zeros(n), p.max(axis=1), np.zeros(n))
    chol = np.linalg.cholesky(covariance)
    white = np.linalg.inv(chol)  # small, and used for every draw
    log_det = 2 * np.log(np.diagonal(chol, axis1=2, axis2=3)).sum(axis=2)
    half = rng.standard_normal((draws, width))
    z = np.concatenate([half, -half])
    later, gain = np.zeros(n), np.zeros(n)
    for k in range(m):
        at = np.flatnonzero(p[:, k] > _NEGLIGIBLE)
        if not at.size:
            continue
        y = mean[at, k, None, :] + z @ chol[at, k].transpose(0, 2, 1)
        off = (y[:, None] - mean[at][:, :, None, :]) @ white[at].transpose(0, 1, 3, 2)
        after = log_p[at][:, :, None] - 0.5 * ((off**2).sum(axis=3) + log_det[at][:, :, None])
        after = (after - logsumexp(after, axis=1, keepdims=True)).transpose(0, 2, 1)
        q = np.exp(after)
        later[at] += p[at, k] * entropy(after).mean(axis=1)
        kept = np.take_along_axis(q, best[at][:, None, None], axis=2)[:, :, 0]
        gain[at] += p[at, k] * (q.max(axis=2) - kept).mean(axis=1)
    return Expected(np.maximum(now - later, 0.0), p.max(axis=1) + gain, gain)
