from thermogrip.sysid.growth.stepwise import Growth as Growth
from thermogrip.sysid.growth.stepwise import grow as grow
