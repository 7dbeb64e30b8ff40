"""Curves: what is varied is varied, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify import evaluate
from thermogrip.classify.evaluation.curves import contact_time_curve, cut_at, difference_curve, learning_curve
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


def test_of_several_records_one_row_stands_for_all_and_the_smallest_says_what_is_left(
    make_touches: Maker,
) -> None:
    records = [make_touches(each=n, name=f"of{n}", noise=0.3, seed=n) for n in (6, 20)]
    rows = learning_curve(["pca-lda"], records, sizes=(2, 5, 6, 10), repeats=2)
    assert [row["train_per_class"] for row in rows] == [2, 5]
    assert [row["condition"] for row in rows] == ["pooled", "pooled"]
    assert rows[1]["tested"] == 2 * 3 * (1 + 15)
