"""Box-Jenkins models: output-error models whose noise is autoregressive.

    y = G(q) w + v,    D(q) v = e,    D(q) = 1 + d_1 q^-1 + ... + d_p q^-p,

with the filter G of :mod:`thermogrip.sysid.blackbox.output_error` and white e.  The likeliest G minimises the
sum of e^2, which is the output-error fit of D y to D w.  One D an output serves all structures: it is that of
the largest one.  The plant keeps G alone: noise is not simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.output_error import Filter, Records, Search, fit_rest, oe_family, refine, solve

MOST_LAGS = 3  # of D
ROUNDS = 2


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
        better = refine(start, white, solve_at).filter(white, nb, found.delay)
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

    origin = "bj"

    @staticmethod
    def numbers(na: int) -> int:
        """Return the count of numbers of an output beside poles and zeros: the constant, the noise."""
        return 2

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure."""
        fitted = super().__call__(records, na, nb, delay)
        return None if fitted is None else with_noise(fitted, records)


bj_family = partial(oe_family, search=NoiseSearch)
