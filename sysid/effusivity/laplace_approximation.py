"""Evidence of a hypothesis about one grasp: Gauss-Newton to the mode, Laplace's method around it.

A hypothesis (a material, or an effusivity) fixes a Gaussian prior over the seven nuisances of a grasp,

    u = (ln h, ln tau_b, t0, b, T_obj, ln e, ln C),

and predicts the bin means f(u).  With the whitener W of the noise and u = mean + sd w the objective is
``|W (y - f)|^2 + |w|^2``, its Gauss-Newton matrix A = I + J' J, and

    ln Z = -1/2 objective - 1/2 ln det A - 1/2 ln det(2 pi C).

A nuisance whose spread was learnt from few grasps has Student's t as its prior instead of a normal one: the
sum of (nu + 1) ln(1 + w^2 / nu) replaces its w^2, the density's own curvature its 1 in A, and ln Z gains the
ratio of the two peaks.  b and T_obj enter f linearly, so for them Laplace's method is exact
marginalisation; the others are nearly Gaussian given them.  A nuisance with sd 0 is known.  Every function
works on a batch of (grasp, hypothesis) pairs.

What a hypothesis expects before the data
-----------------------------------------

- A **material with training grasps**: its block's ln h and ln e as calibrated, with the spread from grasp to
  grasp.
- **Another block** of such a material (``finish="unknown"``): ln h is 0.4 off, as much as ground faces of one
  metal whose roughness is a factor of 1.5 apart (between 0.25 and 2.5 um conductance changes fivefold), ln e
  by the table's uncertainty of the material and 5 % of composition.
- A **material of the library**: its effusivity on the gripper's scale, with the row's uncertainty, on a block
  of unknown contact conductance.
- A **free effusivity**: a point of ln e, unknown contact conductance, rho c_p of solids in general (3.2
  MJ/m^3K for metals, 1.7 for insulators).

What comes from the gripper and the nominal temperature (build-up time, onset, object temperature) is common
to all of them.

Somebody stated the nominal temperature, and blocks are mistaken, or not at rest: one in twenty is three times
as far off as the training's were (Tukey's contaminated normal).  T_obj enters linearly, so the readings' own
say, the ratio of its posterior and prior, gives mode and evidence under the wider prior too, and the answer
is the mixture (:func:`doubted`).

Uncertain grippers
------------------

A calibration leaves theta (:mod:`thermogrip.sysid.effusivity.gripper_model`) with a covariance P.  theta
moves the response, and the prior means of the nuisances: u = v + M (theta - t0), with v as it was for the
gripper t0.  With J = df/du and K = df/dtheta, the latter along with u, the prediction around a guess (v, t)
is f + J dv + K dtheta, and theta ~ N(t0, P) makes the data a problem in v alone, with more noise and shifted
readings:

    y - f + K (t - t0) = J dv + noise,   cov(noise) = C + K P K' = S.

Its solution in dv gives the next guess of theta, t0 + P a with

    a = K' S^-1 [y - f + K (t - t0) - J dv],

until the joint density of (v, theta) grows no more.  That is Gauss-Newton for both together, and the evidence
at its end is Laplace's for both.  Every hypothesis finds a gripper of its own, and starts from that of the
likeliest one, through a, which unlike theta does not depend on the block.  One that is 20 nats behind is left
there, unsettled.

Where the block is not of the calibration its effusivity is on the scale that the calibration's blocks
define, so P is taken given theirs; the scale's own uncertainty is added where effusivities are reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs
from scipy.special import gammaln

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.materials import Material, find_material
from thermogrip.sysid.contact.simulation import (
    LAYER_NAMES,
    Stack,
    TimeNodes,
    contact_numbers,
    gripper_modes,
    nearby_modes,
    stack_modes,
    time_nodes,
)
from thermogrip.sysid.effusivity.data import Touches, Whitened, noise_covariance, whiten, whiteners
from thermogrip.sysid.effusivity.gripper_model import (
    INSULATOR,
    LEVEL_SD,
    SHARED_NAMES,
    UNKNOWN_OBJECT_SD,
    GripperModel,
    stack_numbers,
    stack_of,
)

H, BUILD_UP, ONSET, LEVEL, T_OBJECT, EFFUSIVITY, CAPACITY = range(7)
N_NUISANCE = 7
_EARLIEST_ONSET = 1.5  # s before the closed message
SENSORS_APART = 0.3  # K: two thermistors of 1 %
_DOF, _COUNTS, _GAIN_SD = 20.0, 2.0, 0.1
_ALIKE_SD = 1.0  # K
# Tukey's contaminated normal: one stated temperature of an object in twenty is three times as far off
SLIPS, _SLIP = 0.05, 3.0
_TELLING = 0.5  # of the prior variance of the temperature: readings that leave more do not tell a slip
_FINISH_SD, _GRADE_SD = 0.4, 0.05  # between blocks of one material: of ln h, and of ln e beside the table's


class Prior(NamedTuple):
    """Mean and sd of u, (n_pair, 7) each; where ``dof`` (n_pair, 7) is given and finite, Student's t with so
    many degrees of freedom and scale ``sd``: a spread estimated from few grasps is itself uncertain."""

    mean: Array
    sd: Array
    dof: Array | None = None


class Mode(NamedTuple):
    """Where Gauss-Newton ended, a row a pair."""

    u: Array  # (n, 7)
    covariance: Array  # (n, 7, 7), of u
    log_evidence: Array  # (n,)
    converged: Mask  # (n,)
    misfit: Array  # (n,), |W (y - f)|^2


def nodes_for(data: Touches) -> TimeNodes:
    """Return the time nodes that reach the last sample of an early contact."""
    return time_nodes(data.tabled or data.end + _EARLIEST_ONSET)


def predict(stack: Stack, nodes: TimeNodes, data: Touches, u: Array, beyond: Array | None = None) -> Array:
    """Return the bin means that nuisances u (n_pair, 7) predict, (n_pair, n_bin) [degC]."""
    return jacobian(stack, nodes, data, u, np.zeros(u.shape, dtype=bool), beyond)[0]


def jacobian(
    stack: Stack, nodes: TimeNodes, data: Touches, u: Array, vary: Mask, beyond: Array | None = None
) -> tuple[Array, Array]:
    """Return the prediction (n_pair, n_bin) and its derivatives by u, (n_pair, n_bin, 7), zero where not
    ``vary`` (n_pair, 7), the unknown nuisances; ``beyond`` (n_pair, 2, n_bin) the gripper's discrepancy."""
    from thermogrip.sysid.effusivity.mode_kernel import readings

    y, slopes = readings(pairs_asked(stack, nodes, data, np.arange(len(u)), beyond), u, vary)
    return y, slopes[:, :, :N_NUISANCE]


def pairs_asked(
    stack: Stack, nodes: TimeNodes, data: Touches, row: NDArray[np.int64], beyond: Array | None, *,
    tabled: bool = False,
) -> Any:  # fmt: skip
    """Return the pairs of some rows and a gripper as the search takes them, their responses ``tabled``
    (:mod:`thermogrip.sysid.contact.response_table`) or stepped."""
    from thermogrip.sysid.contact.response_table import response_table
    from thermogrip.sysid.effusivity.mode_kernel import Asked

    shape = (row.size, 2, data.y.shape[1])
    # a copy in C order: for other kinds of arrays kernels are compiled anew
    nothing = np.zeros(shape) if beyond is None else np.array(np.broadcast_to(beyond, shape), order="C")
    table = response_table(stack, data.tabled) if tabled and data.tabled else None
    return Asked(nodes, gripper_modes(stack), data, row, nothing, table)


def find_modes(
    stack: Stack, data: Touches, row: NDArray[np.int64], whitener: Whitened, prior: Prior, *,
    start: Array | None = None, max_steps: int = 20, beyond: Array | None = None, rivals: bool = False,
) -> Mode:  # fmt: skip
    """Return mode, covariance and log evidence of every pair by damped Gauss-Newton.

    Pair p is touch ``row[p]`` under row p of ``prior``; ``whitener`` is what
    :func:`~thermogrip.sysid.effusivity.data.whiten` returns for ``data``.  It starts at the prior's mean with
    the level as measured, or at ``start`` (n_pair, 7); a pair that has not settled within ``max_steps`` is
    hopeless in practice, and where pairs of one touch are ``rivals`` one far behind the best is left early.
    """
    from thermogrip.sysid.effusivity.mode_kernel import modes

    vary = prior.sd > 0
    u = prior.mean.copy() if start is None else np.where(vary, start, prior.mean)
    if start is None:
        u[:, LEVEL] = np.where(vary[:, LEVEL], data.level[row], u[:, LEVEL])
    dof = np.full(u.shape, np.inf) if prior.dof is None else prior.dof
    w_matrix, log_det = whitener
    asked, law = (
        pairs_asked(stack, nodes_for(data), data, row, beyond, tabled=True),
        np.stack([prior.mean, prior.sd, dof], axis=1),
    )
    covariance, objective, misfit, settled = modes(asked, w_matrix, law, u, max_steps, rivals=rivals)
    evidence = -0.5 * (objective + log_det[row]) + peak_ratio(dof, vary)
    return Mode(u, covariance, evidence, settled, misfit)


def peak_ratio(dof: Array, vary: Mask) -> Array:
    """Return the log of Student's peak density over the normal one of the same scale, summed, (n_pair,)."""
    heavy = vary & np.isfinite(dof)
    nu = np.where(heavy, dof, 1.0)
    ratio = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu)
    return np.asarray(np.where(heavy, ratio, 0.0).sum(axis=1))


_AT = {name: i for i, name in enumerate((*SHARED_NAMES, "ln_h", "ln_e"))}
_ROUNDS = 8
_STILL = 0.5  # of -2 ln density: a smaller predicted decrease ends the search
_HOPELESS = 20.0  # nats behind the likeliest
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
    beyond: Array  # (1, 2, n_bin)


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
    """The solution around a guess: step of v, new a, predicted decrease, evidence, and factors at its end."""

    dv: Array
    a: Array
    decrease: float
    log_evidence: float
    curved: Array  # (7, 7), Cholesky factor of the curvature in units of the prior's sd
    chol: Array  # that of S


def uncertain_gripper_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], whitener: tuple[Array, Array], prior: Prior,
    block: NDArray[np.int64], *, start: Array | None = None, max_steps: int = 20,
) -> Mode:  # fmt: skip
    """Return mode, covariance and log evidence of every pair, the gripper's parameters integrated over.

    As :func:`find_modes`; ``block`` (n_pair,) is the place in ``gripper.materials`` of a hypothesis' block,
    -1 for others.  ``u`` and its covariance are for the gripper that each hypothesis found.
    """
    beyond = gripper.beyond(data.take(row).t, prior.mean[:, EFFUSIVITY])
    first = find_modes(
        gripper.stack, data, row, whitener, prior, start=start, max_steps=max_steps, beyond=beyond
    )
    pairs = _pairs(gripper, data, row, whitener, prior, block)
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
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], whitener: tuple[Array, Array], prior: Prior,
    block: NDArray[np.int64],
) -> list[_Pair]:  # fmt: skip
    own = np.array([gripper.blocks[gripper.materials[b]].ln_h_sd if b >= 0 else 0.0 for b in block])
    sd = prior.sd.copy()
    # how well the block's mean is known is in the covariance
    sd[:, H] = np.sqrt(np.maximum(sd[:, H] ** 2 - own**2, 1e-12))
    covariance = {b: _covariance(gripper, b) for b in set(block.tolist())}
    noise, nodes = noise_covariance(data, gripper.noise), nodes_for(data)
    centre = stack_numbers(gripper.stack)
    dof = np.full(sd.shape, np.inf) if prior.dof is None else prior.dof
    there = (data.count > 0).sum(axis=1)
    constant = peak_ratio(dof, sd > 0) - 0.5 * np.log(2 * np.pi) * there[row]
    out = []
    for i, r in enumerate(row.tolist()):
        own_prior = Prior(prior.mean[i : i + 1], sd[i : i + 1])
        one = data.take(np.array([r]))
        known = covariance[int(block[i])], centre, _mean_slopes(one), float(constant[i])
        beyond = gripper.beyond(one.t, own_prior.mean[:, EFFUSIVITY])
        out.append(_Pair(one, nodes, whitener[0][r], noise[r], own_prior, dof[i], *known, beyond))
    return out


def _covariance(gripper: GripperModel, block: int) -> Array:
    """Return P of the shared numbers and of the block's ln h and ln e, (n_theta, n_theta)."""
    assert gripper.uncertainty is not None
    names, full = gripper.uncertainty.names, gripper.uncertainty.covariance
    pick = np.zeros((len(_AT), len(names)))
    for name in SHARED_NAMES:
        pick[_AT[name], names.index(name)] = 1.0
    if block >= 0:
        label = gripper.materials[block]
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


def _mean_slopes(data: Touches) -> Array:
    """Return the derivative of the prior mean of one touch's u by theta, (7, n_theta)."""
    known = bool(np.isfinite(data.t_object[0]))
    out = np.zeros((N_NUISANCE, len(_AT)))
    for k, name in ((BUILD_UP, "ln_build_up"), (ONSET, "onset"), (CAPACITY, "ln_depth"), (H, "ln_h")):
        out[k, _AT[name]] = 1.0
    out[EFFUSIVITY, _AT["ln_e"]] = 1.0
    if known:
        out[T_OBJECT, _AT["bias"]] = 1.0
        out[T_OBJECT, _AT["transit_loss"]] = np.nan_to_num(data.t_ambient[0] - data.t_object[0])
    return out


def _settle(pair: _Pair, v: Array, a: Array, least: float) -> tuple[Mode, Array]:
    """Return the mode of (v, theta) and its a, from the calibration's gripper or from that of ``a``."""
    here, settled, before = _start(pair, v, a), False, -np.inf
    for i in range(_ROUNDS):
        k, j = _slopes(pair, here)
        ahead = _expand(pair, here, k, j)
        settled = ahead.decrease < _STILL
        # far from the guess a first round says little, so that what is behind is left where it gains little
        gain, before = ahead.log_evidence - before, ahead.log_evidence
        if settled or ahead.log_evidence + gain * (_ROUNDS - i) < least:
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
    try:
        stack = stack_of(pair.centre + moved[: pair.centre.size])
    except ValueError:
        return None
    u = v + pair.by_mean @ moved
    left = np.where(
        pair.data.count[0] > 0,
        pair.data.y[0] - predict(stack, pair.nodes, pair.data, u[None], pair.beyond)[0], 0.0,
    )  # fmt: skip
    cost = float(((pair.whitener @ left) ** 2).sum()) + _penalty(pair, v)[0] + float(a @ moved)
    return _Point(v, a, moved, u, stack, left, cost)


def _penalty(pair: _Pair, v: Array) -> tuple[float, Array, Array, Array]:
    """Return the prior's -2 ln density, its slopes, bounds of the curvatures and these, (7,) each."""
    from thermogrip.sysid.effusivity.mode_kernel import penalty

    value, *parts = penalty(v[None], pair.prior.mean, pair.prior.sd, pair.dof[None])
    return float(value[0]), parts[0][0], parts[1][0], parts[2][0]


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
    cost = float(after @ after + value + 2 * slope @ dw + dw @ (bound * dw))
    curved = _factor(square + np.diag(own))
    log_det = float(np.log(np.diagonal(chol)).sum() + np.log(np.diagonal(curved)).sum())
    evidence = pair.constant - 0.5 * cost - log_det
    a = k.T @ dtrtrs(chol, after, lower=1, trans=1)[0]
    return _Expansion(sd * dw, a, here.cost - cost, evidence, curved, np.asarray(chol))


def _factor(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a curvature."""
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
    from thermogrip.sysid.contact.time_stepping import grippers
    from thermogrip.sysid.effusivity.mode_kernel import readings

    data, u, stack = pair.data, here.u, here.stack
    n = len(_LAYERS)
    layers = np.repeat([[getattr(stack, name) for name in LAYER_NAMES]], n, axis=0)
    layers[np.arange(n), np.arange(n)] *= np.exp(_DIFFERENCE)
    near, base = nearby_modes(stack, layers), stack_modes(stack)
    own = contact_numbers(stack, base)
    contact = np.repeat(own[None], len(_MOVED) + 1, axis=0)
    contact[:n, 0] = near.resistance
    contact[np.arange(n, n + 5), np.arange(1, 6)] += _DIFFERENCE * np.where(_BY_LOGARITHM, own[1:6], 1.0)
    lam, face, sensor = (
        np.concatenate([moved, np.repeat(here_[None], len(_CONTACT) + 1, axis=0)])
        for moved, here_ in zip(near[:3], base[:3])
    )
    asked = pairs_asked(stack, pair.nodes, data, np.zeros(len(contact), dtype=np.int64), pair.beyond)
    asked = asked._replace(gripper=grippers(lam, face, sensor, contact))
    us = np.repeat(u[None], len(contact), axis=0)
    vary = np.zeros(us.shape, dtype=bool)
    vary[-1] = True
    y, slopes = readings(asked, us, vary)
    by_u = slopes[-1, :, :N_NUISANCE]
    k = by_u @ pair.by_mean
    k[:, _MOVED] = ((y[:-1] - y[-1]) / _DIFFERENCE).T
    if np.isfinite(data.t_ambient[0]):
        k[:, _AT["leak"]] = (data.t_ambient[0] - u[LEVEL]) * data.ramp[0]
    there = (data.count[0] > 0)[:, None]
    return k * there, by_u * there


class Hypotheses(NamedTuple):
    """``n`` hypotheses: mean and sd of ln h, of ln e and of ln(rho c_p), (n,) each."""

    ln_h: Array
    ln_h_sd: Array
    ln_e: Array
    ln_e_sd: Array
    ln_rho_c: Array
    ln_rho_c_sd: Array
    ln_h_dof: Array  # degrees of freedom behind the spread of ln h
    ln_e_dof: Array  # and of ln e
    block: Array  # place in ``gripper.materials`` of a block that was calibrated, -1 for others


def material_hypotheses(
    gripper: GripperModel, candidates: Sequence[str | Material], finish: str = "known"
) -> Hypotheses:
    """Return one hypothesis a candidate, in their order."""
    if finish not in ("known", "unknown"):
        raise UserError(f"finish {finish!r} is unknown", hint="use 'known' or 'unknown'")
    names = [c if isinstance(c, str) else c.name for c in candidates]
    if not names:
        raise UserError("no candidate materials", hint="name at least one")
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"candidate {name!r} is named twice", hint="name each once")
    rows = [
        _trained(gripper, name, finish)
        if name in gripper.blocks
        else _untrained(gripper, candidate if isinstance(candidate, Material) else find_material(name))
        for name, candidate in zip(names, candidates)
    ]
    return Hypotheses(*np.array(rows).T)


def free_hypotheses(gripper: GripperModel, ln_e: ArrayLike) -> Hypotheses:
    """Return one hypothesis for each effusivity ln e on the gripper's own scale, h_c unknown."""
    x = np.asarray(ln_e, dtype=float).ravel()
    metal = 1 / (1 + np.exp(-4 * (x - np.log(4500.0))))
    spread = np.full(x.size, gripper.spreads.ln_h_of_blocks)
    return Hypotheses(
        ln_h=gripper.expected_ln_h(x), ln_h_sd=np.hypot(spread, gripper.spreads.ln_h), ln_e=x,
        ln_e_sd=np.zeros(x.size), ln_rho_c=np.log(1.7e6) + metal * np.log(3.2e6 / 1.7e6),
        ln_rho_c_sd=0.4 - 0.2 * metal, ln_h_dof=np.full(x.size, np.inf), ln_e_dof=np.full(x.size, np.inf),
        block=np.full(x.size, -1.0),
    )  # fmt: skip


def prior_of(gripper: GripperModel, data: Touches, hypotheses: Hypotheses) -> Prior:
    """Return the prior of each (touch, hypothesis) pair, row by row; both have n rows."""
    n = data.level.size
    mean, sd = np.empty((n, N_NUISANCE)), np.empty((n, N_NUISANCE))
    dof = np.full((n, N_NUISANCE), np.inf)
    spreads = gripper.spreads
    dof[:, H], dof[:, EFFUSIVITY] = hypotheses.ln_h_dof, hypotheses.ln_e_dof
    dof[:, BUILD_UP] = dof[:, ONSET] = spreads.dof
    mean[:, H], sd[:, H] = hypotheses.ln_h, hypotheses.ln_h_sd
    mean[:, BUILD_UP], sd[:, BUILD_UP] = np.log(gripper.stack.build_up), spreads.ln_build_up
    mean[:, ONSET], sd[:, ONSET] = gripper.onset, spreads.onset
    if (own_blocks := gripper.discrepancy_of(hypotheses.ln_e)) is not None:
        mean[:, ONSET] += own_blocks.onset
    mean[:, LEVEL], sd[:, LEVEL] = data.level, LEVEL_SD
    known = np.isfinite(data.t_object)
    lost = gripper.transit_loss * np.nan_to_num(data.t_ambient - data.t_object)
    room = np.where(np.isfinite(data.t_ambient), data.t_ambient, data.level)
    mean[:, T_OBJECT] = np.where(known, data.t_object + gripper.bias + lost, room)
    # normal, so that it can be integrated exactly: with the variance of Student's t, which has none at two
    # degrees of freedom, of one training grasp a material: then the nominal one counts little
    beyond = max(spreads.dof - 2, 1e-9)
    learnt = min(spreads.t_object * np.sqrt(spreads.dof / beyond), UNKNOWN_OBJECT_SD)
    own = np.where(np.isfinite(data.t_object_sd), data.t_object_sd, learnt)
    if not gripper.uncertain:  # else it is integrated with all the rest
        own = np.hypot(own, gripper.nominal_sd(data.t_ambient - data.t_object))
    sd[:, T_OBJECT] = np.where(known, own, UNKNOWN_OBJECT_SD)
    mean[:, EFFUSIVITY], sd[:, EFFUSIVITY] = hypotheses.ln_e, hypotheses.ln_e_sd
    mean[:, CAPACITY] = hypotheses.ln_rho_c + np.log(gripper.block_length * gripper.depth_share)
    sd[:, CAPACITY] = hypotheses.ln_rho_c_sd
    return Prior(mean, sd, dof)


def fit_pairs(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, *,
    start: Array | None = None, max_steps: int = 20, noise: Whitened | None = None,
    prior: Prior | None = None, rivals: bool = False,
) -> Mode:  # fmt: skip
    """Return the modes of pairs, hypothesis i against touch ``row[i]``, integrated over an uncertain
    gripper's parameters, a second sensor used; ``noise`` and ``prior`` are
    :func:`~thermogrip.sysid.effusivity.data.whiten` and :func:`prior_of` where a caller has them."""
    prior = prior_of(gripper, data.known(row), hypotheses) if prior is None else prior
    # what else counts may bring another one up
    rivals = rivals and gripper.discrepancy is None and (gripper.second is None or data.second is None)
    mode = _own_modes(gripper, data, row, hypotheses, prior, start, max_steps, noise, rivals)
    mode = with_second(gripper, data, row, hypotheses, prior, mode)
    n = (data.count[row] > 0).sum(axis=1)
    if gripper.second is not None and data.second is not None:
        n = n + (data.second.count[row] > 0).sum(axis=1)
    if gripper.discrepancy is not None:
        mode = widened(mode, prior, n, gripper.bias)
        if gripper.discrepancy.from_room.size:
            unknown = ~np.isfinite(data.t_object[row])
            mode = as_in_training(mode, prior, gripper.discrepancy.from_room, unknown)
    return mode


def with_second(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, prior: Prior,
    mode: Mode,
) -> Mode:  # fmt: skip
    """Return the modes of pairs by the first sensor with what the second one saw, if there is one."""
    second = gripper.second
    if second is None or data.second is None:
        return mode
    beside, own = second_modes(gripper, data, row, hypotheses, mode)
    return joined_modes(mode, prior, beside, own, second.bias - gripper.bias)


def second_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, mode: Mode
) -> tuple[Mode, Prior]:
    """Return the modes of pairs by the second sensor alone, and its prior; ``mode`` is the first one's."""
    assert gripper.second is not None
    assert data.second is not None
    second, others = gripper.second, hypotheses_of_second(gripper, gripper.second, hypotheses)
    own = prior_of(second, data.second.known(row), others)
    begin = own.mean.copy()
    begin[:, LEVEL], begin[:, T_OBJECT] = data.second.level[row], mode.u[:, T_OBJECT]
    return _own_modes(second, data.second, row, others, own, begin, 20, None, False), own


def whitened(gripper: GripperModel, data: Touches) -> Whitened:
    """Return what whitens the first sensor's noise as :func:`fit_pairs` takes it."""
    # of an uncertain gripper each pair has a matrix of its own
    return (whiteners if data.tabled and not gripper.uncertain else whiten)(data, gripper.noise)


def _own_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, prior: Prior,
    start: Array | None, max_steps: int, noise: Whitened | None, rivals: bool,
) -> Mode:  # fmt: skip
    """Return the modes of pairs by the first sensor alone."""
    noise = whitened(gripper, data) if noise is None else noise
    if gripper.uncertain:
        block = hypotheses.block.astype(np.int64)
        return uncertain_gripper_modes(
            gripper, data, row, noise, prior, block, start=start, max_steps=max_steps
        )
    beyond = None if gripper.discrepancy is None else gripper.beyond(data.t[row], prior.mean[:, EFFUSIVITY])
    return find_modes(
        gripper.stack, data, row, noise, prior, start=start, max_steps=max_steps, beyond=beyond, rivals=rivals
    )


def hypotheses_of_second(gripper: GripperModel, second: GripperModel, one: Hypotheses) -> Hypotheses:
    """Return the hypotheses as they stand for the second sensor, on its own scale of effusivities."""
    ln_e = second.found_effusivity(one.ln_e - gripper.effusivity_scale(one.ln_e)[0])
    spread = np.full(ln_e.size, np.hypot(second.spreads.ln_h_of_blocks, second.spreads.ln_h))
    other = [second.expected_ln_h(ln_e), spread, ln_e, *one[3:8], np.full(ln_e.size, -1.0)]
    for i, block in enumerate(one.block.astype(int)):
        name = gripper.materials[block] if block >= 0 else ""
        if name in second.blocks:
            known = "known" if np.isfinite(one.ln_h_dof[i]) else "unknown"
            for column, value in zip(other, _trained(second, name, known)):
                column[i] = value
    return Hypotheses(*other)


def joined_modes(first: Mode, prior: Prior, second: Mode, own: Prior, apart: float) -> Mode:
    r"""Return the modes of one object that two sensors touched, with its temperature x common to both: what
    the second saw of x is its posterior over its prior, a normal likelihood of precision :math:`1/V_2 -
    1/V_{02}`, its thermometer ``apart`` [K] above the first one's, give or take 0.3 K; all else is each
    sensor's own."""
    seen, width = _seen_temperature(second, own)
    off = seen - apart - first.u[:, T_OBJECT]
    variance = first.covariance[:, T_OBJECT, T_OBJECT] + width + SENSORS_APART**2
    evidence = first.log_evidence + second.log_evidence + _log_normal(off, variance)
    evidence -= _log_normal(seen - own.mean[:, T_OBJECT], own.sd[:, T_OBJECT] ** 2 + width)
    settled, misfit = first.converged & second.converged, first.misfit + second.misfit
    column = first.covariance[:, :, T_OBJECT]
    moved = first.covariance - column[:, :, None] * (column / variance[:, None])[:, None, :]
    return Mode(first.u + (off / variance)[:, None] * column, moved, evidence, settled, misfit)


def at_temperature(mode: Mode, prior: Prior, mean: Array, variance: Array) -> Mode:
    """Return the modes of pairs under another prior of the object's temperature, N(mean, variance), (n,)
    each."""
    seen, width = _seen_temperature(mode, prior)
    own = prior.sd[:, T_OBJECT] ** 2
    evidence = mode.log_evidence + _log_normal(seen - mean, variance + width)
    evidence -= _log_normal(seen - prior.mean[:, T_OBJECT], own + width)
    before = mode.covariance[:, T_OBJECT, T_OBJECT]
    after = variance * width / (variance + width)
    column = mode.covariance[:, :, T_OBJECT] / before[:, None]
    moved = (mean * width + seen * variance) / (variance + width) - mode.u[:, T_OBJECT]
    covariance = mode.covariance + (after - before)[:, None, None] * column[:, :, None] * column[:, None, :]
    return mode._replace(
        u=mode.u + moved[:, None] * column, covariance=covariance, log_evidence=np.asarray(evidence)
    )


def temperatures_by_the_other(
    first: Mode, prior: Prior, second: Mode, own: Prior, apart: float
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return mean and variance of the object's temperature as each of two sensors' thermometers shows it, by
    its prior and what the other sensor saw: arguments as of :func:`joined_modes`."""
    x0, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    (seen, width), (other, other_width) = _seen_temperature(first, prior), _seen_temperature(second, own)
    other_width = other_width + SENSORS_APART**2
    by_second = (x0 * other_width + (other - apart) * v0) / (v0 + other_width)
    by_first = (x0 * width + seen * v0) / (v0 + width)
    return (
        (by_second, v0 * other_width / (v0 + other_width)),
        (by_first + apart, v0 * width / (v0 + width) + SENSORS_APART**2),
    )


def widened(mode: Mode, prior: Prior, n: NDArray[np.int64], bias: float) -> Mode:
    r"""Return what a gripper with a discrepancy knows: less than its model says, least where that misfits.

    A grasp's noise is larger or smaller than the others' as the discrepancy was: with a variance of inverse
    gamma distribution, :math:`\nu = 20`, the misfit S of ``n`` readings counts
    :math:`(\nu + n) \ln(1 + S / \nu)` in place of S.  All evidence counts half, since what differs from
    grasp to grasp is not the noise that it is taken for.  The object's temperature is known to a tenth of its
    distance from the skin at best, and to the thermometer's own ``bias`` [K], of which the discrepancy may
    have taken a part.
    """
    evidence = mode.log_evidence + 0.5 * (mode.misfit - (_DOF + n) * np.log1p(mode.misfit / _DOF))
    seen, width = _seen_temperature(mode, prior)
    x0, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    width *= np.maximum(_COUNTS * (_DOF + mode.misfit) / (_DOF + n), 1.0)
    width += (_GAIN_SD * (mode.u[:, T_OBJECT] - mode.u[:, LEVEL])) ** 2 + bias**2
    u, covariance = mode.u.copy(), mode.covariance.copy()
    covariance[:, T_OBJECT, T_OBJECT] = v0 * width / (v0 + width)
    u[:, T_OBJECT] = (x0 * width + seen * v0) / (v0 + width)
    return mode._replace(u=u, covariance=covariance, log_evidence=evidence / _COUNTS)


def as_in_training(mode: Mode, prior: Prior, from_room: Array, unknown: Mask) -> Mode:
    """Return the modes under even odds that an object of unknown temperature is as far from its room as some
    object of the training was, within 1 K, or anywhere in its range."""
    seen, width = _seen_temperature(mode, prior)
    room, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    off, variance = room[:, None] + from_room - seen[:, None], (width + _ALIKE_SD**2)[:, None]
    ratio = _log_normal(off, variance) - _log_normal(seen - room, v0 + width)[:, None]
    each = np.exp(np.clip(ratio, -700.0, 300.0)) / (2 * from_room.size)
    # where it lies: the range's own answer, or that of an object of the training
    weight = np.column_stack([np.full(seen.size, 0.5), each])
    means = seen[:, None] + (width[:, None] / variance) * off
    means = np.column_stack([mode.u[:, T_OBJECT], means])
    within = (width * _ALIKE_SD**2 / (width + _ALIKE_SD**2))[:, None] * np.ones(each.shape)
    within = np.column_stack([mode.covariance[:, T_OBJECT, T_OBJECT], within])
    total = weight.sum(axis=1)
    mean = (weight * means).sum(axis=1) / total
    spread = (weight * (within + (means - mean[:, None]) ** 2)).sum(axis=1) / total
    u, covariance = mode.u.copy(), mode.covariance.copy()
    u[unknown, T_OBJECT] = mean[unknown]
    covariance[unknown, T_OBJECT, T_OBJECT] = spread[unknown]
    evidence = mode.log_evidence + np.where(unknown, np.log(total), 0.0)
    return mode._replace(u=u, covariance=covariance, log_evidence=evidence)


def slip_of(sd: ArrayLike) -> Array:
    """Return how many times as far off as its ``sd`` [K] a stated temperature that is a slip may be: three,
    no farther than one that nobody stated."""
    return np.clip(UNKNOWN_OBJECT_SD / np.asarray(sd), 1.0, _SLIP)


def doubted(gripper: GripperModel, data: Touches, prior: Prior, mode: Mode) -> Mode:
    """Return the modes of pairs, a row of data each, where the stated temperature of an object may be off by
    more than the training's were: with a probability of 0.05 the sd about it is three times its own."""
    off = gripper.nominal_sd(data.t_ambient - data.t_object) if gripper.uncertain else 0.0
    v0 = prior.sd[:, T_OBJECT] ** 2 + np.square(off)
    x0, v = prior.mean[:, T_OBJECT], mode.covariance[:, T_OBJECT, T_OBJECT]
    # beyond what readings know of it the normal distribution around the mode is no guide
    telling = np.isfinite(data.t_object) & (v < _TELLING * v0) & mode.converged
    precision = np.where(telling, 1 / v - 1 / v0, 1.0)
    seen, width = x0 + (mode.u[:, T_OBJECT] - x0) / (v * precision), 1 / precision
    wide = slip_of(np.sqrt(v0)) ** 2 * v0
    ratio = _log_normal(seen - x0, wide + width) - _log_normal(seen - x0, v0 + width)
    slip = np.where(telling, SLIPS * np.exp(np.clip(ratio, -700.0, 300.0)), 0.0)
    total = np.where(telling, 1 - SLIPS, 1.0) + slip
    share, apart = slip / total, (wide * seen + width * x0) / (wide + width) - mode.u[:, T_OBJECT]
    within = share * (wide * width / (wide + width) - v) + share * (1 - share) * apart**2
    # the rest of what is unknown goes along with the temperature
    column = mode.covariance[:, :, T_OBJECT] / v[:, None]
    u = mode.u + column * (share * apart)[:, None]
    covariance = mode.covariance + within[:, None, None] * column[:, :, None] * column[:, None, :]
    return mode._replace(u=u, covariance=covariance, log_evidence=mode.log_evidence + np.log(total))


def _seen_temperature(mode: Mode, prior: Prior) -> tuple[Array, Array]:
    """Return what the readings alone say of T_obj, the ratio of posterior and prior: mean and variance."""
    x0, v = prior.mean[:, T_OBJECT], mode.covariance[:, T_OBJECT, T_OBJECT]
    precision = np.maximum(1 / v - 1 / prior.sd[:, T_OBJECT] ** 2, 1e-9)
    return x0 + (mode.u[:, T_OBJECT] - x0) / (v * precision), 1 / precision


def _log_normal(x: Array, variance: Array) -> Array:
    return np.asarray(-0.5 * (x**2 / variance + np.log(variance)))


def fit_candidates(
    gripper: GripperModel, data: Touches, candidates: Sequence[str | Material], finish: str = "known", *,
    start: Array | None = None,
) -> tuple[Mode, Prior, NDArray[np.int64]]:  # fmt: skip
    """Return modes of every touch under every candidate, (n m,) rows, from nuisances ``start`` (n, m, 7), and
    the prior and the touch of each."""
    one = material_hypotheses(gripper, candidates, finish)
    n, m = data.level.size, len(candidates)
    row = np.repeat(np.arange(n), m)
    hypotheses = Hypotheses(*(np.tile(h, n) for h in one))
    begin = None if start is None else start.reshape(n * m, -1)
    each = data.known(row)
    prior = prior_of(gripper, each, hypotheses)
    mode = fit_pairs(gripper, data, row, hypotheses, start=begin, prior=prior, rivals=True)
    return doubted(gripper, each, prior, mode), prior, row


def _trained(gripper: GripperModel, name: str, finish: str) -> tuple[float, ...]:
    block, spreads, own = gripper.blocks[name], gripper.spreads, finish == "known"
    between = max(_FINISH_SD, spreads.ln_h_of_blocks)
    spread = spreads.ln_h if own else float(np.hypot(between, spreads.ln_h))
    scatter = spreads.ln_effusivity if block.library_effusivity < INSULATOR else 0.0
    composition = 0.0 if own else float(np.hypot(_GRADE_SD, min(block.library_sd_ln, 0.3)))
    return (
        block.ln_h,
        float(np.hypot(spread, block.ln_h_sd)),
        block.ln_effusivity,
        float(np.hypot(scatter, composition)),
        float(np.log(block.heat_capacity)),
        0.0,
        spreads.dof if own else np.inf,
        spreads.insulator_dof if scatter and own else np.inf,
        float(gripper.materials.index(name)),
    )


def _untrained(gripper: GripperModel, row: Material) -> tuple[float, ...]:
    found = float(gripper.found_effusivity(np.log([row.effusivity]))[0])
    scale_sd = gripper.effusivity_scale(np.array([found]))[1]
    scatter = gripper.spreads.ln_effusivity if row.effusivity < INSULATOR else 0.0
    return (
        float(gripper.expected_ln_h(np.array(found))),
        float(np.hypot(gripper.spreads.ln_h_of_blocks, gripper.spreads.ln_h)),
        float(found),
        float(np.sqrt(row.effusivity_sd_ln**2 + float(scale_sd[0]) ** 2 + scatter**2)),
        float(np.log(row.rho * row.c_p)),
        0.05,
        np.inf,
        np.inf,
        -1.0,
    )
