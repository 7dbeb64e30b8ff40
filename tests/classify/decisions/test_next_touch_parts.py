"""Curves and the next touch on made-up readings: what is weighed, at which price, of which records."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from thermogrip.classify.decisions import next_touch
from thermogrip.classify.decisions.next_touch import NextTouch, advise_touches, choose_next_touch
from thermogrip.classify.evaluation import curves
from thermogrip.classify.evaluation.curves import contact_time_curve, cut_at, difference_curve, learning_curve
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

Maker = Callable[..., Grasps]


class PosteriorPredictive(NamedTuple):
    log_p: Any


def made_up(monkeypatch: pytest.MonkeyPatch, gain: list[float], information: list[float]) -> list[Any]:
    """Let a touch gain so much at each temperature; return the probabilities that it was weighed with."""
    weighed: list[Any] = []
    model = SimpleNamespace(
        classes_=["a", "b"],
        device_=None,
        coupling_=None,
        finish=None,
        log_prior=lambda names: np.log([0.8, 0.2]),
        _check_candidates=lambda names: None,
    )
    said = np.array(gain)

    def expected(outlook: PosteriorPredictive, **options: Any) -> Any:
        weighed.append(np.exp(outlook.log_p))
        return SimpleNamespace(information=np.array(information), accuracy=0.6 + said, gain=said)

    monkeypatch.setattr(next_touch, "with_model", lambda classifier: model)
    monkeypatch.setattr(next_touch, "expected_information", expected)
    monkeypatch.setattr(
        "thermogrip.sysid.effusivity.predictive.next_touch",
        lambda *a, **o: PosteriorPredictive(np.log([[0.25, 0.75], [0.5, 0.5]])),
    )
    return weighed


def test_a_touch_is_worth_what_it_gains_less_the_price_of_its_seconds(monkeypatch: pytest.MonkeyPatch):
    weighed = made_up(monkeypatch, [0.1, 0.2, 0.3], [0.0, 0.1, 0.2])
    found = choose_next_touch(
        None, None, t_gripper=[20.0, 30.0, 40.0], price=0.002, rest=30.0, end=5.0,  # type: ignore[arg-type]
        seconds=lambda there: 4.0 * (there - 20.0),
    )  # fmt: skip
    assert found.seconds.tolist() == [35.0, 45.0, 85.0]  # the rest passes while it warms
    np.testing.assert_allclose(found.value, [0.1 - 0.07, 0.2 - 0.09, 0.3 - 0.17])
    assert found.best == 40.0
    # what was known before the touches counts: 0.25 x 0.8 against 0.75 x 0.2
    np.testing.assert_allclose(weighed[0][0], [4 / 7, 3 / 7])
    assert found.accuracy_now == pytest.approx(4 / 7)
    assert found.entropy == pytest.approx(-np.sum(weighed[0][0] * np.log(weighed[0][0])))


def test_of_touches_worth_as_much_the_one_that_tells_more_is_best():
    same = {"accuracy": np.full(3, 0.5), "seconds": np.ones(3), "entropy": 1.0, "accuracy_now": 0.5}
    levels, value = np.array([20.0, 30.0, 40.0]), np.array([0.1, 0.3, 0.3])
    touch = NextTouch(t_gripper=levels, information=np.array([0.9, 0.2, 0.4]), value=value, **same)
    assert (touch.best, touch.worth_it) == (40.0, True)
    none = NextTouch(t_gripper=levels, information=np.zeros(3), value=np.zeros(3), **same)
    assert not none.worth_it  # to gain nothing is not to gain


def test_advice_goes_to_every_touch_of_a_block_at_the_price_asked_for(
    monkeypatch: pytest.MonkeyPatch, make_touches: Maker
):
    grasps = make_touches(each=2)
    asked: list[dict[str, Any]] = []

    def choose(classifier: Any, block: Grasps, **options: Any) -> NextTouch:
        asked.append(options)
        value = np.array([0.1, 0.2]) if len(asked) % 2 else np.array([-0.1, -0.2])
        return NextTouch(
            np.array([20.0, 30.0]), np.ones(2), np.array([0.9, 0.7]), np.ones(2), value, 1.0, 0.55
        )

    monkeypatch.setattr(next_touch, "choose_next_touch", choose)
    rows = advise_touches(None, grasps, candidates=["a"], price=0.03)  # type: ignore[arg-type]
    assert len(rows) == grasps.sizes["grasp"] == len(asked)
    assert all(options == {"candidates": ["a"], "price": 0.03} for options in asked)
    # of the touch that is best, and not of the one that would be right most often
    assert rows[0] == {"next_touch_degC": 30.0, "next_touch_accuracy": 0.7}
    assert rows[1] == {"next_touch_degC": None, "next_touch_accuracy": 0.55}


# ---- curves ----


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What a curve asks of an evaluation."""
    asked: list[dict[str, Any]] = []

    def evaluate(classifiers: Any, conditions: Any, **options: Any) -> Any:
        asked.append({"conditions": conditions, **options})
        return SimpleNamespace(scores=lambda: [{"condition": "one", "accuracy": 1.0}])

    monkeypatch.setattr(curves, "evaluate", evaluate)
    return asked


def test_a_curve_takes_its_seed_and_its_sizes_to_every_evaluation(
    evaluated: list[dict[str, Any]], make_touches: Maker
):
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
