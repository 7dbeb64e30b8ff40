"""Calibration finds what grasps were made with, and its noise where the likelihood is greatest."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from thermogrip.classify import answer
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.contact.materials import find_material
from thermogrip.sysid.effusivity import calibration
from thermogrip.sysid.effusivity.calibration import calibrate_example_gripper, calibrate_gripper
from thermogrip.sysid.effusivity.data import KNOTS, touches
from thermogrip.sysid.effusivity.gripper_model import (
    INSULATOR,
    SHARED_NAMES,
    another_gripper,
    load_default_gripper,
    stack_numbers,
)
from thermogrip.sysid.effusivity.laplace_approximation import material_hypotheses, prior_of
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_fit

from .makers import FIVE, drawn_gripper, simulated, split_of

FIRST = np.array([-3.1, -4.0, 1.4, -6.5, 1.0])


@cache
def calibrated(name):
    """Return the gripper as the training grasps of a record make it, and the searches for its noise."""
    seen, least = [], calibration._least

    def spy(cost, first, n_grasp, slope):
        found = least(cost, first, n_grasp, slope)
        seen.append((cost, found))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "_least", spy)
        return calibrate_gripper([split_of(load_example_grasps()[name], "train")]), seen


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exp2_dT20", "exp4_cooled5_obj18_grip38_40s"])
def test_no_noise_nearby_is_likelier_than_that_of_a_calibration(name):
    """By more than the slope at which the last search may end allows over the way there: the cost is convex
    about its least value."""
    device, searches = calibrated(name)
    assert len(searches) == 3  # the last for the first look at a discrepancy, of which there is none
    assert device.discrepancy is None
    cost, found = searches[1]
    assert device.noise.white == pytest.approx(np.exp(found[0]))
    best = cost(found)[0]
    for k, size in enumerate((0.002, 0.02, 0.02, 0.02, 0.02)):
        for side in (-1, 1):
            inside = np.clip(found + side * size * np.eye(5)[k], *calibration._NOISE_RANGE.T)
            margin = calibration.SETTINGS.noise_slope * size / calibration._NOISE_STEPS[k]
            assert cost(inside)[0] > best - margin


def narrow(q):
    """A valley that turns, a thousand times as steep across as along, its floor at (-3, -4, 1, -7, 0.5)."""
    off = q - np.array([-3.0, -4.0, 1.0, -7.0, 0.5])
    across = off[0] + 0.1 * off[2] ** 2 - 0.3 * off[1]
    value = 5e3 * across**2 + 0.5 * (off[1:] ** 2).sum()
    slopes = np.concatenate([[0.0], off[1:]])
    slopes += 1e4 * across * np.array([1.0, -0.3, 0.2 * off[2], 0.0, 0.0])
    return float(value), slopes


def test_the_search_goes_on_through_a_narrow_valley():
    found = calibration._least(narrow, FIRST, n_grasp=1)
    np.testing.assert_allclose(found, [-3.0, -4.0, 1.0, -7.0, 0.5], atol=0.05)


def test_a_search_that_is_cut_short_says_so(monkeypatch):
    monkeypatch.setattr(calibration, "SETTINGS", calibration.CalibrationSettings(noise_steps=3))
    with pytest.warns(RuntimeWarning, match="noise of 7 grasps ended after 3 steps before it settled"):
        calibration._least(narrow, FIRST, n_grasp=7)


@pytest.mark.slow
def test_the_bundled_gripper_is_what_its_training_grasps_make():
    """Within what the ends of its searches leave: one that ends at a change of 0.05 in -2 ln evidence, half
    of it left, is off by at most 0.16 standard deviations along its last step, and a file made by another
    end of it 0.011 in any of its numbers, 0.9 % in the growth of the noise, 0.2 % in spreads."""
    bundled, again = load_default_gripper(), calibrate_example_gripper()
    known = again.uncertainty
    labels = [name.partition(" ")[2] for name in known.names if name.startswith("ln_e ")]
    nothing = np.zeros(len(known.names))
    ends = [calibration.gripper_theta(gripper, labels, nothing) for gripper in (bundled, again)]
    off = np.abs(ends[1] - ends[0]) / np.sqrt(np.diag(known.covariance))
    assert off.max() < 0.02, dict(zip(known.names, off.round(3)))
    for part, close in (("noise", 0.01), ("spreads", 3e-3)):
        for name, value in vars(getattr(bundled, part)).items():
            assert getattr(getattr(again, part), name) == pytest.approx(value, rel=close), (part, name)
    assert again.trained_on == bundled.trained_on


def heated(record, cut):
    """What a finger whose heater is cut at contact reads, smoothed over a second."""
    time, y = record["time"].values, record["t_surface"].values
    window = np.hanning(11) / np.hanning(11).sum()
    smooth = [np.convolve(row, window, "valid") for row in np.pad(y, ((0, 0), (5, 5)), mode="edge")]
    cooler = cut * (1 - np.exp(-np.maximum(time, 0.0) / 1.5))
    return record.assign(t_surface=(("grasp", "time"), smooth - cooler))


def test_what_no_gripper_does_is_a_discrepancy_that_is_learnt(files):
    """From objects on both sides of the skin, which tell what is common to all."""
    records = [heated(files[name], 1.5) for name in ("exp2_dT20", "exp3A_obj43_grip23")]
    training = [split_of(record, "train") for record in records]
    device = calibrate_gripper(training)
    found = device.discrepancy
    assert device.noise.smooth
    assert found.always[KNOTS == 4.6] < -0.2
    test = split_of(records[0], "test")
    p = material_fit(device, test, ["copper", "iron", "wood"]).probabilities
    assert (np.array(["copper", "iron", "wood"])[p.argmax(axis=1)] == test["material"].values).sum() >= 8
    # a refit from it keeps it
    again = calibrate_gripper(training, start=device)
    np.testing.assert_allclose(again.discrepancy.share, found.share)
    np.testing.assert_allclose(again.discrepancy.always, found.always)


def test_a_discrepancy_learnt_at_one_difference_holds_at_half_of_it(files):
    """What objects 20 K above the skin show is no reason to doubt grasps of some 10 K above it."""
    known = PosteriorClassifier().fit(split_of(heated(files["exp2_dT20"], 0.0), "train"))
    assert known.device_.discrepancy is not None
    test = split_of(heated(files["exp2_dT10"], 0.0), "test")
    found = answer(known, test)
    assert sum(one.nearest == name for one, name in zip(found, test["material"].values)) >= 8
    assert not [note.words for one in found for note in one.notes]


def test_objects_of_unstated_temperature_are_looked_for_about_a_room_not_about_a_heated_skin(device):
    def touched(seed):
        warm = {"t_gripper": 49.0, "t_object": 22.0, "ambient": 22.0}
        drawn = simulated(device, ["copper", "iron", "wood"], n=6, seed=seed, **warm)
        return drawn.drop_vars(["t_object", "t_ambient"])

    found = effusivity_posterior(calibrate_gripper([touched(1)]), touched(2))
    assert np.mean([row.t_object_p05 <= 22.0 <= row.t_object_p95 for row in found]) > 0.7


def test_a_block_at_the_bound_of_insulators_is_none():
    library = tuple(calibration.Anchor(e, 0.1, 2e6) for e in (2999.0, INSULATOR, 3001.0))
    which = np.array([1, 0, 2, 0])
    problem = calibration.Problem(None, None, ("a", "b", "c"), library, which, None, np.zeros(3))
    assert problem.insulating.tolist() == [False, True, False, True]


def test_calibration_finds_the_blocks_it_was_shown(device):
    """Simulated grasps of three materials at two differences: what the data fix comes back."""
    sets = [
        simulated(device, ["copper", "iron", "wood"], t_gripper=g, t_object=43.0, seed=5 + int(g), n=8)
        for g in (23.0, 33.0)
    ]
    fitted = calibrate_gripper(sets)
    # h and e share a scale with the gripper's own effusivity; ratios between blocks do not
    for name in ("copper", "wood"):
        want = device.blocks[name].ln_h - device.blocks["iron"].ln_h
        got = fitted.blocks[name].ln_h - fitted.blocks["iron"].ln_h
        # two conductances from 16 grasps each, and a tenth for what trades with effusivity
        assert got == pytest.approx(want, abs=3 * device.spreads.ln_h * np.sqrt(2 / 16) + 0.1)
    # spreads from 48 grasps: chi bounds of one in a thousand, widened for the fitted means
    assert 0.6 < fitted.spreads.t_object / device.spreads.t_object < 1.45
    assert 0.6 < fitted.spreads.onset / device.spreads.onset < 1.45
    assert 0.9 < fitted.noise.white / device.noise.white < 1.1
    fresh = simulated(device, ["copper", "iron", "wood"], t_gripper=23.0, t_object=43.0, seed=99, n=10)
    p = material_fit(fitted, fresh, ["copper", "iron", "wood"]).probabilities
    right = np.array(["copper", "iron", "wood"])[p.argmax(axis=1)] == fresh["material"].values
    assert right.mean() > 0.85


def test_a_refit_from_an_earlier_one_ends_at_the_same_place(files):
    cold, _ = calibrated("exp2_dT20")
    warm = calibrate_gripper([split_of(files["exp2_dT20"], "train")], start=cold)
    assert warm.noise == cold.noise
    fresh, names = split_of(files["exp2_dT20"], "test"), ["copper", "iron", "wood"]
    np.testing.assert_allclose(
        material_fit(warm, fresh, names).probabilities,
        material_fit(cold, fresh, names).probabilities,
        atol=0.05,
    )


@pytest.mark.parametrize(
    ("records", "match"),
    [
        (lambda g: [], "no training grasps"), (lambda g: [g.drop_vars("material")], "has no material"),
        (lambda g: [g.isel(grasp=[0, 1, 2])], "at least two materials, or a prior"),
    ],
)  # fmt: skip
def test_grasps_that_teach_nothing_are_refused(files, records, match):
    with pytest.raises(UserError, match=match):
        calibrate_gripper(records(files["exp2_dT20"]))


def test_a_training_in_which_no_object_temperature_is_known_names_materials(files):
    """Objects 15 K below the skin, as of a heated sensor that touches what lies in the room."""
    record = files["exp2_dT15"].drop_vars(["t_object", "t_ambient"])
    found = calibrate_gripper([split_of(record, "train")])
    test, names = split_of(record, "test"), ["copper", "iron", "wood"]
    p = material_fit(found, test, names).probabilities
    metal = np.isin(test["material"].values, names[:2])
    assert (p[metal, :2].sum(axis=1) > 0.5).all()
    assert (p[~metal, 2] > 0.5).all()


REAL = Path(os.environ.get("THERMOGRIP_REAL_DATA", Path(__file__).parents[4] / "shared" / "data" / "real"))


@pytest.mark.slow
@pytest.mark.skipif(
    not (REAL / "two_sensor_contacts.csv.gz").is_file(),
    reason=f"no measurements of other labs in {REAL} (set THERMOGRIP_REAL_DATA)",
)
def test_what_objects_of_unknown_temperature_show_does_not_hang_on_where_a_search_begins():
    """From objects as warm as the skin it ended 1200 nats below another maximum, and named .84; that of a
    second sensor ended 3600 below the one near what surrounds the first."""
    meta = pd.read_csv(REAL / "two_sensor_contacts_meta.csv", index_col="grasp")
    table = pd.read_csv(REAL / "two_sensor_contacts.csv.gz")
    columns = ["t_heated_degC", "t_passive_degC"]
    heated, passive = (table.pivot(index="grasp", columns="time_s", values=column) for column in columns)
    record = make_grasps(
        heated.columns, heated.to_numpy(), [f"g{k}" for k in heated.index], name="two sensors",
        material=meta.loc[heated.index, "material"].tolist(),
    ).assign(t_surface_2=(("grasp", "time"), passive.to_numpy()))  # fmt: skip
    third = meta.loc[heated.index, "set"].to_numpy() % 3 == 2
    found = calibrate_gripper([record.isel(grasp=~third)])
    both, names = record.isel(grasp=third), ["aluminium", "wood", "wood_cold"]
    alone = both.drop_vars("t_surface_2")
    beside = alone.assign(t_surface=both["t_surface_2"])
    for gripper, test, least in ((found, both, 0.99), (found, alone, 0.9), (found.second, beside, 0.65)):
        p = material_fit(gripper, test, names).probabilities
        assert (np.array(names)[p.argmax(axis=1)] == test["material"].values).mean() > least


def test_calibration_finds_the_loss_and_with_it_the_temperature(device):
    """Of blocks that stay 15 K above the room, which a gripper without the loss takes for colder ones."""
    kinds = ((43.0, 23.0), (43.0, 38.0), (18.0, 38.0), (28.0, 48.0))
    grasps = [
        simulated(device, ["copper", "iron", "wood"], n=5, t_gripper=g, t_object=o, seed=40 + i)
        for i, (o, g) in enumerate(kinds)
    ]
    found = calibrate_gripper(grasps)
    at = found.uncertainty.names.index("ln_g_far")
    sd = np.sqrt(found.uncertainty.covariance[at, at])
    off = np.log(found.stack.g_far / device.stack.g_far)
    assert sd < 0.6
    assert abs(off) < 3 * sd


def test_a_few_known_grasps_teach_the_other_gripper(device):
    other = another_gripper(device)
    truth = drawn_gripper(other, 3)
    known = simulated(truth, ["copper", "wood"], n=2, t_gripper=48.0, t_object=28.0, seed=1)
    fresh = simulated(truth, FIVE, n=4, t_gripper=23.0, t_object=43.0, seed=2)
    at = np.array([FIVE.index(name) for name in fresh["material"].values])
    model = calibrate_gripper([known], prior=other)
    taught, untaught = (
        -np.log(np.maximum(material_fit(g, fresh, FIVE).probabilities[np.arange(at.size), at], 1e-12)).mean()
        for g in (model, device)
    )
    assert taught < untaught - 0.1
    assert set(model.materials) == set(FIVE)


def test_what_grasps_teach_is_never_less_than_nothing(device):
    """The covariance shrinks in every direction, and the truth lies inside it."""
    other = another_gripper(device)
    truth = drawn_gripper(other, 5)
    known = simulated(truth, ["copper", "wood"], n=3, t_gripper=48.0, t_object=28.0, seed=4)
    model = calibrate_gripper([known], prior=other)
    names = model.uncertainty.names
    at = [other.uncertainty.names.index(name) for name in names]
    before = other.uncertainty.covariance[np.ix_(at, at)]
    floor = 1e-5  # numbers that count as exact keep a thousandth of a wide prior
    assert np.linalg.eigvalsh(before - model.uncertainty.covariance + floor * np.eye(len(names))).min() > 0
    off = stack_numbers(truth.stack) - stack_numbers(model.stack)
    sd = np.array([model.uncertainty.sd(name) for name in SHARED_NAMES[: off.size]])
    assert np.abs(off / np.maximum(sd, 1e-3)).max() < 4.5
    assert model.uncertainty.sd("ln_lag") < 0.7 * other.uncertainty.sd("ln_lag")
    # iron was not touched, but pressing harder moves every block's conductance
    assert model.uncertainty.sd("ln_h iron") < 0.8 * other.uncertainty.sd("ln_h iron")


@pytest.fixture(scope="module")
def learnt(device, files):
    """The gripper as thirty of its grasps teach it."""
    return calibrate_gripper([split_of(files["exp2_dT20"], "train")], start=device)


def test_one_calibration_after_another_is_both_at_once(device, files, learnt):
    train = split_of(files["exp2_dT20"], "train")
    half = np.arange(train.sizes["grasp"]) % 2 == 0
    first = calibrate_gripper([train.isel(grasp=half)], start=device)
    then = calibrate_gripper([train.isel(grasp=~half)], prior=first)
    for name in ("ln_h copper", "ln_e wood", "ln_lag", "onset"):
        sd = learnt.uncertainty.sd(name)
        one, other = (numbers_of(d)[name] for d in (then, learnt))
        assert abs(one - other) < 1.0 * sd, name
        assert 0.7 < then.uncertainty.sd(name) / sd < 1.4, name
    assert then.trained_on == (*first.trained_on, "exp2_dT20")
    assert then.blocks["copper"].n_grasp == learnt.blocks["copper"].n_grasp


def numbers_of(device):
    """Return some numbers of a device by the names of their covariance."""
    blocks = {f"ln_h {k}": b.ln_h for k, b in device.blocks.items()}
    blocks |= {f"ln_e {k}": b.ln_effusivity for k, b in device.blocks.items()}
    return blocks | {"ln_lag": np.log(device.stack.lag), "onset": device.onset}


def test_the_nominal_temperature_is_best_known_in_rooms_like_those_of_the_calibration(learnt):
    away = np.array([-40.0, -20.0, -3.0, 20.0, 40.0])
    sd = learnt.nominal_sd(away)
    assert sd.argmin() in (1, 2)
    assert min(sd[0], sd[4]) > 2 * sd.min()
    assert learnt.nominal_sd(np.array([np.nan]))[0] == pytest.approx(learnt.uncertainty.sd("bias"))
    # and an answer includes it
    grasp = load_example_grasps()["exp2_dT20"].isel(grasp=[5])
    cold = grasp.assign(t_ambient=grasp["t_ambient"] - 30)
    hypotheses = material_hypotheses(learnt, ["copper"])
    sds = [prior_of(learnt, touches(g), hypotheses).sd[0, 4] for g in (grasp, cold)]
    assert sds[1] > sds[0]


def test_a_label_without_a_row_is_learnt_beside_one_that_has_one_or_given_a_row(files):
    grasps = files["exp2_dT20"].isel(grasp=[0, 8, 9, 16])
    label = grasps["material"].values.astype(object)
    label[[1, 2]] = "bismuth"
    odd = grasps.assign(material=("grasp", label.astype(str)))
    wide = calibration._problem(calibration._labelled_touches([odd], {}, 2), {}, None, 0.02)
    assert wide.library[0].sd_ln == 2.0
    assert wide.library[1].sd_ln < 0.3
    name = str(grasps["grasp"].values[1])
    strange = odd.isel(grasp=[1, 2]).assign(material=("grasp", ["bismuth", "x"]))
    with pytest.raises(UserError, match=f"grasp '{name}' is of 'bismuth', and the materials table has none"):
        calibrate_gripper([strange])
    row = replace(find_material("iron"), name="bismuth", rho=8000.0, c_p=200.0, effusivity=9e3)
    problem = calibration._problem(
        calibration._labelled_touches([odd], {"bismuth": row}, 2), {"bismuth": row}, None, 0.03
    )
    assert problem.labels[0] == "bismuth"
    assert problem.library[0].effusivity == 9e3
    assert problem.ln_capacity[0] == pytest.approx(np.log(8000.0 * 200.0 * 0.03))
    assert problem.which[[1, 2]].tolist() == [0, 0]


def test_an_earlier_calibration_is_a_prior_of_what_it_knows(device):
    """Of a new block nothing is known but its row; an exact number keeps a thousandth of the wide prior."""
    other = another_gripper(device)
    known = calibration.anchors(["copper", "glass"], {"glass": find_material("glass")}, other)
    assert known[0] == calibration.Anchor(
        device.blocks["copper"].library_effusivity, device.blocks["copper"].library_sd_ln,
        device.blocks["copper"].heat_capacity,
 )  # fmt: skip
    prior = calibration.prior_of_gripper(other, ["copper", "glass"], known)
    names = [*SHARED_NAMES, "ln_h copper", "ln_h glass", "ln_e copper", "ln_e glass"]
    mean, cov = dict(zip(names, prior.mean)), np.linalg.inv(prior.precision)
    sd = dict(zip(names, np.sqrt(np.diag(cov))))
    assert mean["ln_h copper"] == pytest.approx(device.blocks["copper"].ln_h)
    assert mean["ln_e copper"] == pytest.approx(device.blocks["copper"].ln_effusivity)
    assert (mean["ln_h glass"], mean["ln_e glass"]) == pytest.approx(
        (np.log(1500), np.log(known[1].effusivity))
    )
    assert (mean["ln_depth"], mean["bias"]) == pytest.approx((np.log(device.depth_share), device.bias))
    assert (sd["ln_h glass"], sd["ln_e glass"]) == pytest.approx((1.0, known[1].sd_ln))
    assert sd["ln_lag"] == pytest.approx(np.hypot(1.5 * 0.5, 1e-3), rel=1e-9)
    assert sd["ln_depth"] == pytest.approx(0.05e-3, rel=1e-6)
    at = [names.index("ln_e_outer"), names.index("ln_z_outer")]
    assert cov[at[0], at[1]] == pytest.approx(1.5**2 * (0.1**2 - 0.3**2) / 4, rel=1e-6)
    assert (prior.guesses, prior.spread["onset"]) == (10.0, device.spreads.onset)
    few = replace(other, spreads=replace(other.spreads, dof=4.0))
    assert calibration.prior_of_gripper(few, ["copper"], known[:1]).guesses == 4.0
    off = prior.mean.copy()
    off[-1] += 2 * known[1].sd_ln
    assert prior.penalty(off) == pytest.approx(4.0)


def test_grasps_of_one_material_add_to_a_prior(device, files):
    train, told = files["exp2_dT20"].isel(grasp=[0, 1]), []
    assert set(train["material"].values.tolist()) == {"copper"}
    found = calibrate_gripper([train], prior=device, progress=lambda f, w: told.append((f, w)))
    count = {name: block.n_grasp for name, block in device.blocks.items()}
    assert {n: b.n_grasp for n, b in found.blocks.items()} == count | {"copper": count["copper"] + 2}
    assert found.block_length == device.block_length
    assert found.noise == device.noise
    assert found.trained_on == (*device.trained_on, "exp2_dT20")
    assert told[-1] == (1.0, "calibrated")
    assert told[:-1] == [(i / 40, "gripper from 2 grasps") for i in range(len(told) - 1)]
