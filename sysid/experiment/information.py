"""Expected information of an experiment: temperatures that it may reach, intervals that it would leave.

A schedule u moves the outputs y(t). With the free parameters theta (logarithms where they are positive) of
covariance P = R R' now, an experiment adds information F and leaves (P^-1 + F)^-1 = R (1 + R'F R)^-1 R'. All
is linear about the plant's values.  Every experiment begins at rest in the room.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.model import GreyModel
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.state_space import symmetric_root
from thermogrip.sysid.plant.linearise import ROOM
from thermogrip.sysid.plant.plant import Plant

DIFFERENCE_STEP = 1e-3  # of a parameter's sd
DRAWS = 8  # of the parameters, that keep the limits too


class Members(NamedTuple):
    """What is simulated side by side: a plant and others beside it."""

    p: Array  # (B, n_p) parameters
    x0: Array  # (B, n_x) starts


class ExperimentForecast:
    """A plant at rest in a room: the outputs that input schedules lead to, and the information they give."""

    def __init__(
        self,
        plant: Plant,
        *,
        lowest: float = -np.inf,
        highest: float = np.inf,
        draws: int = DRAWS,
        dt: float | None = None,
    ) -> None:
        self.plant, self.dt = plant, plant.dt if dt is None else float(dt)
        self.lowest = lowest
        self.highest = highest
        self.n_draws = draws if plant.covariance is not None or plant.samples is not None else 0
        self._d = np.nan_to_num(plant.undisturbed(ROOM))
        self._celsius = np.array([plant.units.get(name, "degC") == "degC" for name in plant.outputs])

    def outputs(self, u: Array) -> Array:
        """Return the outputs (1 + n_draws, N + 1, n_y) of the plant and of its draws under u (N, n_u)."""
        return self._run(u, *self._cautious)

    def stays(self, u: Array, *, margin: float = 0.0) -> bool:
        """Say whether all outputs in degC stay inside the limits, by so much, under u (N, n_u)."""
        y = self.outputs(u)
        temperatures = y[:, :, self._celsius]
        low, high = temperatures.min(initial=np.inf), temperatures.max(initial=-np.inf)
        return bool(np.isfinite(y).all() and low >= self.lowest + margin and high <= self.highest - margin)

    def bits(self, u: Array) -> float:
        """Return the expected gain of information of an experiment u (N, n_u) [bits]."""
        gain = self._gain(self._run(u, *self._moved))
        # 1/2 log2 det(1 + R'F R): K. Chaloner, I. Verdinelli, "Bayesian experimental design: a review",
        # Statistical Science 10(3), 1995
        return float(0.5 * np.linalg.slogdet(gain)[1] / np.log(2.0))

    def covariance(self, u: Array) -> Array:
        """Return the covariance (n_free, n_free) of theta expected after an experiment u (N, n_u)."""
        after = self._root @ np.linalg.solve(self._gain(self._run(u, *self._moved)), self._root.T)
        return np.asarray(0.5 * (after + after.T))

    def evaluate(self, u: Array, *, margin: float = 0.0) -> float:
        """Return the bits of u (N, n_u), minus infinity where it leaves the limits."""
        return self.bits(u) if self.stays(u, margin=margin) else -np.inf

    def _gain(self, y: Array) -> Array:
        """Return the inverse (n_free, n_free) of the covariance after an experiment, where it is 1 now, from
        the outputs ``y`` of the plant and of what was moved."""
        n = len(self.plant.free)
        slopes = np.nan_to_num(y[1:, 1:] - y[0, 1:]) / self._steps[:, None, None]
        rise = np.asarray(np.tensordot(self._root.T, slopes, axes=1), dtype=np.float64)
        # the weights of the fit: sd of the sensors, seconds of an independent reading
        sd, seconds = reading_noise(self.plant)
        # F = sum_j 1 / (sigma_j^2 tau_j) integral (dy_j/dtheta) (dy_j/dtheta)' dt
        flat = (rise * np.sqrt(self.dt / seconds) / sd).reshape(n, -1)
        return np.asarray(np.eye(n) + flat @ flat.T)

    def _run(self, u: Array, p: Array, x0: Array) -> Array:
        d = np.tile(self._d, (1, len(u), 1))
        return np.asarray(self.plant.model.rollout(x0, u[None], d, p, self.dt)[0])

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
        size = DIFFERENCE_STEP * np.sqrt(np.maximum(np.diag(self._root @ self._root.T), 1e-20))
        theta = self.plant.theta + size
        free = [self.plant.bounds.get(name, (-np.inf, np.inf))[1] for name in self.plant.free]
        return np.where(self.plant.natural(theta) > np.array(free), -size, size)

    @cached_property
    def _moved(self) -> Members:
        """The plant's, and each parameter moved by its step."""
        theta = np.vstack([self.plant.theta, self.plant.theta + np.diag(self._steps)])
        rows = np.repeat(self.plant.p[None], len(theta), axis=0)
        columns = [self.plant.model.parameters.index(name) for name in self.plant.free]
        rows[:, columns] = np.array([self.plant.natural(row) for row in theta])
        first = self._rest(rows[0])
        # at rest with an ambient that is measured the start is known
        start_known = self.plant.reference is not None and bool(self.plant.disturbances)
        return Members(
            rows, np.array([first, *(first if start_known else self._rest(row) for row in rows[1:])])
        )

    @cached_property
    def _cautious(self) -> Members:
        """The plant and its draws."""
        rows = [self.plant.draw(k).p for k in range(self.n_draws + 1)]
        return Members(np.array(rows), np.array([self._rest(row) for row in rows]))

    def _rest(self, p: Array) -> Array:
        model = self.plant.model
        seen = [self.plant.valid.get(name, (0.0, 0.0)) for name in (*model.inputs, *model.outputs)]
        (least, lowest), (most, _) = (np.split(end, [len(model.inputs)]) for end in np.array(seen).T)
        still = np.where([name in model.switches for name in model.inputs], 1.0, np.clip(0.0, least, most))
        y = np.where(self._celsius, ROOM, lowest)
        return np.asarray(model.rest(y, still, self._d, p), dtype=float)


def plant_from_prior(model: GreyModel) -> Plant:
    """Return a model at its prior medians as a plant whose covariance is the prior's."""
    plant = prior_plant(model)
    width = [model.specs[name].sd_log or model.specs[name].sd or 0.0 for name in plant.free]
    tables = model.network.inputs if isinstance(model, NetworkModel) else {}
    valid = {name: item.range for name, item in tables.items()}
    return replace(plant, covariance=np.diag(np.square(width)), valid=valid)


def reading_noise(plant: Plant) -> tuple[Array, Array]:
    """Return sd (n_y,) [unit of the output] of independent readings, and seconds (n_y,) between them."""
    model = plant.model
    if not isinstance(model, GreyModel):
        raise UserError("the plant's sensors have no stated error", hint="identify a network")
    scores = plant.scores
    coarsening = 1.0 if scores.intervals is None else scores.intervals.coarsening
    # A log has T times less information than the fit's weights assume (sysid.greybox.sandwich).  After the
    # experiment 12 simulated rigs stated intervals 1.7 times as wide as was predicted (geometric mean), 2.0
    # without T.
    seconds = [coarsening * scores.weight_s.get(name, model.independent) for name in plant.outputs]
    return np.array([model.sensor_sd[name] for name in plant.outputs]), np.array(seconds)


def interval_widths(plant: Plant, covariance: Array, level: float = 0.9) -> dict[str, float]:
    """Return the width of each free parameter's central interval, in natural units, at a covariance."""
    expected = replace(plant, covariance=covariance, samples=None)
    return {name: high - low for name, (low, high) in expected.intervals(level).items()}
