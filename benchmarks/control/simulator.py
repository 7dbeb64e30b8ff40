r"""The reference problem once more, written for itself: what closes the loop is not what the controller has.

A skin behind two tubes of water, a tank with two Peltier modules, one current (``benchmarks/mpc/problem.py``
has the equations).  This simulator shares no code with the package, nor with that file: explicit steps of
10 ms, tubes as rings of such steps, and what a model does not know as numbers of :class:`Truth`: a gain, a
delay, a lag of the skin's sensor, a second layer of the skin, fouling, a dead zone of the driver, modules
that fade.  Everything is in degC, s, W, A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP = 0.01  # s
KELVIN = 273.15
OUTPUTS = ("t_heatsink", "t_tank", "t_surface")
SKIN = 2  # where the controlled output stands
_NODES = 7  # heatsink, wall, water, finger, skin, second layer, what the skin's sensor shows
_SEEBECK, _JOULE, _CONDUCT, _SINK, _WALL, _TANK, _FLOW, _FINGER, _SKIN, _TO_SKIN, _LOSS, _ROOM = range(12)
_SENSOR, _LAYER, _TO_LAYER, _OUTSIDE, _FOUL, _DEAD, _FADE, _TUBE = range(12, 20)
_SINK_OUT, _WALL_OUT, _WALL_IN = range(20, 23)


@dataclass(frozen=True)
class Truth:
    """A plant; the defaults are the reference model's numbers and nothing unknown."""

    seebeck: float = 0.050  # V/K of a module
    resistance: float = 2.0  # ohm
    conductance: float = 0.55  # W/K
    flow: float = 21.0  # W/K
    to_skin: float = 2.0  # W/K, from the finger's water
    loss: float = 0.15  # W/K, of the skin
    wall_loss: float = 0.15  # W/K, of the tank
    sink: float = 8.0  # W/K, of the heatsink to the room
    room: float = 25.0
    delay: float = 2.0  # s, of each tube
    sensor_lag: float = 0.0  # s, of the skin's sensor
    layer: float = 0.0  # J/K, of a second layer of the skin
    to_layer: float = 0.3  # W/K
    outside: bool = False  # whether sensor and loss are on the second layer
    fouling: float = 0.0  # share of ``to_skin`` that is lost in a minute
    dead_zone: float = 0.0  # A, on either side of 0, that do nothing
    fading: float = 0.0  # share of ``seebeck`` that is lost in the first ten minutes


class Plant:
    """A truth that runs: ``read`` its sensors, ``run`` it under a current."""

    def __init__(self, truth: Truth, *, start: float = 25.0) -> None:
        t = self.truth = truth
        self.numbers = np.zeros(23)
        self.numbers[:12] = (
            *(t.seebeck, t.resistance, t.conductance, 540.0, 58.0, 105.0, t.flow, 25.0, 15.0),
            *(t.to_skin, t.loss, t.room),
        )
        self.numbers[12:] = (
            *(t.sensor_lag, t.layer, t.to_layer, float(t.outside), t.fouling, t.dead_zone, t.fading, 0.15),
            *(t.sink, t.wall_loss, 30.0),
        )
        self.x = np.full(_NODES, start)
        self.tubes = np.full((2, max(1, round(t.delay / STEP))), start)
        self.steps = 0

    def read(self) -> Array:
        """Return what the sensors of heatsink, tank and skin show, without noise."""
        return self.x[[0, 2, 6]]

    def run(self, current: float, seconds: float) -> None:
        """Let so many seconds pass."""
        count = round(seconds / STEP)
        _advance(self.x, self.tubes, self.numbers, current, self.steps, count)
        self.steps += count

    def copy(self) -> Plant:
        """Return a plant in the same state."""
        other = Plant(self.truth)
        other.x, other.tubes, other.steps = self.x.copy(), self.tubes.copy(), self.steps
        return other


def full_drive_time(
    plant: Plant, target: float, band: float, *, current: float, slew: float, now: float
) -> float:
    """Return how long full drive, reached at the slew limit from the current of now, needs to bring the skin
    into the band [s]; inf where it does not within 20 minutes."""
    plant, dt = plant.copy(), 0.1
    end = current if target > plant.read()[SKIN] else -current
    for k in range(12000):
        if abs(plant.read()[SKIN] - target) <= band:
            return k * dt
        now += float(np.clip(end - now, -slew * dt, slew * dt))
        plant.run(now, dt)
    return float("inf")


@njit(cache=True)
def _advance(x, tubes, p, current, first, count):  # type: ignore[no-untyped-def]
    cells = tubes.shape[1]
    keep = np.exp(-p[_TUBE] / p[_FLOW])
    u = current
    if abs(u) < p[_DEAD]:
        u = 0.0
    elif p[_DEAD] > 0:
        u -= np.sign(u) * p[_DEAD]
    for k in range(first, first + count):
        minutes = k * STEP / 60.0
        seebeck = p[_SEEBECK] * (1.0 - p[_FADE] * min(minutes / 10.0, 1.0))
        to_skin = p[_TO_SKIN] * (1.0 - p[_FOUL]) ** minutes
        h, c, w, f, s, layer, shown = x
        at = k % cells
        to_finger = p[_ROOM] + keep * (tubes[0, at] - p[_ROOM])
        to_tank = p[_ROOM] + keep * (tubes[1, at] - p[_ROOM])
        tubes[0, at], tubes[1, at] = w, f
        joule = 0.5 * p[_JOULE] * u * u
        cold = seebeck * u * (c + KELVIN) + joule + p[_CONDUCT] * (h - c)
        hot = joule - seebeck * u * (h + KELVIN) - p[_CONDUCT] * (h - c)
        x[0] += STEP * (2.0 * hot - p[_SINK_OUT] * (h - p[_ROOM])) / p[_SINK]
        x[1] += STEP * (2.0 * cold - p[_WALL_IN] * (c - w) - p[_WALL_OUT] * (c - p[_ROOM])) / p[_WALL]
        x[2] += STEP * (p[_WALL_IN] * (c - w) + p[_FLOW] * (to_tank - w)) / p[_TANK]
        x[3] += STEP * (p[_FLOW] * (to_finger - f) - to_skin * (f - s)) / p[_FINGER]
        into = 0.0
        if p[_LAYER] > 0:
            into = p[_TO_LAYER] * (s - layer)
            lost = p[_OUTSIDE] * p[_LOSS] * (layer - p[_ROOM])
            x[5] += STEP * (into - lost) / p[_LAYER]
        lost = (1.0 - p[_OUTSIDE]) * p[_LOSS] * (s - p[_ROOM])
        x[4] += STEP * (to_skin * (f - s) - lost - into) / p[_SKIN]
        seen = layer if p[_OUTSIDE] > 0 else s
        if p[_SENSOR] > 0:
            x[6] += STEP * (seen - shown) / p[_SENSOR]
        else:
            x[6] = x[5] if p[_OUTSIDE] > 0 else x[4]
