r"""How soon the drive alone could do it: a time before which no controller settles.

To settle in the band is to have arrived in it.  The earliest arrival is the least T for which

    max over u of  s y(T)  >=  s r - band,     s = sign(r - y(0)),

with u inside its range, its slew limit kept, from the drive that holds the start on, and changed at the
controller's samples only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.plant.prediction import held_start, prediction_model

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_DRIVE_LEVELS = np.linspace(0.4, 1.0, 13)
_CLIMBS = 12
_SHARES = 0.5 ** np.arange(6)  # of the way to a better plan


def full_drive_bound(plant: Plant, design: Design, step: tuple[float, float], spec: Spec) -> float:
    """Return the shortest time [s] in which a step (start, target) [degC] can settle, whatever the
    controller; inf where it cannot within ``hold_s``."""
    # each output is asked alone, with all drives at its service: together they cannot be sooner
    return max(_Race(plant, design, step, spec, name).shortest_time() for name in design.controlled)


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
        self.goal = self.side * (step[1] - offset) - spec.band_degC
        self.d = model.undisturbed(spec.ambient_degC)
        self.x, holding_drive = held_start(model, tuple(design.controlled), step[0], tuple(self.d.tolist()))
        self.low, self.high = np.array([design.drive_range[name] for name in model.drives]).T
        self.slew = np.array([design.slew_per_s[name] for name in model.drives]) * design.dt
        self.samples_across = np.ceil((self.high - self.low) / self.slew).astype(int)
        self.neutral = np.clip(np.zeros(model.n_u), self.low, self.high)
        # the drive before the step, from which the slew counts
        self.begun = self.neutral if holding_drive is None else np.clip(holding_drive, self.low, self.high)
        self.n = max(2, round(spec.hold_s / design.dt))
        self.sub = max(1, round(design.dt / model.dt))

    def shortest_time(self) -> float:
        """Return the least time of arrival [s], inf where there is none."""
        # the end of each drive (n_u,) that helps: by its gain over the whole time, at rest
        _, G = self.coarse.trajectory(self.x, self.neutral[None], self.d, [self.n])
        direction = np.where(self.side * G[-1, self.row, 0] >= 0, self.high, self.low)
        # For a plant that answers to every earlier move in one direction, g_k = s dy(T)/du_k >= 0 for all k,
        # the best is as much as there is, all the time: the first plan, which no climb betters.
        levels = np.clip(_DRIVE_LEVELS[:, None] * direction, self.low, self.high)
        plans = self._headed_for(np.repeat(levels[:, None], self.n, axis=1))
        heights = self._heights(plans)
        best = int(np.lexsort((-heights.max(axis=1), self._arrivals(heights)))[0])
        # Elsewhere (a Peltier element past its optimum, an output that first goes the wrong way) y(T) climbs
        # towards the plan that heads for the better end of each drive, by g, by the share of the way that is
        # best (Frank and Wolfe). For a linear plant whose g has one sign the bound is the true one.
        for _ in range(_CLIMBS):
            plan, height = plans[best], heights[best]
            arrival = float(self._arrivals(height[None])[0])
            last = int(min(arrival, len(height) - 1))
            plans = plan + _SHARES[:, None, None] * (self._headed_for(self._better_ends(plan, last)) - plan)
            heights = self._heights(plans)
            best = int(np.argmax(heights[:, last]))
            if heights[best, last] <= height[last] + 1e-9:
                break
        return arrival * self.model.dt

    def _better_ends(self, plan: Array, last: int) -> Array:
        """Return the end of each drive (1, n, n_u) that raises the height at native sample ``last``."""
        used = max(1, min(self.n, -(-last // self.sub)))
        _, G = self.coarse.trajectory(self.x, plan[:used], self.d, [1] * used)
        # a drive that turns takes some samples to its other end: it turns best where what all of these do to
        # the height together changes sign
        sums = self.side * np.cumsum(np.pad(G[-1, self.row], ((1, 0), (0, 0))), axis=0)
        turned = np.minimum(np.arange(used)[:, None] + self.samples_across, used)
        gain = np.take_along_axis(sums, turned, axis=0) - sums[:-1]
        ends = np.where(gain >= 0, self.high, self.low)
        whole: Array = np.concatenate([ends, np.repeat(ends[-1:], self.n - used, axis=0)])
        return whole[None]

    def _headed_for(self, ends: Array) -> Array:
        """Return plans (plans, n, n_u) that go where ``ends`` are as fast as the slew allows."""
        plans, drive = np.empty_like(ends), self.begun
        for k in range(self.n):
            drive = drive + np.clip(ends[:, k] - drive, -self.slew, self.slew)
            plans[:, k] = drive
        return plans

    def _heights(self, plans: Array) -> Array:
        """Return s y (plans, native samples) from the start on."""
        fine = np.repeat(plans, self.sub, axis=1)
        y, _ = self.model.run(np.repeat(self.x[None], len(plans), axis=0), fine, self.d)
        return np.asarray(self.side * y[:, :, self.row])

    def _arrivals(self, heights: Array) -> Array:
        """Return the native sample at which each reaches the goal, inf where it does not."""
        reached = heights >= self.goal
        return np.where(reached.any(axis=1), np.argmax(reached, axis=1).astype(float), np.inf)
