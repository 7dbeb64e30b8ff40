"""Plants that close a loop and share no code with the package: plain ODEs in NumPy, and linear models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm

from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

Array = np.ndarray


@dataclass
class Ode:
    """dx/dt = rhs(x, u), y = C x, integrated by Runge-Kutta; ``bias`` is what the sensors add."""

    rhs: Callable[[Array, Array], Array]
    x: Array
    drives: tuple[str, ...]
    outputs: tuple[str, ...]
    C: Array
    bias: Array | float = 0.0
    noise: float = 0.02
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def reading(self) -> dict[str, float]:
        values = self.true + self.bias + self.noise * self.rng.standard_normal(len(self.C))
        return dict(zip(self.outputs, values.tolist(), strict=True))

    @property
    def true(self) -> Array:
        return self.C @ self.x

    def apply(self, drive: float | dict[str, float], seconds: float) -> None:
        u = np.array([drive[name] for name in self.drives] if isinstance(drive, dict) else [drive])
        n = max(1, round(seconds / 0.5))
        for _ in range(n):
            h, x, f = seconds / n, self.x, self.rhs
            a = f(x, u)
            b = f(x + h / 2 * a, u)
            c = f(x + h / 2 * b, u)
            self.x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c, u))


def linear_model(truth: Ode, x: Array, u: Array, *, dt: float, unit: str = "percent") -> Plant:
    """Return the sampled plant, linearised at (x, u)."""
    n, eps = len(x), 1e-5
    A = np.stack([(truth.rhs(x + e, u) - truth.rhs(x - e, u)) / (2 * eps) for e in eps * np.eye(n)], axis=1)
    B = np.stack(
        [(truth.rhs(x, u + e) - truth.rhs(x, u - e)) / (2 * eps) for e in eps * np.eye(len(u))], axis=1
    )
    still = truth.rhs(x, u) - A @ x - B @ u
    whole = np.zeros((n + len(u) + 1,) * 2)
    whole[:n] = np.hstack([A, B, still[:, None]])
    step = expm(dt * whole)[:n]
    model = StateSpaceModel(
        truth.drives, (), truth.outputs, A=step[:, :n], B=step[:, n:-1], C=truth.C, c=step[:, -1], dt=dt,
        spread=np.diag(np.full(n, 9.0)),
    )  # fmt: skip
    units = dict.fromkeys(truth.drives, unit) | dict.fromkeys(truth.outputs, "degC")
    valid = dict.fromkeys(truth.drives, (0.0, 100.0))
    return Plant(model, {}, dt=dt, units=units, valid=valid, noise=dict.fromkeys(truth.outputs, 0.02))


def furnace(*, disagree: float = 0.0) -> Ode:
    """Two heaters on six zones in a row and six sensors, each of which sees its neighbours' zones as well."""
    heat, to_air, between = np.zeros((6, 2)), np.full(6, 0.25), np.full(5, 6.0)
    heat[1, 0] = heat[4, 1] = 0.9  # W per percent
    capacity = np.array([48.0, 80.0, 56.0, 64.0, 88.0, 44.0])

    def rhs(x: Array, u: Array) -> Array:
        flow = heat @ u - to_air * (x - 25.0)
        through = between * np.diff(x)
        flow[:-1] += through
        flow[1:] -= through
        return flow / capacity

    signs = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    names = tuple(f"t{k}" for k in range(1, 7))
    C = 0.39 * np.eye(6) + 0.305 * (np.eye(6, k=1) + np.eye(6, k=-1))
    C /= C.sum(axis=1, keepdims=True)
    return Ode(rhs, np.full(6, 25.0), ("q1", "q2"), names, C, disagree * signs)


def quadruple_tank(*, power: float = 1.0) -> Ode:
    """Johansson's four tanks, minimum phase, at 30 percent of pumps of this ``power``; levels in cm."""
    area, hole = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])
    k, split, g = power * np.array([3.33, 3.35]), np.array([0.7, 0.6]), 981.0

    def rhs(x: Array, u: Array) -> Array:
        h = np.maximum(x, 0.0)
        out = hole * np.sqrt(2 * g * h) / area
        v = 0.1 * u  # 100 percent are 10 V
        into = np.array([split[0] * k[0] * v[0], split[1] * k[1] * v[1],
                         (1 - split[1]) * k[1] * v[1], (1 - split[0]) * k[0] * v[0]])  # fmt: skip
        fed = np.array([out[2] * area[2], out[3] * area[3], 0.0, 0.0])
        return (into + fed) / area - out

    rest = np.array([12.263, 12.783, 1.634, 1.409])
    return Ode(rhs, rest, ("v1", "v2"), ("h1", "h2"), np.eye(4)[:2], noise=0.005)
