"""Input schedules for identification, and how much information they are expected to give."""

from thermogrip import lazy_exports

_HOME = {"Expectation": "optimal", "excite": "schedules", "expect": "optimal", "optimal_schedule": "optimal"}
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
