"""The noise of a calibration: its search ends where the likelihood is greatest, or says that it did not."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity import calibration
from thermogrip.sysid.effusivity.calibration import calibrate_example_gripper, calibrate_gripper
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

FIRST = np.array([-3.1, -4.0, 1.4, -6.5, 1.0])


@pytest.fixture
def searches(monkeypatch):
    """The searches of a calibration: cost, and where each ended."""
    seen, least = [], calibration._least

    def spy(cost, first, n_grasp):
        found = least(cost, first, n_grasp)
        seen.append((cost, found))
        return found

    monkeypatch.setattr(calibration, "_least", spy)
    return seen


@pytest.mark.parametrize("name", ["exp2_dT20", "exp4_cooled5_obj18_grip38_40s"])
def test_no_noise_nearby_is_likelier_than_that_of_a_calibration(searches, name):
    record = load_example_grasps()[name]
    device = calibrate_gripper([record.isel(grasp=record["split"].values == "train")])
    assert len(searches) == 2
    cost, found = searches[-1]
    assert device.noise.white == pytest.approx(np.exp(found[0]))
    best = cost(found)[0]
    for k in range(5):
        for side in (-1, 1):
            step = np.zeros(5)
            step[k] = side * (0.002 if k == 0 else 0.02)
            inside = np.clip(found + step, *calibration._NOISE_RANGE.T)
            assert cost(inside)[0] > best - 1e-3


def narrow(q):
    """A valley that turns, a thousand times as steep across as along, its floor at (-3, -4, 1, -7, 0.5)."""
    off = q - np.array([-3.0, -4.0, 1.0, -7.0, 0.5])
    across = off[0] + 0.1 * off[2] ** 2 - 0.3 * off[1]
    value = 5e3 * across**2 + 0.5 * (off[1:] ** 2).sum()
    slopes = np.concatenate([[0.0], off[1:]])
    slopes += 1e4 * across * np.array([1.0, -0.3, 0.2 * off[2], 0.0, 0.0])
    return float(value), slopes


def test_the_search_goes_on_through_a_narrow_valley():
    found = calibration._least(narrow, FIRST, n_grasp=1)
    np.testing.assert_allclose(found, [-3.0, -4.0, 1.0, -7.0, 0.5], atol=0.05)


def test_a_search_that_is_cut_short_says_so(monkeypatch):
    monkeypatch.setattr(calibration, "_NOISE_SEARCH", 3)
    with pytest.warns(RuntimeWarning, match="noise of 7 grasps ended after 3 steps before it settled"):
        calibration._least(narrow, FIRST, n_grasp=7)


def test_the_bundled_gripper_is_what_its_training_grasps_make():
    """Within rounding of another machine, far below what the grasps leave open."""
    bundled, again = load_default_gripper(), calibrate_example_gripper()
    for part in ("stack", "noise", "spreads"):
        for name, value in vars(getattr(bundled, part)).items():
            assert getattr(getattr(again, part), name) == pytest.approx(value, rel=2e-3), (part, name)
    for label, block in bundled.blocks.items():
        assert again.blocks[label].ln_h == pytest.approx(block.ln_h, abs=1e-4)
        assert again.blocks[label].ln_effusivity == pytest.approx(block.ln_effusivity, abs=1e-4)
    assert again.trained_on == bundled.trained_on
