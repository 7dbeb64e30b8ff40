"""A plant for other libraries: linearised, python-control, scipy, CasADi, FMU."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "LinearPlant": "linearise",
    "linearise_plant": "linearise",
    "to_casadi": "libraries",
    "to_control": "libraries",
    "to_fmu": "fmu",
    "to_scipy": "libraries",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
