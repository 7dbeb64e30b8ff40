"""A gripper in doubt: its integral beside brute force, its frequency beside its confidence, few known grasps.

Grippers are drawn from the stated spread and their grasps simulated: what the engine believes is true.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import binom

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.contact.response import LAYER_NAMES, nearby_modes, stack_modes
from thermogrip.sysid.effusivity import laplace_approximation as doubt
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.data import touches, whiten
from thermogrip.sysid.effusivity.gripper_model import (
    SHARED_NAMES,
    GripperModel,
    GripperSpread,
    ParameterCovariance,
    another_gripper,
    block_names,
    load_default_gripper,
)
from thermogrip.sysid.effusivity.laplace_approximation import predict
from thermogrip.sysid.effusivity.multi_touch import two_touch_fit
from thermogrip.sysid.effusivity.posterior import (
    effusivity_posterior,
    material_evidence,
    material_fit,
    material_posterior,
)
from thermogrip.sysid.effusivity.predictive import rest_of_contact
from thermogrip.sysid.effusivity.priors import Hypotheses, fit_pairs, material_hypotheses, prior_of

from ...oracles.emcee_posterior import emcee_posterior
from .makers import FIVE, simulated

NOTHING = GripperSpread(**dict.fromkeys(GripperSpread.__dataclass_fields__, 0.0))


@pytest.fixture(scope="module")
def device():
    return load_default_gripper()


@pytest.fixture(scope="module")
def touched():
    """One grasp of each of five materials, 20 K apart."""
    return load_example_grasps()["exp1A_obj43_grip23"].isel(grasp=[5, 13, 21, 29, 37])


@pytest.fixture(scope="module")
def learnt():
    """The gripper as thirty of its grasps teach it."""
    record = load_example_grasps()["exp2_dT20"]
    return calibrate_gripper(
        [record.isel(grasp=record["split"].values == "train")], start=load_default_gripper()
    )


def drawn(device, seed):
    """Return a gripper drawn from what is known of it, its numbers exact."""
    known = device.uncertainty
    move = np.random.default_rng(seed).multivariate_normal(np.zeros(len(known.names)), known.covariance)
    by = dict(zip(known.names, move))
    numbers = doubt._numbers(device.stack) + [
        by[name] for name in SHARED_NAMES[: SHARED_NAMES.index("onset")]
    ]
    numbers[SHARED_NAMES.index("ln_first")] = min(numbers[SHARED_NAMES.index("ln_first")], -0.01)
    blocks = {
        name: replace(b, ln_h=b.ln_h + by[f"ln_h {name}"], ln_effusivity=b.ln_effusivity + by[f"ln_e {name}"])
        for name, b in device.blocks.items()
    }
    return replace(
        device,
        stack=doubt._stack(numbers),
        onset=device.onset + by["onset"],
        transit_loss=device.transit_loss + by["transit_loss"],
        bias=device.bias + by["bias"],
        blocks=blocks,
        uncertain=False,
    )


def test_without_spread_doubt_changes_nothing(device, touched):
    exact = replace(device, blocks={k: replace(b, ln_h_sd=0.0) for k, b in device.blocks.items()})
    same = another_gripper(exact, NOTHING)
    assert same.uncertain
    sure, unsure = material_fit(exact, touched, FIVE), material_fit(same, touched, FIVE)
    near = sure.log_evidence > sure.log_evidence.max(axis=1, keepdims=True) - 20
    np.testing.assert_allclose(unsure.log_evidence[near], sure.log_evidence[near], atol=0.01)
    np.testing.assert_allclose(unsure.t_object[near], sure.t_object[near], atol=0.01)
    np.testing.assert_allclose(unsure.t_object_sd[near], sure.t_object_sd[near], rtol=0.01)


@pytest.mark.parametrize("name", ["lag", "sheet_thickness", "contact", "bias", "build_up"])
def test_evidence_is_the_integral_over_the_grippers(device, touched, name):
    """Beside sums over exact grippers on a fine grid of the one number that is in doubt."""
    exact = replace(device, blocks={k: replace(b, ln_h_sd=0.0) for k, b in device.blocks.items()})
    spread = replace(NOTHING, **{name: 0.3})
    found = material_evidence(another_gripper(exact, spread), touched, FIVE)
    z = np.linspace(-4.5, 4.5, 61)
    moved = {
        "lag": lambda d: {"stack": replace(exact.stack, lag=exact.stack.lag * np.exp(d))},
        "sheet_thickness": lambda d: {"stack": replace(exact.stack, z_outer=exact.stack.z_outer * np.exp(d))},
        "build_up": lambda d: {"stack": replace(exact.stack, build_up=exact.stack.build_up * np.exp(d))},
        "bias": lambda d: {"bias": exact.bias + d},
        "contact": lambda d: {"blocks": {k: replace(b, ln_h=b.ln_h + d) for k, b in exact.blocks.items()}},
    }
    sums = [material_evidence(replace(exact, **moved[name](0.3 * v)), touched, FIVE) for v in z]
    log_weight = -0.5 * z**2 - 0.5 * np.log(2 * np.pi) + np.log(z[1] - z[0])
    expected = logsumexp(np.stack(sums) + log_weight[:, None, None], axis=0)
    near = expected > expected.max(axis=1, keepdims=True) - 10
    np.testing.assert_allclose(found[near], expected[near], atol=0.15)
    assert np.abs(found - material_evidence(exact, touched, FIVE))[near].max() > 0.3


def test_derivatives_by_the_gripper_are_those_of_its_readings(device, touched):
    other = another_gripper(device)
    data, row = touches(touched.isel(grasp=[1])), np.zeros(1, dtype=np.int64)
    hypotheses = material_hypotheses(device, ["copper"])
    u = fit_pairs(device, data, row, hypotheses).u
    pair = doubt._pairs(
        other, data, row, whiten(data, device.noise), prior_of(device, data, hypotheses), np.array([1])
    )[0]
    slopes, _ = doubt._slopes(pair, doubt._point(pair, u[0], np.zeros(len(doubt._AT))))
    for name, i in doubt._AT.items():
        step = np.zeros(len(doubt._AT))
        step[i] = 1e-6 if name == "leak" else 1e-4
        there, back = (
            predict(
                doubt._stack(pair.centre + sign * step[: SHARED_NAMES.index("onset")]),
                pair.nodes,
                data,
                u + sign * pair.by_mean @ step,
            )[0]
            for sign in (1, -1)
        )
        expected = (there - back) / (2 * step[i])
        np.testing.assert_allclose(
            slopes[:, i], expected, atol=2e-3 * np.abs(expected).max() + 1e-3, err_msg=name
        )


def test_theta_moves_the_prior_means_as_another_device_would(device, touched):
    data, hypotheses = touches(touched.isel(grasp=[1])), material_hypotheses(device, ["copper"])
    here = prior_of(device, data, hypotheses).mean[0]
    copper, step = device.blocks["copper"], 1e-3
    moved = {
        "ln_build_up": {"stack": replace(device.stack, build_up=device.stack.build_up * np.exp(step))},
        "onset": {"onset": device.onset + step},
        "transit_loss": {"transit_loss": device.transit_loss + step},
        "bias": {"bias": device.bias + step},
        "ln_depth": {"depth_share": device.depth_share * np.exp(step)},
        "ln_h": {"blocks": {**device.blocks, "copper": replace(copper, ln_h=copper.ln_h + step)}},
        "ln_e": {
            "blocks": {**device.blocks, "copper": replace(copper, ln_effusivity=copper.ln_effusivity + step)}
        },
    }
    slopes = doubt._mean_slopes(data)
    for name, i in doubt._AT.items():
        other = replace(device, **moved.get(name, {}))
        there = prior_of(other, data, material_hypotheses(other, ["copper"])).mean[0]
        np.testing.assert_allclose(slopes[:, i], (there - here) / step, atol=1e-9, err_msg=name)


def test_doubt_about_the_dial_is_a_wider_spread_of_the_object(device, touched):
    """Both are normal and enter alike, so that the answers are the same, temperature and all."""
    exact = replace(device, blocks={k: replace(b, ln_h_sd=0.0) for k, b in device.blocks.items()})
    found = material_fit(
        another_gripper(exact, replace(NOTHING, bias=0.6)), touched, ["brass", "copper", "zinc"]
    )
    nu = device.spreads.dof
    wide = float(np.hypot(device.spreads.t_object, 0.6 / np.sqrt(nu / (nu - 2))))
    same = material_fit(
        replace(exact, spreads=replace(exact.spreads, t_object=wide)), touched, ["brass", "copper", "zinc"]
    )
    metal = slice(0, 4)
    np.testing.assert_allclose(found.t_object_sd[metal], same.t_object_sd[metal], rtol=0.03)
    np.testing.assert_allclose(found.t_object[metal], same.t_object[metal], atol=0.05)
    np.testing.assert_allclose(found.log_evidence[metal], same.log_evidence[metal], atol=0.1)


def test_nearby_modes_are_right_to_first_order(device):
    stack = device.stack
    here = np.array([getattr(stack, name) for name in LAYER_NAMES])
    for i, name in enumerate(LAYER_NAMES):
        off = []
        for step in (1e-3, 1e-4):
            moved = here.copy()
            moved[i] *= np.exp(step)
            exact = stack_modes(replace(stack, **{name: float(moved[i])}))
            off.append(np.abs(nearby_modes(stack, moved[None]).lam[0] - exact.lam)[:20].max())
        assert off[1] < 0.02 * off[0] + 1e-9, name  # a hundredth: the error is of second order


def test_confidence_about_another_gripper_is_its_frequency(device):
    """Of grippers drawn as stated, an answer of probability p is right in p of the cases."""
    other = another_gripper(device)
    p, right = [], []
    for seed in range(12):
        grasps = simulated(drawn(other, seed), FIVE, n=1, t_gripper=23.0, t_object=43.0, seed=seed)
        found = material_posterior(other, grasps, FIVE)
        p += found.max(axis=1).tolist()
        right += (found.argmax(axis=1) == np.arange(5)).tolist()
    low, high = binom.ppf([0.001, 0.999], len(p), np.mean(p))
    assert low <= np.sum(right) <= high
    assert np.mean(p) < 0.75  # metals cannot be told by a gripper that nobody has calibrated


def test_taken_as_exact_another_gripper_is_far_too_sure(device):
    other = another_gripper(device)
    grasps = [simulated(drawn(other, s), FIVE, n=1, t_gripper=23.0, t_object=43.0, seed=s) for s in range(5)]
    loss = {
        name: -np.mean([np.log(np.diag(material_posterior(d, g, FIVE)) + 1e-12).mean() for g in grasps])
        for name, d in (("exact", device), ("in doubt", other))
    }
    assert loss["in doubt"] < 1.4 < loss["exact"]


def test_a_few_known_grasps_teach_the_other_gripper(device):
    other = another_gripper(device)
    truth = drawn(other, 3)
    known = simulated(truth, ["copper", "wood"], n=2, t_gripper=48.0, t_object=28.0, seed=1)
    fresh = simulated(truth, FIVE, n=4, t_gripper=23.0, t_object=43.0, seed=2)
    at = np.array([FIVE.index(name) for name in fresh["material"].values])
    losses = []
    for n in (0, 1, 4):
        model = other if n == 0 else calibrate_gripper([known.isel(grasp=slice(n))], prior=other)
        p = material_posterior(model, fresh, FIVE)
        losses.append(-np.log(p[np.arange(at.size), at]).mean())
    assert losses[2] < losses[0] - 0.2
    assert (
        losses[2]
        < -np.log(np.maximum(material_posterior(device, fresh, FIVE)[np.arange(at.size), at], 1e-12)).mean()
    )
    assert model.uncertain
    assert set(model.materials) == set(FIVE)


def test_what_grasps_teach_is_never_less_than_nothing(device):
    """The covariance shrinks in every direction, and the truth lies inside it."""
    other = another_gripper(device)
    truth = drawn(other, 5)
    known = simulated(truth, ["copper", "wood"], n=3, t_gripper=48.0, t_object=28.0, seed=4)
    model = calibrate_gripper([known], prior=other)
    names = model.uncertainty.names
    at = [other.uncertainty.names.index(name) for name in names]
    before = other.uncertainty.covariance[np.ix_(at, at)]
    floor = 1e-5  # numbers that count as exact keep a thousandth of a wide prior
    assert np.linalg.eigvalsh(before - model.uncertainty.covariance + floor * np.eye(len(names))).min() > 0
    off = doubt._numbers(truth.stack) - doubt._numbers(model.stack)
    sd = np.array([model.uncertainty.sd(name) for name in SHARED_NAMES[: off.size]])
    assert np.abs(off / np.maximum(sd, 1e-3)).max() < 4.5
    assert model.uncertainty.sd("ln_lag") < 0.7 * other.uncertainty.sd("ln_lag")
    # iron was not touched, but pressing harder moves every block's conductance
    assert model.uncertainty.sd("ln_h iron") < 0.8 * other.uncertainty.sd("ln_h iron")


def test_one_calibration_after_another_is_both_at_once(device):
    record = load_example_grasps()["exp2_dT20"]
    train = record.isel(grasp=record["split"].values == "train")
    half = np.arange(train.sizes["grasp"]) % 2 == 0
    first = calibrate_gripper([train.isel(grasp=half)], start=device)
    then = calibrate_gripper([train.isel(grasp=~half)], prior=first)
    both = calibrate_gripper([train], start=device)
    for name in ("ln_h copper", "ln_e wood", "ln_lag", "onset"):
        sd = both.uncertainty.sd(name)
        one, other = (doubt_numbers(d)[name] for d in (then, both))
        assert abs(one - other) < 1.0 * sd, name
        assert 0.7 < then.uncertainty.sd(name) / sd < 1.4, name
    assert not then.uncertain
    assert then.trained_on == (*first.trained_on, "exp2_dT20")
    assert then.blocks["copper"].n_grasp == both.blocks["copper"].n_grasp


def doubt_numbers(device):
    """Return some numbers of a device by the names of their covariance."""
    blocks = {f"ln_h {k}": b.ln_h for k, b in device.blocks.items()}
    blocks |= {f"ln_e {k}": b.ln_effusivity for k, b in device.blocks.items()}
    return blocks | {"ln_lag": np.log(device.stack.lag), "onset": device.onset}


def test_effusivity_by_another_gripper_is_less_well_known(device, touched):
    sure = effusivity_posterior(device, touched.isel(grasp=[4]))[0]
    unsure = effusivity_posterior(another_gripper(device), touched.isel(grasp=[4]))[0]
    assert unsure.log10_effusivity_sd > 1.1 * sure.log10_effusivity_sd
    assert unsure.effusivity_p05 < sure.effusivity < unsure.effusivity_p95
    assert unsure.t_object_p95 - unsure.t_object_p05 > sure.t_object_p95 - sure.t_object_p05


def test_the_dial_is_best_known_in_rooms_like_those_of_the_calibration(learnt):
    away = np.array([-40.0, -20.0, -3.0, 20.0, 40.0])
    sd = learnt.nominal_sd(away)
    assert sd.argmin() in (1, 2)
    assert min(sd[0], sd[4]) > 2 * sd.min()
    assert learnt.nominal_sd(np.array([np.nan]))[0] == pytest.approx(learnt.uncertainty.sd("bias"))
    # and an answer carries it
    grasp = load_example_grasps()["exp2_dT20"].isel(grasp=[5])
    cold = grasp.assign(t_ambient=grasp["t_ambient"] - 30)
    hypotheses = material_hypotheses(learnt, ["copper"])
    sds = [prior_of(learnt, touches(g), hypotheses).sd[0, 4] for g in (grasp, cold)]
    assert sds[1] > sds[0]


def test_the_spread_between_grippers_is_that_of_its_causes():
    names = ("ln_e_outer", "ln_z_outer", "ln_h copper", "ln_h iron", "ln_e copper", "ln_depth")
    cov = GripperSpread().covariance(names)
    assert cov[0, 0] == pytest.approx((0.3**2 + 0.1**2) / 4)
    assert cov[1, 1] == pytest.approx(0.2**2 + (0.3**2 + 0.1**2) / 4)
    assert cov[0, 1] == pytest.approx((0.1**2 - 0.3**2) / 4)  # what conducts better is thinner in time
    assert cov[2, 3] == pytest.approx(0.25**2)
    assert cov[2, 2] == pytest.approx(0.25**2 + 0.1**2)
    assert not cov[4:].any()
    with pytest.raises(ValueError, match="lag must be >= 0"):
        GripperSpread(lag=-0.1)


def test_doubt_survives_its_file(device, tmp_path):
    other = another_gripper(device)
    back = GripperModel.load(other.save(tmp_path / "other.json"))
    assert back.uncertain
    assert back == other
    np.testing.assert_array_equal(back.uncertainty.covariance, other.uncertainty.covariance)
    assert back.uncertainty.names == (*SHARED_NAMES, *block_names(device.materials))
    # files from before there was a covariance
    old = {k: v for k, v in device.to_dict().items() if k != "in_doubt"}
    assert GripperModel.from_dict(old) == device
    broken = other.to_dict()
    broken["knowledge"]["covariance"][0][1] = 9.0
    with pytest.raises(UserError, match="symmetric"):
        GripperModel.from_dict(broken)
    with pytest.raises(UserError, match="needs the covariance of its parameters"):
        GripperModel.from_dict(device.to_dict() | {"in_doubt": True})
    with pytest.raises(ValueError, match="lacks ln_e_outer"):
        ParameterCovariance(("onset",), np.eye(1))


def test_a_covariance_with_a_negative_variance_is_refused_with_its_file(device, tmp_path):
    """Lag and settling time correlated by 1.5: symmetric, every variance positive, and none of anything."""
    content = another_gripper(device).to_dict()
    names, matrix = content["knowledge"]["names"], np.array(content["knowledge"]["covariance"])
    i, k = names.index("ln_lag"), names.index("ln_settle")
    matrix[i, k] = matrix[k, i] = 1.5 * np.sqrt(matrix[i, i] * matrix[k, k])
    content["knowledge"]["covariance"] = matrix.tolist()
    with pytest.raises(UserError, match=r"gripper\.json.*negative variance"):
        GripperModel.from_dict(content, file="gripper.json")
    for fine in (
        np.eye(len(names)),
        np.zeros((len(names),) * 2),
        another_gripper(device).uncertainty.covariance,
    ):
        ParameterCovariance(another_gripper(device).uncertainty.names, np.asarray(fine))


@pytest.mark.parametrize("value", [-2.0, np.nan])
def test_a_curvature_that_is_none_is_an_error_and_no_answer(value):
    matrix = np.eye(7)
    np.testing.assert_array_equal(doubt._factor(4 * matrix), 2 * matrix)
    matrix[4, 4] = value
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        doubt._factor(matrix)


def test_what_needs_a_known_gripper_is_refused(device, touched):
    other = another_gripper(device)
    pairs = load_example_grasps()["exp5_two_touch_unknown_object"]
    with pytest.raises(UserError, match="several touches of one block needs a known gripper"):
        two_touch_fit(other, pairs, FIVE)
    with pytest.raises(UserError, match="rest of a contact needs a known gripper"):
        rest_of_contact(other, touched, FIVE, until=2.0)
    with pytest.raises(UserError, match="needs a known gripper"):
        emcee_posterior(other, touched, 0, max_steps=10)
    train = load_example_grasps()["exp2_dT20"]
    with pytest.raises(UserError, match="both start and prior"):
        calibrate_gripper([train], start=device, prior=other)
    copper = train.isel(grasp=train["material"].values == "copper")
    with pytest.raises(UserError, match="at least two materials, or a prior"):
        calibrate_gripper([copper])
    assert isinstance(material_hypotheses(other, FIVE), Hypotheses)
