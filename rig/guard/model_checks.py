r"""Does the rig follow its identified model?

A filter follows the rig (:mod:`~thermogrip.rig.guard.kalman_filter`), and three things are tested: an
innovation that is too large for this rig (the reading is suspect), the change over windows, and the filter's
biases, which follow a sensor that drifts slowly or a driver that weakens.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.rig.guard.kalman_filter import RigFilter
from thermogrip.rig.guard.settings import ModelSettings
from thermogrip.sysid.plant.plant import Plant


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
    """Follow a rig with its plant; pure: times are passed in."""

    def __init__(self, plant: Plant, settings: ModelSettings | None = None) -> None:
        self.plant = plant
        self.settings = ModelSettings() if settings is None else settings
        # a window begins at a reading, which may be some steps earlier
        keep = int(np.ceil(max(self.settings.windows_s) / plant.dt)) + 8
        self._filter = RigFilter(plant, self.settings, keep)
        self.drives = self._filter.drives

    def reset(self, time: float, values: Mapping[str, float]) -> None:
        """Start at rest at these readings."""
        y = _values_of(self.plant.outputs, values)
        self._filter.reset(time, y, _values_of(self.plant.disturbances, values))
        # when windows may begin [s]
        self.compared_from = time + (0.0 if self._filter.at_rest else self.settings.warm_up_s)
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
        # where an output is unmasked, its states are less certain, and its windows start afresh
        if not (self._masked - masked).isdisjoint(self.plant.outputs):
            self._filter.loosen()  # once, also where two sensors of one skin are unmasked together
        for k, name in enumerate(self.plant.outputs):
            if name in masked:
                self._since[k] = np.inf
            elif name in self._masked:
                self._since[k] = max(time, self.compared_from)
        self._masked = masked
        y = _values_of(self.plant.outputs, values)
        y[[name in masked for name in self.plant.outputs]] = np.nan
        self._filter.correct(time, y)
        done = self._filter.done
        # whether this reading completed a native step of the model, a second after the last one that did
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
        now = self._filter
        s = self.settings
        plant = self.plant
        # the state of a window ago is simulated under the drives since, without looking at a reading, and
        # where it ends compared with the mean of the newest readings.  A model is wrong by a share of what it
        # predicts (of the largest change that either path makes), and by a floor when it predicts nothing:
        #     |r| <= floor + share * swing
        switches = [index for index, name in enumerate(plant.inputs) if name in plant.model.switches]
        residuals = []
        for length, floor in zip(s.windows_s, s.floors_K):
            begin = now.begin(length)
            if begin is None or begin.step >= now.done:
                continue
            recent_s = max(begin.time, self._time - s.smooth_s)
            recent = [one for one in now.estimates if one.time > recent_s]
            u, d = now.applied_since(begin.step)
            path = now.path(begin, u, d)
            # a pump that was switched meanwhile is another plant
            least = floor + (s.switching_K if np.ptp(u[:, switches], axis=0).any() else 0.0)
            readings = np.array([one.y for one in recent])
            ends = path[[one.step - begin.step for one in recent]]
            for k in np.flatnonzero((self._since <= begin.time) & np.isfinite(readings).all(axis=0)):
                start, measured = float(path[0, k]), float(readings[:, k].mean())
                swing = max(float(np.ptp(path[:, k])), abs(measured - start))
                change = float(ends[:, k].mean()) - start, measured - start
                residuals.append(
                    Residual("window", plant.outputs[k], length, *change, least + s.share * swing)
                )
        return residuals

    def _biases(self, time: float) -> list[Residual]:
        if time < self.compared_from + self.settings.bias_after_s:
            return []
        s, residuals = self.settings, []
        for k in self._filter.biased:
            bias = float(self._filter.b[k])
            if abs(bias) > s.bias_limit_K and self._since[k] < time:
                residuals.append(Residual("bias", self.plant.outputs[k], 0.0, 0.0, bias, s.bias_limit_K))
        for j, (bias, sd) in enumerate(zip(self._filter.w.tolist(), self._filter.bias_spread().tolist())):
            if abs(bias) <= 5 * sd:  # five: of 5,700 estimates without a fault the largest was 3.1
                continue
            # from run to run the effect of inputs differs by 5 % of itself (plant_data.RUN_GAIN_SD)
            limit = float(np.hypot(s.drive_limit * self._largest_drive(j), 5 * sd))
            if abs(bias) > limit:
                residuals.append(Residual("bias", self.drives[j], 0.0, 0.0, bias, limit))
        return residuals

    def _largest_drive(self, j: int) -> float:
        """Return the largest drive of the longest window by its effect over its slope, a fraction of half its
        range; infinite where the slope is 0."""
        # it is that drive, but more of it where more drive barely does more, near a Peltier's optimum
        now = self._filter
        input_index = now.drive_at[j]
        applied = now.applied_since(now.done - len(now.applied))[0]
        largest, less = applied[np.abs(applied[:, input_index]).argmax(), input_index], 0.01 * now.half[j]
        u = np.repeat(np.repeat(now.u[None, None], 3, axis=0), len(applied), axis=1)
        u[:, :, input_index] = np.array([0.0, largest - np.copysign(less, largest), largest])[:, None]
        d = np.repeat(np.repeat(now.d[None, None], 3, axis=0), len(applied), axis=1)
        without, slightly_less, end = now.run(np.repeat(now.x[None], 3, axis=0), u, d)[:, -1]
        effect, slope = np.abs(end - without), np.abs(end - slightly_less) / 0.01
        k = int(effect.argmax())
        return float(effect[k] / slope[k]) if slope[k] > 0 else np.inf


def _values_of(names: tuple[str, ...], values: Mapping[str, float]) -> Array:
    """Return values (n,) by name, NaN where there is none."""
    return np.array([values.get(name, np.nan) for name in names], dtype=float)
