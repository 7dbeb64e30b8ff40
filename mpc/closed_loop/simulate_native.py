"""A closed loop that runs wholly in C: the plant, its sensors, the observer and the controller.

What :func:`thermogrip.mpc.closed_loop.simulate.simulate_closed_loop` does step by step in Python is one call
here, with the same noise from the same seed; a search for weights spends its time in such loops.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.closed_loop.simulate import (
    Calls,
    ClosedLoop,
    Surroundings,
    Truth,
    record_loop,
    simulate_closed_loop,
)
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.interface import STATUSES
from thermogrip.mpc.native.runtime import CompiledController, CompiledTruth, address, relay_rows
from thermogrip.mpc.native.shared_constants import UNCUT

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


def compiled_loop(
    controller: Controller | PIController,
    plant: Plant,
    schedule: Sequence[tuple[float, float]],
    *,
    start: float | None = None,
    surroundings: Surroundings | None = None,
    band: float = 0.25,
    seed: int = 0,
) -> ClosedLoop:
    """Run a compiled controller as :func:`simulate_closed_loop` does; the record has no advices and no step
    times."""
    if controller.c is None:
        raise ValueError("the controller is not compiled")
    around = Surroundings() if surroundings is None else surroundings
    about: dict[str, Any] = {"start": start, "surroundings": around, "band": band, "seed": seed}
    truth = Truth(plant, controller.dt, around, start, seed)
    begun, controlled = truth.reading(), tuple(controller.controlled)
    controller.reset(begun | truth.begun())
    counts = [max(1, round(seconds / controller.dt)) for _, seconds in schedule]
    wanted = np.repeat([float(target) for target, _ in schedule], counts)
    target = np.ascontiguousarray(np.repeat(wanted[:, None], len(controlled), axis=1))
    run = _Run(truth, len(target))
    if isinstance(controller, Controller):
        _run_mpc(controller.c, controller, run, target, drives_known=truth.known)
    # PI loops, which go to one target in C, run in Python where a reading is absurd
    elif np.ptp(target) > 0 or not _run_pi(controller.c, controller, run, target[0]):
        return simulate_closed_loop(controller, plant, schedule, **about)
    truth.y = list(run.y)
    status = tuple(STATUSES[code] for code in run.status)
    calls = Calls(target, run.reading, run.drive, status, ("",) * len(status), np.zeros(len(status)))
    return record_loop(truth, controlled, calls, np.cumsum(counts).tolist(), band)


class _Around(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("per_sample", "late", "n_relays")),
        *((name, ctypes.c_double) for name in ("sees", "acts", "step_s")),
        *((name, ctypes.c_void_p) for name in ("before", "d", "noise", "quanta", "d_offset")),
        *((name, ctypes.c_void_p) for name in ("relays", "switches")),
    ]


#: ``tg_relay`` and ``tg_switch`` of ``tg_switches.h``.
_NUMBERS = ("full", "on_s", "off_s", "dead_s")
_RELAY = np.dtype([("drive", "i4"), ("opposite", "i4"), *((name, "f8") for name in _NUMBERS)], align=True)
_STATES = ("on", "stopped", "fresh")
_SWITCH = np.dtype([*((name, "i4") for name in _STATES), ("owed_s", "f8"), ("since_s", "f8")], align=True)


class _Run:
    """The plant, its surroundings and the record of n samples, as C has them: outputs in steps of the plant,
    and by sample readings, outputs first, drives, and places in :data:`thermogrip.mpc.interface.STATUSES`."""

    def __init__(self, truth: Truth, n: int) -> None:
        model, around = truth.model, truth.around
        noise = around.noises_of(model.outputs) * truth.rng.standard_normal((n, model.n_y))
        noise += truth.loaded(n * truth.sub)[:: truth.sub]  # what is read of a load
        offset = np.array([around.offset.get(name, 0.0) for name in model.disturbances])
        quanta = around.steps_of((*model.outputs, *model.disturbances))
        self.y = np.zeros((n * truth.sub + 1, model.n_y))
        self.reading, self.drive = np.zeros((n, model.n_y + model.n_d)), np.zeros((n, model.n_u))
        self.status = np.full(n, STATUSES.index("ok"), dtype=np.int32)
        relays = np.array(relay_rows(truth.switches, model.drives), dtype=_RELAY)
        states = np.array([(0, 0, 1, 0.0, np.inf)] * len(relays), dtype=_SWITCH)  # as truth has them
        self.plant, arrays_of_plant = CompiledTruth(model).at(truth.x, truth.offset)
        # they live as long as this
        self._held = (arrays_of_plant, truth.before, truth.d, noise, quanta, offset, relays, states)
        places = [address(values) for values in self._held[1:]]
        numbers = truth.sub, truth.late, len(relays), truth.sees, around.drive_share, model.dt
        self.around = _Around(*numbers, *places)


def _run_mpc(
    c: CompiledController, controller: Controller, run: _Run, target: Array, *, drives_known: bool
) -> None:
    """Run an MPC that was reset to targets (n, n_controlled) [degC], with the drives before known or not."""
    estimate = controller.observer.estimate()
    observed = np.concatenate([values.ravel() for values in estimate.values()])
    c.library.tg_host_loop(
        c.state,
        *(ctypes.byref(struct) for struct in (c.design, run.plant, run.around)),
        len(target),
        int(drives_known),
        *(address(values) for values in (observed, target, run.y, run.reading, run.drive, run.status)),
    )


def _run_pi(c: CompiledController, controller: PIController, run: _Run, target: Array) -> bool:
    """Run PI loops that were reset at a reading to a target (n_controlled,) [degC]; return whether all
    readings were plausible."""
    loops, arrays = _loops_at(controller, target)
    places = [ctypes.byref(struct) for struct in (loops, run.plant, run.around)]
    written = [address(values) for values in (run.y, run.reading, run.drive)]
    done = c.library.tg_host_loop_pi(*places, len(run.status), *written)
    del arrays  # it had to live until here
    return bool(done)


class _Loops(ctypes.Structure):
    _arrays_ = "drive output Kc Ti target kept lowest highest slew uncut integral u"
    _fields_ = [
        ("n", ctypes.c_int),
        *((name, ctypes.c_double) for name in ("dt", "coldest", "hottest")),
        *((name, ctypes.c_void_p) for name in _arrays_.split()),
    ]


def _loops_at(controller: PIController, target: Array) -> tuple[_Loops, Any]:
    """Return PI loops that were reset, for a target (n_controlled,), and what the C struct points to."""
    model, loops = controller.model, controller.loops
    rows = [model.outputs.index(controller.controlled[i]) for _, i in controller.ends]
    places = [np.array(values, dtype=np.int32) for values in ([j for j, _ in controller.ends], rows)]
    numbers = [
        [loop.Kc for loop in loops],
        [loop.Ti for loop in loops],
        target[[i for _, i in controller.ends]],
        *(
            controller.left_out(target),
            controller.drives.lowest,
            controller.drives.highest,
            controller.drives.slew,
            UNCUT * model.span,
        ),
        *(controller.integral, controller.u),
    ]
    arrays = [*places, *(np.array(values, dtype=float) for values in numbers)]
    bounds = (controller.dt, model.coldest, model.hottest)
    return _Loops(len(loops), *bounds, *(address(values) for values in arrays)), arrays
