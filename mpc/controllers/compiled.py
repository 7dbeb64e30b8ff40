"""The whole step of a controller in C, behind readings and moves.

Readings by name become the numbers of a :class:`thermogrip.mpc.native.runtime.CompiledController`, its
answer a move.  What it advises of is put into words from its state, in the few steps where there is anything.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.controllers import advice
from thermogrip.mpc.controllers.base import as_drive, has_preview, targets_ahead
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.estimator.reading_checks import is_off
from thermogrip.mpc.interface import STATUSES, Move, Readings, Trajectory, number, target_now
from thermogrip.mpc.native.runtime import QP_STATUS, CompiledController, address


class _Code(IntEnum):
    """What the C advises of: ``enum tg_advice``."""

    ALL_WELL = 0
    TOO_EARLY = 1
    STALE = 2
    RESTARTED = 3
    LOST_READING = 4
    NO_TARGET = 5
    BAD_TARGET = 6
    BLIND = 7
    SOLVER = 8
    OUT_OF_RANGE = 9
    LIMIT_BREAKS = 10
    STUCK = 11
    TOO_LATE = 12
    SENSOR_OFFSET = 13
    WORLD_CHANGED = 14
    UNSEEN = 15
    PUMP_OFF = 16


class CompiledStep:
    """Steps in C of the controller that a reference is of."""

    def __init__(self, reference: ReferenceController) -> None:
        self.reference, model = reference, reference.model
        self.clock, self._started = reference.clock, 0.0
        # a clock of the caller's own, which the C cannot read, is asked
        deadline_s = reference.design.deadline_s
        ask = None if self.clock is time.perf_counter else lambda: self.clock() - self._started >= deadline_s
        self.c = CompiledController(reference, ask)
        self._names = (*model.outputs, *model.disturbances, *model.drives, "time_s")
        self._switches = [name for name in model.model.switches if name not in model.drives]
        self._move = Move(as_drive(model.drives, reference.safe_drives))
        self.reset({})

    @property
    def plan(self) -> Array | None:
        """The plan that is still ahead, (N, n_u)."""
        return self.c.plan()

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading."""
        _put(self.c.given, reading, self._names)
        self.reference.reset(reading)
        estimate = self.reference.observer.estimate()
        self.c.reset(estimate | {"seen": estimate["x"]})

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample."""
        self._started = started = self.clock()
        c = self.c
        names = self._names
        controlled = self.reference.controlled
        _put(c.given, reading, names)
        now = target_now(target)
        by_name = now if isinstance(now, Mapping) else dict.fromkeys(controlled, now)
        _put(c.given, by_name, controlled, len(names))
        unknown = [name for name in by_name if name not in controlled]
        ahead = self._ahead(target)
        if ahead is not None:
            c.library.tg_host_goals(c.state, address(ahead))
        c.step(bool(self._switches) and is_off(self._switches, reading))
        if ahead is not None:
            c.library.tg_host_goals(c.state, None)
        *drive, over, pump, status, code, which, _, moved = c.answer[:]
        if not moved:
            again = self._move.advice or advice.TOO_EARLY
            return replace(self._move, advice=again, seconds=self.clock() - started)
        words, state = "", STATUSES[int(status)]
        if code or unknown:
            words = self._words(int(code), over, int(which), reading)
            if unknown and code != _Code.BAD_TARGET:
                words = advice.bad_target(controlled, unknown[0])
                state = "infeasible" if state == "ok" else state
        applied = drive[0] if len(drive) == 1 else dict(zip(self.reference.model.drives, drive))
        self._move = Move(applied, int(pump), state, words, self.clock() - started)
        return self._move

    def _ahead(self, target: Trajectory) -> Array | None:
        """Return the targets of the samples ahead (N, n_controlled), None where they stay."""
        if not isinstance(target, Mapping) or not has_preview(target):
            return None
        model = self.reference.model
        controlled = self.reference.controlled
        begin = len(self._names)
        targets = np.array(self.c.given[begin : begin + len(controlled)])
        good = (targets >= model.coldest) & (targets <= model.hottest)
        now = np.where(good, targets, self.c.view("target", targets.shape))
        samples = np.arange(1, self.reference.optimiser.N + 1)
        return targets_ahead(target, controlled, now, samples, model.coldest, model.hottest)

    def _words(self, code: int, over: float, which: int, reading: Readings) -> str:
        """Return what the C advises of in words."""
        reference, model = self.reference, self.reference.model
        name = model.outputs[which]
        if code in (_Code.LOST_READING, _Code.STUCK):
            readings = np.concatenate([self.c.view("y", (model.n_y,)), reference.measured(reading)])
            names = (*model.outputs, *model.disturbances)
            lost = [one for one, value in zip(names, readings) if not np.isfinite(value)]
            return advice.lost_readings(lost, stuck=code == _Code.STUCK)
        if code in (_Code.SENSOR_OFFSET, _Code.WORLD_CHANGED):
            stays = self.c.view("stays", (model.n_y,))
            jumped = [one for one, jumps in zip(model.outputs, stays) if jumps]
            return advice.jump(jumped, offset=code == _Code.SENSOR_OFFSET)
        if code in (_Code.BLIND, _Code.UNSEEN):
            unread_s = self.c.view("unread_s", (len(reference.controlled),))
            return advice.blind(unread_s.min()) if code == _Code.BLIND else reference.say_unseen(unread_s)
        if code == _Code.BAD_TARGET:
            begin = len(self._names)
            targets = self.c.given[begin : begin + len(reference.controlled)]
            good = [model.coldest <= value <= model.hottest for value in targets]
            return advice.bad_target(reference.controlled[good.index(False) :])
        words: dict[int, Callable[[], str]] = {
            _Code.STALE: lambda: advice.STALE,
            _Code.RESTARTED: lambda: advice.silence(over),
            _Code.NO_TARGET: lambda: advice.no_target(safe=bool(reference.design.safe_drive)),
            _Code.SOLVER: lambda: advice.solver(QP_STATUS[self.c.view("qp_status", (1,))[0]]),
            _Code.OUT_OF_RANGE: lambda: advice.OUT_OF_RANGE,
            _Code.LIMIT_BREAKS: lambda: advice.limit_breaks(name, over),
            _Code.TOO_LATE: lambda: advice.TOO_LATE,
            _Code.PUMP_OFF: lambda: advice.pump_off(model.model.switches),
        }
        return words[code]() if code in words else ""


def _put(into: Any, values: Mapping[str, Any], names: Sequence[str], at: int = 0) -> None:
    """Write values of these names into an array of C from place ``at`` on, NaN where one is none."""
    for place, name in enumerate(names, at):
        try:
            into[place] = values.get(name, np.nan)
        except TypeError:  # a number as a text, an array of one
            into[place] = number(values, name)
