"""A log as a plant sees it: stretches without a gap, on the grid of the model's own step.

The model steps by its own dt from the first row of a stretch on.  An input is the exact mean of its held
value over each step; a command that its driver rounds is what the driver made of it.  A measured ambient
is smoothed over 20 s, for its sensor is slow and coarse.  The outputs of the model are interpolated to the
times of the rows (the middle of the blocks of an averaged log).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import most_bytes
from thermogrip.datasets.resample import gaps as find_gaps
from thermogrip.datasets.resample import hold_average
from thermogrip.datasets.schema import Log, columns, log_name
from thermogrip.sysid.plant.signal_match import match_log

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant_data import PlantData

__all__ = ["GAP", "Stretch", "at_rows", "cut_stretches"]

Array = NDArray[np.float64]

GAP = 10.0  # [s] input unknown beyond
_GRIDS = 4  # arrays of a run's size that are held at a time
SMOOTH = 20.0  # [s] mean of a measured ambient


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a log without a gap, on the model's grid.

    Attributes
    ----------
    rows : slice
        Its rows in the log.
    time : (n,) ndarray
        Times of the readings since the first step [s].
    y : (n, n_y) ndarray
        Readings, NaN where lost.
    u, d : (N, n_u), (N, n_d) ndarray
        Inputs and ambients of each step.
    gap : float
        Seconds between the row before and the first row; 0 at the start of a log.
    log : str
        Name of the log.
    """

    rows: slice
    time: Array
    y: Array
    u: Array
    d: Array
    gap: float
    log: str


def cut_stretches(plant: PlantData, log: Log, *, gaps: str = "mend") -> list[Stretch]:
    """Return the log's stretches on the plant's grid, checked against the plant's signals."""
    log = _checked(plant, log)
    time = np.asarray(log["time"].values, dtype=float)
    after = [row + 1 for row, _, _ in find_gaps(log, GAP)] if gaps == "mend" else []
    readings, out = columns(log, plant.outputs), []
    middle = float(log.attrs.get("averaged_s", 0.0)) / 2  # where the mean of a block belongs
    for begin, end in pairwise([0, *after, time.size]):
        rows, t = slice(begin, end), time[begin:end]
        n = max(1, int(np.ceil((t[-1] - t[0] + middle) / plant.dt - 1e-9)))
        _check_steps(n, plant, log)
        edges = t[0] + plant.dt * np.arange(n + 1)
        part = _applied(log.isel(time=rows), plant)
        u, d = hold_average(part, plant.inputs, edges), _smooth(part, plant, edges)
        gap = float(t[0] - time[begin - 1]) if begin else 0.0
        out.append(Stretch(rows, t - t[0] + middle, readings[rows], u, d, gap, log_name(log)))
    return out


def _check_steps(n: int, plant: PlantData, log: Log) -> None:
    """Refuse a run of more steps than there is room for, before its grid is made."""
    signals = len(plant.inputs) + len(plant.disturbances) + len(plant.outputs)
    if 8 * n * signals > most_bytes(_GRIDS):
        took = f"{n} steps of {plant.dt:g} s"
        hint = "cut the log, or use a plant of a longer step"
        raise UserError(f"would be simulated in {took}", file=log_name(log), hint=hint)


def at_rows(stretch: Stretch, run: Array, dt: float) -> Array:
    """Interpolate a run (B, N + 1, n_y) on the grid to the stretch's rows: (B, n, n_y)."""
    place = np.clip(stretch.time / dt, 0.0, run.shape[1] - 1)
    left = np.minimum(place.astype(int), run.shape[1] - 2)
    share = (place - left)[None, :, None]
    return np.asarray((1 - share) * run[:, left] + share * run[:, left + 1])


def _applied(log: Log, plant: PlantData) -> Log:
    """Return the log with what the drivers made of its commands.

    A driver that drops what lies behind a multiple of its step is undone row by row; of commands that were
    averaged only the mean of the loss is known, half a step.
    """
    steps: dict[str, float] = getattr(plant.model, "command_steps", {})
    if not steps:
        return log
    out = log.copy()
    for name, step in steps.items():
        u = columns(log, (name,))[:, 0]
        if "averaged_s" in log.attrs:
            whole = u - np.sign(u) * np.minimum(np.abs(u), step / 2)
        else:
            whole = np.trunc(u / step + 1e-9 * np.sign(u)) * step
        out[name] = ("time", whole, log[name].attrs)
    return out


def _smooth(log: Log, plant: PlantData, edges: Array) -> Array:
    """Return ambients (N, n_d): the mean over 20 s (the step, if longer) about the middle of each step.

    A model that is not of heat says for itself over how many seconds, in ``smooth``.
    """
    wanted = plant.disturbances
    if not wanted:
        return np.empty((len(edges) - 1, 0))
    middle = (edges[1:] + edges[:-1]) / 2
    half = max(getattr(plant.model, "smooth", SMOOTH), edges[1] - edges[0]) / 2
    low, high = np.maximum(middle - half, edges[0]), np.minimum(middle + half, edges[-1])
    ends, place = np.unique(np.concatenate([low, high]), return_inverse=True)
    parts = hold_average(log, wanted, ends) * np.diff(ends)[:, None]
    area = np.vstack([np.zeros(parts.shape[1]), np.cumsum(parts, axis=0)])[place]
    return np.asarray((area[len(low) :] - area[: len(low)]) / (high - low)[:, None])


def _checked(plant: PlantData, log: Log) -> Log:
    """Return the log in the plant's units, its inputs and disturbances known in every row."""
    log, _ = match_log(plant, log)
    for name in (*plant.inputs, *plant.disturbances):
        if not np.isfinite(columns(log, (name,))).all():
            raise UserError(
                "is unknown in some rows", file=log_name(log), column=name, hint="fill or cut them"
            )
    return log
