"""How far a free run may be off: prediction bands, and the disagreement of an ensemble.

**Bands.** With v_k the free run of the k-th draw of the parameters and s the error of the fit (model error
and sensor together, ``Plant.noise``), a reading is expected within

    v +- z sqrt(var_k v_k + s^2 + r^2),        z = 1.645 for 90 %.

A fit compares means over bins of n readings, so s is an error of means. A reading of white noise w lies off
its mean by r besides, r^2 = w^2 (1 - 1/n); w follows from the second differences of the logs of the fit,
whose variance is 6 w^2 (:func:`thermogrip.sysid.data.data_quality.reading_excess`).

A draw has its own start: state and sensor offsets are estimated anew from the warm-up. A plant without
uncertainty of its parameters (a neural model) has the second part alone, and reports that.

A black box chose its structure by free runs over parts that were held out, whose rms error h contains both
the wrong structure and the uncertainty of its numbers. Its s is the part of it that the draws do not
explain,

    s^2 = max(h^2 - mean_k,t (v_k - v)^2, 0),

so that on average the band is as wide as its held-out errors, and wider where its draws disagree. (Its
``Plant.noise`` is smaller: that is the weight of a reading in a warm-up.) h is the larger one of the folds'
error and of that on the last parts of the logs; with n folds it is known as badly as a variance of n numbers,
so s is multiplied by t_n / z, Student's quantile over the normal one (1.3 for four folds and 90 %).

The error to expect of one part more is neither the larger one nor that of those seen: of n folds and the last
parts, which lie in them, with the mean square e^2 it is e sqrt(1 + 1 / n) (:func:`expected_error`), as the
variance of one value more about the mean of n; over 33 outputs of public sets its median ratio to the true
error is 1.00 (docs/records/identification.md).

**Where that is too narrow.** The average over parts does not apply to each: a tank that overflows in one
stretch and not in the next errs there three times as much. With e_f the error on part f and h_f that on all
the others, the expected coverage of part f by a band of the others is

    2 Phi(z h_f / e_f) - 1.

Where the least of these falls short the band reports it (:func:`expected_coverage`); no factor on h is
right for both kinds of stretches. Parts that are alike give no information on logs that are not: a plant
that drifts, or is driven where it never was, errs by more than any of its parts.

**Another run.** What differs between runs (supply voltage, air about the plant, a sensor that was glued
anew) is in the errors of whole logs that were held out, so in those of a plant of three logs or more. One or
two logs cannot show it, and parts of one log share it. Then the gain of the inputs is taken to vary from run
to run by g = :data:`~thermogrip.sysid.plant.fit_record.RUN_GAIN_SD`, and

    (v(u) - v(u - g (u - u_0)))^2,        u_0 the value nearest to 0 in the logs of the fit,

is added to the variance: an input that was 0 at times has its whole effect scaled, and one that never was
only the effect of its changes, for what it does from 0 on is part of the operating point. Models of two
heater boards, fitted on one day, have gains that are off by 4 to 8 percent on another, and few other errors;
of a third board and of a motor by 0 and 3 percent (rms of the four 4 percent); boards of one kind differ by 5
to 20 percent.

**A run unlike the fit.** A black box knows nothing of where it has not been. Three things are added to its
variance, all 0 on a run like those of the fit: the part of v that lies beyond the range of the readings of
the fit (it may be wrong altogether: losses curve, supplies saturate); by how much the readings of the warm-up
lie beyond it (another room, to which the model does not know the way); and a gain that is off by

    k min(|ln r|, 1),        r = rms effect of the inputs on this run over that in the fit,

for where losses grow with temperature the gain of a linear model is that of the excursions that it was
fitted to. Of four heater boards, from one kind of run to another (pulses, long steps), gains are off by .11
to .27 where |ln r| is .27 to .46 and by .02 to .14 where it is .5 to .6: k = :data:`GAIN_OF_SIZE`.

**Ensemble disagreement.** The members of a :class:`~thermogrip.sysid.models.neural.NeuralModel` were fitted
to the same rows from different random weights, so they agree where the data constrain them. On other drives
and temperatures one member settles in a state of its own and another does not. The standard deviation s of
the members about their mean over a run, beside the spread S of the output in the data of the fit, depends
on the drives alone, so a run may be refused before its readings are used:

    s <= :data:`MOST_DISAGREEMENT` S        or the run is refused.

The mean errs by about as much as its members differ, since they share what the data left open; a model
without input errs by about S, and one that errs by half of that is not called good
(:mod:`thermogrip.sysid.identification`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np
from scipy.special import ndtr, stdtrit

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, column, columns, log_name
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.plant.fit_record import RUN_GAIN_SD, SEVERAL, TAIL
from thermogrip.sysid.plant.log_grid import cut_stretches, match_logs
from thermogrip.sysid.plant.plant import WARMUP, Plant
from thermogrip.sysid.plant.simulation import find_starts

SHORT = 0.1  # of the level: a part on which the expected coverage falls short by more is reported
#: Standard deviation of a black box's gain on a run whose inputs have e times the effect they had in the fit.
GAIN_OF_SIZE = 0.4
_DIVERGED = 1e6  # of an output's spread
_SMALL = 0.05  # change of the inputs by which their effect is found
_UNLIKE = 0.1  # of the run's error: what a run unlike the fit adds, from which it is reported


@dataclass(frozen=True, eq=False)
class Band:
    """A band about a free run."""

    level: float  # probability that it should cover a reading
    half: dict[str, Array]  # (n,), half-width at each row of the log, in the output's unit
    inside: dict[str, float]  # share of the scored readings that it covers
    draws: int  # of the parameters; 0: the plant has none, the band is the plant's own error alone
    own_error: str = "the error of the fit"  # how the plant's own error was estimated, in words
    expected: dict[str, float] = field(default_factory=dict)  # rms error of the run that it stands for


def free_run_band(
    plant: Plant,
    log: Log,
    simulated: Log,
    *,
    level: float = 0.9,
    draws: int = 30,
    warmup: float = WARMUP,
) -> Band:
    """Return the band about the ``simulated`` free run of a plant over a log, of so many draws of its
    parameters (seeds 1 to ``draws``), whose state readings of ``warmup`` [s] have set."""
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level:g}")
    wide = NormalDist().inv_cdf(0.5 + level / 2)
    taken = draws if plant.uncertain else 0
    stretches = cut_stretches(plant, match_logs(plant, [log])[0][0]) if taken else []
    run, variances = (
        columns(simulated, plant.outputs),
        np.zeros((simulated.sizes["time"], len(plant.outputs))),
    )
    for k in range(1, taken + 1):
        variances += (plant.draw(k).over(stretches, warmup)[0] - run) ** 2 / taken
    scored = np.asarray(simulated["scored"].values) > 0
    half, inside, expected = {}, {}, {}
    other_run, unlike = between_runs(plant, [log]), unlike_fit(plant, log, simulated, warmup)
    far = False
    for at, name in enumerate(plant.outputs):
        nominal = column(simulated, name)
        variance = variances[:, at]
        own = _own_variance(plant, name, variance, level) + plant.scores.reading_excess.get(name, 0.0) ** 2
        seen = variance + own + other_run.get(name, 0.0) ** 2
        added = unlike.get(name, 0.0) ** 2
        half[name] = wide * np.sqrt(seen + added)
        expected[name] = float(np.sqrt(np.mean((seen + added)[scored]))) if scored.any() else float("nan")
        far = far or bool(np.mean(added) > _UNLIKE * np.mean(seen))
        miss = np.abs(column(log, name) - nominal)
        known = scored & np.isfinite(miss)
        inside[name] = float(np.mean(miss[known] <= half[name][known])) if known.any() else float("nan")
    words = _own_words(plant, level)
    if other_run:
        words += f" and a gain that varies by {100 * RUN_GAIN_SD:.0f} % from run to run (assumed: "
        words += f"{'one log' if len(plant.logs) == 1 else 'two logs'} cannot show it)"
    if far:
        words += ", wider because this run is unlike the fit (range of the readings, size of the moves)"
    return Band(level, half, inside, taken, words, expected)


def unlike_fit(plant: Plant, log: Log, simulated: Log, warmup: float) -> dict[str, Array]:
    """Return by output the standard deviation that a black box gets at each row for what is unlike its fit;
    empty for other plants."""
    if not plant.scores.held_out_by_part:
        return {}
    effects, time = between_runs(plant, [log], 1.0), log["time"].values
    begin, out = time - time[0] < max(warmup, plant.dt), {}
    for name in plant.outputs:
        run, (low, high) = column(simulated, name), plant.valid.get(name, (-np.inf, np.inf))
        first = column(log, name)[begin]
        first = first[np.isfinite(first)]
        start = float(np.mean(first - np.clip(first, low, high))) if first.size else 0.0
        added = np.hypot(run - np.clip(run, low, high), start)
        effect, before = effects.get(name), plant.scores.input_effect.get(name, 0.0)
        size = 0.0 if effect is None else float(np.sqrt(np.mean(effect**2)))
        if effect is not None and min(size, before) > 0:
            added = np.hypot(added, GAIN_OF_SIZE * min(abs(np.log(size / before)), 1.0) * effect)
        out[name] = np.asarray(added)
    return out


def between_runs(plant: Plant, logs: Sequence[Log], gain: float = RUN_GAIN_SD) -> dict[str, Array]:
    """Return by output what a gain of the inputs that is off by so much changes at each row of the logs, one
    after the other; empty for a plant of no log, or of so many that their held-out errors show what differs
    between runs. The effect of an input begins at the value nearest to 0 in the fit: a run that holds it has
    none of its own."""
    if not 0 < len(plant.logs) < SEVERAL:
        return {}
    return effect_of_inputs(plant, logs, gain)


def effect_of_inputs(plant: Plant, logs: Sequence[Log], gain: float) -> dict[str, Array]:
    """Return by output what inputs that do less by so large a share change at each row of the logs."""
    moving = set(plant.inputs) - set(plant.model.switches)
    nearest = {name: np.clip(0.0, *plant.valid.get(name, (0.0, 0.0))) for name in moving}
    changes = []
    for log in logs:
        change = columns(plant.simulate(log), plant.outputs)
        log = log.copy()
        for name in moving:
            u = column(log, name)
            log[name] = log[name].copy(data=u - gain * (u - nearest[name]))
        changes.append(change - columns(plant.simulate(log), plant.outputs))
    return dict(zip(plant.outputs, np.concatenate(changes).T))


def gain_of_run(plant: Plant, miss: Array, log: Log) -> tuple[float, Array] | None:
    """Return by how large a share the inputs did more in a run than in the fit, by least squares of what the
    free run missed (n, n_y), NaN where it is not scored, in the spread of each output; and what that leaves
    (n_y,) as rms. None where it is within two standard deviations of what differs from run to run, or leaves
    half of the squared error."""
    effects = effect_of_inputs(plant, [log], _SMALL)
    effect = np.array([effects[name] for name in plant.outputs]).T / _SMALL
    spread = np.array([np.nanstd(column(log, name)) for name in plant.outputs])
    with np.errstate(over="ignore", invalid="ignore"):  # a run that diverged has no gain
        known = (
            np.isfinite(miss) & (np.abs(effect) < _DIVERGED * spread) & (np.abs(miss) < _DIVERGED * spread)
        )
    size, gap = (np.where(known, each / np.where(spread > 0, spread, 1.0), 0.0) for each in (effect, miss))
    if not np.any(size):
        return None
    gain = float(np.sum(size * gap) / np.sum(size**2))
    if abs(gain) <= 2 * RUN_GAIN_SD or np.sum((gap - gain * size) ** 2) > 0.5 * np.sum(gap**2):
        return None
    left = np.where(known, miss - gain * effect, np.nan)
    return gain, np.sqrt(np.nanmean(left**2, axis=0))


def beyond_range(plant: Plant, logs: Sequence[Log]) -> dict[str, float]:
    """Return by output how far (rms) runs go beyond the readings of the fit if each input in percent, which
    the logs moved over a part of its range, is moved alike over 0 to 100."""
    parts = {name: plant.valid[name] for name in plant.inputs if plant.units.get(name) == "percent"}
    parts = {name: (low, high) for name, (low, high) in parts.items() if 0 <= low < high <= 100}
    out = dict.fromkeys(plant.outputs, 0.0)
    if all(ends == (0, 100) for ends in parts.values()):
        return out
    moved = []
    for log in logs:
        log = log.copy()
        for name, (low, high) in parts.items():
            u = column(log, name)
            log[name] = log[name].copy(data=100 * (u - low) / (high - low))
        moved.append(plant.simulate(log))
    for name in plant.outputs:
        run = np.concatenate([column(one, name) for one in moved])
        out[name] = float(np.sqrt(np.mean((run - np.clip(run, *plant.valid[name])) ** 2)))
    return out


def expected_coverage(plant: Plant, level: float = 0.9) -> dict[str, Array]:
    """Return by output the coverage of each held-out part expected of a band of the other parts, of a black
    box only."""
    wide = NormalDist().inv_cdf(0.5 + level / 2)
    out = {}
    for name, errors in plant.scores.held_out_by_part.items():
        squares = np.maximum(np.square(errors), 1e-24)
        if len(squares) > 1:
            others = (squares.sum() - squares) / (len(squares) - 1)
            out[name] = 2 * ndtr(wide * np.sqrt(others / squares)) - 1
    return out


def _own_words(plant: Plant, level: float) -> str:
    """Return how the plant's own error was estimated, and where a band of it falls short."""
    if not plant.scores.held_out_rmse:
        return "the error of the fit"
    words = "the errors of free runs over parts held out of it"
    shares = np.concatenate([np.empty(0), *expected_coverage(plant, level).values()])
    if not shares.size or shares.min() > level - SHORT:
        return words
    return (
        f"{words}, which differ: too narrow where errors are as on the worst part, "
        f"of which a band of the others should cover {100 * shares.min():.0f} %"
    )


def _own_variance(plant: Plant, name: str, drawn: Array, level: float) -> float:
    """Return s^2, of a black box what its draws do not explain of its held-out errors."""
    held_out = plant.scores.held_out_rmse.get(name)
    if held_out is None:
        return float(plant.noise.get(name, 0.0) ** 2)
    tails = [each.rmse for each in plant.scores.held_out if each.output == name and each.log.startswith(TAIL)]
    error = max(held_out, float(np.sqrt(np.mean(np.square(tails)))) if tails else 0.0)
    return float(max(error**2 - drawn.mean(), 0.0)) * _few_parts(plant, name, level) ** 2


def expected_error(errors: Sequence[float], parts: int) -> float:
    """Return the rms error to expect of one part more, of errors over ``parts`` that do not overlap."""
    return float(np.sqrt(np.mean(np.square(errors)) * (1 + 1 / (parts or len(errors)))))


def _few_parts(plant: Plant, name: str, level: float) -> float:
    """Return the quantile of Student's t over that of a normal error, for an s of so many parts."""
    parts = len(plant.scores.held_out_by_part.get(name, ()))
    upper = 0.5 + level / 2
    return float(stdtrit(parts, upper)) / NormalDist().inv_cdf(upper) if parts > 1 else 1.0


MOST_DISAGREEMENT = 0.4  # of the output's spread in the data of the fit
_STATES_AT_ONCE = 1_000_000  # numbers, 8 MB


def ensemble_disagreement(plant: Plant, log: Log, *, warmup: float = 5.0) -> dict[str, float]:
    """Return by output the rms of the members' sd over the output's spread; empty where not neural."""
    model = plant.model
    if not isinstance(model, NeuralModel) or len(model.A) < 2:
        return {}
    stretches, n_y = cut_stretches(plant, log), len(model.outputs)
    rows = max(1, _STATES_AT_ONCE // model.n_x)
    variance, count = np.zeros(n_y), 0
    for stretch, start in zip(stretches, find_starts(plant, plant.p, stretches, warmup)):
        x_end = start.x0
        for begin in range(0, len(stretch.u), rows):
            part = slice(begin, begin + rows)
            x = model.states(x_end, stretch.u[part], stretch.d[part] - start.d_offset, plant.dt)
            fresh = x if begin == 0 else x[1:]
            members = fresh.reshape(len(fresh), *model.A.shape[:2])[:, :, :n_y]
            variance += members.var(axis=1).sum(axis=0)
            count, x_end = count + len(fresh), x[-1]
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
