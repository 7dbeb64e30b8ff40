"""The density that the score of a fit defines: some parameters are sampled, the others integrated out.

With s(z) = z + sum_l J_l' r_l(z), simulated anew at each z with the J_l of the fit, and Omega its covariance
at the truth (:mod:`~thermogrip.sysid.score_covariance`),

    ln p(z) = -1/2 |R (s(z) - s(z_fit))|^2,      R' R = Omega^-1,

inside the bounds.  It has its mode at the fit, where s is 0 (but for parameters on a bound), and near it the
covariance that the fit states; further away it bends as the plant does.  The prior is in s already.

For sampled z_s and others z_o the score is linear in z_o to first order, with the columns P_o of the Hessian.
With e = R s(z_s, z_o,fit) and B = R P_o,

    ln p(z_s) = -1/2 [e'e - e'B (B'B)^-1 B'e] + const,     z_o = z_o,fit - (B'B)^-1 B'e + N(0, (B'B)^-1).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from thermogrip.sysid.greybox_problem import Problem
from thermogrip.sysid.score_covariance import ScoreCovariance, white_scores

__all__ = ["ScoreDensity"]

Array = NDArray[np.float64]


class ScoreDensity:
    """The log density of some of the parameters, the others integrated out.

    Parameters
    ----------
    problem : Problem
        With the weights of the fit.
    z : (n_free,) ndarray
        The fit, in prior units.
    uncertainty : ScoreCovariance
        At the fit.
    sampled : sequence of int
        Which parameters are sampled.
    """

    def __init__(
        self, problem: Problem, z: Array, uncertainty: ScoreCovariance, sampled: Sequence[int]
    ) -> None:
        self.problem, self.z = problem, np.asarray(z, dtype=float)
        self.sampled = np.array(sampled, dtype=int)
        self.others = np.setdiff1d(np.arange(self.z.size), self.sampled)
        by_log, self._starts = problem.by_log(self.z), problem.start(self.z)
        white = white_scores(uncertainty)
        self._white = white
        self._pull = [white @ jacobian.T for _, jacobian in by_log]
        self._level = sum((pull @ r for pull, (r, _) in zip(self._pull, by_log)), white @ self.z)
        hessian = np.eye(self.z.size) + sum(J.T @ J for _, J in by_log)
        self._b = white @ hessian[:, self.others]
        self._factor = cho_factor(self._b.T @ self._b, lower=True) if self.others.size else None

    def log_posterior(self, z: Array) -> Array:
        """Return ln p (B,), up to a constant, at sampled z (B, n_sampled) in prior units."""
        full = self._full(np.atleast_2d(z))
        low, high = self.problem.box
        out = np.full(len(full), -np.inf)
        ok = np.all((full >= low) & (full <= high), axis=1)
        if ok.any():
            e = self._scores(full[ok])
            out[ok] = -0.5 * np.einsum("bi,bi->b", e, e)
            if self._factor is not None:
                pull = e @ self._b
                out[ok] += 0.5 * np.einsum("bi,ib->b", pull, cho_solve(self._factor, pull.T))
        out[~np.isfinite(out)] = -np.inf  # a run that blew up
        return out

    def complete(self, z: Array, rng: np.random.Generator) -> Array:
        """Return all parameters (B, n_free) in prior units, the others drawn given the sampled ones."""
        full = self._full(np.atleast_2d(z))
        if self._factor is not None:
            mean = -cho_solve(self._factor, (self._scores(full) @ self._b).T).T
            normal = rng.standard_normal(mean.shape).T
            spread = solve_triangular(self._factor[0], normal, lower=True, trans="T").T
            full[:, self.others] += mean + spread
        return full

    def _full(self, z: Array) -> Array:
        """Return parameter vectors with the others at the fit."""
        full = np.tile(self.z, (len(z), 1))
        full[:, self.sampled] = z
        return full

    def _scores(self, full: Array) -> Array:
        """Return R (s - s_fit), (B, n_free)."""
        out = full @ self._white.T - self._level
        for pull, residual in zip(self._pull, self.problem.residuals(full, self._starts)):
            out = out + residual @ pull.T
        return np.asarray(out)
