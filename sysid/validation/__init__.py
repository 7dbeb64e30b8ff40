"""Free runs on logs that were not fitted: errors, bands, and tests of the residuals."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {"Band": "prediction_bands", "FreeRun": "free_run", "free_run_band": "prediction_bands"}
__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
