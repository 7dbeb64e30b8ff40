"""Expected information of an experiment: temperatures that it may reach, intervals that it would leave.

**Information.** A schedule u moves the outputs y(t). With the free parameters theta (logarithms where they
are positive) of covariance P = R R' now, an experiment whose output j is read with standard deviation
sigma_j, one independent reading every tau_j seconds, adds

    F = sum_j 1 / (sigma_j^2 tau_j) integral (dy_j/dtheta) (dy_j/dtheta)' dt

and leaves (P^-1 + F)^-1 = R (1 + R'F R)^-1 R': a gain of 1/2 log2 det(1 + R'F R) bits [1]_. All is linear
about the plant's values.  Every experiment begins at rest in the room.

**A learnt error model.** A fit learns the covariance C of its residuals, random effects of each log and
model discrepancy (:mod:`thermogrip.sysid.greybox.noise_model`). With the sensitivities J of an experiment's
bins, in units of the fit's residuals, B the random effects at one sd and phi the factor by which logs
disagree, the experiment adds to the fit's Hessian A = J'J and to the covariance of its score

    V = phi (J' C J + E E'),      E = J' B,

of a start E H E', with H the covariance of what its warm-up leaves unknown
(:mod:`thermogrip.sysid.greybox.random_effects`). Discrepancy is the same in every log: its responses F of the
learnt sizes s add G = J' F s where they added U to the score of the fit, before both are squared. Sizes are
scaled anew with every fit: an experiment that moves the plant more than the n stretches of the fit, to a mean
square m instead of m_0, changes them by c = sqrt((n + 1) / (n + m / m_0)).

With the fit's Hessian P and covariance S (:mod:`thermogrip.sysid.greybox.sandwich`), a fit to all logs has

    (P + A)^-1 Omega (P + A)^-1,      Omega = P S P - U U' + (U + G) c c' (U + G)' + V.

In whitened parameters, R R' = S, the inverse is the gain (P' + A') Omega'^-1 (P' + A'), P' = R' P R and so
on. S may be less than U U' in some direction; singular values of P'^-1 R' U above 1 are cut to 1 there.

Without this model the optimal schedule of the gripper gains 7 of 41 bits less, and a fit with a
third log states intervals 2.2 times the predicted ones (median), not 1.5.

References
----------
.. [1] K. Chaloner, I. Verdinelli, "Bayesian experimental design: a review", Statistical Science 10(3), 1995.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox.noise_model import Block, ErrorModel
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.greybox.random_effects import Response, WarmUp, signals, warm_noise
from thermogrip.sysid.models.lti import symmetric_root
from thermogrip.sysid.models.model import GreyModel
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class ForecastSettings:
    """Steps and counts of a forecast."""

    least_score: float = 1e-9  # keeps the score's covariance invertible in directions without information
    difference_step: float = 1e-3  # of a parameter's sd
    disturbance_step: float = 0.1  # in its unit, for differences
    start_step: float = 0.1  # of its spread, for differences
    independent_s: float = 60.0  # per independent reading where no fit has measured it
    tries: int = 40  # draws until one can be simulated


FORECAST = ForecastSettings()


@dataclass(frozen=True, eq=False)
class Experiment:
    """What moves the outputs of an experiment."""

    rise: Array  # (n, N, n_y), sensitivities to the whitened parameters
    effects: Array  # (n_effect, N, n_y), at one sd of each effect other than start and sensor offsets
    starts: Array  # (n_start, N, n_y), what its start does at one spread
    lagged: Array  # (n_term, N), the lagged signal of each term that may be discrepancy
    dt: float  # time between rows [s]
    warm_up: float  # seconds from which a fit would estimate the start, 0 where it does not


class _Added(NamedTuple):
    """What an experiment adds to a fit."""

    hessian: Array  # A (n, n)
    spread: Array  # V (n, n)
    discrepancy: Array  # G (n, n_term)


@dataclass(frozen=True, eq=False)
class ReadingError:
    """A fit's error model, ready for another log."""

    numbers: ErrorModel
    hessian: Array  # P of theta, (n_free, n_free)
    unit: Array  # (n_y,), one residual of the fit in the unit of the output
    sensor: Array  # (n_y,), sd of a reading that a start is estimated with, in the unit of the output
    bin_s: float  # width of a bin of ``numbers`` [s]
    merge: float  # residuals of the fit that one bin represents
    phi: float  # by how much the logs of the fit disagreed beyond ``numbers``
    offset: Array  # (n_y,), spread of the outputs' offsets over logs
    bias: Array  # (n_d,), spread of the measured disturbances' biases over logs
    parameter_sd: Array  # (n_free,), spread of theta over logs; 0 for what all logs share
    terms: tuple[Response, ...]  # that may be discrepancy, each of the size that the fit learnt
    pull: Array  # U, (n_free, n_term), contribution of each term to the score of the fit
    stretches: int  # of the logs of the fit

    def gain(self, root: Array, new: Experiment) -> Array:
        """Return the inverse (n, n) of the covariance of the whitened parameters after an experiment."""
        added = self._added(new)
        before = root.T @ self.hessian @ root
        after, shared = before + added.hessian, self._shared(before, root)
        alone = np.eye(len(root)) - shared @ shared.T
        both = (before @ shared + added.discrepancy) * self._resized(new.lagged)
        score = (
            before @ alone @ before + both @ both.T + added.spread + FORECAST.least_score * np.eye(len(root))
        )
        return np.asarray(after @ np.linalg.solve(score, after))

    def _resized(self, lagged: Array) -> Array:
        """Return c (n_term,)."""
        louder = np.mean(lagged**2, axis=1) / np.square([term.rms for term in self.terms])
        return np.asarray(np.sqrt((self.stretches + 1) / (self.stretches + louder)))

    def _shared(self, before: Array, root: Array) -> Array:
        """Return W (n, n_term), of singular values up to 1."""
        if not self.terms:
            return np.zeros((len(root), 0))
        left_vectors, size, right_vectors = np.linalg.svd(
            np.linalg.solve(before, root.T @ self.pull), full_matrices=False
        )
        return np.asarray((left_vectors * np.minimum(size, 1.0)) @ right_vectors)

    def _added(self, new: Experiment) -> _Added:
        """Return A and V (n, n) and G (n, n_term) of the experiment."""
        n, rows, n_y = new.rise.shape
        sizes = np.array([term.size for term in self.terms]).reshape(-1, n_y)
        discrepancy = np.einsum("kt,kj->ktj", new.lagged, sizes)
        offsets = np.zeros((n_y, rows, n_y))
        offsets[np.arange(n_y), :, np.arange(n_y)] = self.offset[:, None]
        columns = np.concatenate([new.rise, discrepancy, new.effects, offsets, new.starts]) / self.unit
        m = max(1, round(self.bin_s / new.dt))
        n_bin, q = rows // m, len(discrepancy)
        if n_bin < 2:
            return _Added(np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, q)))
        bins = columns[:, : n_bin * m].reshape(len(columns), n_bin, m, n_y).mean(axis=2)
        whole = self.merge * bins[:n].reshape(n, -1) @ bins.reshape(len(bins), -1).T
        block = Block.of(bins[:n].transpose(1, 2, 0), range(n_y))
        noise = self.merge**2 * np.tensordot(block.covariance(self.numbers), block.products, axes=3)
        begin = n + q + len(new.effects)  # of the start
        effect_pull, start_pull = whole[:, n + q : begin], whole[:, begin:]
        start_error = self._start_error(bins[begin:], new.warm_up)
        spread = noise + effect_pull @ effect_pull.T + start_pull @ start_error @ start_pull.T
        return _Added(whole[:n, :n], self.phi * spread, whole[:, n : n + q])

    def _start_error(self, bins: Array, warm_up: float) -> Array:
        """Return H (k, k) of offsets and start, of which these are the bins (k, n_bin, n_y)."""
        n = min(max(1, round(warm_up / self.bin_s)), bins.shape[1])
        if not warm_up:
            return np.eye(len(bins))
        noise = warm_noise(warm_up, self.bin_s) * self.sensor / self.unit
        first = WarmUp((), bins[:, :n].transpose(1, 2, 0), tuple(range(bins.shape[2])), noise)
        return first.error(self.numbers, np.ones(len(bins)))


def learnt_error(plant: Plant) -> ReadingError | None:
    """Return what the plant's fit learnt of its error, None where it learnt nothing."""
    intervals = plant.scores.intervals
    if intervals is None or intervals.numbers is None or plant.covariance is None:
        return None
    numbers = intervals.numbers
    spread = intervals.spread_over_logs
    terms = intervals.terms
    sensor = _sensor_sd(plant)
    return ReadingError(
        ErrorModel.of(numbers),
        np.array(intervals.hessian, dtype=float),
        np.array(numbers.unit, dtype=float),
        np.array([sensor[name] for name in plant.outputs], dtype=float),
        numbers.bin_s,
        float(numbers.merge),
        max(intervals.between_logs, 1.0),
        np.array([spread.get(f"offset of {name}", 0.0) for name in plant.outputs]),
        np.array([spread.get(f"bias of {name}", 0.0) for name in plant.disturbances]),
        np.array([spread.get(name, 0.0) for name in plant.free]),
        tuple(Response(t.signal, t.lag_s, np.array(t.size), t.rms) for t in terms),
        np.array(intervals.pull, dtype=float) if terms else np.zeros((len(plant.free), 0)),
        intervals.stretches,
    )


ROOM = 25.0  # degC
DRAWS = 8  # of the parameters, that keep the limits too


class Members(NamedTuple):
    """What is simulated side by side: a plant and others beside it."""

    p: Array  # (B, n_p) parameters
    x0: Array  # (B, n_x) starts
    d: Array  # (B, n_d) disturbances


class ExperimentForecast:
    """A plant at rest in a room: the outputs that input schedules lead to, and the information they give."""

    def __init__(
        self,
        plant: Plant,
        *,
        lowest: float = -np.inf,
        highest: float = np.inf,
        room: float = ROOM,
        draws: int = DRAWS,
        dt: float | None = None,
        starts: bool = True,
    ) -> None:
        self.plant, self.dt = plant, plant.dt if dt is None else float(dt)
        self.starts = starts
        self.lowest = lowest
        self.highest = highest
        self.room = room
        self.n_draws = draws if plant.covariance is not None or plant.samples is not None else 0
        self._d = np.array(
            [room if _is_celsius(plant, name) else _middle(plant, name) for name in plant.disturbances]
        )

    def outputs(self, u: Array) -> Array:
        """Return the outputs (1 + n_draws, N + 1, n_y) of the plant and of its draws under u (N, n_u)."""
        return self._run(u, *self._cautious)

    def stays(self, u: Array, *, margin: float = 0.0) -> bool:
        """Say whether all outputs in degC stay inside the limits, by so much, under u (N, n_u)."""
        return self._inside(self.outputs(u), margin)

    def bits(self, u: Array) -> float:
        """Return the expected gain of information of an experiment u (N, n_u) [bits]."""
        return _bits(self._gain(u, self._run(u, *self._moved)))

    def covariance(self, u: Array) -> Array:
        """Return the covariance (n_free, n_free) of theta expected after an experiment u (N, n_u)."""
        after = self._root @ np.linalg.solve(self._gain(u, self._run(u, *self._moved)), self._root.T)
        return np.asarray(0.5 * (after + after.T))

    def evaluate(self, u: Array, *, margin: float = 0.0) -> float:
        """Return the bits of u (N, n_u), minus infinity where it leaves the limits; one batch for both."""
        n_moved = len(self._moved.p)
        together = (np.vstack([moved, drawn[1:]]) for moved, drawn in zip(self._moved, self._cautious))
        y = self._run(u, *together)
        if not self._inside(np.vstack([y[:1], y[n_moved:]]), margin):
            return -np.inf
        return _bits(self._gain(u, y[:n_moved]))

    def _gain(self, u: Array, y: Array) -> Array:
        """Return the inverse (n_free, n_free) of the covariance after an experiment, where it is 1 now, from
        the outputs ``y`` of the plant and of what was moved."""
        n = len(self.plant.free)
        change = np.nan_to_num(y[1:, 1:] - y[0, 1:])
        slopes = change[:n] / self._steps[:, None, None]
        rise = np.asarray(np.tensordot(self._root.T, slopes, axes=1), dtype=np.float64)
        if self._error is not None:
            effects, starts = self._effects(self._error, change)
            lagged = self._lagged(self._error, u, y[0])
            warm_up = self._warm_up(len(u))
            return self._error.gain(self._root, Experiment(rise, effects, starts, lagged, self.dt, warm_up))
        sd, seconds = reading_noise(self.plant)
        flat = (rise * np.sqrt(self.dt / seconds) / sd).reshape(n, -1)
        return np.asarray(np.eye(n) + flat @ flat.T)

    def _effects(self, error: ReadingError, change: Array) -> tuple[Array, Array]:
        """Return what may be the new log's own, (n_effect, N, n_y), and its start, each at one spread."""
        n, n_d = len(self.plant.free), self._d.size
        varies = error.parameter_sd > 0
        parameters = change[:n][varies] * (error.parameter_sd / self._steps)[varies, None, None]
        biases = change[n : n + n_d] * error.bias[:, None, None] / FORECAST.disturbance_step
        return np.concatenate([parameters, biases]), change[n + n_d :] / FORECAST.start_step

    def _warm_up(self, rows: int) -> float:
        """Return the seconds from which a fit would estimate the start, 0 where it knows it or does not."""
        model = self.plant.model
        if self._known or not isinstance(model, GreyModel):
            return 0.0
        return float(min(model.warmup, rows * self.dt / 2))

    def _lagged(self, error: ReadingError, u: Array, run: Array) -> Array:
        """Return the lagged signal of each term that the model may lack, (n_term, N)."""
        inputs_and_states = signals(self.plant.model, u, np.repeat(self._d[None], len(u), axis=0), run)
        return np.array([term.lagged(inputs_and_states, self.dt)[1:] for term in error.terms]).reshape(
            -1, len(u)
        )

    def _inside(self, y: Array, margin: float) -> bool:
        warm = [k for k, name in enumerate(self.plant.outputs) if _is_celsius(self.plant, name)]
        if not np.isfinite(y).all():
            return False
        temperatures = y[:, :, warm]
        return not temperatures.size or bool(
            temperatures.min() >= self.lowest + margin and temperatures.max() <= self.highest - margin
        )

    def _run(self, u: Array, p: Array, x0: Array, d: Array) -> Array:
        disturbances = (
            np.repeat(d[:, None], len(u), axis=1)
            if np.ptp(d, axis=0).any()
            else np.tile(d[:1], (1, len(u), 1))
        )
        y, _ = self.plant.model.rollout(x0, u[None], disturbances, p, self.dt)
        return np.asarray(y)

    @property
    def _known(self) -> bool:
        """Whether the start is known: at rest with the ambient, which is measured."""
        return self.plant.reference is not None and bool(self.plant.disturbances)

    @cached_property
    def _error(self) -> ReadingError | None:
        return learnt_error(self.plant)

    @cached_property
    def _root(self) -> Array:
        if self.plant.covariance is None or not self.plant.free:
            raise UserError(
                "the plant has no covariance, so what an experiment adds to it is unknown",
                hint="identify a network, or start from one with --network",
            )
        covariance = np.asarray(self.plant.covariance)
        if not np.isfinite(covariance).all():
            raise UserError("the plant's covariance is not finite", hint="identify it again")
        return symmetric_root(covariance)

    @cached_property
    def _steps(self) -> Array:
        """Signed steps of theta (n_free,), away from a bound that is near."""
        size = FORECAST.difference_step * np.sqrt(np.maximum(np.diag(self._root @ self._root.T), 1e-20))
        theta = self.plant.theta + size
        free = [self.plant.bounds.get(name, (-np.inf, np.inf))[1] for name in self.plant.free]
        return np.where(self.plant.natural(theta) > np.array(free), -size, size)

    @cached_property
    def _moved(self) -> Members:
        """The plant's, each parameter moved by its step, and where an
        error model asks for it each disturbance."""
        theta = np.vstack([self.plant.theta, self.plant.theta + np.diag(self._steps)])
        rows = np.repeat(self.plant.p[None], len(theta), axis=0)
        columns = [self.plant.model.parameters.index(name) for name in self.plant.free]
        rows[:, columns] = np.array([self.plant.natural(row) for row in theta])
        first = self._rest(rows[0])
        begin = [first, *(first if self._known else self._rest(row) for row in rows[1:])]
        d = np.repeat(self._d[None], len(rows), axis=0)
        if self._error is not None:  # the start stays: a log at rest has seen the room
            aside = (
                FORECAST.start_step * _spread_root(self.plant).T if self.starts else np.zeros((0, first.size))
            )
            n = self._d.size
            rows = np.vstack([rows, np.repeat(rows[:1], n + len(aside), axis=0)])
            begin += [first] * n + list(first + aside)
            warmer, same = (
                self._d + FORECAST.disturbance_step * np.eye(n),
                np.repeat(self._d[None], len(aside), axis=0),
            )
            d = np.vstack([d, warmer, same])
        return Members(rows, np.array(begin), d)

    @cached_property
    def _cautious(self) -> Members:
        """The plant and its draws."""
        rows, k = [self.plant.p], 0
        while len(rows) <= self.n_draws and k < FORECAST.tries + self.n_draws:
            k += 1
            rows.append(self.plant.draw(k).p)
        d = np.repeat(self._d[None], len(rows), axis=0)
        return Members(np.array(rows), np.array([self._rest(row) for row in rows]), d)

    def _rest(self, p: Array) -> Array:
        model = self.plant.model
        still = np.array([1.0 if name in model.switches else self._still(name) for name in model.inputs])
        lowest = {name: self.plant.valid.get(name, (0.0, 0.0))[0] for name in model.outputs}
        y = np.array([self.room if _is_celsius(self.plant, n) else low for n, low in lowest.items()])
        return np.asarray(model.rest(y, still, self._d, p), dtype=float)

    def _still(self, name: str) -> float:
        low, high = self.plant.valid.get(name, (0.0, 0.0))
        return float(np.clip(0.0, low, high)) if low < high else 0.0


def plant_from_prior(model: GreyModel) -> Plant:
    """Return a model at its prior medians as a plant whose covariance is the prior's."""
    plant = prior_plant(model)
    width = [model.specs[name].sd_log or model.specs[name].sd or 0.0 for name in plant.free]
    tables = model.network.inputs if isinstance(model, NetworkModel) else {}
    ranges = {name: item.range for name, item in tables.items()}
    valid = {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
    return replace(plant, covariance=np.diag(np.square(width)), valid=valid)


def reading_noise(plant: Plant) -> tuple[Array, Array]:
    """Return sd (n_y,) [unit of the output] of independent readings, and seconds (n_y,) between them."""
    sensor = _sensor_sd(plant)
    sd = np.array([max(plant.noise.get(name, 0.0), sensor.get(name, 0.0)) for name in plant.outputs])
    if not np.all(sd > 0):
        lost = ", ".join(np.array(plant.outputs)[~(sd > 0)])
        raise UserError(f"the plant has no sensor error for {lost}", hint="identify it again")
    measured_s = plant.scores.independent_s
    bin_s = plant.scores.average_s or plant.dt
    guess = plant.model.independent if isinstance(plant.model, GreyModel) else FORECAST.independent_s
    seconds = np.array([max(float(measured_s.get(name, guess)), bin_s) for name in plant.outputs])
    return sd, seconds


def interval_widths(plant: Plant, covariance: Array, level: float = 0.9) -> dict[str, float]:
    """Return the width of each free parameter's central interval, in natural units, at a covariance."""
    expected = replace(plant, covariance=covariance, samples=None)
    return {name: high - low for name, (low, high) in expected.intervals(level).items()}


def _sensor_sd(plant: Plant) -> dict[str, float]:
    return plant.model.sensor_sd if isinstance(plant.model, GreyModel) else {}


def _bits(gain: Array) -> float:
    return float(0.5 * np.linalg.slogdet(gain)[1] / np.log(2.0))


def _spread_root(plant: Plant) -> Array:
    """Return columns (n_x, n_mode) by which a state at rest may be off."""
    root = symmetric_root(plant.model.spread)
    return root[:, root.any(axis=0)]


def _is_celsius(plant: Plant, name: str) -> bool:
    return plant.units.get(name, "degC") == "degC"


def _middle(plant: Plant, name: str) -> float:
    low, high = plant.valid.get(name, (0.0, 0.0))
    return 0.5 * (low + high)
