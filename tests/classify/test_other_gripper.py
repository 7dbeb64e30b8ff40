"""The posterior classifier asked about another gripper than that of its calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError

from thermogrip.classify import load_classifier, make_classifier, save_classifier
from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import GripperSpread, another_gripper, load_default_gripper
from thermogrip.sysid.effusivity.posterior import material_posterior


@pytest.fixture(scope="module")
def metals() -> Grasps:
    """Three grasps 20 K away: brass, copper, iron."""
    record = load_example_grasps()["exp1A_obj43_grip23"]
    rows = [int(np.flatnonzero(record["material"].values == m)[5]) for m in ("brass", "copper", "iron")]
    return pick(record, np.array(rows))


@pytest.fixture(scope="module")
def ours() -> PosteriorClassifier:
    """The bundled gripper."""
    return PosteriorClassifier().with_device(load_default_gripper())


def test_answers_are_those_of_the_gripper_in_doubt(ours: PosteriorClassifier, metals: Grasps) -> None:
    expected = material_posterior(another_gripper(ours.device_), metals, ours.classes_.tolist())
    for model in (
        ours.for_another_gripper(),
        PosteriorClassifier(gripper="another").with_device(ours.device_),
    ):
        np.testing.assert_allclose(model.predict_proba(metals), expected, rtol=1e-9)
    assert not ours.device_.uncertain  # the one that was asked stays as it was


def test_the_closer_grippers_lie_together_the_surer(ours: PosteriorClassifier, metals: Grasps) -> None:
    tight = replace(GripperSpread(), contact=0.02, block_contact=0.01, sheet_thickness=0.02, lag=0.05)
    tight = replace(tight, sheet_conductivity=0.03, layer_conductivity=0.02, layer_thickness=0.02)
    loss = [
        -np.log(model.predict_proba(metals)[np.arange(3), [0, 1, 2]]).mean()
        for model in (ours.for_another_gripper(spread=tight), ours.for_another_gripper())
    ]
    assert loss[0] < loss[1]


def test_doubt_is_saved_with_the_model(ours: PosteriorClassifier, metals: Grasps, tmp_path: object) -> None:
    other = ours.for_another_gripper()
    save_classifier(other, f"{tmp_path}/other")
    back = load_classifier(f"{tmp_path}/other")
    np.testing.assert_array_equal(back.predict_proba(metals), other.predict_proba(metals))
    twice = PosteriorClassifier(gripper="another").with_device(ours.device_)
    save_classifier(twice, f"{tmp_path}/twice")
    # the spread between grippers is added once, not again when the model is read
    np.testing.assert_array_equal(
        load_classifier(f"{tmp_path}/twice").predict_proba(metals), twice.predict_proba(metals)
    )


def test_a_gripper_that_is_none_of_them_is_refused(ours: PosteriorClassifier) -> None:
    with pytest.raises(UserError, match="gripper is 'mine'"):
        make_classifier("posterior", gripper="mine").with_device(ours.device_)  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="does not say how well it knows"):
        PosteriorClassifier(gripper="uncertain").with_device(ours.device_)
    with pytest.raises(NotFittedError):
        PosteriorClassifier().for_another_gripper()
