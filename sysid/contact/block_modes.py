"""Compiled modes of the grasped block, of one step of a mode, and their derivatives.

The face of a slab whose far one loses U per degree falls, per unit flux, by modes j = 0, 1, ... of rate

    lam_j = (beta_j e / C)^2,   beta_j = j pi + arctan(Bi / beta_j),   Bi = U C / e^2,

and weight 2/C (beta^2 + Bi^2) / (beta^2 + Bi^2 + Bi): j pi and 2/C (1/C of j = 0) where nothing is lost.
Those beyond the first dozen are grouped by Gauss quadrature over ln j from j = 11.5 (Euler-Maclaurin's
midpoint rule, with its next term), those faster than a millisecond are a series resistance.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["FADED", "INNER", "N_MODE", "OUTER", "first_step", "mode_step", "mode_step_moves", "slab"]
__all__ += ["slab_moves", "slabs"]

Array = NDArray[np.float64]

# sums over modes may be reordered, so that they run in vector registers; infinities stay what they are
_FAST = {"reassoc", "contract", "arcp", "nsz"}
OUTER: dict[str, Any] = {"cache": True, "fastmath": _FAST, "error_model": "numpy"}
# what only compiled code calls needs no door for the interpreter, and compiles sooner
INNER = OUTER | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_N_EXACT, _N_GROUPED = 12, 24
N_MODE = _N_EXACT + _N_GROUPED + 1
FADED = 34.0  # lam dt past which exp(-lam dt) is nothing beside 1
_FASTEST = 2e3  # 1/s: modes beyond it are a series resistance
_NODE, _SHARE = (np.ascontiguousarray(v[::-1]) for v in np.polynomial.legendre.leggauss(_N_GROUPED))
_SMALL = 1e-3  # lam dt below which the series is closer
_HALVINGS = 7


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _eigenvalue(y: float, biot: float) -> float:
    """Return beta = y pi + arctan(Bi / beta), y pi where nothing is lost."""
    if biot == 0.0:
        return float(y * np.pi)
    # from the left of the root Newton's steps on a concave function never pass it
    beta = np.sqrt(biot / (1.0 + 0.5 * biot)) if y == 0.0 else y * np.pi
    for _ in range(4 if y == 0.0 else 3):
        square = beta * beta + biot * biot
        beta -= (beta - y * np.pi - np.arctan(biot / beta)) * square / (square + biot)
    return float(beta)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def slab(e: float, c: float, far: float, lam: Array, weight: Array) -> float:
    """Fill decay rates and weights (N_MODE,) of a slab, fast ones first; return its series resistance.

    ``far`` [W m^-2 K^-1] is lost per degree by the far face.
    """
    unit, biot = (e / c) ** 2, far * c / e**2
    start = _N_EXACT - 0.5
    top = max(np.sqrt(_FASTEST / unit) / np.pi, 3 * start)
    span = np.log(top / start)
    for i in range(N_MODE):
        grouped = i < _N_GROUPED
        y = start * np.exp(0.5 * span * (1 + _NODE[i])) if grouped else float(N_MODE - 1 - i)
        beta = _eigenvalue(y, biot)
        square = beta * beta + biot * biot
        # of a mode that nothing damps half
        share = square / (square + biot) if square > 0.0 else 0.5
        lam[i] = beta * beta * unit
        weight[i] = share / c * (span * _SHARE[i] * y if grouped else 2.0)
    # next Euler-Maclaurin term, f'(start)/24 as a difference of the modes on either side
    weight[_N_GROUPED + 1] *= 1 - 1 / 24
    weight[_N_GROUPED] *= 1 / 24
    resistance: float = 2 / (c * np.pi**2 * unit * top)
    return resistance


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def slabs(effusivity: Array, capacity: Array, far: float) -> tuple[Array, Array, Array]:
    """Return decay rates, weights (n, N_MODE) and series resistance (n,) of n slabs, slow modes first."""
    n = effusivity.size
    lam, weight, resistance = np.empty((n, N_MODE)), np.empty((n, N_MODE)), np.empty(n)
    for p in range(n):
        resistance[p] = slab(effusivity[p], capacity[p], far, lam[p], weight[p])
    return lam[:, ::-1].copy(), weight[:, ::-1].copy(), resistance


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def slab_moves(e: float, c: float, far: float, lam: Array, moves: Array) -> tuple[float, float]:
    """Fill derivatives (4, N_MODE) of ln rate and ln weight by ln e, then by ln C.

    ``lam`` (N_MODE,) are the rates. Return the derivatives of the logarithm of the series resistance.
    """
    ratio = np.sqrt(_FASTEST) * c / (np.pi * e * (_N_EXACT - 0.5))
    free, biot = ratio > 3.0, far * c / e**2
    for i in range(N_MODE):
        # the span shrinks by ln e and grows by ln C, and with it the place of a grouped mode
        along = 0.5 * (1 + _NODE[i]) if free and i < _N_GROUPED else 0.0
        wider = 1.0 / np.log(ratio) if free and i < _N_GROUPED else 0.0
        moves[0, i], moves[1, i] = 2.0 - 2.0 * along, -along - wider
        moves[2, i], moves[3, i] = -moves[0, i], -1.0 - moves[1, i]
        if biot == 0.0:
            continue
        beta = np.sqrt(lam[i]) * c / e
        square = beta * beta + biot * biot
        place = (beta - np.arctan(biot / beta)) / beta * square / (square + biot)  # d ln beta / d ln y
        by_biot = biot / (square + biot)  # d ln beta / d ln Bi
        for at, sign, power in ((0, -1.0, -2.0), (2, 1.0, 1.0)):
            d = sign * along * place + power * by_biot
            lost = power * biot / (square + biot)
            moves[at, i] = -2.0 * sign + 2.0 * d
            moves[at + 1, i] += 2.0 * (beta * beta * d + biot * biot * power) / square * by_biot - lost
    return (-1.0, 0.0) if free else (-2.0, 1.0)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def first_step(x: float) -> Any:
    """Return 1 - exp(-x) by a series and halvings, arithmetic that runs in vector registers."""
    y = min(x, 40.0) / 2**_HALVINGS
    m = 1.0
    for k in range(12, 1, -1):
        m = 1.0 - m * y / k
    m *= y
    for _ in range(_HALVINGS):
        m = m * (2.0 - m)
    return m


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def mode_step(lam: float, dt: float, m: float) -> tuple[float, float]:
    """Return a and b of a mode of weight 1 over a step dt, m = 1 - exp(-lam dt)."""
    x = lam * dt
    phi = m / lam
    far = (dt - phi) / x
    small = x < _SMALL
    a = dt * (0.5 - x * (1.0 / 3.0 - 0.125 * x)) if small else phi - far
    b = dt * (0.5 - x * (1.0 / 6.0 - x / 24.0)) if small else far
    return a, b


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def mode_step_moves(lam: float, dt: float, m: float, b: float) -> tuple[float, float]:
    """Return the derivatives of a and b by ln lam."""
    x = lam * dt
    d_phi = dt * (1.0 - m) - m / lam
    far = -d_phi / x - b
    small = x < _SMALL
    d_a = -dt * x * (1.0 / 3.0 - 0.25 * x) if small else d_phi - far
    d_b = -dt * x * (1.0 / 6.0 - x / 12.0) if small else far
    return d_a, d_b
