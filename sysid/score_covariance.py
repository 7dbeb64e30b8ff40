"""How far a least-squares fit may be off: the covariance of its score, and what follows from it.

**The estimate** solves s(z) = z + sum_l J_l' r_l(z) = 0, the gradient of |z|^2 + sum |r_l|^2 / tau (prior
rows, then the residuals of each log, weighted).  Free runs are what the plant is for, so the estimate stays
that of least squares; but its weights are no noise model, and the inverse Hessian is no covariance.

**The truth** z_0 has s(z_0) = z_0 + sum_l J_l' r_l(z_0): a draw from the prior and what noise, model error
and effects of the logs leave.  With the covariance C_l of the latter, learnt by
:mod:`~thermogrip.sysid.error_model`,

    cov s(z_0) = Omega = 1 + phi sum_l V_l,      V_l = J_l' C_l J_l,

and with P = 1 + sum_l A_l, A_l = J_l' J_l, the estimate is off by P^-1 s(z_0):

    covariance = P^-1 Omega P^-1.

It is the sandwich [1]_, its filling from a model of the error instead of four noisy squares.

**Do the logs agree as they should?**  Leaving log l out moves the estimate by

    d_l = (P - A_l)^-1 sum_{m != l} J_m' r_m - P^-1 sum_m J_m' r_m      (about z = 0),

whose covariance follows from the V's.  Over the directions of which a log tells something, the mean of the
squares over what was expected is q, 1 where the learnt model is right.  Logs that differ by more, because
the plant itself varies or because what the model lacks is met by other inputs, have q > 1: phi = q.  Where
they agree better, the model of the error counts as one more log: phi = (1 + (L - 1) q) / L.  With one or
two logs their quarters stand for logs; quarters of one log have much in common, so then phi = max(q, 1).

**The set of z that agrees with the logs** is where s' Omega^-1 s is small, s simulated anew at each z.
:mod:`thermogrip.sysid.posterior` samples exp(-s' Omega^-1 s / 2); near the estimate, where it has its mode,
that is the normal distribution of the covariance above [2]_.

References
----------
.. [1] H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50 (1982).
.. [2] V. Chernozhukov, H. Hong, "An MCMC approach to classical estimation", J. Econometrics 115 (2003).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.error_model import ErrorModel, LogData, information, learn_error_model
from thermogrip.sysid.greybox_problem import Problem
from thermogrip.sysid.log_effects import Linearised, linearise_logs

__all__ = ["LogScores", "ScoreCovariance", "agreement", "score_covariance", "white_scores"]

Array = NDArray[np.float64]

_TOLD = 0.1  # information of a log over that of all others from which it tells of a direction
_BINS = 10  # to learn an error from
_FEW, _PIECES = 3, 4  # with fewer logs, so many pieces of each stand for logs


@dataclass(frozen=True, eq=False)
class LogScores:
    """What each log (or piece of one) adds to the score: A_l, V_l (n_log, n, n) and J_l' r_l (n_log, n)."""

    hessian: Array
    spread: Array
    score: Array


@dataclass(frozen=True, eq=False)
class ScoreCovariance:
    """Uncertainty of a least-squares fit.

    Attributes
    ----------
    covariance : (n_free, n_free) ndarray
        Of z, in prior units.
    omega : (n_free, n_free) ndarray
        Covariance of the score.
    hessian : (n_free, n_free) ndarray
        P.
    q : float
        How much logs differ over how much they should.
    numbers : ErrorModel
        In the units of the fit's residuals.
    bin_s : float
        Width of its bins [s].
    effects : dict of str to dict of str to (float, float)
        By log and effect: estimate and its standard deviation, in the signal's unit; of a parameter, as its
        logarithm where that is positive.
    spreads : dict of str to float
        By effect: its standard deviation over logs.
    """

    covariance: Array
    omega: Array
    hessian: Array
    q: float
    numbers: ErrorModel
    bin_s: float
    effects: dict[str, dict[str, tuple[float, float]]]
    spreads: dict[str, float]

    @property
    def widening(self) -> Array:
        """Standard deviation over that of the inverse Hessian, (n_free,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance) / np.diag(np.linalg.inv(self.hessian))))


def score_covariance(
    problem: Problem, z: Array, by_log: Sequence[tuple[Array, Array]] | None = None
) -> ScoreCovariance:
    """Return the uncertainty of the least-squares fit ``z``.

    Parameters
    ----------
    problem : Problem
        With the weights of the fit.
    z : (n_free,) ndarray
        The fit, in prior units.
    by_log : sequence of (residual (m,), Jacobian (m, n_free)), optional
        Of each log at ``z``, where they are at hand.

    Raises
    ------
    UserError
        If the logs are too short to learn anything of the error.
    """
    by_log = problem.by_log(z, central=True) if by_log is None else by_log
    data = linearise_logs(problem, z, by_log)
    if sum(block.n for log in data.logs for block in log.blocks) < _BINS:
        problem_is = f"too short: fewer than {_BINS} means of {problem.average:g} s"
        raise UserError(problem_is, file=problem.names[0], mend="give a longer log, or a smaller average")
    numbers = learn_error_model(data.logs, z, n_kind=len(data.kinds))
    whole = _log_scores(problem, data, numbers, z.size)
    parts = whole
    if len(data.logs) < _FEW:
        cut = linearise_logs(problem, z, by_log, pieces=_PIECES)
        parts = _log_scores(problem, cut, numbers, z.size) if len(cut.logs) >= _FEW else whole
    q = agreement(parts, z)
    hessian = np.eye(z.size) + whole.hessian.sum(axis=0)
    n_log = len(data.logs)
    factor = max(q, (1 + (n_log - 1) * q) / n_log if n_log >= _FEW else 1.0)
    omega = np.eye(z.size) + factor * whole.spread.sum(axis=0)
    inverse = np.linalg.inv(hessian)
    effects, spreads = _effects(data, numbers, z)
    return ScoreCovariance(
        inverse @ omega @ inverse, omega, hessian, q, numbers, data.bin_s, effects, spreads
    )


def agreement(scores: LogScores, z: Array) -> float:
    """Return q; 1 where there are fewer than three logs, from which nothing can be learnt.

    Examples
    --------
    Three logs of one parameter whose scores differ as much as their spread says, and more than that:

    >>> three = np.full((3, 1, 1), 10.0)
    >>> pull = np.array([[2.0], [-2.0], [0.0]])
    >>> round(agreement(LogScores(three, three * 0.4, pull), np.zeros(1)), 2)
    0.96
    >>> round(agreement(LogScores(three, three * 0.08, pull), np.zeros(1)), 1)
    4.2
    """
    n_log, n = scores.score.shape
    if n_log < _FEW:
        return 1.0
    pulls = scores.score + scores.hessian @ z  # about z = 0
    whole, ratios = np.eye(n) + scores.hessian.sum(axis=0), list[float]()
    inverse, spread = np.linalg.inv(whole), np.eye(n) + scores.spread.sum(axis=0)
    for a, v, pull in zip(scores.hessian, scores.spread, pulls):
        rest = whole - a
        step = np.linalg.inv(rest) - inverse  # how the other logs move it
        moved = np.linalg.solve(rest, pulls.sum(axis=0) - pull) - inverse @ pulls.sum(axis=0)
        expected = step @ (spread - v) @ step.T + inverse @ v @ inverse
        told, axes = eigh(a, rest)
        axes = (rest @ axes)[:, told > _TOLD]
        ratios += ((axes.T @ moved) ** 2 / np.einsum("ai,ab,bi->i", axes, expected, axes)).tolist()
    return float(np.mean(ratios)) if ratios else 1.0


def white_scores(covariance: ScoreCovariance) -> Array:
    """Return R (n_free, n_free) with R' R = Omega^-1, so that R s is white."""
    size, axes = np.linalg.eigh(covariance.omega)
    return np.asarray((axes / np.sqrt(size)).T)


def _log_scores(problem: Problem, data: Linearised, numbers: ErrorModel, n: int) -> LogScores:
    merge = float(round(data.bin_s / problem.average))  # residuals that one mean stands for
    parts = [_one_log(log, merge, numbers, n) for log in data.logs]
    return LogScores(*(np.array([part[k] for part in parts]) for k in range(3)))


def _one_log(log: LogData, merge: float, numbers: ErrorModel, n: int) -> tuple[Array, Array, Array]:
    """Return A_l, V_l and J_l' r_l (r: reading less model, so that it pulls upwards)."""
    scale = np.append(numbers.scale(log.kind), 1.0)
    products, noise = np.zeros((scale.size, scale.size)), np.zeros((n, n))
    for block in log.blocks:
        products += merge * np.einsum("bjjac->ac", block.products)
        noise += merge**2 * np.tensordot(block.covariance(numbers), block.products[..., :n, :n], axes=3)
    products = products * scale * scale[:, None]
    effects = products[:n, n:-1]
    return products[:n, :n], noise + effects @ effects.T, products[:n, -1]


def _effects(
    data: Linearised, numbers: ErrorModel, z: Array
) -> tuple[dict[str, dict[str, tuple[float, float]]], dict[str, float]]:
    """Return the effects of each log with their sd, and the spread of each kind."""
    said, out, spreads = information(numbers, data.logs, z), {}, dict.fromkeys(data.kinds, 0.0)
    for log, names, (mean, covariance) in zip(data.logs, data.own, said.own):
        scale = numbers.scale(log.kind[z.size :])
        rows = zip(names, scale * mean, scale * np.sqrt(np.diag(covariance)))
        out[log.name] = {name: (float(base + m * s), float(d * s)) for (name, s, base), m, d in rows if name}
        for (name, s, _), factor in zip(names, scale):
            if name:
                spreads[name] = max(spreads[name], float(factor * s))
    return out, spreads
