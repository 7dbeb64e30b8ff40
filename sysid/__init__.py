"""Identification: thermal networks, grey-box and black-box fits, posteriors, contact physics.

>>> from thermogrip.sysid import read_log, identify, Plant
>>> identify.__name__, Plant.__name__
('identify', 'Plant')
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.datasets.log_files import read_log as read_log
    from thermogrip.sysid.identification import identify as identify
    from thermogrip.sysid.plant.plant import Plant as Plant

__all__ = ["Plant", "identify", "read_log"]

# Looked up on first use, so that importing the room pulls in no heavy package.
_HOME = {
    "Plant": "thermogrip.sysid.plant.plant",
    "identify": "thermogrip.sysid.identification",
    "read_log": "thermogrip.datasets.log_files",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
