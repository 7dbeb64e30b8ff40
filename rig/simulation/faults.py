"""What of a virtual device may fail; it is known without loading one."""

#: Faults of one sensor, and the option that each takes.
SENSOR_FAULTS = {
    "sensor_open": "the wire is broken",
    "sensor_short": "the wires touch",
    "sensor_stuck": "it repeats its last value",
    "sensor_drift": "it leaves the truth by `rate` K/s",
    "sensor_lag": "it shows what was `seconds` ago",
    "sensor_offset": "it is off by `kelvin` at once",
    "sensor_nan": "the device itself reports nonsense (-273.15 degC)",
}
#: What :meth:`~thermogrip.rig.simulation.virtual_device.VirtualDevice.fault` knows.
FAULTS = SENSOR_FAULTS | {
    "garbage": "each line, either way, is spoilt with probability `rate`",
    "silence": "its answers are lost",
    "deaf": "the host's lines are lost",
    "reset": "it starts anew, for the reason `cause`; happens once",
    "pump_stall": "the pump has stopped, whatever is commanded",
    "driver_stuck": "every driver gives `share` (-1 to 1) of its full range while it has a supply",
    "cable_pulled": "the port vanishes; its drive runs on until it expires",
}
