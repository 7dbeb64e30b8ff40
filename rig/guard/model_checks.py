r"""Does the rig follow its identified model?

A filter follows the rig (:mod:`~thermogrip.rig.guard.kalman_filter`), and three tests are made.

*One step.*  An innovation that is too large is no temperature of this rig: the reading is suspect.

*A window.*  The state of H seconds ago is simulated under the drives that were applied since, without looking
at a reading, and the mean of the last ``smooth`` seconds of readings is compared with where it ends.  The
residual r may be

    |r| <= floor(H) + share * swing,

swing the largest change that either path makes in the window: a model is wrong by a share of what it
predicts, and by a floor when it predicts nothing.  A pump that was switched meanwhile is another plant, and
the floor is larger by ``switching``.  The cause of a larger residual is sought as below.

*A bias.*  A sensor that drifts slowly, or a driver that weakens, is followed by the filter's biases b and w.
b may not exceed ``bias_limit``, and w, of standard deviation sd in the filter, not

    sqrt((drive_limit e / s)^2 + (5 sd)^2),

e being what the largest drive of the longest window does in such a window, and s its slope: e / s is that
drive, but more of it where more drive barely does more, near a Peltier element's optimum.  From run to run
the effect of inputs differs by 5 % of itself (:data:`~thermogrip.sysid.plant.fit_record.RUN_GAIN_SD`), so
``drive_limit`` is three of that.

**A rig that has drifted** a little from its plant (its water, its paste) needs a larger ``share`` and
``drive_limit``: docs/howto/rig.md.

**Which fault explains a window** whose residual is too large?  The window is simulated again under each fault
that may have happened in it, from several onsets on.  With e = reading less path, summed over the readings of
the window and the outputs,

    cost = rarity * sum e^2,

rarity more than 1 for what is rare (nobody rewires a rig that runs).  A sensor that is wrong alone leaves the
other outputs on the model's path.  The cheapest is the explanation if its cost is a small part of that
without any fault, and the next best is named as well where the readings cannot distinguish the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.limits import keyed
from thermogrip.rig.guard.kalman_filter import Estimate, FilterSettings, History, RigFilter, RigModel
from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class Cause:
    """What may have happened: kind and subject of the trip, in words, and how much rarer than others."""

    kind: str
    subject: str
    text: str
    rarity: float = 1.0


_NO_FAULT = Cause("model", "", "")
_DRIVER, _MODULE = "the driver", "the module"
_NOTHING = Cause("driver", _DRIVER, "the driver gives nothing")
_FULL_DRIVE = Cause("driver", _DRIVER, "the driver is stuck at full drive", 1.2)
_FULL_COOLING = Cause("driver", _DRIVER, "the driver is stuck at full cooling", 1.2)
_REVERSED = Cause("reversed", _MODULE, "the module is wired the wrong way round", 2.0)  # nobody rewires a rig
_HALF = Cause("driver", _DRIVER, "the driver gives half of the command")
_PUMP = Cause("pump", "the pump", "the pump has stopped")
_DANGER = ("driver", "reversed", "pump", "drift", "model")  # the most dangerous first: it does not obey


@dataclass(frozen=True)
class ExplainSettings:
    """Numbers of the search for a cause."""

    onsets: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 0.85, 0.9, 0.95)  # shares of a window
    wrong_cost: float = 0.15  # of its own errors, for a sensor that may read anything
    explains: float = 0.35  # of the unexplained cost, that an explanation must stay below
    alike: float = 2.5  # times the best cost, below which the next best is as good


_EXPLAIN = ExplainSettings()


def explain_window(model: RigModel, past: History, seconds: float) -> list[Cause]:
    """Return what explains the readings of the last seconds best: one cause, two that are alike, or none."""
    begin = past.begin(past.now - seconds)
    if begin is None:
        return []
    applied, rows = past.steps.rows(begin.step)
    causes, u = _hypotheses(model, applied, begin.w)
    d = np.repeat(rows[None], len(causes), axis=0)
    y = model.run(np.repeat(begin.x[None], len(causes), axis=0), u, d) + model.offsets + begin.b
    errors = past.errors(begin, y)
    cost = np.nansum(errors**2, axis=(1, 2))
    best: dict[Cause, float] = {}
    for cause, c in zip(causes[1:], cost[1:]):
        best[cause] = min(cause.rarity * float(c), best.get(cause, np.inf))
    best |= _sensor_costs(model, past, begin, y[0])
    ranked = sorted(best, key=lambda cause: (best[cause], cause.text))
    if not ranked or best[ranked[0]] >= _EXPLAIN.explains * float(cost[0]):
        return []
    return ranked[:1] + [cause for cause in ranked[1:2] if best[cause] < _EXPLAIN.alike * best[ranked[0]]]


def by_danger(causes: Sequence[Cause], output: str) -> list[tuple[str, str]]:
    """Return kind and subject of each cause, the most dangerous first; without one the output's model."""
    kinds = dict.fromkeys((cause.kind, cause.subject) for cause in causes) or [("model", output)]
    return sorted(kinds, key=lambda pair: _DANGER.index(pair[0]))


def _hypotheses(model: RigModel, u: Array, w: Array) -> tuple[list[Cause], Array]:
    """Return causes (no fault first) and inputs (B, N, n_u) of what was applied (N, n_u) with biases w of the
    drives, which hold until the onset, and not for what a broken driver gives."""
    causes, rows = [_NO_FAULT], [model.biased(u, w)]
    for onset in _EXPLAIN.onsets:
        since = int(onset * len(u))
        for cause, wrong in _wrong_drives(model, u[since:]) + _wrong_pump(model, u[since:]):
            causes.append(cause)
            rows.append(np.concatenate([rows[0][:since], wrong]))
    return causes, np.array(rows)


def _wrong_drives(model: RigModel, u: Array) -> list[tuple[Cause, Array]]:
    out = []
    for input_index, half, (low, high) in zip(model.drive_at, model.half, model.ranges):
        faults = [(_NOTHING, np.clip(0.0, low, high)), (_FULL_DRIVE, high), (_HALF, 0.5 * u[:, input_index])]
        if low < 0:
            faults += [(_FULL_COOLING, low), (_REVERSED, np.clip(-u[:, input_index], low, high))]
        for cause, values in faults:
            changed = u.copy()
            changed[:, input_index] = values
            if np.max(np.abs(changed[:, input_index] - u[:, input_index]), initial=0.0) > 0.1 * half:
                out.append((cause, changed))
    return out


def _wrong_pump(model: RigModel, u: Array) -> list[tuple[Cause, Array]]:
    if "pump" not in model.plant.inputs:
        return []
    pump_index = model.plant.inputs.index("pump")
    if not u[:, pump_index].max(initial=0.0) > 0.5:
        return []
    still = u.copy()
    still[:, pump_index] = 0.0
    return [(_PUMP, still)]


def _sensor_costs(model: RigModel, past: History, begin: Estimate, path: Array) -> dict[Cause, float]:
    """Return the cost where one sensor alone is wrong, given the model's path (N + 1, n_y)."""
    own_costs = np.nansum(past.errors(begin, path[None])[0] ** 2, axis=0)
    costs = {}
    for k, name in enumerate(model.plant.outputs):
        others = float(own_costs.sum() - own_costs[k])
        if len(own_costs) > 1:
            wrong = _EXPLAIN.wrong_cost * float(own_costs[k])
            costs[Cause("drift", name, f"{name} alone is wrong")] = others + wrong
    return costs


@dataclass(frozen=True)
class ModelSettings(FilterSettings):
    """How far the rig may be from its model; measured in docs/reference/faults.md."""

    windows: tuple[float, ...] = keyed((10.0, 30.0, 90.0), "windows_s", 2, 600)  # lengths H [s], rising
    # of each, where the model predicts no change [K]
    floors: tuple[float, ...] = keyed((0.55, 0.35, 0.45), "floors_K", 0.05, 20)
    share: float = keyed(0.25, "share", 0, 2)  # allowed part of the change in the window
    switching: float = keyed(0.5, "switching_K", 0, 20)  # besides, where the pump was switched in it [K]
    smooth: float = keyed(3.0, "smooth_s", 0, 60)  # readings of so long are averaged [s]
    bias_limit: float = keyed(2.0, "bias_limit_K", 0.1, 20)  # of an output [K]
    # of a drive's bias, a share of what was asked for lately: three of the 5 % from run to run
    drive_limit: float = keyed(0.15, "drive_limit", 0.01, 0.45)
    warm_up: float = keyed(60.0, "warm_up_s", 0, 3600)  # nothing is compared where it starts not at rest [s]
    compared_every_s: float = 1.0  # a tenth of the shortest window; it costs half of a look
    bias_after_s: float = 60.0  # a bias is not evaluated before the filter has seen something


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
        """The multiple of what is allowed."""
        return self.off / self.allowed

    @property
    def off(self) -> float:
        """How far measured is from expected."""
        return abs(self.measured - self.expected)


class ModelMonitor:
    """Follow a rig with its plant; pure: times are passed in.

    ``compared_from`` is when windows may begin [s]; ``compared_now`` says whether the last reading was
    compared: it completed a native step of the model, and a second had passed since the last one that was.
    """

    def __init__(self, plant: Plant, settings: ModelSettings | None = None) -> None:
        self.plant = plant
        self.settings = ModelSettings() if settings is None else settings
        self._model = RigModel(plant)
        self.drives = self._model.drives
        keep = int(np.ceil(max(self.settings.windows) / plant.dt)) + 8
        self._filter, self._seconds = RigFilter(self._model, self.settings, keep), keep * plant.dt

    def reset(self, time: float, values: Mapping[str, float]) -> None:
        """Start at rest at these readings."""
        y = _values_of(self.plant.outputs, values)
        self._filter.reset(time, y, _values_of(self.plant.disturbances, values))
        self.compared_from = time + (0.0 if self._filter.at_rest else self.settings.warm_up)
        self._past = History(self._filter.steps, self._seconds)
        self._past.add(self._filter.moment(time, y))
        self._masked: frozenset[str] = frozenset()
        self._since = np.full(len(self.plant.outputs), self.compared_from)
        self._time = time
        self._compared = 0
        self.compared_now = False
        self.share = 0.0
        self._compared_at = float("-inf")

    def predict(
        self, time: float, drive: Mapping[str, float], pump: int, values: Mapping[str, float]
    ) -> None:
        """Predict the estimate at a time under what was applied since the last call."""
        u = np.array([float(pump) if n == "pump" else float(drive[n]) for n in self.plant.inputs])
        self._filter.predict(time, u, _values_of(self.plant.disturbances, values))
        self._time = time

    def is_jump(self, name: str, value: float) -> bool:
        """Say whether the innovation of a reading [degC] is too large."""
        if name not in self.plant.outputs:
            return False
        output_index = self.plant.outputs.index(name)
        return bool(self._since[output_index] <= self._time) and self._filter.is_jump(output_index, value)

    def update(
        self, time: float, values: Mapping[str, float], masked: frozenset[str] = frozenset()
    ) -> list[Residual]:
        """Correct the estimate with readings and return the alarms; ``masked`` outputs touch an object."""
        self._mask(time, masked)
        y = _values_of(self.plant.outputs, values)
        y[[name in masked for name in self.plant.outputs]] = np.nan
        self._filter.correct(y)
        self._past.add(self._filter.moment(time, y))
        done = self._filter.steps.done
        self.compared_now = (
            done != self._compared and time >= self._compared_at + self.settings.compared_every_s - 1e-6
        )
        if not self.compared_now:
            return []
        self._compared, self._compared_at = done, time
        compared = self.compare()
        self.share = max((one.excess for one in compared), default=0.0)
        return [one for one in compared if one.off > one.allowed] + self._biases(time)

    def compare(self) -> list[Residual]:
        """Return every window and output that can be compared now, whether within what is allowed or not."""
        model = self._model
        past = self._past
        s = self.settings
        plant = self.plant
        switches = [index for index, name in enumerate(plant.inputs) if name in plant.model.switches]
        residuals = []
        for length, floor in zip(s.windows, s.floors):
            begin = past.begin(past.now - length)
            if begin is None or begin.step >= past.steps.done:
                continue
            recent = [one for one in past.after(past.now - s.smooth) if one.time > begin.time]
            u, d = past.steps.rows(begin.step)
            path = model.run(begin.x[None], model.biased(u, begin.w)[None], d[None])[0]
            path = path + model.offsets + begin.b
            least = floor + (s.switching if np.ptp(u[:, switches], axis=0).any() else 0.0)
            readings = np.array([m.y for m in recent])
            ends = path[[m.step - begin.step for m in recent]]
            for k in np.flatnonzero((self._since <= begin.time) & np.isfinite(readings).all(axis=0)):
                start, measured = float(path[0, k]), float(readings[:, k].mean())
                swing = max(float(np.ptp(path[:, k])), abs(measured - start))
                change = float(ends[:, k].mean()) - start, measured - start
                residuals.append(
                    Residual("window", plant.outputs[k], length, *change, least + s.share * swing)
                )
        return residuals

    def explain(self, alarm: Residual) -> list[Cause]:
        """Return what explains the readings of an alarm's window best; nothing where nothing does."""
        return explain_window(self._model, self._past, alarm.window) if alarm.kind == "window" else []

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

    def _biases(self, time: float) -> list[Residual]:
        if time < self.compared_from + self.settings.bias_after_s:
            return []
        s, residuals = self.settings, []
        for k in self._filter.biased:
            bias = float(self._filter.b[k])
            if abs(bias) > s.bias_limit and self._since[k] < time:
                residuals.append(Residual("bias", self.plant.outputs[k], 0.0, 0.0, bias, s.bias_limit))
        for j, (bias, sd) in enumerate(zip(self._filter.w.tolist(), self._filter.bias_spread().tolist())):
            if abs(bias) <= 5 * sd:  # five: of 5,700 estimates without a fault the largest was 3.1
                continue
            limit = float(np.hypot(s.drive_limit * self._largest_drive(j), 5 * sd))
            if abs(bias) > limit:
                residuals.append(Residual("bias", self.drives[j], 0.0, 0.0, bias, limit))
        return residuals

    def _largest_drive(self, j: int) -> float:
        """Return the largest drive of the longest window by its effect over its slope, a fraction of half its
        range; infinite where the slope is 0."""
        model = self._model
        now = self._filter
        steps = self._past.steps
        input_index = self._model.drive_at[j]
        applied = steps.rows(steps.first)[0]
        largest, less = applied[np.abs(applied[:, input_index]).argmax(), input_index], 0.01 * model.half[j]
        u = np.repeat(np.repeat(now.u[None, None], 3, axis=0), len(applied), axis=1)
        u[:, :, input_index] = np.array([0.0, largest - np.copysign(less, largest), largest])[:, None]
        d = np.repeat(np.repeat(now.d[None, None], 3, axis=0), len(applied), axis=1)
        without, slightly_less, end = model.run(np.repeat(now.x[None], 3, axis=0), u, d)[:, -1]
        effect, slope = np.abs(end - without), np.abs(end - slightly_less) / 0.01
        k = int(effect.argmax())
        return float(effect[k] / slope[k]) if slope[k] > 0 else np.inf


def _values_of(names: tuple[str, ...], values: Mapping[str, float]) -> Array:
    """Return values (n,) by name, NaN where there is none."""
    return np.array([values.get(name, np.nan) for name in names], dtype=float)
