r"""Does the rig do what its identified model says?

A filter follows the rig (:mod:`~thermogrip.rig.guard.kalman_filter`).  Three questions are put to it.

*One step.*  Is this reading where the last ones say it must be?  One that is not is not believed.

*A window.*  Have the last seconds gone where the model goes by itself from where they began
(:mod:`~thermogrip.rig.guard.windows`)?  Where a window objects, :mod:`~thermogrip.rig.guard.fault_isolation`
says what may have gone wrong.

*A bias.*  A sensor that drifts slowly, or a driver that weakens, is followed by the filter's biases b and w.
Beyond ``bias_limit`` and ``drive_limit`` it is no plugging anew any more.

Of the model alone: would more cooling drive still cool?

Where somebody states that the rig may have drifted from its plant, a window and a bias of a drive are judged
by what the plant's parameters may be off by as well (:mod:`~thermogrip.rig.guard.plant_mismatch`), and the
longest windows of a session are evidence of what they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thermogrip.rig.guard.fault_isolation import explain_window
from thermogrip.rig.guard.history import Past
from thermogrip.rig.guard.kalman_filter import FilterSettings, RigFilter, RigModel
from thermogrip.rig.guard.plant_mismatch import Evidence, PlantDrift
from thermogrip.rig.guard.windows import Surprise, WindowSettings, compare_windows, window_slopes
from thermogrip.sysid.models.model import Array
from thermogrip.sysid.plant.plant import Plant

__all__ = ["ModelWatch", "Surprise", "WatchSettings"]

_BIAS_AFTER_S = 60.0  # a bias is not judged before the filter has seen something


@dataclass(frozen=True)
class WatchSettings(FilterSettings, WindowSettings):
    """How far the rig may be from its model; measured in docs/reference/faults.md.

    Besides those of :class:`~thermogrip.rig.guard.windows.WindowSettings` and
    :class:`~thermogrip.rig.guard.kalman_filter.FilterSettings`:

    Attributes
    ----------
    bias_limit : float
        Of an output bias [K].
    drive_limit : float
        Of a drive bias, as a fraction of its range's half.
    warm_up : float
        Where it starts away from rest nothing is known of what cannot be read (a hot heatsink), and for so
        long nothing is compared [s].
    drift : float
        Share by which each parameter of the plant may have drifted; 0 where the plant is what the rig is.
    """

    bias_limit: float = 2.0
    drive_limit: float = 0.25
    warm_up: float = 60.0
    drift: float = 0.0


class ModelWatch:
    """Follow a rig with its plant; pure: times are passed in.

    Parameters
    ----------
    plant : Plant
    settings : WatchSettings, optional
    drift : PlantDrift, optional
        What is known of how far the rig is from its plant; by default what ``settings.drift`` says.

    Attributes
    ----------
    drives : tuple of str
        The inputs that are not the pump.
    drift : PlantDrift or None
    evidence : list of Evidence
        Of the longest windows since the start, where the drift is learnt.
    compared_from : float
        When windows may begin [s].
    compared_now : bool
        Whether the last reading completed a native step of the model, so that there was something to compare.

    Examples
    --------
    A heater that is asked for full power and gives none:

    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    >>> watch = ModelWatch(Plant(block, {}, dt=1.0, units={"q": "1"}))
    >>> watch.reset(0.0, {"t": 25.0})
    >>> for k in range(1, 20):
    ...     said = watch.follow(float(k), {"q": 1.0}, 1, {"t": 25.0})
    ...     if said:
    ...         print(k, said[0].subject, round(said[0].expected, 1), said[0].measured)
    ...         print(watch.explain(said[0]))
    ...         break
    10 t 4.3 0.0
    the driver gives nothing
    """

    def __init__(
        self, plant: Plant, settings: WatchSettings | None = None, drift: PlantDrift | None = None
    ) -> None:
        self.plant = plant
        self.settings = WatchSettings() if settings is None else settings
        self._model = RigModel(plant)
        self.drives = self._model.drives
        self.drift: PlantDrift | None = None
        self.evidence: list[Evidence] = []
        self._weighed = float("-inf")
        if drift is None and self.settings.drift > 0:
            drift = PlantDrift.unknown(plant, self.settings.drift)
        if drift is not None:
            self.believe(drift)
        keep = int(np.ceil(max(self.settings.windows) / plant.dt)) + 8
        self._filter = RigFilter(self._model, self.settings, keep)

    def believe(self, drift: PlantDrift) -> None:
        """Go by the parameters that are known of the rig, and by how well they are; forget the evidence."""
        self.drift, self.evidence = drift, []
        self._model.p = drift.parameters(self.plant)

    def reset(self, time: float, values: Mapping[str, float]) -> None:
        """Start at rest at these readings."""
        y = _in_order(self.plant.outputs, values)
        self._filter.reset(time, y, _in_order(self.plant.disturbances, values))
        self.compared_from = time + (0.0 if self._filter.at_rest else self.settings.warm_up)
        seconds = max(self.settings.windows) + 4 * self.settings.smooth + 5
        self._past = Past(self._filter.steps, seconds)
        self._past.add(self._filter.moment(time, y))
        self._blind: frozenset[str] = frozenset()
        self._since = np.full(len(self.plant.outputs), self.compared_from)
        self._time, self._compared, self.compared_now = time, 0, False
        self._weighed = float("-inf")

    def follow(
        self,
        time: float,
        drive: Mapping[str, float],
        pump: int,
        values: Mapping[str, float],
        blind: frozenset[str] = frozenset(),
    ) -> list[Surprise]:
        """Take what was applied since the last call and what is read now; return what does not fit.

        Parameters
        ----------
        time : float
            Of the reading [s].
        drive, pump
            What was applied since the call before.
        values : mapping of str to float
            Readings that are believed; NaN or absent where not.
        blind : frozenset of str
            Outputs that the plant does not describe now (a skin that touches an object).
        """
        self.predict(time, drive, pump, values)
        return self.update(time, values, blind)

    def predict(
        self, time: float, drive: Mapping[str, float], pump: int, values: Mapping[str, float]
    ) -> None:
        """Carry the estimate on to a time under what was applied since the last call."""
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
        """Say whether a reading is not one of this rig, given all before it."""
        if name not in self.plant.outputs:
            return False
        at = self.plant.outputs.index(name)
        return bool(self._since[at] <= self._time) and self._filter.is_jump(at, value)

    def update(
        self, time: float, values: Mapping[str, float], blind: frozenset[str] = frozenset()
    ) -> list[Surprise]:
        """Correct the estimate with the readings and return what does not fit."""
        self._note_blind(time, blind)
        y = _in_order(self.plant.outputs, values)
        y[[name in blind for name in self.plant.outputs]] = np.nan
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

    def compare(self) -> list[Surprise]:
        """Return every window and output that can be compared now, whether within what is allowed or not."""
        return compare_windows(self._model, self._past, self.settings, self._since)

    def explain(self, surprise: Surprise) -> str:
        """Return what fits the readings of the window best, in words; "" where nothing fits better."""
        if surprise.kind != "window":
            return ""
        return explain_window(self._model, self._past, surprise.window)

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

    def _note_blind(self, time: float, blind: frozenset[str]) -> None:
        """Where an output is described again, its states are known less, and windows start afresh."""
        if not (self._blind - blind).isdisjoint(self.plant.outputs):
            self._filter.loosen()  # once, also where two sensors of one skin are described again together
        for k, name in enumerate(self.plant.outputs):
            if name in blind:
                self._since[k] = np.inf
            elif name in self._blind:
                self._since[k] = max(time, self.compared_from)
        self._blind = blind

    def _slopes(self, window: float) -> tuple[Array, Array] | None:
        if self.drift is None:
            return None
        steps = self.drift.steps(self.plant)
        return window_slopes(self._model, self._past, self.settings.smooth, window, steps)

    def _with_drift(self, one: Surprise) -> Surprise:
        """Return a surprise as it is where the plant's parameters may be off.

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

    def _weigh(self, time: float, compared: list[Surprise]) -> None:
        """Keep what a longest window says of the parameters, one after another."""
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

    def _drifted(self, compared: list[Surprise]) -> bool:
        """Say whether what the drives' biases do in a longest window may be the plant's parameters."""
        longest = max(self.settings.windows)
        of_all = [one for one in compared if one.window == longest]
        found = self._slopes(longest)
        if not of_all or found is None or self.drift is None:
            return False
        at = [self.plant.outputs.index(one.subject) for one in of_all]
        does = np.abs(np.array([one.expected for one in of_all]) - found[0][at])
        may = np.minimum(self.drift.spread(found[1])[at], [one.allowed for one in of_all])
        return bool((does <= may).all())

    def _biases(self, time: float, compared: list[Surprise]) -> list[Surprise]:
        if time < self.compared_from + _BIAS_AFTER_S:
            return []
        s, found = self.settings, []
        for k in self._filter.biased:
            bias = float(self._filter.b[k])
            if abs(bias) > s.bias_limit and self._since[k] < time:
                found.append(Surprise("bias", self.plant.outputs[k], 0.0, 0.0, bias, s.bias_limit))
        for name, bias in zip(self.drives, self._filter.w.tolist()):
            if abs(bias) > s.drive_limit and not self._drifted(compared):
                found.append(Surprise("bias", name, 0.0, 0.0, bias, s.drive_limit))
        return found


def _in_order(names: tuple[str, ...], values: Mapping[str, float]) -> Array:
    """Return values (n,) by name, NaN where there is none."""
    return np.array([values.get(name, np.nan) for name in names], dtype=float)
