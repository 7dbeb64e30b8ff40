r"""Does the rig follow its identified model?

A filter follows the rig (:mod:`~thermogrip.rig.guard.kalman_filter`), and three tests are made.

*One step.*  An innovation that is too large is no temperature of this rig: the reading is suspect.

*A window.*  The state of H seconds ago is simulated under the drives that were applied since, without looking
at a reading, and the mean of the last ``smooth`` seconds of readings is compared with where it ends.  The
residual r may be

    |r| <= floor(H) + share * swing,

swing the largest change that either path makes in the window: a model is wrong by a share of what it
predicts, and by a floor when it predicts nothing.  This is the "not heating at the expected rate" of 3-D
printers, with a sign, for cooling too, and with the expected number at hand.  A pump that was switched
meanwhile is another plant, and the floor is larger by ``switching``.  The cause of a larger residual is
sought by :mod:`~thermogrip.rig.guard.fault_isolation`.

*A bias.*  A sensor that drifts slowly, or a driver that weakens, is followed by the filter's biases b and w,
which may not exceed ``bias_limit`` and ``drive_limit``.

Of the model alone: would more cooling drive still cool?

Where the user states that the rig may have drifted from its plant, windows and drive biases are evaluated
with the uncertainty of the plant's parameters as well (:mod:`~thermogrip.rig.guard.plant_mismatch`), and the
longest windows of a session are evidence of these parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermogrip.rig.guard.fault_isolation import Cause, explain_window
from thermogrip.rig.guard.kalman_filter import Estimate, FilterSettings, History, RigFilter, RigModel
from thermogrip.rig.guard.plant_mismatch import Evidence, PlantDrift
from thermogrip.sysid.models.model import Array
from thermogrip.sysid.plant.plant import Plant

__all__ = ["ModelMonitor", "ModelSettings", "Residual"]

_BIAS_AFTER_S = 60.0  # a bias is not evaluated before the filter has seen something


@dataclass(frozen=True)
class ModelSettings(FilterSettings):
    """How far the rig may be from its model; measured in docs/reference/faults.md."""

    windows: tuple[float, ...] = (10.0, 30.0, 90.0)  # lengths H [s], rising
    floors: tuple[float, ...] = (0.55, 0.35, 0.45)  # of each, where the model predicts no change [K]
    share: float = 0.25  # allowed part of the change in the window
    switching: float = 0.5  # allowed besides where the pump was switched in the window [K]
    smooth: float = 3.0  # readings of so long are averaged [s]
    bias_limit: float = 2.0  # of an output [K]
    drive_limit: float = 0.25  # of a drive's bias, as a fraction of half its range
    warm_up: float = 60.0  # nothing is compared for so long where the start is not at rest [s]
    drift: float = 0.0  # share by which each parameter of the plant may have drifted


@dataclass(frozen=True)
class Residual:
    """What the rig does, beside what its model predicts; beyond ``allowed`` it is an alarm."""

    kind: str  # ``window`` or ``bias``
    subject: str  # output or drive
    window: float  # seconds that were compared; 0 for a bias
    expected: float  # change over the window [K]; 0 for a bias
    measured: float  # change over the window [K], or the bias
    allowed: float

    @property
    def excess(self) -> float:
        """How many times what is allowed."""
        return self.off / self.allowed

    @property
    def off(self) -> float:
        """How far measured is from expected."""
        return abs(self.measured - self.expected)


def _compare_windows(model: RigModel, past: History, settings: ModelSettings, since: Array) -> list[Residual]:
    """Return the residuals of every window that ends now and began after ``since`` (n_y,) [s]."""
    found = []
    for length, floor in zip(settings.windows, settings.floors):
        begin = past.begin(past.now - length)
        if begin is None or begin.step >= past.steps.done:
            continue
        window = _Window(begin, length, floor)
        found += _compare(model, past, settings, window, since <= begin.time)
    return found


def _window_slopes(
    model: RigModel, past: History, smooth: float, length: float, steps: Array
) -> tuple[Array, Array] | None:
    """Return how far the path of a window without drive biases goes (n_y,) [K], and its slopes (n_y, n_p).

    The slopes are the further change with each parameter moved by ``steps`` (n_p,); None without such a
    window.
    """
    begin, n = past.begin(past.now - length), len(steps)
    if begin is None or begin.step >= past.steps.done:
        return None
    u, d = past.steps.rows(begin.step)
    p = np.repeat(model.p[None], n + 1, axis=0)
    p[np.arange(1, n + 1), np.arange(n)] += steps
    many = [np.repeat(part[None], n + 1, axis=0) for part in (begin.x, u, d)]
    y = np.asarray(model.rollout(many[0], many[1], many[2], p)[0])
    at = [min(m.step - begin.step, y.shape[1] - 1) for m in _recent(past, begin, smooth)]
    ends = y[:, at].mean(axis=1)
    return ends[0] - y[0, 0], (ends[1:] - ends[0]).T


def _recent(past: History, begin: Estimate, smooth: float) -> list[Estimate]:
    """Return the estimates that the end of a window is the mean of."""
    return [m for m in past.after(past.now - smooth) if m.time > begin.time]


@dataclass(frozen=True)
class _Window:
    begin: Estimate
    length: float
    floor: float


def _compare(
    model: RigModel, past: History, settings: ModelSettings, window: _Window, known: NDArray[np.bool_]
) -> list[Residual]:
    begin, plant = window.begin, model.plant
    recent = _recent(past, begin, settings.smooth)
    if not recent or not known.any():
        return []
    u, d = past.steps.rows(begin.step)
    path = model.run(begin.x[None], model.biased(u, begin.w)[None], d[None])[0] + model.offsets + begin.b
    switched = [at for at, name in enumerate(plant.inputs) if name in plant.model.switches]
    floor = window.floor + (settings.switching if np.ptp(u[:, switched], axis=0).any() else 0.0)
    readings = np.array([m.y for m in recent])
    ends = np.array([path[min(m.step - begin.step, len(path) - 1)] for m in recent])
    found = []
    for k in np.flatnonzero(known & np.isfinite(readings).all(axis=0)):
        measured, expected = float(readings[:, k].mean()), float(ends[:, k].mean())
        start = float(path[0, k])
        swing = max(float(np.ptp(path[:, k])), abs(measured - start))
        allowed = floor + settings.share * swing
        change = expected - start, measured - start
        found.append(Residual("window", plant.outputs[k], window.length, *change, allowed))
    return found


class ModelMonitor:
    """Follow a rig with its plant; pure: times are passed in.

    ``compared_from`` is when windows may begin [s]; ``compared_now`` says whether the last reading completed
    a native step of the model, so that there was something to compare; ``evidence`` is of the longest windows
    since the start, where the drift is learnt.
    """

    def __init__(
        self, plant: Plant, settings: ModelSettings | None = None, drift: PlantDrift | None = None
    ) -> None:
        self.plant = plant
        self.settings = ModelSettings() if settings is None else settings
        self._model = RigModel(plant)
        self.drives = self._model.drives
        self.drift: PlantDrift | None = None
        self.evidence: list[Evidence] = []
        self._weighed = float("-inf")
        if drift is None and self.settings.drift > 0:
            drift = PlantDrift.unknown(plant, self.settings.drift)
        if drift is not None:
            self.adopt(drift)
        keep = int(np.ceil(max(self.settings.windows) / plant.dt)) + 8
        self._filter = RigFilter(self._model, self.settings, keep)

    def adopt(self, drift: PlantDrift) -> None:
        """Use what is known of the rig's parameters from now on, and forget the evidence."""
        self.drift, self.evidence = drift, []
        self._model.p = drift.parameters(self.plant)

    def reset(self, time: float, values: Mapping[str, float]) -> None:
        """Start at rest at these readings."""
        y = _in_order(self.plant.outputs, values)
        self._filter.reset(time, y, _in_order(self.plant.disturbances, values))
        self.compared_from = time + (0.0 if self._filter.at_rest else self.settings.warm_up)
        seconds = max(self.settings.windows) + 4 * self.settings.smooth + 5
        self._past = History(self._filter.steps, seconds)
        self._past.add(self._filter.moment(time, y))
        self._masked: frozenset[str] = frozenset()
        self._since = np.full(len(self.plant.outputs), self.compared_from)
        self._time, self._compared, self.compared_now = time, 0, False
        self._weighed = float("-inf")

    def follow(
        self,
        time: float,
        drive: Mapping[str, float],
        pump: int,
        values: Mapping[str, float],
        masked: frozenset[str] = frozenset(),
    ) -> list[Residual]:
        """Predict under what was applied since the last call, update with readings, return the alarms."""
        self.predict(time, drive, pump, values)
        return self.update(time, values, masked)

    def predict(
        self, time: float, drive: Mapping[str, float], pump: int, values: Mapping[str, float]
    ) -> None:
        """Predict the estimate at a time under what was applied since the last call."""
        u = np.array([float(pump) if n == "pump" else float(drive[n]) for n in self.plant.inputs])
        self._filter.predict(time, u, _in_order(self.plant.disturbances, values))
        self._time = time

    def expected(self) -> dict[str, float]:
        """Return the readings that are expected now, by output."""
        return dict(zip(self.plant.outputs, self._filter.expected.tolist()))

    def spread(self) -> dict[str, float]:
        """Return the standard deviations of the innovations now, by output [K]."""
        return dict(zip(self.plant.outputs, self._filter.spread().tolist()))

    def is_jump(self, name: str, value: float) -> bool:
        """Say whether the innovation of a reading [degC] is too large."""
        if name not in self.plant.outputs:
            return False
        at = self.plant.outputs.index(name)
        return bool(self._since[at] <= self._time) and self._filter.is_jump(at, value)

    def update(
        self, time: float, values: Mapping[str, float], masked: frozenset[str] = frozenset()
    ) -> list[Residual]:
        """Correct the estimate with readings and return the alarms; ``masked`` outputs touch an object."""
        self._mask(time, masked)
        y = _in_order(self.plant.outputs, values)
        y[[name in masked for name in self.plant.outputs]] = np.nan
        self._filter.correct(y)
        self._past.add(self._filter.moment(time, y))
        done = self._filter.steps.done
        self.compared_now = done != self._compared
        if not self.compared_now:
            return []
        self._compared = done
        compared = self.compare()
        self._weigh(time, compared)
        found = [self._with_drift(one) for one in compared if one.off > one.allowed]
        return [one for one in found if one.off > one.allowed] + self._biases(time, compared)

    def compare(self) -> list[Residual]:
        """Return every window and output that can be compared now, whether within what is allowed or not."""
        return _compare_windows(self._model, self._past, self.settings, self._since)

    def explain(self, alarm: Residual) -> list[Cause]:
        """Return what explains the readings of an alarm's window best; nothing where nothing does."""
        return explain_window(self._model, self._past, alarm.window) if alarm.kind == "window" else []

    def past_optimum(self, seconds: float = 120.0) -> str:
        """Return the drive with which more cooling would cool less, "" where there is none.

        A Peltier element pumps heat in proportion to its current and makes heat with its square.  Beyond the
        optimum a controller that wants it colder drives harder and gets it warmer: a runaway with the wrong
        sign in it.  Asked of the model: from now on, does a tenth less drive end colder?
        """
        model, now = self._model, self._filter
        n = max(1, round(seconds / self.plant.dt))
        for j, at in enumerate(model.drive_at):
            if now.u[at] >= -0.3 * model.half[j] or model.ranges[j, 0] >= 0:
                continue
            u = np.repeat(now.driven(now.u)[None, None], 2, axis=0).repeat(n, axis=1)
            u[1, :, at] += 0.1 * model.half[j]
            d = np.repeat(np.repeat(now.d[None, None], 2, axis=0), n, axis=1)
            end = model.run(np.repeat(now.x[None], 2, axis=0), u, d)[:, -1]
            if np.isfinite(end).all() and float((end[1] - end[0]).min()) < -0.02:
                return self.drives[j]
        return ""

    def _mask(self, time: float, masked: frozenset[str]) -> None:
        """Where an output is unmasked, its states are less certain, and its windows start afresh."""
        if not (self._masked - masked).isdisjoint(self.plant.outputs):
            self._filter.loosen()  # once, also where two sensors of one skin are unmasked together
        for k, name in enumerate(self.plant.outputs):
            if name in masked:
                self._since[k] = np.inf
            elif name in self._masked:
                self._since[k] = max(time, self.compared_from)
        self._masked = masked

    def _slopes(self, window: float) -> tuple[Array, Array] | None:
        if self.drift is None:
            return None
        steps = self.drift.steps(self.plant)
        return _window_slopes(self._model, self._past, self.settings.smooth, window, steps)

    def _with_drift(self, one: Residual) -> Residual:
        """Return a residual with the uncertainty of the plant's parameters.

        A drive's bias that was such a parameter is wrong once the rig does something else: the path without
        it counts where that is nearer, and no further away than the parameters explain.
        """
        found = self._slopes(one.window)
        if found is None or self.drift is None:
            return one
        k = self.plant.outputs.index(one.subject)
        more, unbiased = float(self.drift.spread(found[1])[k]), float(found[0][k])
        may = [one.expected] + [unbiased] * (abs(unbiased - one.expected) <= more)
        near = min(may, key=lambda change: abs(one.measured - change))
        return replace(one, expected=near, allowed=one.allowed + min(more, one.allowed))

    def _weigh(self, time: float, compared: list[Residual]) -> None:
        """Keep the evidence of the longest windows, one after another."""
        longest = max(self.settings.windows)
        of_all = [one for one in compared if one.window == longest]
        if not of_all or self.drift is None or not self.drift.learns or time - self._weighed < longest:
            return
        found = self._slopes(longest)
        if found is None:
            return
        self._weighed = time
        for one in of_all:
            k = self.plant.outputs.index(one.subject)
            rest = one.measured - float(found[0][k])
            self.evidence.append(Evidence(rest, found[1][k], one.allowed / 3))

    def _drifted(self, compared: list[Residual]) -> bool:
        """Say whether the effect of the drives' biases in a longest window may be the plant's parameters."""
        longest = max(self.settings.windows)
        of_all = [one for one in compared if one.window == longest]
        found = self._slopes(longest)
        if not of_all or found is None or self.drift is None:
            return False
        at = [self.plant.outputs.index(one.subject) for one in of_all]
        does = np.abs(np.array([one.expected for one in of_all]) - found[0][at])
        may = np.minimum(self.drift.spread(found[1])[at], [one.allowed for one in of_all])
        return bool((does <= may).all())

    def _biases(self, time: float, compared: list[Residual]) -> list[Residual]:
        if time < self.compared_from + _BIAS_AFTER_S:
            return []
        s, found = self.settings, []
        for k in self._filter.biased:
            bias = float(self._filter.b[k])
            if abs(bias) > s.bias_limit and self._since[k] < time:
                found.append(Residual("bias", self.plant.outputs[k], 0.0, 0.0, bias, s.bias_limit))
        for name, bias in zip(self.drives, self._filter.w.tolist()):
            if abs(bias) > s.drive_limit and not self._drifted(compared):
                found.append(Residual("bias", name, 0.0, 0.0, bias, s.drive_limit))
        return found


def _in_order(names: tuple[str, ...], values: Mapping[str, float]) -> Array:
    """Return values (n,) by name, NaN where there is none."""
    return np.array([values.get(name, np.nan) for name in names], dtype=float)
