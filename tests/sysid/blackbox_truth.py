"""Simulated plants with known poles, gains and delays, for the black-box tests."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log

POLE, GAIN, DELAY = 0.95, 0.5, 3  # y[k] = 0.95 y[k-1] + 0.5 u[k-3] about 25 degC: gain 10 K


def first_order_log(
    n: int = 2000,
    *,
    noise: float = 0.05,
    seed: int = 0,
    gap: bool = False,
    level: float = 25.0,
    name: str = "a",
) -> Log:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random(n // 20 + 1) - 0.5, 20)[:n]
    u[:20] = 0.0  # at rest before the first row
    y = level + lfilter([0.0] * DELAY + [GAIN], [1.0, -POLE], u) + noise * rng.standard_normal(n)
    time = np.arange(float(n))
    if gap:
        keep = (time < n // 2) | (time > n // 2 + 40)
        time, u, y = time[keep], u[keep], y[keep]
    return make_log(time, {"q": (u, "1", "input"), "t": (y, "degC", "output")}, name=name)


def mimo_log(n: int = 3000, *, noise: float = 0.01, seed: int = 0) -> tuple[Log, tuple[np.ndarray, ...]]:
    """Two coupled blocks heated by two heaters; returns the log and (A, B, C)."""
    rng = np.random.default_rng(seed)
    A = np.array([[0.93, 0.04], [0.05, 0.90]])
    B, C = np.array([[0.6, 0.0], [0.1, 0.4]]), np.eye(2)
    u = np.repeat(rng.random((n // 15 + 1, 2)), 15, axis=0)[:n]
    x = np.zeros((n + 1, 2))
    for k in range(n):
        x[k + 1] = A @ x[k] + B @ u[k]
    y = x[:-1] @ C.T + np.array([25.0, 27.0]) + noise * rng.standard_normal((n, 2))
    variables = {
        "q1": (u[:, 0], "1", "input"),
        "q2": (u[:, 1], "1", "input"),
        "t1": (y[:, 0], "degC", "output"),
        "t2": (y[:, 1], "degC", "output"),
    }
    return make_log(np.arange(float(n)), variables, name="mimo"), (A, B, C)
