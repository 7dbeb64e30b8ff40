"""The compiled kernels: a block's modes, the far face, one step."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermogrip.sysid.contact import time_stepping as kernel
from thermogrip.sysid.contact.simulation import far_response, step_response, time_nodes
from thermogrip.sysid.contact.time_stepping import N_MODE, first_step, slab, slab_moves, slabs
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


@pytest.mark.parametrize("block", [COPPER, IRON, WOOD, (3.64e4, 3e3)])
@pytest.mark.parametrize("far", [0.0, 3.0, 2000.0])
def test_the_slopes_of_modes_are_their_differences(block, far):
    e, c = block
    lam, weight, moves = np.empty(N_MODE), np.empty(N_MODE), np.empty((4, N_MODE))

    def modes(ln_e, ln_c):
        own = _modes(e * np.exp(ln_e), c * np.exp(ln_c), far, lam, weight)
        return lam.copy(), weight.copy(), own

    rate, size, resistance = modes(0.0, 0.0)
    own = _slopes(e, c, far, rate, moves)
    h = 1e-5
    for at, step in enumerate(((h, 0.0), (0.0, h))):
        low, high = modes(*(-s for s in step)), modes(*step)
        by_rate, by_size, by_resistance = ((b - a) / (2 * h) for a, b in zip(low, high, strict=True))
        np.testing.assert_allclose(rate * moves[2 * at], by_rate, rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(size * moves[2 * at + 1], by_size, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(resistance * own[at], by_resistance, rtol=1e-5, atol=1e-12)


@numba.njit(error_model="numpy")  # what only compiled code calls is compiled for that alone
def _modes(e, c, far, lam, weight):
    return slab(e, c, far, lam, weight)


@numba.njit(error_model="numpy")
def _slopes(e, c, far, lam, moves):
    return slab_moves(e, c, far, lam, moves)


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
    rise, _, _ = step_response(STACK, nodes, **given, h_c=[1000.0])
    got = far_response(STACK, nodes, rise, **given)[0]
    t = np.linspace(0.0, 12.0, 1201)
    free = untouched(block, STACK.g_far, t)
    f = np.interp(t, nodes.t, rise[0])
    want = np.array([np.interp(at - t[1:] + 0.005, t, f, left=0.0)[t[1:] <= at] @ np.diff(free)[t[1:] <= at]
                     for at in (3.0, 6.0, 12.0)])  # fmt: skip
    # to first order in the loss: U t / C is 2 % at 12 s
    np.testing.assert_allclose(np.interp((3.0, 6.0, 12.0), nodes.t, got), want, rtol=0.06, atol=2e-4)
    assert want[-1] < 1e-4 if block is WOOD else want[-1] > 0.003


def test_a_step_without_an_exponential_is_one_less_it():
    x = np.concatenate([[0.0], np.logspace(-12, 1.5, 60)])
    got = [first_step.py_func(v) for v in x]
    np.testing.assert_allclose(got, -np.expm1(-x), rtol=1e-14)
    assert first_step.py_func(1e6) == 1.0


@pytest.mark.parametrize("x", [1e-6, 0.99e-3, 1.01e-3, 0.3, 5.0])
def test_a_step_of_a_mode_is_its_answer_to_a_flux_that_changes_along_a_line(x):
    """Integrals of exp(-lam (dt - s)) times 1 - s / dt and s / dt, and their slopes by ln lam."""
    dt, (node, weight) = 0.4, np.polynomial.legendre.leggauss(30)
    share, weight = 0.5 * (1 + node), 0.5 * weight

    def exact(x):
        fade = np.exp(-x * (1 - share))
        return dt * (weight * fade * (1 - share)).sum(), dt * (weight * fade * share).sum()

    m = -np.expm1(-x)
    got = kernel.mode_step.py_func(x / dt, dt, m)
    np.testing.assert_allclose(got, exact(x), rtol=2e-9)
    h = 1e-4
    rise = [(up - down) / (2 * h) for up, down in zip(exact(x * np.exp(h)), exact(x * np.exp(-h)))]
    moves = kernel.mode_step_moves.py_func(x / dt, dt, m, got[1])
    np.testing.assert_allclose(moves, rise, rtol=2e-6, atol=1e-11)


def test_conductance_grows_over_steps_that_double():
    numbers, repeat, dt = np.array([0.0, 0.1, 0.2, 0.5, 3.0, 0.0]), np.array([2, 3]), np.array([0.1, 0.2])
    t = np.array([0.0, 0.1, 0.2, 0.4, 0.6, 0.8])

    def grown(tau):
        out = np.empty((2, 6))
        kernel._grow.py_func(repeat, dt, 700.0, tau, numbers, out)
        return out

    want = 700 * (0.2 + 0.8 * -np.expm1(-t / 0.5)) * (1 + 0.5 * -np.expm1(-t / 3.0))
    np.testing.assert_allclose(grown(0.5)[0], want)
    rise = (grown(0.5 * np.exp(1e-5))[0] - grown(0.5 * np.exp(-1e-5))[0]) / 2e-5
    np.testing.assert_allclose(grown(0.5)[1], rise, rtol=1e-6, atol=1e-6)


def test_a_delayed_integral_goes_by_straight_lines_between_the_points_that_count():
    """Readings 0, 2, 4 at 1, 2, 4 s, one lost between: integrals 0, 1, 7; looked at half a second late."""
    t, count = np.array([1.0, 2.0, 3.0, 4.0, 4.5]), np.array([1.0, 2.0, 0.0, 1.0, 3.0])
    curve, total, value = np.array([0.0, 2.0, 99.0, 4.0, 4.0]), np.empty(5), np.empty(5)
    kernel.fill_delayed.py_func(t, count, 0.5, curve, total, value)
    np.testing.assert_allclose(value, [0.0, 1.0, 0.0, 3.5, 4.0])
    np.testing.assert_allclose(total, [0.0, 0.25, 0.0, 1 + 1.5 * 2.75, 7.0])
    kernel.fill_delayed.py_func(t, count, 0.0, curve, total, value)
    np.testing.assert_allclose(total, [0.0, 1.0, 0.0, 7.0, 9.0])
    assert kernel.delay.py_func(np.log(3.0), np.log(18.0)) == pytest.approx(6.0)


def test_samples_find_their_nodes_whichever_way_they_come():
    nodes, times = np.array([0.0, 1.0, 2.0, 4.0]), np.array([0.5, 3.5, 9.0, 1.5, 2.5, 3.0, 1.6])
    bins = np.array([0, 0, 0, 0, -1, 0, 0])
    place, share = np.empty(7, dtype=np.int64), np.zeros(7)
    kernel._places.py_func(nodes, 0.5, times, bins, place, share)
    assert place.tolist() == [-1, 2, 2, 1, -1, 2, 1]
    np.testing.assert_allclose(share[[1, 2, 3, 5, 6]], [0.5, 1.0, 0.0, 0.25, 0.1])
