r"""The dual active-set method of the exported C, in NumPy: what its iterations are compared with.

The theory is at the head of ``csource/tg_qp.c``.  Here every factor is made anew at every iteration, by
NumPy; the C updates its own row by row.  Both take the same rows in and out in the same order, so that
not only their answers but also their iterations must agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.optimiser.qp import CondensedQP, QPAnswer

_REGULAR, _TOLERANCE, _SHORT, _CONTRADICTION, _FAR = 1e-11, 1e-10, 1e-5, 1e-6, 1e15
_HARD, _KEPT, _BROKEN = 0, 1, 2


@dataclass
class _Entry:
    """A row in the working set: +1 at its upper bound, -1 at its lower, and how much pushes there."""

    row: int
    side: int
    state: int
    multiplier: float


class ActiveSetQP(CondensedQP):
    """The same program, always cold; a penalty a row, or one for all."""

    def __init__(
        self, *, soft: Mask, linear: Array | float, quadratic: Array | float, iteration_limit: int = 500
    ) -> None:
        rows = np.ones(len(soft))
        super().__init__(
            soft=soft, linear=linear * rows, quadratic=quadratic * rows, iteration_limit=iteration_limit
        )

    def _solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> QPAnswer:
        length = np.linalg.norm(A / np.sqrt(np.diag(H)), axis=1)
        self._idle = self.soft & (length <= _SHORT)
        self._weight = 1.0 / np.where(self._idle, 1.0, length)
        L = np.linalg.cholesky(H)
        self._A, self._bounds = A, (np.clip(lower, -1e30, 1e30), np.clip(upper, -1e30, 1e30))
        self._back = np.linalg.inv(L)
        self._normals, self._c = A @ self._back.T, self._back @ f
        self._set, iterations = list[_Entry](), 0
        while iterations <= self.iteration_limit:
            ended = self._go()
            if ended is not None:
                iterations += 1
                self._change(*ended)
                continue
            x = self._answer()
            found = self._worst(x)
            if found is None:
                return self._refined(iterations)
            iterations += 1
            row, side = found
            self._set.append(_Entry(row, side, _KEPT if self.soft[row] else _HARD, 0.0))
        return self._failed("iteration limit", f.size, iterations)

    def _system(self) -> tuple[Array, Array]:
        """Return K, with its regular share, and the right side, of the set."""
        m = self._normals_of_set()
        K = m @ m.T
        K.flat[:: len(K) + 1] *= 1 + _REGULAR
        right = -np.array([self._bound(entry) for entry in self._set]) - m @ self._c
        for at, entry in enumerate(self._set):
            if entry.state == _BROKEN:
                K[at, at] += 1.0 / self.quadratic[entry.row]
                right[at] += self.linear[entry.row] / self.quadratic[entry.row]
        return K, right

    def _normals_of_set(self) -> Array:
        sides = np.array([float(entry.side) for entry in self._set])
        return np.asarray(self._normals[[entry.row for entry in self._set]] * sides[:, None])

    def _bound(self, entry: _Entry) -> float:
        lower, upper = self._bounds
        return float(upper[entry.row] if entry.side > 0 else -lower[entry.row])

    def _go(self) -> tuple[int, bool] | None:
        """Go toward the multipliers that fulfil the set; return who ended first, and whether upward."""
        if not self._set:
            return None
        wanted = np.linalg.solve(*self._system())
        slack = 1e-13 * float(np.max(np.abs(wanted)))
        share, which, upward = 1.0, -1, False
        for at, (entry, there) in enumerate(zip(self._set, wanted.tolist())):
            low = self.linear[entry.row] if entry.state == _BROKEN else 0.0
            high = self.linear[entry.row] if entry.state == _KEPT else np.inf
            here = entry.multiplier
            if there < low - slack:
                part = (here - low) / (here - there) if here > low else 0.0
            elif there > high + slack:
                part = (high - here) / (there - here) if here < high else 0.0
            else:
                continue
            if which < 0 or part < share:
                share, which, upward = part, at, there > high
        for entry, there in zip(self._set, wanted.tolist()):
            entry.multiplier += share * (there - entry.multiplier)
        return None if which < 0 else (which, upward)

    def _change(self, at: int, upward: bool) -> None:
        """Let an entry that has reached the end of its state leave, or go on in the next one."""
        entry = self._set.pop(at)
        if entry.state == _KEPT and upward:
            self._set.append(_Entry(entry.row, entry.side, _BROKEN, self.linear[entry.row]))
        elif entry.state == _BROKEN:
            self._set.append(_Entry(entry.row, entry.side, _KEPT, self.linear[entry.row]))

    def _answer(self) -> Array:
        v = -self._c
        if self._set:
            v = v - self._normals_of_set().T @ np.array([entry.multiplier for entry in self._set])
        return np.asarray(self._back.T @ v)

    def _worst(self, x: Array) -> tuple[int, int] | None:
        """Return the row that is broken most outside the set, and at which of its bounds."""
        lower, upper = self._bounds
        value = self._A @ x
        over = np.where(upper > _FAR, 0.0, (value - upper) * self._weight)
        under = np.where(lower < -_FAR, 0.0, (lower - value) * self._weight)
        most = np.maximum(over, under)
        most[[entry.row for entry in self._set]] = 0.0
        most[self._idle] = 0.0
        row = int(np.argmax(most))
        return (row, 1 if over[row] > under[row] else -1) if most[row] > _TOLERANCE else None

    def _refined(self, iterations: int) -> QPAnswer:
        """Take back what the regular share did, and look whether the hard rows hold."""
        x, multipliers = self._answer(), np.zeros(len(self.soft))
        if self._set:
            rest = np.array([e.side * (self._A[e.row] @ x) - self._bound(e) for e in self._set])
            for at, entry in enumerate(self._set):
                if entry.state == _BROKEN:
                    rest[at] -= (entry.multiplier - self.linear[entry.row]) / self.quadratic[entry.row]
            for entry, more in zip(self._set, np.linalg.solve(self._system()[0], rest).tolist()):
                entry.multiplier += more
            x = self._answer()
        hard = [e for e in self._set if e.state == _HARD]
        over = [(e.side * (self._A[e.row] @ x) - self._bound(e)) * self._weight[e.row] for e in hard]
        if over and not max(over) < _CONTRADICTION:
            return QPAnswer(np.full(x.size, np.nan), "infeasible", iterations, multipliers, multipliers)
        for entry in self._set:
            multipliers[entry.row] += entry.side * entry.multiplier
        value = self._A @ x
        slack = np.maximum(0.0, np.maximum(value - self._bounds[1], self._bounds[0] - value))
        return QPAnswer(x, "solved", iterations, multipliers, np.where(self.soft, slack, 0.0))
