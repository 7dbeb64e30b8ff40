"""Thermal touch with a finger that sets its own temperature.

The rooms are ``thermogrip.datasets``, ``sysid``, ``mpc``, ``rig`` and ``classify``; data flows through them
one way: logs -> plant -> controller -> session -> grasps -> classifier -> report.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

os.environ.setdefault("NUMBA_CACHE_DIR", "")  # else numba's settings in the working folder may name one


def lazy_exports(package: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__all__``, ``__getattr__`` and ``__dir__`` of a package that loads its exports at first use
    (PEP 562): what the ``__init__.pyi`` beside its ``__init__.py`` imports, for type checkers as well."""
    stub = ast.parse(Path(str(sys.modules[package].__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(stub) if isinstance(node, ast.ImportFrom)]
    home = {alias.name: str(node.module) for node in imports for alias in node.names}
    # what the stub imports under ``if typing.TYPE_CHECKING`` is found and not listed
    listed = sorted(alias.name for node in imports if node in stub.body for alias in node.names)

    def load(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(home[name], package), name)

    return listed, load, lambda: listed.copy()
