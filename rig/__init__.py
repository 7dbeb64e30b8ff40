"""The rig: one interface for the twin and hardware, virtual devices, and the session that records grasps."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.rig.drivers.connect import open_rig
    from thermogrip.rig.drivers.tclab import TCLabRig
    from thermogrip.rig.drivers.thermogrip import DeviceRig
    from thermogrip.rig.guard.guard import Guard, GuardSettings
    from thermogrip.rig.guard.settings import read_guard
    from thermogrip.rig.guard.trip import Trip
    from thermogrip.rig.interface import Reading, Rig
    from thermogrip.rig.records.batch import Trial, read_plan, run_batch
    from thermogrip.rig.records.export import export_run
    from thermogrip.rig.records.recorder import RunFolder
    from thermogrip.rig.records.rosbridge import Bridge
    from thermogrip.rig.records.run_folder import read_run, recover
    from thermogrip.rig.serial.port import Port
    from thermogrip.rig.session.session import Object, Session, run_session
    from thermogrip.rig.simulation.twin import Twin
    from thermogrip.rig.simulation.virtual_device import VirtualDevice
    from thermogrip.sysid.contact.simulation import Grip, simulate_grasps

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

_NAMES = {
    "drivers.connect": ["open_rig"], "drivers.tclab": ["TCLabRig"], "drivers.thermogrip": ["DeviceRig"],
    "guard.guard": ["Guard", "GuardSettings"], "guard.settings": ["read_guard"], "guard.trip": ["Trip"],
    "interface": ["Reading", "Rig"], "records.batch": ["Trial", "read_plan", "run_batch"],
    "records.export": ["export_run"], "records.recorder": ["RunFolder"], "records.rosbridge": ["Bridge"],
    "records.run_folder": ["read_run", "recover"], "serial.port": ["Port"],
    "session.session": ["Object", "Session", "run_session"],
    "simulation.twin": ["Twin"], "simulation.virtual_device": ["VirtualDevice"],
    ".sysid.contact.simulation": ["Grip", "simulate_grasps"],
}  # fmt: skip
_HOME = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)
