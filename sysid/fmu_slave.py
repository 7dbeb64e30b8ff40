"""The name under which FMUs of version 0.1.0 look for :mod:`thermogrip.sysid.export.fmu`."""

from thermogrip.sysid.export.fmu import *  # noqa: F403
