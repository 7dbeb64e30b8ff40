"""The rig: one interface for the twin and (later) hardware, and the session that records grasps."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.rig.interface import Reading, Rig
    from thermogrip.rig.recorder import RunFolder
    from thermogrip.rig.session import Session, run_session
    from thermogrip.rig.touch import Grip, simulate_grasps
    from thermogrip.rig.twin import Twin

__all__ = ["Grip", "Reading", "Rig", "RunFolder", "Session", "Twin", "run_session", "simulate_grasps"]

_HOME = {
    "Grip": "touch",
    "Reading": "interface",
    "Rig": "interface",
    "RunFolder": "recorder",
    "Session": "session",
    "Twin": "twin",
    "run_session": "session",
    "simulate_grasps": "touch",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
