"""The physics of two bodies that touch, and what a sensor in one of them reads."""

from thermogrip import lazy_exports

_NAMES = {
    "closed_forms": [
        "Impedance", "block_contact_flux", "block_skin_temperature", "contact_flux", "contact_heat",
        "contact_temperature", "device_temperature", "half_space", "layer_on", "layered_temperature",
        "object_surface_temperature", "object_temperature", "sensor_temperature", "skin_temperature", "slab",
        "slab_heat", "slab_temperature", "slab_temperature_convective", "two_body_flux",
        "two_body_temperatures",
    ],
    "response": ["Stack"],
    "simulation": ["Grip", "simulate_grasps"],
}  # fmt: skip
_HOME = {name: module for module, names in _NAMES.items() for name in names}
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
