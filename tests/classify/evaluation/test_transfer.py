"""What another situation costs is measured against the same one again, and no test grasp trains."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from thermogrip.classify import evaluate, make_classifier
from thermogrip.classify.evaluation.transfer import transfer
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

Maker = Callable[..., Grasps]


def _sets(make_touches: Maker, count: int = 2) -> list[list[Grasps]]:
    return [[make_touches(name=f"train{k}", seed=k, noise=1.0).drop_vars("split")] for k in range(count)]


def test_a_change_of_scale_costs_accuracy_and_the_same_again_does_not(make_touches: Maker) -> None:
    same = make_touches(name="same", seed=8, noise=1.0).drop_vars("split")
    other = make_touches(name="weak", seed=9, noise=1.0).drop_vars("split")
    level = other["t_surface"].values[:, :1]
    other["t_surface"] = (("grasp", "time"), level + 0.7 * (other["t_surface"].values - level))
    models = {name: make_classifier(name) for name in ("pca-lda", "features-lda")}
    found = transfer(models, _sets(make_touches), {"same again": [same], "weaker": [other]})
    rows = {(row["classifier"], row["target"]): row for row in found.table()}
    for name in models:
        again, weaker = rows[name, "same again"], rows[name, "weaker"]
        assert (again["n"], again["tested"], again["sd_over_splits"] is None) == (24, 48, False)
        assert again["low"] > 0.8
        assert weaker["high"] < again["accuracy"]
        assert weaker["log_loss_low"] > again["log_loss_high"]


def test_one_training_set_is_a_test_on_files(make_touches: Maker) -> None:
    [train], fresh = _sets(make_touches, 1), make_touches(name="fresh", seed=8).drop_vars("split")
    [row] = transfer({"pca-lda": make_classifier("pca-lda")}, [train], {"fresh": [fresh]}).table()
    [alone] = evaluate(["pca-lda"], train, test=[fresh], probe=False).scores()
    assert row["log_loss"] == alone["log_loss"]
    assert row["ece_high"] == alone["ece_high"]


def test_a_training_grasp_is_no_target(make_touches: Maker) -> None:
    [train] = _sets(make_touches, 1)
    with pytest.raises(UserError, match="is in training"):
        transfer({"pca-lda": make_classifier("pca-lda")}, [train], {"itself": train})
    with pytest.raises(UserError, match="nothing to train on"):
        transfer({"pca-lda": make_classifier("pca-lda")}, [train], {})
