r"""The dual active-set method of the exported C, in NumPy: what its iterations are compared with.

The theory is at the head of ``csource/tg_qp.c``.  K is worked out once, of all rows, and its factor of those
in the set is made anew at every iteration, by LAPACK; the C makes products of the rows that it takes in alone
and updates its factor row by row.  Both take the same rows in and out in the same order, so that not only
their answers but also their iterations must agree.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.optimiser.qp import CondensedQP, QPAnswer

REGULAR, TOLERANCE, SHORT, CONTRADICTION, FAR = 1e-11, 1e-10, 1e-5, 1e-6, 1e15
_HARD, _KEPT, _BROKEN = 0, 1, 2


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
        idle = self.soft & (length <= SHORT)
        self._weight = 1.0 / np.where(idle, 1.0, length)
        self._given_bounds = lower, upper
        self._lower = np.where(idle | (lower < -FAR), -np.inf, lower)
        self._upper = np.where(idle | (upper > FAR), np.inf, upper)
        back = np.linalg.inv(np.linalg.cholesky(H))
        normals, c = A @ back.T, back @ f
        self._K, along = normals @ normals.T, normals @ c
        self._right = {1: -upper - along, -1: lower + along}
        # x without a row in the set, and what each does to it
        self._free, self._by = -back.T @ c, normals @ back
        self._free_value = A @ self._free
        # of each row in the set: which, its bound (+1 upper, -1 lower), its state, and how much pushes there
        self._prices = list(zip(self.linear.tolist(), self.quadratic.tolist()))
        self._rows, self._sides = list[int](), list[int]()
        self._states, self._multipliers = list[int](), list[float]()
        iterations = 0
        while iterations <= self.iteration_limit:
            ended = self._go()
            if ended is not None:
                iterations += 1
                self._change(*ended)
                continue
            found = self._worst()
            if found is None:
                return self._refined(iterations, f.size)
            iterations += 1
            row, side = found
            self._put(row, side, _KEPT if self.soft[row] else _HARD, 0.0)
        return self._failed("iteration limit", f.size, iterations)

    def _put(self, row: int, side: int, state: int, multiplier: float) -> None:
        self._rows.append(row)
        self._sides.append(side)
        self._states.append(state)
        self._multipliers.append(multiplier)

    def _system(self) -> tuple[Array, Array]:
        """Return K, with its regular share, and the right side, of the set."""
        rows, sides = np.array(self._rows), np.array(self._sides, dtype=float)
        K = self._K[rows[:, None], rows] * (sides[:, None] * sides)
        diagonal = K.flat[:: len(K) + 1] * (1 + REGULAR)
        right = np.where(sides > 0, self._right[1][rows], self._right[-1][rows])
        for at, (row, state) in enumerate(zip(self._rows, self._states)):
            if state == _BROKEN:
                linear, quadratic = self._prices[row]
                diagonal[at] += 1.0 / quadratic
                right[at] += linear / quadratic
        K.flat[:: len(K) + 1] = diagonal
        return K, right

    def _go(self) -> tuple[int, bool] | None:
        """Go toward the multipliers that fulfil the set; return who ended first, and whether upward."""
        if not self._rows:
            return None
        wanted = _solution(*self._system()).tolist()
        slack = 1e-13 * max(map(abs, wanted))
        share, which, upward = 1.0, -1, False
        for at, (row, state, here, there) in enumerate(
            zip(self._rows, self._states, self._multipliers, wanted)
        ):
            price = self._prices[row][0]
            low = price if state == _BROKEN else 0.0
            if there < low - slack:
                part = (here - low) / (here - there) if here > low else 0.0
            elif state == _KEPT and there > price + slack:
                part = (price - here) / (there - here) if here < price else 0.0
            else:
                continue
            if which < 0 or part < share:
                share, which, upward = part, at, there > low
        pairs = zip(self._multipliers, wanted)
        self._multipliers = [here + share * (there - here) for here, there in pairs]
        return None if which < 0 else (which, upward)

    def _change(self, at: int, upward: bool) -> None:
        """Let a row that has reached the end of its state leave, or go on in the next one."""
        row, side, state = self._rows.pop(at), self._sides.pop(at), self._states.pop(at)
        self._multipliers.pop(at)
        if state == _KEPT and upward:
            self._put(row, side, _BROKEN, float(self.linear[row]))
        elif state == _BROKEN:
            self._put(row, side, _KEPT, float(self.linear[row]))

    def _pushes(self) -> Array:
        """Return the multipliers of the set, positive at upper bounds."""
        return np.asarray(np.array(self._multipliers) * np.array(self._sides, dtype=float))

    def _values(self) -> Array:
        """Return what all rows are."""
        if not self._rows:
            return np.asarray(self._free_value)
        return np.asarray(self._free_value - self._pushes() @ self._K[self._rows])

    def _worst(self) -> tuple[int, int] | None:
        """Return the row that is broken most outside the set, and at which of its bounds."""
        value = self._values()
        over, under = (value - self._upper) * self._weight, (self._lower - value) * self._weight
        most = np.maximum(over, under)
        most[self._rows] = 0.0
        row = int(np.argmax(most))
        return (row, 1 if over[row] > under[row] else -1) if most[row] > TOLERANCE else None

    def _refined(self, iterations: int, n: int) -> QPAnswer:
        """Take back what the regular share did, and look whether the hard rows hold."""
        multipliers = np.zeros(len(self.soft))
        if self._rows:
            rest = self._beyond()
            for at, (row, state) in enumerate(zip(self._rows, self._states)):
                if state == _BROKEN:
                    rest[at] -= (self._multipliers[at] - self.linear[row]) / self.quadratic[row]
            more = _solution(self._system()[0], rest).tolist()
            self._multipliers = [now + add for now, add in zip(self._multipliers, more)]
            over = np.where(np.array(self._states) == _HARD, self._beyond() * self._weight[self._rows], 0.0)
            if not over.max() < CONTRADICTION:
                return QPAnswer(np.full(n, np.nan), "infeasible", iterations, multipliers, multipliers)
            multipliers[self._rows] = self._pushes()
        x, value = self._free - self._by.T @ multipliers, self._values()
        lower, upper = self._given_bounds  # of those too short to be kept as well
        slack = np.maximum(0.0, np.maximum(value - upper, lower - value))
        return QPAnswer(x, "solved", iterations, multipliers, np.where(self.soft, slack, 0.0))

    def _beyond(self) -> Array:
        """Return by how much each row in the set is beyond its bound."""
        value = self._values()[self._rows]
        ends = zip(value.tolist(), self._rows, self._sides)
        return np.array([v - self._upper[r] if s > 0 else self._lower[r] - v for v, r, s in ends])


def _solution(K: Array, right: Array) -> Array:
    """Return K^-1 right by Cholesky's method; where rounding has left K without a root, by elimination."""
    _, found, failed = dposv(K, right)
    return np.asarray(np.linalg.solve(K, right) if failed else found, dtype=np.float64)
