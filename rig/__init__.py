"""The rig: one interface for the twin and hardware, virtual devices, and the session that records grasps."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
