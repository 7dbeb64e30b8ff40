"""Linear discriminants are those of scikit-learn; where noise is in them they count less."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.lda import ArrayClassifier, FeaturesLda, PcaLda
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

Maker = Callable[..., Grasps]


@pytest.mark.parametrize("which", [[*range(7), *range(9, 14), 16, 18, 22], [*range(7), 8, 10, 13]])
def test_components_of_one_spread_are_told_apart_at_equal_priors(which: list[int], three: Grasps) -> None:
    some = pick(three, which)
    labels = some["material"].values.astype(str)
    model = PcaLda(components=3, start=0.4).fit(some)
    x = three["t_surface"].values[:, three["time"].values > 0.3]
    pca = PCA(3, svd_solver="full").fit(x[which])
    scale, k = pca.transform(x[which]).std(axis=0), len(set(labels))
    lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto", priors=[1 / k] * k)
    lda.fit(pca.transform(x[which]) / scale, labels)
    log_p, odds = model.predict_log_proba(three), lda.decision_function(pca.transform(x) / scale)
    odds = odds[:, None] if k == 2 else (odds - odds[:, :1])[:, 1:]
    np.testing.assert_allclose((log_p - log_p[:, :1])[:, 1:], odds, atol=1e-8)
    np.testing.assert_allclose(np.exp(log_p).sum(axis=1), 1.0)
    assert PcaLda(components=99).fit(some).axes_.shape == (len(which), 51)
    assert PcaLda().fit(three).axes_.shape == (4, 51)


def test_discriminants_of_features_count_by_the_share_that_is_not_noise(make_touches: Maker) -> None:
    train = make_touches(("copper", "iron", "wood", "zinc"), each=5)
    labels = train["material"].values.astype(str)
    model = FeaturesLda().fit(pick(train, [*range(4), *range(5, 20)]))
    read = model.reader_.read(train)
    found = model._discriminants(read.normalised()[0])
    used = np.arange(20) != 4
    within = 0.0
    for name in np.unique(labels):
        d = found[used & (labels == name)]
        d = d - d.mean(axis=1, keepdims=True)
        within += np.sum((d - d.mean(axis=0)) ** 2)
    assert model.spread_ == pytest.approx(within / (19 - 4))

    asked = make_touches(("copper", "wood"), each=2, t_object=28.0, seed=3)
    asked = asked.assign(t_object=("grasp", [28.0, 24.9, 23.4, 28.0]))
    x, noise = model.reader_.read(asked).normalised()
    logits = model._discriminants(np.where(np.isnan(x), model.center_, x))
    expected = np.zeros((4, 4))
    for g in (0, 1, 3):  # the third is within 1 K
        step = model.coef_ / model.scale_ - (model.coef_ / model.scale_).mean(axis=0)
        variance = sum(row @ noise[g] @ row for row in step)
        expected[g] = logits[g] / (1 + variance / model.spread_)
    expected -= np.logaddexp.reduce(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(model.predict_log_proba(asked), expected, atol=1e-9)
    assert np.exp(expected[2]).tolist() == pytest.approx([0.25] * 4)


def test_a_class_without_probabilities_is_as_likely_as_so_many_grasps_can_show(three: Grasps) -> None:
    """(24 + 1) / (24 + 3), and the rest to the others; a vote that is certain leaves one in 1e12."""
    model = ArrayClassifier("sklearn.linear_model:RidgeClassifier", random_state=7).fit(three)
    assert model.model_.random_state == 7
    assert np.unique(model.predict_proba(three).round(12)).tolist() == pytest.approx([1 / 27, 25 / 27])
    vote = ArrayClassifier("sklearn.neighbors:KNeighborsClassifier", {"n_neighbors": 1}, random_state=7)
    assert vote.fit(three).predict_log_proba(three).min() == pytest.approx(np.log(1e-12))
    with pytest.raises(UserError, match="does not take these parameters"):
        ArrayClassifier("sklearn.svm:LinearSVC", {"colour": 1}).fit(three)
