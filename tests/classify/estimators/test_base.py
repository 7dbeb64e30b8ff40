"""Every classifier keeps the scikit-learn contract on grasp records; odd records get one clear line."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sklearn.base import BaseEstimator, ClassifierMixin, clone, is_classifier
from sklearn.exceptions import NotFittedError

from thermogrip.classify import load_classifier, make_classifier, save_classifier
from thermogrip.classify.estimators.base import (
    GraspClassifier,
    as_array,
    check_shapes,
    common_times,
    grasp_labels,
    join_grasps,
    level,
    pick,
    record_labels,
    record_list,
    times_from,
)
from thermogrip.classify.estimators.lda import ArrayClassifier
from thermogrip.classify.estimators.registry import can_be_saved
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps

Maker = Callable[..., Grasps]


def test_fitting_returns_itself_changes_no_parameter_and_is_repeated_by_its_clone(
    estimator: GraspClassifier, three: Grasps
) -> None:
    before = dict(estimator.get_params())
    assert is_classifier(estimator)
    assert estimator.fit(three) is estimator
    assert estimator.classes_.tolist() == ["copper", "iron", "wood"]
    copy = clone(estimator)
    assert copy.get_params() == estimator.get_params() == before
    assert not hasattr(copy, "classes_")
    with pytest.raises(NotFittedError, match="fit"):
        copy.predict(three)
    np.testing.assert_array_equal(copy.fit(three).predict_proba(three), estimator.predict_proba(three))


def test_probabilities_sum_to_one_and_prediction_is_the_largest(
    estimator: GraspClassifier, three: Grasps, make_touches: Maker
) -> None:
    fresh = make_touches(seed=5, name="fresh")
    estimator.fit(three)
    p = estimator.predict_proba(fresh)
    assert p.shape == (24, 3)
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-9)
    assert np.array_equal(estimator.predict(fresh), estimator.classes_[p.argmax(axis=1)])
    assert np.mean(estimator.predict(fresh) == fresh["material"].values) > 0.8
    assert estimator.score(fresh, fresh["material"].values) > 0.8


def test_several_records_are_one_training_set(estimator: GraspClassifier, make_touches: Maker) -> None:
    records = [make_touches(seed=1, name="a"), make_touches(seed=2, name="b", end=12.0)]
    assert estimator.fit(records).predict_proba(records).shape == (48, 3)


def test_labels_given_as_y_replace_those_of_the_record(estimator: GraspClassifier, three: Grasps) -> None:
    y = np.where(three["material"].values == "wood", "insulator", "metal")
    estimator.fit(three.drop_vars("material"), y)
    assert estimator.classes_.tolist() == ["insulator", "metal"]
    assert np.mean(estimator.predict(three) == y) > 0.9


def test_a_lost_sample_changes_little(estimator: GraspClassifier, three: Grasps) -> None:
    holed = three.copy(deep=True)
    holed["t_surface"].values[:, 20::9] = np.nan
    estimator.fit(three)
    p, q = estimator.predict_proba(three), estimator.predict_proba(holed)
    assert np.isfinite(q).all()
    assert np.mean(p.argmax(axis=1) == q.argmax(axis=1)) > 0.9
    estimator.fit(holed)
    assert np.mean(estimator.predict(three) == three["material"].values) > 0.8


def test_candidates_share_the_probability_of_others(estimator: GraspClassifier, three: Grasps) -> None:
    p = estimator.fit(three).predict_proba(three)
    q = np.exp(estimator.candidate_log_proba(three, ["wood", "iron"]))
    expected = p[:, [2, 1]] / p[:, [2, 1]].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(q, expected, atol=1e-6)
    with pytest.raises(UserError, match="'gold' is no class of this classifier; it knows copper, iron, wood"):
        estimator.candidate_log_proba(three, ["gold"])


def test_impossible_candidates_still_have_an_answer(three: Grasps) -> None:
    model = make_classifier("features-lda").fit(three)
    woods = pick(three, three["material"].values == "wood")
    model.intercept_ = model.intercept_ + np.array([-2000.0, -2005.0, 0.0])
    assert np.exp(model.predict_log_proba(woods))[:, :2].max() == 0.0
    q = np.exp(model.candidate_log_proba(woods, ["copper", "iron"]))
    np.testing.assert_allclose(q.sum(axis=1), 1.0)


def test_permuted_labels_give_chance(estimator: GraspClassifier, make_touches: Maker) -> None:
    right = 0
    for seed in range(3):
        trained = make_touches(seed=seed, shuffled=True)
        fresh = make_touches(seed=100 + seed, each=10)
        right += int(np.sum(estimator.fit(trained).predict(fresh) == fresh["material"].values))
    # 90 tests at 1/3, but the ten of one material stand or fall together: nine clusters of ten
    sd = np.sqrt(10 * 9 * 10 * (1 / 3) * (2 / 3))
    assert abs(right - 30) < 3 * sd
    assert right < 72


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda g: pick(g, g["material"].values == "wood"), "all grasps are of 'wood'; give at least two"),
        (
            lambda g: g.drop_vars("material"),
            "the grasps have no material; add the column 'material' or give y",
        ),
        (
            lambda g: g.assign(material=("grasp", np.where(np.arange(24) == 3, "", g["material"].values))),
            "grasp 'touches-3' has no material",
        ),
    ],
)
def test_a_training_set_without_a_question_is_refused(
    estimator: GraspClassifier, three: Grasps, spoil: Callable[[Grasps], Grasps], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        estimator.fit(spoil(three))


def test_a_wrong_count_of_labels_is_refused(three: Grasps) -> None:
    with pytest.raises(UserError, match="2 labels for 24 grasps"):
        make_classifier("bayes").fit(three, ["a", "b"])


@pytest.mark.parametrize("name", ["pca-lda", "lstm"])
def test_a_trace_that_ends_too_early_is_refused_not_continued(
    name: str, three: Grasps, make_touches: Maker, make_tiny_lstm: Callable[..., GraspClassifier]
) -> None:
    model = (make_tiny_lstm(epochs=1) if name == "lstm" else make_classifier(name)).fit(three)
    with pytest.raises(UserError, match=r"'short-0' covers -2 to 5 s, 0 to 10 s are needed; cut all"):
        model.predict(make_touches(end=5.0, name="short"))


class Rows(ClassifierMixin, BaseEstimator):
    """A classifier that keeps the rows that it was shown."""

    def fit(self, x: np.ndarray, y: np.ndarray) -> Rows:
        self.learnt_, self.classes_ = x, np.unique(y)
        return self

    def predict(self, x: np.ndarray) -> np.ndarray:
        self.asked_ = x
        return np.full(len(x), self.classes_[0])


def test_rows_are_standardised_by_the_training_grasps_and_new_ones_alike(three: Grasps) -> None:
    model = ArrayClassifier(Rows(), start=0.4).fit(three)
    learnt = model.model_.learnt_
    np.testing.assert_allclose(learnt.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(learnt.std(axis=0), 1.0, rtol=1e-9)
    model.predict(three.isel(grasp=[5, 2]))
    np.testing.assert_allclose(model.model_.asked_, learnt[[5, 2]], atol=1e-12)
    raw = ArrayClassifier(Rows(), start=0.4, standardise=False, subtract_level=False).fit(three)
    np.testing.assert_allclose(
        raw.model_.learnt_, three["t_surface"].sel(time=slice(0.39, None)).values, atol=1e-9
    )


def test_any_scikit_learn_classifier_fits_on_the_traces(three: Grasps) -> None:
    from sklearn.ensemble import RandomForestClassifier

    by_path = ArrayClassifier("sklearn.ensemble.RandomForestClassifier", {"n_estimators": 20}, random_state=3)
    by_object = ArrayClassifier(RandomForestClassifier(n_estimators=20, random_state=3))
    np.testing.assert_array_equal(
        by_path.fit(three).predict_proba(three), by_object.fit(three).predict_proba(three)
    )


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("sklearn.svm.NoSuch", "cannot be imported"),
        ("no_such_module.Thing", "cannot be imported"),
        ("collections.OrderedDict", "is no scikit-learn classifier"),
        ("sklearn.linear_model:LinearRegression", "it must have fit, and predict a class"),
    ],
)
def test_a_wrong_import_path_is_the_users_error(path: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_classifier(path)


def test_as_array_is_the_record_and_subtracts_what_it_says(three: Grasps) -> None:
    np.testing.assert_allclose(as_array(three), three["t_surface"].values)
    rise = as_array(three, start=0.0, subtract_level=True)
    assert rise.shape == (24, 51)
    assert abs(np.median(as_array(three, subtract_level=True)[:, :5])) < 0.1
    x = as_array(three.assign(t_surface_2=three["t_surface"] + 1.0))
    np.testing.assert_allclose(x[:, 61:], x[:, :61] + 1.0)


def test_joining_keeps_what_the_records_share() -> None:
    a = make_grasps([0, 1, 2], [[1, 2, 3]], ["a"], t_surface_2=[[1, 1, 1]], t_object=[43.0])
    b = make_grasps([1, 2, 3], [[4, 5, 6]], ["b"])
    both = join_grasps([a, b])
    assert both["time"].values.tolist() == [1.0, 2.0]
    assert "t_surface_2" not in both
    assert np.isnan(both["t_object"].values[1])
    with pytest.raises(UserError, match="share no time axis"):
        join_grasps([a, make_grasps([0.5, 1.5], [[4, 5]], ["c"])])


HALF = np.array([-1.0, -0.75, -0.5, -0.25, 0.0, 0.5])
READ = np.array([[20.0, 26.0, 23.0, 90.0, np.nan, 40.0], [np.nan, 1.0, 5.0, 7.0, 9.0, np.nan]])


def test_traces_are_read_within_half_a_second_of_their_ends_about_their_own_level() -> None:
    g = make_grasps(HALF, READ, list("ab"), t_surface_2=READ + 1.0)
    np.testing.assert_array_equal(level(g), [23.0, 3.0])  # of the samples up to -0.5 s
    np.testing.assert_array_equal(level(g, "t_surface_2"), [24.0, 4.0])
    got = as_array(g, times=[-1.25, 0.0, 0.5], subtract_level=True)
    traces = [[20 - 23, (2 * 90 + 40) / 3 - 23, 40 - 23], [1 - 3, 9 - 3, 9 - 3]]
    np.testing.assert_allclose(got, np.hstack([traces, traces]))
    np.testing.assert_array_equal(as_array(g, start=-0.25)[:, :3], [[90.0, 220 / 3, 40.0], [7.0, 9.0, 9.0]])
    for times in ([-1.2500001, 0.0], [0.0, 0.5000001]):  # of b, which is read from -0.75 to 0 s
        with pytest.raises(UserError, match=r"grasp 'b' covers -0\.75 to 0 s, .* are needed"):
            as_array(g, times=times)
    late = make_grasps(HALF[2:], READ[:1, 2:], ["c"])
    assert level(late).tolist() == [56.5]  # one sample up to -0.5 s: the first three, one of them lost
    assert times_from(g.assign_coords(time=HALF - 1e-9), 0.0).tolist() == [0.0, 0.5]
    assert not np.signbit(times_from(make_grasps([-1e-9, 1.0], [[1, 1]], ["a"]), 0.0)[0])


def test_labels_and_records_are_taken_one_after_another(three: Grasps) -> None:
    a, b = pick(three, [0, 9]), pick(three, [17]).assign_attrs(name="b")
    assert [x.tolist() for x in record_labels([a, b], ["p", "q", "r"])] == [["p", "q"], ["r"]]
    assert [x.tolist() for x in record_labels([a, b], None)] == [["copper", "iron"], ["wood"]]
    for y, message in (
        (["p"] * 4, "4 labels for 3 grasps"),
        (["p", "q", ""], "b: grasp 'touches-17' has no"),
    ):
        with pytest.raises(UserError, match=message):
            record_labels([a, b], y)
    with pytest.raises(UserError, match="touches: 1 labels for 2 grasps"):
        grasp_labels(a, ["p"])
    with pytest.raises(UserError, match="no grasps were given"):
        record_list([])
    with pytest.raises(UserError, match="expected Grasps, got int"):
        record_list([a, 3])  # type: ignore[list-item]
    mask = np.arange(24) == 3
    assert pick(three, mask)["grasp"].values.tolist() == ["touches-3"]
    assert pick(three, [5, 2])["grasp"].values.tolist() == ["touches-5", "touches-2"]


def test_records_share_times_to_a_microsecond_and_fields_that_only_some_have_are_unknown() -> None:
    a = make_grasps([0, 1, 2], [[1, 2, 3]], ["a"], material=["iron"], name="p")
    b = make_grasps([1 + 4e-7, 2 - 4e-7, 3], [[4, 5, 6]], ["b"], t_object=[43.0], name="q")
    assert common_times([a, b]).tolist() == [1.0, 2.0]
    both = join_grasps([a, b])
    assert both["t_surface"].values.tolist() == [[2, 3], [4, 5]]
    assert both["material"].values.tolist() == ["iron", ""]
    np.testing.assert_array_equal(both["t_object"], [np.nan, 43.0])
    assert (both.attrs["name"], join_grasps([a, b], name="all").attrs["name"]) == ("p+q", "all")
    two = join_grasps([g.assign(t_surface_2=g["t_surface"] + 1) for g in (a, b)])
    assert two["t_surface_2"].values.tolist() == [[3, 4], [5, 6]]
    with pytest.raises(UserError, match="p and r: the grasps share no time axis"):
        join_grasps([a, make_grasps([2, 5], [[1, 2]], ["c"], name="r")])  # one instant is no axis


@pytest.mark.parametrize(
    ("shape", "fits"), [((2, 3), True), ((2, None), True), ((3, None), False), ((2,), False)]
)
def test_arrays_of_a_file_have_their_shape(shape: tuple[int | None, ...], fits: bool) -> None:
    if fits:
        check_shapes({"x": np.zeros((2, 3))}, x=shape)
    else:
        with pytest.raises(ValueError, match=r"x has shape \(2, 3\)"):
            check_shapes({"x": np.zeros((2, 3))}, x=shape)


LEARNERS = ["bayes", "features-lda", "pca-lda"]


@pytest.fixture(scope="module")
def rig() -> Grasps:
    return load_example_grasps()["exp2_dT20"]


@pytest.fixture(scope="module")
def two_sensors(rig: Grasps) -> Grasps:
    return rig.assign(t_surface_2=0.2 * rig["t_surface"] + 20.0)


@pytest.mark.parametrize("name", ["pca-lda", "svm-pca", "sklearn.neighbors:KNeighborsClassifier"])
def test_a_missing_second_sensor_is_reported(
    name: str, rig: Grasps, two_sensors: Grasps, tmp_path: Path
) -> None:
    model = make_classifier(name, seed=0).fit(two_sensors)
    for asked in (
        model,
        *([load_classifier(save_classifier(model, tmp_path))] if can_be_saved(model) else []),
    ):
        with pytest.raises(UserError, match="has no t_surface_2, and the classifier was trained with two"):
            asked.predict(rig)


@pytest.mark.parametrize("name", ["pca-lda", "svm-pca", "features-lda"])
def test_a_second_sensor_not_trained_with_is_not_read(name: str, rig: Grasps, two_sensors: Grasps) -> None:
    model = make_classifier(name, seed=0).fit(rig)
    np.testing.assert_array_equal(model.predict_proba(two_sensors), model.predict_proba(rig))


def test_features_of_the_first_sensor_need_no_second(rig: Grasps, two_sensors: Grasps) -> None:
    model = make_classifier("features-lda").fit(two_sensors)
    assert model.notes_ == ["the second sensor is not read"]
    assert make_classifier("features-lda").fit(rig).notes_ == []
    assert (model.predict(rig) == rig["material"].values).mean() > 0.9


@pytest.mark.parametrize("how", ["column", "one"])
def test_an_object_temperature_that_was_trained_with_is_asked_for(how: str, rig: Grasps) -> None:
    model = make_classifier("features-lda").fit(rig)
    unknown = rig["t_object"].where(rig["grasp"] != rig["grasp"].values[3])
    record = rig.drop_vars("t_object") if how == "column" else rig.assign(t_object=unknown)
    with pytest.raises(UserError, match="has no object temperature, and the classifier was trained with"):
        model.predict(record)


@pytest.mark.parametrize("name", LEARNERS)
def test_one_grasp_of_a_material_trains_without_a_word(name: str, rig: Grasps) -> None:
    material = rig["material"].values
    keep = (material != "wood") | (np.cumsum(material == "wood") == 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = make_classifier(name).fit(rig.isel(grasp=keep))
    assert (model.predict(rig) == material).mean() > 0.85


def test_an_estimator_that_cannot_learn_the_grasps_reports_it(rig: Grasps) -> None:
    model = make_classifier("sklearn.neighbors:KNeighborsClassifier", n_neighbors=-1)
    with pytest.raises(UserError, match="exp2_dT20: KNeighborsClassifier cannot learn these 24 grasps"):
        model.fit(rig)
