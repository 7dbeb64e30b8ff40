r"""The controller's quadratic program: few unknowns, hard and soft rows, an answer with a status.

With the states eliminated (condensed), the unknowns are the block values of the drives only, a dozen or so:

    minimise    1/2 x'Hx + f'x + sum_i ( w_i (s_i^- + s_i^+) + 1/2 q_i (s_i^-^2 + s_i^+^2) )
    subject to  lower_i - s_i^- <= (A x)_i <= upper_i + s_i^+ ,   s >= 0,   s_i = 0 on hard rows.

It is handed to DAQP as a least-distance program (:meth:`CondensedQP.solve`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from thermogrip.datasets.arrays import Array

LEAST_QUADRATIC = 1e-9  # of a scaled row's quadratic penalty

#: What DAQP's exit flags mean where they are not positive: a positive flag is a solution.
_EXIT_FLAGS = {
    -1: "infeasible",
    -2: "cycling",
    -3: "unbounded",
    -4: "iteration limit",
    -5: "not convex",
    -6: "bad start",
    -7: "time limit",
}
_SOFT = 8  # DAQP's flag of a row that may be broken at a penalty
TOLERANCE = 1e-10  # of a scaled row
SHORT = 1e-5  # a soft row shorter than this, scaled, cannot be kept by any answer
_NO_BOUND = 1e20  # means "no bound"; DAQP takes 1e30 as infinite


@dataclass(frozen=True)
class QPAnswer:
    """What the solver says."""

    x: Array  # (n,) the minimiser; NaN where there is none
    status: str  # ``"solved"``, ``"infeasible"``, ``"iteration limit"``, ``"time limit"``, ``"not finite"``
    iterations: int  # active-set changes
    # (m,) of the rows, positive at the upper bound, negative at the lower one: H x + f + A' multipliers = 0
    multipliers: Array

    @property
    def solved(self) -> bool:
        """Whether x is the minimiser."""
        return self.status == "solved"


class CondensedQP:
    """A QP of fixed shape, solved again and again with new numbers."""

    def __init__(
        self, *, soft: Any, linear: Any, quadratic: Any, iteration_limit: int = 500, time_limit_s: float = 0.0
    ) -> None:
        self.soft = np.asarray(soft, dtype=bool)
        self.linear = np.asarray(linear, dtype=float)
        self.quadratic = np.asarray(quadratic, dtype=float)
        self.iteration_limit, self.time_limit_s = iteration_limit, time_limit_s
        self._sense = np.where(self.soft, _SOFT, 0).astype(np.int32)
        self._hard, self._priced = ~self.soft, np.where(self.soft, self.linear, 0.0)
        self._given: tuple[Array, Array] | None = None  # the newest H and A, of a linear plant the same ones
        self._scaled: tuple[Array, ...] = ()
        self._model: Any = None  # DAQP's, None before the first program and after one without an answer

    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> QPAnswer:
        """Return the minimiser for H (n, n), positive definite, f (n,) and rows A (m, n) between bounds that
        are infinite where there is none."""
        if A.shape != (self.soft.size, f.size):
            raise ValueError(f"A is {A.shape}, not {(self.soft.size, f.size)}")
        room = upper - lower
        is_same = self._given is not None and H is self._given[0] and A is self._given[1]
        is_finite = _is_finite(f) and (is_same or (_is_finite(H) and _is_finite(A)))
        crossed = ~(room >= 0)
        if not is_finite or (crossed.any() and np.isnan(room).any()):
            return self._failed("not finite", f.size)
        if (crossed & self._hard).any():
            return self._failed("infeasible", f.size)
        if not is_same:
            # x = L^-T z with H = L L': the factor and A L^-T are LAPACK's and BLAS', which take less time
            factor, failed = dpotrf(H.T, lower=1, clean=1)
            if failed:
                return self._failed("not convex", f.size)
            back = dtrtri(factor, lower=1)[0].T  # L^-T
            # each row is divided by its length in units in which H has a diagonal of 1
            length = np.maximum(np.sqrt((A * A) @ (1.0 / H.diagonal())), 1e-12)
            rows = A @ back
            rows /= length[:, None]
            self._scaled = back, length, rows
            self._given = H, A
        back, length, rows = self._scaled
        least, most = np.maximum(lower / length, -_NO_BOUND), np.minimum(upper / length, _NO_BOUND)
        idle = self.soft & (length < SHORT)
        if idle.any():
            least[idle], most[idle] = -_NO_BOUND, _NO_BOUND
        scaled = self._run(f @ back, rows, least, most, length)
        if not scaled.solved:
            return scaled
        return QPAnswer(back @ scaled.x, "solved", scaled.iterations, scaled.multipliers / length)

    def _run(self, f: Array, A: Array, lower: Array, upper: Array, length: Array) -> QPAnswer:
        """Return DAQP's answer to the scaled problem."""
        from daqp import Model

        # D. Arnstrom, A. Bemporad, D. Axehill, "A dual active-set solver for embedded quadratic programming
        # using recursive LDL' updates", IEEE Transactions on Automatic Control 67(8), 2022.  It is started
        # anew each time: from the active set of the last sample it takes a fifth less time, but its answer
        # was now and then off by 2e-4 of a range while it called it solved
        # (``tests/mpc/controllers/test_compiled.py``).
        if self._model is None:
            self._model = Model()
            self._model.settings = {
                "iter_limit": self.iteration_limit,
                "time_limit": self.time_limit_s,
                "primal_tol": TOLERANCE,
            }
            flag, _ = self._model.setup(np.eye(f.size), f, A, upper, lower, self._sense.copy())
        else:  # in the same memory
            flag = self._model.update(f=f, A=A, bupper=upper, blower=lower, sense=self._sense.copy())
        if flag < 0:  # it has seen that there is no answer
            self._model = None
            return self._failed(_EXIT_FLAGS.get(flag, f"solver flag {flag}"), f.size)
        # penalties in scaled units; of the quadratic one it takes the reciprocal
        # a slack becomes s/r, and its penalties w r and q r^2: the linear one makes a soft row exact (it is
        # broken only if keeping it costs more than w per degC), the quadratic one spreads it;
        reciprocal = 1.0 / np.maximum(self.quadratic * length**2, LEAST_QUADRATIC)
        linear = self._priced * length
        self._model.soft_weights(reciprocal, reciprocal, linear, linear)
        z, _, flag, info = self._model.solve()
        if flag <= 0:
            self._model = None
            return self._failed(_EXIT_FLAGS.get(flag, f"solver flag {flag}"), f.size, info["iterations"])
        if not np.isfinite(z).all():
            return self._failed("not finite", f.size, info["iterations"])
        return QPAnswer(np.asarray(z), "solved", info["iterations"], np.asarray(info["lam"]))

    def _failed(self, status: str, n: int, iterations: int = 0) -> QPAnswer:
        return QPAnswer(np.full(n, np.nan), status, iterations, np.zeros(self.soft.size))


def _is_finite(values: Array) -> bool:
    """Return whether all are numbers, with squares that are."""
    flat = values.ravel()
    return bool(np.isfinite(flat @ flat))
