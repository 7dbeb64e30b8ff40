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
from itertools import product
from operator import attrgetter

import numpy as np
from scipy.linalg import block_diag
from scipy.linalg.lapack import dgeqrf
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox import order_selection
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
    shared: Array  # (n_drive nb + 1,), numerators and the constant
    first: Array  # (n_segment, na), initial conditions
    outputs: list[Array]  # model output, segment by segment
    misses: list[Array]  # readings minus model output, 0 where lost
    columns: list[Array]

    def slopes(self, records: Records) -> tuple[Array, Array]:
        """Return T and t of |T da - t|^2, the cost with the linear columns projected out of dv/da."""
        na, rows = len(self.a), []
        for v, miss, X, is_read in zip(self.outputs, self.misses, self.columns, records.known):
            filtered = lfilter([1.0], np.append(1.0, self.a), v)  # dv/da_i = -q^-i v / A(q): shifts too
            J = np.zeros((na, len(v)))
            for i in range(1, na + 1):
                J[i - 1, i:] = -filtered[:-i]
            rows.append(np.vstack([X[len(self.shared) :], X[: len(self.shared)], J * is_read, miss]))
        whole, _ = _triangles(rows, na)
        of_a = slice(len(self.shared), len(self.shared) + na)
        return whole[of_a, of_a], whole[of_a, -1]

    def filter(self, records: Records, nb: int, delay: int) -> Filter:
        """Return the filter of these numbers."""
        b = self.shared[:-1].reshape(-1, nb)
        return Filter(self.a, b, float(self.shared[-1]), delay, self.first)


def solve(a: Array, records: Records, nb: int, delay: int) -> Solution | None:
    """Solve for b, c and the initial conditions at this denominator; None where it is unstable."""
    if not is_stable(a):
        return None
    n_shared = records.n_drive * nb + 1
    impulse, step = responses(a, records)
    segments = range(len(records.y))
    columns = [columns_of(a, records, segment, nb, delay, impulse, step) for segment in segments]
    right = [np.where(is_read, y, 0.0) for is_read, y in zip(records.known, records.y)]
    shared, first = least_squares([X[n_shared:] for X in columns], [X[:n_shared] for X in columns], right)
    outputs, misses = [], []
    for segment, is_read in enumerate(records.known):
        # where a reading is lost the columns are empty, yet the model runs on
        whole = columns[segment]
        if not is_read.all():
            whole = columns_of(a, records, segment, nb, delay, impulse, step, lost=True)
        outputs.append(shared @ whole[:n_shared] + first[segment] @ whole[n_shared:])
        misses.append(np.where(is_read, records.y[segment] - outputs[-1], 0.0))
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
    own: Sequence[Array], shared: Sequence[Array], right: Sequence[Array], dependent: float = DEPENDENT
) -> tuple[Array, Array]:
    """Return the least-squares weights of the shared columns, and those of each part's own ones."""
    na, n_own = len(own[0]), len(own) * len(own[0])
    whole, by_part = _triangles([np.vstack(trio) for trio in zip(own, shared, right)], na)
    R = np.zeros((n_own + len(whole) - 1, n_own + len(whole)))
    for place, triangle in enumerate(by_part):
        rows = slice(place * na, (place + 1) * na)
        R[rows, rows], R[rows, n_own:] = triangle[:na, :na], triangle[:na, na:]
    R[n_own:, n_own:] = whole[:-1]
    size = order_selection.column_sizes(np.sqrt((R[:, :-1] ** 2).sum(axis=0)))
    weights = np.linalg.lstsq(R[:, :-1] / size, R[:, -1], rcond=dependent)[0] / size
    return weights[n_own:], weights[:n_own].reshape(-1, na)


def responses(a: Array, records: Records) -> Array:
    """Return the responses of 1/A to an impulse and to a step."""
    tests = np.zeros((2, records.longest))
    tests[0, 0], tests[1] = 1.0, 1.0
    return np.asarray(lfilter([1.0], np.append(1.0, a), tests, axis=1))


def arx_start(records: Records, na: int, nb: int, delay: int) -> Array | None:
    """Return a_1 ... a_na of the ARX fit, None where it is unstable or too few rows are whole."""
    deep = max(na, delay + nb - 1)
    n = na + records.n_drive * nb + 1
    gram = np.zeros((n, n))
    right = np.zeros(n)
    count = 0
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
        gram = gram + X.T @ X
        right = right + X.T @ y
        count = count + len(y)
    if count < 2 * n:
        return None
    size = order_selection.column_sizes(np.sqrt(np.diag(gram)))
    a = np.asarray((np.linalg.lstsq(gram / size / size[:, None], right / size, rcond=1e-13)[0] / size)[:na])
    return a if is_stable(a) else None


def fit_rest(found: Filter, records: Records) -> tuple[Filter, list[Array]]:
    """Return the filter with constant and initial conditions fitted again, and the errors left."""
    a, (n_drive, nb) = found.a, found.b.shape
    end = n_drive * nb
    impulse, step = responses(a, records)
    columns, right = [], []
    for segment, is_read in enumerate(records.known):
        X = columns_of(a, records, segment, nb, found.delay, impulse, step)
        columns.append(X[end:])
        right.append(np.where(is_read, records.y[segment], 0.0) - found.b.reshape(-1) @ X[:end])
    shared, first = least_squares([X[1:] for X in columns], [X[:1] for X in columns], right)
    misses = [y - shared @ X[:1] - initial @ X[1:] for y, X, initial in zip(right, columns, first)]
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


def columns_of(
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
    moves, is_read = records.moves[at], records.known[at]
    n_drive, n = moves.shape
    na, end = len(a), n_drive * nb
    # Columns are shifts: each drive less its first row, a step and an impulse are filtered by 1/A once.
    # Every lag of a drive is a shift of its filtered rows plus its first value times the step response
    # (before a segment the first row was held), every initial condition a shift of the impulse response.
    filtered = lfilter([1.0], np.append(1.0, a), moves, axis=1)
    X = np.zeros((end + 1 + na, n))
    for lag in range(nb):
        late = min(delay + lag, n)
        X[lag:end:nb, late:] = filtered[:, : n - late]
    X[:end] += np.repeat(records.first[at], nb)[:, None] * step[:n]
    X[end] = step[:n]
    for row in range(min(na, n)):
        X[end + 1 + row, row:] = impulse[: n - row]
    if not lost and not is_read.all():
        X *= is_read
    return X


def is_stable(a: Array) -> bool:
    """Return whether all roots lie inside of the unit circle (Schur-Cohn: every reflection is below one)."""
    coefficients = [value / (1 - 1e-7) ** i for i, value in enumerate(a.tolist(), start=1)]
    while coefficients:
        last = coefficients.pop()
        if not abs(last) < 1:
            return False
        coefficients = [(x - last * y) / (1 - last * last) for x, y in zip(coefficients, coefficients[::-1])]
    return True


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
            size = (na + w[0].shape[1] * nb + kind.numbers(na)) * len(grid.outputs)
            structure = order_selection.Structure(label, size, products)
            if only is not None and structure not in only:
                continue
            fitted = [search_one(record, na, nb, nk) for search_one, record in zip(searches, records)]
            filters = [filter_of_output for filter_of_output in fitted if filter_of_output is not None]
            if len(filters) == len(fitted):
                out[structure] = assemble(grid, filters, products, origin=kind.origin)
    return out


def assemble(
    grid: Grid, filters: Sequence[Filter], terms: tuple[str, ...], *, origin: str
) -> StateSpaceModel:
    """Return the model of one filter per output, block by block, in observer form: v_1+ = -a_1 v_1 + v_2 +
    (numerator row) w, ..., y = v_1, behind n_k - 1 rows of pure shift for a delay of n_k."""
    A = []
    W = []
    c = []
    C = []
    for filter_of_output in filters:
        na, (n_drive, nb) = len(filter_of_output.a), filter_of_output.b.shape
        n = max(na, filter_of_output.delay - 1 + nb)
        block = np.diag(np.ones(n - 1), 1)
        block[:na, 0] -= filter_of_output.a
        push = np.zeros((n, n_drive))
        push[filter_of_output.delay - 1 : filter_of_output.delay - 1 + nb] = filter_of_output.b.T
        A.append(block)
        W.append(push)
        c.append(np.concatenate([[filter_of_output.constant], np.zeros(n - 1)]))
        C.append(np.eye(1, n))
    matrices = block_diag(*A), np.vstack(W), block_diag(*C), np.concatenate(c)
    model = order_selection.as_state_space(grid, *matrices, terms=terms, origin=origin)
    starts = [
        _first_states(filters, w[0], segment) for segment, w in enumerate(order_selection.drives(grid, terms))
    ]
    return order_selection.with_spread(model, grid, starts)


def _first_states(filters: Sequence[Filter], held: Array, segment: int) -> Array:
    """Return the state at a segment's first row, before which the drives ``held`` stood."""
    out = []
    for filter_of_output in filters:
        na, (_, nb) = len(filter_of_output.a), filter_of_output.b.shape
        x = np.zeros(max(na, filter_of_output.delay - 1 + nb))
        x[:na] += filter_of_output.first[segment]
        x[0] += filter_of_output.constant
        for lag, gain in enumerate(filter_of_output.b.T @ held, start=filter_of_output.delay):
            x[:lag] += gain  # a drive so many rows back still acts on the rows before its lag
        out.append(x)
    return np.concatenate(out)


class Search:
    """Fits one output, structure by structure, and remembers the denominators that it found."""

    origin = "oe"

    def __init__(self) -> None:
        self._found: dict[int, list[Array]] = {}

    @staticmethod
    def numbers(na: int) -> int:
        """Return the count of numbers of an output beside poles and zeros."""
        return 1

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure, None where no start leads to one."""
        best = self._search(records, na, nb, delay, lambda a: solve(a, records, nb, delay))
        return None if best is None else best.filter(records, nb, delay)

    def starts(self, records: Records, na: int) -> list[Array]:
        """Return denominators where the search begins, beside that of ARX."""
        return [*real_pole_starts(records, na), *map(with_pole, self._found.get(na - 1, [])[:1])]

    def _search(
        self, records: Records, na: int, nb: int, delay: int, at: Callable[[Array], Solution | None]
    ) -> Solution | None:
        # The first structure of an order starts from ARX, from real poles at several time constants and from
        # the order below with one fast pole more; all go a few steps, the best two to the end.  Every other
        # starts from its own ARX fit and from denominators found so far: one that suits one delay is a few
        # steps from that of another.
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
