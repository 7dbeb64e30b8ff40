"""Inference from grasps: effusivity, object temperature and material, with a calibrated gripper."""

from thermogrip import lazy_exports

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
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
