"""Cuts, gaps and averages of logs.

An input is applied from its row until the next (zero-order hold), so its mean over a cell [a, b) is an integral of a
staircase.  With t_i the rows and U(t) the integral of the held input up to t, which is piecewise linear,

    mean over [a, b) = (U(b) - U(a)) / (b - a)

exactly, whatever the jitter of the rows.  Outputs are samples: their mean is over the samples in the cell that are
there.  Averaging is what makes a coarse converter (the 0.4 degC of a hobby board) usable in a fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.repair import gap_rows
from thermogrip.datasets.schema import Log, columns, log_name, make_log, names

__all__ = ["average", "cut", "gaps", "hold_average"]


def cut(log: Log, start: float = -np.inf, stop: float = np.inf) -> Log:
    """Return the rows with start <= time < stop [s]; times stay as they are.

    Raises
    ------
    UserError
        If fewer than two rows are left.

    Examples
    --------
    >>> log = make_log([0.0, 1.0, 2.0, 3.0], {"pump": ([0, 1, 1, 0], "1", "input")})
    >>> cut(log, 1.0, 3.0)["time"].values
    array([1., 2.])
    """
    time = log["time"].values
    inside = (time >= start) & (time < stop)
    if inside.sum() < 2:
        problem = f"the cut {start:g}:{stop:g} s leaves {int(inside.sum())} row(s)"
        mend = f"the log goes from {time[0]:g} to {time[-1]:g} s"
        raise UserError(problem, file=log_name(log), mend=mend)
    return log.isel(time=np.flatnonzero(inside))


def gaps(log: Log, longer_than: float = 10.0) -> list[tuple[int, float, float]]:
    """Return (row before, time before [s], time after [s]) of each gap longer than that and than five median steps.

    Examples
    --------
    >>> gaps(make_log([0.0, 1.0, 2.0, 40.0, 41.0], {"pump": ([1] * 5, "1", "input")}))
    [(2, 2.0, 40.0)]
    """
    time = log["time"].values
    return [(int(at), float(time[at]), float(time[at + 1])) for at in gap_rows(time, longer_than)]


def hold_average(log: Log, wanted: tuple[str, ...], grid: ArrayLike) -> NDArray[np.float64]:
    """Return the exact means of held variables over the cells of a grid.

    Parameters
    ----------
    log : Log
    wanted : tuple of str
        Names of variables that are held from their row until the next.
    grid : (n_cell + 1,) array_like
        Edges of the cells [s], increasing.  Before the first row its value is taken, after the last row the last.

    Returns
    -------
    means : (n_cell, n_wanted) ndarray

    Examples
    --------
    >>> log = make_log([0.0, 0.5, 2.0], {"pump": ([0, 1, 0], "1", "input")})
    >>> hold_average(log, ("pump",), [0.0, 1.0, 2.0, 3.0]).ravel()
    array([0.5, 1. , 0. ])
    """
    edges = np.asarray(grid, dtype=float)
    if edges.ndim != 1 or edges.size < 2 or np.any(np.diff(edges) <= 0):
        raise ValueError("need at least two increasing edges")
    time, values = log["time"].values, columns(log, wanted)
    area = np.zeros_like(values)
    np.cumsum(values[:-1] * np.diff(time)[:, None], axis=0, out=area[1:])
    at = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, None)
    integral = area[at] + values[at] * (edges - time[at])[:, None]
    return np.asarray(np.diff(integral, axis=0) / np.diff(edges)[:, None], dtype=float)


def average(log: Log, seconds: float) -> Log:
    """Return the log in blocks of that length.

    A block's time is its start, so that its input is the one applied until the next block.  Inputs and disturbances
    are averaged as held, outputs and others over the samples present (NaN where there is none).  Blocks that lie
    wholly inside a gap are left out, so the gap stays a gap.

    Raises
    ------
    UserError
        If the blocks are shorter than the median step or fewer than two are filled.

    Examples
    --------
    >>> log = make_log([0.0, 0.5, 1.0, 1.5], {"pump": ([0, 1, 1, 0], "1", "input"),
    ...                                       "t": ([20.0, 20.2, 20.4, np.nan], "degC", "output")})
    >>> average(log, 1.0)["t"].values, average(log, 1.0)["pump"].values
    (array([20.1, 20.4]), array([0.5, 0.5]))
    """
    time = log["time"].values
    step = float(np.median(np.diff(time)))
    if not seconds >= step * (1 - 1e-9):
        problem = f"cannot average over {seconds:g} s: the rows are {step:g} s apart"
        raise UserError(problem, file=log_name(log), mend="choose a longer block")
    # rows a rounding error before an edge belong behind it: 0.1 * 3 > 0.3
    block = np.floor((time - time[0]) / seconds + 1e-9).astype(np.int64)
    filled, where = np.unique(block, return_inverse=True)
    n_blocks = int(block[-1]) + 1
    if filled.size < 2:
        problem = f"{filled.size} block of {seconds:g} s is not a log"
        raise UserError(problem, file=log_name(log), mend="choose a shorter block")
    held = names(log, "input") + names(log, "disturbance")
    edges = time[0] + seconds * np.arange(n_blocks + 1)
    edges[-1] = min(edges[-1], time[-1] + step)  # the last row holds for one step, not to the end of the block
    if edges[-1] <= edges[-2]:
        edges[-1] = edges[-2] + step
    means = hold_average(log, held, edges)[filled] if held else np.empty((filled.size, 0))
    variables = {}
    for key, variable in log.data_vars.items():
        name = str(key)
        values = means[:, held.index(name)] if name in held else _mean_of_present(variable.values, where, filled.size)
        variables[name] = (values, variable.attrs["units"], variable.attrs["role"])
    said = [line for line in str(log.attrs.get("repairs", "")).splitlines() if line]
    said.append(f"averaged over {seconds:g} s")
    return make_log(edges[:-1][filled], variables, name=log_name(log), repairs=said)


def _mean_of_present(values: NDArray[np.float64], where: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    there = np.isfinite(values)
    count = np.bincount(where[there], minlength=n)
    total = np.bincount(where[there], weights=values[there], minlength=n)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
