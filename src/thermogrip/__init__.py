"""Thermal touch with a finger that sets its own temperature.

The rooms are ``thermogrip.datasets``, ``sysid``, ``mpc``, ``rig`` and ``classify``; data flows through them
one way: logs -> plant -> controller -> session -> grasps -> classifier -> report.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def lazy_exports(
    package: str, home: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package whose exports are loaded at first use (PEP 562).

    ``home`` is the module of each exported name, relative to the package (``.datasets.schema`` is beside it).
    """

    def load(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f".{home[name]}", package), name)

    return load, lambda: sorted({*vars(sys.modules[package]), *home})
