"""Black-box fits: choose a structure, fit it to all logs, resample it to see how certain it is.

The kinds (:data:`BLACK_BOXES`) differ in the family of models
(:class:`thermogrip.sysid.blackbox.order_selection.Family`).  A black box has no parameters whose prior and
likelihood could be written down, and its errors are not white.  So the chosen structure is fitted anew to
readings that might have been: the spread of the refits estimates how the fit would differ had the same rig
been logged again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.schema import Log
from thermogrip.sysid.blackbox.order_selection import (
    MANY_ROWS,
    ORDER_MARGIN,
    Choice,
    Family,
    Fold,
    Run,
    choose,
    excess_within_noise,
    folds,
    free_run_errors,
    free_run_misses,
)
from thermogrip.sysid.data.data_quality import reading_excess
from thermogrip.sysid.plant.log_grid import MOVED, Grid, Segment, make_grid, rows_of
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import SEVERAL, PlantScores, fit_logs
from thermogrip.sysid.plant.simulation import READING_EVERY

if TYPE_CHECKING:
    from thermogrip.sysid.blackbox.order_selection import Fitted

#: The module of each kind, which is loaded where that is first fitted.
_MODULES = {
    "arx": "arx",
    "oe": "output_error",
    "armax": "noise_models",
    "bj": "noise_models",
    "subspace": "subspace",
    "parsim": "subspace",
    "sindy": "sindy",
    "neural": "neural",
}
BLACK_BOXES = tuple(_MODULES)
_SEARCHED = ("oe", "armax", "bj")  # whose searches may begin where those of fits before ended
# a refit of a neural model takes as long as its fit
RESAMPLED = ("arx", "oe", "armax", "bj", "subspace", "parsim", "sindy")

_AVERAGED = ("sindy", "neural")  # fitted at the averaged rate alone
_FEWEST_ROWS = 160  # of means over five rows: eight blocks' worth of the shortest that is held out
_MEMORIES, _MEMORY_ROWS = 32, 20  # l of the bootstrap: this part of the logs, and so many rows at least
FEWEST_RESAMPLED = 160  # rows of logs that are resampled: l is an eighth
_TRIES, _HOPELESS = 3, 8  # fits per draw; fits of which none agrees
_AGREES = 1.5  # times the error of the fit


@dataclass(frozen=True, eq=False)
class BlackBoxFit:
    """A black box fitted to all logs."""

    kind: str
    plant: Plant
    choice: Choice  # the structure with its held-out errors
    grid: Grid  # the data that it was fitted to


def family_of(kind: str) -> Family:
    """Return the family of models of a kind."""
    module = import_module(f"thermogrip.sysid.blackbox.{_MODULES[kind]}")
    family: Family = getattr(module, f"{kind}_family")
    return family


def fit_black_box(
    kind: str,
    logs: Sequence[Log],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    average: float | None = None,
    grid: Grid | None = None,
    progress: Progress | None = None,
) -> BlackBoxFit:
    """Fit one kind of :data:`BLACK_BOXES` to one or several logs.

    Where absent, signals are known by role and two steps ``average`` [s] are tried (the chosen one and the
    logs' own, or means over five rows). ``grid`` has the logs at a step that is known already. A UserError
    where there is no such kind, the data are too short, or no structure survives the held-out free run.
    """
    if kind not in BLACK_BOXES:
        raise UserError(f"no model of kind {kind!r}", hint=known_names(kind, BLACK_BOXES))
    best: tuple[float, Grid, Choice] | None = None
    refused: UserError | None = None
    if grid is not None and kind not in _AVERAGED:
        grids = [grid]  # what subspace models chose serves the others (14 public logs: no choice differs)
    else:
        grids = _grids(kind, logs, inputs, outputs, disturbances, average)
    # of few rows a search of its own for each part takes little, and may find another optimum
    many = sum(len(segment.time) for segment in grids[0].segments) > MANY_ROWS
    family = _remembering(kind, searches=many)
    for at, tried in enumerate(grids):

        def report(done: float, what: str, at: int = at) -> None:
            if progress is not None:
                progress((at + done) / len(grids), f"{kind}, {what}")

        try:
            choice = choose(tried, family, warmup=_warmup_rows(tried), progress=report)
        except UserError as error:
            refused = refused or error
            continue
        error_of_readings = float(np.hypot(choice.error, _within_steps(tried, grids)))
        if best is None or error_of_readings < best[0]:
            best = error_of_readings, tried, choice
    if best is None:
        raise refused if refused is not None else UserError(f"{kind} could not be fitted")
    chosen, choice = _with_convention(kind, *best[1:], logs, family)
    return BlackBoxFit(kind, _plant(chosen, choice, logs), choice, chosen)


def _grids(
    kind: str,
    logs: Sequence[Log],
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
    disturbances: Sequence[str] | None,
    average: float | None,
) -> list[Grid]:
    """Return the logs at the steps that are tried: the averaged one and the logs' own, or where that is the
    logs' own, five times it too."""
    # a coarse converter calls for the averaged rate, a delay for the logs' own
    first = make_grid(logs, inputs=inputs, outputs=outputs, disturbances=disturbances, average=average)
    rows = sum(len(segment.time) for segment in first.segments) * first.dt / first.native
    if average is not None or kind in _AVERAGED or rows > MANY_ROWS:
        return [first]
    if first.dt > 1.5 * first.native:
        other, usual = first.native, "the logs' own"
    elif rows >= 5 * _FEWEST_ROWS:
        other, usual = 5 * first.native, "five rows"
    else:
        return [first]
    why = f"{usual}: free runs over held-out parts err less than at {first.dt:.3g} s"
    return [first, replace(first.of(logs, average=other), why=why)]


def _within_steps(grid: Grid, grids: Sequence[Grid]) -> float:
    """Return how far the readings on the finest grid lie off the lines between those of this one."""
    finest = min(grids, key=lambda each: each.dt)
    if grid.dt == finest.dt:
        return 0.0
    squares = []
    for fine in finest.segments:
        for coarse in grid.segments:
            inside = (fine.time >= coarse.time[0]) & (fine.time <= coarse.time[-1]) & (fine.log == coarse.log)
            lines = [np.interp(fine.time[inside], coarse.time, each) for each in coarse.y.T]
            squares.append((fine.y[inside] - np.transpose(lines)) ** 2)
    missed = np.sqrt(np.nanmean(np.concatenate(squares), axis=0))
    return float(np.mean(missed / np.maximum(finest.output_spread(), 1e-9)))


def _remembering(kind: str, *, searches: bool = True) -> Family:
    """Return the family, with what its searches leave to the next ones."""
    settings: dict[str, Any] = {"searches": []} if searches and kind in _SEARCHED else {}
    return partial(family_of(kind), **settings)


def _with_convention(
    kind: str, grid: Grid, choice: Choice, logs: Sequence[Log], family: Family
) -> tuple[Grid, Choice]:
    """Return grid and choice with inputs that were applied up to their rows where that errs clearly less."""
    if grid.dt > 1.5 * grid.native or kind in _AVERAGED:
        return grid, choice
    moved = replace(grid.of(logs, ends=True), why=grid.why)
    if [fold.label for fold in folds(moved)] != [fold.label for fold in choice.folds]:
        return grid, choice  # moved by a row, an input loses a move in its first: errors do not pair
    # the same structure first: one fit a fold
    for tried in (partial(family, only=(choice.structure,)), family):
        try:
            other = choose(moved, tried, warmup=_warmup_rows(moved))
        except UserError:  # no structure of it is stable
            return grid, choice
        excess = np.log(choice.errors[choice.structure]) - np.log(other.errors[other.structure])
        if excess_within_noise(excess, ORDER_MARGIN):  # neither is richer
            return grid, choice
    return moved, other


def with_refits(fit: BlackBoxFit, n: int = 24, *, seed: int = 0, progress: Progress | None = None) -> Plant:
    """Return the plant with ``n`` refits to resampled errors, for :meth:`Plant.draw`."""
    if fit.kind not in RESAMPLED:
        raise ValueError(f"{fit.kind} is not refitted; choose from {', '.join(RESAMPLED)}")
    rows = sum(len(segment.time) for segment in fit.grid.segments)
    if rows < FEWEST_RESAMPLED:
        problem = f"{rows} rows of {fit.grid.dt:g} s are too few to resample their errors"
        raise UserError(f"{fit.kind}: {problem}", hint=f"a log of {FEWEST_RESAMPLED} rows has intervals")
    family = _remembering(fit.kind)
    rng = np.random.default_rng(seed)
    most = _AGREES * _error(fit, fit.choice.model)
    misses = _misses(fit)
    refits: list[Fitted] = []
    tried = 0
    while len(refits) < n and tried < _TRIES * n and (refits or tried < _HOPELESS):
        if progress is not None:
            progress(len(refits) / n, f"{fit.kind}, refits to resampled errors")
        memory = max(_MEMORY_ROWS, rows // _MEMORIES)
        drawn = replace(fit.grid, segments=_resampled(fit.grid.segments, misses, memory, rng))
        model, tried = family(drawn, only=(fit.choice.structure,)).get(fit.choice.structure), tried + 1
        # the structure is not chosen again, for held-out runs show how good it is; a refit that errs far more
        # over the logs than the fit does not agree with them
        if model is not None and _error(fit, model) <= most:
            refits.append(model)
    if len(refits) < n:
        raise UserError(
            f"{fit.kind}: of {tried} refits to resampled errors only {len(refits)} agree with the logs",
            hint="a smaller structure, or longer logs",
        )
    return replace(fit.plant, refits=tuple(refits))


def _resampled(
    segments: Sequence[Segment], misses: Sequence[Array], memory: float, rng: np.random.Generator
) -> tuple[Segment, ...]:
    """Return the segments with resampled readings, one course w for all outputs, l so many rows."""
    from scipy.signal import oaconvolve  # half a second

    # a Gaussian filter of sd sigma leaves white noise the correlation exp(-(t - s)^2 / (4 sigma^2))
    # X. Shao, "The dependent wild bootstrap", Journal of the American Statistical Association 105 (2010)
    sigma = memory / 2
    pad = int(4 * sigma)
    gaussian = np.exp(-0.5 * (np.arange(-pad, pad + 1) / sigma) ** 2)
    gaussian /= np.linalg.norm(gaussian)  # so that white noise keeps its variance
    out = []
    for segment, miss in zip(segments, misses):
        noise = rng.standard_normal(len(segment.time) + 2 * pad)
        w = oaconvolve(noise, gaussian, mode="valid")
        # the free run of the fit plus its error times a random course w of mean 0, variance 1 and the
        # correlation exp(-(t - s)^2 / l^2), l longer than the errors are correlated
        out.append(replace(segment, y=segment.y + miss - miss * w[:, None]))
    return tuple(out)


def _error(fit: BlackBoxFit, model: Fitted) -> float:
    """Return the free-run error over all logs, the worst output's, in units of its spread."""
    return float(np.max(free_run_errors(model, [Run(s) for s in fit.grid.segments], **_run_settings(fit))))


def _misses(fit: BlackBoxFit) -> list[Array]:
    settings = _run_settings(fit)
    return [free_run_misses(fit.choice.model, segment, **settings)[0] for segment in fit.grid.segments]


def white_error(fit: BlackBoxFit) -> float:
    """Return the part of the error over all logs that is white, which no model would predict, as a mean over
    the outputs in their spreads."""
    scale = np.maximum(fit.grid.output_spread(), 1e-9)
    differences = np.concatenate([np.diff(miss, n=2, axis=0) for miss in _misses(fit)])
    # the variance of second differences is six times that of white noise
    return float(np.mean(np.sqrt(np.nanmean(differences**2, axis=0) / 6) / scale))


def _run_settings(fit: BlackBoxFit) -> dict[str, Any]:
    grid, warmup = fit.grid, max(2, min(50, min(len(s.time) for s in fit.grid.segments) // 4))
    scale = np.maximum(grid.output_spread(), 1e-9)
    return {"dt": grid.dt, "scale": scale, "warmup": warmup, "priors": [fit.choice.prior]}


def _warmup_rows(grid: Grid) -> int:
    """Return the number of readings that set the state: 5 s of whole logs, 50 samples of parts of a log."""
    seconds = 5.0 if len(grid.logs) >= SEVERAL else 50 * grid.native
    most = sum(len(segment.time) for segment in grid.segments) // 16  # of a short log, a quarter of a block
    return max(2, min(round(seconds / grid.dt), most))


def _untested(grid: Grid, parts: Sequence[Fold]) -> dict[str, float]:
    """Return the inputs that move in no part held out of a rest that moves them: 0 where one has its value of
    98 percent of the rows, which is part of the operating point, else 1."""
    u = np.concatenate([segment.u for segment in grid.segments])
    least, tested = MOVED * np.ptp(u, axis=0), np.zeros(u.shape[1], dtype=bool)
    for part in parts:
        if part.runs and part.train.segments:
            tested |= np.all(part.moves(least), axis=0)
    moved = np.ptp(np.percentile(u, (1, 99), axis=0), axis=0) > least
    unsure = moved | (not moved.any())  # what the readings show are then these few rows
    return {
        name: float(unsure[k])
        for k, name in enumerate(grid.inputs)
        if not tested[k] and name not in grid.switches
    }


def _plant(grid: Grid, choice: Choice, logs: Sequence[Log]) -> Plant:
    scale = np.maximum(grid.output_spread(), 1e-9)
    rows, prior = choice.warmup, choice.prior
    # a simulation counts one independent reading in 10 s, the choice counted every row
    independent = min(1 + rows * grid.dt / READING_EVERY, rows + 1) / (rows + 1)
    noise, nuisance = prior.noise * scale * np.sqrt(independent), prior.nuisance * scale
    log_rows = [rows_of(log, (), grid.outputs, ()) for log in logs]
    excess = reading_excess(log_rows, grid.outputs, grid.dt)
    by_part = np.hypot(choice.rmse, [excess[name] for name in grid.outputs])  # of readings, not of means
    scores = PlantScores(
        structure=choice.structure.label,
        average_s=grid.dt,
        average_why=grid.why,
        reading_excess=excess,
        reading_sd=reading_excess(log_rows, grid.outputs, np.inf),
        held_out_by_part={name: errors.tolist() for name, errors in zip(grid.outputs, by_part.T)},
        untested=_untested(grid, choice.folds),
    )
    plant = Plant(
        choice.model,
        {},
        dt=grid.dt,
        units=dict(grid.units),
        noise={name: float(v) for name, v in zip(grid.outputs, noise)},
        nuisance={name: float(v) for name, v in zip(grid.outputs, nuisance)},
        valid=grid.ranges(),
        logs=grid.logs,
        scores=scores,
        fitted_to=fit_logs(logs),
        inputs_end_at_row=grid.ends,
        offset_memory=prior.memory,
    )
    d = np.concatenate([segment.d for segment in grid.segments])
    return plant.with_medians(dict(zip(grid.disturbances, d.T)))
