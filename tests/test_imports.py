"""Nothing imports upwards: not late, not for a type, not by a string for ``import_module``.

And a heavy package is imported by few modules, inside functions, so that ``thermogrip --help`` is quick.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = {"thermogrip": ROOT / "src" / "thermogrip"}
FOLDERS |= {f"thermogrip.{room}": ROOT / room for room in ("datasets", "sysid", "mpc", "rig", "classify")}

#: Who may import a package: modules, or a whole room.
DOORS = {
    "arviz": {"sysid.greybox.posterior"},
    "casadi": {
        "sysid.models.network", "sysid.greybox.fit", "sysid.plant.linearise", "mpc.plant.prediction",
        "mpc.native.codegen",
    },
    "daqp": {"mpc.optimiser.qp"},
    "distributed": {"datasets.parallel"},
    "emcee": {"sysid.greybox.posterior"},
    "foxglove": {"live.foxglove"},
    "llvmlite": {"sysid.models.jit_rollout"},
    "mcap": {"datasets.rosbag", "rig.records.mcap_export"},
    "nlopt": {"mpc.tuning.tune"},
    "numba": {"datasets.compiled"},
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
    """Return every module of the package by its dotted name, stubs of doors in place of these."""
    out = {}
    for package, folder in FOLDERS.items():
        for path in [*folder.rglob("*.py"), *folder.rglob("*.pyi")]:
            parts = path.relative_to(folder).with_suffix("").parts
            out[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return out


def named(text: str, known: dict[str, Path]) -> Iterator[tuple[str, int]]:
    """Yield modules that a source imports, late and for types too, and those that a string in it names."""
    tree = ast.parse(text)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            names = re.findall(r"^(thermogrip(?:\.\w+)+)(?=$|[:.])", node.value)
        for name in names:
            while name not in known and "." in name:
                name = name.rpartition(".")[0]
            if name in known:
                yield name, node.lineno


@cache
def layers() -> list[tuple[str, dict[str, int]]]:
    """Return the package of each layers contract, and the height of what lies in it."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    out = []
    for contract in content["tool"]["importlinter"]["contracts"]:
        if contract["type"] == "layers":
            rows = [re.split(r"\s*[|]\s*", row) for row in reversed(contract["layers"])]
            out.append((contract["containers"][0], {part: k for k, row in enumerate(rows) for part in row}))
    return out


def goes_up(importer: str, imported: str) -> bool:
    """Tell whether an import goes to a higher layer, or to another one at the same height."""
    for package, height in layers():
        pair = [name.removeprefix(f"{package}.").split(".")[0] for name in (importer, imported)]
        if all(name.startswith(f"{package}.") for name in (importer, imported)) and pair[0] != pair[1]:
            return height[pair[0]] <= height[pair[1]]
    return False


def test_nothing_imports_upwards():
    known = modules()
    found = {
        f"{path.relative_to(ROOT)}:{line} {there}"
        for here, path in known.items()
        for there, line in named(path.read_text(encoding="utf-8"), known)
        if goes_up(here, there)
    }
    assert not found


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
        if path.suffix == ".py"
        for package in external(path.read_text(encoding="utf-8"))
        if past_its_doors(name, package)
    }
    assert not wrong
