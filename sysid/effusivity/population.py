r"""What a new gripper of a kind may be, from several calibrated ones.

The numbers theta of gripper k (:mod:`~thermogrip.sysid.effusivity.gripper_model`) were estimated as x_k with
covariance P_k.  Grippers differ by independent causes j of their making
(:class:`~thermogrip.sysid.effusivity.gripper_model.GripperSpread`), each of which moves theta along d_j:

    x_k = mu + sum_j d_j a_kj + noise,   a_kj ~ N(0, s_j^2),   noise ~ N(0, P_k).

What is assumed of a kind of which nothing is known, s_j = 1.5 times the class's numbers, counts as
:math:`\nu = 4` grippers; EM under a flat prior of mu (restricted likelihood) finds

    s_j^2 = (nu s_0j^2 + sum_k E[a_kj^2]) / (nu + K),

and a new gripper is N(mu, D S D' + cov(mu)).  Two grippers say little of so many causes, and answers hardly
leave what is assumed; ten say most of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.effusivity.calibration import gripper_theta
from thermogrip.sysid.effusivity.data import Noise
from thermogrip.sysid.effusivity.gripper_model import (
    SHARED_NAMES,
    WIDER,
    Block,
    GripperModel,
    GripperSpread,
    ParameterCovariance,
    Spreads,
    block_names,
    stack_of,
)

LEAST = 3  # grippers
_ASSUMED = 4.0  # grippers that what is assumed of their spread counts for
_ROUNDS, _STILL = 500, 1e-6  # of EM, and the relative change that ends it


def gripper_population(grippers: Sequence[GripperModel]) -> GripperModel:
    """Return what a new gripper may be, of the kind of three calibrated ones or more: mean and spread.

    Parameters
    ----------
    grippers : sequence of GripperModel
        Calibrated each by itself, on materials of which at least one is common to all.

    Returns
    -------
    GripperModel
        The population's mean, with the materials that all have; ``uncertain``, so that answers integrate over
        what such grippers may be, and a few grasps of known blocks narrow it
        (``PosteriorClassifier().with_device(...).for_another_gripper(known)``).

    Raises
    ------
    UserError
        If there are fewer than three grippers, one keeps no covariance, has a second sensor or a
        discrepancy, or they have no material in common.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from thermogrip.sysid.effusivity import calibrate_gripper, gripper_population
    >>> from thermogrip.datasets import load_example_grasps
    >>> files = load_example_grasps()
    >>> names = ("exp2_dT10", "exp2_dT15", "exp2_dT20")
    >>> days = gripper_population([calibrate_gripper([files[name]]) for name in names])
    >>> days.materials, days.uncertain
    (('copper', 'iron', 'wood'), True)
    """
    labels = _common(grippers)
    names = (*SHARED_NAMES, *block_names(labels))
    nothing = np.zeros(len(names))
    x = np.stack([gripper_theta(one, labels, nothing) for one in grippers])
    p = np.stack([_covariance(one, names) for one in grippers])
    mean, covariance = _population(x, p, GripperSpread().directions(names))
    shared = dict(zip(SHARED_NAMES, mean.tolist()))
    first, n = grippers[0], len(labels)
    sd = np.sqrt(np.diag(covariance))
    blocks = {
        label: _block([one.blocks[label] for one in grippers], mean[-2 * n + k], mean[-n + k], sd[-n + k])
        for k, label in enumerate(labels)
    }
    return replace(
        first, stack=stack_of(mean), onset=shared["onset"], transit_loss=shared["transit_loss"],
        bias=shared["bias"], depth_share=float(np.exp(shared["ln_depth"])), blocks=blocks,
        noise=_middle([one.noise for one in grippers]), spreads=_middle([one.spreads for one in grippers]),
        ln_h_level=float(np.mean([one.ln_h_level for one in grippers])),
        ln_h_slope=float(np.mean([one.ln_h_slope for one in grippers])),
        block_length=float(np.mean([one.block_length for one in grippers])),
        trained_on=tuple(dict.fromkeys(name for one in grippers for name in one.trained_on)),
        uncertainty=ParameterCovariance(names, covariance), uncertain=True,
    )  # fmt: skip


def _common(grippers: Sequence[GripperModel]) -> list[str]:
    """Return the materials that all grippers have."""
    if len(grippers) < LEAST:
        raise UserError(
            f"{len(grippers)} grippers make no population", hint=f"give {LEAST} calibrated ones or more"
        )
    for k, one in enumerate(grippers, start=1):
        if one.uncertainty is None:
            raise UserError(f"gripper {k} keeps no covariance of its numbers", hint="calibrate it again")
        if one.second is not None or one.discrepancy is not None:
            what = "a second sensor" if one.second is not None else "a discrepancy"
            problem = f"gripper {k} has {what}, of which no population is made"
            raise UserError(problem, hint="leave it out")
    labels = [m for m in grippers[0].materials if all(m in one.blocks for one in grippers)]
    if not labels:
        raise UserError("the grippers have no material in common", hint="touch one with all of them")
    return labels


def _covariance(gripper: GripperModel, names: Sequence[str]) -> Array:
    assert gripper.uncertainty is not None
    at = [gripper.uncertainty.names.index(name) for name in names]
    return gripper.uncertainty.covariance[np.ix_(at, at)]


def _population(x: Array, p: Array, directions: Array) -> tuple[Array, Array]:
    """Return mean and covariance of a new gripper's numbers, by EM; ``x`` (K, n) with covariances ``p`` (K,
    n, n), ``directions`` (n, m) as assumed, a standard deviation long."""
    n_gripper = len(x)
    d = directions * WIDER
    share = np.ones(d.shape[1])  # s_j^2 in units of what is assumed
    for _ in range(_ROUNDS):
        precision = np.linalg.inv(p + (d * share) @ d.T)
        doubt = np.linalg.inv(precision.sum(axis=0))
        mean = doubt @ np.einsum("kab,kb->a", precision, x)
        gain = np.einsum("j,aj,kab->kjb", share, d, precision)  # of a_k from x_k - mu
        a = np.einsum("kjb,kb->kj", gain, x - mean)
        left = share - np.einsum("kjb,bj,j->kj", gain, d, share)
        left += np.einsum("kja,ab,kjb->kj", gain, doubt, gain)
        new = (_ASSUMED + (a**2 + left).sum(axis=0)) / (_ASSUMED + n_gripper)
        done = np.abs(new - share).max() < _STILL
        share = new
        if done:
            break
    covariance = (d * share) @ d.T + doubt
    return mean, 0.5 * (covariance + covariance.T)


def _block(blocks: Sequence[Block], ln_h: float, ln_e: float, ln_e_sd: float) -> Block:
    """Return a block as the population has it."""
    return replace(
        blocks[0], ln_h=float(ln_h), ln_effusivity=float(ln_e), ln_effusivity_sd=float(ln_e_sd),
        ln_h_sd=float(np.mean([b.ln_h_sd for b in blocks])), n_grasp=min(b.n_grasp for b in blocks),
    )  # fmt: skip


_Numbers = TypeVar("_Numbers", Noise, Spreads)


def _middle(parts: Sequence[_Numbers]) -> _Numbers:
    """Return the medians of the numbers of several records of one kind."""
    numbers = [f.name for f in fields(parts[0]) if isinstance(getattr(parts[0], f.name), float)]
    middle: dict[str, Any] = {k: float(np.median([getattr(one, k) for one in parts])) for k in numbers}
    return replace(parts[0], **middle)
