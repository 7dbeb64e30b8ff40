"""Value, slope and curvature are those of the trace; the pool trusts whom held-out grasps trust."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.local_polynomials import (
    POOLS,
    ExpansionClassifier,
    Pool,
    _expanded,
    _Gaussians,
    chosen_weights,
    mixture_weights,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps

Maker = Callable[..., Grasps]


def test_a_cubic_is_its_own_expansion() -> None:
    t = np.arange(0.0, 2.01, 0.1)
    u = 1 + 2 * (t - 2.0) / 1.5
    truth = np.array([0.3, -1.0, 0.5, 0.2])
    trace = np.polynomial.legendre.legval(u, truth)
    got = _expanded(np.hstack([trace, 22.0])[None, :], times=t, sensors=1, window=1.5, degree=3)
    np.testing.assert_allclose(got, [[*truth, 22.0]], atol=1e-12)


def test_what_lies_before_the_window_is_not_read() -> None:
    t = np.arange(0.0, 2.01, 0.1)
    row = np.hstack([np.sin(t), 22.0])[None, :]
    other = np.where(np.arange(22) < 9, 99.0, row)  # up to 0.8 s
    how = {"times": t, "sensors": 1, "window": 1.0, "degree": 3}
    np.testing.assert_array_equal(_expanded(row, **how), _expanded(other, **how))


def test_the_mixture_beats_its_best_member_where_they_are_right_in_turn() -> None:
    rng = np.random.default_rng(0)
    good = rng.random((2, 400)) < 0.5
    said = np.where(good, 0.9, 0.3)
    weights = mixture_weights(said)
    assert weights.sum() == pytest.approx(1.0)
    assert weights == pytest.approx([0.5, 0.5], abs=0.1)
    assert np.log(weights @ said).mean() > np.log(said).mean(axis=1).max()


def test_one_round_shares_each_grasp_by_who_said_it_and_adds_one_for_all() -> None:
    said = np.array([[0.8, 0.2, 0.5], [0.2, 0.6, 0.5]])  # the first has 0.8, 0.25 and 0.5 of them
    np.testing.assert_allclose(mixture_weights(said, rounds=1), [(1.55 + 0.5) / 4, (1.45 + 0.5) / 4])
    np.testing.assert_array_equal(mixture_weights(said), mixture_weights(said, rounds=200))
    assert np.abs(mixture_weights(said, rounds=3) - mixture_weights(said)).max() > 1e-3


def test_covariances_are_drawn_towards_the_common_one_as_if_by_so_many_grasps() -> None:
    rng = np.random.default_rng(4)
    rows, labels = rng.standard_normal((9, 2)) * [1.0, 3.0], np.array(list("xyxxyzyxz"))
    own = {c: np.cov(rows[labels == c].T) * (np.sum(labels == c) - 1) for c in "xyz"}
    common = (sum(own.values()) + 3.0 * 1e-3 * np.eye(2)) / (9 - 3 + 3.0)
    log_p = [
        multivariate_normal.logpdf(
            rows, rows[labels == c].mean(axis=0), (own[c] + 3.0 * common) / (np.sum(labels == c) - 1 + 3.0)
        )
        for c in "xyz"
    ]
    expected = np.exp(log_p - np.logaddexp.reduce(log_p)).T
    np.testing.assert_allclose(_Gaussians(3.0).fit(rows, labels).predict_proba(rows), expected)


def test_a_machine_that_is_sure_and_wrong_is_left_alone() -> None:
    said = np.vstack([np.full(40, 0.6), np.where(np.arange(40) % 4 == 0, 1e-6, 1.0)])
    assert mixture_weights(said)[0] > 0.4  # a plain mean of log losses would say the same, more sharply


def test_held_out_folds_decide_between_the_mixture_and_its_best_machine() -> None:
    rng = np.random.default_rng(1)
    folds = np.array_split(np.arange(200), 5)
    in_turn = np.where(rng.random((2, 200)) < 0.5, 0.9, 0.3)
    np.testing.assert_array_equal(chosen_weights(in_turn, folds), mixture_weights(in_turn))
    one_knows = np.vstack([np.full(200, 0.3), np.full(200, 0.98)])
    assert chosen_weights(one_knows, folds).tolist() == [0.0, 1.0]
    assert 0 < chosen_weights(one_knows, [])[0] < 0.1  # nothing held out: the mixture


def test_the_rule_is_evaluated_on_the_fold_that_its_weights_have_not_seen() -> None:
    """Each of five machines knows one fold by heart: their mixture says nothing of a fold that is new."""
    folds = np.array_split(np.arange(50), 5)
    said = np.full((6, 50), 0.01)
    said[5] = 0.2
    for k, fold in enumerate(folds):
        said[k, fold] = 1.0
    mixture = mixture_weights(said)
    assert np.log(mixture @ said).mean() > np.log(0.2)  # on all that it was made from it would win
    assert chosen_weights(said, folds).tolist() == [0.0] * 5 + [1.0]


def test_a_pool_says_what_is_tried(make_touches: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(POOLS, "tiny", Pool((1.0, 2.0), (2, 7), (4,), (0.1, 1.0), (10.0,)))
    model = ExpansionClassifier(pool="tiny", rule="nested").fit(make_touches(each=4, step=0.25))
    # two logistic, two Gaussian machines; 1 s holds 4 samples, too few for degree 7
    assert len(model.weights_) == 4 * (2 + 1 + 1)
    fresh = make_touches(seed=5, step=0.25)
    assert np.mean(model.predict(fresh) == fresh["material"].values) > 0.9
    tried = {name: (pool.windows, pool.degrees) for name, pool in POOLS.items() if name != "tiny"}
    assert tried == {
        "small": ((1.0, 1.5, 2.5, 4.5), (3, 5)),
        "wide": ((0.5, 1.0, 2.0, 4.0), (2, 3, 4, 5, 6)),
    }
    tuned = {name: (pool.components, pool.strengths, pool.pulls) for name, pool in POOLS.items()}
    assert tuned["small"] == ((6, 12), (3.0,), (10.0,))
    assert tuned["wide"] == ((4, 8, 12, 16), (0.1, 1.0, 10.0), (3.0, 10.0, 30.0))
    with pytest.raises(UserError, match="no pool 'huge'"):
        ExpansionClassifier(pool="huge").fit(fresh)


def test_two_sensors_say_what_one_cannot(make_touches: Maker) -> None:
    """Material or object temperature: one sensor sees their product, two at different levels see both."""
    rng = np.random.default_rng(0)
    t = np.arange(-1.0, 4.01, 0.1)
    share = np.where(np.arange(60) % 2 == 0, 0.5, 0.25)
    t_object = rng.uniform(5.0, 15.0, 60)
    rise = -np.expm1(-np.maximum(t, 0))
    both = [
        b + (share * (t_object - b))[:, None] * rise + 0.02 * rng.standard_normal((60, t.size))
        for b in (30.0, 20.0)
    ]
    labels = np.where(share == 0.5, "iron", "wood")
    one = make_grasps(t, both[0], [f"g{k}" for k in range(60)], material=labels)
    two = one.assign(t_surface_2=(("grasp", "time"), both[1], one["t_surface"].attrs))
    right = []
    for grasps in (one, two):
        model = make_classifier("expansions").fit(pick(grasps, np.arange(40)))
        right.append(np.mean(model.predict(pick(grasps, np.arange(40, 60))) == labels[40:]))
    assert right[1] == 1.0
    assert right[0] <= right[1]


def test_one_grasp_a_material_is_enough_to_answer(three: Grasps) -> None:
    model = make_classifier("expansions").fit(pick(three, [0, 8, 16]))
    assert np.unique(list(model.weights_.values())).size == 1
    assert np.isfinite(model.predict_log_proba(three)).all()
    assert make_classifier("expansions").fit(pick(three, [0, 1, 8, 9, 16])).predict(three).size == 24


def test_a_trace_too_short_to_bend_is_read_by_components_alone() -> None:
    traces = np.outer([1.0, 1.1, 3.0, 3.1, 0.9, 2.9], [0.0, 0.5, 0.8])
    grasps = make_grasps(np.arange(3) * 0.1, traces, list("abcdef"), material=list("xxyyxy"))
    model = make_classifier("expansions").fit(grasps)
    assert all(name.endswith("components") for name in model.weights_)
    assert model.predict(grasps).tolist() == list("xxyyxy")
