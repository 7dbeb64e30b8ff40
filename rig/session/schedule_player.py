"""Play a schedule on a rig and record what it does: the log that a plant is identified from.

It is a session without a controller: the same loop reads, guards, applies and writes down, and every way out
switches off.  The drive is the schedule's row that is in force; the log is sampled every ``dt`` seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.trip import TripError
from thermogrip.rig.interface import UNIT_RANGES, Rig
from thermogrip.rig.session.loop import Loop, Recorder
from thermogrip.rig.session.signals import stop_signals


class Playback:
    """A schedule as a controller: it returns the row in force, whatever the reading."""

    def __init__(self, schedule: Log, units: Mapping[str, str], dt: float) -> None:
        self._dt, self._begin = dt, 0.0
        self._time = np.asarray(schedule["time"].values, dtype=float)
        self._time = self._time - self._time[0]
        for name, unit in units.items():
            if name not in schedule or str(schedule[name].attrs.get("units", "1")) != unit:
                hint = f"the rig needs a column of {name} in {unit}; excite --plant writes it"
                raise UserError(f"the schedule has no {name} in {unit}", hint=hint)
        self._drives = {name: np.asarray(schedule[name].values, dtype=float) for name in units}
        self._pump = np.asarray(schedule["pump"].values) if "pump" in schedule else np.ones(self._time.size)
        for line in str(schedule.attrs.get("repairs", "")).splitlines():  # logs may be repaired, orders not
            if line.partition(":")[0] in (*units, "pump") or "of an input dropped" in line:
                raise UserError(f"the schedule is not whole ({line})", hint="write a number into every row")
        for name, unit in units.items():
            self._check(name, self._drives[name], UNIT_RANGES.get(unit, (-np.inf, np.inf)))
        self._check("pump", np.where(np.isin(self._pump, (0, 1)), 0.0, self._pump), (0, 0), "0 or 1")

    def _check(
        self, name: str, values: NDArray[np.float64], span: tuple[float, float], allowed: str = ""
    ) -> None:
        wrong = np.flatnonzero(~((values >= span[0]) & (values <= span[1])))  # also NaN
        if wrong.size:
            at, hint = int(wrong[0]), allowed or f"{span[0]:g} to {span[1]:g}"
            problem = f"the schedule's {name} is {values[at]:g} at {self._time[at]:g} s"
            raise UserError(problem, hint=f"write {hint}")

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self._dt

    @property
    def seconds(self) -> float:
        """How long the schedule is; its last row holds as long as the one before it [s]."""
        return float(self._time[-1] + (self._time[-1] - self._time[-2] if self._time.size > 1 else self._dt))

    def reset(self, reading: Readings) -> None:
        """Begin at this reading's time."""
        self._begin = reading["time_s"]

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the row in force."""
        row = int(np.searchsorted(self._time, reading["time_s"] - self._begin + 1e-9, "right")) - 1
        drive = {name: float(values[row]) for name, values in self._drives.items()}
        pump = int(self._pump[row])
        return Move(drive=drive if pump else dict.fromkeys(drive, 0.0), pump=pump)


def play(
    rig: Rig,
    schedule: Log,
    *,
    dt: float = 1.0,
    guard: Guard | None = None,
    clock: Callable[[], float] | None = None,
    recorder: Recorder | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> tuple[Log, str]:
    """Play a schedule, sampled every ``dt`` [s]; return the log, and the line of the trip that ended it.

    The other arguments are those of :func:`~thermogrip.rig.session.session.run_session`.  The rig is powered
    down but not closed at the end; UserError where a trip comes before there are two rows.
    """
    player = Playback(schedule, rig.units, dt)
    run = Loop(rig, player, recorder, progress, Guard() if guard is None else guard, clock)
    ended = ""
    with stop_signals():
        try:
            run.start({})
            for passed in run.regulate("hold", player.seconds):
                run.report(passed / player.seconds, "playing the schedule")
        except TripError as tripped:
            ended = tripped.trip.line()
        finally:
            run.power_off()
    if ended:
        run.record_last()
        run.note("tripped", ended)
    if len(run.rows) < 2:
        raise UserError("the rig ended at its first reading", hint=ended)
    return run.log(), ended
