r"""What state a plant at rest is in, when its sensors do not agree.

At rest the state stays where it is under some past drive v, but for a small rate r,

    x = f(x, v, d) + r,     v ~ N(rest, span^2),     r ~ N(0, (0.2 degC a sample)^2),

and each reading is off by an offset of its own, b ~ N(0, (0.3 degC)^2).  Linearised, x is Gaussian with

    (I - A) x = h + B (v - rest) + r,     P^-1 = (I - A)' S^-1 (I - A),     S = B span^2 B' + diag(rates^2),

and one Kalman update with the readings is the weighted least-squares answer for state, offsets and past drive
together.  A state that would leave its place by degrees within a sample is not believed, whatever the sensors
say: they are off.  What is left open between a state that moves and a sensor that is off stands in the
covariance, and the next readings decide.  A slow mode moves little wherever it is; what no reading tells of
it stays within 10 degC of where the plant's own ``rest`` has it at the mean of the readings.

For a nonlinear plant the update is repeated at its own answer (Gauss-Newton).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thermogrip.mpc.plant.prediction import PredictionModel

__all__ = ["OFFSET", "RestingState", "resting_state", "resting_state_in_room"]

Array = NDArray[np.float64]

#: Standard deviation of a sensor's offset that nobody knows [degC].
OFFSET = 0.3
_RATE = 0.2  # degC a sample, of a plant that is said to be at rest
_FAR = 10.0  # degC from the plant's own rest, of what neither rest nor readings hold


@dataclass(frozen=True, eq=False)
class RestingState:
    """Where a plant at rest may be, before its sensors are looked at.

    Attributes
    ----------
    x : (n_x,) ndarray
        Mean.
    P : (n_x, n_x) ndarray
        Covariance.
    by_level, by_d : (n_x,), (n_x, n_d) ndarray
        How the mean answers to the level of the readings and to the measured disturbances.
    to_drive : (n_u, n_x) ndarray
        The past drive of another state is that of the mean, plus this times the difference.
    drive : (n_u,) ndarray
        Past drive of the mean.
    """

    x: Array
    P: Array
    by_level: Array
    by_d: Array
    to_drive: Array
    drive: Array

    def past_drive(self, x: Array) -> Array:
        """Return the drive (n_u,) that most likely held state x (n_x,)."""
        return np.asarray(self.drive + self.to_drive @ (x - self.x))


def resting_state(
    model: PredictionModel, x: Array, v: Array, level: float, d: Array, *, unit: Array
) -> RestingState:
    """Return where a plant at rest may be, linearised at state x and drive v.

    Parameters
    ----------
    model : PredictionModel
    x, v : (n_x,), (n_u,) ndarray
        Where it is linearised.
    level : float
        Mean of the readings [degC].
    d : (n_d,) ndarray
        Measured disturbances.
    unit : (n_x,) ndarray
        What counts as 1 degC of each state.
    """
    after, A, B, E = model.linearise(x, v, d)
    away = np.eye(model.n_x) - A
    push = after - A @ x + B @ (model.neutral - v)
    scaled = B * model.span
    S = scaled @ scaled.T + np.diag((_RATE * unit) ** 2)
    weighted = np.linalg.solve(S, away).T  # (I - A)' S^-1
    weak = 1.0 / (_FAR * unit) ** 2
    information = weighted @ away + np.diag(weak)
    P = np.linalg.inv(0.5 * (information + information.T))

    def own(step: float, change: Array) -> Array:
        return model.rest(np.full(model.n_y, level + step), d + change)

    still = np.zeros(model.n_d)
    mean = P @ (weighted @ push + weak * own(0.0, still))
    by_level = P @ (weak * (own(1.0, still) - own(-1.0, still)) / 2)
    own_by_d = np.array([(own(0.0, e) - own(0.0, -e)) / 2 for e in np.eye(model.n_d)])
    by_d = P @ (weighted @ E + weak[:, None] * own_by_d.reshape(model.n_d, model.n_x).T)
    to_drive = model.span[:, None] * np.linalg.solve(S, scaled).T
    drive = model.neutral + to_drive @ (away @ mean - push)
    return RestingState(mean, 0.5 * (P + P.T), by_level, by_d, to_drive @ away, drive)


@lru_cache(maxsize=16)
def resting_state_in_room(model: PredictionModel, ambient: float, unit: tuple[float, ...]) -> RestingState:
    """Return :func:`resting_state` linearised where all rests in a room of ``ambient`` [degC]."""
    x, v, d = model.at_rest(ambient)
    return resting_state(model, x, v, ambient, d, unit=np.array(unit))
