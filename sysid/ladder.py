"""From logs to a plant: the ladder of models.

    data check -> fit each rung -> score each by free run on data that it has not seen -> keep one, say why

The rungs are ``arx``, ``oe``, ``subspace``, ``sindy``, ``neural`` (black boxes) and ``network`` (physics).
Each black box chooses its orders by held-out free run inside the data that it is given, so a log that is
left out is left out of that choice as well.

* ``leave_one_out``: each log is left out in turn, every rung is fitted on the others and simulates it.
* Otherwise the last 30 percent of each log are held out for one round of scores, run freely from the log's
  start.  The plant that is returned is fitted on everything; its scores on its own logs stand beside, marked
  as in-sample.

**Which one is kept.**  The rung of the least held-out error; the network also when it is within 10 percent
of the best, for its parameters mean something.  A model that no output shows to beat a model without input
(see :mod:`thermogrip.sysid.validate`) is never called good.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, log_name, names
from thermogrip.sysid.bands import SHORT, foretold_shares
from thermogrip.sysid.blackbox import BLACK_BOXES, Rung, fit_black_box
from thermogrip.sysid.bootstrap import RESAMPLED, with_refits
from thermogrip.sysid.check_data import DataCheck, check_data
from thermogrip.sysid.evidence import Evidence, evidence
from thermogrip.sysid.plant import Plant
from thermogrip.sysid.segments import signals
from thermogrip.sysid.validate import free_run

if TYPE_CHECKING:
    from thermogrip.sysid.grey_model import GreyModel

__all__ = ["MODELS", "Identification", "Row", "identify"]

MODELS = (*BLACK_BOXES, "network")

HELD_OUT_SHARE = 0.3  # of each log, without leave_one_out
WITHIN_NOISE = 1.1  # of the best error: then the network is preferred
USEFUL = 0.5  # of the no-input error: below it a model is called good

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Row:
    """One line of the table: one model, one log, one output.

    Parameters
    ----------
    model : str
        The rung.
    structure : str
        Its orders, delays or network.
    log : str
        What was simulated.
    output : str
    rmse, fit_percent, unit, n
        The free run; n scored samples.
    no_input_rmse : float
        The same of the no-input baseline.
    held_out : bool
        Whether the model was fitted without these rows.
    """

    model: str
    structure: str
    log: str
    output: str
    rmse: float
    fit_percent: float
    unit: str
    n: int
    no_input_rmse: float
    held_out: bool


@dataclass(frozen=True, eq=False)
class Identification:
    """What :func:`identify` found.

    Parameters
    ----------
    plant : Plant
        The chosen model, fitted on everything.
    model : str
        Its rung.
    rows : tuple of Row
        The table: every rung on held-out data, then the chosen one in sample.
    data_check : DataCheck
    evidence : Evidence
        Which temperatures and how many minutes of each kind of drive the plant rests on.
    good : bool
        Whether the chosen model may be called good.
    verdict : str
        One sentence.
    notes : tuple of str
        Rungs that could not be fitted, and why; the step of a black box that is kept, and why.
    """

    plant: Plant
    model: str
    rows: tuple[Row, ...]
    data_check: DataCheck
    evidence: Evidence
    good: bool
    verdict: str
    notes: tuple[str, ...]

    def errors(self) -> dict[str, float]:
        """Return the held-out error of each rung, relative to the no-input baseline, averaged over rows."""
        out: dict[str, list[float]] = {}
        for row in self.rows:
            if row.held_out:
                out.setdefault(row.model, []).append(_share(row))
        return {model: float(np.mean(values)) for model, values in out.items()}


def identify(
    logs: Sequence[Log] | Log,
    network: GreyModel | str | Path | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    *,
    models: Sequence[str] = MODELS,
    average: float | None = None,
    leave_one_out: bool = False,
    posterior: bool = False,
    draws: int = 24,
    seed: int = 0,
    progress: Progress | None = None,
) -> Identification:
    """Find the plant behind one or several logs.

    Parameters
    ----------
    logs : Log or sequence of Log
    network : GreyModel, str or Path, optional
        A thermal network, or the name or file of one; without it the rung ``network`` is left out.
    inputs, outputs, disturbances : sequence of str, optional
        Names of the signals; by role where absent.
    models : sequence of str, optional
        Rungs to fit, of :data:`MODELS`.
    average : float, optional
        Averaging step of the black boxes [s]; chosen where absent.
    leave_one_out : bool, optional
        Score each log by a fit to the others (at least two logs).
    posterior : bool, optional
        Sample the posterior of the network's parameters.
    draws : int, optional
        Without the posterior: so many plants that agree with the logs stand in for it; of a black box, refits
        to resampled logs.
    seed : int, optional
    progress : callable, optional
        Called with (fraction done, what).

    Returns
    -------
    Identification

    Raises
    ------
    UserError
        If a signal or a model is unknown, the data say nothing (a constant input), or no rung can be fitted.

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
    records = [logs] if not isinstance(logs, Sequence) else list(logs)
    u, y, d = signals(records, inputs=inputs, outputs=outputs, disturbances=disturbances)
    rungs = _wanted(models, network)
    if leave_one_out and len(records) < 2:
        raise UserError("leaving one log out needs at least two logs", mend="give another log")
    checked = check_data(records, inputs=u, outputs=y, disturbances=d, average=average)
    for found in checked.of("excitation"):
        if found.verdict == "fail":
            mend = "move it in the experiment, or leave it out"
            raise UserError(found.says, file=log_name(records[0]), column=found.channel, mend=mend)
    fit = _Fitter(network, u, y, d, average, seed)
    cases = list(_cases(records, leave_one_out))
    told = _Told(progress, len(cases) * len(rungs) + 2)
    rows, refused = _held_out_rows(fit, rungs, cases, told)
    notes = refused + (_left_out(records, (*u, *y, *d)) if inputs is outputs is disturbances is None else [])
    chosen = _choose(rows, len(cases))
    if chosen is None:
        raise UserError(f"no model could be fitted ({refused[0] if refused else 'no rung asked for'})")
    on_all = told.part(f"{chosen} on all logs")
    if chosen == "network":
        plant = fit(chosen, records, on_all, posterior=posterior)
        told.next()
        if draws and not posterior:
            from thermogrip.sysid.posterior import with_draws

            plant = with_draws(plant, records, draws, seed=seed, progress=told.part("draws"))
    else:
        fitted_rung = fit.black_box(chosen, records, on_all)
        told.next()
        plant, note = _with_refits(fitted_rung, draws, seed, told.part("draws"))
        notes += note
    if "average_why" in plant.scores:
        notes.append(f"{chosen}: steps of {plant.scores['average_s']:.3g} s ({plant.scores['average_why']})")
    notes += _uneven(chosen, plant)
    for log in records:
        # the same warm-up as on what was held out, or errors of the start would stand beside ones without
        begin = 0.0 if leave_one_out else _warm(log)
        rows += _rows(chosen, plant, _Held(log, log_name(log), begin), held_out=False)
    good, verdict = _verdict(chosen, rows, checked, leave_one_out)
    covered = evidence(plant, records)
    verdict += "; " + covered.sentence(plant.units)
    plant = replace(plant, verdict=verdict, scores=plant.scores | {"held_out": _as_scores(rows, chosen)})
    return Identification(plant, chosen, tuple(rows), checked, covered, good, verdict, tuple(notes))


@dataclass(frozen=True)
class _Fitter:
    """Fits a rung by name."""

    network: GreyModel | str | Path | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    average: float | None
    seed: int

    def __call__(
        self, rung: str, logs: Sequence[Log], progress: Progress | None, *, posterior: bool = False
    ) -> Plant:
        if rung != "network":
            return self.black_box(rung, logs, progress).plant
        from thermogrip.sysid.greybox import fit_network  # pulls in llvmlite and nlopt at the first fit

        if self.network is None:
            raise UserError("no network was named", mend="name one")
        plant = fit_network(self.network, logs, seed=self.seed, progress=progress)
        if not posterior:
            return plant
        from thermogrip.sysid.posterior import sample_posterior

        return sample_posterior(plant, logs, seed=self.seed, progress=progress)[0]

    def black_box(self, rung: str, logs: Sequence[Log], progress: Progress | None) -> Rung:
        return fit_black_box(
            rung,
            logs,
            inputs=self.inputs,
            outputs=self.outputs,
            disturbances=self.disturbances,
            average=self.average,
            progress=progress,
        )


def _held_out_rows(
    fit: _Fitter, rungs: Sequence[str], cases: Sequence[tuple[list[Log], _Held]], told: _Told
) -> tuple[list[Row], list[str]]:
    """Return the rows of every rung on what is held out, and which could not be fitted, and why."""
    rows: list[Row] = []
    refused: list[str] = []
    fitted: dict[tuple[str, int], Plant] = {}  # without leave_one_out all cases share one training set
    for train, held in cases:
        for rung in rungs:
            what = f"{rung} without {held.name}"
            try:
                if (rung, id(train)) not in fitted:
                    fitted[rung, id(train)] = fit(rung, train, told.part(what))
                rows += _rows(rung, fitted[rung, id(train)], held, held_out=True)
            except UserError as error:
                refused.append(f"{what}: {error}")
            told.next()
    return rows, refused


def _with_refits(rung: Rung, draws: int, seed: int, progress: Progress | None) -> tuple[Plant, list[str]]:
    """Return the plant with its refits, and in words why there are none."""
    if not draws or rung.kind not in RESAMPLED:
        return rung.plant, []
    try:
        return with_refits(rung, draws, seed=seed, progress=progress), []
    except UserError as error:
        return rung.plant, [f"{rung.kind}: no draws: {error}"]


def _left_out(logs: Sequence[Log], used: Sequence[str]) -> list[str]:
    """Return a line for each log with signals that the first one, which says what is used, does not have."""
    out = []
    for log in logs[1:]:
        signals_of = (name for role in ("input", "output", "disturbance") for name in names(log, role))
        if more := [name for name in signals_of if name not in used]:
            out.append(
                f"{log_name(log)}: {', '.join(more)} left out, for {log_name(logs[0])} has no such signal"
            )
    return out


def _uneven(rung: str, plant: Plant) -> list[str]:
    """Return a line for each output whose errors differ so much over the logs that no band fits all."""
    out = []
    for name, shares in foretold_shares(plant).items():
        worst = int(np.argmin(shares))
        if shares[worst] <= 0.9 - SHORT:
            part = plant.scores["folds"][worst]
            out.append(
                f"{rung}: errors of {name} differ over the logs; of {part} a 90 % band of the others "
                f"should hold {100 * shares[worst]:.0f} %, so bands are too narrow where it is like that"
            )
    return out


class _Told:
    """Spreads the progress of parts over the whole."""

    def __init__(self, progress: Progress | None, parts: int) -> None:
        self._progress, self._parts, self._done = progress, parts, 0

    def part(self, what: str) -> Progress | None:
        if self._progress is None:
            return None
        whole, begin, parts = self._progress, self._done, self._parts
        return lambda done, detail: whole((begin + done) / parts, f"{what}: {detail}")

    def next(self) -> None:
        self._done += 1


def _wanted(models: Sequence[str], network: GreyModel | str | Path | None) -> list[str]:
    unknown = [name for name in models if name not in MODELS]
    if unknown:
        raise UserError(f"no model of kind {unknown[0]!r}", mend=f"choose from {', '.join(MODELS)}")
    rungs = [name for name in models if name != "network" or network is not None]
    if not rungs:
        raise UserError("no model is left to fit", mend="name a network, or another model")
    return rungs


class _Held(NamedTuple):
    """A log to run freely, what to call it, and the seconds since its start from which it is scored."""

    log: Log
    name: str
    score_from: float


def _cases(logs: Sequence[Log], leave_one_out: bool) -> Iterator[tuple[list[Log], _Held]]:
    """Yield (training logs, what is held out)."""
    if len({log_name(log) for log in logs}) < len(logs):
        raise UserError("two logs have the same name", mend="give each file its own name")
    if leave_one_out:
        for held in logs:
            yield [log for log in logs if log is not held], _Held(held, log_name(held), 0.0)
        return
    cuts = [_cut(log) for log in logs]
    train = [first for first, _ in cuts]
    for _, last in cuts:
        yield train, last


def _cut(log: Log) -> tuple[Log, _Held]:
    """Return the first part of a log, and its last, run from the log's start: there its state is known."""
    time = log["time"].values
    at = int(np.searchsorted(time, time[0] + (1 - HELD_OUT_SHARE) * (time[-1] - time[0])))
    name = f"last {100 * HELD_OUT_SHARE:.0f} % of {log_name(log)}"
    return log.isel(time=slice(0, at)), _Held(log, name, float(time[at] - time[0]))


def _rows(rung: str, plant: Plant, held: _Held, *, held_out: bool) -> list[Row]:
    # a log may begin warm, and then its state needs more readings than one that begins at rest
    warmup = max(5.0 if held.score_from == 0 else _warm(held.log), plant.dt)
    if held_out and rung == "neural":
        from thermogrip.sysid.neural_trust import refuse_strays  # pulls in numba

        refuse_strays(plant, held.log, warmup=warmup)
    run = free_run(plant, held.log, warmup=warmup, score_from=max(warmup, held.score_from), tests=False)
    structure = str(plant.scores.get("structure", rung))
    return [
        Row(rung, structure, held.name, name, s.rmse, s.fit_percent, s.unit, s.n, blind.rmse, held_out)
        for (name, s), blind in zip(run.scores.items(), run.naive["no_input"].values())
    ]


def _warm(log: Log) -> float:
    """Return the warm-up [s] of a log that may begin warm: fifty rows, a minute at most."""
    return min(50.0 * float(np.median(np.diff(log["time"].values))), 60.0)


def _choose(rows: Sequence[Row], complete: int) -> str | None:
    """Return the rung of the least mean relative error among those scored on every held-out log."""
    errors: dict[str, list[float]] = {}
    scored: dict[str, set[str]] = {}
    for row in rows:
        errors.setdefault(row.model, []).append(_share(row))
        scored.setdefault(row.model, set()).add(row.log)
    mean = {model: float(np.mean(e)) for model, e in errors.items() if len(scored[model]) == complete}
    mean = {model: e for model, e in mean.items() if np.isfinite(e)} or mean
    if not mean:
        return None
    best = min(mean, key=lambda model: mean[model])
    return "network" if mean.get("network", np.inf) <= WITHIN_NOISE * mean[best] else best


def _verdict(rung: str, rows: Sequence[Row], checked: DataCheck, whole_logs: bool) -> tuple[bool, str]:
    held = [row for row in rows if row.held_out and row.model == rung]
    worst = max(held, key=_share)
    share = _share(worst)
    own = max((row for row in rows if not row.held_out and row.model == rung), key=_share, default=worst)
    good = share < USEFUL and _share(own) < USEFUL and checked.verdict != "fail"
    where = "logs left out" if whole_logs else "the last part of the logs, left out"
    units = dict.fromkeys((row.output, "" if row.unit == "1" else f" {row.unit}") for row in held)
    numbers = ", ".join(
        f"{name} {np.sqrt(np.mean([r.rmse**2 for r in held if r.output == name])):.2g}{unit}"
        for name, unit in units
    )
    head = f"{rung}: free run on {where}: RMSE {numbers}"
    if good:
        return True, f"{head}; good for simulation and control inside what the logs cover"
    if share < USEFUL <= _share(own):
        part = f"on {own.log}, which it is fitted to, its error for {own.output} is {100 * _share(own):.0f} %"
        return False, f"{head}; not good: {part} of a model's without input; try other models, or longer logs"
    if share < 1:
        part = (
            f"on {worst.log} its error for {worst.output} is {100 * share:.0f} % of a model's without input"
        )
        return False, f"{head}; not good: {part}; it needs more excitation, or another model"
    return False, f"{head}; not good: a model without input does as well on {worst.log}"


def _share(row: Row) -> float:
    """Return the error over that of a model without input."""
    return row.rmse / max(row.no_input_rmse, 1e-12)


def _as_scores(rows: Sequence[Row], rung: str) -> list[dict[str, object]]:
    keep = ("log", "output", "rmse", "fit_percent", "unit", "n")
    return [{key: getattr(row, key) for key in keep} for row in rows if row.held_out and row.model == rung]
