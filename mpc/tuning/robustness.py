r"""What a PI loop bears that its model does not have: the peak of its sensitivity.

With the step response y of the model to a drive, sampled as the loop is, and the loop as it is called,

    S(w) = 1 / (1 + C(z) G(z)),   z = exp(j w dt),   C = Kc (1 + dt / (Ti (z - 1))),
    G = sum_k (y_k - y_k-1) z^-k,   behind a lag 1 / (1 + j w lag) and a delay exp(-j w delay),

and Ms is the largest abs(S): 1/Ms is how near the loop comes to the point where it oscillates for good;
SIMC's own settings have 1.6 to 1.7 [1]_. A response that still grows where it ends is taken to grow on at
that rate, as a level does.

References
----------
.. [1] S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning", Journal of Process
   Control 13(4), 2003.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.design.design import PILoop
from thermogrip.mpc.plant.prediction import prediction_model, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_FREQUENCIES = 200  # from a 5000th of the loop's highest one on
_UNSEEN = 2  # of the plant's steps: no log shows a delay or a lag that is shorter
_SHARE = 0.5  # of an apparent delay, by which a delay or a sensor's lag may be longer


def peak_sensitivity(plant: Plant, loop: PILoop, dt: float, *, lag: float = 0.0, delay: float = 0.0) -> float:
    """Return Ms of a PI loop that is called every dt [s] on the linear model of a plant about its rest, whose
    sensor is slower by ``lag`` and whose drive comes later by ``delay`` [s].

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> from thermogrip.mpc.design.design import simc
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> loop = simc(plant, "q1", "t1")
    >>> [round(peak_sensitivity(plant, loop, 2.0, lag=lag), 1) for lag in (0.0, 5.0)]
    [1.8, 2.6]
    """
    w, back, G = _frequency_response(plant, loop.drive, loop.output, dt)
    G = G * np.exp(-1j * w * delay) / (1 + 1j * w * lag)
    C = loop.Kc * (1 + dt / loop.Ti * back / (1 - back))
    return float(np.max(1 / np.maximum(np.abs(1 + C * G), 1e-9)))


@lru_cache(maxsize=16)
def _frequency_response(
    plant: Plant, drive: str, output: str, dt: float
) -> tuple[Array, NDArray[np.complex128], NDArray[np.complex128]]:
    """Return frequencies [rad/s], the delay of one sample and the plant there."""
    model = prediction_model(plant, plant.dt)
    answer = step_response(plant, drive, output)
    y = answer.y[:: max(1, round(dt / plant.dt))] / model.span[model.drives.index(drive)]
    w = np.geomspace(2e-4, 1.0, _FREQUENCIES) * np.pi / dt
    back = np.exp(-1j * w * dt)
    rises = np.diff(y)
    powers = np.cumprod(np.broadcast_to(back, (len(rises), len(w))), axis=0)
    return w, back, rises @ powers + rises[-1] * powers[-1] * back / (1 - back)


def worst_sensitivity(plant: Plant, loops: Sequence[PILoop], dt: float) -> float:
    """Return the largest Ms of loops whose sensors are slower, or whose drives come later, by two of the
    plant's steps, which no log shows, or by half the apparent delay, where that is longer."""
    found = []
    for loop in loops:
        delay = step_response(plant, loop.drive, loop.output).delay
        more = max(_UNSEEN * plant.dt, _SHARE * delay)
        found += [peak_sensitivity(plant, loop, dt, lag=more), peak_sensitivity(plant, loop, dt, delay=more)]
    return max(found, default=0.0)
