"""What moves the residuals besides the parameters: random effects of each log, and model discrepancy.

**Random effects.** Beside the shared parameters each log has, with the stated sd,

    offset of an output   of its readings: ``log_sd`` of the sensor
    bias of an ambient    of the measured disturbance: ``log_sd`` of the sensor
    start                 of the state at its first row: the model's ``spread``
    a parameter           one with ``per_log`` in the network (relative if it is positive)

**Model discrepancy** responds to the inputs in every log alike and does not average out over logs. A bank of
responses represents all that may be missing, each through first-order lags, on all outputs alike; the error
model learns one s per signal from the residuals. Without it intervals are 0.82 times as wide and cover 3 per
cent less (48 simulated rigs of ``benchmarks/coverage``; of one log 8 per cent less).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.greybox.noise_model import Block, LogData
from thermogrip.sysid.greybox.problem import Problem
from thermogrip.sysid.models.model import Model
from thermogrip.sysid.models.state_space import symmetric_root
from thermogrip.sysid.plant.simulation import Start, predict


@dataclass(frozen=True)
class EffectSettings:
    """Sizes and lengths of effects."""

    lags: tuple[float, ...] = (2.0, 8.0, 32.0)  # of the responses [bins]
    discrepancy_rms: float = 0.5  # of all responses together with s = 1, in sd of a bin
    measured_offset_sd: float = 0.05  # [K] what a start at rest leaves unknown: rounding, a room not uniform
    start_after_gap: float = 3.0  # times as uncertain as the first start: its input's change is timed
    most_bins: int = 400  # of a stretch; more are averaged
    least_read: float = 0.5  # of a stretch's bins, that an output must have
    least_mode: float = 0.02  # sd of a bin: a start that moves no bin by more is left out
    least_bins: int = 3  # of a stretch


EFFECTS = EffectSettings()


def discrepancy_responses(problem: Problem, runs: Sequence[Sequence[Array]]) -> list[tuple[str, list[Array]]]:
    """Return what the responses with s = 1 do to the residuals of each log, with the names of signals."""
    signals_of = [
        [signals(problem.model, stretch.u, stretch.d, run) for stretch, run in zip(stretches, of_log)]
        for (stretches, _), of_log in zip(problem.logs, runs)
    ]
    stretches_of = [stretch for of_log in signals_of for stretch in of_log]
    names = [
        name
        for name in stretches_of[0]
        # the size of an input that is never negative is that input
        if not name.startswith("|") or any(np.any(one[name] != one[name[1:-1]]) for one in stretches_of)
    ]
    rms = EFFECTS.discrepancy_rms / np.sqrt(len(names) * len(EFFECTS.lags))
    out = [
        (name, _response(problem, signals_of, name, lag * problem.average, rms))
        for name in names
        for lag in EFFECTS.lags
    ]
    return [(name, moves) for name, moves in out if any(moved.any() for moved in moves)]


def signals(model: Model, u: Array, d: Array, run: Array) -> dict[str, Array]:
    """Return the signals (N,) to which the discrepancy may respond, by name."""
    # every input u, its size |u|, u v, v |v| and every disturbance, v the first output above the ambient,
    # else about its mean
    v = run[:-1, 0] - (d[:, 0] if d.shape[1] else float(run[:, 0].mean()))
    out = {"v |v|": v * np.abs(v)}
    for k, name in enumerate(model.inputs):
        out |= {name: u[:, k], f"{name} v": u[:, k] * v}
        if name not in model.switches:
            out[f"|{name}|"] = np.abs(u[:, k])
    for k, name in enumerate(model.disturbances):
        out[f"{name} "] = d[:, k] - d[0, k]
    return out


def _response(
    problem: Problem, signals_of: Sequence[Sequence[Mapping[str, Array]]], name: str, lag: float, rms: float
) -> list[Array]:
    """Return the response by log to a signal behind a lag [s], of this rms [sd of a bin]."""
    keep = np.exp(-problem.plant.dt / lag)
    means = []
    for of_log, (_, bins) in zip(signals_of, problem.logs):
        lagged = [np.append(0.0, lfilter([1 - keep], [1, -keep], one[name])) for one in of_log]
        means.append([[operator @ slow for operator in cells.operators] for cells, slow in zip(bins, lagged)])
    squares = [float(np.mean(mean**2)) for log in means for stretch in log for mean in stretch if mean.size]
    size = float(np.sqrt(np.mean(squares))) if squares else 0.0
    gains = rms * problem.sd / size if size > 1e-9 else np.zeros(len(problem.sd))
    return [
        _residuals(problem, [[gain * mean for gain, mean in zip(gains, stretch)] for stretch in log])
        for log in means
    ]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Logs as the error model takes them, and what was put in."""

    logs: list[LogData]
    kinds: list[str]  # responses and random effects that are estimated, each of one sd over all logs
    n_responses: int  # the first of ``kinds`` are of the model discrepancy
    n_shared: int  # columns that logs share: parameters, then responses
    bin_s: float  # width of a bin [s]


@dataclass(frozen=True, eq=False)
class _Column:
    """Something that moves the residuals of one log."""

    name: str  # empty of a start
    moves: Array  # (m_log,), at the stated sd


def linearise_logs(problem: Problem, z: Array, by_log: Sequence[tuple[Array, Array]]) -> Linearised:
    """Return residuals, sensitivities and effects of each log at ``z``."""
    starts, p = problem.start(z), problem.parameters(z[None])
    longest = max(_n_bins(problem, i, k) for i, (s, _) in enumerate(problem.logs) for k in range(len(s)))
    merge = max(1, int(np.ceil(longest / EFFECTS.most_bins)))  # bins averaged to one
    runs = [_simulations(problem, log_index, p, begin) for log_index, begin in enumerate(starts)]
    discrepancy = discrepancy_responses(problem, runs)
    signals_of = list(dict.fromkeys(f"term {signal}" for signal, _ in discrepancy))
    shared = [-1] * z.size + [signals_of.index(f"term {signal}") for signal, _ in discrepancy]
    logs: list[LogData] = []
    effects_of_logs: list[list[_Column]] = []
    for log_index, (r, jacobian) in enumerate(by_log):
        effects = _log_effects(problem, log_index, p, starts[log_index], jacobian)
        alike = [moves[log_index] for _, moves in discrepancy]
        columns = np.column_stack([jacobian, *alike, *(effect.moves for effect in effects), -r])
        blocks, begin = [], 0
        for k, cells in enumerate(problem.logs[log_index][1]):
            ends = begin + np.cumsum([mean.size for mean in cells.means])
            by_output = np.split(columns[begin : ends[-1]], ends[:-1] - begin)
            blocks += _binned_block(problem, log_index, k, merge, by_output)
            begin = int(ends[-1])
        if blocks:
            kind = np.array(shared + [-1] * len(effects), dtype=np.int64)
            effects_of_logs.append(effects)
            logs.append(LogData(tuple(blocks), kind, len(effects)))
    kinds = [*signals_of, *dict.fromkeys(c.name for log in effects_of_logs for c in log if c.name)]
    for log, effects in zip(logs, effects_of_logs):
        log.kind[len(shared) :] = [kinds.index(c.name) if c.name else -1 for c in effects]
    return Linearised(logs, kinds, len(signals_of), len(shared), merge * problem.average)


def _simulations(problem: Problem, at: int, p: Array, starts: list[Start]) -> list[Array]:
    """Return the free run (N + 1, n_y) of each stretch."""
    return [run[0] for run in predict(problem.model, problem.plant.dt, p, problem.logs[at][0], starts)]


def _log_effects(problem: Problem, at: int, p: Array, starts: list[Start], slopes: Array) -> list[_Column]:
    """Return everything that is the log's own."""
    plant, (stretches, bins) = problem.plant, problem.logs[at]
    # a log that began at rest has measured its sensors' offsets in its first seconds
    most = EFFECTS.measured_offset_sd if starts[0].level is not None else np.inf
    out = []
    for j, name in enumerate(plant.outputs):
        spread = min(plant.nuisance.get(name, 0.0), most)
        if spread > 0:
            moves = [
                [np.full(mean.size, spread if k == j else 0.0) for k, mean in enumerate(cells.means)]
                for cells in bins
            ]
            out.append(_Column(f"offset of {name}", _residuals(problem, moves)))
    for j, name in enumerate(plant.disturbances):
        spread = min(plant.nuisance.get(name, 0.0), most)
        if spread > 0:
            of_one = spread * (np.arange(len(plant.disturbances)) == j)
            lower = [replace(s, d_offset=s.d_offset + of_one) for s in starts]  # the truth, below the reading
            measured, biased = (_simulations(problem, at, p, begin) for begin in (starts, lower))
            moves = [
                [np.asarray(operator @ (b[:, k] - a[:, k])) for k, operator in enumerate(cells.operators)]
                for a, b, cells in zip(measured, biased, bins)
            ]
            out.append(_Column(f"bias of {name}", _residuals(problem, moves)))
    specs = list(problem.model.specs.values())
    for i, place in enumerate(problem.free):
        spread = specs[place].per_log or 0.0
        if spread > 0:
            out.append(_Column(problem.model.parameters[place], slopes[:, i] * spread / problem.width[i]))
    for k in range(len(stretches)):
        out += _of_start(problem, at, k, p, starts[k])
    return out


def _of_start(problem: Problem, at: int, k: int, p: Array, start: Start) -> list[_Column]:
    """Return what an uncertain start of stretch k does, where it matters, without a name."""
    stretches, bins = problem.logs[at]
    root = symmetric_root(problem.model.spread) * (1.0 if k == 0 else EFFECTS.start_after_gap)
    # a tenth of a spread: a state near a limit must not cross it
    x0 = np.vstack([start.x0, start.x0 + 0.1 * root.T])
    d = stretches[k].d - start.d_offset
    y, _ = problem.model.rollout(x0, stretches[k].u[None], d[None], p, problem.plant.dt)
    change = 10.0 * (y[1:] - y[0])  # (n_x, N + 1, n_y)
    scaled = [o @ change[:, :, j].T / problem.sd[j] for j, o in enumerate(bins[k].operators)]
    stacked = np.nan_to_num(np.vstack(scaled))
    modes = stacked @ np.linalg.eigh(stacked.T @ stacked)[1]
    modes = modes[:, np.abs(modes).max(axis=0, initial=0.0) > EFFECTS.least_mode]
    ends = np.cumsum([bins_of_output.shape[0] for bins_of_output in scaled])[:-1]
    nothing = [[np.zeros(mean.size) for mean in cells.means] for cells in bins]
    out = []
    for mode in modes.T:
        moves = [bins_of_output * sd for bins_of_output, sd in zip(np.split(mode, ends), problem.sd)]
        out.append(_Column("", _residuals(problem, [*nothing[:k], moves, *nothing[k + 1 :]])))
    return out


def _residuals(problem: Problem, parts: list[list[Array]]) -> Array:
    """Return what moves the bins of a log by stretch and output, in the order and units of its residuals."""
    return np.concatenate([problem.scaled(k, bins) for stretch in parts for k, bins in enumerate(stretch)])


def _n_bins(problem: Problem, at: int, k: int) -> int:
    return max((int(place[-1]) + 1 for place in problem.logs[at][1][k].places if place.size), default=0)


def _binned_block(problem: Problem, at: int, k: int, merge: int, columns: list[Array]) -> list[Block]:
    """Return stretch k of a log, its columns by output, on a regular grid of bins; none where it is too
    short."""
    places, n = problem.logs[at][1][k].places, _n_bins(problem, at, k) // merge * merge
    outputs = [j for j, place in enumerate(places) if n and place.size >= EFFECTS.least_read * n]
    if not outputs or n < EFFECTS.least_bins * merge:
        return []
    grids = []
    for j in outputs:
        # linear between the bins that were read, held beyond
        grid = np.column_stack([np.interp(np.arange(n), places[j], column) for column in columns[j].T])
        grids.append(grid.reshape(-1, merge, grid.shape[1]).mean(axis=1))
    return [Block.of(np.stack(grids, axis=1), outputs)]
