"""Error model of simulations, learnt from residuals: noise, slow model error, random effects of the logs.

The residuals of one stretch of log l, one row of bins per output, are linear near the optimum:

    r = J (z - z_ref) + F c + B b_l + e.

z ~ N(0, 1) are the parameters in prior units, c ~ N(0, s^2) the model discrepancy, the same in every log,
b_l ~ N(0, s^2) the random effects of the log. Columns of F and B come in kinds with one s each. e is white
noise and two slow errors of the model with correlation times tau_m.  The numbers maximise the likelihood with
z, c and all b_l integrated out (restricted maximum likelihood), under weak log-normal priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, irfft, rfft
from scipy.optimize import minimize

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.plant.plant_data import ErrorNumbers

N_SLOW = 2
_SINGLE, _GROWTH = 12, 1.2  # bands of one frequency, then wider and wider


@dataclass(frozen=True, eq=False)
class Block:
    """One stretch of a log: its products by band of frequencies."""

    n: int  # bins
    outputs: tuple[int, ...]  # which outputs it has
    # (n_band, n_y, n_y, q, q), sums over each band of x_j x_k'; columns x: parameters, effects of the log,
    # and last the residual
    products: Array

    @classmethod
    def of(cls, columns: Array, outputs: Sequence[int]) -> Block:
        """Take the columns (n, n_y, q) of a stretch by time; the last is reading less model."""
        # such a covariance is nearly diagonal in cosine coordinates: N. Ahmed, T. Natarajan, K. R. Rao,
        # "Discrete cosine transform", IEEE Trans. Computers C-23 (1974)
        waves = dct(columns, axis=0, norm="ortho")
        edges = _frequency_bands(len(columns))
        band_products = [
            np.einsum("fja,fkb->jkab", waves[a:b], waves[a:b], optimize=True) for a, b in pairwise(edges)
        ]
        return cls(len(columns), tuple(outputs), np.array(band_products))

    @property
    def sizes(self) -> Array:
        """Frequencies in each band, (n_band,)."""
        return np.diff(_frequency_bands(self.n)).astype(float)

    def covariance(self, numbers: ErrorModel) -> Array:
        """Return S (n_band, n_y, n_y) of these outputs."""
        return np.asarray(numbers.covariance(self.n)[:, self.outputs][:, :, self.outputs])


@dataclass(frozen=True, eq=False)
class LogData:
    """The blocks of one log."""

    blocks: tuple[Block, ...]
    # of each column (parameters, then effects) the index of its sd; -1: a parameter, or an effect of known sd
    kind: NDArray[np.int64]
    n_effects: int


class ErrorModel(ErrorNumbers):
    """What the numbers that a fit keeps stand for."""

    def covariance(self, n: int) -> Array:
        """Return the covariance (n_band, n_y, n_y) of a stretch of n bins."""
        # cov(e_j(t), e_k(t')) = w_j^2 [t = t'] [j = k] + sum_m R_m,jk a_mj a_mk exp(-|t - t'| / tau_m)
        return np.diag(np.square(self.white)) + sum(self.slow(n))

    def slow(self, n: int) -> list[Array]:
        """Return what each slow error adds to :meth:`covariance`."""
        weights, lag = band_weights(n), np.arange(n)
        same = np.eye(len(self.white), dtype=bool)
        out = []
        for tau, sd, correlation in zip(self.tau, self.sd, self.correlation):
            between_outputs = np.where(same, 1.0, correlation) * np.outer(sd, sd)
            out.append((weights @ np.exp(-lag / tau))[:, None, None] * between_outputs)
        return out

    def scale(self, kind: NDArray[np.int64]) -> Array:
        """Return the factor of each column: its kind's s, or 1."""
        return np.append(np.asarray(self.spread, dtype=float), 1.0)[kind]

    def describe(self, outputs: Sequence[str], bin_s: float, units: Sequence[tuple[float, str]]) -> str:
        """Return the numbers in words; ``bin_s`` [s] is the width of a bin, ``units`` what 1 is worth."""
        slow_errors = []
        for tau, sd, correlation in zip(self.tau, self.sd, self.correlation):
            sds = ", ".join(f"{name} {a * x:.2g} {unit}" for name, a, (x, unit) in zip(outputs, sd, units))
            also = f", correlation {correlation:.2f}" if len(outputs) > 1 else ""
            slow_errors.append(f"{sds} over {tau * bin_s:.0f} s{also}")
        return "model error " + "; ".join(slow_errors)


@dataclass(frozen=True, eq=False)
class Information:
    """Posterior of what the logs share (z, c), their random effects integrated out."""

    mean: Array  # (n,), posterior mean of z
    covariance: Array  # (n, n)
    effects: list[tuple[Array, Array]]  # mean and covariance of each log's own
    joint: list[Array]  # posterior covariance of z and the log's effects
    log_likelihood: float  # with all of them integrated out, up to a constant


def information(numbers: ErrorModel, logs: Sequence[LogData], ref: Array) -> Information:
    """Return the posterior with these numbers, linearised at ``ref`` (n,)."""
    log_terms = [_log_terms(numbers, log, ref) for log in logs]
    by_log, pull = np.array([p.h for p in log_terms]), np.array([p.g for p in log_terms])
    whole = np.eye(pull.shape[1]) + by_log.sum(axis=0)
    covariance = np.linalg.inv(whole)
    mean = covariance @ pull.sum(axis=0)
    total = sum(p.value for p in log_terms) + 0.5 * float(pull.sum(axis=0) @ mean)
    total -= 0.5 * float(np.linalg.slogdet(whole)[1])
    effects, joint = [], []
    for term in log_terms:
        follows = -term.inner @ term.mixed  # how an effect follows a parameter
        corner = term.inner + follows @ covariance @ follows.T
        effects.append((term.mean + follows @ mean, corner))
        joint.append(np.block([[covariance, covariance @ follows.T], [follows @ covariance, corner]]))
    return Information(mean, covariance, effects, joint, total)


def learn_error_model(logs: Sequence[LogData], ref: Array, *, width: Sequence[float]) -> ErrorModel:
    """Return the numbers that the residuals support best."""
    blocks = [block for log in logs for block in log.blocks]
    n_y, n_kind = 1 + max(max(block.outputs) for block in blocks), len(width)
    mean, sd = _hyper_prior(logs, n_y)
    mean, sd = np.append(mean, np.zeros(n_kind)), np.append(sd, width)

    def cost(v: Array) -> tuple[float, Array]:
        value, slope = _evidence(mean + sd * v, logs, ref, n_y, n_kind)
        return 0.5 * float(v @ v) - value, v - sd * slope

    start, limits = np.zeros(mean.size), [(-4.0, 4.0)] * mean.size
    optimum = minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 60, "ftol": 1e-6}
    )
    return _unpack(mean + sd * optimum.x, n_y, n_kind)


@dataclass(frozen=True, eq=False)
class _OneLog:
    """A log with its own columns integrated out: inner = (1 + B'B)^-1, mixed = B'X, mean = inner B'r."""

    h: Array
    g: Array
    value: float
    inner: Array
    mixed: Array
    mean: Array


def _scaling_matrix(numbers: ErrorModel, log: LogData, ref: Array) -> Array:
    """Return the matrix (q, q) that takes stored columns to scaled ones, the residual to that about zero."""
    take = np.diag(np.append(numbers.scale(log.kind), 1.0))
    take[: ref.size, -1] = ref  # about z = 0, the prior mean
    return take


def _log_terms(numbers: ErrorModel, log: LogData, ref: Array) -> _OneLog:
    take, n = _scaling_matrix(numbers, log, ref), len(log.kind) - log.n_effects
    products, value = np.zeros(take.shape), 0.0
    for block in log.blocks:
        S = block.covariance(numbers)
        products += np.tensordot(np.linalg.inv(S), block.products, axes=3)
        value -= 0.5 * float(block.sizes @ np.linalg.slogdet(S)[1])
    products = take.T @ products @ take
    value -= 0.5 * float(products[-1, -1])
    effect_products, right = products[n:-1, n:-1], products[:-1, -1]
    # the random effects integrated out, as the Schur complement of 1 + B'B
    local = np.eye(log.n_effects) + effect_products
    inner, mixed = np.asarray(np.linalg.inv(local)), products[n:-1, :n]
    mean = np.asarray(inner @ right[n:])
    value += 0.5 * float(right[n:] @ mean) - 0.5 * float(np.linalg.slogdet(local)[1])
    h = products[:n, :n] - mixed.T @ inner @ mixed
    return _OneLog((h + h.T) / 2, right[:n] - mixed.T @ mean, value, inner, mixed, mean)


def _evidence(v: Array, logs: Sequence[LogData], ref: Array, n_y: int, n_kind: int) -> tuple[float, Array]:
    """Return the likelihood with everything integrated out, and its slope in v."""
    numbers = _unpack(v, n_y, n_kind)
    posterior = information(numbers, logs, ref)
    slope = np.zeros(v.size)
    # in ln s of a kind, with b in units of its s and P the posterior covariance:  sum_i (E[b_i]^2 + P_ii - 1)
    by_kind = np.zeros(n_kind + 1)
    n = posterior.mean.size
    np.add.at(by_kind, logs[0].kind[:n], posterior.mean**2 + np.diag(posterior.covariance) - 1)
    for log, joint, (effects, spread) in zip(logs, posterior.joint, posterior.effects):
        np.add.at(by_kind, log.kind[n:], effects**2 + np.diag(spread) - 1)
        unexplained = np.concatenate([-posterior.mean, -effects, [1.0]])  # the residual less its explanation
        take = _scaling_matrix(numbers, log, ref)
        uncertain = np.outer(unexplained, unexplained)
        uncertain[:-1, :-1] += joint
        uncertain = take @ uncertain @ take.T
        for block in log.blocks:
            slope += _slopes(v, numbers, block, uncertain)
    slope[v.size - n_kind :] = by_kind[:n_kind]
    return posterior.log_likelihood, slope


def _slopes(v: Array, numbers: ErrorModel, block: Block, uncertain: Array) -> Array:
    """Return one block's share of the slope in the numbers of the covariance."""
    n_y = len(numbers.white)
    out = np.zeros(v.size)
    lag = np.arange(block.n)
    inverse = np.linalg.inv(block.covariance(numbers))
    # in a number v of S, with alpha = S^-1 (r - X E[z, b]) and P the posterior covariance of (z, b_l):
    # 1/2 sum_b tr[(alpha alpha' - S^-1 + S^-1 X P X' S^-1) dS/dv]
    # sum over the band of E[(r - X zcb)(r - X zcb)'] by pair of outputs
    square = np.tensordot(block.products, uncertain, axes=2)
    pressed = 0.5 * (inverse @ square @ inverse - block.sizes[:, None, None] * inverse)
    both = np.zeros((len(block.sizes), n_y, n_y))
    both[np.ix_(range(len(both)), block.outputs, block.outputs)] = pressed
    diagonal = both[:, range(n_y), range(n_y)].sum(axis=0)
    out[N_SLOW : N_SLOW + n_y] = 2 * diagonal * np.square(numbers.white)
    weights = band_weights(block.n)
    for m, slow in enumerate(numbers.slow(block.n)):
        tau, decay = numbers.tau[m], np.exp(-lag / numbers.tau[m])
        share = both * slow
        out[m] = float((share.sum(axis=(1, 2)) * (weights @ (decay * lag / tau)) / (weights @ decay)).sum())
        first_sd = N_SLOW + n_y * (1 + m)
        out[first_sd : first_sd + n_y] = 2 * share.sum(axis=(0, 2))
        if n_y > 1:
            k = N_SLOW + n_y * (1 + N_SLOW) + m
            across = float(share.sum() - share[:, range(n_y), range(n_y)].sum())
            rate = 0.999 * (1 + 1 / (n_y - 1)) * 0.5 * (1 - np.tanh(v[k]) ** 2)  # d correlation / d v
            out[k] = across / numbers.correlation[m] * rate
    return out


@lru_cache(maxsize=64)
def _frequency_bands(n: int) -> tuple[int, ...]:
    """Return the edges of the bands of n frequencies."""
    # The diagonal is smooth in f, so frequencies are taken in bands with one small matrix S_b each, and of
    # the data only the sums of products over each band are needed: a likelihood costs the same for an hour as
    # for a day.
    edges = list(range(min(n, _SINGLE) + 1))
    while edges[-1] < n:
        edges.append(min(n, max(edges[-1] + 1, int(edges[-1] * _GROWTH))))
    return tuple(edges)


@lru_cache(maxsize=64)
def band_weights(n: int) -> Array:
    """Return what takes an autocovariance to the variances in cosine coordinates."""
    # the diagonal sum_k W_fk c(k) of the autocovariance c
    basis = dct(np.eye(n), axis=0, norm="ortho")  # row f: the f-th cosine
    weights = irfft(np.abs(rfft(basis, 2 * n, axis=1)) ** 2, 2 * n, axis=1)[:, :n]
    weights[:, 1:] *= 2  # lags of either sign
    edges = _frequency_bands(n)
    out = np.array([weights[a:b].mean(axis=0) for a, b in pairwise(edges)])
    out.setflags(write=False)
    return out


def _hyper_prior(logs: Sequence[LogData], n_y: int) -> tuple[Array, Array]:
    """Return mean and sd of the unconstrained numbers: ln tau, ln w, ln a, correlations."""
    total, count = np.zeros(n_y), np.zeros(n_y)  # rms residuals about each stretch's mean, its first cosine
    for block in (block for log in logs for block in log.blocks):
        for k, j in enumerate(block.outputs):
            total[j] += block.products[1:, k, k, -1, -1].sum()
            count[j] += block.n
    scale = np.maximum(np.sqrt(total / np.maximum(count, 1)), 1e-6)
    span = float(np.median([max(block.n for block in log.blocks) for log in logs]))
    mean = [np.log(3.0), np.log(max(span / 20, 9.0)), *np.log(0.3 * scale)]
    sd = [0.7, 0.7] + [1.0] * n_y
    for _ in range(N_SLOW):
        mean += list(np.log(0.5 * scale))
        sd += [1.0] * n_y
    if n_y > 1:
        mean += [0.5] * N_SLOW
        sd += [0.7] * N_SLOW
    return np.array(mean), np.array(sd)


def _unpack(v: Array, n_y: int, n_kind: int) -> ErrorModel:
    """Return the numbers from their unconstrained form."""

    def at(k: int) -> tuple[float, ...]:
        return tuple(float(a) for a in np.exp(v[N_SLOW + k * n_y : N_SLOW + (k + 1) * n_y]))

    correlation = [0.0] * N_SLOW
    if n_y > 1:
        # an equal correlation below the lower end is none
        first, low = N_SLOW + n_y * (1 + N_SLOW), -1 / (n_y - 1)
        shares = 0.5 + 0.5 * np.tanh(v[first : first + N_SLOW])
        correlation = [float(0.999 * (low + (1 - low) * share)) for share in shares]
    tau = tuple(float(a) for a in np.exp(v[:N_SLOW]))
    spread = tuple(float(a) for a in np.exp(v[v.size - n_kind :])) if n_kind else ()
    return ErrorModel(at(0), tau, tuple(at(1 + m) for m in range(N_SLOW)), tuple(correlation), spread)
