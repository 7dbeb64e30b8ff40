"""Modes and evidences of single grasps against general optimisers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize
from scipy.special import gammaln

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.contact.materials import find_material
from thermogrip.sysid.contact.simulation import far_response, step_response
from thermogrip.sysid.effusivity import laplace_approximation as laplace
from thermogrip.sysid.effusivity import mode_kernel
from thermogrip.sysid.effusivity.data import touches, whiten
from thermogrip.sysid.effusivity.laplace_approximation import (
    N_NUISANCE,
    ONSET,
    T_OBJECT,
    Mode,
    Prior,
    find_modes,
    fit_pairs,
    free_hypotheses,
    jacobian,
    joined_modes,
    material_hypotheses,
    nodes_for,
    predict,
    prior_of,
    widened,
)

from .makers import simulated


@pytest.fixture(scope="module")
def data():
    """A grasp of copper, one of iron, one of wood, at a difference of 20 K."""
    return touches(load_example_grasps()["exp2_dT20"].isel(grasp=[1, 9, 17]))


@pytest.fixture(scope="module")
def u(device, data):
    """Three points away from anything's centre."""
    prior = prior_of(device, data, free_hypotheses(device, [10.4, 9.7, 6.2]))
    shift = np.array([0.2, -0.3, 0.07, 0.1, -0.4, 0.05, 0.1])
    return prior.mean + shift * np.array([[1.0], [-1.0], [0.5]])


def test_readings_are_bin_means_of_the_curve_later_by_the_onset(device, data, u):
    nodes = nodes_for(data)
    response = step_response(
        device.stack, nodes, effusivity=np.exp(u[:, 5]), capacity=np.exp(u[:, 6]), h_c=np.exp(u[:, 0]),
        build_up=np.exp(u[:, 1]),
 )  # fmt: skip
    f = np.zeros(data.y.shape)
    for p in range(3):
        t, bins = data.sample_t[p] - u[p, 2], data.sample_bin[p]
        at = np.where(
            t > 0, CubicHermiteSpline(nodes.t, response.rise[p], response.slope[p])(np.maximum(t, 0.0)), 0.0
        )
        f[p] = np.bincount(bins, at, f.shape[1]) / np.bincount(bins, minlength=f.shape[1])
    level, t_object = u[:, 3, None], u[:, 4, None]
    want = level + (t_object - level) * f
    want += device.stack.leak * (data.t_ambient[:, None] - level) * data.ramp
    room = far_response(
        device.stack, nodes, response.rise, effusivity=np.exp(u[:, 5]), capacity=np.exp(u[:, 6])
    )
    want += (data.t_ambient[:, None] - t_object) * [
        np.interp(data.t[p] - u[p, 2], nodes.t, room[p]) for p in range(3)
    ]
    np.testing.assert_allclose(predict(device.stack, nodes, data, u), want, atol=3e-4)


@pytest.mark.parametrize("thin", [False, True])
@pytest.mark.parametrize("room", [True, False])
def test_derivatives_are_those_of_the_prediction(device, data, u, thin, room):
    """Also where a block is so thin that the grouped modes end at three times the first of them."""
    nodes, u = nodes_for(data), u.copy()
    if thin:
        u[:, 5:] = np.log([[1e5, 2e4], [3e4, 1e4], [1e4, 4e3]])
    if not room:
        data = replace(data, t_ambient=np.full(3, np.nan))
    y, slopes = jacobian(device.stack, nodes, data, u, np.ones(u.shape, dtype=bool))
    np.testing.assert_allclose(y, predict(device.stack, nodes, data, u), rtol=1e-12)
    for k in range(N_NUISANCE):
        step = 1e-4 * np.eye(N_NUISANCE)[k]
        up, down = (predict(device.stack, nodes, data, u + s * step) for s in (1, -1))
        # a reading within 1e-4 s of contact is on one side of it in one prediction only
        atol = 3e-3 if k == ONSET else 1e-6
        np.testing.assert_allclose(slopes[:, :, k], (up - down) / 2e-4, atol=atol, err_msg=str(k))


@pytest.mark.parametrize("dof", [np.inf, 5.0])
def test_the_search_ends_where_a_general_optimiser_does(device, data, dof):
    """And its evidence is Laplace's, put together again from numerical second derivatives."""
    spreads = device.spreads if np.isinf(dof) else replace(device.spreads, dof=dof, insulator_dof=dof)
    ours = replace(device, spreads=spreads)
    hypothesis = material_hypotheses(ours, ["iron"])
    one = data.take(np.array([1]))
    prior = prior_of(ours, one, hypothesis)
    if np.isinf(dof):
        prior = prior._replace(dof=None)
    w, log_det = whiten(one, ours.noise)
    found = find_modes(ours.stack, one, np.arange(one.level.size), (w, log_det), prior)
    free = np.flatnonzero(prior.sd[0] > 0)
    law = np.full(N_NUISANCE, np.inf) if prior.dof is None else prior.dof[0]

    def cost(z):
        v = prior.mean.copy()
        v[0, free] += prior.sd[0, free] * z
        residual = w[0] @ (one.y - predict(ours.stack, nodes_for(one), one, v))[0]
        heavy = np.isfinite(law[free])
        nu = np.where(heavy, law[free], 1.0)
        return float((residual**2).sum() + np.where(heavy, (nu + 1) * np.log1p(z**2 / nu), z**2).sum())

    start = (found.u[0, free] - prior.mean[0, free]) / prior.sd[0, free]
    best = minimize(cost, start, method="Powell", options={"xtol": 1e-5, "ftol": 1e-10})
    assert cost(start) < best.fun + 0.02
    np.testing.assert_allclose(start, best.x, atol=0.05)
    eye, h = np.eye(free.size), 0.02
    curvature = np.array(
        [
            [
                cost(start + h * (a + b)) - cost(start + h * (a - b)) - cost(start - h * (a - b))
                + cost(start - h * (a + b))
                for a in eye
            ]
            for b in eye
        ]
 ) / (8 * h**2)  # fmt: skip
    nu = law[free][np.isfinite(law[free])]
    peak = (gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu)).sum()
    want = -0.5 * (cost(start) + np.linalg.slogdet(curvature)[1] + log_det[0]) + peak
    assert found.log_evidence[0] == pytest.approx(want, abs=0.1)


def test_few_degrees_of_freedom_forgive_a_far_grasp(device, data):
    """Twice the usual conductance is far out for a normal spread, less so for one that 5 grasps taught."""
    block = device.blocks["copper"]
    far = replace(device, blocks={**device.blocks, "copper": replace(block, ln_h=block.ln_h + 0.7)})
    unsure = replace(far, spreads=replace(far.spreads, dof=4.0))
    row = np.array([0])
    sure, mild = (
        fit_pairs(d, data, row, material_hypotheses(d, ["copper"])).log_evidence[0] for d in (far, unsure)
    )
    assert mild > sure + 10


def test_the_compiled_search_has_the_slopes_of_the_prediction(device, monkeypatch):
    """Its covariance is that of the least squares that ``jacobian`` says, all seven nuisances unknown."""
    leaky = replace(device, stack=replace(device.stack, g_far=3000.0))
    data = touches(simulated(leaky, ["iron", "zinc"], n=1, t_gripper=38.0, t_object=43.0))
    prior = prior_of(leaky, data, material_hypotheses(leaky, ["iron", "zinc"]))
    sd = np.where(prior.sd > 0, prior.sd, 0.3)
    whitener = whiten(data, leaky.noise)
    monkeypatch.setattr(mode_kernel, "SEARCH", mode_kernel.SearchSettings(most_steps=60))
    found = find_modes(leaky.stack, data, np.arange(data.level.size), whitener, Prior(prior.mean, sd))
    slopes = jacobian(leaky.stack, nodes_for(data), data, found.u, sd > 0)[1]
    for i in range(2):
        j = whitener[0][i] @ slopes[i]
        want = np.linalg.inv(j.T @ j + np.diag(sd[i] ** -2.0))
        # the search is over when a step predicts no gain, a little before it ends
        np.testing.assert_allclose(found.covariance[i] / np.outer(sd[i], sd[i]),
                                   want / np.outer(sd[i], sd[i]), atol=2e-3)  # fmt: skip


def test_an_unknown_room_does_nothing_and_nothing_is_done_where_the_room_is_as_warm(device):
    grasps = simulated(device, ["copper", "iron"], n=1, t_gripper=23.0, t_object=43.0)
    data = touches(grasps)
    u = prior_of(device, data, material_hypotheses(device, ["copper", "iron"])).mean
    bare = replace(device.stack, leak=0.0)
    nodes = nodes_for(data)
    with_room = predict(bare, nodes, data, u)
    unknown = replace(data, t_ambient=np.full(2, np.nan))
    whitener, leaky = whiten(unknown, device.noise), predict(device.stack, nodes, unknown, u)
    assert np.isfinite(
        find_modes(device.stack, unknown, np.arange(2), whitener, Prior(u, 0 * u + 0.1)).u
    ).all()
    np.testing.assert_allclose(leaky, predict(bare, nodes, unknown, u), atol=1e-12)
    alike = replace(data, t_ambient=u[:, 4])
    np.testing.assert_allclose(predict(bare, nodes, unknown, u), predict(bare, nodes, alike, u), rtol=1e-12)
    colder = (predict(bare, nodes, unknown, u) - with_room)[:, -1]
    # a room 16 K below, and U / C = 0.0015 / s for ten seconds
    assert np.all((colder > 0.03) & (colder < 0.3))


@pytest.fixture(scope="module")
def touched():
    """One grasp of each of five materials, 20 K apart."""
    return load_example_grasps()["exp1A_obj43_grip23"].isel(grasp=[5, 13, 21, 29, 37])


def test_degrees_of_freedom_of_a_number_that_has_no_spread_are_none(device, touched):
    data, row, rows = touches(touched), np.array([1]), material_hypotheses(device, ["copper"])
    mean, sd, dof = prior_of(device, data.take(row), rows)
    sd[:, ONSET], many, few = 0.0, dof.copy(), dof.copy()
    many[:, ONSET], few[:, ONSET] = np.inf, 3.0
    one, same = (fit_pairs(device, data, row, rows, prior=Prior(mean, sd, nu)) for nu in (many, few))
    assert one.log_evidence[0] == pytest.approx(same.log_evidence[0], abs=1e-9)


@pytest.mark.parametrize("value", [-2.0, np.nan])
def test_a_curvature_that_is_none_is_an_error_and_no_answer(value):
    matrix, own = 3 * np.eye(8)[None], np.ones((1, 7))
    inverse, log_det = mode_kernel.curvature(matrix, own)
    np.testing.assert_allclose(inverse[0], np.eye(7) / 4)
    assert log_det[0] == pytest.approx(7 * np.log(4))
    matrix[0, 4, 4] = value
    with np.errstate(invalid="ignore"), pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        mode_kernel.curvature(matrix, own)


def test_what_each_kind_of_hypothesis_expects(device):
    block, spreads = device.blocks["wood"], device.spreads
    rows = material_hypotheses(device, ["copper", "wood", "cork"])
    cork = find_material("cork")
    found = float(device.found_effusivity(np.log([cork.effusivity]))[0])
    anew = np.hypot(spreads.ln_h_of_blocks, spreads.ln_h)
    np.testing.assert_allclose(rows.ln_h[1:], [block.ln_h, device.expected_ln_h(found)])
    np.testing.assert_allclose(rows.ln_h_sd[1:], [np.hypot(spreads.ln_h, block.ln_h_sd), anew])
    np.testing.assert_allclose(rows.ln_e[1:], [block.ln_effusivity, found])
    scale_sd = device.effusivity_scale(np.array([found]))[1][0]
    own = np.sqrt(cork.effusivity_sd_ln**2 + scale_sd**2 + spreads.ln_effusivity**2)
    np.testing.assert_allclose(rows.ln_e_sd, [0.0, spreads.ln_effusivity, own])
    np.testing.assert_allclose(rows.ln_rho_c[1:], np.log([block.heat_capacity, cork.rho * cork.c_p]))
    assert rows.ln_rho_c_sd.tolist() == [0.0, 0.0, 0.05]
    assert rows.ln_h_dof.tolist() == [spreads.dof, spreads.dof, np.inf]
    assert rows.ln_e_dof.tolist() == [np.inf, spreads.insulator_dof, np.inf]
    assert rows.block.tolist() == [device.materials.index("copper"), device.materials.index("wood"), -1]
    # half way from insulators to metals at 4500
    free = free_hypotheses(device, np.log([4500.0, 10.0, 1e6]))
    np.testing.assert_allclose(np.exp(free.ln_rho_c), [np.sqrt(1.7e6 * 3.2e6), 1.7e6, 3.2e6], rtol=1e-4)
    np.testing.assert_allclose(free.ln_rho_c_sd, [0.3, 0.4, 0.2], atol=1e-4)
    np.testing.assert_allclose(free.ln_h_sd, anew)
    by = free_hypotheses(device, np.log(4500.0) + 0.25)  # exp(-4 / 4): 1 / (1 + 1 / e) of the way
    assert by.ln_rho_c_sd[0] == pytest.approx(0.4 - 0.2 / (1 + np.exp(-1)))


@pytest.mark.parametrize(
    ("t_object", "sd", "room", "dof", "mean", "want"),
    [
        (43.0, np.nan, 28.0, 12.0, 43.0 + 0.1 - 0.02 * 15, 0.4 * np.sqrt(12 / 10)),
        (43.0, 0.3, 28.0, 12.0, 42.8, 0.3), (43.0, np.nan, np.nan, 12.0, 43.1, 0.4 * np.sqrt(12 / 10)),
        (43.0, np.nan, 28.0, 2.0, 42.8, 20 / 3**0.5), (np.nan, 0.3, 28.0, 12.0, 28.0, 20 / 3**0.5),
        (np.nan, np.nan, np.nan, 12.0, 22.5, 20 / 3**0.5),
    ],
)  # fmt: skip
def test_what_a_nominal_temperature_says_of_the_object(device, t_object, sd, room, dof, mean, want):
    ours = replace(
        device, bias=0.1, transit_loss=0.02, spreads=replace(device.spreads, t_object=0.4, dof=dof)
    )
    data = touches(make_grasps([-1.0, 1.0, 2.0], [[23.0, 24.0, 25.0]], ["a"], t_object=[t_object],
                               t_object_sd=[sd], t_ambient=[room]))  # fmt: skip
    prior = prior_of(ours, data, material_hypotheses(ours, ["wood"]))
    assert (prior.mean[0, 4], prior.sd[0, 4]) == (pytest.approx(mean), pytest.approx(want))
    assert (prior.mean[0, 3], prior.sd[0, 3], prior.mean[0, 2]) == (23.0, 3.0, ours.onset)
    assert prior.mean[0, 6] == pytest.approx(
        np.log(ours.blocks["wood"].heat_capacity * ours.block_length * ours.depth_share)
    )
    insulators = ours.spreads.insulator_dof
    assert prior.dof[0].tolist() == [dof, dof, dof, np.inf, np.inf, insulators, np.inf]


def test_a_contact_is_made_within_1_5_s_of_the_message(device, data, u):
    nodes, early, late = nodes_for(data), u.copy(), u.copy()
    assert nodes.t[-1] >= data.end + 1.5
    for at, onset in ((early, -1.5), (late, 1.5)):
        at[:, ONSET] = onset
        beyond = at.copy()
        beyond[:, ONSET] = 1.5 * onset
        np.testing.assert_array_equal(*(predict(device.stack, nodes, data, v) for v in (at, beyond)))
        vary = np.ones(u.shape, dtype=bool)
        slopes = [jacobian(device.stack, nodes, data, v, vary)[1][:, :, ONSET] for v in (at, beyond)]
        assert np.abs(slopes[0]).max() > 0.1
        assert not slopes[1].any()
    assert (
        np.abs(predict(device.stack, nodes, data, early) - predict(device.stack, nodes, data, late)).max() > 1
    )


def normal_mode(mean, variance, misfit=0.0, evidence=0.0):
    """Return one pair whose T_obj has this posterior."""
    u, covariance = np.zeros((1, 7)), np.eye(7)[None].copy()
    u[0, T_OBJECT], covariance[0, T_OBJECT, T_OBJECT] = mean, variance
    return Mode(u, covariance, np.array([evidence]), np.array([True]), np.array([misfit]))


def normal_prior(mean, sd):
    return Prior(np.full((1, 7), mean), np.full((1, 7), sd))


def test_two_sensors_on_one_object_are_the_joint_normal():
    """Readings r1 = x + noise, r2 = x + 0.4 + offset + noise of x ~ N(20, 9^2), seen under N(22, 11^2)."""
    x0, v0, own0, own_v, noise, apart, r = 20.0, 81.0, 22.0, 121.0, (1.0, 2.25), 0.4, (14.0, 15.5)

    def alone(reading, mean, variance, sigma2):
        total = variance + sigma2
        log_z = -0.5 * ((reading - mean) ** 2 / total + np.log(2 * np.pi * total))
        return normal_mode(mean + variance / total * (reading - mean), variance * sigma2 / total, 1.0, log_z)

    found = joined_modes(
        alone(r[0], x0, v0, noise[0]),
        alone(r[1], own0, own_v, noise[1]),
        normal_prior(own0, own_v**0.5),
        apart,
    )
    covariance = v0 + np.diag([noise[0], noise[1] + 0.3**2])
    off = np.array([r[0] - x0, r[1] - x0 - apart])
    want = -0.5 * (off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(2 * np.pi * covariance)[1])
    gain = np.linalg.solve(covariance, np.full(2, v0))
    assert found.log_evidence[0] == pytest.approx(want, abs=1e-9)
    assert found.u[0, T_OBJECT] == pytest.approx(x0 + gain @ off)
    assert found.covariance[0, T_OBJECT, T_OBJECT] == pytest.approx(v0 - gain @ np.full(2, v0))
    assert found.misfit[0] == 2.0


def test_a_second_sensor_that_saw_nothing_changes_nothing():
    first = normal_mode(14.0, 1.0, evidence=-3.0)
    blank = normal_mode(22.0, 121.0, evidence=0.0)
    found = joined_modes(first, blank, normal_prior(22.0, 11.0), 0.0)
    assert found.log_evidence[0] == pytest.approx(-3.0, abs=1e-6)
    np.testing.assert_allclose(found.u, first.u, atol=1e-6)


def test_the_more_a_grasp_misfits_the_less_it_says():
    prior, n = normal_prior(20.0, 11.5), np.array([40])
    pairs = [(0.0, 4.0), (40.0, 50.0), (200.0, 210.0)]  # misfits of two candidates
    gaps = []
    for misfits in pairs:
        one, two = (widened(normal_mode(10.0, 0.2, m, -0.5 * m), prior, n, 0.3) for m in misfits)
        gaps.append(float(one.log_evidence[0] - two.log_evidence[0]))
    # half of what Student's t says with 20 degrees of freedom, of readings that count half
    np.testing.assert_allclose(gaps, [15 * np.log((20 + 2 * b) / (20 + 2 * a)) for a, b in pairs])
    assert gaps[2] / 10 < 0.4 * gaps[1] / 10
    small, large = (widened(normal_mode(10.0, 0.2, m), prior, n, 0.3) for m in (10.0, 400.0))
    assert small.covariance[0, 4, 4] < large.covariance[0, 4, 4]
    # a tenth of the distance from the skin, here of 0 degC, and the bias
    width = 0.2 * (20 + 2 * 10.0) / (20 + 40) + 1.0 + 0.3**2
    assert small.covariance[0, 4, 4] == pytest.approx(1 / (1 / width + 1 / 11.5**2), rel=1e-3)


def test_the_second_sensor_is_asked_about_the_same_material(device):
    second = replace(
        device, blocks={k: replace(b, ln_h=b.ln_h - 1.0) for k, b in device.blocks.items() if k != "zinc"}
    )
    first = material_hypotheses(device, ["copper", "zinc", "aluminium"])
    other = laplace.hypotheses_of_second(device, second, first)
    own = material_hypotheses(second, ["copper", "aluminium"])
    for k, (theirs, ours) in enumerate(zip(own, other)):
        if k < 4:
            np.testing.assert_allclose(ours[[0, 2]], theirs, atol=0.02)
    # no block of the second sensor's is of zinc: its conductance is unknown there
    assert other.block.tolist() == [second.materials.index("copper"), -1, -1]
    assert other.ln_h_sd[1] > 2 * other.ln_h_sd[0]
