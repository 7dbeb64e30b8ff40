"""Evidence of a hypothesis when the gripper itself is in doubt.

A calibration leaves theta (the stack, mean onset, carrying loss, dial, depth, the block's ln h and ln e)
with a covariance P (:mod:`thermogrip.sysid.effusivity.gripper_model`), large for a gripper that was
never calibrated.  theta moves the response, and the prior means of the nuisances: u = v + M (theta - t0),
with v as it was for the gripper t0.  With J = df/du and K = df/dtheta, the latter along with u, the
prediction around a guess (v, t) is f + J dv + K dtheta, and theta ~ N(t0, P) makes the data a problem in v
alone, with more noise and shifted readings:

    y - f + K (t - t0) = J dv + noise,   cov(noise) = C + K P K' = S.

Its solution in dv gives the next guess of theta, t0 + P a with

    a = K' S^-1 [y - f + K (t - t0) - J dv],

until the joint density of (v, theta) promises no more.  That is Gauss-Newton for both together, halved where
the density would fall, and the evidence at its end is Laplace's for both.  Every hypothesis finds a gripper
of its own: the one that a poor hypothesis needs costs it what such a gripper is improbable by.

Since it is the same finger, a hypothesis starts from the gripper of the likeliest one, through a, which
unlike theta does not depend on the block.  One that is 50 nats behind is left there, unsettled.

Where the block is not of the calibration its effusivity is on the scale that the calibration's blocks
define, so P is taken given theirs; the scale's own uncertainty is added where effusivities are reported.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs

from thermogrip.sysid.contact.response import (
    LAYER_NAMES,
    Stack,
    TimeNodes,
    contact_numbers,
    nearby_modes,
    stack_modes,
)
from thermogrip.sysid.effusivity.data import Touches, noise_covariance
from thermogrip.sysid.effusivity.gripper_model import NOTHING, SHARED_NAMES
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    N_NUISANCE,
    ONSET,
    T_OBJECT,
    H,
    Mode,
    Prior,
    far_integrals,
    far_rate,
    find_modes,
    jacobian,
    nodes_for,
    peak_ratio,
    predict,
)

if TYPE_CHECKING:
    from thermogrip.sysid.effusivity.gripper_model import Device

__all__ = ["doubtful_modes"]

Array = NDArray[np.float64]

_STACK_NAMES = SHARED_NAMES[: SHARED_NAMES.index("onset")]  # these make a Stack
_AT = {name: i for i, name in enumerate((*SHARED_NAMES, "ln_h", "ln_e"))}
_ROUNDS = 8
_STILL = 0.5  # of -2 ln density: smaller promises end the search
_HOPELESS = 50.0  # nats behind the likeliest
_DIFFERENCE = 1e-6
_LAYERS = [_AT[f"ln_{name}"] for name in LAYER_NAMES]
_CONTACT = ("lag", "first", "creep", "settle", "g_far")
_BY_LOGARITHM = np.array([name != "creep" for name in _CONTACT])
_MOVED = [*_LAYERS, _AT["ln_lag"], _AT["ln_first"], _AT["creep"], _AT["ln_settle"], _AT["ln_g_far"]]


class _Pair(NamedTuple):
    """A touch under a hypothesis: one row of data, whitener and noise C, prior of v, P, numbers of t0."""

    data: Touches
    nodes: TimeNodes
    whitener: Array
    noise: Array
    prior: Prior
    dof: Array
    covariance: Array
    centre: Array
    by_mean: Array  # (7, n_theta): how theta moves the prior's mean of u
    constant: float  # what neither guess nor gripper changes of the log evidence


@dataclass(frozen=True)
class _Point:
    """A guess: ``v`` (7,), the gripper t0 + P a, what it comes to, and -2 ln density there."""

    v: Array
    a: Array
    moved: Array
    u: Array
    stack: Stack
    left: Array
    cost: float


class _Expansion(NamedTuple):
    """The solution around a guess: step of v, new a, what they promise, evidence, and factors at its end.

    ``curved`` (7, 7) is the Cholesky factor of the curvature in units of the prior's sd, ``chol`` that of S.
    """

    dv: Array
    a: Array
    promise: float
    log_evidence: float
    curved: Array
    chol: Array


def doubtful_modes(
    device: Device,
    data: Touches,
    row: NDArray[np.int64],
    whitener: tuple[Array, Array],
    prior: Prior,
    block: NDArray[np.int64],
    *,
    start: Array | None = None,
    max_steps: int = 20,
) -> Mode:
    """Return mode, covariance and log evidence of every pair, the gripper's numbers integrated over.

    Parameters
    ----------
    device : Device
        With its ``knowledge``.
    data, row, whitener, prior, start, max_steps
        As in :func:`~thermogrip.sysid.effusivity.laplace_approximation.find_modes`.
    block : (n_pair,) ndarray of int
        The calibration's block that a hypothesis is of, by its place in ``device.materials``; -1 for others.

    Returns
    -------
    mode : Mode
        ``u`` and its covariance are as of the gripper that each hypothesis found.
    """
    first = find_modes(device.stack, data, row, whitener, prior, start=start, max_steps=max_steps)
    pairs = _pairs(device, data, row, whitener, prior, block)
    found: list[Mode | None] = [None] * row.size
    for touch in np.unique(row):
        at = np.flatnonzero(row == touch)
        a, best = np.zeros(len(_AT)), -np.inf
        for i in at[np.argsort(-first.log_evidence[at], kind="stable")]:
            mode, its_a = _settle(pairs[i], first.u[i], a, best - _HOPELESS)
            found[i] = mode
            if mode.log_evidence[0] > best:
                a, best = its_a, float(mode.log_evidence[0])
    return Mode(*(np.concatenate(part) for part in zip(*(m for m in found if m is not None))))


def _pairs(
    device: Device,
    data: Touches,
    row: NDArray[np.int64],
    whitener: tuple[Array, Array],
    prior: Prior,
    block: NDArray[np.int64],
) -> list[_Pair]:
    own = np.array([device.blocks[device.materials[b]].ln_h_sd if b >= 0 else 0.0 for b in block])
    sd = prior.sd.copy()
    # how well the block's mean is known is in the covariance
    sd[:, H] = np.sqrt(np.maximum(sd[:, H] ** 2 - own**2, 1e-12))
    covariance = {b: _covariance(device, b) for b in set(block.tolist())}
    noise, nodes, centre = noise_covariance(data, device.noise), nodes_for(data), _numbers(device.stack)
    dof = np.full(sd.shape, np.inf) if prior.dof is None else prior.dof
    there = (data.count > 0).sum(axis=1)
    constant = peak_ratio(dof, sd > 0) - 0.5 * np.log(2 * np.pi) * there[row]
    out = []
    for i, r in enumerate(row.tolist()):
        own_prior = Prior(prior.mean[i : i + 1], sd[i : i + 1])
        one = data.take(np.array([r]))
        out.append(
            _Pair(
                one,
                nodes,
                whitener[0][r],
                noise[r],
                own_prior,
                dof[i],
                covariance[int(block[i])],
                centre,
                _mean_slopes(one),
                float(constant[i]),
            )
        )
    return out


def _covariance(device: Device, block: int) -> Array:
    """Return P of the shared numbers and of the block's ln h and ln e, (n_theta, n_theta)."""
    assert device.knowledge is not None
    names, full = device.knowledge.names, device.knowledge.covariance
    pick = np.zeros((len(_AT), len(names)))
    for name in SHARED_NAMES:
        pick[_AT[name], names.index(name)] = 1.0
    if block >= 0:
        label = device.materials[block]
        pick[_AT["ln_h"], names.index(f"ln_h {label}")] = 1.0
        pick[_AT["ln_e"], names.index(f"ln_e {label}")] = 1.0
        return np.asarray(pick @ full @ pick.T)
    ln_h = [i for i, name in enumerate(names) if name.startswith("ln_h ")]
    ln_e = [i for i, name in enumerate(names) if name.startswith("ln_e ")]
    pick[_AT["ln_h"], ln_h] = 1 / len(ln_h)
    cross = pick @ full[:, ln_e]
    # what lies within rounding of zero is known exactly
    known = np.linalg.pinv(full[np.ix_(ln_e, ln_e)], rcond=1e-10, hermitian=True)
    return np.asarray(pick @ full @ pick.T - cross @ known @ cross.T)


def _numbers(stack: Stack) -> Array:
    values = {f.name: float(getattr(stack, f.name)) for f in fields(Stack)}
    return np.array(
        [np.log(max(values[n[3:]], NOTHING)) if n.startswith("ln_") else values[n] for n in _STACK_NAMES]
    )


def _stack(numbers: Array) -> Stack | None:
    """Return the gripper, None where there can be none."""
    named = zip(_STACK_NAMES, numbers.tolist())
    try:
        return Stack(**{n.removeprefix("ln_"): float(np.exp(v)) if "ln_" in n else v for n, v in named})
    except ValueError:
        return None


def _mean_slopes(data: Touches) -> Array:
    """Return the derivative of the prior mean of one touch's u by theta, (7, n_theta)."""
    known = bool(np.isfinite(data.t_object[0]))
    out = np.zeros((N_NUISANCE, len(_AT)))
    for k, name in ((BUILD, "ln_build"), (ONSET, "onset"), (CAPACITY, "ln_depth"), (H, "ln_h")):
        out[k, _AT[name]] = 1.0
    out[EFFUSIVITY, _AT["ln_e"]] = 1.0
    if known:
        out[T_OBJECT, _AT["bias"]] = 1.0
        out[T_OBJECT, _AT["carry"]] = np.nan_to_num(data.t_ambient[0] - data.t_object[0])
    return out


def _settle(pair: _Pair, v: Array, a: Array, least: float) -> tuple[Mode, Array]:
    """Return the mode of (v, theta) and its a, from the calibration's gripper or from that of ``a``."""
    here, settled = _start(pair, v, a), False
    for _ in range(_ROUNDS):
        k, j = _slopes(pair, here)
        ahead = _expand(pair, here, k, j)
        settled = ahead.promise < _STILL
        if settled or ahead.log_evidence < least:
            break
        there = _step(pair, here, ahead)
        if there is None:
            break
        here = there
    u = here.u + ahead.dv + pair.by_mean @ (pair.covariance @ ahead.a - here.moved)
    covariance = _whole_covariance(pair, ahead, k, j)
    misfit = float(((pair.whitener @ here.left) ** 2).sum())
    mode = Mode(
        u[None], covariance[None], np.array([ahead.log_evidence]), np.array([settled]), np.array([misfit])
    )
    return mode, here.a


def _start(pair: _Pair, v: Array, a: Array) -> _Point:
    here = _point(pair, v, np.zeros(a.size))
    assert here is not None
    there = _point(pair, v, a) if a.any() else None
    return there if there is not None and there.cost < here.cost else here


def _point(pair: _Pair, v: Array, a: Array) -> _Point | None:
    moved = pair.covariance @ a
    stack = _stack(pair.centre + moved[: len(_STACK_NAMES)])
    if stack is None:
        return None
    u = v + pair.by_mean @ moved
    left = np.where(
        pair.data.count[0] > 0, pair.data.y[0] - predict(stack, pair.nodes, pair.data, u[None])[0], 0.0
    )
    cost = float(((pair.whitener @ left) ** 2).sum()) + float(_penalty(pair, v)[0].sum()) + float(a @ moved)
    return _Point(v, a, moved, u, stack, left, cost)


def _penalty(pair: _Pair, v: Array) -> tuple[Array, Array, Array, Array]:
    """Return -2 ln prior density of each nuisance, relative to its peak, and by (v - mean) / sd, halved, its
    slope, a curvature that bounds it, and the curvature itself, (7,) each.
    """
    sd, nu = pair.prior.sd[0], pair.dof
    vary, heavy = sd > 0, np.isfinite(nu)
    w = np.where(vary, v - pair.prior.mean[0], 0.0) / np.where(vary, sd, 1.0)
    n = np.where(heavy, nu, 1.0)
    value = np.where(heavy, (n + 1) * np.log1p(w**2 / n), w**2)
    slope = np.where(heavy, (n + 1) * w / (n + w**2), w)
    bound = np.where(heavy, (n + 1) / (n + w**2), 1.0)
    own = np.where(heavy, np.maximum((n + 1) * (n - w**2) / (n + w**2) ** 2, 1e-3), 1.0)
    return value, slope, np.where(vary, bound, 1.0), np.where(vary, own, 1.0)


def _expand(pair: _Pair, here: _Point, k: Array, j: Array) -> _Expansion:
    """Return the solution of the problem that is linear in v and theta around a guess."""
    sd = pair.prior.sd[0]
    value, slope, bound, own = _penalty(pair, here.v)
    chol = np.linalg.cholesky(pair.noise + k @ pair.covariance @ k.T)
    white = dtrtrs(chol, np.column_stack([j * sd, here.left + k @ here.moved]), lower=1)[0]
    jw, rest = white[:, :-1], white[:, -1]
    square = jw.T @ jw
    dw = dpotrs(_factor(square + np.diag(bound)), jw.T @ rest - slope, lower=1)[0]
    after = rest - jw @ dw
    cost = float(after @ after + value.sum() + 2 * slope @ dw + dw @ (bound * dw))
    curved = _factor(square + np.diag(own))
    log_det = float(np.log(np.diagonal(chol)).sum() + np.log(np.diagonal(curved)).sum())
    evidence = pair.constant - 0.5 * cost - log_det
    a = k.T @ dtrtrs(chol, after, lower=1, trans=1)[0]
    return _Expansion(sd * dw, a, here.cost - cost, evidence, curved, np.asarray(chol))


def _factor(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a curvature.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite, or not finite.
    """
    low, info = dpotrf(matrix, lower=1)
    # not every LAPACK notices a NaN
    if info != 0 or not np.isfinite(np.diagonal(low)).all():
        raise np.linalg.LinAlgError("the curvature of a grasp's posterior is not positive definite")
    return np.asarray(low)


def _step(pair: _Pair, here: _Point, ahead: _Expansion) -> _Point | None:
    """Return the point there, or on the way, where the density is higher; None if there is none."""
    part = 1.0
    for _ in range(6):
        there = _point(pair, here.v + part * ahead.dv, here.a + part * (ahead.a - here.a))
        if there is not None and there.cost < here.cost:
            return there
        part *= 0.4
    return None


def _whole_covariance(pair: _Pair, ahead: _Expansion, k: Array, j: Array) -> Array:
    """Return the covariance of u = v + M (theta - t0), (7, 7)."""
    p, sd = pair.covariance, pair.prior.sd[0]
    lower = dpotri(ahead.curved, lower=1)[0]
    known = (np.tril(lower) + np.tril(lower, -1).T) * sd[:, None] * sd[None, :]
    gain = dpotrs(ahead.chol, k @ p, lower=1)[0].T
    turn = np.eye(N_NUISANCE) - pair.by_mean @ gain @ j
    left = pair.by_mean @ (p - gain @ k @ p) @ pair.by_mean.T
    return np.asarray(turn @ known @ turn.T + left)


def _slopes(pair: _Pair, here: _Point) -> tuple[Array, Array]:
    """Return the derivatives of the bin means by theta, (n_bin, n_theta), and by u, (n_bin, 7)."""
    from thermogrip.sysid.contact.bin_means import gripper_responses

    data, u, stack = pair.data, here.u, here.stack
    _, by_u = jacobian(stack, pair.nodes, data, u[None], np.ones((1, u.size), dtype=bool))
    k = by_u[0] @ pair.by_mean
    n = len(_LAYERS)
    layers = np.repeat([[getattr(stack, name) for name in LAYER_NAMES]], n, axis=0)
    layers[np.arange(n), np.arange(n)] *= np.exp(_DIFFERENCE)
    near, base = nearby_modes(stack, layers), stack_modes(stack)
    own = contact_numbers(stack, base)
    contact = np.repeat(own[None], len(_MOVED) + 1, axis=0)
    contact[:n, 0] = near.resistance
    contact[np.arange(n, n + 5), np.arange(1, 6)] += _DIFFERENCE * np.where(_BY_LOGARITHM, own[1:], 1.0)
    lam, face, sensor = (
        np.concatenate([moved, np.repeat(here_[None], len(_CONTACT) + 1, axis=0)])
        for moved, here_ in zip(near[:3], base[:3])
    )
    f = gripper_responses(
        tuple(pair.nodes), lam, face, sensor, contact, u, data.sample_t[0],
        data.sample_bin[0], data.count[0],
    )  # fmt: skip
    by = (f[:-1] - f[-1])[None] / _DIFFERENCE
    rate, way = (float(v[0, 0]) for v in far_rate(stack, data, u[None]))
    total = far_integrals(data, u[None], np.concatenate([by, f[None, -1:]], axis=1))[0][0]
    k[:, _MOVED] = ((u[T_OBJECT] - u[LEVEL]) * by[0] + rate * way * total[:-1]).T
    k[:, _AT["ln_g_far"]] += rate * way * total[-1]
    if np.isfinite(data.t_ambient[0]):
        k[:, _AT["leak"]] = (data.t_ambient[0] - u[LEVEL]) * data.ramp[0]
    there = (data.count[0] > 0)[:, None]
    return k * there, by_u[0] * there
