"""Output-error models: the simulated output itself is fitted, so noise does not bias the poles.

Each output is a filter of the drives w_j (inputs, disturbances, products of inputs) with one denominator,

    A(q) y[k] = sum_j B_j(q) w_j[k - n_k] + c + initial condition,     A(q) = 1 + a_1 q^-1 + ... + a_na q^-na,

B_j(q) = b_j0 + ... + b_j(nb-1) q^-(nb-1), n_k >= 1.  Given A, the output is linear in b, c and in one initial
condition per segment (an impulse response of 1/A at each of the first na rows), so these are solved for
exactly and only the a_i are iterated (variable projection).  With the model output v, the Gauss-Newton
derivatives are filters as well,

    dv/da_i = - q^-i v / A(q),        dv/db_jl = q^-(n_k + l) w_j / A(q),

all by ``scipy.signal.lfilter``.  Steps are Levenberg-Marquardt; a step that makes a root leave the unit
circle is refused.  The start is the least-squares ARX fit and, because that is biased towards fast poles, a
ladder of real poles between the step and the length of the data; the best start wins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import lfilter

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.choose import Structure, with_spread
from thermogrip.sysid.linear import evaluate_terms
from thermogrip.sysid.segments import Grid, bridge
from thermogrip.sysid.statespace import StateSpaceModel

__all__ = ["Filter", "assemble", "drives", "fit_filter", "oe_family", "oe_model"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Filter:
    """One output as a filter of the drives.

    Parameters
    ----------
    a : (na,) ndarray
        a_1 ... a_na of the denominator.
    b : (n_drive, nb) ndarray
        Numerators, the first one ``delay`` rows after the drive.
    constant : float
        c of the module's equation.
    delay : int
        n_k, at least 1.
    rmse : float
        Free-run error over the training data, in the output's unit.
    """

    a: Array
    b: Array
    constant: float
    delay: int
    rmse: float

    @property
    def stable(self) -> bool:
        """Whether the roots of the denominator lie inside the unit circle."""
        return _stable(self.a)


def oe_family(
    grid: Grid,
    *,
    poles: Sequence[int] = (1, 2, 3),
    zeros: Sequence[int] = (1, 2),
    delays: Sequence[int] = (1, 2, 3),
    terms: Sequence[tuple[str, ...]] = ((),),
) -> Mapping[Structure, StateSpaceModel]:
    """Return an output-error model for each structure that has a stable one.

    Parameters
    ----------
    grid : Grid
    poles, zeros, delays : sequence of int, optional
        Orders na and nb and delays n_k [rows] to try.
    terms : sequence of tuple of str, optional
        Sets of products of inputs to try.
    """
    out = {}
    for some, na, nb, nk in product(terms, poles, zeros, delays):
        model = _fit(grid, na, nb, nk, some)
        if model is not None:
            n_drive = len(grid.inputs) + len(grid.disturbances) + len(some)
            label = f"na {na}, nb {nb}, delay {nk}" + (f", with {', '.join(some)}" if some else "")
            out[Structure(label, (na + n_drive * nb + 1) * len(grid.outputs))] = model
    return out


def oe_model(
    grid: Grid, *, poles: int, zeros: int, delay: int = 1, terms: tuple[str, ...] = ()
) -> StateSpaceModel:
    """Return the output-error model of one structure.

    Raises
    ------
    UserError
        If no stable model was found.
    """
    model = _fit(grid, poles, zeros, delay, terms)
    if model is None:
        raise UserError(f"no stable output-error model with {poles} pole(s)", mend="try another order")
    return model


def drives(grid: Grid, terms: Sequence[str]) -> list[Array]:
    """Return the columns w = [u, d, phi(u, d)] of each segment, shape (n, n_drive).

    A column that never moves anywhere cannot be told from a constant; it is zero here, so that its effect is
    fitted as none and not as an arbitrary share of the constant.
    """
    names = grid.inputs + grid.disturbances
    rows = [np.hstack([segment.u, segment.d]) for segment in grid.segments]
    w = [np.hstack([some, evaluate_terms(terms, names, some)]) for some in rows]
    whole = np.concatenate(w)
    moves = np.ptp(whole, axis=0) > 1e-9 * np.maximum(np.abs(whole).max(axis=0), 1e-300)
    return [column * moves for column in w]


def fit_filter(y: Sequence[Array], w: Sequence[Array], *, na: int, nb: int, delay: int) -> Filter | None:
    """Fit one output by least squares of the free run.

    Parameters
    ----------
    y : sequence of (n,) ndarray
        Readings of each segment; NaN rows carry no weight.
    w : sequence of (n, n_drive) ndarray
        Drives of each segment.
    na, nb, delay : int
        Orders and delay [rows].

    Returns
    -------
    Filter, or None where no start led to a stable one.
    """
    starts = [_real_poles(tau, na) for tau in _ladder(y)]
    regressed = _least_squares_poles(y, w, na, nb, delay)
    if regressed is not None:
        starts.insert(0, regressed)
    first = [(_project(a, y, w, nb, delay), a) for a in starts]
    ranked = sorted(((fit[0], tuple(a)) for fit, a in first if fit is not None))[:2]
    best: tuple[float, Array] | None = None
    for _, start in ranked:
        cost, a = _iterate(np.array(start), y, w, nb, delay)
        if best is None or cost < best[0]:
            best = (cost, a)
    if best is None:
        return None
    solved = _project(best[1], y, w, nb, delay)
    if solved is None:
        return None
    cost, linear, _ = solved
    n_drive, count = w[0].shape[1], sum(int(np.isfinite(column).sum()) for column in y)
    b = linear[: n_drive * nb].reshape(n_drive, nb)
    return Filter(best[1], b, float(linear[n_drive * nb]), delay, float(np.sqrt(cost / count)))


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
    stacked, n_u, n_d = np.vstack(W), len(grid.inputs), len(grid.disturbances)
    model = StateSpaceModel(
        grid.inputs,
        grid.disturbances,
        grid.outputs,
        A=block_diag(*A),
        B=stacked[:, :n_u],
        C=block_diag(*C),
        dt=grid.dt,
        E=stacked[:, n_u : n_u + n_d],
        c=np.concatenate(c),
        switches=grid.switches,
        terms=terms,
        F=stacked[:, n_u + n_d :],
        origin=origin,
    )
    return with_spread(model, grid)


def _fit(grid: Grid, na: int, nb: int, delay: int, terms: tuple[str, ...]) -> StateSpaceModel | None:
    w = drives(grid, terms)
    filters = []
    for i in range(len(grid.outputs)):
        found = fit_filter([segment.y[:, i] for segment in grid.segments], w, na=na, nb=nb, delay=delay)
        if found is None:
            return None
        filters.append(found)
    return assemble(grid, filters, terms, origin="oe")


def _project(
    a: Array, y: Sequence[Array], w: Sequence[Array], nb: int, delay: int
) -> tuple[float, Array, list[Array]] | None:
    """Solve for b, c and the initial conditions at this denominator: (cost, solution, model outputs)."""
    if not _stable(a):
        return None
    blocks, targets, wholes = [], [], []
    n_shared = w[0].shape[1] * nb + 1
    for at, (reading, drive) in enumerate(zip(y, w)):
        whole = np.zeros((len(reading), n_shared + len(a) * len(y)))
        whole[:, : n_shared - 1] = _lagged(drive, nb, delay)
        whole[:, n_shared - 1] = 1.0
        first = n_shared + at * len(a)
        whole[: len(a), first : first + len(a)] = np.eye(len(reading), len(a))[: len(a)]
        whole = lfilter([1.0], np.append(1.0, a), whole, axis=0)
        known = np.isfinite(reading)
        blocks.append(whole[known])
        targets.append(reading[known])
        wholes.append(whole)
    rows, right = np.concatenate(blocks), np.concatenate(targets)
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    gram = (rows / size).T @ (rows / size)
    gram[np.diag_indices_from(gram)] += 1e-10
    linear = np.linalg.solve(gram, (rows / size).T @ right) / size
    seen = [whole @ linear for whole in wholes]
    miss = right - rows @ linear
    return float(miss @ miss), linear, seen


def _iterate(a: Array, y: Sequence[Array], w: Sequence[Array], nb: int, delay: int) -> tuple[float, Array]:
    """Levenberg-Marquardt over the denominator, the linear part projected out (Kaufman's Jacobian)."""
    state = _project(a, y, w, nb, delay)
    if state is None:
        return float("inf"), a
    damping = 1e-3
    for _ in range(30):
        cost, _, seen = state
        J, miss = _denominator_jacobian(a, y, w, nb, delay, seen)
        gram, slope = J.T @ J, J.T @ miss
        improved = False
        for _ in range(8):
            step = np.linalg.solve(gram + damping * np.diag(np.diag(gram) + 1e-12), slope)
            trial = _project(a + step, y, w, nb, delay)
            if trial is not None and trial[0] < cost:
                a, state, damping, improved = a + step, trial, damping / 5, True
                break
            damping *= 5
        if not improved or cost - state[0] < 1e-6 * cost:
            break
    return state[0], a


def _denominator_jacobian(
    a: Array, y: Sequence[Array], w: Sequence[Array], nb: int, delay: int, seen: Sequence[Array]
) -> tuple[Array, Array]:
    """Return dv/da with the linear columns projected out, and the residual."""
    slopes, linear, misses = [], [], []
    n_shared = w[0].shape[1] * nb + 1
    for at, (reading, drive, v) in enumerate(zip(y, w, seen)):
        known, na = np.isfinite(reading), len(a)
        late = np.column_stack([np.append(np.zeros(i), -v[: len(v) - i]) for i in range(1, na + 1)])
        columns = np.zeros((len(v), n_shared + na * len(y)))
        columns[:, : n_shared - 1] = _lagged(drive, nb, delay)
        columns[:, n_shared - 1] = 1.0
        first = n_shared + at * na
        columns[:na, first : first + na] = np.eye(na)
        both = lfilter([1.0], np.append(1.0, a), np.hstack([late, columns]), axis=0)[known]
        slopes.append(both[:, :na])
        linear.append(both[:, na:])
        misses.append((reading - v)[known])
    X, J = np.concatenate(linear), np.concatenate(slopes)
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-12)
    gram = X.T @ X
    gram[np.diag_indices_from(gram)] += 1e-10
    return J - X @ np.linalg.solve(gram, X.T @ J), np.concatenate(misses)


def _least_squares_poles(
    y: Sequence[Array], w: Sequence[Array], na: int, nb: int, delay: int
) -> Array | None:
    """Return a_1 ... a_na of the ARX fit, None where it is unstable or too few rows are whole."""
    rows, right = [], []
    for reading, drive in zip(y, w):
        whole = bridge(reading[:, None])[:, 0]
        past = np.column_stack([np.append(np.full(i, np.nan), -whole[:-i]) for i in range(1, na + 1)])
        block = np.hstack([past, _lagged(drive, nb, delay), np.ones((len(reading), 1))])
        block[: max(na, delay + nb - 1)] = np.nan
        known = np.isfinite(block).all(axis=1) & np.isfinite(reading)
        rows.append(block[known])
        right.append(reading[known])
    X, target = np.concatenate(rows), np.concatenate(right)
    if len(target) < 2 * X.shape[1]:
        return None
    a = np.asarray(np.linalg.lstsq(X, target, rcond=None)[0][:na])
    return a if _stable(a) else None


def _lagged(drive: Array, nb: int, delay: int) -> Array:
    """Return w_j[k - delay - l], columns drive by drive; before the segment the first row was held."""
    n = len(drive)
    at = np.maximum(np.arange(n)[:, None] - delay - np.arange(nb)[None], 0)
    return np.asarray(np.moveaxis(drive[at], 2, 1).reshape(n, -1))


def _ladder(y: Sequence[Array]) -> Array:
    """Return time constants [rows] to start from."""
    return np.geomspace(3.0, max(len(column) for column in y) / 3, 6)


def _real_poles(tau: float, na: int) -> Array:
    """Return the denominator with poles of time constants tau, tau / 4, ... [rows]."""
    roots = [np.exp(-1 / max(tau / 4**i, 0.5)) for i in range(na)]
    return np.asarray(np.poly(roots)[1:])


def _stable(a: Array) -> bool:
    return bool(np.abs(np.roots(np.append(1.0, a))).max(initial=0.0) < 1 - 1e-7)
