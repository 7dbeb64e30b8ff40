"""Decisions: what readings are expected to tell, whether to touch again, and when to say "unknown"."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from thermogrip.classify import Costs, choose_next_touch, make_classifier, name_or_unknown
from thermogrip.classify.decisions.expected_information import entropy, expected_information
from thermogrip.classify.decisions.next_touch import NextTouch, at_rates
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.predictive import PosteriorPredictive


@pytest.fixture(scope="module")
def known() -> PosteriorClassifier:
    return PosteriorClassifier().with_device(load_default_gripper())


@pytest.fixture(scope="module")
def touched() -> Grasps:
    """A copper block of unknown temperature, touched once at 40 degC."""
    return load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[24])


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0, 4.0])
def test_two_normals_are_told_apart_as_often_as_their_overlap_allows(distance: float) -> None:
    """Equal odds, N(0, 1) against N(d, 1): the likelier one is right with probability Phi(d / 2)."""
    outlook = PosteriorPredictive(
        np.log([[0.5, 0.5]]), np.array([[[0.0], [distance]]]), np.ones((1, 2, 1, 1))
    )
    found = expected_information(outlook, draws=4000)
    # 16 000 draws of a number in (0, 1): standard error below 0.004
    assert found.accuracy[0] == pytest.approx(norm.cdf(distance / 2), abs=0.015)
    y = np.linspace(-8, 8 + distance, 4001)
    p, q = norm.pdf(y), norm.pdf(y - distance)
    after = entropy(np.log(np.stack([p, q], axis=1) / (p + q)[:, None] + 1e-300))
    information = np.log(2) - np.trapezoid(0.5 * (p + q) * after, y)
    assert found.information[0] == pytest.approx(information, abs=0.015)


def test_a_sharp_and_a_blurred_candidate_are_told_apart_as_their_densities_say() -> None:
    """Odds 3 to 7, N(0, 1) against N(0.5, 3^2): everything by quadrature over the reading."""
    y = np.linspace(-40, 40, 80_001)
    joint = np.stack([0.3 * norm.pdf(y), 0.7 * norm.pdf(y, 0.5, 3.0)], axis=1)
    total = joint.sum(axis=1)
    accuracy = np.trapezoid(joint.max(axis=1), y)
    open_after = np.trapezoid(total * entropy(np.log(joint / total[:, None] + 1e-300)), y)
    spread = np.array([[[[1.0]], [[9.0]]]])
    outlook = PosteriorPredictive(np.log([[0.3, 0.7]]), np.array([[[0.0], [0.5]]]), spread)
    found = expected_information(outlook, draws=4000)
    assert found.accuracy[0] == pytest.approx(accuracy, abs=0.015)
    assert found.gain[0] == pytest.approx(accuracy - 0.7, abs=0.015)
    assert found.information[0] == pytest.approx(entropy(np.log([0.3, 0.7])) - open_after, abs=0.015)


def test_each_draw_is_used_with_both_signs_so_that_a_mirror_image_tells_as_much() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 4, 2, 2))
    covariance, mean = root @ root.transpose(0, 1, 3, 2) + 0.1 * np.eye(2), rng.standard_normal((3, 4, 2))
    log_p = np.log(rng.dirichlet(np.ones(4), 3))
    found, mirrored = (
        expected_information(PosteriorPredictive(log_p, m, covariance), draws=5) for m in (mean, -mean)
    )
    np.testing.assert_allclose(mirrored, found, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 5), st.integers(1, 4), st.integers(0, 10_000))
def test_readings_never_cost_accuracy_nor_tell_more_than_is_open(m: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((1, m, width, width))
    log_p = np.log(rng.dirichlet(np.ones(m))[None])
    covariance = root @ root.transpose(0, 1, 3, 2) + 0.1 * np.eye(width)
    found = expected_information(PosteriorPredictive(log_p, rng.standard_normal((1, m, width)), covariance))
    assert 0 <= found.information[0] <= entropy(log_p)[0] + 1e-9
    assert found.gain[0] >= 0
    assert found.accuracy[0] <= 1 + 1e-9


def test_unknown_is_said_where_it_is_the_cheaper_mistake() -> None:
    names, p = ["iron", "wood"], [[0.95, 0.05], [0.55, 0.45], [0.95, 0.05]]
    outside = [0.02, 0.02, 0.6]
    assert name_or_unknown(p, outside, names).tolist() == ["iron", "iron", "unknown"]
    # a rejection that costs little is used where the candidates are alike, too
    careful = Costs(rejected=0.3)
    assert name_or_unknown(p, outside, names, costs=careful).tolist() == ["iron", "unknown", "unknown"]
    bold = Costs(rejected=1e6)
    assert name_or_unknown(p, outside, names, costs=bold).tolist() == ["iron"] * 3
    with pytest.raises(UserError, match="p_unknown is missing"):
        name_or_unknown(p, [np.nan, 0.0, 0.0], names)
    for none in ({"missed": 0.0}, {"rejected": 0.0}, {"rejected": -1.0}):
        with pytest.raises(UserError, match="not positive"):
            Costs(**none)


@pytest.mark.parametrize(("likeliest", "answer"), [(0.6, "unknown"), (0.8, "iron")])
def test_costs_are_expected_over_strangers_and_candidates(likeliest: float, answer: str) -> None:
    # a stranger in 3 of 10: naming costs 0.3 + 0.7 (1 - p), 0.58 or 0.44; unknown 0.7 x 0.75 = 0.525
    costs = Costs(missed=1.0, rejected=0.75)
    said = name_or_unknown([[likeliest, 1 - likeliest]], [0.3], ["iron", "wood"], costs=costs)
    assert said.tolist() == [answer]


@given(
    st.lists(st.floats(0.01, 1.0), min_size=2, max_size=4),
    st.floats(0.0, 1.0),
    st.floats(0.05, 3.0),
    st.floats(0.05, 3.0),
)
def test_the_answer_is_the_one_of_the_least_expected_cost(
    share: list[float], outside: float, rejected: float, missed: float
) -> None:
    p = np.array(share) / np.sum(share)
    names = [f"m{k}" for k in range(p.size)]
    costs = {name: outside * missed + (1 - outside) * (1 - q) for name, q in zip(names, p)}
    costs["unknown"] = (1 - outside) * rejected
    said = name_or_unknown([p], [outside], names, costs=Costs(rejected=rejected, missed=missed))[0]
    assert costs[said] <= min(costs.values()) + 1e-12


def test_a_grasp_without_an_answer_is_unknown_whatever_that_costs() -> None:
    nothing = [[np.nan, np.nan], [0.9, 0.1]]
    said = name_or_unknown(nothing, [np.nan, 0.0], ["a", "b"], costs=Costs(rejected=1e6))
    assert said.tolist() == ["unknown", "a"]


def test_without_strangers_the_rule_is_chows() -> None:
    """Answer where 1 - max p is below the cost of not answering."""
    p = np.stack([np.linspace(0.5, 1.0, 21), 1 - np.linspace(0.5, 1.0, 21)], axis=1)
    said = name_or_unknown(p, np.zeros(21), ["a", "b"], costs=Costs(rejected=0.2)) != "unknown"
    np.testing.assert_array_equal(said, 1 - p.max(axis=1) <= 0.2)


def test_the_second_touch_is_asked_far_from_the_first(known: PosteriorClassifier, touched: Grasps) -> None:
    choice = choose_next_touch(known, touched, t_gripper=[15.0, 25.0, 35.0, 40.0])
    assert choice.best == 15.0
    assert np.all(np.diff(choice.information[:3]) < 0)  # towards the block's own temperature, near 37 degC
    assert choice.worth_it
    assert choice.entropy > choice.information.max()


def test_a_touch_that_costs_more_than_a_right_answer_is_not_worth_it(
    known: PosteriorClassifier, touched: Grasps
) -> None:
    choice = choose_next_touch(known, touched, t_gripper=[15.0, 25.0], price=0.1)
    assert not choice.worth_it
    np.testing.assert_allclose(choice.seconds, 70.0)  # a minute of rest and ten seconds


def test_a_slow_gripper_asks_nearer(known: PosteriorClassifier, touched: Grasps) -> None:
    """Reaching 15 degC takes long at 0.02 K/s; a dearer second moves the choice to where it is already."""
    slow = at_rates(22.0, heating=0.02, cooling=0.02)
    fast = choose_next_touch(known, touched, t_gripper=[15.0, 22.0], price=0.0)
    dear = choose_next_touch(known, touched, t_gripper=[15.0, 22.0], price=0.002, seconds=slow)
    assert (fast.best, dear.best) == (15.0, 22.0)
    with pytest.raises(UserError, match="rate is not positive"):
        at_rates(20.0, heating=0.0, cooling=1.0)


def test_the_rest_is_waited_for_only_while_the_gripper_is_not_on_its_way(
    known: PosteriorClassifier, touched: Grasps
) -> None:
    slow = at_rates(22.0, heating=0.2, cooling=0.05)
    choice = choose_next_touch(
        known, touched, t_gripper=[15.0, 21.0, 25.0, 40.0], price=0.001, seconds=slow, rest=60.0, end=5.0
    )
    assert choice.seconds.tolist() == [140.0 + 5.0, 65.0, 65.0, 90.0 + 5.0]
    plain = choose_next_touch(known, touched, t_gripper=[15.0, 21.0, 25.0, 40.0], price=0.0, end=5.0)
    np.testing.assert_allclose(choice.value, plain.value - 0.001 * choice.seconds)
    np.testing.assert_allclose(plain.value, plain.accuracy - plain.accuracy_now, atol=1e-12)


def test_what_was_thought_likely_before_counts(known: PosteriorClassifier, touched: Grasps) -> None:
    names = ["copper", "brass"]
    odds = {"copper": 1.0, "brass": 3.0}
    device = load_default_gripper()
    plain, told = (
        choose_next_touch(model, touched, candidates=names, t_gripper=[20.0])
        for model in (known, PosteriorClassifier(priors=odds).with_device(device))
    )
    p = known.candidate_log_proba(touched, names)[0] + np.log([1.0, 3.0])
    p = np.exp(p - p.max()) / np.exp(p - p.max()).sum()
    assert told.accuracy_now == pytest.approx(p.max(), abs=0.02)
    assert told.entropy == pytest.approx(-(p * np.log(p)).sum(), abs=0.03)
    assert plain.accuracy_now != pytest.approx(told.accuracy_now, abs=0.02)


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


def test_a_classifier_that_foresees_nothing_is_refused(touched: Grasps) -> None:
    with pytest.raises(UserError, match="cannot foresee readings"):
        choose_next_touch(make_classifier("pca-lda"), touched)


def test_numbers_that_are_none_are_refused(known: PosteriorClassifier, touched: Grasps) -> None:
    with pytest.raises(UserError, match="is no number"):
        choose_next_touch(known, touched, t_gripper=[np.nan])
    with pytest.raises(UserError, match="'gold' is no class"):
        choose_next_touch(known, touched, candidates=["gold", "iron"])
