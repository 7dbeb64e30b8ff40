"""What compiled code is held against, and the gain of a linear model."""

from __future__ import annotations

from typing import Any

import numpy as np


def roll_rows(step: Any, output: Any, x0: Any, u: Any, d: Any, p: Any, h: float, pieces: int = 1) -> Any:
    """A rollout by NumPy: the same lines on rows with one entry a member."""
    x, parameters = list(x0.T.copy()), list(p.T)
    outputs = [np.broadcast_to(output(x, parameters), (len(output(x, parameters)), len(x0)))]
    for u_row, d_row in zip(u.transpose(1, 2, 0), d.transpose(1, 2, 0)):
        for _ in range(pieces):
            x = step(x, list(u_row), list(d_row), parameters, h)
        outputs.append(np.array(output(x, parameters)))
    return np.array(outputs).transpose(2, 0, 1), np.array(x).T


def steady_gain(model: Any) -> Any:
    return model.C @ np.linalg.solve(np.eye(model.n_x) - model.A, model.B)
