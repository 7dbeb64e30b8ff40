"""Order selection by free run on held-out stretches.

One-step error cannot choose a model: on a slow plant the last reading alone predicts the next one well,
input or not. Every structure is therefore fitted on part of the training data and *simulated* over the
rest: the readings of a short warm-up set its state, and the remaining rows score it. With three or more
logs each log is held out in turn; with fewer, each of four consecutive blocks. A log or block that alone
moves an input (the only one that stops the pump, the one with the step) is not held out: a model fitted to
the others cannot know that input.

**The one-standard-error rule.** With e_sf the error of structure s on fold f and b the best structure, the
smallest structure is taken for which

    mean_f ln(e_sf / e_bf) <= min(se_f ln(e_sf / e_bf), ln 1.05),        ln 1.2 over whole logs,

with the standard error of the paired differences. Logarithms, because a fold whose input lies outside of
what the rest has seen is bad for every structure alike and must not outweigh the others. Models that are
unstable or diverge on any fold are refused, and structures whose fit to all data is, or errs on them far more
than on any fold.

**Averages.** Structures that err alike on the folds may differ by much on another day, where each errs in its
own way.  The mean of their free runs errs at most as much as they do in the mean, and less as far as their
errors differ.  So of one or two logs, which do not show what differs between days, the average of the ten,
five or three best structures is taken instead of the one above if

    mean_f ln(hypot(e_af, s) / hypot(e_1f, s)) <= ln 1.05

with the error s that another run adds, 7 percent of the outputs' spread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.lti import StartPrior, estimate_starts, evaluate_terms
from thermogrip.sysid.models.model import Model as PlantModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import RUN_GAIN_LARGE, SEVERAL
from thermogrip.sysid.plant.log_grid import MOVED, Grid, Segment

Array = NDArray[np.float64]

HARDLY_MORE = float(np.log(1.05))  # of log errors
MORE_BY_LOGS = float(np.log(1.2))  # the same over whole logs, of which there are few
_AVERAGED = (10, 5, 3)  # structures
_MOST_ON_ALL = 2.0  # times the worst fold's error: a fit to all data that errs more on them is refused
_BLOCKS = 4  # of one or two logs
FEWEST = 20  # rows of a block that is held out

_ALIKE = 0.98  # correlation of an input with its square: a line leaves a fifth of the square's spread

_SHORT = 0.25  # of a held-out part: the memory of an offset that fades


class Model(PlantModel, Protocol):
    """What a family returns: a model of a plant that knows whether it is stable."""

    @property
    def stable(self) -> bool:
        """Whether a bounded input keeps the state bounded."""
        ...


class Structure(NamedTuple):
    """Orders and delays of a model, and how many numbers it has; the same whatever data it is fitted to."""

    label: str
    size: int
    members: tuple[Structure, ...] = ()  # of what is the average of several


class Family(Protocol):
    """A kind of models: fits every structure that it has, or ``only`` one, and returns the stable models."""

    def __call__(self, grid: Grid, *, only: Structure | None = None) -> Mapping[Structure, Model]:
        """Return a model for each structure that could be fitted to the grid."""
        ...


@dataclass(frozen=True)
class Choice:
    """A structure with the errors that chose it."""

    structure: Structure
    prior: StartPrior  # the start of the free runs that served this structure best
    errors: dict[Structure, Array]  # (n_fold,) mean over outputs of RMSE / sd of the output; inf: refused
    folds: tuple[str, ...]  # what each fold held out
    rmse: Array  # (n_fold, n_y), free-run RMSE of the chosen structure, in the outputs' units
    warmup: int  # rows at the start of each run that set its state and are not scored
    model: Model  # the structure fitted to all data

    @property
    def error(self) -> float:
        """Geometric mean of the chosen structure's errors over the folds."""
        return self.error_of(self.structure)

    def error_of(self, structure: Structure) -> float:
        """Return the geometric mean of a structure's errors over the folds."""
        return float(np.exp(np.mean(np.log(np.maximum(self.errors[structure], 1e-12)))))


def folds(grid: Grid, *, blocks: int = _BLOCKS) -> Iterator[tuple[str, Grid, tuple[Segment, ...]]]:
    """Yield (what is held out, the training grid, the held-out segments)."""
    if len(grid.logs) >= 3:
        parts = [
            (name, [s for s in grid.segments if s.log == name], [s for s in grid.segments if s.log != name])
            for name in grid.logs
        ]
        yield from _of_known_inputs(grid, parts)
        return
    total = sum(len(segment.time) for segment in grid.segments)
    if total < FEWEST * blocks:
        raise UserError(
            f"{total} rows of {grid.dt:g} s are too short to hold a part out",
            hint="give a longer log or average less",
        )
    edges = [round(total * block / blocks) for block in range(blocks + 1)]
    labels = [f"block {block + 1} of {blocks}" for block in range(blocks)]
    cut = [_split(grid.segments, *pair) for pair in pairwise(edges)]
    yield from _of_known_inputs(grid, [(label, *both) for label, both in zip(labels, cut)])


def _of_known_inputs(
    grid: Grid, parts: Sequence[tuple[str, list[Segment], list[Segment]]]
) -> Iterator[tuple[str, Grid, tuple[Segment, ...]]]:
    """Yield the parts (what, held out, rest) as folds: those whose rest moves each input that they move, or
    all where these are fewer than two."""
    range_of = np.ptp(np.concatenate([segment.u for segment in grid.segments]), axis=0)
    known = [part for part in parts if _moves_all(part[2], than=part[1], least=MOVED * range_of)]
    for label, held, rest in known if len(known) >= 2 else parts:
        yield label, grid.having(rest), tuple(held)


def held_out_runs(grid: Grid, held: Sequence[Segment]) -> list[Segment]:
    """Return what is run freely of a held-out part: all of it, and of a block its second half once more."""
    return [*held, *(s.part(len(s.time) // 2, len(s.time)) for s in held if len(grid.logs) < 3)]


def priors_of(grid: Grid) -> tuple[StartPrior, ...]:
    """Return how a first error may be shared between state and sensor, and how long an offset lasts; offsets
    that fade do in a quarter of a held-out part: a longer memory cannot be told from one that lasts."""
    seconds = grid.dt * sum(len(segment.time) for segment in grid.segments)
    fading = _SHORT * seconds / (len(grid.logs) if len(grid.logs) >= 3 else _BLOCKS)
    none = [StartPrior(noise=r) for r in (0.03, 0.1, 0.3)]
    kinds = [(0.0, np.inf), *product((0.1, 0.3, 1.0), (np.inf, fading))]
    return tuple(replace(some, nuisance=q, memory=memory) for q, memory in kinds for some in none)


def free_run_errors(
    model: Model,
    segments: Sequence[Segment],
    *,
    dt: float,
    scale: Array,
    warmup: int,
    priors: Sequence[StartPrior],
) -> Array:
    """Return the free-run RMSE over the rows after the warm-up, for each prior of the start."""
    refused = np.full((len(priors), len(scale)), np.inf)
    if not model.stable:
        return refused
    total, count = np.zeros((len(priors), len(scale))), np.zeros(len(scale))
    for segment in segments:
        known = np.isfinite(segment.y[warmup:])
        miss = free_run_misses(model, segment, dt=dt, scale=scale, warmup=warmup, priors=priors)[:, warmup:]
        if not np.isfinite(miss[:, known]).all():
            return refused
        total += np.sum(np.where(known, miss, 0.0) ** 2, axis=1)
        count += known.sum(axis=0)
    return np.sqrt(total / count) if count.all() else refused


def free_run_misses(
    model: Model, segment: Segment, *, dt: float, scale: Array, warmup: int, priors: Sequence[StartPrior]
) -> Array:
    """Return the free run less the readings, from the start that each prior makes of the warm-up."""
    memory = np.array([prior.memory for prior in priors])[:, None]
    # the memory has no part in the start
    shares = list(dict.fromkeys(replace(prior, memory=np.inf) for prior in priors))
    at = [shares.index(replace(prior, memory=np.inf)) for prior in priors]
    head = (segment.y[:warmup], segment.u[:warmup], segment.d[:warmup])
    x0, offset = estimate_starts(model, *head, dt=dt, scale=scale, priors=shares)
    seen, _ = model.rollout(x0, segment.u[None], segment.d[None], (), dt)
    rows = np.maximum(np.arange(len(segment.y)) - warmup / 2, 0.0)  # after the middle of the warm-up
    lasts = np.exp(-rows * dt / memory)[:, :, None]
    return np.asarray((seen[:, :-1] - segment.y)[at] + offset[at, None] * lasts)


def choose(
    grid: Grid,
    family: Family,
    *,
    warmup: int,
    average: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> Choice:
    """Fit every structure of the family on every fold and choose by the one-standard-error rule; ``average``:
    of one or two logs the average of the best ones is taken where it errs hardly more."""
    cases = list(folds(grid))
    scored = _score(grid, family, cases, warmup, progress)
    left = {structure: errors.mean for structure, errors in scored.items()}
    fitted = None
    while fitted is None:
        structure = _one_standard_error(left, HARDLY_MORE if len(grid.logs) < SEVERAL else MORE_BY_LOGS)
        fitted = _fit_to_all(grid, family, structure, scored[structure], warmup)
        del left[structure]
    best = scored[structure].mean
    for each in _averages_of(scored) if average and len(grid.logs) < SEVERAL else ():
        scored |= _score(grid, partial(family, only=each), cases, warmup)
        if each in scored and _hardly_worse(scored[each].mean, best):
            averaged = _fit_to_all(grid, family, each, scored[each], warmup)
            if averaged is not None:
                structure, fitted = each, averaged
                break
    errors, labels = scored[structure], tuple(label for label, _, _ in cases)
    table = {each: item.mean for each, item in scored.items()}
    return Choice(structure, errors.prior, table, labels, errors.rmse, warmup, fitted)


class _Errors(NamedTuple):
    """The errors of a structure on the folds, from the start that served it best."""

    prior: StartPrior
    mean: Array  # (n_fold,) over the outputs, of RMSE / spread; inf: refused
    rmse: Array  # (n_fold, n_y)


def _score(
    grid: Grid,
    fit: Callable[[Grid], Mapping[Structure, Model]],
    cases: Sequence[tuple[str, Grid, tuple[Segment, ...]]],
    warmup: int,
    progress: Callable[[float, str], None] | None = None,
) -> dict[Structure, _Errors]:
    """Return the errors of each structure that ``fit`` makes of the rest of the folds."""
    scale, priors = np.maximum(grid.output_spread(), 1e-9), priors_of(grid)
    refused = np.full((len(priors), len(scale)), np.inf)
    errors: dict[Structure, list[Array]] = {}
    for at, (label, train, held) in enumerate(cases):
        if progress is not None:
            progress(at / len(cases), f"without {label}")
        starts = held_out_runs(grid, held)
        for structure, model in fit(train).items():
            column = errors.setdefault(structure, [refused] * at)
            column.append(
                free_run_errors(model, starts, dt=grid.dt, scale=scale, warmup=warmup, priors=priors)
            )
        for column in errors.values():  # a structure that could not be fitted on this fold is refused
            column.extend([refused] * (at + 1 - len(column)))
    out = {}
    for structure, columns in errors.items():
        by_output = np.stack(columns)  # (n_fold, n_prior, n_y)
        by_prior = np.mean(by_output / scale, axis=2)
        with np.errstate(divide="ignore"):
            at = int(np.argmin(np.log(by_prior).mean(axis=0)))
        out[structure] = _Errors(priors[at], by_prior[:, at], by_output[:, at])
    return out


def _averages_of(scored: Mapping[Structure, _Errors]) -> list[Structure]:
    """Return the averages of the ten, five and three best structures, as far as there are so many."""
    logs = {s: float(np.log(np.maximum(errors.mean, 1e-12)).mean()) for s, errors in scored.items()}
    best = sorted((structure for structure in logs if np.isfinite(logs[structure])), key=logs.__getitem__)
    return [
        Structure(f"average of the best {n}", sum(s.size for s in best[:n]) // n, tuple(best[:n]))
        for n in _AVERAGED
        if n <= len(best)
    ]


def _hardly_worse(errors: Array, least: Array) -> bool:
    """Return whether errors on the folds hardly exceed others on another run, where the gain differs too."""
    excess = np.log(np.hypot(errors, RUN_GAIN_LARGE)) - np.log(np.hypot(least, RUN_GAIN_LARGE))
    return bool(excess.mean() <= HARDLY_MORE)


def _fit_to_all(
    grid: Grid, family: Family, structure: Structure, errors: _Errors, warmup: int
) -> Model | None:
    """Return the structure fitted to all data; None if it is unstable, or errs far more than on any fold."""
    fitted = family(grid, only=structure).get(structure)
    most = _MOST_ON_ALL * float(np.max(errors.mean))
    if fitted is None or _error_on_all(fitted, grid, errors.prior, warmup) > most:
        return None
    return fitted


def _error_on_all(model: Model, grid: Grid, prior: StartPrior, warmup: int) -> float:
    """Return the error over the data of the fit, of runs that start as held-out ones do."""
    scale = np.maximum(grid.output_spread(), 1e-9)
    runs = held_out_runs(grid, grid.segments)
    errors = free_run_errors(model, runs, dt=grid.dt, scale=scale, warmup=warmup, priors=[prior])
    return float(np.mean(errors / scale))


def drives(grid: Grid, terms: Sequence[str]) -> list[Array]:
    """Return the columns w = [u, d, phi(u, d)] of each segment, shape (n, n_drive); a column that never moves
    cannot be distinguished from a constant; it is zero here, so that its effect is fitted as none and not as
    an arbitrary share of the constant."""
    names = grid.inputs + grid.disturbances
    rows = [np.hstack([segment.u, segment.d]) for segment in grid.segments]
    w = [np.hstack([some, evaluate_terms(terms, names, some)]) for some in rows]
    whole = np.concatenate(w)
    moves = np.ptp(whole, axis=0) > 1e-9 * np.maximum(np.abs(whole).max(axis=0), 1e-300)
    return [column * moves for column in w]


def column_sizes(norms: Array) -> Array:
    """Return what the columns of a regression and then its weights are divided by: norms, and infinity for a
    column that is zero, whose weight would otherwise be rounding, scaled up."""
    return np.where(norms > 1e-12, norms, np.inf)


def default_terms(grid: Grid, *, switched: bool = True) -> tuple[tuple[str, ...], ...]:
    """Return sets of products worth trying: none, magnitudes of signed inputs, squares of others that show
    their curvature (Joule heat), those with a moving switch."""
    u = np.concatenate([segment.u for segment in grid.segments])
    signed = [n for i, n in enumerate(grid.inputs) if u[:, i].min() < 0 < u[:, i].max()]
    moving = [n for n in grid.switches if np.ptp(u[:, grid.inputs.index(n)])]
    curved = [n for n, each in zip(grid.inputs, u.T) if n not in signed and _shows_curvature(each)]
    sets: list[tuple[str, ...]] = [()]
    if signed:
        sets.append(tuple(f"|{n}|" for n in signed))
        sets.append(tuple(t for n in signed for t in (f"|{n}|", f"{n}*|{n}|")))
    if curved:
        sets.append(tuple(f"{n}*{n}" for n in curved))
    if moving and switched:
        others = [n for n in (*grid.inputs, *grid.disturbances) if n not in moving]
        sets += [(*some, *(f"{s}*{n}" for s in moving for n in others)) for some in list(sets)]
    return tuple(sets)


def _shows_curvature(u: Array) -> bool:
    """Return whether the square of an input is no line in it; of two levels, or of few moves, it is."""
    return bool(np.ptp(u) > 0 and abs(np.corrcoef(u, u**2)[0, 1]) < _ALIKE)


def as_state_space(
    grid: Grid, A: Array, W: Array, C: Array, c: Array, *, terms: tuple[str, ...], origin: str, **more: Any
) -> StateSpaceModel:
    """Return x+ = A x + W w + c, y = C x as a model of the grid's signals; W (n_x, n_drive)."""
    labels = grid.inputs, grid.disturbances, grid.outputs
    B, E, F = np.split(W, np.cumsum([len(grid.inputs), len(grid.disturbances)]), axis=1)
    parts = {"A": A, "B": B, "C": C, "E": E, "F": F, "c": c} | more
    return StateSpaceModel(*labels, **parts, dt=grid.dt, switches=grid.switches, terms=terms, origin=origin)


def with_spread(model: StateSpaceModel, grid: Grid, starts: Sequence[Array]) -> StateSpaceModel:
    """Return the model with the covariance of its state over the training data."""
    rows = [
        model.states(x0[None], segment.u[None], segment.d[None], model.dt)[0]
        for x0, segment in zip(starts, grid.segments)
    ]
    x = np.concatenate(rows)
    if not np.isfinite(x).all():
        return model
    spread = np.atleast_2d(np.cov(x.T))
    # a state that never moved (a constant input in a delay line) keeps a trace of variance
    return replace(model, spread=spread + 1e-8 * max(np.trace(spread), 1e-12) * np.eye(model.n_x))


def excess_within_noise(excess: Array, most: float = HARDLY_MORE) -> bool:
    """Return whether paired differences of log errors are zero to within one standard error and 5 percent, or
    ``most``."""
    return bool(excess.mean() <= min(excess.std(ddof=1) / np.sqrt(excess.size), most))


def _one_standard_error(table: Mapping[Structure, Array], most: float = HARDLY_MORE) -> Structure:
    usable = {structure: error for structure, error in table.items() if np.isfinite(error).all()}
    if not usable:
        raise UserError(
            "no structure gives a stable model on every held-out part",
            hint="give a longer log, more excitation, or average more",
        )
    logs = {structure: np.log(np.maximum(error, 1e-12)) for structure, error in usable.items()}
    best = min(logs, key=lambda s: float(logs[s].mean()))
    good = [best]
    for structure, error in logs.items():
        if excess_within_noise(error - logs[best], most):
            good.append(structure)
    return min(good, key=lambda s: (s.size, float(logs[s].mean())))


def _moves_all(rest: Sequence[Segment], *, than: Sequence[Segment], least: Array) -> bool:
    """Return whether the rest moves every input that these segments move by more than ``least``."""
    own, others = (np.concatenate([segment.u for segment in some]) for some in (than, rest))
    return not np.any((np.ptp(own, axis=0) > least) & (np.ptp(others, axis=0) <= least))


def _split(segments: Sequence[Segment], first: int, last: int) -> tuple[list[Segment], list[Segment]]:
    """Cut the rows first to last, counted over all segments, out of the segments."""
    inside, outside, at = [], [], 0
    for segment in segments:
        n = len(segment.time)
        a, b = np.clip([first - at, last - at], 0, n)
        if b > a:
            inside.append(segment.part(int(a), int(b)))
        outside += [segment.part(i, j) for i, j in ((0, int(a)), (int(b), n)) if j - i >= 20]
        at += n
    return inside, outside
