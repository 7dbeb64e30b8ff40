"""The effusivity-posterior classifier on the example grasps, and asked about another gripper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from thermogrip.classify import classify_grasps, load_classifier, make_classifier, save_classifier
from thermogrip.classify.estimators import posterior as estimator
from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.data import KNOTS, Touches, touches
from thermogrip.sysid.effusivity.gripper_model import (
    Discrepancy,
    GripperModel,
    GripperSpread,
    another_gripper,
    load_default_gripper,
)
from thermogrip.sysid.effusivity.multi_touch import two_touch_fit
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_evidence, material_posterior
from thermogrip.sysid.effusivity.posterior_grid import free_evidence


@pytest.fixture(scope="module")
def warm() -> Grasps:
    """Gripper at 48, blocks at 28 degC: copper, iron, wood."""
    return load_example_grasps()["exp2_dT20"]


@pytest.fixture(scope="module")
def fresh(warm: Grasps) -> Grasps:
    """The nine test grasps."""
    return pick(warm, warm["split"].values == "test")


@pytest.fixture(scope="module")
def fitted(warm: Grasps) -> PosteriorClassifier:
    """Calibrated on the fifteen training grasps."""
    model = PosteriorClassifier()
    return model.fit(pick(warm, warm["split"].values == "train"))


def test_fifteen_grasps_teach_it_to_identify_the_other_nine(
    fitted: PosteriorClassifier, fresh: Grasps
) -> None:
    assert fitted.classes_.tolist() == ["copper", "iron", "wood"]
    assert np.sum(fitted.predict(fresh) == fresh["material"].values) >= 8
    p = fitted.predict_proba(fresh)
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    assert np.array_equal(fitted.predict(fresh), fitted.classes_[p.argmax(axis=1)])


def test_probabilities_are_the_evidence_times_the_prior(fitted: PosteriorClassifier, fresh: Grasps) -> None:
    evidence = material_evidence(fitted.device_, fresh, ["copper", "iron", "wood"])
    biased = clone(fitted).set_params(priors={"iron": 20.0}, gripper="same", finish="known")
    biased.device_, biased.classes_ = fitted.device_, fitted.classes_
    expected = evidence + np.log([1.0, 20.0, 1.0])
    expected -= logsumexp(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(biased.predict_log_proba(fresh), expected, atol=1e-9)


def test_candidates_come_in_the_order_asked_for(fitted: PosteriorClassifier, fresh: Grasps) -> None:
    p = fitted.predict_proba(fresh)
    q = np.exp(fitted.candidate_log_proba(fresh, ["wood", "copper"]))
    two = p[:, [2, 0]]
    seen = two.sum(axis=1) > 1e-6
    np.testing.assert_allclose(q[seen], two[seen] / two[seen].sum(axis=1, keepdims=True), atol=1e-6)
    with pytest.raises(UserError, match="'goldd' is no class"):
        fitted.candidate_log_proba(fresh, ["goldd"])


def test_a_material_of_the_table_may_be_asked_for_untrained() -> None:
    others = load_example_grasps()["exp6_other_materials_obj43_grip23"]
    glass = pick(others, others["material"].values == "glass")
    model = PosteriorClassifier().with_device(load_default_gripper())
    p = np.exp(model.candidate_log_proba(glass, ["copper", "glass", "wood"]))
    assert p[:, 1].min() > 0.9
    assert model.p_unknown(glass, ["copper", "glass", "wood"]).max() < 0.5
    assert model.p_unknown(glass, ["copper", "wood"]).min() > 0.9


def test_none_of_the_candidates_is_weighed_against_blocks_of_the_training(
    fitted: PosteriorClassifier, fresh: Grasps
) -> None:
    some = pick(fresh, [0, 3, 6])
    of_other, of_same = (
        PosteriorClassifier(finish=finish, gripper="same")
        .with_device(fitted.device_)
        .open_set_log_proba(some, ["copper", "wood"])
        for finish in ("unknown", "known")
    )
    np.testing.assert_allclose(of_other[1], of_same[1], rtol=1e-4)  # a free effusivity has their finish
    assert np.abs(of_other[0] - of_same[0]).max() > 1.0


def test_a_saved_one_predicts_the_same(fitted: PosteriorClassifier, fresh: Grasps, tmp_path: Path) -> None:
    again = load_classifier(save_classifier(fitted, tmp_path))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["classifier.json", "device.json"]
    assert np.array_equal(again.predict_log_proba(fresh), fitted.predict_log_proba(fresh))
    (tmp_path / "device.json").unlink()
    with pytest.raises(UserError, match=r"device\.json: no such file"):
        load_classifier(tmp_path)


def test_a_second_sensor_is_part_of_the_answer_where_there_is_one(fresh: Grasps, tmp_path: Path) -> None:
    device, fresh = load_default_gripper(), pick(fresh, [0, 3, 6])
    one = PosteriorClassifier().with_device(device)
    two = PosteriorClassifier().with_device(replace(device, second=device))
    bare = fresh.assign(t_object=("grasp", np.full(fresh.sizes["grasp"], np.nan)))
    both = bare.assign(t_surface_2=bare["t_surface"])
    np.testing.assert_array_equal(two.predict_log_proba(bare), one.predict_log_proba(bare))
    np.testing.assert_array_equal(one.predict_log_proba(both), one.predict_log_proba(bare))
    alone, joint = (m.predict_proba(both).max(axis=1) for m in (one, two))
    assert joint.mean() > alone.mean() + 0.04  # the same readings twice: the same answer, surer
    assert np.array_equal(one.predict(both), two.predict(both))
    again = load_classifier(save_classifier(two, tmp_path))
    np.testing.assert_array_equal(again.predict_log_proba(both), two.predict_log_proba(both))
    assert not any([*two.beyond_training(both), *one.beyond_training(bare)])
    assert set(two.beyond_training(bare)) == {
        "answered by the first sensor alone: the record has no second one"
    }
    assert set(one.beyond_training(both)) == {"the second sensor is not read: the training had one"}
    widths = [
        [row.t_object_p95 - row.t_object_p05 for row in effusivity_posterior(m.device_, both)]
        for m in (one, two)
    ]
    assert np.median(np.divide(widths[1], widths[0])) < 0.9


FIVE = ["copper", "zinc", "brass", "iron", "wood"]


def test_what_is_none_of_them_is_called_unknown() -> None:
    files, model = load_example_grasps(), PosteriorClassifier().with_device(load_default_gripper())
    others, home = files["exp6_other_materials_obj43_grip23"], files["exp1A_obj43_grip23"]
    far = np.isin(others["material"].values, ["glass", "acrylic", "rubber", "cork", "stainless"])
    outside = model.p_unknown(pick(others, far), FIVE)
    inside = model.p_unknown(pick(home, home["split"].values == "test"), FIVE)
    assert outside.min() > 0.5
    assert np.median(outside) > 0.95
    assert np.median(inside) < 0.1
    assert inside.max() < outside.min()


def test_odds_of_an_unknown_are_prior_odds_times_the_bayes_factor() -> None:
    device, record = (
        load_default_gripper(),
        load_example_grasps()["exp1A_obj43_grip23"].isel(grasp=[0, 9, 18]),
    )
    known = material_evidence(device, record, FIVE)
    free = free_evidence(device, touches(record))
    factor = np.exp(known).mean(axis=1) / np.exp(free)
    for prior, odds in ((0.25, 3.0), (0.1, 9.0)):
        model = PosteriorClassifier(prior_unknown=prior, gripper="same", finish="known").with_device(device)
        # by other points of the same density
        np.testing.assert_allclose(model.p_unknown(record, FIVE), 1 / (1 + odds * factor), atol=1e-3)


def test_a_metal_is_unknown_to_one_who_knows_only_wood(fitted: PosteriorClassifier, fresh: Grasps) -> None:
    two = pick(fresh, [0, 8])
    assert two["material"].values.tolist() == ["copper", "wood"]
    alone = fitted.p_unknown(two, ["wood"])
    assert alone[0] > 0.99
    assert alone[1] < 0.5
    rows = classify_grasps(fitted, two)
    assert all(0 <= row["p_unknown"] <= 1 for row in rows)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"finish": "shiny"}, "finish is 'shiny'; use one of auto, known, unknown"),
        ({"prior_unknown": 0.0}, "prior_unknown is 0"),
        ({"priors": {"wood": 0.0}}, "a prior is not positive"),
    ],
)
def test_a_wrong_parameter_is_refused(warm: Grasps, params: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_classifier("posterior", **params).fit(warm)


def test_labels_run_through_all_records(warm: Grasps) -> None:
    with pytest.raises(UserError, match="3 labels for 48 grasps"):
        PosteriorClassifier().fit([warm, warm.assign_attrs(name="again")], ["a", "b", "c"])
    with pytest.raises(UserError, match="all grasps are of 'copper'"):
        PosteriorClassifier().fit(warm.drop_vars("material"), ["copper"] * 24)


def test_touches_of_one_block_get_their_joint_answer(tmp_path: Path) -> None:
    """Not the product of two single answers: the touches share the temperature that nobody recorded."""
    record = load_example_grasps()["exp5_two_touch_unknown_object"]
    record = pick(record, np.isin(record["material"].values, ["brass", "iron", "wood"]))
    train, test = (
        pick(record, record["split"].values == "train"),
        pick(record, record["split"].values == "test"),
    )
    known = load_example_grasps()["exp2_dT20"]
    model = PosteriorClassifier(device=load_default_gripper()).fit([train, pick(known, slice_of(known))])
    assert model.coupling_ is not None
    names = ["brass", "iron", "wood"]
    rows = {row["grasp_id"]: row for row in classify_grasps(model, test, names)}
    fit = two_touch_fit(model.device_, test, names, coupling=model.coupling_)
    p = np.exp(fit.log_evidence - logsumexp(fit.log_evidence, axis=1, keepdims=True))
    for group, row in zip(fit.groups, p):
        for touch in ("1", "2"):
            got = [rows[f"{group}_{touch}"][f"p_{name}"] for name in names]
            np.testing.assert_allclose(got, row, atol=1e-9)
        assert rows[f"{group}_1"]["p_unknown"] == rows[f"{group}_2"]["p_unknown"]
    again = load_classifier(save_classifier(model, tmp_path))
    assert again.coupling_ == model.coupling_


def slice_of(record: Grasps) -> np.ndarray:
    """Training grasps of copper and iron, two each."""
    label, split = record["material"].values, record["split"].values
    return np.concatenate([np.flatnonzero((label == m) & (split == "train"))[:2] for m in ("copper", "iron")])


@pytest.fixture(scope="module")
def metals() -> Grasps:
    """Three grasps 20 K away: brass, copper, iron."""
    record = load_example_grasps()["exp1A_obj43_grip23"]
    rows = [int(np.flatnonzero(record["material"].values == m)[5]) for m in ("brass", "copper", "iron")]
    return pick(record, np.array(rows))


def test_answers_include_the_uncertainty_of_the_gripper(known: PosteriorClassifier, metals: Grasps) -> None:
    expected = material_posterior(another_gripper(known.device_), metals, known.classes_.tolist())
    for model in (
        known.for_another_gripper(),
        PosteriorClassifier(gripper="another").with_device(known.device_),
    ):
        np.testing.assert_allclose(model.predict_proba(metals), expected, rtol=1e-9)
    assert not known.device_.uncertain  # the one that was asked stays as it was


@pytest.fixture(scope="module")
def strange() -> Grasps:
    """Grasps by a gripper of a slower sensor under a thicker sheet, pressed less."""
    device = load_default_gripper()
    stack = replace(device.stack, lag=2.5 * device.stack.lag, z_outer=1.3 * device.stack.z_outer)
    blocks = {name: replace(block, ln_h=block.ln_h - 0.3) for name, block in device.blocks.items()}
    other = replace(device, stack=stack, blocks=blocks)
    return simulate_grasps(other.grip(), FIVE * 2, t_gripper=23.0, t_object=43.0, seed=3, **other.readings())


def test_a_record_decides_which_gripper_took_it(known: PosteriorClassifier, strange: Grasps) -> None:
    same = known.certain()
    other = known.for_another_gripper()
    decided = known.predict_proba(strange)
    np.testing.assert_allclose(decided, other.predict_proba(strange), atol=0.01)
    rows = classify_grasps(known, strange)
    assert all("another gripper" in row["note"] for row in rows)
    assert max(row["p_unknown"] for row in rows) < 0.5
    # at home each answer stays as it was, whatever grasps are with it
    home = pick(load_example_grasps()["exp1A_obj43_grip23"], range(0, 40, 4))
    np.testing.assert_allclose(known.predict_proba(home), same.predict_proba(home), atol=1e-4)
    assert not any("note" in row for row in classify_grasps(known, home))


def test_another_gripper_is_asked_about_the_grasp_that_moved_the_temperature_most(
    known: PosteriorClassifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, asked = load_example_grasps()["exp1A_obj43_grip23"], list[str]()
    fit = estimator.fit_candidates

    def counted(device: GripperModel, data: Touches, *args: Any, **options: Any) -> Any:
        if device.uncertain:
            asked.extend(data.grasp_id.tolist())
        return fit(device, data, *args, **options)

    monkeypatch.setattr(estimator, "fit_candidates", counted)
    known.predict_proba(home)
    data = touches(home)
    first = np.linspace(0, data.level.size - 1, 5).astype(int)
    order = data.grasp_id[first[np.argsort(-data.excursion[first])]].tolist()
    assert asked == order[: len(asked)]
    assert len(asked) <= 2


def test_what_a_record_decides_is_the_mixture_of_its_explanations(
    known: PosteriorClassifier, metals: Grasps
) -> None:
    """Each grasp of three by Bayes' rule, the other ones and their materials summed over."""
    some, names = pick(metals, [0, 1, 2]), ["brass", "copper"]
    levels = [
        (0.784, known.device_, "known"),
        (0.196, known.device_, "unknown"),
        (0.02, another_gripper(known.device_), "known"),
    ]
    z = [material_evidence(device, some, names, finish=finish) for _, device, finish in levels]
    free = free_evidence(known.device_, touches(some))
    top, odds = np.max(z), np.zeros((3, 2))
    sure = np.array([p * np.exp(e - top).mean(axis=1).prod() for (p, *_), e in zip(levels, z)])
    assert sure[0] / sum(sure) < 0.99  # so that a free effusivity is asked
    for (prior, device, _), e in zip(levels, z):
        own = np.exp(np.array(free) - top) * (device is known.device_)
        each = 0.9 * np.exp(e - top).mean(axis=1) + 0.1 * own
        odds += prior * (each.prod() / each)[:, None] * np.exp(e - top)
    want = odds / odds.sum(axis=1, keepdims=True)
    # the levels of a classifier are searched from each other's answers, which end within 0.005 nat
    np.testing.assert_allclose(np.exp(known.candidate_log_proba(some, names)), want, rtol=5e-3)


UNLIKE = {
    "a slip that leaves a step": lambda t, y, swing: y + 0.2 * swing * (t > 2.0),
    "a drift": lambda t, y, swing: y + 0.3 * swing * (t + 2.0) / 12.0,
    "a reading that sticks": lambda t, y, swing: np.where((t > 0.5) & (t < 3.5), y[t <= 0.5][-1], y),
    "a gain error": lambda t, y, swing: y[0] + 1.25 * (y - y[0]),
    "a heater nearby": lambda t, y, swing: y + 0.1 * swing * np.sign(np.sin(2.0 * t)),
}


@pytest.mark.parametrize("what", UNLIKE)
def test_a_grasp_unlike_the_training_is_not_named_wrong_for_certain(
    known: PosteriorClassifier, what: str
) -> None:
    record = load_example_grasps()["exp1A_obj43_grip23"]
    record = pick(record, np.flatnonzero(record["split"].values == "test")[::2])
    t, y = record["time"].values, record["t_surface"].values
    y = np.array([UNLIKE[what](t, row, np.abs(row - row[0]).max()) for row in y])
    changed = record.assign(t_surface=(("grasp", "time"), y))
    true = np.searchsorted(known.classes_, record["material"].values)
    p = np.exp([known.predict_log_proba(pick(changed, [i]))[0] for i in range(true.size)])
    assert not ((p.max(axis=1) > 0.95) & (p.argmax(axis=1) != true)).any()
    assert -np.log(p[np.arange(true.size), true]).mean() < np.log(known.classes_.size)


def test_one_block_far_from_its_stated_temperature_makes_no_other_gripper(known: PosteriorClassifier) -> None:
    """Copper at 16.3 degC, stated as 18 +- 0.36, touched 0.17 s before the message."""
    device = known.device_
    grip = replace(device.grip(), onset=-0.17, onset_sd=0.0, bias=0.0, t_object_sd=0.0)
    one = simulate_grasps(
        grip, ["copper"], t_gripper=38.0, t_object=16.3, seed=2, ambient=25.0, **device.readings()
    )
    one = one.assign(t_object=("grasp", [18.0]))
    (row,) = classify_grasps(known, one)
    assert (row["material"], "note" in row) == ("copper", False)
    assert row["p_copper"] > 0.8
    assert row["p_unknown"] < 0.1


def test_a_gripper_with_a_discrepancy_is_taken_for_no_other(known: PosteriorClassifier) -> None:
    device, n = known.device_, len(known.device_.blocks)
    odd = Discrepancy(np.zeros(KNOTS.size), np.zeros((n, KNOTS.size)), np.zeros(n), np.zeros(0))
    levels = [
        PosteriorClassifier().with_device(d)._levels(3) for d in (device, replace(device, discrepancy=odd))
    ]
    assert [[level.prior for level in some] for some in levels] == [
        pytest.approx([0.784, 0.196, 0.02]), pytest.approx([0.8, 0.2])
    ]  # fmt: skip
    assert not any(level.device.uncertain for level in levels[1])


def test_other_blocks_are_answered_less_surely(known: PosteriorClassifier) -> None:
    device = known.device_
    off = dict(zip(FIVE, (0.5, -0.5, 0.45, -0.4, 0.5)))
    blocks = {name: replace(block, ln_h=block.ln_h + off[name]) for name, block in device.blocks.items()}
    other = replace(device, blocks=blocks)
    grasps = simulate_grasps(
        other.grip(), FIVE * 4, t_gripper=23.0, t_object=43.0, seed=5, **other.readings()
    )
    same = known.certain()
    loss = [
        -m.predict_log_proba(grasps)[np.arange(20), np.searchsorted(m.classes_, FIVE * 4)].mean()
        for m in (known, same)
    ]
    assert loss[0] < loss[1] - 0.15
    assert any("another block" in row.get("note", "") for row in classify_grasps(known, grasps))


def test_the_closer_grippers_lie_together_the_surer(known: PosteriorClassifier, metals: Grasps) -> None:
    tight = replace(GripperSpread(), contact=0.02, block_contact=0.01, sheet_thickness=0.02, lag=0.05)
    tight = replace(tight, sheet_conductivity=0.03, layer_conductivity=0.02, layer_thickness=0.02)
    loss = [
        -np.log(model.predict_proba(metals)[np.arange(3), [0, 1, 2]]).mean()
        for model in (known.for_another_gripper(spread=tight), known.for_another_gripper())
    ]
    assert loss[0] < loss[1]


def test_parameter_uncertainty_is_saved_with_the_model(
    known: PosteriorClassifier, metals: Grasps, tmp_path: object
) -> None:
    other = known.for_another_gripper()
    save_classifier(other, f"{tmp_path}/other")
    back = load_classifier(f"{tmp_path}/other")
    np.testing.assert_array_equal(back.predict_proba(metals), other.predict_proba(metals))
    twice = PosteriorClassifier(gripper="another").with_device(known.device_)
    save_classifier(twice, f"{tmp_path}/twice")
    # the spread between grippers is added once, not again when the model is read
    np.testing.assert_array_equal(
        load_classifier(f"{tmp_path}/twice").predict_proba(metals), twice.predict_proba(metals)
    )


def test_a_gripper_that_is_none_of_them_is_refused(known: PosteriorClassifier) -> None:
    with pytest.raises(UserError, match="gripper is 'mine'"):
        make_classifier("posterior", gripper="mine").with_device(known.device_)  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="has no parameter covariance"):
        PosteriorClassifier(gripper="uncertain").with_device(known.device_)
    with pytest.raises(NotFittedError):
        PosteriorClassifier().for_another_gripper()
