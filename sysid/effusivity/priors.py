"""What a hypothesis expects of a grasp before the data: priors of the seven nuisances.

Three kinds of hypothesis:

- a **material with training grasps**: its block's ln h and ln e as calibrated, with the spread from grasp
  to grasp;
- a **material of the library**: its effusivity carried to the gripper's scale, with the row's uncertainty,
  on a block of unknown finish;
- a **free effusivity**: a point of ln e, unknown finish, rho c_p of solids in general (3.2 MJ/m^3K for
  metals, 1.7 for insulators).

What comes from the gripper and the dial (build-up, onset, object temperature) is common to all of them.  How
far a block has gone to the room's temperature is known for rooms like those of the calibration only: in a
colder one the object's temperature is less well known than its spread.

A spread that n grasps have taught is itself uncertain, and a grasp two and a half of its standard deviations
out is no stranger where n is small: such a nuisance has Student's t as its prior, with the degrees of freedom
that the calibration had left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.materials import Material, find_material
from thermogrip.sysid.effusivity.data import Touches, whiten
from thermogrip.sysid.effusivity.gripper_model import INSULATOR, LEVEL_SD, UNKNOWN_OBJECT_SD, GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    N_NUISANCE,
    ONSET,
    T_OBJECT,
    H,
    Mode,
    Prior,
    find_modes,
    uncertain_gripper_modes,
)

__all__ = ["FINISHES", "Hypotheses", "fit_pairs", "free_hypotheses", "material_hypotheses", "prior_of"]

Array = NDArray[np.float64]

FINISHES = ("known", "unknown")


class Hypotheses(NamedTuple):
    """``n`` hypotheses: mean and sd of ln h, of ln e and of ln(rho c_p), (n,) each.

    ``ln_h_dof`` and ``ln_e_dof`` (n,) are the degrees of freedom behind the first two spreads; ``block`` (n,)
    is the place in ``device.materials`` of a block that was calibrated, -1 for others.
    """

    ln_h: Array
    ln_h_sd: Array
    ln_e: Array
    ln_e_sd: Array
    ln_rho_c: Array
    ln_rho_c_sd: Array
    ln_h_dof: Array
    ln_e_dof: Array
    block: Array


def material_hypotheses(
    device: GripperModel, candidates: Sequence[str | Material], finish: str = "known"
) -> Hypotheses:
    """Return one hypothesis a candidate, in their order."""
    if finish not in FINISHES:
        raise UserError(f"finish {finish!r} is unknown", hint="use 'known' or 'unknown'")
    names = [c if isinstance(c, str) else c.name for c in candidates]
    if not names:
        raise UserError("no candidate materials", hint="name at least one")
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"candidate {name!r} stands twice", hint="name each once")
    rows = [
        _trained(device, name, finish)
        if name in device.blocks
        else _untrained(device, candidate if isinstance(candidate, Material) else find_material(name))
        for name, candidate in zip(names, candidates)
    ]
    return Hypotheses(*np.array(rows).T)


def free_hypotheses(device: GripperModel, ln_e: ArrayLike) -> Hypotheses:
    """Return one hypothesis for each effusivity ln e on the gripper's own scale, finish unknown."""
    x = np.asarray(ln_e, dtype=float).ravel()
    metal = 1 / (1 + np.exp(-4 * (x - np.log(4500.0))))
    spread = np.full(x.size, device.spreads.ln_h_of_blocks)
    return Hypotheses(
        ln_h=device.expected_ln_h(x),
        ln_h_sd=np.hypot(spread, device.spreads.ln_h),
        ln_e=x,
        ln_e_sd=np.zeros(x.size),
        ln_rho_c=np.log(1.7e6) + metal * np.log(3.2e6 / 1.7e6),
        ln_rho_c_sd=0.4 - 0.2 * metal,
        ln_h_dof=np.full(x.size, np.inf),
        ln_e_dof=np.full(x.size, np.inf),
        block=np.full(x.size, -1.0),
    )


def prior_of(device: GripperModel, data: Touches, hypotheses: Hypotheses) -> Prior:
    """Return the prior of each (touch, hypothesis) pair, row by row; both have n rows."""
    n = data.level.size
    mean, sd = np.empty((n, N_NUISANCE)), np.empty((n, N_NUISANCE))
    dof = np.full((n, N_NUISANCE), np.inf)
    spreads = device.spreads
    dof[:, H], dof[:, EFFUSIVITY] = hypotheses.ln_h_dof, hypotheses.ln_e_dof
    dof[:, BUILD_UP] = dof[:, ONSET] = spreads.dof
    mean[:, H], sd[:, H] = hypotheses.ln_h, hypotheses.ln_h_sd
    mean[:, BUILD_UP], sd[:, BUILD_UP] = np.log(device.stack.build_up), spreads.ln_build_up
    mean[:, ONSET], sd[:, ONSET] = device.onset, spreads.onset
    mean[:, LEVEL], sd[:, LEVEL] = data.level, LEVEL_SD
    known = np.isfinite(data.t_object)
    carried = device.transit_loss * np.nan_to_num(data.t_ambient - data.t_object)
    room = np.where(np.isfinite(data.t_ambient), data.t_ambient, data.level)
    mean[:, T_OBJECT] = np.where(known, data.t_object + device.bias + carried, room)
    # normal, so that it can be integrated exactly: with the variance of Student's t, which has none at two
    # degrees of freedom, of one training grasp a material: then the dial is not believed
    beyond = max(spreads.dof - 2, 1e-9)
    learnt = min(spreads.t_object * np.sqrt(spreads.dof / beyond), UNKNOWN_OBJECT_SD)
    own = np.where(np.isfinite(data.t_object_sd), data.t_object_sd, learnt)
    if not device.uncertain:  # else it is integrated with all the rest
        own = np.hypot(own, device.nominal_sd(data.t_ambient - data.t_object))
    sd[:, T_OBJECT] = np.where(known, own, UNKNOWN_OBJECT_SD)
    mean[:, EFFUSIVITY], sd[:, EFFUSIVITY] = hypotheses.ln_e, hypotheses.ln_e_sd
    mean[:, CAPACITY] = hypotheses.ln_rho_c + np.log(device.block_length * device.depth_share)
    sd[:, CAPACITY] = hypotheses.ln_rho_c_sd
    return Prior(mean, sd, dof)


def fit_pairs(
    device: GripperModel,
    data: Touches,
    row: NDArray[np.int64],
    hypotheses: Hypotheses,
    *,
    start: Array | None = None,
    max_steps: int = 20,
    noise: tuple[Array, Array] | None = None,
) -> Mode:
    """Return the modes of pairs, hypothesis i against touch ``row[i]``; a gripper in doubt is integrated.

    ``noise`` is what :func:`~thermogrip.sysid.effusivity.data.whiten` gives, where a caller has it.
    """
    prior = prior_of(device, data.take(row), hypotheses)
    noise = whiten(data, device.noise) if noise is None else noise
    if device.uncertain:
        block = hypotheses.block.astype(np.int64)
        return uncertain_gripper_modes(
            device, data, row, noise, prior, block, start=start, max_steps=max_steps
        )
    return find_modes(device.stack, data, row, noise, prior, start=start, max_steps=max_steps)


def _trained(device: GripperModel, name: str, finish: str) -> tuple[float, ...]:
    block = device.blocks[name]
    spread = (
        device.spreads.ln_h
        if finish == "known"
        else float(np.hypot(device.spreads.ln_h_of_blocks, device.spreads.ln_h))
    )
    scatter = device.spreads.ln_effusivity if block.library_effusivity < INSULATOR else 0.0
    return (
        block.ln_h,
        float(np.hypot(spread, block.ln_h_sd)),
        block.ln_effusivity,
        scatter,
        float(np.log(block.heat_capacity)),
        0.0,
        device.spreads.dof if finish == "known" else np.inf,
        device.spreads.insulator_dof if scatter else np.inf,
        float(device.materials.index(name)),
    )


def _untrained(device: GripperModel, row: Material) -> tuple[float, ...]:
    found = float(device.found_effusivity(np.log([row.effusivity]))[0])
    scale_sd = device.effusivity_scale(np.array([found]))[1]
    scatter = device.spreads.ln_effusivity if row.effusivity < INSULATOR else 0.0
    return (
        float(device.expected_ln_h(np.array(found))),
        float(np.hypot(device.spreads.ln_h_of_blocks, device.spreads.ln_h)),
        float(found),
        float(np.sqrt(row.effusivity_sd_ln**2 + float(scale_sd[0]) ** 2 + scatter**2)),
        float(np.log(row.rho * row.c_p)),
        0.05,
        np.inf,
        np.inf,
        -1.0,
    )
