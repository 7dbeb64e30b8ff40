"""The posterior of one grasp as a function to sample: five unknowns, two temperatures marginalised exactly.

With y = X(u) beta + c(u) + noise, beta = (b, T_obj) ~ N(beta0, S) and whitener W, the residual r = W (y - X
beta0 - c) has covariance I + V V', V = W X S^1/2, so

    ln p(y | u) = -1/2 (r' r - r' V (I + V' V)^-1 V' r) - 1/2 ln det(I + V' V) + const.

A sampler is quick where its target is round.  So it walks in coordinates z in which Laplace's method on the
grid says that the posterior is a standard normal,

    x = Q(Phi(z_0)),   (ln h, ln tau_b, t0, ln C) = m(x) + L(x) (z_1, ..., z_4),

Q the quantile function of the grid's posterior of x = ln e, mixed with a little of the prior so that no
effusivity is out of reach, m and L modes and Cholesky factors between the grid's points.  This is a change of
variables: with its Jacobian the density is that of the grasp, and a wrong grid costs time, not truth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr

from thermogrip.sysid.effusivity_grid import LN_E_RANGE, grid_posteriors
from thermogrip.sysid.grasp_data import Touches, whiten
from thermogrip.sysid.grasp_hypotheses import fit_pairs, free_hypotheses, prior_of
from thermogrip.sysid.grasp_laplace import (
    BUILD,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    ONSET,
    T_OBJECT,
    H,
    gripper_arguments,
    nodes_for,
)
from thermogrip.sysid.gripper_device import Device

__all__ = ["MarginalPosterior", "RoundPosterior", "independent_proposal"]

Array = NDArray[np.float64]

_SAMPLED = [EFFUSIVITY, H, BUILD, ONSET, CAPACITY]
_KNOTS = 40
_OF_PRIOR = 0.01  # share of the prior in Q
_TAIL_DOF, _TAIL_SCALE = 6.0, 1.1


class MarginalPosterior:
    """Log posterior of (ln e, ln h, ln tau_b, t0, ln C), up to a constant, of many points at once.

    Parameters
    ----------
    device : Device
    data : Touches
        One grasp.
    """

    n = len(_SAMPLED)

    def __init__(self, device: Device, data: Touches) -> None:
        self.device, self.data = device, data
        self.whitener = whiten(data, device.noise)[0][0]
        self._arguments = gripper_arguments(device.stack, nodes_for(data))
        # of the prior only what depends on ln e is looked up again
        self._prior = prior_of(device, data, free_hypotheses(device, [9.0]))

    def __call__(self, points: Array) -> Array:
        """Return the log posterior (n_point,) at points (n_point, 5); -inf outside the prior's range."""
        points = np.atleast_2d(points)
        inside = (points[:, 0] > LN_E_RANGE[0]) & (points[:, 0] < LN_E_RANGE[1])
        value = np.full(points.shape[0], -np.inf)
        if inside.any():
            value[inside] = self._log_posterior(points[inside])
        return value

    def _log_posterior(self, points: Array) -> Array:
        from thermogrip.sysid.grasp_mode_kernel import marginals

        free, common, data = free_hypotheses(self.device, points[:, 0]), self._prior, self.data
        u = np.repeat(common.mean, points.shape[0], axis=0)
        u[:, _SAMPLED] = points
        log_prior = _log_normal(points[:, 1], free.ln_h, free.ln_h_sd)
        ln_length = np.log(self.device.block_length * self.device.depth_share)
        log_prior += _log_normal(points[:, 4], free.ln_rho_c + ln_length, free.ln_rho_c_sd)
        for column, k in ((2, BUILD), (3, ONSET)):
            dof = np.inf if common.dof is None else common.dof[0, k]
            log_prior += _log_student(points[:, column], common.mean[0, k], common.sd[0, k], dof)
        likelihood = marginals(
            *self._arguments, self.device.stack.leak, data.sample_t[0], data.sample_bin[0], data.count[0],
            data.y[0], data.ramp[0], float(data.t_ambient[0]), self.whitener, float(common.sd[0, LEVEL]),
            np.full(points.shape[0], common.sd[0, T_OBJECT]), u,
        )  # fmt: skip
        return np.asarray(log_prior + likelihood)


class RoundPosterior:
    """The same posterior in coordinates z (n_point, 5) in which it is nearly a standard normal."""

    n = MarginalPosterior.n

    def __init__(self, device: Device, data: Touches) -> None:
        self.target = MarginalPosterior(device, data)
        posterior = grid_posteriors(device, data)[0]
        self.edges, self.cumulative = _quantile_table(posterior.x, posterior.mass)
        inside = np.interp([1e-4, 1 - 1e-4], self.cumulative, self.edges)
        self.knots = np.linspace(inside[0], inside[1], _KNOTS)
        row = np.zeros(_KNOTS, dtype=np.int64)
        mode = fit_pairs(device, data, row, free_hypotheses(device, self.knots))
        rest = np.array(_SAMPLED[1:])
        self.centre = mode.u[:, rest]
        self.root: Array = np.asarray(np.linalg.cholesky(mode.covariance[:, rest[:, None], rest[None, :]]))

    def points(self, z: Array) -> Array:
        """Return (ln e, ln h, ln tau_b, t0, ln C) at z, both (n_point, 5)."""
        return self._carried(np.atleast_2d(z))[0]

    def __call__(self, z: Array) -> Array:
        """Return the log density (n_point,) of z, up to a constant."""
        points, log_volume = self._carried(np.atleast_2d(z))
        return np.asarray(self.target(points) + log_volume)

    def _carried(self, z: Array) -> tuple[Array, Array]:
        share = ndtr(z[:, 0])
        x = np.interp(share, self.cumulative, self.edges)
        cell = np.clip(np.searchsorted(self.cumulative, share) - 1, 0, self.edges.size - 2)
        density = np.diff(self.cumulative)[cell] / np.diff(self.edges)[cell]
        centre, root = _between(x, self.knots, self.centre), _between(x, self.knots, self.root)
        rest = centre + np.einsum("nij,nj->ni", root, z[:, 1:])
        log_volume = -0.5 * z[:, 0] ** 2 - np.log(density)
        log_volume += np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return np.column_stack([x, rest]), log_volume


def independent_proposal(z: Array, rng: np.random.RandomState) -> tuple[Array, Array]:
    """Return points from Student's t, whatever ``z`` (n, 5) is, and the log ratio of proposal densities."""
    new = _TAIL_SCALE * rng.standard_normal(z.shape)
    new *= np.sqrt(_TAIL_DOF / rng.chisquare(_TAIL_DOF, z.shape[0]))[:, None]
    return new, _log_tail(z) - _log_tail(new)


def _log_tail(z: Array) -> Array:
    square = (z**2).sum(axis=1) / _TAIL_SCALE**2
    return np.asarray(-0.5 * (_TAIL_DOF + z.shape[1]) * np.log1p(square / _TAIL_DOF))


def _quantile_table(x: Array, mass: Array) -> tuple[Array, Array]:
    """Return edges over the prior's range and the distribution function at each, strictly increasing."""
    step = x[1] - x[0]
    edges = np.concatenate([[LN_E_RANGE[0]], x - 0.5 * step, [x[-1] + 0.5 * step], [LN_E_RANGE[1]]])
    cumulative = np.concatenate([[0.0, 0.0], np.cumsum(mass), [1.0]])
    order = (edges >= LN_E_RANGE[0]) & (edges <= LN_E_RANGE[1])
    edges, first = np.unique(edges[order], return_index=True)
    uniform = (edges - LN_E_RANGE[0]) / (LN_E_RANGE[1] - LN_E_RANGE[0])
    cumulative = cumulative[order][first]
    cumulative = (cumulative - cumulative[0]) / (cumulative[-1] - cumulative[0])
    return edges, (1 - _OF_PRIOR) * cumulative + _OF_PRIOR * uniform


def _between(x: Array, knots: Array, values: Array) -> Array:
    """Return values (n_knot, ...) at x (n,), linear between knots and constant beyond them."""
    at = np.clip((x - knots[0]) / (knots[1] - knots[0]), 0.0, knots.size - 1.000001)
    k = at.astype(np.int64)
    share = (at - k).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1 - share) * values[k] + share * values[k + 1])


def _log_normal(x: Array, mean: Array, sd: Array) -> Array:
    return np.asarray(-0.5 * ((x - mean) / sd) ** 2 - np.log(sd))


def _log_student(x: Array, mean: float, sd: float, dof: float) -> Array:
    w = (x - mean) / sd
    if np.isinf(dof):
        return np.asarray(-0.5 * w**2 - np.log(sd))
    norm = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(0.5 * dof)
    return np.asarray(norm - 0.5 * (dof + 1) * np.log1p(w**2 / dof) - np.log(sd))
