"""ARMAX models: the equation error of ARX is a moving average, with one more polynomial.

    A(q) y[k] = sum_j B_j(q) w_j[k - n_k] + c + C(q) e[k],     C(q) = 1 + c_1 q^-1 + ... + c_na q^-na,

for each output, e white: what one innovation of the state-space form leaves in one reading.  C = 1 is ARX,
C = A output error.  Given C, the one-step errors e = (A y - B w - c) / C are linear in a, b and c, so only
C is iterated (variable projection, as in :mod:`thermogrip.sysid.blackbox.output_error`), with

    de/dc_i = - q^-i e / C(q).

The plant keeps B/A; noise is not simulated.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox import output_error


def solve_armax(c: Array, records: output_error.Records, nb: int, delay: int) -> output_error.Solution | None:
    """Solve for a, b, the constant and what begins a segment at this C, ``outputs`` being -e; None where 1/C
    is unstable."""
    if not output_error.is_stable(c):
        return None
    na, n_shared = len(c), len(c) + records.n_drive * nb + 1
    impulse, step = output_error.responses(c, records)
    columns, right = [], []
    for segment, (y, is_read) in enumerate(zip(records.y, records.known)):
        # a line replaces a lost reading, and rows that need one carry no weight; rows before the record enter
        # A y in its first na rows alone, where an impulse each takes them up
        rows = np.arange(len(y))
        whole = np.interp(rows, rows[is_read], y[is_read]) if is_read.any() else np.zeros(len(y))
        late = np.zeros((na, len(y)))
        filtered, used = lfilter([1.0], np.append(1.0, c), whole), is_read.copy()
        for i in range(1, na + 1):
            late[i - 1, i:] = -filtered[:-i]
            used[i:] &= is_read[:-i]
        X = np.vstack(
            [late, output_error.columns_of(c, records, segment, nb, delay, impulse, step, lost=True)]
        )
        columns.append(X * used)
        right.append(filtered * used)
    shared, first = output_error.least_squares(
        [X[n_shared:] for X in columns], [X[:n_shared] for X in columns], right
    )
    misses = [
        y - shared @ X[:n_shared] - initial @ X[n_shared:] for y, X, initial in zip(right, columns, first)
    ]
    cost = float(sum(miss @ miss for miss in misses))
    return output_error.Solution(c, cost, shared, first, [-miss for miss in misses], misses, columns)


class ArmaxSearch(output_error.Search):
    """Fits one output, structure by structure, and remembers each C that it found."""

    origin = "armax"

    @staticmethod
    def numbers(na: int) -> int:
        """Return the count of numbers of an output beside poles and zeros: the constant, C."""
        return 1 + na

    def starts(self, records: output_error.Records, na: int) -> list[Array]:
        """Return where the search for C begins: at that of ARX, and where that for A would."""
        return [np.zeros(na), *super().starts(records, na)]

    def __call__(
        self, records: output_error.Records, na: int, nb: int, delay: int
    ) -> output_error.Filter | None:
        """Return the best stable filter of this structure, None where no start leads to one."""
        best = self._search(records, na, nb, delay, partial(solve_armax, records=records, nb=nb, delay=delay))
        if best is None or not output_error.is_stable(best.shared[:na]):
            return None
        # constant and initial conditions are fitted to the free run
        b = best.shared[na:-1].reshape(-1, nb)
        return output_error.fit_rest(
            output_error.Filter(best.shared[:na], b, 0.0, delay, np.zeros((len(records.y), na))), records
        )[0]


armax_family = partial(output_error.oe_family, search=ArmaxSearch)
