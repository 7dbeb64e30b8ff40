"""Arrays and data frames instead of records: what scikit-learn's own tools make of the classifiers."""

from __future__ import annotations

import pickle
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from sklearn.model_selection import GridSearchCV, cross_val_score, train_test_split
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

from thermogrip.classify import ArrayClassifier, make_classifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps

BLOBS = "clouds of two numbers are no contacts: less their level, or as features of one, they hold too little"
TIE = "features of clouds of two numbers are at a tie, which rounding breaks"
EXCEPTIONS = {
    "svm-pca": {"check_classifiers_train": BLOBS},
    "bayes": {"check_classifiers_train": BLOBS},
    "features-lda": {"check_classifiers_train": BLOBS, "check_classifier_data_not_an_array": TIE},
}
"""With the posterior, which asks for a level before contact and materials of the table, five."""
SETTINGS = {"lstm": {"epochs": 40, "series_per_class": 10, "hidden": 8}}


@pytest.fixture(scope="module")
def warm() -> Grasps:
    return load_example_grasps()["exp2_dT20"]


@pytest.fixture(scope="module")
def frame(warm: Grasps) -> pd.DataFrame:
    """The same grasps, times as columns beside what is known of each."""
    table = pd.DataFrame(warm["t_surface"].values, columns=[f"{t:g}" for t in warm["time"].values])
    return table.assign(t_object=warm["t_object"].values, t_ambient=warm["t_ambient"].values)


def checked(name: str) -> list[str]:
    if name == "rocket":
        pytest.importorskip("aeon")
    if name == "lstm":
        pytest.importorskip("torch")
    made = make_classifier(name, **SETTINGS.get(name, {}))
    found = check_estimator(made, expected_failed_checks=EXCEPTIONS.get(name), on_skip=None, on_fail=None)
    assert sum(row["status"] == "passed" for row in found) >= 48
    return [f"{row['check_name']}: {row['exception']}" for row in found if row["status"] == "failed"]


@pytest.mark.parametrize("name", ["pca-lda", "bayes"])
@pytest.mark.filterwarnings("ignore:Estimator .* does not inherit:UserWarning")  # its own functions serve
def test_scikit_learns_own_checks_pass(name: str) -> None:
    assert not checked(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["features-lda", "svm-pca", "rocket", "lstm"])
@pytest.mark.filterwarnings("ignore:Estimator .* does not inherit:UserWarning")  # its own functions serve
def test_scikit_learns_own_checks_pass_of_the_slower_ones(name: str) -> None:
    assert not checked(name)


def test_the_posterior_says_in_one_line_what_an_array_lacks() -> None:
    x, y = np.random.default_rng(0).normal(20.0, 1.0, (8, 30)), ["iron", "wood"] * 4
    with pytest.raises(UserError, match="has no sample before contact; record from -2 s") as fault:
        make_classifier("posterior").fit(x, y)
    assert "\n" not in str(fault.value)


def test_a_scikit_learn_users_five_lines_run(warm: Grasps) -> None:
    X, y = warm["t_surface"].values, warm["material"].values
    X_train, X_test, y_train, y_test = train_test_split(X, y, random_state=0, stratify=y)
    model = make_classifier("pca-lda").fit(X_train, y_train)
    assert model.score(X_test, y_test) > 0.8
    scaled = make_pipeline(StandardScaler(), make_classifier("pca-lda"))
    assert cross_val_score(scaled, X, y, cv=3).mean() > 0.9


def test_records_are_split_by_grasp_as_arrays_are(warm: Grasps) -> None:
    assert len(warm) == 24
    assert warm.shape == (24, 121)
    picked = warm[np.array([3, 1])]
    assert picked["grasp"].values.tolist() == warm["grasp"].values[[3, 1]].tolist()
    assert len(warm[warm["material"].values == "wood"]) == 8
    assert len(warm[:5]) == 5
    assert len(pickle.loads(pickle.dumps(warm))) == 24  # noqa: S301
    search = GridSearchCV(make_classifier("pca-lda"), {"components": [1, 4]}, cv=3)
    search.fit(warm, warm["material"].values)
    assert search.best_score_ > 0.9
    assert set(search.predict(warm[[0, 23]])) == {"copper", "wood"}
    words = r"Grasps 'exp2_dT20': 24 grasps \(8 copper, 8 iron, 8 wood\), 121 samples from -2 to 10 s; .*"
    assert re.fullmatch(words, repr(warm))


def test_a_plain_dataset_is_a_record_too(warm: Grasps) -> None:
    plain = xr.Dataset(warm.data_vars, coords=warm.coords, attrs=warm.attrs)
    model = make_classifier("pca-lda").fit(plain)
    np.testing.assert_array_equal(model.predict(plain), model.predict(warm))


def test_a_data_frame_states_times_and_temperatures(warm: Grasps, frame: pd.DataFrame) -> None:
    y = warm["material"].values
    named = make_classifier("bayes").fit(warm)
    for columns in (list(frame), list(frame)[::-1]):
        model = make_classifier("bayes").fit(frame[columns], y)
        np.testing.assert_allclose(model.predict_proba(frame), named.predict_proba(warm), rtol=1e-6)
    assert cross_val_score(make_classifier("bayes"), frame, y, cv=3).mean() > 0.9
    with pytest.raises(UserError, match="column 'weight' is no time and nothing of a grasp"):
        model.fit(frame.assign(weight=1.0), y)


def test_an_array_is_read_at_the_times_that_are_given(warm: Grasps) -> None:
    x, y, time = warm["t_surface"].values, warm["material"].values, warm["time"].values
    model = make_classifier("pca-lda", times=time.tolist())
    np.testing.assert_allclose(
        model.fit(x, y).predict_proba(x), make_classifier("pca-lda").fit(warm).predict_proba(warm)
    )
    with pytest.raises(UserError, match="121 times for 120 samples"):
        model.fit(x[:, 1:], y)
    with pytest.raises(ValueError, match="X has 120 features, but PcaLda is expecting 121"):
        model.fit(x, y).predict(x[:, 1:])


def test_two_channels_are_two_sensors_in_either_order_of_axes(warm: Grasps) -> None:
    name = "pca-lda"
    x, y = warm["t_surface"].values, warm["material"].values
    cube = np.stack([x, 22 + 0.1 * (x - x[:, :1])], axis=2)
    model = make_classifier(name).fit(cube, y)
    assert model.sensors_ == 2
    turned = make_classifier(name).fit(cube.transpose(0, 2, 1), y)
    np.testing.assert_allclose(turned.predict_proba(cube), model.predict_proba(cube.transpose(0, 2, 1)))
    with pytest.raises(UserError, match="3 channels"):
        make_classifier(name).fit(np.repeat(cube, 2, axis=2)[:, :, :3], y)
    with pytest.raises(UserError, match="traces of 100 samples, the training's had 121"):
        model.predict(cube[:, :100])


def test_contacts_of_different_lengths_are_lists_of_rows(warm: Grasps) -> None:
    x, y = warm["t_surface"].values, warm["material"].values
    rows = [row[: 121 - 3 * (k % 5)] for k, row in enumerate(x)]
    padded = x.copy()
    for k, row in enumerate(rows):
        padded[k, row.size :] = np.nan
    model = make_classifier("pca-lda").fit(rows, y)
    np.testing.assert_array_equal(model.predict_proba(rows), model.predict_proba(padded))
    assert model.times_[-1] < 12.0 - 0.6  # the longest time that all have, within half a second
    assert (model.predict(rows) == y).mean() > 0.9


@pytest.mark.parametrize("values", [[3, 10], [True, False], [2.0, 1.0], ["b", "a"]])
def test_labels_of_any_type_come_back_as_they_were(values: list) -> None:
    x = np.linspace([20.0, 20.0, 20.0], [21.0, 25.0, 28.0], 12)
    y = np.array(values)[(np.arange(12) > 5).astype(int)]
    model = make_classifier("pca-lda").fit(x, y)
    np.testing.assert_array_equal(model.classes_, np.unique(y))
    assert model.predict(x).dtype.kind == y.dtype.kind
    np.testing.assert_array_equal(model.predict(x), y)
    again = pickle.loads(pickle.dumps(model))  # noqa: S301, as scikit-learn users do in memory
    np.testing.assert_array_equal(again.predict_proba(x), model.predict_proba(x))


def test_every_kind_survives_a_pickle_in_memory(warm: Grasps) -> None:
    few = warm[np.r_[0:4, 8:12, 16:20]]
    for name in ("posterior", "bayes", "features-lda", "svm-pca", "pca-lda"):
        model = make_classifier(name).fit(few)
        again = pickle.loads(pickle.dumps(model))  # noqa: S301
        np.testing.assert_array_equal(again.predict_proba(warm), model.predict_proba(warm), err_msg=name)


def test_a_plain_estimator_without_probabilities_keeps_the_types_of_labels() -> None:
    x = np.linspace([20.0, 20.0, 20.0], [21.0, 25.0, 28.0], 12)
    y = (np.arange(12) > 5).astype(int) + 7
    model = ArrayClassifier("sklearn.neighbors:NearestCentroid", subtract_level=False).fit(x, y)
    assert set(model.predict(x)) == {7, 8}


def test_a_contact_from_zero_has_the_level_that_its_frame_states() -> None:
    time = [0.0, 0.5, 1.0, 1.5]
    table = pd.DataFrame(np.full((4, 4), 25.0) + np.arange(4)[:, None], columns=time)
    table = table.assign(t_gripper=[20.0, 20.0, 20.0, 20.0])
    model = make_classifier("pca-lda", start=-9.0).fit(table, list("aabb"))
    assert model.times_[0] < -2.0
    assert make_grasps(time, table[time].to_numpy(), list("abcd")).sizes["time"] == 4
