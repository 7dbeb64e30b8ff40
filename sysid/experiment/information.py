r"""What an experiment would tell before it is run: temperatures it may reach, intervals it would leave.

**Information.**  A schedule u moves the outputs y(t); with the free parameters theta (logarithms where they
are positive) of covariance P now, an experiment whose output j is read with standard deviation sigma_j, one
independent reading every tau_j seconds, adds

    F = sum_j 1 / (sigma_j^2 tau_j) integral (dy_j/dtheta) (dy_j/dtheta)' dt,

and leaves the covariance (P^-1 + F)^-1.  With P = R R' this is R (1 + R'F R)^-1 R', which needs no inverse of
P, and the volume of the posterior shrinks by

    bits = 1/2 log2 det(1 + R'F R),

the expected gain of information [1]_.  sigma_j and tau_j are those that the fit used: the error about its own
free run, at least what the model states of its sensors, and the time over which its residuals repeat
each other.  A fit that has learnt more of its error (two memories, effects of each log) lends that to the
experiment instead (:mod:`thermogrip.sysid.greybox.reading_error`); what it cannot know beforehand makes a
range of the promise.  All is linear in theta about the plant's values,
so it is a promise for a plant near them.

**Start.**  Every experiment begins at rest in the room, which is how a fit knows the state best.  A plant
that measures its ambient knows its start outright; for any other the state at rest follows the parameters.

**Limits** are held by the plant itself and by so many draws of its parameters.

References
----------
.. [1] K. Chaloner, I. Verdinelli, "Bayesian experimental design: a review", Statistical Science 10(3), 1995.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox.model_discrepancy import signals
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.greybox.reading_error import Experiment, Missing, ReadingError, learnt_error
from thermogrip.sysid.plant.plant import Plant

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel

__all__ = ["Outlook", "interval_widths", "prior_belief", "reading_noise"]

Array = NDArray[np.float64]

ROOM = 25.0  # degC
DRAWS = 8  # of the parameters, that keep the limits too
_STEP = 1e-3  # of a parameter's sd, for differences
_WARMER = 0.1  # of a disturbance, for differences
_ASIDE = 0.1  # of its spread, that a start is moved for differences
_INDEPENDENT = 60.0  # [s] per independent reading where no fit has measured it
_TRIES = 40  # draws until one can be simulated


class Outlook:
    """A plant at rest in a room, and what input schedules would do to it and tell of it."""

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
        self.lowest, self.highest, self.room = lowest, highest, room
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

    def covariance(self, u: Array, missing: Missing = "sized anew") -> Array:
        """Return the covariance (n_free, n_free) of theta expected after an experiment u (N, n_u).

        ``missing`` says what terms that the model may lack do in it
        (:mod:`thermogrip.sysid.greybox.reading_error`).
        """
        after = self._root @ np.linalg.solve(self._gain(u, self._run(u, *self._moved), missing), self._root.T)
        return np.asarray(0.5 * (after + after.T))

    @property
    def has_range(self) -> bool:
        """Whether the fit has learnt of terms that may be missing, so that a promise has a range."""
        return self._error is not None and bool(self._error.terms)

    def judge(self, u: Array, *, margin: float = 0.0) -> float:
        """Return the bits of u (N, n_u), minus infinity where it leaves the limits; one batch for both."""
        rows, begin, d = self._moved
        careful, at_rest, room = self._cautious
        together = (np.vstack([a, b[1:]]) for a, b in ((rows, careful), (begin, at_rest), (d, room)))
        y = self._run(u, *together)
        if not self._inside(np.vstack([y[:1], y[len(rows) :]]), margin):
            return -np.inf
        return _bits(self._gain(u, y[: len(rows)]))

    def _gain(self, u: Array, y: Array, missing: Missing = "sized anew") -> Array:
        """Return the inverse (n_free, n_free) of the covariance after an experiment, where it is 1 now.

        ``y`` are the outputs of the plant and of what was moved.
        """
        n = len(self.plant.free)
        change = np.nan_to_num(y[1:, 1:] - y[0, 1:])
        slopes = change[:n] / self._steps[:, None, None]
        rise = np.asarray(np.tensordot(self._root.T, slopes, axes=1), dtype=np.float64)
        if self._error is not None:
            effects, starts = self._effects(self._error, change)
            lagged = self._lagged(self._error, u, y[0])
            warm_up = self._warm_up(len(u))
            return self._error.gain(
                self._root, Experiment(rise, effects, starts, lagged, self.dt, warm_up), missing
            )
        sd, seconds = reading_noise(self.plant)
        flat = (rise * np.sqrt(self.dt / seconds) / sd).reshape(n, -1)
        return np.asarray(np.eye(n) + flat @ flat.T)

    def _effects(self, error: ReadingError, change: Array) -> tuple[Array, Array]:
        """Return what may be the new log's own, (n_effect, N, n_y), and its start, each at one spread."""
        n, n_d = len(self.plant.free), self._d.size
        own = error.own > 0
        parameters = change[:n][own] * (error.own / self._steps)[own, None, None]
        biases = change[n : n + n_d] * error.bias[:, None, None] / _WARMER
        return np.concatenate([parameters, biases]), change[n + n_d :] / _ASIDE

    def _warm_up(self, rows: int) -> float:
        """Return the seconds from which a fit would estimate the start, 0 where it knows it or does not."""
        model = self.plant.model
        if self._known or getattr(model, "wander", {}):
            return 0.0
        return float(min(getattr(model, "warmup", 0.0), rows * self.dt / 2))

    def _lagged(self, error: ReadingError, u: Array, run: Array) -> Array:
        """Return the lagged signal of each term that the model may lack, (n_term, N)."""
        given = signals(self.plant.model, u, np.repeat(self._d[None], len(u), axis=0), run)
        return np.array([term.lagged(given, self.dt)[1:] for term in error.terms]).reshape(-1, len(u))

    def _inside(self, y: Array, margin: float) -> bool:
        warm = [k for k, name in enumerate(self.plant.outputs) if _is_celsius(self.plant, name)]
        if not np.isfinite(y).all():
            return False
        seen = y[:, :, warm]
        return not seen.size or bool(
            seen.min() >= self.lowest + margin and seen.max() <= self.highest - margin
        )

    def _run(self, u: Array, p: Array, x0: Array, d: Array) -> Array:
        held = (
            np.repeat(d[:, None], len(u), axis=1)
            if np.ptp(d, axis=0).any()
            else np.tile(d[:1], (1, len(u), 1))
        )
        y, _ = self.plant.model.rollout(x0, u[None], held, p, self.dt)
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
        size, axes = np.linalg.eigh(covariance)
        return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))

    @cached_property
    def _steps(self) -> Array:
        """Signed steps of theta (n_free,), away from a bound that is near."""
        size = _STEP * np.sqrt(np.maximum(np.diag(self._root @ self._root.T), 1e-20))
        theta = self.plant.theta + size
        free = [self.plant.bounds.get(name, (-np.inf, np.inf))[1] for name in self.plant.free]
        return np.where(_natural(self.plant, theta) > np.array(free), -size, size)

    @cached_property
    def _moved(self) -> tuple[Array, Array, Array]:
        """Parameters, starts and disturbances: the plant's, each parameter moved by its step, and where an
        error model asks for it each disturbance."""
        theta = np.vstack([self.plant.theta, self.plant.theta + np.diag(self._steps)])
        rows = np.repeat(self.plant.p[None], len(theta), axis=0)
        at = [self.plant.model.parameters.index(name) for name in self.plant.free]
        rows[:, at] = np.array([_natural(self.plant, row) for row in theta])
        first = self._rest(rows[0])
        begin = [first, *(first if self._known else self._rest(row) for row in rows[1:])]
        d = np.repeat(self._d[None], len(rows), axis=0)
        if self._error is not None:  # the start stays: a log at rest has seen the room
            aside = _ASIDE * _spread_root(self.plant).T if self.starts else np.zeros((0, first.size))
            n = self._d.size
            rows = np.vstack([rows, np.repeat(rows[:1], n + len(aside), axis=0)])
            begin += [first] * n + list(first + aside)
            warmer, same = self._d + _WARMER * np.eye(n), np.repeat(self._d[None], len(aside), axis=0)
            d = np.vstack([d, warmer, same])
        return rows, np.array(begin), d

    @cached_property
    def _cautious(self) -> tuple[Array, Array, Array]:
        """Parameters, starts and disturbances of the plant and of its draws."""
        rows, k = [self.plant.p], 0
        while len(rows) <= self.n_draws and k < _TRIES + self.n_draws:
            k += 1
            rows.append(self.plant.draw(k).p)
        d = np.repeat(self._d[None], len(rows), axis=0)
        return np.array(rows), np.array([self._rest(row) for row in rows]), d

    def _rest(self, p: Array) -> Array:
        model = self.plant.model
        still = np.array([1.0 if name in model.switches else self._still(name) for name in model.inputs])
        y = np.array(
            [
                self.room if _is_celsius(self.plant, name) else _lowest(self.plant, name)
                for name in model.outputs
            ]
        )
        return np.asarray(model.rest(y, still, self._d, p), dtype=float)

    def _still(self, name: str) -> float:
        low, high = self.plant.valid.get(name, (0.0, 0.0))
        return float(np.clip(0.0, low, high)) if low < high else 0.0


def prior_belief(model: GreyModel) -> Plant:
    """Return a model at its prior medians as a plant whose covariance is the prior's."""
    plant = prior_plant(model)
    width = [model.specs[name].sd_log or model.specs[name].sd or 0.0 for name in plant.free]
    network = getattr(model, "network", None)
    ranges = {name: item.range for name, item in network.inputs.items()} if network is not None else {}
    valid = {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
    return replace(plant, covariance=np.diag(np.square(width)), valid=valid)


def reading_noise(plant: Plant) -> tuple[Array, Array]:
    """Return sd (n_y,) [unit of the output] of independent readings, and seconds (n_y,) between them."""
    sensor = getattr(plant.model, "sensor_sd", {})
    sd = np.array([max(plant.noise.get(name, 0.0), sensor.get(name, 0.0)) for name in plant.outputs])
    if not np.all(sd > 0):
        lost = ", ".join(np.array(plant.outputs)[~(sd > 0)])
        raise UserError(f"the plant does not say how well {lost} is read", hint="identify it again")
    seen = plant.scores.independent_s
    bin_s = plant.scores.average_s or plant.dt
    guess = float(getattr(plant.model, "independent", _INDEPENDENT))
    seconds = np.array([max(float(seen.get(name, guess)), bin_s) for name in plant.outputs])
    return sd, seconds


def interval_widths(plant: Plant, covariance: Array, level: float = 0.9) -> dict[str, float]:
    """Return the width of each free parameter's central interval, in natural units, at a covariance."""
    at = replace(plant, covariance=covariance, samples=None)
    return {name: high - low for name, (low, high) in at.intervals(level).items()}


def _bits(gain: Array) -> float:
    return float(0.5 * np.linalg.slogdet(gain)[1] / np.log(2.0))


def _natural(plant: Plant, theta: Array) -> Array:
    """Return parameters from theta, without clipping to the bounds."""
    logs = plant.log_scaled
    return np.where(logs, np.exp(np.where(logs, theta, 0.0)), theta)


def _spread_root(plant: Plant) -> Array:
    """Return columns (n_x, n_mode) by which a state at rest may be off."""
    size, axes = np.linalg.eigh(plant.model.spread)
    return np.asarray((axes * np.sqrt(np.maximum(size, 0.0)))[:, size > 0])


def _is_celsius(plant: Plant, name: str) -> bool:
    return plant.units.get(name, "degC") == "degC"


def _middle(plant: Plant, name: str) -> float:
    low, high = plant.valid.get(name, (0.0, 0.0))
    return 0.5 * (low + high)


def _lowest(plant: Plant, name: str) -> float:
    return plant.valid.get(name, (0.0, 0.0))[0]
