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

_HOME = {
    "Bridge": "records.rosbridge",
    "DeviceRig": "drivers.thermogrip",
    "Grip": "thermogrip.sysid.contact.simulation",
    "Guard": "guard.guard",
    "GuardSettings": "guard.guard",
    "Object": "session.session",
    "Port": "serial.port",
    "Reading": "interface",
    "Rig": "interface",
    "RunFolder": "records.recorder",
    "Session": "session.session",
    "TCLabRig": "drivers.tclab",
    "Trial": "records.batch",
    "Trip": "guard.trip",
    "Twin": "simulation.twin",
    "VirtualDevice": "simulation.virtual_device",
    "export_run": "records.export",
    "open_rig": "drivers.connect",
    "read_guard": "guard.settings",
    "read_plan": "records.batch",
    "read_run": "records.run_folder",
    "recover": "records.run_folder",
    "run_batch": "records.batch",
    "run_session": "session.session",
    "simulate_grasps": "thermogrip.sysid.contact.simulation",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _HOME[name]
    return getattr(import_module(home if home.startswith("thermogrip.") else f"{__name__}.{home}"), name)
