"""The compiled face of a user's class: its functions through numba, with the Runge-Kutta loop around them.

The arithmetic is that of :meth:`thermogrip.sysid.own_model.OwnModel.step`, member by member instead of in
rows; a test holds the two together.  numba reads the user's functions themselves, with ``self`` standing
for the numbers on the class.  What it cannot read (a call of another method, say) is left to NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numba.core.errors import NumbaError
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from thermogrip.sysid.own_code import OwnCode, as_tuple

__all__ = ["Compiled", "compile_code"]

Array = NDArray[np.float64]

_F = TypeVar("_F", bound=Callable[..., Any])
_NOISE = ("Failed in", "During", "File", "<source", ">>>", "^")  # how numba frames what it says


def _jit(function: _F) -> _F:
    """Return the function compiled; numba's own decorator has no types."""
    return cast("_F", njit(function, nogil=True, error_model="numpy"))


@dataclass(frozen=True, eq=False)
class Compiled:
    """A compiled rollout, or why there is none.

    Attributes
    ----------
    run : callable or None
    refused : str
        What numba could not read; "" where it read all.
    n_y : int
    """

    run: Callable[..., None] | None
    refused: str
    n_y: int

    def rollout(self, x0: Array, u: Array, d: Array, p: Array, h: float, pieces: int) -> tuple[Array, Array]:
        """Simulate a batch, ``pieces`` steps of h between rows; shapes as in :class:`OwnModel.rollout`."""
        assert self.run is not None
        x, y = x0.copy(), np.empty((len(x0), u.shape[1] + 1, self.n_y))
        self.run(x, u, d, p, h, pieces, y)
        return y, x


@lru_cache(maxsize=32)
def compile_code(code: OwnCode) -> Compiled:
    """Return the class's functions compiled, tried on one step; once for each class."""
    n_x, n_y, values = len(code.states), len(code.outputs), list(code.parameters.values())
    u, d = np.ones((1, 1, len(code.inputs))), np.ones((1, 1, len(code.disturbances)))
    p = np.array([[item.value for item in values]])
    try:
        made = Compiled(_loop(code), "", n_y)
        made.rollout(np.ones((1, n_x)), u, d, p, 1e-3, 1)
    except NumbaError as error:
        return Compiled(None, _first_line(error), n_y)
    return made


def _loop(code: OwnCode) -> Callable[..., None]:
    """Return the loop over members, rows and pieces, around the compiled functions."""
    kind = type(code.made)
    rhs = _jit(kind.rhs)
    output = _jit(kind.output) if hasattr(kind, "output") else _states_read(code)
    constants = code.constants
    own: Any = as_tuple("own", constants)(*constants.values())
    X, U, D, P = code.X, code.U, code.D, code.P
    n_x, n_u, n_d, n_p = len(code.states), len(code.inputs), len(code.disturbances), len(code.parameters)
    ends = [code.limits.get(name, (-np.inf, np.inf)) for name in code.states]
    low, high = np.array([a for a, _ in ends]), np.array([b for _, b in ends])

    @_jit
    def piece(x: Array, a: Array, k: Array, held: Any, fed: Any, numbers: Any, h: float, me: Any) -> None:
        for stage in range(4):
            share = 0.0 if stage == 0 else h if stage == 3 else h / 2
            for i in range(n_x):
                a[i] = x[i] + share * k[stage - 1, i] if stage else x[i]
            rate = rhs(me, X(*to_fixed_tuple(a, n_x)), held, fed, numbers)
            for i in range(n_x):
                k[stage, i] = rate[i]
        for i in range(n_x):
            x[i] += h / 6 * (k[0, i] + 2 * (k[1, i] + k[2, i]) + k[3, i])
            x[i] = min(max(x[i], low[i]), high[i]) if np.isfinite(x[i]) else x[i]

    @_jit
    def read(x: Array, numbers: Any, me: Any, y: Array) -> None:
        values = output(me, X(*to_fixed_tuple(x, n_x)), numbers)
        for j in range(len(y)):
            y[j] = values[j]

    @_jit
    def run(x: Array, u: Array, d: Array, p: Array, h: float, pieces: int, y: Array, me: Any) -> None:
        a, k = np.empty(n_x), np.empty((4, n_x))
        for b in range(len(x)):
            numbers = P(*to_fixed_tuple(p[b if len(p) > 1 else 0], n_p))
            at_u, at_d = b if len(u) > 1 else 0, b if len(d) > 1 else 0
            for row in range(u.shape[1]):
                read(x[b], numbers, me, y[b, row])
                held, fed = U(*to_fixed_tuple(u[at_u, row], n_u)), D(*to_fixed_tuple(d[at_d, row], n_d))
                for _ in range(pieces):
                    piece(x[b], a, k, held, fed, numbers, h, me)
            read(x[b], numbers, me, y[b, u.shape[1]])

    return lambda x, u, d, p, h, pieces, y: run(x, u, d, p, h, pieces, y, own)


def _states_read(code: OwnCode) -> Callable[..., Any]:
    """Return the output of a class whose outputs are states of the same name."""
    at = tuple(list(code.states).index(name) for name in code.outputs)

    @_jit
    def output(_me: Any, x: Any, _p: Any) -> Any:
        out = np.empty(len(at))
        for j in range(len(at)):
            out[j] = x[at[j]]
        return out

    return output


def _first_line(error: Exception) -> str:
    """Return what numba says in one line: the last line of its message that is a sentence."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    said = [
        line for line in lines if not line.startswith(("Failed in", "During", "File", "<source", ">>>", "^"))
    ]
    return (said or lines or ["numba cannot read it"])[0][:160]
