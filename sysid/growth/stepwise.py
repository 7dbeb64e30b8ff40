"""Stepwise growth and pruning of a network, decided on held-out logs.

Every term that residuals suggest lowers the error of the logs that it is fitted to. Here each one is kept
only for its gain on logs that it has not seen:

1. A *candidate* is a named change of the network file: an element more, or one less.
2. It is fitted and simulated freely in *folds*. With three logs or more each is left out in turn; a log
   that alone moves some input is cut in half instead, for only it contains that effect. Fewer logs are cut
   into blocks.
3. Its *gain* is g = mean_f ln(e_f / e'_f) over the folds f, e the held-out RMSE before and e' after (the
   geometric mean over outputs), with the standard error of that mean: folds are compared in pairs, since a
   hard log is hard for both.
4. An addition is kept if g exceeds its standard error and _LEAST, its new parameters are practically
   identifiable (on no bound, not known from the prior alone), the condition of the scaled Hessian is at
   most _WORST, and half of the gain is left once a straight line in time is taken out of the held-out
   errors of each: on one log anything slow, a cooling room above all, resembles a drift of the sensor or
   the supply.
5. A removal is kept if the error does not rise by more than the standard error and _LEAST.

The terms with which the residuals of the first network correlate
(:func:`~thermogrip.sysid.growth.candidates.residual_terms`) stand beside the record, and the largest propose
the candidates that they stand for, with their own time constants; after each change that is kept the new
residual proposes again. A proposal is evaluated like any other candidate.

The best candidate of a round becomes the base of the next. Every comparison uses the held-out logs again,
and the best of many comparisons is biased: :attr:`Growth.evaluations` is their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.resample import cut
from thermogrip.datasets.schema import Log, column, log_name
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.growth.candidates import (
    Candidate,
    ResidualTerm,
    patched,
    proposed,
    residual_terms,
    suggested,
)
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.plant.fit_record import Identifiability
from thermogrip.sysid.plant.plant import Plant

_LEAST = 0.01  # a gain of 1 % is not worth a parameter
_WORST = 1e7  # condition of the scaled Hessian
_BLOCKS = 3  # of a log, where logs are fewer than three
_LINE_LEAVES = 0.5  # of the gain, once a straight line is taken out


@dataclass(frozen=True, eq=False)
class Fold:
    """Logs to fit and a log to score."""

    name: str
    train: tuple[Log, ...]
    test: Log  # run freely from its start
    score_from: float  # seconds since its start from which it is scored


@dataclass(frozen=True)
class GrowthRow:
    """One comparison."""

    round: int  # 0 is the initial network
    candidate: str
    change: str  # "add", "remove" or "base"
    rmse: dict[str, float]  # held-out RMSE by fold, the geometric mean over the outputs
    gain: float  # mean of ln(before / after)
    se: float  # its standard error
    condition: float  # of the scaled Hessian of all logs; NaN where the gain was not worth the fit
    verdict: str  # "kept", "good" (but another was better in this round) or "refused"
    why: str  # one clause
    asked: str = ""  # the residual's term that proposed it, such as "t_surface: drive*t_tank"


@dataclass(frozen=True, eq=False)
class Growth:
    """The network that grew, and how."""

    network: NetworkModel
    plant: Plant  # fitted to all logs
    rows: tuple[GrowthRow, ...]
    evaluations: int  # comparisons on the held-out logs
    # terms with which the residuals of the initial network correlate, on stretches held out
    residual: tuple[ResidualTerm, ...] = ()


@dataclass(frozen=True, eq=False)
class _Trial:
    """A network with its plants and held-out errors by fold."""

    model: NetworkModel
    plants: tuple[Plant, ...]
    rmse: Array  # (n_fold,) geometric mean over outputs
    flat: Array  # the same, a straight line taken out


def grow(
    network: NetworkModel | str,
    logs: Sequence[Log],
    candidates: Sequence[Candidate] | None = None,
    *,
    folds: Sequence[Fold] | None = None,
    outputs: Sequence[str] | None = None,
    rounds: int = 2,
    warmup: float = 5.0,
    progress: Progress | None = None,
) -> Growth:
    """Try candidates on held-out logs, keep those that earn it, and return the network with the whole record.

    Where absent, ``candidates`` are what the residual's terms propose and then those of
    :func:`thermogrip.sysid.growth.candidates.suggested`; all ``outputs`` count. The best candidate may become
    the base of the next round so many ``rounds``; ``warmup`` [s] of a held-out log may set its start.
    """
    model = network if isinstance(network, NetworkModel) else load_network(network)
    report = progress or (lambda fraction, what: None)
    cases = tuple(folds_of(model, logs) if folds is None else folds)
    wanted = _wanted(model, outputs)
    base = _try(model, cases, wanted, warmup, None)
    plant = fit_network(model, list(logs))
    residual = residual_terms(plant, logs, warmup=warmup)
    left = _proposals(model, residual, wanted) if candidates is None else [(c, "") for c in candidates]
    rows = [_base_row(base, cases, plant)]
    for number in range(1, rounds + 1):
        found: list[tuple[GrowthRow, _Trial, Plant | None]] = []
        for at, (candidate, asked) in enumerate(left):
            done = (number - 1 + at / len(left)) / rounds
            report(min(0.99, done), f"round {number}: {candidate.name}")
            trial = _try(patched(base.model, candidate), cases, wanted, warmup, base)
            row, fitted = _evaluate(number, candidate, base, trial, cases, plant, logs)
            found.append((replace(row, asked=asked), trial, fitted))
        good = [item for item in found if item[0].verdict == "good"]
        best = max(good, key=lambda item: item[0].gain, default=None)
        rows += [replace(item[0], verdict="kept") if item is best else item[0] for item in found]
        if best is None or best[2] is None:
            break
        base, plant = best[1], best[2]
        left = [(c, asked) for c, asked in left if c.name != best[0].candidate and _applies(base.model, c)]
        if candidates is None and number < rounds:
            left = _proposals(base.model, residual_terms(plant, logs, warmup=warmup), wanted, left)
    report(1.0, "grown")
    return Growth(base.model, plant, tuple(rows), len(rows) - 1, residual)


def folds_of(model: NetworkModel, logs: Sequence[Log]) -> list[Fold]:
    """Return the folds of some logs: whole logs left out, halves of a log that is alone in something, or
    blocks."""
    if len(logs) < 3:
        return [fold for log in logs for fold in _block_folds(log, [o for o in logs if o is not log])]
    out = []
    for log in logs:
        rest = tuple(other for other in logs if other is not log)
        alone = [u for u in model.inputs if _moves(log, u) and not any(_moves(o, u) for o in rest)]
        if alone:
            first, last = _span(log)
            half = (first + last) / 2
            out.append(Fold(f"{log_name(log)}, second half", (*rest, cut(log, stop=half)), log, half - first))
        else:
            out.append(Fold(log_name(log), rest, log, 5.0))
    return out


def growth_table(growth: Growth) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the record as text: one row a comparison."""
    names = list(growth.rows[0].rmse) if growth.rows else []
    header = [
        "round",
        "candidate",
        "proposed by",
        "change",
        *names,
        "gain [%]",
        "condition",
        "verdict",
        "why",
    ]
    rows = []
    for row in growth.rows:
        gain = "-" if row.change == "base" else f"{100 * row.gain:.1f} +- {100 * row.se:.1f}"
        condition = "-" if np.isnan(row.condition) else f"{row.condition:.0e}"
        errors = [f"{row.rmse[name]:.3f}" for name in names]
        about = [str(row.round), row.candidate, row.asked or "-", row.change]
        rows.append([*about, *errors, gain, condition, row.verdict, row.why])
    return header, rows


def _block_folds(log: Log, rest: Sequence[Log]) -> list[Fold]:
    first, last = _span(log)
    edges = np.linspace(first, last, _BLOCKS + 1)
    if (last - first) / _BLOCKS < 120:
        raise UserError("is too short to hold a part out", file=log_name(log), hint="give a longer log")
    out = []
    for k in range(_BLOCKS):
        parts = [] if k == 0 else [cut(log, stop=edges[k])]
        parts += [] if k == _BLOCKS - 1 else [cut(log, start=edges[k + 1])]
        test = cut(log, start=edges[k], stop=edges[k + 1])
        out.append(Fold(f"{log_name(log)}, part {k + 1}", (*rest, *parts), test, 100.0))
    return out


def _span(log: Log) -> tuple[float, float]:
    time = np.asarray(log["time"].values, dtype=float)
    return float(time[0]), float(time[-1])


def _moves(log: Log, name: str) -> bool:
    return float(np.nanstd(column(log, name))) > 0


def _wanted(model: NetworkModel, outputs: Sequence[str] | None) -> tuple[str, ...]:
    for name in outputs or ():
        if name not in model.outputs:
            raise UserError(f"no output {name!r}", hint=known_names(name, model.outputs, "there are {}"))
    return tuple(outputs or model.outputs)


def _proposals(
    model: NetworkModel,
    terms: Sequence[ResidualTerm],
    wanted: Sequence[str],
    others: Sequence[tuple[Candidate, str]] | None = None,
) -> list[tuple[Candidate, str]]:
    """Return candidates with the term that by_name for each: what the residual proposes, then the others."""
    counted = [term for term in terms if term.output in wanted]
    by_name = {c.name: (c, f"{term.output}: {term.term}") for c, term in proposed(model, counted)}
    rest = [(c, "") for c in suggested(model)] if others is None else others
    return [*by_name.values(), *((c, asked) for c, asked in rest if c.name not in by_name)]


def _applies(model: NetworkModel, candidate: Candidate) -> bool:
    try:
        patched(model, candidate)
    except UserError:
        return False
    return True


def _try(
    model: NetworkModel, cases: Sequence[Fold], wanted: Sequence[str], warmup: float, base: _Trial | None
) -> _Trial:
    """Fit and score a network in all folds, each fit starting near that of the base."""
    plants, rmse, flat = [], [], []
    for k, fold in enumerate(cases):
        near = None if base is None else base.plants[k].values
        plant = fit_network(model, list(fold.train), near=near)
        errors = _held_out_errors(plant, fold, wanted, warmup)
        plants.append(plant)
        rmse.append(_size([e for _, e in errors]))
        flat.append(_size([_without_line(t, e) for t, e in errors]))
    return _Trial(model, tuple(plants), np.array(rmse), np.array(flat))


def _held_out_errors(
    plant: Plant, fold: Fold, wanted: Sequence[str], warmup: float
) -> list[tuple[Array, Array]]:
    """Return times and errors of the scored readings, by output."""
    warmup = min(max(warmup, 1.0), fold.score_from) if fold.score_from > 0 else warmup
    run = plant.simulate(fold.test, warmup=warmup, score_from=max(fold.score_from, warmup))
    scored, time = np.asarray(run["scored"].values) > 0, np.asarray(run["time"].values, dtype=float)
    out = []
    for name in wanted:
        error = column(run, name) - column(fold.test, name)
        known = scored & np.isfinite(error)
        out.append((time[known], error[known]))
    return out


def _size(errors: Sequence[Array]) -> float:
    return float(np.exp(np.mean([0.5 * np.log(np.mean(e**2) + 1e-12) for e in errors])))


def _without_line(time: Array, error: Array) -> Array:
    return np.asarray(error - np.polyval(np.polyfit(time - time.mean(), error, 1), time - time.mean()))


def _gain(before: Array, after: Array) -> tuple[float, float]:
    """Return the mean of ln(before / after) and its standard error."""
    each = np.log(before / after)
    se = float(each.std(ddof=1) / np.sqrt(each.size)) if each.size > 1 else float("inf")
    return float(each.mean()), se


def _evaluate(
    number: int,
    candidate: Candidate,
    base: _Trial,
    trial: _Trial,
    cases: Sequence[Fold],
    plant: Plant,
    logs: Sequence[Log],
) -> tuple[GrowthRow, Plant | None]:
    """Return the row of a candidate, and its plant where it is good."""
    gain, se = _gain(base.rmse, trial.rmse)
    straight = _gain(base.flat, trial.flat)[0]
    row = GrowthRow(
        number,
        candidate.name,
        candidate.change,
        dict(zip((fold.name for fold in cases), trial.rmse.round(4).tolist())),
        gain,
        se,
        float("nan"),
        "refused",
        "",
    )
    why = _against(candidate, gain, se, straight)
    if why:
        return replace(row, why=why), None
    fitted = fit_network(trial.model, list(logs), near=plant.values)
    report = _identifiability(fitted)
    row = replace(row, condition=report.condition)
    why = _not_identifiable(candidate, base.model, trial.model, report, _identifiability(plant))
    if why:
        return replace(row, why=why), None
    why = f"{100 * (1 - np.exp(-gain)):.0f} % less error" if candidate.change == "add" else "costs nothing"
    return replace(row, verdict="good", why=why), fitted


def _against(candidate: Candidate, gain: float, se: float, straight: float) -> str:
    """Return why the held-out logs refuse a candidate; empty where they do not."""
    if candidate.change == "remove":
        return f"its loss costs {-100 * gain:.0f} %" if gain < -max(_LEAST, min(se, 3 * _LEAST)) else ""
    if gain < _LEAST:
        return "no gain on held-out logs" if gain > -_LEAST else "larger error on held-out logs"
    if gain < se:
        return "gain within one standard error"
    if straight < _LINE_LEAVES * gain:
        return "a straight line in time explains its gain as well"
    return ""


def _not_identifiable(
    candidate: Candidate,
    before: NetworkModel,
    after: NetworkModel,
    report: Identifiability,
    base: Identifiability,
) -> str:
    """Return why identifiability refuses a candidate; empty where it does not."""
    new = [name for name in after.parameters if name not in before.parameters]
    stuck = [name for name in report.on_bound if name not in base.on_bound]
    if stuck:
        return f"on a bound: {', '.join(stuck)}"
    prior_only = [name for name in new if name in report.prior_only]
    if prior_only:
        return f"known from the prior only: {', '.join(prior_only)}"
    if candidate.change == "add" and report.condition > max(_WORST, 3 * base.condition):
        return f"badly conditioned: {report.weakest}"
    return ""


def _identifiability(plant: Plant) -> Identifiability:
    """Return the identifiability of a network's parameters."""
    report = plant.scores.identifiability
    assert report is not None  # every fit of a network has it
    return report


def _base_row(base: _Trial, cases: Sequence[Fold], plant: Plant) -> GrowthRow:
    rmse = dict(zip((fold.name for fold in cases), base.rmse.round(4).tolist()))
    condition = _identifiability(plant).condition
    return GrowthRow(0, base.model.name, "base", rmse, 0.0, 0.0, condition, "kept", "as it came")
