"""Margins become probabilities that hold on new grasps, with nothing taken from them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import GraspClassifier, pick
from thermogrip.classify.estimators.margins import SvmPca, calibrated_scale, inner_folds
from thermogrip.datasets.schema import Grasps, make_grasps

Maker = Callable[..., Grasps]


def minirocket(monkeypatch: pytest.MonkeyPatch) -> GraspClassifier:
    """Return MiniRocket as it was before its compilation, which takes a minute."""
    aeon = pytest.importorskip("aeon.transformations.collection.convolution_based._minirocket")
    for name in ("_fit_biases", "_static_transform_uni", "_static_transform_multi"):
        monkeypatch.setattr(aeon, name, getattr(aeon, name).py_func)
    return make_classifier("rocket", kernels=200)


@pytest.fixture(params=["svm-pca", "rocket"])
def machine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> GraspClassifier:
    """Both classifiers with margins, unfitted."""
    return minirocket(monkeypatch) if request.param == "rocket" else make_classifier(request.param)


def test_the_scale_found_is_the_one_that_the_truth_was_drawn_with() -> None:
    rng = np.random.default_rng(0)
    margins = rng.standard_normal((20_000, 3))
    p = np.exp(2.5 * margins) / np.exp(2.5 * margins).sum(axis=1, keepdims=True)
    truth = np.array([rng.choice(3, p=row) for row in p])
    assert calibrated_scale(margins, truth) == pytest.approx(2.5, rel=0.05)  # standard error 0.02
    assert calibrated_scale(margins[:5000, :2], rng.integers(0, 2, 5000)) < 0.1  # of margins that say nothing


@pytest.mark.parametrize(("n", "k"), [(6, 2), (30, 2), (6, 3), (40, 4)])
def test_where_all_are_right_the_truth_counts_as_one_observation_less(n: int, k: int) -> None:
    """Margins 1 for the truth and 0 else: e^s / (e^s + k - 1) = (n + 1) / (n + 2)."""
    truth = np.arange(n) % k
    assert calibrated_scale(np.eye(k)[truth], truth) == pytest.approx(np.log((k - 1) * (n + 1)), rel=1e-3)


def test_sessions_stay_whole_inside_the_training_and_grasps_where_there_is_one(make_touches: Maker) -> None:
    one = make_touches()
    labels = one["material"].values.astype(str)
    by_grasp = inner_folds(one, labels)
    assert sorted(np.concatenate([held for _, held in by_grasp]).tolist()) == list(range(24))
    several = one.assign(session=("grasp", [f"day{k % 4}" for k in range(24)]))
    for fitted, held in inner_folds(several, labels):
        days = several["session"].values
        assert not set(days[fitted]) & set(days[held])


def test_two_sessions_are_held_out_one_after_the_other_and_no_fold_lacks_a_material(three: Grasps) -> None:
    labels = three["material"].values.astype(str)
    two = three.assign(session=("grasp", np.where(np.arange(24) % 8 < 3, "a", "b")))
    assert sorted(held.size for _, held in inner_folds(two, labels)) == [9, 15]
    rng, whole = np.random.default_rng(0), 0
    for _ in range(60):
        days = three.assign(session=("grasp", rng.choice(["a", "b", "c"], 24, p=[0.6, 0.2, 0.2])))
        for fitted, held in inner_folds(days, labels):
            whole += 1
            assert set(labels[fitted]) == set(labels)
            assert held.size > 0
    assert whole > 60


def test_labels_without_a_meaning_are_not_learnt(make_touches: Maker) -> None:
    """What is held out was not seen, so probabilities are near those of no information, a third each."""
    model = SvmPca().fit(make_touches(each=12, noise=0.2, seed=1, shuffled=True))
    fresh = make_touches(each=12, noise=0.2, seed=2, name="b")
    assert model.predict_proba(fresh).max() < 0.6


def test_a_level_says_nothing_of_the_material(three: Grasps) -> None:
    model = SvmPca().fit(three)
    warmer = three.assign(t_surface=three["t_surface"] + 7.0, t_gripper=three["t_gripper"] + 7.0)
    np.testing.assert_allclose(model.predict_log_proba(warmer), model.predict_log_proba(three), atol=1e-8)


def test_one_grasp_a_material_leaves_nothing_to_hold_out(machine: GraspClassifier, three: Grasps) -> None:
    single = pick(three, [0, 8, 16])
    assert inner_folds(single, single["material"].values.astype(str)) == []
    np.testing.assert_allclose(machine.fit(single).predict_proba(single).sum(axis=1), 1.0)
    assert (machine.predict(single) == single["material"].values).all()


def test_probabilities_are_calibrated_and_not_one_hot(machine: GraspClassifier, make_touches: Maker) -> None:
    """A task with 20 % or so of errors: confidence is near accuracy, and neither 0 nor 1."""
    make = lambda seed, name: make_touches(  # noqa: E731
        ("copper", "zinc", "iron"), each=20, noise=0.5, seed=seed, name=name, step=0.4
    )
    machine.fit(make(0, "a"))
    fresh = make(1, "b")
    p = machine.predict_proba(fresh)
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    right = np.mean(machine.classes_[p.argmax(axis=1)] == fresh["material"].values)
    assert right > 0.6
    assert abs(p.max(axis=1).mean() - right) < 0.2  # three standard errors of 60 grasps
    assert -np.log(p[np.arange(60), np.searchsorted(machine.classes_, fresh["material"].values)]).mean() < 1.0


def test_both_sensors_are_seen(machine: GraspClassifier, three: Grasps) -> None:
    """The first sensor alone says nothing here."""
    flat = three.assign(t_surface=0 * three["t_surface"] + 23.0, t_surface_2=three["t_surface"])
    assert np.mean(machine.fit(flat).predict(flat) == flat["material"].values) > 0.9


def test_a_trace_too_short_for_the_kernels_stays_where_it_ended() -> None:
    pytest.importorskip("aeon")
    traces = np.outer([1.0, 1.1, 3.0, 3.1], [0.0, 0.5, 0.8, 0.9, 0.95, 1.0])
    short = make_grasps(np.arange(6) * 0.1, traces, list("abcd"), material=list("xxyy"))
    longer = np.pad(traces, ((0, 0), (0, 3)), mode="edge")
    whole = make_grasps(np.arange(9) * 0.1, longer, list("abcd"), material=list("xxyy"))
    found, same = (make_classifier("rocket", kernels=200).fit(g).predict_proba(g) for g in (short, whole))
    np.testing.assert_allclose(found, same)
