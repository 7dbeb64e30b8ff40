"""What one touch says about the things that it shares with other touches, as a Gaussian factor.

Touches of one block share its effusivity, its heat capacity, part of its contact conductance, and a
temperature that moves in a known way from one to the next.  Under a candidate, Laplace's method gives the
posterior of a touch's nuisances; dividing out its prior leaves the likelihood of x = (T_obj, ln h, ln e, ln
C) alone,

    L(x) = c exp(eta' d - d' Lambda d / 2),   d = x - x0,

with everything that no other touch knows (onset, level, build-up) integrated.  A Gaussian prior N(mu, P) of
the x of all touches of a block, stacked, then has its evidence in closed form, P singular or not: with g =
eta - Lambda (mu - x0),

    ln Z = sum ln c + (eta - Lambda (mu - x0) / 2)' (mu - x0) + g' (I + P Lambda)^-1 P g / 2
           - ln det(I + P Lambda) / 2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.effusivity.laplace_approximation import CAPACITY, EFFUSIVITY, T_OBJECT, H, Mode, Prior

__all__ = ["N_SHARED", "SHARED", "Factor", "Joint", "combine", "factor_of"]

Array = NDArray[np.float64]

SHARED = (T_OBJECT, H, EFFUSIVITY, CAPACITY)
N_SHARED = len(SHARED)


class Factor(NamedTuple):
    """Likelihoods of x = (T_obj, ln h, ln e, ln C), a row a (touch, hypothesis) pair.

    ``log_size`` (n,) is ln c; ``centre`` (n, 4) is x0; ``eta`` (n, 4); ``precision`` (n, 4, 4) is Lambda,
    zero in whatever the hypothesis knows.
    """

    log_size: Array
    centre: Array
    eta: Array
    precision: Array

    def take(self, index: NDArray[np.int64]) -> Factor:
        """Return the rows of an index of any shape, which becomes the leading shape of each field."""
        return Factor(*(field[index] for field in self))


class Joint(NamedTuple):
    """``log_evidence`` (...,), and the posterior ``mean`` (..., k) and ``covariance`` (..., k, k) of all
    x."""

    log_evidence: Array
    mean: Array
    covariance: Array


def factor_of(mode: Mode, prior: Prior) -> Factor:
    """Return what the data alone say of x: the posterior at the mode with its prior divided out."""
    at = list(SHARED)
    sd = np.where(prior.sd[:, at] > 0, prior.sd[:, at], 1.0)
    vary = prior.sd[:, at] > 0
    scaled = mode.covariance[:, at][:, :, at] / (sd[:, :, None] * sd[:, None, :])
    scaled += np.eye(N_SHARED) * ~vary[:, :, None]
    whole = np.linalg.inv(scaled)
    w = np.where(vary, (mode.u[:, at] - prior.mean[:, at]) / sd, 0.0)
    eta = np.einsum("nij,nj->ni", whole, w)
    size = mode.log_evidence + 0.5 * np.linalg.slogdet(whole)[1] - 0.5 * (eta * w).sum(axis=1)
    precision = (whole - np.eye(N_SHARED)) / (sd[:, :, None] * sd[:, None, :])
    return Factor(size, prior.mean[:, at], eta / sd, precision)


def combine(factor: Factor, mean: Array, covariance: Array) -> Joint:
    """Return evidence and posterior of touches under a joint prior.

    Parameters
    ----------
    factor : Factor
        Fields of leading shape (..., n_touch).
    mean, covariance : (..., 4 n_touch), (..., 4 n_touch, 4 n_touch) ndarray
        Prior of the touches' x, one touch after the other.

    Examples
    --------
    One touch under its own prior, of which the data say nothing:

    >>> nothing = Factor(np.zeros(1), np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 4, 4)))
    >>> joint = combine(nothing, np.zeros(4), np.eye(4))
    >>> float(joint.log_evidence), joint.covariance.diagonal().tolist()
    (0.0, [1.0, 1.0, 1.0, 1.0])
    """
    lead, n = factor.log_size.shape[:-1], factor.log_size.shape[-1]
    k = n * N_SHARED
    lam = np.zeros((*lead, k, k))
    for i in range(n):
        part = slice(i * N_SHARED, (i + 1) * N_SHARED)
        lam[..., part, part] = factor.precision[..., i, :, :]
    eta = factor.eta.reshape(*lead, k)
    away = mean - factor.centre.reshape(*lead, k)
    pulled = np.einsum("...ij,...j->...i", lam, away)
    matrix = np.eye(k) + covariance @ lam
    posterior = np.linalg.solve(matrix, np.broadcast_to(covariance, matrix.shape))
    g = eta - pulled
    move = np.einsum("...ij,...j->...i", posterior, g)
    evidence = factor.log_size.sum(axis=-1) + ((eta - 0.5 * pulled) * away).sum(axis=-1)
    evidence = evidence + 0.5 * (g * move).sum(axis=-1) - 0.5 * np.linalg.slogdet(matrix)[1]
    return Joint(np.asarray(evidence), mean + move, np.asarray(posterior, dtype=float))
