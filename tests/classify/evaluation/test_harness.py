"""One harness: the same grasps for all, intervals, planted leaks are found; curves vary one thing."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from thermogrip.classify import evaluate, make_classifier
from thermogrip.classify.estimators.base import Answered, JoinedClassifier, pick
from thermogrip.classify.estimators.bayes import BayesClassifier
from thermogrip.classify.evaluation import harness
from thermogrip.classify.evaluation.comparison import Comparison
from thermogrip.classify.evaluation.harness import binomial_p, untouched
from thermogrip.classify.evaluation.metrics import (
    calibration_bins,
    calibration_interval,
    clopper_pearson,
    mean_intervals,
)
from thermogrip.classify.evaluation.splits import plan_folds
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps

Maker = Callable[..., Grasps]
FAST = ["bayes", "features-lda", "pca-lda"]


def test_an_estimator_of_anyone_is_scored_as_its_rows_are_by_itself(three: Grasps) -> None:
    """A pipeline on traces less their level before contact, without any class of ours."""
    pipeline = make_pipeline(StandardScaler(), KNeighborsClassifier(3))
    train, test = (pick(three, three["split"].values == part) for part in ("train", "test"))
    after = three["time"].values >= 0
    rows = {}
    for name, record in (("train", train), ("test", test)):
        traces = record["t_surface"].transpose("grasp", "time").values
        rows[name] = (traces - traces[:, three["time"].values < 0].mean(axis=1, keepdims=True))[:, after]
    truth = test["material"].values
    p = pipeline.fit(rows["train"], train["material"].values).predict_proba(rows["test"])
    unfitted = make_pipeline(StandardScaler(), KNeighborsClassifier(3))
    [row] = evaluate([unfitted], [three], probe=False).scores()
    assert row["classifier"] == "KNeighborsClassifier"
    assert row["accuracy"] == (pipeline.classes_[p.argmax(axis=1)] == truth).mean()
    [named] = evaluate({"mine": KNeighborsClassifier(3)}, [three], probe=False).scores()
    assert named["classifier"] == "mine"
    [forest] = evaluate(["forest"], [three], probe=False).scores()
    assert forest["accuracy"] > 0.8
    for wrong in (KNeighborsClassifier, 3, three):
        with pytest.raises(UserError, match="is no classifier; give a name, or an unfitted estimator"):
            evaluate([wrong], [three], probe=False)  # type: ignore[list-item]


@pytest.fixture(scope="module")
def found(three: Grasps) -> Comparison:
    """Three classifiers on six random splits of one condition."""
    return evaluate(FAST, [three], split="random", repeats=6, probe=False)


def test_the_scores_are_those_of_the_classifier_alone(three: Grasps) -> None:
    train, test = (pick(three, three["split"].values == part) for part in ("train", "test"))
    model = make_classifier("pca-lda").fit(train)
    p = model.predict_proba(test)
    true = np.searchsorted(model.classes_, test["material"].values)
    [row] = evaluate(["pca-lda"], [three], probe=False).scores()
    k = int(np.sum(p.argmax(axis=1) == true))
    assert (row["n"], row["tested"], row["accuracy"]) == (9, 9, k / 9)
    assert (row["low"], row["high"]) == clopper_pearson(k, 9)
    assert row["log_loss"] == pytest.approx(-np.log(p[np.arange(9), true]).mean())
    assert row["brier"] == pytest.approx(((p - np.eye(3)[true]) ** 2).sum(axis=1).mean())
    assert row["log_loss_chance"] == pytest.approx(np.log(3))
    assert row["log_loss_base"] == pytest.approx(np.log(3))  # five grasps of each train


def test_every_classifier_is_tested_on_the_same_grasps(found: Comparison) -> None:
    tested = [
        [(r["repeat"], r["grasp_id"]) for r in found.predictions if r["classifier"] == name] for name in FAST
    ]
    assert tested[0] == tested[1] == tested[2]
    assert len(tested[0]) == 6 * 9


def test_repeats_do_not_shrink_the_interval_below_that_of_the_distinct_grasps(found: Comparison) -> None:
    for row in found.scores():
        assert row["tested"] == 54
        assert row["n"] <= 24
        exact = clopper_pearson(row["accuracy"] * row["n"], row["n"])
        assert (row["low"], row["high"]) == exact
        assert row["high"] - row["low"] > 0.1
    assert "distinct grasps" in found.interval_note


def test_every_score_has_an_interval_in_the_table_and_its_file(found: Comparison, tmp_path: Path) -> None:
    with open(found.save(tmp_path) / "scores.csv", newline="") as file:
        saved = list(csv.DictReader(file))
    for row, cells in zip(found.scores(), saved, strict=True):
        mine = [r for r in found.predictions if r["classifier"] == row["classifier"]]
        said, right = [r["confidence"] for r in mine], [r["correct"] for r in mine]
        gaps = sum(b.n * abs(b.confidence - b.accuracy) for b in calibration_bins(said, right))
        assert row["ece"] == pytest.approx(gaps / len(said))
        assert 0 <= row["ece_calibrated"] < 0.3
        for key in ("log_loss", "brier", "ece"):
            assert row[f"{key}_low"] <= row[key] <= row[f"{key}_high"]
            assert float(cells[f"{key}_high"]) == pytest.approx(row[f"{key}_high"], rel=1e-5)
        assert row["low"] <= row["boot_low"] <= row["accuracy"] <= row["boot_high"] <= row["high"]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_same_seed_gives_the_same_comparison_on_one_process_or_two(three: Grasps, workers: int) -> None:
    one = evaluate(["features-lda"], [three], split="random", repeats=3, seed=4)
    two = evaluate(["features-lda"], [three], split="random", repeats=3, seed=4, workers=workers)
    assert one.predictions == two.predictions
    assert one.leaks == two.leaks


def test_clean_grasps_pass_the_leak_probe(three: Grasps, make_touches: Maker) -> None:
    found = evaluate(FAST, [three, make_touches(name="more", seed=6)])
    assert list(dict.fromkeys(r["classifier"] for r in found.leaks)) == ["untouched traces", *FAST]
    assert not any(r["leak"] for r in found.leaks)


def test_a_level_that_follows_the_label_is_found_as_a_leak(make_touches: Maker) -> None:
    planted = make_touches(each=12)
    shift = np.array([{"copper": 0.0, "iron": 1.5, "wood": 3.0}[m] for m in planted["material"].values])
    planted["t_surface"] = (("grasp", "time"), planted["t_surface"].values + shift[:, None])
    found = evaluate(["features-lda", "pca-lda"], [planted])
    leaks = {r["classifier"]: r for r in found.leaks}
    assert leaks["untouched traces"]["leak"]
    assert leaks["pca-lda"]["leak"]  # it sees levels
    assert not leaks["features-lda"]["leak"]  # it sees rises only
    assert leaks["pca-lda"]["accuracy"] > 0.9
    assert {row["cautions"] for row in found.scores()} == {"leak"}  # the record's, so of every number on it
    assert [c.code for c in found.cautions] == ["leak", "leak"]
    [line] = found.caution_lines()
    assert line.startswith("touches: labels can be predicted from samples before contact")
    assert "pca-lda: 100 % of n = " in line
    assert "touches: labels can be predicted" in str(found)


def test_a_material_that_training_lacks_is_counted_with_its_answers(three: Grasps) -> None:
    marks = np.where(three["material"].values == "wood", "test", three["split"].values.astype(str))
    found = evaluate(["features-lda"], [three.assign(split=("grasp", marks))], probe=False)
    [row] = found.scores()
    assert (row["n"], row["n_test"], row["cautions"]) == (6, 14, "unseen_material")
    [caution] = found.cautions
    assert caution.words == "8 of 14 test grasps are of wood, which training lacks, and are not scored"
    answers = [r["predicted"] for r in found.predictions if not r["known"]]
    assert {f"{name} {answers.count(name)}" in caution.detail for name in set(answers)} == {True}
    assert caution.brief.startswith("8 unseen (wood): ")
    # one that is likelier none of the candidates counts as that, as `classify` says
    doubting = replace(found, predictions=[row | {"p_unknown": 0.9} for row in found.predictions])
    assert [one.brief for one in doubting.cautions] == ["8 unseen (wood): unknown 8"]


def test_a_fault_of_contacts_touches_the_scores_that_rest_on_them(three: Grasps, make_touches: Maker) -> None:
    faulty = make_touches(name="faulty", seed=9)
    traces = faulty["t_surface"].values.copy()
    traces[0] = 23 + 0.01 * np.random.default_rng(0).standard_normal(traces.shape[1])
    faulty["t_surface"] = (("grasp", "time"), traces, three["t_surface"].attrs)
    found = evaluate(["features-lda"], [three, faulty], probe=False)
    assert {row["condition"]: row["cautions"] for row in found.scores()} == {
        "pooled": "session_fault", "touches": "", "faulty": "session_fault",
    }  # fmt: skip
    [caution] = found.cautions
    assert "stay as they are: no contact?" in caution.words


class ReadsTheName(JoinedClassifier):
    """A cheat: it reads the material off the record that it should predict."""

    def _fit(self, grasps: Grasps, labels: np.ndarray) -> None:
        self.fitted_ = True

    def _log_proba(self, grasps: Grasps) -> np.ndarray:
        hit = grasps["material"].values[:, None] == self.classes_
        return np.log(0.01 + hit)


def test_a_classifier_that_reads_labels_is_found_as_a_leak(three: Grasps) -> None:
    leaks = {r["classifier"]: r for r in evaluate({"cheat": ReadsTheName()}, [three]).leaks}
    assert leaks["cheat"]["accuracy"] == 1.0
    assert leaks["cheat"]["leak"]


def test_an_untouched_record_keeps_what_was_before_and_nothing_after(three: Grasps) -> None:
    blank = untouched(three)
    time = three["time"].values
    before, after = time <= -0.5, time > -0.5
    assert np.array_equal(blank["t_surface"].values[:, before], three["t_surface"].values[:, before])
    level = np.median(three["t_surface"].values[:, before], axis=1)
    assert np.abs(blank["t_surface"].values[:, after] - level[:, None]).max() < 0.3
    assert np.ptp(three["t_surface"].values) > 10


def probed(condition: str, grasps: int, right: int, **more: Any) -> Any:
    """Return a probe of so many grasps, half of them iron, each tested twice."""
    rows = [
        {"condition": condition, "grasp_id": f"g{i % grasps}", "material": "iron" if i % 2 else "wood",
         "correct": i % grasps < right, "known": True} | more
        for i in range(2 * grasps)
    ]  # fmt: skip
    return SimpleNamespace(classifier="p", rows=rows)


def test_leaks_share_their_level_and_count_grasps() -> None:
    """All seven right at a chance of a half: 1/128 is a leak alone, and none among two."""
    seven, none = probed("c", 7, 7), probed("d", 6, 3)
    alone, strange = harness._leaks([seven]), harness._leaks([seven, probed("e", 6, 6, known=False)])
    assert alone == [
        {"classifier": "p", "condition": "c", "n": 7, "accuracy": 1.0, "chance": 0.5, "p_value": 1 / 128,
         "leak": True}
    ]  # fmt: skip
    assert [row["leak"] for row in harness._leaks([seven, none])] == [False, False]
    assert strange == [alone[0] | {"leak": False}]
    assert harness._leaks([none])[0]["p_value"] == pytest.approx(42 / 64)


def test_who_cannot_answer_is_left_out_with_the_reason_and_the_others_are_scored(three: Grasps) -> None:
    strange = three.assign(
        material=("grasp", np.char.add("a kind of ", three["material"].values.astype(str)))
    )
    found = evaluate(["posterior", "pca-lda"], [strange])
    assert found.classifiers == ("pca-lda",)
    assert {row["classifier"] for row in found.leaks} == {"pca-lda", "untouched traces"}
    head = f"posterior left out of {three.attrs['name']}: "
    [note] = [note for note in found.notes if note.startswith(head)]
    assert "the materials table has none of the labels" in note
    with pytest.raises(UserError, match="the materials table has none of the labels"):
        evaluate(["posterior"], [strange])


def test_base_rates_are_those_of_the_training(three: Grasps) -> None:
    few = pick(three, np.r_[0:5, 8:12, 16:24])
    marks = [*["train"] * 4, "test", *["train"] * 3, "test", *["train"] * 7, "test"]
    kept = few.assign(split=("grasp", marks))
    [row] = evaluate(["pca-lda"], [kept], probe=False).scores()
    assert row["log_loss_base"] == pytest.approx(-np.log([4 / 14, 3 / 14, 7 / 14]).mean())


def test_the_probe_is_the_one_sided_binomial_test() -> None:
    from scipy.stats import binomtest

    for k, n, p in ((0, 9, 1 / 3), (7, 9, 1 / 3), (12, 15, 0.2)):
        assert binomial_p(k, n, p) == pytest.approx(binomtest(k, n, p, alternative="greater").pvalue)


def test_two_classifiers_are_compared_grasp_by_grasp(three: Grasps) -> None:
    [row] = evaluate(
        {"cheat": ReadsTheName(), "pca": make_classifier("pca-lda")}, [three], probe=False
    ).differences("touches")
    scores = {r["classifier"]: r for r in evaluate(["pca-lda"], [three], probe=False).scores()}
    missed = round(9 * (1 - scores["pca-lda"]["accuracy"]))
    assert (row["only_first"], row["only_second"], row["test"]) == (missed, 0, "McNemar exact")
    assert row["p_value"] == pytest.approx(min(1.0, 2 * 0.5**missed))
    assert row["low"] <= row["difference"] <= row["high"]
    lost = row["log_loss_difference"]
    cheat = -np.log(1.01 / 1.03)  # of three candidates: 1.01, 0.01 and 0.01
    assert lost == pytest.approx(cheat - scores["pca-lda"]["log_loss"])
    assert row["log_loss_low"] <= lost <= row["log_loss_high"]


def test_conditions_are_pooled_but_not_those_with_unknown_temperature(make_touches: Maker) -> None:
    a, b = make_touches(name="a"), make_touches(name="b", seed=1)
    c = make_touches(name="c", seed=2).drop_vars("t_object")
    found = evaluate(["features-lda"], [a, b, c], probe=False)
    n = {r["condition"]: (r["n"], r["apart"]) for r in found.scores()}
    assert n == {"pooled": (18, False), "a": (9, False), "b": (9, False), "c": (9, True)}


def test_two_touches_of_a_block_are_one_decision(make_touches: Maker) -> None:
    g = make_touches(each=16, noise=0.5)
    paired = g.assign(touch_group=("grasp", [f"p{i // 2}" for i in range(48)])).drop_vars("split")
    found = evaluate(["bayes"], [paired], split="random", repeats=2, train_per_class=4, probe=False)
    [row] = found.scores()
    assert row["apart"]
    assert row["tested"] == 2 * 3 * 4
    assert {r["grasp_id"][0] for r in found.predictions} == {"p"}


def test_materials_that_were_no_candidates_are_counted_apart(make_touches: Maker) -> None:
    class Novelty(ReadsTheName):
        def _answered(self, grasps: Grasps, names: list[str]) -> Answered:
            p_unknown = np.where(np.isin(grasps["material"].values, ["copper", "wood"]), 0.1, 0.9)
            return super()._answered(grasps, names)._replace(p_unknown=p_unknown)

    known = make_touches(("copper", "wood"), name="known")
    strange = make_touches(("zinc",), name="strange", seed=3).assign(split=("grasp", np.full(8, "test")))
    found = evaluate({"novelty": Novelty()}, [known, strange], probe=False)
    assert [r["condition"] for r in found.scores()] == ["known"]
    assert sum(not r["known"] for r in found.predictions) == 8
    [row] = found.open_set()
    assert (row["material"], row["n_unknown"], row["n_known"], row["auroc"]) == ("zinc", 8, 6, 1.0)


class Pooled(ReadsTheName):
    """Remembers what it was given to learn from."""

    learns_from_all_conditions = True

    def fit(self, X: list[Grasps], y: object = None) -> Pooled:
        self.classes_ = np.unique(np.concatenate([g["material"].values for g in X]))
        Pooled.seen.append({str(i) for g in X for i in g["grasp"].values})
        return self

    seen: list[set[str]] = []  # noqa: RUF012


def test_what_is_learnt_from_all_conditions_never_sees_a_test_grasp(make_touches: Maker) -> None:
    Pooled.seen.clear()
    a, b = make_touches(name="a"), make_touches(("iron", "zinc"), name="b", seed=1)
    found = evaluate({"pooled": Pooled()}, [a, b], split="random", repeats=3, probe=False)
    assert len(Pooled.seen) == 3
    for repeat, seen in enumerate(Pooled.seen):
        tested = {r["grasp_id"] for r in found.predictions if r["repeat"] == repeat}
        assert len(seen) == 25
        assert not seen & tested
    assert {r["candidates"] for r in found.predictions} == {2, 3}
    # by the fit of its own repeat alone: one of another repeat may have seen it
    answered = [(r["repeat"], r["grasp_id"]) for r in found.predictions]
    assert len(answered) == len(set(answered))


@pytest.mark.parametrize(
    ("classifiers", "message"),
    [
        ("bayes", "classifiers is one word"),
        ([], "no classifier is given"),
        (["bayes", "bayes"], "two classifiers are called 'bayes'"),
        (["oak"], "no classifier is called 'oak'"),
    ],
)
def test_a_wrong_list_of_classifiers_is_refused(three: Grasps, classifiers: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        evaluate(classifiers, [three])


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
    with pytest.raises(UserError, match="one training grasp of each of 2 materials does not show how"):
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


def test_what_no_training_grasp_is_of_is_reported_as_unscored() -> None:
    apart = grasps("xxxyyyzzz", session=list("111222333"))
    notes = plan_folds([apart], split="session").notes
    assert "a: nothing to score, as no training grasp is of z" in notes
    some = grasps("xxxyyyzx", split=["train"] * 6 + ["test"] * 2)
    assert plan_folds([some]).notes == ()


def test_where_sessions_cannot_be_held_out_grasps_are() -> None:
    record = grasps("yyxyxxxx", session=list("12424224"))
    p = make_classifier("svm-pca", seed=0).fit(record).predict_proba(record)
    truth = (record["material"].values == "y").astype(int)
    assert -np.log(p[np.arange(8), truth]).mean() < 0.6 * np.log(2)


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


def test_one_training_grasp_of_each_material_answers_without_the_nominal_temperature() -> None:
    """Two grasps with two means leave nothing to identify the scatter about the nominal temperature from."""
    grasps = load_example_grasps()["exp2_dT20"]
    copper, wood = 0, 16
    model = make_classifier("posterior").fit(grasps.isel(grasp=[copper, wood]))
    fresh = grasps.isel(grasp=[5, 6, 21, 22])
    p = model.predict_proba(fresh)
    assert (model.predict(fresh) == ["copper", "copper", "wood", "wood"]).all()
    off = model.predict_proba(fresh.assign(t_object=fresh["t_object"] + 2.0))
    np.testing.assert_allclose(off, p, atol=0.05)


Maker = Callable[..., Grasps]


def test_bayes_learns_all_conditions_together_but_those_scored_apart(make_touches: Maker) -> None:
    """One of unknown temperature, and one whose material no other temperature shows, are learnt alone."""
    warm, mild = make_touches(name="warm"), make_touches(t_object=33.0, seed=1, name="mild")
    unknown = make_touches(seed=2, name="unknown").drop_vars("t_object")
    level = make_touches(("zinc", "iron"), t_object=23.0, seed=3, name="level")
    learnt: list[list[str]] = []

    class Watched(BayesClassifier):
        def fit(self, X, y=None):  # type: ignore[no-untyped-def]
            records = X if isinstance(X, list) else [X]
            learnt.append([str(part.attrs["name"]) for part in records])
            return super().fit(X, y)

    evaluate({"b": Watched()}, [warm, mild, unknown, level], probe=False)
    assert learnt == [["warm", "mild", "unknown", "level"], ["unknown"], ["level"]]
    learnt.clear()
    evaluate({"b": Watched()}, [warm, mild], probe=False)
    assert learnt == [["warm", "mild"]]
