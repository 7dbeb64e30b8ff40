"""A heavy package is imported by few modules, inside functions, so that ``thermogrip --help`` is quick."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = {"thermogrip": ROOT / "src" / "thermogrip"}
FOLDERS |= {f"thermogrip.{room}": ROOT / room for room in ("datasets", "sysid", "mpc", "rig", "classify")}

#: Who may import a package: modules, or a whole room.
DOORS = {
    "arviz": {"sysid.greybox.posterior"},
    "casadi": {
        "sysid.models.jit_rollout", "sysid.greybox.fit", "sysid.plant.plant", "mpc.plant.prediction",
        "mpc.native.codegen",
    },
    "daqp": {"mpc.optimiser.qp"},
    "distributed": {"datasets.parallel"},
    "emcee": {"sysid.greybox.posterior"},
    "foxglove": {"live.foxglove"},
    "llvmlite": {"sysid.models.jit_rollout"},
    "mcap": {"datasets.rosbag", "rig.records.mcap_export"},
    "nlopt": {"mpc.tuning.tune"},
    "numba": {"sysid.contact.time_stepping", "sysid.effusivity.mode_kernel", "sysid.models.recurrences"},
    "pysindy": {"sysid.blackbox.sindy"},
    "rosbags": {"datasets.rosbag"},
    "safetensors": {"classify.estimators.lstm", "classify.estimators.registry"},
    "serial": {"rig.serial.port"},
    "starlette": {"live.server", "classify.decisions.serve"},
    "torch": {"classify.estimators.lstm"},
    "uvicorn": {"live.server", "classify.decisions.serve"},
    "websockets": {"rig.records.rosbridge"},
    "aeon": {"classify"},
    "sklearn": {"classify", "cli.compare"},
    # what runs code from a file
    **{name: set() for name in ("pickle", "shelve", "dill", "marshal")},
    "joblib": set(),
    "loky": {"datasets.parallel"},  # its processes; no file is opened by it
}  # fmt: skip


def modules() -> dict[str, Path]:
    """Return every module of the package by its dotted name."""
    out = {}
    for package, folder in FOLDERS.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            out[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return out


def external(text: str) -> set[str]:
    """Return the packages outside of the project that a source imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").partition(".")[0])
    return found


def past_its_doors(module: str, package: str) -> bool:
    """Tell whether a package has doors and a module is none of them."""
    doors = [f"thermogrip.{door}." for door in DOORS.get(package, ())]
    return package in DOORS and not f"{module}.".startswith(tuple(doors))


def test_a_heavy_package_is_imported_by_its_doors_alone():
    wrong = {
        f"{name} imports {package}"
        for name, path in modules().items()
        for package in external(path.read_text(encoding="utf-8"))
        if past_its_doors(name, package)
    }
    assert not wrong
