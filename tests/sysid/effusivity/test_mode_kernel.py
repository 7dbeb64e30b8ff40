"""The compiled search: its responses are the plain march's, its slopes differences, its end a minimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize
from scipy.special import gammaln

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.contact.response import far_response, step_response
from thermogrip.sysid.contact.time_stepping import first_step
from thermogrip.sysid.effusivity.data import touches, whiten
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import (
    N_NUISANCE,
    ONSET,
    find_modes,
    jacobian,
    nodes_for,
    predict,
)
from thermogrip.sysid.effusivity.priors import fit_pairs, free_hypotheses, material_hypotheses, prior_of


@pytest.fixture(scope="module")
def device():
    return load_default_gripper()


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
    rise, slope, _ = step_response(
        device.stack, nodes, effusivity=np.exp(u[:, 5]), capacity=np.exp(u[:, 6]), h_c=np.exp(u[:, 0]),
        build_up=np.exp(u[:, 1]),
    )  # fmt: skip
    f = np.zeros(data.y.shape)
    for p in range(3):
        t, bins = data.sample_t[p] - u[p, 2], data.sample_bin[p]
        at = np.where(t > 0, CubicHermiteSpline(nodes.t, rise[p], slope[p])(np.maximum(t, 0.0)), 0.0)
        f[p] = np.bincount(bins, at, f.shape[1]) / np.bincount(bins, minlength=f.shape[1])
    level, t_object = u[:, 3, None], u[:, 4, None]
    want = level + (t_object - level) * f
    want += device.stack.leak * (data.t_ambient[:, None] - level) * data.ramp
    room = far_response(device.stack, nodes, rise, effusivity=np.exp(u[:, 5]), capacity=np.exp(u[:, 6]))
    want += (data.t_ambient[:, None] - t_object) * [
        np.interp(data.t[p] - u[p, 2], nodes.t, room[p]) for p in range(3)
    ]
    np.testing.assert_allclose(predict(device.stack, nodes, data, u), want, atol=3e-4)


def test_derivatives_are_those_of_the_prediction(device, data, u):
    nodes = nodes_for(data)
    slopes = jacobian(device.stack, nodes, data, u, np.ones(u.shape, dtype=bool))[1]
    for k in range(N_NUISANCE):
        step = np.zeros(N_NUISANCE)
        step[k] = 1e-4
        up, down = (predict(device.stack, nodes, data, u + s * step) for s in (1, -1))
        # a reading within 1e-4 s of contact is on one side of it in one prediction only
        atol = 3e-3 if k == ONSET else 1e-6
        np.testing.assert_allclose(slopes[:, :, k], (up - down) / 2e-4, atol=atol, err_msg=str(k))


def test_derivatives_hold_where_a_block_is_so_thin_that_no_mode_is_left_out(device, data, u):
    """The grouped modes then end at three times the first of them, whatever e and C are."""
    nodes, thin = nodes_for(data), u.copy()
    thin[:, 5:] = np.log([[1e5, 2e4], [3e4, 1e4], [1e4, 4e3]])
    slopes = jacobian(device.stack, nodes, data, thin, np.ones(u.shape, dtype=bool))[1]
    for k in (5, 6):
        step = 1e-4 * np.eye(N_NUISANCE)[k]
        up, down = (predict(device.stack, nodes, data, thin + s * step) for s in (1, -1))
        np.testing.assert_allclose(slopes[:, :, k], (up - down) / 2e-4, atol=1e-6, err_msg=str(k))


def test_a_step_without_an_exponential_is_one_less_it():
    x = np.concatenate([[0.0], np.logspace(-12, 1.5, 60)])
    got = [first_step.py_func(v) for v in x]
    np.testing.assert_allclose(got, -np.expm1(-x), rtol=1e-14)
    assert first_step.py_func(1e6) == 1.0


@pytest.mark.parametrize("dof", [np.inf, 4.0])
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


def test_a_search_from_afar_ends_at_the_same_mode(device, data):
    row = np.arange(3)
    hypotheses = free_hypotheses(device, [10.4, 9.7, 6.2])
    near = fit_pairs(device, data, row, hypotheses)
    start = near.u + np.array([0.5, 0.1, 0.1, 0.3, -0.5, 0.0, 0.2])
    again = fit_pairs(device, data, row, hypotheses, start=start)
    np.testing.assert_allclose(again.log_evidence, near.log_evidence, atol=0.02)
    assert again.converged.all()


def test_lost_samples_and_unknown_rooms_are_left_out(device, data):
    blind = replace(data, t_ambient=np.full(3, np.nan))
    nodes = nodes_for(data)
    prior = prior_of(device, blind, free_hypotheses(device, [10.4, 9.7, 6.2]))
    mode = find_modes(device.stack, blind, np.arange(blind.level.size), whiten(blind, device.noise), prior)
    assert np.isfinite(mode.log_evidence).all()
    no_leak = replace(device.stack, leak=0.0)
    np.testing.assert_allclose(
        predict(device.stack, nodes, blind, mode.u), predict(no_leak, nodes, blind, mode.u), atol=1e-12
    )
