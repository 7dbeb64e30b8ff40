"""The calibrated gripper: its file, its scale, the spread between grippers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.effusivity.gripper_model import (
    SHARED_NAMES,
    GripperModel,
    GripperSpread,
    ParameterCovariance,
    another_gripper,
    block_names,
)


def test_a_gripper_survives_its_file_and_those_of_before_are_read(device, tmp_path):
    assert GripperModel.load(device.save(tmp_path / "device.json")) == device
    assert device.to_dict()["blocks"]["wood"]["library_effusivity"] == pytest.approx(367, rel=0.01)
    content = device.to_dict()  # from before blocks had a far face, and before there was a covariance
    del content["stack"]["g_far"], content["in_doubt"]
    assert GripperModel.from_dict(content) == replace(device, stack=replace(device.stack, g_far=0.0))


def test_effusivity_scale_is_that_of_the_anchors(device):
    """Blocks found 1.2 times too high at one end shift the scale there, and less far away."""
    wood = replace(
        device.blocks["wood"], ln_effusivity=np.log(1.2 * 367), library_effusivity=367.0, library_sd_ln=0.01
    )
    bent = replace(device, blocks={**device.blocks, "wood": wood})
    mean, sd = bent.effusivity_scale(np.log([1.2 * 367, 3e4]))
    assert mean[0] == pytest.approx(np.log(1.2), abs=0.04)
    assert abs(mean[1]) < 0.1
    assert 0.05 < sd[0] < 0.15


@pytest.mark.parametrize(
    ("part", "name", "value", "match"),
    [
        ("stack", "lag", None, "not a whole device"), ("spreads", "dof", 0.0, "dof is 0, not 1e-09"),
        ("spreads", "insulator_dof", -1.0, "insulator_dof is -1"),
        ("spreads", "onset", -0.1, "onset is -0.1"),
    ],
)  # fmt: skip
def test_a_broken_file_is_refused(device, tmp_path, part, name, value, match):
    content = json.loads(device.save(tmp_path / "d.json").read_text())
    content[part][name] = value
    broken = tmp_path / "broken.json"
    broken.write_text(json.dumps(content))
    with pytest.raises(UserError, match=rf"broken\.json.*{match}"):
        GripperModel.load(broken)
    broken.write_text("not json")
    with pytest.raises(UserError, match=r"broken\.json"):
        GripperModel.load(broken)


def test_the_spread_between_grippers_is_that_of_its_causes():
    names = ("ln_e_outer", "ln_z_outer", "ln_h copper", "ln_h iron", "ln_e copper", "ln_depth")
    cov = GripperSpread().covariance(names)
    assert cov[0, 0] == pytest.approx((0.3**2 + 0.1**2) / 4)
    assert cov[1, 1] == pytest.approx(0.2**2 + (0.3**2 + 0.1**2) / 4)
    assert cov[0, 1] == pytest.approx((0.1**2 - 0.3**2) / 4)  # what conducts better is thinner in time
    assert cov[2, 3] == pytest.approx(0.25**2)
    assert cov[2, 2] == pytest.approx(0.25**2 + 0.1**2)
    assert not cov[4:].any()
    with pytest.raises(ValueError, match="lag must be >= 0"):
        GripperSpread(lag=-0.1)


def test_a_covariance_survives_its_file(device, tmp_path):
    other = another_gripper(device)
    back = GripperModel.load(other.save(tmp_path / "other.json"))
    assert back.uncertain
    assert back == other
    np.testing.assert_array_equal(back.uncertainty.covariance, other.uncertainty.covariance)
    assert back.uncertainty.names == (*SHARED_NAMES, *block_names(device.materials))
    broken = other.to_dict()
    broken["knowledge"]["covariance"][0][1] = 9.0
    with pytest.raises(UserError, match="symmetric"):
        GripperModel.from_dict(broken)
    with pytest.raises(UserError, match="needs the covariance of its parameters"):
        GripperModel.from_dict(device.to_dict() | {"in_doubt": True})
    with pytest.raises(ValueError, match="lacks ln_e_outer"):
        ParameterCovariance(("onset",), np.eye(1))


def test_a_covariance_with_a_negative_variance_is_refused_with_its_file(device, tmp_path):
    """Lag and settling time correlated by 1.5: symmetric, every variance positive, and none of anything."""
    content = another_gripper(device).to_dict()
    names, matrix = content["knowledge"]["names"], np.array(content["knowledge"]["covariance"])
    i, k = names.index("ln_lag"), names.index("ln_settle")
    matrix[i, k] = matrix[k, i] = 1.5 * np.sqrt(matrix[i, i] * matrix[k, k])
    content["knowledge"]["covariance"] = matrix.tolist()
    with pytest.raises(UserError, match=r"gripper\.json.*negative variance"):
        GripperModel.from_dict(content, file="gripper.json")
    known = another_gripper(device).uncertainty
    for fine in (np.eye(len(names)), np.zeros((len(names),) * 2), known.covariance):
        ParameterCovariance(known.names, np.asarray(fine))
