"""The simulated contact against closed forms that share no line with it, and its derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.contact.finite_bodies import (
    block_contact_flux,
    half_space,
    layer_on,
    slab,
    two_body_flux,
)
from thermogrip.sysid.contact.half_spaces import sensor_temperature
from thermogrip.sysid.contact.response import Stack, block_modes, step_response, time_nodes
from thermogrip.sysid.effusivity.data import Noise, noise_covariance, noise_fit, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import N_NUISANCE, ONSET, jacobian, nodes_for, predict

# one layer, contact at once and for good: what the closed forms describe
PLAIN = Stack(
    e_outer=1600.0,
    z_outer=1e-3,
    e_inner=1600.0,
    z_inner=25.0,
    g_back=0.0,
    lag=0.5,
    first=1.0,
    build_up=1.0,
    creep=0.0,
)
TIME = np.round(np.arange(-2.0, 10.05, 0.1), 1)


@pytest.mark.parametrize("h_c", [200.0, 1000.0])
@pytest.mark.parametrize("e_obj", [367.0, 1.6e4])
def test_one_layer_on_a_deep_block_reads_the_closed_form(e_obj, h_c):
    nodes = time_nodes(10.0)
    rise = step_response(PLAIN, nodes, effusivity=[e_obj], capacity=[e_obj * 50], h_c=[h_c])[0][0]
    want = sensor_temperature(nodes.t, T_dev0=0.0, T_obj0=1.0, e_dev=1600.0, e_obj=e_obj, h_c=h_c, lag=0.5)
    near = nodes.t < 10
    np.testing.assert_allclose(rise[near], want[near], atol=2e-3)


def test_flux_from_a_finite_block_is_the_closed_forms():
    nodes = time_nodes(40.0)
    flux = step_response(PLAIN, nodes, effusivity=[3.64e4], capacity=[68600.0], h_c=[800.0])[2][0]
    late = (nodes.t > 0.05) & (nodes.t < 40)
    want = block_contact_flux(
        nodes.t[late], T_dev0=0, T_obj0=1, e_dev=1600.0, e_obj=3.64e4, capacity=68600.0, h_c=800.0
    )
    np.testing.assert_allclose(flux[late], want, rtol=4e-3)


def test_two_layers_are_the_layered_impedance():
    stack = replace(PLAIN, e_outer=600.0, z_outer=0.4)
    nodes = time_nodes(20.0)
    flux = step_response(stack, nodes, effusivity=[1.6e4], capacity=[6e4], h_c=[500.0])[2][0]
    some = (nodes.t > 0.1) & (nodes.t < 20)
    dev = layer_on(600.0, 600.0 * 0.4, half_space(1600.0))
    want = two_body_flux(nodes.t[some], dev=dev, obj=slab(1.6e4, 6e4), T_dev0=0, T_obj0=1, h_c=500.0)
    np.testing.assert_allclose(flux[some], want, rtol=6e-3)


def test_a_stiff_contact_tends_to_perfect_contact():
    nodes = time_nodes(5.0)
    rise = step_response(PLAIN, nodes, effusivity=[5e3], capacity=[5e5], h_c=[1e7])[0][0]
    want = sensor_temperature(nodes.t, T_dev0=0, T_obj0=1, e_dev=1600.0, e_obj=5e3, lag=0.5)
    later = nodes.t > 0.2
    np.testing.assert_allclose(rise[later], want[later], atol=5e-3)


def test_a_finite_block_is_a_half_space_at_short_times():
    nodes = time_nodes(1.0)
    both = step_response(PLAIN, nodes, effusivity=[1.6e4, 1.6e4], capacity=[7e4, 7e6], h_c=[1e3, 1e3])[0]
    early = nodes.t < 0.05 * (7e4 / 1.6e4) ** 2
    np.testing.assert_allclose(both[0, early], both[1, early], rtol=1e-5)


def test_heat_is_conserved_in_a_closed_gripper():
    """Nothing leaks, so all of gripper, side store and block end at the mean over their capacities."""
    stack = replace(PLAIN, e_inner=2e3, z_inner=5.0, g_side=300.0, c_side=2.5e4)
    nodes = time_nodes(3e5)
    capacity, own = 6e4, 1600.0 * 1e-3 + 2e3 * 5.0 + 2.5e4
    rise, _, flux = step_response(stack, nodes, effusivity=[1.6e4], capacity=[capacity], h_c=[800.0])
    assert rise[0, -1] == pytest.approx(capacity / (capacity + own), rel=1e-4)
    given = np.trapezoid(flux[0], nodes.t)
    assert given == pytest.approx(capacity * own / (capacity + own), rel=1e-3)


def test_modes_of_a_block_sum_to_its_image_series():
    e, c = 500.0, 24080.0
    lam, weight, _ = block_modes([e], [c])
    for t in (0.01, 0.3, 10.0, 3e3):
        n = np.arange(1, 40)
        # theta function: the same kernel as a half-space plus its images
        want = (1 + 2 * np.exp(-((n * c / e) ** 2) / t).sum()) / (e * np.sqrt(np.pi * t))
        assert (weight * np.exp(-lam * t)).sum() == pytest.approx(want, rel=1e-5)


@pytest.fixture(scope="module")
def case():
    device = load_default_gripper()
    data = touches(
        make_grasps(TIME, np.full((3, TIME.size), 23.0), ["a", "b", "c"], t_ambient=[27.0, 20.0, np.nan])
    )
    u = np.array(
        [
            [7.0, -0.8, 0.05, 23.0, 43.0, 10.4, 11.1],
            [6.5, -0.5, -0.07, 48.0, 28.0, 6.0, 10.0],
            [6.9, -0.8, 0.0, 38.0, 18.0, 9.7, 11.0],
        ]
    )
    return device.stack, nodes_for(data), data, u


def test_derivatives_are_those_of_the_prediction(case):
    stack, nodes, data, u = case
    y, slopes = jacobian(stack, nodes, data, u, np.ones(u.shape, dtype=bool))
    np.testing.assert_allclose(y, predict(stack, nodes, data, u), rtol=1e-12)
    for k in range(N_NUISANCE):
        step = np.zeros(N_NUISANCE)
        step[k] = 1e-3
        want = (predict(stack, nodes, data, u + step) - predict(stack, nodes, data, u - step)) / 2e-3
        # the onset meets the corner of the response inside one sample
        bins = np.abs(data.t) > 0.15 if k == ONSET else np.ones(data.t.shape, dtype=bool)
        np.testing.assert_allclose(slopes[:, :, k][bins], want[bins], atol=3e-3 * np.abs(want).max())


def test_a_later_onset_is_a_later_clock(case):
    stack, nodes, _, u = case
    stack = replace(stack, leak=0.0)  # the leak keeps the pump's clock
    late = make_grasps(TIME + 0.3, np.full((1, TIME.size), 23.0), ["a"])
    now = make_grasps(TIME, np.full((1, TIME.size), 23.0), ["a"])
    shifted = u[:1].copy()
    shifted[:, ONSET] += 0.3
    # sample by sample: bins are fixed in time, so compare with bins of one sample each
    here, there = _by_sample(touches(now)), _by_sample(touches(late))
    np.testing.assert_allclose(
        predict(stack, nodes, there, shifted), predict(stack, nodes, here, u[:1]), rtol=1e-12
    )


def _by_sample(data):
    n = data.sample_t.shape[1]
    zero = np.zeros((1, n))
    return replace(data, sample_bin=np.arange(n)[None], y=zero, t=data.sample_t, ramp=zero, count=zero + 1)


def test_equal_temperatures_read_flat(case):
    stack, nodes, data, u = case
    same = u[2:].copy()
    same[:, 4] = same[:, 3]
    np.testing.assert_allclose(predict(stack, nodes, data.take(np.array([2])), same), same[0, 3], rtol=1e-13)


def test_whitener_inverts_the_covariance_and_leaves_lost_bins_out():
    y = np.full((2, TIME.size), 30.0)
    y[1, 30:40] = np.nan
    data = touches(make_grasps(TIME, y + 3 * (TIME > 0), ["a", "b"]))
    w, log_det = whiten(data, Noise())
    cov = noise_covariance(data, Noise())
    for i in range(2):
        there = data.count[i] > 0
        part = cov[i][np.ix_(there, there)]
        inverse = (w[i].T @ w[i])[np.ix_(there, there)]
        np.testing.assert_allclose(inverse @ part, np.eye(there.sum()), atol=1e-8)
        assert log_det[i] == pytest.approx(np.linalg.slogdet(2 * np.pi * part)[1])
    assert (data.count[1] == 0).any()


def test_slopes_of_the_noise_are_those_of_its_likelihood():
    """The likelihood put together from the covariance, a sample lost, something else in doubt as well."""
    y = np.random.default_rng(3).normal(0.0, 0.05, (2, TIME.size)) + 3 * (TIME > 0)
    y[1, 30:40] = np.nan
    data = touches(make_grasps(TIME, y, ["a", "b"]))
    there = data.count > 0
    left = np.random.default_rng(4).normal(0.0, 0.1, there.shape) * there
    extra = 0.01 * there[:, :, None] * there[:, None, :]
    q = np.array([*np.log([0.05, 0.02, 3.0, 0.002]), 0.7])

    def cost(q):
        white, slow, memory, misfit = np.exp(q[:4])
        noise = Noise(white=white, slow=slow, correlation_time=memory, misfit=misfit, growth=q[4])
        cov = noise_covariance(data, noise) + extra
        want = sum(r @ np.linalg.solve(c, r) + np.linalg.slogdet(c)[1] for r, c in zip(left, cov))
        return 0.5 * want, noise_fit(data, noise, extra, left)

    want, (value, slopes) = cost(q)
    assert value == pytest.approx(want, rel=1e-10)
    steps = 1e-5 * np.eye(5)
    differences = [(cost(q + s)[0] - cost(q - s)[0]) / 2e-5 for s in steps]
    np.testing.assert_allclose(slopes, differences, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    "bad", [{"e_outer": 0.0}, {"lag": -1.0}, {"first": 2.0}, {"g_side": -1.0}, {"z_inner": np.nan}]
)
def test_a_stack_that_cannot_be_is_refused(bad):
    with pytest.raises(ValueError, match=r"must be positive|need"):
        replace(PLAIN, **bad)


@pytest.mark.parametrize("bad", [{"effusivity": [-1.0]}, {"h_c": [0.0]}, {"capacity": [np.inf]}])
def test_a_block_that_cannot_be_is_refused(bad):
    good = {"effusivity": [1e4], "capacity": [6e4], "h_c": [500.0]}
    with pytest.raises(ValueError, match="positive and finite"):
        step_response(PLAIN, time_nodes(1.0), **(good | bad))
