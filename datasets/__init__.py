"""The records every stage exchanges (Log, Grasps), their files, materials, examples and splits."""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {
    "examples": ("copy_examples",),
    "grasp_files": ("read_grasp_files", "shared_grasps"),
    "materials": ("Material", "load_materials"),
    "resample": ("gaps", "hold_average"),
    "splits": ("by_block", "by_grasp", "by_session", "shipped"),
}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
