r"""What somebody beside a loop may say of it: it swings, a sensor has stopped, or its plant is another.

A monitor is fed what was read, asked and moved, outside of the step and its deadline, whatever the law, and
has a filter of its own.  Its words name a load where one would look the same, and are taken back when their
evidence goes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.estimator.call_times import RESTART_S, SAME
from thermogrip.mpc.estimator.fault_monitors import GainMonitor, StuckMonitor
from thermogrip.mpc.estimator.oscillation import NOISE_SD, Oscillation
from thermogrip.mpc.estimator.reading_checks import follows
from thermogrip.mpc.interface import Move, Readings, Trajectory, number, target_now
from thermogrip.mpc.optimiser.rti import BREAKS
from thermogrip.mpc.plant.prediction import holding_drive, prediction_model, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_CONSTANTS = 4.0  # time constants until a loop is there
_OUTSIDE = 0.01  # of a range, by which what balances an integrator may be beyond it
_REMEMBER = 0.3  # share of the newest distance in their mean


def settling_time(gain: float, delay: float, lag: float, Kc: float, Ti: float) -> float:
    """Return how long a loop of a first-order plant takes until 2 % are left [s]; inf where it is not stable.

    >>> round(settling_time(gain=2.0, delay=5.0, lag=100.0, Kc=5.0, Ti=40.0), 1)
    129.7
    """
    # the poles T s^2 + (1 + K Kc) s + K Kc / Ti = 0 of a first-order plant with gain K, lag T and apparent
    # delay L under a PI; with the slowest of them, 1 / t, the loop is there in L + 4 t
    slowest = float(np.max(np.roots([lag, 1.0 + gain * Kc, gain * Kc / Ti]).real))
    return delay - _CONSTANTS / slowest if slowest < 0 else np.inf


class LoopMonitor:
    """Watches one loop of a plant.

    Parameters
    ----------
    plant : Plant
    design : Design
        Of the loop; its PI loops pair outputs and drives.

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

    def __init__(self, plant: Plant, design: Design) -> None:
        self.model, self.loops = prediction_model(plant, design.dt), design.loops
        model = self.model
        self.controlled = design.controlled
        self._rows = [model.outputs.index(p.output) for p in self.loops]
        self._drives = [model.drives.index(p.drive) for p in self.loops]
        answers = [step_response(plant, p.drive, p.output) for p in self.loops]
        delays = [max(a.delay, model.dt) for a in answers]
        spans = model.span[self._drives].tolist()
        # a predictive controller is held to the PI by Skogestad's rule
        self._promised = np.array(
            [
                settling_time(a.gain / span, delay, a.lag, p.Kc, p.Ti)
                for a, delay, span, p in zip(answers, delays, spans, self.loops)
            ]
        )
        self._look_s = max((delay + a.lag for a, delay in zip(answers, delays)), default=np.inf)
        self._zone = np.array([design.zones.get(p.output, 0.0) for p in self.loops])
        self._ranges = np.array([design.drive_range[name] for name in model.drives], dtype=float).T
        self._limits = dict(design.limits)
        self.names = tuple(p.output for p in self.loops)
        filters = {name: design.observer(model) for name in model.drives}
        self.gain = GainMonitor(filters, float(np.max(self._promised, initial=0.0)))
        self.stuck = StuckMonitor(model.outputs)
        self.observer = design.observer(model)
        noise = NOISE_SD * np.sqrt(self.observer.R[self._rows])
        self._near = np.maximum(2.0 * design.overshoot, noise)  # of its target an output is there
        self._signals = [Oscillation(model.dt, *of) for of in zip(delays, self._near.tolist())]
        self.forget()

    def forget(self) -> None:
        """Begin anew, as with other readings."""
        self.message = ""  # of the newest sample
        self._time_s = np.nan
        self._u: Array | None = None
        self._goals: list[float] = []
        self.gain.forget()
        self.stuck.forget()
        self._restart()

    def _restart(self) -> None:
        """Begin anew, as towards a new target."""
        n = len(self.loops)
        for signal in self._signals:
            signal.restart()
        self._target = np.full(n, np.nan)
        self._error = np.full(n, np.nan)  # mean of the last errors
        self._strange_s = 0.0
        self._looked_s = np.inf  # since the drives were sought that hold the targets
        self._unreachable = ""

    def note(self, reading: Readings, move: Move, target: Trajectory) -> str:
        """Note a reading, the move that answered it, and the target; return what is to be said.  Where relays
        switch a drive, ``mean_<drive>`` of the reading is what they gave since the one before."""
        now = number(reading, "time_s")
        seconds = now - self._time_s if np.isfinite(now - self._time_s) else self.model.dt
        y = np.array([number(reading, name) for name in self.model.outputs])
        d = np.array([number(reading, name) for name in self.model.disturbances])
        d = np.where(np.isfinite(d), d, self.model.undisturbed(self.observer.ambient))
        u = np.array(move.drives(self.model.drives), dtype=float)
        between = seconds < self.model.dt * (1 - SAME)
        # between two samples only a move counts: until then another drive was applied
        if self._u is not None and between and (seconds <= 0 or np.array_equal(u, self._u)):
            return self.message
        self._time_s = now
        applied = u if self._u is None else self._u
        for prefix in ("", "mean_"):  # what relays gave since the last reading is more than what they do now
            read_drives = np.array([number(reading, prefix + name) for name in self.model.drives])
            applied = np.where(np.isfinite(read_drives), read_drives, applied)
        wanted = target_now(target)
        by_name = wanted if isinstance(wanted, Mapping) else dict.fromkeys(self.controlled, wanted)
        goals = [number(by_name, p.output) for p in self.loops]
        new = bool(self._goals) and goals != self._goals
        strange = self._follow(y, d, applied, seconds, new=new)
        self._u, self._goals = u, goals
        if move.status not in ("ok", "late", "infeasible"):
            self._restart()  # no law is followed
            self.message = ""
        else:
            self.message = self._judge(y[self._rows], np.array(goals), d, seconds, strange)
        return self.message

    def _follow(self, y: Array, d: Array, applied: Array, seconds: float, *, new: bool) -> str:
        """Let the filters follow; return in what the plant is another than its model."""
        observer = self.observer
        if self._u is None or seconds > RESTART_S + self.model.dt:
            observer.reset(y, d)
            observer.update(y)
            self.gain.restart(y, d)
            self.stuck.forget()
        else:
            observer.advance(seconds, applied, d)
            observer.look(d)
            self.gain.note(observer.update(y), observer.R, y, applied, d, seconds, new=new)
        self.stuck.note(observer, y, applied, d)
        return follows(observer, self.controlled)

    def _judge(self, y: Array, target: Array, d: Array, seconds: float, strange: str) -> str:
        """Return what is to be said after readings y and targets of the loops (n,) amid disturbances d."""
        if np.any(target != self._target):
            self._restart()
            self._target = target.copy()
        error = target - y
        swings = self._swings(-np.sign(error) * np.maximum(np.abs(error) - self._zone, 0.0), seconds)
        begun = np.where(np.isfinite(self._error), self._error, error)
        self._error = np.where(np.isfinite(error), begun + _REMEMBER * (error - begun), begun)
        self._strange_s = self._strange_s + seconds if strange else 0.0
        self._looked_s += seconds
        # the drives that hold the targets are sought where these are new or have been missed for long
        if not np.any(np.abs(self._error) > self._near + self._zone):
            self._unreachable = ""
        elif self._looked_s >= self._look_s:
            self._unreachable, self._looked_s = self._missed(target, d), 0.0
        lasts = self._strange_s > np.max(self._promised, initial=0.0)  # a draw is over by then
        if message := self.stuck.message or self._unreachable:
            return message
        if swings:
            return "; ".join(filter(None, (swings, strange)))
        return self.gain.message or (f"{strange} or is it a load?" if strange and lasts else "")

    def _swings(self, error: Array, seconds: float) -> str:
        """Note the errors (n,), so many seconds after the last; return which output swings most."""
        found = [
            (signal.amplitude / signal.least, name, signal)
            for name, signal, each in zip(self.names, self._signals, error.tolist())
            if signal.note(each, seconds)
        ]
        if not found:
            return ""
        _, name, signal = max(found, key=lambda swing: swing[0])
        return (
            f"{name} swings about its target by {signal.amplitude:.2g} with a period of about "
            f"{signal.period:.2g} s: the plant is not the model, its valve or relay sticks, or a load comes "
            "and goes"
        )

    def _missed(self, target: Array, d: Array) -> str:
        """Return which target (n,) no drive holds, and what can be held; empty where drives hold all."""
        observer, bias, rows = self.observer, self.observer.output_bias, self._rows
        low, high = self._ranges + observer.drive_bias
        asked = target - bias[rows]
        d = d + observer.disturbance_bias
        if not np.isfinite(asked).all():
            return ""
        # the biases that the filter has found are in it: a dead heater is a bias of its range
        held = holding_drive(self.model, self.names, asked, d, within=(low, high))
        shown = held.y + bias
        miss = np.abs(shown[rows] - target) - self._zone
        slack = _OUTSIDE * self.model.span
        if np.any((held.u < low - slack) | (held.u > high + slack)):
            return f"no drive holds {', '.join(self.names)}: the drives would go beyond their ranges"
        if np.any(miss > self._near):
            k = int(np.argmax(miss / self._near))
            can = f"{shown[rows[k]]:.4g} can be held while the load is as it is"
            return f"no drive holds {self.names[k]} at {target[k]:.4g}: {can}"
        for name, (least, most) in self._limits.items():
            i = self.model.outputs.index(name)
            beyond = max(least - shown[i], shown[i] - most)
            if beyond > BREAKS * self.model.unit[i]:
                return f"with {', '.join(self.names)} on target {name} is at {shown[i]:.4g}, beyond its limit"
        return ""
