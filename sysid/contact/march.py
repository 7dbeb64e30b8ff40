"""Compiled marching of one contact: the inner loop of :mod:`thermogrip.sysid.contact.response`.

Both bodies are sums of exponential modes, so one step of length ``dt`` with a flux linear in time is exact:

    x(t + dt) = E x(t) + a q(t) + b q(t + dt),   E = exp(-lam dt),  b = w (dt - phi)/(lam dt),  a = w phi - b,

with phi = (1 - E)/lam and w the mode's weight.  The contact closes the loop, q = h(t) (1 - device rise -
block drop), which is linear in the one unknown q(t + dt).  What is marched is x less b q, so that a step is
one pass over the modes,

    x <- E x + (E b + a) q,     q = h (1 - sum x) / (1 + h Z),     Z = sum b + resistances.

A mode that a step damps below rounding keeps no state: only a q is left of it.  Steps double from group to
group, and with them m = 1 - E becomes m (2 - m), without another exponential.

**Derivatives** are marched along, in lanes of their own.  One by ln h or ln tau_b obeys the same recursion;
one by ln e or ln C, which move the block's modes, gains dE x + d(E b + a) q.  All are driven by

    dq = [dh gap - h (d sum x + q dZ)] / (1 + h Z),     gap = (1 - sum x) / (1 + h Z).

This file and those that build on it import numba, so nothing pays for the compiler before it is used.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.contact.block_modes import (
    FADED,
    INNER,
    N_MODE,
    OUTER,
    first_step,
    mode_step,
    mode_step_moves,
    slab,
    slab_moves,
)

__all__ = ["BY_BUILD", "BY_C", "BY_E", "BY_H", "N_LANE", "VALUE", "Gripper", "Nodes", "Room"]
__all__ += ["contacts", "gripper_of", "march", "room_for"]

Array = NDArray[np.float64]
# a plain tuple of dt, repeat and t, as TimeNodes has them: compiled code that is kept must not depend on the
# name that a class was imported under
Nodes = tuple[Array, NDArray[np.int64], Array]

VALUE, BY_H, BY_BUILD, BY_E, BY_C = range(5)
N_LANE = 5


class Gripper(NamedTuple):
    """A gripper on one set of time steps.

    ``dt`` (n_group,); ``steps`` (3, n_group, n_mode): E, E b + a and b; ``alive`` (n_group,) modes that keep
    a state; ``sums`` (n_group, 2): of b, and of a past the alive ones; ``sensed`` (n_group, 6): the same as
    the sensor sees them, E, a and b of its lag, and its rate; ``sensor`` (n_mode,) weights; ``numbers`` (6,):
    resistance, lag, first, creep, settle, and what the block's far face loses per degree.
    """

    dt: Array
    steps: Array
    alive: NDArray[np.int64]
    sums: Array
    sensed: Array
    sensor: Array
    numbers: Array


class Room(NamedTuple):
    """Room to work in.

    ``rise``, ``slope`` (5, n_node) and ``flux`` (n_node,): what a march finds, a row a lane.  ``grown`` (2,
    n_node): h(t) and its derivative by ln tau_b.  The modes lie side by side, the slab's from fast to slow
    and the gripper's from slow to fast, so that those that keep a state are neighbours: ``x`` (5, n_mode)
    their states, ``steps`` (4, n_mode) E, E b + a, b and the sensor's weights, ``moved`` (2, 3, n_mode)
    derivatives of the first three by ln e and by ln C.  ``slab`` (7, N_MODE): rate, weight, their moves and
    1 - E.  ``now`` (3, 5): flux, sensor's node and reading of each lane.  ``sums`` (5, 2): Z and the sum of a
    past the alive modes, of the value and of lanes 3 and 4.
    """

    rise: Array
    slope: Array
    flux: Array
    grown: Array
    x: Array
    steps: Array
    moved: Array
    slab: Array
    now: Array
    sums: Array


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def room_for(n_gripper: int, n_node: int) -> Room:
    """Return room to work in, for a gripper of ``n_gripper`` modes on ``n_node`` time nodes."""
    n = N_MODE + n_gripper
    return Room(
        np.zeros((N_LANE, n_node)), np.zeros((N_LANE, n_node)), np.zeros(n_node), np.zeros((2, n_node)),
        np.zeros((N_LANE, n)), np.zeros((4, n)), np.zeros((2, 3, n)), np.zeros((7, N_MODE)),
        np.zeros((3, N_LANE)), np.zeros((N_LANE, 2)),
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
def _grow(repeat: NDArray[np.int64], dt: Array, h: float, build: float, numbers: Array, grown: Array) -> None:
    """Fill h(t) of the contact on the time nodes, and its derivative by ln tau_b."""
    first, creep, settle = numbers[2], numbers[3], numbers[4]
    keep, keep_settle, late, unsettled = np.exp(-dt[0] / build), np.exp(-dt[0] / settle), 1.0, 1.0
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
            grown[1, k] = -settled * (1.0 - first) * late * t / build
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
def _contact_pass(
    decay: Array, gain: Array, sensor: Array, x: Array, x1: Array, x2: Array, q: float, q1: float, q2: float
) -> tuple[float, float, float, float, float, float]:
    """Move value and derivatives by the contact on, which share all but the flux; return their sums."""
    w = w1 = w2 = n = n1 = n2 = 0.0
    for j in range(x.size):
        v = decay[j] * x[j] + gain[j] * q
        v1 = decay[j] * x1[j] + gain[j] * q1
        v2 = decay[j] * x2[j] + gain[j] * q2
        x[j], x1[j], x2[j] = v, v1, v2
        w += v
        w1 += v1
        w2 += v2
        n += sensor[j] * v
        n1 += sensor[j] * v1
        n2 += sensor[j] * v2
    return w, w1, w2, n, n1, n2


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
def _prepare_moved(dt: float, low: int, lane: int, slab_parts: Array, moved: Array, sums: Array) -> None:
    """Fill the derivatives of steps and sums by ln e or ln C."""
    z = late = 0.0
    at = lane - BY_E
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
    sums[lane, 0], sums[lane, 1] = z, late


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _shift(low: int, high: int, b: Array, x: Array, q: float) -> None:
    """Add b q to the modes of a lane."""
    part, of = b[low:high], x[low:high]
    for j in range(part.size):
        of[j] += part[j] * q


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _shift_all(
    low: int, high: int, steps: Array, moved: Array, x: Array, now: Array, contact: bool, by_e: bool,
    by_c: bool, sign: float,
) -> None:  # fmt: skip
    """Add b q to the modes of all lanes, or take it off them."""
    _shift(low, high, steps[2], x[VALUE], sign * now[0, VALUE])
    if contact:
        _shift(low, high, steps[2], x[BY_H], sign * now[0, BY_H])
        _shift(low, high, steps[2], x[BY_BUILD], sign * now[0, BY_BUILD])
    for lane, wanted in ((BY_E, by_e), (BY_C, by_c)):
        if wanted:
            _shift(low, high, steps[2], x[lane], sign * now[0, lane])
            _shift(low, N_MODE, moved[lane - BY_E, 2], x[lane], sign * now[0, VALUE])


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _start(
    e: float, c: float, far: float, dt: float, by_e: bool, by_c: bool, resistance: float, grown: float,
    parts: Array, sums: Array, now: Array,
) -> None:  # fmt: skip
    """Fill the slab's modes and the fluxes at first touch; resistances are left in ``sums``."""
    now[:], sums[:] = 0.0, 0.0
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
    lane: int, i: int, p: float, q: float, sensed: Array, now: Array, rise: Array, slope: Array
) -> None:
    """Take the sensor of a lane to node i, where the flux is q and the modes bring p."""
    p += sensed[0] * q + sensed[1] * now[0, lane]
    s = sensed[2] * now[2, lane] + sensed[3] * now[1, lane] + sensed[4] * p
    now[0, lane], now[1, lane], now[2, lane] = q, p, s
    rise[lane, i], slope[lane, i] = s, (p - s) * sensed[5]


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _followed_steps(
    k: int, n: int, low: int, high: int, steps: Array, x: Array, sums: Array, sensed: Array, grown: Array,
    now: Array, rise: Array, slope: Array, flux: Array, moved: Array, by_e: bool, by_c: bool,
) -> None:  # fmt: skip
    """Take n steps of value and derivatives from node k on."""
    decay, gain, sensor = steps[0, low:high], steps[1, low:high], steps[3, low:high]
    d_decay3, d_gain3 = moved[0, 0, low:high], moved[0, 1, low:high]
    d_decay4, d_gain4 = moved[1, 0, low:high], moved[1, 1, low:high]
    x0, x1, x2 = x[VALUE, low:high], x[BY_H, low:high], x[BY_BUILD, low:high]
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
        w, w1, w2, p, p1, p2 = _contact_pass(decay, gain, sensor, x0, x1, x2, q, q1, q2)
        gap = (1.0 - w - fast * q) * invert
        q_new = h * gap
        flux[i] = q_new
        q1 = h * (gap - w1 - fast * q1) * invert
        q2 = (grown[1, i] * gap - h * (w2 + fast * q2)) * invert
        _read(VALUE, i, p, q_new, sensed, now, rise, slope)
        _read(BY_H, i, p1, q1, sensed, now, rise, slope)
        _read(BY_BUILD, i, p2, q2, sensed, now, rise, slope)
        if by_e:
            q3 = -h * (w3 + fast * q3 + sums[BY_E, 1] * q + q_new * sums[BY_E, 0]) * invert
            _read(BY_E, i, p3, q3, sensed, now, rise, slope)
        if by_c:
            q4 = -h * (w4 + fast * q4 + sums[BY_C, 1] * q + q_new * sums[BY_C, 0]) * invert
            _read(BY_C, i, p4, q4, sensed, now, rise, slope)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def march(
    repeat: NDArray[np.int64], gripper: Gripper, e: float, c: float, h: float, build: float, contact: bool,
    by_e: bool, by_c: bool, room: Room,
) -> None:  # fmt: skip
    """Fill rise and slope of the sensor and the flux, on the time nodes, for unit difference.

    ``repeat`` (n_group,) says how often each step is taken; ``e``, ``c``, ``h``, ``build`` are effusivity and
    heat capacity of the slab, settled conductance and build-up time of the contact; ``contact``, ``by_e`` and
    ``by_c`` ask for derivatives, the last two for those by the contact too.
    """
    dts, alive, of_gripper, sensed = gripper.dt, gripper.alive, gripper.steps, gripper.sensed
    rise, slope, flux, grown, x, steps, moved, parts, now, sums = room
    _grow(repeat, dts, h, build, gripper.numbers, grown)
    _start(e, c, gripper.numbers[5], dts[0], by_e, by_c, gripper.numbers[0], grown[0, 0], parts, sums, now)
    x[:], rise[:, 0], slope[:, 0], flux[0] = 0.0, 0.0, 0.0, now[0, VALUE]
    steps[3, N_MODE:] = gripper.sensor
    r, r3, r4 = sums[VALUE, 0], sums[BY_E, 0], sums[BY_C, 0]
    k = low = 0
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
    nodes: Nodes, gripper: Gripper, effusivity: Array, capacity: Array, h_c: Array, build: Array
) -> tuple[Array, Array, Array]:
    """Return sensor rise, its slope and the flux of n contacts on the time nodes, (n, n_node) each."""
    n, n_node = effusivity.size, nodes[2].size
    rise, slope, flux = np.empty((n, n_node)), np.empty((n, n_node)), np.empty((n, n_node))
    room = room_for(gripper.sensor.size, n_node)
    for p in range(n):
        march(nodes[1], gripper, effusivity[p], capacity[p], h_c[p], build[p], False, False, False, room)
        rise[p], slope[p], flux[p] = room.rise[VALUE], room.slope[VALUE], room.flux
    return rise, slope, flux
