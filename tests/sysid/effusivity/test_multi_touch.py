"""Touches of one block have a smaller uncertainty than one touch, and intervals that cover."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from thermogrip.classify import classify_grasps
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity import multi_touch
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import material_hypotheses
from thermogrip.sysid.effusivity.multi_touch import (
    Coupling,
    Factor,
    Traces,
    combine,
    free_touch_fit,
    joint_prior,
    learn_coupling,
    rested_long,
    touch_groups,
    traces_of,
    two_touch_fit,
)
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_evidence, material_fit

from .makers import FIVE


@pytest.fixture(scope="module")
def record():
    grasps = load_example_grasps()["exp5_two_touch_unknown_object"]
    return grasps.isel(grasp=np.flatnonzero(np.isin(grasps["material"].values, FIVE)))


@pytest.fixture(scope="module")
def fit(device, record):
    return two_touch_fit(device, record, FIVE)


def _truth(record, fit):
    return record["material"].values[[at[0] for at in fit.rows]]


def test_two_touches_name_blocks_that_one_cannot(device, record, fit):
    """None of these grasps was in the calibration: the gripper is known, the object's temperature is not."""
    truth = _truth(record, fit)
    first = [at[0] for at in fit.rows]
    two = np.array(FIVE)[fit.log_evidence.argmax(axis=1)]
    one = np.array(FIVE)[material_evidence(device, record.isel(grasp=first), FIVE).argmax(axis=1)]
    assert (two == truth).mean() > (one == truth).mean() + 0.1
    # metal from wood is certain with two touches
    assert np.array_equal(two == "wood", truth == "wood")
    own = fit.t_object_sd[np.arange(truth.size), [FIVE.index(m) for m in truth]]
    assert own.max() < 0.6


def test_one_touch_alone_is_the_single_fit(device, record):
    """With the scatter of single grasps, known well, a group of one says what the engine says of a grasp."""
    device = replace(device, spreads=replace(device.spreads, dof=1e9, insulator_dof=1e9))
    coupling = replace(Coupling(), ln_h_sd=device.spreads.ln_h)
    alone = record.isel(grasp=[0, 4])
    fit = two_touch_fit(device, alone, FIVE, coupling=coupling)
    single = material_fit(device, alone, FIVE)
    near = single.log_evidence > single.log_evidence.max(axis=1, keepdims=True) - 10
    np.testing.assert_allclose(fit.log_evidence[near], single.log_evidence[near], atol=1e-4)
    np.testing.assert_allclose(fit.t_object[near], single.t_object[near], atol=1e-4)


def test_evidence_of_linear_touches_is_that_of_a_normal_distribution():
    """Two touches that read x plus noise, with a correlated prior: an independent density agrees."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((8, 8))
    prior, mean, noise = root @ root.T, rng.standard_normal(8), 0.3
    seen, centre = rng.standard_normal(8), rng.standard_normal((2, 4))
    away = seen.reshape(2, 4) - centre
    factor = Factor(
        log_size=-0.5 * (away**2).sum(axis=1) / noise**2 - 2 * np.log(2 * np.pi * noise**2),
        centre=centre,
        eta=away / noise**2,
        precision=np.repeat(np.eye(4)[None] / noise**2, 2, axis=0),
    )
    joint = combine(factor, mean, prior)
    total = prior + noise**2 * np.eye(8)
    assert joint.log_evidence == pytest.approx(multivariate_normal(mean, total).logpdf(seen), abs=1e-9)
    gain = prior @ np.linalg.inv(total)
    np.testing.assert_allclose(joint.mean, mean + gain @ (seen - mean), atol=1e-9)
    np.testing.assert_allclose(joint.covariance, prior - gain @ prior, atol=1e-9)


def test_a_prior_without_width_is_known_exactly():
    factor = Factor(np.zeros(1), np.zeros((1, 4)), np.ones((1, 4)), np.eye(4)[None])
    joint = combine(factor, np.full(4, 2.0), np.zeros((4, 4)))
    assert joint.log_evidence == pytest.approx(4 * (2.0 - 0.5 * 2.0**2))
    np.testing.assert_array_equal(joint.mean, np.full(4, 2.0))


def test_the_order_of_the_touches_is_that_of_the_column(record):
    """Rows may come in any order; the column ``touch`` says which was first."""
    shuffled = record.isel(grasp=slice(None, None, -1))
    groups = touch_groups(shuffled)
    assert sum(len(at) for at in groups.values()) == record.sizes["grasp"] > 0
    for name, at in groups.items():
        assert shuffled["grasp"].values[at].tolist() == [f"{name}_1", f"{name}_2"]


def test_a_metal_forgets_where_it_was_touched_and_wood_does_not(device, record):
    """In metal the drop is the heat that left over the heat capacity at any time; in wood it fades."""
    data = touches(record)
    rest = np.full(data.level.size, 60.0)
    left = traces_of(device, data, rest, material_hypotheses(device, ["copper", "wood"]))
    early, late = left.drop(30.0), left.drop(600.0)
    assert late[0] == pytest.approx(early[0], rel=1e-3)
    assert late[1] < 0.6 * early[1]
    even = left.moved[:, 0] * np.exp(-left.decay[:, 0] * 60.0)  # the mode of even temperature
    assert left.drop(60.0)[0] == pytest.approx(even[0], rel=1e-3)


def test_learnt_coupling_makes_its_groups_likelier(device, record):
    train = record.isel(grasp=np.flatnonzero(record["split"].values == "train"))
    learnt = learn_coupling(device, train)

    def likelihood(coupling: Coupling) -> float:
        fit = two_touch_fit(device, train, FIVE, coupling=coupling)
        return float(sum(fit.log_evidence[i, FIVE.index(m)] for i, m in enumerate(_truth(train, fit))))

    assert likelihood(learnt) > likelihood(Coupling(found=0.0, loss=1.0))
    assert likelihood(learnt) >= likelihood(Coupling()) - 0.5
    assert 0.6 < learnt.found < 1.1  # part of the heat is missing, most is there


def test_touches_bound_the_effusivity_that_one_leaves_open(device, record):
    """Wood of unknown temperature: one touch knows e to a factor of 1.3 at best, two know it and T."""
    group = record.isel(grasp=np.flatnonzero(record["touch_group"].values == "p028"))
    two = effusivity_posterior(device, group)
    one = effusivity_posterior(device, group.drop_vars("touch_group"))
    assert two[0].effusivity == two[1].effusivity
    assert two[0].effusivity_p05 < 367.0 < two[0].effusivity_p95
    for a, b in zip(two, one):
        assert a.t_object_p95 - a.t_object_p05 < 0.5 * (b.t_object_p95 - b.t_object_p05)
    assert len(free_touch_fit(device, group)["p028"]) == 2


def test_coupling_survives_its_file_and_damage_is_reported(tmp_path):
    coupling = Coupling(found=0.8, loss=90.0, sd=0.3, ln_h_sd=0.1, longest_rest=120.0)
    file = coupling.save(tmp_path / "c.json")
    assert Coupling.load(file) == coupling
    content = json.loads(file.read_text())
    del content["longest_rest"]  # as earlier versions wrote it
    file.write_text(json.dumps(content))
    earlier = Coupling.load(file)
    assert earlier == replace(coupling, longest_rest=np.inf)
    assert Coupling.load(earlier.save(file)) == earlier
    with pytest.raises(UserError, match="not a whole coupling"):
        Coupling.from_dict({"found": 0.8})
    with pytest.raises(ValueError, match="sd > 0"):
        Coupling(sd=0.0)


def test_a_record_without_groups_is_refused(device, record):
    with pytest.raises(UserError, match="no touch_group"):
        two_touch_fit(device, record.drop_vars("touch_group"), FIVE)
    with pytest.raises(UserError, match="no material"):
        learn_coupling(device, record.drop_vars("material"))


def test_a_hypothesis_that_contradicts_itself_is_not_carried_away(device):
    """Metal at a conductance of nothing: no expansion may reach for a block of hundreds of degrees."""
    grasps = load_example_grasps()["exp5_two_touch_unknown_object"]
    groups = ["p006", "p026", "p036"]
    few = grasps.isel(grasp=np.flatnonzero(np.isin(grasps["touch_group"].values, groups)))
    names = ["iron", "stainless", "wood", "zinc"]
    known = two_touch_fit(device, few, names)
    free = free_touch_fit(device, few)
    assert sorted(known.groups) == groups
    for name, row, t in zip(known.groups, known.log_evidence, known.t_object, strict=True):
        best = int(row.argmax())
        mean = float((free[name][0].weight * free[name][0].t_object).sum())
        assert mean == pytest.approx(t[best], abs=2.0)
        # a free effusivity cannot fit much better than a material whose block was touched before
        assert free[name][0].log_evidence < row[best] + 4.0


def test_a_rest_longer_than_those_of_the_training_is_noted():
    two = load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[24, 25, 72, 73])
    learnt = Coupling(longest_rest=60.0)
    for rest, expected in ((60.0, False), (90.0, False), (300.0, True)):
        waited = two.assign(rest=("grasp", [np.nan, np.nan, 60.0, rest]))
        assert rested_long(waited, learnt).tolist() == [False, expected, False, expected]
    assert not rested_long(waited, replace(learnt, longest_rest=300.0)).any()
    known = PosteriorClassifier().with_device(load_default_gripper(), learnt)
    notes = [row.get("note", "") for row in classify_grasps(known, waited, ["copper", "wood"])]
    assert notes == ["", "rested longer than the 60 s of the training: the answer may be too confident"] * 2


@pytest.mark.parametrize(
    ("rest", "room", "way"),
    [(0.0, 22.0, [0.0, 0.0]), (1e9, 22.0, [-38.0, -8.0]), (1e9, np.nan, [0.0, 0.0]), (600.0, 22.0, None)],
)
def test_of_the_way_to_the_room_a_share_is_uncertain(rest, room, way):
    """Two hypotheses, one that lost 5 K by the touch; at 60 and at 30 degC, the skin at 40."""
    coupling = Coupling(found=1.0, loss=100.0, sd=0.3)
    capacity, both = np.array([7e4, 2e4]), np.ones(2)
    traces = Traces(moved=np.zeros((2, 1)), decay=np.ones((2, 1)), capacity=capacity, skin=40.0 * both,
                    room=room * both, rest=np.array([0, rest]))  # fmt: skip
    mean, variance = np.tile([50.0, 7.0, 9.0, 11.0], (2, 1)), np.array([4.0, 9.0])
    about = np.array([[60.0, np.nan], [30.0, np.nan]])
    shared = (np.zeros(2), np.zeros(2), np.zeros(2))
    mu, p = joint_prior(coupling, traces, np.array([0, 1]), (mean, variance), shared, about)
    stay = np.exp(-100.0 * rest / capacity) if np.isfinite(room) else np.ones(2)
    if way is None:
        way = (1 - stay) * (22.0 - about[:, 0])
    np.testing.assert_allclose(p[:, 4, 4], stay**2 * variance + 0.3**2 + (0.15 * np.array(way)) ** 2)
    np.testing.assert_allclose(mu[:, 4], 50.0 * stay + (1 - stay) * np.nan_to_num(room))


def test_the_way_begins_where_the_touches_found_the_block(record):
    """Not where the prior has it, which knows no more than the skin's temperature here."""
    at = touch_groups(record)["p000"]
    device = load_default_gripper()
    view = multi_touch._view(device, record, material_hypotheses(device, FIVE), Coupling())
    factor = multi_touch._factors(view, [at])[0]
    mean, p = multi_touch._prior(view, at, view.coupling, factor)
    first = combine(factor, mean, p).mean[:, 0]
    skin, room = view.data.level[at[0]], view.data.t_ambient[at[0]]
    assert np.all(np.abs(first - skin) > 3.0)
    rest = float(view.traces.rest[at[1]])
    taken = 0.75 * view.traces.drop(rest)
    left = first - taken * (first - skin)
    stay = np.exp(-100.0 * rest / view.traces.capacity)
    variance = 0.36**2 + (0.15 * (1 - stay) * (room - left)) ** 2
    np.testing.assert_allclose(p[:, 4, 4], (stay * (1 - taken)) ** 2 * p[:, 0, 0] + variance, rtol=0.05)
    assert variance.max() > 1.2 * 0.36**2
