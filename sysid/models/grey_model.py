"""What a fit needs of a model with physical parameters.

A :class:`GreyModel` is a :class:`~thermogrip.sysid.plant.plant.Model` that also states what was known before
any log was seen: a prior and bounds for each parameter, how well each sensor reads, and the times over which
the fit averages.  A thermal network from a file (:mod:`thermogrip.sysid.models.network`) and a class of the
user's own (:mod:`thermogrip.sysid.models.user_model`) both are;
:func:`thermogrip.sysid.greybox.fit.fit_network`, the posterior and the report take either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from thermogrip.datasets.schema import Log
from thermogrip.sysid.models.model import Array, Model
from thermogrip.sysid.models.network_spec import Parameter

__all__ = ["FreeRuns", "GreyModel"]


class FreeRuns(Protocol):
    """A function that simulates logs: one (log's name, (1, N + 1, n_y) outputs) a stretch without a gap."""

    def __call__(self, model: GreyModel, logs: Sequence[Log], p: Array) -> list[tuple[str, Array]]:
        """Return the free runs of a model over logs with parameters p (n_p,)."""
        ...


class GreyModel(Model, Protocol):
    """Equations with priors."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def dt(self) -> float:
        """Step of the simulation [s]."""
        ...

    @property
    def specs(self) -> Mapping[str, Parameter]:
        """Unit, prior and bounds of each parameter, in the order of ``parameters``."""
        ...

    @property
    def units(self) -> dict[str, str]:
        """Units of the signals and the parameters."""
        ...

    @property
    def sensor_sd(self) -> dict[str, float]:
        """Standard deviation of the mean over a bin about the model, by output, in the output's unit."""
        ...

    @property
    def nuisance(self) -> dict[str, float]:
        """How far each output and disturbance is off, from log to log, in its own unit."""
        ...

    @property
    def reference(self) -> str | None:
        """The output that has no offset of its own, if one does not."""
        ...

    @property
    def average(self) -> float:
        """Length of the bins that a fit compares [s], where it is not asked for another."""
        ...

    @property
    def independent(self) -> float:
        """Seconds per independent residual, until that is measured."""
        ...

    @property
    def warmup(self) -> float:
        """Seconds of a log that a fit may use to estimate how it starts."""
        ...

    @property
    def search_step(self) -> float:
        """Step of a global search [s], which may be coarser."""
        ...

    def prepared(self, logs: Sequence[Log], p: Array | None = None, *, free_runs: FreeRuns) -> GreyModel:
        """Return the model made ready for these logs, its step short enough at p (at the prior where absent).

        The model itself where it is ready as it is.
        """
        ...
