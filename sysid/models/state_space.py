"""Linear discrete-time model of a plant, the form that ARX, OE and subspace fits return.

With x the state, u the inputs, d the measured disturbances and y the outputs, one step of length ``dt`` is

    x+ = A x + B u + E d + F phi(u, d) + sum_s u_s A_s x + c,        y = C x + y0.

Transport delays are states (a shift register).  ``phi`` are products of inputs, their magnitudes and
disturbances (``"drive*|drive|"``); with ``A_s`` a switch such as the pump changes how the states couple.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.limits import array_within
from thermogrip.sysid.models.model import BlackBox, Values


@dataclass(frozen=True, eq=False)
class StateSpaceModel(BlackBox):
    """A linear model with offsets, delays as states, and optional products of the inputs."""

    A: Array  # (n_x, n_x)
    B: Array  # (n_x, n_u)
    C: Array  # (n_y, n_x)
    E: Array = field(default_factory=lambda: np.empty(0))  # (n_x, n_d) disturbance matrix; zero where absent
    c: Array = field(default_factory=lambda: np.empty(0))  # (n_x,) constant drive
    y0: Array = field(default_factory=lambda: np.empty(0))  # (n_y,) offset of the outputs, in their unit
    switches: tuple[str, ...] = ()  # the inputs that are on or off
    # names of ``phi``: factors joined by ``*``, each an input or disturbance or its magnitude ``|name|``
    terms: tuple[str, ...] = ()
    F: Array = field(default_factory=lambda: np.empty(0))  # (n_x, n_terms) matrix of the terms
    A_switch: Mapping[str, Array] = field(default_factory=dict)  # change of ``A`` while the switch is on
    # (n_x, n_x) covariance of the state in the data of the fit; the identity where absent
    spread: Array = field(default_factory=lambda: np.empty(0))

    kind = "statespace"
    title = "state-space model"
    labels = (*BlackBox.labels, "terms")
    arrays = ("A", "B", "C", "E", "c", "y0", "F", "spread")

    def __post_init__(self) -> None:
        n_x, n_y = np.atleast_2d(self.A).shape[0], len(self.outputs)
        shapes: dict[str, tuple[int, ...]] = {
            "A": (n_x, n_x),
            "B": (n_x, len(self.inputs)),
            "C": (n_y, n_x),
            "E": (n_x, len(self.disturbances)),
            "c": (n_x,),
            "y0": (n_y,),
            "F": (n_x, len(self.terms)),
            "spread": (n_x, n_x),
        }
        if not np.size(self.spread):
            object.__setattr__(self, "spread", np.eye(n_x))
        for name, shape in shapes.items():
            object.__setattr__(self, name, _shaped(name, getattr(self, name), shape))
        switched = {
            key: _shaped(f"A_switch {key}", value, (n_x, n_x)) for key, value in self.A_switch.items()
        }
        object.__setattr__(self, "A_switch", switched)
        strangers = (set(self.switches) | set(switched)) - set(self.inputs)
        if strangers:
            raise ValueError(f"switches must be inputs, {sorted(strangers)} are not")
        if not self.dt > 0:
            raise ValueError(f"dt must be > 0 s, got {self.dt:g}")
        read_terms(self.terms, self.inputs + self.disturbances)  # refuses strangers

    @property
    def n_x(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    def one_step(self, x: Values, u: Values, d: Values) -> list[Any]:
        """Return the state one step of the model later."""
        phi = products(self.terms, self.inputs + self.disturbances, [*u, *d])
        switched = [(u[self.inputs.index(name)], matrix) for name, matrix in self.A_switch.items()]
        return [
            dot(self.A[i], x)
            + (self.c[i] + dot(self.B[i], u) + dot(self.E[i], d) + dot(self.F[i], phi))
            + sum(on * dot(matrix[i], x) for on, matrix in switched)
            for i in range(self.n_x)
        ]

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return the outputs y = C x + y0 as a list of length n_y, in plain arithmetic."""
        # no direct term: an input that is applied at a row cannot have moved the reading of that row
        return [dot(self.C[i], x) + self.y0[i] for i in range(len(self.outputs))]

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose outputs read y."""
        u, d, y = (np.asarray(value, dtype=float) for value in (u, d, y))
        switched = (u[self.inputs.index(name)] * matrix for name, matrix in self.A_switch.items())
        A, push = self.A + sum(switched, 0.0 * self.A), self.push(u, d)
        move = np.array([name not in self.switches for name in self.inputs], dtype=bool)
        gain = (self.B + self._term_slopes(u, d))[:, move]
        n_v = gain.shape[1]
        scale = np.sqrt(np.maximum(np.trace(self.spread) / self.n_x, 1e-12))
        # held there by *some* constant input v:
        # min |x - A x - B v - E d - c|^2 + eps |v - u|^2 subject to C x + y0 = y
        rows = np.block(
            [
                [(np.eye(self.n_x) - A) / scale, -gain / scale],
                [np.zeros((n_v, self.n_x)), 1e-4 * np.eye(n_v)],
                [1e-7 / scale * np.eye(self.n_x), np.zeros((self.n_x, n_v))],
            ]
        )
        right = np.concatenate([push / scale, np.zeros(n_v + self.n_x)])
        is_read = np.isfinite(y)
        fixed = np.hstack([self.C[is_read], np.zeros((int(is_read.sum()), n_v))])
        return constrained_lstsq(rows, right, fixed, (y - self.y0)[is_read])[: self.n_x]

    def states(self, x0: Array, u: Array, d: Array, times: int = 1) -> Array:
        """Return the states (B, N + 1, n_x) of :meth:`rollout`, ``times`` steps with each row."""
        from thermogrip.sysid.models.recurrences import run_linear  # pulls in numba

        on = np.ascontiguousarray(u[:, :, [self.inputs.index(name) for name in self.A_switch]])
        A, push = np.stack([self.A, *self.A_switch.values()]), np.ascontiguousarray(self.push(u, d))
        return np.asarray(run_linear(A, on, push, np.ascontiguousarray(x0), times))

    @staticmethod
    def others(data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields that are neither names nor plain arrays."""
        switched = {str(key): array_within(data["A_switch"], key) for key in data["A_switch"]}
        return {"A_switch": switched}

    def push(self, u: Array, d: Array) -> Array:
        """Return B u + E d + F phi(u, d) + c for rows of inputs, shape (..., n_x)."""
        out = u @ self.B.T + d @ self.E.T + self.c
        if self.terms:
            names = self.inputs + self.disturbances
            out = out + evaluate_terms(self.terms, names, join_columns(u, d)) @ self.F.T
        return np.asarray(out)

    def poles(self) -> NDArray[np.complex128]:
        """Return the eigenvalues of A at the position of the switches where the largest is largest."""
        positions = [self.A]
        for matrix in self.A_switch.values():
            positions += [position + matrix for position in positions]
        sets = [np.linalg.eigvals(position) for position in positions]
        return np.asarray(max(sets, key=lambda roots: float(np.abs(roots).max(initial=0.0))), dtype=complex)

    @property
    def stable(self) -> bool:
        """Whether every pole lies inside the unit circle, at every position of the switches."""
        return bool(np.all(np.abs(self.poles()) < 1))

    def _term_slopes(self, u: Array, d: Array) -> Array:
        """Return F dphi/du at (u, d), shape (n_x, n_u), by central differences of a small step."""
        if not self.terms:
            return np.zeros_like(self.B)
        step = 1e-3 * np.eye(len(self.inputs))
        names = self.inputs + self.disturbances
        joined = [join_columns(u + sign * step, np.tile(d, (len(u), 1))) for sign in (1, -1)]
        up, down = (evaluate_terms(self.terms, names, rows) for rows in joined)
        return np.asarray(self.F @ ((up - down) / 2e-3).T)


def _shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.asarray(value, dtype=float)
    if array.size == 0:
        array = np.zeros(shape)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is not finite everywhere")
    return array


def products(terms: Sequence[str], names: Sequence[str], signals: Sequence[Any]) -> list[Any]:
    """Return the products ``terms`` of the signals ``names`` (numbers, columns or symbols)."""
    out = []
    for factors in read_terms(terms, names):
        value: Any = 1.0
        for index, magnitude in factors:
            value = value * (abs(signals[index]) if magnitude else signals[index])
        out.append(value)
    return out


def evaluate_terms(terms: Sequence[str], names: Sequence[str], rows: Array) -> Array:
    """Return the products ``terms`` of the columns ``names``."""
    columns = products(terms, names, list(np.moveaxis(rows, -1, 0)))
    return np.stack(columns, axis=-1) if columns else np.ones((*rows.shape[:-1], 0))


def constrained_lstsq(rows: Array, right: Array, fixed: Array, value: Array) -> Array:
    """Return the z of least |rows z - right| with fixed z = value (least squares where that conflicts)."""
    z, *_ = np.linalg.lstsq(fixed, value, rcond=None) if len(value) else (np.zeros(rows.shape[1]),)
    _, sizes, vh = np.linalg.svd(fixed)
    rank = int(np.sum(sizes > 1e-10 * max(1e-300, float(sizes.max(initial=0.0)))))
    free = vh[rank:].T
    move, *_ = np.linalg.lstsq(rows @ free, right - rows @ z, rcond=None)
    return np.asarray(z + free @ move)


def symmetric_root(covariance: Array) -> Array:
    """Return R with R R' = covariance, one column an axis; a variance lost to rounding is 0."""
    size, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))


def read_terms(terms: Sequence[str], names: Sequence[str]) -> list[list[tuple[int, bool]]]:
    """Read each term as a list of (column, whether its magnitude is meant)."""
    out = []
    for term in terms:
        words = term.split("*")
        bare = [word.strip("|") for word in words]
        unknown = [word for word in bare if word not in names]
        if unknown:
            raise ValueError(f"term {term!r} names {unknown[0]!r}, which is not among {', '.join(names)}")
        out.append([(list(names).index(name), word.startswith("|")) for name, word in zip(bare, words)])
    return out


def join_columns(u: Array, d: Array) -> Array:
    """Return u and d side by side in the last axis, batches broadcast against each other."""
    shape = np.broadcast_shapes(u.shape[:-1], d.shape[:-1])
    return np.concatenate(
        [np.broadcast_to(columns, (*shape, columns.shape[-1])) for columns in (u, d)], axis=-1
    )


def dot(row: Array, values: Values) -> Any:
    """Return the dot product without the zero entries, so that symbolic graphs stay small."""
    total: Any = 0.0
    for i in np.flatnonzero(row):
        total = total + float(row[i]) * values[int(i)]
    return total


def first_readings(y: Array) -> Array:
    """Return the first reading (n_y,) of each output of y (n, n_y), NaN where it has none."""
    return np.asarray(y[np.argmax(np.isfinite(y), axis=0), np.arange(y.shape[1])])
