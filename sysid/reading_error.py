"""What the readings of an experiment are worth, given how a fit's readings missed it.

A fit learns the covariance of what its free runs leave (:mod:`thermogrip.sysid.error_model`): white noise,
two memories of model error, and effects that each log has for itself.  An experiment that is yet to come has
the same.  With the sensitivities J of its bins, in the units of the fit's residuals, it adds to a fit by
least squares the Hessian A = J'J and to the covariance of its score

    V = phi (J' C J + E E'),      E = J' B,

C the learnt covariance, B the columns of the log's effects in their spreads, phi by how much more the logs of
the fit disagreed than that.  With the fit's Hessian P and covariance S
(:mod:`thermogrip.sysid.score_covariance`; the covariance of its score is P S P), a fit to all logs would
have

    (P + A)^-1 (P S P + V) (P + A)^-1.

In coordinates R x = theta with R R' = S, in which S is 1, the inverse of this is the gain of the experiment

    (P' + A') (P'P' + V')^-1 (P' + A'),      P' = R' P R and so on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.error_model import Block, ErrorModel

if TYPE_CHECKING:
    from thermogrip.sysid.plant import Plant

__all__ = ["ReadingError", "learnt_error"]

Array = NDArray[np.float64]

_TINY = 1e-9  # keeps the score's covariance invertible where a direction is told by nothing


@dataclass(frozen=True, eq=False)
class ReadingError:
    """A fit's error model, ready for another log.

    Attributes
    ----------
    numbers : ErrorModel
    hessian : (n_free, n_free) ndarray
        P, of theta.
    unit : (n_y,) ndarray
        One residual of the fit in the unit of the output.
    bin_s : float
        Width of a bin of ``numbers`` [s].
    merge : float
        Residuals of the fit that one bin stands for.
    phi : float
        By how much the logs of the fit disagreed beyond ``numbers``.
    offset : (n_y,) ndarray
        Spread of the outputs' offsets over logs.
    bias : (n_d,) ndarray
        Spread of the measured disturbances' biases over logs.
    own : (n_free,) ndarray
        Spread of theta over logs; 0 for what all logs share.
    """

    numbers: ErrorModel
    hessian: Array
    unit: Array
    bin_s: float
    merge: float
    phi: float
    offset: Array
    bias: Array
    own: Array

    def gain(self, root: Array, rise: Array, effects: Array, dt: float) -> Array:
        """Return the inverse (n, n) of the covariance after an experiment, in coordinates where it is 1 now.

        Parameters
        ----------
        root : (n, n) ndarray
            R, whose square R R' is the covariance of theta now.
        rise : (n, N, n_y) ndarray
            Sensitivities of the outputs in these coordinates.
        effects : (n_effect, N, n_y) ndarray
            What each effect of the log does to the outputs at one spread, but for their offsets.
        dt : float
            Time between rows [s].
        """
        hessian, spread = self._added(rise, effects, dt)
        before = root.T @ self.hessian @ root
        after = before + hessian
        score = before @ before + spread + _TINY * np.eye(len(root))
        return np.asarray(after @ np.linalg.solve(score, after))

    def _added(self, rise: Array, effects: Array, dt: float) -> tuple[Array, Array]:
        """Return A and V (n, n) of the experiment."""
        n, n_y = len(rise), rise.shape[2]
        offsets = np.zeros((n_y, rise.shape[1], n_y))
        offsets[np.arange(n_y), :, np.arange(n_y)] = self.offset[:, None]
        columns = np.concatenate([rise, offsets, effects]) / self.unit
        m = max(1, round(self.bin_s / dt))
        n_bin = columns.shape[1] // m
        if n_bin < 2:
            return np.zeros((n, n)), np.zeros((n, n))
        bins = columns[:, : n_bin * m].reshape(len(columns), n_bin, m, n_y).mean(axis=2)
        block = Block.of(bins.transpose(1, 2, 0), range(n_y))
        whole = self.merge * np.einsum("bjjac->ac", block.products)
        S = block.covariance(self.numbers)
        noise = self.merge**2 * np.tensordot(S, block.products[..., :n, :n], axes=3)
        return whole[:n, :n], self.phi * (noise + whole[:n, n:] @ whole[:n, n:].T)


def learnt_error(plant: Plant) -> ReadingError | None:
    """Return what the plant's fit learnt of its error, None where it learnt nothing."""
    intervals: Mapping[str, Any] = plant.scores.get("intervals", {})
    numbers = intervals.get("numbers")
    if numbers is None or plant.covariance is None:
        return None
    error = ErrorModel(
        white=tuple(numbers["white"]),
        tau=tuple(numbers["tau"]),
        sd=tuple(tuple(row) for row in numbers["sd"]),
        correlation=tuple(numbers["correlation"]),
    )
    spread: Mapping[str, float] = intervals.get("spread_over_logs", {})
    return ReadingError(
        error,
        np.array(intervals["hessian"], dtype=float),
        np.array(numbers["unit"], dtype=float),
        float(numbers["bin_s"]),
        float(numbers["merge"]),
        max(float(intervals.get("between_logs", 1.0)), 1.0),
        np.array([spread.get(f"offset of {name}", 0.0) for name in plant.outputs]),
        np.array([spread.get(f"bias of {name}", 0.0) for name in plant.disturbances]),
        np.array([spread.get(name, 0.0) for name in plant.free]),
    )
