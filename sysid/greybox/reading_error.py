"""What the readings of an experiment are worth, given how a fit's readings missed it.

A fit learns the covariance of what its free runs leave (:mod:`thermogrip.sysid.greybox.noise_model`): white
noise, two memories of model error, effects that each log has for itself, and terms that the model may lack.
An experiment that is yet to come has the same.  With the sensitivities J of its bins, in the units of the
fit's residuals, it adds to a fit by least squares the Hessian A = J'J and to the covariance of its score

    V = phi (J' C J + E E'),      E = J' B,

C the learnt covariance, B the columns of the log's effects in their spreads, phi by how much more the logs of
the fit disagreed than that.  A start that a fit would estimate from the log's warm-up is known better than by
its spread (:mod:`thermogrip.sysid.greybox.random_effects`): E E' is then E H E', with H the covariance of its
error.

**Terms that may be missing** are the same in every log.  With F their responses to the experiment's inputs,
of the sizes s that were learnt, they pull the score of the new log by G = J' F s where they pulled that of
the fit by U.  The two add up before they are squared: a fit to all logs is off by the pull U + G of one and
the same term, and what a second experiment answers alike does not average out.  Leaving G out promises too
much for exactly those parameters that a missing term can pass for.

Sizes are taken afresh with every fit: in s = 1 is a response's rms over all of its logs
(:mod:`thermogrip.sysid.greybox.model_discrepancy`), for what has moved a plant much without a trace of the
term says that it is small.  An experiment that moves the plant more than the n stretches of the fit did, to
a mean square m instead of m_0, has the fit to all of them think of a term c times as large,

    c = sqrt((n + 1) / (n + m / m_0)),

with s as it was.  What s will be no design can know.  If the new log has no trace of such terms, its score is
not pulled by them: G = 0, c = 1.  If they are there, as large as in the fit, c is 1 at least, with all of G.
These are the ends of the range of a promise.

With the fit's Hessian P and covariance S (:mod:`thermogrip.sysid.greybox.sandwich`; the covariance of its
score is P S P, U U' in it), a fit to all logs would have

    (P + A)^-1 Omega (P + A)^-1,      Omega = P S P - U U' + (U + G) c c' (U + G)' + V.

In coordinates R x = theta with R R' = S, in which S is 1, the inverse of this is the gain of the experiment

    (P' + A') Omega'^-1 (P' + A'),      P' = R' P R and so on.

S has been widened by parameter for how far logs disagree, so in some direction U U' may be a little more than
P S P has; W = P'^-1 R' U, whose singular values are then above 1, is cut to 1 there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.greybox.model_discrepancy import Term
from thermogrip.sysid.greybox.noise_model import Block, ErrorModel
from thermogrip.sysid.greybox.random_effects import WarmUp, warm_noise

if TYPE_CHECKING:
    from thermogrip.sysid.plant.fit_record import ErrorNumbers
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["Experiment", "Missing", "ReadingError", "error_model_of", "learnt_error"]

Array = NDArray[np.float64]
Missing = Literal["sized anew", "absent", "as learnt"]

_TINY = 1e-9  # keeps the score's covariance invertible where a direction is told by nothing


@dataclass(frozen=True, eq=False)
class Experiment:
    """What moves the outputs of an experiment."""

    rise: Array  # (n, N, n_y), sensitivities to the whitened parameters
    effects: Array  # (n_effect, N, n_y), at one sd of each effect other than start and sensor offsets
    starts: Array  # (n_start, N, n_y), what its start does at one spread
    lagged: Array  # (n_term, N), the lagged signal of each term that may be missing
    dt: float  # time between rows [s]
    warm_up: float  # seconds from which a fit would estimate the start, 0 where it does not


@dataclass(frozen=True, eq=False)
class ReadingError:
    """A fit's error model, ready for another log."""

    numbers: ErrorModel
    hessian: Array  # P of theta, (n_free, n_free)
    unit: Array  # (n_y,), one residual of the fit in the unit of the output
    sensor: Array  # (n_y,), sd of a reading that a start is estimated with, in the unit of the output
    bin_s: float  # width of a bin of ``numbers`` [s]
    merge: float  # residuals of the fit that one bin stands for
    phi: float  # by how much the logs of the fit disagreed beyond ``numbers``
    offset: Array  # (n_y,), spread of the outputs' offsets over logs
    bias: Array  # (n_d,), spread of the measured disturbances' biases over logs
    own: Array  # (n_free,), spread of theta over logs; 0 for what all logs share
    terms: tuple[Term, ...]  # that may be missing, each of the size that the fit learnt
    pull: Array  # U, (n_free, n_term), contribution of each term to the score of the fit
    stretches: int  # of the logs of the fit

    def gain(self, root: Array, new: Experiment, missing: Missing = "sized anew") -> Array:
        """Return the inverse (n, n) of the covariance of the whitened parameters after an experiment."""
        hessian, spread, pull = self._added(new)
        before = root.T @ self.hessian @ root
        after, shared = before + hessian, self._shared(before, root)
        alone = np.eye(len(root)) - shared @ shared.T
        both = before @ shared
        if missing != "absent":
            both = (both + pull) * self._resized(new.lagged, missing)
        score = before @ alone @ before + both @ both.T + spread + _TINY * np.eye(len(root))
        return np.asarray(after @ np.linalg.solve(score, after))

    def _resized(self, lagged: Array, missing: Missing) -> Array:
        """Return c (n_term,)."""
        louder = np.mean(lagged**2, axis=1) / np.square([term.rms for term in self.terms])
        anew = np.sqrt((self.stretches + 1) / (self.stretches + louder))
        return np.asarray(np.maximum(anew, 1.0) if missing == "as learnt" else anew)

    def _shared(self, before: Array, root: Array) -> Array:
        """Return W (n, n_term), of singular values up to 1."""
        if not self.terms:
            return np.zeros((len(root), 0))
        left, size, right = np.linalg.svd(np.linalg.solve(before, root.T @ self.pull), full_matrices=False)
        return np.asarray((left * np.minimum(size, 1.0)) @ right)

    def _added(self, new: Experiment) -> tuple[Array, Array, Array]:
        """Return A and V (n, n) and G (n, n_term) of the experiment."""
        n, rows, n_y = new.rise.shape
        sizes = np.array([term.size for term in self.terms]).reshape(-1, n_y)
        missing = np.einsum("kt,kj->ktj", new.lagged, sizes)
        offsets = np.zeros((n_y, rows, n_y))
        offsets[np.arange(n_y), :, np.arange(n_y)] = self.offset[:, None]
        columns = np.concatenate([new.rise, missing, new.effects, offsets, new.starts]) / self.unit
        m = max(1, round(self.bin_s / new.dt))
        n_bin, q = rows // m, len(missing)
        if n_bin < 2:
            return np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, q))
        bins = columns[:, : n_bin * m].reshape(len(columns), n_bin, m, n_y).mean(axis=2)
        whole = self.merge * bins[:n].reshape(n, -1) @ bins.reshape(len(bins), -1).T
        block = Block.of(bins[:n].transpose(1, 2, 0), range(n_y))
        noise = self.merge**2 * np.tensordot(block.covariance(self.numbers), block.products, axes=3)
        begin = n + q + len(new.effects)  # of the start
        own, start = whole[:, n + q : begin], whole[:, begin:]
        left = self._start_error(bins[begin:], new.warm_up)
        spread = noise + own @ own.T + start @ left @ start.T
        return whole[:n, :n], self.phi * spread, whole[:, n : n + q]

    def _start_error(self, bins: Array, warm_up: float) -> Array:
        """Return H (k, k) of offsets and start, of which these are the bins (k, n_bin, n_y)."""
        n = min(max(1, round(warm_up / self.bin_s)), bins.shape[1])
        if not warm_up:
            return np.eye(len(bins))
        noise = warm_noise(warm_up, self.bin_s) * self.sensor / self.unit
        first = WarmUp((), bins[:, :n].transpose(1, 2, 0), tuple(range(bins.shape[2])), noise)
        return first.error(self.numbers, np.ones(len(bins)))


def error_model_of(numbers: ErrorNumbers) -> ErrorModel:
    """Return the error model that a fit has written into ``scores.intervals.numbers`` of its plant."""
    return ErrorModel(numbers.white, numbers.tau, numbers.sd, numbers.correlation, numbers.spread)


def learnt_error(plant: Plant) -> ReadingError | None:
    """Return what the plant's fit learnt of its error, None where it learnt nothing."""
    intervals = plant.scores.intervals
    if intervals is None or intervals.numbers is None or plant.covariance is None:
        return None
    numbers, spread, terms = intervals.numbers, intervals.spread_over_logs, intervals.terms
    sensor: Mapping[str, float] = getattr(plant.model, "sensor_sd", {})
    return ReadingError(
        error_model_of(numbers),
        np.array(intervals.hessian, dtype=float),
        np.array(numbers.unit, dtype=float),
        np.array([sensor[name] for name in plant.outputs], dtype=float),
        numbers.bin_s,
        float(numbers.merge),
        max(intervals.between_logs, 1.0),
        np.array([spread.get(f"offset of {name}", 0.0) for name in plant.outputs]),
        np.array([spread.get(f"bias of {name}", 0.0) for name in plant.disturbances]),
        np.array([spread.get(name, 0.0) for name in plant.free]),
        tuple(Term(t.signal, t.lag_s, np.array(t.size), t.rms) for t in terms),
        np.array(intervals.pull, dtype=float) if terms else np.zeros((len(plant.free), 0)),
        intervals.stretches,
    )
