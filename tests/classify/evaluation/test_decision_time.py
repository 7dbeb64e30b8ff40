"""Contacts end where training grasps showed that to be safe, and nothing of the test says when."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binom

from thermogrip.classify import evaluate, make_classifier
from thermogrip.classify.decisions.stopping_rule import StopRule
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.classify.evaluation.decision_time import Decisions, decision_times
from thermogrip.classify.evaluation.metrics import clopper_pearson, mean_intervals
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

Maker = Callable[..., Grasps]
TIMES = (0.6, 1.0, 2.0, 5.0)


def _follow(grasps: Grasps, **settings: object) -> Decisions:
    models = {"pca-lda": make_classifier("pca-lda")}
    return decision_times(models, [grasps], **({"times": TIMES, "error": 0.1} | settings))


def contact(condition: str, grasp: str, time: float, right: bool, p_wrong: float, **more: object) -> dict:
    """Return one contact of 10 s."""
    return {
        "classifier": "a", "repeat": 0, "condition": condition, "grasp_id": grasp, "time": time, "end": 10.0,
        "correct": right, "correct_at_end": True, "early": time < 10, "p_wrong": p_wrong,
    } | more  # fmt: skip


def test_a_row_is_made_of_its_contacts_and_counts_grasps() -> None:
    rows = (
        contact("wet", "i", 1.0, True, 0.1),
        contact("wet", "i", 3.0, False, 0.3, repeat=1),
        contact("wet", "w", 10.0, True, 0.4),
        contact("dry", "i", 2.0, False, 0.2, end=8.0, correct_at_end=False),
    )
    rules = tuple(StopRule(sure=0.9, error=error) for error in (0.05, 0.2, 0.1))
    pooled, wet, dry = Decisions(rows, {"a": rules}, ()).table(level=0.9, seed=3)
    assert [row["condition"] for row in (pooled, wet, dry)] == ["pooled", "wet", "dry"]
    time = mean_intervals([[1.0], [3.0], [10.0], [2.0]], [0, 0, 1, 2], level=0.9, seed=3)[0]
    ends = (*clopper_pearson(1.5, 3, level=0.9), *clopper_pearson(4 / 3, 2, level=0.9))
    assert pooled == {
        "classifier": "a", "condition": "pooled", "error": 0.2, "n": 3, "tested": 4, "time": 4.0,
        "time_low": time.low, "time_high": time.high, "end": 9.5, "accuracy": 0.5, "low": ends[0],
        "high": ends[1], "accuracy_at_end": 0.75, "early": 0.75, "wrong_early": pytest.approx(2 / 3),
        "wrong_early_low": pytest.approx(ends[2]), "wrong_early_high": pytest.approx(ends[3]),
        "expected_early": pytest.approx(0.2),
    }  # fmt: skip
    assert (wet["n"], wet["tested"], dry["accuracy_at_end"]) == (2, 3, 0.0)
    [alone] = Decisions(rows[3:], {"a": rules}, ()).table()
    assert (alone["condition"], np.isnan(alone["time_low"])) == ("dry", True)


@pytest.fixture(scope="module")
def found() -> Decisions:
    from tests.classify.conftest import touches

    return _follow(touches(each=24, noise=0.3, seed=3))


def test_contacts_end_early_and_no_more_are_wrong_than_stated(found: Decisions) -> None:
    [row] = found.table()
    assert row["n"] == row["tested"] == 27
    assert row["time_low"] <= row["time"] <= row["time_high"] < row["end"] == pytest.approx(10.0)
    assert row["early"] > 0.5
    # stated 0.1; of at most 27 contacts, 7 or more wrong happen once in 50 such runs
    assert row["wrong_early"] * row["early"] * 27 < 7
    assert {r["time"] for r in found.rows} <= {*TIMES, 10.0}


def test_errors_of_ended_contacts_stand_with_their_interval_and_what_was_expected(found: Decisions) -> None:
    [row] = found.table()
    early = [r for r in found.rows if r["early"]]
    wrong = sum(not r["correct"] for r in early)
    assert row["wrong_early"] == wrong / len(early)
    # Clopper-Pearson: so many or more are wrong in 2.5 % of draws at its lower end, so few at its upper
    assert binom.sf(wrong - 1, len(early), row["wrong_early_low"]) == pytest.approx(0.025) or wrong == 0
    assert binom.cdf(wrong, len(early), row["wrong_early_high"]) == pytest.approx(0.025)
    # every contact that ended was as sure as the rule asks, so none was expected to err more often than that
    [rule] = found.rules["pca-lda"]
    assert all(r["p_wrong"] <= 1 - rule.sure + 1e-9 for r in early)
    assert row["expected_early"] == pytest.approx(np.mean([r["p_wrong"] for r in early]))


def test_where_no_contact_ends_early_there_is_nothing_to_be_wrong(make_touches: Maker) -> None:
    [row] = _follow(make_touches(noise=0.3, seed=4, shuffled=True)).table()
    assert row["early"] == 0.0
    assert row["wrong_early"] is row["wrong_early_low"] is row["expected_early"] is None


@pytest.mark.parametrize("shuffled", [False, True])  # what is learnt from shuffled labels is never sure
def test_a_contact_not_ended_early_has_the_answer_of_the_whole(make_touches: Maker, shuffled: bool) -> None:
    grasps = make_touches(noise=0.3, seed=4, shuffled=shuffled)
    rows = _follow(grasps).rows
    assert [r["early"] for r in rows] == [not shuffled] * 9
    whole = evaluate(["pca-lda"], [grasps], probe=False).predictions
    right = {r["grasp_id"]: r["correct"] for r in whole}
    assert all(r["correct_at_end"] == right[r["grasp_id"]] for r in rows)
    assert all(r["correct"] == r["correct_at_end"] for r in rows if not r["early"])


def test_no_test_label_moves_the_threshold(make_touches: Maker) -> None:
    grasps = make_touches(each=16, noise=0.4, seed=5)
    test = grasps["split"].values == "test"
    labels = grasps["material"].values.astype(str)
    labels[test] = np.roll(labels[test], 3)
    shuffled = grasps.assign(material=("grasp", labels))
    assert _follow(grasps).rules == _follow(shuffled).rules
    mine, other = _follow(grasps).table()[0], _follow(shuffled).table()[0]
    assert mine["time"] == other["time"]
    assert mine["accuracy"] > other["accuracy"]


def test_a_threshold_from_grasps_known_by_heart_would_be_too_low(make_touches: Maker) -> None:
    """One nearest neighbour is sure of every training grasp; only held-out ones show how often it errs."""
    grasps = make_touches(each=24, noise=2.0, seed=6)
    nearest = make_classifier("sklearn.neighbors:KNeighborsClassifier", n_neighbors=1)
    nearest.fits_in_a_blink = True
    [row] = decision_times({"nearest": nearest}, [grasps], times=TIMES, error=0.1).table()
    assert row["early"] < 0.5


def test_few_training_grasps_guarantee_less_and_that_is_reported(make_touches: Maker) -> None:
    small = _follow(make_touches(each=5), error=0.02)
    assert small.notes == ("pca-lda: 9 training grasps show an error of 0.091 at best",)
    assert small.table()[0]["error"] == pytest.approx(1 / 11)
    too_small = _follow(make_touches(each=4))  # two of each train: with one held out, one is left
    assert too_small.notes == ("pca-lda: 1 conditions with too few training grasps left out",)
    assert too_small.table() == []


def test_what_cannot_be_followed_is_noted_or_refused(make_touches: Maker, make_tiny_lstm: Callable) -> None:
    models = {"lstm": make_tiny_lstm(), "pca-lda": make_classifier("pca-lda")}
    found = decision_times(models, [make_touches()], times=(1.0,), error=0.2)
    assert found.classifiers == ("pca-lda",)
    assert found.notes[0].startswith("lstm: training it for each window takes long")
    with pytest.raises(UserError, match="no classifier can be followed"):
        decision_times({"lstm": models["lstm"]}, [make_touches()])


class Calibrated(PosteriorClassifier):
    """The bundled gripper, in place of a fit of half a minute."""

    def fit(self, X: object, y: object = None, **_: object) -> Calibrated:
        self.with_device(load_default_gripper())
        return self


def test_the_posterior_is_followed_without_a_fit_for_each_window() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    found = decision_times({"posterior": Calibrated()}, [grasps], times=(0.5, 1.0, 3.0), error=0.1)
    [row] = found.table()
    assert row["accuracy_at_end"] == 1.0
    assert row["time"] < 3.0
    assert row["early"] >= 8 / 9  # of one iron block it is not sure after 3 s
