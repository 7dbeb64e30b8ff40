"""The state at rest of a user's class that has no ``rest`` of its own.

It is the state x that some input v near u holds still and whose outputs read y,

    min  |T f(x, v) / s|^2 + w_y |(output(x) - y) / sd|^2 + w_u |(v - u) / range|^2,

inside the limits, with s the class's spread of each state and T the seconds of a warm-up.  Few logs of such
plants begin at rest: it is where the estimate of a start begins, and the warm-up then shifts it by what its
readings say (:mod:`thermogrip.sysid.plant.simulation`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.models.user_class import OwnCode

__all__ = ["still"]

Array = NDArray[np.float64]

_SENSOR_WEIGHT, _INPUT_WEIGHT = 1e2, 1e-2
_NUDGE = 1e-6
_ITERATIONS = 40
_SETTLED = 1e-9  # relative fall of the cost at which to stop


def still(code: OwnCode, y: Array, u: Array, d: Array, p: Array, *, sd: Array, seconds: float) -> Array:
    """Return the state (n_x,) at rest; it may be not finite where the class's functions are not.

    Parameters
    ----------
    code : OwnCode
    y, u, d, p : (n_y,), (n_u,), (n_d,), (n_p,) ndarray
        Readings (NaN: unknown), inputs, disturbances, parameters.
    sd : (n_y,) ndarray
        Of the sensors.
    seconds : float
        T of the module's theory.

    Examples
    --------
    A tank that reads 2 and empties with a time constant of 100 s was held by an inflow of 0.02 a second:

    >>> from thermogrip.sysid.models.user_class import read_class
    >>> class Tank:
    ...     inputs, outputs, states, dt = {"pump": "V"}, {"read": "V"}, {"level": 0.1}, 4.0
    ...     parameters = {"time": {"value": 100.0, "sd_log": 0.7, "unit": "s"}}
    ...     def rhs(self, x, u, d, p):
    ...         return [u.pump - x.level / p.time]
    ...     def output(self, x, p):
    ...         return [x.level + 1.0]
    >>> numbers = [np.array([value]) for value in (2.0, 0.0, 100.0)]
    >>> x = still(read_class(Tank), *numbers[:2], np.empty(0), numbers[2], sd=np.array([0.1]), seconds=200.0)
    >>> x.round(3).tolist()
    [1.0]
    """
    n_x, known = len(code.states), np.isfinite(y)
    scale = np.array(list(code.states.values()))
    ranges = [item.range for item in code.inputs.values()]
    wide = np.array([ends[1] - ends[0] if ends else 1.0 for ends in ranges])
    moved = np.array([not item.switch for item in code.inputs.values()], dtype=bool)

    def residuals(z: Array) -> Array:
        """Return (n_r, B) at the columns of z: states, then inputs, in units of their scale."""
        x = z[:n_x] * scale[:, None]
        v = np.where(moved[:, None], z[n_x:] * wide[:, None], u[:, None])
        flow = seconds * _rows(code.rhs(list(x), list(v), list(d), list(p)), z.shape[1])
        read = _rows(code.output(list(x), list(p)), z.shape[1])
        miss = (_SENSOR_WEIGHT * (read - y[:, None]) / sd[:, None])[known]
        return np.concatenate([flow / scale[:, None], miss, _INPUT_WEIGHT * (z[n_x:] - (u / wide)[:, None])])

    limits = [code.limits.get(name, (-np.inf, np.inf)) for name in code.states]
    ends = np.array([*limits, *((ends or (-np.inf, np.inf)) for ends in ranges)], dtype=float)
    low, high = (ends / np.concatenate([scale, wide])[:, None]).T
    z = np.clip(np.concatenate([_guess(code, y) / scale, u / wide]), low, high)
    return np.asarray(_settle(residuals, z, low, high)[:n_x] * scale)


def _guess(code: OwnCode, y: Array) -> Array:
    """Return a first guess: the reading of the output of a state's name, else the mean of all readings."""
    mean, read = float(np.nanmean(y)), dict(zip(code.outputs, y.tolist()))
    guess = [read.get(name, mean) for name in code.states]
    return np.array([value if np.isfinite(value) else mean for value in guess])


def _settle(residuals: Callable[[Array], Array], z: Array, low: Array, high: Array) -> Array:
    """Return where bounded, damped Gauss-Newton ends; its best point, however it ends."""
    damping, n = 1e-3, len(z)
    moves = np.hstack([np.zeros((n, 1)), _NUDGE * np.eye(n)])
    rows = residuals(z[:, None] + moves)
    cost = float(rows[:, 0] @ rows[:, 0])
    if not np.isfinite(cost):
        return np.full(n, np.nan)
    for _ in range(_ITERATIONS):
        jacobian = np.nan_to_num((rows[:, 1:] - rows[:, :1]) / _NUDGE)
        step = np.linalg.solve(jacobian.T @ jacobian + damping * np.eye(n), -jacobian.T @ rows[:, 0])
        trial = np.clip(z + step, low, high)
        again = residuals(trial[:, None] + moves)
        fallen = float(again[:, 0] @ again[:, 0])
        if not fallen < cost:  # or NaN
            damping *= 100
            if damping > 1e9:
                break
            continue
        done = fallen > (1 - _SETTLED) * cost or float(np.abs(trial - z).max()) < 1e-9
        z, rows, cost, damping = trial, again, fallen, damping / 10
        if done:
            break
    return z


def _rows(values: Sequence[Any], n: int) -> Array:
    """Return values, each a number or a row, as an array (len(values), n)."""
    rows = [np.broadcast_to(value, n) for value in values]
    return np.array(rows, dtype=float).reshape(len(values), n)
