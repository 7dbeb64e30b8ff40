"""Free run of a plant over a log: the start, the gaps.

**Start.**  What a log does not say is estimated from its warm-up, the first few seconds, and from nothing
later: x0 = x_rest + s with s ~ N(0, P) and sensor offsets o ~ N(pooled, q^2), but for a log that starts at
rest.

**Gaps.**  Over a gap of more than 10 s the input is unknown, and the 60 s after it are not scored.
``gaps="hold"`` holds the last row instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.models.state_space import symmetric_root
from thermogrip.sysid.plant.log_grid import Stretch

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model
    from thermogrip.sysid.plant.plant_data import PlantData

AFTER_GAP = 60.0  # [s] unscored after a gap


@dataclass(frozen=True)
class StartSettings:
    """When a log is at rest, and how a start is looked for."""

    rest_band: float = 1.0  # [K] between any two sensors of a rig at rest
    rest_s: float = 5.0  # at most, for the drive may move the rig at once
    least_noise: float = 1e-6  # of a plant that was fitted to readings without any, in their unit
    rounding: float = 1e-8  # of the largest sd of the state: eigenvalues are known to 1e-16 of it


START = StartSettings()

READING_EVERY = 10.0  # [s] between independent readings of a warm-up, for the model's error is not white


@dataclass(frozen=True, eq=False)
class Start:
    """How a stretch begins."""

    x0: Array  # (n_x,) the state at the parameters that it was estimated with
    # (n_x,) x0 minus the state at rest of the readings without their offsets, or minus the state propagated
    # through the gap
    shift: Array
    y_offset: Array  # (n_y,) reading minus model, as the warm-up says
    d_offset: Array  # (n_d,)
    level: float | None  # the uniform temperature of a log that starts at rest
    how: str  # one clause for notes
    fading: Array | float = 0.0  # (n_y,) share of y_offset that fades
    memory: float = np.inf  # [s] in which it falls to 1/e
    warm: float = 0.0  # middle of the warm-up, after which it fades, in seconds of this stretch

    def moved(self, step: Array) -> Start:
        """Return the start with its state moved by a step (n_x,)."""
        return replace(self, x0=self.x0 + step, shift=self.shift + step)

    def offset(self, time: Array) -> Array:
        """Return the offset (n, n_y) at seconds ``time`` of the stretch; (n_y,) of one that lasts."""
        if np.isinf(self.memory):
            return self.y_offset
        # where the fit found that a log's own offset fades, it does to the pooled one
        lost = -np.expm1(-np.maximum(time - self.warm, 0.0) / self.memory)
        return np.asarray(self.y_offset - self.fading * lost[:, None])


def find_starts(plant: PlantData, p: Array, stretches: Sequence[Stretch], warmup: float) -> list[Start]:
    """Estimate how each stretch of one log begins, from its own first ``warmup`` seconds."""
    starts = [_first_start(plant, p, stretches[0], warmup)]
    for before, stretch in pairwise(stretches):
        starts.append(_after_gap(plant, p, before, stretch, starts[-1], warmup))
    return starts


def predict(
    model: Model, dt: float, p: Array, stretches: Sequence[Stretch], starts: Sequence[Start]
) -> list[Array]:
    """Simulate the stretches of one log for a batch of parameters; starts' shifts and offsets are held
    relative to the state at rest, or propagated through a gap, of these parameters."""
    out: list[Array] = []
    x_end = np.empty((len(p), model.n_x))
    for index, (stretch, start) in enumerate(zip(stretches, starts)):
        d = stretch.d - start.d_offset
        if index == 0:
            x0 = np.repeat(start.x0[None], len(p), axis=0)
            if start.level is None and len(p) > 1:
                x0 = _at_rest(model, p, stretch, start) + start.shift
        else:
            u_gap, d_gap, dt_gap = _through_gap(stretches[index - 1], stretch, start, dt)
            x0 = model.rollout(x_end, u_gap[None], d_gap[None], p, dt_gap)[1] + start.shift
        y, x_end = model.rollout(x0, stretch.u[None], d[None], p, dt)
        out.append(y + start.offset(dt * np.arange(y.shape[1], dtype=np.float64)))
    return out


class _GapInputs(NamedTuple):
    """What acts through a gap, a step of ``dt`` [s] each."""

    u: Array  # (N, n_u)
    d: Array  # (N, n_d)
    dt: float


def _at_rest(model: Model, p: Array, stretch: Stretch, start: Start) -> Array:
    """Return the states (k, n_x) at rest of the first readings and ambients without their offsets."""
    y, d = _first_reading(stretch) - start.y_offset, stretch.d[0] - start.d_offset
    if hasattr(model, "rest_of_each"):  # a fit asks for hundreds
        return np.asarray(model.rest_of_each(y, stretch.u[0], d, p))
    return np.array([model.rest(y, stretch.u[0], d, row) for row in p])


def _first_reading(stretch: Stretch) -> Array:
    """Return the mean reading of the first 2 s, and of the first row that is read where all are lost."""
    out = np.full(stretch.y.shape[1], np.nan)
    for k, y in enumerate(stretch.y.T):
        is_read = np.isfinite(y) & (stretch.time < 60)
        if is_read.any():
            early = y[is_read & (stretch.time <= 2.0)]
            out[k] = early.mean() if early.size else y[is_read][0]
    return out


def _first_start(plant: PlantData, p: Array, stretch: Stretch, warmup: float) -> Start:
    at_rest = _readings_at_rest(plant, stretch, warmup)
    y_offset = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
    d_offset = np.array([plant.offsets.get(name, 0.0) for name in plant.disturbances])
    zero = np.zeros(plant.model.n_x)
    if at_rest is None:
        start = Start(zero, zero, y_offset, d_offset, None, "started from its warm-up")
        x0 = _at_rest(plant.model, p[None], stretch, start)[0]
        start = _corrected(plant, p, stretch, replace(start, x0=x0), warmup, offsets=True)
        # the state at rest for other parameters is that of readings without the offsets that were found
        start = replace(start, shift=start.x0 - _at_rest(plant.model, p[None], stretch, start)[0])
        return replace(start, fading=start.y_offset - y_offset, memory=plant.offset_memory, warm=warmup / 2)
    y_mean, d_mean = at_rest
    T0 = float(y_mean[plant.outputs.index(str(plant.reference))])
    y_own = np.array([plant.nuisance.get(name, 0.0) > 0 for name in plant.outputs], dtype=bool)
    d_own = np.array([plant.nuisance.get(name, 0.0) > 0 for name in plant.disturbances], dtype=bool)
    y_offset = np.where(y_own, y_mean - T0, y_offset)
    d_offset = np.where(d_own, d_mean - T0, d_offset)
    y0, d0 = np.full(len(plant.outputs), T0), np.where(d_own, T0, d_mean - d_offset)
    x0 = plant.model.rest(y0, stretch.u[0], d0, p)
    return Start(x0, zero, y_offset, d_offset, T0, f"started at rest at {T0:.2f} degC")


def _readings_at_rest(plant: PlantData, stretch: Stretch, warmup: float) -> tuple[Array, Array] | None:
    """Return the mean readings and ambients of a log that starts at rest, None of another."""
    if plant.reference is None or not plant.disturbances:
        return None
    seconds = min(warmup, START.rest_s)
    early = stretch.time <= seconds
    if not np.isfinite(stretch.y[early]).any(axis=0).all():
        return None
    # at rest all sensors, the ambient's among them, read the same, the temperature of the reference sensor:
    # what another reads beside it is its offset in this log
    y = np.nanmean(stretch.y[early], axis=0)
    d = stretch.d[: max(1, round(seconds / plant.dt))].mean(axis=0)
    return None if np.ptp(np.concatenate([y, d])) > START.rest_band else (y, d)


def _corrected(
    plant: PlantData, p: Array, stretch: Stretch, start: Start, warmup: float, *, offsets: bool
) -> Start:
    """Shift the start (and, if asked, the sensor offsets) to what the warm-up says."""
    pooled = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
    free = np.array([plant.nuisance.get(name, 0.0) for name in plant.outputs]) * float(offsets)
    root = symmetric_root(plant.model.spread)
    size = np.linalg.norm(root, axis=0)  # its columns are orthogonal
    along = np.divide(root, size**2, out=np.zeros_like(root), where=size > START.rounding * size.max())
    # readings of the warm-up are linear in (s, o) to first order: a ridge regression, done twice
    for _ in range(2):
        residual, response, sd = _warm(plant, p, stretch, start, warmup)
        blocks = [response @ root, np.tile(np.diag(free / sd), (len(response) // free.size, 1))]
        is_read = np.isfinite(residual)
        A, r = np.hstack(blocks)[is_read], residual[is_read]
        # the prior is about the first guess, so what was moved before counts
        beside = np.divide(start.y_offset - pooled, free, out=np.zeros(len(free)), where=free > 0)
        moved = np.concatenate([along.T @ start.shift, beside])
        # min |A s - r|^2 + |s + moved|^2 within the directions that the few rows of A see
        axes, triangle = np.linalg.qr(A.T)
        rows = np.vstack([triangle.T, np.eye(len(triangle))])
        right = np.append(r + A @ moved, np.zeros(len(triangle)))
        step = axes @ np.linalg.lstsq(rows, right, rcond=None)[0] - moved
        shift = root @ step[: plant.model.n_x]
        start = replace(
            start,
            x0=start.x0 + shift,
            shift=start.shift + shift,
            y_offset=start.y_offset + free * step[plant.model.n_x :],
        )
    return start


def _after_gap(
    plant: PlantData, p: Array, before: Stretch, stretch: Stretch, start: Start, warmup: float
) -> Start:
    """Return the start after a gap: the state propagated through it, and corrected like a start."""
    x = plant.model.rollout(
        start.x0[None], before.u[None], before.d[None] - start.d_offset, p[None], plant.dt
    )[1]
    u, d, dt = _through_gap(before, stretch, start, plant.dt)
    x0 = plant.model.rollout(x, u[None], d[None], p[None], dt)[1][0]
    how = f"propagated through a gap of {stretch.gap:.1f} s"
    if not np.array_equal(before.u[-1], stretch.u[0]):
        how += "; the input is taken to have changed in its middle"
    warm = start.warm - before.time[-1] - stretch.gap
    start_after = replace(start, x0=x0, level=None, shift=np.zeros_like(x0), warm=warm, how=how)
    return _corrected(plant, p, stretch, start_after, warmup, offsets=False)


def _through_gap(before: Stretch, after: Stretch, start: Start, dt: float) -> _GapInputs:
    """Return what acts through the gap before ``after``."""
    length = after.gap - (before.u.shape[0] * dt - before.time[-1])  # the grid may end past the last row
    n = max(1, round(length / dt))
    share_of_gap = ((np.arange(n) + 0.5) / n)[:, None]
    unchanged = np.clip(0.5 * n - np.arange(n), 0.0, 1.0)[:, None]
    # searched for by what fits the warm-up best, the time of the change moved no error of the rig's logs, one
    # of which lacks 39 s, by more than 1 per cent
    u = unchanged * before.u[-1] + (1 - unchanged) * after.u[0]
    d = (1 - share_of_gap) * before.d[-1] + share_of_gap * after.d[0] - start.d_offset
    return _GapInputs(u, d, max(length, 1e-3) / n)


def _warm(
    plant: PlantData, p: Array, stretch: Stretch, start: Start, warmup: float
) -> tuple[Array, Array, Array]:
    """Return residuals (n_r,) of the warm-up, their response (n_r, n_x) to the start [sd], and sd (n_y,)."""
    n = min(len(stretch.u), max(1, int(np.ceil(warmup / plant.dt - 1e-9))))
    y = _binned(stretch, plant.dt, n, warmup) - start.offset(plant.dt * np.arange(n + 1, dtype=np.float64))
    size = 1e-3 * np.sqrt(np.diag(plant.model.spread))
    around = np.vstack([start.x0, start.x0 + np.diag(size)])
    u, d = stretch.u[None, :n], stretch.d[None, :n] - start.d_offset
    run = plant.model.rollout(around, u, d, p[None], plant.dt)[0]
    # of each bin of the warm-up: together one reading per 10 s
    noise = np.array([max(plant.noise.get(name, 0.1), START.least_noise) for name in plant.outputs])
    sd = noise * np.sqrt((n + 1) / min(1 + n * plant.dt / READING_EVERY, n + 1))
    response = ((run[1:] - run[0]) / sd).reshape(len(size), -1).T / size
    return ((y - run[0]) / sd).ravel(), response, sd


def _binned(stretch: Stretch, dt: float, n: int, warmup: float) -> Array:
    """Return mean readings (n + 1, n_y) around the grid's times, NaN where none is within the warm-up."""
    early = stretch.time <= warmup + 1e-9
    cell = np.minimum(np.round(stretch.time[early] / dt).astype(int), n)
    out = np.full((n + 1, stretch.y.shape[1]), np.nan)
    for k in range(out.shape[1]):
        is_read = np.isfinite(stretch.y[early, k])
        count = np.bincount(cell[is_read], minlength=n + 1)
        total = np.bincount(cell[is_read], weights=stretch.y[early, k][is_read], minlength=n + 1)
        out[count > 0, k] = total[count > 0] / count[count > 0]
    return out
