"""What every model that is described by tables says of itself: names, units and priors, read from the tables.

A thermal network has its tables from TOML (:mod:`thermogrip.sysid.models.network_spec`), a class of the
user's own from its attributes (:mod:`thermogrip.sysid.models.user_class`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.models.network_spec import Parameter

__all__ = ["Described"]


class Described(ABC):
    """The part of a :class:`~thermogrip.sysid.models.grey_model.GreyModel` that tables answer."""

    @property
    @abstractmethod
    def tables(self) -> Any:
        """What has ``inputs``, ``disturbances``, ``outputs``, ``parameters`` by name, and ``dt``."""

    @property
    def name(self) -> str:
        """Name of the model."""
        return str(self.tables.name)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(self.tables.inputs)

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of what is measured and not moved."""
        return tuple(self.tables.disturbances)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(self.tables.outputs)

    @property
    def switches(self) -> tuple[str, ...]:
        """The inputs that are on or off."""
        return tuple(name for name, item in self.tables.inputs.items() if item.switch)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.tables.parameters)

    @property
    def dt(self) -> float:
        """Step of the simulation [s]."""
        return float(self.tables.dt)

    @property
    def specs(self) -> dict[str, Parameter]:
        """Unit, prior and bounds of each parameter."""
        return dict(self.tables.parameters)

    @property
    def prior(self) -> NDArray[np.float64]:
        """Prior median (mean) of each parameter, shape (n_p,)."""
        return np.array([item.value for item in self.tables.parameters.values()])

    @property
    def units(self) -> dict[str, str]:
        """Units of the signals and the parameters."""
        tables = self.tables
        groups = (tables.inputs, tables.disturbances, tables.outputs, tables.parameters)
        return {name: item.unit for group in groups for name, item in group.items()}

    @property
    def nuisance(self) -> dict[str, float]:
        """How far each sensor is off, from log to log."""
        groups = (self.tables.outputs, self.tables.disturbances)
        return {name: item.log_sd for group in groups for name, item in group.items()}
