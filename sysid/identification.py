"""From logs to a plant: candidate models are fitted, compared on data that they have not seen, one is kept.

    read -> candidates (grid, folds, orders) -> held out -> choice -> refit -> verdict -> Identification

The candidates are ``arx``, ``oe``, ``subspace``, ``sindy``, ``neural`` (black boxes) and ``network``
(physics). Each black box chooses its step and orders by free run over parts held out of the data that it is
given (:mod:`thermogrip.sysid.blackbox.order_selection`); with ``leave_one_out`` a log that is left out has no
part in that choice either.  The one that is kept, and the network, are scored besides on the last 30 percent
of each log, fitted without them and run freely from the log's start, where its state is known.  When a plant
is called good is in :mod:`thermogrip.sysid.validation.stated_errors`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.log_files import Logs, as_logs
from thermogrip.datasets.parallel import Progress, Workers, in_order, sub_progress
from thermogrip.datasets.schema import Log, log_name
from thermogrip.media.rendering import Shown
from thermogrip.sysid.blackbox.fit import (
    BLACK_BOXES,
    RESAMPLED,
    BlackBoxFit,
    family_of,
    fit_black_box,
    white_error,
    with_refits,
)
from thermogrip.sysid.blackbox.order_selection import BARELY_MORE, excess_within_noise
from thermogrip.sysid.data.data_quality import DataCheck, Evidence, check_data, evidence
from thermogrip.sysid.data.preparation import (
    SignalRole,
    doubt_of_gains,
    role_doubts,
    signal_roles,
    still_inputs,
    with_rest,
    without_still,
)
from thermogrip.sysid.export.dynamics import Dynamics, settled_dynamics
from thermogrip.sysid.plant.innovations import innovation_noise
from thermogrip.sysid.plant.log_grid import match_logs, misfit, moved_before, signals
from thermogrip.sysid.plant.log_grid import rows_of as log_rows
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import HELD_OUT_SHARE, RUN_GAIN_SD, TAIL, ExpectedError, HeldOut
from thermogrip.sysid.validation.free_run import FreeRun, free_run, no_input_baseline, warm_up_of
from thermogrip.sysid.validation.stated_errors import (
    Row,
    between_runs,
    check_ensemble,
    doubts_of,
    expected_error,
    network_name,
    part_errors,
    verdict_of,
    with_gain_spreads,
)

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel

MODELS = (*BLACK_BOXES, "network")
# armax, bj, parsim err least on held-out parts of some logs, and more than others on another day; of 14
# public logs and four of a gripper none keeps sindy
ON_REQUEST = ("armax", "bj", "parsim", "sindy")
USUAL_MODELS = tuple(model for model in MODELS if model not in ON_REQUEST)
LINEAR = ("arx", "oe", "armax", "bj", "subspace", "parsim")
NO_DRAWS = (UserError, np.linalg.LinAlgError)  # what draws of a fit may fail with; the fit itself is sound


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """What :func:`identify` found."""

    plant: Plant  # the chosen model, fitted on everything
    model: str  # its kind, of :data:`MODELS`
    rows: tuple[Row, ...]  # every candidate on held-out data, then the chosen one in sample
    data_check: DataCheck
    evidence: Evidence  # which temperatures and the minutes of each kind of drive the plant rests on
    good: bool  # whether the chosen model may be called good
    doubts: tuple[str, ...]  # what decides and is not certain, a line each; none where it is good
    verdict: str  # one sentence
    notes: tuple[str, ...]  # candidates that could not be fitted, and why; the step of a black box, and why
    signals: tuple[SignalRole, ...] = ()  # what each column of the logs was taken for
    runs: tuple[FreeRun, ...] = ()  # of ``plant`` over each log, its residual not tested
    # of the chosen model fitted without them, over each log, or last part of one, that was held out, by name
    held_out_runs: Mapping[str, FreeRun] = field(default_factory=dict)
    dynamics: Dynamics | None = None  # gains and responses of ``plant``; None where it does not settle

    @property
    def expected(self) -> dict[str, ExpectedError]:
        """The error by output of another run like the logs."""
        return self.plant.scores.expected

    def _facts(self) -> dict[str, object]:
        """Return the chosen model, the held-out error of each candidate, and the verdict."""
        errors = {f"error of {m}": f"{e:.3g} of that without an input" for m, e in self.errors().items()}
        return {"model": self.model, **errors, "notes": "; ".join(self.notes), "verdict": self.verdict}

    def errors(self) -> dict[str, float]:
        """Return the mean held-out error of each candidate, relative to the no-input baseline."""
        return _mean_errors([row for row in self.rows if row.held_out])


def identify(
    logs: Logs,
    network: GreyModel | str | Path | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    *,
    models: Sequence[str] = USUAL_MODELS,
    average: float | None = None,
    leave_one_out: bool = False,
    draws: int = 24,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress | None = None,
    early: Callable[[Identification], None] | None = None,
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
    leave_one_out : bool, optional
        Score each log by a fit to the others (at least two logs).
    draws : int, optional
        So many plants that agree with the logs show how certain the kept one is: of a network, of the normal
        approximation of its posterior (:func:`~thermogrip.sysid.greybox.posterior.sample_posterior` samples
        it); of a black box, refits to resampled logs.
    seed : int, optional
    workers : int or str, optional
        Local processes, or the address of a Dask scheduler, for the logs that are left out. The result is the
        same.
    progress : callable, optional
        Called with (fraction done, what).
    early : callable, optional
        Called once with what subspace models say, within seconds, before the other candidates are fitted.

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
    task = _read_logs(
        as_logs(logs, inputs, outputs, disturbances),
        network if "network" in models else None,
        {"inputs": inputs, "outputs": outputs, "disturbances": disturbances},
        average,
        leave_one_out=leave_one_out,
    )
    kinds = _candidate_kinds(models, task.network)
    cases = cases_of(task.logs, leave_one_out)
    steps = _Steps(progress, (len(cases) + 1) * len(kinds) + 2)
    boxes = _fit_black_boxes(kinds, task, steps, early)
    finalists = kinds if leave_one_out else [k for k in kinds if k == "network" or boxes.kept_as(k)]
    folds = _hold_out(finalists, cases, boxes.kept, task, workers, steps)
    kind = choose_model(_held_out_rows(folds), sum(len(case.held) for case in cases))
    kind = kind or (boxes.kept.kind if boxes.kept is not None else None)
    if kind is None:
        refused = [*boxes.refused, *(line for fold in folds for line in fold.refused), "none was asked for"]
        noisy = [finding.says for finding in task.checked.of("noise") if finding.verdict != "ok"]
        hint = "; ".join([*noisy, *task.doubts]) or None
        raise UserError(f"no model could be fitted ({refused[0]})", hint=hint)
    plant, without_draws = _refit(kind, boxes.kept, task, steps, draws, seed)
    return _judged(kind, plant, boxes, folds, task, without_draws)


# read


@dataclass(frozen=True, eq=False)
class _Task:
    """The logs as all candidates see them."""

    logs: list[Log]
    network: GreyModel | None
    fit_box: Callable[..., BlackBoxFit]  # of a kind to logs, with the signals and the step of all
    checked: DataCheck
    signals: tuple[SignalRole, ...]
    doubts: tuple[str, ...]
    notes: tuple[str, ...]  # what was converted, taken for rest, or left out
    leave_one_out: bool


def _read_logs(
    logs: list[Log],
    network: GreyModel | str | Path | None,
    named: Mapping[str, Sequence[str] | None],
    average: float | None,
    *,
    leave_one_out: bool,
) -> _Task:
    """Return the logs in the roles and units of all candidates, checked; each is matched once."""
    model: GreyModel | None = None
    converted: list[str] = []
    if network is None:
        logs = without_still(logs)
    else:
        model, of_room = _for_logs(network, logs)
        logs, converted = match_logs(model, logs, keep_others=True)
        converted = [*of_room, *converted]
    u, y, d = signals(logs, **named)
    # a network has a prior of what never moves, others nothing
    still = still_inputs(model, logs, u)
    u = tuple(name for name in u if name not in still)
    logs, rested = with_rest(logs, u, y)
    if leave_one_out and len(logs) < 2:
        raise UserError("leaving one log out needs at least two logs", hint="give another log")
    checked = check_data(logs, inputs=u, outputs=y, disturbances=d, average=average)
    if failed := [finding for finding in checked.of("excitation") if finding.verdict == "fail"]:
        moved_inputs = [name for name in u if name not in {finding.channel for finding in failed}]
        hint = "move it alone in the experiment, or name what you set with --inputs"
        hint += f" {','.join(moved_inputs)}" if 0 < len(moved_inputs) < len(u) else ""
        says, log = "; ".join(finding.says for finding in failed), logs[0]
        raise UserError(says, file=log_name(log), hint=hint + moved_before(log))
    roles, unused = signal_roles(logs, ([*u, *still], d, y), named, model, still)
    all_named = named["inputs"] is not None and named["outputs"] is not None
    doubts = (*role_doubts(logs, named_all=all_named), *doubt_of_gains(logs, u))
    notes = (*converted, *rested, *unused)
    fit_box = partial(fit_black_box, inputs=u, outputs=y, disturbances=d, average=average)
    return _Task(logs, model, fit_box, checked, roles, doubts, notes, leave_one_out)


def _for_logs(network: GreyModel | str | Path, logs: list[Log]) -> tuple[GreyModel, list[str]]:
    """Return the network in the units of the logs, and what they say of its room; refuse a misfit."""
    if isinstance(network, (str, Path)):
        from thermogrip.sysid.models.network import load_network

        network = load_network(network)
    from thermogrip.sysid.models.network import NetworkModel

    notes: list[str] = []
    if isinstance(network, NetworkModel):
        from thermogrip.sysid.data.shipped_networks import in_log_units, in_logged_room

        network, notes = in_logged_room(in_log_units(network, logs), logs)
    for log in logs:
        reason = misfit(network, log)
        if reason is not None:
            column_words = "" if reason.column is None else f"{reason.column} "
            raise UserError(
                f"the network {network.name} does not apply: {column_words}{reason.problem}",
                file=reason.file,
                hint=f"{reason.hint}; rename columns, or name another network (or none)",
            )
    return network, notes


def _candidate_kinds(models: Sequence[str], network: GreyModel | None) -> list[str]:
    unknown = [name for name in models if name not in MODELS]
    if unknown:
        raise UserError(f"no model of kind {unknown[0]!r}", hint=known_names(unknown[0], MODELS))
    candidates = [name for name in models if name != "network" or network is not None]
    if not candidates:
        raise UserError("no model is left to fit", hint="name a network, or another model")
    return candidates


# candidates: each black box with its step, folds and orders


@dataclass(frozen=True, eq=False)
class _Boxes:
    """The black boxes that were compared on the same parts."""

    fits: list[BlackBoxFit]
    refused: list[str]
    kept: BlackBoxFit | None

    def kept_as(self, kind: str) -> bool:
        return self.kept is not None and self.kept.kind == kind


def _fit_black_boxes(
    kinds: Sequence[str], task: _Task, steps: _Steps, early: Callable[[Identification], None] | None
) -> _Boxes:
    """Fit each black box to all logs: subspace, whose step the others take, first, neural ones last."""
    boxes = [] if task.leave_one_out else [kind for kind in kinds if kind != "network"]
    fits: dict[str, BlackBoxFit] = {}
    refused: dict[str, str] = {}
    grid = None
    for kind in sorted(boxes, key=lambda kind: (kind == "neural") - (kind == "subspace")):
        report = steps.start(kind)
        try:
            if kind == "neural" and beyond_reach(list(fits.values()), task.logs):
                raise UserError(
                    "left out, for even without any error on held-out parts it would not be kept: linear "
                    "models err by little more than noise, or less than another run differs (--models neural "
                    "fits it)"
                )
            fits[kind] = task.fit_box(kind, task.logs, grid=grid, progress=report)
        except UserError as error:
            refused[kind] = f"{kind}: {error}"
            continue
        if kind == "subspace":
            grid = fits[kind].grid
            if early is not None:
                early(_judged(kind, fits[kind].plant, _Boxes([fits[kind]], [], fits[kind]), [], task, []))
    in_order = [fits[kind] for kind in boxes if kind in fits]
    chosen = choose_black_box(in_order, task.logs) if in_order else None
    return _Boxes(in_order, [refused[kind] for kind in boxes if kind in refused], chosen)


# held out: the finalists on what they were fitted without


class Held(NamedTuple):
    """A log to run freely, what to call it, and the seconds since its start from which it is scored."""

    log: Log
    name: str
    score_from: float


class Case(NamedTuple):
    """Training logs, and what is held out of them."""

    train: list[Log]
    held: list[Held]


def cases_of(logs: Sequence[Log], leave_one_out: bool) -> list[Case]:
    """Return what is held out: each log in turn, or the last part of all."""
    if len({log_name(log) for log in logs}) < len(logs):
        raise UserError("two logs have the same name", hint="give each file its own name")
    if leave_one_out:
        others = [[other for other in logs if other is not log] for log in logs]
        return [Case(train, [Held(log, log_name(log), 0.0)]) for train, log in zip(others, logs)]
    case = Case([], [])
    for log in logs:
        time = log["time"].values
        cut = int(np.searchsorted(time, time[0] + (1 - HELD_OUT_SHARE) * (time[-1] - time[0])))
        case.train.append(log.isel(time=slice(0, cut)))
        # run from the log's start: there its state is known
        case.held.append(Held(log, f"{TAIL}{log_name(log)}", float(time[cut] - time[0])))
    return [case]


def run_held_out(plant: Plant, held: Held, *, unseen: bool = False) -> FreeRun:
    """Return the free run over what is held out; ``unseen`` by the fit, a neural model may be refused."""
    # a log may begin warm, and then its state needs more readings than one that begins at rest
    warmup = max(5.0 if held.score_from == 0 else warm_up_of(held.log["time"].values), plant.dt)
    if unseen:
        check_ensemble(plant, held.log, warmup=warmup)
    return free_run(plant, held.log, warmup=warmup, score_from=max(warmup, held.score_from), tests=False)


def rows_of(model: str, plant: Plant, name: str, run: FreeRun, *, held_out: bool) -> list[Row]:
    """Return a row for each output of a free run; ``held_out``: the plant was fitted without it."""
    structure = plant.scores.structure or network_name(plant) or model
    return [
        Row(name, output, s.rmse, s.fit_percent, s.unit, s.n, model, structure, baseline.rmse, held_out)
        for (output, s), baseline in zip(run.scores.items(), run.naive["no_input"].values())
    ]


def fold_rows(fit: BlackBoxFit) -> list[Row]:
    """Return a row for each output of each part that chose the structure of a black box."""
    rows = []
    for fold, by_output in zip(fit.choice.folds, np.transpose([*fit.plant.scores.held_out_by_part.values()])):
        for k, (output, rmse) in enumerate(zip(fit.grid.outputs, by_output.tolist())):
            firsts = [max(fit.choice.warmup, run.scored_from) for run in fold.runs]
            scored = [
                (run.segment.time[first_scored:], run.segment.y[first_scored:, k])
                for run, first_scored in zip(fold.runs, firsts)
            ]
            scored = [(t, y) for t, y in scored if np.isfinite(y).any()]
            y = np.concatenate([y for _, y in scored])
            idle = np.concatenate([y - no_input_baseline(t, y) for t, y in scored])
            n, spread = int(np.isfinite(y).sum()), float(np.nanstd(y))
            percent = 100 * (1 - rmse / spread) if spread > 0 else float("nan")
            idle_rmse = float(np.sqrt(np.nanmean(idle**2)))
            score = (fold.label, output, rmse, percent, fit.grid.units[output], n)
            rows.append(Row(*score, fit.kind, fit.choice.structure.label, idle_rmse, held_out=True))
    return rows


def _mean_errors(rows: Sequence[Row]) -> dict[str, float]:
    """Return by candidate the mean of its errors over those of a model without input."""
    errors: dict[str, list[float]] = {}
    for row in rows:
        errors.setdefault(row.model, []).append(row.rmse / max(row.no_input_rmse, 1e-12))
    return {model: float(np.mean(each)) for model, each in errors.items()}


@dataclass(frozen=True, eq=False)
class _Fold:
    """How a candidate did on what it was fitted without."""

    kind: str
    refused: list[str]
    runs: dict[str, FreeRun]  # by what was held out


def _hold_out(
    kinds: Sequence[str],
    cases: Sequence[Case],
    kept: BlackBoxFit | None,
    task: _Task,
    workers: Workers,
    steps: _Steps,
) -> list[_Fold]:
    """Fit each finalist without what is held out, and run it over that; on several processes where whole logs
    are left out and they can know the network, which is no class of the user's own."""
    pairs = [(kind, case) for case in cases for kind in kinds]
    fold_of = partial(_fold_of, kept=kept, task=task)
    if task.leave_one_out and workers != 1 and (task.network is None or task.network.kind == "network"):
        report = steps.start("left out", of=len(pairs))
        return list(in_order(fold_of, pairs, workers, report, what="fitting"))
    return [
        fold_of((kind, case), report=steps.start(f"{kind} without {_case_name(case)}"))
        for kind, case in pairs
    ]


def _case_name(case: Case) -> str:
    """Return what is held out of a case, in short."""
    return case.held[0].name if len(case.held) == 1 else f"{TAIL}each log"


def _fold_of(
    pair: tuple[str, Case], *, kept: BlackBoxFit | None, task: _Task, report: Progress | None = None
) -> _Fold:
    """Fit a candidate to the training logs of a case and run it over what is held out."""
    kind, case = pair
    fold = _Fold(kind, [], {})
    try:
        plant = _fitted(kind, case.train, kept, task, report)
    except UserError as error:
        fold.refused.append(f"{kind} without {_case_name(case)}: {error}")
        return fold
    for held_out in case.held:
        try:
            fold.runs[held_out.name] = run_held_out(plant, held_out, unseen=True)
        except UserError as error:
            fold.refused.append(f"{kind} without {held_out.name}: {error}")
    return fold


def _held_out_rows(folds: Sequence[_Fold]) -> list[Row]:
    return [
        row
        for fold in folds
        for name, run in fold.runs.items()
        for row in rows_of(fold.kind, run.plant, name, run, held_out=True)
    ]


def _fitted(
    kind: str, train: Sequence[Log], kept: BlackBoxFit | None, task: _Task, report: Progress | None
) -> Plant:
    """Return a candidate fitted to some logs: of the black box that is kept the same structure."""
    if kind == "network":
        from thermogrip.sysid.greybox.fit import fit_network  # pulls in llvmlite at the first fit

        assert task.network is not None
        return fit_network(task.network, train, progress=report)
    if kept is None:
        return task.fit_box(kind, train, progress=report).plant
    grid = kept.grid.of(train, ends=kept.grid.ends)
    model = family_of(kind)(grid, only=(kept.choice.structure,)).get(kept.choice.structure)
    if model is None:
        raise UserError(f"{kind}: the chosen structure is unstable without the last part of the logs")
    return replace(kept.plant, model=model)


# choice


def choose_black_box(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> BlackBoxFit:
    """Return the fit of the least error on the parts, a linear one within one standard error of another."""
    # on another run the gain differs besides, which the errors of one or two logs do not show
    run = _run_error(fits, logs)
    errors = [np.log(np.hypot(fit.choice.errors[fit.choice.structure], run)) for fit in fits]
    by_error = sorted(range(len(fits)), key=lambda k: float(errors[k].mean()))
    best = by_error[0]
    # the smaller of two linear kinds that tie was no better on 14 public logs, nor the one of the less error
    # over the whole log of its fit (1.69 times the best structure of all in the geometric mean, for 1.34)
    linear = next((k for k in by_error if fits[k].kind in LINEAR), best)
    return fits[linear if excess_within_noise(errors[linear] - errors[best]) else best]


def beyond_reach(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> bool:
    """Return whether a kind that errs by white noise alone would be barely better on another run."""
    linear = [fit for fit in fits if fit.kind in LINEAR]
    if not linear:
        return False
    best, run = min(linear, key=lambda fit: fit.choice.error), _run_error(linear, logs)
    return float(np.hypot(best.choice.error, run)) <= BARELY_MORE * float(np.hypot(white_error(best), run))


def _run_error(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> float:
    """Return what a gain that differs from run to run adds, in units of the outputs' spread, by the best
    linear fit (else any); 0 where the logs show it."""
    best = min([fit for fit in fits if fit.kind in LINEAR] or fits, key=lambda fit: fit.choice.error)
    changes = _rms_of_changes(between_runs(best.plant, logs, RUN_GAIN_SD))
    added = [changes.get(name, 0.0) / s for name, s in zip(best.grid.outputs, best.grid.output_spread())]
    return float(np.sqrt(np.mean(np.square(added))))


def _rms_of_changes(changes: Mapping[str, Array]) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(change**2))) for name, change in changes.items()}


def choose_model(rows: Sequence[Row], complete: int) -> str | None:
    """Return the candidate of the least mean relative error among those scored on every held-out log."""
    scored = {model: len({row.log for row in rows if row.model == model}) for model in _mean_errors(rows)}
    mean = {model: e for model, e in _mean_errors(rows).items() if scored[model] == complete}
    mean = {model: e for model, e in mean.items() if np.isfinite(e)} or mean
    if not mean:
        return None
    best = min(mean, key=lambda model: mean[model])
    # within 10 percent of the best the network is kept, for its parameters mean something
    return "network" if mean.get("network", np.nan) <= BARELY_MORE * mean[best] else best


# refit: the chosen one on all logs, with what its uncertainty is drawn from


def _refit(
    kind: str, kept: BlackBoxFit | None, task: _Task, steps: _Steps, draws: int, seed: int
) -> tuple[Plant, list[str]]:
    """Return the plant of a kind fitted to all logs with its draws, and in words why it has none."""
    report = steps.start(f"{kind} on all logs")
    box = None if kind == "network" else kept or task.fit_box(kind, task.logs, progress=report)
    plant = box.plant if box is not None else _fitted(kind, task.logs, None, task, report)
    if not draws or (box is not None and kind not in RESAMPLED):
        return plant, []
    report = steps.start("draws")
    try:
        if box is not None:
            return with_refits(box, draws, seed=seed, progress=report), []
        from thermogrip.sysid.greybox.posterior import fit_problem, with_draws

        return with_draws(plant, fit_problem(plant, task.logs), draws, seed=seed, progress=report), []
    except NO_DRAWS as error:
        return plant, [no_draws(kind, "draws", error)]


def no_draws(model: str, what: str, error: Exception) -> str:
    """Return the note on a fit that is kept without its ``what`` (draws, posterior)."""
    return f"{model}: no {what}, the fit is kept without: {error}"


# verdict


def _judged(
    kind: str, plant: Plant, boxes: _Boxes, folds: Sequence[_Fold], task: _Task, without_draws: Sequence[str]
) -> Identification:
    """Return the plant with its scores and expected errors, and all that was found beside it."""
    # the last part of the kept black box is scored at the logs' own rows
    part_rows = [row for fit in boxes.fits for row in fold_rows(fit)]
    part_rows = [row for row in part_rows if not (boxes.kept_as(row.model) and row.log.startswith(TAIL))]
    rows = [*part_rows, *_held_out_rows(folds)]
    # the same warm-up as on what was held out, or errors of the start would stand beside ones without
    starts = [0.0 if task.leave_one_out else warm_up_of(log["time"].values) for log in task.logs]
    whole = [Held(log, log_name(log), start) for log, start in zip(task.logs, starts)]
    runs = tuple(run_held_out(plant, whole_log) for whole_log in whole)
    for whole_log, run in zip(whole, runs):
        rows += rows_of(kind, plant, whole_log.name, run, held_out=False)
    dynamics = settled_dynamics(plant)
    plant = _with_expected(plant, kind, rows, task.logs, dynamics)
    refused = [line for fold in folds for line in fold.refused]
    # a fit without the last part that could not be run over it says nothing of another run either
    not_scored = [line for line in refused if line.startswith(f"{kind} without ")]
    doubts = (*task.doubts, *doubts_of(plant, dynamics), *not_scored)
    good, verdict = verdict_of(kind, plant, rows, task.checked, doubts)
    covered = evidence(plant, [log_rows(log, plant.inputs, plant.outputs, ()) for log in task.logs])
    verdict += f" {covered.sentence(plant.units)}."
    notes = (*task.notes, *boxes.refused, *refused, *without_draws, *_plant_notes(kind, plant))
    return Identification(
        plant=replace(plant, verdict=verdict),
        model=kind,
        rows=tuple(rows),
        data_check=task.checked,
        evidence=covered,
        good=good,
        doubts=doubts,
        verdict=verdict,
        notes=notes,
        signals=task.signals,
        runs=runs,
        held_out_runs={name: run for fold in folds if fold.kind == kind for name, run in fold.runs.items()},
        dynamics=dynamics,
    )


def _with_expected(
    plant: Plant, kind: str, rows: Sequence[Row], logs: Sequence[Log], dynamics: Dynamics | None
) -> Plant:
    """Return the plant with its held-out scores and the error of another run."""
    held_out = [
        # of a constant reading no share can be fitted, and JSON has no NaN
        HeldOut(row.log, row.output, row.rmse, float(np.nan_to_num(row.fit_percent)), row.unit, row.n)
        for row in rows
        if row.held_out and row.model == kind
    ]
    plant = replace(plant, scores=replace(plant.scores, held_out=held_out))
    plant = with_gain_spreads(plant, dynamics)
    differs = _rms_of_changes(between_runs(plant, logs))
    expected = {
        name: expected_error(part_errors(plant, name), differs.get(name, 0.0)) for name in plant.outputs
    }
    noise = innovation_noise(plant, logs)
    return replace(plant, scores=replace(plant.scores, expected=expected, innovations=noise))


def _plant_notes(model: str, plant: Plant) -> list[str]:
    """Return the step of a black box and why it is that, and when its inputs act."""
    out, scores = [], plant.scores
    if scores.average_why:
        out.append(f"{model}: steps of {scores.average_s:.3g} s ({scores.average_why})")
    if plant.inputs_end_at_row:
        out.append(
            f"{model}: an input moves its own row's reading, so it is taken as applied up to its row and "
            "not from it on (inputs_end_at_row)"
        )
    return out


class _Steps:
    """Spreads the progress of steps over the whole."""

    def __init__(self, progress: Progress | None, steps: int) -> None:
        self._progress = progress
        self._steps = steps
        self._done = 0

    def start(self, what: str, of: int = 1) -> Progress | None:
        """Return where a step reports to that counts as so many."""
        begin, self._done = self._done, self._done + of
        return sub_progress(self._progress, begin / self._steps, self._done / self._steps, what)
