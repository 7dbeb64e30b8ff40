"""A plant for other libraries: linearised, python-control, scipy, CasADi, FMU."""

from thermogrip import lazy_exports

_HOME = {
    "Dynamics": "dynamics",
    "LinearPlant": "linearise",
    "linearise_plant": "linearise",
    "plant_dynamics": "dynamics",
    "to_casadi": "libraries",
    "to_control": "libraries",
    "to_fmu": "fmu",
    "to_scipy": "libraries",
}
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
