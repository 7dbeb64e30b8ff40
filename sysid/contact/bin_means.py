"""Compiled responses of one contact and their derivatives, as means over the sensor's bins.

The curves of :mod:`thermogrip.sysid.contact.march` are read between their nodes by cubic Hermite
interpolation, at the samples' times less the onset, and averaged bin by bin.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.contact.block_modes import INNER, OUTER
from thermogrip.sysid.contact.march import (
    BY_BUILD,
    BY_C,
    BY_H,
    VALUE,
    Gripper,
    Nodes,
    Room,
    gripper_of,
    march,
    room_for,
)

__all__ = ["N_CURVE", "RATE", "binned_responses", "fill_responses", "gripper_responses"]

Array = NDArray[np.float64]

RATE = 5  # the row of the slope, after the lanes of the march
N_CURVE = 6
_LATEST_ONSET = 0.8
_H, _BUILD, _ONSET, _LEVEL, _T, _E, _C = range(7)


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
    place: NDArray[np.int64], share: Array, out: Array,
) -> None:  # fmt: skip
    """Fill bin means (n_bin,) of a curve."""
    out[:] = 0.0
    for i in range(place.size):
        k = place[i]
        if k < 0:
            continue
        s, dt = share[i], nodes[k + 1] - nodes[k]
        v = s * s * (3.0 - 2.0 * s)
        bent = s * (1.0 - s) * dt * ((1.0 - s) * slope[k] - s * slope[k + 1])
        out[bins[i]] += rise[k] + v * (rise[k + 1] - rise[k]) + bent
    for m in range(out.size):
        out[m] = out[m] / count[m] if count[m] > 0.0 else 0.0


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def _mean_rates(
    nodes: Array, rise: Array, slope: Array, bins: NDArray[np.int64], count: Array,
    place: NDArray[np.int64], share: Array, out: Array,
) -> None:  # fmt: skip
    """Fill bin means (n_bin,) of a curve's slope."""
    out[:] = 0.0
    for i in range(place.size):
        k = place[i]
        if k < 0:
            continue
        s = share[i]
        steep = 6.0 * s * (1.0 - s) * (rise[k + 1] - rise[k]) / (nodes[k + 1] - nodes[k])
        out[bins[i]] += steep + (1.0 - s) * (1.0 - 3.0 * s) * slope[k] + s * (3.0 * s - 2.0) * slope[k + 1]
    for m in range(out.size):
        out[m] = out[m] / count[m] if count[m] > 0.0 else 0.0


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def fill_responses(
    nodes: Nodes, gripper: Gripper, u: Array, vary: NDArray[np.bool_], times: Array,
    bins: NDArray[np.int64], count: Array, room: Room, place: NDArray[np.int64], share: Array, out: Array,
) -> None:  # fmt: skip
    """Fill bin means of F, of its derivatives by ln h, ln tau_b, ln e, ln C, and of its slope, (6, n_bin).

    Derivatives that ``vary`` (7,) does not ask for are left as they are.
    """
    by_e, by_c = vary[_E], vary[_C]
    contact = vary[_H] or vary[_BUILD] or by_e or by_c
    march(
        nodes[1], gripper, np.exp(u[_E]), np.exp(u[_C]), np.exp(u[_H]), np.exp(u[_BUILD]), contact, by_e,
        by_c, room,
    )  # fmt: skip
    onset = min(max(u[_ONSET], -_LATEST_ONSET), _LATEST_ONSET)
    _places(nodes[2], onset, times, bins, place, share)
    t, rise, slope = nodes[2], room.rise, room.slope
    wanted = (True, contact, contact, by_e, by_c)
    for lane in range(BY_C + 1):
        if wanted[lane]:
            _means(t, rise[lane], slope[lane], bins, count, place, share, out[lane])
    if vary[_ONSET]:
        _mean_rates(t, rise[VALUE], slope[VALUE], bins, count, place, share, out[RATE])


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def binned_responses(
    nodes: Nodes, gripper: Gripper, u: Array, vary: NDArray[np.bool_], times: Array,
    bins: NDArray[np.int64], count: Array,
) -> Array:  # fmt: skip
    """Return what :func:`fill_responses` finds for n pairs, (n, 6, n_bin), zero where not wanted.

    ``u``, ``vary`` (n, 7) the nuisances and which of them are unknown; ``times``, ``bins`` (n, n_sample) and
    ``count`` (n, n_bin) the samples.
    """
    n, n_sample = times.shape
    out = np.zeros((n, N_CURVE, count.shape[1]))
    room = room_for(gripper.sensor.size, nodes[2].size)
    place, share = np.empty(n_sample, dtype=np.int64), np.empty(n_sample)
    for p in range(n):
        fill_responses(nodes, gripper, u[p], vary[p], times[p], bins[p], count[p], room, place, share, out[p])
        for lane, at in ((BY_H, _H), (BY_BUILD, _BUILD)):
            if not vary[p, at]:
                out[p, lane] = 0.0
    return out


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def gripper_responses(
    nodes: Nodes, lam: Array, face: Array, sensor: Array, numbers: Array, u: Array, times: Array,
    bins: NDArray[np.int64], count: Array,
) -> Array:  # fmt: skip
    """Return bin means of the response of n grippers to one contact, (n, n_bin).

    ``lam``, ``face``, ``sensor`` (n, n_mode) are their modes; ``numbers`` (n, 6) holds face resistance, lag,
    first, creep, settle and loss of the far face of each; ``u`` (7,) the nuisances; ``times``, ``bins``
    (n_sample,) and ``count`` (n_bin,) the samples.
    """
    n, n_sample = lam.shape[0], times.size
    out, vary = np.zeros((n, N_CURVE, count.size)), np.zeros(7, dtype=np.bool_)
    room = room_for(lam.shape[1], nodes[2].size)
    place, share = np.empty(n_sample, dtype=np.int64), np.empty(n_sample)
    for p in range(n):
        one = gripper_of(nodes[0], lam[p], face[p], sensor[p], numbers[p])
        fill_responses(nodes, one, u, vary, times, bins, count, room, place, share, out[p])
    return out[:, VALUE]
