r"""The move as a table: the explicit law of a design with few unknowns.

Linear about rest, the program of a sample with range and slew as its limits is

    minimise 1/2 z'Hz + f'z    subject to    low <= z <= high,    |z_i - z_i-1| <= s_i,

z the plan in fractions of the drives' ranges, z_-1 the drive applied now.  Only f and z_-1 change from sample
to sample, f linearly with estimate, target and measured disturbances.  For a set W of limits that hold with
equality, G_W z = b_W, the Karush-Kuhn-Tucker conditions are linear in p = (f, z_-1):

    lambda = - (G_W H^-1 G_W')^-1 (b_W + G_W H^-1 f),     z = - H^-1 (f + G_W' lambda),

so the solution is affine in p on the polyhedron where lambda >= 0 and all other limits hold: a *critical
region* [1]_.  Every W of at most n independent rows is tried, and kept where a linear program finds a point
inside; together the regions cover all p.  With n unknowns there are up to sum_k C(2n, k) 2^k sets, so this is
for a handful of blocks.

The overshoot band and the limits of outputs are soft rows whose number is that of the samples; the law
leaves them out, as it leaves out what a Peltier element loses near its optimum.

References
----------
.. [1] A. Bemporad, M. Morari, V. Dua, E. N. Pistikopoulos, "The explicit linear quadratic regulator for
   constrained systems", Automatica 38(1), 2002.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product
from math import comb
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.linear_equivalent import linear_move, plan_gains

if TYPE_CHECKING:
    from thermogrip.mpc.controllers.mpc import Controller

__all__ = ["ExplicitLaw", "Region", "explicit_law"]

Array = NDArray[np.float64]

_INSIDE = 1e-9  # of a row of a region
_ROOM = 1e-7  # radius of the ball that a region must hold


@dataclass(frozen=True, eq=False)
class Region:
    """Where one set of limits holds with equality.

    Attributes
    ----------
    active : tuple of (int, int)
        Row and side (+1 upper, -1 lower) of each of these limits.
    gain, offset : (n, n_p), (n,) ndarray
        The plan is ``gain p + offset``.
    rows, bounds : (m, n_p), (m,) ndarray
        The region is ``rows p <= bounds``, rows of length 1.
    """

    active: tuple[tuple[int, int], ...]
    gain: Array
    offset: Array
    rows: Array
    bounds: Array


@dataclass(frozen=True, eq=False)
class ExplicitLaw:
    """The plan as a piecewise affine function of p = (f, drive applied now in fractions of its range).

    Attributes
    ----------
    regions : tuple of Region
    H : (n, n) ndarray
    span : (n_u,) ndarray
        Width of each drive's range.
    by : tuple of ndarray
        What f is made of: matrices for the estimate (n_z,), the target (n_c,), the measured disturbances
        (n_d,) and the drive applied now (n_u,), all in changes from rest.
    """

    regions: tuple[Region, ...]
    H: Array
    span: Array
    by: tuple[Array, Array, Array, Array]

    def program(self, z: Array, target: Array, d: Array, last: Array) -> Array:
        """Return f (n,) of a sample: estimate of state and disturbances, target, measured d, drive now."""
        return np.asarray(sum(matrix @ part for matrix, part in zip(self.by, (z, target, d, last))))

    def plan(self, f: Array, last: Array) -> Array:
        """Return the plan (n,) in fractions of the drives' ranges for f (n,) and the drives now (n_u,)."""
        p = np.concatenate([f, last / self.span])
        off = [float(np.max(region.rows @ p - region.bounds, initial=-np.inf)) for region in self.regions]
        best = self.regions[int(np.argmin(off))]
        return np.asarray(best.gain @ p + best.offset)

    def drive(self, f: Array, last: Array) -> Array:
        """Return the first move (n_u,) in the drives' units."""
        return self.plan(f, last)[: len(self.span)] * self.span

    @property
    def numbers(self) -> int:
        """How many numbers the table holds."""
        return sum(r.gain.size + r.offset.size + r.rows.size + r.bounds.size for r in self.regions)


def explicit_law(controller: Controller, *, most: int = 2000) -> ExplicitLaw:
    """Return the explicit law of a controller's linear program.

    Parameters
    ----------
    controller : Controller
    most : int, optional
        Sets of limits to try at most.

    Raises
    ------
    UserError
        If there are more sets than that.

    Examples
    --------
    A heater of two blocks; 0.1 degC below the target with the drive at 0.5, and 20 degC below:

    >>> from thermogrip.mpc.controllers.mpc import design_controller
    >>> from thermogrip.sysid import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> a = float(np.exp(-0.05))
    >>> A, B = [[a, 40 * (1 - a)], [0, 0]], [[0], [1]]
    >>> heater = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0]], dt=5.0, y0=[25.0])
    >>> plant = Plant(heater, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0)})
    >>> law = explicit_law(design_controller(plant, blocks=(1, 9)))
    >>> now, none, half = np.zeros(3), np.zeros(0), np.array([0.5])
    >>> moves = [law.drive(law.program(now, np.array([r]), none, half), half) for r in (0.1, 20.0)]
    >>> len(law.regions), [round(float(move[0]), 2) for move in moves]
    (21, [0.08, 1.0])
    """
    optimiser, model = controller.optimiser, controller.model
    n, n_u = optimiser.n_b * model.n_u, model.n_u
    tried = sum(comb(2 * n, size) * 2**size for size in range(n + 1))
    if tried > most:
        raise UserError(
            f"{optimiser.n_b} blocks of {n_u} drives have {tried} sets of limits, {most} are tried at most",
            mend="take fewer blocks (blocks = [1, 2, 8]), or export the controller as C",
        )
    H, _, _ = linear_move(controller)
    G = np.vstack([np.eye(n), optimiser.differences])
    span = np.tile(model.span, optimiser.n_b)
    high = np.concatenate([np.tile(optimiser.highest, optimiser.n_b) / span, optimiser.slews / span])
    low = np.concatenate([np.tile(optimiser.lowest, optimiser.n_b) / span, -optimiser.slews / span])
    on_last = np.zeros((2 * n, n_u))  # the first slew counts from the drive applied now
    on_last[n : n + n_u] = np.eye(n_u)
    found = []
    for size in range(n + 1):
        for rows in combinations(range(2 * n), size):
            if size and np.linalg.matrix_rank(G[list(rows)]) < size:
                continue
            for sides in product((1, -1), repeat=size):
                region = _region(H, G, (low, high), on_last, tuple(zip(rows, sides)))
                if _has_inside(region):
                    found.append(region)
    on_z, on_r, on_d, on_u = (-H @ (gain / span[:, None]) for gain in plan_gains(controller))
    return ExplicitLaw(tuple(found), H, model.span, (on_z, on_r, on_d, on_u))


def _region(
    H: Array, G: Array, ends: tuple[Array, Array], on_last: Array, active: tuple[tuple[int, int], ...]
) -> Region:
    """Return the affine plan of one set of limits, and where it is the solution."""
    n, n_u = len(H), on_last.shape[1]
    low, high = ends
    back = np.linalg.inv(H)
    rows = [row for row, _ in active]
    sides = np.array([float(side) for _, side in active])
    held = G[rows] * sides[:, None]
    value = np.array([high[row] if side > 0 else -low[row] for row, side in active])
    # lambda = -(by_f f + by_last z_-1 + fixed)
    inner = np.linalg.inv(held @ back @ held.T) if rows else np.zeros((0, 0))
    multipliers = -inner @ np.hstack([held @ back, on_last[rows] * sides[:, None]])
    fixed = -inner @ value
    gain = -back @ (np.hstack([np.eye(n), np.zeros((n, n_u))]) + held.T @ multipliers)
    offset = -back @ held.T @ fixed
    others = [row for row in range(len(G)) if row not in rows]
    moved = G[others] @ gain - np.hstack([np.zeros((len(others), n)), on_last[others]])
    all_rows = np.vstack([-multipliers, moved, -moved])
    still = G[others] @ offset
    bounds = np.concatenate([fixed, high[others] - still, still - low[others]])
    length = np.maximum(np.linalg.norm(all_rows, axis=1), 1e-300)
    return Region(active, gain, offset, all_rows / length[:, None], bounds / length)


def _has_inside(region: Region) -> bool:
    """Return whether a ball fits into a region (a linear program for the largest one)."""
    from scipy.optimize import linprog

    n_p = region.rows.shape[1]
    found = linprog(
        np.append(np.zeros(n_p), -1.0),
        A_ub=np.hstack([region.rows, np.ones((len(region.rows), 1))]),
        b_ub=region.bounds,
        bounds=[(None, None)] * n_p + [(None, 1.0)],
    )
    return found.status == 0 and found.x is not None and bool(found.x[-1] > _ROOM)
