"""Targets over time: a profile that a loop is to follow, with what is ahead of it.

Between two rows the target is on the straight line through them; after the last one it stays.  Two rows at
one time are a jump.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, column
from thermogrip.datasets.tables import read_csv_table
from thermogrip.datasets.units import split_header, to_record_unit


@dataclass(frozen=True)
class Profile:
    """Targets by output [degC] at times [s] that count from its begin."""

    time: Array
    targets: Mapping[str, Array]
    preview_s: float = 0.0  # how far ahead a controller is shown it

    @property
    def seconds(self) -> float:
        """How long it is."""
        return float(self.time[-1])

    def at(self, seconds: float) -> dict[str, float]:
        """Return the targets at a time."""
        return {name: values[0] for name, values in self._at(np.array([seconds])).items()}

    def ahead(self, seconds: float, dt: float) -> dict[str, list[float]]:
        """Return the targets at a time and at the samples of the preview that follow it."""
        samples = np.arange(1.0 + round(self.preview_s / dt))
        return self._at(np.asarray(seconds + dt * samples))

    def _at(self, times: Array) -> dict[str, list[float]]:
        after = np.clip(np.searchsorted(self.time, times, "right"), 1, self.time.size - 1)
        begin, end = self.time[after - 1], self.time[after]
        share = np.clip((times - begin) / np.where(end > begin, end - begin, 1.0), 0.0, 1.0)
        return {
            name: (values[after - 1] + share * (values[after] - values[after - 1])).tolist()
            for name, values in self.targets.items()
        }


def tracking_error(log: Log, outputs: Iterable[str]) -> tuple[float, float]:
    """Return the rms and the largest error of a session's outputs from their targets [K]."""
    errors = np.array([column(log, name) - column(log, f"target_{name}") for name in outputs])
    return float(np.sqrt(np.nanmean(errors**2))), float(np.nanmax(np.abs(errors)))


def read_profile(path: str | Path, outputs: Sequence[str], *, preview_s: float = 0.0) -> Profile:
    """Return the profile of a CSV table: ``time_s`` (or ``time_min``) and a column of each regulated output
    (``t1_degC``), or one ``target_degC`` for all of them.
    """
    table, columns = read_csv_table(path), {}
    for header, values in table.numbers.items():
        name, unit = split_header(header, file=str(path))
        columns[name], unit = to_record_unit(values, unit)
        if unit != ("s" if name == "time" else "degC"):
            raise UserError("has another unit", file=path, column=header, hint="write time_s and t1_degC")
        wrong = np.flatnonzero(~np.isfinite(values))
        if wrong.size:
            row = int(table.lines[wrong[0]])
            raise UserError("is empty", file=path, row=row, column=header, hint="write a number")
    wanted = ("time", "target") if "target" in columns else ("time", *outputs)
    if set(columns) != set(wanted):
        headers = ", ".join(f"{name}_degC" for name in outputs)
        problem = f"has the columns {', '.join(table.numbers)}"
        raise UserError(problem, file=path, hint=f"write time_s and target_degC, or time_s and {headers}")
    time = columns["time"] - columns["time"][0]
    back = np.flatnonzero(np.diff(time) < 0)
    if back.size or time.size < 2 or time[-1] == 0.0:
        row = int(table.lines[back[0] + 1 if back.size else -1])
        raise UserError("does not go on in time", file=path, row=row, hint="give two times or more, in order")
    targets = {name: columns["target" if "target" in columns else name] for name in outputs}
    return Profile(time, targets, preview_s)
