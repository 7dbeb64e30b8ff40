"""Small neural state-space model: a stable linear plant, bent by a few tanh units, several times over.

With the drives w = [u, d] and the outputs at zero mean and unit spread, each member k of the model is

    x+ = A x + B w + c + V tanh(W x + U w + b),       its first n_y states are the outputs,

and the model's output is the mean of its members, which differ in the random start of their weights.

**Bounded.**  A is that of a stable linear fit and is not trained, tanh never exceeds 1, and each drive is
clipped to r, ten times its reach in the data (a drive that never moved there has r = 0 and moves
nothing).  So the state is bounded whatever the weights and the inputs,

    |x| <= sum_k |A^k| (|B| r + |c| + |V| 1).

**Rails.**  An output that has stood still on its least or greatest value in the data is at the end of its
range (an overflowing tank, the end of a converter); the states of such an output are clipped there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.models.model import BlackBox, Values, gauss_newton
from thermogrip.sysid.models.state_space import dot, join_columns

_RAILS = ("low", "high")


def member_shapes(n: int, m: int, h: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a member's arrays: A, and the weights as they stand in a row."""
    return {"A": (n, n), "B": (n, m), "c": (n,), "V": (n, h), "W": (h, n), "U": (h, m), "b": (h,)}


@dataclass(frozen=True, eq=False)
class NeuralModel(BlackBox):
    """A mean of K small neural state-space models in scaled units."""

    switches: tuple[str, ...]
    A: Array  # (K, n, n) linear part, stable
    B: Array  # (K, n, m) of m inputs and disturbances
    c: Array  # (K, n)
    V: Array  # (K, n, h) the h units
    W: Array  # (K, h, n)
    U: Array  # (K, h, m)
    b: Array  # (K, h)
    y_middle: Array  # (n_y,) y = y_middle + y_size x_y
    y_size: Array  # (n_y,)
    w_middle: Array  # (m,) w = ([u, d] - w_middle) / w_size
    w_size: Array  # (m,)
    reach: Array  # (m,) w is clipped to [-reach, reach]
    low: Array  # (n_y,) rails of the outputs, in their units; infinite where there is none
    high: Array  # (n_y,)
    spread: Array = field(default_factory=lambda: np.empty(0))  # (K n, K n) of the state in the data

    kind = "neural"
    title = "neural model"
    arrays = (
        *("A", "B", "c", "V", "W", "U", "b"),
        *("y_middle", "y_size", "w_middle", "w_size", "reach", "spread"),
    )

    def __post_init__(self) -> None:
        for name in (*self.arrays, *_RAILS):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=float))
        members, n = self.A.shape[:2]
        h = self.b.shape[1]
        m = len(self.inputs) + len(self.disturbances)
        n_y = len(self.outputs)
        shapes = {name: (members, *shape) for name, shape in member_shapes(n, m, h).items()}
        shapes |= dict.fromkeys(("y_middle", "y_size", "low", "high"), (n_y,))
        shapes |= dict.fromkeys(("w_middle", "w_size", "reach"), (m,))
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape or (name not in _RAILS and not np.isfinite(value).all()):
                raise ValueError(f"{name} has shape {value.shape}, expected finite {shape}")
        if n < n_y:
            raise ValueError(f"{n} states cannot hold {n_y} outputs")
        if not (np.abs(np.linalg.eigvals(self.A)) < 1).all():
            raise ValueError("the linear part of a member is not stable")
        if not self.spread.size:
            object.__setattr__(self, "spread", np.eye(self.n_x))

    @property
    def n_x(self) -> int:
        """Number of states of all members together."""
        return int(self.A.shape[0] * self.A.shape[1])

    def one_step(self, x: Values, u: Values, d: Values) -> list[Any]:
        """Return the state one step of the model later."""
        scaled = [(v - float(a)) / float(s) for v, a, s in zip([*u, *d], self.w_middle, self.w_size)]
        # |v + r| - |v - r| is twice v clipped to [-r, r]
        w = [(abs(v + float(r)) - abs(v - float(r))) / 2 for v, r in zip(scaled, self.reach)]
        n = self.A.shape[1]
        return [v for k in range(len(self.A)) for v in self._member_step(k, x[k * n : (k + 1) * n], w)]

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return the mean of the members' outputs, in natural units."""
        n, members = self.A.shape[1], len(self.A)
        return [
            float(middle) + float(size) / members * sum(x[k * n + i] for k in range(members))
            for i, (middle, size) in enumerate(zip(self.y_middle, self.y_size))
        ]

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state at rest at which every member's outputs read y, held there by some input near u:
        min |f(x, v) - x|^2 + 1e-4 |v - w|^2 over hidden states, unknown readings and moved drives v."""
        y = (np.asarray(y, dtype=float) - self.y_middle) / self.y_size
        w = (np.concatenate([np.asarray(u, float), np.asarray(d, float)]) - self.w_middle) / self.w_size
        w = np.clip(w, -self.reach, self.reach)
        n_u = len(self.inputs)
        members = len(self.A)
        n = self.A.shape[1]
        moved = [i for i in range(n_u) if self.inputs[i] not in self.switches]
        is_read = np.flatnonzero(np.isfinite(y))
        free = [i for i in range(n) if i not in is_read] + [n + i for i in moved]
        z = np.tile(np.concatenate([np.zeros(n), w]), (members, 1))
        z[:, is_read] = y[is_read]
        weight = np.where(np.array(free) < n, 1e-4, 1e-2)

        def misfit(move: Array, of: NDArray[np.int_]) -> Array:
            moved_z = np.repeat(z[of][:, None], move.shape[1], axis=1)
            moved_z[..., free] += move
            x, w = moved_z[..., :n], moved_z[..., n:]
            t = np.tanh(_products(self.W[of], x) + _products(self.U[of], w) + self.b[of][:, None])
            steps = _products(self.B[of], w) + self.c[of][:, None] + _products(self.V[of], t)
            return np.concatenate([_products(self.A[of], x) + steps - x, weight * move], axis=-1)

        ends = np.full(len(free), np.inf)
        z[:, free] += gauss_newton(misfit, np.zeros((members, len(free))), -ends, ends)
        return np.asarray(z[:, :n]).ravel()

    def states(self, x0: Array, u: Array, d: Array, times: int = 1) -> Array:
        """Return the states (B, N + 1, n_x) of :meth:`rollout`, ``times`` steps with each row."""
        from thermogrip.sysid.models.recurrences import run_states  # pulls in numba

        w = np.clip((join_columns(u, d) - self.w_middle) / self.w_size, -self.reach, self.reach)
        drives = np.ascontiguousarray(np.repeat(w, times, axis=1))
        matrices = (self.B, self.c, self.V, self.W, self.U, self.b)
        weights = np.hstack([matrix.reshape(len(self.A), -1) for matrix in matrices])
        low, high = ((rail - self.y_middle) / self.y_size for rail in (self.low, self.high))
        runs = [
            run_states(self.A, weights, self.b.shape[1], start, drives[k % len(drives)], low, high)
            for k, start in enumerate(x0.reshape(-1, *self.A.shape[:2]))
        ]
        return np.moveaxis(np.stack(runs)[:, :, ::times], 1, 2).reshape(len(runs), -1, self.n_x)

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain lists and numbers, for JSON (``None``: no rail)."""
        rails = {key: [v if np.isfinite(v) else None for v in getattr(self, key)] for key in _RAILS}
        return super().to_dict() | rails

    @staticmethod
    def others(data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the rails."""
        open_ends = zip(_RAILS, (-np.inf, np.inf))
        return {key: [free if v is None else v for v in data[key]] for key, free in open_ends}

    def _member_step(self, k: int, x: Values, w: Values) -> list[Any]:
        units = zip(self.W[k], self.U[k], self.b[k])
        t = [_tanh(dot(row, x) + dot(column, w) + float(shift)) for row, column, shift in units]
        after = [
            dot(self.A[k, i], x) + dot(self.B[k, i], w) + dot(self.V[k, i], t) + float(self.c[k, i])
            for i in range(len(x))
        ]
        for i in range(len(self.outputs)):
            low, high = ((rail[i] - self.y_middle[i]) / self.y_size[i] for rail in (self.low, self.high))
            if np.isfinite(low):
                after[i] = (after[i] + float(low) + abs(after[i] - float(low))) / 2
            if np.isfinite(high):
                after[i] = (after[i] + float(high) - abs(after[i] - float(high))) / 2
        return after


def _products(matrices: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("kij,kbj->kbi", matrices, vectors))


def _tanh(value: Any) -> Any:
    return value.tanh() if hasattr(value, "tanh") else np.tanh(value)  # a symbol brings its own
