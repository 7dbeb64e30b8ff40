"""Input schedules for identification, and how much information they are expected to give."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
