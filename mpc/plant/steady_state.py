r"""Which drive holds which temperature: the plant's steady map, its limits, and where its gain turns over.

In steady state x = f(x, u, d), so the outputs are a function y(u) of the drives.  For a Peltier element it
is a parabola in the cooling direction: pumped heat grows with the current, Joule heat with its square, and
past the optimum more current heats.  What lies beyond the optimum, or beyond the range of the drive, cannot
be held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.plant.prediction import PredictionModel

_NEWTON_STEPS, _BALANCED = 20, 1e-7  # and by how much a state may move in a sample [degC]


@dataclass(frozen=True)
class Holding:
    """The drive that holds a target."""

    u: Array  # (n_u,) drives
    y: Array  # (n_y,) all outputs at these drives [degC]
    # largest distance of a controlled output from its target [degC]; 0 where the target can be held
    miss: float


@dataclass(frozen=True)
class SteadyCurve:
    """One output over one drive, in steady state."""

    drive: Array  # (n,) drive in its units, output [degC]; NaN where the plant has no steady state
    y: Array
    # the widest range of drive in which the output rises with it (or falls, for a cooler): the safe side
    rising: tuple[float, float]
    turns: tuple[float, ...]  # drives at which the gain changes sign, an optimum of the Peltier element


def holding_drive(
    model: PredictionModel, controlled: tuple[str, ...], target: ArrayLike, d: ArrayLike
) -> Holding:
    """Return the drives inside their range that hold the controlled outputs nearest to target (n_controlled,)
    [degC].

    Nearest in the least-squares sense, started from the best of a coarse grid: beyond an optimum there are
    two drives for one temperature, and the smaller one wins. For an integrator, which rests at any
    temperature or at none, the drives that balance it there; they may lie outside their range.
    """
    wanted = np.asarray(target, dtype=float).reshape(len(controlled))
    d = np.asarray(d, dtype=float)
    rows = [model.outputs.index(name) for name in controlled]

    def miss(scaled: Array) -> Array:
        y = model.steady_output(scaled * model.span, d)[rows]
        return np.where(np.isfinite(y), y - wanted, 1e3)

    low, high = model.lowest / model.span, model.highest / model.span
    starts = [low + share * (high - low) for share in (0.1, 0.3, 0.5, 0.7, 0.9)]
    # a small weight of the drive itself picks the smaller of two that hold the same temperature
    costs = [float(np.sum(miss(start) ** 2) + 1e-2 * np.sum(start**2)) for start in starts]
    found = least_squares(
        miss, starts[int(np.argmin(costs))], bounds=(low, high), diff_step=[1e-3] * model.n_u, xtol=1e-10
    )
    u = found.x * model.span
    y = model.steady_output(u, d)
    if not np.isfinite(y).all():
        u, y = _balance(model, rows, wanted, d)
        return Holding(u, y, float(np.max(np.abs(np.where(np.isfinite(y[rows]), y[rows] - wanted, 1e3)))))
    return Holding(u, y, float(np.max(np.abs(miss(found.x)))))


def _balance(model: PredictionModel, rows: list[int], wanted: Array, d: Array) -> tuple[Array, Array]:
    """Return drives and outputs of a state that stays and has these outputs, by Newton's method.

    Outputs are NaN where there is none.
    """
    x, u = model.rest(np.full(model.n_y, wanted.mean()), d), model.neutral
    for _ in range(_NEWTON_STEPS):
        after, A, B, _ = model.linearise(x, u, d)
        off = np.concatenate([after - x, model.output(x)[rows] - wanted])
        if np.max(np.abs(off)) < _BALANCED:
            return u, model.output(x)
        outputs = np.hstack([model.C[rows], np.zeros((len(rows), model.n_u))])
        by = np.vstack([np.hstack([A - np.eye(model.n_x), B * model.span]), outputs])
        move = np.linalg.lstsq(by, -off, rcond=None)[0]
        x, u = x + move[: model.n_x], u + move[model.n_x :] * model.span
    return u, np.full(model.n_y, np.nan)


def steady_curve(
    model: PredictionModel, drive: str, output: str, d: ArrayLike, *, n: int = 41
) -> SteadyCurve:
    """Return the steady output over n points of a drive's range, the other drives at rest, under
    disturbances d (n_d,).
    """
    j, i = model.drives.index(drive), model.outputs.index(output)
    grid = np.linspace(model.lowest[j], model.highest[j], n)
    neutral = model.neutral
    y = np.empty(n)
    for at, value in enumerate(grid):
        u = neutral.copy()
        u[j] = value
        y[at] = model.steady_output(u, d)[i]
    sign = np.sign(np.diff(y))
    usual = sign[np.argmin(np.abs(0.5 * (grid[1:] + grid[:-1]) - neutral[j]))]
    turns = tuple(float(grid[at + 1]) for at in np.flatnonzero(sign[1:] * sign[:-1] < 0))
    below = [turn for turn in turns if turn < neutral[j]]
    above = [turn for turn in turns if turn > neutral[j]]
    rising = (max(below, default=float(grid[0])), min(above, default=float(grid[-1])))
    return SteadyCurve(grid, y, rising if usual else (neutral[j], neutral[j]), turns)
