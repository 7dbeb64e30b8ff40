"""The rig: one interface for the twin and hardware, virtual devices, and the session that records grasps."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.rig.device import DeviceRig
    from thermogrip.rig.interface import Reading, Rig
    from thermogrip.rig.opening import open_rig
    from thermogrip.rig.port import Port
    from thermogrip.rig.recorder import RunFolder
    from thermogrip.rig.session import Session, run_session
    from thermogrip.rig.tclab import TCLabRig
    from thermogrip.rig.touch import Grip, simulate_grasps
    from thermogrip.rig.twin import Twin
    from thermogrip.rig.virtual import VirtualDevice

__all__ = [
    "DeviceRig",
    "Grip",
    "Port",
    "Reading",
    "Rig",
    "RunFolder",
    "Session",
    "TCLabRig",
    "Twin",
    "VirtualDevice",
    "open_rig",
    "run_session",
    "simulate_grasps",
]

_HOME = {
    "DeviceRig": "device",
    "Grip": "touch",
    "Port": "port",
    "Reading": "interface",
    "Rig": "interface",
    "RunFolder": "recorder",
    "Session": "session",
    "TCLabRig": "tclab",
    "Twin": "twin",
    "VirtualDevice": "virtual",
    "open_rig": "opening",
    "run_session": "session",
    "simulate_grasps": "touch",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
