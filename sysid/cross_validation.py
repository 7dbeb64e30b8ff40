"""How candidate models are compared: what is held out, the free run through it, which candidate is kept.

**What is held out.**  With ``leave_one_out`` each log in turn.  Otherwise the last 30 percent of each log,
for one round of scores, run freely from the log's start, where its state is known.

**Which candidate is kept.**  That of the least held-out error over that of a model without input; the network
also when it is within 10 percent of the best, for its parameters mean something.  A model that no output
shows to beat a model without input (see :mod:`thermogrip.sysid.validation.free_run`) is never called good.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, log_name
from thermogrip.sysid.data.data_quality import DataCheck
from thermogrip.sysid.plant.fit_record import HeldOut
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run

__all__ = [
    "Held",
    "Row",
    "cases_of",
    "choose_model",
    "held_out_scores",
    "relative_error",
    "rows_of",
    "run_held_out",
    "verdict_of",
    "warm_up_of",
]

HELD_OUT_SHARE = 0.3  # of each log, without leave_one_out
WITHIN_NOISE = 1.1  # of the best error: then the network is preferred
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
    times = [log["time"].values for log in logs]
    rows = [int(np.searchsorted(t, t[0] + (1 - HELD_OUT_SHARE) * (t[-1] - t[0]))) for t in times]
    train = [log.isel(time=slice(0, at)) for log, at in zip(logs, rows)]
    for log, time, at in zip(logs, times, rows):  # run from the log's start: there its state is known
        name = f"last {100 * HELD_OUT_SHARE:.0f} % of {log_name(log)}"
        yield train, Held(log, name, float(time[at] - time[0]))


def run_held_out(plant: Plant, held: Held, *, unseen: bool = False) -> FreeRun:
    """Return the free run over what is held out; ``unseen`` by the fit, a neural model may be refused for it.

    Members of a neural model that disagree over what they have not seen have a mean that means nothing.
    """
    # a log may begin warm, and then its state needs more readings than one that begins at rest
    warmup = max(5.0 if held.score_from == 0 else warm_up_of(held.log), plant.dt)
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


def warm_up_of(log: Log) -> float:
    """Return the warm-up [s] of a log that may begin warm: fifty rows, a minute at most."""
    return min(50.0 * float(np.median(np.diff(log["time"].values))), 60.0)


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
    return "network" if mean.get("network", np.inf) <= WITHIN_NOISE * mean[best] else best


def verdict_of(model: str, rows: Sequence[Row], checked: DataCheck, whole_logs: bool) -> tuple[bool, str]:
    """Return whether the kept candidate may be called good, and why, in a sentence."""
    held = [row for row in rows if row.held_out and row.model == model]
    worst = max(held, key=relative_error)
    share = relative_error(worst)
    own = max(
        (row for row in rows if not row.held_out and row.model == model), key=relative_error, default=worst
    )
    good = share < USEFUL and relative_error(own) < USEFUL and checked.verdict != "fail"
    where = "logs left out" if whole_logs else "the last part of the logs, left out"
    units = dict.fromkeys((row.output, "" if row.unit == "1" else f" {row.unit}") for row in held)
    numbers = ", ".join(
        f"{name} {np.sqrt(np.mean([r.rmse**2 for r in held if r.output == name])):.2g}{unit}"
        for name, unit in units
    )
    head = f"{model}: free run on {where}: RMSE {numbers}"
    if good:
        return True, f"{head}; good for simulation and control inside what the logs cover"
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


def relative_error(row: Row) -> float:
    """Return the error over that of a model without input."""
    return row.rmse / max(row.no_input_rmse, 1e-12)


def held_out_scores(rows: Sequence[Row], model: str) -> list[HeldOut]:
    """Return a candidate's held-out rows as a plant's file keeps them."""
    return [
        HeldOut(row.log, row.output, row.rmse, row.fit_percent, row.unit, row.n)
        for row in rows
        if row.held_out and row.model == model
    ]
