"""Output-error models: the simulated output itself is fitted, so noise does not bias the poles.

Each output is a filter of the drives w_j (inputs, disturbances, products of inputs such as ``|drive|`` and
``drive*|drive|``) with one denominator, fitted by least squares of the free run
(:mod:`thermogrip.sysid.blackbox.output_error_fit`).

**Many structures, few searches.**  The first structure of each denominator order starts from the ARX fit
and, because that is biased towards fast poles, from a ladder of real poles between the step and the length
of the data and from the order below with one fast pole more; the best two are refined.  Every other
structure of that order starts from its own ARX fit and from the refined denominators found so far: the best
of them is refined alone.  A denominator that suits one delay is a few steps from that of another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox.order_selection import Structure, with_spread
from thermogrip.sysid.blackbox.output_error_fit import (
    Filter,
    Records,
    arx_start,
    ladder,
    refine,
    solve,
    with_pole,
)
from thermogrip.sysid.models.lti import evaluate_terms
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid

__all__ = ["Filter", "assemble", "drives", "fit_filter", "oe_family", "oe_model"]

Array = NDArray[np.float64]


def oe_family(
    grid: Grid,
    *,
    poles: Sequence[int] = (1, 2, 3),
    zeros: Sequence[int] = (1, 2),
    delays: Sequence[int] = (1, 2, 3),
    terms: Sequence[tuple[str, ...]] = ((),),
    only: Structure | None = None,
) -> Mapping[Structure, StateSpaceModel]:
    """Return an output-error model for each structure that has a stable one.

    Parameters
    ----------
    grid : Grid
    poles, zeros, delays : sequence of int, optional
        Orders na and nb and delays n_k [rows] to try.
    terms : sequence of tuple of str, optional
        Sets of products of inputs to try.
    only : Structure, optional
        Fit this one alone.
    """
    out = {}
    searches = [_Search() for _ in grid.outputs]
    for some in terms:
        w = drives(grid, some)
        records = [Records([s.y[:, i] for s in grid.segments], w) for i in range(len(grid.outputs))]
        for na, nb, nk in product(poles, zeros, delays):
            label = f"na {na}, nb {nb}, delay {nk}" + (f", with {', '.join(some)}" if some else "")
            structure = Structure(label, (na + w[0].shape[1] * nb + 1) * len(grid.outputs))
            if only not in (None, structure):
                continue
            found = [search(part, na, nb, nk) for search, part in zip(searches, records)]
            filters = [each for each in found if each is not None]
            if len(filters) == len(found):
                out[structure] = assemble(grid, filters, some, origin="oe")
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
    w = drives(grid, terms)
    columns = [[segment.y[:, i] for segment in grid.segments] for i in range(len(grid.outputs))]
    found = [fit_filter(y, w, na=poles, nb=zeros, delay=delay) for y in columns]
    filters = [each for each in found if each is not None]
    if len(filters) < len(found):
        raise UserError(f"no stable output-error model with {poles} pole(s)", mend="try another order")
    return assemble(grid, filters, terms, origin="oe")


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
    return _Search()(Records(y, w), na, nb, delay)


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


class _Search:
    """Fits one output, structure by structure, and remembers the denominators that it found."""

    def __init__(self) -> None:
        self._found: dict[int, list[Array]] = {}

    def __call__(self, records: Records, na: int, nb: int, delay: int) -> Filter | None:
        """Return the best stable filter of this structure, None where no start leads to one."""
        known = self._found.get(na, [])
        starts = known or [*ladder(records, na), *map(with_pole, self._found.get(na - 1, [])[:1])]
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
