"""Fits of linear, polynomial and neural models, with structure and order chosen on held-out stretches."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {"BLACK_BOXES": "fit", "fit_black_box": "fit"}
__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
