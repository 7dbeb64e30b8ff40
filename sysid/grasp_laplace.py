"""Evidence of a hypothesis about one grasp: Gauss-Newton to the mode, Laplace's method around it.

A hypothesis (a material, or an effusivity) fixes a Gaussian prior over the seven nuisances of a grasp,

    u = (ln h, ln tau_b, t0, b, T_obj, ln e, ln C),

and predicts the bin means f(u).  With the whitener W of the noise and u = mean + sd w the objective is
``|W (y - f)|^2 + |w|^2``, its Gauss-Newton matrix A = I + J' J, and

    ln Z = -1/2 objective - 1/2 ln det A - 1/2 ln det(2 pi C).

b and T_obj enter f linearly, so for them Laplace's method is exact marginalisation; the others are nearly
Gaussian given them.  A nuisance with sd 0 is known.  Every function works on a batch of (grasp, hypothesis)
pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.grasp_data import Touches
from thermogrip.sysid.grasp_response import Stack, TimeNodes, step_response, time_nodes

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
__all__ += ["find_mode", "jacobian", "nodes_for", "predict"]

Array = NDArray[np.float64]

H, BUILD, ONSET, LEVEL, T_OBJECT, EFFUSIVITY, CAPACITY = range(7)
N_NUISANCE = 7
_LATEST_ONSET = 0.8  # s, either side of the closed message
_LONGEST = 1.5  # step of a logarithm
_DIFFERENCE = 1e-4  # of a logarithm


class Prior(NamedTuple):
    """Mean and standard deviation of u, (n_pair, 7) each."""

    mean: Array
    sd: Array


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


def _bins(stack: Stack, nodes: TimeNodes, data: Touches, u: Array) -> tuple[Array, Array]:
    from thermogrip.sysid.grasp_kernel import bin_means

    rise, slope, _ = step_response(
        stack,
        nodes,
        effusivity=np.exp(u[:, EFFUSIVITY]),
        capacity=np.exp(u[:, CAPACITY]),
        h_c=np.exp(u[:, H]),
        build=np.exp(u[:, BUILD]),
    )
    onset = np.clip(u[:, ONSET], -_LATEST_ONSET, _LATEST_ONSET)
    value, rate = bin_means(nodes.t, rise, slope, onset, data.sample_t, data.sample_bin, data.y.shape[1])
    return value, rate


def _reading(stack: Stack, data: Touches, u: Array, f: Array) -> Array:
    level, t_object = u[:, LEVEL, None], u[:, T_OBJECT, None]
    room = np.where(np.isfinite(data.t_ambient)[:, None], data.t_ambient[:, None], level)
    return level + (t_object - level) * f + stack.leak * (room - level) * data.ramp


def predict(stack: Stack, nodes: TimeNodes, data: Touches, u: Array) -> Array:
    """Return the bin means that nuisances u (n_pair, 7) predict, (n_pair, n_bin) [degC]."""
    return _reading(stack, data, u, _bins(stack, nodes, data, u)[0])


def jacobian(
    stack: Stack, nodes: TimeNodes, data: Touches, u: Array, vary: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return the prediction (n_pair, n_bin) and its derivatives by u, (n_pair, n_bin, 7), zero where not
    ``vary``.

    ``vary`` (n_pair, 7) says which nuisances are unknown.  Level, temperature and onset are analytic, the
    others forward differences of a smooth simulation.
    """
    f, rate = _bins(stack, nodes, data, u)
    y = _reading(stack, data, u, f)
    slopes = np.zeros((*y.shape, N_NUISANCE))
    difference = (u[:, T_OBJECT] - u[:, LEVEL])[:, None]
    slopes[:, :, ONSET] = -difference * rate
    slopes[:, :, T_OBJECT] = f
    known_room = np.isfinite(data.t_ambient)[:, None]
    slopes[:, :, LEVEL] = 1 - f - stack.leak * data.ramp * known_room
    for k in (H, BUILD, EFFUSIVITY, CAPACITY):
        rows = np.flatnonzero(vary[:, k])
        if rows.size:
            moved = u[rows].copy()
            moved[:, k] += _DIFFERENCE
            f_moved = _bins(stack, nodes, data.take(rows), moved)[0]
            slopes[rows, :, k] = difference[rows] * (f_moved - f[rows]) / _DIFFERENCE
    return y, slopes * vary[:, None, :]


def find_mode(
    stack: Stack,
    data: Touches,
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
        One row a pair.
    whitener : (W, ln det)
        As :func:`~thermogrip.sysid.grasp_data.whiten` gives them, rows as in ``data``.
    prior : Prior
    start : (n_pair, 7) ndarray, optional
        Where to start; default the prior's mean, with the level as measured.
    max_steps : int, optional
        A pair that has not settled by then is reported in ``converged``; such a hypothesis is hopeless in
        practice.
    """
    nodes = nodes_for(data)
    w_matrix, log_det = whitener
    vary = prior.sd > 0
    sd = np.where(vary, prior.sd, 1.0)
    u = prior.mean.copy() if start is None else np.where(vary, start, prior.mean)
    if start is None:
        u[:, LEVEL] = np.where(vary[:, LEVEL], data.level, u[:, LEVEL])
    state = _evaluate(stack, nodes, data, w_matrix, prior, sd, vary, u)
    damping = np.full(u.shape[0], 1e-3)
    active = np.ones(u.shape[0], dtype=bool)
    for _ in range(max_steps):
        rows = np.flatnonzero(active)
        step = _solve(state, rows, damping)
        logs = np.abs(step * sd[rows] * vary[rows])[:, [H, BUILD, EFFUSIVITY, CAPACITY]].max(axis=1)
        step *= np.minimum(1.0, _LONGEST / np.maximum(logs, 1e-300))[:, None]
        trial_u = u[rows] + step * sd[rows] * vary[rows]
        part = _evaluate(
            stack, nodes, data.take(rows), w_matrix[rows], Prior(prior.mean[rows], prior.sd[rows]), sd[rows],
            vary[rows], trial_u,
        )  # fmt: skip
        gain = state.objective[rows] - part.objective
        better = gain > 0
        took = rows[better]
        u[took] = trial_u[better]
        for whole, new in zip(state, part, strict=True):
            whole[took] = new[better]
        damping[rows] = np.clip(damping[rows] * np.where(better, 0.1, 10.0), 1e-9, 1e9)
        # a step that is refused at tiny length is the end too
        small = np.abs(step).max(axis=1) < 1e-6
        active[rows[(better & (gain < 1e-5)) | small]] = False
        if not active.any():
            break
    matrix = np.eye(N_NUISANCE) + state.matrix
    covariance = np.linalg.inv(matrix) * sd[:, :, None] * sd[:, None, :] * vary[:, :, None] * vary[:, None, :]
    evidence = -0.5 * (state.objective + np.linalg.slogdet(matrix)[1] + log_det)
    return Mode(u, covariance, evidence, ~active, state.misfit)


class _State(NamedTuple):
    objective: Array
    misfit: Array
    matrix: Array  # J' J in units of the prior's sd
    gradient: Array


def _evaluate(
    stack: Stack, nodes: TimeNodes, data: Touches, w_matrix: Array, prior: Prior, sd: Array,
    vary: NDArray[np.bool_], u: Array,
) -> _State:  # fmt: skip
    y, slopes = jacobian(stack, nodes, data, u, vary)
    residual = np.einsum("nij,nj->ni", w_matrix, data.y - y)
    j = w_matrix @ (slopes * sd[:, None, :])
    w = np.where(vary, (u - prior.mean) / sd, 0.0)
    misfit = (residual**2).sum(axis=1)
    gradient = np.einsum("nik,ni->nk", j, residual) - w
    return _State(misfit + (w**2).sum(axis=1), misfit, j.transpose(0, 2, 1) @ j, gradient)


def _solve(state: _State, rows: NDArray[np.int64], damping: Array) -> Array:
    matrix = np.eye(N_NUISANCE) + state.matrix[rows]
    at = np.arange(N_NUISANCE)
    matrix[:, at, at] *= 1 + damping[rows, None]
    return np.asarray(np.linalg.solve(matrix, state.gradient[rows][:, :, None])[:, :, 0])
