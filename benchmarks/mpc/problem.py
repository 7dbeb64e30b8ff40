r"""The reference problem of the controllers: a skin behind two tubes of water, a Peltier tank, one current.

Two Peltier modules temper a copper tank; a pump moves its water through a tube to a finger whose surface is
to follow a schedule, and back.  With temperatures [degC] of the heatsinks h, the tank's wall c, its water w,
the finger's water f and its surface s, n modules, the current I (heating where positive) and T in kelvin:

    C_h h' = n (-S I T_h + R I^2 / 2 - K (h - c)) - G_h (h - a)
    C_c c' = n ( S I T_c + R I^2 / 2 + K (h - c)) + q_c - k_cw (c - w) - G_c (c - a)
    C_w w' = k_cw (c - w) + F (b - w)
    C_f f' = F (e - f) - k_fs (f - s)
    C_s s' = k_fs (f - s) + q_s - G_s (s - a)

e and b leave the tubes: what entered one delay ago, drawn towards the room a by exp(-G_t/F).  q_c and q_s are
heat flows that the model does not know; a filter estimates them.  S, R, K are near a TEC1-12706; tank, tubes
and finger are engineering guesses.

The plant that closes the loop is not the model: S -7 %, R +7.5 %, K +9 %, flow -5 %, losses +20 to 33 %, the
room 1.5 degC warmer, 0.02 degC of noise on three sensors; it runs in steps of 50 ms.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.sysid.plant.plant import Plant

__all__ = [
    "DT",
    "MODEL",
    "OVERSHOOT",
    "SEGMENT",
    "TANK",
    "TRUE",
    "Filter",
    "Loop",
    "ReferenceModel",
    "plant_of",
    "run_loop",
]

Array = NDArray[np.float64]

DT = 0.5  # s
HORIZON = 50
SEGMENT = 150  # samples of each target
SLEW = 0.5  # A per sample
TANK = (2.0, 60.0)  # degC, soft
OVERSHOOT = 0.3  # degC, soft
TRACK, DRIVE, MOVE, LAST = 1.0, 1e-3, 0.2, 10.0  # weights: degC^2, A^2, (A per sample)^2, the last sample
PRICE = 50.0
DELAY = 2.0  # s, each way
KELVIN = 273.15

MODEL: dict[str, float] = {
    "n": 2, "S": 0.050, "R": 2.0, "K": 0.55,
    "C_h": 540.0, "G_h": 8.0, "C_c": 58.0, "k_cw": 30.0, "C_w": 105.0, "F": 21.0,
    "C_f": 25.0, "k_fs": 2.0, "C_s": 15.0, "G_c": 0.15, "G_s": 0.15, "G_t": 0.15, "a": 25.0,
}  # fmt: skip
TRUE = MODEL | {
    "S": 0.0465,
    "R": 2.15,
    "K": 0.60,
    "G_s": 0.18,
    "G_c": 0.2,
    "k_fs": 1.85,
    "F": 20.0,
    "a": 26.5,
    "G_h": 7.2,
}


class ReferenceModel:
    """The equations, in steps of one Runge-Kutta rule, the tubes as shift registers.

    Parameters
    ----------
    numbers : mapping of str to float
        :data:`MODEL` or :data:`TRUE`.
    dt : float, optional
        Step [s].
    """

    kind = "reference"
    inputs, disturbances = ("current",), ("q_tank", "q_surface")
    outputs = ("t_heatsink", "t_tank", "t_surface")
    switches: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()

    def __init__(self, numbers: Mapping[str, float], *, dt: float = DT) -> None:
        self.numbers, self.dt = dict(numbers), dt
        self.cells = round(DELAY * MODEL["F"] / numbers["F"] / dt)  # the same water, at another flow
        self.keeps = float(np.exp(-numbers["G_t"] / numbers["F"]))

    @property
    def n_x(self) -> int:
        """Five temperatures and the cells of both tubes."""
        return 5 + 2 * self.cells

    @property
    def spread(self) -> Array:
        """Prior covariance of a state about rest."""
        return np.eye(self.n_x) * 0.25

    def rhs(self, x: Sequence[Any], u: Any, d: Sequence[Any], e: Any, b: Any) -> list[Any]:
        """Return the five derivatives."""
        p, (h, c, w, f, s) = self.numbers, x
        joule = 0.5 * p["R"] * u * u
        into_tank = p["S"] * u * (c + KELVIN) + joule + p["K"] * (h - c)
        into_sink = joule - p["S"] * u * (h + KELVIN) - p["K"] * (h - c)
        return [
            (p["n"] * into_sink - p["G_h"] * (h - p["a"])) / p["C_h"],
            (p["n"] * into_tank + d[0] - p["k_cw"] * (c - w) - p["G_c"] * (c - p["a"])) / p["C_c"],
            (p["k_cw"] * (c - w) + p["F"] * (b - w)) / p["C_w"],
            (p["F"] * (e - f) - p["k_fs"] * (f - s)) / p["C_f"],
            (p["k_fs"] * (f - s) + d[1] - p["G_s"] * (s - p["a"])) / p["C_s"],
        ]

    def step(self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], p: Any, dt: float) -> list[Any]:
        """Return the state one step later."""
        n, room = self.cells, self.numbers["a"]
        x = [x[i] for i in range(self.n_x)]
        five, there, back = x[:5], x[5 : 5 + n], x[5 + n :]
        e, b = (room + self.keeps * (tube[-1] - room) for tube in (there, back))
        k1 = self.rhs(five, u[0], d, e, b)
        k2 = self.rhs([v + dt / 2 * k for v, k in zip(five, k1)], u[0], d, e, b)
        k3 = self.rhs([v + dt / 2 * k for v, k in zip(five, k2)], u[0], d, e, b)
        k4 = self.rhs([v + dt * k for v, k in zip(five, k3)], u[0], d, e, b)
        after = [v + dt / 6 * (q + 2 * (r + s) + t) for v, q, r, s, t in zip(five, k1, k2, k3, k4)]
        return [*after, x[2], *there[:-1], x[3], *back[:-1]]

    def output(self, x: Sequence[Any], p: Any) -> list[Any]:
        """Return what the three sensors read."""
        return [x[0], x[2], x[4]]

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return a state whose sensors read y, each tube as warm as what enters it."""
        h, w, s = np.asarray(y, dtype=float)
        return np.array([h, w, w, s, s] + [w] * self.cells + [s] * self.cells)

    def rollout(
        self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float
    ) -> tuple[Array, Array]:
        """Simulate a batch in machine code."""
        from thermogrip.sysid.models.jit_rollout import Kernel
        from thermogrip.sysid.models.model import Sizes

        if not hasattr(self, "_kernel"):
            self._kernel = Kernel(self.step, self.output, Sizes(self.n_x, 1, len(self.disturbances), 0))
        batch = [np.ascontiguousarray(v, dtype=float) for v in (x0, u, d)]
        return self._kernel.rollout(*batch, np.zeros((1, 0)), dt)

    def to_dict(self) -> dict[str, Any]:
        """Return what makes it."""
        return {"kind": self.kind, "numbers": self.numbers, "dt": self.dt}


def plant_of(numbers: Mapping[str, float], *, dt: float = DT, current: float = 5.0) -> Plant:
    """Return the model as a plant whose current may be up to so many amperes."""
    units = {"current": "A"} | dict.fromkeys(ReferenceModel.disturbances, "W")
    noise = dict.fromkeys(ReferenceModel.outputs, 0.02)
    valid = {"current": (-current, current), "t_surface": (5.0, 50.0)}
    return Plant(ReferenceModel(numbers, dt=dt), {}, dt=dt, units=units, noise=noise, valid=valid)


class Filter:
    """Extended Kalman filter of the state and the two unknown heat flows, each with process noise.

    Every controller of the benchmark gets its estimates; its time is nobody's.
    """

    def __init__(self, model: ReferenceModel) -> None:
        from thermogrip.mpc.plant.prediction import PredictionModel

        self.model = PredictionModel(plant_of(model.numbers), dt=DT)
        n = self.model.n_x
        self.x, self.q = np.full(n, 25.0), np.zeros(2)
        self.P = np.diag([0.1] * n + [100.0, 1.0])
        self.Q = np.diag([2e-4] * 5 + [1e-5] * (n - 5) + [0.3, 1e-3])
        self.H = np.zeros((3, n + 2))
        self.H[[0, 1, 2], [0, 2, 4]] = 1.0

    def update(self, y: Array) -> None:
        """Correct with the three readings."""
        z = np.concatenate([self.x, self.q])
        gain = np.linalg.solve(self.H @ self.P @ self.H.T + 0.02**2 * np.eye(3), self.H @ self.P).T
        z = z + gain @ (y - self.H @ z)
        self.P = (np.eye(len(z)) - gain @ self.H) @ self.P
        self.x, self.q = z[:-2], z[-2:]

    def predict(self, u: float) -> None:
        """Carry on under this current."""
        n = len(self.x)
        self.x, A, _, E = self.model.linearise(self.x, np.array([u]), self.q)
        step = np.eye(n + 2)
        step[:n, :n], step[:n, n:] = A, E
        self.P = step @ self.P @ step.T + self.Q


@dataclass(frozen=True)
class Loop:
    """One closed loop.

    Attributes
    ----------
    y : (n, 3) ndarray
        True temperatures after each sample.
    u : (n,) ndarray
        Currents.
    target : (n,) ndarray
    cpu : (n,) ndarray
        Process CPU time of each call of the controller [s].
    power : (n,) ndarray
        Electrical power [W].
    failed : int
        Answers that were no number.
    """

    y: Array
    u: Array
    target: Array
    cpu: Array
    power: Array
    failed: int

    @property
    def cost(self) -> float:
        """Sum of the squared errors and of the weighted currents and their changes."""
        moves = np.diff(self.u, prepend=0.0)
        squares = TRACK * (self.y[:, 2] - self.target) ** 2 + MOVE * moves**2 + DRIVE * self.u**2
        return float(np.sum(squares))

    @property
    def energy_wh(self) -> float:
        """Electrical energy [Wh]."""
        return float(np.sum(np.maximum(self.power, 0.0)) * DT / 3600)

    def settling(self, band: float = 0.2) -> list[float]:
        """Return by segment the last time outside the band [s]; NaN where it ends outside."""
        found = []
        for part in range(len(self.u) // SEGMENT):
            rows = slice(part * SEGMENT, (part + 1) * SEGMENT)
            outside = np.flatnonzero(np.abs(self.y[rows, 2] - self.target[rows]) > band)
            last = outside[-1] + 1 if outside.size else 0
            found.append(last * DT if last < SEGMENT else float("nan"))
        return found

    def overshoot(self) -> list[float]:
        """Return by segment the largest excursion beyond the target [degC]."""
        found, before = [], 25.0
        for part in range(len(self.u) // SEGMENT):
            rows = slice(part * SEGMENT, (part + 1) * SEGMENT)
            goal = float(self.target[rows][0])
            error = (self.y[rows, 2] - goal) * np.sign(goal - before)
            found.append(max(0.0, float(error.max())))
            before = goal
        return found


#: state, heat flows, current before, target, lower and upper edge of the band -> current
Answer = Callable[[Array, Array, float, float, float, float], float]


def run_loop(
    answer: Answer,
    *,
    targets: Sequence[float] = (18.0, 38.0, 23.0, 48.0),
    current: float = 5.0,
    seed: int = 0,
    steps: int | None = None,
) -> Loop:
    """Close the loop; what a controller answers is clipped to range and slew here as well."""
    true = ReferenceModel(TRUE, dt=DT / 10)
    x, rng = [25.0] * true.n_x, np.random.default_rng(seed)
    estimate = Filter(ReferenceModel(MODEL))
    u, side, goal_before, failed = 0.0, 0.0, 25.0, 0
    rows: list[tuple[float, ...]] = []
    y = np.array(true.output(x, ())) + 0.02 * rng.standard_normal(3)
    for k in range(SEGMENT * len(targets) if steps is None else steps):
        goal = targets[min(k // SEGMENT, len(targets) - 1)]
        if goal != goal_before:
            side, goal_before = np.sign(goal - goal_before), goal
        low = goal - OVERSHOOT if side < 0 else -100.0
        high = goal + OVERSHOOT if side > 0 else 100.0
        estimate.update(y)
        state, flows = estimate.x.copy(), estimate.q.copy()
        children, began = _children(), time.process_time()
        wanted = answer(state, flows, u, goal, low, high)
        cpu = time.process_time() - began + _children() - children
        if not np.isfinite(wanted):
            failed, wanted = failed + 1, u
        u = float(np.clip(np.clip(wanted, u - SLEW, u + SLEW), -current, current))
        estimate.predict(u)
        p = true.numbers
        power = p["n"] * (p["S"] * u * (x[1] - x[0]) + p["R"] * u * u)
        for _ in range(10):
            x = true.step(x, [u], (0.0, 0.0), (), DT / 10)
        y = np.array(true.output(x, ())) + 0.02 * rng.standard_normal(3)
        rows.append((x[0], x[2], x[4], u, goal, cpu, power))
    found = np.array(rows)
    return Loop(found[:, :3], found[:, 3], found[:, 4], found[:, 5], found[:, 6], failed)


def _children() -> float:
    """Return the CPU time of programs that a controller starts [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
