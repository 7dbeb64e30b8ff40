"""Sparse nonlinear difference equations with control (SINDy), by pysindy.

With z the outputs, their last values (``memory``), inputs and disturbances, each scaled to zero mean and
unit spread,

    y[k+1] = y[k] + Xi' Theta(z[k]),

Theta all monomials up to a degree, and Xi sparse: sequentially thresholded least squares (STLSQ; Brunton,
Proctor, Kutz) drops what is smaller than a threshold, refits, and repeats.  The increment is fitted rather
than the next value, so that the threshold weighs what moves the plant and not that it stands still.  Degree,
threshold and memory are chosen by held-out free run; an equation whose simulation leaves ten times the range
of the data is refused.

The equations are kept in natural units (degrees and the units of the inputs), as coefficients and
exponents: no pickle, and ``step`` is plain arithmetic.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import comb
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.choose import Structure
from thermogrip.sysid.linear import join_columns
from thermogrip.sysid.segments import Grid, Segment, whole_readings

__all__ = ["SindyModel", "sindy_family", "sindy_model"]

Array = NDArray[np.float64]

BOUND = 10.0  # spreads beyond the range of the data: a simulation that leaves it has diverged


@dataclass(frozen=True, eq=False)
class SindyModel:
    """Polynomial difference equations of the outputs.

    Parameters
    ----------
    inputs, disturbances, outputs, switches : tuple of str
    dt : float
        Step [s].
    memory : int
        How many past values of each output the equations see, at least 1; the state is
        [y[k], y[k-1], ...].
    exponents : (n_term, n_variable) array_like of int
        Powers of the variables [state, inputs, disturbances] in each term.
    coefficients : (n_y, n_term) array_like
        Of y[k+1], in natural units.
    low, high : (n_y,) array_like
        Range of the outputs in the data of the fit.
    spread : (n_x, n_x) array_like, optional
        Covariance of the state in the data of the fit.

    Examples
    --------
    >>> powers = [[0, 0], [1, 0], [0, 1]]
    >>> cooling = SindyModel(("q",), (), ("t",), (), 1.0, 1, powers, [[2.0, 0.9, 0.5]], [0], [50])
    >>> cooling.equations()
    ('t[k+1] = 2 + 0.9 t + 0.5 q',)
    >>> cooling.step([20.0], [1.0], [], [], 1.0)
    [20.5]
    """

    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    outputs: tuple[str, ...]
    switches: tuple[str, ...]
    dt: float
    memory: int
    exponents: NDArray[np.int_]
    coefficients: Array
    low: Array
    high: Array
    spread: Array = field(default_factory=lambda: np.empty(0))

    kind = "sindy"
    origin = "sindy"
    parameters: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("coefficients", "low", "high"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        object.__setattr__(self, "exponents", np.asarray(self.exponents, dtype=int))
        n_variable = self.n_x + len(self.inputs) + len(self.disturbances)
        n_term = self.exponents.shape[0]
        if self.exponents.shape != (n_term, n_variable) or self.coefficients.shape != (
            len(self.outputs),
            n_term,
        ):
            raise ValueError(f"{n_variable} variables, but exponents {self.exponents.shape}")
        if (self.exponents < 0).any() or not np.isfinite(self.coefficients).all():
            raise ValueError("exponents must be >= 0 and coefficients finite")
        spread = np.asarray(self.spread, dtype=float)
        object.__setattr__(self, "spread", spread if spread.size else np.eye(self.n_x))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.memory * len(self.outputs)

    @property
    def stable(self) -> bool:
        """Always true: the fit refuses equations that diverge, and every free run is bounded besides."""
        return True

    def step(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], p: Sequence[Any], dt: float
    ) -> list[Any]:
        """Return the state one step later, in plain arithmetic (dt: a multiple of the model's)."""
        now = [x[i] for i in range(self.n_x)]
        outside = [*(u[i] for i in range(len(self.inputs))), *(d[i] for i in range(len(self.disturbances)))]
        n_y = len(self.outputs)
        for _ in range(self._repeats(dt)):
            variables = [*now, *outside]
            terms = [_monomial(row, variables) for row in self.exponents]
            after = [sum(float(c) * t for c, t in zip(row, terms) if c) for row in self.coefficients]
            now = [*after, *now[: self.n_x - n_y]]
        return now

    def output(self, x: Sequence[Any], p: Sequence[Any]) -> list[Any]:
        """Return the outputs, the first states."""
        return [x[i] for i in range(len(self.outputs))]

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state whose present and past outputs all read y (an unknown reading: the middle)."""
        y = np.asarray(y, dtype=float)
        return np.tile(np.where(np.isfinite(y), y, (self.low + self.high) / 2), self.memory)

    def rollout(
        self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float
    ) -> tuple[Array, Array]:
        """Simulate a batch; see :class:`thermogrip.sysid.plant.Model`.

        A state that leaves :data:`BOUND` times the range of the data has diverged and is infinite from
        there on.
        """
        x = np.array(x0, dtype=float)
        w = join_columns(np.asarray(u, dtype=float), np.asarray(d, dtype=float))
        n_y, rows, n_x = len(self.outputs), w.shape[1], self.n_x
        times = max(1, round(dt / self.dt))  # the step of a gap may differ a little from the model's
        powers, gains = self._by_state(w)
        y = np.empty((x.shape[0], rows + 1, n_y))
        y[:, 0] = x[:, :n_y]
        with np.errstate(over="ignore", invalid="ignore"):  # what diverges is marked below
            for k in range(rows):
                for _ in range(times):
                    after = np.matmul(gains[:, k], _monomials(powers, x)[:, :, None])[:, :, 0]
                    x = np.hstack([after, x[:, : n_x - n_y]])
                y[:, k + 1] = x[:, :n_y]
            middle, reach = (self.low + self.high) / 2, BOUND * (self.high - self.low)
            gone = np.maximum.accumulate(~(np.abs(y - middle) < reach).all(axis=2), axis=1)
        y[gone], x[gone[:, -1]] = np.inf, np.inf
        return y, x

    def _by_state(self, w: Array) -> tuple[NDArray[np.int_], Array]:
        """Return the distinct monomials of the state and, row by row, their gains (B, N, n_y, n_monomial)."""
        n_x = self.n_x
        powers, place = np.unique(self.exponents[:, :n_x], axis=0, return_inverse=True)
        outside = _monomials(self.exponents[:, n_x:], w.reshape(-1, w.shape[2])).reshape(*w.shape[:2], -1)
        gains = np.zeros((*w.shape[:2], len(self.outputs), len(powers)))
        for term, monomial in enumerate(place.ravel()):
            gains[..., monomial] += outside[..., term, None] * self.coefficients[:, term]
        return powers, gains

    def equations(self, digits: int = 4) -> tuple[str, ...]:
        """Return one equation per output as text, in natural units."""
        past = ["" if lag == 0 else f"[k-{lag}]" for lag in range(self.memory)]
        names = [f"{name}{at}" for at in past for name in self.outputs]
        names += [*self.inputs, *self.disturbances]
        return tuple(
            f"{name}[k+1] = {_text(row, self.exponents, names, digits)}"
            for name, row in zip(self.outputs, self.coefficients)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain lists and numbers, for JSON."""
        arrays = ("exponents", "coefficients", "low", "high", "spread")
        labels = ("inputs", "disturbances", "outputs", "switches")
        named = {key: list(getattr(self, key)) for key in labels}
        return {
            "kind": self.kind,
            **named,
            "dt": self.dt,
            "memory": self.memory,
            **{key: getattr(self, key).tolist() for key in arrays},
            "equations": list(self.equations()),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> SindyModel:
        """Return the model of :meth:`to_dict`; raise :class:`UserError` where a field is missing or wrong."""
        try:
            labels = ("inputs", "disturbances", "outputs", "switches")
            named: dict[str, Any] = {key: tuple(str(name) for name in data[key]) for key in labels}
            arrays: dict[str, Any] = {key: np.asarray(data[key], dtype=float) for key in _FLOATS}
            powers = np.asarray(data["exponents"], dtype=int)
            return cls(**named, **arrays, exponents=powers, dt=float(data["dt"]), memory=int(data["memory"]))
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise UserError(f"not a SINDy model ({error})", mend="save it again with this version") from error

    def _repeats(self, dt: float) -> int:
        times = round(dt / self.dt)
        if times < 1 or abs(times * self.dt - dt) > 1e-6 * dt:
            raise ValueError(f"step of {dt:g} s is not a whole multiple of the model's {self.dt:g} s")
        return times


_FLOATS = ("coefficients", "low", "high", "spread")


def sindy_family(
    grid: Grid,
    *,
    degrees: Sequence[int] = (1, 2),
    thresholds: Sequence[float] = (0.0, 0.01, 0.05),
    memories: Sequence[int] = (1, 2),
) -> Mapping[Structure, SindyModel]:
    """Return a model for each degree, threshold and memory whose simulation stays bounded.

    Parameters
    ----------
    grid : Grid
    degrees : sequence of int, optional
        Of the polynomials.
    thresholds : sequence of float, optional
        Of STLSQ, relative to the largest coefficient.
    memories : sequence of int, optional
        Past values of each output.
    """
    out = {}
    n_y, outside = len(grid.outputs), len(grid.inputs) + len(grid.disturbances)
    for degree, memory in product(degrees, memories):
        n_term = comb(memory * n_y + outside + degree, degree)
        for at, threshold in enumerate(sorted(thresholds)):
            model = _fit(grid, degree, threshold, memory)
            if model is not None:
                # the same on every fold, however many terms survive there: all terms, less for each threshold
                label = f"degree {degree}, memory {memory}, threshold {threshold:g}"
                out[Structure(label, max(1, n_y * n_term - at))] = model
    return out


def sindy_model(grid: Grid, *, degree: int = 2, threshold: float = 0.01, memory: int = 1) -> SindyModel:
    """Return the SINDy model of one structure.

    Raises
    ------
    UserError
        If too few rows are whole, or the simulation diverges on the data of the fit.
    """
    model = _fit(grid, degree, threshold, memory)
    if model is None:
        raise UserError(
            f"the SINDy equations of degree {degree} diverge in simulation or lack data",
            mend="use a lower degree or a larger threshold",
        )
    return model


def _fit(grid: Grid, degree: int, threshold: float, memory: int) -> SindyModel | None:
    import pysindy

    x, w, move = _trajectories(grid, memory)
    total = sum(map(len, x))
    if not x or total < 3 * x[0].shape[1] + 20:
        return None
    z, low, size = _scaled(x, w)
    n_x, n_y = x[0].shape[1], len(grid.outputs)
    weight = np.maximum(np.concatenate(move).std(axis=0), 1e-12)
    library = pysindy.PolynomialLibrary(degree=degree)
    optimiser = pysindy.STLSQ(threshold=0.0, alpha=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pysindy warns of every term that it drops
        model = pysindy.SINDy(optimizer=optimiser, feature_library=library)
        targets = [np.hstack([m / weight, np.zeros((len(m), n_x - n_y))]) for m in move]
        arguments = {"x": [part[:, :n_x] for part in z], "u": [part[:, n_x:] for part in z]}
        model.fit(arguments["x"], t=grid.dt, x_dot=targets, u=arguments["u"])
        if threshold:
            largest = float(np.abs(model.coefficients()[:n_y]).max())
            optimiser = pysindy.STLSQ(threshold=threshold * largest, alpha=1e-6)
            model = pysindy.SINDy(optimizer=optimiser, feature_library=library)
            model.fit(arguments["x"], t=grid.dt, x_dot=targets, u=arguments["u"])
    coefficients = np.asarray(model.coefficients(), dtype=float)[:n_y] * weight[:, None]
    powers = np.asarray(library.powers_, dtype=int)
    exponents, natural = _natural(powers, coefficients, low, size)
    for i in range(n_y):  # the increment was fitted
        natural[
            i, int(np.flatnonzero((exponents == np.eye(exponents.shape[1], dtype=int)[i]).all(axis=1))[0])
        ] += 1
    return _bounded(grid, exponents, natural, memory)


def _bounded(grid: Grid, exponents: NDArray[np.int_], natural: Array, memory: int) -> SindyModel | None:
    """Return the model, or None where its simulation of the training data diverges."""
    y = np.concatenate([segment.y for segment in grid.segments])
    low, high = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
    if not np.isfinite(natural).all() or not np.all(high > low):
        return None
    labels = (grid.inputs, grid.disturbances, grid.outputs, grid.switches)
    model = SindyModel(*labels, grid.dt, memory, exponents, natural, low, high)
    states = []
    for segment in grid.segments:
        first = segment.y[np.argmax(np.isfinite(segment.y), axis=0), np.arange(len(grid.outputs))]
        seen, _ = model.rollout(
            model.rest(first, (), (), ())[None], segment.u[None], segment.d[None], (), grid.dt
        )
        if not np.isfinite(seen).all():
            return None
        states.append(np.hstack([seen[0, memory - 1 - lag : len(seen[0]) - lag] for lag in range(memory)]))
    spread = np.atleast_2d(np.cov(np.concatenate(states).T))
    return replace(model, spread=spread + 1e-8 * max(np.trace(spread), 1e-12) * np.eye(model.n_x))


def _trajectories(grid: Grid, memory: int) -> tuple[list[Array], list[Array], list[Array]]:
    """Return states, outside variables and increments of every run of whole rows."""
    x, w, move = [], [], []
    readings = whole_readings(grid.segments, memory + 5)
    for segment in (replace(some, y=y) for some, y in zip(grid.segments, readings)):
        for begin, end in _whole(segment):
            y = segment.y[begin:end]
            if end - begin < memory + 5:
                continue
            now = range(memory - 1, len(y) - 1)
            x.append(np.hstack([y[[k - lag for k in now]] for lag in range(memory)]))
            w.append(np.hstack([segment.u, segment.d])[begin:end][list(now)])
            move.append(np.diff(y, axis=0)[memory - 1 :])
    return x, w, move


def _whole(segment: Segment) -> list[tuple[int, int]]:
    known = np.isfinite(segment.y).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _scaled(x: Sequence[Array], w: Sequence[Array]) -> tuple[list[Array], Array, Array]:
    rows = [np.hstack(pair) for pair in zip(x, w)]
    stacked = np.concatenate(rows)
    middle, size = stacked.mean(axis=0), stacked.std(axis=0)
    size = np.where(size > 1e-9, size, 1.0)
    return [(row - middle) / size for row in rows], middle, size


def _natural(powers: NDArray[np.int_], coefficients: Array, middle: Array, size: Array) -> tuple[Any, Array]:
    """Expand polynomials of (v - middle) / size into polynomials of v."""
    expanded: dict[tuple[int, ...], Array] = {
        tuple(row): np.zeros(len(coefficients)) for row in powers.tolist()
    }
    for row, column in zip(powers, coefficients.T):
        parts: dict[tuple[int, ...], float] = {(0,) * len(row): 1.0}
        for variable, power in enumerate(row):
            for _ in range(power):
                bigger: dict[tuple[int, ...], float] = {}
                for key, value in parts.items():
                    up = tuple(k + (i == variable) for i, k in enumerate(key))
                    bigger[up] = bigger.get(up, 0.0) + value / size[variable]
                    bigger[key] = bigger.get(key, 0.0) - value * middle[variable] / size[variable]
                parts = bigger
        for key, value in parts.items():
            expanded[key] = expanded[key] + value * column
    keys = list(expanded)
    return np.array(keys, dtype=int), np.stack([expanded[key] for key in keys], axis=1)


def _monomial(row: NDArray[np.int_], variables: Sequence[Any]) -> Any:
    value: Any = 1.0
    for power, variable in zip(row.tolist(), variables):
        for _ in range(power):
            value = value * variable
    return value


def _monomials(exponents: NDArray[np.int_], rows: Array) -> Array:
    """Return the terms (n, n_term) of rows (n, n_variable)."""
    out = np.ones((rows.shape[0], exponents.shape[0]))
    with np.errstate(over="ignore", invalid="ignore"):
        for variable in range(exponents.shape[1]):
            for power in range(1, int(exponents[:, variable].max(initial=0)) + 1):
                out[:, exponents[:, variable] >= power] *= rows[:, [variable]]
    return out


def _text(row: Array, exponents: NDArray[np.int_], names: Sequence[str], digits: int) -> str:
    parts = []
    for value, powers in zip(row, exponents):
        if value == 0:
            continue
        factors = [n if p == 1 else f"{n}^{p}" for n, p in zip(names, powers.tolist()) if p]
        parts.append(" ".join([f"{value:.{digits}g}", *factors]))
    return " + ".join(parts).replace("+ -", "- ") or "0"
