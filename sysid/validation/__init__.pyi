from thermogrip.sysid.validation.free_run import FreeRun as FreeRun
from thermogrip.sysid.validation.stated_errors import Band as Band
from thermogrip.sysid.validation.stated_errors import free_run_band as free_run_band
