"""A controller as an FMU: FMI 2.0 co-simulation, as a plant's (:mod:`thermogrip.sysid.export.fmu`).

Its inputs are the readings of outputs and measured disturbances and ``target_<output>``, its outputs the
drives, ``pump`` and ``status``, the place in :data:`thermogrip.mpc.interface.STATUSES`.  What it was given
when a communication step begins is answered when that ends; within its sample time it holds its move, so
steps may be short.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.interface import STATUSES, Regulator
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.export.fmu import Port, fmu_path, write_fmu
from thermogrip.sysid.plant.plant import Plant

TARGET = "target_"  # with the name of an output


class Exportable(Regulator, Protocol):
    """What an FMU is made of: a controller with its plant, its design, and what its file has."""

    model: PredictionModel
    plant: Plant
    design: Design

    def to_dict(self) -> dict[str, Any]:
        """Return what its file has."""
        ...


class Core:
    """A controller that is stepped from outside."""

    def __init__(self, controller: Exportable) -> None:
        self.controller, model = controller, controller.model
        usual = dict(zip(model.outputs, model.usual(controller.design.ambient).tolist(), strict=True))
        d = model.undisturbed(controller.design.ambient).tolist()
        self._readings = usual | dict(zip(model.disturbances, d, strict=True))
        self._targets = {TARGET + name: usual[name] for name in controller.controlled}
        self._answer = dict(zip(model.drives, model.neutral.tolist(), strict=True)) | {
            "pump": 1.0,
            "status": 0.0,
        }
        self._time = 0.0

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.controller.dt

    @property
    def ports(self) -> tuple[Port, ...]:
        """All variables: readings and targets, drives, pump and status."""
        units = self.controller.plant.units
        given = [Port(name, "input", units.get(name.removeprefix(TARGET), "1")) for name in self._inputs()]
        return (*given, *(Port(name, "output", units.get(name, "1")) for name in self._answer))

    def get(self, name: str) -> float:
        """Return a variable's value."""
        return float((self._inputs() | self._answer)[name])

    def set(self, name: str, value: float) -> None:
        """Set a reading or a target."""
        for group in (self._readings, self._targets):
            if name in group:
                group[name] = float(value)
                return
        raise KeyError(name)

    def begin(self) -> None:
        """Start at rest at the readings."""
        self.controller.reset(self._readings)
        self._time = 0.0

    def advance(self, seconds: float) -> bool:
        """Answer the inputs as they are, and let so many seconds pass."""
        targets = {name.removeprefix(TARGET): value for name, value in self._targets.items()}
        move = self.controller.step({"time_s": self._time, **self._readings}, targets)
        drives = self.controller.model.drives
        self._answer = dict(zip(drives, move.drives(drives), strict=True))
        self._answer |= {"pump": float(move.pump), "status": float(STATUSES.index(move.status))}
        self._time += seconds
        return True

    def _inputs(self) -> dict[str, float]:
        return self._readings | self._targets


def to_fmu(controller: Exportable, path: str | Path) -> Path:
    """Write a controller as an FMU; see :meth:`thermogrip.mpc.controllers.mpc.Controller.to_fmu`."""
    target = fmu_path(path, controller.plant)
    taken = {"pump", "status"} & {*controller.model.outputs, *controller.model.disturbances}
    if taken:
        raise UserError(
            f"an FMU has a variable {min(taken)} of its own", hint="give that column another name"
        )
    runs = "thermogrip.mpc.controllers.fmu_runtime"
    return write_fmu(target, controller.to_dict(), runs, "a controller tuned by thermogrip")
