"""When has a temperature settled?  A test that allows for noise, and the three figures of a step.

Over the last ``window`` seconds the error e = y - target is fitted by a line, e = a + b (t - t_mean).  Its
two coefficients are uncertain: readings are noisy, quantised, and correlated from sample to sample.
With the residual standard deviation s, floored at the rounding error quantum / sqrt(12), and its lag-one
correlation r, the n samples are worth n_eff = n (1 - r) / (1 + r) independent ones, so

    se(a) = s / sqrt(n_eff),        se(b) = sqrt(12) s / (window sqrt(n_eff)).

The temperature has settled if level and drift are inside the band even at two standard errors:

    |a| + 2 se(a) <= band    and    window (|b| + 2 se(b)) <= band.

A single reading inside the band proves nothing (it may be passing through), and a fixed waiting time proves
less.  The rule errs towards waiting: with noise that could hide a drift of the size of the band it is never
met.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["StepFigures", "has_settled", "step_figures"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepFigures:
    """Settling time, overshoot and bias of a regulated step."""

    # time from the start after which the smoothed error stays inside the band [s]; NaN if it does not
    settle_time: float
    # of the smoothed temperature beyond the target, in the direction of approach [K]
    overshoot: float
    # mean error of the last 120 s, or since it settled where that is shorter [K]; NaN if it did not
    bias: float


def has_settled(
    time: ArrayLike, error: ArrayLike, *, band: float, window: float = 30.0, quantum: float = 1 / 16
) -> bool:
    """Say whether level and drift of the last ``window`` seconds are surely inside the band."""
    t, e = np.asarray(time, dtype=float), np.asarray(error, dtype=float)
    if t.size == 0 or t[-1] - t[0] < window:
        return False
    recent = (t >= t[-1] - window) & np.isfinite(e)
    t, e = t[recent], e[recent]
    if t.size < 5:
        return False
    slope, level = np.polyfit(t - t.mean(), e, 1)
    se_level = _standard_error(e - level - slope * (t - t.mean()), quantum)
    se_slope = np.sqrt(12.0) * se_level / window
    level_ok = abs(level) + 2 * se_level <= band
    return bool(level_ok and window * (abs(slope) + 2 * se_slope) <= band)


def step_figures(
    time: ArrayLike, reading: ArrayLike, target: float, *, band: float = 0.25, smooth: float = 5.0
) -> StepFigures:
    """Return settling time, overshoot and bias of a temperature that was brought to a constant target."""
    t, y = np.asarray(time, dtype=float), np.asarray(reading, dtype=float)
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    if t.size == 0:
        return StepFigures(np.nan, 0.0, np.nan)
    error = _moving_mean(t, y, smooth) - target
    outside = np.flatnonzero(np.abs(error) > band)
    approach = np.sign(target - y[0])
    beyond = approach * error if abs(y[0] - target) > band else np.abs(error)
    overshoot = max(0.0, float(beyond.max()))
    if outside.size and outside[-1] == t.size - 1:
        return StepFigures(np.nan, overshoot, np.nan)
    settled_at = t[outside[-1] + 1] if outside.size else t[0]
    last = t >= max(settled_at, t[-1] - 120.0)
    return StepFigures(float(settled_at - t[0]), overshoot, float(np.mean(y[last] - target)))


def _standard_error(residual: Array, quantum: float) -> float:
    """Return the standard error of the mean of correlated residuals about a line."""
    n = residual.size
    sd = max(float(np.sqrt(residual @ residual / (n - 2))), quantum / np.sqrt(12.0))
    power = float(residual @ residual)
    lag_one = float(residual[1:] @ residual[:-1]) / power if power > 0 else 0.0
    # 1/n and 3/n undo the bias of a lag-one correlation about a fitted line
    r = min(max(lag_one + (1 + 3 * max(lag_one, 0.0)) / n, 0.0), 0.95)
    return float(sd / np.sqrt(max(n * (1 - r) / (1 + r), 2.0)))


def _moving_mean(t: Array, y: Array, width: float) -> Array:
    """Return the mean of y over the ``width`` seconds round each time (shorter at the ends)."""
    total = np.concatenate([[0.0], np.cumsum(y)])
    lo, hi = np.searchsorted(t, t - width / 2, "left"), np.searchsorted(t, t + width / 2, "right")
    return np.asarray((total[hi] - total[lo]) / (hi - lo))
