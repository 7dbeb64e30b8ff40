from thermogrip.sysid.experiment.optimal import Expectation as Expectation
from thermogrip.sysid.experiment.optimal import expect as expect
from thermogrip.sysid.experiment.optimal import optimal_schedule as optimal_schedule
from thermogrip.sysid.experiment.schedules import excite as excite
