"""What a controller is built from, as its C code and its linear equivalent read it."""

from __future__ import annotations

from typing import Protocol

from thermogrip.mpc.design.design import Design
from thermogrip.mpc.estimator.observer import DisturbanceModel, Observer
from thermogrip.mpc.optimiser.rti import Optimiser
from thermogrip.mpc.plant.prediction import PredictionModel

__all__ = ["ControllerParts"]


class ControllerParts(Protocol):
    """A model-predictive controller, as far as its parts go."""

    @property
    def model(self) -> PredictionModel:
        """The plant at the sample time."""
        ...

    @property
    def design(self) -> Design:
        """Its design."""
        ...

    @property
    def disturbance(self) -> DisturbanceModel:
        """What the observer estimates beside the state."""
        ...

    @property
    def observer(self) -> Observer:
        """Its observer."""
        ...

    @property
    def optimiser(self) -> Optimiser:
        """Its optimiser."""
        ...
