"""Slow errors that no parameter explains: what a fit should not chase.

Over hours a reading wanders away from any lumped model: the room's air moves, a supply drifts, the bench
warms.  An error of bin t of an output is taken as

    e_t = s_t + w_t,    s_(t+1) = rho s_t + sqrt(1 - rho^2) sd eta_t,    rho = exp(-bin / time),

a wander s of standard deviation ``sd`` that forgets over ``time``, and w_t of variance r per bin.  Least
squares on e itself counts an hour of wander as hundreds of independent readings and bends conductances to
follow it.  Its maximum-likelihood counterpart is least squares on the *innovations*: what the steady Kalman
filter of s did not foresee,

    v_t = (e_t - s_t) / sqrt(P + r),    s_(t+1) = rho (s_t + K v_t sqrt(P + r)),    K = P / (P + r),

with P = rho^2 P r / (P + r) + (1 - rho^2) sd^2.  The filter is linear, so innovations of a model's
sensitivities are the sensitivities of its innovations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

__all__ = ["innovations"]

Array = NDArray[np.float64]


def innovations(errors: Array, *, sd: float, time: float, variance: float, bin_s: float) -> Array:
    """Return the errors less their foreseeable wander, in units of their standard deviation.

    Parameters
    ----------
    errors : (k, m) ndarray
        A row each of k models: errors of m bins in order of time.
    sd, time : float
        Standard deviation of the wander [unit of the output] and how long it remembers [s].
    variance : float
        Of the rest of a bin.
    bin_s : float
        Length of a bin [s].

    Returns
    -------
    innovations : (k, m) ndarray

    Examples
    --------
    A constant error is news at first, then expected:

    >>> v = innovations(np.full((1, 400), 0.1), sd=0.1, time=1e4, variance=0.01**2, bin_s=10.0)
    >>> bool(abs(v[0, 0]) > 30 * abs(v[0, -1]))
    True
    """
    rho = float(np.exp(-bin_s / time))
    push = (1 - rho**2) * sd**2
    # P^2 + P (r (1 - rho^2) - push) - push r = 0
    half = 0.5 * (variance * (1 - rho**2) - push)
    P = -half + np.sqrt(half**2 + push * variance)
    K = P / (P + variance)
    foreseen = lfilter([0.0, rho * K], [1.0, -rho * (1 - K)], errors, axis=-1)
    return np.asarray((errors - foreseen) / np.sqrt(P + variance))
