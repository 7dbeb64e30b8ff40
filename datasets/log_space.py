"""Sums of probabilities that are known by their logarithms, and logarithms of odds.

``scipy.special`` has them all; to import it takes as long as to answer a grasp, so what an answer needs is
here.  These are the definitions, as stable: no exponential overflows, and -inf is no probability.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array


def log_sum(log_p: ArrayLike, axis: int | None = None, *, keepdims: bool = False) -> Any:
    """Return ln of the sum of exp(log_p), along an axis or over all.

    >>> round(float(log_sum([-1000.0, -1000.0])), 3), float(log_sum([-np.inf, -np.inf]))
    (-999.307, -inf)
    """
    given = np.asarray(log_p, dtype=float)
    top = given.max(axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    total = np.exp(given - top).sum(axis=axis, keepdims=True)
    with np.errstate(divide="ignore"):
        found = np.log(total) + top
    if keepdims:
        return found
    return found.squeeze() if axis is None else found.squeeze(axis=axis)


def shares(log_p: Array, axis: int) -> Array:
    """Return exp(log_p) divided by its sum along an axis."""
    return np.asarray(np.exp(log_p - log_sum(log_p, axis, keepdims=True)))


def logit(p: ArrayLike) -> Any:
    """Return the logarithm of the odds of a probability."""
    given = np.asarray(p, dtype=float)
    with np.errstate(divide="ignore"):
        return (np.log(given) - np.log1p(-given))[()]


def expit(log_odds: ArrayLike) -> Any:
    """Return the probability of which these are the logarithm of the odds.

    >>> float(expit(0.0)), float(expit(-np.inf)), round(float(expit(logit(0.02))), 12)
    (0.5, 0.0, 0.02)
    """
    given = np.asarray(log_odds, dtype=float)
    small = np.exp(-np.abs(given))  # of what it is less likely
    return np.where(given < 0, small, 1.0)[()] / (1.0 + small)


def log_gamma(x: ArrayLike) -> Array:
    """Return ln Gamma of positive numbers, of which few differ."""
    given = np.asarray(x, dtype=float)
    values, at = np.unique(given, return_inverse=True)
    return np.array([math.lgamma(value) for value in values])[at].reshape(given.shape)
