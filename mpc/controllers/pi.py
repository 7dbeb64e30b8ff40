"""The baseline: PI control with feed-forward and anti-windup, behind the same interface as the MPC.

One loop for each controlled output, on the drive that moves it most:

    v = u_ff(r, d) + Kc (b r + (1 - b) r_0 - y) + I,      u = v inside range and slew,
    I+ = I + dt Kc/Ti (r - y),  but I where u is limited and this would take v further out.

So the integrator stands while the drive is limited, which is most of the time after a step of the target
(taken to the limit by back-calculation, it overshoots).  ``u_ff`` is the drive that holds the target in
steady state, from the plant, weighted; r_0 is where the loop began, and b below 1 answers a new target less
than a reading, against overshoot.  Where readings have a time, dt is what really passed, for the integrator
and for the slew alike, and a call before a move is due (:mod:`thermogrip.mpc.estimator.call_times`) holds the
last one.

Its loops are tuned by :mod:`thermogrip.mpc.design.design`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.controllers.base import SampledController
from thermogrip.mpc.controllers.controller_file import Parts
from thermogrip.mpc.design.design import (
    Design,
    PILoop,
    check_design,
    default_controlled,
    default_design,
    pair_loops,
)
from thermogrip.mpc.estimator.call_times import SAME
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.native.shared_constants import UNCUT
from thermogrip.mpc.plant.prediction import ROOM, PredictionModel, holding_drive, prediction_model

if TYPE_CHECKING:
    from thermogrip.mpc.native.runtime import CompiledController
    from thermogrip.sysid.plant.plant import Plant


class PIController(SampledController):
    """PI with feed-forward and anti-windup.

    Parameters
    ----------
    plant : Plant
        Gives the holding drive and the ranges.
    dt : float, optional
        Sample time [s].
    loops : tuple of PILoop, optional
        By default :func:`pair_loops`.
    controlled : tuple of str, optional
        By default :func:`default_controlled`.
    drive_range : dict of str to (float, float), optional
        Narrower ranges of the drives, in their units.
    slew_per_s : dict of str to float, optional
        Largest change of a drive [units per s]; an eighth of its range where absent.
    patience_s : float, optional
        How long the drive of a loop is held without a reading [s], by default 10 s and at least 5 samples, as
        :func:`thermogrip.mpc.design.design.default_design` has it.
    clock : callable, optional
        Where step times come from [s].
    safe_drive : dict of str to float, optional
        Where drives go without readings, in their units; 0 where absent.
    notes : dict, optional
        What the tuner found, kept in the file.

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
        *,
        dt: float | None = None,
        loops: tuple[PILoop, ...] | None = None,
        controlled: tuple[str, ...] | None = None,
        drive_range: Mapping[str, tuple[float, float]] | None = None,
        slew_per_s: Mapping[str, float] | None = None,
        patience_s: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
        safe_drive: Mapping[str, float] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        model = PredictionModel(plant) if dt is None else prediction_model(plant, dt)
        ranges = dict(zip(model.drives, zip(model.lowest.tolist(), model.highest.tolist())))
        slews = dict(zip(model.drives, (0.125 * model.span).tolist())) | dict(slew_per_s or {})
        super().__init__(
            model,
            default_controlled(plant) if controlled is None else controlled,
            ranges | dict(drive_range or {}),
            model.dt * np.array([slews[name] for name in model.drives]),
            max(10.0, 5 * model.dt) if patience_s is None else patience_s,
            clock,
            safe_drive,
        )
        self.plant, self.notes = plant, dict(notes or {})
        self.loops = pair_loops(plant, self.controlled) if loops is None else loops
        self._design: Design | None = None
        # of each loop its drive and its controlled output, counted from 0
        self.ends = [(model.drives.index(p.drive), self.controlled.index(p.output)) for p in self.loops]
        self.integral, self._begun = np.zeros(len(self.loops)), np.full(len(self.controlled), np.nan)
        self._room, self._usual_d = np.full(model.n_d, np.nan), model.undisturbed(ROOM)
        #: An MPC of the same plant and drives in C, in whose library trials of these loops can run.
        self.c: CompiledController | None = None

    @classmethod
    def of(
        cls,
        plant: Plant,
        design: Design,
        loops: tuple[PILoop, ...] | None = None,
        *,
        notes: Mapping[str, Any] | None = None,
    ) -> PIController:
        """Return the PI loops of a design, or others, under its limits."""
        design = check_design(design if loops is None else replace(design, loops=loops), plant)
        made = cls(
            plant,
            dt=design.dt,
            loops=design.loops,
            controlled=design.controlled,
            drive_range=design.drive_range,
            slew_per_s=design.slew_per_s,
            patience_s=design.patience_s,
            safe_drive=design.safe_drive,
            notes=notes,
        )
        made._design = design
        return made

    @property
    def design(self) -> Design:
        """What it is beside its plant; of what no PI has, the plant's default."""
        if self._design is None:
            ranges = dict(zip(self.model.drives, zip(self.lowest.tolist(), self.highest.tolist())))
            self._design = default_design(
                self.plant,
                controlled=self.controlled,
                dt=self.dt,
                loops=self.loops,
                drive_range=ranges,
                slew_per_s=dict(zip(self.model.drives, (self.slew / self.dt).tolist())),
                safe_drive=dict(zip(self.model.drives, self._safe.tolist())),
                patience_s=self._patience_s / (1 + SAME),
            )
        return self._design

    def save(self, path: str | Path) -> Path:
        """Write the controller with its plant as JSON and return the path;
        :func:`thermogrip.mpc.load_controller` reads it."""
        return Parts("PI", self.plant, self.design, self.notes).save(path)

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading, under the drive that holds it or that the
        reading has."""
        self._forget()
        self.integral = np.zeros(len(self.loops))
        self._u = self._applied(reading, self._u)
        y, room = self._read(reading)
        self._target = self._begun = y[self._rows]
        self._room = np.full(self.model.n_d, np.nan)
        if np.isfinite(self._target).all():  # what the feed-forward leaves of the drive that holds this
            held = self._held(self._target, np.where(np.isfinite(room), room, self._usual_d))
            rest = self._applied(reading, held)
            self.integral = np.array(
                [rest[j] - p.feedforward * held[j] for p, (j, _) in zip(self.loops, self.ends)]
            )
        self.times.reset()

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample; a lost reading holds the drive of its loop for ``patience_s``,
        then it goes to rest, and the others go on."""
        started = self.clock()
        self.times.call(reading)
        if not self.times.due:
            return self._held_move(started)
        y, room, wanted, wrong = self._given(reading, target)
        y = y[self._rows]
        self._room = np.where(np.isfinite(room), room, self._room)
        usable = np.isfinite(y) & np.isfinite(wanted).all()
        self._unread_s = np.where(usable, 0.0, self._unread_s + self.times.waited_s)
        status, advice = "fallback_plan", wrong or "reading lost: the drive is held"
        if usable.any():
            d = np.where(np.isfinite(self._room), self._room, self._usual_d)
            self._u = self.propose(y, wanted, d, seconds=self.times.slew_s)
            lost = [name for name, seen in zip(self.controlled, usable) if not seen]
            status, advice = "ok", wrong
            if lost:
                status, advice = "fallback_plan", f"{', '.join(lost)}: no usable reading, the others go on"
        elif self._lost.all():
            self._u = self._within(self._safe, self.times.slew_s)
            status, advice = "off", wrong or "reading lost: drive to zero"
        return self._answer(status, advice, started)

    def propose(self, y: Array, target: Array, d: Array, *, seconds: float | None = None) -> Array:
        """Return the limited drives (n_u,) after so many seconds, and integrate; readings y (n_controlled,)
        are NaN where lost, d (n_d,) feeds the holding drive [degC]."""
        seconds = self.dt if seconds is None else seconds
        error = target - y
        self._begun = np.where(np.isfinite(self._begun), self._begun, y)
        ahead, kept = self.terms(target, d)
        v = ahead.copy()
        for at, (loop, (j, i)) in enumerate(zip(self.loops, self.ends)):
            if np.isfinite(error[i]):
                v[j] = ahead[j] + loop.Kc * (error[i] - kept[at]) + self.integral[at]
            else:
                v[j] = self._safe[j] if self._lost[i] else self._u[j]
        u = self._within(v, seconds)
        for at, (loop, (j, i)) in enumerate(zip(self.loops, self.ends)):
            if np.isfinite(error[i]):
                inward = (u[j] - v[j]) * loop.Kc * error[i] > 0
                if inward or abs(u[j] - v[j]) <= UNCUT * self.model.span[j]:
                    self.integral[at] += seconds * loop.Kc / loop.Ti * error[i]
        return u

    def terms(self, target: Array, d: Array) -> tuple[Array, Array]:
        """Return the feed-forward (n_u,), weighted where a loop is, and of each loop the part of its error
        that its setpoint weight leaves out."""
        ahead = self._feedforward(target, d).copy()
        for loop, (j, _) in zip(self.loops, self.ends):
            ahead[j] *= loop.feedforward
        kept = [
            (1 - loop.setpoint) * (target[i] - self._begun[i]) for loop, (_, i) in zip(self.loops, self.ends)
        ]
        return ahead, np.array(kept)

    @property
    def applied(self) -> Array:
        """Drives (n_u,) of the last move."""
        return self._u

    def hold(self, u: Array) -> None:
        """Note the drives (n_u,) that were applied, from which the slew limit counts."""
        self._u = np.asarray(u, dtype=float)

    def follow(self, u: Array, y: Array, target: Array, d: Array) -> None:
        """Set the integrators so that the next proposal, with the arguments of :meth:`propose`, starts from
        drives u (n_u,): a bumpless take-over."""
        self._u, self._begun = np.asarray(u, dtype=float), target
        ahead, error = self._feedforward(target, d), target - y
        for at, (loop, (j, i)) in enumerate(zip(self.loops, self.ends)):
            self.integral[at] = self._u[j] - loop.feedforward * ahead[j] - loop.Kc * error[i]

    def _feedforward(self, target: Array, d: Array) -> Array:
        """Return the drives that hold the target, where a loop uses them."""
        if not any(loop.feedforward for loop in self.loops):
            return np.zeros(self.model.n_u)
        return self._held(target, d)

    def _held(self, target: Array, d: Array) -> Array:
        """Return the drives that hold the target; worked out once for a target and half a degree of room."""
        wanted, room = tuple(np.round(target, 2).tolist()), self.model.rounded_d(d)
        return np.asarray(
            np.clip(held_drive(self.model, self.controlled, wanted, room), self.lowest, self.highest)
        )


@lru_cache(maxsize=1024)
def held_drive(
    model: PredictionModel, controlled: tuple[str, ...], target: tuple[float, ...], d: tuple[float, ...]
) -> Array:
    """Return the drives that hold a target, zero where none does; a search asks for the same ones again."""
    found = holding_drive(model, controlled, target, d)
    return found.u if np.isfinite(found.y).all() else np.zeros(model.n_u)
