import typing

from thermogrip.mpc.closed_loop.simulate import simulate_closed_loop as simulate_closed_loop
from thermogrip.mpc.controllers.loop_monitor import LoopMonitor as LoopMonitor
from thermogrip.mpc.controllers.mpc import Controller as Controller
from thermogrip.mpc.controllers.mpc import design_controller as design_controller
from thermogrip.mpc.controllers.mpc import load_controller as load_controller
from thermogrip.mpc.controllers.pi import PIController as PIController
from thermogrip.mpc.design.design import default_design as default_design
from thermogrip.mpc.design.spec import SPEC_TEMPLATE as SPEC_TEMPLATE
from thermogrip.mpc.design.spec import read_spec as read_spec
from thermogrip.mpc.interface import Move as Move
from thermogrip.mpc.tuning.design_review import Check as Check
from thermogrip.mpc.tuning.design_review import review as review
from thermogrip.mpc.tuning.tune import Tuning as Tuning
from thermogrip.mpc.tuning.tune import tune as tune

if typing.TYPE_CHECKING:  # doors of 0.1.0, which are found and not listed
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop as ClosedLoop
    from thermogrip.mpc.closed_loop.simulate import Surroundings as Surroundings
    from thermogrip.mpc.design.design import Design as Design
    from thermogrip.mpc.design.spec import Spec as Spec
