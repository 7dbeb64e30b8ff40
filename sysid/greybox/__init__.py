"""Fits of models with physical parameters, how well these are identifiable, and posteriors."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {"Posterior": "posterior", "fit_network": "fit", "sample_posterior": "posterior"}
__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
