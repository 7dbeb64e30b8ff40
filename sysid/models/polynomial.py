"""Polynomial difference equations of the outputs, the model that SINDy fits.

    y[k+1] = sum_i xi_i m_i(y[k], y[k-1], ..., u[k], d[k]),

m_i monomials.  The equations are kept in natural units (degrees and the units of the inputs), as
coefficients and exponents: no pickle, and ``step`` is plain arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.limits import array_within, number_within
from thermogrip.sysid.models.model import BlackBox, Values

BOUND = 10.0  # spreads beyond the range of the data: a simulation that leaves it has diverged
_MOST_DEGREE, _MOST_MEMORY = 20, 1000


@dataclass(frozen=True, eq=False)
class SindyModel(BlackBox):
    """Polynomial difference equations of the outputs."""

    switches: tuple[str, ...]
    # number of past values of each output the equations see, at least 1; the state is [y[k], y[k-1], ...]
    memory: int
    # (n_term, n_variable) powers of the variables [state, inputs, disturbances] in each term
    exponents: NDArray[np.int_]
    coefficients: Array  # (n_y, n_term) of y[k+1], in natural units
    low: Array  # (n_y,) range of the outputs in the data of the fit
    high: Array  # (n_y,)
    # (n_x, n_x) Covariance of the state in the data of the fit
    spread: Array = field(default_factory=lambda: np.empty(0))

    kind = "sindy"
    title = "SINDy model"
    arrays = ("coefficients", "low", "high", "spread")

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

    def one_step(self, x: Values, u: Values, d: Values) -> list[Any]:
        """Return the state one step of the model later."""
        variables = [*x, *u, *d]
        terms = [
            prod(variable for power, variable in zip(row, variables) for _ in range(power))
            for row in self.exponents.tolist()
        ]
        after = [sum(float(c) * t for c, t in zip(row, terms) if c) for row in self.coefficients]
        return [*after, *x[: self.n_x - len(after)]]

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return the outputs, the first states."""
        return [x[i] for i in range(len(self.outputs))]

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state whose present and past outputs all read y (an unknown reading: the middle)."""
        y = np.asarray(y, dtype=float)
        return np.tile(np.where(np.isfinite(y), y, (self.low + self.high) / 2), self.memory)

    def states(self, x0: Array, u: Array, d: Array, times: int = 1) -> Array:
        """Return the states (B, N + 1, n_x) of :meth:`rollout`; an output beyond :data:`BOUND` times the
        range of the data has diverged, and the state is infinite from there on."""
        x = np.empty((len(x0), u.shape[1] + 1, self.n_x))
        x[:, 0] = x0
        middle, reach = (self.low + self.high) / 2, BOUND * (self.high - self.low)
        with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is infinite, an answer
            for k in range(u.shape[1]):
                row = list(x[:, k].T)
                for _ in range(times):
                    row = self.one_step(row, list(u[:, k].T), list(d[:, k].T))
                for i, value in enumerate(row):
                    x[:, k + 1, i] = value
            within = np.abs(x[:, :, : len(self.outputs)] - middle) < reach
        x[np.maximum.accumulate(~within.all(axis=2), axis=1)] = np.inf
        return np.asarray(x)

    def equations(self) -> tuple[str, ...]:
        """Return one equation per output as text, in natural units."""
        past = ["" if lag == 0 else f"[k-{lag}]" for lag in range(self.memory)]
        names = [f"{name}{lag_suffix}" for lag_suffix in past for name in self.outputs]
        names += [*self.inputs, *self.disturbances]
        powers = [[n if p == 1 else f"{n}^{p}" for n, p in zip(names, row) if p] for row in self.exponents]
        terms = [
            [" ".join([f"{value:.4g}", *factors]) for value, factors in zip(row, powers) if value]
            for row in self.coefficients
        ]
        right = [" + ".join(summands).replace("+ -", "- ") or "0" for summands in terms]
        return tuple(f"{name}[k+1] = {polynomial}" for name, polynomial in zip(self.outputs, right))

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain lists and numbers, for JSON, and its equations for readers."""
        return super().to_dict() | {"equations": list(self.equations())}

    @staticmethod
    def others(data: Mapping[str, Any]) -> dict[str, Any]:
        """Return exponents and memory."""
        powers = array_within(data, "exponents", _MOST_DEGREE).astype(int)
        return {"exponents": powers, "memory": int(number_within(data, "memory", 1, _MOST_MEMORY))}
