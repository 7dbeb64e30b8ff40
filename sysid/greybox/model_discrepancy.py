"""Responses that stand for what a model lacks, whatever it is.

A wall that was left out, a dead zone, a resistance that rises with temperature: each answers the inputs in
every log alike, so its effect on the parameters does not average out over logs, and logs that agree with
each other say nothing of it.  Which term is missing is not known (or it would be there), so a bank of
responses stands for all of them: every input u, its size |u|, u v, v |v| and every disturbance, with v the
first output above the ambient (else about its mean), each through first-order lags of 2, 8 and 32 bins, on
all outputs alike: heat that one sensor sees the others see too.

How large each kind is, the error model learns from the residuals
(:mod:`thermogrip.sysid.greybox.noise_model`): one s per signal, log-normal beforehand; with s = 1 all of
them together have an rms of half a sensor's standard deviation.  Where residuals do not follow the inputs it
shrinks to nothing, and so does what it adds to the intervals.

A response that a fit has learnt the size of may be there in the next log just as well, so an experiment that
is yet to come is foretold with the same ones (:mod:`thermogrip.sysid.greybox.reading_error`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from thermogrip.sysid.greybox.problem import Problem

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model

__all__ = ["Term", "missing_terms", "signals"]

Array = NDArray[np.float64]
Parts = list[list[list[Array]]]  # by log, stretch and output

_LAGS = (2.0, 8.0, 32.0)  # [bins]
_SIZE = 0.5  # rms of all responses together with s = 1, in sd of a bin


@dataclass(frozen=True, eq=False)
class Term:
    """One response."""

    signal: str  # what it answers, a name of :func:`signals`
    lag: float  # [s]
    size: Array  # (n_y,), what a signal of 1 that stays does to each output, in its unit
    rms: float  # of the lagged signal, over the logs that gave the size

    def lagged(self, given: Mapping[str, Array], dt: float) -> Array:
        """Return the lagged signal (N + 1,) of the signals (N,) every ``dt`` seconds."""
        keep = np.exp(-dt / self.lag)
        return np.append(0.0, lfilter([1 - keep], [1, -keep], given[self.signal]))


def missing_terms(problem: Problem, runs: Sequence[Sequence[Array]]) -> list[tuple[Term, Parts]]:
    """Return the responses with s = 1, and each by log, stretch and output in the units of the readings."""
    given = [
        [signals(problem.model, stretch.u, stretch.d, run) for stretch, run in zip(stretches, of_log)]
        for (stretches, _), of_log in zip(problem.logs, runs)
    ]
    names = [name for name in given[0][0] if not _is_twin(name, given)]
    rms = _SIZE / np.sqrt(len(names) * len(_LAGS))
    out = [_of_rms(problem, given, name, lag * problem.average, rms) for name in names for lag in _LAGS]
    return [(term, parts) for term, parts in out if any(p.any() for log in parts for k in log for p in k)]


def signals(model: Model, u: Array, d: Array, run: Array) -> dict[str, Array]:
    """Return what a missing term may answer, each (N,), by name."""
    v = run[:-1, 0] - (d[:, 0] if d.shape[1] else float(run[:, 0].mean()))
    out = {"v |v|": v * np.abs(v)}
    for k, name in enumerate(model.inputs):
        out |= {name: u[:, k], f"{name} v": u[:, k] * v}
        if name not in model.switches:
            out[f"|{name}|"] = np.abs(u[:, k])
    for k, name in enumerate(model.disturbances):
        out[f"{name} "] = d[:, k] - d[0, k]
    return out


def _of_rms(
    problem: Problem, given: Sequence[Sequence[Mapping[str, Array]]], name: str, lag: float, rms: float
) -> tuple[Term, Parts]:
    """Return the response of this rms [sd of a bin], and it by log, stretch and output."""
    plain = Term(name, lag, np.ones(1), 1.0)
    means = [
        [
            [operator @ slow for operator in cells.operators]
            for cells, slow in zip(bins, (plain.lagged(part, problem.plant.dt) for part in of_log))
        ]
        for of_log, (_, bins) in zip(given, problem.logs)
    ]
    squares = [float(np.mean(part**2)) for log in means for stretch in log for part in stretch if part.size]
    size = float(np.sqrt(np.mean(squares))) if squares else 0.0
    factor = rms * problem.sd / size if size > 1e-9 else np.zeros(len(problem.sd))
    parts = [[[f * part for f, part in zip(factor, stretch)] for stretch in log] for log in means]
    return Term(name, lag, factor, size), parts


def _is_twin(name: str, given: Sequence[Sequence[Mapping[str, Array]]]) -> bool:
    """Say whether this is the size of an input that is never negative."""
    if not name.startswith("|"):
        return False
    return all(np.array_equal(part[name], part[name[1:-1]]) for of_log in given for part in of_log)
