"""From grasps to materials and effusivities: the posterior engine (signatures; the filling follows).

``calibrate_device`` (in :mod:`thermogrip.sysid.calibration`) learns the gripper and its spreads; the functions here
use that frozen :class:`~thermogrip.sysid.gripper_device.Device` on new grasps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.materials import Material
from thermogrip.datasets.schema import Grasps

if TYPE_CHECKING:
    from thermogrip.sysid.gripper_device import Device

__all__ = [
    "EffusivityRow",
    "OpenSet",
    "effusivity_posterior",
    "emcee_posterior",
    "material_evidence",
    "material_posterior",
    "open_set",
]


@dataclass(frozen=True)
class EffusivityRow:
    """One grasp's posterior (one row of ``posterior.csv``)."""

    grasp_id: str
    effusivity: float
    effusivity_p05: float
    effusivity_p95: float
    t_object: float
    t_object_p05: float
    t_object_p95: float
    h_c: float
    log10_effusivity_sd: float


@dataclass(frozen=True)
class OpenSet:
    """``log_bayes_factor`` (n_grasp,) of the known candidates against a free effusivity; ``p_unknown`` (n_grasp,)."""

    log_bayes_factor: NDArray[np.float64]
    p_unknown: NDArray[np.float64]


def material_evidence(
    device: Device,
    grasps: Grasps,
    candidates: Sequence[str | Material],
    *,
    finish: str = "known",
    until: float | None = None,
) -> NDArray[np.float64]:
    """Return the log evidence of each candidate for each grasp, shape (n_grasp, n_candidate).

    ``finish="known"`` uses the contact conductance that the training blocks had; ``"unknown"`` is another block
    of the same material.  ``until`` keeps the samples up to that time after the closed message [s].
    """
    raise NotImplementedError


def material_posterior(
    device: Device,
    grasps: Grasps,
    candidates: Sequence[str | Material],
    *,
    finish: str = "known",
    until: float | None = None,
) -> NDArray[np.float64]:
    """Return probabilities (n_grasp, n_candidate); equal prior odds, rows sum to 1."""
    raise NotImplementedError


def open_set(
    device: Device, grasps: Grasps, candidates: Sequence[str | Material], *, prior_unknown: float = 0.1
) -> OpenSet:
    """Return log Bayes factors known : free effusivity, and p_unknown."""
    raise NotImplementedError


def effusivity_posterior(device: Device, grasps: Grasps) -> list[EffusivityRow]:
    """Return one row a grasp; effusivity log-uniform, finish unknown, object temperature as far as it is known."""
    raise NotImplementedError


def emcee_posterior(device: Device, grasps: Grasps, i: int, *, seed: int = 0, max_steps: int = 20000) -> object:
    """Sample the same posterior for grasp ``i`` with emcee, as a check of the fast engine."""
    raise NotImplementedError
