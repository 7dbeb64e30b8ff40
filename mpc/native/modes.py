r"""The modes of a linear plant, in which the C keeps the covariance of its filter.

Carried by a sample, A P A', the covariance of n states costs some n^3 operations. In the coordinates z of
x = V z, V^-1 A V is diagonal but for a block of two of each pair of complex poles,

    (a, b; -b, a)    of poles a +- ib,

and the same costs 4 n^2. The filter is the same in all coordinates; what differs is how sums are rounded, by
cond(V)^2. So V is real, its columns as long as each other in the states' own units, and a plant whose V is
badly conditioned (a chain of delays has no V at all) keeps its own states.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.arrays import Array

if TYPE_CHECKING:
    from thermogrip.mpc.plant.prediction import PredictionModel

__all__ = ["Modes", "modes_of"]

_FEWEST = 8  # states, from which on modes are worth it
_WORST = 100.0  # condition of V: its square is by how many roundings an entry of P may differ


@dataclass(frozen=True, eq=False)
class Modes:
    """Coordinates in which a sample of a plant is tridiagonal."""

    states: Array  # (n_x, n_x) V, states by modes
    inverse: Array
    # (3, n_x) of V^-1 A V what each mode becomes: by the mode before, itself, and the mode behind
    step: Array

    def into(self, P: Array) -> Array:
        """Return a covariance (n, n), whose first n_x rows are of states, with those of modes."""
        return _both_sides(self.inverse, P)

    def out_of(self, P: Array) -> Array:
        """Undo :meth:`into`."""
        return _both_sides(self.states, P)


def _both_sides(T: Array, P: Array) -> Array:
    n, whole = len(T), P.copy()
    whole[:n] = T @ whole[:n]
    whole[:, :n] = whole[:, :n] @ T.T
    return whole


@lru_cache(maxsize=16)
def modes_of(model: PredictionModel, unit: tuple[float, ...]) -> Modes | None:
    """Return the modes of a plant whose states have these units (n_x,); None where it is not linear, does not
    settle, or is better left as it is. Shared: read it."""
    if model.n_x < _FEWEST or model.affine is None:
        return None
    A = model.affine[0]
    poles, vectors = np.linalg.eig(A)
    if not np.max(np.abs(poles)) < 1:
        return None
    V, step, at = np.empty(A.shape), np.zeros((3, model.n_x)), 0
    while at < model.n_x:
        pole, v = poles[at], vectors[:, at]
        if pole.imag == 0:
            V[:, at], step[1, at], at = v.real, pole.real, at + 1
            continue
        # turned so that both parts are at right angles, as far from each other as they can be
        scaled = v / unit
        v = v * np.exp(-0.5j * np.angle(scaled @ scaled))
        V[:, at : at + 2] = np.column_stack([v.real, v.imag])
        step[:, at : at + 2] = [[0.0, -pole.imag], [pole.real] * 2, [pole.imag, 0.0]]
        at += 2
    length = np.linalg.norm(V / np.array(unit)[:, None], axis=0)
    if not np.min(length) > 0 or not np.linalg.cond(V / np.outer(unit, length)) < _WORST:
        return None
    V = V / length
    step[0, 1:] *= length[1:] / length[:-1]
    step[2, :-1] *= length[:-1] / length[1:]
    return Modes(V, np.linalg.inv(V), step)
