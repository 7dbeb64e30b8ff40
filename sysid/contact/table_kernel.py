"""The compiled part of :mod:`thermogrip.sysid.contact.response_table`: interpolation between its nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.compiled import numba
from thermogrip.sysid.contact.time_stepping import COMPILED

N_BASIS = 16  # curves whose combinations are all responses


@numba.njit(**COMPILED)  # type: ignore[untyped-decorator]
def blend(
    index: NDArray[np.int32], rows: NDArray[np.float32], cell: NDArray[np.int64], by_e: tuple[Array, Array],
    by_slab: tuple[Array, Array], by_h: tuple[Array, Array], by_build_up: tuple[Array, Array], wanted: Mask,
    room: Array, out: Array,
) -> None:  # fmt: skip
    """Fill ``out`` (n, 5, N_BASIS): coefficients of the value, and of its derivatives by ln h, ln tau_b, ln e
    at the same C/e, and ln C/e; one direction after the other."""
    b, c = room[:3], room[3:7]  # summed over ln tau_b and ln h, and over ln C/e
    for p in range(cell.shape[0]):
        w, s = by_build_up[0][p], by_build_up[1][p]
        w0, w1, w2, w3, s0, s1, s2, s3 = w[0], w[1], w[2], w[3], s[0], s[1], s[2], s[3]
        moved = wanted[p, 1] or wanted[p, 2]
        for i in range(by_e[0].shape[1]):
            x_e, y_e = by_e[0][p, i], by_e[1][p, i]
            if x_e == 0.0 and not wanted[p, 3]:
                continue
            c[:] = 0.0
            for j in range(by_slab[0].shape[1]):
                x, y = by_slab[0][p, j], by_slab[1][p, j]
                if x == 0.0 and not (wanted[p, 3] or wanted[p, 4]):
                    continue
                b[:] = 0.0
                for k in range(by_h[0].shape[1]):
                    u, v = by_h[0][p, k], by_h[1][p, k]
                    at = index[cell[p, 0] + i, cell[p, 1] + j, cell[p, 2] + k, cell[p, 3] :]
                    r0, r1, r2, r3 = rows[at[0]], rows[at[1]], rows[at[2]], rows[at[3]]
                    if moved:
                        for q in range(N_BASIS):
                            one = w0 * r0[q] + w1 * r1[q] + w2 * r2[q] + w3 * r3[q]
                            b[0, q] += u * one
                            b[1, q] += v * one
                            b[2, q] += u * (s0 * r0[q] + s1 * r1[q] + s2 * r2[q] + s3 * r3[q])
                    else:
                        for q in range(N_BASIS):
                            b[0, q] += u * (w0 * r0[q] + w1 * r1[q] + w2 * r2[q] + w3 * r3[q])
                for q in range(N_BASIS):
                    c[0, q] += x * b[0, q]
                    c[1, q] += x * b[1, q]
                    c[2, q] += x * b[2, q]
                    c[3, q] += y * b[0, q]
            for q in range(N_BASIS):
                out[p, 0, q] += x_e * c[0, q]
                out[p, 1, q] += x_e * c[1, q]
                out[p, 2, q] += x_e * c[2, q]
                out[p, 3, q] += y_e * c[0, q]
                out[p, 4, q] += x_e * c[3, q]
