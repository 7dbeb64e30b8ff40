"""Inference from grasps: effusivity, object temperature and material, with a calibrated gripper."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
