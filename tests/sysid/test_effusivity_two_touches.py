"""Two touches of one block know more than one, and say so honestly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity import material_evidence
from thermogrip.sysid.gripper_device import load_default_device
from thermogrip.sysid.two_touches import two_touch_fit

FIVE = ["brass", "copper", "iron", "wood", "zinc"]


@pytest.fixture(scope="module")
def record():
    grasps = load_example_grasps()["exp5_two_touch_unknown_object"]
    return grasps.isel(grasp=np.flatnonzero(np.isin(grasps["material"].values, FIVE)))


def test_two_touches_name_blocks_that_one_cannot(record):
    """None of these grasps was in the calibration: the gripper is known, the object's temperature is not."""
    device = load_default_device()
    fit = two_touch_fit(device, record, FIVE)
    truth = record["material"].values[fit.first]
    two = np.array(FIVE)[fit.log_evidence.argmax(axis=1)] == truth
    one = np.array(FIVE)[material_evidence(device, record, FIVE)[fit.first].argmax(axis=1)] == truth
    assert two.mean() > one.mean()
    # metal from wood is certain with two touches
    assert np.all((np.array(FIVE)[fit.log_evidence.argmax(axis=1)] == "wood") == (truth == "wood"))
    own = fit.t_object_sd[np.arange(truth.size), [FIVE.index(m) for m in truth]]
    assert own[truth != "wood"].max() < 0.6


def test_touches_far_apart_in_time_are_two_single_touches(record):
    """With a useless coupling the evidences add, up to the second touch's share of the prior."""
    device = load_default_device()
    single = material_evidence(device, record, FIVE)
    fit = two_touch_fit(device, record, FIVE, coupling_sd=300.0, found_again=0.0, loss=0.0)
    added = single[fit.first] + single[fit.second]
    p = np.exp(fit.log_evidence - logsumexp(fit.log_evidence, axis=1, keepdims=True))
    q = np.exp(added - logsumexp(added, axis=1, keepdims=True))
    assert np.abs(p - q).mean() < 0.1


def test_groups_that_are_no_pairs_are_refused(record):
    device = load_default_device()
    with pytest.raises(UserError, match="has 1 touches"):
        two_touch_fit(device, record.isel(grasp=[0]), FIVE)
    with pytest.raises(UserError, match="no touch_group"):
        two_touch_fit(device, record.drop_vars("touch_group"), FIVE)
