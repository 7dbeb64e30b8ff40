"""Logs against a plant: residuals of batches of parameters, averaged over bins, and their likelihood.

**Data.**  Each log is put on the model's step, cut at its gaps, and averaged over bins of ``average``
seconds; the model is simulated at its step and averaged over the same samples.  Averaging throws away what is
faster than a bin (a delay is then known less well, and the interval says so), it makes the sensor's noise and
rounding Gaussian and small, and it keeps the covariance matrices of a log at a few hundred rows.

**Start.**  State and sensor offsets at the start of a log, and the state after a gap, are those of the free
run (:mod:`~thermogrip.sysid.simulation`), from the first seconds.  What is left unknown of them is a
nuisance: the state with the model's spread (ten times that after a gap), the offsets with 0.05 K where the
log began at rest and so measured them, else with the spread that the plant states (``Plant.nuisance``).

**Likelihood.**  With z the free parameters in prior standard deviations from the prior mean, split into
sampled z_s and others z_o, the residual is r(z_s) - J_o (z_o - z_o,ref); J_o is taken at the reference.  With
C of :mod:`~thermogrip.sysid.discrepancy`, W W' = C^-1, e = W'(r + J_o z_o,ref) and B = W' J_o,

    ln L(z_s) = -1/2 [ e'e - e'B (1 + B'B)^-1 B'e ] + const,

which has z_o integrated out over its prior.  Given z_s, z_o is Gaussian about (1 + B'B)^-1 B'e, so full
parameter vectors can be drawn afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.discrepancy import Discrepancy, LogResiduals
from thermogrip.sysid.plant import Plant
from thermogrip.sysid.segments import Segment, make_grid, quantum, sample_time
from thermogrip.sysid.simulation import cut_stretches, find_starts

__all__ = ["Bins", "Likelihood", "Prior", "linearise", "make_bins", "prior_of"]

Array = NDArray[np.float64]

_BINS_PER_LOG = 150  # of the longest log: the covariance of a log then has a few hundred rows
_AFTER_GAP = 10.0  # the start after a gap is this much less certain than at rest
_MEASURED = 0.05  # [K] what a start at rest leaves unknown of an offset: rounding, drift, a room not uniform
WARMUP = 5.0  # [s] whose readings set the start
_MODES = 1e-3  # [K] start directions that move no bin by more are left out


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal prior of theta = ln p or p of each free parameter, and the bounds of p.

    ``mean``, ``sd``, ``low``, ``high`` have shape (n_free,); ``log`` says which are logarithms.
    """

    names: tuple[str, ...]
    mean: Array
    sd: Array
    log: NDArray[np.bool_]
    low: Array
    high: Array

    def natural(self, z: Array) -> Array:
        """Return parameters (..., n_free) in natural units from prior units."""
        theta = self.mean + self.sd * z
        return np.where(self.log, np.exp(np.where(self.log, theta, 0.0)), theta)

    def standard(self, p: Array) -> Array:
        """Return parameters (..., n_free) in prior units from natural ones."""
        theta = np.where(self.log, np.log(np.where(self.log, p, 1.0)), p)
        return np.asarray((theta - self.mean) / self.sd)

    def inside(self, p: Array) -> NDArray[np.bool_]:
        """Say which rows of parameters lie inside all bounds."""
        return np.asarray(np.all((p >= self.low) & (p <= self.high), axis=-1))


def prior_of(plant: Plant) -> Prior:
    """Return the prior of the plant's free parameters.

    A network states one; for another model it is ten standard deviations of the fit about the fit.

    Raises
    ------
    UserError
        If the plant has no free parameter, or neither a prior nor a covariance.
    """
    if not plant.free:
        raise UserError("the plant has no free parameter", mend="fit a network first")
    specs = getattr(plant.model, "specs", {})
    log = np.array([plant.scales.get(name) == "log" for name in plant.free])
    at = np.array([plant.values[name] for name in plant.free])
    at = np.where(log, np.log(np.where(log, at, 1.0)), at)
    mean, sd = at.copy(), np.full(at.size, np.nan)
    for i, name in enumerate(plant.free):
        spec = specs.get(name)
        if spec is not None and (spec.sd_log or spec.sd):
            mean[i] = np.log(spec.value) if log[i] else spec.value
            sd[i] = spec.sd_log if log[i] else spec.sd
        elif plant.covariance is not None:
            sd[i] = 10 * np.sqrt(plant.covariance[i, i])
    if not np.all(sd > 0):
        lost = ", ".join(np.array(plant.free)[~(sd > 0)])
        raise UserError(f"{lost} has neither prior nor covariance", mend="fit the plant again")
    bounds = [plant.bounds.get(name, (-np.inf, np.inf)) for name in plant.free]
    low, high = np.array(bounds, dtype=float).T
    return Prior(plant.free, mean, sd, log, low, high)


@dataclass(frozen=True, eq=False)
class _Stretch:
    """A segment of a log with its bins of m samples, which of them are read, and its start."""

    segment: Segment
    x0: Array
    spread: Array
    m: int
    read: NDArray[np.bool_]  # (n_bin, m, n_y)
    measured: bool  # whether the log's start at rest has measured its sensors' offsets

    def averaged(self, y: Array) -> Array:
        """Return the means (B, n_used) of outputs y (B, >= n_bin m, n_y) over the used bins."""
        n_bin, m, n_y = self.read.shape
        rows = y[:, : n_bin * m].reshape(-1, n_bin, m, n_y)
        count = self.read.sum(axis=1)
        mean = np.einsum("bimj,imj->bij", rows, self.read.astype(float)) / np.maximum(count, 1)
        return np.asarray(mean[:, self.used])

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Bins (n_bin, n_y) in which at least half of the samples are read."""
        return np.asarray(self.read.sum(axis=1) >= 0.5 * self.m)


@dataclass(frozen=True, eq=False)
class Bins:
    """Logs, averaged, with all that is needed to simulate them; from :func:`make_bins`."""

    plant: Plant
    prior: Prior
    logs: tuple[tuple[str, tuple[_Stretch, ...]], ...]
    dt: float
    average: float
    nuisance: Mapping[str, float]
    sensor: Array  # (n_y,) sd of one sample [K]
    correction: tuple[Array, ...] = ()  # added to the residuals, one array a log [K]

    def residuals(self, z: Array, *, ambient: float = 0.0) -> list[Array]:
        """Return reading less model, a (B, n) array per log, for parameters z (B, n_free) in prior units.

        ``ambient`` is added to every measured disturbance.
        """
        p = np.tile(self.plant.p, (len(z), 1))
        at = [self.plant.model.parameters.index(name) for name in self.prior.names]
        p[:, at] = self.prior.natural(z)
        out = [
            np.hstack([self._residual(s, p, ambient, s.x0) for s in stretches]) for _, stretches in self.logs
        ]
        return [r + change for r, change in zip(out, self.correction)] if self.correction else out

    def keys(self) -> list[list[tuple[float, int]]]:
        """Return time and output of each residual, a list per log."""
        layouts = [_layout(self, stretches)[:2] for _, stretches in self.logs]
        return [list(zip(np.round(time, 3).tolist(), output.tolist())) for time, output in layouts]

    def _residual(self, stretch: _Stretch, p: Array, ambient: float, x0: Array) -> Array:
        """Return the residuals (B, n_used) of one stretch."""
        segment = stretch.segment
        start = np.broadcast_to(x0, (len(p), x0.shape[-1]))
        y, _ = self.plant.model.rollout(start, segment.u[None], segment.d[None] + ambient, p, self.dt)
        return stretch.averaged(np.nan_to_num(segment.y[None])) - stretch.averaged(y)


def make_bins(
    plant: Plant, logs: Sequence[Log], *, average: float | None = None, step: float | None = None
) -> Bins:
    """Return the logs averaged for the plant's likelihood.

    Parameters
    ----------
    plant : Plant
    logs : sequence of Log
    average : float, optional
        Bin width [s]; default a 150th of the longest log, at least the model's step.
    step : float, optional
        Step of the simulation [s]; default the plant's own.

    Raises
    ------
    UserError
        If a signal of the plant is missing in a log, or a log is shorter than ten bins.
    """
    model = plant.model
    names = {"inputs": model.inputs, "outputs": model.outputs, "disturbances": model.disturbances}
    dt = max(step or plant.dt, max((sample_time(log) for log in logs), default=0.0))
    grids = [make_grid([log], **names, average=dt, min_rows=10) for log in logs]
    longest = max((sum(s.time.size for s in grid.segments) for grid in grids), default=0) * dt
    if average is None:  # whole multiples of a step four times as long, so that both have the same bins
        m = 4 * max(1, round(longest / _BINS_PER_LOG / (4 * dt)))
    else:
        m = max(1, round(average / dt))
    made = []
    for log, grid in zip(logs, grids):
        stretches = _stretches(plant, log, [s for s in grid.segments if s.time.size >= m], m, dt)
        if sum(int(s.used.any(axis=1).sum()) for s in stretches) < 10:
            problem = f"is too short for bins of {m * dt:g} s"
            raise UserError(problem, file=grid.logs[0], mend="give a longer log or a smaller average")
        made.append((grid.logs[0], tuple(stretches)))
    sensor = np.array([max(_sample_noise(log, name, dt) for log in logs) for name in model.outputs])
    return Bins(plant, prior_of(plant), tuple(made), dt, m * dt, dict(plant.nuisance), sensor)


def linearise(bins: Bins, z: Array) -> list[LogResiduals]:
    """Return residuals, sensitivities and nuisances of each log at z (n_free,), by central differences."""
    n, step = z.size, 0.01
    moves = np.vstack([z, z + step * np.eye(n), z - step * np.eye(n)])
    all_residuals = bins.residuals(moves)
    warmer = bins.residuals(z[None], ambient=0.1)
    out = []
    for (name, stretches), r, w in zip(bins.logs, all_residuals, warmer):
        time, output, noise = _layout(bins, stretches)
        sensitivity = -(r[1 : n + 1] - r[n + 1 :]).T / (2 * step)
        local = _local(bins, stretches, z, output, (r[0] - w[0]) / 0.1)
        out.append(LogResiduals(name, time, output, r[0], noise, local, sensitivity))
    return out


class Likelihood:
    """The log posterior of some of the parameters, the others integrated out.

    Parameters
    ----------
    bins : Bins
    linear : list of LogResiduals
        At the reference.
    at : (n_free,) ndarray
        The reference, in prior units.
    discrepancy : Discrepancy
    sampled : sequence of int
        Which parameters are sampled; the others are integrated out.
    """

    def __init__(
        self,
        bins: Bins,
        linear: Sequence[LogResiduals],
        at: Array,
        discrepancy: Discrepancy,
        sampled: Sequence[int],
    ) -> None:
        self.bins, self.at = bins, np.asarray(at, dtype=float)
        self.sampled = np.array(sampled, dtype=int)
        self.others = np.setdiff1d(np.arange(self.at.size), self.sampled)
        self._roots = [cholesky(discrepancy.covariance(log), lower=True) for log in linear]
        self._shift = [log.sensitivity[:, self.others] @ self.at[self.others] for log in linear]
        whitened = [
            solve_triangular(root, log.sensitivity[:, self.others], lower=True)
            for root, log in zip(self._roots, linear)
        ]
        self._b = np.vstack(whitened)
        self._factor = cho_factor(np.eye(self.others.size) + self._b.T @ self._b, lower=True)

    def log_posterior(self, z: Array) -> Array:
        """Return ln posterior (B,), up to a constant, at sampled z (B, n_sampled) in prior units."""
        z = np.atleast_2d(z)
        full = self._full(z)
        out = np.full(len(z), -np.inf)
        ok = self.bins.prior.inside(self.bins.prior.natural(full))
        if ok.any():
            e, pull = self._whitened(full[ok])
            explained = np.einsum("bi,ib->b", pull, cho_solve(self._factor, pull.T))
            out[ok] = -0.5 * (np.einsum("bi,bi->b", e, e) - explained + np.einsum("bi,bi->b", z[ok], z[ok]))
        out[~np.isfinite(out)] = -np.inf  # a run that blew up
        return out

    def complete(self, z: Array, rng: np.random.Generator) -> Array:
        """Return all free parameters (B, n_free) in prior units, the others drawn given the sampled ones."""
        full = self._full(np.atleast_2d(z))
        _, pull = self._whitened(full)
        mean = cho_solve(self._factor, pull.T).T
        normal = rng.standard_normal(mean.shape).T
        full[:, self.others] = mean + solve_triangular(self._factor[0], normal, lower=True, trans="T").T
        return full

    def _full(self, z: Array) -> Array:
        """Return parameter vectors with the others at the reference."""
        full = np.tile(self.at, (len(z), 1))
        full[:, self.sampled] = z
        return full

    def _whitened(self, full: Array) -> tuple[Array, Array]:
        """Return the whitened residuals (B, n) about the others' prior mean, and B'e (B, n_others)."""
        residuals = self.bins.residuals(full)
        parts = [
            solve_triangular(root, (r + shift).T, lower=True, check_finite=False).T
            for root, r, shift in zip(self._roots, residuals, self._shift)
        ]
        e = np.hstack(parts)
        return e, e @ self._b


def _stretches(plant: Plant, log: Log, segments: Sequence[Segment], m: int, dt: float) -> list[_Stretch]:
    """Return the segments of one log with their bins and starts, known offsets taken off."""
    cut = cut_stretches(plant, log)
    starts = find_starts(plant, plant.p, cut, WARMUP)
    times = np.array([log["time"].values[piece.rows.start] for piece in cut])
    out: list[_Stretch] = []
    for segment in segments:
        k = int(np.argmin(np.abs(times - segment.time[0])))
        start, level = starts[k], starts[0].level
        y_offset, d_offset = (
            np.array([plant.offsets.get(name, 0.0) for name in names])
            for names in (plant.outputs, plant.disturbances)
        )
        if level is not None:  # the log measured them itself
            y_offset, d_offset = starts[0].y_offset, starts[0].d_offset
        n_bin = segment.time.size // m
        read = np.isfinite(segment.y[: n_bin * m]).reshape(n_bin, m, -1)
        true = replace(segment, y=segment.y - y_offset, d=segment.d - d_offset)
        spread = plant.model.spread * (1.0 if k == 0 else _AFTER_GAP**2)
        out.append(_Stretch(true, start.x0, spread, m, read, level is not None))
    return out


def _layout(bins: Bins, stretches: Sequence[_Stretch]) -> tuple[Array, NDArray[np.int64], Array]:
    """Return time, output and noise of each used bin of a log, in the order of the residuals."""
    time, output, noise = [], [], []
    for s in stretches:
        i, j = np.nonzero(s.used)
        time.append(s.segment.time[0] + (i + 0.5) * s.m * bins.dt)
        output.append(j)
        noise.append(bins.sensor[j] / np.sqrt(s.read.sum(axis=1)[i, j]))
    return np.concatenate(time), np.concatenate(output).astype(np.int64), np.concatenate(noise)


def _local(
    bins: Bins, stretches: Sequence[_Stretch], z: Array, output: NDArray[np.int64], per_degree: Array
) -> Array:
    """Return the nuisance columns (n, n_local) of one log."""
    columns = []
    most = _MEASURED if stretches[0].measured else np.inf
    for j, name in enumerate(bins.plant.outputs):
        columns.append(min(bins.nuisance.get(name, 0.0), most) * (output == j))
    bias = min(max((bins.nuisance.get(name, 0.0) for name in bins.plant.disturbances), default=0.0), most)
    columns.append(bias * per_degree)
    at = 0
    for s in stretches:
        modes = _start_modes(bins, s, z)
        rows = np.zeros((output.size, modes.shape[1]))
        rows[at : at + len(modes)] = modes
        at += len(modes)
        columns += list(rows.T)
    local = np.column_stack(columns)
    return np.asarray(local[:, np.abs(local).max(axis=0) > 0])


def _start_modes(bins: Bins, stretch: _Stretch, z: Array) -> Array:
    """Return what an uncertain start does to the bins, (n_used, n_mode), where it matters."""
    size, axes = np.linalg.eigh(stretch.spread)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    p = bins.plant.p[None].copy()
    at = [bins.plant.model.parameters.index(name) for name in bins.prior.names]
    p[:, at] = bins.prior.natural(z)
    starts = np.vstack([stretch.x0, stretch.x0 + root.T])
    r = bins._residual(stretch, np.tile(p, (len(starts), 1)), 0.0, starts)
    left, strength, _ = np.linalg.svd((r[0] - r[1:]).T, full_matrices=False)
    return np.asarray((left * strength)[:, strength > _MODES])


def _sample_noise(log: Log, name: str, dt: float) -> float:
    """Return the sd of one sample on the model's grid: second differences, where the plant hardly moves."""
    values = log[name].values
    values = values[np.isfinite(values)]
    step = sample_time(log)
    bend = values[2:] - 2 * values[1:-1] + values[:-2]
    robust = 1.4826 * float(np.median(np.abs(bend - np.median(bend)))) / np.sqrt(6.0)
    floor = max(quantum(values), 1e-9) / np.sqrt(12.0)
    return float(max(robust, floor) * np.sqrt(min(step / dt, 1.0)))
