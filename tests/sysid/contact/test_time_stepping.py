"""The compiled kernels: a block's modes, the far face, one step."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermogrip.sysid.contact import time_stepping as kernel
from thermogrip.sysid.contact.simulation import far_response, gripper_modes, step_response, time_nodes
from thermogrip.sysid.contact.time_stepping import slabs
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

STACK = load_default_gripper().stack
COPPER, IRON, WOOD = (3.64e4, 6.86e4), (1.61e4, 7.14e4), (367.0, 2.41e4)  # e, C


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
def test_what_the_room_does_is_what_cells_say(block):
    """Through the response to a step, of which the way of the untouched face is a sum (Duhamel)."""
    nodes = time_nodes(12.0, per_group=40)
    given = {"effusivity": [block[0]], "capacity": [block[1]]}
    rise = step_response(STACK, nodes, **given, h_c=[1000.0]).rise
    got = far_response(STACK, nodes, rise, **given)[0]
    t = np.linspace(0.0, 12.0, 1201)
    free = untouched(block, STACK.g_far, t)
    f = np.interp(t, nodes.t, rise[0])
    want = np.array([np.interp(at - t[1:] + 0.005, t, f, left=0.0)[t[1:] <= at] @ np.diff(free)[t[1:] <= at]
                     for at in (3.0, 6.0, 12.0)])  # fmt: skip
    # to first order in the loss: U t / C is 2 % at 12 s
    np.testing.assert_allclose(np.interp((3.0, 6.0, 12.0), nodes.t, got), want, rtol=0.06, atol=2e-4)
    assert want[-1] < 1e-4 if block is WOOD else want[-1] > 0.003


@pytest.mark.parametrize("block", [COPPER, IRON, WOOD])
def test_the_slopes_of_a_contact_are_its_differences(block):
    """By ln h, ln tau_b, ln e and ln C; curves that nobody wants cost nothing and change nothing."""
    nodes, gripper, h = tuple(time_nodes(12.0)), gripper_modes(STACK), 1e-4
    at = np.log([block[0], block[1], 900.0, 0.7])
    wanted = np.ones((1, 5), dtype=bool)
    rise, slope, flux = kernel.contacts(nodes, gripper, np.exp(at)[None], wanted)
    moved = np.exp(at + h * np.concatenate([np.eye(4), -np.eye(4)]))
    alone = np.zeros((8, 5), dtype=bool)
    alone[:, 0] = True
    ups, slopes, _ = kernel.contacts(nodes, gripper, moved, alone)
    for curve, k in ((1, 2), (2, 3), (3, 0), (4, 1)):
        np.testing.assert_allclose(rise[0, curve], (ups[k, 0] - ups[k + 4, 0]) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(slope[0, curve], (slopes[k, 0] - slopes[k + 4, 0]) / (2 * h), atol=1e-7)
    again = kernel.contacts(
        nodes, gripper, np.exp(at)[None], wanted & np.array([True, False, False, True, False])
    )
    for curve in (0, 3):
        np.testing.assert_array_equal(again[0][0, curve], rise[0, curve])
    np.testing.assert_array_equal(again[2], flux)


def test_a_gripper_each_is_what_each_gripper_says():
    """The second one with another lag, and with a resistance before it."""
    one, nodes = gripper_modes(STACK), tuple(time_nodes(3.0))
    numbers = np.concatenate([one.numbers, one.numbers * [1.5, 2.0, 1, 1, 1, 1, 1]])
    two = kernel.Gripper(np.repeat(one.modes, 2, axis=0), numbers)
    two.modes[1, :2, -1] /= 2.0  # twice the lag
    contact, wanted = np.repeat([[*IRON, 800.0, 0.7]], 2, axis=0), np.ones((2, 5), dtype=bool)
    rise, _, _ = kernel.contacts(nodes, two, contact, wanted)
    for k in range(2):
        alone = kernel.Gripper(two.modes[[k]], numbers[[k]])
        np.testing.assert_array_equal(kernel.contacts(nodes, alone, contact[:1], wanted[:1])[0][0], rise[k])
    assert (rise[1, 0, 1:] < rise[0, 0, 1:]).all()


def test_conductance_grows_as_its_law_says():
    numbers, t = np.array([[0.0, 0.1, 0.2, 0.5, 3.0, 0.0, 0.0]]), np.array([0.0, 0.1, 0.2, 0.4, 0.6, 0.8])

    def grown(tau):
        return kernel.conductance(t, np.array([700.0]), np.array([tau]), numbers)[0]

    want = 700 * (0.2 + 0.8 * -np.expm1(-t / 0.5)) * (1 + 0.5 * -np.expm1(-t / 3.0))
    np.testing.assert_allclose(grown(0.5)[0], want)
    rise = (grown(0.5 * np.exp(1e-5))[0] - grown(0.5 * np.exp(-1e-5))[0]) / 2e-5
    np.testing.assert_allclose(grown(0.5)[1], rise, rtol=1e-6, atol=1e-6)
