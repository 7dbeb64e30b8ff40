"""A grasp is one step response with circumstances drawn from stated populations.

The simulated contact against closed forms that share no line with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.sysid.contact.closed_forms import (
    half_space,
    layer_on,
    sensor_temperature,
    slab,
    two_body_flux,
)
from thermogrip.sysid.contact.materials import load_materials
from thermogrip.sysid.contact.simulation import (
    SOFT_FINGER,
    Blocks,
    Grip,
    Stack,
    Touch,
    far_response,
    record_touches,
    simulate_grasps,
    step_response,
    time_nodes,
)

STILL = {"build_up_sd_ln": 0.0, "onset": 0.0, "onset_sd": 0.0, "t_object_sd": 0.0, "transit_loss": 0.0}
EXACT = Grip(h_c_sd_ln=0.0, effusivity_sd_ln={}, **STILL)
SILENT = {"noise": 0.0, "slow_noise": 0.0, "quantum": 0.0, "regulation_sd": 0.0}


def test_before_contact_nothing_has_happened():
    touch = Grip(onset=0.5, onset_sd=0.0).draw("copper", 43.0, np.random.default_rng(0), ambient=28.0)
    assert np.all(touch.response([-2.0, 0.0, 0.49]) == 0.0)
    assert touch.response([0.7])[0] > 0.0


def test_simulated_grasps_are_the_response_scaled_by_the_difference():
    g = simulate_grasps(EXACT, ["brass", "wood"], t_object=43.0, t_gripper=23.0, n=2, **SILENT)
    response = EXACT.draw("brass", 43.0, np.random.default_rng(0), ambient=28.0).response(g["time"].values)
    np.testing.assert_allclose(g["t_surface"].values[0], 23.0 + 20.0 * response, atol=1e-12)
    np.testing.assert_array_equal(g["t_surface"].values[0], g["t_surface"].values[1])


def test_simulation_repeats_with_its_seed():
    def run(seed: int) -> np.ndarray:
        g = simulate_grasps(Grip(), ["copper"], t_object=43.0, t_gripper=23.0, n=3, seed=seed)
        return g["t_surface"].values

    np.testing.assert_array_equal(run(1), run(1))
    assert np.any(run(1) != run(2))


def test_labels_follow_the_repeats():
    split = ["train"] * 5 + ["test"] * 3
    g = simulate_grasps(
        Grip(), ["copper", "wood"], t_object=43.0, t_gripper=23.0, n=8, split=split.__getitem__
    )
    assert g["split"].values.tolist() == 2 * split
    assert g["material"].values.tolist() == ["copper"] * 8 + ["wood"] * 8


def test_a_finish_and_an_effusivity_are_the_materials_own():
    grip = Grip(h_c_of={"zinc": 300.0}, h_c_sd_ln=0.0, effusivity_of={"zinc": 1000.0}, until=5.0, **STILL)
    zinc, brass = grip.draw_many(["zinc", "brass"], 43.0, np.random.default_rng(0), ambient=28.0)
    assert (zinc.h_c, brass.h_c) == (300.0, 1600.0)
    poor = Grip(h_c=300.0, h_c_sd_ln=0.0, h_c_of={}, until=5.0, **STILL)
    same = poor.draw("zinc", 43.0, np.random.default_rng(0), ambient=28.0)
    assert zinc.response([5.0])[0] < 0.9 * same.response([5.0])[0]


def test_slow_noise_has_its_spread_from_the_first_reading_on_and_forgets_in_four_seconds():
    n, still = 1000, {"noise": 0.0, "quantum": 0.0, "regulation_sd": 0.0}
    g = simulate_grasps(EXACT, ["wood"], t_object=28.0, t_gripper=28.0, n=n, slow_noise=0.1, **still)
    slow = g["t_surface"].values - 28.0
    # 1000 draws: the standard error of a standard deviation is 2.2 %, of the correlation 1/e it is 0.027
    assert np.std(slow, axis=0) == pytest.approx(np.full(slow.shape[1], 0.1), rel=0.1)
    assert np.corrcoef(slow[:, 0], slow[:, 40])[0, 1] == pytest.approx(np.exp(-1), abs=4 * 0.027)
    assert np.corrcoef(slow[:, 80], slow[:, 120])[0, 1] == pytest.approx(np.exp(-1), abs=4 * 0.027)


def test_a_skin_drifts_to_the_room_from_one_second_before_contact():
    still = {"t_object": 28.0, "t_gripper": 28.0, "ambient": 18.0, **SILENT}
    g = simulate_grasps(replace(EXACT, h_c=1e-3, h_c_of={}), ["wood"], leak=0.01, **still)
    want = 28.0 - 0.1 * np.maximum(g["time"].values + 1.0, 0.0)
    np.testing.assert_allclose(g["t_surface"].values[0], want, atol=1e-3)


def test_each_circumstance_has_its_own_draw_in_a_fixed_order():
    """h, onset, temperature, effusivity, build-up: a seed makes the same grasps in every version."""
    grip = Grip(bias=0.5, transit_loss=0.1, effusivity_sd_ln={"wood": 0.2, "copper": 0.1}, build_up_sd_ln=0.3)
    z = np.random.default_rng(3).standard_normal((5, 2))
    names = ["copper", "wood"]
    touches = grip.draw_many(names, 43.0, np.random.default_rng(3), ambient=28.0)
    e = [load_materials()[name].effusivity for name in names] * np.exp(np.array([0.1, 0.2]) * z[3])
    h = np.array([1600.0, 910.0]) * np.exp(0.09 * z[0])
    away = 43.5 + 0.4 * z[2]
    nodes = time_nodes(60.0)
    capacity = [load_materials()[name].rho * load_materials()[name].c_p * 0.02 for name in names]
    stack = replace(SOFT_FINGER, g_far=50.0)
    build_up = 0.78 * np.exp(0.3 * z[4])
    rise = step_response(stack, nodes, effusivity=e, capacity=capacity, h_c=h, build_up=build_up).rise
    room = far_response(stack, nodes, rise, effusivity=e, capacity=capacity)
    lossy = replace(grip, stack=stack).draw_many(names, 43.0, np.random.default_rng(3), ambient=28.0)
    for i, touch in enumerate(touches):
        true = away[i] + 0.1 * (28.0 - away[i])
        assert (touch.h_c, touch.onset, touch.t_object) == pytest.approx((h[i], 0.02 + 0.09 * z[1, i], true))
        t = touch.onset + np.array([-1.0, 0.2, 3.0])
        np.testing.assert_allclose(lossy[i].response(t), np.interp(t - touch.onset, nodes.t, rise[i]))
        np.testing.assert_allclose(
            lossy[i].by_room(t), (28.0 - true) * np.interp(t - touch.onset, nodes.t, room[i])
        )
        assert replace(touch, room=None).by_room(t).tolist() == [0.0, 0.0, 0.0]
    blocks = Blocks([5e3, 6e3], [300.0, 400.0], [2e4, 3e4])
    given = grip.draw_many(["", ""], 43.0, np.random.default_rng(3), ambient=28.0, blocks=blocks)
    assert [touch.h_c for touch in given] == [300.0, 400.0]
    assert given[1].onset == touches[1].onset


def test_readings_are_made_of_level_response_room_drift_and_noise():
    """The same numbers drawn again: level, slow noise, white noise; then the sensor's step of a sixteenth."""
    times, rise = np.array([0.0, 4.0]), np.array([0.0, 0.8])
    touches = [Touch(43.0, 0.5, 1.0, times, rise, np.array([0.0, 2.0])), Touch(33.0, 0.0, 1.0, times, rise)]
    time, reading = record_touches(touches, np.random.default_rng(6), t_gripper=23.0, leak=0.01)
    np.testing.assert_allclose(time, np.arange(-20, 101) / 10)
    rng = np.random.default_rng(6)
    level, slow, white = rng.standard_normal(2), rng.standard_normal((2, 121)), rng.standard_normal((2, 121))
    level, keep = 23.0 + 0.35 * level, np.exp(-0.1 / 4.0)
    slow *= 0.018 * np.where(np.arange(121) > 0, np.sqrt(1 - keep**2), 1.0)
    for k in range(1, 121):
        slow[:, k] += keep * slow[:, k - 1]
    since = np.clip([time - 0.5, time], 0.0, 4.0)
    want = level[:, None] + (np.array([[43.0], [33.0]]) - level[:, None]) * 0.2 * since
    want += [[0.5], [0.0]] * since + 0.01 * (28.0 - level[:, None]) * np.maximum(time + 1.0, 0.0)
    np.testing.assert_array_equal(reading, np.round((want + slow + 0.04 * white) * 16) / 16)
    short = record_touches(touches, rng, t_gripper=23.0, until=3.0, dt=0.25)[0]
    np.testing.assert_allclose(short, np.arange(-8, 13) / 4)


def test_a_simulated_record_says_what_it_is_of():
    g = simulate_grasps(Grip(until=1.0), ["copper", "wood"], t_object=43.0, t_gripper=23.0, until=0.5)
    assert g["grasp"].values.tolist() == ["s0000", "s0001"]
    assert [set(g[k].values.tolist()) for k in ("t_object", "t_gripper", "t_ambient")] == [
        {43.0},
        {23.0},
        {28.0},
    ]
    assert (g.attrs["name"], "split" in g and set(g["split"].values.tolist()) - {""}) in (
        ("simulated", False), ("simulated", set())
    )  # fmt: skip


# one layer, contact at once and for good: what the closed forms describe
PLAIN = Stack(
    e_outer=1600.0, z_outer=1e-3, e_inner=1600.0, z_inner=25.0, g_back=0.0, lag=0.5, first=1.0, build_up=1.0,
    creep=0.0,
)  # fmt: skip


@pytest.mark.parametrize("h_c", [200.0, 1000.0])
@pytest.mark.parametrize("e_obj", [367.0, 1.6e4])
def test_one_layer_on_a_deep_block_reads_the_closed_form(e_obj, h_c):
    nodes = time_nodes(10.0)
    rise = step_response(PLAIN, nodes, effusivity=[e_obj], capacity=[e_obj * 50], h_c=[h_c]).rise[0]
    want = sensor_temperature(nodes.t, T_dev0=0.0, T_obj0=1.0, e_dev=1600.0, e_obj=e_obj, h_c=h_c, lag=0.5)
    near = nodes.t < 10
    np.testing.assert_allclose(rise[near], want[near], atol=2e-3)


def test_flux_from_a_finite_block_is_the_closed_forms():
    nodes = time_nodes(40.0)
    flux = step_response(PLAIN, nodes, effusivity=[3.64e4], capacity=[68600.0], h_c=[800.0]).flux[0]
    late = (nodes.t > 0.05) & (nodes.t < 40)
    bodies = {"dev": half_space(1600.0), "obj": slab(3.64e4, 68600.0)}
    want = two_body_flux(nodes.t[late], T_dev0=0, T_obj0=1, h_c=800.0, **bodies)
    np.testing.assert_allclose(flux[late], want, rtol=4e-3)


def test_two_layers_are_the_layered_impedance():
    stack = replace(PLAIN, e_outer=600.0, z_outer=0.4)
    nodes = time_nodes(20.0)
    flux = step_response(stack, nodes, effusivity=[1.6e4], capacity=[6e4], h_c=[500.0]).flux[0]
    some = (nodes.t > 0.1) & (nodes.t < 20)
    dev = layer_on(600.0, 600.0 * 0.4, half_space(1600.0))
    want = two_body_flux(nodes.t[some], dev=dev, obj=slab(1.6e4, 6e4), T_dev0=0, T_obj0=1, h_c=500.0)
    np.testing.assert_allclose(flux[some], want, rtol=6e-3)


def test_heat_is_conserved_in_a_closed_gripper():
    """Nothing leaks, so all of gripper, side store and block end at the mean over their capacities."""
    stack = replace(PLAIN, e_inner=2e3, z_inner=5.0, g_side=300.0, c_side=2.5e4)
    nodes = time_nodes(3e5)
    capacity, own = 6e4, 1600.0 * 1e-3 + 2e3 * 5.0 + 2.5e4
    response = step_response(stack, nodes, effusivity=[1.6e4], capacity=[capacity], h_c=[800.0])
    assert response.rise[0, -1] == pytest.approx(capacity / (capacity + own), rel=1e-4)
    given = np.trapezoid(response.flux[0], nodes.t)
    assert given == pytest.approx(capacity * own / (capacity + own), rel=1e-3)


@pytest.mark.parametrize("bad", [{"effusivity": [-1.0]}, {"h_c": [0.0]}, {"capacity": [np.inf]}])
def test_a_block_that_cannot_be_is_refused(bad):
    good = {"effusivity": [1e4], "capacity": [6e4], "h_c": [500.0]}
    with pytest.raises(ValueError, match="positive and finite"):
        step_response(PLAIN, time_nodes(1.0), **(good | bad))


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
    response = step_response(stack, nodes, **given)
    through = 1 / (1 / 500 + 0.4 / 600 + 5 / 1600 + 1 / 200)
    assert response.flux[0, -1] == pytest.approx(through, rel=1e-3)
    assert response.rise[0, -1] == pytest.approx(1 - through * (1 / 500 + 0.4 / 600), rel=1e-3)
    # a contact that creeps by a fifth ends at 600 of it
    creeping = step_response(replace(stack, creep=0.2, first=0.5), nodes, **given).flux[0, -1]
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
        flux, t = step_response(stack, nodes, **given, **asked).flux[0], nodes.t
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
