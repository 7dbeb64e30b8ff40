"""The posterior of one grasp as a function to sample: five unknowns, two temperatures marginalised exactly.

With y = X(u) beta + c(u) + noise, beta = (b, T_obj) ~ N(beta0, S) and whitener W, the residual r = W (y - X
beta0 - c) has covariance I + V V', V = W X S^1/2, so

    ln p(y | u) = -1/2 (r' r - r' V (I + V' V)^-1 V' r) - 1/2 ln det(I + V' V) + const.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.effusivity_grid import LN_E_RANGE
from thermogrip.sysid.grasp_data import Touches, whiten
from thermogrip.sysid.grasp_hypotheses import free_hypotheses, prior_of
from thermogrip.sysid.grasp_laplace import (
    BUILD,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    ONSET,
    T_OBJECT,
    H,
    jacobian,
    nodes_for,
)
from thermogrip.sysid.gripper_device import Device

__all__ = ["MarginalPosterior", "starting_walkers"]

Array = NDArray[np.float64]

_SAMPLED = [EFFUSIVITY, H, BUILD, ONSET, CAPACITY]


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
        self.device, self.data, self.nodes = device, data, nodes_for(data)
        self.whitener = whiten(data, device.noise)[0][0]

    def __call__(self, points: Array) -> Array:
        """Return the log posterior (n_point,) at points (n_point, 5); -inf outside the prior's range."""
        points = np.atleast_2d(points)
        inside = (points[:, 0] > LN_E_RANGE[0]) & (points[:, 0] < LN_E_RANGE[1])
        value = np.full(points.shape[0], -np.inf)
        if inside.any():
            value[inside] = self._log_posterior(points[inside])
        return value

    def _log_posterior(self, points: Array) -> Array:
        data = self.data.take(np.zeros(points.shape[0], dtype=np.int64))
        prior = prior_of(self.device, data, free_hypotheses(self.device, points[:, 0]))
        u = prior.mean.copy()
        u[:, _SAMPLED] = points
        offset = (u - prior.mean)[:, _SAMPLED[1:]] / prior.sd[:, _SAMPLED[1:]]
        log_prior = -0.5 * (offset**2).sum(axis=1) - np.log(prior.sd[:, _SAMPLED[1:]]).sum(axis=1)
        y, slopes = jacobian(self.device.stack, self.nodes, data, u, _linear(u))
        residual = (data.y - y) @ self.whitener.T
        linear = slopes[:, :, [LEVEL, T_OBJECT]] * prior.sd[:, None, [LEVEL, T_OBJECT]]
        v = np.einsum("ij,njk->nik", self.whitener, linear)
        matrix = np.eye(2) + v.transpose(0, 2, 1) @ v
        projected = np.einsum("nik,ni->nk", v, residual)
        solved = np.linalg.solve(matrix, projected[:, :, None])[:, :, 0]
        square = (residual**2).sum(axis=1) - (projected * solved).sum(axis=1)
        return np.asarray(log_prior - 0.5 * square - 0.5 * np.linalg.slogdet(matrix)[1])


def _linear(u: Array) -> NDArray[np.bool_]:
    """Return a mask of the two temperatures, whose derivatives cost no simulation."""
    mask = np.zeros(u.shape, dtype=bool)
    mask[:, [LEVEL, T_OBJECT]] = True
    return mask


def starting_walkers(device: Device, data: Touches, walkers: int, rng: np.random.Generator) -> Array:
    """Return starting points (walkers, 5): the grid's posterior in ln e, the prior in the rest."""
    from thermogrip.sysid.effusivity_grid import grid_posteriors

    posterior = grid_posteriors(device, data)[0]
    x = rng.choice(posterior.x, size=walkers, p=posterior.mass)
    touched = data.take(np.zeros(walkers, dtype=np.int64))
    prior = prior_of(device, touched, free_hypotheses(device, x))
    points = prior.mean[:, _SAMPLED] + 0.3 * prior.sd[:, _SAMPLED] * rng.standard_normal(
        (walkers, len(_SAMPLED))
    )
    points[:, 0] = x + 1e-3 * rng.standard_normal(walkers)
    return np.asarray(points)
