"""What runs inside an FMU of a plant: its parameters, its state, and one communication step.

:mod:`thermogrip.sysid.export.fmu` packs a plant's JSON with a script that hands every call on to a
:class:`Core`. The state at the start is the plant at rest with its sensors at the ``start_`` temperatures,
held by an input near the first one.  A communication step is cut into whole steps of the plant, or where it
is no multiple of that, into equal shorter ones; a black box has no shorter ones and reports the step as
failed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.export.linearise import operating_point
from thermogrip.sysid.plant.plant import Plant

__all__ = ["Core", "Port", "core_of", "described"]

Array = NDArray[np.float64]

START = "start_"  # with the name of an output: what it reads when the simulation begins


@dataclass(frozen=True)
class Port:
    """A variable of the FMU: its name, what it is for (input, output, parameter), its unit."""

    name: str
    causality: str
    unit: str

    @property
    def variability(self) -> str:
        """When it may change, as FMI has it."""
        if self.name.startswith(START) and self.causality == "parameter":
            return "fixed"
        return "tunable" if self.causality == "parameter" else "continuous"


class Core:
    """A plant that is stepped from outside.

    Parameters
    ----------
    plant : Plant

    Examples
    --------
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> core = Core(prior_plant(load_network("tclab")))
    >>> core.set("start_t1", 23.0), core.set("start_t2", 23.0), core.begin()
    (None, None, None)
    >>> core.set("q1", 50.0)
    >>> core.advance(60.0), round(core.get("t1"), 1)
    (True, 31.1)
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        u, d = operating_point(plant, None, None)
        self._inputs = dict(zip(plant.inputs, u.tolist())) | dict(zip(plant.disturbances, d.tolist()))
        self._parameters = {name: float(plant.values[name]) for name in plant.model.parameters}
        room = float(d[0]) if d.size and plant.units.get(plant.disturbances[0], "degC") == "degC" else 25.0
        usual = {name: room if plant.units.get(name, "degC") == "degC" else 0.0 for name in plant.outputs}
        self._start = {START + name: value for name, value in usual.items()}
        self._x: Array | None = None

    @property
    def ports(self) -> tuple[Port, ...]:
        """All variables: inputs and disturbances, outputs, parameters, starts."""
        units = self.plant.units
        out = [Port(name, "input", units.get(name, "1")) for name in self._inputs]
        out += [Port(name, "output", units.get(name, "1")) for name in self.plant.outputs]
        out += [Port(name, "parameter", units.get(name, "1")) for name in self._parameters]
        starts = self._start
        return (*out, *(Port(name, "parameter", units.get(name[len(START) :], "1")) for name in starts))

    def get(self, name: str) -> float:
        """Return a variable's value."""
        for group in (self._inputs, self._parameters, self._start):
            if name in group:
                return group[name]
        x = self._at_rest() if self._x is None else self._x
        y = self.plant.model.output(x.tolist(), list(self._parameters.values()))
        return float(y[self.plant.outputs.index(name)])

    def set(self, name: str, value: float) -> None:
        """Set an input, a parameter or a start."""
        for group in (self._inputs, self._parameters, self._start):
            if name in group:
                group[name] = float(value)
                return
        raise KeyError(name)

    def begin(self) -> None:
        """Put the plant at rest with its sensors at their starts."""
        self._x = self._at_rest()

    def advance(self, seconds: float) -> bool:
        """Simulate so many seconds under the inputs as they are; False: the step cannot be made."""
        if self._x is None:
            self.begin()
        assert self._x is not None
        n = max(1, int(np.ceil(seconds / self.plant.dt - 1e-9)))
        h = seconds / n
        if abs(h - self.plant.dt) <= 1e-9 * h:
            h = self.plant.dt
        elif self.plant.model.kind not in ("network", "own"):
            return False
        u, d = (self._vector(names, n) for names in (self.plant.inputs, self.plant.disturbances))
        p = np.array(list(self._parameters.values()))
        _, end = self.plant.model.rollout(self._x[None], u, d, p[None], h)
        if not np.isfinite(end).all():
            return False
        self._x = np.asarray(end[0], dtype=float)
        return True

    def _vector(self, names: tuple[str, ...], n: int) -> Array:
        return np.tile(np.array([self._inputs[name] for name in names]), (1, n, 1))

    def _at_rest(self) -> Array:
        u, d = (self._vector(names, 1)[0, 0] for names in (self.plant.inputs, self.plant.disturbances))
        y, p = np.array(list(self._start.values())), np.array(list(self._parameters.values()))
        return np.asarray(self.plant.model.rest(y, u, d, p), dtype=float)


def described(root: Element, ports: Sequence[Port]) -> Element:
    """Return a model description with what its writer leaves out: units, and which unknowns exist at the
    start."""
    units = Element("UnitDefinitions")
    for unit in sorted({port.unit for port in ports}):
        SubElement(units, "Unit", name=unit)
    root.insert([child.tag for child in root].index("CoSimulation") + 1, units)
    by_name = {port.name: port for port in ports}
    structure = root.find("ModelStructure")
    assert structure is not None
    initial = SubElement(structure, "InitialUnknowns")
    for index, variable in enumerate(root.iter("ScalarVariable"), start=1):
        port, real = by_name[variable.attrib["name"]], variable.find("Real")
        assert real is not None
        real.set("unit", port.unit)
        if port.causality == "output":
            SubElement(initial, "Unknown", index=str(index))
    return root


def core_of(path: Path) -> Any:
    """Return the core of the plant in a JSON file of ``Plant.to_dict``."""
    return Core(Plant.from_dict(json.loads(path.read_text(encoding="utf-8"))))
