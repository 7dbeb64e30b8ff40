"""The compiled part of :mod:`thermogrip.sysid.contact.response_table`: interpolation between its nodes, and
bin means of what it finds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.compiled import kernel
from thermogrip.sysid.contact.time_stepping import COMPILED

N_BASIS = 16  # curves whose combinations are all responses


@kernel(**COMPILED)
def blend(
    index: NDArray[np.int32], shape: tuple[int, ...], rows: NDArray[np.float32], cell: NDArray[np.int64],
    share: Array, late: Mask, weight: Array, step: Array, wanted: Mask, order: NDArray[np.int64], kept: Array,
    kept_of: NDArray[np.int32], room: Array, sums: Array, out: Array,
) -> None:  # fmt: skip
    """Fill ``out`` (n, 5, N_BASIS): coefficients of the value, and of its derivatives by ln h, ln tau_b, ln e
    at the same C/e, and ln C/e, at a ``share`` (n, 4) of the way through each ``cell``.

    ``index`` (n_e, -1) are the rows of the nodes of a lattice of that ``shape``.  ln e goes first: a free
    effusivity needs no derivative by it, and sums along it are ``kept`` (-1, N_BASIS) for the next places at
    the same ln e, neighbours in ``order`` (n,); ``kept_of`` are zeros, ``sums`` (5, N_BASIS) room.
    ``weight`` (4, 6, 6) are the nodes' as polynomials (direction, order, node); a ``late`` place lies on
    nodes of ln C/e, which nothing depends on there."""
    w, s, (_, _, n_h, n_b), group, last = room[:4], room[4:], shape, 0, -1
    for i in range(cell.shape[0]):
        p = order[i]
        for d in range(4):
            x = share[p, d]
            for k in range(6):
                value = slope = 0.0
                for o in range(5, -1, -1):
                    slope = slope * x + value
                    value = value * x + weight[d, o, k]
                w[d, k], s[d, k] = value, slope / step[d]
        moved, by_e = wanted[p, 1] or wanted[p, 2], wanted[p, 3]
        by_slab = (by_e or wanted[p, 4]) and not late[p]
        if last < 0 or cell[p, 0] != cell[last, 0] or share[p, 0] != share[last, 0]:
            group += 1
        last = p
        at_e, corner = cell[p, 0], (cell[p, 1] * n_h + cell[p, 2]) * n_b + cell[p, 3]
        e0, e1, e2, e3, e4, e5 = w[0, 0], w[0, 1], w[0, 2], w[0, 3], w[0, 4], w[0, 5]
        h0, h1, h2, h3, h4, h5 = s[0, 0], s[0, 1], s[0, 2], s[0, 3], s[0, 4], s[0, 5]
        sums[:] = 0.0
        for j in range(6):
            if w[1, j] == 0.0 and not by_slab:
                continue
            for k in range(6):
                for m in range(4):
                    n = corner + (j * n_h + k) * n_b + m
                    if kept_of[n] == group and not by_e:
                        continue
                    kept_of[n] = group
                    a, b, c = index[at_e, n], index[at_e + 1, n], index[at_e + 2, n]
                    d, f, g = index[at_e + 3, n], index[at_e + 4, n], index[at_e + 5, n]
                    for q in range(N_BASIS):
                        at = e0 * rows[a, q] + e1 * rows[b, q] + e2 * rows[c, q]
                        at += e3 * rows[d, q] + e4 * rows[f, q] + e5 * rows[g, q]
                        kept[n, q] = at
                    if by_e:
                        x = w[1, j] * w[2, k] * w[3, m]
                        for q in range(N_BASIS):
                            at = h0 * rows[a, q] + h1 * rows[b, q] + h2 * rows[c, q]
                            at += h3 * rows[d, q] + h4 * rows[f, q] + h5 * rows[g, q]
                            sums[3, q] += x * at
        t0, t1, t2, t3 = w[3, 0], w[3, 1], w[3, 2], w[3, 3]
        z0, z1, z2, z3 = s[3, 0], s[3, 1], s[3, 2], s[3, 3]
        for j in range(6):
            x, y = w[1, j], s[1, j]
            if x == 0.0 and not by_slab:
                continue
            for k in range(6):
                n, b0 = corner + (j * n_h + k) * n_b, x * w[2, k]
                b1, b2 = x * s[2, k], y * w[2, k]
                if not (moved or by_slab):
                    for q in range(N_BASIS):
                        at = t0 * kept[n, q] + t1 * kept[n + 1, q] + t2 * kept[n + 2, q] + t3 * kept[n + 3, q]
                        sums[0, q] += b0 * at
                    continue
                for q in range(N_BASIS):
                    k0, k1, k2, k3 = kept[n, q], kept[n + 1, q], kept[n + 2, q], kept[n + 3, q]
                    at = t0 * k0 + t1 * k1 + t2 * k2 + t3 * k3
                    sums[0, q] += b0 * at
                    sums[1, q] += b1 * at
                    sums[2, q] += b0 * (z0 * k0 + z1 * k1 + z2 * k2 + z3 * k3)
                    sums[4, q] += b2 * at
        if not moved:
            sums[1:3] = 0.0
        if not by_slab:
            sums[4] = 0.0
        for q in range(N_BASIS):
            out[p, 0, q], out[p, 1, q], out[p, 2, q] = sums[0, q], sums[1, q], sums[2, q]
            out[p, 3, q], out[p, 4, q] = sums[3, q] - sums[4, q], sums[4, q]  # by ln e at the same C


@kernel(**COMPILED)
def blended_means(
    values: Array, slopes: Array, first: float, step: float, coefficients: Array, which: NDArray[np.int64],
    onset: Array, wanted: Mask, room: Array, means: Array,
) -> None:  # fmt: skip
    """Fill ``means`` (n, 6, n_bin): bin means of the ``wanted`` curves of ``coefficients`` (k, 5, N_BASIS),
    ``which`` of these belongs to each pair, and of the slope of its first, which is the last curve.

    ``values`` and ``slopes`` (n_place, N_BASIS, n_bin) are bin means of the basis and their derivatives by
    the onset, at onsets ``first``, ``first + step`` and on; between them cubics."""
    n_bin, last = values.shape[2], means.shape[1] - 1
    for p in range(which.size):
        place = (onset[p] - first) / step
        g = min(int(place), values.shape[0] - 2)
        x, own = place - g, coefficients[which[p]]
        w0, w1 = (1.0 + 2.0 * x) * (1.0 - x) * (1.0 - x), x * x * (3.0 - 2.0 * x)
        w2, w3 = x * (1.0 - x) * (1.0 - x) * step, x * x * (x - 1.0) * step
        means[p] = 0.0
        for q in range(N_BASIS):
            for m in range(n_bin):
                room[m] = (
                    w0 * values[g, q, m] + w1 * values[g + 1, q, m]
                    + w2 * slopes[g, q, m] + w3 * slopes[g + 1, q, m]
                )  # fmt: skip
            for c in range(last):
                if wanted[p, c]:
                    factor = own[c, q]
                    for m in range(n_bin):
                        means[p, c, m] += factor * room[m]
        if wanted[p, last]:
            d1 = 6.0 * x * (1.0 - x) / step
            d2, d3 = (1.0 - x) * (1.0 - 3.0 * x), x * (3.0 * x - 2.0)
            for q in range(N_BASIS):
                factor = -own[0, q]  # a later onset is an earlier time
                for m in range(n_bin):
                    means[p, last, m] += factor * (
                        d1 * (values[g + 1, q, m] - values[g, q, m])
                        + d2 * slopes[g, q, m] + d3 * slopes[g + 1, q, m]
                    )  # fmt: skip
