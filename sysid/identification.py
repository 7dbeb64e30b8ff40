"""From logs to a plant: candidate models are fitted, compared on data that they have not seen, one is kept.

    read -> candidates (grid, folds, orders) -> held out -> choice -> refit -> verdict -> Identification

The candidates are ``arx``, ``oe``, ``subspace``, ``sindy``, ``neural`` (black boxes) and ``network``
(physics). Each black box chooses its step and orders by free run over parts held out of the data that it is
given (:mod:`thermogrip.sysid.blackbox.order_selection`); with ``leave_one_out`` a log that is left out has no
part in that choice either.  What is held out is in :mod:`thermogrip.sysid.validation.held_out`, when a plant
is called good in :mod:`thermogrip.sysid.validation.goodness`.

The plant that is returned is fitted to everything; its scores on its own logs are listed beside, marked as
in-sample.

**Which candidate is kept.**  Among black boxes the one of the least error on parts held out, a linear one
where another kind errs less by no more than a standard error and 5 percent.  On another run the gain differs
besides (:mod:`thermogrip.sysid.validation.prediction_bands`): of one or two logs that is added to the errors,
and where even no error at all would not be 10 percent better neural models are not fitted.  On whole logs,
and beside a network, that of the least held-out error over that of a model without input; the network also
when it is within 10 percent of the best, for its parameters mean something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.log_files import Logs, as_logs
from thermogrip.datasets.media import Shown
from thermogrip.datasets.parallel import Workers, run_parallel
from thermogrip.datasets.schema import Log, log_name
from thermogrip.sysid.blackbox.fit import (
    BLACK_BOXES,
    FAMILIES,
    RESAMPLED,
    BlackBoxFit,
    fit_black_box,
    with_refits,
)
from thermogrip.sysid.blackbox.order_selection import HARDLY_MORE, MORE_BY_LOGS, excess_within_noise
from thermogrip.sysid.data.data_quality import DataCheck, Evidence, check_data, evidence
from thermogrip.sysid.data.rest_before import with_rest
from thermogrip.sysid.data.signal_roles import (
    SignalRole,
    role_doubts,
    signal_roles,
    still_inputs,
    without_still,
)
from thermogrip.sysid.plant.fit_record import (
    SEVERAL,
    TAIL,
    ExpectedError,
    HeldOut,
)
from thermogrip.sysid.plant.innovations import innovation_noise
from thermogrip.sysid.plant.log_grid import Grid, match_logs, misfit, moved_before, signals
from thermogrip.sysid.plant.log_grid import rows_of as log_rows
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun
from thermogrip.sysid.validation.goodness import doubts_of, verdict_of
from thermogrip.sysid.validation.held_out import (
    Case,
    Held,
    Row,
    Searched,
    cases_of,
    fold_rows,
    relative_error,
    rows_of,
    run_held_out,
    searched_rows,
    warm_up_of,
)
from thermogrip.sysid.validation.prediction_bands import between_runs, expected_error, part_errors

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel

MODELS = (*BLACK_BOXES, "network")
# armax, bj, parsim err least on held-out parts of some logs, and more than others on another day; of 14
# public logs and four of a gripper none keeps sindy
ON_REQUEST = ("armax", "bj", "parsim", "sindy")
USUAL_MODELS = tuple(model for model in MODELS if model not in ON_REQUEST)
LINEAR = ("arx", "oe", "armax", "bj", "subspace", "parsim")  # kept where another kind errs hardly less
WITHIN_NOISE = 1.1  # of the best error: then the network is preferred, and a linear kind to neural models
NO_DRAWS = (UserError, np.linalg.LinAlgError)  # what draws of a fit may fail with; the fit itself is sound
#: Of the candidates, by time for a fit.
_LONGEST = ("neural", "bj", "armax", "subspace", "parsim", "oe", "sindy", "network")

Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """What :func:`identify` found."""

    plant: Plant  # the chosen model, fitted on everything
    model: str  # its kind, of :data:`MODELS`
    rows: tuple[Row, ...]  # every candidate on held-out data, then the chosen one in sample
    data_check: DataCheck
    evidence: Evidence  # which temperatures and how many minutes of each kind of drive the plant rests on
    good: bool  # whether the chosen model may be called good
    doubts: tuple[str, ...]  # what decides and is not certain, a line each; none where it is good
    verdict: str  # one sentence
    notes: tuple[str, ...]  # candidates that could not be fitted, and why; the step of a black box, and why
    signals: tuple[SignalRole, ...] = ()  # what each column of the logs was taken for
    runs: tuple[FreeRun, ...] = ()  # of ``plant`` over each log, its residual not tested
    searched: tuple[Searched, ...] = ()  # structures of the black boxes, by kind, the best first
    # of the chosen model fitted without them, over each log, or last part of one, that was held out, by name
    held_out_runs: Mapping[str, FreeRun] = field(default_factory=dict)

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
    wanted = _Wanted(average, order, delay, leave_one_out, posterior, draws, seed, workers)
    data = _read(logs, network if "network" in models else None, (inputs, outputs, disturbances), wanted)
    kinds = _candidates(models, data.network)
    cases = cases_of(data.logs, leave_one_out)
    parts = _Parts(progress, (len(cases) + 1) * len(kinds) + 2)
    boxes = _fit_black_boxes(kinds, data, wanted, parts, early)
    finalists = kinds if leave_one_out else [k for k in kinds if k == "network" or boxes.kept_as(k)]
    held_out = _hold_out(finalists, cases, boxes.kept, data, wanted, parts)
    kind = choose_model(held_out.rows, sum(len(case.held) for case in cases))
    kind = kind or (boxes.kept.kind if boxes.kept is not None else None)
    if kind is None:
        raise _nothing_fitted((*boxes.refused, *held_out.refused), data)
    plant, lost = _refit(kind, boxes.kept, held_out, data, wanted, parts)
    return _judged(kind, plant, lost, boxes, held_out, data, wanted)


# read


@dataclass(frozen=True)
class _Wanted:
    """What was asked for beside the data."""

    average: float | None
    order: int | None
    delay: int | None
    leave_one_out: bool
    posterior: bool
    draws: int
    seed: int
    workers: Workers


@dataclass(frozen=True, eq=False)
class _Data:
    """The logs as all candidates see them."""

    logs: list[Log]
    network: GreyModel | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    checked: DataCheck
    signals: tuple[SignalRole, ...]
    doubts: tuple[str, ...]
    notes: tuple[str, ...]  # what was converted, taken for rest, or left out


_Lists = tuple[Sequence[str] | None, Sequence[str] | None, Sequence[str] | None]


def _read(logs: Logs, network: GreyModel | str | Path | None, lists: _Lists, wanted: _Wanted) -> _Data:
    """Return the logs in the roles and units of all candidates, checked; each is matched once."""
    named = dict(zip(("inputs", "outputs", "disturbances"), lists))
    read = as_logs(logs, *lists)
    model, read, converted = _for_network(network, read)
    if model is None:
        read = without_still(read)
    u, y, d = signals(read, **named)
    # a network has a prior of what never moves, others nothing
    still = still_inputs(model, read, u)
    u = tuple(name for name in u if name not in still)
    read, rested = with_rest(read, u, y)
    if wanted.leave_one_out and len(read) < 2:
        raise UserError("leaving one log out needs at least two logs", hint="give another log")
    checked = check_data(read, inputs=u, outputs=y, disturbances=d, average=wanted.average)
    _ask_for_excitation(checked, u, read[0])
    roles, unused = signal_roles(read, ([*u, *still], d, y), named, model, still)
    doubts = role_doubts(read, named_all=lists[0] is not None and lists[1] is not None)
    return _Data(read, model, u, y, d, checked, roles, doubts, (*converted, *rested, *unused))


def _ask_for_excitation(checked: DataCheck, inputs: Sequence[str], log: Log) -> None:
    failed = [finding for finding in checked.of("excitation") if finding.verdict == "fail"]
    if not failed:
        return
    kept = [name for name in inputs if name not in {finding.channel for finding in failed}]
    hint = "move it in the experiment, or leave it out"
    hint += f" with --inputs {','.join(kept)}" if 0 < len(kept) < len(inputs) else ""
    says = "; ".join(finding.says for finding in failed)
    raise UserError(says, file=log_name(log), column=failed[0].channel, hint=hint + moved_before(log))


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

    notes: list[str] = []
    if isinstance(network, NetworkModel):
        from thermogrip.sysid.data.shipped_networks import in_log_units, in_logged_room

        network, notes = in_logged_room(in_log_units(network, logs), logs)
    for log in logs:
        reason = misfit(network, log)
        if reason is not None:
            what = "" if reason.column is None else f"{reason.column} "
            raise UserError(
                f"the network {network.name} does not apply: {what}{reason.problem}",
                file=reason.file,
                hint=f"{reason.hint}; rename columns, or name another network (or none)",
            )
    matched, converted = match_logs(network, logs, keep_others=True)
    return network, matched, [*notes, *converted]


def _candidates(models: Sequence[str], network: GreyModel | None) -> list[str]:
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

    def rows(self) -> list[Row]:
        return [row for fit in self.fits for row in fold_rows(fit)]


def _fit_black_boxes(
    kinds: Sequence[str],
    data: _Data,
    wanted: _Wanted,
    parts: _Parts,
    early: Callable[[Identification], None] | None,
) -> _Boxes:
    """Fit each black box to all logs: subspace models first, whose step the others take; neural models, which
    take longest, last, and not at all where they are beyond reach. With ``leave_one_out`` they are fitted by
    case instead."""
    boxes = [] if wanted.leave_one_out else [kind for kind in kinds if kind != "network"]
    found: dict[str, BlackBoxFit | str] = {}
    grid = None
    if "subspace" in boxes:
        first = found["subspace"] = _fitted_here("subspace", data, wanted, parts)
        if isinstance(first, BlackBoxFit):
            grid = first.grid
            if early is not None:
                alone = _Boxes([first], [], first)
                early(_judged("subspace", first.plant, [], alone, _HeldOut([], [], {}), data, wanted))
    others = [kind for kind in boxes if kind not in ("subspace", "neural")]
    found |= dict(zip(others, _fitted_side_by_side(others, data, wanted, parts, grid)))
    if "neural" in boxes:
        fits = [each for each in found.values() if isinstance(each, BlackBoxFit)]
        found["neural"] = _fitted_neural(fits, data, wanted, parts)
    every = [found[kind] for kind in boxes]
    fits = [each for each in every if isinstance(each, BlackBoxFit)]
    kept = choose_black_box(fits, data.logs) if fits else None
    return _Boxes(fits, [each for each in every if isinstance(each, str)], kept)


def _fitted_side_by_side(
    kinds: Sequence[str], data: _Data, wanted: _Wanted, parts: _Parts, grid: Grid | None
) -> list[BlackBoxFit | str]:
    """Return each kind fitted to all logs, or why it could not be."""
    if wanted.workers == 1 or len(kinds) < 2:
        return [_fitted_here(kind, data, wanted, parts, grid) for kind in kinds]
    items = [(kind, _portable(data), wanted, None, grid) for kind in kinds]
    report = parts.part("black boxes", of=len(kinds))
    found = run_parallel(_fit_or_refusal, items, wanted.workers, report, what="fitting")
    parts.next(len(kinds))
    return found


def _fitted_here(
    kind: str,
    data: _Data,
    wanted: _Wanted,
    parts: _Parts,
    grid: Grid | None = None,
    beat: Mapping[str, float] | None = None,
) -> BlackBoxFit | str:
    report = parts.part(kind)
    found = _fit_or_refusal((kind, data, wanted, report, grid), beat)
    if report is not None:
        report(1.0, _in_short(found))
    parts.next()
    return found


def _fitted_neural(
    others: Sequence[BlackBoxFit], data: _Data, wanted: _Wanted, parts: _Parts
) -> BlackBoxFit | str:
    """Return the neural models, or why they were left out, or given up after the first parts held out."""
    if not others:
        return _fitted_here("neural", data, wanted, parts)
    if beyond_reach(others, data.logs):
        parts.next()
        return (
            "neural: left out, for even without any error on held-out parts it would not be kept: "
            "another run differs by more than the linear models err (--models neural fits it)"
        )
    choice = min((fit.choice for fit in others), key=lambda choice: choice.error)
    beat = dict(zip((fold.label for fold in choice.folds), choice.errors[choice.structure].tolist()))
    return _fitted_here("neural", data, wanted, parts, beat=beat)


def _portable(data: _Data) -> _Data:
    """Return the data without a network that another process cannot know: a class of the user's own."""
    from thermogrip.sysid.models.network import NetworkModel

    return data if isinstance(data.network, NetworkModel) else replace(data, network=None)


def _fit_or_refusal(
    item: tuple[str, _Data, _Wanted, Progress | None, Grid | None], beat: Mapping[str, float] | None = None
) -> BlackBoxFit | str:
    kind, data, wanted, report, grid = item
    try:
        return _fit_box(kind, data.logs, data, wanted, report, grid, beat)
    except UserError as error:
        return f"{kind}: {error}"


def _fit_box(
    kind: str,
    logs: Sequence[Log],
    data: _Data,
    wanted: _Wanted,
    report: Progress | None,
    grid: Grid | None = None,
    beat: Mapping[str, float] | None = None,
) -> BlackBoxFit:
    return fit_black_box(
        kind,
        logs,
        inputs=data.inputs,
        outputs=data.outputs,
        disturbances=data.disturbances,
        average=wanted.average,
        order=wanted.order,
        delay=wanted.delay,
        grid=grid,
        progress=report,
        beat=beat,
    )


def _in_short(found: BlackBoxFit | str) -> str:
    if isinstance(found, str):
        return "refused"
    choice = found.choice
    return f"{choice.structure.label}, errs {100 * choice.error:.1f} % of the spread on held-out parts"


# held out: the finalists on what they were fitted without


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """How the finalists did on what they were fitted without."""

    rows: list[Row]
    refused: list[str]
    runs: dict[str, dict[str, FreeRun]]  # by candidate and what was held out
    network: Plant | None = None  # fitted to all logs, where another process had the time


class _Fold(NamedTuple):
    """A candidate fitted to the training logs of a case (or why it was not), and its runs over the rest."""

    plant: Plant | None
    refused: tuple[str, ...]
    runs: tuple[tuple[str, FreeRun], ...]


_Item = tuple[str, Case, "BlackBoxFit | None", _Data, _Wanted, "Progress | None"]


def _hold_out(
    kinds: Sequence[str],
    cases: Sequence[Case],
    kept: BlackBoxFit | None,
    data: _Data,
    wanted: _Wanted,
    parts: _Parts,
) -> _HeldOut:
    """Fit each finalist without what is held out, and run it over that; on several processes where whole logs
    are left out."""
    pairs = [(kind, case) for case in cases for kind in kinds]
    everything = Case(data.logs, [])
    elsewhere = wanted.leave_one_out and wanted.workers != 1
    found: dict[int, _Fold] = {}
    whole: Plant | None = None
    if elsewhere:
        sent = _portable(data)
        shared = [k for k, (kind, _) in enumerate(pairs) if kind != "network" or sent.network is not None]
        # what takes longest first: a process that begins with it last leaves others idle
        shared.sort(key=lambda k: _LONGEST.index(pairs[k][0]) if pairs[k][0] in _LONGEST else len(_LONGEST))
        todo = [(*pairs[k], kept, sent, wanted, None) for k in shared]
        at = next((k for k, item in enumerate(todo) if item[0] == "network"), None)
        if at is not None:  # the likely one: it is kept also where another errs a little less
            todo.insert(at, ("network", everything, None, sent, wanted, None))
        report = parts.part("left out", of=len(todo))
        folds = run_parallel(_fold_of, todo, wanted.workers, report, what="fitting")
        if at is not None:
            whole = folds.pop(at).plant
        found = dict(zip(shared, folds))
    for k, (kind, case) in enumerate(pairs):
        if k not in found:
            report = parts.part(f"{kind} without {_names(case)}")
            found[k] = _fold_of((kind, case, kept, data, wanted, report))
        parts.next()
    rows, refused, runs = list[Row](), list[str](), dict[str, dict[str, FreeRun]]()
    for k, (kind, _) in enumerate(pairs):
        refused += found[k].refused
        for name, run in found[k].runs:
            rows += rows_of(kind, run.plant, name, run, held_out=True)
            runs.setdefault(kind, {})[name] = run
    return _HeldOut(rows, refused, runs, whole)


def _names(case: Case) -> str:
    """Return what is held out of a case, in short."""
    return case.held[0].name if len(case.held) == 1 else f"{TAIL}each log"


def _fold_of(item: _Item) -> _Fold:
    """Fit a candidate to the training logs of a case and run it over what is held out; a network fitted to
    all logs is drawn from at once."""
    kind, case, kept, data, wanted, report = item
    names = _names(case)
    try:
        plant = _fitted(kind, case.train, kept, data, wanted, report)
    except UserError as error:
        return _Fold(None, (f"{kind} without {names}: {error}",), ())
    if not case.held and wanted.draws and not wanted.posterior:
        from thermogrip.sysid.greybox.posterior import fit_problem, with_draws

        with suppress(*NO_DRAWS):  # who wants them meets the same fault, and says it
            plant = with_draws(plant, fit_problem(plant, case.train), wanted.draws, seed=wanted.seed)
    refused, runs = list[str](), list[tuple[str, FreeRun]]()
    for held in case.held:
        try:
            runs.append((held.name, run_held_out(plant, held, unseen=True)))
        except UserError as error:
            refused.append(f"{kind} without {held.name}: {error}")
    return _Fold(plant, tuple(refused), tuple(runs))


def _fitted(
    kind: str,
    train: Sequence[Log],
    kept: BlackBoxFit | None,
    data: _Data,
    wanted: _Wanted,
    report: Progress | None,
) -> Plant:
    """Return a candidate fitted to some logs: of the black box that is kept the same structure."""
    if kind == "network":
        from thermogrip.sysid.greybox.fit import fit_network  # pulls in llvmlite at the first fit

        assert data.network is not None
        return fit_network(data.network, train, progress=report)
    if kept is None:
        return _fit_box(kind, train, data, wanted, report).plant
    grid = kept.grid.of(train, ends=kept.grid.ends)
    model = FAMILIES[kind](grid, only=kept.choice.structure).get(kept.choice.structure)
    if model is None:
        raise UserError(f"{kind}: the chosen structure is unstable without the last part of the logs")
    return replace(kept.plant, model=model)


# choice


def choose_black_box(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> BlackBoxFit:
    """Return the fit of the least error on the parts, a linear one where another kind errs hardly less.

    Among linear kinds the smaller one of two that tie was no better on 14 public logs (in the geometric mean
    both err 1.34 times the best structure of all), nor was the one of the less error on the whole log of its
    fit, run from its start (1.69 times, 1.37 where it decides within 5 percent)."""
    run = _run_error(fits, logs)
    most = HARDLY_MORE if len(fits[0].grid.logs) < SEVERAL else MORE_BY_LOGS
    errors = [np.log(np.hypot(fit.choice.errors[fit.choice.structure], run)) for fit in fits]
    by_error = sorted(range(len(fits)), key=lambda k: float(errors[k].mean()))
    best = by_error[0]
    linear = next((k for k in by_error if fits[k].kind in LINEAR), best)
    return fits[linear if excess_within_noise(errors[linear] - errors[best], most) else best]


def beyond_reach(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> bool:
    """Return whether even another kind without any error would be hardly better on another run."""
    linear = [fit for fit in fits if fit.kind in LINEAR]
    run = _run_error(linear, logs) if linear else 0.0
    return run > 0 and float(np.hypot(min(fit.choice.error for fit in linear), run)) <= WITHIN_NOISE * run


def _run_error(fits: Sequence[BlackBoxFit], logs: Sequence[Log]) -> float:
    """Return what a gain that differs from run to run adds, in units of the outputs' spread, by the best
    linear fit (else any); 0 where the logs show it."""
    best = min([fit for fit in fits if fit.kind in LINEAR] or fits, key=lambda fit: fit.choice.error)
    changes = _rms(between_runs(best.plant, logs))
    added = [changes.get(name, 0.0) / s for name, s in zip(best.grid.outputs, best.grid.output_spread())]
    return float(np.sqrt(np.mean(np.square(added))))


def _rms(changes: Mapping[str, Array]) -> dict[str, float]:
    return {name: float(np.sqrt(np.mean(change**2))) for name, change in changes.items()}


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


def _nothing_fitted(refused: Sequence[str], data: _Data) -> UserError:
    noisy = [finding.says for finding in data.checked.of("noise") if finding.verdict != "ok"]
    problem = f"no model could be fitted ({refused[0] if refused else 'none was asked for'})"
    return UserError(problem, hint="; ".join([*noisy, *data.doubts]) or None)


# refit: the chosen one on all logs, with what its uncertainty is drawn from


def _refit(
    kind: str,
    kept: BlackBoxFit | None,
    held_out: _HeldOut,
    data: _Data,
    wanted: _Wanted,
    parts: _Parts,
) -> tuple[Plant, list[str]]:
    """Return the plant of a kind fitted to all logs with its draws, and in words why it has none."""
    report = parts.part(f"{kind} on all logs")
    if kind == "network":
        plant = held_out.network or _fitted(kind, data.logs, None, data, wanted, report)
        parts.next()
        if plant.samples is not None:  # another process has drawn already
            return plant, []
        return _network_draws(plant, data.logs, wanted, parts)
    fit = kept or _fit_box(kind, data.logs, data, wanted, report)
    parts.next()
    if not wanted.draws or kind not in RESAMPLED:
        return fit.plant, []
    try:
        return with_refits(fit, wanted.draws, seed=wanted.seed, progress=parts.part("draws")), []
    except NO_DRAWS as error:
        return fit.plant, [no_draws(kind, "draws", error)]


def _network_draws(
    plant: Plant, logs: Sequence[Log], wanted: _Wanted, parts: _Parts
) -> tuple[Plant, list[str]]:
    what = "posterior" if wanted.posterior else "draws"
    if not (wanted.posterior or wanted.draws):
        return plant, []
    from thermogrip.sysid.greybox.posterior import fit_problem, sample_posterior, with_draws

    report = parts.part(what)
    try:
        if wanted.posterior:
            return sample_posterior(plant, logs, seed=wanted.seed, progress=report)[0], []
        problem = fit_problem(plant, logs)
        return with_draws(plant, problem, wanted.draws, seed=wanted.seed, progress=report), []
    except NO_DRAWS as error:
        return plant, [no_draws("network", what, error)]


def no_draws(model: str, what: str, error: Exception) -> str:
    """Return the note on a fit that is kept without its ``what`` (draws, posterior)."""
    return f"{model}: no {what}, the fit is kept without: {error}"


# verdict


def _judged(
    kind: str,
    plant: Plant,
    lost: Sequence[str],
    boxes: _Boxes,
    held_out: _HeldOut,
    data: _Data,
    wanted: _Wanted,
) -> Identification:
    """Return the plant with its scores and expected errors, and all that was found beside it."""
    # the last part of the kept black box is scored at the logs' own rows
    folds = [row for row in boxes.rows() if not (boxes.kept_as(row.model) and row.log.startswith(TAIL))]
    rows = [*folds, *held_out.rows]
    # the same warm-up as on what was held out, or errors of the start would stand beside ones without
    starts = [0.0 if wanted.leave_one_out else warm_up_of(log["time"].values) for log in data.logs]
    whole = [Held(log, log_name(log), start) for log, start in zip(data.logs, starts)]
    runs = tuple(run_held_out(plant, held) for held in whole)
    for held, run in zip(whole, runs):
        rows += rows_of(kind, plant, held.name, run, held_out=False)
    plant = _with_expected(plant, kind, rows, data.logs)
    # a fit without the last part that could not be run over it says nothing of another run either
    not_scored = [note for note in held_out.refused if note.startswith(f"{kind} without ")]
    doubts = (*data.doubts, *doubts_of(plant), *not_scored)
    good, verdict = verdict_of(kind, plant, rows, data.checked, doubts)
    covered = evidence(plant, [log_rows(log, plant.inputs, plant.outputs, ()) for log in data.logs])
    verdict += f" {covered.sentence(plant.units)}."
    notes = (*data.notes, *boxes.refused, *held_out.refused, *lost, *_plant_notes(kind, plant))
    return Identification(
        plant=replace(plant, verdict=verdict),
        model=kind,
        rows=tuple(rows),
        data_check=data.checked,
        evidence=covered,
        good=good,
        doubts=doubts,
        verdict=verdict,
        notes=notes,
        signals=data.signals,
        runs=runs,
        searched=tuple(row for fit in boxes.fits for row in searched_rows(fit)),
        held_out_runs=held_out.runs.get(kind, {}),
    )


def _with_expected(plant: Plant, kind: str, rows: Sequence[Row], logs: Sequence[Log]) -> Plant:
    """Return the plant with its held-out scores and the error of another run."""
    held = [
        # of a constant reading no share can be fitted, and JSON has no NaN
        HeldOut(row.log, row.output, row.rmse, float(np.nan_to_num(row.fit_percent)), row.unit, row.n)
        for row in rows
        if row.held_out and row.model == kind
    ]
    plant = replace(plant, scores=replace(plant.scores, held_out=held))
    differs = _rms(between_runs(plant, logs))
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
