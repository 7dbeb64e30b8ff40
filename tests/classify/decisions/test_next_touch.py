"""Decisions: expected information, whether to touch again and at which cost, and when to answer unknown."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from thermogrip.classify import choose_next_touch, make_classifier
from thermogrip.classify.decisions import next_touch
from thermogrip.classify.decisions.next_touch import NextTouch, advise_touches, entropy, expected_information
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.predictive import PosteriorPredictive


@pytest.fixture(scope="module")
def touched() -> Grasps:
    """A copper block of unknown temperature, touched once at 40 degC."""
    return load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[24])


@pytest.mark.parametrize(
    ("odds", "distance", "sd"), [(0.5, 0.5, 1.0), (0.5, 1.0, 1.0), (0.5, 4.0, 1.0), (0.3, 0.5, 3.0)]
)
def test_candidates_are_separated_as_their_densities_are(odds: float, distance: float, sd: float) -> None:
    """N(0, 1) against N(d, sd^2): everything by quadrature over the reading."""
    y = np.linspace(-40, 40, 80_001)
    joint = np.stack([odds * norm.pdf(y), (1 - odds) * norm.pdf(y, distance, sd)], axis=1)
    total = joint.sum(axis=1)
    accuracy = np.trapezoid(joint.max(axis=1), y)
    with np.errstate(invalid="ignore"):
        after = np.nan_to_num(entropy(np.log(joint / total[:, None] + 1e-300)))
    if sd == 1.0:  # at equal odds and spreads the likelier one is right with probability Phi(d / 2)
        assert accuracy == pytest.approx(norm.cdf(distance / 2))
    log_p, spread = np.log([[odds, 1 - odds]]), np.array([[[[1.0]], [[sd**2]]]])
    forecast = PosteriorPredictive(log_p, np.array([[[0.0], [distance]]]), spread)
    found = expected_information(forecast, draws=4000)
    # 16 000 draws of a number in (0, 1): standard error below 0.004
    assert found.accuracy[0] == pytest.approx(accuracy, abs=0.015)
    assert found.gain[0] == pytest.approx(accuracy - max(odds, 1 - odds), abs=0.015)
    open_after = np.trapezoid(total * after, y)
    assert found.information[0] == pytest.approx(entropy(log_p)[0] - open_after, abs=0.015)


def test_expected_information_is_the_mean_over_the_drawn_readings() -> None:
    """One reading after another, with scipy's densities; what is less likely than 1e-4 is not drawn."""
    rng = np.random.default_rng(8)
    root = rng.standard_normal((2, 4, 2, 2))
    covariance, mean = root @ root.transpose(0, 1, 3, 2) + 0.2 * np.eye(2), rng.standard_normal((2, 4, 2))
    p = np.array([[0.6, 0.3 - 3e-4, 0.1, 3e-4], [0.2, 9e-5, 0.5, 0.3 - 9e-5]])
    found = expected_information(PosteriorPredictive(np.log(p), mean, covariance))
    half = np.random.default_rng(0).standard_normal((48, 2))
    for i in range(2):
        later, right = 0.0, 0.0
        for k in np.flatnonzero(p[i] > 1e-4):
            for z in np.concatenate([half, -half]):
                y = mean[i, k] + np.linalg.cholesky(covariance[i, k]) @ z
                q = p[i] * [multivariate_normal.pdf(y, mean[i, j], covariance[i, j]) for j in range(4)]
                q /= q.sum()
                later -= p[i, k] * np.sum(q * np.log(q)) / 96
                right += p[i, k] * (q.max() - q[p[i].argmax()]) / 96
        assert found.information[i] == pytest.approx(-np.sum(p[i] * np.log(p[i])) - later)
        assert found.gain[i] == pytest.approx(right)
        assert found.accuracy[i] == pytest.approx(p[i].max() + right)
    nothing = expected_information(PosteriorPredictive(np.log(p), mean[..., :0], covariance[..., :0, :0]))
    assert [list(v) for v in nothing] == [[0, 0], [0.6, 0.5], [0, 0]]


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 5), st.integers(1, 4), st.integers(0, 10_000))
def test_readings_never_cost_accuracy_nor_add_more_than_is_missing(m: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((1, m, width, width))
    log_p = np.log(rng.dirichlet(np.ones(m))[None])
    covariance = root @ root.transpose(0, 1, 3, 2) + 0.1 * np.eye(width)
    found = expected_information(PosteriorPredictive(log_p, rng.standard_normal((1, m, width)), covariance))
    assert 0 <= found.information[0] <= entropy(log_p)[0] + 1e-9
    assert found.gain[0] >= 0
    assert found.accuracy[0] <= 1 + 1e-9


def test_the_second_touch_is_asked_far_from_the_first(known: PosteriorClassifier, touched: Grasps) -> None:
    choice = choose_next_touch(known, touched, t_gripper=[15.0, 25.0, 35.0, 40.0])
    assert choice.best == 15.0
    assert np.all(np.diff(choice.information[:3]) < 0)  # towards the block's own temperature, near 37 degC
    assert choice.worth_it
    assert choice.entropy > choice.information.max()


def test_a_slow_gripper_asks_nearer(known: PosteriorClassifier, touched: Grasps) -> None:
    """Reaching 15 degC takes long at 0.02 K/s; a dearer second moves the choice to where it is already."""
    slow = lambda there: abs(there - 22.0) / 0.02  # noqa: E731
    fast = choose_next_touch(known, touched, t_gripper=[15.0, 22.0], price=0.0)
    dear = choose_next_touch(known, touched, t_gripper=[15.0, 22.0], price=0.002, seconds=slow)
    assert (fast.best, dear.best) == (15.0, 22.0)
    assert not choose_next_touch(known, touched, t_gripper=[15.0, 25.0], price=0.1).worth_it


def test_values_that_tie_go_to_the_most_information() -> None:
    two = np.array([1.0, 2.0])
    choice = NextTouch(
        t_gripper=np.array([20.0, 30.0]), information=two, accuracy=two, seconds=two, value=np.zeros(2),
        entropy=1.0, accuracy_now=0.5,
    )  # fmt: skip
    assert choice.best == 30.0
    assert not choice.worth_it
    assert choice.to_dict() == {
        "t_gripper": [20.0, 30.0], "information": [1.0, 2.0], "accuracy": [1.0, 2.0], "seconds": [1.0, 2.0],
        "value": [0.0, 0.0], "entropy": 1.0, "accuracy_now": 0.5, "best": 30.0, "worth_it": False,
    }  # fmt: skip


Maker = Callable[..., Grasps]


class Forecast(NamedTuple):
    log_p: Any


def made_up(monkeypatch: pytest.MonkeyPatch, gain: list[float], information: list[float]) -> list[Any]:
    """Let a touch gain so much at each temperature; return the probabilities that it was weighed with."""
    weighed: list[Any] = []
    model = SimpleNamespace(
        device_=None, coupling_=None, as_taught="known",
        log_prior=lambda names: np.log([0.8, 0.2]), asked=lambda names: ["a", "b"],
    )  # fmt: skip
    said = np.array(gain)

    def expected(forecast: Forecast, **options: Any) -> Any:
        weighed.append(np.exp(forecast.log_p))
        return SimpleNamespace(information=np.array(information), accuracy=0.6 + said, gain=said)

    monkeypatch.setattr(next_touch, "with_model", lambda classifier: model)
    monkeypatch.setattr(next_touch, "expected_information", expected)
    monkeypatch.setattr(
        "thermogrip.classify.decisions.next_touch.next_touch",
        lambda *a, **o: Forecast(np.log([[0.25, 0.75], [0.5, 0.5]])),
    )
    return weighed


def test_a_touch_is_worth_what_it_gains_less_the_cost_of_its_seconds(monkeypatch: pytest.MonkeyPatch):
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
    plain = choose_next_touch(None, None, t_gripper=[20.0, 30.0, 40.0])  # type: ignore[arg-type]
    np.testing.assert_allclose(plain.value, [0.03, 0.13, 0.23])  # 60 s of rest, 10 s of touch
    assert plain.seconds.tolist() == [70.0] * 3
    every = choose_next_touch(None, None, t_gripper=20.0, price=0.0)  # type: ignore[arg-type]
    assert every.t_gripper.tolist() == [20.0]
    assert next_touch.TEMPERATURES == (
        12.5, 15.0, 17.5, 20.0, 22.5, 25.0, 27.5, 30.0, 32.5, 35.0, 37.5, 40.0, 42.5, 45.0, 47.5, 50.0
    )  # fmt: skip


def test_advice_goes_to_every_touch_at_the_given_cost_per_second(
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
    asked.clear()
    grasps["t_surface"].values[2] = 23.0  # a skin that does not move, 20 K from its block
    told: list[tuple[float, str]] = []
    paired = grasps.assign(touch_group=("grasp", ["b", "b", "c", "d", "d", "d"]))
    rows = advise_touches(None, paired, progress=lambda *at: told.append(at))  # type: ignore[arg-type]
    assert asked == [{"candidates": None, "price": 0.001}] * 2
    assert rows[2] == {"next_touch_degC": None, "next_touch_accuracy": None}
    assert [row["next_touch_degC"] for row in rows] == [30.0, 30.0, None, None, None, None]
    assert told == [(k / 3, f"another touch of {name}") for k, name in enumerate("bcd")]


def test_what_has_no_model_is_refused(known: PosteriorClassifier, touched: Grasps) -> None:
    with pytest.raises(UserError, match="cannot predict readings"):
        choose_next_touch(make_classifier("pca-lda"), touched)
    for wrong in ({"t_gripper": [np.nan]}, {"t_gripper": []}, {"price": -1e-9}, {"price": np.inf}):
        with pytest.raises(UserError, match="is no number"):
            choose_next_touch(known, touched, **wrong)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="'goldd' is no class"):
        choose_next_touch(known, touched, candidates=["goldd", "iron"])
