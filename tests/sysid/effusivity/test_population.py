"""What several grippers say of a new one: beside the normal law they were drawn from, and by limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.effusivity import gripper_population
from thermogrip.sysid.effusivity.calibration import gripper_theta
from thermogrip.sysid.effusivity.gripper_model import (
    SHARED_NAMES,
    WIDER,
    GripperSpread,
    ParameterCovariance,
    another_gripper,
    block_names,
    stack_of,
)
from thermogrip.sysid.effusivity.population import _population

NOTHING = 1e-8


def known_to(gripper, sd):
    """Return a gripper whose numbers are each known to ``sd``."""
    names = (*SHARED_NAMES, *block_names(gripper.materials))
    return replace(gripper, uncertainty=ParameterCovariance(names, sd**2 * np.eye(len(names))))


def drawn(gripper, n, *, times, seed):
    """Return n grippers whose making differs ``times`` as much as is assumed, exactly known."""
    names = (*SHARED_NAMES, *block_names(gripper.materials))
    theta = gripper_theta(gripper, gripper.materials, np.zeros(len(names)))
    moves = GripperSpread().directions(names) * WIDER * times
    rng, out = np.random.default_rng(seed), []
    for _ in range(n):
        at = theta + moves @ rng.standard_normal(moves.shape[1])
        at[SHARED_NAMES.index("ln_first")] = min(at[SHARED_NAMES.index("ln_first")], 0.0)
        k = len(gripper.materials)
        blocks = {
            m: replace(b, ln_h=float(at[-2 * k + i]), ln_effusivity=float(at[-k + i]))
            for i, (m, b) in enumerate(gripper.blocks.items())
        }
        out.append(known_to(replace(gripper, stack=stack_of(at), blocks=blocks), NOTHING))
    return out


@pytest.mark.parametrize("times", [0.3, 1.0, 2.0])
def test_the_spread_of_many_grippers_is_found(times):
    """Of 400 numbers each, 3 directions of 6: sds within 4 standard errors of 1 / sqrt(2 K)."""
    rng = np.random.default_rng(2)
    directions = np.linalg.qr(rng.standard_normal((6, 3)))[0] * [0.2, 0.5, 1.0]
    x = 5.0 + (times * WIDER * directions @ rng.standard_normal((3, 400))).T
    mean, covariance = _population(x, np.tile(1e-10 * np.eye(6), (400, 1, 1)), directions)
    np.testing.assert_allclose(mean, x.mean(axis=0), atol=1e-3)
    found = np.sqrt(np.diag(np.linalg.pinv(directions) @ covariance @ np.linalg.pinv(directions).T))
    np.testing.assert_allclose(found, times * WIDER, rtol=4 / np.sqrt(800))


def test_errors_of_the_estimates_are_no_spread():
    """Grippers that are all alike, badly calibrated: a variance is known to 0.09 sqrt(2 / K)."""
    rng, sd, n = np.random.default_rng(3), 0.3, 4000
    x = sd * rng.standard_normal((n, 4))
    _, covariance = _population(x, np.tile(sd**2 * np.eye(4), (n, 1, 1)), 0.1 * np.eye(4))
    assert np.diag(covariance).max() < 4 * sd**2 * np.sqrt(2 / n) < 0.4 * (0.1 * WIDER) ** 2


def test_three_grippers_that_are_alike_are_hardly_doubted_less_than_assumed(device):
    one = known_to(device, NOTHING)
    found = gripper_population([one, one, one])
    assumed = another_gripper(known_to(device, NOTHING)).uncertainty.covariance
    ratio = np.sqrt(np.diag(found.uncertainty.covariance) / np.maximum(np.diag(assumed), 1e-12))
    moved = np.diag(assumed) > 1e-10
    # s^2 = (4 + s^2) / 7 of what is assumed, the mean is known to a third of it
    assert ratio[moved].min() == pytest.approx(np.sqrt(4 / 6 * 4 / 3), rel=1e-3)
    assert ratio[moved].max() < 1.0
    assert found.uncertain
    assert found.stack.e_outer == pytest.approx(device.stack.e_outer)
    assert found.blocks["iron"].ln_h == pytest.approx(device.blocks["iron"].ln_h)


def test_a_new_gripper_lies_within_what_a_dozen_others_leave_open(device):
    """Twelve grippers and a new one, drawn forty times: 90 % intervals of its numbers hold 0.90."""
    held = []
    for seed in range(40):
        *others, new = drawn(device, 13, times=1.0, seed=seed)
        found = gripper_population(others)
        theta = [
            gripper_theta(g, found.materials, np.zeros(len(found.uncertainty.names))) for g in (found, new)
        ]
        sd = np.sqrt(np.diag(found.uncertainty.covariance))
        moved = [
            found.uncertainty.names.index(n)
            for n in ("ln_e_outer", "ln_z_inner", "ln_lag", "creep", "ln_h iron")
        ]
        held += [(np.abs(theta[1] - theta[0]) < 1.645 * sd)[moved]]
    assert abs(np.mean(held) - 0.9) < 4 * np.sqrt(0.09 / np.size(held))


def only(gripper, material):
    return replace(gripper, blocks={material: gripper.blocks[material]})


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda g: [g, g], "2 grippers make no population"),
        (lambda g: [g, replace(g, uncertainty=None), g], "gripper 2 keeps no covariance"),
        (lambda g: [g, g, replace(g, second=g)], "gripper 3 has a second sensor"),
        (lambda g: [only(g, "iron"), g, only(g, "wood")], "no material in common"),
    ],
)  # fmt: skip
def test_what_makes_no_population_is_told(device, spoil, match):
    with pytest.raises(UserError, match=match):
        gripper_population(spoil(known_to(device, 0.1)))
