r"""When an input that is on or off goes over: of the few sequences that it may follow the cheapest.

A pump, a valve or a compressor has two positions, and a device may ask that it stays in each for some time.
Over the blocks of a plan it may stay, go over for good (as soon as it may, a block later, halfway, or at the
last), or go over as soon as it may and back as soon as it may: six sequences at most.  With the positions of
a sequence the other drives' program is the usual one, the input a drive whose plan is given.  Its cost, with
what the input costs while it is on, is compared:

    min over sequences s of  min over plans v of  J(v, s) + price * samples on.

Going over is a move by the whole range, and costs as much as one of any drive: noise does not pay for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.optimiser.rti import Optimiser, Outcome

_EARLY = 1e-6  # s


@dataclass(frozen=True)
class Choice:
    """What was chosen for an on/off input."""

    outcome: Outcome
    positions: Array  # (n_b,) by block, 0 or 1
    wait_s: float  # for which it may not go over yet, where it would as soon as it may; else 0


def sequences(begins_s: Array, position: float, wait_s: float, stays_s: float) -> Array:
    """Return the positions (n, n_b) of blocks that begin at these times [s] from now: the first stays, the
    others go over once ``wait_s`` are over, the second back again after ``stays_s``."""
    may = np.flatnonzero(begins_s >= wait_s - _EARLY)
    found = [np.full(len(begins_s), position)]
    starts = {may[0], may[min(1, len(may) - 1)], may[len(may) // 2], may[-1]} if len(may) else set()
    for first in sorted(starts):
        after = np.full(len(begins_s), position)
        after[first:] = 1.0 - position
        found.append(after)
    if len(may):
        back = found[1].copy()
        back[begins_s >= begins_s[may[0]] + stays_s - _EARLY] = position
        if not np.array_equal(back, found[1]) and not np.array_equal(back, found[0]):
            found.insert(1, back)
    return np.stack(found)


def choose(
    optimiser: Optimiser,
    drive: int,
    solve: Callable[[], Outcome],
    *,
    position: float,
    wait_s: float,
    stays_s: float,
    price: float,
) -> Choice:
    """Return the cheapest sequence of the on/off input ``drive``, which is in a position; each is tried by
    ``solve``."""
    lengths = np.asarray(optimiser.blocks)
    begins_s = optimiser.design.dt * (np.cumsum(lengths) - lengths)
    tried: list[tuple[float, Array, Outcome]] = []
    for positions in sequences(begins_s, position, wait_s, stays_s):
        optimiser.positions = {drive: positions}
        outcome = solve()
        cost = outcome.cost + price * float(lengths @ positions) if outcome.status == "solved" else np.inf
        tried.append((cost, positions, outcome))
    _, positions, outcome = min(tried, key=lambda each: each[0])
    optimiser.positions = {drive: positions}
    over = np.flatnonzero(positions != position)
    held = bool(len(over)) and wait_s > _EARLY and not np.any(begins_s[: over[0]] >= wait_s - _EARLY)
    return Choice(outcome, positions, wait_s if held else 0.0)
