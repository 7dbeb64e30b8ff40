"""Model error that remembers: the covariance of what a free run leaves, and how it is learnt.

A free run misses the readings by tenths of a degree for minutes at a time.  Counting such residuals as
independent makes parameter intervals several times too narrow.  Here the residual of one log, averaged over
bins at the times t_i for the outputs j(i), is Gaussian with the covariance

    C_ab =  f^2 s_j^2 / n_a  (a = b)                           sensor noise, averaged over n_a samples
          + f^2 sum_k R_k[j, j'] a_kj a_kj' exp(-|t_a - t_b| / tau_k)   k = 1, 2: fast and slow model error
          + sum_m N_am N_bm                                    nuisances of the log: sensor offsets, start

which is exact for linear nuisances (they are integrated out).  One component is the AR(1) process; two follow
a residual that has both quick and slow memory.  R_k is one correlation between outputs, since an error of the
tank is an error of the finger.

The numbers (a, tau, R) maximise the marginal likelihood of the residuals with the parameters themselves
integrated out over their prior (linearised): what the parameters absorb is accounted for, as in restricted
maximum likelihood.  Weak log-normal priors keep what the data do not tell in a sensible range.

f >= 1 comes from :func:`log_jackknife`: if leaving out one log after the other moves the parameters by more
than their covariance says, whatever the reason, all of it is too narrow by that factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, eigh, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

__all__ = ["Discrepancy", "LogResiduals", "fit_discrepancy", "log_jackknife", "marginal_likelihood", "white"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LogResiduals:
    """What one log says, linearised about a reference.

    Attributes
    ----------
    name : str
        The log.
    time : (n,) ndarray
        Centres of the bins [s].
    output : (n,) ndarray of int
        Which output each bin is of.
    residual : (n,) ndarray
        Reading less model at the reference [K].
    noise : (n,) ndarray
        Standard deviation of the averaged sensor noise [K].
    local : (n, n_local) ndarray
        Nuisances of this log, columns in units of their prior standard deviation [K].
    sensitivity : (n, n_free) ndarray
        Change of the model per prior standard deviation of each free parameter [K].
    """

    name: str
    time: Array
    output: NDArray[np.int64]
    residual: Array
    noise: Array
    local: Array
    sensitivity: Array


@dataclass(frozen=True)
class Discrepancy:
    """Numbers of the covariance.

    Attributes
    ----------
    tau : tuple of float
        Memory of each component [s].
    sd : tuple of tuple of float
        Standard deviation by component and output [K].
    correlation : tuple of float
        Between outputs, by component.
    inflation : float
        f: by how much all of it is widened.
    """

    tau: tuple[float, ...]
    sd: tuple[tuple[float, ...], ...]
    correlation: tuple[float, ...]
    inflation: float = 1.0

    def covariance(self, log: LogResiduals) -> Array:
        """Return the covariance (n, n) of one log's residuals [K^2], nuisances included."""
        lag = np.abs(log.time[:, None] - log.time[None])
        same = log.output[:, None] == log.output[None]
        out = np.diag(log.noise**2)
        for tau, sd, correlation in zip(self.tau, self.sd, self.correlation):
            scale = np.asarray(sd)[log.output]
            out += np.outer(scale, scale) * np.where(same, 1.0, correlation) * _memory(lag, tau)
        return np.asarray(self.inflation**2 * out + log.local @ log.local.T)

    def describe(self, outputs: Sequence[str]) -> str:
        """Return the numbers in words."""
        parts = []
        for tau, sd, correlation in zip(self.tau, self.sd, self.correlation):
            each = ", ".join(f"{name} {value:.3f}" for name, value in zip(outputs, sd))
            also = f", correlation {correlation:.2f}" if len(outputs) > 1 else ""
            parts.append(f"{each} degC over {tau:.0f} s{also}")
        return (
            f"model error: {'; '.join(parts)}; widened {self.inflation:.1f} times by the jackknife over logs"
        )


def white(sd: Sequence[float]) -> Discrepancy:
    """Return model error without memory, of these standard deviations by output [K].

    It makes intervals too narrow; it is here to be compared with.

    Examples
    --------
    >>> white([0.1]).tau[0] < 1e-3
    True
    """
    return Discrepancy((1e-6,), (tuple(float(value) for value in sd),), (0.0,))


def fit_discrepancy(logs: Sequence[LogResiduals], at: Array | None = None) -> Discrepancy:
    """Return the covariance numbers that the residuals support best, not yet widened.

    Parameters
    ----------
    logs : sequence of LogResiduals
        Linearised near the optimum.
    at : (n_free,) ndarray, optional
        Where: the reference in prior standard deviations from the prior mean; default the prior mean.

    Returns
    -------
    discrepancy : Discrepancy

    Raises
    ------
    ValueError
        If there is no log, or a log has fewer than ten bins.
    """
    if not logs or min(log.residual.size for log in logs) < 10:
        raise ValueError("need logs of at least ten bins each")
    n_y = 1 + max(int(log.output.max()) for log in logs)
    scale = np.array([_rms(logs, j) for j in range(n_y)])
    step = float(np.median([_bin(log) for log in logs]))
    span = float(np.median([np.ptp(log.time) for log in logs]))
    mean, sd = _hyper_prior(n_y, scale, step, span)

    blocks = [_Block(log, at) for log in logs]

    def cost(z: Array) -> tuple[float, Array]:
        value, slope = _evidence(mean + sd * z, blocks, n_y)
        return 0.5 * float(z @ z) - value, z - sd * slope

    start, limits = np.zeros(mean.size), [(-4.0, 4.0)] * mean.size
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 60})
    return _unpack(mean + sd * found.x, n_y)


def marginal_likelihood(
    discrepancy: Discrepancy, logs: Sequence[LogResiduals], at: Array | None = None
) -> float:
    """Return the log likelihood of all residuals, all free parameters integrated out over their prior."""
    n_free = logs[0].sensitivity.shape[1]
    information, pull, total = np.eye(n_free), np.zeros(n_free), 0.0
    for log in logs:
        root = cholesky(discrepancy.covariance(log), lower=True, check_finite=False)
        # the residual that the prior mean would leave: the prior is centred there
        about = log.residual if at is None else log.residual + log.sensitivity @ at
        whole = np.column_stack([about, log.sensitivity])
        whole = solve_triangular(root, whole, lower=True, check_finite=False)
        e, b = whole[:, 0], whole[:, 1:]
        information += b.T @ b
        pull += b.T @ e
        total -= 0.5 * float(e @ e) + float(np.log(np.diag(root)).sum()) + 0.5 * e.size * np.log(2 * np.pi)
    factor = cho_factor(information, lower=True)
    total += 0.5 * float(pull @ cho_solve(factor, pull)) - float(np.log(np.diag(factor[0])).sum())
    return total


def log_jackknife(discrepancy: Discrepancy, logs: Sequence[LogResiduals], at: Array) -> float:
    """Return f: how much more a left-out log moves the parameters than the covariance says, at least 1.

    With P = 1 + sum H_l the information of all logs, leaving out log l moves the estimate by d, whose
    covariance should be (P - H_l)^-1 - P^-1.  Along the eigenvectors of H_l against P - H_l it is
    lam / (1 + lam), so the mean of d^2 (1 + lam) / lam over all logs and all directions of which a log tells
    something (lam > 0.1)
    should be 1; it is f^2.

    Parameters
    ----------
    discrepancy : Discrepancy
        Not widened.
    logs : sequence of LogResiduals
    at : (n_free,) ndarray
        Where they are linearised.

    Returns
    -------
    inflation : float
        1 for fewer than three logs, from which nothing can be learnt.
    """
    if len(logs) < 3:
        return 1.0
    information, pulls = [], []
    for log in logs:
        root = cholesky(discrepancy.covariance(log), lower=True)
        b = solve_triangular(root, log.sensitivity, lower=True)
        information.append(b.T @ b)
        pulls.append(b.T @ solve_triangular(root, log.residual + log.sensitivity @ at, lower=True))
    whole, pull = np.eye(at.size) + np.sum(information, axis=0), np.sum(pulls, axis=0)
    ratios: list[float] = []
    for h, g in zip(information, pulls):
        rest = whole - h
        moved = np.linalg.solve(rest, pull - g) - np.linalg.solve(whole, pull)
        lam, axes = eigh(h, rest)
        along = axes.T @ rest @ moved
        told = lam > 0.1
        ratios += ((along**2)[told] * (1 + lam[told]) / lam[told]).tolist()
    return max(1.0, float(np.sqrt(np.mean(ratios)))) if ratios else 1.0


class _Block:
    """What does not change while the numbers of the covariance are learnt."""

    def __init__(self, log: LogResiduals, at: Array | None) -> None:
        self.log = log
        self.residual = log.residual if at is None else log.residual + log.sensitivity @ at
        self.lag = np.abs(log.time[:, None] - log.time[None])
        self.same = log.output[:, None] == log.output[None]
        self.fixed = np.diag(log.noise**2) + log.local @ log.local.T

    def parts(self, numbers: Discrepancy) -> tuple[Array, list[Array]]:
        """Return the covariance and what each component adds to it."""
        out, parts = self.fixed.copy(), []
        for tau, sd, correlation in zip(numbers.tau, numbers.sd, numbers.correlation):
            scale = np.asarray(sd)[self.log.output]
            part = _memory(self.lag, tau) * np.where(self.same, 1.0, correlation) * np.outer(scale, scale)
            out += part
            parts.append(part)
        return out, parts


def _evidence(v: Array, blocks: Sequence[_Block], n_y: int) -> tuple[float, Array]:
    """Return the marginal likelihood and its gradient in the unconstrained numbers.

    With K the covariance, the parameters' share included, and a = K^-1 r, the slope is
    tr[(a a' - K^-1) dK] / 2; K is block diagonal plus low rank, so only its diagonal blocks are ever formed.
    """
    numbers = _unpack(v, n_y)
    n_free = blocks[0].log.sensitivity.shape[1]
    information, pull, total, kept = np.eye(n_free), np.zeros(n_free), 0.0, []
    for block in blocks:
        covariance, parts = block.parts(numbers)
        inverse, log_det = _inverse(covariance)
        weighted = inverse @ block.log.sensitivity
        a = inverse @ block.residual
        information += block.log.sensitivity.T @ weighted
        pull += weighted.T @ block.residual
        total -= 0.5 * (float(block.residual @ a) + log_det + a.size * np.log(2 * np.pi))
        kept.append((block, parts, inverse, weighted, a))
    spread, log_det = _inverse(information)
    total += 0.5 * float(pull @ spread @ pull) - 0.5 * log_det
    slope = np.zeros(v.size)
    for block, parts, inverse, weighted, a in kept:
        alpha = a - weighted @ (spread @ pull)
        both = 0.5 * (np.outer(alpha, alpha) - inverse + weighted @ spread @ weighted.T)
        slope += _slopes(v, numbers, block, parts, both, n_y)
    return total, slope


def _slopes(
    v: Array, numbers: Discrepancy, block: _Block, parts: Sequence[Array], both: Array, n_y: int
) -> Array:
    """Return one log's share of the gradient, in the order of :func:`_unpack`."""
    out = np.zeros(v.size)
    for k, (part, tau) in enumerate(zip(parts, numbers.tau)):
        pressed = both * part
        out[k] = float((pressed * block.lag).sum()) / tau
        by_row = pressed.sum(axis=1)
        out[2 + k * n_y : 2 + (k + 1) * n_y] = 2 * np.bincount(block.log.output, by_row, minlength=n_y)
        if n_y > 1:
            share = 0.5 + 0.5 * np.tanh(v[2 + 2 * n_y + k])
            rate = 0.999 * (1 + 1 / (n_y - 1)) * 2 * share * (1 - share)
            across = float(pressed[~block.same].sum())
            out[2 + 2 * n_y + k] = across / numbers.correlation[k] * rate
    return out


def _memory(lag: Array, tau: float) -> Array:
    """Return exp(-lag / tau), kept off the subnormal numbers that slow a factorisation down a hundredfold."""
    return np.asarray(np.maximum(np.exp(-lag / tau), 1e-12))


def _inverse(matrix: Array) -> tuple[Array, float]:
    """Return the inverse and the log determinant of a covariance."""
    root = cholesky(matrix, lower=True, check_finite=False)
    inverse, info = dpotri(root, lower=1)
    if info:
        raise np.linalg.LinAlgError("covariance is singular")
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    return inverse, 2 * float(np.log(np.diag(root)).sum())


def _hyper_prior(n_y: int, scale: Array, step: float, span: float) -> tuple[Array, Array]:
    """Return mean and sd of the unconstrained numbers: ln tau, ln sd, atanh-like correlation."""
    mean = [np.log(2 * step), np.log(max(span / 20, 4 * step))]
    sd = [0.7, 0.7]
    for _ in range(2):
        mean += list(np.log(0.5 * scale))
        sd += [1.0] * n_y
    if n_y > 1:
        mean += [0.5, 0.5]
        sd += [0.7, 0.7]
    return np.array(mean), np.array(sd)


def _unpack(v: Array, n_y: int) -> Discrepancy:
    """Return the numbers from their unconstrained form."""
    tau = (float(np.exp(v[0])), float(np.exp(v[1])))
    sd = tuple(tuple(float(a) for a in np.exp(v[2 + k * n_y : 2 + (k + 1) * n_y])) for k in range(2))
    at = 2 + 2 * n_y
    correlation: tuple[float, ...] = (0.0, 0.0)
    if n_y > 1:
        low = -1 / (n_y - 1)  # an equal correlation below this is none
        share = 0.5 + 0.5 * np.tanh(v[at : at + 2])
        correlation = tuple(float(0.999 * (low + (1 - low) * s)) for s in share)
    return Discrepancy(tau, sd, correlation)


def _rms(logs: Sequence[LogResiduals], j: int) -> float:
    """Return the rms residual of an output about each log's mean, floored well below any sensor's noise."""
    parts = [log.residual[log.output == j] for log in logs]
    return max(float(np.sqrt(np.mean(np.concatenate([p - p.mean() for p in parts if p.size]) ** 2))), 1e-6)


def _bin(log: LogResiduals) -> float:
    """Return the bin width [s]."""
    return float(np.median(np.diff(np.unique(log.time))))
