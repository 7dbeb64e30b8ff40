"""Plants that agree with the logs as well as can be told: draws that stay on the curved valleys of a fit.

A fit of many parameters has valleys: combinations along which the free runs hardly change.  They are
curved, so that a draw from a normal distribution, straight as it is, leaves them and is a plant that nobody
has seen.

**Density.**  Least squares weigh the residuals as if the model's error forgot itself within a minute.  It
does not, so a log says less, T-fold:

    ln p(z) = -1/2 |z - c|^2 - 1/(2 T) sum_l |r_l(z)|^2,      T = tr(P^-1 sum V_l) / tr(P^-1 sum A_l).

With A_l = J_l' J_l what a log says by the weights of the fit and V_l the covariance of its score as it was
learnt (:mod:`~thermogrip.sysid.score_covariance`; without the terms that the model lacks, for the
parameters have taken them up, and a plant that is to foretell readings keeps them so), T is how much more
the fit's errors cost than its weights expect; 1 if they are right.  It is a coarsened posterior [1]_.  The
prior's centre c = (1 - 1/T) z_fit keeps the mode at the fit.

**Draws.**  Each is a fit of its own, to perturbed readings from a perturbed prior [2]_:

    minimise  |z - c - xi|^2 + sum_l |r_l(z) - e_l|^2 / T,      xi ~ N(0, 1),  e ~ N(0, T).

Where the model is linear that is a draw from p; elsewhere it bends as the plant does.  All go through
Levenberg-Marquardt side by side, for the simulator runs many parameter sets at once.  A few steps settle
what the free runs see; along a valley that they hardly see a draw may stop short of its end.

**Some sampled, the others integrated out.**  For sampled z_s the others follow by a Gauss-Newton step with
the slopes J_o of the fit; p is evaluated there, and what the step has left is integrated out to second
order:

    g = (z - c)_o + J_o' r / T,     H = 1 + J_o' J_o / T,     ln p(z_s) = ln p(z_s, z_o) + g' H^-1 g / 2.

References
----------
.. [1] J. W. Miller, D. B. Dunson, "Robust Bayesian inference via coarsening", JASA 114 (2019).
.. [2] J. M. Bardsley, A. Solonen, H. Haario, M. Laine, "Randomize-then-optimize", SIAM J. Sci. Comput. 36
   (2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from thermogrip.sysid.greybox_problem import Problem

__all__ = ["Agreement"]

Array = NDArray[np.float64]

_STEP = 1e-4  # of z, for differences
_LONGEST = 1.0  # prior sd that one step may move a parameter


class Agreement:
    """The density of plants that agree with the logs, and draws from it.

    Parameters
    ----------
    problem : Problem
        With the weights of the fit.
    z : (n_free,) ndarray
        The fit, in prior units.
    coarse : float
        T, 1 or more.
    """

    def __init__(self, problem: Problem, z: Array, coarse: float) -> None:
        self.problem, self.z, self.coarse = problem, np.asarray(z, dtype=float), max(float(coarse), 1.0)
        self.centre = (1.0 - 1.0 / self.coarse) * self.z
        self.starts = problem.start(self.z)
        self.low, self.high = problem.box
        self._kept: dict[tuple[int, ...], tuple[list[Array], Any]] = {}

    def log_density(self, z: Array) -> Array:
        """Return ln p (n,) up to a constant at z (n, n_free); -inf outside of the bounds."""
        inside = np.all((z >= self.low) & (z <= self.high), axis=1)
        out = np.full(len(z), -np.inf)
        if inside.any():
            out[inside] = -self._cost(z[inside], self.centre, self._still())
        return out

    def log_profile(self, z: Array, columns: Sequence[int]) -> Array:
        """Return ln p (n,) of the parameters ``columns`` at z (n, n_columns), the others integrated out."""
        others = np.setdiff1d(np.arange(self.z.size), np.array(columns, dtype=int))
        whole = np.tile(self.z, (len(z), 1))
        whole[:, list(columns)] = z
        if not others.size:
            return self.log_density(whole)
        inside = np.all((whole >= self.low) & (whole <= self.high), axis=1)
        out = np.full(len(z), -np.inf)
        at = whole[inside]
        if not len(at):
            return out
        slopes, factor = self._others(tuple(others.tolist()))
        gradient, _ = self._pull(at, others, slopes)
        at[:, others] = np.clip(
            at[:, others] - cho_solve(factor, gradient.T).T, self.low[others], self.high[others]
        )
        gradient, cost = self._pull(at, others, slopes)
        with np.errstate(invalid="ignore", over="ignore"):
            found = -cost + 0.5 * np.einsum("ki,ik->k", gradient, cho_solve(factor, gradient.T))
        out[inside] = np.where(np.isfinite(found), found, -np.inf)
        return out

    def draws(
        self,
        n: int,
        *,
        seed: int = 0,
        held: Array | None = None,
        columns: Sequence[int] = (),
        iterations: int = 8,
        progress: Callable[[float, str], None] | None = None,
    ) -> Array:
        """Return draws (n, n_free) of z, in prior units, inside the bounds.

        Parameters
        ----------
        n : int
        seed : int, optional
        held : (n, n_held) ndarray, optional
            Values of the parameters ``columns``, which then stay: the draws are of the others, given these.
        columns : sequence of int, optional
        iterations : int, optional
            Of Levenberg-Marquardt, each.
        progress : callable, optional
            Called with (fraction done, what).
        """
        rng = np.random.default_rng(seed)
        z = np.tile(self.z, (n, 1))
        centre = self.centre + rng.standard_normal(z.shape)
        moving = np.setdiff1d(np.arange(self.z.size), np.array(columns, dtype=int))
        if held is not None:
            z[:, list(columns)] = centre[:, list(columns)] = held
        noise = [np.sqrt(self.coarse) * rng.standard_normal((n, r.shape[1])) for r in self._still()]
        damping, cost = np.full(n, 1e-5), self._cost(z, centre, noise)
        for iteration in range(iterations):
            if progress is not None:
                progress(iteration / iterations, "plants that agree with the logs")
            gradient, hessian = self._slopes(z, centre, noise, moving)
            for _ in range(2):  # a refused step is tried again with more damping
                trial = z.copy()
                trial[:, moving] += self._steps(z[:, moving], gradient, hessian, damping, moving)
                trial = np.clip(trial, self.low, self.high)
                found = self._cost(trial, centre, noise)
                better = found < cost
                z[better], cost[better] = trial[better], found[better]
                damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-8, 1e8)
                if better.all():
                    break
                gradient[better] = 0.0  # has moved: waits for new slopes
        return z

    def _others(self, others: tuple[int, ...]) -> tuple[list[Array], Any]:
        """Return the slopes of each log at the fit, of these parameters, and the factor of H."""
        if others not in self._kept:
            slopes = [jacobian[:, list(others)] for _, jacobian in self.problem.by_log(self.z)]
            hessian = np.eye(len(others)) + sum(J.T @ J for J in slopes) / self.coarse
            self._kept[others] = slopes, cho_factor(hessian, lower=True)
        return self._kept[others]

    def _pull(self, z: Array, others: NDArray[np.int_], slopes: Sequence[Array]) -> tuple[Array, Array]:
        """Return g (n, n_others) and -ln p (n,) at z; what blew up has no pull and no chance."""
        gradient, cost = (z - self.centre)[:, others], 0.5 * ((z - self.centre) ** 2).sum(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            for r, jacobian in zip(self.problem.residuals(z, self.starts), slopes):
                gradient = gradient + r @ jacobian / self.coarse
                cost = cost + 0.5 * (r**2).sum(axis=1) / self.coarse
        finite = np.isfinite(cost) & np.isfinite(gradient).all(axis=1)
        return np.where(finite[:, None], gradient, 0.0), np.where(finite, cost, np.inf)

    def _still(self) -> list[Array]:
        """Return no perturbation of each log, (1, m_log)."""
        return [np.zeros((1, r.shape[1])) for r in self.problem.residuals(self.z[None], self.starts)]

    def _cost(self, z: Array, centre: Array, noise: Sequence[Array]) -> Array:
        """Return half the objective (n,), infinite where a run blew up."""
        with np.errstate(over="ignore", invalid="ignore"):
            squares = sum(
                ((r - e) ** 2).sum(axis=1) for r, e in zip(self.problem.residuals(z, self.starts), noise)
            )
        found = 0.5 * ((z - centre) ** 2).sum(axis=1) + 0.5 * squares / self.coarse
        return np.where(np.isfinite(found), found, np.inf)

    def _slopes(
        self, z: Array, centre: Array, noise: Sequence[Array], moving: NDArray[np.int_]
    ) -> tuple[Array, Array]:
        """Return gradient (n, n_moving) and Gauss-Newton Hessian (n, n_moving, n_moving)."""
        n, d = len(z), moving.size
        sign = np.where(z[:, moving] + _STEP > self.high[moving], -1.0, 1.0)
        ahead = z[:, None] + _STEP * sign[:, :, None] * np.eye(self.z.size)[moving]
        around = np.concatenate([z[:, None], ahead], axis=1).reshape(-1, self.z.size)
        gradient, hessian = (z - centre)[:, moving], np.tile(np.eye(d), (n, 1, 1))
        for r, e in zip(self.problem.residuals(around, self.starts), noise):
            runs = r.reshape(n, d + 1, -1)
            slopes = (runs[:, 1:] - runs[:, :1]) / (_STEP * sign[:, :, None])
            gradient = gradient + np.einsum("kim,km->ki", slopes, runs[:, 0] - e) / self.coarse
            hessian = hessian + slopes @ slopes.transpose(0, 2, 1) / self.coarse
        return gradient, hessian

    def _steps(
        self, z: Array, gradient: Array, hessian: Array, damping: Array, moving: NDArray[np.int_]
    ) -> Array:
        """Return one damped step of each draw; what is pushed against a bound stays."""
        stuck = ((z <= self.low[moving]) & (gradient > 0)) | ((z >= self.high[moving]) & (gradient < 0))
        out = np.zeros_like(gradient)
        for k, (g, h, lam) in enumerate(zip(gradient, hessian, damping)):
            free = np.flatnonzero(~stuck[k])
            part = h[np.ix_(free, free)]
            step = -np.linalg.solve(part + lam * np.diag(np.diag(part)), g[free])
            out[k, free] = step * min(1.0, _LONGEST / max(float(np.abs(step).max(initial=0.0)), 1e-300))
        return out
