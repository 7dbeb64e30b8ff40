"""Inference from grasps: effusivity, object temperature and material, with a calibrated gripper."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "EffusivityRow": "posterior",
    "MaterialFit": "posterior",
    "OpenSet": "posterior",
    "effusivity_posterior": "posterior",
    "material_evidence": "posterior",
    "material_fit": "posterior",
    "material_posterior": "posterior",
    "open_set": "posterior",
}

__all__ = [
    "EffusivityRow",
    "MaterialFit",
    "OpenSet",
    "effusivity_posterior",
    "material_evidence",
    "material_fit",
    "material_posterior",
    "open_set",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
