r"""How soon the drive alone could do it: a time before which no controller settles.

To settle in the band is to have arrived in it.  The earliest arrival is the least T for which

    max over u of  s y(T)  >=  s r - band,     s = sign(r - y(0)),

with u inside its range, its slew limit kept, from no drive on, and changed at the controller's samples only.
For a plant that answers to every earlier move in one direction, g_k = s dy(T)/du_k >= 0 for all k, the best u
is as much as there is, all the time, reached as fast as the slew allows.  That is tried first, and where the
gradient along it (:meth:`PredictionModel.trajectory`) has no other sign, it is the answer: for a linear plant
the true bound, since y(T) is linear in u.

Elsewhere (a Peltier element past its optimum, an output that first goes the wrong way) y(T) is climbed by
linear programmes, max g u within the limits and a trust region about the last u, from the best constant level
on.  For a linear plant the first programme is exact; for another the answer is the best that was found.

Of several regulated outputs each is asked alone, with all drives at its service, and the latest counts:
together they cannot be sooner.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import diags_array, kron, vstack

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.plant.prediction import held_start, prediction_model

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_DRIVE_LEVELS = np.linspace(0.4, 1.0, 13)
_CLIMBS = 12


def full_drive_bound(
    plant: Plant, design: Design, step: tuple[float, float], spec: Spec, output: str = ""
) -> float:
    """Return the shortest time [s] in which a step (start, target) [degC] can settle, of all controlled
    outputs or of one, whatever the controller; NaN where it cannot within ``hold_s``."""
    outputs = (output,) if output else design.controlled
    return max(_Race(plant, design, step, spec, name).shortest_time() for name in outputs)


class _Race:
    """One output on its way into the band."""

    def __init__(
        self, plant: Plant, design: Design, step: tuple[float, float], spec: Spec, output: str
    ) -> None:
        self.model = prediction_model(plant, plant.dt)
        self.coarse = prediction_model(plant, design.dt)
        model = self.model
        self.row, self.side = model.outputs.index(output), float(np.sign(step[1] - step[0]))
        # what the sensors would read, so that all chase the same temperature
        offset = plant.offsets.get(output, 0.0) + spec.sensor_offset_degC
        self.goal = self.side * (step[1] - offset) - spec.asked(output).band_degC
        self.d = model.undisturbed(spec.ambient_degC)
        self.x, holding_drive = held_start(model, tuple(design.controlled), step[0], tuple(self.d.tolist()))
        self.low, self.high = np.array([design.drive_range[name] for name in model.drives]).T
        self.slew = np.array([design.slew_per_s[name] for name in model.drives]) * design.dt
        self.neutral = np.clip(np.zeros(model.n_u), self.low, self.high)
        # the drive before the step, from which the slew counts
        self.begun = self.neutral if holding_drive is None else np.clip(holding_drive, self.low, self.high)
        self.n = max(2, round(spec.hold_s / design.dt))
        self.sub = max(1, round(design.dt / model.dt))

    def shortest_time(self) -> float:
        """Return the least time of arrival [s], inf where there is none."""
        direction = self._direction()
        plans = np.stack([self._ramp(share * direction) for share in _DRIVE_LEVELS])
        heights = self._heights(plans)
        best = int(np.lexsort((-heights.max(axis=1), self._arrivals(heights)))[0])
        plan, arrival = plans[best], self._arrivals(heights)[best]
        last = int(min(arrival, heights.shape[1] - 1))
        gradient = self._gradient(plan, last)
        if best == len(_DRIVE_LEVELS) - 1 and np.all(gradient * direction >= -1e-9 * np.abs(gradient).max()):
            return self._seconds(arrival)
        return self._seconds(self._climb(plan, last))

    def _climb(self, plan: Array, last: int) -> float:
        """Return the sample of arrival after climbing the height at ``last``, step by step earlier."""
        trust = float("inf")
        heights = self._heights(plan[None])
        for _ in range(_CLIMBS):
            used = -(-last // self.sub)
            best = self._programme(self._gradient(plan, last), plan, used, trust)
            tried = self._heights(best[None])
            if tried[0, last] > heights[0, last] + 1e-9:
                plan, heights = best, tried
                last = int(min(self._arrivals(heights)[0], last))
            elif np.isinf(trust):
                trust = 0.25
            else:
                trust /= 2
        return float(self._arrivals(heights)[0])

    def _programme(self, gradient: Array, plan: Array, used: int, trust: float) -> Array:
        """Return the plan that the linear programme finds best, within the limits and about ``plan``."""
        n_u = plan.shape[1]
        change = diags_array([1.0, -1.0], offsets=[0, -1], shape=(used, used))
        rows: Any = kron(change, np.eye(n_u)).tocsr()
        slews = np.tile(self.slew, used)
        start = np.zeros(used * n_u)
        start[:n_u] = self.begun
        room = trust * (self.high - self.low) if np.isfinite(trust) else self.high - self.low
        low = np.maximum(self.low, plan[:used] - room).ravel()
        high = np.minimum(self.high, plan[:used] + room).ravel()
        optimum = linprog(
            -gradient[:used].ravel(),
            A_ub=vstack([rows, -rows]),
            b_ub=np.concatenate([slews + start, slews - start]),
            bounds=list(zip(low.tolist(), high.tolist(), strict=True)),
            method="highs",
        )
        best = plan.copy()
        if optimum.status == 0 and optimum.x is not None:
            best[:used] = optimum.x.reshape(used, n_u)
            best[used:] = best[used - 1]
        return best

    def _direction(self) -> Array:
        """Return the end of each drive (n_u,) that helps: by its gain over the whole time, at rest."""
        blocks = [self.n]
        _, G = self.coarse.trajectory(self.x, self.neutral[None], self.d, blocks)
        gain = self.side * G[-1, self.row, 0]
        return np.where(gain >= 0, self.high, self.low)

    def _gradient(self, plan: Array, last: int) -> Array:
        """Return s dy/du (n, n_u) of the height at native sample ``last``."""
        used = max(1, min(self.n, -(-last // self.sub)))
        _, G = self.coarse.trajectory(self.x, plan[:used], self.d, [1] * used)
        gradient = np.zeros_like(plan)
        gradient[:used] = self.side * G[-1, self.row]
        return gradient

    def _ramp(self, level: Array) -> Array:
        """Return the plan (n, n_u) that goes to a level as fast as the slew allows."""
        k = np.arange(1, self.n + 1)[:, None]
        away = level - self.begun
        return np.asarray(self.begun + np.sign(away) * np.minimum(np.abs(away), k * self.slew))

    def _heights(self, plans: Array) -> Array:
        """Return s y (plans, native samples) from the start on."""
        fine = np.repeat(plans, self.sub, axis=1)
        y, _ = self.model.run(np.repeat(self.x[None], len(plans), axis=0), fine, self.d)
        return np.asarray(self.side * y[:, :, self.row])

    def _arrivals(self, heights: Array) -> Array:
        """Return the native sample at which each reaches the goal, inf where it does not."""
        reached = heights >= self.goal
        return np.where(reached.any(axis=1), np.argmax(reached, axis=1).astype(float), np.inf)

    def _seconds(self, sample: float) -> float:
        return float(sample * self.model.dt)
