"""Randomised maximum a posteriori: draws of plants that agree with the logs, along curved valleys.

A fit of many parameters has valleys: combinations along which the free runs hardly change. They are curved,
so a draw from a normal distribution, which is straight, leaves them and is a plant that contradicts the
logs.

**Density.** Least squares weigh the residuals as if the model's error had a correlation time below a
minute, which it has not. What a fit leaves open is how far its free runs may move, d(z) = r(z) - r(z_fit),
all logs together:

    ln p(z) = -1/2 |z - z_fit|^2 - 1/2 |K^(1/2) Q'd(z)|^2 - 1/(2 T) |d(z) - Q Q'd(z)|^2.

Q spans the slopes J = Q S R' of the fit. With A = J'J the information by the weights of the fit, V the
learnt covariance of the score (:mod:`~thermogrip.sysid.greybox.sandwich`) and K = S R' V^-1 R S, the second
term is A V^-1 A near the fit, where least squares are off by A^-1 V A^-1. Directions that move no run (S
below 1e-9 of its largest) are left out of Q; only the first term restricts them. Model discrepancy is not
in V: the parameters have absorbed it, and a plant that is to predict readings keeps them so. The third term
is 0 where the plant is linear. Further away it excludes runs that the slopes do not predict; it is weighed
by T = tr(P^-1 V) / tr(P^-1 A), how much larger the errors are than the fit's weights expect [1]_. No
direction is less certain than by the prior, whose width the first term has, about the fit.

**Draws.** Each is a fit of its own, to perturbed readings from a perturbed prior [2]_:

    minimise  |z - z_fit - xi|^2 + |K^(1/2) Q'd(z) - e|^2 + |d(z) - Q Q'd(z)|^2 / T,      xi, e ~ N(0, 1).

Where the model is linear that is a draw from p; elsewhere it bends as the plant does. All go through
Levenberg-Marquardt side by side, for the simulator runs many parameter sets at once. A few steps settle
what the free runs see; along a valley that they hardly see a draw may stop short of its end.

**Some sampled, the others integrated out.** For sampled z_s the others z_o begin where the normal
approximation has their mean, and follow by a Gauss-Newton step with the slopes J_o of the fit; p is
evaluated there, and the rest is integrated out to second order. With H = 1 + A V^-1 A,

    z_o = z_fit - H_oo^-1 H_os (z_s - z_fit) - H_oo^-1 g_o,     g = z - z_fit + J'Q K Q'd,
    ln p(z_s) = ln p(z_s, z_o) + g_o' H_oo^-1 g_o / 2.

References
----------
.. [1] J. W. Miller, D. B. Dunson, "Robust Bayesian inference via coarsening", JASA 114 (2019).
.. [2] J. M. Bardsley, A. Solonen, H. Haario, M. Laine, "Randomize-then-optimize", SIAM J. Sci. Comput. 36
   (2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from thermogrip.sysid.greybox.problem import Problem
from thermogrip.sysid.greybox.sandwich import ScoreCovariance

__all__ = ["RandomizedMap"]

Array = NDArray[np.float64]

_STEP = 1e-4  # of z, for differences
_LONGEST = 1.0  # prior sd that one step may move a parameter
_FLOOR = 1e-3  # of A: the least that V may be in any direction
_UNSEEN = 1e-9  # of the largest slope: what moves the runs by less is lost in the differences


class RandomizedMap:
    """The density of plants that agree with the logs, and draws from it."""

    def __init__(self, problem: Problem, z: Array, uncertainty: ScoreCovariance) -> None:
        self.problem, self.z = problem, np.asarray(z, dtype=float)
        self.starts = problem.start(self.z)
        self.low, self.high = problem.box
        by_log = problem.by_log(self.z, central=True)
        self._fitted = np.concatenate([r for r, _ in by_log])
        span, size, turn = np.linalg.svd(np.vstack([J for _, J in by_log]), full_matrices=False)
        seen = size > _UNSEEN * size.max(initial=0.0)
        self._span, size, turn = span[:, seen], size[seen], turn[seen]
        along = turn / size[:, None]
        error = along @ uncertainty.spread @ along.T  # S^-1 R V R' S^-1, about the error's covariance along Q
        value, axes = np.linalg.eigh((error + error.T) / 2)
        root = axes.T / np.sqrt(np.maximum(value, 0.0) + _FLOOR)[:, None]
        self._root = np.linalg.qr(root)[1]  # K = root' root, and no rounding makes it indefinite
        self._root *= np.where(np.diag(self._root) < 0, -1.0, 1.0)[:, None]
        self._pull = turn.T * size @ self._root.T  # J'Q K^(1/2)'
        self.information = self._pull @ self._pull.T
        self._loose = 1.0 / np.sqrt(uncertainty.coarsening)

    @property
    def covariance(self) -> Array:
        """Covariance (n_free, n_free) of z near the fit."""
        return np.asarray(np.linalg.inv(np.eye(self.z.size) + self.information))

    def log_density(self, z: Array) -> Array:
        """Return ln p (n,) up to a constant at z (n, n_free); -inf outside of the bounds."""
        inside = np.all((z >= self.low) & (z <= self.high), axis=1)
        out = np.full(len(z), -np.inf)
        if inside.any():
            out[inside] = -self._cost(z[inside], np.zeros(self.z.size), np.zeros(len(self._root)))
        return out

    def log_profile(self, z: Array, columns: Sequence[int]) -> Array:
        """Return ln p (n,) of the parameters ``columns`` at z (n, n_columns), the others integrated out."""
        others = np.setdiff1d(np.arange(self.z.size), np.array(columns, dtype=int))
        whole = np.tile(self.z, (len(z), 1))
        whole[:, list(columns)] = z
        if not others.size:
            return self.log_density(whole)
        out = np.full(len(z), -np.inf)
        inside = np.all((whole >= self.low) & (whole <= self.high), axis=1)
        at = whole[inside]
        if not len(at):
            return out
        H = np.eye(self.z.size) + self.information
        factor = cho_factor(H[np.ix_(others, others)], lower=True)
        tied = H[others][:, list(columns)] @ (at - self.z)[:, list(columns)].T
        at[:, others] = at[:, others] - cho_solve(factor, tied).T
        at = np.clip(at, self.low, self.high)
        step = cho_solve(factor, self._gradient(at)[0][:, others].T).T
        at[:, others] = np.clip(at[:, others] - step, self.low[others], self.high[others])
        gradient, cost = self._gradient(at)
        left = gradient[:, others]
        out[inside] = -cost + 0.5 * np.einsum("ki,ik->k", left, cho_solve(factor, left.T))
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
        """Return draws (n, n_free) of z, in prior units, inside the bounds."""
        rng = np.random.default_rng(seed)
        z = np.tile(self.z, (n, 1))
        xi, noise = rng.standard_normal(z.shape), rng.standard_normal((n, len(self._root)))
        moving = np.setdiff1d(np.arange(self.z.size), np.array(columns, dtype=int))
        if held is not None:
            z[:, list(columns)] = held
        damping, cost = np.full(n, 1e-5), self._cost(z, xi, noise)
        for iteration in range(iterations):
            if progress is not None:
                progress(iteration / iterations, "plants that agree with the logs")
            gradient, hessian = self._slopes(z, xi, noise, moving)
            for _ in range(2):  # a refused step is tried again with more damping
                trial = z.copy()
                trial[:, moving] += self._steps(z[:, moving], gradient, hessian, damping, moving)
                trial = np.clip(trial, self.low, self.high)
                found = self._cost(trial, xi, noise)
                better = found < cost
                z[better], cost[better] = trial[better], found[better]
                damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-8, 1e8)
                if better.all():
                    break
                gradient[better] = 0.0  # has moved: waits for new slopes
        return z

    def _moved(self, z: Array) -> tuple[Array, Array]:
        """Return K^(1/2) Q'd (n, n_free) and d, off the span and weighed (n, m)."""
        with np.errstate(over="ignore", invalid="ignore"):
            d = np.concatenate(self.problem.residuals(z, self.starts), axis=1) - self._fitted
            along = d @ self._span
            return along @ self._root.T, self._loose * (d - along @ self._span.T)

    def _cost(self, z: Array, xi: Array, noise: Array) -> Array:
        """Return half the objective (n,), infinite where a run blew up."""
        along, rest = self._moved(z)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = ((along - noise) ** 2).sum(axis=1) + (rest**2).sum(axis=1)
        found = 0.5 * ((z - self.z - xi) ** 2).sum(axis=1) + 0.5 * squares
        return np.where(np.isfinite(found), found, np.inf)

    def _gradient(self, z: Array) -> tuple[Array, Array]:
        """Return g (n, n_free), with the slopes of the fit, and -ln p (n,); what blew up has no pull."""
        along, rest = self._moved(z)
        with np.errstate(over="ignore", invalid="ignore"):
            gradient = z - self.z + along @ self._pull.T
            cost = 0.5 * (((z - self.z) ** 2).sum(axis=1) + (along**2).sum(axis=1) + (rest**2).sum(axis=1))
        finite = np.isfinite(cost) & np.isfinite(gradient).all(axis=1)
        return np.where(finite[:, None], gradient, 0.0), np.where(finite, cost, np.inf)

    def _slopes(self, z: Array, xi: Array, noise: Array, moving: NDArray[np.int_]) -> tuple[Array, Array]:
        """Return gradient (n, n_moving) and Gauss-Newton Hessian (n, n_moving, n_moving)."""
        n, d = len(z), moving.size
        sign = np.where(z[:, moving] + _STEP > self.high[moving], -1.0, 1.0)
        ahead = z[:, None] + _STEP * sign[:, :, None] * np.eye(self.z.size)[moving]
        around = np.concatenate([z[:, None], ahead], axis=1).reshape(-1, self.z.size)
        gradient, hessian = (z - self.z - xi)[:, moving], np.tile(np.eye(d), (n, 1, 1))
        along, rest = self._moved(around)
        for part, less in ((along, noise), (rest, np.zeros((1, 1)))):
            runs = part.reshape(n, d + 1, -1)
            slopes = (runs[:, 1:] - runs[:, :1]) / (_STEP * sign[:, :, None])
            gradient = gradient + np.einsum("kim,km->ki", slopes, runs[:, 0] - less)
            hessian = hessian + slopes @ slopes.transpose(0, 2, 1)
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
