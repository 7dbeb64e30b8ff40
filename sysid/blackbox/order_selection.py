"""Order selection by free run on held-out parts.

Every structure is fitted on part of the data and *simulated* over the rest. With three or more logs each log
is held out in turn. Of one or two logs each of four consecutive blocks is, and the last 30 percent of each
log, run from the start of the log.

**The one-standard-error rule.** With e_sf the error of structure s on part f and b the best structure, the
smallest structure is taken for which

    mean_f ln(e_sf / e_bf) <= min(se_f ln(e_sf / e_bf), ln 1.05),        ln 1.2 over whole logs,

with the standard error of the paired differences. A richer class of models (with products of inputs, of a
nonlinear kind) is taken only where the best of it wins by more than the standard error, or ln 1.1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress
from thermogrip.sysid.models.state_space import (
    StateSpaceModel,
    evaluate_terms,
    first_readings,
    symmetric_root,
)
from thermogrip.sysid.plant.log_grid import MOVED, Grid, Segment
from thermogrip.sysid.plant.plant_data import HELD_OUT_SHARE, SEVERAL, TAIL

if TYPE_CHECKING:
    from thermogrip.sysid.models.neural import NeuralModel
    from thermogrip.sysid.models.polynomial import SindyModel

    Fitted: TypeAlias = StateSpaceModel | SindyModel | NeuralModel

# of log errors, to which a standard error of few parts is limited; over whole logs, of which there are fewer
ORDER_MARGIN, ORDER_MARGIN_OF_LOGS = float(np.log(1.05)), float(np.log(1.2))
BARELY_MORE = 1.1  # times the error: then a richer class of models, or one without physics, is not taken
# Times the error on the worst part: a fit to all data, which it has seen, errs on them no more than that;
# where none does (one structure was asked for, say) no more than twice that.
_ERROR_ON_ALL_RATIOS = (1.0, 2.0)
_CUTS = 4  # of one or two logs
MANY_ROWS = 8000  # beyond it a fit to all structures and steps takes minutes, and two parts tell them apart
FEWEST_HELD_OUT_ROWS = 20  # rows of a block that is held out

# of an input with its square: a line leaves a fifth of the square's spread
_LINEAR_CORRELATION = 0.98
_FADING_SHARE = 0.25  # of a held-out part: the memory of an offset that fades; a longer one looks lasting

_SameKind = TypeVar("_SameKind", bound="Fitted")


class Structure(NamedTuple):
    """Orders and delays of a model, and its count of numbers; the same whatever data it is fitted to."""

    label: str
    size: int
    products: tuple[str, ...] = ()  # of inputs, beside these


# (grid, only=structures or None for all that a kind of models has) -> the stable models that could be fitted
Family: TypeAlias = "Callable[..., Mapping[Structure, Fitted]]"


@dataclass(frozen=True)
class Choice:
    """A structure with the errors that chose it."""

    structure: Structure
    prior: StartPrior  # the start of the free runs that served this structure best
    errors: dict[Structure, Array]  # (n_fold,) mean over outputs of RMSE / sd of the output; inf: refused
    folds: tuple[Fold, ...]  # what was held out
    rmse: Array  # (n_fold, n_y), free-run RMSE of the chosen structure, in the outputs' units
    warmup: int  # rows at the start of each run that set its state and are not scored
    model: Fitted  # the structure fitted to all data

    @property
    def error(self) -> float:
        """Geometric mean of the chosen structure's errors over the folds."""
        return float(np.exp(np.mean(np.log(np.maximum(self.errors[self.structure], 1e-12)))))


class Run(NamedTuple):
    """A segment that is run freely, and the first of its rows that is scored (after the warm-up)."""

    segment: Segment
    scored_from: int = 0


class Fold(NamedTuple):
    """A part of the data that is held out."""

    label: str
    train: Grid
    runs: tuple[Run, ...]

    def moves(self, least: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which inputs move by more than ``least`` in the part, and which in its rest."""
        held_out = np.concatenate([run.segment.u[run.scored_from :] for run in self.runs])
        rest = np.concatenate([segment.u for segment in self.train.segments])
        return np.ptp(held_out, axis=0) > least, np.ptp(rest, axis=0) > least


def folds(grid: Grid) -> list[Fold]:
    """Return the parts that are held out in turn: those whose rest moves each input that they move, or all
    where these are fewer than two."""
    if len(grid.logs) >= SEVERAL:
        by_log = {name: [s for s in grid.segments if s.log == name] for name in grid.logs}
        others_of = {name: tuple(s for s in grid.segments if s.log != name) for name in grid.logs}
        parts = [
            Fold(name, replace(grid, segments=others_of[name]), tuple(map(Run, held_out)))
            for name, held_out in by_log.items()
        ]
    else:
        parts = [*_cut_blocks(grid, _CUTS), _last_parts(grid)]
    # a model fitted to the others cannot know an input that one part alone moves
    least = MOVED * np.ptp(np.concatenate([segment.u for segment in grid.segments]), axis=0)
    excited = []
    for part in parts:
        if part.train.segments and part.runs:
            in_part, in_rest = part.moves(least)
            if np.all(~in_part | in_rest):
                excited.append(part)
    return excited if len(excited) >= 2 else parts


def _cut_blocks(grid: Grid, blocks: int) -> list[Fold]:
    total = sum(len(segment.time) for segment in grid.segments)
    if total < FEWEST_HELD_OUT_ROWS * blocks:
        raise UserError(
            f"{total} rows of {grid.dt:g} s are too few: parts are held out in turn, which takes "
            f"{FEWEST_HELD_OUT_ROWS * blocks}",
            hint="give a longer log or average less",
        )
    edges = [round(total * block / blocks) for block in range(blocks + 1)]
    row, parts = np.arange(total), []
    for at, (first, last) in enumerate(pairwise(edges)):
        held_out, rest = _split_segments(grid, (first <= row) & (row < last))
        inside = [segment.part(*ends) for segment, ends in held_out]
        # the second half is run once more from a warm-up of its own
        halves = [segment.part(len(segment.time) // 2, len(segment.time)) for segment in inside]
        # the readings of a short warm-up set the state, the others are scored
        parts.append(Fold(f"block {at + 1} of {blocks}", rest, tuple(map(Run, (*inside, *halves)))))
    return parts


def _last_parts(grid: Grid) -> Fold:
    """Return the last part of each log, to be run from the log's start."""
    # a block is too short to show the drift of an integrator, or of a pole that is a little too slow
    is_last = []
    for log in grid.logs:
        time = np.concatenate([segment.time for segment in grid.segments if segment.log == log])
        is_last.append(time >= time[0] + (1 - HELD_OUT_SHARE) * (time[-1] - time[0]))
    held_out, rest = _split_segments(grid, np.concatenate(is_last))
    runs = tuple(Run(segment, first) for segment, (first, _) in held_out)
    return Fold(f"{TAIL}{' and '.join(grid.logs)}", rest, runs)


def _split_segments(
    grid: Grid, is_held_out: NDArray[np.bool_]
) -> tuple[list[tuple[Segment, tuple[int, int]]], Grid]:
    """Return the segments with the ends of what is held out of them, and the rest of the grid."""
    held_out, rest = [], []
    ends = np.cumsum([len(segment.time) for segment in grid.segments])
    for segment, inside in zip(grid.segments, np.split(is_held_out, ends)):
        rows = np.flatnonzero(inside)
        n = len(inside)
        first, last = (int(rows[0]), int(rows[-1]) + 1) if rows.size else (n, n)
        held_out += [(segment, (first, last))] if rows.size else []
        outside = [segment.part(i, j) for i, j in ((0, first), (last, n))]
        rest += [part for part in outside if len(part.time) >= FEWEST_HELD_OUT_ROWS]
    return held_out, replace(grid, segments=tuple(rest))


@dataclass(frozen=True)
class StartPrior:
    """Noise of a reading and spread of a sensor's offset, in units of the output's standard deviation."""

    noise: float = 0.1  # r, per row of the warm-up
    nuisance: float = 0.0  # q; 0 means that sensors have no offset of their own
    memory: float = np.inf  # [s] in which an offset falls to 1/e


def estimate_starts(
    model: Fitted, y: Array, u: Array, d: Array, *, dt: float, scale: Array, priors: Sequence[StartPrior]
) -> tuple[Array, Array]:
    """Return the start and the sensors' offsets for each prior."""
    # With x0 = x_rest + s, s ~ N(0, P), offsets o ~ N(0, q^2) that are constant over the log and white
    # reading noise r, the readings of the warm-up are linear in (s, o), so their posterior mean is a ridge
    # regression.  P comes from the data of the fit; (r, q) share a first error between state and sensor, and
    # cannot be read off one-step errors.
    n_y = y.shape[1]
    x_rest = model.rest(first_readings(y), u.mean(axis=0), d.mean(axis=0), ())
    is_read = np.isfinite(y)
    if not is_read.any():
        return np.tile(x_rest, (len(priors), 1)), np.zeros((len(priors), n_y))
    root = symmetric_root(model.spread)
    runs = model.rollout(np.vstack([x_rest, x_rest + root.T]), u[None], d[None], (), dt)[0][:, :-1]
    if not np.isfinite(runs).all():  # equations that diverge within the warm-up
        return np.tile(x_rest, (len(priors), 1)), np.zeros((len(priors), n_y))
    weight = np.broadcast_to(1 / scale, y.shape)[is_read]
    by_state = (runs[1:] - runs[0])[:, is_read].T * weight[:, None]
    by_offset = np.broadcast_to(np.eye(n_y), (len(y), n_y, n_y))[is_read] * (scale * weight[:, None])
    miss = (y - runs[0])[is_read] * weight
    r, q = (np.array([getattr(prior, name) for prior in priors]) for name in ("noise", "nuisance"))
    n, n_s = len(miss), root.shape[1]
    # the prior as rows of their own: squares of a nearly unstable model's slopes would swamp it
    rows = np.zeros((len(priors), n + n_s + n_y, n_s + n_y))
    rows[:, :n, :n_s] = by_state / r[:, None, None]
    rows[:, :n, n_s:] = by_offset * (q / r)[:, None, None]
    rows[:, n:] = np.eye(n_s + n_y)
    orthogonal, triangle = np.linalg.qr(rows)
    right = np.einsum("bnk,n->bk", orthogonal[:, :n], miss) / r[:, None]
    z = np.linalg.solve(triangle, right[:, :, None])[:, :, 0]
    return x_rest + z[:, :n_s] @ root.T, q[:, None] * scale * z[:, n_s:]


def priors_of(grid: Grid) -> tuple[StartPrior, ...]:
    """Return how a first error may be shared between state and sensor, and how long an offset lasts."""
    seconds = grid.dt * sum(len(segment.time) for segment in grid.segments)
    fading = _FADING_SHARE * seconds / (len(grid.logs) if len(grid.logs) >= 3 else _CUTS)
    none = [StartPrior(noise=r) for r in (0.03, 0.1, 0.3)]
    kinds = [(0.0, np.inf), *product((0.1, 0.3, 1.0), (np.inf, fading))]
    return tuple(replace(some, nuisance=q, memory=memory) for q, memory in kinds for some in none)


def free_run_errors(
    model: Fitted, runs: Sequence[Run], *, dt: float, scale: Array, warmup: int, priors: Sequence[StartPrior]
) -> Array:
    """Return the free-run RMSE over the rows after the warm-up, for each prior of the start."""
    refused = np.full((len(priors), len(scale)), np.inf)
    if not model.stable:
        return refused
    total, count = np.zeros((len(priors), len(scale))), np.zeros(len(scale))
    for segment, scored_from in runs:
        first = max(warmup, scored_from)
        is_read = np.isfinite(segment.y[first:])
        # simulated, since on a slow plant the last reading alone predicts the next one well
        miss = free_run_misses(model, segment, dt=dt, scale=scale, warmup=warmup, priors=priors)[:, first:]
        # it diverged
        if not np.isfinite(miss[:, is_read]).all():
            return refused
        total += np.sum(np.where(is_read, miss, 0.0) ** 2, axis=1)
        count += is_read.sum(axis=0)
    return np.sqrt(total / count) if count.all() else refused


def free_run_misses(
    model: Fitted, segment: Segment, *, dt: float, scale: Array, warmup: int, priors: Sequence[StartPrior]
) -> Array:
    """Return the free run less the readings, from the start that each prior makes of the warm-up."""
    memory = np.array([prior.memory for prior in priors])[:, None]
    # the memory has no part in the start
    shares = list(dict.fromkeys(replace(prior, memory=np.inf) for prior in priors))
    share_of_prior = [shares.index(replace(prior, memory=np.inf)) for prior in priors]
    head = (segment.y[:warmup], segment.u[:warmup], segment.d[:warmup])
    x0, offset = estimate_starts(model, *head, dt=dt, scale=scale, priors=shares)
    outputs, _ = model.rollout(x0, segment.u[None], segment.d[None], (), dt)
    rows = np.maximum(np.arange(len(segment.y)) - warmup / 2, 0.0)  # after the middle of the warm-up
    lasts = np.exp(-rows * dt / memory)[:, :, None]
    return np.asarray((outputs[:, :-1] - segment.y)[share_of_prior] + offset[share_of_prior, None] * lasts)


def choose(grid: Grid, family: Family, *, warmup: int, progress: Progress | None = None) -> Choice:
    """Fit every structure on every fold and choose by the one-standard-error rule."""
    cases = folds(grid)
    scored = _score(grid, family, cases, warmup, progress)
    table = {structure: errors.mean for structure, errors in scored.items()}
    sound = _first_sound(grid, family, scored, warmup)
    if sound is None:
        raise UserError(
            "no structure gives a stable model on every held-out part",
            hint="give a longer log, more excitation, or average more",
        )
    structure, fitted = sound
    if structure.products:
        plain = {each: errors for each, errors in scored.items() if not each.products}
        without = _first_sound(grid, family, plain, warmup)
        if without is not None and excess_within_noise(np.log(table[without[0]] / table[structure])):
            structure, fitted = without
    chosen = scored[structure]
    return Choice(structure, chosen.prior, table, tuple(cases), chosen.rmse, warmup, fitted)


def _first_sound(
    grid: Grid, family: Family, scored: Mapping[Structure, _Errors], warmup: int
) -> tuple[Structure, Fitted] | None:
    """Return the best structure whose fit to all data errs on them no more than it may, and that fit; None
    where there is none."""
    most = ORDER_MARGIN if len(grid.logs) < SEVERAL else ORDER_MARGIN_OF_LOGS
    fit = cache(lambda structure: _fit_to_all(grid, family, structure, scored[structure], warmup))
    for times in _ERROR_ON_ALL_RATIOS:
        remaining = {structure: errors.mean for structure, errors in scored.items()}
        while any(np.isfinite(errors).all() for errors in remaining.values()):
            structure = smallest_near_the_best(remaining, most)
            fitted = fit(structure)
            if fitted is not None and fitted[1] <= times * float(np.max(remaining[structure])):
                return structure, fitted[0]
            del remaining[structure]
    return None


class _Errors(NamedTuple):
    """The errors of a structure on the folds, from the start that served it best."""

    prior: StartPrior
    mean: Array  # (n_fold,) over the outputs, of RMSE / spread; inf: refused
    rmse: Array  # (n_fold, n_y)


def _score(
    grid: Grid, family: Family, cases: Sequence[Fold], warmup: int, progress: Progress | None = None
) -> dict[Structure, _Errors]:
    """Return the errors of each structure that the family fits to the rest of the folds."""
    scale, priors = np.maximum(grid.output_spread(), 1e-9), priors_of(grid)
    refused = np.full((len(priors), len(scale)), np.inf)
    errors: dict[Structure, list[Array]] = {}
    remaining: list[Structure] | None = None
    many = sum(len(segment.time) for segment in grid.segments) > MANY_ROWS
    for at, (label, train, runs) in enumerate(cases):
        if progress is not None:
            progress(at / len(cases), f"without {label}")
        models = family(train) if remaining is None else family(train, only=remaining)
        for structure, model in models.items():
            column = errors.setdefault(structure, [refused] * at)
            column.append(free_run_errors(model, runs, dt=grid.dt, scale=scale, warmup=warmup, priors=priors))
        for column in errors.values():  # a structure that could not be fitted on this fold is refused
            column.extend([refused] * (at + 1 - len(column)))
        best = _non_dominated(errors, scale)
        if many and at >= 1 and len(best) < len(errors):
            remaining = best
    out = {}
    for structure, columns in errors.items():
        by_output = np.stack(columns)  # (n_fold, n_prior, n_y)
        by_prior = np.mean(by_output / scale, axis=2)
        with np.errstate(divide="ignore"):
            at = int(np.argmin(np.log(by_prior).mean(axis=0)))
        out[structure] = _Errors(priors[at], by_prior[:, at], by_output[:, at])
    return out


def _non_dominated(errors: Mapping[Structure, list[Array]], scale: Array) -> list[Structure]:
    """Return the structures for which no other one as small or smaller errs less on each part so far."""
    points = {
        structure: np.array([structure.size, *(np.min(np.mean(e / scale, axis=1)) for e in column)])
        for structure, column in errors.items()
    }
    return [
        structure
        for structure, point in points.items()
        if np.isfinite(point).all()
        and not any(np.all(other <= point) and np.any(other < point) for other in points.values())
    ]


def _fit_to_all(
    grid: Grid, family: Family, structure: Structure, errors: _Errors, warmup: int
) -> tuple[Fitted, float] | None:
    """Return the structure fitted to all data and its error on them, of runs that start as held-out ones do;
    None if it is unstable."""
    fitted = family(grid, only=(structure,)).get(structure)
    if fitted is None:
        return None
    scale = np.maximum(grid.output_spread(), 1e-9)
    halves = [s.part(len(s.time) // 2, len(s.time)) for s in grid.segments if len(grid.logs) < SEVERAL]
    runs = [Run(segment) for segment in (*grid.segments, *halves)]
    priors = [errors.prior]
    on_all = free_run_errors(fitted, runs, dt=grid.dt, scale=scale, warmup=warmup, priors=priors)
    return fitted, float(np.mean(on_all / scale))


def drives(grid: Grid, terms: Sequence[str]) -> list[Array]:
    """Return the columns w = [u, d, phi(u, d)] of each segment, shape (n, n_drive); one that never moves is
    zero, so that its effect is fitted as none and not as an arbitrary share of the constant."""
    rows = [np.hstack([segment.u, segment.d]) for segment in grid.segments]
    w = [np.hstack([each, evaluate_terms(terms, grid.inputs + grid.disturbances, each)]) for each in rows]
    whole = np.concatenate(w)
    moves = np.ptp(whole, axis=0) > 1e-9 * np.maximum(np.abs(whole).max(axis=0), 1e-300)
    return [column * moves for column in w]


def column_sizes(norms: Array) -> Array:
    """Return what the columns of a regression and then its weights are divided by: norms, and infinity for a
    column that is zero, whose weight would otherwise be rounding, scaled up."""
    return np.where(norms > 1e-12, norms, np.inf)


def default_terms(grid: Grid) -> tuple[tuple[str, ...], ...]:
    """Return sets of products worth trying: none, and where there are any the magnitudes of signed inputs (a
    Peltier heats and cools unequally) or the squares of others that show their curvature (Joule heat)."""
    u = np.concatenate([segment.u for segment in grid.segments])
    signed = [n for i, n in enumerate(grid.inputs) if u[:, i].min() < 0 < u[:, i].max()]
    moved = [(n, v) for n, v in zip(grid.inputs, u.T) if n not in signed and np.ptp(v) > 0]
    # of two levels, or of few moves, the square of an input is a line in it
    curved = [n for n, v in moved if abs(np.corrcoef(v, v**2)[0, 1]) < _LINEAR_CORRELATION]
    products = tuple(f"|{n}|" for n in signed) or tuple(f"{n}*{n}" for n in curved)
    return ((), products) if products else ((),)


def as_state_space(
    grid: Grid,
    A: Array,
    W: Array,
    C: Array,
    c: Array,
    starts: Sequence[Array],
    *,
    terms: tuple[str, ...],
    **more: Any,
) -> StateSpaceModel:
    """Return x+ = A x + W w + c, y = C x as a model of the grid's signals; where it is stable with the
    covariance of its state over the training data, of ``starts`` by segment. W (n_x, n_drive)."""
    labels = grid.inputs, grid.disturbances, grid.outputs
    B, E, F = np.split(W, np.cumsum([len(grid.inputs), len(grid.disturbances)]), axis=1)
    matrices = {"A": A, "B": B, "C": C, "E": E, "F": F, "c": c} | more
    model = StateSpaceModel(*labels, **matrices, dt=grid.dt, switches=grid.switches, terms=terms)
    return with_spread(model, grid, starts) if model.stable else model


def polynomial_model(
    grid: Grid, A: Array, B: Array, c: Array, starts: Sequence[Array], *, terms: tuple[str, ...]
) -> StateSpaceModel:
    """Return y[k] = sum_i A_i y[k - i] + sum_i B_i w[k - i] + c, i = 1 ... n, in observer form: v_i+ =
    A_i v_1 + v_(i+1) + B_i w, c in v_1, y = v_1; A (n, n_y, n_y), B (n, n_y, n_w), ``starts`` (n, n_y)."""
    n, n_y, n_w = B.shape
    matrix, C = np.eye(n * n_y, k=n_y), np.eye(n_y, n * n_y)
    matrix[:, :n_y] += A.reshape(-1, n_y)
    states = [start.ravel() for start in starts]
    return as_state_space(grid, matrix, B.reshape(-1, n_w), C, c @ C, states, terms=terms)


def held(moves: Array) -> Array:
    """Return the states v (n, n_y) of an observer form whose equations (n, n_y) have always moved so."""
    return np.cumsum(moves[::-1], axis=0)[::-1]


def with_spread(model: _SameKind, grid: Grid, starts: Sequence[Array]) -> _SameKind:
    """Return the model with the covariance of its state over the training data."""
    rows = [model.states(x0[None], s.u[None], s.d[None])[0] for x0, s in zip(starts, grid.segments)]
    x = np.concatenate(rows)
    more: dict[str, Any] = {"spread": state_spread(x)}
    return replace(model, **more) if np.isfinite(x).all() else model


def state_spread(x: Array) -> Array:
    """Return the covariance of states (n, n_x)."""
    spread = np.atleast_2d(np.cov(x.T))
    # a state that never moved (a constant input in a delay line) keeps a trace of variance
    return np.asarray(spread + 1e-8 * max(np.trace(spread), 1e-12) * np.eye(len(spread)))


def excess_within_noise(excess: Array, most: float = float(np.log(BARELY_MORE))) -> bool:
    """Return whether paired differences of log errors are zero to within one standard error, and ``most``."""
    return bool(excess.mean() <= min(excess.std(ddof=1) / np.sqrt(excess.size), most))


def smallest_near_the_best(table: Mapping[Structure, Array], most: float) -> Structure:
    """Return by the one-standard-error rule the smallest of structures that were scored on the same parts."""
    # a part whose input lies outside of what the rest has seen is bad for all alike: it must not outweigh
    logs = {s: np.log(np.maximum(error, 1e-12)) for s, error in table.items() if np.isfinite(error).all()}
    best = min(logs, key=lambda s: float(logs[s].mean()))
    near_best = [s for s in logs if s == best or excess_within_noise(logs[s] - logs[best], most)]
    return min(near_best, key=lambda s: (s.size, float(logs[s].mean())))
