"""The predictions table: what stands in predictions.csv."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import classify_grasps, make_classifier, write_predictions
from thermogrip.classify.decisions.stopping_rule import StopRule
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps


def test_the_table_has_the_columns_of_its_contract(three: Grasps, tmp_path: Path) -> None:
    model = make_classifier("bayes").fit(three)
    path = write_predictions(classify_grasps(model, three), tmp_path / "predictions.csv")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "grasp_id",
        "material",
        "p_copper",
        "p_iron",
        "p_wood",
        "p_unknown",
        "decided_at_s",
    ]
    p = np.array([[float(r[f"p_{m}"]) for m in ("copper", "iron", "wood")] for r in rows])
    np.testing.assert_allclose(p.sum(axis=1), 1.0, atol=2e-6)
    assert [r["material"] for r in rows] == model.predict(three).tolist()
    assert {r["p_unknown"] for r in rows} == {""}
    assert {r["decided_at_s"] for r in rows} == {"10"}


def test_candidates_are_asked_for_by_name(three: Grasps) -> None:
    model = make_classifier("bayes").fit(three)
    rows = classify_grasps(model, three, ["wood", "copper"])
    assert {r["material"] for r in rows} == {"wood", "copper"}
    assert "p_iron" not in rows[0]
    with pytest.raises(UserError, match="named twice"):
        classify_grasps(model, three, ["wood", "wood"])
    with pytest.raises(UserError, match="'gold' is no class"):
        classify_grasps(model, three, ["gold"])
    with pytest.raises(UserError, match="no candidate"):
        classify_grasps(model, three, [])


def test_two_touches_multiply_and_share_the_answer(three: Grasps) -> None:
    model = make_classifier("bayes").fit(three)
    paired = three.assign(touch_group=("grasp", [f"p{i // 2}" for i in range(24)]))
    alone, both = model.predict_proba(three), classify_grasps(model, paired)
    product = alone[0] * alone[1]
    got = [[r[f"p_{m}"] for m in ("copper", "iron", "wood")] for r in both[:2]]
    np.testing.assert_allclose(got, [product / product.sum()] * 2, rtol=1e-9)


def test_the_decision_time_is_the_last_sample_that_was_seen(
    three: Grasps, make_touches: Callable[..., Grasps]
) -> None:
    model = make_classifier("bayes").fit(three)
    cut = make_touches(seed=3)
    cut["t_surface"].values[0, cut["time"].values > 9.65] = np.nan
    times = [r["decided_at_s"] for r in classify_grasps(model, cut)]
    assert times[0] == pytest.approx(9.6)
    assert times[1] == pytest.approx(10.0)


@pytest.mark.parametrize(("gain", "asked"), [(0.0, False), (1e-6, True)])
def test_what_more_contact_would_bring_is_worked_out_only_for_a_rule_that_asks(
    gain: float, asked: bool, three: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Seen(Exception):
        pass

    def windows(*_: object, gain: bool, **__: object) -> None:
        raise Seen(gain)

    monkeypatch.setattr("thermogrip.classify.decisions.stopping_rule.growing_windows", windows)
    with pytest.raises(Seen) as seen:
        classify_grasps(make_classifier("bayes").fit(three), three, rule=StopRule(sure=0.99, gain=gain))
    assert seen.value.args == (asked,)
