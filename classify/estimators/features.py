r"""Physics features of a grasp: how much, how fast, and how it goes on.

After contact the sensor moves from its level :math:`b` towards the object.  Both bodies start uniform, the
equations are linear, so the trace is

.. math:: T(t) = b + (T_{obj} - b)\, F(t - t_0),

and :math:`F` depends on the object's material but not on the temperatures: the responses of each grasp are
divided by its own :math:`T_{obj} - b` where the object's temperature is known and differs by 1 K or more, and
are NaN in the others.  Where no grasp of a record can be divided they are in kelvin.

The noise of the sensor becomes noise of the features, :func:`feature_noise`: at small responses the weights
of the average below are those of its prior, so that responses and slopes are linear in the samples.

The real contact time :math:`t_0` is not the "closed" message.  It is estimated together with a rise,

.. math:: F(s) \approx A (1 - e^{-s/\tau}) + B (1 - e^{-s/6\,\mathrm{s}}), \qquad s = \max(t - t_0, 0),

by solving the linear part for each :math:`(t_0, \tau)` of a grid and averaging over the grid with weights
:math:`\exp(-\mathrm{SSE} / 2 \sigma^2 - t_0^2 / 2 \sigma_0^2)`, :math:`\sigma_0` = 0.15 s.  An average has no
local minima, and at equal temperatures, where no onset is visible, it falls back to the message.  Responses
are read at fixed times after :math:`t_0`: the fitted curve plus the mean residual within 0.3 s.

:func:`linear_features` need no onset: a **change** is the rise at a fixed time t after the message, on the
line through the samples within 0.3 s, or t / 5, of it.  How late a contact was is a part of their scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import xarray as xr
from scipy.special import softmax

from thermogrip.classify.estimators.base import Floats, level
from thermogrip.datasets.schema import Grasps, check_grasps, make_grasps

RESPONSE_TIMES = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
MATERIAL_FEATURES = ("initial_slope", "fitted_rise", "log_time_constant", "late_slope", "response_")
"""Prefixes of the features that speak of the object; ``level``, ``level_drift`` and ``onset`` do not."""

_LINEAR = ("change_", "late_slope")
_NEAR, _SHARE = 0.3, 0.2  # s, and of the time
_SLOW = 6.0  # s, about the time in which a 2 cm metal block and the skin come to terms
_ONSETS = np.arange(-0.40, 0.401, 0.04)
_RATES = np.geomspace(0.15, 3.0, 14)
_ONSET_SD = 0.15
FIT_END = 10.0
_LEAST_FIT = 5.0  # s; the end of a rise is not read from its beginning
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


def extract_features(
    grasps: Grasps, *, normalise: bool | None = None, times: Sequence[float] | None = None
) -> xr.DataArray:
    """Return a table of physics features, one row a grasp: dims (grasp, feature), with the coordinate
    ``unit``.

    Responses at ``times`` after onset [s], by default 0.5 to 40 s as far as the record reaches, are divided
    by the grasp's ``T_obj - T_skin`` (unit 1) or in kelvin, by default as :func:`can_normalise` says; NaN
    where a grasp cannot be divided or its trace does not reach far enough.
    """
    check_grasps(grasps)
    divide = can_normalise(grasps) if normalise is None else normalise
    time = np.asarray(grasps["time"].values, dtype=float)
    reach = [t for t in RESPONSE_TIMES if t <= time[-1] + 0.05] if times is None else list(times)
    base, scale = level(grasps), np.ones(grasps.sizes["grasp"])
    if divide:
        scale = object_difference(grasps)
        scale = np.where(np.abs(scale) >= LEAST_DIFFERENCE, scale, np.nan)
    rise, seen = _filled(time, grasps["t_surface"].values - base[:, None])
    fit = _RiseFit(time, rise, seen)
    unit = "1" if divide else "K"
    table = {
        "level": (base, "degC"),
        "level_drift": (_slope(time, rise, seen, -np.inf, -0.5), "K/s"),
        "onset": (fit.onset, "s"),
        "initial_slope": (fit.slope / scale, f"{unit}/s"),
        **{f"response_{t:g}s": (fit.response(t) / scale, unit) for t in reach},
        "fitted_rise": (np.where(fit.last >= _LEAST_FIT, fit.rise, np.nan) / scale, unit),
        "log_time_constant": (np.where(fit.last >= _LEAST_FIT, fit.log_tau, np.nan), "ln s"),
        "late_slope": (_slope(time, rise, seen, 5.0, FIT_END) / scale, f"{unit}/s"),
    }
    return xr.DataArray(
        np.column_stack([values for values, _ in table.values()]),
        dims=("grasp", "feature"),
        coords={
            "grasp": grasps["grasp"].values,
            "feature": list(table),
            "unit": ("feature", [unit for _, unit in table.values()]),
        },
        name="features",
    )


def linear_features(grasps: Grasps, times: Sequence[float]) -> xr.DataArray:
    """Return the changes at some times after the message [s], ``change_<t>s`` [K], and ``late_slope`` [K/s]
    of each grasp, (n_grasp, n): sums of samples less the level before contact; NaN where a trace ends
    before."""
    time = np.asarray(grasps["time"].values, dtype=float)
    rise, seen = _filled(time, grasps["t_surface"].values - level(grasps)[:, None])
    last = np.max(np.where(seen > 0, time, -np.inf), axis=1)
    names = [*(f"change_{t:g}s" for t in times), "late_slope"]
    values = np.full((last.size, len(names)), np.nan)
    for end in np.unique(last):
        own = last == end
        values[own] = rise[own] @ _linear_weights(tuple(time.tolist()), tuple(names), float(end))
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
        asked = FIT_END if slope else float(name[len("change_") : -1])
        at = min(asked, last)
        used = (t >= 5.0) if slope else np.abs(t - at) <= max(_NEAR, _SHARE * at) + 1e-6
        used &= t <= (at + 1e-6 if slope else last)
        if used.sum() < (3 if slope else 1) or last < asked - max(0.06, 0.02 * asked):
            continue
        off = np.where(used, t - t[used].mean(), 0.0)
        lever = off / max(float(off @ off), 1e-12)
        weights[:, k] = lever if slope else used / used.sum() + (at - t[used].mean()) * lever
    return weights


def feature_noise(grasps: Grasps, names: Sequence[str]) -> Floats:
    """Return the covariance that the noise of the sensor, read from a trace's second differences, gives
    features in kelvin, (n_grasp, n, n); of a time constant, a ratio of responses, it is that of the fitted
    rise."""
    time = tuple(np.asarray(grasps["time"].values, dtype=float).tolist())
    shape = _noise_shape(time, tuple(names))
    noise = _sample_noise(grasps)[:, None, None] ** 2 * shape
    if "log_time_constant" in names:
        at = list(names).index("log_time_constant")
        late = grasps["t_surface"].values[:, grasps["time"].values > 1.0]
        rise = np.abs(np.nanmedian(late, axis=1) - level(grasps))
        sd = _sample_noise(grasps) * np.sqrt(_noise_shape(time, ("fitted_rise",))[0, 0])
        noise[:, at, at] = np.minimum(sd / np.maximum(rise, 1e-9), 1.0) ** 2
    return np.asarray(noise)


def _sample_noise(grasps: Grasps) -> Floats:
    """Return the sd of the noise of one sample [K], (n_grasp,)."""
    second = np.abs(np.diff(grasps["t_surface"].values, n=2, axis=1))
    seen = np.isfinite(second).any(axis=1)
    middle = np.full(second.shape[0], 0.0)
    middle[seen] = np.nanmedian(second[seen], axis=1)
    return np.asarray(np.maximum(middle / (0.6745 * np.sqrt(6.0)), _LEAST_NOISE))


@lru_cache(maxsize=16)
def _noise_shape(time: tuple[float, ...], names: tuple[str, ...]) -> Floats:
    """Return the covariance of features for samples of sd 1 when responses are small, (n, n)."""
    t = np.asarray(time)
    if all(name.startswith(_LINEAR) for name in names):
        gain = _linear_weights(time, names, time[-1]).T
    else:
        small = 1e-3  # K: the weights of the average over the grid stay those of its prior
        one_each = make_grasps(t, small * np.eye(t.size), [str(i) for i in range(t.size)])
        at = [float(name[len("response_") : -1]) for name in names if name.startswith("response_")]
        table = extract_features(one_each, normalise=False, times=at).sel(feature=list(names))
        gain = np.where(np.array(names) == "log_time_constant", 0.0, table.values).T / small
    after = t > -0.5
    shift = gain[:, after].sum(axis=1)  # of an error of the level, which the median hides above
    before = max(int(np.sum(t <= -0.5)), 3)
    return np.asarray(gain @ gain.T + np.pi / 2 / before * np.outer(shift, shift))


class _RiseFit:
    """The two-exponential rise of each trace, averaged over onset and time constant."""

    def __init__(self, time: Floats, rise: Floats, seen: Floats) -> None:
        self.time, self.data, self.seen = time, rise, seen
        onset, tau = (grid.ravel() for grid in np.meshgrid(_ONSETS, _RATES, indexing="ij"))
        shapes = _shapes(time[None, :], onset[:, None], tau[:, None])  # (2, n_grid, n_time)
        used = seen * ((time > -0.5) & (time <= FIT_END))
        gram = np.einsum("kct,lct,gt->gckl", shapes, shapes, used) + 1e-6 * np.eye(2)
        right = np.einsum("kct,gt->gck", shapes, used * rise)
        amplitude = np.linalg.solve(gram, right[..., None])[..., 0]  # (n_grasp, n_grid, 2)
        sse = np.sum(used * rise**2, axis=1)[:, None] - np.sum(amplitude * right, axis=2)
        noise = np.maximum(sse.min(axis=1, keepdims=True) / np.maximum(used.sum(axis=1), 5)[:, None], 0.03**2)
        self.weight = softmax(-0.5 * sse / noise - 0.5 * (onset / _ONSET_SD) ** 2, axis=1)
        self.onset = np.asarray(self.weight @ onset)
        self.log_tau = np.asarray(self.weight @ np.log(tau))
        a, b = amplitude[..., 0], amplitude[..., 1]
        self.rise = np.sum(self.weight * (a + b), axis=1)
        self.last = np.max(np.where(seen > 0, time, -np.inf), axis=1)
        self.slope = np.sum(self.weight * (a / tau + b / _SLOW), axis=1)
        self.curve = np.einsum("gc,gck,kct->gt", self.weight, amplitude, shapes)

    def response(self, after: float) -> Floats:
        """Return the response [K] this long after onset [s], NaN where the trace ends before."""
        at = self.onset + after
        out = np.full(at.size, np.nan)
        for i, t in enumerate(at):
            last = self.last[i]
            if t > last + 0.6:
                continue
            t = min(t, last)
            near = (self.seen[i] > 0) & (np.abs(self.time - t) <= 0.3)
            if near.any():
                residual = (self.data[i] - self.curve[i])[near].mean()
                out[i] = np.interp(t, self.time, self.curve[i]) + residual
        return out


def _shapes(time: Floats, onset: Floats, tau: Floats) -> Floats:
    s = np.maximum(time - onset, 0.0)
    return np.stack([-np.expm1(-s / tau), -np.expm1(-s / _SLOW)])


def _filled(time: Floats, rise: Floats) -> tuple[Floats, Floats]:
    """Return the traces with lost samples interpolated, and 1.0 where a trace has begun and not ended."""
    out, seen = np.zeros_like(rise), np.zeros_like(rise)
    for i, row in enumerate(rise):
        ok = np.isfinite(row)
        out[i] = np.interp(time, time[ok], row[ok])
        seen[i] = (time >= time[ok][0]) & (time <= time[ok][-1])
    return out, seen


def _slope(time: Floats, rise: Floats, seen: Floats, start: float, stop: float) -> Floats:
    weight = seen * ((time >= start) & (time <= stop))
    n = weight.sum(axis=1)
    safe = np.maximum(n, 1)
    t = time - ((weight @ time) / safe)[:, None]
    spread = np.sum(weight * t**2, axis=1)
    slope = np.sum(weight * t * rise, axis=1) / np.maximum(spread, 1e-12)
    last = np.max(np.where(seen > 0, time, -np.inf), axis=1)
    return np.where((n >= 3) & (last >= stop - 1.0), slope, np.nan)
