"""A calibrated gripper: what describes the device, and what it learnt about blocks (signatures; filling follows)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["Device", "load_default_device"]


@dataclass(frozen=True)
class Device:
    """The calibrated gripper (JSON, schema ``thermogrip.device``)."""

    materials: tuple[str, ...]  # labels it was calibrated with

    def save(self, path: str | Path) -> Path:
        """Write JSON."""
        raise NotImplementedError

    @classmethod
    def load(cls, path: str | Path) -> Device:
        """Read JSON."""
        raise NotImplementedError


def load_default_device() -> Device:
    """Return the bundled calibration of the example rig's gripper (data/gripper_device.json)."""
    raise NotImplementedError
