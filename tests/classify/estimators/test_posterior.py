"""The effusivity-posterior classifier on the example grasps, and asked about another gripper."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from sklearn.base import clone

from thermogrip.classify import classify_grasps, load_classifier, make_classifier, save_classifier
from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.data import KNOTS, graded, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import Discrepancy, load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import fit_candidates
from thermogrip.sysid.effusivity.multi_touch import two_touch_fit
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_fit
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
    evidence = material_fit(fitted.device_, fresh, ["copper", "iron", "wood"]).log_evidence
    biased = clone(fitted).set_params(priors={"iron": 20.0})
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
    assert not any("sensor" in words for words in [*notes_of(two, both), *notes_of(one, bare)])
    assert {"answered by the first sensor alone: the record has no second one"} <= notes_of(two, bare)
    assert {"the second sensor is not read: the training had one"} <= notes_of(one, both)
    widths = [
        [row.t_object_p95 - row.t_object_p05 for row in effusivity_posterior(m.device_, both)]
        for m in (one, two)
    ]
    assert np.median(np.divide(widths[1], widths[0])) < 0.9


def notes_of(model: PosteriorClassifier, grasps: Grasps) -> set[str]:
    return {note.words for notes in model.answered(grasps).notes for note in notes}


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
    known = material_fit(device, record, FIVE).log_evidence
    data = touches(record)
    fits = fit_candidates(device, data, FIVE).mode
    best = fits.log_evidence.reshape(3, 5).argmax(axis=1)
    near = fits.u.reshape(3, 5, -1)[np.arange(3), best]
    free = free_evidence(device, data, near, whiten(graded(data, device.grades), device.noise))
    factor = np.exp(known).mean(axis=1) / np.exp(free)
    for prior, odds in ((0.25, 3.0), (0.1, 9.0)):
        model = PosteriorClassifier(prior_unknown=prior).with_device(device)
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
    [({"prior_unknown": 0.0}, "prior_unknown is 0"), ({"priors": {"wood": 0.0}}, "a prior is not positive")],
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
def strange() -> Grasps:
    """Grasps by a gripper of a slower sensor under a thicker sheet, pressed less."""
    device = load_default_gripper()
    stack = replace(device.stack, lag=2.5 * device.stack.lag, z_outer=1.3 * device.stack.z_outer)
    blocks = {name: replace(block, ln_h=block.ln_h - 0.3) for name, block in device.blocks.items()}
    other = replace(device, stack=stack, blocks=blocks)
    return simulate_grasps(other.grip(), FIVE * 2, t_gripper=23.0, t_object=43.0, seed=3, **other.readings())


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


def test_a_contact_long_after_the_message_is_not_named_wrong_for_certain(known: PosteriorClassifier) -> None:
    """Onsets of more than 0.8 s were none: iron was copper for certain."""
    record = load_example_grasps()["exp2_dT20"]
    late = pick(record, np.flatnonzero(record["split"].values == "test"))
    t, y = late["time"].values, late["t_surface"].values
    late = late.assign(t_surface=(("grasp", "time"), np.array([np.interp(t - 1.0, t, row) for row in y])))
    true = np.searchsorted(known.classes_, late["material"].values)
    p = np.exp([known.predict_log_proba(pick(late, [i]))[0] for i in range(true.size)])
    assert not ((p.max(axis=1) > 0.95) & (p.argmax(axis=1) != true)).any()


def test_one_block_far_from_its_stated_temperature_makes_no_other_gripper(known: PosteriorClassifier) -> None:
    """Copper at 16.3 degC, stated as 18 +- 0.36, touched 0.17 s before the message."""
    device = known.device_
    grip = replace(device.grip(), onset=-0.17, onset_sd=0.0, bias=0.0, t_object_sd=0.0)
    one = simulate_grasps(
        grip, ["copper"], t_gripper=38.0, t_object=16.3, seed=2, ambient=25.0, **device.readings()
    )
    one = one.assign(t_object=("grasp", [18.0]))
    (row,) = classify_grasps(known, one)
    assert row["material"] == "copper"
    assert row["note"] == "as copper its object is 1.9 K colder than stated: answered less surely"
    assert row["p_copper"] > 0.8
    assert row["p_unknown"] < 0.1


def test_what_no_block_reaches_is_unknown_beside_a_learnt_discrepancy_too() -> None:
    """Wood is none of a block of two thirds of its effusivity, five times the scatter away, however little
    its readings count."""
    device, grasps = load_default_gripper(), load_example_grasps()["exp2_dT20"]
    wood = device.blocks["wood"]
    blocks = {**device.blocks, "cedar": replace(wood, ln_effusivity=wood.ln_effusivity - 0.4)}
    shape = len(blocks), KNOTS.size
    nothing = Discrepancy(np.zeros(KNOTS.size), np.zeros(shape), np.zeros(len(blocks)))
    model = PosteriorClassifier().with_device(replace(device, blocks=blocks, discrepancy=nothing))
    touched = pick(grasps, np.flatnonzero(grasps["material"].values == "wood")[:6])
    assert model.p_unknown(touched, ["cedar", "copper"]).min() > 0.5
    assert model.p_unknown(touched, ["copper", "wood"]).max() < 0.05


@pytest.mark.parametrize(
    ("names", "misstatements", "of_chance"),
    [
        (("exp2_dT20", "exp3C_obj18_grip38"), (-5.0, 5.0), 0.25),
        (("exp2_dT15", "exp3B_obj28_grip48"), (1.5,), 0.15),  # or iron is a sheet of copper
    ],
)
def test_temperatures_stated_wrongly_mislead_little(
    names: tuple[str, ...], misstatements: tuple[float, ...], of_chance: float
) -> None:
    model, losses = PosteriorClassifier().with_device(load_default_gripper()), list[float]()
    for name in names:
        record = load_example_grasps()[name]
        test = pick(record, record["split"].values == "test")
        for off in misstatements:
            wrong = test.assign(t_object=test["t_object"] + off)
            p = np.exp(model.candidate_log_proba(wrong, ["copper", "iron", "wood"]))
            at = np.searchsorted(["copper", "iron", "wood"], test["material"].values)
            losses += (-np.log(p[np.arange(at.size), at])).tolist()
    assert np.mean(losses) < of_chance * np.log(3)


def test_grasps_by_another_gripper_are_answered_less_surely_than_known_ones_would_be(
    known: PosteriorClassifier, strange: Grasps
) -> None:
    """And not as chance would have them; a few that are known teach it."""
    true = np.searchsorted(known.classes_, FIVE * 2)
    p = known.predict_proba(strange)
    assert not ((p.max(axis=1) > 0.95) & (p.argmax(axis=1) != true)).any()
    assert -np.log(p[np.arange(10), true]).mean() < np.log(5)
    few = pick(strange, [0, 4, 5, 9])
    taught = known.for_another_gripper(few).predict_proba(strange)
    assert -np.log(taught[np.arange(10), true]).mean() < -np.log(p[np.arange(10), true]).mean()


def test_files_that_state_finish_and_gripper_still_load(
    known: PosteriorClassifier, warm: Grasps, tmp_path: Path
) -> None:
    """Version 0.2.0 wrote them."""
    file = save_classifier(known, tmp_path) / "classifier.json"
    content = json.loads(file.read_text())
    content["params"] |= {"finish": "auto", "gripper": "auto"}
    file.write_text(json.dumps(content))
    np.testing.assert_array_equal(load_classifier(tmp_path).predict_proba(warm), known.predict_proba(warm))
