"""How far a start may be off that was estimated from its warm-up.

A fit does not know how a log starts.  Unless that was at rest, it takes state and sensor offsets, s in units
of their prior spreads, from the first bins y_w = B s + e_w (:mod:`thermogrip.sysid.plant.simulation`), by a
ridge regression that takes e_w for white, of standard deviation r:

    s_fit = K y_w,      K = (B'B / r^2 + 1)^-1 B' / r^2.

The errors of those bins have the covariance C_w that was learnt
(:mod:`thermogrip.sysid.greybox.noise_model`), and s the variances D.  What is left unknown of the start is
therefore

    cov(s_fit - s) = (1 - K B) D (1 - K B)' + K C_w K',

and not D: a heater that may be 2 K from rest is known to a few tenths after a minute, whatever it was.  What
the warm-up does not see keeps its prior spread, and what it sees by readings that repeat each other may be
off by more than that, for the ridge believes them.  That errors of the warm-up are in the residuals of the
fit too is left out; a start pulled upwards by a reading is one that the readings after it pull down, so the
two partly cancel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.greybox.noise_model import ErrorModel
from thermogrip.sysid.plant.simulation import READING_EVERY

__all__ = ["WarmUp", "warm_noise"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WarmUp:
    """The first bins of a log, and what its start does to them.

    Attributes
    ----------
    at : tuple of int
        Where these columns stand among the effects of the log.
    columns : (n, n_y, k) ndarray
        What each does to the bins at one prior spread, in the units of the fit's residuals.
    outputs : tuple of int
        Which outputs they are.
    noise : (n_y,) ndarray
        r of a bin, in these units.
    """

    at: tuple[int, ...]
    columns: Array
    outputs: tuple[int, ...]
    noise: Array

    def error(self, numbers: ErrorModel, spread: Array) -> Array:
        """Return the covariance (k, k) of the start's error, of prior spreads squared.

        Parameters
        ----------
        numbers : ErrorModel
        spread : (k,) ndarray
            The learnt spread of each column, in prior spreads.

        Examples
        --------
        Four bins of unit white noise, taken for such, that a start moves by 2 each: known to 1 / (1 + 16):

        >>> numbers = ErrorModel((1.0,), (1.0,), ((1e-9,),), (0.0,))
        >>> first = WarmUp((0,), np.full((4, 1, 1), 2.0), (0,), np.ones(1))
        >>> first.error(numbers, np.ones(1)).round(4).tolist()
        [[0.0588]]
        """
        n, n_y, k = self.columns.shape
        pick = np.ix_(range(n), self.outputs, range(n), self.outputs)
        errors = numbers.in_time(n)[pick].reshape(n * n_y, -1)
        B = self.columns.reshape(-1, k)
        weighed = (self.columns / np.square(self.noise)[:, None]).reshape(-1, k)
        K = np.linalg.solve(weighed.T @ B + np.eye(k), weighed.T)
        unseen = (np.eye(k) - K @ B) * spread
        return np.asarray(unseen @ unseen.T + K @ errors @ K.T)


def warm_noise(seconds: float, bin_s: float) -> float:
    """Return r of a bin over the sd of a reading, where the warm-up counts one reading every 10 s.

    Parameters
    ----------
    seconds, bin_s : float
        Length of the warm-up and of a bin [s].

    Examples
    --------
    >>> round(warm_noise(60.0, 5.0), 2)  # 12 bins for 7 readings
    1.31
    """
    return float(np.sqrt(seconds / (1 + seconds / READING_EVERY) / bin_s))
