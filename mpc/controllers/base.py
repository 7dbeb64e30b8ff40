"""What the controllers share besides their law: when a move is due, what was read, and what may be applied.

Readings are screened for what cannot be a temperature, the last good target stays in force, and a drive is
finite, inside its range, and within the slew limit of the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.controllers import advice
from thermogrip.mpc.estimator.call_times import SAME, CallTimes
from thermogrip.mpc.interface import Move, Readings, Trajectory, is_line, number, target_now
from thermogrip.mpc.optimiser.drive_limits import DriveLimits
from thermogrip.mpc.plant.prediction import PredictionModel


class SampledController:
    """A controller whose drives stay within their limits."""

    def __init__(
        self,
        model: PredictionModel,
        controlled: tuple[str, ...],
        drives: DriveLimits,
        patience_s: float,
        clock: Callable[[], float],
    ) -> None:
        self.model = model
        self.controlled, self.dt = controlled, model.dt
        self.drives = drives
        self.clock = clock
        self.times = CallTimes(model.dt)
        self._rows = [model.outputs.index(name) for name in controlled]
        self._patience_s = patience_s * (1 + SAME)
        self._forget()
        self._move = Move(as_drive(model.drives, self.u))

    def _forget(self) -> None:
        """Return to no drive and no target, every output just read."""
        self.u = self.drives.neutral.copy()  # (n_u,) in force, from which the slew limit counts
        self._target = np.full(len(self.controlled), np.nan)
        self._unread_s = np.zeros(len(self.controlled))  # since each controlled output was read

    def _applied(self, reading: Readings, otherwise: Array) -> Array:
        """Return the drives (n_u,) that a reading says were applied, else these."""
        applied = np.array([number(reading, name) for name in self.model.drives])
        return np.where(np.isfinite(applied), applied, otherwise)

    @property
    def safe_drives(self) -> Array:
        """Drives (n_u,) of a loop that has failed or ends."""
        return self.drives.safe.copy()

    @property
    def _lost(self) -> Mask:
        """Which controlled outputs have not been read for longer than patience."""
        return np.asarray(self._unread_s > self._patience_s)

    def _clean(self, reading: Readings, name: str) -> float:
        """Return a plausible value from a reading, NaN where it is missing, no number, or absurd."""
        value = number(reading, name)
        return value if self.model.coldest <= value <= self.model.hottest else float("nan")

    def measured(self, reading: Readings) -> Array:
        """Return the measured disturbances (n_d,) of a reading, NaN where they cannot be."""
        model = self.model
        d = np.array([number(reading, name) for name in model.disturbances], dtype=float)
        return np.where((model.least_d <= d) & (d <= model.most_d), d, np.nan)

    def _read(self, reading: Readings) -> tuple[Array, Array]:
        """Return the outputs (n_y,) and disturbances (n_d,) of a reading [degC], NaN where they cannot be."""
        y = np.array([self._clean(reading, name) for name in self.model.outputs])
        return y, self.measured(reading)

    def _wanted(self, target: Trajectory) -> tuple[Array, str]:
        """Return targets (n_controlled,) [degC], the last good one staying and a single number being that of
        every controlled output, and what was wrong with them."""
        controlled, now = self.controlled, target_now(target)
        if isinstance(now, Mapping):
            wanted = np.array([self._clean(now, name) for name in controlled])
            unknown = [name for name in now if name not in controlled]
            wrong = advice.bad_target(controlled, unknown[0]) if unknown else ""
        else:
            wanted, wrong = np.full(len(controlled), self._clean({"": now}, "")), ""
        lost = ~np.isfinite(wanted)
        if lost.any():
            wrong = advice.bad_target(controlled[int(np.argmax(lost)) :])
        return np.where(lost, self._target, wanted), wrong

    def _is_new(self, wanted: Array) -> bool:
        """Return whether a target (n_controlled,) is another one than at the last move."""
        return bool((np.isfinite(wanted) & (wanted != self._target)).any())

    def _within(self, u: Array) -> Array:
        """Return drives (n_u,) that are finite, in range, and within the slew limit since the last ones."""
        return self.drives.follow(u, self.u, self.times.slew_s / self.dt)

    def _answer(self, u: Array, status: str, why: str, started: float) -> Move:
        """Return the move to drives (n_u,), from now on in force; without any, the pump may rest."""
        self.times.moved(self.dt * float(np.max(np.abs(u - self.u) / self.drives.slew)))
        self.u = u
        pump = 0 if status == "off" and not np.any(self.u) else 1
        drive = as_drive(self.model.drives, self.u)
        self._move = Move(drive, pump, status, why, self.clock() - started)
        return self._move

    def _held_move(self, started: float) -> Move:
        """Return the last move again, for a call before the next one is due; its advice stays."""
        again = self._move.advice or advice.TOO_EARLY
        return replace(self._move, advice=again, seconds=self.clock() - started)


def has_preview(target: Trajectory) -> bool:
    """Return whether targets of the samples ahead are known."""
    return isinstance(target, Mapping) and any(map(is_line, target.values()))


def targets_ahead(
    target: Trajectory, controlled: Sequence[str], now: Array, at: NDArray[np.int_], low: float, high: float
) -> Array | None:
    """Return the targets (len(at), n_controlled) of samples ``at`` from now, of which the last stays; None
    where targets do.  What is not from low to high is the target now (n_controlled,)."""
    if not isinstance(target, Mapping) or not has_preview(target):
        return None
    lines = [np.append([], target.get(name, [])) for name in controlled]
    lines = [line if line.size else np.array([target_now]) for line, target_now in zip(lines, now)]
    ahead = np.column_stack([line[np.minimum(at, len(line) - 1)] for line in lines]).astype(float)
    return np.where((ahead >= low) & (ahead <= high), ahead, now)  # NaN is neither


def as_drive(drives: tuple[str, ...], u: ArrayLike) -> float | dict[str, float]:
    """Return drives as a move has them: a number where there is one, else by name."""
    values = np.asarray(u, dtype=float).tolist()
    return float(values[0]) if len(drives) == 1 else dict(zip(drives, values))
