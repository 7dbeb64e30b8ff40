"""Are the residuals white, and do they still know the input?

With residuals e of n samples the autocorrelation r_k of a white sequence is N(0, 1/n), so 95 % of its lags
lie inside +-1.96/sqrt(n).  The cross-correlation with an input u that is itself correlated is wider: with e
and u independent, E e_i e_j u_i u_j = r_e(i - j) r_u(i - j), so c_k = (1/n) sum_i e_i u_(i-k) has (Bartlett)

    var c_k = (1/n) sum_j r_e(j) r_u(j).

A residual that follows the input after lag zero means that a delay or a time constant is missing; whether it
does is no count of lags (they follow each other), but a test
(:mod:`thermogrip.sysid.validation.residual_correlation`).  A residual that is merely not white means that
one-step intervals are too narrow.  Samples that are lost or not scored are left out of the sums, pair by
pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Correlation", "autocorrelation", "cross_correlation"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlations by lag, with the band that independence would keep.

    Parameters
    ----------
    lags : (n_lags,) ndarray
        Lags [samples]; positive: the residual comes after the input.
    values : (n_lags,) ndarray
        Correlation coefficients; NaN where a lag has too few pairs.
    band : float
        Half-width of the 95 % band.
    """

    lags: Array
    values: Array
    band: float

    @property
    def share_outside(self) -> float:
        """Share of the lags outside of the band; about 0.05 under independence."""
        known = np.isfinite(self.values)
        return float(np.mean(np.abs(self.values[known]) > self.band)) if known.any() else float("nan")

    @property
    def independent(self) -> bool:
        """Whether the share outside is within what chance gives (99 % of a binomial with p = 0.05)."""
        n = int(np.isfinite(self.values).sum())
        return bool(n > 0 and self.share_outside * n <= 0.05 * n + 2.33 * np.sqrt(n * 0.05 * 0.95) + 0.5)


def autocorrelation(residual: ArrayLike, n_lags: int = 40) -> Correlation:
    """Return the autocorrelation of a residual at lags 1 to n_lags.

    Parameters
    ----------
    residual : (n,) array_like
        Evenly spaced; NaN where lost or not scored.
    n_lags : int, optional

    Examples
    --------
    >>> slow = np.sin(np.arange(200) / 30)
    >>> autocorrelation(slow).independent
    False
    """
    e = np.asarray(residual, dtype=float)
    lags = np.arange(1, max(1, min(n_lags, e.size // 4)) + 1)
    values = _correlate(e, e, lags)
    return Correlation(lags.astype(float), values, float(1.96 / np.sqrt(max(1, np.isfinite(e).sum()))))


def cross_correlation(residual: ArrayLike, drive: ArrayLike, n_lags: int = 40) -> Correlation:
    """Return the correlation of a residual with the input that came k samples before it, k = 0 to n_lags.

    Parameters
    ----------
    residual : (n,) array_like
        Evenly spaced; NaN where lost or not scored.
    drive : (n,) array_like
        The input at the same times.
    n_lags : int, optional
    """
    e, u = np.asarray(residual, dtype=float), np.asarray(drive, dtype=float)
    u = np.where(np.isfinite(e), u, np.nan)
    lags = np.arange(0, max(1, min(n_lags, e.size // 4)) + 1)
    values = _correlate(e, u, lags)
    wide = np.arange(1, max(2, e.size // 4))
    both = np.nan_to_num(_correlate(e, e, wide)) * np.nan_to_num(_correlate(u, u, wide))
    spread = max(1.0 + 2.0 * float(np.sum(both)), 1.0) / max(1, int(np.isfinite(e).sum()))
    return Correlation(lags.astype(float), values, float(1.96 * np.sqrt(spread)))


def _correlate(e: Array, u: Array, lags: NDArray[np.int_]) -> Array:
    """Return sum_i u[i] e[i + k] over the known pairs, scaled to a correlation coefficient."""
    known_e, known_u = np.isfinite(e), np.isfinite(u)
    if not known_e.any() or not known_u.any():
        return np.full(lags.shape, np.nan)
    a = np.where(known_e, e - e[known_e].mean(), 0.0)
    b = np.where(known_u, u - u[known_u].mean(), 0.0)
    largest = float(np.abs(a).max()), float(np.abs(b).max())
    if not min(largest) > 1e-150:
        return np.full(lags.shape, np.nan)
    a, b = a / largest[0], b / largest[1]  # a run that diverged has no squares
    size = float(np.sqrt((a**2).sum() * (b**2).sum()))
    n = len(e)
    length = 1 << int(np.ceil(np.log2(2 * n)))
    both = np.fft.irfft(np.fft.rfft(a, length) * np.conj(np.fft.rfft(b, length)), length)
    return np.asarray(both[lags] / size)
