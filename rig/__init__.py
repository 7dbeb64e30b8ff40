"""The rig: one interface for the twin and hardware, virtual devices, and the session that records grasps."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.rig.batch import Trial, read_plan, run_batch
    from thermogrip.rig.bridge import Bridge
    from thermogrip.rig.device import DeviceRig
    from thermogrip.rig.guard import Guard, GuardSettings
    from thermogrip.rig.guard_file import read_guard
    from thermogrip.rig.interface import Reading, Rig
    from thermogrip.rig.opening import open_rig
    from thermogrip.rig.port import Port
    from thermogrip.rig.recorder import RunFolder
    from thermogrip.rig.run_export import export_run
    from thermogrip.rig.run_files import read_run, recover
    from thermogrip.rig.session import Object, Session, run_session
    from thermogrip.rig.tclab import TCLabRig
    from thermogrip.rig.touch import Grip, simulate_grasps
    from thermogrip.rig.trips import Trip
    from thermogrip.rig.twin import Twin
    from thermogrip.rig.virtual import VirtualDevice

__all__ = [
    "Bridge",
    "DeviceRig",
    "Grip",
    "Guard",
    "GuardSettings",
    "Object",
    "Port",
    "Reading",
    "Rig",
    "RunFolder",
    "Session",
    "TCLabRig",
    "Trial",
    "Trip",
    "Twin",
    "VirtualDevice",
    "export_run",
    "open_rig",
    "read_guard",
    "read_plan",
    "read_run",
    "recover",
    "run_batch",
    "run_session",
    "simulate_grasps",
]

_HOME = {
    "Bridge": "bridge",
    "DeviceRig": "device",
    "Grip": "touch",
    "Guard": "guard",
    "GuardSettings": "guard",
    "Object": "session",
    "Port": "port",
    "Reading": "interface",
    "Rig": "interface",
    "RunFolder": "recorder",
    "Session": "session",
    "TCLabRig": "tclab",
    "Trial": "batch",
    "Trip": "trips",
    "Twin": "twin",
    "VirtualDevice": "virtual",
    "export_run": "run_export",
    "open_rig": "opening",
    "read_guard": "guard_file",
    "read_plan": "batch",
    "read_run": "run_files",
    "recover": "run_files",
    "run_batch": "batch",
    "run_session": "session",
    "simulate_grasps": "touch",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
