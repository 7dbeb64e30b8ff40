r"""Compiled time stepping of one contact: the inner loop of :mod:`thermogrip.sysid.contact.simulation`.

Both bodies are sums of exponential modes, so one step of length ``dt`` with a flux linear in time is exact:

    x(t + dt) = E x(t) + a q(t) + b q(t + dt),   E = exp(-lam dt),  b = w (dt - phi)/(lam dt),  a = w phi - b,

with phi = (1 - E)/lam and w the mode's weight.  The contact closes the loop, q = h(t) (1 - device rise -
block drop), which is linear in the one unknown q(t + dt).  Derivatives by ln h, ln tau_b, ln e and ln C are
stepped along, as curves of their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba  # slow: what builds on this is imported where it is used
import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask

# sums over modes may be reordered, so that they run in vector registers; infinities stay what they are
_SUMS = {"reassoc", "contract", "arcp", "nsz"}
COMPILED: dict[str, Any] = {"cache": True, "fastmath": _SUMS, "error_model": "numpy"}
# a tenth of the compiler's time, for nothing here
COMPILED |= {"no_rewrites": True, "no_cfunc_wrapper": True}
_N_EXACT, _N_GROUPED = 12, 24
# which serve copper (diffusion time C^2/e^2 of 4 s) and wood (over an hour) alike
N_MODE = _N_EXACT + _N_GROUPED + 1
# Stepped with some of no weight: what vector registers of eight leave of a loop costs most, and a mode that a
# step damps away is not left out either (12 -> 8 us a contact).
_N_BLOCK = 40
_FASTEST = 2e3  # 1/s: modes beyond it are a series resistance
_NODE_PLACE, _NODE_WEIGHT = (
    np.ascontiguousarray(v[::-1]) for v in np.polynomial.legendre.leggauss(_N_GROUPED)
)
_SERIES_BELOW = 1e-3  # lam dt below which the series is closer

VALUE, BY_H, BY_BUILD_UP, BY_E, BY_C = range(5)
N_STEPPED = 5


class Slabs(NamedTuple):
    """Modes of n slabs, fast ones first: decay rates and weights (n, N_MODE), series resistance (n,)."""

    rate: Array
    weight: Array
    resistance: Array


def slabs(effusivity: Array, capacity: Array, far: float | Array) -> Slabs:
    """Return the modes of slabs that lose ``far`` [W m^-2 K^-1] by their far faces."""
    n, numbers = effusivity.size, np.zeros((np.size(far), 7))
    numbers[:, 5] = far
    modes, moves = np.empty((n, 4, N_MODE)), np.empty((0, 4, N_MODE))
    series = np.empty((n, 3))
    contact = np.stack([effusivity, capacity], axis=1)
    slab_modes(contact, numbers, 1.0, _NODE_PLACE, _NODE_WEIGHT, modes, moves, series)
    return Slabs(modes[:, 0], modes[:, 1], series[:, 0])


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def slab_modes(
    contact: Array, numbers: Array, step: float, node: Array, shares: Array, modes: Array, moves: Array,
    series: Array,
) -> None:  # fmt: skip
    """Fill rates, weights and 1 - exp(-rate ``step``) of slabs' modes, rows 0, 1 and 3 of ``modes`` (n, 4,
    N_MODE or more), the resistance before them and its derivatives by ln e and ln C, ``series`` (n, 3), and,
    where ``moves`` (n, 4, N_MODE) has rows, derivatives of ln rate and ln weight by ln e, then by ln C.

    ``contact`` (n, 2 or more) begins with effusivity and heat capacity, ``numbers`` are those of
    :class:`Gripper`, ``node`` and ``shares`` those of the quadrature."""
    # The face of a slab whose far one loses U per degree falls, per unit flux, by modes j = 0, 1, ... of rate
    #     lam_j = (beta_j e / C)^2,   beta_j = j pi + arctan(Bi / beta_j),   Bi = U C / e^2,
    # and weight 2/C (beta^2 + Bi^2) / (beta^2 + Bi^2 + Bi): j pi and 2/C (1/C of j = 0) where nothing is
    # lost. Those beyond the first dozen are grouped by Gauss quadrature over ln j from j = 11.5
    # (Euler-Maclaurin's midpoint rule, with its next term), those faster than a millisecond are a series
    # resistance.
    start = _N_EXACT - 0.5
    for p in range(contact.shape[0]):
        e = contact[p, 0]
        c = contact[p, 1]
        k = min(p, numbers.shape[0] - 1)
        unit, biot = (e / c) ** 2, numbers[k, 5] * c / (e * e)
        top = np.sqrt(_FASTEST / unit) / np.pi
        # past it modes are too fast to count; a slab whose first dozen are has groups of a fixed span
        free = top > 3.0 * start
        top = top if free else 3.0 * start
        span, beyond = np.log(top / start), 2.0 / (c * np.pi**2 * unit * top)
        series[p, 0] = numbers[k, 0] + beyond
        series[p, 1], series[p, 2] = (-beyond, 0.0) if free else (-2.0 * beyond, beyond)
        for j in range(N_MODE):
            y = N_MODE - 1.0 - j
            share = 2.0
            along = by_span = 0.0
            if j < _N_GROUPED:
                y = start * np.exp(0.5 * span * (1.0 + node[j]))
                share = span * shares[j] * y
                if free:  # the span shrinks by ln e and grows by ln C, and with it the place of a mode
                    along, by_span = 0.5 * (1.0 + node[j]), 1.0 / span
            elif j < _N_GROUPED + 2:  # next Euler-Maclaurin term, f'(start)/24 as a difference of modes
                share = 2.0 / 24.0 if j == _N_GROUPED else 2.0 - 2.0 / 24.0
            beta = np.pi * y
            square = beta * beta
            damping = place = 1.0
            by_biot = 0.0
            if biot > 0.0:
                if j == N_MODE - 1:
                    # from the left of the root Newton's steps on a concave function never pass it
                    beta = np.sqrt(biot / (1.0 + 0.5 * biot))
                for _ in range(5):
                    square = beta * beta + biot * biot
                    damping = (np.pi * y + np.arctan(biot / beta) - beta) * square / (square + biot)
                    beta += damping
                    if damping < 1e-9 * beta:  # digits double with each step
                        break
                square = beta * beta + biot * biot
                damping, by_biot = square / (square + biot), biot / (square + biot)
                place = np.pi * y / beta * damping  # d ln beta / d ln y
            elif j == N_MODE - 1:
                damping = 0.5  # a mode that nothing damps counts half
            rate = beta * beta * unit
            modes[p, 0, j] = rate
            modes[p, 1, j] = share * damping / c
            modes[p, 3, j] = -np.expm1(-rate * step)
            if moves.shape[0] > 0:
                by_e, by_c = -along * place - 2.0 * by_biot, along * place + by_biot
                moves[p, 0, j], moves[p, 2, j] = 2.0 * by_e + 2.0, 2.0 * by_c - 2.0
                moves[p, 1, j], moves[p, 3, j] = -along - by_span, along + by_span - 1.0
                if biot > 0.0:
                    lost, kept_share = biot * biot / square, beta * beta / square
                    moves[p, 1, j] += (2.0 * (kept_share * by_e - 2.0 * lost) + 2.0) * by_biot
                    moves[p, 3, j] += (2.0 * (kept_share * by_c + lost) - 1.0) * by_biot


class Gripper(NamedTuple):
    """One gripper for all contacts, or one for each (k of them)."""

    # (k, 3, n + 1): decay rates, from slow to fast, weights at face and sensor, the sensor's lag last
    modes: Array
    # (k, 7): resistance, lag, first, creep, settle, what the block's far face loses per degree, skin's leak
    numbers: Array


def conductance(t: Array, h: Array, build_up: Array, numbers: Array) -> Array:
    """Return h(t) of n contacts on time nodes, and its derivative by ln tau_b, (n, 2, n_node); ``numbers``
    are those of :class:`Gripper`."""
    first = numbers[:, 2, None]
    creep = numbers[:, 3, None]
    settle = numbers[:, 4, None]
    late = np.exp(-t / build_up[:, None])
    settled = h[:, None] * (1.0 - creep * np.expm1(-t / settle))
    grown = np.empty((h.size, 2, t.size))
    grown[:, 0] = settled * (1.0 - (1.0 - first) * late)
    grown[:, 1] = -settled * (1.0 - first) * late * (t / build_up[:, None])
    return grown


def contacts(
    nodes: tuple[Array, NDArray[np.int64], Array], gripper: Gripper, contact: Array, wanted: Mask
) -> tuple[Array, Array, Array]:
    """Return the sensor's rise and its slope (n, 5, n_node) and the flux (n, n_node) for unit difference.

    ``contact`` (n, 4) has effusivity and heat capacity of the slab, settled conductance and build-up time;
    ``nodes`` are dt, repeat and t of :class:`~thermogrip.sysid.contact.simulation.TimeNodes`.  Of the curves
    (n, 5), the value and its derivatives by ln h, ln tau_b, ln e, ln C, only the ``wanted`` are filled.
    """
    (dt, repeat, t), n, gripper_rows = nodes, len(contact), gripper.modes
    modes, series = np.zeros((n, 4, _N_BLOCK + gripper_rows.shape[2])), np.empty((n, 3))
    moves = np.zeros((n if wanted[:, BY_E:].any() else 0, 4, _N_BLOCK))
    modes[:, :3, _N_BLOCK:], modes[:, 3, _N_BLOCK:] = gripper_rows, -np.expm1(-gripper_rows[:, 0] * dt[0])
    slab_modes(contact, gripper.numbers, dt[0], _NODE_PLACE, _NODE_WEIGHT, modes, moves, series)
    rise = np.empty((n, N_STEPPED, t.size))
    slope = np.empty((n, N_STEPPED, t.size))
    flux = np.empty((n, t.size))
    grown = conductance(t, contact[:, 2], contact[:, 3], gripper.numbers)
    room, now = np.zeros((18, modes.shape[2])), np.zeros((6, 5))
    step_contacts(repeat, dt, modes, moves, series, grown, wanted, room, now, rise, slope, flux)
    return rise, slope, flux


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def step_contacts(
    repeat: NDArray[np.int64], dt: Array, modes: Array, moves: Array, series: Array, grown: Array,
    wanted: Mask, room: Array, now: Array, rise: Array, slope: Array, flux: Array,
) -> None:  # fmt: skip
    """Fill ``rise``, ``slope`` and ``flux`` of :func:`contacts`, curve by curve.

    ``modes`` (n, 4, n_mode + 1) are rate, weight at face and sensor and 1 - E of the first step: the slab's
    with some of no weight, the gripper's and the sensor's lag; ``moves`` are those of :func:`slab_modes`;
    ``series`` (n, 3) is the resistance, and its derivatives by ln e and ln C.
    """
    # One function, in which it is all written out: one that calls others is optimised whole with each of
    # them, and what NumPy does for many contacts at once costs no compilation.
    last = modes.shape[2] - 1
    # states; 1 - E, a, b, E and E b + a; derivatives of the last two and b by ln e and ln C
    x, m, a, b, keep, gain = room[:5], room[5], room[6], room[7], room[8], room[9]
    x0, x1, x2, x3, x4 = x[0], x[1], x[2], x[3], x[4]
    keep_e, gain_e, b_e, keep_c, gain_c, b_c = room[10], room[11], room[12], room[13], room[14], room[15]
    per_rate, unit = room[16], room[17]  # 1 / rate and b / weight
    # of each curve: flux, sensor's node and reading, sums of the states at face and sensor, and Z
    q = now[0]
    node = now[1]
    read = now[2]
    w = now[3]
    s = now[4]
    z = now[5]
    for p in range(modes.shape[0]):
        rate = modes[p, 0]
        by_block = wanted[p, BY_E] or wanted[p, BY_C]
        weight = modes[p, 1]
        sensor = modes[p, 2]
        for c in range(5):
            q[c] = node[c] = read[c] = rise[p, c, 0] = slope[p, c, 0] = 0.0
            for j in range(last):
                x[c, j] = 0.0
        for j in range(last + 1):
            m[j], per_rate[j] = modes[p, 3, j], 1.0 / rate[j]
        share = 1.0 / (1.0 + grown[p, 0, 0] * series[p, 0])
        q[0] = grown[p, 0, 0] * share
        q[1], q[3], q[4] = q[0] * share, -q[0] * q[0] * series[p, 1], -q[0] * q[0] * series[p, 2]
        flux[p, 0] = q[0]
        k = 0
        for g in range(repeat.size):
            step, per_step = dt[g], 1.0 / dt[g]
            for j in range(last + 1):
                y, phi = rate[j] * step, m[j] * per_rate[j]
                general_form, small = (step - phi) * per_rate[j] * per_step, y < _SERIES_BELOW
                unit[j] = step * (0.5 - y * (1.0 / 6.0 - y / 24.0)) if small else general_form
                late_unit = step * (0.5 - y * (1.0 / 3.0 - 0.125 * y)) if small else phi - general_form
                a[j], b[j] = late_unit * weight[j], unit[j] * weight[j]
                keep[j] = 1.0 - m[j]
                gain[j] = keep[j] * b[j] + a[j]
            z[0], z[1], z[2], sensor_sum = series[p, 0], 0.0, 0.0, 0.0
            for j in range(last):
                z[0] += b[j]
                sensor_sum += b[j] * sensor[j]
            if by_block:
                z3, z4 = series[p, 1], series[p, 2]
                for j in range(_N_BLOCK):
                    y = rate[j] * step
                    d_phi = step * keep[j] - m[j] * per_rate[j]
                    general_form, small = -d_phi * per_rate[j] * per_step - unit[j], y < _SERIES_BELOW
                    d_a = -step * y * (1.0 / 3.0 - 0.25 * y) if small else d_phi - general_form
                    d_b = -step * y * (1.0 / 6.0 - y / 12.0) if small else general_form
                    d_a, d_b, d_keep = weight[j] * d_a, weight[j] * d_b, -y * keep[j]
                    d_gain = d_keep * b[j] + keep[j] * d_b + d_a
                    by_rate, by_weight = moves[p, 0, j], moves[p, 1, j]
                    keep_e[j], gain_e[j] = d_keep * by_rate, d_gain * by_rate + gain[j] * by_weight
                    b_e[j] = d_b * by_rate + b[j] * by_weight
                    z3 += b_e[j]
                    by_rate, by_weight = moves[p, 2, j], moves[p, 3, j]
                    keep_c[j], gain_c[j] = d_keep * by_rate, d_gain * by_rate + gain[j] * by_weight
                    b_c[j] = d_b * by_rate + b[j] * by_weight
                    z4 += b_c[j]
                z[3], z[4] = z3, z4
            # so that a step is one pass over the modes, x <- E x + (E b + a) q
            for c in range(5):  # the state is less b q
                if wanted[p, c]:
                    for j in range(last):
                        x[c, j] -= b[j] * q[c]
                    if c > 2:
                        for j in range(_N_BLOCK):
                            x[c, j] -= room[3 * c + 3, j] * q[0]
            for i in range(k + 1, k + 1 + repeat[g]):
                q0, q1, q2, q3, q4 = q[0], q[1], q[2], q[3], q[4]
                w0 = w1 = w2 = w3 = w4 = s0 = s1 = s2 = s3 = s4 = 0.0
                # Curves share a pass and its loads, wanted or not: a quarter less time than a pass each.
                # Those of the block, whose modes ln e and ln C move, are first: they gain
                # dE x + d(E b + a) q of the value's state of before.
                if by_block:
                    for j in range(_N_BLOCK):
                        v3 = keep[j] * x3[j] + gain[j] * q3 + keep_e[j] * x0[j] + gain_e[j] * q0
                        v4 = keep[j] * x4[j] + gain[j] * q4 + keep_c[j] * x0[j] + gain_c[j] * q0
                        x3[j], x4[j] = v3, v4
                        w3 += v3
                        w4 += v4
                    for j in range(_N_BLOCK, last):
                        v3, v4 = keep[j] * x3[j] + gain[j] * q3, keep[j] * x4[j] + gain[j] * q4
                        x3[j], x4[j] = v3, v4
                        w3 += v3
                        w4 += v4
                        s3 += sensor[j] * v3
                        s4 += sensor[j] * v4
                for j in range(last):
                    v0, v1 = keep[j] * x0[j] + gain[j] * q0, keep[j] * x1[j] + gain[j] * q1
                    v2 = keep[j] * x2[j] + gain[j] * q2
                    x0[j], x1[j], x2[j] = v0, v1, v2
                    w0 += v0
                    w1 += v1
                    w2 += v2
                    s0 += sensor[j] * v0
                    s1 += sensor[j] * v1
                    s2 += sensor[j] * v2
                w[0], w[1], w[2], w[3], w[4] = w0, w1, w2, w3, w4
                s[0], s[1], s[2], s[3], s[4] = s0, s1, s2, s3, s4
                h = grown[p, 0, i]
                # q = h (1 - sum x) / (1 + h Z), Z = sum b + resistances
                invert = 1.0 / (1.0 + h * z[0])
                gap = (1.0 - w[0]) * invert
                flux[p, i] = h * gap
                for c in range(5):
                    if wanted[p, c]:
                        new = h * gap
                        if c > 0:
                            # dq = [dh gap - h (d sum x + q dZ)] / (1 + h Z), gap = (1 - sum x) / (1 + h Z)
                            driven = h * gap if c == 1 else (grown[p, 1, i] * gap if c == 2 else 0.0)
                            new = (driven - h * (w[c] + z[c] * h * gap)) * invert
                        v = s[c] + sensor_sum * new
                        read[c] = keep[last] * read[c] + a[last] * node[c] + b[last] * v
                        q[c], node[c] = new, v
                        rise[p, c, i], slope[p, c, i] = read[c], (v - read[c]) * rate[last]
            for c in range(5):
                if wanted[p, c]:
                    for j in range(last):
                        x[c, j] += b[j] * q[c]
                    if c > 2:
                        for j in range(_N_BLOCK):
                            x[c, j] += room[3 * c + 3, j] * q[0]
            k += repeat[g]
            for j in range(last + 1):
                # steps double from group to group, and with them 1 - E, without another exponential
                m[j] = m[j] * (2.0 - m[j])
