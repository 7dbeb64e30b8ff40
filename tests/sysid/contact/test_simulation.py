"""A grasp is one step response with circumstances drawn from stated populations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.materials import load_materials
from thermogrip.sysid.contact.response import far_response, step_response, time_nodes
from thermogrip.sysid.contact.simulation import (
    SOFT_FINGER,
    Blocks,
    Grip,
    Touch,
    record_touches,
    simulate_grasps,
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
    rise = step_response(stack, nodes, effusivity=e, capacity=capacity, h_c=h, build_up=build_up)[0]
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
