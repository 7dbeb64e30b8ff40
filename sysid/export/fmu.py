"""A plant as an FMU: FMI 2.0 co-simulation, by pythonfmu.

The FMU holds the plant's JSON and a short script that passes every call on to a :class:`Core`; its binary
starts the Python of the machine that runs it, where thermogrip must be installed.  So what is simulated is
the plant itself, to the last digit, of whatever kind: thermal network, state space, SINDy.  Its inputs and
disturbances are FMU inputs, its outputs FMU outputs, its parameters tunable parameters, and
``start_<output>`` what a sensor reads at the start.

The state at the start is the plant at rest with its sensors at the ``start_`` temperatures, held by an input
near the first one.  A communication step is cut into whole steps of the plant, or where it is no multiple of
that, into equal shorter ones; a black box has no shorter ones and reports the step as failed.

A model of the user's own is refused: its class is in no file, and opening a file never runs code.
"""

from __future__ import annotations

import json
import keyword
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.atomic_files import atomic_path
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.provenance import KEY, provenance
from thermogrip.sysid.export.linearise import needed, operating_point
from thermogrip.sysid.plant.plant import Plant

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
    """A plant that is stepped from outside."""

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
    def dt(self) -> float:
        """The plant's own step [s]."""
        return self.plant.dt

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


def to_fmu(plant: Plant, path: str | Path) -> Path:
    """Write the plant as an FMU (FMI 2.0, co-simulation) and return the path.

    Parameters
    ----------
    plant : Plant
    path : str or Path
        Ends in ``.fmu``; its stem becomes the model's identifier.

    Raises
    ------
    UserError
        If pythonfmu is not installed, the name cannot be an identifier, or the plant is a class of the user's
        own.

    Examples
    --------
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     to_fmu(prior_plant(load_network("tclab")), f"{folder}/board.fmu").name
    'board.fmu'
    """
    target = fmu_path(path, plant)
    Core(plant)  # refuses here what the script would refuse inside
    content = replace(plant, samples=None).to_dict()
    return write_fmu(target, content, "thermogrip.sysid.export.fmu", "a plant identified by thermogrip")


def fmu_path(path: str | Path, plant: Plant) -> Path:
    """Return where an FMU of a plant, or of its controller, goes; a UserError where its stem cannot be an
    identifier, or the plant is in no file."""
    target = Path(path)
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", target.stem) and not keyword.iskeyword(target.stem)
    if target.suffix != ".fmu" or not plain:
        raise UserError(
            "cannot name an FMU", file=target, hint="letters, digits and underscores, ending in .fmu"
        )
    if plant.model.kind == "own":
        raise UserError(
            "the plant is a class of your own, which no FMU can hold", hint="write it as a network"
        )
    return target


def write_fmu(target: Path, content: dict[str, Any], core: str, what: str) -> Path:
    """Write an FMU with this JSON in it and return its path; ``core_of`` of the module ``core`` makes of it
    what is stepped, ``what`` describes it."""
    name = target.stem
    builder = needed("pythonfmu.builder", "fmu")
    with tempfile.TemporaryDirectory() as folder, atomic_path(target) as temporary:
        module = f"thermogrip_slave_{name}"
        script, beside = Path(folder) / f"{module}.py", Path(folder) / f"{name}.json"
        # names in it begin with an underscore, so that no name of a plant can hide one of them
        text = (resources.files("thermogrip.sysid.export") / "slave.py.in").read_text(encoding="utf-8")
        script.write_text(text.format(name=name, module=core, what=what), encoding="utf-8")
        beside.write_text(json.dumps(content | {KEY: provenance()}), encoding="utf-8")
        path_before = list(sys.path)
        sys.modules.pop(module, None)  # the builder imports the script by its name
        try:
            made = builder.FmuBuilder.build_FMU(script, dest=Path(folder), project_files=[beside])
        finally:
            sys.path[:] = path_before
            sys.modules.pop(module, None)
        Path(temporary).write_bytes(Path(made).read_bytes())
    return target
