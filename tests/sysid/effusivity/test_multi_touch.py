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
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.contact.simulation import step_response, time_nodes
from thermogrip.sysid.effusivity import multi_touch
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import fit_pairs, material_hypotheses, prior_of
from thermogrip.sysid.effusivity.multi_touch import (
    SHARED,
    Coupling,
    Factor,
    Traces,
    combine,
    factor_of,
    free_touch_fit,
    joint_prior,
    learn_coupling,
    next_touch_prior,
    rested_long,
    touch_groups,
    traces_of,
    two_touch_fit,
)
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_fit

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
    one = np.array(FIVE)[material_fit(device, record.isel(grasp=first), FIVE).log_evidence.argmax(axis=1)]
    assert (two == truth).mean() > (one == truth).mean() + 0.1
    # metal from wood is certain with two touches
    assert np.array_equal(two == "wood", truth == "wood")
    own = fit.t_object_sd[np.arange(truth.size), [FIVE.index(m) for m in truth]]
    assert own.max() < 0.8


def test_a_temperature_far_from_the_skin_is_known_less_well(device, record, monkeypatch):
    """By 3 % of what is beyond 15 K, in quadrature, under candidates as under a free effusivity."""
    at = touch_groups(record)["p000"]
    block, names = record.isel(grasp=at), ["copper", "iron"]
    skin = touches(block).level
    near, near_free = two_touch_fit(device, block, names), free_touch_fit(device, block)["p000"]
    far = np.abs(near.t_object[0] - skin[0])
    monkeypatch.setattr(multi_touch, "BLOCK", multi_touch.BlockSettings(far_K=2.0))
    wide, wide_free = two_touch_fit(device, block, names), free_touch_fit(device, block)["p000"]
    assert far.min() > 2.0
    grown = 0.03**2 * (far**2 - 4.0 - np.maximum(far**2 - 225.0, 0.0))
    np.testing.assert_allclose(wide.t_object_sd[0] ** 2 - near.t_object_sd[0] ** 2, grown)
    for k, (a, b) in enumerate(zip(near_free, wide_free)):
        far = np.abs(a.t_object - skin[k])
        grown = 0.03**2 * (np.maximum(far**2 - 4.0, 0.0) - np.maximum(far**2 - 225.0, 0.0))
        np.testing.assert_allclose(b.t_object_sd**2 - a.t_object_sd**2, grown, atol=1e-9)
    assert near.log_evidence.tolist() == wide.log_evidence.tolist()


@pytest.mark.usefixtures("one_grade")
@pytest.mark.parametrize("sensors", [1, 2])
def test_one_touch_alone_is_the_single_fit(device, record, sensors):
    """With the scatter of single grasps, known well, a group of one says what the engine says of a grasp."""
    device = replace(device, spreads=replace(device.spreads, dof=1e9, insulator_dof=1e9))
    if sensors == 2:
        device = replace(device, second=replace(device, bias=device.bias + 0.5))
        record = record.assign(t_surface_2=record["t_surface"] + 0.5)
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
    rested = "rested longer than the 60 s of the training: the answer may be too confident"
    assert notes == ["", rested] * 2


@pytest.mark.parametrize("rest", [20.0, 180.0])
def test_blocks_that_lose_otherwise_are_named_as_well(device, record, rest):
    """All rested 60 s: by what their rows say of it, they lost three times as much as expected or a third."""
    known = PosteriorClassifier().with_device(device)
    p = known.predict_proba(record.assign(rest=("grasp", np.full(record.sizes["grasp"], rest))))
    true = np.searchsorted(known.classes_, record["material"].values)
    assert (p.argmax(axis=1) == true).mean() > 0.8  # 0.87 where the rests are right
    assert -np.log(p[np.arange(true.size), true]).mean() < 0.4  # 0.34


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


def test_three_touches_move_one_block_as_computed_by_hand():
    """A drop of 0.2 + 0.1 / 2 of which 0.8 is found; half of the way to the room in each rest of 60 s."""
    traces = Traces(
        moved=np.array([[0.2, 0.1]]), decay=np.array([[0.0, np.log(2) / 62]]),
            capacity=np.array([6e3 / np.log(2)]),
        skin=np.array([30.0, 25.0, 20.0]), room=np.array([12.0, 99.0, 10.0]), rest=np.array([60.0, 60.0,
            7.0]),
    )  # fmt: skip
    coupling, rows = Coupling(found=0.8, loss=100.0, sd=0.5, ln_h_sd=0.1), np.array([2, 0, 1])
    shared = (np.array([4.0]), np.array([0.01]), np.array([0.09]))
    one = np.array([[50.0, 7.0, 9.0, 11.0]]), np.array([9.0])
    for about, ways in ((None, (0.0, 0.0)), (np.array([[45.0, 28.0, np.nan]]), (-15.0, -8.2))):
        mu, p = joint_prior(coupling, traces, rows, one, shared, about)
        np.testing.assert_allclose(mu, [[50, 7, 9, 11, 27, 7, 9, 11, 19.8, 7, 9, 11]])
        want = np.kron(np.ones((3, 3)), np.diag([0.0, 4.0, 0.01, 0.09]))
        want[[1, 5, 9], [1, 5, 9]] += 0.01
        law = 0.15 + 0.25 * 0.5 ** (60 / 62)  # the slower of its modes has lost half in 62 s
        second = 0.16 * 9 + 0.25 + (law * ways[0]) ** 2
        third = 0.16 * second + 0.25 + (law * ways[1]) ** 2
        want[np.ix_([0, 4, 8], [0, 4, 8])] = [
            [9.0, 3.6, 1.44], [3.6, second, 0.4 * second], [1.44, 0.4 * second, third]
        ]  # fmt: skip
        np.testing.assert_allclose(p[0], want, atol=1e-12)


@pytest.mark.parametrize("name", ["copper", "wood"])
def test_what_a_touch_leaves_is_what_cells_keep(device, record, name):
    """The face of an insulated block of 200 cells, under the flux of the touch and then at rest."""
    data, hypothesis = touches(record), material_hypotheses(device, [name])
    traces = traces_of(device, data, np.array([np.nan, 45.0] * (data.level.size // 2)), hypothesis)
    assert traces.rest[:2].tolist() == [60.0, 45.0]
    assert (traces.skin[3], traces.room[3]) == (data.level[3], data.t_ambient[3])
    e, h = (float(np.exp(v[0])) for v in (hypothesis.ln_e, hypothesis.ln_h))
    capacity = float(np.exp(hypothesis.ln_rho_c[0])) * 0.02 * device.depth_share
    assert traces.capacity == pytest.approx(capacity)
    nodes = time_nodes(10.0)
    flux = step_response(device.stack, nodes, effusivity=[e], capacity=[capacity], h_c=[h]).flux[0]
    n = 200
    link, cell = n * e**2 / capacity, capacity / n
    matrix = (
        (np.diag(np.full(n - 1, 1.0), 1) + np.diag(np.full(n - 1, 1.0), -1) - 2 * np.eye(n)) * link / cell
    )
    matrix[0, 0] = matrix[-1, -1] = -link / cell
    lam, vectors = np.linalg.eigh(matrix)
    t = np.linspace(0.0, nodes.t[nodes.t <= 10.0][-1], 4001)  # the flux is taken until its last node
    for rest in (0.0, 30.0, 300.0):
        face = vectors[0] ** 2 @ np.exp(lam[:, None] * (10.0 - t + rest + 2.0)) / cell
        want = np.trapezoid(face * np.interp(t, nodes.t, flux), t)
        assert traces.drop(rest)[0] == pytest.approx(want, rel=0.01)


def test_dividing_the_prior_out_and_multiplying_it_in_again_is_nothing(device, record):
    """Also where a nuisance is known: the factor of a touch, with its own prior, is the fit itself."""
    data, hypotheses = touches(record.isel(grasp=[0])), material_hypotheses(device, ["wood"])
    prior = prior_of(device, data, hypotheses)
    mode = fit_pairs(device, data, np.array([0]), hypotheses, prior=prior._replace(dof=None))
    factor, at = factor_of(mode, prior), list(SHARED)
    joint = combine(factor, prior.mean[:, at][0], np.diag(prior.sd[0, at] ** 2))
    assert np.count_nonzero(prior.sd[0, at]) == 3
    assert joint.log_evidence == pytest.approx(mode.log_evidence[0], abs=1e-8)
    np.testing.assert_allclose(joint.mean, mode.u[0, at], atol=1e-9)
    np.testing.assert_allclose(joint.covariance, mode.covariance[0][np.ix_(at, at)], atol=1e-12)


@pytest.mark.parametrize(
    ("given", "fine"),
    [
        ({"found": 0.0}, True), ({"found": 2.0}, True), ({"found": -0.01}, False), ({"found": 2.01}, False),
        ({"loss": 0.0}, True), ({"loss": -1.0}, False), ({"sd": 0.0}, False), ({"ln_h_sd": 0.0}, False),
        ({"longest_rest": 0.0}, True),
    ],
)  # fmt: skip
def test_which_couplings_there_are(given, fine):
    whole = {"found": 0.75, "loss": 100.0, "sd": 0.36, "ln_h_sd": 0.12, "longest_rest": 60.0}
    assert Coupling().to_dict() == whole
    # 3 % of the distance, in quadrature beyond 15 K
    np.testing.assert_allclose(
        Coupling(sd=0.3).touch_sd(np.array([0.0, -15.0, 25.0])), [0.15, 0.15, np.hypot(0.15, 0.6)]
    )
    if fine:
        assert Coupling.from_dict(whole | given) == Coupling(**given)
        return
    with pytest.raises(ValueError, match="need 0 <= found <= 2, loss >= 0, sd > 0, ln_h_sd > 0"):
        Coupling(**given)
    with pytest.raises(UserError, match="is not a whole coupling of touches"):
        Coupling.from_dict(whole | given)


def test_a_coupling_is_learnt_from_where_it_starts_and_keeps_the_longest_rest(device, record):
    """Two groups move it a little: of found by up to half, of the two scatters by up to a fifth each."""
    two = record.isel(grasp=np.flatnonzero(np.isin(record["touch_group"].values, ["p000", "p028"])))
    two = two.assign(rest=("grasp", np.where(two["touch"].values == 1, 900.0, 70.0)))
    start = Coupling(found=0.9, loss=80.0, sd=0.5, ln_h_sd=0.2, longest_rest=40.0)
    learnt, longer = (
        learn_coupling(device, two, start=replace(start, longest_rest=r)) for r in (40.0, 400.0)
    )
    assert (learnt.longest_rest, longer.longest_rest) == (70.0, 400.0)
    assert learnt.sd == pytest.approx(longer.sd)
    assert learn_coupling(device, two).longest_rest == 70.0
    moved = np.log([getattr(learnt, k) / getattr(start, k) for k in ("found", "loss", "sd", "ln_h_sd")])
    assert np.all(np.abs(moved) < 2 * np.array([0.5, 1.0, 0.2, 0.2]))
    assert np.abs(moved).max() > 0.01


@pytest.mark.parametrize("touched", [1, 2])
def test_another_touch_expects_what_the_touches_found_moved_on(device, record, touched):
    """Of a block that loses nothing the drop moves what was found towards the skin; h scatters anew."""
    names = ["copper", "wood"]
    block = record.isel(grasp=touch_groups(record)["p000"][:touched])
    coupling = Coupling(found=0.0, loss=0.0, sd=0.3, ln_h_sd=0.2)
    prior = next_touch_prior(device, block, names, coupling=coupling, rest=30.0)
    fit = two_touch_fit(device, block, names, coupling=coupling)
    np.testing.assert_allclose(prior.log_evidence, fit.log_evidence[0], atol=1e-9)
    if touched == 1:
        np.testing.assert_allclose(prior.mean[:, 0], fit.t_object[0], atol=1e-6)
    assert np.all(prior.covariance[:, 0, 0] > 0.09)
    assert np.all(prior.covariance[:, 1, 1] > 0.04)
    skin = float(touches(block).level[-1])
    taken = next_touch_prior(device, block, names, coupling=replace(coupling, found=1.0), rest=30.0)
    assert np.all(np.abs(taken.mean[:, 0] - skin) < np.abs(prior.mean[:, 0] - skin))


def test_another_touch_is_of_a_record_of_one_block_in_any_order(device, record):
    pair = record.isel(grasp=touch_groups(record)["p000"])
    for same, rows in (
        (pair.isel(grasp=[0]), pair.isel(grasp=[0]).drop_vars("touch_group")),
        (pair, pair.isel(grasp=[1, 0])),
    ):
        for one, other in zip(*(next_touch_prior(device, some, FIVE) for some in (same, rows))):
            np.testing.assert_allclose(other, one)
    stray = pair.isel(grasp=[0, 1, 1])
    stray = stray.assign(touch_group=("grasp", ["p000", "p000", ""]))
    for several in (record.isel(grasp=[0, 1, 2, 3]), stray):
        with pytest.raises(UserError, match="touches of several blocks; give those of one block"):
            next_touch_prior(device, several, FIVE)


def test_the_longest_rest_is_between_touches():
    skins = [[23.0, 23.0, 30.0]] * 4
    grasps = make_grasps(
        [-1.0, 0.0, 5.0], skins, list("abcd"), touch_group=["p", "p", "q", "p"], touch=[2, 1, 1, 3],
        rest=[45.0, 500.0, 500.0, np.nan],
    )  # fmt: skip
    for learnt, longer in ((39.0, True), (41.0, False)):  # unless given, a rest is of 60 s
        rested = rested_long(grasps, Coupling(longest_rest=learnt))
        assert rested.tolist() == [longer, longer, False, longer]
    assert not rested_long(grasps.drop_vars("touch_group")).any()
