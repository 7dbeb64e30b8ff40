"""The block's far face: modes against the closed form, the room's way to the sensor against cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermogrip.sysid.contact.response import far_response, step_response, time_nodes
from thermogrip.sysid.contact.time_stepping import slabs
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.data import touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import Prior, find_modes, jacobian, nodes_for, predict
from thermogrip.sysid.effusivity.priors import material_hypotheses, prior_of

from ..effusivity.makers import simulated

COPPER, IRON, WOOD = (3.64e4, 6.86e4), (1.61e4, 7.14e4), (367.0, 2.41e4)  # e, C


@pytest.fixture(scope="module")
def device():
    return load_default_gripper()


@pytest.mark.parametrize("block", [COPPER, IRON, WOOD])
@pytest.mark.parametrize("far", [0.0, 3.0, 100.0, 2000.0])
def test_modes_of_a_slab_make_its_impedance(block, far):
    e, c = block
    s = np.geomspace(1e-4, 3.0, 12)
    lam, weight, resistance = slabs(np.array([e]), np.array([c]), far)
    found = (weight / (s[:, None] + lam)).sum(axis=1) + resistance
    k, x = e * np.sqrt(s), np.sqrt(s) * c / e
    want = (k + far * np.tanh(x)) / (k * np.tanh(x) + far) / k
    np.testing.assert_allclose(found, want, rtol=1e-4)


def untouched(block, far, t, n=120):
    """Return how far the near face of a block goes to the room, its far one alone losing heat: n cells."""
    e, c = block
    link = (e**2 / c) * n  # k / dx, k / L being e^2 / C
    cell, end = c / n, 1 / (1 / far + 0.5 / link)

    def rate(_, x):
        flux = link * np.diff(x)
        out = np.zeros(n)
        out[:-1] += flux
        out[1:] -= flux
        out[-1] += end * (1 - x[-1])
        return out / cell

    return solve_ivp(rate, (0, t[-1]), np.zeros(n), t_eval=t, method="LSODA", rtol=1e-8, atol=1e-11).y[0]


@pytest.mark.parametrize("block", [COPPER, IRON, WOOD])
def test_what_the_room_does_is_what_cells_say(device, block):
    """Through the response to a step, of which the way of the untouched face is a sum (Duhamel)."""
    nodes = time_nodes(12.0, per_group=40)
    given = {"effusivity": [block[0]], "capacity": [block[1]]}
    rise, _, _ = step_response(device.stack, nodes, **given, h_c=[1000.0])
    got = far_response(device.stack, nodes, rise, **given)[0]
    t = np.linspace(0.0, 12.0, 1201)
    free = untouched(block, device.stack.g_far, t)
    f = np.interp(t, nodes.t, rise[0])
    want = np.array([np.interp(at - t[1:] + 0.005, t, f, left=0.0)[t[1:] <= at] @ np.diff(free)[t[1:] <= at]
                     for at in (3.0, 6.0, 12.0)])  # fmt: skip
    # to first order in the loss: U t / C is 2 % at 12 s
    np.testing.assert_allclose(np.interp((3.0, 6.0, 12.0), nodes.t, got), want, rtol=0.06, atol=2e-4)
    assert want[-1] < 1e-4 if block is WOOD else want[-1] > 0.003


def test_the_compiled_search_has_the_slopes_of_the_prediction(device):
    """Its covariance is that of the least squares that ``jacobian`` says, all seven nuisances unknown."""
    leaky = replace(device, stack=replace(device.stack, g_far=3000.0))
    data = touches(simulated(leaky, ["iron", "zinc"], n=1, t_gripper=38.0, t_object=43.0))
    prior = prior_of(leaky, data, material_hypotheses(leaky, ["iron", "zinc"]))
    sd = np.where(prior.sd > 0, prior.sd, 0.3)
    whitener = whiten(data, leaky.noise)
    found = find_modes(
        leaky.stack, data, np.arange(data.level.size), whitener, Prior(prior.mean, sd), max_steps=60
    )
    slopes = jacobian(leaky.stack, nodes_for(data), data, found.u, sd > 0)[1]
    for i in range(2):
        j = whitener[0][i] @ slopes[i]
        want = np.linalg.inv(j.T @ j + np.diag(sd[i] ** -2.0))
        # the search is over when a step promises nothing, a little before it ends
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
    alike = replace(data, t_ambient=u[:, 4])
    np.testing.assert_allclose(predict(bare, nodes, unknown, u), predict(bare, nodes, alike, u), rtol=1e-12)
    colder = (predict(bare, nodes, unknown, u) - with_room)[:, -1]
    # a room 16 K below, and U / C = 0.0015 / s for ten seconds
    assert np.all((colder > 0.03) & (colder < 0.3))


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


def test_a_device_of_before_has_no_far_face(device):
    content = device.to_dict()
    del content["stack"]["g_far"]
    assert GripperModel.from_dict(content).stack == replace(device.stack, g_far=0.0)
