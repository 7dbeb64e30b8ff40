r"""Find the weights for what is wanted, and say whether weights were the limit.

The search varies what a user would have to guess: move suppression, the terminal weight, the overshoot band
kept free, how fast the observer moves its bias (all as logarithms, by NLopt's subplex, which needs no
derivative and takes the small jumps of a settling time), and before that moves that are dearer by powers of
ten, a filter that trusts readings less, and the horizon. Subplex takes the parameters a few at a time, those
named first before the others: 20 trials change the first two and hardly the rest. Each design
is evaluated in closed loop on draws of the plant's posterior, never on the model itself, and on draws that
lack structure (:mod:`thermogrip.mpc.tuning.objective`). A linear-quadratic regulator is tuned with the same
number of trials and a PI controller with three times as many, SIMC's first; they stand beside it. Of PIs that
score alike the one is taken that bears most of what no log shows (:mod:`thermogrip.mpc.tuning.robustness`).

Trade-offs that remain are reported: designs of which none is better in all of settling, overshoot and energy,
what each weight does (:mod:`thermogrip.mpc.tuning.trade_offs`), and whether weights were the limit at all:

* **actuator-limited**: the spec asks for less time than the drive allows, or the settling time is within a
  quarter of what the drive allows and the search won nothing: change the hardware or the spec, not the
  weights;
* **improved**: the score fell by more than 3 % against the default design on draws that the search has not
  seen;
* **flat**: it did not; the default is kept.

Whatever the verdict, it reports where a simpler controller, tuned with the same number of trials, is as good.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.parallel import (
    Progress,
    Workers,
    joint_progress,
    run_parallel,
    run_threads,
    sub_progress,
)
from thermogrip.mpc.closed_loop.simulate import ClosedLoop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.objective import (
    FREE,
    LONGEST_TI,
    LQR_PARAMETERS,
    MPC_PARAMETERS,
    PI_PARAMETERS,
    STILL,
    STRUCTURE,
    Bounds,
    Record,
    Search,
    StepResult,
    Trial,
    bound_of,
    counting,
    lacking,
    meets_spec,
    parameters_of,
    scaled_loops,
    score,
    trial,
)
from thermogrip.mpc.tuning.robustness import worst_sensitivity
from thermogrip.mpc.tuning.trade_offs import (
    PARAMETER_WORDS,
    RAMPS,
    STILL_SHARES,
    Pareto,
    Sensitivity,
    front_of,
    non_dominated,
    scan_of,
    sensitivity_of,
    sensitivity_words,
)

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_WON = 0.03  # relative fall of the score that counts
_NEAR = 1.25  # settling over bound that counts as the actuator's limit


@dataclass(frozen=True)
class Row(Record):
    """One line of the comparison: a controller on one step, over the draws."""

    controller: str  # ``"baseline"``, ``"tuned"``, ``"PI"`` or ``"LQR"``
    start: float  # [degC]
    target: float
    settle_mean_s: float  # NaN where it did not settle on some draw
    settle_worst_s: float
    overshoot_mean: float  # [degC]; the mean bias is of its size
    overshoot_worst: float
    bias_mean: float
    bias_worst: float
    energy_mean_s: float  # over the draws
    energy_worst_s: float
    travel_mean: float
    full_share: float
    bound_s: float  # before this no drive within the limits is in the band [s], mean over the draws
    output: str = ""  # the one it is of, where each is judged by itself


def rows_of(name: str, results: Sequence[StepResult], spec: Spec, bounds: Bounds) -> list[Row]:
    """Return a controller's rows, one a step of the spec, of each output where they are judged apart."""
    outputs = dict.fromkeys(result.output for result in results)
    of: dict[Any, list[StepResult]] = {(step, output): [] for step in spec.steps for output in outputs}
    for result in results:
        of[(result.start, result.target), result.output].append(result)
    return [_row(name, step, part, bounds) for (step, _), part in of.items()]


def _row(name: str, step: tuple[float, float], part: Sequence[StepResult], bounds: Bounds) -> Row:
    settle = np.array([result.settle_s for result in part])
    bias = np.array([result.bias for result in part])
    energy = np.array([result.energy_s for result in part])
    overshoot = np.array([result.overshoot for result in part])
    return Row(
        controller=name,
        start=step[0],
        target=step[1],
        settle_mean_s=float(np.mean(settle)),
        settle_worst_s=float(np.max(settle)),
        overshoot_mean=float(np.mean(overshoot)),
        overshoot_worst=float(np.max(overshoot)),
        bias_mean=float(np.mean(np.abs(bias))),
        bias_worst=float(bias[np.argmax(np.abs(bias))]),
        energy_mean_s=float(np.mean(energy)),
        energy_worst_s=float(np.max(energy)),
        travel_mean=float(np.mean([result.travel for result in part])),
        full_share=float(np.mean([result.full_share for result in part])),
        bound_s=float(np.mean([bound_of(bounds, result) for result in part])),
        output=part[0].output,
    )


def verdict_of(
    spec: Spec, scores: Mapping[str, float], rows: Sequence[Row], *, unseen: str = "on unseen draws"
) -> tuple[str, str]:
    """Return the verdict and its numbers in words."""
    won = 1 - min(scores["tuned"], scores["baseline"]) / scores["baseline"]
    beyond = [row for row in rows if row.bound_s > spec.asked(row.output).within_s]
    if beyond:
        return "actuator-limited", _beyond(max(beyond, key=lambda row: row.bound_s), spec)
    ratio = float(np.mean([row.settle_mean_s / max(row.bound_s, 1.0) for row in rows]))
    limits, simpler = _limits(rows, spec), _simpler(scores, spec)
    best = min(scores, key=lambda name: scores[name])
    first = ""
    if best in ("PI", "LQR"):  # what is best of all is said before all
        kept = " (its settings are in the file, `PIController.of` runs them)" if best == "PI" else ""
        first = f"{simpler} The MPC is what is saved{kept}. "
    against = limits if first else f"{limits} {simpler}".strip()
    if won > _WON:
        return "improved", f"{first}Score {100 * won:.0f} % below the default design {unseen}. {against}"
    if ratio <= _NEAR:
        return "actuator-limited", f"{first}Weights win {100 * won:.1f} %: the drive is the limit. {against}"
    few = f"less than the {100 * _WON:.0f} % that count"
    return "flat", f"{first}Weights win {100 * won:.1f} %, {few}. {against}"


def _beyond(row: Row, spec: Spec) -> str:
    """Return the sentence about a step that no controller can do in time."""
    step = f"{row.start:g} to {row.target:g} degC{row.output and f' of {row.output}'}"
    if not np.isfinite(row.bound_s):
        return f"{step} cannot be reached at this drive; no weight changes that."
    takes = f"takes {row.settle_mean_s:.0f} s" if np.isfinite(row.settle_mean_s) else "does not settle"
    asked = f"{spec.asked(row.output).within_s:g} s are asked"
    return (
        f"{step} cannot settle under {row.bound_s:.0f} s at this drive, and {asked}; yours {takes}; "
        f"no weight changes that."
    )


def _limits(rows: Sequence[Row], spec: Spec) -> str:
    """Return each step's settling beside what the drive allows, and the ramp where there is one."""
    said, allowed = [], "at this drive and ramp" if spec.ramps else "at this drive"
    for row in rows:
        settled = np.isfinite(row.settle_mean_s)
        takes = f"takes {row.settle_mean_s:.0f} s" if settled else "does not settle on every draw"
        step = f"{row.start:g} to {row.target:g}{row.output and f' of {row.output}'}"
        pace = spec.asked(row.output).pace_s
        least = f"may take {pace:g} s" if pace else f"cannot settle under {row.bound_s:.0f} s {allowed}"
        said.append(f"{step} {least}, yours {takes}")
    return "; ".join(said) + "."


def _simpler(scores: Mapping[str, float], spec: Spec) -> str:
    """Return what a simpler controller makes of it, "" where the MPC is plainly better than both."""
    kept = min(scores["tuned"], scores["baseline"])
    near = {name: scores[name] for name in ("PI", "LQR") if name in scores and scores[name] < 1.03 * kept}
    if not near:
        return ""
    name = min(near, key=lambda key: near[key])
    share = 100 * (1 - near[name] / kept)
    how = "as well" if abs(share) < 0.5 else f"{abs(share):.1f} % {'better' if share > 0 else 'worse'}"
    wishes = {"zones": spec.zones, "energy prices": spec.energy_price, "ramps": spec.ramps}
    unknown = [wish for wish, value in wishes.items() if value]
    unknown += ["limits of outputs", "where a gain turns over"] if name == "LQR" else []
    listed = f"{', '.join(unknown[:-1])} or {unknown[-1]}" if unknown[1:] else "".join(unknown)
    missing = f", and does not know {listed}" if unknown else ""
    return f"{name}, tuned with no fewer trials, scores {how} on this spec{missing}."


def _moved(kept: Sequence[Row], rows: Sequence[Row]) -> str:
    """Return how far a step moves the drives, beside the default design."""
    own = np.mean([row.travel_mean for row in kept])
    default = np.mean([row.travel_mean for row in rows if row.controller == "baseline"])
    return f"A step moves the drives by {own:.1f} times full drive, {default:.1f} with the default design."


def _ramps(design: Design, default: Design, plant: Plant) -> str:
    """Return how fast targets may change where they step in the default design, else ""."""
    own = {name: rate for name, rate in design.ramp_per_s.items() if name not in default.ramp_per_s}
    said = ", ".join(f"{name} by {rate:.2g} {plant.units.get(name, 'degC')}/s" for name, rate in own.items())
    return f"Targets ramp, which spares overshoot: {said}." if own else ""


def _lacking(plant: Plant, design: Design, spec: Spec, results: Sequence[StepResult]) -> str:
    """Return what becomes of a plant that has what its model lacks."""
    said = []
    for at, (what, _) in enumerate(lacking(plant, spec, design.controlled), start=1):
        part = [result for result in results if result.draw // STRUCTURE == at]
        settled = all(np.isfinite(result.settle_s) for result in part)
        takes = f"settles in {max(r.settle_s for r in part):.0f} s" if settled else "does not settle"
        said.append(f"with {what} it {takes}, overshoot {max(r.overshoot for r in part):.2f} K")
    return f"Where the model lacks structure: {'; '.join(said)}." if said else ""


# to begin with: dearer moves than in the default design, a price of travel, a filter that trusts readings
# less, or more, other horizons
_LOOK = (
    ("move", (10.0, 100.0, 1000.0)),
    ("still", STILL_SHARES),
    ("state_walk", (0.3, 0.1)),
    ("output_walk", (3.0, 10.0)),
    ("horizon", (0.7, 1.5)),
)
# where each part of the work ends, in shares of its CPU time (a furnace's): bounds and compilation, the
# search (shares of MPC, of which so much is a look about, PI and LQR), trade-offs, the comparison
_BEGUN, _SEARCHED, _TRADED, _COMPARED = 0.09, 0.67, 0.8, 0.87
_SHARES, _LOOKED = (0.17, 0.76, 0.07), 0.4
_WORTH = 0.01  # by which a traded design must be better on the spec's own score to be taken
_ALIKE = 0.01  # of designs with as much of the drive that differ by less in score the one that moves least;
# by no more than this either where noise alone makes a greater difference
_ALIKE_IN_NOISE = 0.05
_STILL = 0.05  # by which one must move less than another to be taken for it
_NOISES = 2  # besides the search's, in which designs are tried ...
_CONTENDERS, _CONTEND = 5, 0.1  # ... so many, whose score in the search's is within this of the least


@dataclass(frozen=True)
class Tuning:
    """What the tuner found.

    Attributes
    ----------
    controller : Controller
        The best design.
    verdict : str
        ``"improved"``, ``"flat"`` or ``"actuator-limited"``.
    finding : str
        The verdict in numbers, a few sentences.
    rows : tuple of Row
        Baseline, tuned, PI and LQR side by side, step by step, on the same draws.
    scores : dict of str to float
        By controller, on those draws; lower is better.
    pareto : Pareto
        Settling, overshoot and energy of designs on the search's draws, and which of them nothing beats.
    sensitivity : tuple of Sensitivity
        What each parameter does, on the search's draws.
    history : tuple of Trial
        Every design that was tried.
    meets_spec : bool
        Whether the tuned controller meets the spec on every draw.
    runs : dict of str to ClosedLoop
        One closed loop a step and controller, on the first draw, for figures: ``"28 to 38, MPC"``.
    spec : Spec
    seed : int
    """

    controller: Controller
    verdict: str
    finding: str
    rows: tuple[Row, ...]
    scores: dict[str, float]
    pareto: Pareto
    sensitivity: tuple[Sensitivity, ...]
    history: tuple[Trial, ...]
    meets_spec: bool
    runs: dict[str, ClosedLoop]
    spec: Spec
    seed: int

    def save(self, path: str | Path) -> Path:
        """Write the controller with what was found about it, and return the path."""
        return self.controller.save(path)


def tune(
    plant: Plant,
    spec: Spec | None = None,
    *,
    progress: Progress | None = None,
    workers: Workers = 1,
    seed: int = 0,
) -> Tuning:
    """Return the best controller found for a spec.

    Parameters
    ----------
    plant : Plant
        With its uncertainty where it has any: draws of it close the loop.
    spec : Spec, optional
        What is wanted; where absent, :meth:`Spec.of` the plant.
    progress : callable, optional
        Called with (fraction done, what is being done).
    workers : int or str, optional
        Local processes, or the address of a Dask cluster; the result does not depend on it.
    seed : int, optional
        Of the noise.

    Raises
    ------
    UserError
        If the spec does not fit the plant, the plant cannot be controlled, or no target can be reached.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> from thermogrip.mpc import Spec
    >>> spec = Spec(steps=[(25.0, 35.0)], sample_time_s=5.0, output="t1", hold_s=200.0, evaluations=3)
    >>> found = tune(plant, spec)
    >>> found.verdict, [row.controller for row in found.rows]
    ('flat', ['baseline', 'tuned', 'PI', 'LQR'])
    """
    spec = Spec.of(plant) if spec is None else spec
    plant = spec.widened(plant)
    search = Search(plant, spec, spec.design(plant), seed, workers=workers)
    baseline = search.baseline
    found, pi = _search_all(search, workers, sub_progress(progress, _BEGUN, _SEARCHED))
    pareto, best = _trade(search, found, pi, workers, sub_progress(progress, _SEARCHED, _TRADED))
    tuned = search.design(best.parameters)
    candidates = {
        "baseline": baseline,
        "tuned": tuned,
        "PI": replace(tuned, loops=scaled_loops(baseline.loops, pi.parameters)),
        "LQR": search.design(_best(found["LQR"]).parameters),
    }
    results = _compare(search, candidates, workers, sub_progress(progress, _TRADED, _COMPARED))
    scores = {name: score(part, spec, search.bounds, search.pi_moves) for name, part in results.items()}
    own = {name: counting(part, spec) for name, part in results.items()}
    moved = {name: np.mean([result.travel for result in part]) for name, part in own.items()}
    stiller = moved["tuned"] < moved["baseline"] / (1 + _STILL)
    alike = 1 + (_ALIKE_IN_NOISE if stiller else _ALIKE if moved["tuned"] < moved["baseline"] else 0.0)
    kept = "tuned" if scores["tuned"] < alike * scores["baseline"] else "baseline"
    # the PI found here also takes over when the optimiser fails
    final = replace(candidates[kept], loops=candidates["PI"].loops)

    def sensitivities() -> list[Sensitivity]:
        # what a number does shows in one noise too
        found_best = best.parameters if kept == "tuned" else parameters_of(baseline, spec)
        about = search.evaluate(found_best, noises=1)
        of = [parameter for parameter in PARAMETER_WORDS if parameter in about.parameters]
        items = [(search, parameter, about.parameters, about) for parameter in of]
        share = sub_progress(progress, _COMPARED, 1.0)
        return run_threads(sensitivity_of, items, workers, share, what="sensitivities")

    last: list[Callable[[], Any]] = [sensitivities, partial(_runs, search, final, candidates["LQR"], workers)]
    sensitivity, shown = run_threads(lambda made: made(), last, workers)
    history = tuple(tried for part in found.values() for tried in part)
    rows = tuple(row for name, part in own.items() for row in rows_of(name, part, spec, search.bounds))
    unseen = "under fresh noise (the plant has no uncertainty)" if search.certain else "on unseen draws"
    kept_rows = [row for row in rows if row.controller == kept]
    still = spec.model_copy(update={"moves_weight": 0.0})
    settling = {name: score(part, still, search.bounds) for name, part in own.items()}
    verdict, finding = verdict_of(spec, settling, kept_rows, unseen=unseen)
    missing = [result for result in results[kept] if result.draw >= STRUCTURE]
    more = [_moved(kept_rows, rows), _ramps(candidates[kept], baseline, plant)]
    more.append(_lacking(plant, baseline, spec, missing))
    finding = " ".join(part for part in (finding, *more) if part)
    meets = all(meets_spec(result, spec) for result in own[kept])
    notes = {
        "verdict": verdict,
        "finding": finding,
        "meets_spec": meets,
        "scores": scores,
        "sensitivity": [item.to_dict() for item in sensitivity],
        "in_words": sensitivity_words(sensitivity),
        "pareto": pareto.rows(),
        "spec": spec.model_dump(mode="json"),
        "seed": seed,
        "rows": [row.to_dict() for row in rows],
        "lacking": [result.to_dict() for result in missing],
    }
    controller = Controller(plant, final, notes=notes)
    return Tuning(
        controller=controller,
        verdict=verdict,
        finding=finding,
        rows=rows,
        scores=scores,
        pareto=pareto,
        sensitivity=tuple(sensitivity),
        history=history,
        meets_spec=meets,
        runs=shown,
        spec=spec,
        seed=seed,
    )


def _best(trials: Sequence[Trial]) -> Trial:
    return min(trials, key=lambda trial: trial.score)


def _allowed(search: Search) -> float:
    """Return the overshoot that every output is allowed."""
    return min(search.spec.asked(name).overshoot_degC for name in search.baseline.controlled)


def _ramped(search: Search, best: Trial, workers: Workers) -> list[Trial]:
    """Return trials of the best design whose targets ramp, none where it keeps to the allowed overshoot.

    A step far beyond what was seen before shows how wrong a model is only on its way; on a ramp the filter
    has the time to learn it, and loads are still met with all of the drive.
    """
    if best.overshoot <= FREE * _allowed(search) or not search.at_once:
        return []
    look = [{**best.parameters, "ramp": times} for times in RAMPS]
    return run_threads(search.evaluate, look, workers, what=PARAMETER_WORDS["ramp"])


# of the best PI's gain and integral time, in what is tried of sturdier ones
_GAINS, _TIMES = (1.0, 0.85, 0.7), (1.0, 1.25, 1.6, 2.0)


def _sturdiest(search: Search, tried: list[Trial]) -> tuple[list[Trial], Trial]:
    """Return a PI's trials, with some more of less gain and longer integral times than the best one has, and
    of those that score as it does, as far as trials tell, the one that bears most of what the model lacks.

    What no log shows no score shows either: on a plant whose sensor is slower than in the logs the PI of the
    better score may settle later.
    """
    best = _best(tried)
    low = {name: least for name, least, _ in search.pi}
    Kc, Ti = (best.parameters[name] for name in ("Kc", "Ti"))
    longest = LONGEST_TI * Kc
    about = {(gain * Kc, min(longer * Ti, gain * longest)) for gain in _GAINS for longer in _TIMES}
    about -= {(Kc, Ti), (Kc, longest)} if Ti >= longest else {(Kc, Ti)}
    more = [
        {**best.parameters, "Kc": Kc, "Ti": Ti}
        for Kc, Ti in sorted(about, reverse=True)
        if Kc >= low["Kc"] and Ti >= low["Ti"]
    ]
    tried = [*tried, *search.evaluate_each("PI", more, what="sturdier PIs")]
    alike = [trial for trial in tried if trial.score <= (1 + _ALIKE_IN_NOISE) * best.score]

    def bears(trial: Trial) -> float:
        loops = scaled_loops(search.baseline.loops, trial.parameters)
        return worst_sensitivity(search.plant, loops, search.baseline.dt)

    return tried, min(alike, key=bears)


def _trade(
    search: Search,
    found: dict[str, list[Trial]],
    pi: Trial,
    workers: Workers,
    progress: Progress | None,
) -> tuple[Pareto, Trial]:
    """Return designs about the best one at full length, beside the best PI and LQR; and the one to take."""
    best = _best(found["MPC"])
    scan = scan_of(best.parameters, found["MPC"], ramps=bool(search.at_once))
    scanned = [(name, ("MPC", parameters)) for name, parameters in scan]
    others = {"PI": pi, "LQR": _best(found["LQR"])}
    scanned += [(f"{name}, tuned", (name, trial.parameters)) for name, trial in others.items()]
    names = [name for name, _ in scanned]
    known = [trial for trial in (*found["MPC"], pi) if search.at_length(trial)]
    looked = {_named(trial.controller, trial.parameters): trial for trial in known}
    items = [item for _, item in scanned if _named(*item) not in looked]
    done = run_threads(search.evaluate_at_length, items, workers, progress, what="trade-offs")
    looked |= {_named(*item): trial for item, trial in zip(items, done, strict=True)}
    tried = [looked[_named(*item)] for _, item in scanned]
    own = [trial for trial in tried if trial.controller == "MPC"]
    near = _contenders(own)
    again = [(trial.parameters, noise) for trial in near for noise in range(1, 1 + _NOISES)]
    louder = run_threads(search.evaluate_in_other_noise, again, workers, what="the same in other noise")
    noises = [[near[k], *louder[_NOISES * k :][:_NOISES]] for k in range(len(near))]
    still = near[_stillest(noises, search.plant.dt, _allowed(search))]
    if still is own[0]:
        return front_of(tried, names), best
    at = next(k for k, trial in enumerate(tried) if trial is still)
    names[0], names[at] = "found by the search", f"tuned: {names[at]}"
    return front_of(tried, names), search.evaluate(still.parameters)


def _named(controller: str, parameters: dict[str, float]) -> tuple[str, tuple[tuple[str, float], ...]]:
    return controller, tuple(sorted(parameters.items()))


def _share(trial: Trial) -> float:
    return trial.parameters.get("drive_share", 1.0)


def _contenders(own: Sequence[Trial]) -> list[Trial]:
    """Return the first of these designs and those that may be taken in its place: near the least score, with
    as much of the drive and none both scoring less and moving less, or the best one with less of it."""
    least = min(trial.score for trial in own)
    near = [trial for trial in own[1:] if trial.score <= (1 + _CONTEND) * least]
    whole = [trial for trial in near if _share(trial) == _share(own[0])]
    points = np.array([(trial.score, trial.travel) for trial in whole]).reshape(-1, 2)
    front = non_dominated(points)
    still = sorted((trial for trial, kept in zip(whole, front) if kept), key=lambda trial: trial.travel)
    capped = [trial for trial in near if _share(trial) != _share(own[0])]
    return [own[0], *still[: _CONTENDERS - 1], *([_best(capped)] if capped else [])]


def _stillest(found: Sequence[Sequence[Trial]], reading_s: float = 0.0, allowed: float = 0.0) -> int:
    """Return which of these designs moves least, of those that score as the best does as far as trials tell;
    of each there is a trial in each of the same noises.

    They tell a difference of their means that is above its standard error: the rule of one standard error, by
    which of models that predict alike the simplest is taken [1]_. Below 1 % none counts; above 5 % each does,
    for three noises are few. Nor do they tell settling times apart that differ by less than half a reading in
    the mean, where no design overshoots. A difference of moves that is below 5 % does not count either. With
    less of the drive than the first, a design must be better than it by 1 %.

    References
    ----------
    .. [1] L. Breiman, J. Friedman, R. Olshen, C. Stone, "Classification and Regression Trees", 1984, 3.4.3.
    """
    scores = np.array([[trial.score for trial in trials] for trials in found])
    travels = np.array([np.mean([trial.travel for trial in trials]) for trials in found])
    shares, means = np.array([_share(trials[0]) for trials in found]), scores.mean(axis=1)
    whole = shares == shares[0]
    least = int(np.argmin(np.where(whole | (means < (1 - _WORTH) * means[0]), means, np.inf)))
    more = scores - scores[least]
    error = more.std(axis=1, ddof=1) / np.sqrt(scores.shape[1])
    told = np.clip(error, _ALIKE * means[least], _ALIKE_IN_NOISE * means[least])
    settles = np.array([np.mean([trial.settle_s for trial in trials]) for trials in found])
    quiet = np.array([max(trial.overshoot for trial in trials) <= FREE * allowed for trials in found])
    unseen = (settles - settles[least] < 0.5 * reading_s) & quiet & quiet[least]
    alike = ((more.mean(axis=1) <= told) | unseen) & (shares == shares[least])
    still = alike & (travels <= (1 + _STILL) * travels[alike].min())
    return int(np.argmin(np.where(still, means, np.inf)))


def _looked_about(search: Search, workers: Workers, progress: Progress | None) -> list[Trial]:
    """Return the first trials of an MPC: the default design, and one parameter after the other in steps that
    the search is too short for."""
    looked = [search.evaluate(parameters_of(search.baseline, search.spec))]
    if progress is not None:
        progress(1 / (1 + len(_LOOK)), "default design")
    for at, (parameter, factors) in enumerate(_LOOK, start=1):
        first = _best(looked).parameters
        values = [factor * first.get(parameter, 1.0) for factor in factors]
        look = [{**first, parameter: float(round(v)) if parameter == "horizon" else v} for v in values]
        share = sub_progress(progress, at / (1 + len(_LOOK)), (at + 1) / (1 + len(_LOOK)))
        looked += run_threads(search.evaluate, look, workers, share, what=PARAMETER_WORDS[parameter])
    return [*looked, *_ramped(search, _best(looked), workers)]


def _search_all(
    search: Search, workers: Workers, progress: Progress | None
) -> tuple[dict[str, list[Trial]], Trial]:
    """Return the trials of MPC, PI and LQR, after as many evaluations each, the PI after thrice as many; and
    the PI to take."""
    n = search.spec.evaluations
    # SIMC, with the drive that holds the target; and without: a plant that has no draws does not know how
    # wrong that drive is
    first = {"Kc": 1.0, "Ti": 1.0, "setpoint": 1.0, "feedforward": 0.99}
    plain = first | {"feedforward": 0.05}
    starts = [plain | dict(zip(_SPREAD, values.tolist())) for values in _spread(search.pi)]
    lqr = {**parameters_of(search.baseline, search.spec), "drive": 1e-2}
    parts = joint_progress(progress, _SHARES)

    def mpc() -> tuple[list[Trial], Trial]:
        looked = _looked_about(search, workers, sub_progress(parts[0], 0.0, _LOOKED))
        best, left = _best(looked), max(0, n - len(looked))
        share = sub_progress(parts[0], _LOOKED, 1.0)
        return [*looked, *_optimise((search, "MPC", [best.parameters], left, share))], best

    def loops() -> tuple[list[Trial], Trial]:
        item = (search, "PI", [first, plain, *starts][search.certain :], 3 * n, parts[1])
        return _sturdiest(search, _optimise(item))

    def regulator() -> tuple[list[Trial], Trial]:
        tried = _optimise((search, "LQR", [lqr], n, parts[2]))
        return tried, _best(tried)

    of: list[Callable[[], tuple[list[Trial], Trial]]] = [mpc, loops, regulator]
    (designs, _), (pis, pi), (others, _) = run_threads(lambda made: made(), of, workers)
    return {"MPC": designs, "PI": pis, "LQR": others}, pi


_SPREAD = {"Kc": (0.4, 2.5), "Ti": (0.4, 2.5), "setpoint": (0.2, 1.0), "feedforward": (0.05, 1.0)}


def _spread(bounds: Sequence[tuple[str, float, float]]) -> Array:
    """Return 32 sets of a PI's parameters inside these bounds, evenly spread over their logarithms."""
    from scipy.stats.qmc import Halton

    ends = [(max(low, _SPREAD[name][0]), min(high, _SPREAD[name][1])) for name, low, high in bounds]
    low, high = np.log(ends).T
    return np.asarray(np.exp(low + Halton(len(ends), scramble=False).random(33)[1:] * (high - low)))


#: What searches, of which controller, its starts, the number of evaluations.
_Item: TypeAlias = "tuple[Search, str, list[dict[str, float]], int, Progress | None]"


def _optimise(item: _Item) -> list[Trial]:
    """Minimise a controller's score over its parameters' logarithms from the best of its starts on; return
    every trial."""
    search, name, starts, evaluations, progress = item
    if evaluations < 1:
        return []
    import nlopt

    parameters = {"MPC": MPC_PARAMETERS, "PI": search.pi, "LQR": LQR_PARAMETERS}[name]
    if "still" in starts[0]:
        parameters = (*parameters[:1], STILL, *parameters[1:])
    evaluate = partial(search.evaluate, name=name)
    names = [parameter for parameter, _, _ in parameters]
    low = np.log([small for _, small, _ in parameters])
    high = np.log([large for _, _, large in parameters])
    tried: list[Trial] = []

    what = f"weights of the {name}"
    if name != "MPC":
        first = starts[:evaluations]
        share = sub_progress(progress, 0.0, len(first) / evaluations)
        tried += search.evaluate_each(name, first, share, what=what)
    start = _best(tried).parameters if tried else starts[0]

    def cost(z: Array, gradient: Array) -> float:
        tried.append(evaluate({**start, **dict(zip(names, np.exp(z).tolist(), strict=True))}))
        if progress is not None:
            progress(min(len(tried) / evaluations, 1.0), what)
        return tried[-1].score

    optimiser = nlopt.opt(nlopt.LN_SBPLX, len(names))
    optimiser.set_min_objective(cost)
    optimiser.set_lower_bounds(low)
    optimiser.set_upper_bounds(high)
    optimiser.set_initial_step(np.full(len(names), 0.3 if name == "PI" else 0.7))
    optimiser.set_maxeval(evaluations - len(tried) or 1)
    optimiser.set_xtol_rel(1e-3)
    optimiser.optimize(np.clip(np.log([start[parameter] for parameter in names]), low + 1e-9, high - 1e-9))
    if name == "PI" and search.pi[0] != PI_PARAMETERS[0] and not np.isfinite(_best(tried).settle_s):
        # within the limits of a delay that no log shows it does not settle
        wide = copy(search)
        wide.pi = PI_PARAMETERS[: len(search.pi)]
        others = [start | dict(zip(_SPREAD, values.tolist())) for values in _spread(wide.pi)]
        return [*tried, *_optimise((wide, name, others, evaluations, progress))]
    return tried


def _compare(
    search: Search, candidates: dict[str, Design], workers: Workers, progress: Progress | None
) -> dict[str, list[StepResult]]:
    """Run all candidates on draws that the search has not seen, at full length."""
    draws = [*search.unseen, *(draw - search.draws[0] + search.unseen[0] for draw in search.lacking)]
    items = [(name, design, draw) for name, design in candidates.items() for draw in draws]
    done = run_parallel(search.check, items, workers, progress, what="comparison")
    results: dict[str, list[StepResult]] = {name: [] for name in candidates}
    for (name, _, _), part in zip(items, done, strict=True):
        results[name] += part
    return results


def _runs(search: Search, design: Design, lqr: Design, workers: Workers) -> dict[str, ClosedLoop]:
    """Return every step on the first unseen draw by the controller as it is used, by PI and by LQR."""
    designs = {"MPC": design, "PI": design, "LQR": lqr}
    items = [(search, name, design, step) for step in search.spec.steps for name, design in designs.items()]
    done = run_parallel(_shown, items, workers, what="runs")
    named = [f"{start:g} to {target:g}, {name}" for _, name, _, (start, target) in items]
    return dict(zip(named, done, strict=True))


def _shown(item: tuple[Search, str, Design, tuple[float, float]]) -> ClosedLoop:
    search, name, design, step = item
    made = Controller(search.plant, design) if name == "MPC" else search.made(name, design)
    return trial(
        made,
        plant=search.plant,
        spec=search.spec,
        step=step,
        draw=search.unseen[0],
        length_s=search.spec.hold_s,
        seed=search.check_seed,
    )
