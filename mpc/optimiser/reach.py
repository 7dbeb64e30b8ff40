r"""Which targets can be held: the nearest steady outputs that the drives' ranges allow.

A horizon does not show it: on the way up, a plan at full drive comes nearer to any target.  So the steady
state itself is sought, with the estimated biases in it, from the last one on, by Newton's method for the
state and least squares inside the ranges for the drives together,

    x_s+ = x_s + (I - A)^-1 (f(x_s, u_s) - x_s + B z),    min_z |r - y(x_s+)|^2,    u_s+ = u_s + z in range.

An output that would go beyond its target counts ten times, as the optimiser has it.  A linear plant needs one
such step.  Where the gain turns over (a Peltier element at its optimum) or the plant
integrates there may be no answer, and then nothing is said.

A target that is missed by more than 0.1 degC in two samples in a row cannot be had; it can again after five
samples in a row in which it is missed by less than 0.05 degC, or when it moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.mpc.plant.prediction import PredictionModel

__all__ = ["Reach", "least_squares_in_box"]

Array = NDArray[np.float64]

_STEPS, _SWEEPS = 10, 200
_STRIDE = 0.3  # of its range, that a drive may go in a step
_STILL = 1e-4  # degC and of the range: the steady state is found
_BEYOND = 10.0  # weight of an output beyond its target
_OUT, _IN = 0.1, 0.05  # degC from the target: it cannot be had, it can
_TELL, _TAKE_BACK = 2, 5  # samples in a row


class Reach:
    """Says whether targets can be held.

    Parameters
    ----------
    model : PredictionModel
    rows : list of int
        The controlled outputs.
    lowest, highest : (n_u,) ndarray
        Ranges of the drives.
    """

    def __init__(self, model: PredictionModel, rows: list[int], lowest: Array, highest: Array) -> None:
        self.model, self._rows, self.lowest, self.highest = model, rows, lowest, highest
        self.forget()

    def forget(self) -> None:
        """Start afresh."""
        self._x: Array | None = None
        self._u = self.model.neutral
        self._out = self._in = 0
        self._told = False
        self._target = np.full(len(self._rows), np.nan)

    def missed(
        self,
        x: Array,
        u: Array,
        d: Array,
        *,
        target: Array,
        side: Array,
        ahead: Array,
        seen: NDArray[np.bool_],
        bias: Array,
        drive_bias: Array,
    ) -> tuple[int, float] | None:
        """Return which controlled output cannot be held at its target, and where it can; None: all can.

        Parameters
        ----------
        x, u, d : (n_x,), (n_u,), (n_d,) ndarray
            Estimate, drives now, and disturbances with their bias.
        target, side, ahead : (n_controlled,) ndarray
            Targets [degC], from where they are approached, and the outputs at the end of the plan [degC].
        seen : (n_controlled,) ndarray of bool
            Which of them count.
        bias, drive_bias : (n_y,), (n_u,) ndarray
            Of outputs [degC] and drives.
        """
        if not np.array_equal(target, self._target):
            self._target, self._out, self._in, self._told = target.copy(), 0, 0, False
        limit = _IN if self._told else _OUT
        held: Array | None = target
        if np.any(np.abs(target - ahead)[seen] > limit):
            held = self._held(x, u, d, target, side, seen, bias, drive_bias)
        if held is None:
            return None
        miss = np.where(seen, np.abs(target - held), 0.0)
        if np.any(miss > limit):
            self._out, self._in = self._out + 1, 0
        else:
            self._out, self._in = 0, self._in + 1
        self._told = self._in < _TAKE_BACK if self._told else self._out >= _TELL
        if not self._told:
            return None
        if self._out:
            self._worst = int(np.argmax(miss))
            self._value = float(held[self._worst])
        return self._worst, self._value

    def _held(
        self,
        x: Array,
        u: Array,
        d: Array,
        target: Array,
        side: Array,
        seen: NDArray[np.bool_],
        bias: Array,
        drive_bias: Array,
    ) -> Array | None:
        """Return the controlled outputs nearest to the targets; None where no steady state is found."""
        model, rows = self.model, self._rows
        x_s, u_s = (x, u) if self._x is None else (self._x, self._u)
        u_s, self._x = np.clip(u_s, self.lowest, self.highest), None
        for _ in range(_STEPS):
            after, A, B, _ = model.linearise(x_s, u_s + drive_bias, d)
            try:
                by = np.linalg.solve(np.eye(model.n_x) - A, np.column_stack([after - x_s, B * model.span]))
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(by).all():
                return None
            y = model.output(x_s + by[:, 0])[rows] + bias[rows]
            G = (model.C @ by[:, 1:])[rows]
            low = np.maximum((self.lowest - u_s) / model.span, -_STRIDE)
            high = np.minimum((self.highest - u_s) / model.span, _STRIDE)
            weight = np.where(seen, 1.0, 0.0)
            for _ in range(len(rows)):
                z = least_squares_in_box(weight[:, None] * G, weight * (target - y), low, high)
                beyond = seen & (side * (y + G @ z - target) > _IN)
                weight = np.where(beyond, _BEYOND, weight)
            x_s, u_s = x_s + by[:, 0] + by[:, 1:] @ z, u_s + z * model.span
            if np.max(np.abs(by[:, 0])) < _STILL and np.max(np.abs(z)) < _STILL:
                self._x, self._u = x_s, u_s
                return np.asarray(y + G @ z)
        return None


def least_squares_in_box(G: Array, e: Array, low: Array, high: Array) -> Array:
    """Return z (n,) between low and high that makes |e - G z| least, by coordinates in turn.

    Examples
    --------
    >>> G = np.array([[2.0, 1.0], [1.0, 2.0]])
    >>> least_squares_in_box(G, G @ [0.1, 5.0], np.full(2, -1.0), np.full(2, 1.0)).round(2)
    array([1., 1.])
    """
    H, f = G.T @ G, G.T @ e
    own = np.diag(H) + 1e-12 * max(np.trace(H), 1e-300)
    z = np.zeros(len(f))
    for _ in range(_SWEEPS):
        moved = 0.0
        for j in range(len(z)):
            best = min(max(z[j] + (f[j] - H[j] @ z) / own[j], low[j]), high[j])
            moved, z[j] = max(moved, abs(best - z[j])), best
        if moved < 1e-9:
            break
    return z
