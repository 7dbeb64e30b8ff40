"""What drives may do: ranges, slew, and where they go without a loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.plant.prediction import PredictionModel


@dataclass(frozen=True, eq=False)
class DriveLimits:
    """Limits of all drives, (n_u,) each, in their units."""

    lowest: Array
    highest: Array
    slew: Array  # largest change in a sample
    neutral: Array  # no drive, or what is nearest to none
    safe: Array  # where the drive of a failing loop goes

    @classmethod
    def of(
        cls,
        model: PredictionModel,
        drive_range: Mapping[str, tuple[float, float]],
        slew_per_s: Mapping[str, float],
        safe_drive: Mapping[str, float],
    ) -> DriveLimits:
        """Return those of a model's drives; a drive without a safe value goes to none."""
        lowest, highest = np.array([drive_range[name] for name in model.drives], dtype=float).T
        neutral = np.clip(np.zeros(model.n_u), lowest, highest)
        safe = [safe_drive.get(name, none) for name, none in zip(model.drives, neutral)]
        slew = model.dt * np.array([slew_per_s[name] for name in model.drives])
        return cls(lowest, highest, slew, neutral, np.array(safe, dtype=float))

    def cut(self, u: Array) -> Array:
        """Return drives (..., n_u) inside their ranges."""
        return np.asarray(np.minimum(np.maximum(u, self.lowest), self.highest))

    def follow(self, u: Array, before: Array, samples: float) -> Array:
        """Return drives (n_u,) that are finite, in range, and within the slew limit of so many samples of
        those before; range wins over slew."""
        before, slew = self.cut(before), self.slew * samples
        wanted = np.where(np.isfinite(u), u, self.safe)
        return self.cut(np.minimum(np.maximum(wanted, before - slew), before + slew))
