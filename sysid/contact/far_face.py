r"""Heat that a block passes to the room by its far face while its near one is touched.

A block of capacity C per face whose far face loses U (T_obj - T_room) warms or cools at its near face,
untouched there, by

.. math:: d(t) = \frac{U (T_{room} - T_{obj})}{C} \int_0^t \vartheta(s) ds
          \approx \frac{U (T_{room} - T_{obj})}{C} \max(t - L^2 / 6 \alpha, 0),

since the mean time of the way through the slab is :math:`L^2 / 6 \alpha = C^2 / 6 e^2`: 0.6 s in 20 mm of
copper, 3 s in iron, minutes in wood, which within a grasp shows nothing of it.  The sensor answers to d as to
every change of the face, by the step response F, so the reading gains

.. math:: \frac{U}{C} (T_{room} - T_{obj}) G(t), \quad G(t) = \int_0^{t - C^2 / 6 e^2} F(s) ds.

That is the first order in U: the loss of what the gripper itself has warmed is left out (of the size of
U t / C, 2 % in 10 s, of a few kelvin).
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.contact.block_modes import INNER, OUTER

__all__ = ["delay", "delayed_integrals", "fill_delayed"]

Array = NDArray[np.float64]


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def delay(ln_e: float, ln_c: float) -> float:
    """Return C^2 / 6 e^2 [s]."""
    return float(np.exp(2.0 * (ln_c - ln_e)) / 6.0)


@numba.njit(**INNER)  # type: ignore[untyped-decorator]
def fill_delayed(t: Array, count: Array, late: float, curve: Array, total: Array, value: Array) -> None:
    """Fill the integral of a curve up to t - late, and the curve there; by straight lines, zero before.

    ``t``, ``count``, ``curve`` (n,) rise in time where ``count`` is not 0; other points are skipped.
    """
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


@numba.njit(**OUTER)  # type: ignore[untyped-decorator]
def delayed_integrals(
    t: Array, count: Array, ln_e: Array, ln_c: Array, curves: Array
) -> tuple[Array, Array, Array]:
    """Return integrals and values of ``curves`` (n, n_curve, n_bin) up to and at t less the delay, and the
    delay (n,) [s].

    ``t``, ``count`` (n, n_bin) the bins, ``ln_e`` and ``ln_c`` (n,) the blocks.
    """
    total, value, late = np.zeros(curves.shape), np.zeros(curves.shape), np.empty(curves.shape[0])
    for p in range(curves.shape[0]):
        late[p] = delay(ln_e[p], ln_c[p])
        for k in range(curves.shape[1]):
            fill_delayed(t[p], count[p], late[p], curves[p, k], total[p, k], value[p, k])
    return total, value, late
