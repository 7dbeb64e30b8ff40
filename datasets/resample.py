"""Cuts, gaps and held means of logs.

An input is applied from its row until the next (zero-order hold), so its mean over a cell [a, b) is an
integral of a staircase.  With t_i the rows and U(t) the integral of the held input up to t, which is
piecewise linear,

    mean over [a, b) = (U(b) - U(a)) / (b - a)

exactly, whatever the jitter of the rows.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.repair import gap_rows
from thermogrip.datasets.schema import Log, log_name

Floats: TypeAlias = NDArray[np.float64]

# where the blocks of a log that version 0.2 averaged start anew [s]: long blocks hide a gap
_AFTER_GAP = "after_gap"


def cut(log: Log, start: float = -np.inf, stop: float = np.inf) -> Log:
    """Return the rows with start <= time < stop; times stay as they are.

    Parameters
    ----------
    log : Log
    start, stop : float, optional
        Ends of the cut [s].

    Raises
    ------
    UserError
        If fewer than two rows are left.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_log
    >>> log = make_log([0.0, 1.0, 2.0, 3.0], {"pump": ([0, 1, 1, 0], "1", "input")})
    >>> cut(log, 1.0, 3.0)["time"].values
    array([1., 2.])
    """
    time = log["time"].values
    inside = (time >= start) & (time < stop)
    if inside.sum() < 2:
        problem = f"the cut {start:g}:{stop:g} s leaves {int(inside.sum())} row(s)"
        hint = f"the log goes from {time[0]:g} to {time[-1]:g} s"
        raise UserError(problem, file=log_name(log), hint=hint)
    return log.isel(time=np.flatnonzero(inside))


def gaps(log: Log, longer_than: float = 10.0) -> list[tuple[int, float, float]]:
    """Return (row before, time before [s], time after [s]) of each gap, longer than this [s] and than five
    median steps; in an averaged log the blocks end where the gaps of the log itself were."""
    time = log["time"].values
    begins = [float(t) for t in str(log.attrs.get(_AFTER_GAP, "")).split()]
    gap_starts = np.union1d(gap_rows(time, longer_than), np.flatnonzero(np.isin(time[1:], begins)))
    return [(int(row), float(time[row]), float(time[row + 1])) for row in gap_starts]


def held_means(time: Floats, values: Floats, edges: Floats) -> Floats:
    """Return the means of the staircases (n_time, n) over the cells between the edges."""
    area = np.zeros_like(values)
    np.cumsum(values[:-1] * np.diff(time)[:, None], axis=0, out=area[1:])
    row = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, None)
    integral = area[row] + values[row] * (edges - time[row])[:, None]
    return np.asarray(np.diff(integral, axis=0) / np.diff(edges)[:, None], dtype=float)
