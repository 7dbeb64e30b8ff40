"""The baseline: PI control with anti-windup, behind the same interface as the MPC.

One loop for each controlled output, on the drive that moves it most:

    v = Kc (b r + (1 - b) r_0 - y) + I,      u = v inside range and slew,
    I+ = I + dt Kc/Ti (r - y),  but I where u is limited and this would take v further out.

where r_0 is the output at which the loop began.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.controllers.advice import STALE
from thermogrip.mpc.controllers.base import SampledController, has_preview
from thermogrip.mpc.controllers.controller_file import Parts
from thermogrip.mpc.design.design import Design, check_design, default_design
from thermogrip.mpc.estimator.call_times import CallTimes
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.native.shared_constants import UNCUT
from thermogrip.mpc.optimiser.drive_limits import DriveLimits
from thermogrip.mpc.plant.prediction import ROOM, PredictionModel, holding_drive, prediction_model

if TYPE_CHECKING:
    from thermogrip.mpc.native.runtime import CompiledController
    from thermogrip.sysid.plant.plant import Plant


class PIController(SampledController):
    """PI with anti-windup.

    Parameters
    ----------
    plant : Plant
        Gives the drive that holds a start.
    design : Design, optional
        Its loops, limits and patience; by default that of
        :func:`thermogrip.mpc.design.design.default_design`.
    notes : dict, optional
        What the tuner found, kept in the file.
    clock : callable, optional
        Where step times come from [s].
    **changes
        Any field of the default design.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> controller = PIController(plant, dt=5.0)
    >>> controller.reset({"t1": 25.0, "t2": 25.0})
    >>> move = controller.step({"t1": 25.0, "t2": 25.0}, 40.0)
    >>> move.status, {name: round(value, 1) for name, value in move.drive.items()}
    ('ok', {'q1': 62.5, 'q2': 62.5})
    """

    def __init__(
        self,
        plant: Plant,
        design: Design | None = None,
        *,
        notes: Mapping[str, Any] | None = None,
        clock: Callable[[], float] = time.perf_counter,
        **changes: Any,
    ) -> None:
        design = default_design(plant, **changes) if design is None else design
        self.design = check_design(design, plant)
        model = prediction_model(plant, design.dt)
        limits = DriveLimits.of(model, design.drive_range, design.slew_per_s, design.safe_drive)
        super().__init__(model, design.controlled, limits, design.patience_s, clock)
        self.plant = plant
        self.notes = dict(notes or {})
        self.loops = self.design.loops
        # of each loop its drive and its controlled output, counted from 0
        self.ends = [(model.drives.index(p.drive), self.controlled.index(p.output)) for p in self.loops]
        self.integral, self._begun = np.zeros(len(self.loops)), np.full(len(self.controlled), np.nan)
        #: An MPC of the same plant and drives in C, in whose library trials of these loops can run.
        self.c: CompiledController | None = None

    def save(self, path: str | Path) -> Path:
        """Write the controller with its plant as JSON and return the path;
        :func:`thermogrip.mpc.load_controller` reads it."""
        return Parts("PI", self.plant, self.design, self.notes).save(path)

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading, under the drive that holds it or that the
        reading has."""
        self._forget()
        self.integral = np.zeros(len(self.loops))
        self.u = self._applied(reading, self.u)
        y, room = self._read(reading)
        self._target = self._begun = y[self._rows]
        if np.isfinite(self._target).all():
            d = np.where(np.isfinite(room), room, self.model.undisturbed(ROOM))
            places = tuple(self._target.tolist()), tuple(d.tolist())
            holding = self.drives.cut(held_drive(self.model, self.controlled, *places))
            self.integral = self._applied(reading, holding)[[j for j, _ in self.ends]]
        self.times.reset()

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample; a lost reading holds the drive of its loop for ``patience_s``,
        then it goes to rest, and the others go on."""
        started = self.clock()
        self.times.call(reading)
        wanted, wrong = self._wanted(target)
        if not self.times.moves(new_target=self._is_new(wanted) and not has_preview(target)):
            return self._held_move(started)
        self._target = wanted
        y = self._read(reading)[0][self._rows]
        if self.times.stale:  # a stale reading is none
            y, wrong = np.full(len(y), np.nan), wrong or STALE
        usable = np.isfinite(y) & np.isfinite(wanted).all()
        self._unread_s = np.where(usable, 0.0, self._unread_s + self.times.waited_s)
        status, advice = "fallback_plan", wrong or "reading lost: the drive is held"
        u = self.u
        if usable.any():
            u = self.propose(y, wanted, self.times)
            lost = [name for name, is_usable in zip(self.controlled, usable) if not is_usable]
            status, advice = "ok", wrong
            if lost:
                status, advice = "fallback_plan", f"{', '.join(lost)}: no usable reading, the others go on"
        elif self._lost.all():
            u = self._within(self.drives.safe)
            status, advice = "off", wrong or "reading lost: drive to zero"
        return self._answer(u, status, advice, started)

    def propose(self, y: Array, target: Array, times: CallTimes | None = None) -> Array:
        """Return the limited drives (n_u,) after the seconds of these calls, by default a sample, and
        integrate; readings y (n_controlled,) are NaN where lost."""
        # where readings have a time, dt is what really passed; a slew limit may count more
        slew_s = self.dt if times is None else times.slew_s
        seconds = slew_s if times is None else min(times.waited_s, slew_s)
        error = target - y
        self._begun = np.where(np.isfinite(self._begun), self._begun, y)
        v = np.zeros(self.model.n_u)
        loops = list(zip(self.loops, self.ends, self.left_out(target).tolist()))
        for k, (loop, (j, i), left_out) in enumerate(loops):
            if np.isfinite(error[i]):
                v[j] = loop.Kc * (error[i] - left_out) + self.integral[k]
            else:
                v[j] = self.drives.safe[j] if self._lost[i] else self.u[j]
        u = self.drives.follow(v, self.u, slew_s / self.dt)
        for k, (loop, (j, i), _) in enumerate(loops):
            if np.isfinite(error[i]):
                # the integrator stands while the drive is limited, which is most of the time after a step of
                # the target; taken to the limit by back-calculation, it overshoots
                inward = (u[j] - v[j]) * loop.Kc * error[i] > 0
                if inward or abs(u[j] - v[j]) <= UNCUT * self.model.span[j]:
                    self.integral[k] += seconds * loop.Kc / loop.Ti * error[i]
        return u

    def left_out(self, target: Array) -> Array:
        """Return of each loop the part of its error that its setpoint weight leaves out."""
        # (1 - b) (r - r_0): b below 1 answers a new target less than a reading, against overshoot
        weights = np.array([loop.setpoint for loop in self.loops])
        return np.asarray((1 - weights) * (target - self._begun)[[i for _, i in self.ends]])

    def follow(self, u: Array, y: Array, target: Array) -> None:
        """Set the integrators so that the next proposal, with the arguments of :meth:`propose`, starts from
        drives u (n_u,): a bumpless take-over."""
        self.u, self._begun = np.asarray(u, dtype=float), target
        error = target - y
        for k, (loop, (j, i)) in enumerate(zip(self.loops, self.ends)):
            self.integral[k] = self.u[j] - loop.Kc * error[i]


@lru_cache(maxsize=1024)
def held_drive(
    model: PredictionModel, controlled: tuple[str, ...], target: tuple[float, ...], d: tuple[float, ...]
) -> Array:
    """Return the drives that hold a target, zero where none does; a search asks for the same ones again."""
    holding = holding_drive(model, controlled, target, d)
    return holding.u if np.isfinite(holding.y).all() else np.zeros(model.n_u)
