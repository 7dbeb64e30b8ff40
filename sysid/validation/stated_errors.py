"""The error that a plant states of another run, bands about a run, and what is said by them.

**The error of another run** is one number for each output, the rms error of a free run over another run like
those of the fit (:func:`expected_error`); bands and `validate` are made of it.  The stated error has the
median of two parts, its ends the 5 and 95 % quantiles of their sum.

*Parts held out.*  Each of n parts (blocks of a log and its last part, or whole logs) has an error e_f.  The
error of one part more lies about them as they do about each other.

*What differs between runs* (supply voltage, air about the plant, a sensor that was glued anew) is in the
errors of whole logs that were held out. A plant of one or two logs cannot show it: the gain of its inputs
varies from run to run by g ~ N(0, :data:`~thermogrip.sysid.plant.plant_data.RUN_GAIN_SD`^2).

**Bands.** With v the free run, a reading is expected within

    v +- z sqrt(var_k v_k + s^2 + (median g)^2 (effect^2 + mean effect^2)/2 + unlike^2),   z = 1.645 for 90 %,

with v_k the free runs of draws of the parameters, each with a start of its own, and s^2 what these do not
explain of the error of parts held out.

**Good** (`identify`).  Over all parts held out, and over the logs of the fit, each output errs by less than
half of the error without input, and so does it on another run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

import numpy as np
from scipy.signal import lfilter
from scipy.special import ndtri, stdtrit

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, column, columns, log_name
from thermogrip.sysid.plant.log_grid import cut_stretches, match_logs
from thermogrip.sysid.plant.plant import WARMUP, Plant
from thermogrip.sysid.plant.plant_data import RUN_GAIN_SD, SEVERAL, TAIL, ExpectedError, HeldOut
from thermogrip.sysid.plant.simulation import find_starts

if TYPE_CHECKING:
    from thermogrip.sysid.data.data_quality import DataCheck
    from thermogrip.sysid.export.dynamics import Dynamics

PRIOR_SPREAD = 0.5  # sd of ln e of the parts of a log: the median over 22 series of 14 public logs is 0.51
PRIOR_PARTS = 4  # which that counts as: as many as one log has blocks
MEDIAN = NormalDist().inv_cdf(0.75)  # of the size of a normal number, in standard deviations
INTERVAL = NormalDist().inv_cdf(0.95)  # half of a 90 % interval, in standard deviations
_RANKS = 199  # quantiles of each part, of which their sum is made
_DIVERGED = 1e6  # of an output's spread
_LATER = (1 / 30, 1 / 10, 1 / 3)  # of a run: lags of an effect that comes later; half a decade apart
_BEYOND = 0.2  # of what lies beyond the readings of the fit: gains of boards are off by .11 to .27 there
_UNLIKE = 0.1  # of the run's error: what a run unlike the fit adds, from which it is reported


@dataclass(frozen=True, eq=False)
class Band:
    """A band about a free run."""

    level: ClassVar[float] = 0.9  # probability that it should cover a reading
    half: dict[str, Array]  # (n,), half-width at each row of the log, in the output's unit
    inside: dict[str, float]  # share of the scored readings that it covers
    draws: int  # of the parameters; 0: the plant has none, the band is the plant's own error alone
    own_error: str = "the error of the fit"  # how the plant's own error was estimated, in words
    expected: dict[str, float] = field(default_factory=dict)  # rms error of the run that it describes
    likely: dict[str, tuple[float, float]] = field(default_factory=dict)  # which 9 of 10 runs lie within


def expected_error(errors: Sequence[float], gain_effect: float) -> ExpectedError:
    """Return the error of another run, of rms errors over parts held out (at least one) and the rms that a
    gain off by one standard deviation changes; see the module's theory.

    >>> found = expected_error([0.1, 0.1, 0.1, 0.1, 0.1], 0.0)
    >>> round(found.rmse, 3), round(found.low, 3), round(found.high, 3)
    (0.1, 0.048, 0.208)
    """
    # one part unlike all others (a tank that overflows once) would make an rms three times too wide
    # ln e^2 of one part more is Student's t about their mean, with the scale s sqrt(1 + 1/n)
    logs, n = 2 * np.log(np.maximum(errors, 1e-12)), len(errors)
    middle, freedom = float(logs.mean()), PRIOR_PARTS + n - 1
    # a few numbers barely show a spread: s^2 is taken with a prior
    squares = PRIOR_PARTS * (2 * PRIOR_SPREAD) ** 2 + float(np.sum((logs - middle) ** 2))
    scale = float(np.sqrt(squares / freedom * (1 + 1 / n)))
    ranks = (np.arange(_RANKS) + 0.5) / _RANKS
    part_squares = np.exp(middle + scale * stdtrit(freedom, ranks))
    # what a gain that is off adds, (v(u) - v(u - g (u - u_0)))^2
    gains = (gain_effect * ndtri(0.5 + ranks / 2)) ** 2
    low, high = np.sqrt(np.quantile(part_squares[:, None] + gains, (0.05, 0.95))).tolist()
    # the median is the geometric mean of the e_f
    of_parts = float(np.exp(middle / 2))
    rmse = float(np.hypot(of_parts, MEDIAN * gain_effect))
    return ExpectedError(rmse, low, high, of_parts if gain_effect else None)


def drawn_runs(plant: Plant, log: Log, warmup: float = WARMUP, *, draws: int = 30) -> Iterator[Array]:
    """Yield the free runs (n, n_y) over a log of so many draws of the parameters (seeds from 1 on), whose
    starts readings of ``warmup`` [s] set; none of a plant without uncertainty."""
    if plant.uncertain:
        stretches = cut_stretches(plant, match_logs(plant, [log])[0][0])
        yield from (plant.draw(k).over(stretches, warmup)[0] for k in range(1, draws + 1))


def free_run_band(
    plant: Plant, log: Log, simulated: Log, drawn: Iterable[Array], *, warmup: float = WARMUP
) -> Band:
    """Return the band about the ``simulated`` free run of a plant over a log, whose state readings of
    ``warmup`` [s] have set, of the runs of its draws."""
    run, taken = columns(simulated, plant.outputs), 0
    variances = np.zeros(run.shape)
    for other in drawn:
        variances += (other - run) ** 2
        taken += 1
    variances /= max(1, taken)
    scored = np.asarray(simulated["scored"].values) > 0
    half = {}
    inside = {}
    expected = {}
    likely = {}
    by_gain = 0.0  # share of the squared error, of the output where it is most
    other_run, unlike = between_runs(plant, [log]), unlike_fit(plant, log, simulated, warmup)
    is_unlike, compared = False, bool(plant.scores.held_out or plant.scores.held_out_by_part)
    for column_index, name in enumerate(plant.outputs):
        errors, variance = part_errors(plant, name), variances[:, column_index]
        error_of_parts = expected_error(errors, 0.0).rmse
        effect = (MEDIAN * other_run.get(name, np.zeros(1))) ** 2
        explained = variance.mean() if compared else 0.0  # errors of a fit have no part of its draws
        # half of it constant, for a level that is off on another day where the inputs are 0 as well (without
        # it the bands of two such heaters held 69 and 52 percent)
        gain_and_level = (effect + effect.mean()) / 2
        like_fit = variance + max(error_of_parts**2 - explained, 0.0) + gain_and_level
        added = unlike.get(name, 0.0) ** 2
        half[name] = INTERVAL * np.sqrt(like_fit + added)
        is_unlike = is_unlike or bool(np.mean(added) > _UNLIKE * np.mean(like_fit))
        size = np.mean((like_fit + added)[scored]) if scored.any() else np.nan
        expected[name] = float(np.sqrt(size))
        if scored.any() and size > 0:
            rest = np.mean((like_fit + added - gain_and_level)[scored])
            by_gain = max(by_gain, 1 - float(rest / size))
        other = np.hypot(other_run.get(name, np.zeros(1)), unlike.get(name, np.zeros(1)) / MEDIAN)
        ends = expected_error(errors, float(np.sqrt(np.mean(other**2))))
        beyond = np.sqrt(max(size - ends.rmse**2, 0.0))  # what draws say beyond it
        likely[name] = float(np.hypot(ends.low, beyond)), float(np.hypot(ends.high, beyond))
        miss = np.abs(column(log, name) - column(simulated, name))
        is_read = scored & np.isfinite(miss)
        inside[name] = float(np.mean(miss[is_read] <= half[name][is_read])) if is_read.any() else float("nan")
    words = "the errors of free runs over parts held out of it" if compared else "the error of the fit"
    if other_run:
        words += f" and a gain that varies by {100 * RUN_GAIN_SD:.0f} % from run to run (assumed, "
        words += f"{100 * by_gain:.0f} % of the squared error: "
        words += f"{'one log' if len(plant.logs) == 1 else 'two logs'} cannot show it)"
    if is_unlike:
        words += ", wider because this run is unlike the fit (range of the readings)"
    return Band(half, inside, taken, words, expected, likely)


def part_errors(plant: Plant, name: str) -> list[float]:
    """Return the errors of an output over the parts that were held out: of a plant of several logs whole
    logs, where it has them; of a fit that was not compared that of the fit, as an error of readings."""
    scores = plant.scores
    held_out = [score for score in scores.held_out if score.output == name]
    whole = [score for score in held_out if not score.log.startswith(TAIL)]
    if len(plant.logs) >= SEVERAL and whole:
        held_out = whole
    errors = [score.rmse for score in held_out] or scores.held_out_by_part.get(name, [])
    # a fit to means adds the white noise of one reading
    return errors or [float(np.hypot(plant.noise.get(name, 0.0), scores.reading_excess.get(name, 0.0)))]


def unlike_fit(plant: Plant, log: Log, simulated: Log, warmup: float) -> dict[str, Array]:
    """Return by output the standard deviation that a black box gets at each row for what is unlike its fit;
    empty for other plants."""
    if not plant.scores.held_out_by_part:
        return {}
    time = log["time"].values
    begin, out = time - time[0] < max(warmup, plant.dt), {}
    for name in plant.outputs:
        run, (low, high) = column(simulated, name), plant.valid.get(name, (-np.inf, np.inf))
        first = column(log, name)[begin]
        first = first[np.isfinite(first)]
        start = float(np.mean(first - np.clip(first, low, high))) if first.size else 0.0
        # the part of the run beyond the readings of the fit, and how far those of the warm-up lie beyond
        out[name] = _BEYOND * np.hypot(run - np.clip(run, low, high), start)
    return out


def between_runs(plant: Plant, logs: Sequence[Log], most: float = 1.0) -> dict[str, Array]:
    """Return by output what a gain that is off as from run to run changes at each row of the logs, one after
    the other; empty for a plant of no log, or of so many that their held-out errors show it."""
    return effect_of_inputs(plant, logs, most) if 0 < len(plant.logs) < SEVERAL else {}


def with_gain_spreads(plant: Plant, dynamics: Dynamics | None) -> Plant:
    """Return the plant with the spread that its draws show of gains that no part held out tests."""
    spreads = dict(plant.scores.untested)
    for row in dynamics.rows() if dynamics is not None else ():
        if row["input"] in spreads and row["gain"] and row["high"] is not None:
            by_draws = (row["high"] - row["low"]) / (2 * INTERVAL) / abs(row["gain"])
            # at 1 the input may as well do nothing
            spreads[row["input"]] = min(by_draws, spreads[row["input"]])
    return replace(plant, scores=replace(plant.scores, untested=spreads))


def effect_of_inputs(plant: Plant, logs: Sequence[Log], most: float) -> dict[str, Array]:
    """Return by output what inputs that do less by :data:`RUN_GAIN_SD`, those that no part held out tests by
    the spread of their gain, ``most`` at most, change at each row of the logs."""
    moving = set(plant.inputs) - set(plant.model.switches)
    nearest = {name: np.clip(0.0, *plant.valid.get(name, (0.0, 0.0))) for name in moving}
    changes = []
    for log in logs:
        change = columns(plant.simulate(log), plant.outputs)
        log = log.copy()
        for name in moving:
            u = column(log, name)
            # g (u - u_0), u_0 the value nearest to 0 in the logs of the fit: what an input that never was 0
            # does from 0 on is part of the operating point
            gain_sd = min(plant.scores.untested.get(name, RUN_GAIN_SD), most)
            log[name] = log[name].copy(data=u - gain_sd * (u - nearest[name]))
        changes.append(change - columns(plant.simulate(log), plant.outputs))
    return dict(zip(plant.outputs, np.concatenate(changes).T))


@dataclass(frozen=True, eq=False)
class InputEffect:
    """What inputs did more in a run than in the fit."""

    gain: float  # by how large a share
    lag_s: float  # how long after the effect that the plant knows; 0: at once
    remaining: dict[str, float]  # rms error by output that it leaves

    def words(self) -> str:
        """Return it in words."""
        more = f"{100 * abs(self.gain):.0f} % {'more' if self.gain > 0 else 'less'}"
        if self.lag_s == 0:
            return f"one gain: inputs do {more} than in the fit (another supply, or another cooling?)"
        later = f"about {self.lag_s:.2g} s later"
        return f"slow: inputs do {more} than in the fit {later}, so slow terms are missing"


def effect_of_run(plant: Plant, error: Array, log: Log) -> InputEffect | None:
    """Return what inputs did more in a run than in the fit, at once or later, by least squares on the errors
    (n, n_y) of the free run, NaN where it is not scored, in the spread of each output; None where
    that is too little."""
    effects = effect_of_inputs(plant, [log], RUN_GAIN_SD)
    at_once = np.array([effects[name] for name in plant.outputs]).T / RUN_GAIN_SD
    spread = np.array([np.nanstd(column(log, name)) for name in plant.outputs])
    spread = np.where(spread > 0, spread, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):  # a run that diverged has no gain
        is_finite = np.isfinite(error) & (np.maximum(np.abs(at_once), np.abs(error)) < _DIVERGED * spread)
    if not is_finite.any():
        return None
    scaled_error = np.where(is_finite, error / spread, 0.0)
    step, seconds = float(log["time"].diff("time").median()), float(log["time"][-1] - log["time"][0])
    best: tuple[float, float, float, Array] | None = None
    by_surroundings = np.inf
    # a gain alone would be taken for what a mass that soaks for longer than the fit does
    for lag_s in (0.0, *(seconds * share for share in _LATER)):
        keep = np.exp(-step / lag_s) if lag_s else 0.0
        effect = lfilter([1 - keep], [1, -keep], np.where(np.isfinite(at_once), at_once, 0.0), axis=0)
        size = np.where(is_finite, effect / spread, 0.0)
        gain = float(np.sum(size * scaled_error) / max(np.sum(size**2), 1e-300))
        squares = float(np.sum((scaled_error - gain * size) ** 2))
        # what surroundings that differ all along do, of each output
        rise = np.where(is_finite, lfilter([1 - keep], [1, -keep], np.ones(len(error)))[:, None], 0.0)
        rises = rise * np.sum(rise * scaled_error, axis=0) / np.maximum(np.sum(rise**2, axis=0), 1e-300)
        by_surroundings = min(by_surroundings, float(np.sum((scaled_error - rises) ** 2)))
        if best is None or squares < best[0]:
            best = squares, gain, lag_s, np.where(is_finite, error - gain * effect, np.nan)
    assert best is not None
    squares, gain, lag_s, remaining = best
    # within two standard deviations of what differs from run to run, or half of the squared error remains, or
    # other surroundings leave less: they are what differs most from day to day
    least = min(0.5 * float(np.sum(scaled_error**2)), by_surroundings)
    if abs(gain) <= 2 * RUN_GAIN_SD or squares > least:
        return None
    rms = np.sqrt(np.nanmean(remaining**2, axis=0))
    return InputEffect(gain, lag_s, dict(zip(plant.outputs, rms.tolist())))


MOST_DISAGREEMENT = 0.4  # of the output's spread in the data of the fit


def ensemble_disagreement(plant: Plant, log: Log, *, warmup: float = 5.0) -> dict[str, float]:
    """Return by output the rms of the members' sd over the output's spread; empty where not neural."""
    model: Any = plant.model
    if model.kind != "neural" or len(model.A) < 2:
        return {}
    # members agree where the data constrain them, and their mean errs by about as much as they differ; that
    # depends on the drives alone, so that a run is refused before its readings are used
    stretches, n_y = cut_stretches(plant, log), len(model.outputs)
    variance, count = np.zeros(n_y), 0
    for stretch, start in zip(stretches, find_starts(plant, plant.p, stretches, warmup)):
        d = stretch.d - start.d_offset
        for (x,) in model.state_blocks(start.x0[None], stretch.u[None], d[None], plant.dt):
            members = x.reshape(len(x), *model.A.shape[:2])[:, :, :n_y]
            variance += members.var(axis=1).sum(axis=0)
            count += len(x)
    return dict(zip(model.outputs, np.sqrt(variance / count).tolist()))


def check_ensemble(plant: Plant, log: Log, *, warmup: float = 5.0) -> None:
    """Refuse with a UserError a neural plant whose members disagree over the log; other plants pass."""
    for name, share in ensemble_disagreement(plant, log, warmup=warmup).items():
        if share > MOST_DISAGREEMENT:
            raise UserError(
                f"its members disagree over {log_name(log)}: {name} by {100 * share:.0f} % of its sd in the "
                "fit, so their mean is not reliable",
                hint="fit logs that cover these drives and temperatures, or use another model",
            )


NO_BETTER = 0.8  # of the no-input error: a free run above it has not shown that the input matters
MOST = 0.5  # of the squared error

Standing: TypeAlias = Literal["as stated", "better", "worse", "another plant", "no test"]
Cause: TypeAlias = Literal["", "gain", "slow", "offset", "start", "dynamics", "seen", "too little input"]

_MEANING: dict[Standing, str] = {
    "as stated": "the error is as stated",
    "better": "the error is smaller than stated",
    "worse": "the error is larger than stated",
    "another plant": "this is another plant, predicted no better than without input",
    "no test": "no test of the plant",
}
_BECAUSE: dict[Cause, str] = {
    "": "",
    "slow": "slow terms are missing, for inputs do more or less later",
    "offset": "most of it is a constant offset",
    "start": "most of it is the start, for the readings of the warm-up do not set the slow states",
    "dynamics": "the plant is not what it was in the fit, or was never run like this",
    "seen": "the rows are in the fit; another log is a test",
    "too little input": "the inputs do too little here",
}
USEFUL = 0.5  # of the no-input error: below it a model is called good
FAR_FROM_PRIOR = 3.3  # sd: beyond it lies one parameter of a right network in a thousand


@dataclass(frozen=True)
class Row(HeldOut):
    """One line of the table: one model, one log, one output."""

    model: str  # kind of the candidate
    structure: str  # its orders, delays or network
    no_input_rmse: float  # the same of the no-input baseline
    held_out: bool  # whether the model was fitted without these rows


@dataclass(frozen=True)
class Verdict:
    """How far a free run bears its plant out."""

    standing: Standing
    over_stated: dict[str, float]  # error over the stated one, by output
    cause: Cause = ""  # by what it is worse, or why it is no test
    gain: float | None = None  # by how large a share inputs did more than in the fit, where that is the cause

    def __str__(self) -> str:
        times = ", ".join(f"{name} {ratio:.2g}" for name, ratio in self.over_stated.items())
        because = _BECAUSE.get(self.cause, "")
        if self.gain is not None:
            because = f"inputs do {100 * abs(self.gain):.0f} % {'more' if self.gain > 0 else 'less'}"
        words = _MEANING[self.standing] + (f": {because}" if because else "")
        return f"{words} (times the stated error: {times})"


def judge(
    band: Band,
    errors: Mapping[str, float],
    no_input: Mapping[str, float],
    *,
    causes: Mapping[str, Mapping[Cause, float]],
    by_inputs: InputEffect | None,
    seen: bool,
) -> Verdict:
    """Return the verdict on a run, by output: its rms errors, those of the no-input baseline, and of the
    start and of an offset the share of its squared error. ``seen``: its rows were in the fit."""
    stated = {name: size for name, size in band.expected.items() if size > 0}
    over = {name: error / stated[name] if name in stated else float("nan") for name, error in errors.items()}
    # X > 0.8 b: no right plant could have done better than without input
    hopeless = {name for name, size in stated.items() if size > NO_BETTER * no_input[name]}
    most = {name: no_input[name] * (1 / NO_BETTER if name in hopeless else NO_BETTER) for name in stated}
    # e > 0.8 b, and where that is hopeless clearly worse than b, e > b / 0.8
    lost = {name for name in stated if not errors[name] <= most[name]}
    # e above the high end, or above X and no better than without input, or most of it what inputs do
    worse = [
        name
        for name in stated
        if not errors[name] <= band.likely[name][1]
        or (over[name] > 1 and (name in lost or by_inputs is not None))
    ]
    if worse:
        worst = max(worse, key=lambda name: over[name])
        # the run diverged
        if not np.isfinite(errors[worst]):
            return Verdict("another plant", over, "dynamics")
        if by_inputs is not None and by_inputs.lag_s == 0:
            return Verdict("worse", over, "gain", by_inputs.gain)
        if by_inputs is not None:
            return Verdict("worse", over, "slow")
        # an offset or its start where one of them is most of the squared error, else its dynamics
        shares = causes.get(worst, {})
        cause = max(shares, key=lambda each: shares[each], default=None)
        if cause is not None and shares[cause] > MOST:
            return Verdict("worse", over, cause)
        # without one cause, and no better than without input
        return Verdict("another plant" if worst in lost else "worse", over, "dynamics")
    if seen:
        return Verdict("no test", over, "seen")
    if stated and len(hopeless) == len(stated):
        return Verdict("no test", over, "too little input")
    # e below the low end, every output
    better = bool(stated) and all(errors[name] < band.likely[name][0] for name in stated)
    return Verdict("better" if better else "as stated", over)


def verdict_of(
    model: str, plant: Plant, rows: Sequence[Row], checked: DataCheck, doubts: Sequence[str] = ()
) -> tuple[bool, str]:
    """Return whether the kept candidate may be called good, and in sentences why, and how much another run
    should err; a doubt forbids it."""
    expected, named = plant.scores.expected, network_name(plant)
    label = f"network {named}" if named else model
    errors = ", ".join(f"{name} {each.words(plant.units.get(name, '1'))}" for name, each in expected.items())
    another = f"Expected error of another run like these: {errors}."
    untested = ", ".join(name for name, gain_sd in plant.scores.untested.items() if gain_sd)
    without = {name: each.same_gain for name, each in expected.items() if each.same_gain is not None}
    if without:
        sizes = ", ".join(
            f"{n} {e:.2g} {plant.units.get(n, '1')}".removesuffix(" 1") for n, e in without.items()
        )
        another += f" It would be {sizes}, were gains the same from run to run: "
        assumed = f"that they vary by {100 * RUN_GAIN_SD:.0f} % is assumed; {SEVERAL} logs would show it."
        another += f"that of {untested} may be another." if untested else assumed
    if untested:
        why = f"{untested} moves in no part held out whose rest moves it, so what it does is tested nowhere"
        return False, f"Not good ({label}): {why}; another move of it in the log would test it. {another}"
    own_rows = [row for row in rows if row.model == model]
    for name, error in expected.items():
        part_error, parts_idle = _pooled([row for row in own_rows if row.output == name and row.held_out])
        whole, whole_idle = _pooled([row for row in own_rows if row.output == name and not row.held_out])
        tail, tail_idle = _pooled(
            [row for row in own_rows if row.output == name and row.held_out and row.log.startswith(TAIL)]
        )
        # it alone is forecast from what was before it, and judged as another run is
        if error.rmse < NO_BETTER * tail_idle <= tail:
            errs = f"on the last part held out {name} errs by {tail / tail_idle:.0%} of no input's error"
            return False, f"Not good ({label}): {errs}; try other models, or longer logs. {another}"
        # a single part that was much worse, of moves that no other part has, widens the stated range and
        # condemns no plant: the fit has seen that part in the end
        for size, idle, where, advice in (
            (part_error, parts_idle, "on parts held out", "it needs more excitation, or another model"),
            (whole, whole_idle, "on the logs of its own fit", "try other models, or longer logs"),
            (error.rmse, whole_idle, "on another run", "it needs more excitation, or more logs"),
        ):
            if not size < USEFUL * idle:
                errs = f"{where} {name} errs by {size / max(idle, 1e-12):.0%} of no input's error"
                return False, f"Not good ({label}): {errs}; {advice}. {another}"
    failed = [finding.says for finding in checked.findings if finding.verdict == "fail"]
    if failed:
        return False, f"Not good ({label}): {failed[0]}. {another}"
    if doubts:
        more = f" (and {len(doubts) - 1} more)" if len(doubts) > 1 else ""
        return False, f"Not good ({label}) as long as this is in doubt: {doubts[0]}{more}. {another}"
    return True, f"Good for simulation and control on runs like these ({label}). {another}"


def _pooled(rows: Sequence[Row]) -> tuple[float, float]:
    """Return the rms errors of a candidate and of no input over all of some rows."""
    both = [(row.rmse, row.no_input_rmse) for row in rows] or [(0.0, np.inf)]
    error, idle = np.sqrt(np.mean(np.square(both), axis=0)).tolist()
    return error, idle


def doubts_of(plant: Plant, dynamics: Dynamics | None) -> list[str]:
    """Return what of a plant itself is not certain, a line each."""
    return [*_far_from_prior(plant), *_effects_in_doubt(plant, dynamics)]


def _far_from_prior(plant: Plant) -> list[str]:
    specs, out = getattr(plant.model, "specs", {}), []
    for name in plant.free:
        spec, value = specs[name], plant.values[name]
        off = (
            np.log(value / spec.value) / spec.sd_log
            if spec.sd_log
            else (value - spec.value) / (spec.sd or np.inf)
        )
        if abs(off) > FAR_FROM_PRIOR:
            unit = plant.units.get(name, "1")
            out.append(
                f"{name} of the network {network_name(plant)} is fitted as "
                f"{value:.3g}{'' if unit == '1' else f' {unit}'}, "
                f"{abs(off):.1f} standard deviations of its prior from {spec.value:.3g}: is it that plant?"
            )
    return out


def _effects_in_doubt(plant: Plant, dynamics: Dynamics | None) -> list[str]:
    if dynamics is None:
        return []
    out = [
        f"whether {name} raises or lowers {' or '.join(plant.outputs)}: move it more"
        for name, certain in zip(dynamics.linear.inputs, dynamics.is_certain.tolist())
        if name in plant.inputs and not certain
    ]
    return out + [
        f"{row['input']} lowers {row['output']} (gain {row['gain']:.2g}): "
        "recorded in closed loop, or not what heats it?"
        for row in dynamics.rows()
        if row["input"] in plant.inputs and "heat" in row["input"].lower()
        if plant.units.get(row["output"]) == "degC" and (row["gain"] or 0.0) < 0
    ]


def network_name(plant: Plant) -> str:
    """Return the name of a plant's network; "" for a black box."""
    return str(getattr(plant.model, "name", ""))
