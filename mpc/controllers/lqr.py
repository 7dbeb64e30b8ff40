r"""A linear-quadratic regulator on the same estimate as the MPC: what is won without looking ahead at limits.

Around the drive that holds the target the plant is linear,

    x+ = x_s + A (x - x_s) + B (u - u_s),

and the regulator minimises, over an endless horizon and without any limit,

    J = sum track |y - r|^2 + move |(u_k - u_k-1)/span|^2 + drive |(u - u_s)/span|^2.

The last drive is a state, z = (x - x_s, u_k-1 - u_s), so that a move has its weight as it has in the MPC:

    z+ = [A B; 0 1] z + [B; 1] du,     du = -K z,     K from the discrete Riccati equation [1]_.

**No offset.**  State and disturbances come from the filter of the MPC
(:mod:`thermogrip.mpc.estimator.observer`), and at each sample (x_s, u_s) is where the disturbed plant rests
at the target:

    [A - 1  B] [x_s]   [what moves the plant besides]
    [C      0] [u_s] = [r - bias                    ].

**Limits.**  The drive is cut to its range and its slew afterwards, and the filter gets what was applied,
so nothing winds up; but the regulator does not know of the limits when it decides, nor of those of outputs.
It does not know either that a Peltier element has an optimum: sent beyond it, more cooling current heats, and
a gain of fixed sign asks for still more.

**A lost sensor.**  The model replaces its reading, for ``patience_s``.  Then the drive of its loop goes
to rest, and the law for the other drives and outputs goes on.

**Time.**  Called late, it will be called late again: then the drive is the mean of the moves that the law
would make until then, sample by sample, and does to the plant what they would have done.

References
----------
.. [1] B. D. O. Anderson, J. B. Moore, "Optimal Control: Linear Quadratic Methods", Prentice Hall, 1990.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_discrete_are

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.base import SampledController
from thermogrip.mpc.controllers.pi import held_drive
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.estimator.call_times import RESTART_S, opening
from thermogrip.mpc.estimator.observer import Observer
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.plant.prediction import PredictionModel, prediction_model

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_LONGEST = 1000.0  # samples that a mean is taken over
_LEAST_WEIGHT = 1e-6  # of a drive: without one, two drives on one output would drift against each other


def regulator_gain(A: Array, B: Array, C: Array, *, track: Array | float, move: Array, drive: Array) -> Array:
    """Return the gain K (n_u, n_x + n_u) of du = -K (x - x_s, u_before - u_s) for weights of the outputs'
    errors (n_y,), of moves (n_u,), and of drives (n_u,); LinAlgError: the Riccati equation has no stabilising
    solution."""
    n_x, n_u = B.shape
    whole = np.block([[A, B], [np.zeros((n_u, n_x)), np.eye(n_u)]])
    into = np.vstack([B, np.eye(n_u)])
    Q = np.zeros((n_x + n_u, n_x + n_u))
    Q[:n_x, :n_x], Q[n_x:, n_x:] = C.T @ (np.atleast_1d(track)[:, None] * C), np.diag(drive)
    P = solve_discrete_are(whole, into, Q, np.diag(move))
    return np.asarray(np.linalg.solve(np.diag(move) + into.T @ P @ into, into.T @ P @ whole))


@dataclass(frozen=True)
class _Point:
    """The plant about one target: x+ = after + A (x - x0) + B (u - u0) + E (d - d0)."""

    x: Array
    u: Array
    d: Array
    after: Array
    A: Array
    B: Array
    E: Array


@dataclass(frozen=True)
class _Law:
    point: _Point
    K: Array
    stay: Array  # (what moves the plant besides, what the outputs lack) -> (x_s - x0, u_s - u0)
    seen: list[int]  # which controlled outputs it brings to rest, with which drives
    live: list[int]


class LQRController(SampledController):
    """Linear-quadratic regulator behind the interface of every controller."""

    def __init__(
        self,
        plant: Plant,
        design: Design,
        *,
        observer: Observer | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        model = prediction_model(plant, design.dt)
        slew = design.dt * np.array([design.slew_per_s[name] for name in model.drives])
        super().__init__(
            *(model, design.controlled, design.drive_range, slew, design.patience_s, clock),
            design.safe_drive,
            design.on_off,
        )
        self.design = design
        if observer is None:
            observer = design.observer(model)
        self.observer = observer
        self._laws: dict[tuple[float, ...], _Law | None] = {}
        self._pair = [
            (model.drives.index(loop.drive), self.controlled.index(loop.output))
            for loop in design.loops
            if loop.output in self.controlled
        ]
        self._resting = self._rest_law()
        self.reset({})

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading, its drive at zero or as the reading has
        it."""
        y, d = self._read(reading)
        self._d = np.where(np.isfinite(d), d, self.model.undisturbed(self.design.ambient))
        self.observer.reset(y, self._d)
        self._forget()
        self._begin_positions()
        self._u = self._applied(reading, self._u)
        self._fresh = True
        self.times.reset()

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample; a lost reading is predicted for ``patience_s``."""
        started = self.clock()
        self.times.call(reading)
        if not self._fresh:
            self.observer.advance(min(self.times.seconds, RESTART_S + self.dt), self._u, self._d)
        if not self.times.due:
            return self._held_move(started)
        self.observer.look(self._d)
        y, d, wanted, said = self._given(reading, target)
        self._fresh = False
        self._d = np.where(np.isfinite(d), d, self._d)
        if self.times.seconds > RESTART_S + self.dt and np.isfinite(y).any():
            self.observer.reset(y, self._d)  # the past is unknown
        self.observer.update(y)
        passed = self.times.slew_s
        seen = np.isfinite(y[self._rows])
        self._unread_s = np.where(seen, 0.0, self._unread_s + self.times.waited_s)
        lost = self._lost
        if lost.all() or not np.isfinite(wanted).all():
            u, status, said = self._safe, "off", said or "reading lost: drive to zero"
        else:
            u, status = self.propose(wanted, passed / self.dt), "ok" if seen.all() else "fallback_plan"
            if seen.any() and not seen.all():
                said = said or self._unseen(
                    [self.model.drives[j] for j in self._parked(lost)], self._unread_s
                )
            said = said or ("" if seen.all() else "reading lost: the state is predicted")
        self._u = self._within(u, passed)
        return self._answer(status, said, started)

    def propose(self, target: Array, samples: float = 1.0) -> Array:
        """Return the drives (n_u,) before their limits for targets (n_controlled,) [degC]: their mean over so
        many samples, at least one."""
        law, observer, n_x = self._law(target), self.observer, self.model.n_x
        proposed = self._safe.copy()
        if law is None:
            return proposed  # no drive that is left moves what is still seen
        point, live = law.point, law.live
        lowest, highest = self.lowest[live], self.highest[live]
        d = self._d + observer.disturbance_bias - point.d
        moved = point.after - point.x + point.B @ observer.drive_bias + point.E @ d
        left = target - (self.model.output(point.x) + observer.output_bias)[self._rows]
        stay = law.stay @ np.concatenate([-moved, left[law.seen]])
        # a target out of reach has its resting drive out of range, where no drive would ever come to rest
        u = np.clip(point.u[live] + stay[n_x:], lowest, highest)
        away = np.concatenate([observer.now - point.x - stay[:n_x], self._u[live] - u])
        moves = []
        for _ in range(max(1, ceil(min(samples, _LONGEST)))):
            after = away[n_x:] - law.K @ away
            moves.append(np.clip(u + after, lowest, highest) if samples > 1 else u + after)
            away = np.concatenate([point.A @ away[:n_x] + point.B[:, live] @ after, after])
        proposed[live] = opening(np.stack(moves), samples)
        return proposed

    def _parked(self, lost: Mask) -> list[int]:
        """Return the drives whose loops are lost."""
        return [drive for drive, output in self._pair if lost[output]]

    def _law(self, target: Array) -> _Law | None:
        """Return the law about a target, worked out once for it, half a degree of room and what is lost."""
        lost = self._lost
        parked = tuple((drive, float(self._safe[drive])) for drive in self._parked(lost))
        wanted, room = tuple(np.round(target, 2).tolist()), self.model.rounded_d(self._d)
        key = wanted + room + tuple(lost.tolist())
        if key not in self._laws:
            try:
                point = _held_point(self.model, self.controlled, wanted, room, parked)
                self._laws[key] = self._law_at(point, lost)
            except (np.linalg.LinAlgError, ValueError):
                # no steady state, or none that a drive moves: a Peltier element at its optimum
                self._laws[key] = self._rest_law_without(lost) if lost.any() else self._resting
        return self._laws[key]

    def _rest_law_without(self, lost: Mask) -> _Law | None:
        try:
            return self._law_at(self._resting.point, lost)
        except (np.linalg.LinAlgError, ValueError):
            return None

    def _rest_law(self) -> _Law:
        x, _, d = self.model.at_rest(self.design.ambient)
        point = _Point(x, self._neutral, d, *self.model.linearise(x, self._neutral, d))
        try:
            return self._law_at(point, np.zeros(len(self._rows), dtype=bool))
        except (np.linalg.LinAlgError, ValueError) as error:
            raise UserError(
                f"no linear regulator brings {', '.join(self.controlled)} to rest",
                hint="control an output that a drive moves",
            ) from error

    def _law_at(self, point: _Point, lost: Mask) -> _Law:
        seen = np.flatnonzero(~lost).tolist()
        parked = self._parked(lost)
        live = [drive for drive in range(self.model.n_u) if drive not in parked]
        A, B, C = point.A, point.B[:, live], self.model.C[self._rows][seen]
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise ValueError("not finite")
        if not live:
            raise ValueError("no drive is left")
        span2, (n_x, n_u) = self.model.span[live] ** 2, B.shape
        move, drive = self.design.move / span2, max(self.design.drive, _LEAST_WEIGHT) / span2
        weights = [self.design.weights.get(self.controlled[at], 1.0) for at in seen]
        track = self.design.track * np.array(weights)
        K = regulator_gain(A, B, C, track=track, move=move, drive=drive)
        whole = np.block([[A - np.eye(n_x), B], [C, np.zeros((len(C), n_u))]])
        return _Law(point, K, np.linalg.pinv(whole), seen, live)


@lru_cache(maxsize=1024)
def _held_point(
    model: PredictionModel,
    controlled: tuple[str, ...],
    target: tuple[float, ...],
    d: tuple[float, ...],
    parked: tuple[tuple[int, float], ...],
) -> _Point:
    """Return the plant about the drive that holds a target; a search of weights asks for the same ones."""
    u, room = held_drive(model, controlled, target, d).copy(), np.array(d)
    for drive, rest in parked:
        u[drive] = rest
    x = model.steady_state(u, room)
    return _Point(x, u, room, *model.linearise(x, u, room))
