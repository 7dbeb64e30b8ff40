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
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from thermogrip.sysid.contact.response import Stack, TimeNodes, contact_numbers, stack_modes, time_nodes
from thermogrip.sysid.effusivity.data import Touches

__all__ = [
    "BUILD",
    "CAPACITY",
    "EFFUSIVITY",
    "LEVEL",
    "N_NUISANCE",
    "ONSET",
    "T_OBJECT",
    "H",
    "Mode",
    "Prior",
]
__all__ += ["find_mode", "find_modes", "gripper_arguments", "jacobian", "nodes_for", "peak_ratio", "predict"]

Array = NDArray[np.float64]

H, BUILD, ONSET, LEVEL, T_OBJECT, EFFUSIVITY, CAPACITY = range(7)
N_NUISANCE = 7
_LATEST_ONSET = 0.8  # s, either side of the closed message


class Prior(NamedTuple):
    """Mean and standard deviation of u, (n_pair, 7) each.

    Where ``dof`` (n_pair, 7) is given and finite, the prior is Student's t with so many degrees of freedom
    and ``sd`` as its scale: a spread that few grasps have taught is itself uncertain.
    """

    mean: Array
    sd: Array
    dof: Array | None = None


class Mode(NamedTuple):
    """Where Gauss-Newton ended, a row a pair.

    ``u`` (n, 7); ``covariance`` (n, 7, 7) of u; ``log_evidence`` (n,); ``converged`` (n,); ``misfit`` (n,) is
    |W (y - f)|^2.
    """

    u: Array
    covariance: Array
    log_evidence: Array
    converged: NDArray[np.bool_]
    misfit: Array


def nodes_for(data: Touches) -> TimeNodes:
    """Return the time nodes that reach the last sample of an early contact."""
    return time_nodes(data.end + _LATEST_ONSET)


def predict(stack: Stack, nodes: TimeNodes, data: Touches, u: Array) -> Array:
    """Return the bin means that nuisances u (n_pair, 7) predict, (n_pair, n_bin) [degC]."""
    f = _responses(stack, nodes, data, u, np.zeros(u.shape, dtype=bool))[:, 0]
    return _reading(stack, data, u, f, far_integrals(data, u, f[:, None])[0][:, 0])


def jacobian(
    stack: Stack, nodes: TimeNodes, data: Touches, u: Array, vary: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return the prediction (n_pair, n_bin) and its derivatives by u, (n_pair, n_bin, 7), zero where not
    ``vary``.

    ``vary`` (n_pair, 7) says which nuisances are unknown.
    """
    found = _responses(stack, nodes, data, u, vary)
    f = found[:, 0]
    slopes = np.zeros((*f.shape, N_NUISANCE))
    difference = (u[:, T_OBJECT] - u[:, LEVEL])[:, None]
    rate, way = far_rate(stack, data, u)
    total, value, late = far_integrals(data, u, found)
    slopes[:, :, ONSET] = -difference * found[:, 5] - rate * way * total[:, 5]
    slopes[:, :, T_OBJECT] = f - rate * total[:, 0]
    known_room = np.isfinite(data.t_ambient)[:, None]
    slopes[:, :, LEVEL] = 1 - f - stack.leak * data.ramp * known_room
    for lane, k in enumerate((H, BUILD, EFFUSIVITY, CAPACITY), start=1):
        slopes[:, :, k] = difference * found[:, lane] + rate * way * total[:, lane]
    # a denser or less conducting block passes the loss on later
    later = 2 * late[:, None] * value[:, 0]
    slopes[:, :, EFFUSIVITY] += rate * way * later
    slopes[:, :, CAPACITY] -= rate * way * (later + total[:, 0])
    return _reading(stack, data, u, f, total[:, 0]), slopes * vary[:, None, :]


def find_mode(
    stack: Stack,
    data: Touches,
    whitener: tuple[Array, Array],
    prior: Prior,
    *,
    start: Array | None = None,
    max_steps: int = 20,
) -> Mode:
    """Return mode, covariance and log evidence of every pair; ``data`` and ``whitener`` have a row a pair.

    See :func:`find_modes`.
    """
    row = np.arange(data.level.size)
    return find_modes(stack, data, row, whitener, prior, start=start, max_steps=max_steps)


def find_modes(
    stack: Stack,
    data: Touches,
    row: NDArray[np.int64],
    whitener: tuple[Array, Array],
    prior: Prior,
    *,
    start: Array | None = None,
    max_steps: int = 20,
) -> Mode:
    """Return mode, covariance and log evidence of every pair by damped Gauss-Newton.

    Parameters
    ----------
    stack : Stack
    data : Touches
        ``n`` touches.
    row : (n_pair,) ndarray of int
        The touch of each pair.
    whitener : (W, ln det)
        As :func:`~thermogrip.sysid.effusivity.data.whiten` gives them, rows as in ``data``.
    prior : Prior
        A row a pair.
    start : (n_pair, 7) ndarray, optional
        Where to start; default the prior's mean, with the level as measured.
    max_steps : int, optional
        A pair that has not settled by then is reported in ``converged``; such a hypothesis is hopeless in
        practice.
    """
    from thermogrip.sysid.effusivity.mode_kernel import modes

    vary = prior.sd > 0
    u = prior.mean.copy() if start is None else np.where(vary, start, prior.mean)
    if start is None:
        u[:, LEVEL] = np.where(vary[:, LEVEL], data.level[row], u[:, LEVEL])
    dof = np.full(u.shape, np.inf) if prior.dof is None else prior.dof
    w_matrix, log_det = whitener
    arguments = gripper_arguments(stack, nodes_for(data))
    covariance, objective, misfit, settled = modes(
        *arguments, stack.leak, stack.g_far, row, data.sample_t, data.sample_bin, data.count, data.t, data.y,
        data.ramp, data.t_ambient, w_matrix, np.stack([prior.mean, prior.sd, dof], axis=1), u, max_steps,
    )  # fmt: skip
    evidence = -0.5 * (objective + log_det[row]) + peak_ratio(dof, vary)
    return Mode(u, covariance, evidence, settled > 0, misfit)


def peak_ratio(dof: Array, vary: NDArray[np.bool_]) -> Array:
    """Return the log of Student's peak density over the normal one of the same scale, summed, (n_pair,)."""
    heavy = vary & np.isfinite(dof)
    nu = np.where(heavy, dof, 1.0)
    ratio = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu)
    return np.asarray(np.where(heavy, ratio, 0.0).sum(axis=1))


@lru_cache(maxsize=64)
def _gripper(stack: Stack, steps: tuple[float, ...]) -> Any:
    """Return what is common to all contacts of a gripper: it costs more than one contact."""
    from thermogrip.sysid.contact.march import gripper_of

    found = stack_modes(stack)
    return gripper_of(np.array(steps), found.lam, found.face, found.sensor, contact_numbers(stack, found))


def gripper_arguments(stack: Stack, nodes: TimeNodes) -> tuple[Any, ...]:
    """Return the first arguments of the compiled functions, kept from call to call for each gripper."""
    return tuple(nodes), _gripper(stack, tuple(nodes.dt.tolist()))


def _responses(stack: Stack, nodes: TimeNodes, data: Touches, u: Array, vary: NDArray[np.bool_]) -> Array:
    from thermogrip.sysid.contact.bin_means import binned_responses

    samples = (data.sample_t, data.sample_bin, data.count)
    return np.asarray(
        binned_responses(*gripper_arguments(stack, nodes), np.ascontiguousarray(u), vary, *samples)
    )


def far_rate(stack: Stack, data: Touches, u: Array) -> tuple[Array, Array]:
    """Return the rate at which the block goes to the room [1/s], and how far it has to go [K], (n, 1) each;
    zero where the room is unknown.
    """
    known = np.isfinite(data.t_ambient)
    rate = np.where(known, stack.g_far * np.exp(-u[:, CAPACITY]), 0.0)
    return rate[:, None], np.where(known, data.t_ambient - u[:, T_OBJECT], 0.0)[:, None]


def far_integrals(data: Touches, u: Array, curves: Array) -> Any:
    """Return :func:`~thermogrip.sysid.contact.far_face.delayed_integrals` of curves (n, n_curve, n_bin)."""
    from thermogrip.sysid.contact.far_face import delayed_integrals

    block = (np.ascontiguousarray(u[:, k]) for k in (EFFUSIVITY, CAPACITY))
    return delayed_integrals(data.t, data.count, *block, np.ascontiguousarray(curves))


def _reading(stack: Stack, data: Touches, u: Array, f: Array, total: Array) -> Array:
    level, t_object = u[:, LEVEL, None], u[:, T_OBJECT, None]
    room = np.where(np.isfinite(data.t_ambient)[:, None], data.t_ambient[:, None], level)
    rate, way = far_rate(stack, data, u)
    drift = stack.leak * (room - level) * data.ramp
    return np.asarray(level + (t_object - level) * f + rate * way * total + drift)
