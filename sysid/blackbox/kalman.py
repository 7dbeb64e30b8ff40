"""Likelihood of a linear model for logs of which readings were lost, one channel or whole rows at a time.

In innovation form, e white with covariance R,

    x+ = A x + B w + c + K e,        y = C x + y0 + e,

and with every reading at hand e is known row by row: y less its prediction.  Where a channel is lost e is
known in part, the state becomes uncertain, and how much the next readings say of it follows from its
covariance.  The Kalman filter carries both and factorises the density of whatever was read into

    ln p(y_read) = sum_t ln N(y_t,o ; C_o x_t, C_o P_t C_o' + R_oo),

o the channels read at row t.  Nothing is filled in, no row is left out, and it is the normal density of
the readings exactly (Ljung, System Identification, 2nd ed., 1999, section 14.3; Durbin and Koopman, Time
Series Analysis by State Space Methods, 2nd ed., 2012, sections 4.10 and 7.2).  Segments have a start each,
and their densities multiply.

**Fit.**  :func:`fit_likelihood` moves A, B, c, K, C, R and the starts to the maximum: exact gradients from
one backward pass, steps of Levenberg and Marquardt with the Gauss-Newton matrix of the prediction errors.
A step that would make the model unstable is refused.  It begins at K = 0, where the error of the free run
counts; the data say how much of the last errors goes into the next prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox.order_selection import with_spread
from thermogrip.sysid.blackbox.output_error import drives
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid, Segment

__all__ = ["Innovations", "fit_likelihood", "log_likelihood"]

Array = NDArray[np.float64]

ENOUGH = 0.02  # of ln p: a step that gains less is the last one
ITERATIONS = 60
SLOWEST = 1 - 1e-6  # modulus of a pole that is stable


@dataclass(frozen=True, eq=False)
class Innovations:
    """A linear model with the noise that goes with it.

    Parameters
    ----------
    model : StateSpaceModel
    gain : (n_x, n_y) ndarray
        K, state per unit of the outputs.
    covariance : (n_y, n_y) ndarray
        R of the innovations, in the outputs' units.
    starts : (n_segment, n_x) ndarray
        The state at the first row of each segment.
    log_likelihood : float
        ln p of all readings.
    """

    model: StateSpaceModel
    gain: Array
    covariance: Array
    starts: Array
    log_likelihood: float


def log_likelihood(
    model: StateSpaceModel,
    segments: Sequence[Segment],
    starts: ArrayLike,
    *,
    gain: ArrayLike,
    covariance: ArrayLike,
) -> float:
    """Return ln p of the readings that are there.

    Parameters
    ----------
    model : StateSpaceModel
    segments : sequence of Segment
        At the model's step; NaN where a reading was lost.
    starts : (n_segment, n_x) array_like
        The state at the first row of each segment.
    gain : (n_x, n_y) array_like
        K of the innovations.
    covariance : (n_y, n_y) array_like
        R of the innovations, positive definite.

    Raises
    ------
    UserError
        If an input or a disturbance is unknown in some row.
    ValueError
        If the covariance is not positive definite.

    Examples
    --------
    A random walk of 1 K a step that is read every time, and with its second reading lost:

    >>> from thermogrip.sysid.plant.log_grid import Segment
    >>> walk = StateSpaceModel((), (), ("t",), A=[[1.0]], B=np.zeros((1, 0)), C=[[1.0]], dt=1.0)
    >>> rows, none = np.arange(3.0), np.zeros((3, 0))
    >>> seen, lost = (Segment(rows, np.array([[0.0], [y], [2.0]]), none, none, "a") for y in (1.0, np.nan))
    >>> [round(log_likelihood(walk, [s], [[0.0]], gain=[[1.0]], covariance=[[1.0]]), 4) for s in (seen, lost)]
    [-3.7568, -3.1845]
    """
    from thermogrip.sysid.blackbox.kalman_kernel import run_filter  # pulls in numba

    K, R = np.asarray(gain, dtype=float), np.atleast_2d(np.asarray(covariance, dtype=float))
    if not np.all(np.linalg.eigvalsh(R) > 0):
        raise ValueError("the covariance of the innovations is not positive definite")
    total = 0.0
    for segment, x0 in zip(segments, np.atleast_2d(np.asarray(starts, dtype=float))):
        if not (np.isfinite(segment.u).all() and np.isfinite(segment.d).all()):
            raise UserError(
                "an input or a disturbance is unknown in some rows", file=segment.log, mend="fill or cut them"
            )
        stack, at = _matrices(model, segment)
        push = np.ascontiguousarray(model.push(segment.u, segment.d))
        noise = np.ascontiguousarray(K @ R @ K.T), np.ascontiguousarray(K @ R), np.ascontiguousarray(R)
        y = np.ascontiguousarray(segment.y - model.y0)
        P0 = np.zeros((model.n_x, model.n_x))
        total -= run_filter(stack, at, push, np.ascontiguousarray(model.C), y, *noise, x0.copy(), P0)[0]
    return float(total)


def fit_likelihood(grid: Grid, start: StateSpaceModel, *, iterations: int = ITERATIONS) -> Innovations | None:
    """Return the model of the greatest likelihood near a first one, None where that is unstable.

    Parameters
    ----------
    grid : Grid
        NaN where a reading was lost.
    start : StateSpaceModel
        A stable model of the same signals without switched matrices, such as a subspace or ARX fit.
    iterations : int, optional
        Steps at most.

    Examples
    --------
    Half of the readings of a block with a time constant of 100 s are lost:

    >>> from scipy.signal import lfilter
    >>> from thermogrip.datasets.schema import make_log
    >>> from thermogrip.sysid.plant.log_grid import make_grid
    >>> rng = np.random.default_rng(0)
    >>> q = np.repeat(rng.random(60), 20)
    >>> t = 25 + lfilter([0, 0.4], [1, -0.99], q) + 0.05 * rng.standard_normal(1200)
    >>> t[rng.random(1200) < 0.5] = np.nan
    >>> log = make_log(np.arange(1200.0), {"q": (q, "1", "input"), "t": (t, "degC", "output")})
    >>> first = StateSpaceModel(("q",), (), ("t",), A=[[0.95]], B=[[1.0]], C=[[1.0]], dt=1.0, y0=[20.0])
    >>> found = fit_likelihood(make_grid([log], average=1.0), first)
    >>> found.model.time_constants().round(0).tolist(), found.model.gain().round(0).tolist()
    ([99.0], [[40.0]])
    >>> np.sqrt(found.covariance).round(2).tolist()  # [degC]
    [[0.05]]
    """
    if np.abs(start.poles()).max() >= SLOWEST:
        return None
    problem = _Problem(grid, start)
    here = problem.first(start)
    damping = 1e-3
    for _ in range(iterations):
        gradient, curvature = problem.slopes(here)
        if not (np.isfinite(gradient).all() and np.isfinite(curvature).all()):
            break  # where it stands nothing can be told of a next step
        weight = np.diag(curvature) + 1e-9 * np.diag(curvature).max()
        unit, gained = np.sqrt(weight), 0.0
        for _ in range(10):
            damped = (curvature + damping * np.diag(weight)) / unit / unit[:, None]
            step = np.asarray(np.linalg.lstsq(damped, -gradient / unit, rcond=1e-14)[0]) / unit
            trial = problem.evaluate(problem.moved(here.theta, step))
            if trial.cost < here.cost:
                gained, here, damping = here.cost - trial.cost, trial, damping / 5
                break
            damping *= 5
        if gained < ENOUGH:
            break
    if not np.isfinite(here.cost):
        return None
    return problem.result(here)


def _matrices(model: StateSpaceModel, segment: Segment) -> tuple[Array, NDArray[np.int64]]:
    """Return the matrices (k, n, n) of the switches' positions in the segment, and which one each row has."""
    columns = [model.inputs.index(name) for name in model.A_switch]
    places, at = np.unique(segment.u[:, columns], axis=0, return_inverse=True)
    changes = np.stack([*model.A_switch.values()]) if columns else np.zeros((0, model.n_x, model.n_x))
    stack = model.A + np.einsum("ps,sij->pij", places, changes)
    return np.ascontiguousarray(stack), np.ascontiguousarray(at.ravel(), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters, J there, and what the filter left of each segment."""

    theta: Array
    cost: float
    passes: list[tuple[Array, ...]]


class _Problem:
    """J and its derivatives in scaled units: outputs and drives at zero mean and unit spread.

    theta is [A, W, K, C] row by row, W = [B E F c], then the starts, then the triangle of the root of R.
    """

    def __init__(self, grid: Grid, start: StateSpaceModel) -> None:
        self.grid, self.terms = grid, start.terms
        self.y0 = np.nanmean(np.concatenate([segment.y for segment in grid.segments]), axis=0)
        self.scale = np.maximum(grid.output_spread(), 1e-9)
        w = np.concatenate(drives(grid, self.terms))
        self.centre = w.mean(axis=0)
        size = w.std(axis=0)
        self.size = np.where(size > 1e-9, size, 1.0)
        self.w = [
            np.hstack([(part - self.centre) / self.size, np.ones((len(part), 1))])
            for part in drives(grid, self.terms)
        ]
        self.y = [np.ascontiguousarray((segment.y - self.y0) / self.scale) for segment in grid.segments]
        self.count = sum(np.isfinite(y).sum(axis=0) for y in self.y)
        n, p, m = start.n_x, len(self.scale), self.w[0].shape[1]
        self.shapes = [(n, n), (n, m), (n, p), (p, n), (len(self.y), n), (p, p)]
        self.ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])

    def first(self, start: StateSpaceModel) -> _Point:
        """Return the start in coordinates of unit spread, with K = 0 and the R that its free run leaves."""
        axes = np.linalg.eigh(start.spread)
        root = axes[1] * np.sqrt(np.maximum(axes[0], 1e-9 * axes[0].max()))
        back = np.linalg.inv(root)
        C = start.C @ root / self.scale[:, None]
        # what the output's level lacks is put into the states, as far as they reach it
        lift = np.linalg.pinv(C) @ ((start.y0 - self.y0) / self.scale)
        A, drive = back @ start.A @ root, back @ np.hstack([start.B, start.E, start.F])
        c = back @ start.c + drive @ self.centre + lift - A @ lift
        W = np.column_stack([drive * self.size, c])
        begin = [slice(0, max(3, min(50, len(s.time) // 4))) for s in self.grid.segments]
        starts = [
            back @ start.start(s.y[b], s.u[b], s.d[b]) + lift for s, b in zip(self.grid.segments, begin)
        ]
        zero = np.zeros(self.shapes[2])
        theta = np.concatenate([part.ravel() for part in (A, W, zero, C, np.array(starts), np.eye(len(C)))])
        misses = np.concatenate([e for *_, e in self.evaluate(theta).passes])
        spread = np.sqrt((misses**2).sum(axis=0) / self.count)
        theta[self.ends[4] :] = np.diag(np.maximum(spread, 1e-6)).ravel()
        return self.evaluate(theta)

    def parts(self, theta: Array) -> list[Array]:
        """Return A, W, K, C, the starts and the root of R."""
        pieces = np.split(theta, self.ends[:-1])
        return [np.ascontiguousarray(piece.reshape(shape)) for piece, shape in zip(pieces, self.shapes)]

    def evaluate(self, theta: Array) -> _Point:
        """Return J at theta, infinite where the model is unstable."""
        from thermogrip.sysid.blackbox.kalman_kernel import run_filter  # pulls in numba

        A, W, K, C, starts, root = self.parts(theta)
        if not np.isfinite(theta).all() or np.abs(np.linalg.eigvals(A)).max() >= SLOWEST:
            return _Point(theta, np.inf, [])
        R = root @ root.T
        Q, S, P0 = np.ascontiguousarray(K @ R @ K.T), np.ascontiguousarray(K @ R), np.zeros_like(A)
        total, passes = 0.0, []
        for y, w, x0 in zip(self.y, self.w, starts):
            at, push = np.zeros(len(y), dtype=np.int64), np.ascontiguousarray(w @ W.T)
            cost, *rest = run_filter(A[None], at, push, C, y, Q, S, R, x0, P0)
            total += cost
            passes.append(tuple(rest))
        return _Point(theta, total if np.isfinite(total) else np.inf, passes)

    def slopes(self, point: _Point) -> tuple[Array, Array]:
        """Return dJ and an approximation of its second derivative by theta, as :meth:`moved` has it."""
        from thermogrip.sysid.blackbox.kalman_kernel import run_adjoint, run_curvature

        A, _, K, C, _, root = self.parts(point.theta)
        R, n, own = root @ root.T, len(A), self.ends[3]
        slopes = [np.zeros(shape) for shape in self.shapes]
        H = np.zeros((len(point.theta), len(point.theta)))
        dR = np.zeros_like(R)
        for k, (w, (x, P, G, V, e)) in enumerate(zip(self.w, point.passes)):
            at = np.zeros(len(w), dtype=np.int64)
            dA, db, dC, dQ, dS, dR_k, dx0 = run_adjoint(A[None], at, C, x, P, G, V, e)
            slopes[0] += dA[0]
            slopes[1] += db.T @ w
            slopes[2] += 2 * dQ @ K @ R + dS @ R
            slopes[3] += dC
            slopes[4][k] = dx0
            dR += dR_k + K.T @ dQ @ K + (K.T @ dS + dS.T @ K) / 2
            place = np.concatenate([np.arange(own), own + n * k + np.arange(n)])
            H[np.ix_(place, place)] += run_curvature(A, C, w, x, G, V, e)
        inner = np.tril(2 * dR @ root)
        # a root's diagonal moves by a factor, the rest in units of its row's diagonal
        slopes[5] = inner * np.diag(root)[:, None]
        at_root = np.arange(self.ends[4], self.ends[5]).reshape(R.shape)
        informed = self.count[:, None] * (np.tril(np.ones_like(R), -1) + 2 * np.eye(len(R)))
        H[at_root, at_root] = informed + np.triu(np.ones_like(R), 1)
        return np.concatenate([part.ravel() for part in slopes]), H

    def moved(self, theta: Array, step: Array) -> Array:
        """Return theta after a step."""
        out = theta + step
        root, part = self.parts(theta)[5], self.parts(step)[5]
        unit = np.diag(root)
        grown = root + np.tril(part, -1) * unit[:, None]
        grown[np.diag_indices_from(grown)] = unit * np.exp(np.clip(np.diag(part), -2.0, 2.0))
        out[self.ends[4] :] = grown.ravel()
        return out

    def result(self, point: _Point) -> Innovations:
        """Return the model in natural units."""
        A, W, K, C, starts, root = self.parts(point.theta)
        grid, n_u, n_d = self.grid, len(self.grid.inputs), len(self.grid.disturbances)
        drive = W[:, :-1] / self.size
        model = StateSpaceModel(
            grid.inputs,
            grid.disturbances,
            grid.outputs,
            A=A,
            B=drive[:, :n_u],
            C=C * self.scale[:, None],
            dt=grid.dt,
            E=drive[:, n_u : n_u + n_d],
            c=W[:, -1] - drive @ self.centre,
            y0=self.y0,
            switches=grid.switches,
            terms=self.terms,
            F=drive[:, n_u + n_d :],
            origin="likelihood",
        )
        root = self.scale[:, None] * root
        ln_p = -point.cost - float(self.count @ np.log(self.scale))
        return Innovations(
            with_spread(model, grid, list(starts)), K / self.scale, root @ root.T, starts, ln_p
        )
