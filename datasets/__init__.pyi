import typing

from thermogrip.datasets.errors import UserError as UserError
from thermogrip.datasets.examples import example_path as example_path
from thermogrip.datasets.examples import load_example_grasps as load_example_grasps
from thermogrip.datasets.examples import load_example_logs as load_example_logs
from thermogrip.datasets.grasp_files import read_grasps as read_grasps
from thermogrip.datasets.grasp_files import write_grasps as write_grasps
from thermogrip.datasets.log_files import read_log as read_log
from thermogrip.datasets.log_files import write_log as write_log
from thermogrip.datasets.schema import Grasps as Grasps
from thermogrip.datasets.schema import Log as Log
from thermogrip.datasets.schema import cut as cut
from thermogrip.datasets.schema import make_grasps as make_grasps
from thermogrip.datasets.schema import make_log as make_log

if typing.TYPE_CHECKING:  # doors of 0.1.0, which are found and not listed
    from thermogrip.datasets.schema import gaps as gaps
