"""Output-error models with a model of their noise: ARMAX and Box-Jenkins.  e is white, and not simulated.

**ARMAX.** The equation error of ARX is a moving average, with one more polynomial,

    A(q) y[k] = sum_j B_j(q) w_j[k - n_k] + c + C(q) e[k],     C(q) = 1 + c_1 q^-1 + ... + c_na q^-na,

for each output: what one innovation of the state-space form leaves in one reading.  C = 1 is ARX, C = A
output error.  Given C, the one-step errors e = (A y - B w - c) / C are linear in a, b and c, so only C is
iterated (variable projection, as in :mod:`thermogrip.sysid.blackbox.output_error`), with

    de/dc_i = - q^-i e / C(q).

**Box-Jenkins.** The noise of an output-error filter G is autoregressive,

    y = G(q) w + v,    D(q) v = e,    D(q) = 1 + d_1 q^-1 + ... + d_p q^-p.

The likeliest G minimises the sum of e^2, which is the output-error fit of D y to D w.  One D an output serves
all structures: it is that of the largest one.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.output_error import (
    Filter,
    Records,
    Search,
    Solution,
    fit_rest,
    is_stable,
    least_squares,
    oe_family,
    refine,
    solve,
)

MOST_LAGS = 3  # of D
ROUNDS = 2


def solve_armax(c: Array, records: Records, nb: int, delay: int) -> Solution | None:
    """Solve for a, b, the constant and what begins a segment at this C, ``outputs`` being -e; None where 1/C
    is unstable."""
    if not is_stable(c):
        return None
    na, columns, right = len(c), [], []
    for X, y, is_read in zip(records.columns(c, nb, delay), records.y, records.known):
        # a line replaces a lost reading, and rows that need one carry no weight; rows before the record enter
        # A y in its first na rows alone, where an impulse each takes them up
        rows = np.arange(len(y))
        whole = np.interp(rows, rows[is_read], y[is_read]) if is_read.any() else np.zeros(len(y))
        late = np.zeros((na, len(y)))
        filtered, used = lfilter([1.0], np.append(1.0, c), whole), is_read.copy()
        for i in range(1, na + 1):
            late[i - 1, i:] = -filtered[:-i]
            used[i:] &= is_read[:-i]
        columns.append(np.vstack([X[:na], late, X[na:]]) * used)
        right.append(filtered * used)
    shared, first = least_squares(columns, na, right)
    misses = [y - np.append(initial, shared) @ X for y, X, initial in zip(right, columns, first)]
    cost = float(sum(miss @ miss for miss in misses))
    return Solution(c, cost, shared, first, [-miss for miss in misses], misses, columns)


class ArmaxSearch(Search):
    """Fits one output, structure by structure, and remembers each C that it found."""

    noise_per_pole = 1  # C
    solve = staticmethod(solve_armax)

    def starts(self, records: Records, na: int) -> list[Array]:
        """Return where the search for C begins: at that of ARX, and where that for A would."""
        return [np.zeros(na), *super().starts(records, na)]

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure, None where no start leads to one."""
        best = self._search(records, na, nb, delay)
        if best is None or not is_stable(best.shared[:na]):
            return None
        # constant and initial conditions are fitted to the free run
        b = best.shared[na:-1].reshape(-1, nb)
        return fit_rest(Filter(best.shared[:na], b, 0.0, delay, np.zeros((len(records.y), na))), records)[0]


def with_noise(found: Filter, records: Records) -> Filter:
    """Return the filter fitted again with autoregressive noise; as it is where its errors are white."""
    nb, rows = found.b.shape[1], sum(int(is_read.sum()) for is_read in records.known)
    found, misses = fit_rest(found, records)
    # generalised least squares, T. Soederstroem and P. Stoica, System Identification (Prentice Hall, 1989),
    # chapter 7
    for _ in range(ROUNDS):
        D = autoregression(misses, records.known)
        if len(D) == 1 or min(map(len, records.y)) < 2 * len(D):
            break
        white = records.filtered(D)
        whole = sum(int(is_read.sum()) for is_read in white.known)
        start = solve(found.a, white, nb, found.delay) if whole > rows / 2 else None  # few were lost
        if start is None:
            break
        solve_at = partial(solve, records=white, nb=nb, delay=found.delay)
        better = refine(start, white, solve_at).filter(nb, found.delay)
        # D nearly removes c and the initial conditions where the noise is slow: the readings give them
        found, misses = fit_rest(better, records)
    return found


def autoregression(errors: Sequence[Array], known: Sequence[NDArray[np.bool_]]) -> Array:
    """Return 1, d_1 ... d_p of errors, segment by segment; those that are not known are 0."""
    lags = range(MOST_LAGS + 1)
    pairs = [sum(int(np.sum(k[: len(k) - lag] & k[lag:])) for k in known) for lag in lags]
    sums = [sum(float(e[: len(e) - lag] @ e[lag:]) for e in errors) for lag in lags]
    r, n = np.array(sums) / np.maximum(pairs, 1), pairs[0]
    best, D = 0.0, np.ones(1)
    # D by the Yule-Walker equations, its order by the Bayesian information criterion
    for p in lags[1:] if r[0] > 0 else ():
        # a trace more variance: errors that are all alike have a singular matrix
        d = solve_toeplitz(np.append((1 + 1e-9) * r[0], r[1:p]), r[1 : p + 1])
        remaining = 1.0 - float(d @ r[1 : p + 1]) / r[0]
        if remaining <= 0.0:  # covariances of a record with gaps need not be those of any process
            break
        criterion = np.log(remaining) + p * np.log(n) / n
        if criterion < best:
            best, D = criterion, np.append(1.0, -d)
    return D


class NoiseSearch(Search):
    """The same, with the filter fitted again with a model of its noise."""

    noise_numbers = 1  # D

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure."""
        fitted = super().__call__(records, na, nb, delay)
        return None if fitted is None else with_noise(fitted, records)


armax_family = partial(oe_family, search=ArmaxSearch)
bj_family = partial(oe_family, search=NoiseSearch)
