import typing

from thermogrip.sysid.export.dynamics import plant_dynamics as plant_dynamics
from thermogrip.sysid.plant.linearise import linearise_plant as linearise_plant

if typing.TYPE_CHECKING:  # doors of 0.1.0, which are found and not listed
    from thermogrip.sysid.export.dynamics import Dynamics as Dynamics
    from thermogrip.sysid.plant.linearise import LinearPlant as LinearPlant
