"""A plant for other libraries: linearised, python-control, scipy, CasADi, FMU."""

from thermogrip import lazy_exports

_HOME = {
    "LinearPlant": "linearise",
    "linearise_plant": "linearise",
    "to_casadi": "libraries",
    "to_control": "libraries",
    "to_fmu": "fmu",
    "to_scipy": "libraries",
}
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
