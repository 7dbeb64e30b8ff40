r"""Readings that cannot be, and plants that do not follow: found by what the model expects.

A jump is a loose plug until it stays; a frozen reading is as finite and as near as any other, and a
controller that accepts it heats for ever.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.interface import number
from thermogrip.mpc.plant.prediction import SPIKE

if TYPE_CHECKING:
    from thermogrip.mpc.estimator.observer import Observer

LEFT_OUT = 3  # samples in a row, at most, that a jump is left out for
#: Of a jump (6 degC, or a tenth of a wide range): what the model expects of a reading that has not moved at
#: all, and a bias of an output that is no small error of the model.
# a thirtieth of a wide range, for readings in coarse steps stay where they are while a model is a little off
SHARE = 1 / 3
FOLLOWS_DRIVE = 0.3  # of its range: a larger bias of a drive is a pump that is off, or another plant


class ReadingMonitor:
    """What the last readings were, and what was expected of them."""

    def __init__(self, n_y: int, *, spike: Array | float = SPIKE) -> None:
        self._spike = spike
        self.forget(np.full(n_y, np.nan))

    def forget(self, y: Array) -> None:
        """Start afresh from reading y (n_y,)."""
        self._last, self._moved = np.array(y, dtype=float), np.zeros(len(y))
        self._spikes = np.zeros(len(y), dtype=int)  # samples in a row that each reading was left out for

    def expect(self, change: Array) -> None:
        """Note by how much the model moves the outputs (n_y,) in a sample [degC]."""
        # m+ = m + C (f(x, u, d) - x), and 0 whenever the reading changes: the estimate follows the frozen
        # reading meanwhile, so that only what each sample adds is summed, not where the model would have gone
        self._moved = self._moved + change

    @property
    def stuck(self) -> Mask:
        """Which readings (n_y,) have stayed the same too long to be true."""
        return np.asarray(np.abs(self._moved) > SHARE * self._spike)

    def screen(self, y: Array, expected: Array) -> tuple[Array, Mask]:
        """Return a reading y (n_y,) [degC], NaN where it cannot be, and which of its sensors (n_y,) have
        jumped and stay there; ``expected`` (n_y,) is the prediction."""
        y, jumped = self._found(y, expected)
        self._spikes = np.where(jumped, self._spikes + 1, np.where(np.isfinite(y), 0, self._spikes))
        # at the fourth it counts: where most sensors have stayed with the model, as an offset of the one that
        # jumped; else the world has changed, and the estimate starts again
        stays = self._spikes > LEFT_OUT
        self._spikes[stays] = 0
        return np.where(jumped & ~stays, np.nan, y), stays

    def screen_between(self, y: Array, expected: Array) -> Array:
        """Return a reading y (n_y,) [degC] between two moves, NaN where it cannot be; no jump counts."""
        y, jumped = self._found(y, expected)
        return np.where(jumped, np.nan, y)

    def _found(self, y: Array, expected: Array) -> tuple[Array, Mask]:
        """Return a reading (n_y,) without those that are stuck, and which of it have jumped (n_y,)."""
        fresh = np.isfinite(y) & (y != self._last)
        self._last = np.where(np.isfinite(y), y, self._last)
        self._moved = np.where(fresh, 0.0, self._moved)
        y = np.where(self.stuck, np.nan, y)
        return y, np.asarray(np.abs(y - expected) > self._spike)


def follows(observer: Observer, controlled: tuple[str, ...]) -> str:
    """Return the report where the model no longer explains the plant; empty where it does."""
    pump = "does the pump run" if observer.model.model.switches else ""
    if np.any(np.abs(observer.disturbance.on_drive @ observer.w) >= FOLLOWS_DRIVE):
        do = "does" if len(controlled) == 1 else "do"
        return f"{', '.join(controlled)} {do} not follow the drive: {pump or 'is it another plant'}?"
    off = np.abs(observer.output_bias - observer.offset)
    share_of_limit = off / (SHARE * observer.model.spike)
    if np.any(share_of_limit >= 1.0):
        name = observer.model.outputs[int(np.argmax(share_of_limit))]
        return f"{name} is far from the model: {pump}{', ' * bool(pump)}is the sensor in place?"
    return ""


def is_off(switches: Sequence[str], reading: Mapping[str, float]) -> bool:
    """Return whether a reading says that a switch is off that the model has on (the pump)."""
    return any(number(reading, name) < 0.5 for name in switches)
