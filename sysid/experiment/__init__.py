"""Input schedules for identification, and how much information they are expected to give."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {"Expectation": "optimal", "excite": "schedules", "expect": "optimal", "optimal_schedule": "optimal"}
__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
