"""Compiled marching of one contact: the inner loop of :mod:`thermogrip.sysid.grasp_response`.

Both bodies are sums of exponential modes, so one step of length ``dt`` with a flux linear in time is exact:

    x(t + dt) = E x(t) + w (a q(t) + b q(t + dt)),   E = exp(-lam dt),  b = (dt - phi)/(lam dt),  a = phi - b,

with phi = (1 - E)/lam.  The contact closes the loop, q = h(t) (1 - device rise - block drop), which is
linear in the one unknown q(t + dt).  This file alone imports numba, so nothing pays for the compiler before
it is used.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["bin_means", "coefficients", "march"]

Array = NDArray[np.float64]

# sums over modes may be reordered, so that they run in vector registers; infinities stay what they are
_FAST = {"reassoc", "contract", "arcp", "nsz"}


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def coefficients(lam: float, dt: float) -> tuple[float, float, float]:
    """Return E, a, b of one mode; by series where lam dt is small."""
    x = lam * dt
    if x < 1e-4:
        return 1.0 - x * (1.0 - 0.5 * x), dt * (0.5 - x / 3.0), dt * (0.5 - x / 6.0)
    decay = np.exp(-x)
    phi = (1.0 - decay) / lam
    b = (dt - phi) / x
    return decay, phi - b, b


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _step_weights(dt: float, lam_d: Array, lam_b: Array, w: Array, decay: Array, a: Array, b: Array) -> float:
    """Fill decay and flux weights of every mode for a step dt; return what the new flux does to the gap."""
    z = 0.0
    for j in range(decay.size):
        lam = lam_d[j] if j < lam_d.size else lam_b[j - lam_d.size]
        decay[j], a[j], b[j] = coefficients(lam, dt)
        a[j] *= w[j]
        b[j] *= w[j]
        z += b[j]
    return z


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def march(
    dts: Array,
    repeat: NDArray[np.int64],
    device: tuple[Array, Array, Array, float],
    lag: float,
    block_lam: Array,
    block_w: Array,
    block_r: Array,
    contact: Array,
) -> tuple[Array, Array, Array]:
    """Return sensor rise, its slope and the flux on the time nodes, for ``n_pair`` contacts of unit
    difference.

    ``device`` is (lam, weight at the face, weight at the sensor, face resistance); ``block_lam``, ``block_w``
    (n_pair, n_mode) and ``block_r`` (n_pair,) are the blocks; ``contact`` (n_pair, 5) holds h, first share
    f0, build-up time, creep and its time of each; ``dts`` (n_group,) steps, each used ``repeat`` times.
    """
    lam_d, w_d, w_s, r_d = device
    n_d, n_pair, n_b = lam_d.size, block_lam.shape[0], block_lam.shape[1]
    n_t = 1 + int(repeat.sum())
    rise = np.zeros((n_pair, n_t))
    slope = np.zeros((n_pair, n_t))
    flux = np.zeros((n_pair, n_t))
    n = n_d + n_b
    decay, a, b = np.empty(n), np.empty(n), np.empty(n)
    x, w = np.empty(n), np.empty(n)
    for p in range(n_pair):
        h, first, build, creep, settle = contact[p]
        x[:] = 0.0
        w[:n_d] = w_d
        w[n_d:] = block_w[p]
        r = r_d + block_r[p]
        h_now = h * first
        q = h_now / (1.0 + h_now * r)
        flux[p, 0] = q
        node, sensor, t, k = 0.0, 0.0, 0.0, 0
        for g in range(dts.size):
            dt = dts[g]
            z = _step_weights(dt, lam_d, block_lam[p], w, decay, a, b)
            e_lag, a_lag, b_lag = coefficients(1.0 / lag, dt)
            for _ in range(repeat[g]):
                t += dt
                k += 1
                history = 0.0
                for j in range(n):
                    x[j] = decay[j] * x[j] + a[j] * q
                    history += x[j]
                h_now = h * (first + (1.0 - first) * (1.0 - np.exp(-t / build)))
                h_now *= 1.0 + creep * (1.0 - np.exp(-t / settle))
                q = h_now * (1.0 - history) / (1.0 + h_now * (z + r))
                node_next = 0.0
                for j in range(n):
                    x[j] += b[j] * q
                    if j < n_d:
                        node_next += w_s[j] * x[j]
                sensor = e_lag * sensor + (a_lag * node + b_lag * node_next) / lag
                node = node_next
                rise[p, k] = sensor
                slope[p, k] = (node - sensor) / lag
                flux[p, k] = q
    return rise, slope, flux


@numba.njit(cache=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def bin_means(
    nodes: Array,
    rise: Array,
    slope: Array,
    onset: Array,
    times: Array,
    bins: NDArray[np.int64],
    n_bin: int,
) -> tuple[Array, Array]:
    """Return bin means of F(t - onset) and of its slope, (n_pair, n_bin), by cubic Hermite interpolation.

    ``times`` and ``bins`` are (n_pair, n_sample); a sample of bin -1 is left out.
    """
    n_pair = rise.shape[0]
    value = np.zeros((n_pair, n_bin))
    rate = np.zeros((n_pair, n_bin))
    count = np.zeros(n_bin)
    last = nodes.size - 1
    for p in range(n_pair):
        count[:] = 0.0
        k = 0
        for i in range(times.shape[1]):
            m = bins[p, i]
            if m < 0:
                continue
            count[m] += 1.0
            t = times[p, i] - onset[p]
            if t <= 0.0:
                continue
            while k < last - 1 and nodes[k + 1] < t:
                k += 1
            while k > 0 and nodes[k] > t:
                k -= 1
            dt = nodes[k + 1] - nodes[k]
            s = min((t - nodes[k]) / dt, 1.0)
            y0, y1, m0, m1 = rise[p, k], rise[p, k + 1], slope[p, k] * dt, slope[p, k + 1] * dt
            c2 = 3.0 * (y1 - y0) - 2.0 * m0 - m1
            c3 = 2.0 * (y0 - y1) + m0 + m1
            value[p, m] += y0 + s * (m0 + s * (c2 + s * c3))
            rate[p, m] += (m0 + s * (2.0 * c2 + 3.0 * s * c3)) / dt
        for m in range(n_bin):
            if count[m] > 0.0:
                value[p, m] /= count[m]
                rate[p, m] /= count[m]
    return value, rate
