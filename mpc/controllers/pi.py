"""The baseline: PI control with feed-forward and anti-windup, behind the same interface as the MPC.

One loop for each controlled output, on the drive that moves it most:

    v = u_ff(r, d) + Kc (r - y) + I,      u = v inside range and slew,
    I+ = I + dt ( Kc/Ti (r - y) + (u - v)/Tt ).

The last term (back-calculation) bleeds the integrator while the drive is limited, which is most of the
time after a step of the target.  ``u_ff`` is the drive that holds the target in steady state, from the
plant, weighted.  Where readings carry a time, dt is what really passed, for the integrator and for the slew
alike, and a call before a move is due (:mod:`thermogrip.mpc.estimator.call_times`) holds the last one.

Its loops are tuned by :mod:`thermogrip.mpc.design.simc`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.mpc.design.simc import PILoop, default_controlled, pair_loops
from thermogrip.mpc.estimator.call_times import SAME, CallTimes
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.mpc.plant.prediction import ROOM, PredictionModel, prediction_model
from thermogrip.mpc.plant.steady_state import holding_drive

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]

#: Readings outside are a broken wire, not a temperature [degC].
PLAUSIBLE = (-60.0, 200.0)
#: What a controller says of a call that comes before its move is due.
TOO_EARLY = "called before its sample time: the move is held"
#: And of a reading that it has seen already.
STALE = "reading is stale: its time has not moved on"


def clean(reading: Readings, name: str) -> float:
    """Return a plausible temperature [degC] from a reading, NaN where it is missing, no number, or absurd."""
    value = reading.get(name) if isinstance(reading, Mapping) else None
    try:
        number = float(value)  # type: ignore[arg-type]  # None and text end in the except
    except (TypeError, ValueError):
        return float("nan")
    return number if PLAUSIBLE[0] <= number <= PLAUSIBLE[1] else float("nan")


def read_target(target: Target, controlled: tuple[str, ...], last: Array) -> tuple[Array, str]:
    """Return targets (n_controlled,) [degC] and what was wrong with them; the last good one stands in.

    A single number is the target of every controlled output.
    """
    if isinstance(target, Mapping):
        wanted = np.array([clean(target, name) for name in controlled])
        unknown = [name for name in target if name not in controlled]
        said = f"target names {unknown[0]}, controlled is {', '.join(controlled)}" if unknown else ""
    else:
        wanted, said = np.full(len(controlled), clean({"": target}, "")), ""
    lost = ~np.isfinite(wanted)
    if lost.any():
        name = controlled[int(np.argmax(lost))]
        said = f"target of {name} is missing or absurd: the last good one stands"
    return np.where(lost, last, wanted), said


class PIController:
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
        Where step times come from.
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
    ) -> None:
        self.model = PredictionModel(plant) if dt is None else prediction_model(plant, dt)
        self.controlled = default_controlled(plant) if controlled is None else controlled
        self.loops = pair_loops(plant, self.controlled) if loops is None else loops
        ranges = dict(drive_range or {})
        pairs = [
            ranges.get(name, (low, high))
            for name, low, high in zip(self.model.drives, self.model.lowest, self.model.highest)
        ]
        self.lowest, self.highest = np.array(pairs, dtype=float).T
        slews = dict(slew_per_s or {})
        self.slew = self.model.dt * np.array(
            [slews.get(name, 0.125 * span) for name, span in zip(self.model.drives, self.model.span)]
        )
        self.patience_s = max(10.0, 5 * self.model.dt) if patience_s is None else patience_s
        self._clock = clock
        self._neutral = np.clip(np.zeros(self.model.n_u), self.lowest, self.highest)
        self._u = self._neutral
        self._I = np.zeros(len(self.loops))
        self._target = np.full(len(self.controlled), np.nan)
        self._room = np.full(self.model.n_d, np.nan)
        self._unread_s = np.zeros(len(self.controlled))  # since each output was read
        self._times = CallTimes(self.model.dt)
        self._move = Move(as_drive(self.model.drives, self._u))

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.model.dt

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading."""
        self._u = self._neutral
        self._I = np.zeros(len(self.loops))
        self._target = np.array([clean(reading, name) for name in self.controlled])
        self._room = np.full(self.model.n_d, np.nan)
        self._unread_s = np.zeros(len(self.controlled))
        self._times.reset()

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the move for this sample.

        A lost reading holds the drive of its loop for ``patience_s``, then it goes to rest; the others go on.
        """
        started = self._clock()
        self._times.call(reading)
        if not self._times.due:
            return held_move(self._move, self._clock() - started)
        wanted, said = read_target(target, self.controlled, self._target)
        self._target = wanted
        y = np.array([clean(reading, name) for name in self.controlled])
        if self._times.stale:
            y, said = np.full(len(y), np.nan), said or STALE
        room = np.array([clean(reading, name) for name in self.model.disturbances])
        self._room = np.where(np.isfinite(room), room, self._room)
        usable = np.isfinite(y) & np.isfinite(wanted).all()
        passed = self._times.slew_s
        self._unread_s = np.where(usable, 0.0, self._unread_s + self._times.waited_s)
        if usable.any():
            d = np.where(np.isfinite(self._room), self._room, ROOM)
            u, status = self.propose(y, wanted, d, seconds=passed), "ok"
            if not usable.all():
                lost = [name for name, seen in zip(self.controlled, usable) if not seen]
                status, said = "fallback_plan", f"{', '.join(lost)}: no usable reading, the others go on"
        elif self._unread_s.min() <= self.patience_s * (1 + SAME):
            u, status, said = self._u, "fallback_plan", said or "reading lost: the drive is held"
        else:
            u, status, said = (
                self._limited(self._neutral, passed),
                "off",
                said or "reading lost: drive to zero",
            )
        self._u = u
        self._times.moved()
        pump = 0 if status == "off" and not np.any(u) else 1
        self._move = Move(as_drive(self.model.drives, u), pump, status, said, self._clock() - started)
        return self._move

    def propose(self, y: Array, target: Array, d: Array, *, seconds: float | None = None) -> Array:
        """Return the limited drives (n_u,) after so many seconds, and integrate; readings y
        (n_controlled,) are NaN where lost, d (n_d,) feeds the holding drive [degC].
        """
        seconds = self.dt if seconds is None else seconds
        ahead = self._feedforward(target, d)
        v = ahead.copy()
        for at, loop in enumerate(self.loops):
            error = target[self.controlled.index(loop.output)] - y[self.controlled.index(loop.output)]
            j = self.model.drives.index(loop.drive)
            if np.isfinite(error):
                v[j] = loop.feedforward * ahead[j] + loop.Kc * error + self._I[at]
            else:
                held = self._unread_s[self.controlled.index(loop.output)] <= self.patience_s * (1 + SAME)
                v[j] = self._u[j] if held else self._neutral[j]
        u = self._limited(v, seconds)
        for at, loop in enumerate(self.loops):
            error = target[self.controlled.index(loop.output)] - y[self.controlled.index(loop.output)]
            if not np.isfinite(error):
                continue
            j = self.model.drives.index(loop.drive)
            self._I[at] += seconds * (loop.Kc / loop.Ti * error + (u[j] - v[j]) / loop.Tt)
        return u

    def hold(self, u: Array) -> None:
        """Note the drives (n_u,) that were applied, from which the slew limit counts."""
        self._u = np.asarray(u, dtype=float)

    def follow(self, u: Array, y: Array, target: Array, d: Array) -> None:
        """Set the integrators so that the next proposal starts from drives u (n_u,): a bumpless take-over.

        The other arguments are those of :meth:`propose`.
        """
        self._u = np.asarray(u, dtype=float)
        ahead = self._feedforward(target, d)
        for at, loop in enumerate(self.loops):
            error = target[self.controlled.index(loop.output)] - y[self.controlled.index(loop.output)]
            j = self.model.drives.index(loop.drive)
            self._I[at] = self._u[j] - loop.feedforward * ahead[j] - loop.Kc * error

    def _limited(self, v: Array, seconds: float) -> Array:
        slew = self.slew * (seconds / self.dt)
        low, high = np.maximum(self.lowest, self._u - slew), np.minimum(self.highest, self._u + slew)
        low, high = np.minimum(low, self.highest), np.maximum(high, self.lowest)
        return np.clip(v, low, np.maximum(low, high))

    def _feedforward(self, target: Array, d: Array) -> Array:
        """Return the drives that hold the target; worked out once for a target and half a degree of room."""
        if not any(loop.feedforward for loop in self.loops):
            return np.zeros(self.model.n_u)
        wanted, room = tuple(np.round(target, 2).tolist()), tuple((np.round(2 * d) / 2).tolist())
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


def held_move(move: Move, seconds: float) -> Move:
    """Return a move again, for a call before the next one is due; its advice stays."""
    return replace(move, advice=move.advice or TOO_EARLY, seconds=seconds)


def unseen_advice(
    controlled: tuple[str, ...], unread_s: Array, lost: NDArray[np.bool_], parked: list[str]
) -> str:
    """Return what becomes of the loops whose sensors are lost while others go on."""
    if not lost.any():
        names = [name for name, seconds in zip(controlled, unread_s) if seconds]
        return f"{', '.join(names)}: no usable reading, the model stands in"
    names = [name for name, gone in zip(controlled, lost) if gone]
    rest = f"{', '.join(parked)} to rest, the others go on" if parked else "the others go on"
    return f"no reading of {', '.join(names)} for {unread_s.max():.0f} s: {rest}"


def as_drive(drives: tuple[str, ...], u: Array) -> float | dict[str, float]:
    """Return drives as a move carries them: a number where there is one, else by name."""
    if len(drives) == 1:
        return float(u[0])
    return {name: float(value) for name, value in zip(drives, u)}
