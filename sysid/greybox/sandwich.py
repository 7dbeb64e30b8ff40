"""Covariance of a least-squares fit from the covariance of its score.

**The estimate** solves s(z) = z + sum_l J_l' r_l(z) = 0, the gradient of |z|^2 + sum |r_l|^2 / tau (prior
rows, then the weighted residuals of each log), whose weights are no noise model.

**The truth** z_0 has s(z_0) = z_0 + sum_l J_l' r_l(z_0): a draw from the prior, the contribution of noise,
model error and random effects of the logs (:mod:`~thermogrip.sysid.greybox.random_effects`), and that of
model discrepancy, the same in all logs. With the covariance C_l of the former and the sizes s of the latter,
learnt by :mod:`~thermogrip.sysid.greybox.noise_model`,

    cov s(z_0) = Omega = 1 + sum_l V_l + U U',      V_l = J_l' C_l J_l,    U = sum_l J_l' F_l s,

and with P = 1 + sum_l A_l, A_l = J_l' J_l, the estimate is off by P^-1 s(z_0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import digamma

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox.noise_model import ErrorModel, LogData, learn_error_model
from thermogrip.sysid.greybox.problem import Problem
from thermogrip.sysid.greybox.random_effects import linearise_logs


@dataclass(frozen=True)
class ErrorPriors:
    """What is taken for known of the errors, and the number of logs and bins that add to it."""

    discrepancy_sd: float = 1.5  # of ln s of a response
    effect_sd: float = 0.7  # of ln s of a random effect
    least_bins: int = 10  # to learn an error from
    least_logs: int = 3  # whose disagreement says something


PRIORS = ErrorPriors()


class LogScores(NamedTuple):
    """What a log adds to the score, or what each of (n_log, ...) adds."""

    hessian: Array  # A_l (n, n)
    spread: Array  # V_l (n, n)
    score: Array  # J_l' r_l (n,)
    discrepancy: Array  # J_l' F_l s (n, n_term)


@dataclass(frozen=True, eq=False)
class ScoreCovariance:
    """Uncertainty of a least-squares fit."""

    covariance: Array  # (n_free, n_free), of z, in prior units
    spread: Array  # the part of Omega that differs from log to log: without prior and model discrepancy
    coarsening: float  # T of :mod:`thermogrip.sysid.greybox.posterior`
    hessian: Array  # (n_free, n_free), P
    phi: float  # how much logs differ over how much they should, as a variance
    numbers: ErrorModel  # in the units of the fit's residuals
    bin_s: float  # width of its bins [s]


def score_covariance(
    problem: Problem,
    z: Array,
    by_log: Sequence[tuple[Array, Array]] | None = None,
    numbers: ErrorModel | None = None,
) -> ScoreCovariance:
    """Return the uncertainty of the least-squares fit ``z``."""
    by_log = problem.by_log(z, central=True) if by_log is None else by_log
    data = linearise_logs(problem, z, by_log)
    if sum(block.n for log in data.logs for block in log.blocks) < PRIORS.least_bins:
        problem_is = f"too short: fewer than {PRIORS.least_bins} means of {problem.average:g} s"
        raise UserError(problem_is, file=problem.names[0], hint="give a longer log, or a smaller average")
    if numbers is None or len(numbers.spread) != len(data.kinds):
        width = [PRIORS.discrepancy_sd] * data.n_responses
        width += [PRIORS.effect_sd] * (len(data.kinds) - data.n_responses)
        numbers = learn_error_model(data.logs, z, width=width)
    merge = float(round(data.bin_s / problem.average))  # residuals in one mean
    scores = [_one_log(log, merge, numbers, z.size, data.n_shared) for log in data.logs]
    whole = LogScores(*(np.array(column) for column in zip(*scores)))
    pull = whole.discrepancy.sum(axis=0)
    hessian = np.eye(z.size) + whole.hessian.sum(axis=0)
    inverse = np.linalg.inv(hessian)
    # without phi intervals are 0.92 times as wide and cover 2 per cent less (48 simulated rigs of
    # benchmarks/coverage)
    phi = common_factor(disagreement(whole, z), len(whole.score))
    fixed, spread = np.eye(z.size) + pull @ pull.T, phi * whole.spread.sum(axis=0)
    # P^-1 Omega P^-1, the sandwich of H. White, "Maximum likelihood estimation of misspecified models",
    # Econometrica 50 (1982), with a model of the error in its middle
    covariance = inverse @ (fixed + spread) @ inverse
    # Logs remove no prior knowledge, so no parameter has a larger sd than its prior's, 1: 90 per cent
    # intervals cover 86 per cent (48 simulated rigs of benchmarks/coverage), 80 if eigenvalues were cut as
    # well.
    narrower = 1 / np.sqrt(np.maximum(np.diag(covariance), 1.0))
    covariance = covariance * np.outer(narrower, narrower)
    by_weights = np.trace(inverse @ whole.hessian.sum(axis=0))
    coarsening = max(1.0, float(np.trace(inverse @ spread)) / max(float(by_weights), 1e-12))
    return ScoreCovariance(covariance, spread, coarsening, hessian, phi, numbers, data.bin_s)


def disagreement(scores: LogScores, z: Array) -> Array:
    """Return q_i (n_free,): 1 where the learnt model is right, or where there are fewer than three logs."""
    n_log, n = scores.score.shape
    if n_log < PRIORS.least_logs:
        return np.ones(n)
    pulls = scores.score + scores.hessian @ z  # about z = 0
    whole, ratios = np.eye(n) + scores.hessian.sum(axis=0), []
    inverse, spread = np.linalg.inv(whole), np.eye(n) + scores.spread.sum(axis=0)
    for k, (v, pull) in enumerate(zip(scores.spread, pulls)):
        # summed anew: with a sensor that is stated to be exact, a difference would lose the prior's 1
        others = np.eye(n) + np.delete(scores.hessian, k, axis=0).sum(axis=0)
        step = np.linalg.inv(others) - inverse  # how the other logs move it
        # leaving it out moves the estimate by (P - A_l)^-1 sum_{m != l} J_m' r_m - P^-1 sum_m J_m' r_m
        moved = np.linalg.solve(others, pulls.sum(axis=0) - pull) - inverse @ pulls.sum(axis=0)
        # its covariance follows from the V's; q_i is the mean over logs of d_li^2 over its expectation
        expected = step @ (spread - v) @ step.T + inverse @ v @ inverse
        size = np.diag(expected)  # 0 of a parameter that no log feels: nothing disagrees
        ratios.append(np.divide(moved**2, size, out=np.ones(n), where=size > 0))
    return np.asarray(np.mean(ratios, axis=0))


def common_factor(q: Array, n_log: int) -> float:
    """Return phi of the q_i (n_free,) of ``n_log`` logs."""
    if n_log < PRIORS.least_logs:
        return 1.0
    # Three degrees of freedom determine one q_i poorly, so phi is their mean in ln q_i over that of a
    # chi-squared over its degrees of freedom.  Where logs agree better than expected, the error model counts
    # as one more log.
    freedom = n_log - 1
    expected_log = digamma(freedom / 2) - np.log(freedom / 2)  # of ln chi^2 / freedom
    phi = float(np.exp(np.log(np.maximum(q, 1e-9)).mean() - expected_log))
    return max(phi, (1 + freedom * phi) / n_log)


def _one_log(log: LogData, merge: float, numbers: ErrorModel, n: int, n_shared: int) -> LogScores:
    """Return what one log adds; the score is of reading less model, so that it pulls upwards."""
    scale = np.append(numbers.scale(log.kind), 1.0)
    products, noise = np.zeros((scale.size, scale.size)), np.zeros((n, n))
    for block in log.blocks:
        products += merge * np.einsum("bjjac->ac", block.products)
        noise += merge**2 * np.tensordot(block.covariance(numbers), block.products[..., :n, :n], axes=3)
    products = products * scale * scale[:, None]
    effects = products[:n, n_shared:-1]
    return LogScores(
        hessian=products[:n, :n],
        spread=noise + effects @ effects.T,
        score=products[:n, -1],
        discrepancy=products[:n, n:n_shared],
    )
