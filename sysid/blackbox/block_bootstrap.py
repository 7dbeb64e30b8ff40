"""How sure a black box is: the same structure, fitted to blocks of the logs drawn anew.

A black box has no parameters whose prior and likelihood could be written down, and its errors are no white
noise: they follow the input where the structure is wrong, and wander from log to log.  The block bootstrap
[1]_ needs to know neither.  The logs are cut into blocks, long enough that what one block leaves over tells
little of the next; as many blocks are drawn with replacement, each with a start of its own; and the structure
that was chosen is fitted to them.  How the refits differ is how the fit would differ had the same rig been
logged again.

Blocks keep together what belongs together, input and reading, so an error of the structure that depends on
the input is drawn with it.  What no block shows, a drift over the whole log or a room that was never colder,
is in none of the refits either.

A refit that does not run along the logs themselves, because its blocks happened to lack what one direction
needs, is no plant that agrees with them: its free run over all logs may err 1.5 times as much as the fit's.

The choice of the structure is not drawn again: the refits say how sure its numbers are, held-out free runs
say how good it is.

References
----------
.. [1] H. R. Kuensch, "The jackknife and the bootstrap for general stationary observations", Annals of
   Statistics 17 (1989).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox.fit import Rung, refit
from thermogrip.sysid.blackbox.order_selection import Model, free_run_errors
from thermogrip.sysid.plant.log_grid import Segment
from thermogrip.sysid.plant.plant import Plant

__all__ = ["RESAMPLED", "cut_into_blocks", "with_refits"]

RESAMPLED = ("arx", "oe", "subspace", "sindy")  # a refit of a neural model takes as long as its fit did

_BLOCKS, _ROWS = 16, 40  # so many in all, where that leaves each so many rows
_FEWEST = 8
_TRIES = 3  # fits per draw
_AGREES = 1.5  # times the error of the fit


def with_refits(
    rung: Rung, n: int = 24, *, seed: int = 0, progress: Callable[[float, str], None] | None = None
) -> Plant:
    """Return the plant of a black box with ``n`` refits to resampled blocks, for :meth:`Plant.draw`."""
    if rung.kind not in RESAMPLED:
        raise ValueError(f"{rung.kind} is not refitted; choose from {', '.join(RESAMPLED)}")
    blocks = cut_into_blocks(rung.grid.segments)
    if len(blocks) < _FEWEST:
        says = f"the logs are too short to be resampled: {len(blocks)} blocks of {_ROWS} rows"
        raise UserError(says, hint=f"give logs of {_FEWEST} such blocks")
    rng, most = np.random.default_rng(seed), _AGREES * _error(rung, rung.model)
    refits: list[Model] = []
    tried = 0
    while len(refits) < n and tried < _TRIES * n:
        if progress is not None:
            progress(len(refits) / n, f"{rung.kind}, refits to resampled blocks")
        drawn = rung.grid.having([blocks[k] for k in rng.integers(len(blocks), size=len(blocks))])
        model, tried = refit(rung.kind, drawn, rung.choice.structure), tried + 1
        if model is not None and _error(rung, model) <= most:
            refits.append(model)
    if len(refits) < n:
        raise UserError(
            f"{rung.kind}: of {tried} refits to resampled blocks only {len(refits)} agree with the logs",
            hint="a smaller structure, or longer logs",
        )
    return replace(rung.plant, refits=tuple(refits))


def cut_into_blocks(segments: tuple[Segment, ...]) -> list[Segment]:
    """Return the segments in blocks of about the same number of rows; shorter segments stay whole."""
    rows = max(_ROWS, sum(len(segment.time) for segment in segments) // _BLOCKS)
    blocks: list[Segment] = []
    for segment in segments:
        n = len(segment.time)
        edges = np.round(np.linspace(0, n, max(1, n // rows) + 1)).astype(int)
        blocks += [segment.part(begin, end) for begin, end in pairwise(edges)]
    return blocks


def _error(rung: Rung, model: Model) -> float:
    """Return the free-run error over all logs, the worst output's, in units of its spread."""
    grid, warmup = rung.grid, max(2, min(50, min(len(s.time) for s in rung.grid.segments) // 4))
    scale = np.maximum(grid.output_spread(), 1e-9)
    prior = [rung.choice.prior]
    errors = free_run_errors(model, grid.segments, dt=grid.dt, scale=scale, warmup=warmup, priors=prior)
    return float(np.max(errors))
