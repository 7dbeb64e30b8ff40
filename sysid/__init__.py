"""Identification: from logs to a plant, its validation and export, excitation, contact physics, effusivity.

>>> from thermogrip.sysid import read_log, identify, Plant
>>> identify.__name__, Plant.__name__
('identify', 'Plant')
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermogrip import lazy_exports

if TYPE_CHECKING:
    from thermogrip.datasets.log_files import read_log as read_log
    from thermogrip.sysid.data.data_quality import check_data as check_data
    from thermogrip.sysid.effusivity.calibration import calibrate_gripper as calibrate_gripper
    from thermogrip.sysid.effusivity.gripper_model import GripperModel as GripperModel
    from thermogrip.sysid.experiment.schedules import excite as excite
    from thermogrip.sysid.export.dynamics import plant_dynamics as plant_dynamics
    from thermogrip.sysid.export.linearise import linearise_plant as linearise_plant
    from thermogrip.sysid.greybox.fit import fit_network as fit_network
    from thermogrip.sysid.greybox.posterior import sample_posterior as sample_posterior
    from thermogrip.sysid.identification import identify as identify
    from thermogrip.sysid.models.network import load_network as load_network
    from thermogrip.sysid.models.user_model import own_model as own_model
    from thermogrip.sysid.plant.plant import Plant as Plant
    from thermogrip.sysid.validation.free_run import free_run as free_run

# Looked up on first use, so that importing the room pulls in no heavy package.
_HOME = {
    "GripperModel": "effusivity.gripper_model",
    "Plant": "plant.plant",
    "calibrate_gripper": "effusivity.calibration",
    "check_data": "data.data_quality",
    "excite": "experiment.schedules",
    "fit_network": "greybox.fit",
    "free_run": "validation.free_run",
    "identify": "identification",
    "linearise_plant": "export.linearise",
    "load_network": "models.network",
    "own_model": "models.user_model",
    "plant_dynamics": "export.dynamics",
    "read_log": ".datasets.log_files",
    "sample_posterior": "greybox.posterior",
}

__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
