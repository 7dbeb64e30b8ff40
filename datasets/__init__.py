"""The records every stage exchanges (Log, Grasps), their files, materials, examples and splits."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.datasets.errors import UserError
    from thermogrip.datasets.examples import example_path, load_example_grasps, load_example_logs
    from thermogrip.datasets.grasp_files import read_grasp_files, read_grasps, write_grasps
    from thermogrip.datasets.log_files import read_log, write_log
    from thermogrip.datasets.materials import Material, find_material, load_materials
    from thermogrip.datasets.resample import average, cut, gaps
    from thermogrip.datasets.schema import Grasps, Log, make_grasps, make_log
    from thermogrip.datasets.splits import by_block, by_grasp, by_session, shipped

__all__ = [
    "Grasps", "Log", "Material", "UserError", "average", "by_block", "by_grasp", "by_session", "cut",
    "example_path", "find_material", "gaps", "load_example_grasps", "load_example_logs", "load_materials",
    "make_grasps", "make_log", "read_grasp_files", "read_grasps", "read_log", "shipped", "write_grasps",
    "write_log",
]  # fmt: skip

# what is not listed above was a door of 0.1.0
_MODULES = {
    "errors": ("UserError",),
    "examples": ("copy_examples", "example_path", "load_example_grasps", "load_example_logs"),
    "grasp_files": ("read_grasp_files", "read_grasps", "shared_grasps", "write_grasps"),
    "log_files": ("read_log", "write_log"),
    "materials": ("Material", "find_material", "load_materials"),
    "resample": ("average", "cut", "gaps", "hold_average"),
    "schema": ("Grasps", "Log", "make_grasps", "make_log"),
    "splits": ("by_block", "by_grasp", "by_session", "shipped"),
}
_HOME = {name: module for module, exported in _MODULES.items() for name in exported}


def __getattr__(name: str) -> Any:  # PEP 562: importing the package loads neither xarray nor pyarrow
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
