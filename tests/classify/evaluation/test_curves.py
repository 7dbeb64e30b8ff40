"""Curves: what is varied is varied, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from thermogrip.classify import evaluate
from thermogrip.classify.evaluation import harness
from thermogrip.classify.evaluation.harness import (
    contact_time_curve,
    cut_at,
    difference_curve,
    learning_curve,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

Maker = Callable[..., Grasps]


def test_more_training_grasps_help_and_sizes_without_a_test_are_left_out(make_touches: Maker) -> None:
    noisy = make_touches(each=20, noise=0.6, seed=1)
    rows = learning_curve(["pca-lda"], [noisy], sizes=(2, 15, 20), repeats=6)
    assert [row["train_per_class"] for row in rows] == [2, 15]
    assert rows[1]["log_loss"] < rows[0]["log_loss"]
    with pytest.raises(UserError, match="20 grasps of a material leave none to test"):
        learning_curve(["pca-lda"], [noisy], sizes=(20, 30))


def test_a_cut_is_what_would_have_been_recorded(three: Grasps) -> None:
    short = cut_at(three, 1.0)
    assert float(short["time"].values[-1]) == pytest.approx(1.0)
    np.testing.assert_array_equal(short["t_surface"].values, three["t_surface"].values[:, :16])
    with pytest.raises(UserError, match="0 s of contact hold no sample"):
        cut_at(three, 0.0)


def test_a_longer_contact_of_these_touches_is_easier(make_touches: Maker) -> None:
    noisy = make_touches(each=10, noise=0.3, seed=2)
    rows = contact_time_curve(["pca-lda"], [noisy], times=(0.4, 10.0, 99.0), repeats=5)
    assert [row["contact_s"] for row in rows] == [0.4, 10.0]
    assert rows[1]["log_loss"] < rows[0]["log_loss"]


def test_the_difference_is_signed_and_orders_by_size(make_touches: Maker) -> None:
    records = [make_touches(t_object=t, name=f"at{t}", seed=k) for k, t in enumerate((43.0, 18.0))]
    rows = difference_curve(evaluate(["pca-lda"], records, probe=False), records)
    assert [round(row["difference_K"]) for row in rows] == [-5, 20]
    near = [make_touches(t_object=t, name=f"near{t}", seed=k) for k, t in enumerate((3.0, 33.0))]
    rows = difference_curve(evaluate(["pca-lda"], near, probe=False), near)
    assert [round(row["difference_K"]) for row in rows] == [10, -20]


def test_of_several_records_one_row_is_pooled_and_the_smallest_limits_the_sizes(make_touches: Maker) -> None:
    records = [make_touches(each=n, name=f"of{n}", noise=0.3, seed=n) for n in (6, 20)]
    rows = learning_curve(["pca-lda"], records, sizes=(2, 5, 6, 10), repeats=2)
    assert [row["train_per_class"] for row in rows] == [2, 5]
    assert [row["condition"] for row in rows] == ["pooled", "pooled"]
    assert rows[1]["tested"] == 2 * 3 * (1 + 15)


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What a curve asks of an evaluation."""
    asked: list[dict[str, Any]] = []

    def evaluate(classifiers: Any, conditions: Any, **options: Any) -> Any:
        asked.append({"conditions": conditions, **options})
        return SimpleNamespace(scores=lambda: [{"condition": "one", "accuracy": 1.0}])

    monkeypatch.setattr(harness, "evaluate", evaluate)
    return asked


def test_a_curve_passes_seed_and_sizes_to_evaluations(evaluated: list[dict[str, Any]], make_touches: Maker):
    records = [make_touches(each=n, name=f"of{n}") for n in (4, 6)]
    rows = learning_curve(["x"], records, sizes=(2, 3, 4), repeats=7, seed=5)
    assert [row["train_per_class"] for row in rows] == [2, 3]
    assert [(a["train_per_class"], a["seed"], a["repeats"]) for a in evaluated] == [(2, 5, 7), (3, 5, 7)]
    evaluated.clear()
    short = [cut_at(records[0], 3.0), records[1]]
    rows = contact_time_curve(["x"], short, times=(1.0, 3.0, 5.0), seed=6, train_per_class=2)
    assert [row["contact_s"] for row in rows] == [1.0, 3.0]  # the shortest record says how long
    assert [[round(float(g["time"].values[-1]), 6) for g in a["conditions"]] for a in evaluated] == [
        [1.0, 1.0],
        [3.0, 3.0],
    ]
    assert [(a["train_per_class"], a["seed"]) for a in evaluated] == [(2, 6), (2, 6)]


def test_two_touches_of_a_block_are_one_to_train_with(evaluated: list[dict[str, Any]], make_touches: Maker):
    grasps = make_touches(each=6)
    n = grasps.sizes["grasp"]
    pairs = grasps.assign(touch_group=("grasp", np.array([f"block {k // 2}" for k in range(n)])))
    pairs = pairs.assign(touch=("grasp", np.arange(n) % 2 + 1))
    with pytest.raises(UserError, match="3 grasps of a material leave none to test"):
        learning_curve(["x"], [pairs], sizes=(3, 5))
    assert learning_curve(["x"], [pairs], sizes=(2, 3, 5))[0]["train_per_class"] == 2


def test_what_is_scored_apart_is_no_point_of_a_curve_of_differences(make_touches: Maker):
    grasps = make_touches(t_object=43.0, name="warm")
    row = {"condition": "warm", "materials": 3, "classifier": "x", "accuracy": 1.0}
    found: Any = SimpleNamespace(
        scores=lambda: [row | {"apart": apart} for apart in (False, True)], classifiers=["x"]
    )
    assert [r["apart"] for r in difference_curve(found, [grasps])] == [False]
