"""Grasps simulated from a calibrated gripper's own populations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.simulation import Blocks, simulate_grasps
from thermogrip.sysid.effusivity.gripper_model import GripperModel

FIVE = ["brass", "copper", "iron", "wood", "zinc"]


def simulated(gripper: GripperModel, materials: list[str], **given: Any) -> Grasps:
    """Return grasps of the gripper's own blocks, 10 Hz, by its own noise and drift."""
    return simulate_grasps(gripper.grip(), materials, **(gripper.readings() | given))


def simulated_blocks(
    gripper: GripperModel, *, ln_e: ArrayLike, ln_h: ArrayLike, ln_rho_c: ArrayLike, **given: Any
) -> tuple[Grasps, NDArray[np.float64]]:
    """Return one grasp of each of these blocks, and their true temperatures at contact (n,) [degC]."""
    grip, e = gripper.grip(), np.exp(np.asarray(ln_e, dtype=float))
    blocks = Blocks(e, np.exp(np.asarray(ln_h)), np.exp(np.asarray(ln_rho_c)) * grip.length)
    labels = given.pop("material", [""] * e.size)
    grasps = simulate_grasps(grip, labels, blocks=blocks, **(gripper.readings() | given))
    rng, ambient = np.random.default_rng(given.get("seed", 0)), given.get("ambient", 28.0)
    touches = grip.draw_many(labels, given["t_object"], rng, ambient=ambient, blocks=blocks)
    return grasps, np.array([touch.t_object for touch in touches])
