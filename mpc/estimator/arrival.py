"""Targets that are not reached when they should be: a loop that is bad while nothing else tells.

What a filter with a disturbance on each output assumes explains any reading, so a plant that is not its model
can pass for one that is.  But one can say when an output arrives at its target.  An output that is
promised in t seconds and is still off after 3 t and ten samples is overdue; it is there again once it has
been near for five samples in a row, so that a swing through the target is no arrival.  Near is within what
the output may overshoot of its target or its zone; noise that the
model does not know of is less in a mean of some three readings, and overdue is what that and the reading of
now are.

A new target, of any output, begins anew.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermogrip.datasets.arrays import Array

# how many promised times are given, and samples besides: loads must be learnt too
LATE_TIMES, LATE_SAMPLES = 3.0, 10
ARRIVAL_SAMPLES = 5  # in a row that make an arrival
NEWEST_ERROR = 0.3  # share of the newest error in their mean


class ArrivalMonitor:
    """When controlled outputs, ``names``, were promised and how long they have been near; ``near`` (n,) is
    how far from a target an output is there."""

    def __init__(self, names: Sequence[str], dt: float, near: Array) -> None:
        self.names, self.dt, self.near = tuple(names), dt, near
        self.restart()

    def restart(self) -> None:
        """Forget what was promised."""
        self._target = np.full(len(self.names), np.nan)
        self._error = np.full(len(self.names), np.nan)  # mean of the last readings', less the target
        self._due = np.full(len(self.names), np.inf)  # seconds until an output is overdue
        self._late = np.zeros(len(self.names))  # seconds since it should have been there
        self._stayed = np.zeros(len(self.names), dtype=int)  # samples in a row that it was near

    def expect(self, y: Array, target: Array, promised: Array, seconds: Array, zone: Array) -> str:
        """Note readings y and targets (n,) where outputs are promised in so many seconds (n,), inf where not,
        ``seconds`` (n,) that count having passed since the last; return which output is overdue."""
        if np.any(target != self._target):
            self.restart()
            self._target = target.copy()
        error = y - target
        begun = np.where(np.isfinite(self._error), self._error, error)
        self._error = np.where(np.isfinite(error), begun + NEWEST_ERROR * (error - begun), begun)
        off = np.abs(self._error) - zone
        self._stayed = np.where(off <= self.near, self._stayed + 1, 0)
        there = self._stayed >= ARRIVAL_SAMPLES
        self._due = np.where(there, np.inf, self._due - seconds)
        self._late = np.where(there, 0.0, self._late + seconds)
        begins = np.isfinite(promised) & (off > self.near) & np.isinf(self._due)
        self._due = np.where(begins, LATE_TIMES * promised + LATE_SAMPLES * self.dt, self._due)
        self._late = np.where(begins, -promised, self._late)
        away = (off > self.near) & (np.abs(error) - zone > self.near)
        overdue = away & (self._due < 0)
        if not overdue.any():
            return ""
        k = int(np.argmax(np.where(overdue, off / self.near, 0.0)))
        return (
            f"{self.names[k]} should have been at {target[k]:.4g} {self._late[k]:.0f} s ago and is "
            f"{off[k]:.2g} off: a load, or another plant than the model"
        )
