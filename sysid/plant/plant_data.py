"""The numbers of a plant: a model, its parameters with their uncertainty, and where both may be trusted.

A :class:`~thermogrip.sysid.models.model.Model` is equations without numbers.  A :class:`Plant` adds the
numbers: one value per parameter, the covariance of the free ones, samples of them where a posterior was
drawn, the noise of each output, and the range of the data that the fit has seen.

**Scales.**  A positive parameter is uncertain by a factor, so its ``theta`` is its logarithm; any other has
``theta`` equal to itself.  Covariance and Laplace draws live in theta; values, samples and intervals are in
natural units.

**One log is not another.**  Thermocouples are plugged anew and rooms change, so each log has sensor offsets
of its own.  ``nuisance`` says by how much (a standard deviation per signal);
:mod:`thermogrip.sysid.plant.simulation` estimates them from the warm-up of the log that it simulates.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Self

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.model import Model
from thermogrip.sysid.plant.fit_record import FitLog, PlantScores


@dataclass(frozen=True, eq=False)
class PlantData:
    """The fields of a plant, see :class:`thermogrip.sysid.plant.plant.Plant`, and what follows from them."""

    model: Model
    values: dict[str, float]
    dt: float
    units: dict[str, str] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    scales: dict[str, str] = field(default_factory=dict)
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    covariance: Array | None = None
    samples: Array | None = None
    refits: tuple[Model, ...] = ()
    noise: dict[str, float] = field(default_factory=dict)
    offsets: dict[str, float] = field(default_factory=dict)
    nuisance: dict[str, float] = field(default_factory=dict)
    reference: str | None = None
    valid: dict[str, tuple[float, float]] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    scores: PlantScores = field(default_factory=PlantScores)
    verdict: str = ""
    fitted_to: tuple[FitLog, ...] = ()
    inputs_end_at_row: bool = False

    def __post_init__(self) -> None:
        missing = [name for name in self.model.parameters if name not in self.values]
        if missing:
            raise ValueError(f"no value for {', '.join(missing)}")
        unknown = [name for name in (*self.values, *self.free) if name not in self.model.parameters]
        if unknown:
            raise ValueError(f"the model has no parameter {', '.join(unknown)}")
        n = len(self.free)
        if self.covariance is not None and np.shape(self.covariance) != (n, n):
            raise ValueError(f"covariance is {np.shape(self.covariance)}, not {(n, n)}")
        if self.samples is not None and np.shape(self.samples)[1:] != (n,):
            raise ValueError(f"samples are {np.shape(self.samples)}, not (n, {n})")

    @property
    def uncertain(self) -> bool:
        """Whether there is anything to draw from."""
        return bool(self.refits) or self.samples is not None or self.covariance is not None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.model.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of the measured disturbances."""
        return self.model.disturbances

    @property
    def p(self) -> Array:
        """The parameter vector (n_p,) in the order of ``model.parameters``."""
        return np.array([self.values[name] for name in self.model.parameters], dtype=float)

    def draw(self, k: int) -> Self:
        """Return the plant with the parameters of the k-th draw.

        Draw 0 is the plant itself.  Others come from the saved samples or refits where there are any (evenly
        spread over them), else from the Laplace approximation N(theta, covariance) with seed k; a UserError
        where there is nothing to draw from.
        """
        if k < 0:
            raise UserError(f"draw {k} is negative", hint="count draws from 0")
        if k == 0:
            return self
        # a golden-ratio sequence visits a chain evenly, however few draws are taken
        along = (k * 0.6180339887498949) % 1.0
        if self.refits:
            return replace(self, model=self.refits[int(along * len(self.refits))])
        if self.samples is not None:
            drawn = np.asarray(self.samples[int(along * len(self.samples))], dtype=float)
        elif self.covariance is not None:
            drawn = self._laplace_draw(np.random.default_rng(k))
        else:
            raise UserError("the plant has no uncertainty to draw from", hint="fit a network, or use draw 0")
        return replace(self, values=self.values | dict(zip(self.free, drawn.tolist())))

    def intervals(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return the central interval of probability ``level`` of each free parameter, in natural units.

        theta +- z sd, clipped to the bounds; quantiles of the samples where there is no covariance.  Samples
        are of plants that agree with the logs, and what their parameters mean may still be off
        (:mod:`thermogrip.sysid.greybox.posterior`).
        """
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level:g}")
        if self.covariance is not None:
            half = NormalDist().inv_cdf(0.5 + level / 2) * np.sqrt(np.diag(self.covariance))
            low, high = self._natural(self.theta - half), self._natural(self.theta + half)
        elif self.samples is not None:
            tails = [0.5 - level / 2, 0.5 + level / 2]
            low, high = np.quantile(self.samples, tails, axis=0)
        else:
            return {}
        return {name: (float(a), float(b)) for name, a, b in zip(self.free, low, high)}

    @property
    def theta(self) -> Array:
        """The free parameters (n_free,) as ``covariance`` has them: logarithms of the ``"log"`` ones."""
        natural = np.array([self.values[name] for name in self.free], dtype=float)
        logs = self.log_scaled
        return np.where(logs, np.log(np.where(logs, natural, 1.0)), natural)

    def _natural(self, theta: Array) -> Array:
        natural = np.where(self.log_scaled, np.exp(np.where(self.log_scaled, theta, 0.0)), theta)
        pairs = [self.bounds.get(name, (-np.inf, np.inf)) for name in self.free]
        low, high = np.array(pairs, dtype=float).reshape(-1, 2).T
        return np.asarray(np.clip(natural, low, high))

    @property
    def log_scaled(self) -> Mask:
        """Which free parameters (n_free,) are logarithms in ``theta``."""
        return np.array([self.scales.get(name) == "log" for name in self.free], dtype=bool)

    def _laplace_draw(self, rng: np.random.Generator) -> Array:
        # eigh, not Cholesky: a weakly determined direction may have lost its last digits
        size, axes = np.linalg.eigh(np.asarray(self.covariance))
        step = axes @ (np.sqrt(np.maximum(size, 0.0)) * rng.standard_normal(len(size)))
        return self._natural(self.theta + step)
