"""Samples of one grasp's posterior by emcee, without Laplace's method or a grid: the engine's check.

Given level and object temperature, which are integrated exactly, five unknowns are left, whose posterior
is curved and, in metals, long.  A sampler is quick where its target is a standard normal, so
it samples in whitened coordinates z, in which Laplace's method on the grid makes the posterior one,

    x = Q(Phi(z_0)),   (ln h, ln tau_b, t0, ln C) = m(x) + L(x) (z_1, ..., z_4),

Q the quantile function of the grid's posterior of x = ln e, mixed with a little of the prior so that no
effusivity is out of reach, m and L modes and Cholesky factors between the grid's points.  This is a change of
variables: with its Jacobian the density is that of the grasp, and a wrong grid costs time, not truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import emcee
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.data import Touches, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    fit_pairs,
    free_hypotheses,
    nodes_for,
    predict,
    prior_of,
)
from thermogrip.sysid.effusivity.posterior_grid import LN_E_RANGE, grid_posteriors

Array = NDArray[np.float64]

_BLOCK = 500  # steps between evaluations of the autocorrelation
_KNOTS = 40
_OF_PRIOR = 0.01  # share of the prior in Q
_TAIL_DOF, _TAIL_SCALE = 6.0, 1.1


@dataclass(frozen=True)
class ChainPosterior:
    """What emcee found for one grasp.

    ``ln_effusivity`` (n_sample,) thinned samples on the gripper's scale; ``quantiles`` 5, 50, 95 % of it;
    ``autocorrelation`` its integrated time [steps]; ``steps`` taken; ``converged`` says whether the chain
    outlasted 50 of them; ``acceptance`` fraction.
    """

    ln_effusivity: Array
    quantiles: tuple[float, float, float]
    autocorrelation: float
    steps: int
    converged: bool
    acceptance: float


SAMPLED = [5, 0, 1, 2, 6]  # of the nuisances: ln e, ln h, ln tau_b, t0, ln C


class MarginalPosterior:
    """Log posterior of (ln e, ln h, ln tau_b, t0, ln C), up to a constant, level and object temperature
    integrated: these enter the readings linearly."""

    def __init__(self, device: GripperModel, data: Touches) -> None:
        self.device, self.data, self.nodes = device, data, nodes_for(data)
        self.whitener = whiten(data, device.noise)[0][0]

    def __call__(self, points: Array) -> Array:
        """Return the log posterior (n_point,) at points (n_point, 5); -inf outside the prior's range."""
        rows = self.data.take(np.zeros(len(points), dtype=np.int64))
        prior = prior_of(self.device, rows, free_hypotheses(self.device, points[:, 0]))
        u = prior.mean.copy()
        u[:, SAMPLED] = points
        y = predict(self.device.stack, self.nodes, rows, u)
        residual, columns = (rows.y - y) @ self.whitener.T, []
        for k in (3, 4):
            moved = u.copy()
            moved[:, k] += 1.0
            step = predict(self.device.stack, self.nodes, rows, moved) - y
            columns.append(step @ self.whitener.T * prior.sd[:, k, None])
        known = self.log_normal(residual, np.stack(columns, axis=2))
        for k in SAMPLED[1:]:
            w, dof = (points[:, SAMPLED.index(k)] - prior.mean[:, k]) / prior.sd[:, k], prior.dof[:, k]
            nu = np.where(np.isinf(dof), 1.0, dof)
            student = -0.5 * (nu + 1) * np.log1p(w**2 / nu)
            known += np.where(np.isinf(dof), -0.5 * w**2, student) - np.log(prior.sd[:, k])
        inside = (points[:, 0] >= LN_E_RANGE[0]) & (points[:, 0] <= LN_E_RANGE[1])
        return np.where(inside, known, -np.inf)

    @staticmethod
    def log_normal(residual: Array, columns: Array) -> Array:
        """Return the log density of residuals (n, n_bin) of covariance I + V V', V (n, n_bin, 2), but for a
        constant."""
        matrix = np.eye(2) + columns.transpose(0, 2, 1) @ columns
        along = np.einsum("nbk,nb->nk", columns, residual)
        explained = (along * np.linalg.solve(matrix, along[:, :, None])[:, :, 0]).sum(axis=1)
        return np.asarray(-0.5 * ((residual**2).sum(axis=1) - explained + np.linalg.slogdet(matrix)[1]))


class WhitenedPosterior:
    """The posterior in coordinates z (n_point, 5) in which it is nearly a standard normal."""

    n = len(SAMPLED)

    def __init__(self, device: GripperModel, data: Touches) -> None:
        self.target = MarginalPosterior(device, data)
        posterior = grid_posteriors(device, data)[0]
        self.edges, self.cumulative = _quantile_table(posterior.x, posterior.mass)
        inside = np.interp([1e-4, 1 - 1e-4], self.cumulative, self.edges)
        self.knots = np.linspace(inside[0], inside[1], _KNOTS)
        row = np.zeros(_KNOTS, dtype=np.int64)
        mode = fit_pairs(device, data, row, free_hypotheses(device, self.knots))
        rest = np.array(SAMPLED[1:])
        self.centre = mode.u[:, rest]
        self.root: Array = np.asarray(np.linalg.cholesky(mode.covariance[:, rest[:, None], rest[None, :]]))

    def points(self, z: Array) -> Array:
        """Return (ln e, ln h, ln tau_b, t0, ln C) at z, both (n_point, 5)."""
        return self.mapped(np.atleast_2d(z))[0]

    def __call__(self, z: Array) -> Array:
        """Return the log density (n_point,) of z, up to a constant."""
        points, log_volume = self.mapped(np.atleast_2d(z))
        return np.asarray(self.target(points) + log_volume)

    def mapped(self, z: Array) -> tuple[Array, Array]:
        share = ndtr(z[:, 0])
        x = np.interp(share, self.cumulative, self.edges)
        cell = np.clip(np.searchsorted(self.cumulative, share) - 1, 0, self.edges.size - 2)
        density = np.diff(self.cumulative)[cell] / np.diff(self.edges)[cell]
        centre, root = _between(x, self.knots, self.centre), _between(x, self.knots, self.root)
        rest = centre + np.einsum("nij,nj->ni", root, z[:, 1:])
        log_volume = -0.5 * z[:, 0] ** 2 - np.log(density)
        log_volume += np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return np.column_stack([x, rest]), log_volume


def emcee_posterior(
    device: GripperModel, grasps: Grasps, i: int, *, seed: int = 0, max_steps: int = 20000, walkers: int = 24,
    effective: float = 1000.0,
) -> ChainPosterior:  # fmt: skip
    """Return samples of grasp ``i``'s posterior of ln e, with ``effective`` of them or ``max_steps`` steps.

    The two temperatures are marginalised exactly.  Moves are differential evolution and, every other time, a
    proposal from Student's t.  The chain ends when it is longer than 50 integrated autocorrelation times,
    that time has settled and the samples suffice: the 5 % quantile of n of them is off by 2.1 / sqrt(n) of
    the posterior's sd.
    """
    density = WhitenedPosterior(device, touches(grasps.isel(grasp=[i])))
    # no snooker move: that of emcee 3.1.6 samples a 5-D standard normal with sd 0.83
    moves = [
        (emcee.moves.DEMove(), 0.45),
        (emcee.moves.DEMove(gamma0=1.0), 0.05),
        (emcee.moves.MHMove(independent_proposal), 0.5),
    ]
    sampler = emcee.EnsembleSampler(walkers, density.n, density, moves=moves, vectorize=True)
    rng = np.random.RandomState(seed)
    sampler.random_state = rng.get_state()
    state = np.random.default_rng(seed).standard_normal((walkers, density.n))
    time, converged = np.inf, False
    while sampler.iteration < max_steps and not converged:
        state = sampler.run_mcmc(state, min(_BLOCK, max_steps - sampler.iteration))
        before, time = time, float(sampler.get_autocorr_time(tol=0)[0])
        settled = sampler.iteration > 50 * time and abs(before - time) < 0.1 * time
        converged = bool(settled and walkers * sampler.iteration > effective * time)
    burn = min(int(5 * time) if np.isfinite(time) else sampler.iteration // 2, sampler.iteration // 2)
    thin = max(1, int(time / 2)) if np.isfinite(time) else 1
    samples = density.points(sampler.get_chain(discard=burn, thin=thin, flat=True))[:, 0]
    low, middle, high = np.quantile(samples, [0.05, 0.5, 0.95])
    return ChainPosterior(
        ln_effusivity=np.asarray(samples), quantiles=(float(low), float(middle), float(high)),
        autocorrelation=time, steps=int(sampler.iteration), converged=converged,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
    )  # fmt: skip


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
