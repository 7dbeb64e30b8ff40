"""A grasp is one step response with circumstances drawn from stated populations."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.rig.touch import Grip, simulate_grasps

EXACT = Grip(
    h_c_sd_ln=0.0, build_sd_ln=0.0, onset=0.0, onset_sd=0.0, t_object_sd=0.0, relaxes=0.0, effusivity_sd_ln={}
)
SILENT = {"noise": 0.0, "slow_noise": 0.0, "quantum": 0.0, "regulation_sd": 0.0}


def test_before_contact_nothing_has_happened() -> None:
    touch = Grip(onset=0.5, onset_sd=0.0).draw("copper", 43.0, np.random.default_rng(0), ambient=28.0)
    assert np.all(touch.response([-2.0, 0.0, 0.49]) == 0.0)
    assert touch.response([0.7])[0] > 0.0


def test_a_better_conductor_moves_the_skin_further() -> None:
    rng = np.random.default_rng(0)
    at_5_s = [
        EXACT.draw(m, 43.0, rng, ambient=28.0).response([5.0])[0] for m in ("wood", "glass", "iron", "copper")
    ]
    assert np.all(np.diff(at_5_s) > 0)


def test_the_populations_have_the_stated_spreads() -> None:
    grip = Grip(until=1.0)
    touches = grip.draw_many(["copper"] * 1000, 43.0, np.random.default_rng(4), ambient=28.0)
    # the standard error of a standard deviation of 1000 draws is 2.2 %
    assert np.std([np.log(t.h_c) for t in touches]) == pytest.approx(0.09, rel=0.09)
    assert np.std([t.onset for t in touches]) == pytest.approx(0.09, rel=0.09)
    temperatures = np.array([t.t_object for t in touches])
    assert np.std(temperatures) == pytest.approx(0.40, rel=0.09)
    assert np.mean(temperatures) == pytest.approx(43.0 - 0.02 * 15.0, abs=4 * 0.4 / np.sqrt(1000))


def test_simulated_grasps_are_the_response_scaled_by_the_difference() -> None:
    g = simulate_grasps(EXACT, ["brass", "wood"], t_object=43.0, t_gripper=23.0, n=2, **SILENT)
    response = EXACT.draw("brass", 43.0, np.random.default_rng(0), ambient=28.0).response(g["time"].values)
    np.testing.assert_allclose(g["t_surface"].values[0], 23.0 + 20.0 * response, atol=1e-12)
    np.testing.assert_array_equal(g["t_surface"].values[0], g["t_surface"].values[1])


def test_hot_and_cold_gripper_mirror_each_other() -> None:
    warm = simulate_grasps(EXACT, ["zinc"], t_object=18.0, t_gripper=38.0, n=1, **SILENT)
    cold = simulate_grasps(EXACT, ["zinc"], t_object=38.0, t_gripper=18.0, n=1, **SILENT)
    np.testing.assert_allclose(warm["t_surface"].values + cold["t_surface"].values, 56.0, atol=1e-9)


def test_simulation_repeats_with_its_seed() -> None:
    def run(seed: int) -> np.ndarray:
        g = simulate_grasps(Grip(), ["copper"], t_object=43.0, t_gripper=23.0, n=3, seed=seed)
        return g["t_surface"].values

    np.testing.assert_array_equal(run(1), run(1))
    assert np.any(run(1) != run(2))


def test_labels_follow_the_repeats() -> None:
    g = simulate_grasps(
        Grip(),
        ["copper", "wood"],
        t_object=43.0,
        t_gripper=23.0,
        n=8,
        split=lambda k: "train" if k < 5 else "test",
    )
    assert list(g["split"].values[:8]) == ["train"] * 5 + ["test"] * 3
    assert list(g["material"].values).count("wood") == 8
