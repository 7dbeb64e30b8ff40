"""From logs to a plant: candidate models are fitted, compared on data that they have not seen, one is kept.

    data check -> fit each candidate -> score it by free run on held-out data -> keep one, say why

The candidates are ``arx``, ``oe``, ``subspace``, ``sindy``, ``neural`` (black boxes) and ``network``
(physics). Each black box chooses its orders by held-out free run inside the data that it is given: with
``leave_one_out`` a log that is left out is left out of that choice as well.

The plant that is returned is fitted to everything; its scores on its own logs are listed beside, marked as
in-sample.

**What is held out.**  With ``leave_one_out`` each log in turn.  Otherwise black boxes are compared on the
folds that chose their orders (:func:`thermogrip.sysid.blackbox.order_selection.folds`: four blocks, or whole
logs where there are three); the end of a log alone says little, for one slow disturbance in it decides. The
one that is kept, and the network, are scored besides on the last 30 percent of each log, fitted without them
and run freely from the log's start, where its state is known.

**Which candidate is kept.**  Among black boxes that of the least error, in units of the outputs' spread, as a
geometric mean over the folds; where the paired excess is within one standard error and 5 percent an average
of structures, else the smallest one, and a linear one before others.  One or two logs do not show what
differs between runs: of the error on another run, whose gain differs
(:mod:`thermogrip.sysid.validation.prediction_bands`), 5 percent count as no difference among linear kinds,
and 10 percent beside others; where even no error at all would be within them neural models are not fitted.
On whole logs, and beside a network, that of the least held-out error over that of a model without input; the
network also when it is within 10 percent of the best, for its parameters mean something.  A model that no
output shows to beat a model without input (see :mod:`thermogrip.sysid.validation.free_run`) is never called
good.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.log_files import Logs, as_logs
from thermogrip.datasets.parallel import Workers, run_parallel
from thermogrip.datasets.schema import Log, column, log_name, names
from thermogrip.datasets.shown import Shown
from thermogrip.sysid.blackbox.fit import (
    BLACK_BOXES,
    FAMILIES,
    RESAMPLED,
    BlackBoxFit,
    fit_black_box,
    with_refits,
)
from thermogrip.sysid.blackbox.order_selection import HARDLY_MORE, excess_within_noise, folds, held_out_runs
from thermogrip.sysid.data.data_quality import DataCheck, Evidence, check_data, evidence
from thermogrip.sysid.data.rest_before import with_rest
from thermogrip.sysid.plant.fit_record import (
    HELD_OUT_SHARE,
    OTHER_KIND_GAIN_SD,
    RUN_GAIN_LARGE,
    RUN_GAIN_SD,
    SEVERAL,
    TAIL,
    HeldOut,
)
from thermogrip.sysid.plant.innovations import innovation_noise
from thermogrip.sysid.plant.log_grid import match_logs, misfit, moved_before, roles_of, signals
from thermogrip.sysid.plant.log_grid import rows_of as log_rows
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run, no_input_baseline
from thermogrip.sysid.validation.prediction_bands import (
    SHORT,
    between_runs,
    beyond_range,
    expected_coverage,
    expected_error,
)

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel

WITHIN_NOISE = 1.1  # of the best error: then the network is preferred, and a linear kind on another run
LINEAR = ("arx", "oe", "armax", "bj", "subspace", "parsim")  # kept where another kind errs hardly less
SHOWN = 12  # structures of a kind
USEFUL = 0.5  # of the no-input error: below it a model is called good


@dataclass(frozen=True)
class Row:
    """One line of the table: one model, one log, one output."""

    model: str  # kind of the candidate
    structure: str  # its orders, delays or network
    log: str  # what was simulated
    output: str
    rmse: float  # of the free run
    fit_percent: float
    unit: str  # of the output
    n: int  # scored samples
    no_input_rmse: float  # the same of the no-input baseline
    held_out: bool  # whether the model was fitted without these rows


class Held(NamedTuple):
    """A log to run freely, what to call it, and the seconds since its start from which it is scored."""

    log: Log
    name: str
    score_from: float


def cases_of(logs: Sequence[Log], leave_one_out: bool) -> Iterator[tuple[list[Log], Held]]:
    """Yield (training logs, what is held out)."""
    if len({log_name(log) for log in logs}) < len(logs):
        raise UserError("two logs have the same name", hint="give each file its own name")
    if leave_one_out:
        for held in logs:
            yield [log for log in logs if log is not held], Held(held, log_name(held), 0.0)
        return
    train: list[Log] = []
    tails: list[Held] = []
    for log in logs:
        time = log["time"].values
        at = int(np.searchsorted(time, time[0] + (1 - HELD_OUT_SHARE) * (time[-1] - time[0])))
        train.append(log.isel(time=slice(0, at)))
        # run from the log's start: there its state is known
        tails.append(Held(log, f"{TAIL}{log_name(log)}", float(time[at] - time[0])))
    yield from ((train, tail) for tail in tails)


def run_held_out(plant: Plant, held: Held, *, unseen: bool = False) -> FreeRun:
    """Return the free run over what is held out; ``unseen`` by the fit, a neural model may be refused for it.

    Members of a neural model that disagree over what they have not seen have a mean that means nothing.
    """
    # a log may begin warm, and then its state needs more readings than one that begins at rest
    warmup = max(5.0 if held.score_from == 0 else warm_up_of(held.log["time"].values), plant.dt)
    if unseen and plant.model.kind == "neural":
        from thermogrip.sysid.validation.prediction_bands import check_ensemble

        check_ensemble(plant, held.log, warmup=warmup)
    return free_run(plant, held.log, warmup=warmup, score_from=max(warmup, held.score_from), tests=False)


def rows_of(model: str, plant: Plant, name: str, run: FreeRun, *, held_out: bool) -> list[Row]:
    """Return a row for each output of a free run; ``held_out``: the plant was fitted without it."""
    structure = plant.scores.structure or model
    return [
        Row(model, structure, name, output, s.rmse, s.fit_percent, s.unit, s.n, baseline.rmse, held_out)
        for (output, s), baseline in zip(run.scores.items(), run.naive["no_input"].values())
    ]


def fold_rows(fit: BlackBoxFit) -> list[Row]:
    """Return a row for each output of each fold that chose the structure of a black box."""
    rows = []
    for (label, _, held), errors in zip(folds(fit.grid), fit.choice.rmse, strict=True):
        for k, (output, rmse) in enumerate(zip(fit.grid.outputs, errors)):
            parts = [(s.time, s.y[:, k]) for s in held_out_runs(fit.grid, held)]
            scored = [(t[fit.choice.warmup :], y[fit.choice.warmup :]) for t, y in parts]
            scored = [(t, y) for t, y in scored if np.isfinite(y).any()]
            y = np.concatenate([y for _, y in scored])
            idle = np.concatenate([y - no_input_baseline(t, y) for t, y in scored])
            n, spread = int(np.isfinite(y).sum()), float(np.nanstd(y))
            percent = 100 * (1 - float(rmse) / spread) if spread > 0 else float("nan")
            idle_rmse = float(np.sqrt(np.nanmean(idle**2)))
            what, unit = (fit.kind, fit.choice.structure.label, label, output), fit.grid.units[output]
            rows.append(Row(*what, float(rmse), percent, unit, n, idle_rmse, held_out=True))
    return rows


def searched_rows(fit: BlackBoxFit) -> list[Searched]:
    """Return the structures of a kind that are usable on every fold, the best first, at most ``SHOWN``."""
    chosen, error_of = fit.choice.structure, fit.choice.error_of
    rows = [
        Searched(fit.kind, each.label, error_of(each), tuple(errors.tolist()), each == chosen)
        for each, errors in fit.choice.errors.items()
        if np.isfinite(errors).all()
    ]
    rows.sort(key=lambda row: row.error)
    return [row for at, row in enumerate(rows) if at < SHOWN or row.kept]


def choose_black_box(fits: Sequence[BlackBoxFit], between: Mapping[str, float]) -> BlackBoxFit:
    """Return the linear fit of the least error over its folds, or another kind that errs clearly less;
    ``between``: by output the error that differences between runs add to that of any of them."""
    linear = [fit for fit in fits if fit.kind in LINEAR]
    others = [fit for fit in fits if fit.kind not in LINEAR]
    if not (linear and others):
        return _preferred(fits)
    run, other = _run_error(fits[0], between), _preferred(others)
    excess = _least(linear, run) - _fold_errors(other, run)
    hardly = excess.mean() <= np.log(WITHIN_NOISE) if run else excess_within_noise(excess)
    return _preferred(linear) if hardly else other


def beyond_reach(fits: Sequence[BlackBoxFit], between: Mapping[str, float]) -> bool:
    """Return whether even another kind without any error on the folds would not replace the linear fits."""
    linear = [fit for fit in fits if fit.kind in LINEAR]
    run = _run_error(linear[0], between) if linear else 0.0
    return run > 0 and float(_least(linear, run).mean() - np.log(run)) <= np.log(WITHIN_NOISE)


def _run_error(fit: BlackBoxFit, between: Mapping[str, float]) -> float:
    """Return what differences between runs add, in units of the outputs' spread."""
    grid = fit.grid
    added = [between.get(name, 0.0) / spread for name, spread in zip(grid.outputs, grid.output_spread())]
    return float(np.sqrt(np.mean(np.square(added))))


def _least(fits: Sequence[BlackBoxFit], run: float) -> Array:
    return min((_fold_errors(fit, run) for fit in fits), key=np.mean)


def _between(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> dict[str, float]:
    """Return what a large difference of gain adds to each output, by the best linear fit (else any)."""
    linear = [fit for fit in fits if fit.kind in LINEAR] or fits
    least = min(linear, key=lambda fit: fit.choice.error)
    return _rms(between_runs(least.plant, logs, RUN_GAIN_LARGE))


def _preferred(fits: Sequence[BlackBoxFit]) -> BlackBoxFit:
    between = 0.0 if len(fits[0].grid.logs) >= SEVERAL else RUN_GAIN_LARGE
    logs = [_fold_errors(fit, between) for fit in fits]
    best = min(logs, key=lambda errors: float(errors.mean()))
    near = [
        (fit, float(e.mean()))
        for fit, e in zip(fits, logs)
        if excess_within_noise(e - best) or (between and (e - best).mean() <= HARDLY_MORE)
    ]
    return min(near, key=lambda item: (not (of := item[0].choice.structure).members, of.size, item[1]))[0]


def _fold_errors(fit: BlackBoxFit, between: float) -> Array:
    """Return the logarithms of errors on another run, where ``between`` is added to those of the folds."""
    return np.asarray(np.log(np.maximum(np.hypot(fit.choice.errors[fit.choice.structure], between), 1e-12)))


def fit_without_tail(fit: BlackBoxFit, train: Sequence[Log]) -> Plant:
    """Return the plant of a black box with the same structure fitted to these parts of its logs."""
    grid = fit.grid.of(train, ends=fit.grid.ends)
    model = FAMILIES[fit.kind](grid, only=fit.choice.structure).get(fit.choice.structure)
    if model is None:
        raise UserError(f"{fit.kind}: the chosen structure is unstable without the last part of the logs")
    return replace(fit.plant, model=model)


def warm_up_of(time: Array) -> float:
    """Return the warm-up [s] of a log that may begin warm: fifty rows, a minute at most."""
    return min(50.0 * float(np.median(np.diff(time))), 60.0)


def warm_up_of_fit(plant: Plant, log: Log) -> float:
    """Return the warm-up [s] that scored a black box of one or two logs; 0 for other plants."""
    black_box = bool(plant.scores.held_out_by_part)
    return warm_up_of(log["time"].values) if black_box and 0 < len(plant.logs) < SEVERAL else 0.0


def choose_model(rows: Sequence[Row], complete: int) -> str | None:
    """Return the candidate of the least mean relative error among those scored on every held-out log."""
    errors: dict[str, list[float]] = {}
    scored: dict[str, set[str]] = {}
    for row in rows:
        errors.setdefault(row.model, []).append(relative_error(row))
        scored.setdefault(row.model, set()).add(row.log)
    mean = {model: float(np.mean(e)) for model, e in errors.items() if len(scored[model]) == complete}
    mean = {model: e for model, e in mean.items() if np.isfinite(e)} or mean
    if not mean:
        return None
    best = min(mean, key=lambda model: mean[model])
    return "network" if mean.get("network", np.nan) <= WITHIN_NOISE * mean[best] else best


def verdict_of(
    model: str, rows: Sequence[Row], checked: DataCheck, whole_logs: bool, doubts: Sequence[str] = ()
) -> tuple[bool, str]:
    """Return whether the kept candidate may be called good, and why, in a sentence; a guess that decides,
    of the ``doubts``, forbids it."""
    held = [row for row in rows if row.held_out and row.model == model]
    tails = [row for row in held if row.log.startswith(TAIL)]
    worst = max(tails or held, key=relative_error)
    share = relative_error(worst)
    own = max(
        (row for row in rows if not row.held_out and row.model == model), key=relative_error, default=worst
    )
    good = share < USEFUL and relative_error(own) < USEFUL and checked.verdict != "fail"
    where = "logs left out" if whole_logs else "parts of the logs, left out"
    units = dict.fromkeys((row.output, "" if row.unit == "1" else f" {row.unit}") for row in held)
    numbers = ", ".join(f"{name} {stated_error(held, name):.2g}{unit}" for name, unit in units)
    head = f"{model}: expected RMSE of a free run {numbers} (from {where})"
    if good and doubts:
        more = f" (and {len(doubts) - 1} more)" if len(doubts) > 1 else ""
        return False, f"{head}; not good as long as this is a guess: {doubts[0]}{more}"
    if good:
        return True, f"{head}; good for simulation and control on runs like these"
    if share < USEFUL <= relative_error(own):
        percent = f"{100 * relative_error(own):.0f} %"
        part = f"on {own.log}, which it is fitted to, its error for {own.output} is {percent}"
        return False, f"{head}; not good: {part} of a model's without input; try other models, or longer logs"
    if share < 1:
        part = (
            f"on {worst.log} its error for {worst.output} is {100 * share:.0f} % of a model's without input"
        )
        return False, f"{head}; not good: {part}; it needs more excitation, or another model"
    return False, f"{head}; not good: a model without input does as well on {worst.log}"


def stated_error(held: Sequence[Row], output: str) -> float:
    """Return the rms error of an output to expect of a part that was not held out, from those that were."""
    rows = [row for row in held if row.output == output]
    return expected_error([row.rmse for row in rows], sum(not row.log.startswith(TAIL) for row in rows))


def relative_error(row: Row) -> float:
    """Return the error over that of a model without input."""
    return row.rmse / max(row.no_input_rmse, 1e-12)


def held_out_scores(rows: Sequence[Row], model: str) -> list[HeldOut]:
    """Return a candidate's held-out rows as a plant's file keeps them."""
    return [
        # of a constant reading no share can be fitted, and JSON has no NaN
        HeldOut(row.log, row.output, row.rmse, float(np.nan_to_num(row.fit_percent)), row.unit, row.n)
        for row in rows
        if row.held_out and row.model == model
    ]


MODELS = (*BLACK_BOXES, "network")
# these err least on held-out parts of some logs, and more than others on another day
ON_REQUEST = ("armax", "bj", "parsim")
USUAL_MODELS = tuple(model for model in MODELS if model not in ON_REQUEST)
NO_DRAWS = (UserError, np.linalg.LinAlgError)  # what draws of a fit may fail with; the fit itself is sound

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SignalRole:
    """What a column of the logs was taken for."""

    name: str
    unit: str
    role: str  # ``"input"``, ``"disturbance"``, ``"output"`` or ``"left out"``
    why: str  # who states the role, or what the guess rests on
    guessed: bool


@dataclass(frozen=True)
class Searched:
    """A structure of a black box (orders, delay) that was compared over the folds."""

    model: str  # kind of the candidate
    structure: str
    error: float  # geometric mean over the folds of RMSE over the outputs' spread
    folds: tuple[float, ...]  # the same by fold
    kept: bool  # whether it represents its kind


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """What :func:`identify` found."""

    plant: Plant  # the chosen model, fitted on everything
    model: str  # its kind, of :data:`MODELS`
    rows: tuple[Row, ...]  # every candidate on held-out data, then the chosen one in sample
    data_check: DataCheck
    evidence: Evidence  # which temperatures and how many minutes of each kind of drive the plant rests on
    good: bool  # whether the chosen model may be called good
    doubts: tuple[str, ...]  # guesses about the logs that decide, a line each; none where it is good
    verdict: str  # one sentence
    notes: tuple[str, ...]  # candidates that could not be fitted, and why; the step of a black box, and why
    signals: tuple[SignalRole, ...] = ()  # what each column of the logs was taken for
    runs: tuple[FreeRun, ...] = ()  # of ``plant`` over each log, its residual not tested
    searched: tuple[Searched, ...] = ()  # structures of the black boxes, by kind, the best first
    # of the chosen model fitted without them, over each log, or last part of one, that was held out, by name
    held_out_runs: Mapping[str, FreeRun] = field(default_factory=dict)

    def _facts(self) -> dict[str, object]:
        """Return the verdict, the chosen model, and the held-out error of each candidate."""
        errors = {f"error of {m}": f"{e:.3g} of that without an input" for m, e in self.errors().items()}
        return {"verdict": self.verdict, "model": self.model, **errors, "notes": "; ".join(self.notes)}

    def errors(self) -> dict[str, float]:
        """Return the mean held-out error of each candidate, relative to the no-input baseline."""
        out: dict[str, list[float]] = {}
        for row in self.rows:
            if row.held_out:
                out.setdefault(row.model, []).append(relative_error(row))
        return {model: float(np.mean(values)) for model, values in out.items()}


def identify(
    logs: Logs,
    network: GreyModel | str | Path | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    *,
    models: Sequence[str] = USUAL_MODELS,
    average: float | None = None,
    order: int | None = None,
    delay: int | None = None,
    leave_one_out: bool = False,
    posterior: bool = False,
    draws: int = 24,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress | None = None,
    early: Callable[[Sequence[Row]], None] | None = None,
) -> Identification:
    """Find the plant behind one or several logs.

    Parameters
    ----------
    logs : Log, DataFrame, str, Path, or sequence of them
        DataFrames and files as :func:`~thermogrip.datasets.log_files.read_log` reads them.
    network : GreyModel, str or Path, optional
        A thermal network, or the name or file of one; without it the candidate ``network`` is left out.
    inputs, outputs, disturbances : sequence of str, optional
        Names of the signals; by role where absent.
    models : sequence of str, optional
        Candidates, of :data:`MODELS`; those of :data:`ON_REQUEST` where they are asked for.
    average : float, optional
        Averaging step of the black boxes [s]; chosen where absent.
    order, delay : int, optional
        Poles of each output (states, of ``subspace``) and steps of delay of the black boxes that have them;
        the others are left out then. Searched where absent.
    leave_one_out : bool, optional
        Score each log by a fit to the others (at least two logs).
    posterior : bool, optional
        Sample the posterior of the network's parameters.
    draws : int, optional
        Without the posterior: so many plants that agree with the logs stand in for it; of a black box, refits
        to resampled logs.
    seed : int, optional
    workers : int or str, optional
        Local processes, or the address of a Dask scheduler, for the kinds of black boxes and for the logs
        that are left out. The result is the same.
    progress : callable, optional
        Called with (fraction done, what).
    early : callable, optional
        Called once with the rows of the other black boxes before neural models, which take longest, are
        fitted; with one worker only.

    Returns
    -------
    Identification

    Raises
    ------
    UserError
        If a signal or a model is unknown, the data say nothing (a constant input), or no candidate can be
        fitted.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> from thermogrip.datasets.schema import make_log
    >>> rng = np.random.default_rng(0)
    >>> q = np.repeat(rng.random(60), 20)
    >>> y = 25 + lfilter([0, 0.5], [1, -0.95], q) + 0.01 * rng.standard_normal(1200)
    >>> log = make_log(np.arange(1200.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    >>> found = identify(log, models=["oe"], average=1.0)
    >>> found.model, found.good, found.errors()["oe"] < 0.05
    ('oe', True, True)
    """
    logs = as_logs(logs, inputs, outputs, disturbances)
    network, logs, converted = _for_network(network if "network" in models else None, logs)
    if network is None:
        logs = _without_still(logs)
    u, y, d = signals(logs, inputs=inputs, outputs=outputs, disturbances=disturbances)
    still = _still_inputs(network, logs, u)
    # a network has a prior of what never moves, others nothing
    u = tuple(name for name in u if name not in still)
    logs, rested = with_rest(logs, u, y)
    candidates = _candidates(models, network)
    if leave_one_out and len(logs) < 2:
        raise UserError("leaving one log out needs at least two logs", hint="give another log")
    checked = check_data(logs, inputs=u, outputs=y, disturbances=d, average=average)
    failed = [finding for finding in checked.of("excitation") if finding.verdict == "fail"]
    if failed:
        says, kept = "; ".join(f.says for f in failed), [n for n in u if n not in {f.channel for f in failed}]
        hint = "move it in the experiment, or leave it out"
        hint += f" with --inputs {','.join(kept)}" if 0 < len(kept) < len(u) else ""
        hint += moved_before(logs[0])
        raise UserError(says, file=log_name(logs[0]), column=failed[0].channel, hint=hint)
    cases = list(cases_of(logs, leave_one_out))
    boxes = [] if leave_one_out else [model for model in candidates if model != "network"]
    parts = _Parts(progress, len(boxes) + len(cases) * (len(candidates) if leave_one_out else 2) + 2)
    settings: dict[str, Any] = {
        "inputs": u, "outputs": y, "disturbances": d, "average": average, "order": order, "delay": delay,
    }  # fmt: skip
    fits, rows, refused = _fit_all(boxes, logs, settings, parts, workers, early)
    best = None
    if fits:
        best = choose_black_box(fits, _between(fits, logs))
    if leave_one_out:
        finalists = candidates
    else:
        finalists = [*([best.kind] if best else []), *(["network"] if "network" in candidates else [])]

    def fit(model: str, train: Sequence[Log], report: Progress | None) -> Plant | BlackBoxFit:
        if best is not None and model == best.kind:
            return best if train is logs else fit_without_tail(best, train)
        return _fit((network, settings, seed), model, train, report)

    folds_done: dict[tuple[str, int], _Fold] = {}
    if leave_one_out and workers != 1:
        from thermogrip.sysid.models.network import NetworkModel

        # a class of the user's own is known in this process alone
        shared = network if isinstance(network, NetworkModel) else None
        some = [model for model in finalists if model != "network" or shared is not None]
        # what takes longest first: a process that begins with it last leaves others idle
        some.sort(key=lambda model: _LONGEST.index(model) if model in _LONGEST else len(_LONGEST))
        folds: list[tuple[str, list[Log], Held | None]]
        folds = [(model, train, held) for model in some for train, held in cases]
        if "network" in some:  # the likely one: it is kept also where another errs a little less
            folds.insert(some.index("network") * len(cases), ("network", logs, None))
        drawn = 0 if posterior else draws
        items = [((shared, settings, seed), *fold, drawn) for fold in folds]
        report = parts.part("left out", of=len(items))
        found = run_parallel(_fitted_or_why, items, workers, report, what="fitting")
        folds_done = {(model, id(train)): each for (model, train, _), each in zip(folds, found)}
    scored, more, tried = _compare(fit, finalists, cases, parts, folds_done)
    rows, refused = rows + scored, refused + more
    chosen = choose_model(scored, len(cases)) or (best.kind if best else None)
    if chosen is None:
        noisy = [finding.says for finding in checked.of("noise") if finding.verdict != "ok"]
        problem = f"no model could be fitted ({refused[0] if refused else 'none was asked for'})"
        raise UserError(problem, hint="; ".join(noisy) or None)
    begun, _ = folds_done.get((chosen, id(logs)), (None, None))
    fitted = begun if isinstance(begun, Plant) else fit(chosen, logs, parts.part(f"{chosen} on all logs"))
    parts.next()
    plant, lost = fitted, list[str]()  # a worker may have drawn already
    if not isinstance(plant, Plant) or plant.samples is None:
        plant, lost = _with_draws(fitted, logs, parts, posterior=posterior, draws=draws, seed=seed)
    lists = {"input": inputs, "output": outputs, "disturbance": disturbances}
    roles, unused = _signal_roles(logs, ([*u, *still], d, y), lists, network, still)
    notes = (*converted, *rested, *refused, *unused, *lost, *_plant_notes(chosen, plant))
    # the same warm-up as on what was held out, or errors of the start would stand beside ones without
    whole = [
        Held(log, log_name(log), 0.0 if leave_one_out else warm_up_of(log["time"].values)) for log in logs
    ]
    runs = tuple(run_held_out(plant, held) for held in whole)
    for held, run in zip(whole, runs):
        rows += rows_of(chosen, plant, held.name, run, held_out=False)
    doubts = _doubts(logs, inputs, outputs)
    good, verdict = verdict_of(chosen, rows, checked, leave_one_out, doubts)
    other, unlike, effect = _errors_of_other_runs(plant, logs, chosen, rows)
    verdict += _other_runs_said(other, unlike, rows)
    covered = evidence(plant, [log_rows(log, plant.inputs, plant.outputs, ()) for log in logs])
    verdict += "; " + covered.sentence(plant.units)
    scores = replace(
        plant.scores,
        held_out=held_out_scores(rows, chosen),
        new_run_rmse=other,
        other_kind_rmse=unlike,
        input_effect=effect,
        innovations=innovation_noise(plant, logs),
    )
    plant = replace(plant, verdict=verdict, scores=scores)
    searched = tuple(row for some in fits for row in searched_rows(some))
    return Identification(
        plant, chosen, tuple(rows), checked, covered, good, doubts, verdict, notes, roles, runs, searched,
        tried.get(chosen, {}),
    )  # fmt: skip


def _errors_of_other_runs(
    plant: Plant, logs: Sequence[Log], chosen: str, rows: Sequence[Row]
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """Return by output the error of another run (empty where the logs show how runs differ), that of one
    unlike them and the effect of the inputs (both empty for a network): what was held out, and a varying
    gain."""
    mine = [row for row in rows if row.held_out and row.model == chosen]
    varied = _rms(between_runs(plant, logs))
    other = {name: float(np.hypot(stated_error(mine, name), varied[name])) for name in varied}
    effect = {} if chosen == "network" else _rms(between_runs(plant, logs, 1.0))
    beyond = beyond_range(plant, logs) if effect else {}
    added = {name: np.hypot(OTHER_KIND_GAIN_SD * size, beyond[name]) for name, size in effect.items()}
    unlike = {name: float(np.hypot(stated_error(mine, name), size)) for name, size in added.items()}
    return other, unlike, effect


def _other_runs_said(other: Mapping[str, float], unlike: Mapping[str, float], rows: Sequence[Row]) -> str:
    """Return the errors of other runs in words, as the verdict has them."""
    units, said = {row.output: "" if row.unit == "1" else f" {row.unit}" for row in rows}, ""
    for what, errors, gain in (
        ("another run", other, RUN_GAIN_SD),
        ("one unlike them (longer holds, other ranges)", unlike, OTHER_KIND_GAIN_SD),
    ):
        if errors:
            sizes = ", ".join(f"{name} {error:.2g}{units[name]}" for name, error in errors.items())
            said += f"; on {what} about {sizes}, its gain off by {100 * gain:.0f} %"
    return said + (f" (assumed: it takes {SEVERAL} logs to show how runs differ)" if other else "")


def _without_still(logs: list[Log]) -> list[Log]:
    """Return the logs with guessed inputs and outputs that never move as ``other``, if others of them do."""
    guesses = _guesses(logs)
    for role in ("input", "output"):
        group = names(logs[0], role)
        still = [name for name in group if not _moves(logs, name)]
        if len(still) < len(group):
            changed = [name for name in still if name in guesses]
            logs = [
                log.assign({n: log[n].assign_attrs(role="other") for n in changed if n in log})
                for log in logs
            ]
    return logs


def _still_inputs(network: GreyModel | None, logs: Sequence[Log], u: Sequence[str]) -> list[str]:
    """Return the inputs of a network, switches aside, that never move, if others of them do."""
    still = [name for name in u if not _moves(logs, name)] if network is not None else []
    if not still or network is None:
        return []
    still = [name for name in still if name not in network.switches]
    return still if len(still) < len(u) else []


def _moves(logs: Sequence[Log], name: str) -> bool:
    """Tell whether the readings of a column, if it has any, differ over the logs."""
    values = np.concatenate([column(log, name) for log in logs if name in log])
    return not np.isfinite(values).any() or bool(np.nanmax(values) > np.nanmin(values))


def _guesses(logs: Sequence[Log]) -> dict[str, str]:
    """Return by column what the guess of its role rests on; the first log has precedence."""
    lines = [line for log in reversed(logs) for line in str(log.attrs.get("guesses", "")).splitlines()]
    return dict(line.split(": ", 1) for line in lines if ": " in line)


def _doubts(
    logs: Sequence[Log], inputs: Sequence[str] | None, outputs: Sequence[str] | None
) -> tuple[str, ...]:
    """Return the guesses of clock and roles that decide what was fitted; roles that are named are none."""
    kinds = ["clock_doubts"] + ([] if inputs is not None and outputs is not None else ["role_doubts"])
    lines = [line for log in logs for kind in kinds for line in str(log.attrs.get(kind, "")).splitlines()]
    return tuple(dict.fromkeys(lines))


def _signal_roles(
    logs: Sequence[Log],
    groups: tuple[Sequence[str], Sequence[str], Sequence[str]],
    lists: Mapping[str, Sequence[str] | None],
    network: GreyModel | None,
    still: Sequence[str] = (),
) -> tuple[tuple[SignalRole, ...], list[str]]:
    """Return what each column of the logs was taken for: inputs, disturbances, outputs, the rest.

    And, where no list names them, a line for each log with signals that the first one, which says what is
    used, does not have.
    """
    units, guesses = dict[str, str](), _guesses(logs)
    for log in reversed(logs):  # the first log has precedence
        units |= {str(name): str(item.attrs.get("units", "1")) for name, item in log.items()}
    of_network = {} if network is None else roles_of(network)
    taken = {name: r for r, group in zip(("input", "disturbance", "output"), groups) for name in group}
    out = []
    for name in (*taken, *(n for n in units if n not in taken)):
        role, why, guessed = taken.get(name, "left out"), "given by the log", False
        if role != "left out" and name in (lists[role] or ()):
            why = "named"
        elif of_network.get(name) == role and network is not None:
            why = f"network {network.name}"
            if name in still:
                why += "; it never moves: what it does is known from the prior only"
        elif name in guesses:
            why, guessed = guesses[name], True
            taken_for = why.startswith(
                ("its name is that of a drive", "its name is that of a read", "its unit")
            )
            if role == "left out" and taken_for and not _moves(logs, name):
                why += ", but it never moves"
        elif role == "left out":
            why = "not named"
        out.append(SignalRole(name, units[name], role, why, guessed))
    unused = []
    for log in logs[1:] if all(words is None for words in lists.values()) else ():
        signals_of = (name for role in ("input", "output", "disturbance") for name in names(log, role))
        if more := ", ".join(name for name in signals_of if name not in taken):
            unused.append(f"{log_name(log)}: {more} left out, for {log_name(logs[0])} has no such signal")
    return tuple(out), unused


def _for_network(
    network: GreyModel | str | Path | None, logs: list[Log]
) -> tuple[GreyModel | None, list[Log], list[str]]:
    """Return the network, the logs in its roles and units, and what was converted; refuse a misfit."""
    if network is None:
        return None, logs, []
    if isinstance(network, (str, Path)):
        from thermogrip.sysid.models.network import load_network

        network = load_network(network)
    from thermogrip.sysid.models.network import NetworkModel

    if isinstance(network, NetworkModel):
        from thermogrip.sysid.data.shipped_networks import in_log_units

        network = in_log_units(network, logs)
    for log in logs:
        reason = misfit(network, log)
        if reason is not None:
            what = "" if reason.column is None else f"{reason.column} "
            raise UserError(
                f"the network {network.name} does not apply: {what}{reason.problem}",
                file=reason.file,
                hint=f"{reason.hint}; rename columns, or name another network (or none)",
            )
    return network, *match_logs(network, logs, keep_others=True)


def _fit_all(
    boxes: Sequence[str],
    logs: Sequence[Log],
    settings: dict[str, Any],
    parts: _Parts,
    workers: Workers,
    early: Callable[[Sequence[Row]], None] | None = None,
) -> tuple[list[BlackBoxFit], list[Row], list[str]]:
    """Return each black box fitted to all logs, the rows of its folds, and why others could not be fitted.

    Neural models take longest, so they come last, and not at all where they are beyond reach.
    """
    found: dict[str, BlackBoxFit | str] = {}

    def fit(kinds: Sequence[str]) -> None:
        if workers != 1 and len(kinds) > 1:
            items = [(kind, logs, settings) for kind in kinds]
            report = parts.part("black boxes", of=len(kinds))
            found.update(zip(kinds, run_parallel(_fit_or_refusal, items, workers, report, what="fitting")))
            parts.next(len(kinds))
            return
        for kind in kinds:
            report = parts.part(kind)
            found[kind] = _fit_or_refusal((kind, logs, settings | {"progress": report}))
            if report is not None:
                report(1.0, _in_short(found[kind]))
            parts.next()

    fit([kind for kind in boxes if kind != "neural"])
    if "neural" in boxes:
        others = [some for some in found.values() if isinstance(some, BlackBoxFit)]
        if others and beyond_reach(others, _between(others, logs)):
            found["neural"] = (
                "neural: left out, for even without any error on held-out parts it would not be kept: "
                "another run differs by more than the linear models err (--models neural fits it)"
            )
            parts.next()
        else:
            if others and early is not None:
                early([row for each in others for row in fold_rows(each)])
            fit(["neural"])
    every = [found[kind] for kind in boxes]
    fits = [each for each in every if isinstance(each, BlackBoxFit)]
    rows = [row for each in fits for row in fold_rows(each)]
    return fits, rows, [each for each in every if isinstance(each, str)]


def _in_short(found: BlackBoxFit | str) -> str:
    if isinstance(found, str):
        return "refused"
    choice = found.choice
    return f"{choice.structure.label}, errs {100 * choice.error:.1f} % of the spread on held-out parts"


def _fit_or_refusal(item: tuple[str, Sequence[Log], dict[str, Any]]) -> BlackBoxFit | str:
    """Return a kind of black box fitted to all logs, or why it could not be."""
    kind, logs, settings = item
    try:
        return fit_black_box(kind, logs, **settings)
    except UserError as error:
        return f"{kind}: {error}"


#: Of the candidates, by time for a fit.
_LONGEST = ("neural", "bj", "armax", "subspace", "parsim", "oe", "sindy", "network")

_Asked: TypeAlias = "tuple[GreyModel | None, dict[str, Any], int]"  # network, settings of black boxes, seed


def _fit(asked: _Asked, model: str, train: Sequence[Log], report: Progress | None) -> Plant | BlackBoxFit:
    """Return a candidate fitted to some logs."""
    network, settings, seed = asked
    if model != "network":
        return fit_black_box(model, train, **settings, progress=report)
    from thermogrip.sysid.greybox.fit import fit_network  # pulls in llvmlite and nlopt at the first fit

    assert network is not None
    return fit_network(network, train, seed=seed, progress=report)


#: A plant, or why it could not be fitted, and its run over what is held out, why there is none, or None where
#: nobody has run it.
_Fold: TypeAlias = "tuple[Plant | str, FreeRun | str | None]"


def _fitted_or_why(item: tuple[_Asked, str, Sequence[Log], Held | None, int]) -> _Fold:
    """Return the plant of a candidate fitted to some logs and its run over another, or why there is none; of
    a network fitted to all logs, with so many draws where it has any."""
    asked, model, train, held, draws = item
    try:
        fitted = _fit(asked, model, train, None)
    except UserError as error:
        return str(error), None
    if held is None and draws and isinstance(fitted, Plant):
        from thermogrip.sysid.greybox.posterior import fit_problem, with_draws

        with suppress(*NO_DRAWS):  # who wants them meets the same fault, and says it
            fitted = with_draws(fitted, fit_problem(fitted, train), draws, seed=asked[2])
    plant = fitted if isinstance(fitted, Plant) else fitted.plant
    try:
        return plant, None if held is None else run_held_out(plant, held, unseen=True)
    except UserError as error:
        return plant, str(error)


def _compare(
    fit: Callable[[str, Sequence[Log], Progress | None], Plant | BlackBoxFit],
    candidates: Sequence[str],
    cases: Sequence[tuple[list[Log], Held]],
    parts: _Parts,
    folds: dict[tuple[str, int], _Fold],
) -> tuple[list[Row], list[str], dict[str, dict[str, FreeRun]]]:
    """Return the rows of every candidate on what is held out, which could not be fitted, and why, and by
    candidate and what was held out its free runs; ``folds`` are those done already."""
    rows: list[Row] = []
    runs: dict[str, dict[str, FreeRun]] = {}
    refused: list[str] = []
    # without leave_one_out all cases share one training set
    for train, held in cases:
        for model in candidates:
            what = f"{model} without {held.name}"
            try:
                if (model, id(train)) not in folds:
                    fitted = fit(model, train, parts.part(what))
                    folds[model, id(train)] = (fitted if isinstance(fitted, Plant) else fitted.plant), None
                plant, run = folds[model, id(train)]
                if isinstance(plant, str) or isinstance(run, str):
                    refused.append(f"{what}: {plant if isinstance(plant, str) else run}")
                    parts.next()
                    continue
                run = run_held_out(plant, held, unseen=True) if run is None else run
                rows += rows_of(model, plant, held.name, run, held_out=True)
                runs.setdefault(model, {})[held.name] = run
            except UserError as error:
                refused.append(f"{what}: {error}")
            parts.next()
    return rows, refused, runs


def _with_draws(
    fitted: Plant | BlackBoxFit, logs: Sequence[Log], parts: _Parts, *, posterior: bool, draws: int, seed: int
) -> tuple[Plant, list[str]]:
    """Return the plant of a fit with what its uncertainty is drawn from, and in words why it has none."""
    if isinstance(fitted, BlackBoxFit):
        plant, model, what = fitted.plant, fitted.kind, "draws"
        if not draws or model not in RESAMPLED:
            return plant, []
    else:
        plant, model, what = fitted, "network", "posterior" if posterior else "draws"
        if not (posterior or draws):
            return plant, []
    report = parts.part(what)
    try:
        if isinstance(fitted, BlackBoxFit):
            return with_refits(fitted, draws, seed=seed, progress=report), []
        from thermogrip.sysid.greybox.posterior import fit_problem, sample_posterior, with_draws

        if posterior:
            return sample_posterior(plant, logs, seed=seed, progress=report)[0], []
        return with_draws(plant, fit_problem(plant, logs), draws, seed=seed, progress=report), []
    except NO_DRAWS as error:
        return plant, [no_draws(model, what, error)]


def no_draws(model: str, what: str, error: Exception) -> str:
    """Return the note on a fit that is kept without its ``what`` (draws, posterior)."""
    return f"{model}: no {what}, the fit is kept without: {error}"


def _rms(changes: Mapping[str, Array]) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(change**2))) for name, change in changes.items()}


def _plant_notes(model: str, plant: Plant) -> list[str]:
    """Return the step of a black box and why it is that, and which outputs no band fits over all logs."""
    out, scores = [], plant.scores
    if scores.average_why:
        out.append(f"{model}: steps of {scores.average_s:.3g} s ({scores.average_why})")
    if plant.inputs_end_at_row:
        out.append(
            f"{model}: an input moves its own row's reading, so it is taken as applied up to its row and "
            "not from it on (inputs_end_at_row)"
        )
    for name, shares in expected_coverage(plant).items():
        worst = int(np.argmin(shares))
        if shares[worst] <= 0.9 - SHORT:
            out.append(
                f"{model}: errors of {name} differ over the logs; of {scores.folds[worst]} a 90 % band of "
                f"the others should hold {100 * shares[worst]:.0f} %, so bands are too narrow where it is "
                "like that"
            )
    return out


class _Parts:
    """Spreads the progress of parts over the whole."""

    def __init__(self, progress: Progress | None, parts: int) -> None:
        self._progress, self._parts, self._done = progress, parts, 0

    def part(self, what: str, of: int = 1) -> Progress | None:
        if self._progress is None:
            return None
        whole, begin, parts = self._progress, self._done, self._parts
        return lambda done, detail: whole((begin + of * done) / parts, f"{what}: {detail}")

    def next(self, parts: int = 1) -> None:
        self._done += parts


def _candidates(models: Sequence[str], network: GreyModel | None) -> list[str]:
    unknown = [name for name in models if name not in MODELS]
    if unknown:
        raise UserError(f"no model of kind {unknown[0]!r}", hint=known_names(unknown[0], MODELS))
    candidates = [name for name in models if name != "network" or network is not None]
    if not candidates:
        raise UserError("no model is left to fit", hint="name a network, or another model")
    return candidates
