r"""The density of one grasp's nuisances, and what Laplace's method leaves out of their integral.

With y = X(u) beta + c(u) + noise, beta = (b, T_obj) ~ N(beta0, S) and whitener W, the residual r = W (y - X
beta0 - c) has covariance I + V V', V = W X S^1/2, so

    ln p(y | u) = -1/2 (r' r - r' V (I + V' V)^-1 V' r) - 1/2 ln det(I + V' V) + const.

Four nuisances are left, (ln C, ln h, ln tau_b, t0).  Given ln e, Laplace's method calls their posterior
N(m, Sigma).  That is nearly true of the last three; but of the heat capacity a touch often knows only that it
is not below some value, and a wall on one side of a mode is not normal.  With Sigma = L L', ln C first, and
u = m + L z, z_0 moves ln C and takes the others along as they go with it, so that

    int p(u) du = |L| sum_i dz sum_k w_k p(m + L (z_0i, s_k)) exp(s_k' s_k / 2) (2 pi)^(3/2)

with z_0 on a regular grid, whose sum is exact but for terms of exp(-2 pi^2 / dz^2), and s_k = +-sqrt(3) times
the unit vectors, w_k = 1/6, the rule that is exact for all cubics of three normal variables.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from thermogrip.sysid.effusivity.data import Touches, whiten
from thermogrip.sysid.effusivity.gripper_model import Device
from thermogrip.sysid.effusivity.laplace_approximation import (
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
from thermogrip.sysid.effusivity.priors import free_hypotheses, prior_of

__all__ = ["LN_E_RANGE", "SAMPLED", "MarginalPosterior", "log_integrals"]

Array = NDArray[np.float64]

# On the gripper's scale.  Of solids at room temperature plastic foams have least (expanded polystyrene, 32),
# diamond most (6.3e4, of one isotope 7.7e4); that far from its blocks a calibration's scale is known to 0.30
# and 0.16 in the logarithm, and two of these are left on either side.
LN_E_RANGE = (float(np.log(17.0)), float(np.log(1.1e5)))
SAMPLED = [EFFUSIVITY, H, BUILD, ONSET, CAPACITY]

_REST = np.array([CAPACITY, H, BUILD, ONSET])  # ln C first
_BACK = [1, 2, 3, 0]  # from there to the order of SAMPLED
_FIRST, _STEP = 1.15 * np.arange(-3.0, 4.0), 1.15  # of z_0
_OTHERS = np.sqrt(3.0) * np.concatenate([np.eye(3), -np.eye(3)])
_Z = np.column_stack([np.repeat(_FIRST, 6), np.tile(_OTHERS, (_FIRST.size, 1))])
# of each point, step exp(3/2) / 6; of 2 pi the power 3/2 from here, -2 from the constants of four priors
_LOG_WEIGHT = 1.5 - np.log(6.0) - 0.5 * np.log(2 * np.pi) + np.log(_STEP)


class MarginalPosterior:
    """Log posterior of (ln e, ln h, ln tau_b, t0, ln C), up to a constant, of many points at once.

    Parameters
    ----------
    device : Device
    data : Touches
        One grasp.
    noise : (W, ln det), optional
        What :func:`~thermogrip.sysid.effusivity.data.whiten` gives, where a caller has it.
    """

    n = len(SAMPLED)

    def __init__(self, device: Device, data: Touches, noise: tuple[Array, Array] | None = None) -> None:
        device.require_known("an integral over one grasp's nuisances")
        self.device, self.data = device, data
        whitener, log_det = whiten(data, device.noise) if noise is None else noise
        self.whitener, self.log_det = whitener[0], float(log_det[0])
        self._arguments = gripper_arguments(device.stack, nodes_for(data))
        # of the prior only what depends on ln e is looked up again
        self._prior = prior_of(device, data, free_hypotheses(device, [9.0]))

    def __call__(self, points: Array) -> Array:
        """Return the log posterior (n_point,) at points (n_point, 5); -inf outside the prior's range."""
        points = np.atleast_2d(points)
        inside = (points[:, 0] >= LN_E_RANGE[0]) & (points[:, 0] <= LN_E_RANGE[1])
        value = np.full(points.shape[0], -np.inf)
        if inside.any():
            value[inside] = self._log_posterior(points[inside])
        return value

    def _log_posterior(self, points: Array) -> Array:
        from thermogrip.sysid.effusivity.mode_kernel import marginals

        free, common, data = free_hypotheses(self.device, points[:, 0]), self._prior, self.data
        u = np.repeat(common.mean, points.shape[0], axis=0)
        u[:, SAMPLED] = points
        log_prior = _log_normal(points[:, 1], free.ln_h, free.ln_h_sd)
        ln_length = np.log(self.device.block_length * self.device.depth_share)
        log_prior += _log_normal(points[:, 4], free.ln_rho_c + ln_length, free.ln_rho_c_sd)
        for column, k in ((2, BUILD), (3, ONSET)):
            dof = np.inf if common.dof is None else common.dof[0, k]
            log_prior += _log_student(points[:, column], common.mean[0, k], common.sd[0, k], dof)
        likelihood = marginals(
            *self._arguments, self.device.stack.leak, self.device.stack.g_far, data.sample_t[0],
            data.sample_bin[0], data.count[0], data.t[0], data.y[0], data.ramp[0],
            float(data.t_ambient[0]), self.whitener, float(common.sd[0, LEVEL]),
            np.full(points.shape[0], common.sd[0, T_OBJECT]), u,
        )  # fmt: skip
        return np.asarray(log_prior + likelihood)


def log_integrals(
    device: Device,
    data: Touches,
    x: Array,
    mode: Array,
    covariance: Array,
    *,
    noise: tuple[Array, Array] | None = None,
) -> Array:
    """Return ln p(y | ln e), every nuisance integrated, at effusivities ``x``.

    Parameters
    ----------
    device : Device
    data : Touches
        One grasp.
    x : (n,) ndarray
        Logarithms of effusivities.
    mode, covariance : (n, 7), (n, 7, 7) ndarrays
        Of the nuisances there, by Laplace's method: where the sum looks, not what it adds.
    noise : (W, ln det), optional
        As in :class:`MarginalPosterior`.

    Returns
    -------
    log_integral : (n,) ndarray
        To be compared with the ``log_evidence`` of
        :class:`~thermogrip.sysid.effusivity.laplace_approximation.Mode`.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.effusivity.data import touches
    >>> from thermogrip.sysid.effusivity.priors import fit_pairs
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_device
    >>> rig, x = load_default_device(), np.array([9.4, 9.6])
    >>> iron = touches(load_example_grasps()["exp2_dT20"].isel(grasp=[13]))
    >>> mode = fit_pairs(rig, iron, np.array([0, 0]), free_hypotheses(rig, x))
    >>> left_out = log_integrals(rig, iron, x, mode.u, mode.covariance) - mode.log_evidence
    >>> bool(np.abs(left_out).max() < 0.5)
    True
    """
    target = MarginalPosterior(device, data, noise)
    root = np.linalg.cholesky(covariance[:, _REST[:, None], _REST[None, :]])
    rest = mode[:, None, _REST] + np.einsum("nij,kj->nki", root, _Z)
    points = np.column_stack([np.repeat(x, _Z.shape[0]), rest.reshape(-1, 4)[:, _BACK]])
    total = logsumexp(target(points).reshape(x.size, -1), axis=1)
    volume = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(total + volume + _LOG_WEIGHT - 0.5 * target.log_det)


def _log_normal(x: Array, mean: Array, sd: Array) -> Array:
    return np.asarray(-0.5 * ((x - mean) / sd) ** 2 - np.log(sd))


def _log_student(x: Array, mean: float, sd: float, dof: float) -> Array:
    w = (x - mean) / sd
    if np.isinf(dof):
        return np.asarray(-0.5 * w**2 - np.log(sd))
    norm = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(0.5 * dof)
    return np.asarray(norm - 0.5 * (dof + 1) * np.log1p(w**2 / dof) - np.log(sd))
