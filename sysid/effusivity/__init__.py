"""Inference from grasps: effusivity, object temperature and material, with a calibrated gripper."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "Coupling": "multi_touch",
    "EffusivityRow": "posterior",
    "GripperModel": "gripper_model",
    "MaterialFit": "posterior",
    "OpenSet": "posterior",
    "another_gripper": "gripper_model",
    "calibrate_gripper": "calibration",
    "check_grasps": "quality",
    "effusivity_posterior": "posterior",
    "load_default_gripper": "gripper_model",
    "material_evidence": "posterior",
    "material_fit": "posterior",
    "material_posterior": "posterior",
    "open_set": "posterior",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
