"""A plant as an FMU: FMI 2.0 co-simulation, by pythonfmu.

The FMU holds the plant's JSON and a short script; its binary starts the Python of the machine that runs it,
where thermogrip must be installed.  So what is simulated is the plant itself, to the last digit, of
whatever kind: thermal network, state space, SINDy.  Its inputs and disturbances are FMU inputs, its outputs
FMU outputs, its parameters tunable parameters, and ``start_<output>`` what a sensor reads at the start.

A model of the user's own is refused: its class stands in no file, and opening a file never runs code.
"""

from __future__ import annotations

import json
import keyword
import re
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from thermogrip.datasets.atomic_files import atomic_path
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.export.fmu_runtime import Core
from thermogrip.sysid.export.libraries import needed

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["to_fmu"]

# its own names begin with an underscore, so that no name of a plant can hide one of them
_SCRIPT = '''"""The plant {name}, by thermogrip; it needs thermogrip in the Python that runs it."""

from pathlib import Path as _Path

import pythonfmu as _fmi
from thermogrip.sysid.export.fmu_runtime import core_of as _core_of
from thermogrip.sysid.export.fmu_runtime import described as _described


class {name}(_fmi.Fmi2Slave):
    description = "{name}: a plant identified by thermogrip"

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.core = _core_of(_Path(__file__).parent / "{name}.json")
        self.default_experiment = _fmi.DefaultExperiment(start_time=0.0, step_size=self.core.plant.dt)
        for port in self.core.ports:
            self.register_variable(self._real(port), nested=False)

    def _real(self, port):
        name, core = port.name, self.core
        kind = dict(causality=_fmi.Fmi2Causality[port.causality])
        kind["variability"] = _fmi.Fmi2Variability[port.variability]
        setter = None if port.causality == "output" else lambda value: core.set(name, value)
        return _fmi.Real(name, getter=lambda: core.get(name), setter=setter, **kind)

    def to_xml(self, *args, **kwargs):
        return _described(super().to_xml(*args, **kwargs), self.core.ports)

    def exit_initialization_mode(self):
        self.core.begin()

    def do_step(self, current_time, step_size):
        return self.core.advance(step_size)
'''


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
    """
    target = Path(path)
    name = target.stem
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) and not keyword.iskeyword(name)
    if target.suffix != ".fmu" or not plain:
        raise UserError(
            "cannot name an FMU", file=target, hint="letters, digits and underscores, ending in .fmu"
        )
    if plant.model.kind == "own":
        raise UserError(
            "the plant is a class of your own, which no FMU can hold", hint="write it as a network"
        )
    builder = needed("pythonfmu.builder", "fmu")
    Core(plant)  # refuses here what the script would refuse inside
    with tempfile.TemporaryDirectory() as folder, atomic_path(target) as temporary:
        module = f"thermogrip_slave_{name}"
        script, beside = Path(folder) / f"{module}.py", Path(folder) / f"{name}.json"
        script.write_text(_SCRIPT.format(name=name), encoding="utf-8")
        beside.write_text(json.dumps(replace(plant, samples=None).to_dict()), encoding="utf-8")
        path_before = list(sys.path)
        sys.modules.pop(module, None)  # the builder imports the script by its name
        try:
            made = builder.FmuBuilder.build_FMU(script, dest=Path(folder), project_files=[beside])
        finally:
            sys.path[:] = path_before
            sys.modules.pop(module, None)
        Path(temporary).write_bytes(Path(made).read_bytes())
    return target
