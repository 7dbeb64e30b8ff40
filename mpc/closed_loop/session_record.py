"""A controller whose answers are kept, and the record of a session that it ran.

A session's log has what was read and applied; what the controller said of it (its status, its advice, how
long it took) is gone when the loop goes on.  :class:`RecordedController` takes its place and keeps it,
and :func:`session_loop` puts both together as a :class:`ClosedLoop`, so that a session on hardware is looked
at as a simulated one is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Log, column, names
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Segment, drive_shares, segment_of
from thermogrip.mpc.interface import Controller, Move, Readings, Target

__all__ = ["RecordedController", "session_loop"]

Array = NDArray[np.float64]


class RecordedController:
    """A controller that keeps its ``moves``, each with the time of its reading [s], counted in sample
    times where the reading has none.
    """

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self.moves: list[tuple[float, Move]] = []

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.controller.dt

    def reset(self, reading: Readings) -> None:
        """Let the controller forget the past; the moves are kept."""
        self.controller.reset(reading)

    def __getattr__(self, name: str) -> Any:
        """Return what else the controller has."""
        return getattr(self.__dict__["controller"], name)

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the controller's move, and keep it."""
        move = self.controller.step(reading, target)
        self.moves.append((float(reading.get("time_s", self.dt * len(self.moves))), move))
        return move


def session_loop(
    log: Log,
    moves: list[tuple[float, Move]],
    *,
    drive_range: Mapping[str, tuple[float, float]],
    band: float = 0.25,
    figures: Mapping[str, Mapping[str, float]] | None = None,
) -> ClosedLoop:
    """Return a session's log (drives, ``pump``, outputs, ``target_<output>``) as the record of a closed loop.

    The moves are those of :class:`RecordedController`; what comes after the last (a grasp) is left out, and
    fewer than two are a ValueError. Of an output whose noisy readings were evaluated otherwise than sample by
    sample, ``figures`` has ``settle_s``, ``overshoot`` or ``bias``. Times count from the log's start.
    """
    if len(moves) < 2:
        raise ValueError(f"{len(moves)} moves are no loop")
    logged = np.asarray(log["time"].values, dtype=float)
    rows = logged <= moves[-1][0] + 1e-6
    time = logged[rows] - logged[rows][0]
    targets = [str(name).removeprefix("target_") for name in log.data_vars if str(name).startswith("target_")]
    drives = {name: column(log, name)[rows] for name in drive_range}
    goal = {name: column(log, f"target_{name}")[rows] for name in targets}
    outputs = {name: column(log, name)[rows] for name in names(log, "output")}
    by_time = {round(at, 6): move for at, move in moves}
    # a reading that was rejected was not shown to the controller: its move was held
    answers = [by_time.get(round(float(at), 6)) for at in logged[rows]]
    return ClosedLoop(
        time=time,
        outputs=outputs,
        sample_time=time,
        readings=outputs,
        drive=drives,
        target=goal,
        status=tuple("fallback_plan" if move is None else move.status for move in answers),
        advice=tuple("" if move is None else move.advice for move in answers),
        seconds=np.array([move.seconds for _, move in moves]),
        band=band,
        drive_range={name: (float(low), float(high)) for name, (low, high) in drive_range.items()},
        segments=_segments(
            time, drives, outputs, goal, drive_range=drive_range, band=band, figures=figures or {}
        ),
    )


def _segments(
    time: Array,
    drives: Mapping[str, Array],
    outputs: Mapping[str, Array],
    goal: Mapping[str, Array],
    *,
    drive_range: Mapping[str, tuple[float, float]],
    band: float,
    figures: Mapping[str, Mapping[str, float]],
) -> tuple[Segment, ...]:
    """Return the way of each regulated output to its target; arguments as of :func:`session_loop`."""
    lowest, highest = np.array([drive_range[name] for name in drives], dtype=float).T
    scaled, full = drive_shares(np.stack(list(drives.values()), axis=1), lowest, highest)
    found = [
        segment_of(name, time, outputs[name], float(target[0]), scaled, full, band)
        for name, target in goal.items()
    ]
    return tuple(_with_figures(one, figures.get(one.output, {})) for one in found)


def _with_figures(one: Segment, figures: Mapping[str, float]) -> Segment:
    return replace(
        one,
        settle_s=figures.get("settle_s", one.settle_s),
        overshoot=figures.get("overshoot", one.overshoot),
        bias=figures.get("bias", one.bias),
    )
