"""The physics of two bodies that touch, and what a sensor in one of them reads."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "Grip": "simulation",
    "Impedance": "finite_bodies",
    "Stack": "response",
    "block_contact_flux": "finite_bodies",
    "block_skin_temperature": "finite_bodies",
    "contact_flux": "half_spaces",
    "contact_heat": "half_spaces",
    "contact_temperature": "half_spaces",
    "device_temperature": "half_spaces",
    "half_space": "finite_bodies",
    "layer_on": "finite_bodies",
    "layered_temperature": "finite_bodies",
    "object_surface_temperature": "half_spaces",
    "object_temperature": "half_spaces",
    "sensor_temperature": "half_spaces",
    "simulate_grasps": "simulation",
    "skin_temperature": "half_spaces",
    "slab": "finite_bodies",
    "slab_heat": "finite_bodies",
    "slab_temperature": "finite_bodies",
    "slab_temperature_convective": "finite_bodies",
    "two_body_flux": "finite_bodies",
    "two_body_temperatures": "finite_bodies",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
