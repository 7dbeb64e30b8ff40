"""The physics of two bodies that touch, and what a sensor in one of them reads."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
