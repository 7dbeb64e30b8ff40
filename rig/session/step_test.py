"""A step test: what the first loop of a rig is made from, in a few minutes.

Each drive in turn is at the end of its range until a sensor is half of its way to the target, and off for as
long, in which the heat that is under way arrives; a drive of both signs goes to its other end likewise.  What
is known afterwards are the slope and the delay of each response; the slope is gain / lag, which is all that
the gain of a SIMC loop takes (its integral time is bounded by the delay).
"""

from __future__ import annotations

from collections.abc import Mapping

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.interface import Move, Readings, Target

LEAST_MOVED = 1.0  # K: three steps of a TCLab's converter (0.32 K), below which a slope is its rounding
PUMP = "pump"


class StepTest:
    """The test as a controller: drives of these ranges until ``targets`` are half reached [degC]."""

    def __init__(
        self,
        ranges: Mapping[str, tuple[float, float]],
        targets: Mapping[str, float],
        *,
        seconds: float,
        has_pump: bool = False,
        dt: float = 1.0,
    ) -> None:
        self.dt = dt
        self.seconds = seconds
        self.done = False
        self._ranges = dict(ranges)
        self._targets = dict(targets)
        self._has_pump = has_pump
        self._turns: list[tuple[str, float]] = []

    def reset(self, reading: Readings) -> None:
        """Begin with the first drive."""
        towards = 1 if sum(goal - reading[name] for name, goal in self._targets.items()) > 0 else -1
        turns = []
        for name, (low, high) in self._ranges.items():
            turns += [(name, high)] if low >= 0 else [(name, high), (name, low)][::towards]
        # the end of a log is what a model is judged by: one that only cools may say nothing of the drives,
        # and of a drive that comes there for the first time nothing can be learnt, so the first comes again
        if len(turns) == 1 or turns[-1][0] != turns[0][0]:
            turns.append(turns[0])
        if self._has_pump:
            turns.insert(1, (PUMP, 0.0))  # once there is heat to stand still
        self._turns, self.done = turns, False
        self._most_on_s = self.seconds / (2 * len(turns))
        self._begin(reading)

    def _begin(self, reading: Readings) -> None:
        self._start = {name: reading[name] for name in self._targets}
        self._on_at, self._on_s = reading["time_s"], float("inf")

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the drive of the turn."""
        passed = reading["time_s"] - self._on_at
        # off for as long as on, but for the last turn and the pump's
        once = len(self._turns) == 1 or self._turns[0][0] == PUMP
        if passed >= (1 if once else 2) * self._on_s:
            on_s = self._on_s
            del self._turns[0]
            self.done = not self._turns
            self._begin(reading)
            passed = 0.0
            if self._turns and self._turns[0][0] == PUMP:
                self._on_s = on_s
        off = dict.fromkeys(self._ranges, 0.0)
        name, full = (PUMP, 0.0) if self.done else self._turns[0]
        if name == PUMP:
            return Move(drive=off, pump=0)
        if passed < self._on_s and self._has_moved(reading, passed):
            self._on_s = passed
        return Move(drive=off | ({name: full} if passed < self._on_s else {}))

    def _has_moved(self, reading: Readings, passed: float) -> bool:
        """Return whether a drive has been on for long enough; UserError where it has moved nothing."""
        moved = {name: reading[name] - begin for name, begin in self._start.items()}
        ways = {name: goal - self._start[name] for name, goal in self._targets.items()}
        if any(abs(moved[name] / way) >= 0.5 for name, way in ways.items() if abs(way) > LEAST_MOVED):
            return True
        if passed < self._most_on_s:
            return False
        if max(map(abs, moved.values())) < LEAST_MOVED:
            name = self._turns[0][0]
            problem = f"{name} moved no sensor by {LEAST_MOVED:g} K in {passed:.0f} s of full drive"
            raise UserError(problem, hint="check the drive and its supply, or give more --minutes")
        return True
