"""From logs to a plant: the ladder of models.

    data check -> fit each rung -> score each by free run on data that it has not seen -> keep one, say why

The rungs are ``arx``, ``oe``, ``subspace``, ``sindy``, ``neural`` (black boxes) and ``network`` (physics).
Each black box chooses its orders by held-out free run inside the data that it is given, so a log that is
left out is left out of that choice as well.

What is held out and which rung is kept is told in :mod:`thermogrip.sysid.cross_validation`.  The plant that
is returned is fitted on everything; its scores on its own logs stand beside, marked as in-sample.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, log_name, names
from thermogrip.sysid.blackbox.block_bootstrap import RESAMPLED, with_refits
from thermogrip.sysid.blackbox.fit import BLACK_BOXES, Rung, fit_black_box
from thermogrip.sysid.cross_validation import (
    Held,
    Row,
    cases_of,
    choose_rung,
    held_out_scores,
    relative_error,
    score_rows,
    verdict_of,
    warm_up_of,
)
from thermogrip.sysid.data.data_quality import DataCheck, Evidence, check_data, evidence
from thermogrip.sysid.plant.log_grid import signals
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.signal_match import match_logs, misfit, roles_of
from thermogrip.sysid.validation.prediction_bands import SHORT, foretold_shares

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel

__all__ = ["MODELS", "NO_DRAWS", "Identification", "Row", "SignalRole", "identify", "no_draws"]

MODELS = (*BLACK_BOXES, "network")
NO_DRAWS = (UserError, np.linalg.LinAlgError)  # what draws of a fit may fail with; the fit itself is sound

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SignalRole:
    """What a column of the logs was taken for.

    Parameters
    ----------
    name, unit : str
    role : str
        ``"input"``, ``"disturbance"``, ``"output"`` or ``"left out"``.
    why : str
        Who says so, or what the guess rests on.
    guessed : bool
    """

    name: str
    unit: str
    role: str
    why: str
    guessed: bool


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
    signals : tuple of SignalRole
        What each column of the logs was taken for, and why.
    """

    plant: Plant
    model: str
    rows: tuple[Row, ...]
    data_check: DataCheck
    evidence: Evidence
    good: bool
    verdict: str
    notes: tuple[str, ...]
    signals: tuple[SignalRole, ...] = ()

    def errors(self) -> dict[str, float]:
        """Return the held-out error of each rung, relative to the no-input baseline, averaged over rows."""
        out: dict[str, list[float]] = {}
        for row in self.rows:
            if row.held_out:
                out.setdefault(row.model, []).append(relative_error(row))
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
    network, records, converted = _for_network(network if "network" in models else None, records)
    u, y, d = signals(records, inputs=inputs, outputs=outputs, disturbances=disturbances)
    rungs = _wanted(models, network)
    if leave_one_out and len(records) < 2:
        raise UserError("leaving one log out needs at least two logs", hint="give another log")
    checked = _checked(records, u, y, d, average)
    fit = _Fitter(network, u, y, d, average, seed)
    cases = list(cases_of(records, leave_one_out))
    told = _Told(progress, len(cases) * len(rungs) + 2)
    rows, refused = _held_out_rows(fit, rungs, cases, told)
    chosen = choose_rung(rows, len(cases))
    if chosen is None:
        asked = [finding.says for finding in checked.of("noise") if finding.verdict != "ok"]
        problem = f"no model could be fitted ({refused[0] if refused else 'no rung asked for'})"
        raise UserError(problem, hint="; ".join(asked) or None)
    plant, note = _on_all(fit, chosen, records, told, posterior=posterior, draws=draws)
    unused = _left_out(records, (*u, *y, *d)) if inputs is outputs is disturbances is None else []
    notes = (*converted, *refused, *unused, *note, *_steps(chosen, plant), *_uneven(chosen, plant))
    rows += _in_sample_rows(chosen, plant, records, leave_one_out=leave_one_out)
    good, verdict = verdict_of(chosen, rows, checked, leave_one_out)
    covered = evidence(plant, records)
    verdict += "; " + covered.sentence(plant.units)
    plant = replace(
        plant, verdict=verdict, scores=replace(plant.scores, held_out=held_out_scores(rows, chosen))
    )
    lists = {"input": inputs, "output": outputs, "disturbance": disturbances}
    taken = _roles_taken(records, (u, d, y), lists, network)
    return Identification(plant, chosen, tuple(rows), checked, covered, good, verdict, notes, taken)


def _roles_taken(
    logs: Sequence[Log],
    groups: tuple[Sequence[str], Sequence[str], Sequence[str]],
    lists: Mapping[str, Sequence[str] | None],
    network: GreyModel | None,
) -> tuple[SignalRole, ...]:
    """Return what each column of the logs was taken for: inputs, disturbances, outputs, the rest."""
    units, guesses = dict[str, str](), dict[str, str]()
    for log in reversed(logs):  # the first log has the say
        units |= {str(name): str(item.attrs.get("units", "1")) for name, item in log.items()}
        lines = str(log.attrs.get("guesses", "")).splitlines()
        guesses |= dict(line.split(": ", 1) for line in lines if ": " in line)
    of_network = {} if network is None else roles_of(network)
    taken = {name: r for r, group in zip(("input", "disturbance", "output"), groups) for name in group}
    out = []
    for name in (*taken, *(n for n in units if n not in taken)):
        role, why, guessed = taken.get(name, "left out"), "the log says so", False
        if role != "left out" and name in (lists[role] or ()):
            why = "named"
        elif of_network.get(name) == role and network is not None:
            why = f"network {network.name}"
        elif name in guesses:
            why, guessed = guesses[name], True
        elif role == "left out":
            why = "not named"
        out.append(SignalRole(name, units[name], role, why, guessed))
    return tuple(out)


def _for_network(
    network: GreyModel | str | Path | None, logs: list[Log]
) -> tuple[GreyModel | None, list[Log], list[str]]:
    """Return the network, the logs in its roles and units, and what was converted."""
    if network is None:
        return None, logs, []
    if isinstance(network, (str, Path)):
        from thermogrip.sysid.models.network import load_network

        network = load_network(network)
    for log in logs:
        reason = misfit(network, log)
        if reason is not None:
            what = "" if reason.column is None else f"{reason.column} "
            raise UserError(
                f"the network {network.name} does not apply: {what}{reason.problem}",
                file=reason.file,
                hint=f"{reason.hint}; rename columns, or name another network (or none)",
            )
    matched, said = match_logs(network, logs, keep_others=True)
    return network, matched, said


def _checked(
    logs: Sequence[Log], u: Sequence[str], y: Sequence[str], d: Sequence[str], average: float | None
) -> DataCheck:
    """Return what the data check says; raise UserError where an input does not move."""
    checked = check_data(logs, inputs=u, outputs=y, disturbances=d, average=average)
    for found in checked.of("excitation"):
        if found.verdict == "fail":
            hint = "move it in the experiment, or leave it out"
            raise UserError(found.says, file=log_name(logs[0]), column=found.channel, hint=hint)
    return checked


@dataclass(frozen=True)
class _Fitter:
    """Fits a rung by name."""

    network: GreyModel | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    average: float | None
    seed: int

    def __call__(self, rung: str, logs: Sequence[Log], progress: Progress | None) -> Plant:
        if rung != "network":
            return self.black_box(rung, logs, progress).plant
        from thermogrip.sysid.greybox.fit import fit_network  # pulls in llvmlite and nlopt at the first fit

        if self.network is None:
            raise UserError("no network was named", hint="name one")
        return fit_network(self.network, logs, seed=self.seed, progress=progress)

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
    fit: _Fitter, rungs: Sequence[str], cases: Sequence[tuple[list[Log], Held]], told: _Told
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
                rows += score_rows(rung, fitted[rung, id(train)], held, held_out=True)
            except UserError as error:
                refused.append(f"{what}: {error}")
            told.next()
    return rows, refused


def _on_all(
    fit: _Fitter, rung: str, logs: Sequence[Log], told: _Told, *, posterior: bool, draws: int
) -> tuple[Plant, list[str]]:
    """Return the kept rung fitted on everything, with its draws, and in words why there are none."""
    on_all = told.part(f"{rung} on all logs")
    if rung != "network":
        fitted = fit.black_box(rung, logs, on_all)
        told.next()
        return _with_refits(fitted, draws, fit.seed, told.part("draws"))
    plant = fit(rung, logs, on_all)
    told.next()
    what = "posterior" if posterior else "draws"
    if not (posterior or draws):
        return plant, []
    from thermogrip.sysid.greybox.posterior import sample_posterior, with_draws

    try:
        if posterior:
            return sample_posterior(plant, logs, seed=fit.seed, progress=told.part(what))[0], []
        return with_draws(plant, logs, draws, seed=fit.seed, progress=told.part(what)), []
    except NO_DRAWS as error:
        return plant, [no_draws(rung, what, error)]


def _in_sample_rows(rung: str, plant: Plant, logs: Sequence[Log], *, leave_one_out: bool) -> list[Row]:
    """Return the rows of the kept rung on the logs that it was fitted to."""
    rows = []
    for log in logs:
        # the same warm-up as on what was held out, or errors of the start would stand beside ones without
        begin = 0.0 if leave_one_out else warm_up_of(log)
        rows += score_rows(rung, plant, Held(log, log_name(log), begin), held_out=False)
    return rows


def _steps(rung: str, plant: Plant) -> list[str]:
    """Return in words the step of a black box, and why it is that."""
    if not plant.scores.average_why:
        return []
    return [f"{rung}: steps of {plant.scores.average_s:.3g} s ({plant.scores.average_why})"]


def _with_refits(rung: Rung, draws: int, seed: int, progress: Progress | None) -> tuple[Plant, list[str]]:
    """Return the plant with its refits, and in words why there are none."""
    if not draws or rung.kind not in RESAMPLED:
        return rung.plant, []
    try:
        return with_refits(rung, draws, seed=seed, progress=progress), []
    except NO_DRAWS as error:
        return rung.plant, [no_draws(rung.kind, "draws", error)]


def no_draws(rung: str, what: str, error: Exception) -> str:
    """Return the note on a fit that is kept without its ``what`` (draws, posterior)."""
    return f"{rung}: no {what}, the fit is kept without: {error}"


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
            part = plant.scores.folds[worst]
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


def _wanted(models: Sequence[str], network: GreyModel | None) -> list[str]:
    unknown = [name for name in models if name not in MODELS]
    if unknown:
        raise UserError(f"no model of kind {unknown[0]!r}", hint=f"choose from {', '.join(MODELS)}")
    rungs = [name for name in models if name != "network" or network is not None]
    if not rungs:
        raise UserError("no model is left to fit", hint="name a network, or another model")
    return rungs
