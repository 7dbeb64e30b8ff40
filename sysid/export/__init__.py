"""A plant for other libraries: linearised, python-control, scipy, CasADi, FMU."""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {"dynamics": ("Dynamics",), "linearise": ("LinearPlant",)}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
