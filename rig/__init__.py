"""The rig: one interface for the twin and hardware, virtual devices, and the session that records grasps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermogrip import lazy_exports

if TYPE_CHECKING:
    from thermogrip.rig.drivers.connect import open_rig as open_rig
    from thermogrip.rig.drivers.tclab import TCLabRig as TCLabRig
    from thermogrip.rig.drivers.thermogrip import DeviceRig as DeviceRig
    from thermogrip.rig.guard.guard import Guard as Guard
    from thermogrip.rig.guard.guard import GuardSettings as GuardSettings
    from thermogrip.rig.guard.settings import read_guard as read_guard
    from thermogrip.rig.guard.trip import Trip as Trip
    from thermogrip.rig.interface import Reading as Reading
    from thermogrip.rig.interface import Rig as Rig
    from thermogrip.rig.records.batch import Trial as Trial
    from thermogrip.rig.records.batch import read_plan as read_plan
    from thermogrip.rig.records.batch import run_batch as run_batch
    from thermogrip.rig.records.export import export_run as export_run
    from thermogrip.rig.records.recorder import RunFolder as RunFolder
    from thermogrip.rig.records.rosbridge import Bridge as Bridge
    from thermogrip.rig.records.run_folder import read_run as read_run
    from thermogrip.rig.records.run_folder import recover as recover
    from thermogrip.rig.serial.port import Port as Port
    from thermogrip.rig.session.session import Object as Object
    from thermogrip.rig.session.session import Session as Session
    from thermogrip.rig.session.session import run_session as run_session
    from thermogrip.rig.simulation.twin import Twin as Twin
    from thermogrip.rig.simulation.virtual_device import VirtualDevice as VirtualDevice
    from thermogrip.sysid.contact.simulation import Grip as Grip
    from thermogrip.sysid.contact.simulation import simulate_grasps as simulate_grasps

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

__all__ = sorted(_HOME)
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
