r"""What somebody beside a loop may say of it: it swings, a sensor has stopped, or its plant is another.

A monitor is fed what was read, asked and moved, outside of the step and its deadline, whatever the law, and
has a filter of its own.  Its words name a load where one would look the same, and are taken back when their
evidence goes.

**Settling.**  Of the first-order plant with gain K, lag T and apparent delay L that its step response is, the
loop of a PI has the poles of

    T s^2 + (1 + K Kc) s + K Kc / Ti = 0,

and with the slowest of them, 1 / t, it is there in L + 4 t (2 % are left); a predictive controller is held to
the PI by Skogestad's rule.

**Limits.**  Where a drive is within 1 % of its range of its limit, on the side to which the error drives it,
the plant has nothing but its own lag.  On the way to a rest at or beyond the target the distance falls by
1 - exp(-1) in T, or by 28 % where the lag is three times the model's; one of which three quarters remain
after L + T is held by nothing.  One that has grown after 2 L, and for as long as the loop takes to arrive, is
driven by another plant or a load.

**Another plant.**  A drive whose estimated bias is beyond 30 % of its range, or an output's beyond a third of
a jump, for as long as the loop takes to arrive: a draw is over by then.  Besides,
:mod:`thermogrip.mpc.estimator.structure_monitor`, :mod:`thermogrip.mpc.estimator.fault_monitors` and
:mod:`thermogrip.mpc.estimator.oscillation`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.design.design import Design, PILoop
from thermogrip.mpc.estimator.call_times import RESTART_S, SAME
from thermogrip.mpc.estimator.fault_monitors import GainMonitor, StuckMonitor
from thermogrip.mpc.estimator.oscillation import NOISE_SD, OscillationMonitor
from thermogrip.mpc.estimator.reading_checks import follows
from thermogrip.mpc.estimator.structure_monitor import StructureMonitor
from thermogrip.mpc.interface import Move, Readings, Trajectory, number, target_now
from thermogrip.mpc.plant.prediction import prediction_model, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_CONSTANTS = 4.0  # time constants until a loop is there
_AT_LIMIT = 0.01  # of a range
_STALLED = 0.75  # of a distance, left after the delay and the lag
_REMEMBER = 0.3  # share of the newest distance in their mean
_EVEN = 0.1  # of a sample time, by which calls may differ from it in a window of the structure's monitor


class _Answer(NamedTuple):
    gain: float  # for the whole range
    delay: float  # s, a sample at least
    lag: float


@lru_cache(maxsize=64)
def _step_answer(plant: Plant, drive: str, output: str, dt: float) -> _Answer:
    response = step_response(plant, drive, output)
    return _Answer(response.gain, max(response.delay, dt), response.lag)


def settling_time(gain: float, delay: float, lag: float, Kc: float, Ti: float) -> float:
    """Return how long a loop of a first-order plant takes until 2 % are left [s], gain and Kc for one and the
    same unit of drive; inf where it is not stable.

    >>> round(settling_time(gain=2.0, delay=5.0, lag=100.0, Kc=5.0, Ti=40.0), 1)
    129.7
    """
    slowest = float(np.max(np.roots([lag, 1.0 + gain * Kc, gain * Kc / Ti]).real))
    return delay - _CONSTANTS / slowest if slowest < 0 else np.inf


class LoopMonitor:
    """Watches one loop of a plant.

    Parameters
    ----------
    plant : Plant
    design : Design
        Of the loop: what is regulated in which ranges, how often, and how far it may overshoot.
    loops : sequence of PILoop, optional
        The PI loops that are watched; by default those of the design.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> from thermogrip.mpc import design_controller
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> controller = design_controller(plant, controlled=("t1",), dt=5.0)
    >>> monitor, reading = LoopMonitor(plant, controller.design), {"t1": 25.0, "t2": 25.0}
    >>> controller.reset(reading)
    >>> monitor.note(reading, controller.step(reading, 40.0), 40.0)
    ''
    """

    def __init__(self, plant: Plant, design: Design, loops: Sequence[PILoop] | None = None) -> None:
        self.model, self.loops = prediction_model(plant, design.dt), tuple(loops or design.loops)
        model, n = self.model, len(self.loops)
        self.controlled = design.controlled
        self._rows = [model.outputs.index(p.output) for p in self.loops]
        self._drives = [model.drives.index(p.drive) for p in self.loops]
        answers = [_step_answer(plant, p.drive, p.output, model.dt) for p in self.loops]
        spans = model.span[self._drives].tolist()
        answers_of_loops = zip(answers, spans, self.loops)
        self._promised = np.array(
            [settling_time(a.gain / s, *a[1:], p.Kc, p.Ti) for a, s, p in answers_of_loops]
        )
        low, high = np.array([design.drive_range[p.drive] for p in self.loops], dtype=float).reshape(n, 2).T
        self._low, self._high = low + _AT_LIMIT * (high - low), high - _AT_LIMIT * (high - low)
        self._side = np.sign([p.Kc for p in self.loops])
        self._delay, self._lag = np.array([[a.delay, a.lag] for a in answers]).reshape(n, 2).T
        self._zone = np.array([design.zones.get(p.output, 0.0) for p in self.loops])
        self.names = tuple(p.output for p in self.loops)
        filters = {name: design.observer(model) for name in model.drives}
        self.gain = GainMonitor(filters, float(np.max(self._promised, initial=0.0)))
        self.stuck = StuckMonitor(model.outputs)
        self.observer = design.observer(model)
        noise = NOISE_SD * np.sqrt(self.observer.R[self._rows])
        self._near = np.maximum(2.0 * design.overshoot, noise)  # of its target an output is there
        self.swings = OscillationMonitor(self.names, model.dt, self._delay.tolist(), self._near.tolist())
        self.structure = StructureMonitor(plant, model, self.controlled)
        self.forget()

    def forget(self) -> None:
        """Begin anew, as with other readings."""
        self.said = ""  # of the newest sample
        self._time_s = np.nan
        self._u: Array | None = None
        self._goals: list[float] = []
        self.structure.forget()
        self.gain.forget()
        self.stuck.forget()
        self._restart()

    def _restart(self) -> None:
        """Begin anew, as towards a new target."""
        n = len(self.loops)
        self.swings.restart()
        self._target = np.full(n, np.nan)
        self._error = np.full(n, np.nan)  # mean of the last errors
        self._limited_s = np.zeros(n)
        self._away_s = np.zeros(n)
        self._strange_s = 0.0
        self._marked_s = np.zeros(n)  # when the distance was noted
        self._marked = np.full(n, np.inf)  # the distance then
        self._begun = np.full(n, np.inf)  # the distance when 2 L were over
        self._stalled = np.zeros(n, dtype=bool)

    def note(self, reading: Readings, move: Move, target: Trajectory) -> str:
        """Note a reading, the move that answered it, and the target; return what is to be said of the loop,
        nothing while all is well. Calls that come before a sample is over say what the last one said."""
        now = number(reading, "time_s")
        seconds = now - self._time_s if np.isfinite(now - self._time_s) else self.model.dt
        if self._u is not None and seconds < self.model.dt * (1 - SAME):
            return self.said
        self._time_s = now
        y = np.array([number(reading, name) for name in self.model.outputs])
        d = np.array([number(reading, name) for name in self.model.disturbances])
        d = np.where(np.isfinite(d), d, self.model.undisturbed(self.observer.ambient))
        u = np.array(move.drives(self.model.drives), dtype=float)
        applied = u if self._u is None else self._u
        read_drives = np.array([number(reading, name) for name in self.model.drives])
        applied = np.where(np.isfinite(read_drives), read_drives, applied)
        wanted = target_now(target)
        by_name = wanted if isinstance(wanted, Mapping) else dict.fromkeys(self.controlled, wanted)
        goals = [number(by_name, p.output) for p in self.loops]
        new = bool(self._goals) and goals != self._goals
        strange = self._follow(y, d, applied, seconds, new=new)
        self._u, self._goals = u, goals
        if move.status not in ("ok", "late", "infeasible"):
            self._restart()  # no law is followed
            self.said = ""
        else:
            self.said = self._judge(y[self._rows], np.array(goals), applied[self._drives], seconds, strange)
        return self.said

    def _follow(self, y: Array, d: Array, applied: Array, seconds: float, *, new: bool) -> str:
        """Let the filters follow, also towards a new target; return in what the plant is another than its
        model."""
        observer = self.observer
        if self._u is None or seconds > RESTART_S + self.model.dt:
            observer.reset(y, d)
            observer.update(y)
            self.structure.restart()
            self.gain.restart(y, d)
            self.stuck.forget()
        else:
            observer.advance(seconds, applied, d)
            observer.look(d)
            self.gain.note(observer.update(y), observer.R, y, applied, d, seconds, new=new)
        if self._u is not None and abs(seconds - self.model.dt) > _EVEN * self.model.dt:
            self.structure.restart()
        self.structure.note(observer, y, applied, d)
        self.stuck.note(observer, y, applied, d)
        return follows(observer, self.controlled)

    def _judge(self, y: Array, target: Array, u: Array, seconds: float, strange: str) -> str:
        """Return what is to be said after readings y and targets of the loops (n,) and drives u (n,)."""
        if np.any(target != self._target):
            self._restart()
            self._target = target.copy()
        error, band = target - y, self._near
        swings = self.swings.note(-np.sign(error) * np.maximum(np.abs(error) - self._zone, 0.0), seconds)
        begun = np.where(np.isfinite(self._error), self._error, error)
        self._error = np.where(np.isfinite(error), begun + _REMEMBER * (error - begun), begun)
        limited = self._limits(u, seconds)
        off, names = np.abs(self._error), self.names
        away = limited & (off > self._begun + band)
        self._away_s = np.where(away, self._away_s + seconds, 0.0)
        self._strange_s = self._strange_s + seconds if strange else 0.0
        if self.stuck.said:
            return self.stuck.said
        for which in (self._away_s > self._promised, limited & self._stalled):
            if which.any():
                k = int(np.argmax(np.where(which, off / band, 0.0)))
                does = f"stays {off[k]:.2g} off its target"
                does = "goes away from its target" if away[k] and not self._stalled[k] else does
                why = "a load, or another plant than the model"
                return f"{names[k]} {does} while {self.loops[k].drive} is at its limit: {why}"
        if swings:
            return "; ".join(filter(None, (swings, strange)))
        lasts = self._strange_s > np.max(self._promised, initial=0.0)
        other = self.structure.said or self.gain.said
        return other or (f"{strange} or is it a load?" if strange and lasts else "")

    def _limits(self, u: Array, seconds: float) -> Mask:
        """Note for how long drives have been at the limits to which errors drive them; return which are."""
        way, off = self._side * self._error, np.abs(self._error)
        limited = (off > self._near) & np.where(way > 0, u >= self._high, u <= self._low)
        self._limited_s = np.where(limited, self._limited_s + seconds, 0.0)
        fresh = ~limited | np.isinf(self._marked)
        self._stalled &= limited
        due = limited & (self._limited_s - self._marked_s >= self._delay + self._lag)
        self._stalled = np.where(due, off > _STALLED * self._marked, self._stalled)
        self._marked = np.where(fresh | due, np.where(limited, off, np.inf), self._marked)
        self._marked_s = np.where(fresh | due, self._limited_s, self._marked_s)
        early = self._limited_s <= 2.0 * self._delay
        self._begun = np.where(early, np.where(limited, off, np.inf), self._begun)
        return np.asarray(limited)
