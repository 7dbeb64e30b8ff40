r"""Exact derivatives of a prediction without a compiler: dual numbers through the model's own step.

A dual number a + b eps with eps^2 = 0 carries a value and its derivative in one direction,

    (a + b eps)(c + d eps) = ac + (ad + bc) eps,     |a + b eps| = |a| + sign(a) b eps.

A model's step is plain arithmetic, so it runs on duals as on numbers: from (x, sx), (u, su), (d, sd) to the
next state and its derivative in that direction.  :class:`DualSteps` gives such a step to
:class:`thermogrip.sysid.models.jit_rollout.Kernel`, which turns it into machine code and runs eight
directions side by side.  The derivatives are those of the step itself, without a difference quotient's error.

NumPy's elementary functions carry theirs along. A model whose step needs more, or branches, cannot be turned
so; then CasADi takes the derivatives.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Model

__all__ = ["Dual", "DualSteps"]

_TINY = 1e-300  # sign(a) = a / (|a| + tiny): 0 at 0, without a branch


class Dual:
    """A value with its derivative in one direction.

    Parameters
    ----------
    value, slope : number
        Numbers, NumPy rows, or lanes.

    Examples
    --------
    The derivative of x^2 + |x| at 3 and at -3:

    >>> [(x * x + abs(x)).slope for x in (Dual(3.0, 1.0), Dual(-3.0, 1.0))]
    [7.0, -7.0]
    >>> (1.0 / Dual(2.0, 1.0)).slope
    -0.25
    """

    __slots__ = ("slope", "value")

    def __init__(self, value: Any, slope: Any) -> None:
        self.value, self.slope = value, slope

    def __add__(self, other: Any) -> Dual:
        other = _dual(other)
        return Dual(self.value + other.value, self.slope + other.slope)

    __radd__ = __add__

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __sub__(self, other: Any) -> Dual:
        other = _dual(other)
        return Dual(self.value - other.value, self.slope - other.slope)

    def __rsub__(self, other: Any) -> Dual:
        return _dual(other) - self

    def __mul__(self, other: Any) -> Dual:
        other = _dual(other)
        return Dual(self.value * other.value, self.value * other.slope + self.slope * other.value)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Dual:
        other = _dual(other)
        ratio = self.value / other.value
        if isinstance(other.slope, float) and other.slope == 0.0:
            return Dual(ratio, self.slope / other.value)
        return Dual(ratio, (self.slope - ratio * other.slope) / other.value)

    def __rtruediv__(self, other: Any) -> Dual:
        return _dual(other) / self

    def __abs__(self) -> Dual:
        size = abs(self.value)
        return Dual(size, self.value / (size + _TINY) * self.slope)

    def __pow__(self, power: float) -> Dual:
        if isinstance(power, Dual):
            return NotImplemented  # of no use to a plant
        return Dual(self.value**power, power * self.value ** (power - 1) * self.slope)

    def __array_ufunc__(self, function: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options:
            return NotImplemented
        if function in _OPERATORS:
            return _OPERATORS[function](*(_dual(value) for value in inputs))
        if function in _SLOPES and len(inputs) == 1:
            return Dual(function(self.value), _SLOPES[function](self.value) * self.slope)
        return NotImplemented


_OPERATORS: dict[Any, Callable[..., Any]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.divide: operator.truediv,
    np.negative: operator.neg,
    np.absolute: operator.abs,
    np.square: lambda a: a * a,
}
#: The derivative of NumPy's functions, of a number or of lanes.
_SLOPES: dict[Any, Callable[[Any], Any]] = {
    np.sqrt: lambda a: 0.5 / np.sqrt(a),
    np.exp: np.exp,
    np.log: lambda a: 1.0 / a,
    np.sin: np.cos,
    np.cos: lambda a: -np.sin(a),
    np.tanh: lambda a: 1.0 - np.tanh(a) * np.tanh(a),
}


def _dual(value: Any) -> Dual:
    if isinstance(value, Dual):
        return value
    return Dual(float(value) if hasattr(value, "dtype") else value, 0.0)


class DualSteps:
    """A model's step on duals, as :class:`thermogrip.sysid.models.jit_rollout.Kernel` takes equations.

    State, inputs and disturbances are the model's, then their directions; of the inputs, the drives alone.

    Parameters
    ----------
    model : Model
    drives : sequence of int
        Which inputs are drives; the others are switches, and on.
    h : float
        Step [s].
    """

    def __init__(self, model: Model, drives: Sequence[int], h: float) -> None:
        self.model, self.drives, self.h = model, list(drives), h
        self.n_x, self.n_u = 2 * model.n_x, 2 * len(self.drives)
        self.n_d, self.n_p = 2 * len(model.disturbances), len(model.parameters)
        self._steps = getattr(model, "steps", None)  # a network works out once what its parameters fix

    def prepare(self, p: Sequence[Any]) -> list[Any]:
        """Return what depends on the parameters alone."""
        if self._steps is None:
            return list(p)
        c = self._steps.prepare(p)
        return [*p, *c, *self._steps.renew([1.0] * len(self.model.inputs), c, self.h)]

    def renew(self, u: Sequence[Any], c: Sequence[Any], h: Any) -> list[Any]:
        """Return nothing: the switches stay on."""
        return []

    def advance(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], c: Sequence[Any], kept: Any, h: Any
    ) -> list[Any]:
        """Return the state after the step, then its direction."""
        state, drives, disturbances = (_pairs(values) for values in (x, u, d))
        full: list[Any] = [1.0] * len(self.model.inputs)
        for at, value in zip(self.drives, drives, strict=True):
            full[at] = value
        known = [_dual(value) for value in c]  # a lane on the left of a dual would not know what to do
        p, rest = known[: self.n_p], known[self.n_p :]
        if self._steps is None:
            after = self.model.step(state, full, disturbances, p, self.h)
        else:
            n_c = len(self._steps.layout.scale)
            after = self._steps.advance(state, full, disturbances, rest[:n_c], rest[n_c:], self.h)
        pairs = [_dual(value) for value in after]
        return [pair.value for pair in pairs] + [pair.slope for pair in pairs]

    def read(self, x: Sequence[Any], c: Sequence[Any]) -> list[Any]:
        """Return the outputs, then their direction."""
        p = [_dual(value) for value in c[: self.n_p]]
        found = [_dual(y) for y in self.model.output(_pairs(x), p)]
        return [pair.value for pair in found] + [pair.slope for pair in found]


def _pairs(values: Sequence[Any]) -> list[Any]:
    half = len(values) // 2
    return [Dual(value, slope) for value, slope in zip(values[:half], values[half:], strict=True)]
