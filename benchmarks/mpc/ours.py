"""thermogrip's own controller of the reference problem: its optimiser on the filter's estimates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from problem import DRIVE, HORIZON, LAST, MODEL, MOVE, OVERSHOOT, PRICE, TANK, TRACK, plant_of

from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import Design, make_blocks
from thermogrip.mpc.optimiser.rti import Sample

__all__ = ["TEN_BLOCKS", "Ours", "design_of"]

#: Four single samples, then ever longer blocks: the first moves matter most.
TEN_BLOCKS = (1, 1, 1, 1, 2, 4, 6, 8, 10, 16)

Array = NDArray[np.float64]


def design_of(blocks: int, current: float = 5.0) -> Design:
    """Return the reference problem's weights and limits with so many blocks."""
    span = 2 * current  # drives count in fractions of their range
    return Design(
        dt=0.5,
        controlled=("t_surface",),
        blocks=TEN_BLOCKS
        if blocks == 10
        else (1,) * HORIZON
        if blocks >= HORIZON
        else make_blocks(HORIZON, blocks),
        drive_range={"current": (-current, current)},
        slew_per_s={"current": 1.0},
        track=TRACK,
        terminal=LAST - TRACK,  # the last sample is tracked as well
        move=MOVE * span**2,
        drive=DRIVE * span**2,
        overshoot=OVERSHOOT,
        limits={"t_tank": TANK},
        price=PRICE,
        ambient=0.0,  # of the unknown heat flows [W]: what replaces a room here
        deadline_s=60.0,
        loops=(),
    )


class Ours:
    """The optimiser with any number of blocks."""

    def __init__(self, *, blocks: int = HORIZON, current: float = 5.0) -> None:
        plant, design = plant_of(MODEL, current=current), design_of(blocks, current)
        self.optimiser = ReferenceController(plant, design).optimiser
        self.blocks = np.asarray(design.blocks)
        self.plan: Array | None = None
        self.begins = np.cumsum(self.blocks) - self.blocks
        self.zero = np.zeros(3), np.zeros(1)
        self(np.full(13, 25.0), np.zeros(2), 0.0, 25.0, -100.0, 100.0)  # whatever is made at the first call
        self.optimiser.forget()
        self.plan = None

    def __call__(self, x: Array, q: Array, before: float, goal: float, low: float, high: float) -> float:
        side = 1.0 if high < 100.0 else -1.0 if low > -100.0 else 0.0
        last = np.array([before])
        guess = np.repeat(last[None], len(self.blocks), axis=0)
        if self.plan is not None:
            guess = np.add.reduceat(self.plan, self.begins, axis=0) / self.blocks[:, None]
        about = {"target": np.array([goal]), "side": np.array([side])}
        bias, drive_bias = self.zero
        found = self.optimiser.solve(Sample(x, last, guess, q, bias=bias, drive_bias=drive_bias, **about))
        if found.status != "solved":
            return float("nan")
        plan = np.repeat(found.plan, self.blocks, axis=0)
        self.plan = np.concatenate([plan[1:], plan[-1:]])
        return float(found.plan[0, 0])
