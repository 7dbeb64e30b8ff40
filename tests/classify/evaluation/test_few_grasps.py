"""Small and awkward records: one line, a note or an honest interval, never a crash or a silent leak."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.classify import evaluate, make_classifier
from thermogrip.classify.evaluation.comparison import Comparison
from thermogrip.classify.evaluation.metrics import calibration_interval, mean_intervals
from thermogrip.classify.evaluation.splits import plan_folds
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps

TIME = np.arange(-20, 101) / 10
RISE = {"x": 5.0, "y": 2.0, "z": 3.5}


def grasps(materials: str, name: str = "a", *, seed: int = 0, **about: Any) -> Grasps:
    """Return grasps whose traces rise by their material's size, give or take 0.3 K."""
    rng = np.random.default_rng(seed)
    n = len(materials)
    size = np.array([RISE[m] for m in materials]) + 0.3 * rng.standard_normal(n)
    skin = 23 + size[:, None] * -np.expm1(-np.maximum(TIME, 0)) + 0.05 * rng.standard_normal((n, TIME.size))
    known = {"t_object": [43.0] * n, "t_gripper": [23.0] * n}
    return make_grasps(
        TIME, skin, [f"{name}{i}" for i in range(n)], name=name, material=list(materials), **known, **about
    )


@pytest.mark.parametrize("name", ["features-lda", "pca-lda"])
def test_one_grasp_of_each_material_is_too_few_for_a_discriminant(name: str) -> None:
    with pytest.raises(UserError, match="one training grasp of each of 2 materials does not tell how"):
        make_classifier(name).fit(grasps("xy"))
    assert make_classifier(name).fit(grasps("xxy")).predict(grasps("xy", seed=1)).size == 2


def test_one_test_grasp_has_no_interval_over_grasps(tmp_path: Path) -> None:
    found = evaluate(["bayes"], [grasps("xxxyyyx", split=["train"] * 6 + ["test"])])
    [row] = found.scores()
    assert (row["n"], row["accuracy"]) == (1, 1.0)
    for score in ("log_loss", "brier", "ece"):
        assert np.isfinite(row[score])
        assert row[f"{score}_low"] is row[f"{score}_high"] is None
    assert row["low"] < 0.05  # of the accuracy there is one
    found.save(tmp_path)
    from thermogrip.report.classification import comparison_sections

    assert comparison_sections("shipped", found)


def test_many_tests_of_one_grasp_are_one_grasp() -> None:
    [loss] = mean_intervals(np.arange(9.0)[:, None], np.zeros(9, dtype=int))
    assert loss.value == 4.0
    assert np.isnan([loss.low, loss.high]).all()
    assert np.isnan(calibration_interval([0.9] * 9, [True] * 9, np.zeros(9, dtype=int)).low)


def test_records_that_begin_with_the_contact_are_not_probed() -> None:
    """What is there of a level is touch already: it named the material, and was called a leak."""
    record = grasps("xxxxxxxxxxyyyyyyyyyy")
    for first, probed in ((0.0, False), (-0.5, True)):
        cut = record.sel(time=slice(first - 1e-9, None))
        found = evaluate(["pca-lda"], [cut], split="random", repeats=1)
        assert bool(found.leaks) == probed
        assert not any(row["leak"] for row in found.leaks)
        assert ("a: no three readings before contact, so there was no leak probe" in found.notes) != probed


def test_what_an_estimator_says_of_too_few_grasps_is_one_line() -> None:
    model = make_classifier("sklearn.neighbors:KNeighborsClassifier").fit(grasps("xy"))
    with pytest.raises(
        UserError, match=r"a: KNeighborsClassifier cannot name these 2 grasps \(Expected n_neigh"
    ):
        model.predict(grasps("xy", seed=1))


def test_a_single_grasp_of_one_material_is_expanded_without_a_warning() -> None:
    assert make_classifier("expansions").fit(grasps("xxyyz")).predict(grasps("xyz", seed=1)).size == 3


def test_what_no_training_grasp_is_of_is_said_to_be_unscored() -> None:
    apart = grasps("xxxyyyzzz", session=list("111222333"))
    notes = plan_folds([apart], split="session").notes
    assert "a: nothing to score, as no training grasp is of z" in notes
    some = grasps("xxxyyyzx", split=["train"] * 6 + ["test"] * 2)
    assert plan_folds([some]).notes == ()


def test_a_copy_under_another_name_is_told_in_splits_and_refused_between_files() -> None:
    whole = grasps("xxxyyy")
    named = whole.assign_coords(grasp=[f"q{i}" for i in range(6)]).assign_attrs(name="b")
    with pytest.raises(UserError, match="b/q0 has the samples of a/a0: a copy in training and in test"):
        plan_folds([whole], test=[named])
    notes = plan_folds([whole, named], split="random", train_per_class=2, repeats=1).notes
    assert sum("has the samples of" in note for note in notes) == 6
    still = whole.assign(t_surface=whole["t_surface"] * 0 + 23.0)  # a coarse sensor, no difference
    assert plan_folds([still], split="random", train_per_class=2, repeats=1).notes == ()


def test_margins_are_scaled_by_the_grasps_that_were_held_out() -> None:
    """Folds that leave no grasp of a material to train on are dropped: their grasps have no margins."""
    record = grasps("yyxyxxxx", session=list("12424224"))
    model = make_classifier("svm-pca", seed=0).fit(record)
    # five of eight were counted as undecided, at ln 2 each, however clear the materials are
    assert model.held_out_loss_ < 0.6 * np.log(2) * 5 / 8


def test_a_confidence_of_one_and_a_rounding_error_has_its_bin() -> None:
    row = {"classifier": "c", "repeat": 0, "condition": "a", "apart": False, "material": "x"}
    row |= {"predicted": "x", "known": True, "correct": True, "confidence": 1 + 2e-16, "grasp_id": "g"}
    [found] = Comparison("shipped", 1, 0, (row,)).calibration("c", "a")
    assert (found["n"], found["grasps"], found["high"]) == (1, 1, 1.0)


@pytest.mark.parametrize("split", ["session", "block"])
def test_intervals_of_held_out_sessions_and_blocks_say_what_they_count(split: str) -> None:
    record = grasps("xxxxyyyy", **{split: list("aabbccdd") if split == "block" else list("12121212")})
    found = evaluate(["bayes"], [record], split=split, probe=False)
    assert f"Grasps of one {split} fail together" in found.interval_note


def test_one_training_grasp_of_each_material_is_an_answer_that_does_not_trust_the_dial() -> None:
    """Of two grasps with two means nothing is left that could tell how far blocks lie from their dial."""
    grasps = load_example_grasps()["exp2_dT20"]
    copper, wood = 0, 16
    model = make_classifier("posterior").fit(grasps.isel(grasp=[copper, wood]))
    fresh = grasps.isel(grasp=[5, 6, 21, 22])
    p = model.predict_proba(fresh)
    assert (model.predict(fresh) == ["copper", "copper", "wood", "wood"]).all()
    off = model.predict_proba(fresh.assign(t_object=fresh["t_object"] + 2.0))
    np.testing.assert_allclose(off, p, atol=0.05)
