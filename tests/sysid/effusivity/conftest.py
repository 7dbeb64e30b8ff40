"""The bundled gripper and the bundled grasps."""

from __future__ import annotations

import pytest

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity import gripper_model
from thermogrip.sysid.effusivity.data import Grade
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper


@pytest.fixture(scope="session")
def device() -> GripperModel:
    return load_default_gripper()


@pytest.fixture(scope="session")
def files() -> dict[str, Grasps]:
    return load_example_grasps()


@pytest.fixture
def one_grade(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every grasp is like those of the training: answers are those of one model."""
    monkeypatch.setattr(gripper_model, "GRADES", (Grade(0.0, 0.0, 1.0),))
