"""The rig: one interface for the twin and hardware, virtual devices, and the session that records grasps."""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {
    ".sysid.contact.simulation": ("Grip",),
    "drivers.tclab": ("TCLabRig",),
    "drivers.thermogrip": ("DeviceRig",),
    "guard.guard": ("GuardSettings",),
    "guard.trip": ("Trip",),
    "records.batch": ("Trial",),
    "records.run_folder": ("RunFolder", "export_run", "recover"),
    "serial.port": ("Port",),
    "session.session": ("Object", "Session"),
}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
