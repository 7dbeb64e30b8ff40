"""Was the skin still moving when it touched?

The engine's skin has one level before contact, and drifts afterwards as its calibration says.  One that was
not settled goes on moving for a while, and an object that answers to it is found too warm or too cold: a skin
that moves by s [K/s] and keeps to it puts the temperature of a metal off by 12 to 17 s times s (simulated
copper and iron at 20 K, 10 s of contact), half of that where it settles within 10 s; of an insulator it is
the effusivity that moves, 0.13 in log10 e for 0.05 K/s.

That drift is no unknown of the model.  A grasp tells its own only badly: a second and a half before contact
leaves 0.02 K/s open at 10 Hz, the contact itself, with all else unknown, 0.014 K/s.  With that for a prior
every metal's temperature would be known to 0.3 K instead of 0.1; the 195 training grasps of the example rig
want 0.002 K/s (-2 ln likelihood -4; +58 at 0.01 K/s), which moves nothing.  So it is looked for, and told: a
line through the last five seconds before contact whose slope noise would make once in 100 000 grasps.  Of the
second and a half that the example rig records that is 0.17 K/s, of five seconds 0.03 K/s; a slower drift
passes, and only a session that has settled rules it out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from thermogrip.datasets.schema import Grasps

__all__ = ["BIAS_S", "level_slope", "unsettled"]

Floats = NDArray[np.float64]

#: A metal's temperature is off by so many seconds of a drift that lasts [s].
BIAS_S = 15.0
_FROM, _UNTIL = -5.0, -0.4  # s: some contacts are made before the message
_LEAST = 6  # readings
_CHANCE = 1e-5


def level_slope(grasps: Grasps) -> tuple[Floats, Floats]:
    """Return the slope of each skin just before contact, and its standard error, (n,) each [K/s].

    NaN where fewer than six readings tell of it.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> slope, sd = level_slope(load_example_grasps()["exp2_dT20"].isel(grasp=[0]))
    >>> bool(abs(slope[0]) < 3 * sd[0]), round(float(sd[0]), 2)
    (True, 0.02)
    """
    near = _near(grasps)
    t = np.asarray(grasps["time"].values, dtype=float)[near]
    y = np.asarray(grasps["t_surface"].values, dtype=float)[:, near]
    there = np.isfinite(y)
    n = there.sum(axis=1)
    least = np.maximum(n, 1)

    def centred(values: Floats) -> Floats:
        kept = np.where(there, values, 0.0)
        return np.where(there, kept - (kept.sum(axis=1) / least)[:, None], 0.0)

    x, off = centred(np.broadcast_to(t, y.shape)), centred(y)
    spread = np.maximum((x**2).sum(axis=1), 1e-12)
    slope = (x * off).sum(axis=1) / spread
    left = ((off - slope[:, None] * x) ** 2).sum(axis=1) / np.maximum(n - 2, 1)
    # readings that all round to one step know no better than that step
    sd = np.sqrt(np.maximum(left, _step(y) ** 2 / 12) / spread)
    known = n >= _LEAST
    return np.where(known, slope, np.nan), np.where(known, sd, np.nan)


def unsettled(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps touched while their skin was surely still moving, (n,).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 1])
    >>> moved = grasps.assign(t_surface=grasps["t_surface"] + 0.2 * grasps["time"])
    >>> unsettled(grasps).any(), unsettled(moved).all()
    (np.False_, np.True_)
    """
    slope, sd = level_slope(grasps)
    n = np.isfinite(np.asarray(grasps["t_surface"].values)[:, _near(grasps)]).sum(axis=1)
    chance = 2 * student_t.sf(np.abs(slope) / np.maximum(sd, 1e-9), np.maximum(n - 2, 1))
    return np.asarray(chance < _CHANCE)


def _near(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which times are just before contact, (n_time,)."""
    time = np.asarray(grasps["time"].values, dtype=float)
    return np.asarray((time >= _FROM) & (time < _UNTIL))


def _step(y: Floats) -> float:
    """Return the step of the sensor [K]: the least difference of two readings that differ."""
    apart = np.diff(np.unique(y[np.isfinite(y)]))
    apart = apart[apart > 1e-6]
    return float(apart.min()) if apart.size else 0.0
