"""What a hypothesis expects of a grasp before the data: priors of the seven nuisances.

Three kinds of hypothesis:

- a **material with training grasps**: its block's ln h and ln e as calibrated, with the spread from grasp
  to grasp;
- a **material of the library**: its effusivity carried to the gripper's scale, with the row's uncertainty,
  on a block of unknown contact conductance;
- a **free effusivity**: a point of ln e, unknown contact conductance, rho c_p of solids in general (3.2
  MJ/m^3K for metals, 1.7 for insulators).

What comes from the gripper and the nominal temperature (build-up time, onset, object temperature) is common
to all of them.  How far a block has gone to the room's temperature is known for rooms like those of the
calibration only: in a colder one the object's temperature is less well known than its spread.

A spread estimated from n grasps is itself uncertain, and a grasp two and a half of its standard deviations
out is not unusual where n is small: such a nuisance has Student's t as its prior, with the degrees of freedom
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

__all__ = ["FINISHES", "Hypotheses", "fit_candidates", "fit_pairs", "free_hypotheses"]
__all__ += ["material_hypotheses", "prior_of"]

Array = NDArray[np.float64]

FINISHES = ("known", "unknown")


class Hypotheses(NamedTuple):
    """``n`` hypotheses: mean and sd of ln h, of ln e and of ln(rho c_p), (n,) each.

    ``ln_h_dof`` and ``ln_e_dof`` (n,) are the degrees of freedom behind the first two spreads; ``block`` (n,)
    is the place in ``gripper.materials`` of a block that was calibrated, -1 for others.
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
    gripper: GripperModel, candidates: Sequence[str | Material], finish: str = "known"
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
        _trained(gripper, name, finish)
        if name in gripper.blocks
        else _untrained(gripper, candidate if isinstance(candidate, Material) else find_material(name))
        for name, candidate in zip(names, candidates)
    ]
    return Hypotheses(*np.array(rows).T)


def free_hypotheses(gripper: GripperModel, ln_e: ArrayLike) -> Hypotheses:
    """Return one hypothesis for each effusivity ln e on the gripper's own scale, h_c unknown."""
    x = np.asarray(ln_e, dtype=float).ravel()
    metal = 1 / (1 + np.exp(-4 * (x - np.log(4500.0))))
    spread = np.full(x.size, gripper.spreads.ln_h_of_blocks)
    return Hypotheses(
        ln_h=gripper.expected_ln_h(x), ln_h_sd=np.hypot(spread, gripper.spreads.ln_h), ln_e=x,
        ln_e_sd=np.zeros(x.size), ln_rho_c=np.log(1.7e6) + metal * np.log(3.2e6 / 1.7e6),
        ln_rho_c_sd=0.4 - 0.2 * metal, ln_h_dof=np.full(x.size, np.inf), ln_e_dof=np.full(x.size, np.inf),
        block=np.full(x.size, -1.0),
    )  # fmt: skip


def prior_of(gripper: GripperModel, data: Touches, hypotheses: Hypotheses) -> Prior:
    """Return the prior of each (touch, hypothesis) pair, row by row; both have n rows."""
    n = data.level.size
    mean, sd = np.empty((n, N_NUISANCE)), np.empty((n, N_NUISANCE))
    dof = np.full((n, N_NUISANCE), np.inf)
    spreads = gripper.spreads
    dof[:, H], dof[:, EFFUSIVITY] = hypotheses.ln_h_dof, hypotheses.ln_e_dof
    dof[:, BUILD_UP] = dof[:, ONSET] = spreads.dof
    mean[:, H], sd[:, H] = hypotheses.ln_h, hypotheses.ln_h_sd
    mean[:, BUILD_UP], sd[:, BUILD_UP] = np.log(gripper.stack.build_up), spreads.ln_build_up
    mean[:, ONSET], sd[:, ONSET] = gripper.onset, spreads.onset
    mean[:, LEVEL], sd[:, LEVEL] = data.level, LEVEL_SD
    known = np.isfinite(data.t_object)
    carried = gripper.transit_loss * np.nan_to_num(data.t_ambient - data.t_object)
    room = np.where(np.isfinite(data.t_ambient), data.t_ambient, data.level)
    mean[:, T_OBJECT] = np.where(known, data.t_object + gripper.bias + carried, room)
    # normal, so that it can be integrated exactly: with the variance of Student's t, which has none at two
    # degrees of freedom, of one training grasp a material: then the nominal one counts little
    beyond = max(spreads.dof - 2, 1e-9)
    learnt = min(spreads.t_object * np.sqrt(spreads.dof / beyond), UNKNOWN_OBJECT_SD)
    own = np.where(np.isfinite(data.t_object_sd), data.t_object_sd, learnt)
    if not gripper.uncertain:  # else it is integrated with all the rest
        own = np.hypot(own, gripper.nominal_sd(data.t_ambient - data.t_object))
    sd[:, T_OBJECT] = np.where(known, own, UNKNOWN_OBJECT_SD)
    mean[:, EFFUSIVITY], sd[:, EFFUSIVITY] = hypotheses.ln_e, hypotheses.ln_e_sd
    mean[:, CAPACITY] = hypotheses.ln_rho_c + np.log(gripper.block_length * gripper.depth_share)
    sd[:, CAPACITY] = hypotheses.ln_rho_c_sd
    return Prior(mean, sd, dof)


def fit_pairs(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, *,
    start: Array | None = None, max_steps: int = 20, noise: tuple[Array, Array] | None = None,
    prior: Prior | None = None,
) -> Mode:  # fmt: skip
    """Return the modes of pairs, hypothesis i against touch ``row[i]``.

    The parameters of an uncertain gripper are integrated over.  ``noise`` and ``prior`` are what
    :func:`~thermogrip.sysid.effusivity.data.whiten` and :func:`prior_of` give, where a caller has them.
    """
    prior = prior_of(gripper, data.take(row), hypotheses) if prior is None else prior
    noise = whiten(data, gripper.noise) if noise is None else noise
    if gripper.uncertain:
        block = hypotheses.block.astype(np.int64)
        return uncertain_gripper_modes(
            gripper, data, row, noise, prior, block, start=start, max_steps=max_steps
        )
    return find_modes(gripper.stack, data, row, noise, prior, start=start, max_steps=max_steps)


def fit_candidates(
    gripper: GripperModel, data: Touches, candidates: Sequence[str | Material], finish: str = "known", *,
    start: Array | None = None,
) -> tuple[Mode, Prior, NDArray[np.int64]]:  # fmt: skip
    """Return modes of every touch under every candidate, (n m,) rows; the prior and the touch of each.

    ``start`` (n, m, 7) are nuisances to start from.
    """
    one = material_hypotheses(gripper, candidates, finish)
    n, m = data.level.size, len(candidates)
    row = np.repeat(np.arange(n), m)
    hypotheses = Hypotheses(*(np.tile(h, n) for h in one))
    begin = None if start is None else start.reshape(n * m, -1)
    prior = prior_of(gripper, data.take(row), hypotheses)
    return fit_pairs(gripper, data, row, hypotheses, start=begin, prior=prior), prior, row


def _trained(gripper: GripperModel, name: str, finish: str) -> tuple[float, ...]:
    block = gripper.blocks[name]
    spread = (
        gripper.spreads.ln_h
        if finish == "known"
        else float(np.hypot(gripper.spreads.ln_h_of_blocks, gripper.spreads.ln_h))
    )
    scatter = gripper.spreads.ln_effusivity if block.library_effusivity < INSULATOR else 0.0
    return (
        block.ln_h,
        float(np.hypot(spread, block.ln_h_sd)),
        block.ln_effusivity,
        scatter,
        float(np.log(block.heat_capacity)),
        0.0,
        gripper.spreads.dof if finish == "known" else np.inf,
        gripper.spreads.insulator_dof if scatter else np.inf,
        float(gripper.materials.index(name)),
    )


def _untrained(gripper: GripperModel, row: Material) -> tuple[float, ...]:
    found = float(gripper.found_effusivity(np.log([row.effusivity]))[0])
    scale_sd = gripper.effusivity_scale(np.array([found]))[1]
    scatter = gripper.spreads.ln_effusivity if row.effusivity < INSULATOR else 0.0
    return (
        float(gripper.expected_ln_h(np.array(found))),
        float(np.hypot(gripper.spreads.ln_h_of_blocks, gripper.spreads.ln_h)),
        float(found),
        float(np.sqrt(row.effusivity_sd_ln**2 + float(scale_sd[0]) ** 2 + scatter**2)),
        float(np.log(row.rho * row.c_p)),
        0.05,
        np.inf,
        np.inf,
        -1.0,
    )
