"""How long DAQP's own solve takes of the programs of a loop, H and A given to it, from its last set."""

from __future__ import annotations

import numpy as np
from daqp import Model
from numpy.typing import NDArray

from thermogrip.mpc.optimiser.qp import CondensedQP, QPAnswer

Array = NDArray[np.float64]


class Floor:
    """Solves the programs of a :class:`CondensedQP` in its place, and keeps the seconds that DAQP says it
    took, its setup (factors of H and A) not counted."""

    def __init__(self, qp: CondensedQP) -> None:
        self.seconds: list[float] = []
        self._qp, self._model = qp, Model()
        self._is_set_up = False
        vars(qp)["solve"] = self.solve

    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> QPAnswer:
        """Return the minimiser, as :meth:`CondensedQP.solve` does."""
        scale = 1.0 / np.sqrt(np.diag(H))
        length = np.maximum(np.linalg.norm(A * scale, axis=1), 1e-5)
        given = {
            "H": H * np.outer(scale, scale),
            "f": f * scale,
            "A": A * scale / length[:, None],
            "bupper": np.minimum(upper / length, 1e20),
            "blower": np.maximum(lower / length, -1e20),
        }
        if self._is_set_up:
            self._model.update(**given)
        else:
            self._model.settings = {"primal_tol": 1e-10}
            self._model.setup(**given, sense=np.where(self._qp.soft, 8, 0).astype(np.int32))
            self._model.settings = {"primal_tol": 1e-10}
            self._is_set_up = True
        give = 1.0 / np.maximum(self._qp.quadratic * length**2, 1e-9)
        price = np.where(self._qp.soft, self._qp.linear * length, 0.0)
        self._model.soft_weights(give, give, price, price)
        z, _, flag, info = self._model.solve()
        if flag <= 0:
            raise RuntimeError(f"DAQP says {flag}")
        self.seconds.append(info["solve_time"])
        nothing = np.zeros(len(lower))
        return QPAnswer(z * scale, "solved", int(info["iterations"]), nothing, nothing)
