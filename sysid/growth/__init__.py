"""Terms added to and pruned from a network, decided on held-out logs."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {"Growth": "stepwise", "grow": "stepwise"}
__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
