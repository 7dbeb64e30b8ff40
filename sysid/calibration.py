"""Learn the gripper from labelled grasps (signature; the filling follows)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from thermogrip.datasets.materials import Material
from thermogrip.datasets.schema import Grasps

if TYPE_CHECKING:
    from thermogrip.sysid.gripper_device import Device

__all__ = ["calibrate_device"]


def calibrate_device(
    grasps: Sequence[Grasps],
    *,
    materials: Mapping[str, Material] | None = None,
    start: Device | None = None,
    block_length: float = 0.02,
    seed: int = 0,
    progress: Callable[[float, str], None] | None = None,
) -> Device:
    """Return the device and populations that all labelled grasps support together.

    ``materials`` maps labels to library rows (default: the project's table); ``start`` is an earlier calibration,
    from which a refit on other grasps is quick (the noise level is then kept).
    """
    raise NotImplementedError
