"""What a fit can and cannot tell: covariance, condition, and the weakest direction in words.

**Within logs.**  With residuals that repeat each other tau-fold, H = J'J (J weighted by 1 / (sd sqrt(tau)),
prior rows included) and the Gauss-Newton covariance is H^-1.

**Between logs.**  One log is not another: rooms, fillings and sensors differ in ways that no noise model
sees, and intervals from H^-1 are too narrow.  Leaving out group l (a log, or a block of one where logs are
few) moves the estimate by about one Newton step,

    theta_(-l) = theta + (H - H_l)^-1 J_l' r_l,

and the jackknife variance is (L - 1) / L sum_l (theta_(-l) - mean)^2.  Four logs make that variance itself
uncertain by tens of per cent, so it only ever widens: the sd of each parameter is the larger of the two, the
correlations stay those of H^-1.

**Null directions.**  D H_data D scaled to a unit diagonal, without the prior, has one small eigenvalue per
combination of parameters that the logs do not tell.  Its eigenvector is said in words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["describe", "jackknife_sd", "weakest_direction"]

Array = NDArray[np.float64]

_EXACT = 1e-11  # eigenvalue of the scaled Hessian below which a direction is not told at all
_PRIOR_ONLY = 0.9  # posterior sd over prior sd from which the logs have added nothing


def jackknife_sd(groups: Sequence[tuple[Array, Array]]) -> Array:
    """Return the standard deviation (n,) of a fit's z over logs, from leaving out one after the other.

    Leaving out group l moves the estimate by about one Newton step,

        z_(-l) = z + (H - H_l)^-1 J_l' r_l,

    and the jackknife variance is (L - 1) / L sum_l (z_(-l) - mean)^2.  Four logs make it uncertain by 40 per
    cent, so it checks intervals and does not make them.

    Parameters
    ----------
    groups : sequence of (residual (m,), Jacobian (m, n))
        One per log or block, weighted; z has the prior N(0, 1).

    Examples
    --------
    The mean of four groups of 0.4, 0.4, -0.4, -0.4, all but free of the prior: 0.4 / sqrt(3)

    >>> groups = [(np.full(90, e), np.full((90, 1), -1.0)) for e in (0.4, 0.4, -0.4, -0.4)]
    >>> jackknife_sd(groups).round(3).tolist()
    [0.23]
    """
    n, n_group = groups[0][1].shape[1], len(groups)
    whole = np.eye(n) + sum((J.T @ J for _, J in groups), np.zeros((n, n)))
    left_out = np.array([np.linalg.solve(whole - J.T @ J, J.T @ r) for r, J in groups])
    spread = left_out - left_out.mean(axis=0)
    return np.asarray(np.sqrt((n_group - 1) / n_group * (spread**2).sum(axis=0)))


def weakest_direction(jacobian: Array, names: Sequence[str]) -> tuple[float, float, str]:
    """Return condition and smallest eigenvalue of the scaled Hessian, and its direction in words.

    Parameters
    ----------
    jacobian : (m, n) ndarray
        Of the data alone.
    names : sequence of str

    Examples
    --------
    Two resistances in series are told by their sum only:

    >>> weakest_direction(np.array([[1.0, 1.0], [2.0, 2.0]]), ["R1", "R2"])[2]
    'R1 up, R2 down'
    """
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(size > 0, size, 1.0)
    values, axes = np.linalg.eigh(scaled.T @ scaled)
    axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    order = [i for i in np.argsort(-np.abs(axis)) if abs(axis[i]) > 0.3]
    words = ", ".join(f"{names[i]} {'up' if axis[i] > 0 else 'down'}" for i in sorted(order))
    least = max(float(values[0]), 0.0)
    return float(values[-1] / max(least, 1e-18)), least, words


def describe(
    names: Sequence[str], jacobian: Array, covariance: Array, widening: Array, on_bound: Mapping[str, str]
) -> dict[str, Any]:
    """Return the identifiability report of a fit as plain numbers and words.

    Parameters
    ----------
    names : sequence of str
        Free parameters.
    jacobian : (m, n) ndarray
        Weighted, of the data alone, in units of the prior sd.
    covariance, widening : (n, n), (n,) ndarray
        From :mod:`thermogrip.sysid.score_covariance`.
    on_bound : dict of name -> "low" or "high"

    Returns
    -------
    dict
        ``condition``, ``weakest`` (words), ``told`` (False: an exact null direction), ``prior_only`` (names),
        ``on_bound``, ``widening`` by name.
    """
    condition, least, words = weakest_direction(jacobian, names)
    sd = np.sqrt(np.diag(covariance))
    return {
        "condition": condition,
        "weakest": words,
        "told": bool(least > _EXACT),
        "prior_only": [name for name, s in zip(names, sd) if s > _PRIOR_ONLY],
        "on_bound": dict(on_bound),
        "widening": {name: round(float(w), 3) for name, w in zip(names, widening)},
    }
