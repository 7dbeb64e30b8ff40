"""The simulated contact against closed forms that share no line with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.sysid.contact.closed_forms import (
    block_contact_flux,
    half_space,
    layer_on,
    sensor_temperature,
    slab,
    two_body_flux,
)
from thermogrip.sysid.contact.response import (
    LAYER_NAMES,
    Stack,
    nearby_modes,
    stack_modes,
    step_response,
    time_nodes,
)
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

# one layer, contact at once and for good: what the closed forms describe
PLAIN = Stack(
    e_outer=1600.0, z_outer=1e-3, e_inner=1600.0, z_inner=25.0, g_back=0.0, lag=0.5, first=1.0, build_up=1.0,
    creep=0.0,
)  # fmt: skip


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


def test_heat_is_conserved_in_a_closed_gripper():
    """Nothing leaks, so all of gripper, side store and block end at the mean over their capacities."""
    stack = replace(PLAIN, e_inner=2e3, z_inner=5.0, g_side=300.0, c_side=2.5e4)
    nodes = time_nodes(3e5)
    capacity, own = 6e4, 1600.0 * 1e-3 + 2e3 * 5.0 + 2.5e4
    rise, _, flux = step_response(stack, nodes, effusivity=[1.6e4], capacity=[capacity], h_c=[800.0])
    assert rise[0, -1] == pytest.approx(capacity / (capacity + own), rel=1e-4)
    given = np.trapezoid(flux[0], nodes.t)
    assert given == pytest.approx(capacity * own / (capacity + own), rel=1e-3)


@pytest.mark.parametrize("bad", [{"effusivity": [-1.0]}, {"h_c": [0.0]}, {"capacity": [np.inf]}])
def test_a_block_that_cannot_be_is_refused(bad):
    good = {"effusivity": [1e4], "capacity": [6e4], "h_c": [500.0]}
    with pytest.raises(ValueError, match="positive and finite"):
        step_response(PLAIN, time_nodes(1.0), **(good | bad))


def test_nearby_modes_are_right_to_first_order():
    stack = load_default_gripper().stack
    here = np.array([getattr(stack, name) for name in LAYER_NAMES])
    for i, name in enumerate(LAYER_NAMES):
        off = []
        for step in (1e-3, 1e-4):
            moved = here.copy()
            moved[i] *= np.exp(step)
            exact = stack_modes(replace(stack, **{name: float(moved[i])}))
            off.append(np.abs(nearby_modes(stack, moved[None]).lam[0] - exact.lam)[:20].max())
        assert off[1] < 0.02 * off[0] + 1e-9, name  # a hundredth: the error is of second order


@pytest.mark.parametrize(
    ("end", "dt", "repeat", "last"),
    [(0.005, [0.01], [2], 0.02), (0.1, [0.01], [10], 0.1), (0.101, [0.01, 0.02], [10, 2], 0.14),
     (10.0, 0.01 * 2.0 ** np.arange(7), [10] * 6 + [6], 10.14)],
)  # fmt: skip
def test_steps_double_after_ten_until_the_end_is_past(end, dt, repeat, last):
    nodes = time_nodes(end)
    np.testing.assert_allclose(nodes.dt, dt)
    assert nodes.repeat.tolist() == repeat
    assert (nodes.t[0], nodes.t[-1], nodes.t.size) == (0.0, pytest.approx(last), sum(repeat) + 1)
    fine = time_nodes(0.7, first=0.1, per_group=2)  # 0.1, 0.1, 0.2, 0.2, then 0.4 twice
    np.testing.assert_allclose(fine.t, [0.0, 0.1, 0.2, 0.4, 0.6, 1.0, 1.4])


def test_in_the_end_heat_flows_through_all_resistances_in_a_row():
    """1 / 500 of the contact, 0.4 / 600 of the sheet, 5 / 1600 behind it and 1 / 200 at the back."""
    stack = replace(PLAIN, e_outer=600.0, z_outer=0.4, z_inner=5.0, g_back=200.0, g_side=300.0, c_side=2e3)
    nodes = time_nodes(3000.0)
    given = {"effusivity": [1e8], "capacity": [1e12], "h_c": [500.0]}
    rise, _, flux = step_response(stack, nodes, **given)
    through = 1 / (1 / 500 + 0.4 / 600 + 5 / 1600 + 1 / 200)
    assert flux[0, -1] == pytest.approx(through, rel=1e-3)
    assert rise[0, -1] == pytest.approx(1 - through * (1 / 500 + 0.4 / 600), rel=1e-3)
    # a contact that creeps by a fifth ends at 600 of it
    creeping = step_response(replace(stack, creep=0.2, first=0.5), nodes, **given)[2][0, -1]
    assert creeping == pytest.approx(1 / (1 / through - 1 / 500 + 1 / 600), rel=1e-3)


def test_a_contact_builds_up_and_then_creeps():
    """Between two bodies that resist nothing the flux is h(t): 0.1 to 1 of it in 0.5 s,
    and a half more in 3 s."""
    stack = replace(
        PLAIN, e_outer=1e7, e_inner=1e7, first=0.1, build_up=0.5, creep=0.5, settle=3.0, g_back=1e9
    )
    nodes = time_nodes(8.0)
    given = {"effusivity": [1e7], "capacity": [1e12], "h_c": [200.0]}
    for tau, asked in ((0.5, {}), (0.9, {"build_up": [0.9]})):
        flux, t = step_response(stack, nodes, **given, **asked)[2][0], nodes.t
        want = 200 * (0.1 + 0.9 * -np.expm1(-t / tau)) * (1 + 0.5 * -np.expm1(-t / 3.0))
        np.testing.assert_allclose(flux, want, rtol=1e-3)


@pytest.mark.parametrize(
    ("given", "fine"),
    [({"first": 0.0}, True), ({"first": 1.0}, True), ({"creep": -0.2}, True), ({"creep": -0.21}, False),
     ({"first": -0.01}, False), ({"first": 1.01}, False), ({"g_back": -1.0}, False), ({"g_far": -1.0}, False),
     ({"c_side": 0.0}, False), ({"settle": 0.0}, False), ({"e_outer": 0.0}, False), ({"lag": -1.0}, False),
     ({"z_inner": np.nan}, False), ({"g_side": -1.0}, False), ({"build_up": 0.0}, False)],
)  # fmt: skip
def test_which_stacks_there_are(given, fine):
    assert (PLAIN.leak, PLAIN.g_side, PLAIN.c_side, PLAIN.settle, PLAIN.g_far) == (0.0, 0.0, 1e4, 2.5, 0.0)
    if fine:
        assert replace(PLAIN, **given) != given
        return
    with pytest.raises(ValueError, match=f"{next(iter(given))} must be positive|need 0 <= first <= 1"):
        replace(PLAIN, **given)
