r"""Compiled time stepping of one contact: the inner loop of :mod:`thermogrip.sysid.contact.simulation`.

Both bodies are sums of exponential modes, so one step of length ``dt`` with a flux linear in time is exact:

    x(t + dt) = E x(t) + a q(t) + b q(t + dt),   E = exp(-lam dt),  b = w (dt - phi)/(lam dt),  a = w phi - b,

with phi = (1 - E)/lam and w the mode's weight.  The contact closes the loop, q = h(t) (1 - device rise -
block drop), which is linear in the one unknown q(t + dt).  The state is x less b q, so that a step is
one pass over the modes,

    x <- E x + (E b + a) q,     q = h (1 - sum x) / (1 + h Z),     Z = sum b + resistances.

A mode that a step damps below rounding keeps no state: only a q is left of it.  Steps double from group to
group, and with them m = 1 - E becomes m (2 - m), without another exponential.

**Derivatives** are stepped along, as curves of their own.  One by ln h or ln tau_b obeys the same recursion;
one by ln e or ln C, which move the block's modes, gains dE x + d(E b + a) q.  All are driven by

    dq = [dh gap - h (d sum x + q dZ)] / (1 + h Z),     gap = (1 - sum x) / (1 + h Z).

This file and those that build_up on it import numba, so nothing pays for the compiler before it is used.

Modes of the block
------------------

The face of a slab whose far one loses U per degree falls, per unit flux, by modes j = 0, 1, ... of rate

    lam_j = (beta_j e / C)^2,   beta_j = j pi + arctan(Bi / beta_j),   Bi = U C / e^2,

and weight 2/C (beta^2 + Bi^2) / (beta^2 + Bi^2 + Bi): j pi and 2/C (1/C of j = 0) where nothing is lost.
Those beyond the first dozen are grouped by Gauss quadrature over ln j from j = 11.5 (Euler-Maclaurin's
midpoint rule, with its next term), those faster than a millisecond are a series resistance.

Heat loss of the block by its far face
--------------------------------------

A block of capacity C per face whose far face loses U (T_obj - T_room) warms or cools at its near face,
untouched there, by

.. math:: d(t) \approx \frac{U (T_{room} - T_{obj})}{C} \max(t - L^2 / 6 \alpha, 0),

since the mean time of the way through the slab is :math:`L^2 / 6 \alpha = C^2 / 6 e^2`: 0.6 s in 20 mm of
copper, 3 s in iron, minutes in wood.  The sensor answers to d by the step response F, so the reading gains

.. math:: \frac{U}{C} (T_{room} - T_{obj}) G(t), \quad G(t) = \int_0^{t - C^2 / 6 e^2} F(s) ds.

That is the first order in U: the loss of what the gripper itself has warmed is left out (of the size of
U t / C, 2 % in 10 s, of a few kelvin).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.compiled import numba

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
    """Fill decay rates and weights (N_MODE,) of a slab that loses ``far`` [W m^-2 K^-1] by its far face, fast
    ones first; return its series resistance."""
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
    """Fill derivatives (4, N_MODE) of ln rate (of the rates ``lam``) and ln weight by ln e, then by ln C;
    return those of the logarithm of the series resistance."""
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


# a plain tuple of dt, repeat and t, as TimeNodes has them: compiled code that is kept must not depend on the
# name that a class was imported under
Nodes = tuple[Array, NDArray[np.int64], Array]

VALUE, BY_H, BY_BUILD_UP, BY_E, BY_C = range(5)
N_STEPPED = 5


class Gripper(NamedTuple):
    """A gripper on one set of time steps."""

    dt: Array  # (n_group,)
    steps: Array  # (3, n_group, n_mode): E, E b + a and b
    alive: NDArray[np.int64]  # (n_group,) modes that keep a state
    sums: Array  # (n_group, 2): of b, and of a past the alive ones
    sensed: Array  # (n_group, 6): the same as the sensor sees them, E, a and b of its lag, and its rate
    sensor: Array  # (n_mode,) weights
    # (7,): resistance, lag, first, creep, settle, what the block's far face loses per degree, the skin's leak
    numbers: Array


class Room(NamedTuple):
    """Room to work in."""

    rise: Array  # (5, n_node): with slope and flux the result, a row a curve
    slope: Array  # (5, n_node)
    flux: Array  # (n_node,)
    grown: Array  # (2, n_node): h(t) and its derivative by ln tau_b
    # the modes lie side by side, the slab's from fast to slow and the gripper's from slow to fast, so that
    # those that keep a state are neighbours
    x: Array  # (5, n_mode), their states
    steps: Array  # (4, n_mode): E, E b + a, b and the sensor's weights
    moved: Array  # (2, 3, n_mode), derivatives of the first three by ln e and by ln C
    slab: Array  # (7, N_MODE): rate, weight, their moves and 1 - E
    now: Array  # (3, 5): flux, sensor's node and reading of each curve
    sums: Array  # (5, 2): Z and the sum of a past the alive modes, of the value and of curves 3 and 4


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def room_for(n_gripper: int, n_node: int) -> Room:
    """Return room to work in, for a gripper of ``n_gripper`` modes on ``n_node`` time nodes."""
    n = N_MODE + n_gripper
    return Room(
        np.zeros((N_STEPPED, n_node)), np.zeros((N_STEPPED, n_node)), np.zeros(n_node), np.zeros((2, n_node)),
        np.zeros((N_STEPPED, n)), np.zeros((4, n)), np.zeros((2, 3, n)), np.zeros((7, N_MODE)),
        np.zeros((3, N_STEPPED)), np.zeros((N_STEPPED, 2)),
    )  # fmt: skip


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def gripper_of(dt: Array, lam: Array, face: Array, sensor: Array, numbers: Array) -> Gripper:
    """Return a gripper's steps from its modes (n_mode,): decay rates, weights at face and sensor."""
    n_group, n = dt.size, lam.size
    steps, sums, sensed = np.empty((3, n_group, n)), np.zeros((n_group, 2)), np.zeros((n_group, 6))
    alive = np.full(n_group, n)
    rate = 1.0 / numbers[1]
    m = np.empty(n + 1)
    for j in range(n):
        m[j] = first_step(lam[j] * dt[0])
    m[n] = first_step(rate * dt[0])
    for g in range(n_group):
        while alive[g] > 0 and lam[alive[g] - 1] * dt[g] > FADED:
            alive[g] -= 1
        for j in range(n):
            a, b = mode_step(lam[j], dt[g], m[j])
            a, b = a * face[j], b * face[j]
            steps[0, g, j], steps[1, g, j], steps[2, g, j] = 1.0 - m[j], (1.0 - m[j]) * b + a, b
            late = a if j >= alive[g] else 0.0
            sums[g, 0] += b
            sums[g, 1] += late
            sensed[g, 0] += b * sensor[j]
            sensed[g, 1] += late * sensor[j]
        a, b = mode_step(rate, dt[g], m[n])
        sensed[g, 2], sensed[g, 3], sensed[g, 4], sensed[g, 5] = 1.0 - m[n], a * rate, b * rate, rate
        for j in range(n + 1):
            m[j] = m[j] * (2.0 - m[j])
    return Gripper(dt, steps, alive, sums, sensed, sensor, numbers)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _grow(
    repeat: NDArray[np.int64], dt: Array, h: float, build_up: float, numbers: Array, grown: Array
) -> None:
    """Fill h(t) of the contact on the time nodes, and its derivative by ln tau_b."""
    first, creep, settle = numbers[2], numbers[3], numbers[4]
    keep, keep_settle, late, unsettled = np.exp(-dt[0] / build_up), np.exp(-dt[0] / settle), 1.0, 1.0
    grown[0, 0], grown[1, 0] = h * first, 0.0
    t, k = 0.0, 0
    for g in range(repeat.size):
        for _ in range(repeat[g]):
            t += dt[g]
            k += 1
            late *= keep
            unsettled *= keep_settle
            settled = h * (1.0 + creep * (1.0 - unsettled))
            grown[0, k] = settled * (first + (1.0 - first) * (1.0 - late))
            grown[1, k] = -settled * (1.0 - first) * late * t / build_up
        keep, keep_settle = keep * keep, keep_settle * keep_settle


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _value_pass(decay: Array, gain: Array, sensor: Array, x: Array, q: float) -> tuple[float, float]:
    """Move modes on; return their sums at face and sensor."""
    w = n = 0.0
    for j in range(x.size):
        v = decay[j] * x[j] + gain[j] * q
        x[j] = v
        w += v
        n += sensor[j] * v
    return w, n


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _moved_pass(
    decay: Array, gain: Array, sensor: Array, d_decay: Array, d_gain: Array, x0: Array, x: Array, q0: float,
    q: float,
) -> tuple[float, float]:  # fmt: skip
    """Move a derivative on that moves the modes themselves, before those of the value; return its sums."""
    w = n = 0.0
    for j in range(x.size):
        v = decay[j] * x[j] + gain[j] * q + d_decay[j] * x0[j] + d_gain[j] * q0
        x[j] = v
        w += v
        n += sensor[j] * v
    return w, n


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _prepare(dt: float, low: int, slab_parts: Array, steps: Array, sums: Array) -> None:
    """Fill the slab's steps of length dt, and their sums: of b, and of a before the first alive mode."""
    z = late = 0.0
    for j in range(N_MODE):
        w, m = slab_parts[1, j], slab_parts[6, j]
        a, b = mode_step(slab_parts[0, j], dt, m)
        a, b = a * w, b * w
        steps[0, j], steps[1, j], steps[2, j] = 1.0 - m, (1.0 - m) * b + a, b
        z += b
        late += a if j < low else 0.0
    sums[VALUE, 0], sums[VALUE, 1] = z, late


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _prepare_moved(dt: float, low: int, curve: int, slab_parts: Array, moved: Array, sums: Array) -> None:
    """Fill the derivatives of steps and sums by ln e or ln C."""
    z = late = 0.0
    at = curve - BY_E
    for j in range(N_MODE):
        lam, w, m = slab_parts[0, j], slab_parts[1, j], slab_parts[6, j]
        by_lam, by_w = slab_parts[2 + 2 * at, j], slab_parts[3 + 2 * at, j]
        a, b = mode_step(lam, dt, m)
        d_a, d_b = mode_step_moves(lam, dt, m, b)
        d_a, d_b = w * (d_a * by_lam + a * by_w), w * (d_b * by_lam + b * by_w)
        d_decay = -lam * dt * (1.0 - m) * by_lam
        moved[at, 0, j], moved[at, 1, j] = d_decay, d_decay * b * w + (1.0 - m) * d_b + d_a
        moved[at, 2, j] = d_b
        z += d_b
        late += d_a if j < low else 0.0
    sums[curve, 0], sums[curve, 1] = z, late


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _shift_all(
    low: int, high: int, steps: Array, moved: Array, x: Array, now: Array, contact: bool, by_e: bool,
    by_c: bool, sign: float,
) -> None:  # fmt: skip
    """Add b q to the modes of all curves, or take it off them."""
    for curve, wanted in ((VALUE, True), (BY_H, contact), (BY_BUILD_UP, contact), (BY_E, by_e), (BY_C, by_c)):
        if wanted:
            q, q0 = sign * now[0, curve], sign * now[0, VALUE]
            for j in range(low, high):
                x[curve, j] += steps[2, j] * q
            for j in range(low, N_MODE if curve >= BY_E else low):
                x[curve, j] += moved[curve - BY_E, 2, j] * q0


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _start(
    e: float, c: float, far: float, dt: float, by_e: bool, by_c: bool, resistance: float, grown: float,
    parts: Array, sums: Array, now: Array,
) -> None:  # fmt: skip
    """Fill the slab's modes and the fluxes at first touch; resistances are left in ``sums``."""
    now.fill(0.0)
    sums.fill(0.0)
    own = slab(e, c, far, parts[0], parts[1])
    if by_e or by_c:
        d_e, d_c = slab_moves(e, c, far, parts[0], parts[2:6])
        sums[BY_E, 0], sums[BY_C, 0] = d_e * own, d_c * own
    for j in range(N_MODE):
        parts[6, j] = first_step(parts[0, j] * dt)
    sums[VALUE, 0] = resistance + own
    share = 1.0 / (1.0 + grown * sums[VALUE, 0])
    q = grown * share
    now[0, VALUE], now[0, BY_H] = q, q * share
    now[0, BY_E], now[0, BY_C] = -q * q * sums[BY_E, 0], -q * q * sums[BY_C, 0]


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _plain_steps(
    k: int, n: int, low: int, high: int, steps: Array, x: Array, sums: Array, sensed: Array, grown: Array,
    now: Array, rise: Array, slope: Array, flux: Array,
) -> None:  # fmt: skip
    """Take n steps of the value alone from node k on."""
    decay, gain, sensor, x0 = steps[0, low:high], steps[1, low:high], steps[3, low:high], x[VALUE, low:high]
    z, fast = sums[VALUE, 0], sums[VALUE, 1]
    q, node, s = now[0, VALUE], now[1, VALUE], now[2, VALUE]
    for i in range(k + 1, k + 1 + n):
        w, p = _value_pass(decay, gain, sensor, x0, q)
        p += sensed[1] * q
        q = grown[0, i] * (1.0 - w - fast * q) / (1.0 + grown[0, i] * z)
        p += sensed[0] * q
        s = sensed[2] * s + sensed[3] * node + sensed[4] * p
        node = p
        rise[VALUE, i], slope[VALUE, i], flux[i] = s, (p - s) * sensed[5], q
    now[0, VALUE], now[1, VALUE], now[2, VALUE] = q, node, s


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _read(
    curve: int, i: int, p: float, q: float, sensed: Array, now: Array, rise: Array, slope: Array
) -> None:
    """Take the sensor of a curve to node i, where the flux is q and the modes bring p."""
    p += sensed[0] * q + sensed[1] * now[0, curve]
    s = sensed[2] * now[2, curve] + sensed[3] * now[1, curve] + sensed[4] * p
    now[0, curve], now[1, curve], now[2, curve] = q, p, s
    rise[curve, i], slope[curve, i] = s, (p - s) * sensed[5]


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _followed_steps(
    k: int, n: int, low: int, high: int, steps: Array, x: Array, sums: Array, sensed: Array, grown: Array,
    now: Array, rise: Array, slope: Array, flux: Array, moved: Array, by_e: bool, by_c: bool,
) -> None:  # fmt: skip
    """Take n steps of value and derivatives from node k on."""
    decay, gain, sensor = steps[0, low:high], steps[1, low:high], steps[3, low:high]
    d_decay3, d_gain3 = moved[0, 0, low:high], moved[0, 1, low:high]
    d_decay4, d_gain4 = moved[1, 0, low:high], moved[1, 1, low:high]
    x0, x1, x2 = x[VALUE, low:high], x[BY_H, low:high], x[BY_BUILD_UP, low:high]
    x3, x4 = x[BY_E, low:high], x[BY_C, low:high]
    z, fast = sums[VALUE, 0], sums[VALUE, 1]
    for i in range(k + 1, k + 1 + n):
        h, q, q1, q2, q3, q4 = grown[0, i], now[0, 0], now[0, 1], now[0, 2], now[0, 3], now[0, 4]
        invert = 1.0 / (1.0 + h * z)
        w3 = w4 = p3 = p4 = 0.0
        if by_e:
            w3, p3 = _moved_pass(decay, gain, sensor, d_decay3, d_gain3, x0, x3, q, q3)
        if by_c:
            w4, p4 = _moved_pass(decay, gain, sensor, d_decay4, d_gain4, x0, x4, q, q4)
        w, p = _value_pass(decay, gain, sensor, x0, q)
        w1, p1 = _value_pass(decay, gain, sensor, x1, q1)
        w2, p2 = _value_pass(decay, gain, sensor, x2, q2)
        gap = (1.0 - w - fast * q) * invert
        q_new = h * gap
        flux[i] = q_new
        q1 = h * (gap - w1 - fast * q1) * invert
        q2 = (grown[1, i] * gap - h * (w2 + fast * q2)) * invert
        _read(VALUE, i, p, q_new, sensed, now, rise, slope)
        _read(BY_H, i, p1, q1, sensed, now, rise, slope)
        _read(BY_BUILD_UP, i, p2, q2, sensed, now, rise, slope)
        if by_e:
            q3 = -h * (w3 + fast * q3 + sums[BY_E, 1] * q + q_new * sums[BY_E, 0]) * invert
            _read(BY_E, i, p3, q3, sensed, now, rise, slope)
        if by_c:
            q4 = -h * (w4 + fast * q4 + sums[BY_C, 1] * q + q_new * sums[BY_C, 0]) * invert
            _read(BY_C, i, p4, q4, sensed, now, rise, slope)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def step_contact(
    repeat: NDArray[np.int64], gripper: Gripper, e: float, c: float, h: float, build_up: float, contact: bool,
    by_e: bool, by_c: bool, room: Room,
) -> None:  # fmt: skip
    """Fill rise and slope of the sensor and the flux, on the time nodes, for unit difference.

    ``repeat`` (n_group,) is how often each step is taken; ``e``, ``c``, ``h``, ``build_up`` are effusivity
    and heat capacity of the slab, settled conductance and build-up time of the contact; ``contact``, ``by_e``
    and ``by_c`` ask for derivatives, the last two for those by the contact too.
    """
    dts, alive, of_gripper, sensed = gripper.dt, gripper.alive, gripper.steps, gripper.sensed
    rise, slope, flux, grown, x, steps, moved, parts, now, sums = room
    _grow(repeat, dts, h, build_up, gripper.numbers, grown)
    _start(e, c, gripper.numbers[5], dts[0], by_e, by_c, gripper.numbers[0], grown[0, 0], parts, sums, now)
    x.fill(0.0)
    flux[0] = now[0, VALUE]
    for curve in range(N_STEPPED):
        rise[curve, 0] = slope[curve, 0] = 0.0
    for j in range(gripper.sensor.size):
        steps[3, N_MODE + j] = gripper.sensor[j]
    r, r3, r4 = sums[VALUE, 0], sums[BY_E, 0], sums[BY_C, 0]
    k = low = np.int64(0)  # for a literal the steps would be compiled once more
    for g in range(repeat.size):
        high = N_MODE + alive[g]
        while low < N_MODE and parts[0, low] * dts[g] > FADED:
            low += 1
        _prepare(dts[g], low, parts, steps, sums)
        sums[VALUE, 0] += gripper.sums[g, 0] + r
        sums[VALUE, 1] += gripper.sums[g, 1]
        for i in range(3):
            for j in range(alive[g]):
                steps[i, N_MODE + j] = of_gripper[i, g, j]
        if by_e:
            _prepare_moved(dts[g], low, BY_E, parts, moved, sums)
            sums[BY_E, 0] += r3
        if by_c:
            _prepare_moved(dts[g], low, BY_C, parts, moved, sums)
            sums[BY_C, 0] += r4
        _shift_all(low, high, steps, moved, x, now, contact, by_e, by_c, -1.0)
        if contact:
            _followed_steps(
                k, repeat[g], low, high, steps, x, sums, sensed[g], grown, now, rise, slope, flux, moved,
                by_e, by_c,
            )  # fmt: skip
        else:
            _plain_steps(k, repeat[g], low, high, steps, x, sums, sensed[g], grown, now, rise, slope, flux)
        _shift_all(low, high, steps, moved, x, now, contact, by_e, by_c, 1.0)
        k += repeat[g]
        for j in range(N_MODE):
            parts[6, j] = parts[6, j] * (2.0 - parts[6, j])


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def contacts(
    nodes: Nodes, gripper: Gripper, effusivity: Array, capacity: Array, h_c: Array, build_up: Array
) -> tuple[Array, Array, Array]:
    """Return sensor rise, its slope and the flux of n contacts on the time nodes, (n, n_node) each."""
    n, n_node = effusivity.size, nodes[2].size
    rise, slope, flux = np.empty((n, n_node)), np.empty((n, n_node)), np.empty((n, n_node))
    room = room_for(gripper.sensor.size, n_node)
    asked = np.zeros(3, dtype=np.bool_)  # for constants everything would be compiled once more
    for p in range(n):
        step_contact(
            nodes[1], gripper, effusivity[p], capacity[p], h_c[p], build_up[p], asked[0], asked[1], asked[2],
            room,
        )  # fmt: skip
        for i in range(n_node):
            rise[p, i], slope[p, i], flux[p, i] = room.rise[VALUE, i], room.slope[VALUE, i], room.flux[i]
    return rise, slope, flux


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def delay(ln_e: float, ln_c: float) -> float:
    """Return C^2 / 6 e^2 [s]."""
    return float(np.exp(2.0 * (ln_c - ln_e)) / 6.0)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def fill_delayed(t: Array, count: Array, late: float, curve: Array, total: Array, value: Array) -> None:
    """Fill the integral of a ``curve`` (n,) up to t - late, and the curve there, by straight lines, zero
    before, over the points with a ``count``, along which ``t`` rises."""
    before = after = -1  # the points on either side of t - late
    summed = 0.0  # integral up to ``before``
    for i in range(t.size):
        total[i] = value[i] = 0.0
        if count[i] <= 0.0:
            continue
        if after < 0:
            after = i
        x = t[i] - late
        while t[after] <= x:
            if before >= 0:
                summed += 0.5 * (t[after] - t[before]) * (curve[after] + curve[before])
            before = after
            if after == i:
                break
            after += 1
            while count[after] <= 0.0:
                after += 1
        if before < 0:
            continue
        ahead = x - t[before]
        rise = 0.0 if after == before else (curve[after] - curve[before]) / (t[after] - t[before])
        total[i] = summed + ahead * (curve[before] + 0.5 * rise * ahead)
        value[i] = curve[before] + rise * ahead


RATE = 5  # the row of the slope, after the stepped curves
N_CURVE = 6
EARLIEST_ONSET, LATEST_ONSET = -1.5, 0.8  # s after the closed message
_H, _BUILD_UP, _ONSET, _LEVEL, _T, _E, _C = range(7)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _places(
    nodes: Array, onset: float, times: Array, bins: NDArray[np.int64], place: NDArray[np.int64], share: Array
) -> None:
    """Fill the node before each sample, -1 before contact and where lost, and the way to the next, 0 to 1."""
    last, k = nodes.size - 1, 0
    for i in range(times.size):
        place[i] = -1
        t = times[i] - onset
        if bins[i] < 0 or t <= 0.0:
            continue
        while k < last - 1 and nodes[k + 1] < t:
            k += 1
        while k > 0 and nodes[k] > t:
            k -= 1
        place[i], share[i] = k, min((t - nodes[k]) / (nodes[k + 1] - nodes[k]), 1.0)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _means(
    nodes: Array, rise: Array, slope: Array, bins: NDArray[np.int64], count: Array,
    place: NDArray[np.int64], share: Array, rates: bool, out: Array,
) -> None:  # fmt: skip
    """Fill bin means (n_bin,) of a curve by cubic Hermite interpolation, of its slope where ``rates``."""
    out[:] = 0.0
    for i in range(place.size):
        k = place[i]
        if k < 0:
            continue
        s, dt, high = share[i], nodes[k + 1] - nodes[k], rise[k + 1] - rise[k]
        if rates:
            v = 6.0 * s * (1.0 - s) * high / dt
            out[bins[i]] += v + (1.0 - s) * (1.0 - 3.0 * s) * slope[k] + s * (3.0 * s - 2.0) * slope[k + 1]
        else:
            bent = s * (1.0 - s) * dt * ((1.0 - s) * slope[k] - s * slope[k + 1])
            out[bins[i]] += rise[k] + s * s * (3.0 - 2.0 * s) * high + bent
    for m in range(out.size):
        out[m] = out[m] / count[m] if count[m] > 0.0 else 0.0


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def fill_responses(
    nodes: Nodes, gripper: Gripper, u: Array, vary: Mask, times: Array,
    bins: NDArray[np.int64], count: Array, room: Room, place: NDArray[np.int64], share: Array, out: Array,
) -> None:  # fmt: skip
    """Fill bin means (6, n_bin) of F, of its derivatives by those of ln h, ln tau_b, ln e, ln C that ``vary``
    (7,) asks for, and of its slope."""
    by_e, by_c = vary[_E], vary[_C]
    contact = vary[_H] or vary[_BUILD_UP] or by_e or by_c
    step_contact(
        nodes[1], gripper, np.exp(u[_E]), np.exp(u[_C]), np.exp(u[_H]), np.exp(u[_BUILD_UP]), contact, by_e,
        by_c, room,
    )  # fmt: skip
    onset = min(max(u[_ONSET], EARLIEST_ONSET), LATEST_ONSET)
    _places(nodes[2], onset, times, bins, place, share)
    t, rise, slope = nodes[2], room.rise, room.slope
    wanted = (True, contact, contact, by_e, by_c)
    for curve in range(BY_C + 1):
        if wanted[curve]:
            _means(t, rise[curve], slope[curve], bins, count, place, share, False, out[curve])
    if vary[_ONSET]:
        _means(t, rise[VALUE], slope[VALUE], bins, count, place, share, True, out[RATE])
        for i in range(out.shape[1]):  # past the range nothing moves
            out[RATE, i] *= 1.0 if onset == u[_ONSET] else 0.0
