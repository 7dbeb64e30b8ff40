"""Noise of one series of block means: white, and two slow errors that forget.

    cov(e_t, e_t') = w^2 [t = t'] + sum_m a_m^2 c(|t - t'|; tau_m),       m = 1, 2,

c the autocovariance of an Ornstein-Uhlenbeck process that is averaged over blocks, as readings are: with the
block as the unit of time and s = 1/tau,

    c(0) = 2 (s - 1 + exp(-s)) / s^2,       c(k) = (2 sinh(s/2) / s)^2 exp(-k s)    for k > 0.

Taken as if it were sampled, c(k) = exp(-k s), a slow error is too rough: fitted to a mean over blocks, whose
fast part is weaker, it loses a third of what it has at low frequencies, and there inputs work.

The covariance is nearly diagonal in cosine coordinates (:mod:`thermogrip.sysid.greybox.noise_model`), with
S_f at frequency f.  The numbers maximise the likelihood of the series with columns X, whose coefficients are
N(0, 1), integrated out, under wide log-normal priors:

    -2 ln L = sum ln S_f + e' S^-1 e - g' A^-1 g + ln |A|,      A = 1 + X' S^-1 X,   g = X' S^-1 e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from thermogrip.sysid.greybox.noise_model import Block, band_weights

__all__ = ["SlowNoise", "learn_slow_noise"]

Array = NDArray[np.float64]

_SIZES = (0.3, 0.5, 0.5)  # prior medians of w and a_m, in rms of the series
_SIZE_SD, _MEMORY_SD = 2.0, (1.0, 1.2)  # of their logarithms, and of those of the memories
_FAST = 3.0  # prior median of the shorter memory [blocks]
_SLOW = (12, 9.0)  # of the longer one: this part of the series, and at least so many blocks
_LEAST = 1e-6  # variance of a frequency: less than a thousandth of the series is no noise that can be told


@dataclass(frozen=True)
class SlowNoise:
    """Numbers of the covariance, in units of the series.

    Parameters
    ----------
    white : float
        w.
    sd, tau : (float, float)
        a_m, and tau_m [blocks].
    """

    white: float
    sd: tuple[float, float]
    tau: tuple[float, float]

    def variances(self, n: int) -> Array:
        """Return S_f of each band of frequencies of n blocks, (n_band,).

        Examples
        --------
        All frequencies together hold the variance of a block, which averaging has made less than a^2:

        >>> noise = SlowNoise(0.0, (1.0, 0.0), (1.0, 1.0))
        >>> bands = Block.of(np.zeros((64, 1, 1)), (0,)).sizes
        >>> round(float(noise.variances(64) @ bands) / 64, 4), round(2 / np.e, 4)
        (0.7358, 0.7358)
        """
        weights, lag = band_weights(n), np.arange(n)
        out = np.full(len(weights), self.white**2)
        for sd, tau in zip(self.sd, self.tau):
            s = 1 / tau
            memory = (2 * np.sinh(s / 2) / s) ** 2 * np.exp(-s * lag)
            memory[0] = 2 * (s + np.expm1(-s)) / s**2
            out += sd**2 * (weights @ memory)
        return np.asarray(np.maximum(out, _LEAST))

    def products(self, blocks: Sequence[Block]) -> Array:
        """Return [X, e]' S^-1 [X, e], (q, q), of stretches of one output."""
        parts = [
            np.tensordot(1 / self.variances(block.n), block.products[:, 0, 0], axes=1) for block in blocks
        ]
        return np.asarray(np.sum(parts, axis=0))


def learn_slow_noise(blocks: Sequence[Block]) -> SlowNoise:
    """Return the numbers that a residual supports best.

    Parameters
    ----------
    blocks : sequence of Block
        Stretches of one output whose rms is about 1; the last column is the residual.

    Examples
    --------
    >>> white = np.random.default_rng(0).standard_normal((400, 1, 1))
    >>> noise = learn_slow_noise([Block.of(white, (0,))])
    >>> round(noise.white, 1), max(noise.sd) < 0.3
    (1.0, True)
    """
    longest = max(block.n for block in blocks)
    mean = np.log([*_SIZES, _FAST, max(longest / _SLOW[0], _SLOW[1])])
    sd = np.array([_SIZE_SD] * 3 + list(_MEMORY_SD))

    def cost(z: Array) -> float:
        noise = _unpack(mean + sd * z)
        logs = sum(float(block.sizes @ np.log(noise.variances(block.n))) for block in blocks)
        return 0.5 * (logs + _squares(noise.products(blocks)) + float(z @ z))

    found = minimize(
        cost, np.zeros(5), method="L-BFGS-B", bounds=[(-4.0, 4.0)] * 5, options={"maxiter": 40, "ftol": 1e-7}
    )
    return _unpack(mean + sd * found.x)


def _squares(products: Array) -> float:
    """Return e' S^-1 e - g' A^-1 g + ln |A|."""
    m = len(products) - 1
    root = np.linalg.cholesky(products[:m, :m] + np.eye(m))
    explained = np.linalg.solve(root, products[:m, -1])
    return float(products[-1, -1] - explained @ explained + 2 * np.log(np.diag(root)).sum())


def _unpack(v: Array) -> SlowNoise:
    white, first, second, fast, slow = np.exp(v).tolist()
    return SlowNoise(white, (first, second), (fast, slow))
