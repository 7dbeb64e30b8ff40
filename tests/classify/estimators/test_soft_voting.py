"""Several classifiers asked at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify import can_be_saved, evaluate, make_classifier
from thermogrip.classify.estimators.registry import classifier_name
from thermogrip.classify.estimators.soft_voting import VoteClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps


def test_a_vote_is_the_mean_of_its_members_probabilities(three: Grasps) -> None:
    names = ("bayes", "features-lda", "pca-lda")
    vote = make_classifier("+".join(names)).fit(three)
    alone = [make_classifier(name).fit(three).predict_proba(three) for name in names]
    np.testing.assert_allclose(vote.predict_proba(three), np.mean(alone, axis=0), rtol=1e-12, atol=1e-300)


def test_one_member_twice_is_that_member(three: Grasps) -> None:
    vote = make_classifier("pca-lda+pca-lda").fit(three)
    alone = make_classifier("pca-lda").fit(three)
    np.testing.assert_allclose(vote.predict_log_proba(three), alone.predict_log_proba(three), atol=1e-12)


def test_the_harness_scores_a_vote_beside_its_members(make_touches: Callable[..., Grasps]) -> None:
    grasps = make_touches(("copper", "iron", "wood"))
    names = ["bayes+pca-lda", "bayes", "pca-lda"]
    found = evaluate(names, [grasps], split="random", repeats=2, train_per_class=2, probe=False)
    loss = {row["classifier"]: row["log_loss"] for row in found.scores()}
    assert set(loss) == set(names)
    assert loss["bayes+pca-lda"] <= (loss["bayes"] + loss["pca-lda"]) / 2 + 1e-12  # Jensen


def test_its_name_is_its_members_and_it_gives_each_the_seed() -> None:
    vote = make_classifier("svm-pca+lstm", quick=True, seed=5)
    assert isinstance(vote, VoteClassifier)
    assert classifier_name(vote) == "svm-pca+lstm"
    assert [member.get_params()["random_state"] for member in vote.members] == [5, 5]
    assert vote.members[1].get_params()["epochs"] == 200
    assert not can_be_saved(vote)


@pytest.mark.parametrize(
    ("name", "params", "said"),
    [
        ("bayes+posterior", {}, "learns from all conditions"),
        ("bayes+", {}, "no classifier is called"),
        ("bayes+nothing", {}, "nothing"),
        ("bayes+pca-lda", {"n": 3}, "no parameters"),
    ],
)
def test_what_can_be_no_vote_is_refused(name: str, params: dict[str, int], said: str) -> None:
    with pytest.raises(UserError, match=said):
        make_classifier(name, **params)


def test_a_vote_of_one_is_refused(three: Grasps) -> None:
    with pytest.raises(UserError, match="fewer than two"):
        VoteClassifier([make_classifier("bayes")]).fit(three)
