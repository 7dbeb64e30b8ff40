"""The records every stage exchanges (Log, Grasps), their files, materials, examples and splits."""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {"copy_examples": "examples", "hold_average": "resample", "shared_grasps": "grasp_files"}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
