import typing

from thermogrip.rig.drivers.connect import open_rig as open_rig
from thermogrip.rig.guard.guard import Guard as Guard
from thermogrip.rig.guard.settings import read_guard as read_guard
from thermogrip.rig.interface import Reading as Reading
from thermogrip.rig.interface import Rig as Rig
from thermogrip.rig.records.batch import read_plan as read_plan
from thermogrip.rig.records.batch import run_batch as run_batch
from thermogrip.rig.records.rosbridge import Bridge as Bridge
from thermogrip.rig.records.run_folder import read_run as read_run
from thermogrip.rig.session.session import run_session as run_session
from thermogrip.rig.simulation.twin import Twin as Twin
from thermogrip.rig.simulation.virtual_device import VirtualDevice as VirtualDevice
from thermogrip.sysid.contact.simulation import simulate_grasps as simulate_grasps

if typing.TYPE_CHECKING:  # doors of 0.1.0, which are found and not listed
    from thermogrip.rig.drivers.tclab import TCLabRig as TCLabRig
    from thermogrip.rig.drivers.thermogrip import DeviceRig as DeviceRig
    from thermogrip.rig.guard.settings import GuardSettings as GuardSettings
    from thermogrip.rig.guard.trip import Trip as Trip
    from thermogrip.rig.records.batch import Trial as Trial
    from thermogrip.rig.records.run_folder import RunFolder as RunFolder
    from thermogrip.rig.records.run_folder import export_run as export_run
    from thermogrip.rig.records.run_folder import recover as recover
    from thermogrip.rig.serial.port import Port as Port
    from thermogrip.rig.session.session import Object as Object
    from thermogrip.rig.session.session import Session as Session
    from thermogrip.sysid.contact.simulation import Grip as Grip
