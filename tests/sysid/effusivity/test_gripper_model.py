"""The calibrated gripper: its file, its scale, the spread between grippers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.contact.materials import load_materials
from thermogrip.sysid.contact.simulation import Stack
from thermogrip.sysid.effusivity.data import Noise
from thermogrip.sysid.effusivity.gripper_model import (
    NOTHING,
    SHARED_NAMES,
    Block,
    Discrepancy,
    GripperModel,
    GripperSpread,
    ParameterCovariance,
    Spreads,
    another_gripper,
    block_names,
    stack_numbers,
    stack_of,
)


def test_a_gripper_survives_its_file_and_those_of_before_are_read(device, tmp_path):
    assert GripperModel.load(device.save(tmp_path / "device.json")) == device
    assert device.to_dict()["blocks"]["wood"]["library_effusivity"] == pytest.approx(367, rel=0.01)
    content = device.to_dict()  # from before blocks had a far face, and before there was a covariance
    del content["stack"]["g_far"]
    content["in_doubt"] = False  # of version 0.2.0
    assert GripperModel.from_dict(content) == replace(device, stack=replace(device.stack, g_far=0.0))


def test_discrepancy_and_second_sensor_survive_the_file(device, tmp_path):
    rng = np.random.default_rng(0)
    parts = rng.normal(size=16), rng.normal(size=(5, 16)), rng.normal(size=5)
    second = replace(device, bias=1.5, noise=replace(device.noise, smooth=True))
    whole = replace(device, second=second, discrepancy=Discrepancy(*parts))
    back = GripperModel.load(whole.save(tmp_path / "device.json"))
    assert back == whole
    assert (back.second.bias, back.second.noise.smooth) == (1.5, True)
    for ours, theirs in zip(vars(back.discrepancy).values(), parts):
        np.testing.assert_array_equal(ours, theirs)
    content = whole.to_dict()
    content["discrepancy"]["from_room"] = [1.0]  # of version 0.2.0
    assert GripperModel.from_dict(content) == whole
    content["discrepancy"]["always"] = [0.0]
    with pytest.raises(UserError, match="discrepancy is of another shape"):
        GripperModel.from_dict(content)
    other = another_gripper(whole)
    assert other.second.uncertainty.sd("ln_lag") > 0.5
    assert other.discrepancy is whole.discrepancy


def test_what_blocks_of_the_calibration_have_others_have_in_between(device):
    share, names = np.zeros((5, 16)), list(device.blocks)
    share[names.index("wood"), 6], share[names.index("copper"), 6] = 0.1, 0.3
    onset = np.where(np.array(names) == "wood", -0.2, 0.0)
    found = replace(device, discrepancy=Discrepancy(np.eye(16)[0], share, onset))
    ln_e = np.array([device.blocks["wood"].ln_effusivity, 3.0, device.blocks["copper"].ln_effusivity])
    beyond = found.beyond(np.array([[-2.0, -1.0, 1.0]]), ln_e)
    np.testing.assert_allclose(beyond[:, 0], [[0.0, 1.0, 0.0]] * 3)
    np.testing.assert_allclose(beyond[:, 1], [[0.0, 0.0, 0.1], [0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
    np.testing.assert_allclose(found.discrepancy_of(ln_e).onset, [-0.2, -0.2, 0.0])
    assert not device.beyond(np.zeros((1, 3)), ln_e).any()


@pytest.mark.parametrize(
    ("part", "name", "value", "match"),
    [
        ("stack", "lag", None, "not a whole device"), ("spreads", "dof", 0.0, "dof is 0, not 1e-09"),
        ("spreads", "insulator_dof", -1.0, "insulator_dof is -1"),
        ("spreads", "onset", -0.1, "onset is -0.1"),
    ],
)  # fmt: skip
def test_a_broken_file_is_refused(device, tmp_path, part, name, value, match):
    content = json.loads(device.save(tmp_path / "d.json").read_text())
    content[part][name] = value
    broken = tmp_path / "broken.json"
    broken.write_text(json.dumps(content))
    with pytest.raises(UserError, match=rf"broken\.json.*{match}"):
        GripperModel.load(broken)
    broken.write_text("not json")
    with pytest.raises(UserError, match=r"broken\.json"):
        GripperModel.load(broken)


def test_a_covariance_survives_its_file(device, tmp_path):
    other = another_gripper(device)
    back = GripperModel.load(other.save(tmp_path / "other.json"))
    assert back == other
    np.testing.assert_array_equal(back.uncertainty.covariance, other.uncertainty.covariance)
    assert back.uncertainty.names == (*SHARED_NAMES, *block_names(device.materials))
    broken = other.to_dict()
    broken["knowledge"]["covariance"][0][1] = 9.0
    with pytest.raises(UserError, match="symmetric"):
        GripperModel.from_dict(broken)
    with pytest.raises(ValueError, match="lacks ln_e_outer"):
        ParameterCovariance(("onset",), np.eye(1))


STACK = Stack(
    e_outer=2e3, z_outer=0.1, e_inner=2.5e3, z_inner=6.0, g_back=0.0, lag=0.2, first=0.05, build_up=0.5,
    creep=0.3, leak=5e-4, g_side=120.0, c_side=2e4, settle=3.0, g_far=20.0,
)  # fmt: skip
BLOCK = Block(
    ln_h=6.5, ln_h_sd=0.03, ln_effusivity=8.2, ln_effusivity_sd=0.04, library_effusivity=float(np.exp(8.0)),
    library_sd_ln=0.03, heat_capacity=3e6, n_grasp=7,
)  # fmt: skip
GRIPPER = GripperModel(
    stack=STACK, noise=Noise(white=0.05, slow=0.02, correlation_time=3.0, misfit=0.002, growth=0.7),
    spreads=Spreads(ln_h=0.1, ln_build_up=0.2, onset=0.09, t_object=0.4, ln_effusivity=0.08,
        ln_h_of_blocks=0.3),
    onset=0.02, transit_loss=0.03, bias=0.1, depth_share=0.9, block_length=0.02, ln_h_level=6.6,
        ln_h_slope=0.2,
    blocks={"slate": BLOCK},
)  # fmt: skip


def test_a_stack_is_its_numbers_in_the_order_of_their_names():
    theta = stack_numbers(STACK)
    named = dict(zip(SHARED_NAMES, theta))
    assert theta.size == 14
    assert (named["creep"], named["leak"]) == (0.3, 5e-4)
    assert named["ln_g_far"] == pytest.approx(np.log(20.0))
    assert named["ln_build_up"] == pytest.approx(np.log(0.5))
    assert named["ln_g_back"] == pytest.approx(np.log(1e-3))
    back = stack_numbers(stack_of([*theta, 99.0] * np.ones(15)))
    np.testing.assert_allclose(back, theta)
    assert stack_of(theta).g_back == pytest.approx(NOTHING)


def test_where_grippers_of_one_kind_lie():
    """Of ln e a quarter of the variances of conductivity and capacity, of ln z also that of the thickness."""
    sheet, layer = (0.3**2 + 0.1**2) / 4, (0.25**2 + 0.1**2) / 4
    want = {
        "ln_e_outer": sheet, "ln_z_outer": sheet + 0.04, "ln_e_inner": layer, "ln_z_inner": layer + 0.0625,
        "ln_g_back": 0.25, "ln_lag": 0.25, "ln_first": 0.25, "creep": 0.01, "ln_settle": 0.09, "leak": 9e-8,
        "ln_g_side": 0.25, "ln_c_side": 0.09, "ln_g_far": 0.0, "ln_build_up": 0.16, "onset": 0.0025,
        "transit_loss": 2.5e-5, "bias": 0.04, "ln_depth": 0.0, "ln_h slate": 0.0725, "ln_h iron": 0.0725,
            "ln_e slate": 0.0,
    }  # fmt: skip
    cov = GripperSpread().covariance(list(want))
    np.testing.assert_allclose(np.diag(cov), list(want.values()), atol=1e-15)
    assert cov[2, 3] == pytest.approx((0.01 - 0.0625) / 4)
    assert cov[-3, -2] == pytest.approx(0.25**2)  # of the skin's pressure, which all blocks meet
    assert np.count_nonzero(cov - np.diag(np.diag(cov))) == 6
    # it comes on top of what the calibration left open
    names = (*SHARED_NAMES, "ln_h slate", "ln_e slate")
    known = ParameterCovariance(names, 0.5 * np.eye(20))
    other = another_gripper(replace(GRIPPER, uncertainty=known)).uncertainty
    assert other.sd("ln_lag") == pytest.approx((0.5 + 1.5**2 * 0.25) ** 0.5)
    assert other.sd("ln_g_far") == pytest.approx(0.5**0.5)
    assert another_gripper(GRIPPER).uncertainty.names == names


DISCREPANT = replace(GRIPPER, discrepancy=Discrepancy(np.zeros(16), np.zeros((1, 16)), np.zeros(1)))
NAMED = (*SHARED_NAMES, "ln_h slate", "ln_e slate")


def with_correlation(off):
    matrix = np.diag(np.linspace(1.0, 2.0, 20))
    matrix[3, 5] = matrix[5, 3] = off * np.sqrt(matrix[3, 3] * matrix[5, 5])
    return matrix


@pytest.mark.parametrize(
    ("names", "matrix", "match"),
    [
        (NAMED, with_correlation(1 + 5e-7), None),
        (NAMED, with_correlation(1 + 2e-6), "negative variance: -2e-06 of correlations"),
        (NAMED, np.eye(19), r"must be finite, of shape \(20, 20\), got \(19, 19\)"),
        (NAMED, with_correlation(0.2) + np.where(np.arange(400).reshape(20, 20) == 22, np.nan, 0.0),
            "must be finite"),
        (NAMED, with_correlation(0.2) + np.where(np.arange(400).reshape(20, 20) == 65, 1e-5, 0.0),
            "must be symmetric"),
        (NAMED, with_correlation(0.2) + np.where(np.arange(400).reshape(20, 20) == 65, 1e-8, 0.0), None),
        (("x", *NAMED[1:]), np.eye(20), "lacks ln_e_outer"),
    ],
)  # fmt: skip
def test_which_covariances_are_taken(names, matrix, match):
    if match is None:
        assert ParameterCovariance(names, matrix).sd("ln_z_inner") == pytest.approx(np.sqrt(1 + 3 / 19))
        return
    with pytest.raises(ValueError, match=match):
        ParameterCovariance(names, matrix)


def test_how_well_a_nominal_temperature_is_known():
    """0.04 - 2 * 10 * 0.001 + 100 * 0.0001 K^2 in a room 10 K colder; without the room that of the bias."""
    matrix = 0.01 * np.eye(20)
    matrix[15:17, 15:17] = [[1e-4, 1e-3], [1e-3, 0.04]]
    known = replace(GRIPPER, uncertainty=ParameterCovariance(NAMED, matrix))
    np.testing.assert_allclose(known.nominal_sd([-10.0, np.nan, 5.0]), np.sqrt([0.03, 0.04, 0.0525]))
    np.testing.assert_array_equal(GRIPPER.nominal_sd([[-10.0, 3.0]]), [[0.0, 0.0]])


@pytest.mark.parametrize(("prior", "gripper"), [(0.09, GRIPPER), (0.36, DISCREPANT)])
def test_the_scale_of_one_block_is_that_of_a_normal_process(prior, gripper):
    """ln 8.2 - 8.0 found 0.2 too high; the prior's variance of the process, about it 0.03^2 and f^2 (0.04^2 +
    0.1^2), of which f is half normal: averages over it, as likely as each makes the 0.2."""
    f = np.arange(0.001, 8.0, 0.002)[:, None]
    variance = prior + 0.03**2 + f**2 * (0.04**2 + 0.1**2)
    weight = np.exp(-0.5 * (f**2 + 0.2**2 / variance)) / np.sqrt(variance)
    weight /= weight.sum()
    cross = prior * np.exp([0.0, -0.5])  # at the block, and 1.5 away
    means = 0.2 * cross / variance
    mean, sd = gripper.effusivity_scale(np.array([[8.2, 9.7]]))
    np.testing.assert_allclose(mean, [(weight * means).sum(axis=0)], rtol=5e-3)
    second_moment = (weight * (prior - cross**2 / variance + means**2)).sum(axis=0)
    np.testing.assert_allclose(sd, [np.sqrt(second_moment - mean[0] ** 2)], rtol=5e-3)
    found = gripper.found_effusivity(np.array([7.0, 8.0, 9.0]))
    np.testing.assert_allclose(found - gripper.effusivity_scale(found)[0], [7.0, 8.0, 9.0], atol=1e-6)


def test_blocks_that_agree_with_the_table_know_the_scale_better_than_blocks_that_scatter():
    def scale_sd(ln_ratios):
        library = np.exp(8.2 - np.array(ln_ratios))
        blocks = {e: replace(GRIPPER.blocks["slate"], library_effusivity=e) for e in library.tolist()}
        return float(replace(GRIPPER, blocks=blocks).effusivity_scale(np.array([8.2]))[1][0])

    # did six blocks count as stated, it would be .045 whatever they show
    assert scale_sd([0.2, 0.21, 0.201, 0.19, 0.202, 0.203]) < 0.03
    assert scale_sd([0.4, -0.1, 0.5, 0.0, 0.3, 0.1]) > 0.055


def test_what_a_simulation_is_given():
    rows, grip = load_materials(), GRIPPER.grip()
    glass = np.log(rows["glass"].effusivity)
    found = glass + GRIPPER.effusivity_scale(np.array([glass]))[0][0]
    assert grip.effusivity_of["glass"] == pytest.approx(np.exp(found))
    assert grip.h_c_of["glass"] == pytest.approx(np.exp(6.6 + 0.2 * (found - 9.0)))
    assert (grip.effusivity_of["slate"], grip.h_c_of["slate"]) == pytest.approx((np.exp(8.2), np.exp(6.5)))
    assert grip.effusivity_sd_ln["wood"] == 0.08
    assert {n for n, e in grip.effusivity_of.items() if e < 3000} == set(grip.effusivity_sd_ln)
    assert (grip.h_c_sd_ln, grip.build_up_sd_ln, grip.onset, grip.onset_sd) == (0.1, 0.2, 0.02, 0.09)
    assert (grip.bias, grip.t_object_sd, grip.transit_loss) == (0.1, 0.4, 0.03)
    assert (grip.length, grip.stack) == (pytest.approx(0.018), STACK)
    assert GRIPPER.readings() == {
        "noise": 0.05, "slow_noise": 0.02, "correlation_time": 3.0, "leak": 5e-4, "quantum": 0.0
    }  # fmt: skip
    assert (Noise().white, Noise().slow, Noise().correlation_time) == (0.045, 0.018, 4.0)
    assert (Noise().misfit, Noise().growth, GRIPPER.spreads.dof) == (0.0015, 1.0, 1e6)


E, S, CONDUCTANCE, TIME = (1.0, 1e6), (0.0, 100.0), (0.0, 1e7), (1e-9, 1e4)
STORE, LOGARITHM, PRECISE = (1e-9, 1e9), (-50.0, 50.0), (1e-12, 100.0)


@pytest.mark.parametrize(
    ("part", "names", "low", "high"),
    [
        ("stack", "e_outer e_inner", *E), ("stack", "z_outer z_inner", 1e-3, 1e3),
        ("stack", "first", 0.0, 1.0),
        ("stack", "g_back g_side g_far", *CONDUCTANCE), ("stack", "lag build settle", *TIME),
        ("stack", "creep", -0.2, 10.0), ("stack", "leak", -10.0, 10.0), ("stack", "c_side", *STORE),
        ("noise", "white slow misfit", *S), ("noise", "memory", *TIME), ("noise", "growth", -10.0, 10.0),
        ("spreads", "ln_h ln_effusivity finish", *S), ("spreads", "dof insulator_dof", *STORE),
        ("spreads", "ln_build onset t_object", *PRECISE), ("slate", "ln_h ln_effusivity", *LOGARITHM),
        ("slate", "ln_h_sd ln_effusivity_sd library_sd_ln", *S), ("slate", "library_effusivity", *E),
        ("slate", "heat_capacity", *STORE), ("slate", "n_grasp", 0.0, 1e9), (None, "onset", -100.0, 100.0),
        (None, "carry", -10.0, 10.0), (None, "bias", -1e3, 1e3),
        (None, "depth_share", 1e-2, 10.0), (None, "block_length", 1e-4, 10.0),
        (None, "finish_level finish_slope", *LOGARITHM),
    ],
)  # fmt: skip
def test_what_the_numbers_of_a_file_may_be(part, names, low, high):
    for name in names.split():
        for value, fine in (
            (low, True),
            (high, True),
            (low - 1e-3 * max(abs(low), 1e-12), False),
            (high * 1.001, False),
        ):
            content = GRIPPER.to_dict()
            inner = {"slate": lambda c: c["blocks"]["slate"], None: lambda c: c}.get(part, lambda c: c[part])(
                content
            )
            assert name in inner
            inner[name] = value
            if fine:
                assert GripperModel.from_dict(content).to_dict() == content
            else:
                with pytest.raises(UserError, match=rf"not a whole device calibration.*{name}"):
                    GripperModel.from_dict(content)
