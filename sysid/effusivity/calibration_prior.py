"""What is known of a gripper before its grasps are looked at: the prior of theta, and of the spreads.

theta is laid out as the stack, the shared means (both in the order of
:data:`~thermogrip.sysid.effusivity.gripper_model.SHARED_NAMES`), then ln h and ln e of each block;
logarithms are named ``ln_...``.  Of a gripper that nobody has seen everything is wide, and only the
effusivities lean on the library.  Of one that has a
:class:`~thermogrip.sysid.effusivity.gripper_model.Device` (an earlier calibration, or that of another
gripper with the spread between grippers added) theta ~ N(its numbers, its covariance); the blocks that it
knows but that are not touched now stay in theta, since what they have in common with the touched ones moves
with them.

An earlier calibration's spreads from grasp to grasp count as ten grasps: another gripper or another day is
alike, not the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.materials import Material
from thermogrip.sysid.contact.response import Stack
from thermogrip.sysid.effusivity.gripper_model import NOTHING, SHARED_NAMES, Device, block_names

__all__ = [
    "FIRST_SPREAD",
    "SHARED",
    "STACK",
    "Anchor",
    "ThetaPrior",
    "anchors",
    "prior_of_device",
    "wide_prior",
]

Array = NDArray[np.float64]

# name: prior mean and sd; all wide, in the units of the name
STACK: dict[str, tuple[float, float]] = {
    "ln_e_outer": (float(np.log(2e3)), 1.0),
    "ln_z_outer": (float(np.log(0.1)), 1.0),
    "ln_e_inner": (float(np.log(2.5e3)), 1.0),
    "ln_z_inner": (float(np.log(6.0)), 0.7),
    "ln_g_back": (float(np.log(100.0)), 1.5),
    "ln_lag": (float(np.log(0.2)), 1.0),
    "ln_first": (float(np.log(0.05)), 1.0),
    "creep": (0.3, 0.5),
    "ln_settle": (float(np.log(3.0)), 0.7),
    "leak": (5e-4, 2e-3),
    "ln_g_side": (float(np.log(100.0)), 1.5),
    "ln_c_side": (float(np.log(2e4)), 1.0),
    "ln_g_far": (float(np.log(20.0)), 1.5),
}
SHARED: dict[str, tuple[float, float]] = {
    "ln_build": (float(np.log(0.5)), 1.0),
    "onset": (0.0, 0.3),
    "carry": (0.02, 0.03),
    "bias": (0.0, 0.3),
    "ln_depth": (0.0, 0.05),
}
FIRST_SPREAD = {"ln_h": 0.15, "ln_build": 0.1, "onset": 0.1, "t_object": 0.5, "ln_effusivity": 0.1}
_LN_H = (float(np.log(1500.0)), 1.0)
_GUESSES = 2.0  # grasps that the first guess of a spread counts for
_EARLIER = 10.0  # grasps that an earlier calibration's spread counts for at most
_EXACT = 1e-3  # of a wide prior's sd: numbers that count as exact keep this much, so that matrices invert


class Anchor(NamedTuple):
    """What a table says of one label: effusivity, its relative sd, and rho c_p."""

    effusivity: float
    sd_ln: float
    heat_capacity: float


@dataclass(frozen=True)
class ThetaPrior:
    """``mean`` (n_theta,) and ``precision`` (n_theta, n_theta) of theta; ``spread`` from grasp to grasp.

    ``guesses`` is the number of grasps that ``spread`` counts for.
    """

    mean: Array
    precision: Array
    spread: Mapping[str, float]
    guesses: float = _GUESSES

    def penalty(self, theta: Array) -> float:
        """Return the squared distance of theta from the mean, in standard deviations."""
        off = theta - self.mean
        return float(off @ self.precision @ off)


def anchors(
    labels: Sequence[str], library: Mapping[str, Material], device: Device | None
) -> tuple[Anchor, ...]:
    """Return what is written of each label, in the library or else in an earlier calibration."""
    out = []
    for label in labels:
        if label in library:
            row = library[label]
            out.append(Anchor(row.effusivity, row.effusivity_sd_ln, row.rho * row.c_p))
        else:
            assert device is not None
            block = device.blocks[label]
            out.append(Anchor(block.library_effusivity, block.library_sd_ln, block.heat_capacity))
    return tuple(out)


def wide_prior(known: Sequence[Anchor]) -> ThetaPrior:
    """Return the prior of a gripper that nobody has seen, with blocks of these effusivities."""
    table = [*STACK.values(), *SHARED.values(), *[_LN_H] * len(known)]
    table += [(float(np.log(row.effusivity)), row.sd_ln) for row in known]
    mean, sd = np.array(table).T
    return ThetaPrior(mean, np.diag(sd**-2.0), dict(FIRST_SPREAD))


def prior_of_device(device: Device, labels: Sequence[str], known: Sequence[Anchor]) -> ThetaPrior:
    """Return the prior that an earlier calibration is; labels that it has not met have a wide one."""
    wide = wide_prior(known)
    names = (*SHARED_NAMES, *block_names(labels))
    mean, sd = device_theta(device, labels, wide.mean), np.diag(wide.precision) ** -0.5
    covariance = np.diag((_EXACT * sd) ** 2)
    knowledge = device.knowledge
    for i, name in enumerate(names):
        label = name.partition(" ")[2]
        if label and label not in device.blocks:
            covariance[i, i] = sd[i] ** 2
    if knowledge is not None:
        at = [i for i, name in enumerate(names) if name in knowledge.names]
        theirs = [knowledge.names.index(names[i]) for i in at]
        covariance[np.ix_(at, at)] += knowledge.covariance[np.ix_(theirs, theirs)]
    spread = {k: float(getattr(device.spreads, k)) for k in FIRST_SPREAD}
    return ThetaPrior(mean, np.asarray(np.linalg.inv(covariance)), spread, min(_EARLIER, device.spreads.dof))


def device_theta(device: Device, labels: Sequence[str], otherwise: Array) -> Array:
    """Return theta of a calibration, (n_theta,); ``otherwise`` where it has no block of a label."""
    theta = otherwise.copy()
    stack = {f.name: float(getattr(device.stack, f.name)) for f in fields(Stack)}
    for i, name in enumerate(STACK):
        value = stack[name.removeprefix("ln_")]
        theta[i] = np.log(max(value, NOTHING)) if name.startswith("ln_") else value
    shared = (np.log(stack["build"]), device.onset, device.carry, device.bias, np.log(device.depth_share))
    theta[len(STACK) : len(STACK) + len(SHARED)] = shared
    n = len(labels)
    for k, label in enumerate(labels):
        if label in device.blocks:
            theta[-2 * n + k] = device.blocks[label].ln_h
            theta[-n + k] = device.blocks[label].ln_effusivity
    return theta
