"""Free run of a plant over a log, beside baselines and tests of its residual.

The plant sees the inputs and disturbances of the whole log, and measured outputs of the warm-up only. For
each output, over the n scored samples,

    RMSE = sqrt(mean (y - v)^2),        fit = 100 (1 - |y - v| / |y - mean y|)  percent.

Beside it stand one step (the last reading plus the model's move: small for every slow plant, it ranks models
wrongly), the mean, and the best decay without an input (:func:`no_input_baseline`): a model that does not
beat that has learnt nothing from the input.

The residual is tested (:mod:`thermogrip.sysid.validation.residual_tests`), the verdict goes by its size
(:mod:`thermogrip.sysid.validation.stated_errors`).
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, column, columns, gaps, log_name
from thermogrip.sysid.plant.log_grid import cut_stretches, match_logs
from thermogrip.sysid.plant.plant_data import SEVERAL, fit_logs, said_of_fit
from thermogrip.sysid.validation.residual_tests import SQUARED, ResidualCorrelations, residual_correlations
from thermogrip.sysid.validation.stated_errors import (
    NO_BETTER,
    Band,
    Cause,
    InputEffect,
    Verdict,
    drawn_runs,
    effect_of_run,
    free_run_band,
    judge,
)

if TYPE_CHECKING:
    from pathlib import Path

    from pandas import DataFrame

    from thermogrip.sysid.plant.plant import Plant

START = 0.1  # share of the squared error due to the start, from which that is reported


@dataclass(frozen=True)
class Score:
    """Agreement of a simulated with a measured output."""

    fit_percent: float  # 100 (1 - |y - v| / |y - mean y|)
    rmse: float  # in ``unit``
    unit: str  # unit of the output
    n: int  # scored samples


@dataclass(frozen=True, eq=False)
class FreeRun:
    """What :func:`free_run` found, by output."""

    log: Log  # simulated outputs, inputs, disturbances and ``scored`` (1 or 0) at the measured times
    scores: dict[str, Score]  # of the free run
    one_step: dict[str, Score]  # of the last reading plus the model's move
    naive: dict[str, dict[str, Score]]  # of the baselines ``"mean"`` and ``"no_input"``
    held: dict[str, Score]  # with the last row held through the gaps; empty without a gap
    # tests of the residual for correlation with signals; empty without ``tests``
    residual: ResidualCorrelations
    no_better: tuple[str, ...]  # outputs whose free run does not clearly beat the no-input baseline
    notes: tuple[str, ...]  # what limits these numbers
    warmup: float  # seconds whose readings set the state
    plant: Plant  # what was run
    measured: Log  # over what, in the plant's units
    verdict: Verdict | None = None  # on the plant; None without ``tests``
    stated: Band | None = None  # the 90 % band, where it is known already

    def band(self) -> Band:
        """Return the band about the run that a new run's readings should lie in, and the share that does;
        see :func:`~thermogrip.sysid.validation.stated_errors.free_run_band`."""
        drawn = drawn_runs(self.plant, self.measured, self.warmup)
        return self.stated or free_run_band(self.plant, self.measured, self.log, drawn, warmup=self.warmup)


def free_run(
    plant: Plant,
    log: Log | DataFrame | str | Path,
    warmup: float | None = None,
    score_from: float | None = None,
    *,
    average: float | None = None,
    tests: bool = True,
) -> FreeRun:
    """Simulate the log and score it.

    Parameters
    ----------
    plant : Plant
    log : Log, DataFrame, str or Path
    warmup : float, optional
        Seconds at the start whose measured outputs may set the state; :func:`usual_warmup` where absent.
    score_from : float, optional
        Samples before this many seconds are not scored; where absent, those of the warm-up.
    average : float, optional
        Compare means over this many seconds, as a coarse sensor needs it; the tests see the samples.
    tests : bool, optional
        Test whether the residual correlates with an input, which takes some dozens of free runs.

    Returns
    -------
    FreeRun

    Raises
    ------
    UserError
        If the log lacks a signal of the plant, or nothing is left to score.

    Examples
    --------
    A plant scored on its own simulation has no error:

    >>> from thermogrip.datasets.schema import make_log
    >>> from thermogrip.sysid.plant.plant import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[1.0]], C=[[1.0]], dt=1.0)
    >>> q = np.repeat([0.0, 1.0, 0.0, 2.0], 50)
    >>> y = block.rollout([[0.0]], q[None, :, None], np.zeros((1, 200, 0)), (), 1.0)[0][0, :-1, 0]
    >>> log = make_log(np.arange(200.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    >>> run = free_run(Plant(block, {}, dt=1.0), log)
    >>> run.scores["t"].rmse < 0.01, run.scores["t"].n, run.no_better
    (True, 195, ())
    """
    (log,), converted = match_logs(plant, [log])
    warmup = usual_warmup(plant, log) if warmup is None else warmup
    score_from = warmup if score_from is None else score_from
    if score_from < warmup:
        raise UserError(
            f"scoring from {score_from:g} s would score readings of the {warmup:g} s warm-up",
            hint=f"score from {warmup:g} s on",
        )
    simulated = plant.simulate(log, warmup=warmup, score_from=score_from)
    compared = _compare(plant, log, simulated, average)
    held = {}
    # through a gap of more than 10 s the input is unknown: the run starts afresh after it, unscored for 60 s
    if gaps(log):
        through = plant.simulate(log, warmup=warmup, score_from=score_from, gaps="hold")
        held = _compare(plant, log, through, average).scores
    run = FreeRun(
        log=simulated,
        **compared._asdict(),
        held=held,
        residual=ResidualCorrelations({}, {}),
        no_better=tuple(
            name
            for name, no_input in compared.naive["no_input"].items()
            if not compared.scores[name].rmse < NO_BETTER * no_input.rmse
        ),
        notes=(),
        warmup=warmup,
        plant=plant,
        measured=log,
    )
    by_inputs = None
    if tests:
        is_scored = column(simulated, "scored")[:, None] > 0
        error = np.where(is_scored, columns(log, plant.outputs) - columns(simulated, plant.outputs), np.nan)
        by_inputs = effect_of_run(plant, error, log)
        run = _judged(run, error, by_inputs)
    notes = [*said_of_fit(plant.fitted_to, *fit_logs([log])), *converted, *_notes(run, by_inputs)]
    return replace(run, notes=tuple(notes))


def usual_warmup(plant: Plant, log: Log) -> float:
    """Return the seconds of readings that set the state where nothing is said."""
    # a black box of one or two logs was scored from the steady start of a part, fifty rows; the slowest state
    # needs a tenth of its time constant to show, and no run spends more than a tenth of its log on that
    few = plant.scores.held_out_by_part and 0 < len(plant.logs) < SEVERAL
    of_fit = warm_up_of(log["time"].values) if few else 0.0
    return max(5.0, plant.dt, of_fit, start_seconds(plant, log))


def start_seconds(plant: Plant, log: Log) -> float:
    """Return a tenth of the slowest time constant of a plant, at most a tenth of the log [s]."""
    return float(f"{slowest_time(plant, log) / 10:.2g}")


def slowest_time(plant: Plant, log: Log) -> float:
    """Return the slowest time constant of a plant, at most the length of the log [s]."""
    from thermogrip.sysid.export.dynamics import plant_dynamics

    slowest, seconds = float("inf"), float(log["time"][-1] - log["time"][0])
    with suppress(UserError):  # a plant that does not settle
        slowest = float(plant_dynamics(plant, draws=0).time_constants[0])
    return min(slowest, seconds)


def warm_up_of(time: Array) -> float:
    """Return the warm-up [s] of a log that may begin warm: fifty rows, a minute at most."""
    return min(50.0 * float(np.median(np.diff(time))), 60.0)


def _judged(run: FreeRun, error: Array, by_inputs: InputEffect | None) -> FreeRun:
    """Return the run with tests of its error (n, n_y), NaN where not scored, and the verdict on the plant."""
    plant, log = run.plant, run.measured
    simulated, scored = columns(run.log, plant.outputs), column(run.log, "scored") > 0
    drawn = list(drawn_runs(plant, log, run.warmup))
    band = free_run_band(plant, log, run.log, drawn, warmup=run.warmup)
    residual = residual_correlations(
        plant, cut_stretches(plant, log), simulated, scored, warmup=run.warmup, drawn=drawn
    )
    with np.errstate(over="ignore", invalid="ignore"):
        offsets = np.nanmean(error, axis=0) ** 2 / np.maximum(np.nanmean(error**2, axis=0), 1e-300)
    causes: dict[str, dict[Cause, float]] = {
        name: {"start": residual.start.get(name, 0.0), "offset": float(share)}
        for name, share in zip(plant.outputs, offsets)
    }
    of_readings = _compare(plant, log, run.log)
    rows = replace(fit_logs([log])[0], start_s=float(log["time"].values[np.argmax(scored)]))
    verdict = judge(
        band,
        {name: each.rmse for name, each in of_readings.scores.items()},
        {name: each.rmse for name, each in of_readings.naive["no_input"].items()},
        causes=causes,
        by_inputs=by_inputs,
        seen=bool(said_of_fit(plant.fitted_to, rows)),
    )
    return replace(run, residual=residual, verdict=verdict, stated=band)


def score(measured: Array, simulated: Array, unit: str = "degC") -> Score:
    """Return the score over the samples where the reading is known; a run that diverged scores infinity."""
    known = np.isfinite(measured)
    if not known.any():
        raise UserError("nothing is left to score", hint="give a longer log, or score from an earlier time")
    y, v = measured[known], simulated[known]
    if not np.isfinite(v).all():
        return Score(float("-inf"), float("inf"), unit, int(y.size))
    with np.errstate(over="ignore"):
        miss, spread = float(np.linalg.norm(y - v)), float(np.linalg.norm(y - y.mean()))
    fit = 100 * (1 - miss / spread) if spread > 0 else float("nan")
    return Score(fit, miss / float(np.sqrt(y.size)), unit, int(y.size))


def no_input_baseline(time: Array, measured: Array) -> Array:
    """Return m + (y_first - m) exp(-t/tau), from the first scored reading to the mean: (n,)."""
    known = np.isfinite(measured)
    mean, first = float(np.mean(measured[known])), float(np.mean(measured[known][:5]))
    best = np.full(measured.shape, mean)
    least = float(np.sum((measured - best)[known] ** 2))
    t = np.maximum(time - time[known][0], 0.0)
    for tau in np.geomspace(max(t[-1], 1.0) / 300, max(t[-1], 1.0) * 30, 30):
        decay = mean + (first - mean) * np.exp(-t / tau)
        cost = float(np.sum((measured - decay)[known] ** 2))
        if cost < least:
            best, least = decay, cost
    return best


class _Scores(NamedTuple):
    """Scores by output of a free run, of one step, and of the baselines."""

    scores: dict[str, Score]
    one_step: dict[str, Score]
    naive: dict[str, dict[str, Score]]


def _compare(plant: Plant, log: Log, simulated: Log, average: float | None = None) -> _Scores:
    """Return the scores of a free run beside a log, in means over ``average`` [s] if given."""
    time, scored = log["time"].values, column(simulated, "scored") > 0
    if not scored.any():
        problem = f"nothing of its {np.ptp(time):g} s is left to score"
        hint = "give a longer log, or score from an earlier time"
        raise UserError(problem, file=log_name(log), hint=hint)
    read, run = (np.where(scored[:, None], columns(each, plant.outputs), np.nan) for each in (log, simulated))
    if average is not None:
        time, means = block_means(log, np.hstack([read, run]), average)
        read, run = np.split(means, 2, axis=1)
    scores, one_step, mean, no_input = {}, {}, {}, {}
    for name, y, v in zip(plant.outputs, read.T, run.T):
        unit = str(log[name].attrs.get("units", "1"))
        scores[name] = score(y, v, unit)
        mean[name] = score(y, np.full(y.shape, np.nanmean(y)), unit)
        no_input[name] = score(y, no_input_baseline(time, y), unit)
        # of the last reading that came plus the run's move
        y, v = y[np.isfinite(y)], v[np.isfinite(y)]
        with np.errstate(invalid="ignore"):  # a run that went to infinity makes no step there
            one_step[name] = score(y[1:], y[:-1] + np.diff(v), unit)
    return _Scores(scores, one_step, {"mean": mean, "no_input": no_input})


def block_means(log: Log, values: Array, seconds: float) -> tuple[Array, Array]:
    """Return starts (n_block,) and means (n_block, n) of what is there of values (n_time, n) in blocks of so
    many seconds, which begin anew after each gap."""
    import pandas as pd

    time = log["time"].values
    step = float(np.median(np.diff(time)))
    if not seconds >= step * (1 - 1e-9):
        problem = f"cannot average over {seconds:g} s: the rows are {step:g} s apart"
        raise UserError(problem, file=log_name(log), hint="choose a longer block")
    segment = np.searchsorted([row for row, _, _ in gaps(log)], np.arange(time.size))
    begin = pd.Series(time).groupby(segment).transform("first").to_numpy()
    # rows a rounding error before an edge belong behind it: 3 * 0.1 > 0.3
    starts = begin + seconds * np.floor((time - begin) / seconds + 1e-9)
    means = pd.DataFrame(values).groupby(starts).mean()
    if len(means) < 2:
        problem = f"{len(means)} block of {seconds:g} s is not a log"
        raise UserError(problem, file=log_name(log), hint="choose a shorter block")
    return means.index.to_numpy(dtype=float), means.to_numpy(dtype=float)


def _notes(run: FreeRun, by_inputs: InputEffect | None) -> list[str]:
    """Return what limits the scores of a run, and what its residual shows."""
    plant = run.plant
    log = run.measured
    verdict = run.verdict
    first, notes = float(log["time"][0]), []
    if first > 60:
        notes.append(
            f"the run starts at {first:g} s from its warm-up alone: what was warm and unseen is guessed; "
            f"give the whole log and score from {first:g} s to start where the log starts"
        )
    held = ", ".join(f"{name} {score.rmse:.3g} {score.unit}" for name, score in run.held.items())
    notes += [
        f"no row from {before:g} to {after:g} s: the run starts afresh after it, the next 60 s are not "
        f"scored (last row held instead: RMSE {held})"
        for _, before, after in gaps(log)
    ]
    if verdict is None or verdict.standing != "no test":
        for name in run.no_better:
            beside = "worse" if run.scores[name].rmse > run.naive["no_input"][name].rmse else "barely better"
            notes.append(
                f"{name}: {beside} than a model without input: the fit cannot be relied on for control"
            )
    outside = _outside(plant, {name: column(log, name) for name in plant.valid if name in log})
    unseen = [name for name in outside if name not in plant.outputs]
    units = {name: each.unit for name, each in run.scores.items()}
    small = verdict is not None and verdict.standing not in ("worse", "another plant")
    notes += _residual_notes(run, units, unseen, small=small)
    if by_inputs is not None:
        remaining = ", ".join(
            f"{name} {rms:.2g} {units[name]}".removesuffix(" 1") for name, rms in by_inputs.remaining.items()
        )
        notes.append(f"most of the error is {by_inputs.words()}, which would leave {remaining}")
    for name, share in outside.items():
        low, high = plant.valid[name]
        where = f"{low:g} to {high:g}, the range of the fit, in {100 * share:.0f} % of the rows"
        notes.append(f"{name} lies outside of {where}")
    return notes if verdict is None else [*notes, str(verdict)]


def _residual_notes(run: FreeRun, units: Mapping[str, str], unseen: list[str], *, small: bool) -> list[str]:
    """Return with what each residual correlates, by how much, and what that may mean; ``small``: of an error
    that is no larger than was stated."""
    notes = []
    for name, tests in run.residual.tests.items():
        significant = {signal: found for signal, found in tests.items() if found.significant}
        for signal, found in significant.items():
            what, lacks = signal, "a delay, lag or term"
            if signal.endswith(SQUARED):
                what = f"the square of {name}"
                losses = "a loss that curves (radiation, free convection)"
                lacks = losses if units[name] == "degC" else "a term that curves"
            why = f"{lacks} is missing, or the plant is not what it was in the fit"
            if small:
                why = f"{lacks} is missing, within the error that was stated"
            if unseen:
                seldom = f"the fit has not seen {', '.join(unseen)} as here"
                why = f"{seldom}, so this need not be a term that is missing"
            size = f"{found.size:.2g} {units[name]}".removesuffix(" 1")
            notes.append(
                f"{name}: the residual correlates with {what} (rms {size}, p = {found.p:.1g}): {why}"
            )
        share = run.residual.start.get(name, 0.0)
        if share > START and not significant:
            notes.append(
                f"{name}: {100 * share:.0f} % of the squared error is the start, which {run.warmup:g} s of "
                "readings do not determine; give a longer warm-up"
            )
    return notes


def _outside(plant: Plant, signals: Mapping[str, Array]) -> dict[str, float]:
    """Return by signal the share of rows outside of the range that the fit has seen, from 1 % on."""
    out = {}
    for name, values in signals.items():
        low, high = plant.valid[name]
        room = 0.05 * (high - low)
        out[name] = float(np.mean((values < low - room) | (values > high + room)))
    return {name: share for name, share in out.items() if share > 0.01}
