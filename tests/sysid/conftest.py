"""Simulated plants with known poles, gains and delays, and fits of one structure of a black box."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.blackbox.fit import family_of
from thermogrip.sysid.models.model import BlackBox
from thermogrip.sysid.plant.log_grid import Grid

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


COUPLED = np.array([[0.93, 0.04], [0.05, 0.90]])
PUSH = np.array([[0.6, 0.0], [0.1, 0.4]])


def coupled_log(
    n: int = 3000,
    *,
    reading: float = 0.0,
    process: float = 0.0,
    seed: int = 0,
    lost: float = 0.0,
    burst: int = 1,
) -> Log:
    """Two coupled blocks, two heaters; noise of readings and of the process, readings lost in bursts."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random((n // 15 + 1, 2)), 15, axis=0)[:n]
    x = np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = COUPLED @ x[k] + PUSH @ u[k] + (process * rng.standard_normal(2) if process else 0.0)
    y = x + np.array([25.0, 27.0]) + reading * rng.standard_normal((n, 2))
    y = np.where(np.repeat(rng.random((n // burst + 1, 2)) < lost, burst, axis=0)[:n], np.nan, y)
    variables = {
        "q1": (u[:, 0], "1", "input"),
        "q2": (u[:, 1], "1", "input"),
        "t1": (y[:, 0], "degC", "output"),
        "t2": (y[:, 1], "degC", "output"),
    }
    return make_log(np.arange(float(n)), variables, name=f"coupled {seed}")


@pytest.fixture(scope="session")
def first_order() -> SimpleNamespace:
    """A heater of one time constant: its numbers, and logs of it."""
    return SimpleNamespace(pole=POLE, gain=GAIN, delay=DELAY, log=first_order_log)


@pytest.fixture(scope="session")
def coupled() -> SimpleNamespace:
    """Two coupled blocks: their matrices, and logs of them."""
    return SimpleNamespace(A=COUPLED, B=PUSH, C=np.eye(2), log=coupled_log)


def _fit_one(kind: str, grid: Grid, *, variant: str = "", **orders: Any) -> BlackBox:
    plain: dict[str, dict[str, Any]] = {"subspace": {"terms": ()}}
    plain |= {kind: {"terms": (), "delays": 1} for kind in ("arx", "oe")}
    plain |= {"sindy": {"degrees": 2, "thresholds": 0.01, "memories": 1}}
    orders = plain.get(kind, {}) | orders
    tried = {name: value if name == "members" else (value,) for name, value in orders.items()}
    found = {s.label: m for s, m in family_of(kind)(grid, **tried).items() if variant in s.label}
    if kind == "arx":  # coupled where it can be
        found = {s: m for s, m in found.items() if "coupled" in s} or found
    (model,) = found.values()  # ValueError where no structure could be fitted
    return model


@pytest.fixture(scope="session")
def fit_one() -> Callable[..., BlackBox]:
    """Return the function of (kind, grid, orders by the family's names, variant) to one model."""
    return _fit_one
