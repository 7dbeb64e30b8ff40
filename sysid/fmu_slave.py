"""The name under which FMUs of version 0.1.0 look for :mod:`thermogrip.sysid.export.fmu_runtime`."""

from thermogrip.sysid.export.fmu_runtime import *  # noqa: F403
