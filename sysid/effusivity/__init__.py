"""Inference from grasps: effusivity, object temperature and material, with a calibrated gripper."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_NAMES = {
    "calibration": ["calibrate_gripper"],
    "gripper_model": ["GripperModel", "another_gripper", "load_default_gripper"],
    "multi_touch": ["Coupling"],
    "posterior": [
        "EffusivityRow", "MaterialFit", "OpenSet", "effusivity_posterior", "material_evidence",
        "material_fit", "material_posterior", "open_set",
    ],
    "quality": ["check_grasps"],
}  # fmt: skip
_HOME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
