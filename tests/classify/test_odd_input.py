"""What users get wrong, and what odd records are worth: one clear line each, no wrong answer in silence."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import load_classifier, make_classifier, save_classifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, check_grasps

LEARNERS = ["bayes", "features-lda", "pca-lda"]


@pytest.fixture(scope="module")
def three() -> Grasps:
    return load_example_grasps()["exp2_dT20"]


@pytest.fixture(scope="module")
def two_sensors(three: Grasps) -> Grasps:
    return three.assign(t_surface_2=0.2 * three["t_surface"] + 20.0)


@pytest.mark.parametrize("name", ["pca-lda", "svm-pca", "sklearn.neighbors:KNeighborsClassifier"])
def test_a_missing_second_sensor_is_said(name: str, three: Grasps, two_sensors: Grasps) -> None:
    model = make_classifier(name, seed=0).fit(two_sensors)
    with pytest.raises(UserError, match="has no t_surface_2, and the classifier was trained with two"):
        model.predict(three)


@pytest.mark.parametrize("name", ["pca-lda", "svm-pca", "features-lda"])
def test_a_second_sensor_that_was_not_trained_with_is_not_read(
    name: str, three: Grasps, two_sensors: Grasps
) -> None:
    model = make_classifier(name, seed=0).fit(three)
    np.testing.assert_array_equal(model.predict_proba(two_sensors), model.predict_proba(three))


def test_a_saved_model_knows_its_sensors(three: Grasps, two_sensors: Grasps, tmp_path: Path) -> None:
    loaded = load_classifier(save_classifier(make_classifier("pca-lda").fit(two_sensors), tmp_path / "m"))
    with pytest.raises(UserError, match="two sensors"):
        loaded.predict(three)


def test_features_of_the_first_sensor_need_no_second(three: Grasps, two_sensors: Grasps) -> None:
    model = make_classifier("features-lda").fit(two_sensors)
    assert (model.predict(three) == three["material"].values).mean() > 0.9


@pytest.mark.parametrize("name", ["bayes", "features-lda"])
@pytest.mark.parametrize("how", ["column", "one"])
def test_an_object_temperature_that_was_trained_with_is_asked_for(name: str, how: str, three: Grasps) -> None:
    model = make_classifier(name).fit(three)
    unknown = three["t_object"].where(three["grasp"] != three["grasp"].values[3])
    record = three.drop_vars("t_object") if how == "column" else three.assign(t_object=unknown)
    with pytest.raises(UserError, match="has no object temperature, and the classifier was trained with"):
        model.predict(record)


@pytest.mark.parametrize("name", LEARNERS)
def test_one_grasp_of_a_material_trains_without_a_word(name: str, three: Grasps) -> None:
    material = three["material"].values
    keep = (material != "wood") | (np.cumsum(material == "wood") == 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = make_classifier(name).fit(three.isel(grasp=keep))
    assert (model.predict(three) == material).mean() > 0.85


@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize(
    "damage", ["fewer classes", "more classes", "shorter array", "word for number", "no arrays", "sensors"]
)
def test_a_damaged_file_is_refused_in_one_line(name: str, damage: str, three: Grasps, tmp_path: Path) -> None:
    folder = save_classifier(make_classifier(name).fit(three), tmp_path / "m")
    content = json.loads((folder / "classifier.json").read_text())
    if damage == "fewer classes":
        content["classes"].pop()
    elif damage == "more classes":
        content["classes"].append("zirconium")
    elif damage == "shorter array":
        content["arrays"]["center_"].pop()
    elif damage == "word for number":
        content["arrays"]["scale_"][0] = "wide"
    elif damage == "no arrays":
        content["arrays"] = {}
    else:
        content["sensors"] = "both"
    (folder / "classifier.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"classifier\.json: is damaged") as caught:
        load_classifier(folder)
    assert "\n" not in str(caught.value)
    assert "train the classifier again" in str(caught.value)


def test_a_network_of_other_classes_is_refused(three: Grasps, tmp_path: Path) -> None:
    folder = save_classifier(make_classifier("lstm", epochs=1, hidden=4).fit(three), tmp_path / "m")
    content = json.loads((folder / "classifier.json").read_text())
    content["classes"].pop()
    (folder / "classifier.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"is damaged .readout"):
        load_classifier(folder)


@pytest.mark.parametrize(
    ("name", "value"), [("prior_unknown", "x"), ("finish", 3), ("priors", {"wood": "x"})]
)
def test_a_damaged_parameter_of_the_posterior_is_refused(name: str, value: object, tmp_path: Path) -> None:
    from thermogrip.classify.estimators.posterior import PosteriorClassifier
    from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

    folder = save_classifier(PosteriorClassifier().with_device(load_default_gripper()), tmp_path / "m")
    content = json.loads((folder / "classifier.json").read_text())
    content["params"][name] = value
    (folder / "classifier.json").write_text(json.dumps(content))
    with pytest.raises(UserError):
        load_classifier(folder)


@pytest.mark.parametrize("name", ["t_object", "t_gripper", "t_surface"])
def test_kelvin_are_refused(name: str, three: Grasps) -> None:
    with pytest.raises(
        UserError, match=rf"grasp 'g0\d+' has a {name} of \d+\.?\d* degC; give degrees Celsius"
    ):
        check_grasps(three.assign({name: three[name] + 273.15}))


@pytest.mark.parametrize("label", ["Train", "test ", "TRAIN"])
def test_a_misspelt_split_is_refused(label: str, three: Grasps) -> None:
    split = three["split"].values.astype("<U8")
    split[4] = label
    with pytest.raises(UserError, match="is neither train nor test; write 't"):
        check_grasps(three.assign(split=("grasp", split)))


def test_an_estimator_that_is_no_classifier_is_refused() -> None:
    with pytest.raises(
        UserError, match="is no scikit-learn classifier; it must have fit, and predict a class"
    ):
        make_classifier("sklearn.linear_model:LinearRegression")


def test_an_estimator_that_cannot_learn_the_grasps_says_so(three: Grasps) -> None:
    model = make_classifier("sklearn.neighbors:KNeighborsClassifier", n_neighbors=-1)
    with pytest.raises(UserError, match="exp2_dT20: KNeighborsClassifier cannot learn these 24 grasps"):
        model.fit(three)


def test_one_material_alone_is_named_as_the_reason(three: Grasps) -> None:
    from thermogrip.classify.evaluation.splits import plan_folds

    iron = three.isel(grasp=three["material"].values == "iron")
    with pytest.raises(UserError, match="its training grasps are of one material"):
        plan_folds([iron])
