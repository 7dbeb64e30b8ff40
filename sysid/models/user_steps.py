"""A user's class as steps: the classical Runge-Kutta rule around its ``rhs``, on numbers of any kind.

    x+ = x + h/6 (k1 + 2 k2 + 2 k3 + k4),
    k1 = f(x),   k2 = f(x + h/2 k1),   k3 = f(x + h/2 k2),   k4 = f(x + h k3),

after which a state with limits is put back inside them.  The same lines run on NumPy rows, on CasADi symbols
and on lanes (:mod:`thermogrip.sysid.models.jit_simd`), which leave them behind as machine code: the class's
functions are called once, whatever they call in turn, and a loop in them is unrolled.  What lanes cannot say
(sorting, say, or a function of SciPy) is left to NumPy, tens of times slower.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.user_class import OwnCode

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Kernel

__all__ = ["OwnSteps", "compile_steps"]


@dataclass(frozen=True)
class OwnSteps:
    """The steps of a class; see :class:`thermogrip.sysid.models.jit_rollout.Equations`."""

    code: OwnCode

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.code.states)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.code.inputs)

    @property
    def n_d(self) -> int:
        """Number of disturbances."""
        return len(self.code.disturbances)

    @property
    def n_p(self) -> int:
        """Number of parameters."""
        return len(self.code.parameters)

    def prepare(self, p: Sequence[Any]) -> list[Any]:
        """Return the parameters."""
        return list(p)

    def renew(self, u: Sequence[Any], c: Sequence[Any], h: Any) -> list[Any]:
        """Return nothing: no part of a class is known to hang on switches alone."""
        return []

    def advance(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], c: Sequence[Any], kept: Any, h: Any
    ) -> list[Any]:
        """Return the state one step of ``h`` on."""
        rhs = self.code.rhs
        k1 = rhs(x, u, d, c)
        k2 = rhs([a + h / 2 * k for a, k in zip(x, k1)], u, d, c)
        k3 = rhs([a + h / 2 * k for a, k in zip(x, k2)], u, d, c)
        k4 = rhs([a + h * k for a, k in zip(x, k3)], u, d, c)
        state = [a + h / 6 * (s + 2 * (q + r) + t) for a, s, q, r, t in zip(x, k1, k2, k3, k4)]
        for i, name in enumerate(self.code.states):
            low, high = self.code.limits.get(name, (-np.inf, np.inf))
            if np.isfinite(low):
                state[i] = np.maximum(state[i], low)
            if np.isfinite(high):
                state[i] = np.minimum(state[i], high)
        return state

    def read(self, x: Sequence[Any], c: Sequence[Any]) -> list[Any]:
        """Return the outputs."""
        return self.code.output(x, c)


@lru_cache(maxsize=32)
def compile_steps(code: OwnCode) -> tuple[Kernel | None, str]:
    """Return the compiled steps of a class, or None and why there are none."""
    try:
        from thermogrip.sysid.models.jit_rollout import Kernel
    except ImportError:
        return None, "llvmlite is missing"
    try:
        return Kernel(OwnSteps(code), in_pieces=True), ""
    except UserError as error:
        return None, error.problem
