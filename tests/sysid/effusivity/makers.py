"""Grasps simulated from a calibrated gripper's own populations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.simulation import Blocks, simulate_grasps
from thermogrip.sysid.effusivity.gripper_model import SHARED_NAMES, GripperModel, stack_numbers, stack_of
from thermogrip.sysid.effusivity.laplace_approximation import free_hypotheses

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


def drawn_from_the_prior(
    gripper: GripperModel, n: int, *, low: float, high: float, seed: int
) -> tuple[Grasps, NDArray[np.float64], NDArray[np.float64]]:
    """Return grasps of what the free hypothesis assumes, any effusivity and conductance; ln e and T_obj."""
    rng = np.random.default_rng(seed)
    ln_e = rng.uniform(np.log(low), np.log(high), n)
    free = free_hypotheses(gripper, ln_e)
    ln_h = free.ln_h + free.ln_h_sd * rng.standard_normal(n)
    ln_rho_c = free.ln_rho_c + free.ln_rho_c_sd * rng.standard_normal(n)
    grasps, t_object = simulated_blocks(
        gripper, ln_e=ln_e, ln_h=ln_h, ln_rho_c=ln_rho_c, t_gripper=23.0, t_object=43.0, seed=seed
    )
    return grasps, ln_e, t_object


def split_of(grasps: Grasps, split: str) -> Grasps:
    """Return the grasps of one split."""
    return grasps.isel(grasp=np.flatnonzero(grasps["split"].values == split))


def drawn_gripper(gripper: GripperModel, seed: int) -> GripperModel:
    """Return a gripper drawn from the covariance of its parameters, exact itself."""
    known = gripper.uncertainty
    assert known is not None
    move = np.random.default_rng(seed).multivariate_normal(np.zeros(len(known.names)), known.covariance)
    by = dict(zip(known.names, move))
    numbers = stack_numbers(gripper.stack)
    numbers += [by[name] for name in SHARED_NAMES[: numbers.size]]
    first = SHARED_NAMES.index("ln_first")
    numbers[first] = min(numbers[first], -0.01)
    blocks = {
        name: replace(b, ln_h=b.ln_h + by[f"ln_h {name}"], ln_effusivity=b.ln_effusivity + by[f"ln_e {name}"])
        for name, b in gripper.blocks.items()
    }
    shared = {name: getattr(gripper, name) + by[name] for name in ("onset", "transit_loss", "bias")}
    return replace(gripper, stack=stack_of(numbers), blocks=blocks, **shared)
