"""The peer of the timing: one rig's grey box, written by hand for that rig alone.

It shares nothing with thermogrip but the log reader.  States: heatsink, wall, water, 12 + 12 cells of tube
water, each with its piece of tube wall, finger water, pipe, foam, two sensors: 56 in all.  Cells of the tubes
are implicit and upwind, finger and pipe an implicit pair, sensors exact lags, everything else Heun; steps of
0.5 s, bins of 5 s.  The Peltier's current is i = g (u + u0), g = 1 heating and g_neg cooling, and droops with
the module's temperature difference:

    wall       S i T_wall / 300 + R i^2 / 2 + K (T_sink - T_wall)
    heatsink  -S i T_sink / 300 + R i^2 / 2 - K (T_sink - T_wall) - G_h (T_sink - T_air)

23 parameters with priors; ``scipy.optimize.least_squares`` with 2-point differences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from thermogrip.datasets.schema import Log

__all__ = ["PRIOR", "HandFit", "fit_by_hand"]

Array = NDArray[np.float64]

STEP, BIN, CELLS = 0.5, 5.0, 12
INDEPENDENT = 60.0  # [s] per independent residual
SD = (0.10, 0.07)  # tank, surface [degC]

#: name: (median, sd, whether of the logarithm)
PRIOR = {
    "S": (100.0, 1.4, True), "R": (60.0, 1.4, True), "K": (1.5, 1.4, True), "C_sink": (400.0, 1.4, True),
    "G_sink": (8.0, 1.4, True), "u0": (0.0, 0.07, False), "g_neg": (1.0, 0.28, False),
    "C_wall": (60.0, 1.4, True), "G_wall": (60.0, 1.4, True), "G_tank": (0.5, 1.4, True),
    "flow": (25.0, 1.0, True), "delay_out": (3.0, 0.86, True), "delay_back": (3.0, 0.86, True),
    "G_tube": (0.15, 1.4, True), "C_tube": (40.0, 1.1, True), "film": (8.0, 1.1, True),
    "film_off": (0.5, 1.0, True), "C_finger": (6.0, 1.1, True), "lag_tank": (1.5, 1.0, True),
    "G_pipe": (0.05, 1.4, True), "C_foam": (20.0, 1.4, True), "G_foam": (0.1, 1.4, True),
    "droop": (0.0, 0.14, False),
}  # fmt: skip


@njit(cache=True, error_model="numpy")
def _peltier(p: Array, u: float, wall: float, sink: float) -> tuple[float, float]:  # pragma: no cover
    """Heat into wall and heatsink [W]."""
    v = u + p[5]
    i = v if v > 0 else p[6] * v
    i *= 1.0 - p[22] * (wall - sink) / 50.0 * np.sign(v)
    joule, across = 0.5 * p[1] * i * i, p[2] * (sink - wall)
    face = p[0] * i * (wall + 273.15) / 300.0 + joule + across
    back = -p[0] * i * (sink + 273.15) / 300.0 + joule - across
    return face, back


@njit(cache=True, error_model="numpy")
def _slow(
    p: Array, u: float, air: float, s: Array, arriving: float, flow: float, pipe: float, ds: Array
) -> None:
    """Rates of heatsink, wall, water and foam [K/s]."""
    face, back = _peltier(p, u, s[1], s[0])
    across = p[8] * (s[2] - s[1])
    ds[0] = (back - p[4] * (s[0] - air)) / p[3]
    ds[1] = (face + across) / p[7]
    ds[2] = (-across - p[9] * (s[2] - air) + flow * (arriving - s[2])) / 900.0
    ds[3] = (p[21] * (pipe - s[3]) + 0.02 * (air - s[3])) / p[20]


@njit(cache=True, error_model="numpy")
def _tube(
    p: Array, water: Array, wall: Array, inlet: float, flow: float, film: float, delay: float, air: float
) -> float:
    """Move the water and the wall of one tube a step on; return what leaves it."""
    n = len(water)
    c, c_wall = p[10] * delay / n, p[14] / n
    g, loss = film / n, p[13] / n
    a, b = STEP * flow / c, STEP * g / c
    e, f = STEP * g / c_wall, STEP * loss / c_wall
    for k in range(n):  # implicit in both, the wall eliminated
        held = (wall[k] + f * air) / (1.0 + e + f)
        water[k] = (water[k] + a * inlet + b * held) / (1.0 + a + b - b * e / (1.0 + e + f))
        wall[k] = held + e / (1.0 + e + f) * water[k]
        inlet = water[k]
    return inlet


@njit(cache=True, error_model="numpy")
def _simulate(p: Array, u: Array, pump: Array, air: Array, start: float, out: Array) -> None:
    """Fill out (n + 1, 2) with the readings of tank and surface."""
    s, first, second, tried = np.full(4, start), np.empty(4), np.empty(4), np.empty(4)
    water, wall = np.full((2, CELLS), start), np.full((2, CELLS), start)
    finger = pipe = tank = surface = start
    out[0, 0] = out[0, 1] = start
    stay_tank, stay_surface = np.exp(-STEP / p[18]), np.exp(-STEP / 0.5)
    for t in range(len(u)):
        on = pump[t]
        flow = p[10] * (on + 0.003 * (1.0 - on))
        film = p[15] * (on + min(p[16], 1.0) * (1.0 - on))
        arriving = water[1, CELLS - 1]
        _slow(p, u[t], air[t], s, arriving, flow, pipe, first)
        for i in range(4):
            tried[i] = s[i] + STEP * first[i]
        _slow(p, u[t], air[t], tried, arriving, flow, pipe, second)
        for i in range(4):
            s[i] += 0.5 * STEP * (first[i] + second[i])
        supplied = _tube(p, water[0], wall[0], s[2], flow, film, p[11], air[t])
        a, b = STEP * flow / p[17], STEP * 2.0 / p[17]  # finger: from the tube, to the pipe
        c, d, e = STEP * 2.0 / 4.0, STEP * p[19] / 4.0, STEP * p[21] / 4.0  # pipe: finger, air, foam
        right, row = pipe + d * air[t] + e * s[3], 1.0 + c + d + e
        finger = (finger + a * supplied + b * right / row) / (1.0 + a + b - b * c / row)
        pipe = (right + c * finger) / row
        _tube(p, water[1], wall[1], finger, flow, film, p[12], air[t])
        tank = s[2] + (tank - s[2]) * stay_tank
        surface = pipe + (surface - pipe) * stay_surface
        out[t + 1, 0], out[t + 1, 1] = tank, surface


class _Record:
    """One log on the grid, and the bins of its readings."""

    def __init__(self, log: Log) -> None:
        time = log["time"].values - log["time"].values[0]
        n = int(np.ceil(time[-1] / STEP))
        edges = STEP * np.arange(n + 1)
        gap = int(np.argmax(np.diff(time)))
        held = time.copy()
        if np.diff(time)[gap] > 10.0:  # the input is taken to have moved in the middle of the gap
            held[gap + 1] = (time[gap] + time[gap + 1]) / 2
        self.u, self.pump = (self._mean(held, log[name].values, edges) for name in ("drive", "pump"))
        early = time <= 5.0
        tank, surface = log["t_tank"].values, log["t_surface"].values
        self.start = float(np.nanmean(tank[early]))
        ambient = log["t_ambient"].values
        half = max(1, int(20.0 / np.median(np.diff(time)) / 2))
        smooth = np.convolve(
            np.pad(ambient, half, mode="edge"), np.ones(2 * half + 1) / (2 * half + 1), "valid"
        )
        self.air = self._mean(time, smooth, edges) - (float(ambient[early].mean()) - self.start)
        self.offset = float(np.nanmean(surface[early])) - self.start
        cell = np.minimum((time / BIN).astype(int), int(n * STEP / BIN) - 1)
        self.parts = []
        for values, offset in ((tank, 0.0), (surface, self.offset)):
            ok = np.isfinite(values)
            _, where, count = np.unique(cell[ok], return_inverse=True, return_counts=True)
            mean = np.bincount(where, values[ok] - offset) / count
            self.parts.append((np.minimum(time[ok] / STEP, n - 1e-9), where, count, mean))
        self.out = np.empty((n + 1, 2))

    @staticmethod
    def _mean(time: Array, values: Array, edges: Array) -> Array:
        """Exact mean of the held values over each step."""
        area = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
        at = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, len(time) - 1)
        total = area[at] + values[at] * (edges - time[at])
        return np.asarray(np.diff(total) / STEP)

    def errors(self, p: Array) -> list[Array]:
        """Model less reading in each bin, tank and surface [degC]."""
        _simulate(p, self.u, self.pump, self.air, self.start, self.out)
        out = []
        for k, (place, where, count, mean) in enumerate(self.parts):
            left = place.astype(int)
            run = self.out[left, k] + (place - left) * (self.out[left + 1, k] - self.out[left, k])
            out.append(np.bincount(where, run) / count - mean)
        return out


class HandFit:
    """What the fit found: ``values`` by name, ``rmse`` of the bins' surface by log, ``evaluations``."""

    def __init__(
        self, result: OptimizeResult, natural: Callable[[Array], Array], records: Mapping[str, _Record]
    ):
        p = natural(result.x)
        self.z, self.evaluations, self.cost = result.x, int(result.nfev), 2 * float(result.cost)
        self.values = dict(zip(PRIOR, p.tolist()))
        self.rmse = {name: float(np.sqrt(np.mean(r.errors(p)[1] ** 2))) for name, r in records.items()}


def fit_by_hand(logs: Mapping[str, Log], near: Any = None, *, tolerance: float = 1e-5) -> HandFit:
    """Fit all logs, from the prior medians or from ``near``, the ``z`` of an earlier fit."""
    median, sd, is_log = (np.array(column) for column in zip(*PRIOR.values()))
    centre = np.where(is_log, np.log(np.where(is_log, median, 1.0)), median)

    def natural(z: Array) -> Array:
        theta = centre + sd * z
        return np.where(is_log, np.exp(np.where(is_log, theta, 0.0)), theta)

    records = {name: _Record(log) for name, log in logs.items()}
    weight = [1.0 / (s * np.sqrt(INDEPENDENT / BIN)) for s in SD]

    def residuals(z: Array) -> Array:
        p = natural(z)
        parts = [w * e for record in records.values() for w, e in zip(weight, record.errors(p))]
        return np.concatenate([*parts, z])

    first = np.zeros(len(PRIOR)) if near is None else np.asarray(near)
    result = least_squares(residuals, first, bounds=(-4.0, 4.0), diff_step=1e-4, ftol=tolerance, xtol=1e-8)
    return HandFit(result, natural, records)
