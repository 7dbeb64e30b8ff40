"""The posterior of one grasp once more, in JAX: what NUTS needs derivatives of.

The same five unknowns, priors and marginalised temperatures as
``thermogrip.sysid.effusivity.posterior_grid.MarginalPosterior``, written again from its equations;
``engine.py`` checks that both give the same density before it samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln

from thermogrip.sysid.contact.simulation import stack_modes
from thermogrip.sysid.effusivity.data import Touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    LEVEL,
    ONSET,
    T_OBJECT,
    free_hypotheses,
    nodes_for,
    prior_of,
)

jax.config.update("jax_enable_x64", True)

_GAUSS = np.polynomial.legendre.leggauss(24)


def eigenvalues(y: Any, biot: Any) -> Any:
    """Return beta = y pi + arctan(Bi / beta), Bi > 0."""
    beta = jnp.where(y > 0, y * jnp.pi, jnp.sqrt(biot / (1 + 0.5 * biot)))
    for _ in range(5):
        square = beta**2 + biot**2
        beta = beta - (beta - y * jnp.pi - jnp.arctan(biot / beta)) * square / (square + biot)
    return beta


def block(e: Any, c: Any, far: float) -> tuple[Any, Any, Any]:
    """Return rates, weights and series resistance of a slab whose far face loses ``far`` per degree."""
    unit, biot = (e / c) ** 2, max(far, 1e-12) * c / e**2
    top = jnp.maximum(jnp.sqrt(2e3 / unit) / jnp.pi, 34.5)
    span = jnp.log(top / 11.5)
    grouped = 11.5 * jnp.exp(0.5 * span * (1 + _GAUSS[0]))
    first = jnp.full(12, 2.0).at[11].set(2.0 * (1 - 1 / 24))
    j = jnp.concatenate([jnp.arange(12.0), grouped, jnp.array([12.0])])
    w = jnp.concatenate([first, span * _GAUSS[1] * grouped, jnp.array([2 / 24])]) / c
    beta = eigenvalues(j, biot)
    square = beta**2 + biot**2
    return beta**2 * unit, w * square / (square + biot), 2 / (c * jnp.pi**2 * unit * top)


def delayed_integral(t: Any, f: Any, late: Any) -> Any:
    """Return the integral of f, straight between its points, up to t - late; zero before the first."""
    t = jnp.asarray(t)  # an array of NumPy's cannot be indexed while JAX traces
    steps = 0.5 * jnp.diff(t) * (f[1:] + f[:-1])
    summed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    k = jnp.clip(jnp.searchsorted(t, t - late, side="right") - 1, 0, t.size - 2)
    ahead = t - late - t[k]
    rise = (f[k + 1] - f[k]) / (t[k + 1] - t[k])
    return jnp.where(t - late >= t[0], summed[k] + ahead * (f[k] + 0.5 * rise * ahead), 0.0)


def coefficients(lam: Any, dt: Any) -> tuple[Any, Any, Any]:
    """Return decay and the two flux weights of modes over a step."""
    x = lam * dt
    small = x < 1e-4
    safe_x, safe_lam = jnp.where(small, 1.0, x), jnp.where(small, 1.0, lam)
    phi = (1 - jnp.exp(-safe_x)) / safe_lam
    b = (dt - phi) / safe_x
    decay = jnp.where(small, 1 - x * (1 - 0.5 * x), jnp.exp(-x))
    return decay, jnp.where(small, dt * (0.5 - x / 3), phi - b), jnp.where(small, dt * (0.5 - x / 6), b)


def log_density(device: GripperModel, data: Touches) -> Callable[[Any], Any]:
    """Return the log posterior of (ln e, ln h, ln tau_b, t0, ln C) as a JAX function, up to a constant."""
    stack, nodes, gripper = device.stack, nodes_for(data), stack_modes(device.stack)
    group = np.repeat(np.arange(nodes.dt.size), nodes.repeat)
    whitener = jnp.asarray(whiten(data, device.noise)[0][0])
    prior = prior_of(device, data, free_hypotheses(device, [9.0]))
    mean, sd, dof = prior.mean[0], prior.sd[0], prior.dof[0]
    there = data.sample_bin[0] >= 0
    times = data.sample_t[0][there]
    pick = np.zeros((data.y.shape[1], times.size))
    pick[data.sample_bin[0][there], np.arange(times.size)] = 1.0
    pick /= np.maximum(data.count[0], 1.0)[:, None]
    room = data.t_ambient[0]
    ln_length = np.log(device.block_length * device.depth_share)
    ramp = stack.leak * data.ramp[0] * np.isfinite(room)
    n_d = gripper.lam.size

    def time_step(e: Any, c: Any, h: Any, build: Any) -> tuple[Any, Any]:
        lam, weight, resistance = block(e, c, stack.g_far)
        lam, w = jnp.concatenate([gripper.lam, lam]), jnp.concatenate([gripper.face, weight])
        r = gripper.resistance + resistance
        decay, a, b = coefficients(lam[None, :], nodes.dt[:, None])
        a, b = a * w, b * w
        z = b.sum(axis=1)
        keep, a_lag, b_lag = coefficients(1 / stack.lag, jnp.asarray(nodes.dt))

        def step(state: Any, xs: Any) -> tuple[Any, Any]:
            x, q, node, sensor = state
            g, t = xs
            x = decay[g] * x + a[g] * q
            h_now = h * (stack.first + (1 - stack.first) * (1 - jnp.exp(-t / build)))
            h_now = h_now * (1 + stack.creep * (1 - jnp.exp(-t / stack.settle)))
            q = h_now * (1 - x.sum()) / (1 + h_now * (z[g] + r))
            x = x + b[g] * q
            new = x[:n_d] @ gripper.sensor
            sensor = keep[g] * sensor + (a_lag[g] * node + b_lag[g] * new) / stack.lag
            return (x, q, new, sensor), (sensor, (new - sensor) / stack.lag)

        q0 = h * stack.first / (1 + h * stack.first * r)
        start = (jnp.zeros(lam.size), q0, 0.0, 0.0)
        _, (rise, slope) = jax.lax.scan(step, start, (group, nodes.t[1:]))
        return jnp.concatenate([jnp.zeros(1), rise]), jnp.concatenate([jnp.zeros(1), slope])

    def student(x: Any, k: int) -> Any:
        w, nu = (x - mean[k]) / sd[k], dof[k]
        if np.isinf(nu):
            return -0.5 * w**2 - np.log(sd[k])
        norm = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu)
        return norm - 0.5 * (nu + 1) * jnp.log1p(w**2 / nu) - np.log(sd[k])

    def density(u: Any) -> Any:
        x, ln_h, ln_build, onset, ln_c = u
        rise, slope = time_step(jnp.exp(x), jnp.exp(ln_c), jnp.exp(ln_h), jnp.exp(ln_build))
        t = times - jnp.clip(onset, -0.8, 0.8)
        k = jnp.clip(jnp.searchsorted(nodes.t, t) - 1, 0, nodes.t.size - 2)
        dt = jnp.asarray(nodes.t)[k + 1] - jnp.asarray(nodes.t)[k]
        s = jnp.minimum((t - jnp.asarray(nodes.t)[k]) / dt, 1.0)
        y0, y1, m0, m1 = rise[k], rise[k + 1], slope[k] * dt, slope[k + 1] * dt
        c2, c3 = 3 * (y1 - y0) - 2 * m0 - m1, 2 * (y0 - y1) + m0 + m1
        f = pick @ jnp.where(t > 0, y0 + s * (m0 + s * (c2 + s * c3)), 0.0)
        level, t_obj = mean[LEVEL], mean[T_OBJECT]
        drift = ramp * ((room if np.isfinite(room) else level) - level)
        lost = stack.g_far * np.isfinite(room) / jnp.exp(ln_c)
        lost *= delayed_integral(data.t[0], f, jnp.exp(2 * (ln_c - x)) / 6)
        drift = drift + lost * ((room if np.isfinite(room) else t_obj) - t_obj)
        v0 = whitener @ (data.y[0] - level - (t_obj - level) * f - drift)
        by_object = (f - lost) * sd[T_OBJECT]
        v = jnp.stack([whitener @ ((1 - f - ramp) * sd[LEVEL]), whitener @ by_object], axis=1)
        matrix = jnp.eye(2) + v.T @ v
        projected = v.T @ v0
        value = -0.5 * (v0 @ v0 - projected @ jnp.linalg.solve(matrix, projected))
        value -= 0.5 * jnp.linalg.slogdet(matrix)[1]
        metal = jax.nn.sigmoid(4 * (x - np.log(4500.0)))
        h_sd = np.hypot(device.spreads.ln_h_of_blocks, device.spreads.ln_h)
        c_mean = np.log(1.7e6) + metal * np.log(3.2e6 / 1.7e6) + ln_length
        c_sd = 0.4 - 0.2 * metal
        value -= 0.5 * ((ln_h - device.ln_h_level - device.ln_h_slope * (x - 9.0)) / h_sd) ** 2
        value -= 0.5 * ((ln_c - c_mean) / c_sd) ** 2 + jnp.log(c_sd) + np.log(h_sd)
        return value + student(ln_build, BUILD_UP) + student(onset, ONSET)

    return density
