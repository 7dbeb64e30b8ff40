"""Output-error models: the simulated output itself is fitted, so noise does not bias the poles.

Each output is a filter of the drives w_j (inputs, disturbances, products of inputs such as ``|drive|``) with
one denominator,

    A(q) y[k] = sum_j B_j(q) w_j[k - n_k] + c + initial condition,     A(q) = 1 + a_1 q^-1 + ... + a_na q^-na,

B_j(q) = b_j0 + ... + b_j(nb-1) q^-(nb-1), n_k >= 1, fitted by least squares of the free run. Given A, the
output is linear in b, c and in one initial condition per segment (an impulse response of 1/A at each of the
first na rows), so these are solved for exactly and only the a_i are iterated (Golub and Pereyra's variable
projection, with Kaufman's Jacobian). Steps are Levenberg-Marquardt; a step that moves a root out of the
unit circle is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from operator import attrgetter

import numpy as np
from scipy.linalg.lapack import dgeqrf
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox import order_selection
from thermogrip.sysid.blackbox.arx import Regression
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid, bridge

DEPENDENT = 1e-11  # of unit columns: two that are alike share their effect
ENOUGH = 1e-7  # of the cost: a step that gains less is the last one
ITERATIONS, FEW = 100, 4  # of the best starts, and of each


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
        self.n_drive = int(w[0].shape[1])

    def filtered(self, D: Array) -> Records:
        """Return readings and drives filtered by the polynomial D(q), without the rows that lack a past."""
        w = [lfilter(D, [1.0], drive, axis=0)[len(D) - 1 :] for drive in self.w]
        return Records([lfilter(D, [1.0], y)[len(D) - 1 :] for y in self.y], w)

    def columns(self, a: Array, nb: int, delay: int) -> list[Array]:
        """Return what is linear at a denominator as rows (na + n_drive nb + 1, n), by segment: what initial
        conditions add, the filtered drives at each lag, the filtered constant."""
        # Columns are shifts: each drive less its first row, a step and an impulse are filtered by 1/A once.
        # Every lag of a drive is a shift of its filtered rows plus its first value times the step response
        # (before a segment the first row was held), every initial condition a shift of the impulse response.
        tests = np.ones((2, self.longest))
        tests[0, 1:] = 0.0
        impulse, step = lfilter([1.0], np.append(1.0, a), tests, axis=1)
        na, out = len(a), []
        for first, moves in zip(self.first, self.moves):
            n = moves.shape[1]
            X = np.zeros((na + self.n_drive * nb + 1, n))
            for row in range(min(na, n)):
                X[row, row:] = impulse[: n - row]
            filtered = lfilter([1.0], np.append(1.0, a), moves, axis=1)
            for lag in range(nb):
                late = min(delay + lag, n)
                X[na + lag : -1 : nb, late:] = filtered[:, : n - late]
            X[na:-1] += np.repeat(first, nb)[:, None] * step[:n]
            X[-1] = step[:n]
            out.append(X)
        return out


@dataclass(frozen=True, eq=False)
class Solution:
    """What is linear, solved at one denominator."""

    a: Array  # (na,)
    cost: float  # sum of squared residuals
    shared: Array  # (n_drive nb + 1,), numerators and the constant
    first: Array  # (n_segment, na), initial conditions
    outputs: list[Array]  # model output, segment by segment
    misses: list[Array]  # readings minus model output, 0 where lost
    columns: list[Array]  # of the initial conditions, then of what is shared; 0 where lost

    def slopes(self, records: Records) -> tuple[Array, Array]:
        """Return T and t of |T da - t|^2, the cost with the linear columns projected out of dv/da."""
        na, rows = len(self.a), []
        for v, miss, X, is_read in zip(self.outputs, self.misses, self.columns, records.known):
            filtered = lfilter([1.0], np.append(1.0, self.a), v)  # dv/da_i = -q^-i v / A(q): shifts too
            J = np.zeros((na, len(v)))
            for i in range(1, na + 1):
                J[i - 1, i:] = -filtered[:-i]
            rows.append(np.vstack([X, J * is_read, miss]))
        whole, _ = _triangles(rows, na)
        of_a = slice(len(self.shared), len(self.shared) + na)
        return whole[of_a, of_a], whole[of_a, -1]

    def filter(self, nb: int, delay: int) -> Filter:
        """Return the filter of these numbers."""
        b = self.shared[:-1].reshape(-1, nb)
        return Filter(self.a, b, float(self.shared[-1]), delay, self.first)


def solve(a: Array, records: Records, nb: int, delay: int) -> Solution | None:
    """Solve for b, c and the initial conditions at this denominator; None where it is unstable."""
    if not is_stable(a):
        return None
    whole = records.columns(a, nb, delay)
    # where a reading is lost the columns are empty, yet the model runs on
    columns = [X if is_read.all() else X * is_read for X, is_read in zip(whole, records.known)]
    right = [np.where(is_read, y, 0.0) for is_read, y in zip(records.known, records.y)]
    shared, first = least_squares(columns, len(a), right)
    outputs = [np.append(initial, shared) @ X for X, initial in zip(whole, first)]
    misses = [np.where(is_read, y - v, 0.0) for is_read, y, v in zip(records.known, records.y, outputs)]
    cost = float(sum(miss @ miss for miss in misses))
    return Solution(a, cost, shared, first, outputs, misses, columns)


def refine(
    start: Solution, records: Records, at: Callable[[Array], Solution | None], most: int = ITERATIONS
) -> Solution:
    """Return where Levenberg-Marquardt steps over the denominator no longer lower the cost."""
    best, damping = start, 1e-3
    for _ in range(most):
        before = best.cost
        T, t = best.slopes(records)
        weight = np.diag(np.linalg.norm(T, axis=0) + 1e-12)
        for _ in range(8):
            rows, right = np.vstack([T, np.sqrt(damping) * weight]), np.append(t, np.zeros(len(t)))
            move = np.linalg.lstsq(rows, right, rcond=None)[0]
            trial = at(best.a + move)
            if trial is not None and trial.cost < before:
                best, damping = trial, damping / 5
                break
            damping *= 5
        if before - best.cost <= ENOUGH * before:  # both are 0 where every reading was lost
            break
    return best


def _triangles(parts: Sequence[Array], na: int) -> tuple[Array, list[Array]]:
    """Return R of the QR of all rows [own | rest], the own columns of each part (na + n_rest, n) projected
    out, and R by part."""
    # shifts are nearly alike where poles are slow: hence a QR
    triangles = [_square_r(rows.T) for rows in parts]
    shared_triangles = [R[na:, na:] for R in triangles]
    one_part = len(shared_triangles) == 1
    whole = shared_triangles[0] if one_part else _square_r(np.concatenate(shared_triangles))
    return whole, triangles


def _square_r(rows: Array) -> Array:
    """Return the square R of a QR."""
    n = rows.shape[1]
    if len(rows) < n:
        rows = np.pad(rows, ((0, n - len(rows)), (0, 0)))
    return np.asarray(np.triu(dgeqrf(rows)[0][:n]))


def least_squares(
    columns: Sequence[Array], na: int, right: Sequence[Array], dependent: float = DEPENDENT
) -> tuple[Array, Array]:
    """Return the least-squares weights of the columns (n_column, n) that parts share, and those of the first
    na, which are each part's own."""
    n_own = len(columns) * na
    whole, by_part = _triangles([np.vstack(pair) for pair in zip(columns, right)], na)
    R = np.zeros((n_own + len(whole) - 1, n_own + len(whole)))
    for place, triangle in enumerate(by_part):
        rows = slice(place * na, (place + 1) * na)
        R[rows, rows], R[rows, n_own:] = triangle[:na, :na], triangle[:na, na:]
    R[n_own:, n_own:] = whole[:-1]
    size = order_selection.column_sizes(np.sqrt((R[:, :-1] ** 2).sum(axis=0)))
    weights = np.linalg.lstsq(R[:, :-1] / size, R[:, -1], rcond=dependent)[0] / size
    return weights[n_own:], weights[:n_own].reshape(-1, na)


def arx_start(records: Records, na: int, nb: int, delay: int) -> Array | None:
    """Return a_1 ... a_na of the ARX fit, None where it is unstable or too few rows are whole."""
    late = range(delay, delay + nb)
    whole = [
        y[:, None] if is_read.all() else bridge(y[:, None]) for y, is_read in zip(records.y, records.known)
    ]
    regression = Regression.of(whole, records.w, max(na, late[-1]))
    if regression is None:
        return None
    a = -regression.solve(0, na, late)[:na]
    return a if is_stable(a) else None


def fit_rest(found: Filter, records: Records) -> tuple[Filter, list[Array]]:
    """Return the filter with constant and initial conditions fitted again, and the errors left."""
    a, nb = found.a, found.b.shape[1]
    columns, right = [], []
    for X, y, is_read in zip(records.columns(a, nb, found.delay), records.y, records.known):
        X = X * is_read
        columns.append(np.delete(X, slice(len(a), -1), axis=0))
        right.append(np.where(is_read, y, 0.0) - found.b.reshape(-1) @ X[len(a) : -1])
    shared, first = least_squares(columns, len(a), right)
    misses = [y - np.append(initial, shared) @ X for y, X, initial in zip(right, columns, first)]
    return Filter(a, found.b, float(shared[0]), found.delay, first), misses


def real_pole_starts(records: Records, na: int) -> list[Array]:
    """Return denominators of real poles with time constants tau, tau / 4, ... for several tau [rows]."""
    taus = np.geomspace(3.0, max(records.longest / 3, 4.0), 6)
    roots = [[np.exp(-1 / max(tau / 4**i, 0.5)) for i in range(na)] for tau in taus]
    return [np.asarray(np.poly(poles)[1:]) for poles in roots]


def with_pole(a: Array) -> Array:
    """Return the denominator with one pole more, four times as fast as the fastest one."""
    fastest = float(np.abs(np.roots(np.append(1.0, a))).min())
    return np.asarray(np.convolve(np.append(1.0, a), [1.0, -(fastest**4)])[1:])


def is_stable(a: Array) -> bool:
    """Return whether all roots lie inside of the unit circle."""
    return bool(np.isfinite(a).all() and np.abs(np.roots(np.append(1.0, a))).max() < 1 - 1e-7)


def oe_family(
    grid: Grid,
    *,
    poles: Sequence[int] = (1, 2, 3),
    # two alone err by up to 41 % more on the rig's four logs, left out in turn
    zeros: Sequence[int] = (1, 2),
    delays: Sequence[int] = (1, 2, 3),
    terms: Sequence[tuple[str, ...]] | None = None,
    only: Collection[order_selection.Structure] | None = None,
    searches: list[Search] | None = None,
    search: type[Search] | None = None,
) -> Mapping[order_selection.Structure, StateSpaceModel]:
    """Return a model for each structure that has a stable one, by ``search`` of output error where absent;
    ``searches``, empty at first, remember the denominators of fits before."""
    out, kind = {}, search or Search
    searches = [] if searches is None else searches
    searches += [kind() for _ in grid.outputs[len(searches) :]]
    for products in order_selection.default_terms(grid) if terms is None else terms:
        w = order_selection.drives(grid, products)
        records = [Records([s.y[:, i] for s in grid.segments], w) for i in range(len(grid.outputs))]
        for na, nb, nk in product(poles, zeros, delays):
            label = f"na {na}, nb {nb}, delay {nk}" + (f", with {', '.join(products)}" if products else "")
            noise = kind.noise_numbers + kind.noise_per_pole * na
            size = (na + w[0].shape[1] * nb + 1 + noise) * len(grid.outputs)
            structure = order_selection.Structure(label, size, products)
            if only is not None and structure not in only:
                continue
            fitted = [search_one(record, na, nb, nk) for search_one, record in zip(searches, records)]
            filters = [filter_of_output for filter_of_output in fitted if filter_of_output is not None]
            if len(filters) == len(fitted):
                out[structure] = assemble(grid, filters, products)
    return out


def assemble(grid: Grid, filters: Sequence[Filter], terms: tuple[str, ...]) -> StateSpaceModel:
    """Return the model of one filter per output."""
    na, (n_drive, nb), delay = len(filters[0].a), filters[0].b.shape, filters[0].delay
    n, n_y = max(na, delay - 1 + nb), len(filters)
    A, B = np.zeros((n, n_y, n_y)), np.zeros((n, n_y, n_drive))
    for k, each in enumerate(filters):
        A[:na, k, k] = -each.a
        B[delay - 1 : delay - 1 + nb, k] = each.b.T
    constant = np.array([each.constant for each in filters])
    starts = []
    for segment, drive in enumerate(order_selection.drives(grid, terms)):
        # before its first row the drives stood
        start = order_selection.held(B @ drive[0])
        start[:na] += np.transpose([each.first[segment] for each in filters])
        start[0] += constant
        starts.append(start)
    return order_selection.polynomial_model(grid, A, B, constant, starts, terms=terms)


class Search:
    """Fits one output, structure by structure, and remembers the denominators that it found."""

    noise_numbers, noise_per_pole = 0, 0  # of the model of the noise
    solve: Callable[..., Solution | None] = staticmethod(solve)  # at a denominator

    def __init__(self) -> None:
        self._found: dict[int, list[Array]] = {}

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure, None where no start leads to one."""
        best = self._search(records, na, nb, delay)
        return None if best is None else best.filter(nb, delay)

    def starts(self, records: Records, na: int) -> list[Array]:
        """Return denominators where the search begins, beside that of ARX."""
        return [*real_pole_starts(records, na), *map(with_pole, self._found.get(na - 1, [])[:1])]

    def _search(self, records: Records, na: int, nb: int, delay: int) -> Solution | None:
        # The first structure of an order starts from ARX, from real poles at several time constants and from
        # the order below with one fast pole more; all go a few steps, the best two to the end.  Every other
        # starts from its own ARX fit and from denominators found so far: one that suits one delay is a few
        # steps from that of another.
        at = partial(self.solve, records=records, nb=nb, delay=delay)
        denominators = self._found.get(na, [])
        starts = denominators or self.starts(records, na)
        regressed = arx_start(records, na, nb, delay)
        if regressed is not None:
            starts = [regressed, *starts]
        solved = [some for some in map(at, starts) if some is not None]
        if not solved:
            return None
        if not denominators:  # the start of the least cost need not lead to it
            solved = [refine(some, records, at, FEW) for some in solved]
        cost = attrgetter("cost")
        solved.sort(key=cost)
        best = min((refine(some, records, at) for some in solved[: 1 if denominators else 2]), key=cost)
        self._found[na] = [best.a, *denominators][:2]
        return best
