"""Responses that stand for what a model lacks, whatever it is.

A wall that was left out, a dead zone, a resistance that rises with temperature: each answers the inputs in
every log alike, so its effect on the parameters does not average out over logs, and logs that agree with
each other say nothing of it.  Which term is missing is not known (or it would be there), so a bank of
responses stands for all of them: every input u, its size |u|, u v, v |v| and every disturbance, with v the
first output above the ambient (else about its mean), each through first-order lags of 2, 8 and 32 bins, on
all outputs alike: heat that one sensor sees the others see too.

How large each kind is, the error model learns from the residuals (:mod:`thermogrip.sysid.error_model`): one
s per signal, log-normal beforehand; with s = 1 all of them together have an rms of half a sensor's standard
deviation.  Where residuals do not follow the inputs it shrinks to nothing, and so does what it adds to the
intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from thermogrip.sysid.greybox_problem import Problem

__all__ = ["missing_terms"]

Array = NDArray[np.float64]
Parts = list[list[list[Array]]]  # by log, stretch and output

_LAGS = (2.0, 8.0, 32.0)  # [bins]
_SIZE = 0.5  # rms of all responses together with s = 1, in sd of a bin


def missing_terms(problem: Problem, runs: Sequence[Sequence[Array]]) -> list[tuple[str, Parts]]:
    """Return the responses with the names of their signals, in the units of the readings.

    Parameters
    ----------
    problem : Problem
    runs : by log and stretch, (N + 1, n_y) ndarray
        Free runs of the fit.
    """
    signals = [
        [_signals(problem, stretch.u, stretch.d, run) for stretch, run in zip(stretches, of_log)]
        for (stretches, _), of_log in zip(problem.logs, runs)
    ]
    names = [name for name in signals[0][0] if not _is_twin(name, signals)]
    out = []
    for name in names:
        for lag in _LAGS:
            keep = np.exp(-problem.plant.dt / (lag * problem.average))
            slow = [
                [np.append(0.0, lfilter([1 - keep], [1, -keep], stretch[name])) for stretch in of_log]
                for of_log in signals
            ]
            out.append((name, _on_all(problem, slow, _SIZE / np.sqrt(len(names) * len(_LAGS)))))
    return [(name, parts) for name, parts in out if any(p.any() for log in parts for k in log for p in k)]


def _on_all(problem: Problem, slow: list[list[Array]], rms: float) -> Parts:
    """Return the response of all outputs by log, stretch and output, of this rms [sd of a bin]."""
    means = [
        [[operator @ signal for operator in cells.operators] for signal, cells in zip(of_log, bins)]
        for of_log, (_, bins) in zip(slow, problem.logs)
    ]
    squares = [float(np.mean(part**2)) for log in means for stretch in log for part in stretch if part.size]
    size = float(np.sqrt(np.mean(squares))) if squares else 0.0
    factor = rms * problem.sd / size if size > 1e-9 else np.zeros(len(problem.sd))
    return [[[f * part for f, part in zip(factor, stretch)] for stretch in log] for log in means]


def _signals(problem: Problem, u: Array, d: Array, run: Array) -> dict[str, Array]:
    """Return what a missing term may answer, each (N,), by name."""
    v = run[:-1, 0] - (d[:, 0] if d.shape[1] else float(run[:, 0].mean()))
    out = {"v |v|": v * np.abs(v)}
    for k, name in enumerate(problem.model.inputs):
        out |= {name: u[:, k], f"{name} v": u[:, k] * v}
        if name not in problem.model.switches:
            out[f"|{name}|"] = np.abs(u[:, k])
    for k, name in enumerate(problem.model.disturbances):
        out[f"{name} "] = d[:, k] - d[0, k]
    return out


def _is_twin(name: str, signals: list[list[dict[str, Array]]]) -> bool:
    """Say whether this is the size of an input that is never negative."""
    if not name.startswith("|"):
        return False
    return all(np.array_equal(part[name], part[name[1:-1]]) for of_log in signals for part in of_log)
