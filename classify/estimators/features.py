r"""Physics features of a grasp: how much, and how it goes on.

After contact the sensor moves from its level :math:`b` towards the object.  Both bodies start uniform, the
equations are linear, so the trace is

.. math:: T(t) = b + (T_{obj} - b)\, F(t - t_0),

and :math:`F` depends on the object's material but not on the temperatures: features of a grasp divided by its
own :math:`T_{obj} - b` are those of the material.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import xarray as xr

from thermogrip.classify.estimators.base import Floats, level
from thermogrip.datasets.schema import Grasps

# fixed times, and no onset: how late a contact was is a part of the features' scatter
RESPONSE_TIMES = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0)  # s after the message
KINDS = ("change_", "late_slope")
_ONSET_WINDOW_S, _SHARE = 0.3, 0.2  # s, and of the time
FIT_END = 10.0  # s, until which the late slope is read
LEAST_DIFFERENCE = 1.0  # K
_LEAST_NOISE = 0.01  # K; a sensor that rests on one step of its converter shows less than it has


def object_difference(grasps: Grasps) -> Floats:
    """Return ``T_obj - T_skin`` of each grasp before contact [K], NaN where ``t_object`` is unknown."""
    base = level(grasps)
    return np.asarray(
        grasps["t_object"].values - base if "t_object" in grasps else np.full(base.size, np.nan)
    )


def can_normalise(grasps: Grasps) -> bool:
    """Return whether any object's temperature is known and 1 K or more from the skin's."""
    return bool(np.any(np.abs(object_difference(grasps)) >= LEAST_DIFFERENCE))  # NaN compares false


def linear_features(grasps: Grasps, times: Sequence[float]) -> xr.DataArray:
    """Return the changes at some times after the message [s], ``change_<t>s`` [K], and ``late_slope`` [K/s]
    of each grasp, (n_grasp, n): sums of samples less the level before contact; NaN where a trace ends
    before."""
    time = np.asarray(grasps["time"].values, dtype=float)
    rise, begun = _filled(time, grasps["t_surface"].values - level(grasps)[:, None])
    last = np.max(np.where(begun > 0, time, -np.inf), axis=1)
    names = [*(f"change_{t:g}s" for t in times), "late_slope"]
    values = np.full((last.size, len(names)), np.nan)
    for end in np.unique(last):
        ends_then = last == end
        values[ends_then] = rise[ends_then] @ _linear_weights(tuple(time.tolist()), tuple(names), float(end))
    return xr.DataArray(
        values, dims=("grasp", "feature"), coords={"grasp": grasps["grasp"].values, "feature": names}
    )


@lru_cache(maxsize=64)
def _linear_weights(time: tuple[float, ...], names: tuple[str, ...], last: float) -> Floats:
    """Return the weight of each sample of a trace that ends at ``last`` [s] in linear features, (n_time, n);
    NaN in the column of a feature that it does not have."""
    t, weights = np.asarray(time), np.full((len(time), len(names)), np.nan)
    for k, name in enumerate(names):
        slope = name == "late_slope"
        nominal_time = FIT_END if slope else float(name[len("change_") : -1])
        read_time = min(nominal_time, last)
        used = (
            # a change is read on the line through the samples within 0.3 s, or t / 5, of its time
            (t >= 5.0) if slope else np.abs(t - read_time) <= max(_ONSET_WINDOW_S, _SHARE * read_time) + 1e-6
        )
        used &= t <= (read_time + 1e-6 if slope else last)
        if used.sum() < (3 if slope else 1) or last < nominal_time - max(0.06, 0.02 * nominal_time):
            continue
        off = np.where(used, t - t[used].mean(), 0.0)
        lever = off / max(float(off @ off), 1e-12)
        weights[:, k] = lever if slope else used / used.sum() + (read_time - t[used].mean()) * lever
    return weights


def feature_noise(grasps: Grasps, names: Sequence[str]) -> Floats:
    """Return the covariance that the noise of the sensor, read from a trace's second differences, gives
    features in kelvin, (n_grasp, n, n)."""
    time = tuple(np.asarray(grasps["time"].values, dtype=float).tolist())
    second = np.abs(np.diff(grasps["t_surface"].values, n=2, axis=1))
    has_difference = np.isfinite(second).any(axis=1)
    middle = np.full(second.shape[0], 0.0)
    middle[has_difference] = np.nanmedian(second[has_difference], axis=1)
    sample_sd = np.maximum(middle / (0.6745 * np.sqrt(6.0)), _LEAST_NOISE)
    # features are sums of samples, so that the noise of the sensor becomes theirs
    return np.asarray(sample_sd[:, None, None] ** 2 * _noise_shape(time, tuple(names)))


@lru_cache(maxsize=16)
def _noise_shape(time: tuple[float, ...], names: tuple[str, ...]) -> Floats:
    """Return the covariance of features for samples of sd 1, (n, n)."""
    gain, t = _linear_weights(time, names, time[-1]).T, np.asarray(time)
    shift = gain[:, t > -0.5].sum(axis=1)  # of an error of the level, which the median hides above
    before = max(int(np.sum(t <= -0.5)), 3)
    return np.asarray(gain @ gain.T + np.pi / 2 / before * np.outer(shift, shift))


def _filled(time: Floats, rise: Floats) -> tuple[Floats, Floats]:
    """Return the traces with lost samples interpolated, and 1.0 where a trace has begun and not ended."""
    out, within_trace = np.zeros_like(rise), np.zeros_like(rise)
    for i, row in enumerate(rise):
        ok = np.isfinite(row)
        out[i] = np.interp(time, time[ok], row[ok])
        within_trace[i] = (time >= time[ok][0]) & (time <= time[ok][-1])
    return out, within_trace
