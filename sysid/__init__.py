"""Identification: from logs to a plant, its validation and export, excitation, contact physics, effusivity.

>>> from thermogrip.sysid import read_log, identify, Plant
>>> identify.__name__, Plant.__name__
('identify', 'Plant')
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.datasets.log_files import read_log as read_log
    from thermogrip.sysid.data.data_quality import check_data as check_data
    from thermogrip.sysid.effusivity.calibration import calibrate_gripper as calibrate_gripper
    from thermogrip.sysid.effusivity.gripper_model import GripperModel as GripperModel
    from thermogrip.sysid.experiment.schedules import excite as excite
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
    "GripperModel": "sysid.effusivity.gripper_model",
    "Plant": "sysid.plant.plant",
    "calibrate_gripper": "sysid.effusivity.calibration",
    "check_data": "sysid.data.data_quality",
    "excite": "sysid.experiment.schedules",
    "fit_network": "sysid.greybox.fit",
    "free_run": "sysid.validation.free_run",
    "identify": "sysid.identification",
    "linearise_plant": "sysid.export.linearise",
    "load_network": "sysid.models.network",
    "own_model": "sysid.models.user_model",
    "read_log": "datasets.log_files",
    "sample_posterior": "sysid.greybox.posterior",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"thermogrip.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
