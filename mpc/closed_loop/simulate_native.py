"""A closed loop that runs wholly in C: the plant, its sensors, the observer and the controller.

What :func:`thermogrip.mpc.closed_loop.simulate.simulate_closed_loop` does step by step in Python is one call
here, with the same noise from the same seed; a search for weights spends its time in such loops.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings, Truth, record_loop
from thermogrip.mpc.controllers.base import as_drive
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.interface import STATUSES, Move
from thermogrip.mpc.native.runtime import CompiledController, CompiledTruth, address

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


def compiled_loop(
    controller: Controller,
    plant: Plant,
    schedule: Sequence[tuple[float, float]],
    *,
    start: float | None = None,
    surroundings: Surroundings | None = None,
    band: float | Mapping[str, float] = 0.25,
    seed: int = 0,
) -> ClosedLoop:
    """Run a compiled controller (else a ValueError) as :func:`simulate_closed_loop` does, with the same
    arguments, against a plant of the same signals whose equations and step may be others; the record has no
    advices and no step times."""
    if controller.c is None:
        raise ValueError("the controller is not compiled")
    around = Surroundings() if surroundings is None else surroundings
    truth = Truth(plant, controller.dt, around, start, seed)
    model = truth.model
    controller.reset(truth.reading() | truth.begun())
    counts = [max(1, round(seconds / controller.dt)) for _, seconds in schedule]
    wanted = np.repeat([float(target) for target, _ in schedule], counts)
    target = np.ascontiguousarray(np.repeat(wanted[:, None], len(controller.controlled), axis=1))
    observed = np.concatenate([values.ravel() for values in controller.observer.estimate().values()])
    reading, drive, status = _loop_in_c(controller.c, observed, truth, target)
    names = (*model.outputs, *model.disturbances)
    readings = [dict(zip(names, row)) for row in reading.tolist()]
    controlled = tuple(controller.controlled)
    targets = [dict(zip(controlled, row)) for row in target.tolist()]
    moves = [Move(as_drive(model.drives, row), status=STATUSES[code]) for row, code in zip(drive, status)]
    return record_loop(truth, controlled, targets, readings, moves, np.cumsum(counts).tolist(), band)


def _loop_in_c(
    c: CompiledController, observed: Array, truth: Truth, target: Array
) -> tuple[Array, Array, NDArray[np.int32]]:
    """Run the loop from an observer's flat estimate to targets (n, n_controlled) [degC]; return readings (n,
    n_y + n_d), outputs first, drives (n, n_u), and places (n,) in :data:`thermogrip.mpc.interface.STATUSES`,
    and leave in ``truth.y`` what the plant did."""
    model, around, n = truth.model, truth.around, len(target)
    noise = around.noises_of(model.outputs) * truth.rng.standard_normal((n, model.n_y))
    d_offset = np.array([around.offset.get(name, 0.0) for name in model.disturbances])
    quanta = around.steps_of((*model.outputs, *model.disturbances))
    y = np.zeros((n * truth.sub + 1, model.n_y))
    reading, drive = np.zeros((n, model.n_y + model.n_d)), np.zeros((n, model.n_u))
    status = np.zeros(n, dtype=np.int32)
    plant_in_c, held = CompiledTruth(model).at(truth.x, truth.offset)
    c.library.tg_host_loop(
        c.state,
        ctypes.byref(c.design),
        ctypes.byref(plant_in_c),
        n,
        truth.sub,
        truth.late,
        ctypes.c_double(truth.sees),
        ctypes.c_double(around.drive_share),
        int(truth.known),
        *(address(values) for values in (truth.before, observed, truth.d, noise)),
        *(address(values) for values in (quanta, d_offset, target, y, reading, drive, status)),
    )
    del held  # it had to live until here
    truth.y = list(y)
    return reading, drive, status
