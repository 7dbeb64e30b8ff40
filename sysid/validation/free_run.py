"""Free run of a plant over a log, beside baselines and tests of its residual.

The plant sees the inputs and disturbances of the whole log, and measured outputs of the warm-up only. For
each output, over the n scored samples,

    RMSE = sqrt(mean (y - v)^2),        fit = 100 (1 - |y - v| / |y - mean y|)  percent.

Beside the free run stand

* **one step**: the last reading plus the model's move. Small for every slow plant; it ranks models wrongly.
* **mean**: the constant that fits the scored samples best (fit 0 percent by definition).
* **no input**: y = m + (y_first - m) exp(-t/tau), with m the mean of the scored samples and tau chosen in
  hindsight. A model that does not beat it has learnt nothing from the input.

The residual is tested twice (:mod:`thermogrip.sysid.validation.residual_tests`): is it white, and does it
correlate with an input beyond the effect of an unknown start, uncertain parameters and slow noise? Only the
latter leads to the note that a term may be missing, for at most one right model in a hundred. Whether that
matters is another question: the verdict goes by how large the error is beside the stated one
(:mod:`thermogrip.sysid.validation.verdict`).

After a gap of more than 10 s the input is unknown: the run starts afresh from its own warm-up, the next 60
s are not scored, and the figure with the last row held through the gap is given with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.resample import block_means, gaps
from thermogrip.datasets.schema import Log, column, columns
from thermogrip.sysid.plant.fit_record import fit_logs, said_of_fit
from thermogrip.sysid.plant.log_grid import Rows, cut_stretches, match_logs, rows_of
from thermogrip.sysid.validation.residual_tests import (
    SQUARED,
    Correlation,
    CorrelationTest,
    ResidualCorrelations,
    autocorrelation,
    cross_correlation,
    residual_correlations,
)
from thermogrip.sysid.validation.verdict import NO_BETTER, Cause, Verdict, judge

if TYPE_CHECKING:
    from pathlib import Path

    from pandas import DataFrame

    from thermogrip.sysid.plant.plant import Plant
    from thermogrip.sysid.validation.prediction_bands import Band

EXCEEDS = 2.0  # times the error of the fit, from which that is reported
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
    whiteness: dict[str, Correlation]  # autocorrelation of the residual
    # of the residual with the inputs before it, of those that move in this log; what a figure shows
    input_correlation: dict[str, dict[str, Correlation]]
    # tests of the residual for correlation with signals; empty without ``tests``
    residual: ResidualCorrelations
    # how many times as far off as its fit an output is, where that is more than twice
    exceeds_fit: dict[str, float]
    no_better: tuple[str, ...]  # outputs whose free run does not clearly beat the no-input baseline
    notes: tuple[str, ...]  # what limits these numbers
    warmup: float  # seconds whose readings set the state
    plant: Plant  # what was run
    measured: Log  # over what, in the plant's units
    verdict: Verdict | None = None  # on the plant; None without ``tests``
    stated: Band | None = None  # the 90 % band, where it is known already

    def band(self, level: float = 0.9) -> Band:
        """Return the band about the run that a new run's readings should lie in, and how many of these do;
        see :func:`thermogrip.sysid.validation.prediction_bands.free_run_band`."""
        if self.stated is not None and level == self.stated.level:
            return self.stated
        from thermogrip.sysid.validation.prediction_bands import free_run_band  # scipy.special

        return free_run_band(self.plant, self.measured, self.log, level=level, warmup=self.warmup)


def free_run(
    plant: Plant,
    log: Log | DataFrame | str | Path,
    warmup: float = 5.0,
    score_from: float = 5.0,
    average: float | None = None,
    *,
    tests: bool = True,
    known: FreeRun | None = None,
) -> FreeRun:
    """Simulate the log and score it.

    Parameters
    ----------
    plant : Plant
    log : Log, DataFrame, str or Path
    warmup : float, optional
        Seconds at the start whose measured outputs may set the state.
    score_from : float, optional
        Samples before this many seconds are not scored.
    average : float, optional
        Score block means over this many seconds instead of samples.
    tests : bool, optional
        Test whether the residual correlates with an input, which takes some dozens of free runs.
    known : FreeRun, optional
        The same run without tests, which then is not simulated again.

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
    if score_from < warmup:
        raise UserError(
            f"scoring from {score_from:g} s would score readings of the {warmup:g} s warm-up",
            hint=f"score from {warmup:g} s on",
        )
    simulated = plant.simulate(log, warmup=warmup, score_from=score_from) if known is None else known.log
    rows = rows_of(log, plant.inputs, plant.outputs, plant.disturbances)
    run, scored = columns(simulated, plant.outputs), column(simulated, "scored") > 0
    units = {name: str(log[name].attrs.get("units", "1")) for name in plant.outputs}
    pairs = _beside(plant, rows, run, scored, average)
    both = pairs.outputs
    scores, found = _scores(both, units), gaps(log)
    held: dict[str, Score] = {}
    if found and known is not None:
        held = known.held
    elif found:
        through = plant.simulate(log, warmup=warmup, score_from=score_from, gaps="hold")
        whole, kept = columns(through, plant.outputs), column(through, "scored") > 0
        held = _scores(_beside(plant, rows, whole, kept, average).outputs, units)
    mean = {n: score(y, np.full(y.shape, np.nanmean(y)), units[n]) for n, (y, _) in both.items()}
    no_input = {n: score(y, no_input_baseline(pairs.time, y), units[n]) for n, (y, _) in both.items()}
    with np.errstate(invalid="ignore"):  # a run that went to infinity makes no step there
        one = {n: _one_step(y, v, units[n]) for n, (y, v) in both.items()}
    no_better = tuple(
        name for name in plant.outputs if not scores[name].rmse < NO_BETTER * no_input[name].rmse
    )
    whiteness = {name: autocorrelation(y - v) for name, (y, v) in both.items()}
    moved = {u: values for u, values in pairs.inputs.items() if np.ptp(values) > 0}
    left = {n: {u: cross_correlation(y - v, w) for u, w in moved.items()} for n, (y, v) in both.items()}
    residual = ResidualCorrelations({}, {})
    if tests:
        residual = residual_correlations(plant, cut_stretches(plant, log), run, scored, warmup=warmup)
    # means over the fit's own blocks: an error as slow as the log correlates with no input, but shows here
    blocks = _blocks_of_fit(plant, rows.time)
    beyond = _beyond_fit(plant, residual, _beside(plant, rows, run, scored, blocks).outputs if blocks else {})
    verdict, band, gain = None, None, list[str]()
    if tests:
        from thermogrip.sysid.validation.prediction_bands import free_run_band  # scipy.special

        miss = rows.y - np.where(scored[:, None], run, np.nan)
        off, gain = _gain(plant, log, miss, units)
        band = free_run_band(plant, log, simulated, warmup=warmup)
        readings = _beside(plant, rows, run, scored, None)
        tested = replace(fit_logs([log])[0], start_s=float(rows.time[np.argmax(scored)]))
        verdict = judge(
            band,
            {name: score(*pair).rmse for name, pair in readings.outputs.items()},
            {n: score(y, no_input_baseline(readings.time, y)).rmse for n, (y, _) in readings.outputs.items()},
            causes=_causes(miss, plant.outputs, residual.start),
            gain=off,
            seen=bool(said_of_fit(plant.fitted_to, tested)),
        )
    outside = _outside(plant, {name: column(log, name) for name in plant.valid if name in log})
    unseen = [name for name in outside if name not in plant.outputs]
    notes = (
        *said_of_fit(plant.fitted_to, *fit_logs([log])),
        *converted,
        *_notes(float(rows.time[0]), found, held, () if _no_test(verdict) else no_better),
        *_residual_notes(whiteness, residual, units, warmup, unseen, verdict),
        *_excess_notes(plant, beyond, units, verdict),
        *gain,
        *_outside_notes(plant, outside),
        *([] if verdict is None else [str(verdict)]),
    )
    exceeds_fit = {name: here / there for name, (here, there) in beyond.items()}
    naive = {"mean": mean, "no_input": no_input}
    return FreeRun(
        simulated, scores, one, naive, held, whiteness, left, residual, exceeds_fit, no_better, notes, warmup,
        plant, log, verdict, band,
    )  # fmt: skip


def _causes(miss: Array, outputs: Sequence[str], start: Mapping[str, float]) -> dict[str, dict[Cause, float]]:
    """Return by output which share of the squared error is the start, and which a constant offset."""
    with np.errstate(over="ignore", invalid="ignore"):
        offsets = np.nanmean(miss, axis=0) ** 2 / np.maximum(np.nanmean(miss**2, axis=0), 1e-300)
    return {n: {"start": start.get(n, 0.0), "offset": float(share)} for n, share in zip(outputs, offsets)}


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


class _Pairs(NamedTuple):
    """Readings beside the run at the same times (n,), NaN where not scored, and the inputs there."""

    time: Array
    outputs: dict[str, tuple[Array, Array]]  # measured, simulated
    inputs: dict[str, Array]


def _beside(plant: Plant, rows: Rows, run: Array, scored: Mask, average: float | None) -> _Pairs:
    """Return what was measured beside the free run (n, n_y), in means over ``average`` [s] if given."""
    time, n_y = rows.time, len(plant.outputs)
    values = np.hstack([np.where(scored[:, None], np.hstack([rows.y, run]), np.nan), rows.u])
    if average is not None:
        held = np.arange(values.shape[1]) >= 2 * n_y
        parts = block_means(time, values, held, seconds=average, after=rows.after, log=rows.log)
        time, values = (np.concatenate(part) for part in zip(*parts))
    if not scored.any():
        problem = f"nothing of its {np.ptp(time):g} s is left to score"
        raise UserError(problem, file=rows.log, hint="give a longer log, or score from an earlier time")
    measured, simulated, drives = values.T[:n_y], values.T[n_y : 2 * n_y], values.T[2 * n_y :]
    outputs = dict(zip(plant.outputs, zip(measured, simulated)))
    return _Pairs(time, outputs, dict(zip(plant.inputs, drives)))


def _one_step(y: Array, v: Array, unit: str) -> Score:
    """Return the score of the last reading that came plus the run's move."""
    known = np.isfinite(y)
    y, v = y[known], v[known]
    return score(y[1:], y[:-1] + np.diff(v), unit)


def _scores(both: Mapping[str, tuple[Array, Array]], units: Mapping[str, str]) -> dict[str, Score]:
    return {name: score(y, v, units[name]) for name, (y, v) in both.items()}


def _notes(
    first: float, found: list[tuple[int, float, float]], held: Mapping[str, Score], no_better: tuple[str, ...]
) -> list[str]:
    """Return notes on the run's start at ``first`` [s], its gaps and its baselines."""
    notes = []
    if first > 60:
        notes.append(
            f"the run starts at {first:g} s from its warm-up alone: what was warm and unseen is guessed; "
            f"give the whole log and score from {first:g} s to start where the log starts"
        )
    beside = ", ".join(f"{name} {s.rmse:.3g} {s.unit}" for name, s in held.items())
    for _, before, after in found:
        notes.append(
            f"no row from {before:g} to {after:g} s: the run starts afresh after it, the next 60 s are not "
            f"scored (last row held instead: RMSE {beside})"
        )
    for name in no_better:
        notes.append(
            f"{name}: hardly better than a model without input: the fit cannot be relied on for control"
        )
    return notes


def _residual_notes(
    whiteness: Mapping[str, Correlation],
    residual: ResidualCorrelations,
    units: Mapping[str, str],
    warmup: float,
    unseen: list[str],
    verdict: Verdict | None = None,
) -> list[str]:
    """Return notes on the residuals of each output."""
    notes, small = [], _small(verdict)
    for name, own in whiteness.items():
        if not own.independent:
            notes.append(f"{name}: residuals are not white; intervals from their variance are narrow")
        significant = {s: f for s, f in residual.tests.get(name, {}).items() if f.significant}
        notes += [
            _correlation_note(name, *item, units[name], unseen, small=small) for item in significant.items()
        ]
        share = residual.start.get(name, 0.0)
        if share > START and not significant:
            notes.append(
                f"{name}: {100 * share:.0f} % of the squared error is the start, which {warmup:g} s of "
                "readings do not determine; give a longer warm-up"
            )
    return notes


def _no_test(verdict: Verdict | None) -> bool:
    return verdict is not None and verdict.standing == "no test"


def _small(verdict: Verdict | None) -> bool:
    """Return whether a run is known to err by no more than was stated."""
    return verdict is not None and verdict.standing not in ("worse", "another plant")


def _correlation_note(
    name: str, signal: str, found: CorrelationTest, unit: str, unseen: list[str], *, small: bool = False
) -> str:
    """Return with what the residual of an output correlates, by how much, and what that may mean; ``small``:
    of an error that is no larger than was stated."""
    if signal.endswith(SQUARED):
        curved = "a loss that curves (radiation, free convection)" if unit == "degC" else "a term that curves"
        what, lacks = f"the square of {name}", curved
    else:
        what, lacks = signal, "a delay, lag or term"
    size = f"{found.size:.2g} {unit}".removesuffix(" 1")
    why = f"{lacks} is missing, or the plant is not what it was in the fit"
    if small:
        why = f"{lacks} is missing, within the error that was stated"
    if unseen:
        why = f"the fit has not seen {', '.join(unseen)} as here, so this need not be a term that is missing"
    return f"{name}: the residual correlates with {what} (rms {size}, p = {found.p:.1g}): {why}"


def _blocks_of_fit(plant: Plant, time: Array) -> float | None:
    """Return the length of the blocks of a grey-box fit [s]; None where these rows make no such means."""
    seconds = plant.scores.average_s
    if not plant.scores.in_sample_rmse or seconds is None:  # a black box's noise is no error of its fit
        return None
    return seconds if float(np.median(np.diff(time))) <= seconds <= np.ptp(time) / 10 else None


def _beyond_fit(
    plant: Plant, residual: ResidualCorrelations, blocks: Mapping[str, tuple[Array, Array]]
) -> dict[str, tuple[float, float]]:
    """Return the errors here and in the fit of outputs whose error exceeds that of the fit by much."""
    found = {}
    for name, (y, v) in blocks.items():
        here, there = score(y, v).rmse, plant.noise.get(name, 0.0)
        if here > EXCEEDS * there > 0 and residual.start.get(name, 0.0) <= START:
            found[name] = (here, there)
    return found


def _excess_notes(
    plant: Plant,
    beyond: Mapping[str, tuple[float, float]],
    units: Mapping[str, str],
    verdict: Verdict | None = None,
) -> list[str]:
    """Return by how much outputs exceed the error of the fit."""
    why = "or the plant is not quite what it was in the fit"
    why = "within the error that was stated" if _small(verdict) else why
    return [
        f"{name}: means over {plant.scores.average_s:g} s err by {here:.2g} {units[name]}, and "
        f"by {there:.2g} {units[name]} in the fit: slow terms are missing, {why}"
        for name, (here, there) in beyond.items()
    ]


def _gain(plant: Plant, log: Log, miss: Array, units: Mapping[str, str]) -> tuple[float | None, list[str]]:
    """Return a gain that is not that of the fit, where it is most of the error, and what it explains."""
    from thermogrip.sysid.validation.prediction_bands import gain_of_run  # scipy.special

    found = gain_of_run(plant, miss, log)
    if found is None:
        return None, []
    gain, left = found
    sizes = ", ".join(f"{name} {rms:.2g} {units[name]}" for name, rms in zip(plant.outputs, left))
    how = f"{100 * abs(gain):.0f} % {'more' if gain > 0 else 'less'}"
    return gain, [
        f"most of the error is one gain: inputs that do {how} than in the fit would leave {sizes}; another "
        "supply, or another cooling? Identify with this log as well"
    ]


def _outside_notes(plant: Plant, outside: Mapping[str, float]) -> list[str]:
    """Return which signals leave the range that the fit has seen."""
    out = []
    for name, share in outside.items():
        low, high = plant.valid[name]
        where = f"{low:g} to {high:g}, the range of the fit, in {100 * share:.0f} % of the rows"
        out.append(f"{name} lies outside of {where}")
    return out


def _outside(plant: Plant, signals: Mapping[str, Array]) -> dict[str, float]:
    """Return by signal the share of rows outside of the range that the fit has seen, from 1 % on."""
    out = {}
    for name, values in signals.items():
        low, high = plant.valid[name]
        room = 0.05 * (high - low)
        out[name] = float(np.mean((values < low - room) | (values > high + room)))
    return {name: share for name, share in out.items() if share > 0.01}
