"""What is held out of logs, and how a plant that was fitted without it does there: a row of the table each.

With ``leave_one_out`` each log in turn is held out.  Otherwise black boxes are compared on the parts that
chose their orders: four blocks and the last 30 percent, or whole logs where there are three. The one that is
kept, and the network, are scored besides on the last 30 percent of each log, fitted without them and run
freely from the log's start, where its state is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, log_name
from thermogrip.sysid.blackbox.fit import BlackBoxFit
from thermogrip.sysid.plant.fit_record import HELD_OUT_SHARE, TAIL
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run, no_input_baseline, warm_up_of
from thermogrip.sysid.validation.prediction_bands import check_ensemble
from thermogrip.sysid.validation.verdict import Row, network_name


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
        return [
            Case(
                [log for log in logs if log is not logs_held_out],
                [Held(logs_held_out, log_name(logs_held_out), 0.0)],
            )
            for logs_held_out in logs
        ]
    case = Case([], [])
    for log in logs:
        time = log["time"].values
        cut = int(np.searchsorted(time, time[0] + (1 - HELD_OUT_SHARE) * (time[-1] - time[0])))
        case.train.append(log.isel(time=slice(0, cut)))
        # run from the log's start: there its state is known
        case.held.append(Held(log, f"{TAIL}{log_name(log)}", float(time[cut] - time[0])))
    return [case]


def run_held_out(plant: Plant, held: Held, *, unseen: bool = False) -> FreeRun:
    """Return the free run over what is held out; ``unseen`` by the fit, a neural model may be refused for it.

    Members of a neural model that disagree over what they have not seen have a mean that means nothing.
    """
    # a log may begin warm, and then its state needs more readings than one that begins at rest
    warmup = max(5.0 if held.score_from == 0 else warm_up_of(held.log["time"].values), plant.dt)
    if unseen and plant.model.kind == "neural":
        check_ensemble(plant, held.log, warmup=warmup)
    return free_run(plant, held.log, warmup=warmup, score_from=max(warmup, held.score_from), tests=False)


def rows_of(model: str, plant: Plant, name: str, run: FreeRun, *, held_out: bool) -> list[Row]:
    """Return a row for each output of a free run; ``held_out``: the plant was fitted without it."""
    structure = plant.scores.structure or network_name(plant) or model
    return [
        Row(model, structure, name, output, s.rmse, s.fit_percent, s.unit, s.n, baseline.rmse, held_out)
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
            what, unit = (fit.kind, fit.choice.structure.label, fold.label, output), fit.grid.units[output]
            rows.append(Row(*what, rmse, percent, unit, n, idle_rmse, held_out=True))
    return rows


def relative_error(row: Row) -> float:
    """Return the error over that of a model without input."""
    return row.rmse / max(row.no_input_rmse, 1e-12)
