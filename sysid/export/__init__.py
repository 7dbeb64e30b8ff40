"""A plant for other libraries: linearised, python-control, scipy, CasADi."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
