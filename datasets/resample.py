"""Cuts, gaps and means of logs.

An input is applied from its row until the next; outputs are samples.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.repair import gap_rows
from thermogrip.datasets.schema import Log, log_name

Floats: TypeAlias = NDArray[np.float64]


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
    median steps."""
    time = log["time"].values
    return [(int(row), float(time[row]), float(time[row + 1])) for row in gap_rows(time, longer_than)]


def block_means(log: Log, values: Floats, seconds: float) -> tuple[Floats, Floats]:
    """Return starts (n_block,) and means (n_block, n) of what is there of values (n_time, n) in blocks of so
    many seconds, which begin anew after each gap."""
    import pandas as pd

    time = log["time"].values
    step = float(np.median(np.diff(time)))
    if not seconds >= step * (1 - 1e-9):
        problem = f"cannot average over {seconds:g} s: the rows are {step:g} s apart"
        raise UserError(problem, file=log_name(log), hint="choose a longer block")
    segment = np.searchsorted([row for row, _, _ in gaps(log)], np.arange(time.size))
    begin = pd.Series(time).groupby(segment).transform("first").to_numpy()
    # rows a rounding error before an edge belong behind it: 3 * 0.1 > 0.3
    starts = begin + seconds * np.floor((time - begin) / seconds + 1e-9)
    means = pd.DataFrame(values).groupby(starts).mean()
    if len(means) < 2:
        problem = f"{len(means)} block of {seconds:g} s is not a log"
        raise UserError(problem, file=log_name(log), hint="choose a shorter block")
    return means.index.to_numpy(dtype=float), means.to_numpy(dtype=float)


def held_means(time: Floats, values: Floats, edges: Floats) -> Floats:
    """Return the means of the staircases (n_time, n) over the cells between the edges."""
    # with U(t) the integral of the held input up to t, which is piecewise linear, its mean over [a, b) is
    # exactly (U(b) - U(a)) / (b - a), whatever the jitter of the rows
    area = np.zeros_like(values)
    np.cumsum(values[:-1] * np.diff(time)[:, None], axis=0, out=area[1:])
    row = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, None)
    integral = area[row] + values[row] * (edges - time[row])[:, None]
    return np.asarray(np.diff(integral, axis=0) / np.diff(edges)[:, None], dtype=float)
