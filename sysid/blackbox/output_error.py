"""Output-error models: the simulated output itself is fitted, so noise does not bias the poles.

Each output is a filter of the drives w_j (inputs, disturbances, products of inputs such as ``|drive|`` and
``drive*|drive|``) with one denominator,

    A(q) y[k] = sum_j B_j(q) w_j[k - n_k] + c + initial condition,     A(q) = 1 + a_1 q^-1 + ... + a_na q^-na,

B_j(q) = b_j0 + ... + b_j(nb-1) q^-(nb-1), n_k >= 1, fitted by least squares of the free run. Given A, the
output is linear in b, c and in one initial condition per segment (an impulse response of 1/A at each of the
first na rows), so these are solved for exactly and only the a_i are iterated (Golub and Pereyra's variable
projection, with Kaufman's Jacobian). Steps are Levenberg-Marquardt; a step that moves a root out of the
unit circle is refused.

**Columns are shifts.** Each drive less its first row, a step and an impulse are filtered by 1/A once. Every
lag of a drive is a shift of its filtered rows plus its first value times the step response (before a
segment the first row was held), every initial condition a shift of the impulse response, and with the model
output v

    dv/da_i = - q^-i v / A(q)

is a shift of one filtered row as well. So an iteration costs one ``scipy.signal.lfilter`` of few rows and
one set of normal equations, however many lags there are.

**Many structures, few searches.** The first structure of each denominator order starts from the ARX fit
and, because that is biased towards fast poles, from real poles at several time constants between the step
and the length of the data and from the order below with one fast pole more; the best two are refined. Every
other structure of that order starts from its own ARX fit and from the refined denominators found so far,
and the best of them is refined: a denominator that suits one delay is a few steps from that of another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.order_selection import (
    Structure,
    as_state_space,
    default_terms,
    drives,
    with_spread,
)
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid, bridge

RIDGE = 1e-10  # of unit columns: two that are alike share their effect
ENOUGH = 1e-5  # of the cost: a step that gains less is the last one
ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Filter:
    """One output as a filter of the drives."""

    a: Array  # (na,), a_1 ... a_na of the denominator
    b: Array  # (n_drive, nb), numerators, the first one ``delay`` rows after the drive
    constant: float  # c of the module's equation
    delay: int  # n_k, at least 1
    first: Array  # (n_segment, na), initial conditions: what is added to the first na rows of each segment


class Records:
    """Readings of one output and the drives, segment by segment, prepared once for all structures."""

    def __init__(self, y: Sequence[Array], w: Sequence[Array]) -> None:
        self.y, self.w = list(y), list(w)
        self.known = [np.isfinite(column) for column in y]
        self.first = [drive[0] for drive in w]
        self.moves = [np.ascontiguousarray((drive - drive[0]).T) for drive in w]
        self.longest = max(map(len, y))

    @property
    def n_drive(self) -> int:
        """Number of drives."""
        return int(self.w[0].shape[1])

    def filtered(self, D: Array) -> Records:
        """Return readings and drives filtered by the polynomial D(q), without the rows that lack a past."""
        w = [lfilter(D, [1.0], drive, axis=0)[len(D) - 1 :] for drive in self.w]
        return Records([lfilter(D, [1.0], y)[len(D) - 1 :] for y in self.y], w)


@dataclass(frozen=True, eq=False)
class Solution:
    """What is linear, solved at one denominator."""

    a: Array  # (na,)
    cost: float  # sum of squared residuals
    linear: Array  # (n_drive nb + 1 + na n_segment,), numerators, the constant, initial conditions
    outputs: list[Array]  # model output, segment by segment
    misses: list[Array]  # readings minus model output, 0 where lost
    columns: list[Array]
    root: tuple[Array, bool]
    size: Array

    def normal(self, records: Records) -> tuple[Array, Array]:
        """Return J'J and J'(y - v) of dv/da, the linear columns projected out."""
        na, n_shared = len(self.a), len(self.linear) - len(self.a) * len(records.y)
        gram, slope = np.zeros((na, na)), np.zeros(na)
        cross = np.zeros((len(self.linear), na))
        for at, (v, miss, X, known) in enumerate(zip(self.outputs, self.misses, self.columns, records.known)):
            filtered = lfilter([1.0], np.append(1.0, self.a), v)
            J = np.zeros((na, len(v)))
            for i in range(1, na + 1):
                J[i - 1, i:] = -filtered[:-i]
            J *= known
            gram, slope, both = gram + J @ J.T, slope + J @ miss, X @ J.T
            cross[:n_shared] += both[:n_shared]
            cross[n_shared + at * na : n_shared + (at + 1) * na] = both[n_shared:]
        cross /= self.size[:, None]
        return gram - cross.T @ cho_solve(self.root, cross, check_finite=False), slope

    def filter(self, records: Records, nb: int, delay: int) -> Filter:
        """Return the filter of these numbers."""
        end = records.n_drive * nb
        b = self.linear[:end].reshape(-1, nb)
        first = self.linear[end + 1 :].reshape(len(records.y), -1)
        return Filter(self.a, b, float(self.linear[end]), delay, first)


def solve(a: Array, records: Records, nb: int, delay: int) -> Solution | None:
    """Solve for b, c and the initial conditions at this denominator; None where it is unstable."""
    if not _stable(a):
        return None
    na, n_shared = len(a), records.n_drive * nb + 1
    n_all = n_shared + na * len(records.y)
    tests = np.zeros((2, records.longest))
    tests[0, 0], tests[1] = 1.0, 1.0
    impulse, step = lfilter([1.0], np.append(1.0, a), tests, axis=1)
    gram, right, columns = np.zeros((n_all, n_all)), np.zeros(n_all), []
    for at, known in enumerate(records.known):
        X = _columns(a, records, at, nb, delay, impulse, step)
        columns.append(X)
        y, own = np.where(known, records.y[at], 0.0), slice(n_shared + at * na, n_shared + (at + 1) * na)
        square, product = X @ X.T, X @ y
        gram[:n_shared, :n_shared] += square[:n_shared, :n_shared]
        gram[:n_shared, own] = square[:n_shared, n_shared:]
        gram[own, :n_shared] = square[n_shared:, :n_shared]
        gram[own, own] = square[n_shared:, n_shared:]
        right[:n_shared] += product[:n_shared]
        right[own] = product[n_shared:]
    size = np.maximum(np.sqrt(np.diag(gram)), 1e-12)
    gram = gram / size / size[:, None]
    gram[np.diag_indices_from(gram)] += RIDGE
    root = cho_factor(gram, lower=True, check_finite=False)
    linear = cho_solve(root, right / size, check_finite=False) / size
    outputs, misses = [], []
    for at, (X, known) in enumerate(zip(columns, records.known)):
        own = slice(n_shared + at * na, n_shared + (at + 1) * na)
        part = np.concatenate([linear[:n_shared], linear[own]])
        # where a reading is lost the columns are empty, yet the model runs on
        whole = X if known.all() else _columns(a, records, at, nb, delay, impulse, step, lost=True)
        outputs.append(part @ whole)
        misses.append(np.where(known, records.y[at] - outputs[-1], 0.0))
    cost = float(sum(miss @ miss for miss in misses))
    return Solution(a, cost, linear, outputs, misses, columns, root, size)


def refine(start: Solution, records: Records, nb: int, delay: int) -> Solution:
    """Return where Levenberg-Marquardt steps over the denominator no longer lower the cost."""
    best, damping = start, 1e-3
    for _ in range(ITERATIONS):
        before = best.cost
        gram, slope = best.normal(records)
        weight = np.diag(np.maximum(np.diag(gram), 0.0) + 1e-12)
        for _ in range(8):
            trial = solve(best.a + np.linalg.solve(gram + damping * weight, slope), records, nb, delay)
            if trial is not None and trial.cost < before:
                best, damping = trial, damping / 5
                break
            damping *= 5
        if before - best.cost < ENOUGH * before:
            break
    return best


def arx_start(records: Records, na: int, nb: int, delay: int) -> Array | None:
    """Return a_1 ... a_na of the ARX fit, None where it is unstable or too few rows are whole."""
    deep = max(na, delay + nb - 1)
    n = na + records.n_drive * nb + 1
    gram, right, count = np.zeros((n, n)), np.zeros(n), 0
    for reading, drive in zip(records.y, records.w):
        if len(reading) <= deep:
            continue
        whole = reading if np.isfinite(reading).all() else bridge(reading[:, None])[:, 0]
        rows = len(whole) - deep
        past = [-whole[deep - i : deep - i + rows, None] for i in range(1, na + 1)]
        late = [drive[deep - i : deep - i + rows] for i in range(delay, delay + nb)]
        X = np.hstack([*past, *late, np.ones((rows, 1))])
        good = np.isfinite(X[:, :na]).all(axis=1) & np.isfinite(reading[deep:])
        X, y = X[good], reading[deep:][good]
        gram, right, count = gram + X.T @ X, right + X.T @ y, count + len(y)
    if count < 2 * n:
        return None
    size = np.maximum(np.sqrt(np.diag(gram)), 1e-12)
    a = np.asarray((np.linalg.lstsq(gram / size / size[:, None], right / size, rcond=1e-13)[0] / size)[:na])
    return a if _stable(a) else None


def fit_rest(found: Filter, records: Records) -> tuple[Filter, list[Array]]:
    """Return the filter with constant and initial conditions fitted again, and the errors left."""
    a, (n_drive, nb) = found.a, found.b.shape
    na, end = len(a), n_drive * nb
    tests = np.zeros((2, records.longest))
    tests[0, 0], tests[1] = 1.0, 1.0
    impulse, step = lfilter([1.0], np.append(1.0, a), tests, axis=1)
    columns, right = [], []
    for at, known in enumerate(records.known):
        X = _columns(a, records, at, nb, found.delay, impulse, step)
        own = np.zeros((1 + na * len(records.y), len(known)))
        own[0], own[1 + at * na : 1 + (at + 1) * na] = X[end], X[end + 1 :]
        columns.append(own)
        right.append(np.where(known, records.y[at], 0.0) - found.b.reshape(-1) @ X[:end])
    size = np.maximum(np.sqrt(sum(np.sum(own**2, axis=1) for own in columns)), 1e-12)
    gram = sum(own @ own.T for own in columns) / size / size[:, None]
    slope = sum(own @ part for own, part in zip(columns, right)) / size
    rest = np.linalg.lstsq(gram, slope, rcond=1e-13)[0] / size
    first = rest[1:].reshape(len(records.y), na)
    misses = [part - rest @ own for own, part in zip(columns, right)]
    return Filter(a, found.b, float(rest[0]), found.delay, first), misses


def real_pole_starts(records: Records, na: int) -> list[Array]:
    """Return denominators of real poles with time constants tau, tau / 4, ... for several tau [rows]."""
    return [_real_poles(tau, na) for tau in np.geomspace(3.0, max(records.longest / 3, 4.0), 6)]


def with_pole(a: Array) -> Array:
    """Return the denominator with one pole more, four times as fast as the fastest one."""
    fastest = float(np.abs(np.roots(np.append(1.0, a))).min())
    return np.asarray(np.convolve(np.append(1.0, a), [1.0, -(fastest**4)])[1:])


def _columns(
    a: Array,
    records: Records,
    at: int,
    nb: int,
    delay: int,
    impulse: Array,
    step: Array,
    *,
    lost: bool = False,
) -> Array:
    """Return the filtered columns of a segment as rows (n_drive nb + 1 + na, n), 0 at lost readings."""
    moves, known = records.moves[at], records.known[at]
    n_drive, n = moves.shape
    na, end = len(a), n_drive * nb
    filtered = lfilter([1.0], np.append(1.0, a), moves, axis=1)
    X = np.zeros((end + 1 + na, n))
    for lag in range(nb):
        late = min(delay + lag, n)
        X[lag:end:nb, late:] = filtered[:, : n - late]
    X[:end] += np.repeat(records.first[at], nb)[:, None] * step[:n]
    X[end] = step[:n]
    for row in range(min(na, n)):
        X[end + 1 + row, row:] = impulse[: n - row]
    if not lost and not known.all():
        X *= known
    return X


def _real_poles(tau: float, na: int) -> Array:
    roots = [np.exp(-1 / max(tau / 4**i, 0.5)) for i in range(na)]
    return np.asarray(np.poly(roots)[1:])


def _stable(a: Array) -> bool:
    return bool(np.abs(np.roots(np.append(1.0, a))).max(initial=0.0) < 1 - 1e-7)


def oe_family(
    grid: Grid,
    *,
    poles: Sequence[int] = (1, 2, 3),
    zeros: Sequence[int] = (1, 2),
    delays: Sequence[int] = (1, 2, 3),
    terms: Sequence[tuple[str, ...]] | None = None,
    only: Structure | None = None,
    with_noise: Callable[[Filter, Records], Filter] | None = None,
) -> Mapping[Structure, StateSpaceModel]:
    """Return an output-error model for each structure that has a stable one.

    ``with_noise`` fits a filter again with a model of its noise.
    """
    out, numbers = {}, 2 if with_noise else 1  # beside poles and zeros: the constant, the noise
    searches = [Search() for _ in grid.outputs]
    # magnitudes and signed squares, never products with a switch that moves in one log alone
    for some in default_terms(grid, switched=False) if terms is None else terms:
        w = drives(grid, some)
        records = [Records([s.y[:, i] for s in grid.segments], w) for i in range(len(grid.outputs))]
        for na, nb, nk in product(poles, zeros, delays):
            label = f"na {na}, nb {nb}, delay {nk}" + (f", with {', '.join(some)}" if some else "")
            structure = Structure(label, (na + w[0].shape[1] * nb + numbers) * len(grid.outputs))
            if only not in (None, structure):
                continue
            found = [search(part, na, nb, nk) for search, part in zip(searches, records)]
            fits = [(each, part) for each, part in zip(found, records) if each is not None]
            if len(fits) == len(found):
                filters = [with_noise(*fit) if with_noise else fit[0] for fit in fits]
                out[structure] = assemble(grid, filters, some, origin="bj" if with_noise else "oe")
    return out


def assemble(
    grid: Grid, filters: Sequence[Filter], terms: tuple[str, ...], *, origin: str
) -> StateSpaceModel:
    """Return the state-space model of one filter per output, block by block, in observer form.

    Observer form: v_1+ = -a_1 v_1 + v_2 + (numerator row) w, ..., y = v_1; a delay of n_k adds n_k - 1 rows
    of pure shift in front of the numerator, so that delays are states.
    """
    A, W, c, C = [], [], [], []
    for each in filters:
        na, (n_drive, nb) = len(each.a), each.b.shape
        n = max(na, each.delay - 1 + nb)
        block = np.diag(np.ones(n - 1), 1)
        block[:na, 0] -= each.a
        push = np.zeros((n, n_drive))
        push[each.delay - 1 : each.delay - 1 + nb] = each.b.T
        A.append(block)
        W.append(push)
        c.append(np.concatenate([[each.constant], np.zeros(n - 1)]))
        C.append(np.eye(1, n))
    parts = block_diag(*A), np.vstack(W), block_diag(*C), np.concatenate(c)
    model = as_state_space(grid, *parts, terms=terms, origin=origin)
    starts = [_first_states(filters, w[0], at) for at, w in enumerate(drives(grid, terms))]
    return with_spread(model, grid, starts)


def _first_states(filters: Sequence[Filter], held: Array, segment: int) -> Array:
    """Return the state at a segment's first row, before which the drives ``held`` stood."""
    out = []
    for each in filters:
        na, (_, nb) = len(each.a), each.b.shape
        x = np.zeros(max(na, each.delay - 1 + nb))
        x[:na] += each.first[segment]
        x[0] += each.constant
        for lag, gain in enumerate(each.b.T @ held, start=each.delay):
            x[:lag] += gain  # a drive so many rows back still acts on the rows before its lag
        out.append(x)
    return np.concatenate(out)


class Search:
    """Fits one output, structure by structure, and remembers the denominators that it found."""

    def __init__(self) -> None:
        self._found: dict[int, list[Array]] = {}

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure, None where no start leads to one."""
        known = self._found.get(na, [])
        starts = known or [*real_pole_starts(records, na), *map(with_pole, self._found.get(na - 1, [])[:1])]
        regressed = arx_start(records, na, nb, delay)
        if regressed is not None:
            starts = [regressed, *starts]
        solved = [some for some in (solve(a, records, nb, delay) for a in starts) if some is not None]
        if not solved:
            return None
        solved.sort(key=lambda some: some.cost)
        refined = [refine(some, records, nb, delay) for some in solved[: 1 if known else 2]]
        best = min(refined, key=lambda some: some.cost)
        self._found[na] = [best.a, *known][:2]
        return best.filter(records, nb, delay)
