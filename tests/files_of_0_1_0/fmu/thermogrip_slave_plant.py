"""The plant plant, by thermogrip; it needs thermogrip in the Python that runs it."""

from pathlib import Path as _Path

import pythonfmu as _fmi
from thermogrip.sysid.fmu_slave import core_of as _core_of
from thermogrip.sysid.fmu_slave import described as _described


class plant(_fmi.Fmi2Slave):
    description = "plant: a plant identified by thermogrip"

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.core = _core_of(_Path(__file__).parent / "plant.json")
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
