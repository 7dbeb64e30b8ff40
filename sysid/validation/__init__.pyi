from thermogrip.sysid.validation.free_run import FreeRun as FreeRun
from thermogrip.sysid.validation.prediction_bands import Band as Band
from thermogrip.sysid.validation.prediction_bands import free_run_band as free_run_band
