r"""Find the weights for what is wanted, and say honestly whether weights were the limit.

The search varies what a user would have to guess: move suppression, the price of the end, the overshoot
band kept free, how fast the observer moves its bias (all as logarithms, by NLopt's subplex, which needs no
derivative and takes the small jumps of a settling time), and before that the horizon.  Each design is
judged in closed loop on draws of the plant's posterior, never on the model itself.  A PI controller is
tuned with the same effort on the same trials, and stands beside it.

The verdict is one of

* **actuator-limited**: the spec asks for less time than full drive needs, or the settling time is within a
  quarter of what full drive alone needs and the search won nothing: change the hardware or the spec, not
  the weights;
* **improved**: the score fell by more than 3 % against the default design on draws that the search has not
  seen;
* **flat**: it did not; the default stands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.workers import run_parallel, sub_progress
from thermogrip.mpc.closed_loop import ClosedLoop
from thermogrip.mpc.controller import Controller
from thermogrip.mpc.design import Design
from thermogrip.mpc.pid import PILoop
from thermogrip.mpc.search import KNOBS, PI_KNOBS, Search, knobs_of, scaled_loops
from thermogrip.mpc.spec import Spec
from thermogrip.mpc.trials import (
    Bounds,
    StepResult,
    score,
    trial,
)

if TYPE_CHECKING:
    from thermogrip.sysid.plant import Plant

__all__ = ["Row", "Tuning", "tune"]

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

_WON = 0.03  # relative fall of the score that counts
_NEAR = 1.25  # settling over bound that counts as the actuator's limit


@dataclass(frozen=True)
class Row:
    """One line of the comparison: a controller on one step, over the draws.

    Attributes
    ----------
    controller : str
        ``"baseline"``, ``"tuned"`` or ``"PI"``.
    start, target : float
        [degC].
    settle_mean_s, settle_worst_s : float
        NaN where it did not settle on some draw.
    overshoot_worst, bias_worst : float
        [degC].
    energy_mean_s, travel_mean, full_share : float
        Mean over the draws.
    bound_s : float
        What full drive needs to reach the band [s], mean over the draws.
    """

    controller: str
    start: float
    target: float
    settle_mean_s: float
    settle_worst_s: float
    overshoot_worst: float
    bias_worst: float
    energy_mean_s: float
    travel_mean: float
    full_share: float
    bound_s: float


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
        The verdict in numbers, one or two sentences.
    rows : tuple of Row
        Baseline, tuned and PI side by side, step by step, on the same draws.
    scores : dict of str to float
        By controller, on those draws; lower is better.
    sensitivity : dict of str to float
        Change of the score, relative, when a knob is doubled (found on the search's draws).
    history : tuple of (dict, float)
        Every design that was tried, and its score.
    meets_spec : bool
        Whether the tuned controller meets the spec on every draw.
    runs : dict of str to ClosedLoop
        One closed loop a step and controller, on the first draw, for figures.
    spec : Spec
    seed : int
    """

    controller: Controller
    verdict: str
    finding: str
    rows: tuple[Row, ...]
    scores: dict[str, float]
    sensitivity: dict[str, float]
    history: tuple[tuple[dict[str, float], float], ...]
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
    workers: int = 1,
    seed: int = 0,
) -> Tuning:
    """Return the best controller found for a spec.

    Parameters
    ----------
    plant : Plant
        With its uncertainty where it has any: draws of it close the loop.
    spec : Spec, optional
        What is wanted; the defaults where absent.
    progress : callable, optional
        Called with (fraction done, what is being done).
    workers : int, optional
        Processes for the first look around and the comparison; the result does not depend on it.
    seed : int, optional
        Of the noise.

    Returns
    -------
    Tuning

    Raises
    ------
    UserError
        If the spec does not fit the plant, or no target can be reached at all.
    """
    spec = Spec() if spec is None else spec
    baseline = spec.design(plant)
    search = Search(plant, spec, baseline, seed)
    look = [{**knobs_of(baseline, spec), "horizon": h * sum(baseline.blocks)} for h in (0.7, 1.0, 1.5)]
    found = run_parallel(search.judge, look, workers, sub_progress(progress, 0.0, 0.12), what="horizon")
    history = list(zip(look, found, strict=True))
    best = min(history, key=lambda pair: pair[1])[0]
    left = max(0, spec.evaluations - len(look))
    history += _subplex(
        search.judge, KNOBS, best, left, sub_progress(progress, 0.12, 0.65), "weights of the MPC"
    )
    best, best_score = min(history, key=lambda pair: pair[1])
    sensitivity = _sensitivity(search, best, best_score, sub_progress(progress, 0.65, 0.75))
    loops = _tune_pi(search, sub_progress(progress, 0.75, 0.80))
    tuned = search.design(best)
    candidates = {"baseline": baseline, "tuned": tuned, "PI": replace(tuned, loops=loops)}
    results = _compare(search, candidates, workers, sub_progress(progress, 0.80, 1.0))
    return _conclude(search, candidates, results, sensitivity, history)


def _subplex(
    judge: Callable[[dict[str, float]], float],
    knobs: Sequence[tuple[str, float, float]],
    start: dict[str, float],
    evaluations: int,
    progress: Progress | None,
    what: str,
) -> list[tuple[dict[str, float], float]]:
    """Minimise over the knobs' logarithms; return every point tried with its score."""
    if evaluations < 1:
        return []
    import nlopt

    names = [name for name, _, _ in knobs]
    low = np.log([small for _, small, _ in knobs])
    high = np.log([large for _, _, large in knobs])
    tried: list[tuple[dict[str, float], float]] = []

    def cost(z: Array, gradient: Array) -> float:
        point = {**start, **dict(zip(names, np.exp(z).tolist(), strict=True))}
        value = judge(point)
        tried.append((point, value))
        if progress is not None:
            progress(len(tried) / evaluations, what)
        return value

    optimiser = nlopt.opt(nlopt.LN_SBPLX, len(names))
    optimiser.set_min_objective(cost)
    optimiser.set_lower_bounds(low)
    optimiser.set_upper_bounds(high)
    optimiser.set_initial_step(np.full(len(names), 0.7))
    optimiser.set_maxeval(evaluations)
    optimiser.set_xtol_rel(1e-3)
    optimiser.optimize(np.clip(np.log([start[name] for name in names]), low + 1e-9, high - 1e-9))
    return tried


def _tune_pi(search: Search, progress: Progress | None) -> tuple[PILoop, ...]:
    """Return PI loops after as many trials as the MPC had, from SIMC on."""
    start = {"Kc": 1.0, "Ti": 1.0, "Tt": 0.5, "feedforward": 0.99}
    n = max(1, search.spec.evaluations)
    tried = [(start, search.judge_pi(start))]
    tried += _subplex(search.judge_pi, PI_KNOBS, start, n, progress, "weights of the PI")
    return scaled_loops(search.baseline.loops, min(tried, key=lambda pair: pair[1])[0])


def _sensitivity(
    search: Search, best: dict[str, float], reference: float, progress: Progress | None
) -> dict[str, float]:
    found = {}
    for at, (name, _, largest) in enumerate(KNOBS):
        doubled = min(2 * best[name], largest)
        found[name] = search.judge({**best, name: doubled}) / reference - 1
        if progress is not None:
            progress((at + 1) / len(KNOBS), "sensitivity")
    return found


def _compare(
    search: Search, candidates: dict[str, Design], workers: int, progress: Progress | None
) -> dict[str, list[StepResult]]:
    """Run all candidates on draws that the search has not seen, at full length."""
    items = [(name, design, draw) for name, design in candidates.items() for draw in search.unseen]
    done = run_parallel(search.check, items, workers, progress, what="comparison")
    results: dict[str, list[StepResult]] = {name: [] for name in candidates}
    for (name, _, _), part in zip(items, done, strict=True):
        results[name] += part
    return results


def _conclude(
    search: Search,
    candidates: dict[str, Design],
    results: dict[str, list[StepResult]],
    sensitivity: dict[str, float],
    history: list[tuple[dict[str, float], float]],
) -> Tuning:
    spec, bounds = search.spec, search.bounds
    scores = {name: score(part, spec, bounds) for name, part in results.items()}
    kept = "tuned" if scores["tuned"] < scores["baseline"] else "baseline"
    rows = tuple(row for name, part in results.items() for row in _rows(name, part, spec, bounds))
    verdict, finding = _verdict(spec, scores, [row for row in rows if row.controller == kept])
    meets = all(_meets(result, spec) for result in results[kept])
    # the PI found here also stands in when the optimiser fails
    design = replace(candidates[kept], loops=candidates["PI"].loops)
    notes = {
        "verdict": verdict,
        "finding": finding,
        "meets_spec": meets,
        "scores": scores,
        "sensitivity": sensitivity,
        "spec": spec.model_dump(mode="json"),
        "seed": search.seed,
        "rows": [{key: _jsonable(value) for key, value in vars(row).items()} for row in rows],
    }
    controller = Controller(search.plant, design, notes=notes)
    draw = search.unseen[0]
    run = partial(trial, plant=search.plant, spec=spec, draw=draw, length_s=spec.hold_s, seed=search.seed)
    runs = {}
    for step in spec.steps:
        runs[f"{step[0]:g} to {step[1]:g}, MPC"] = run(controller, step=step)
        runs[f"{step[0]:g} to {step[1]:g}, PI"] = run(search.pi(design.loops), step=step)
    return Tuning(
        controller,
        verdict,
        finding,
        rows,
        scores,
        sensitivity,
        tuple(history),
        meets,
        runs,
        spec,
        search.seed,
    )


def _rows(name: str, results: list[StepResult], spec: Spec, bounds: Bounds) -> list[Row]:
    rows = []
    for step in spec.steps:
        part = [result for result in results if (result.start, result.target) == step]
        settle = np.array([result.settle_s for result in part])
        rows.append(
            Row(
                controller=name,
                start=step[0],
                target=step[1],
                settle_mean_s=float(np.mean(settle)),
                settle_worst_s=float(np.max(settle)),
                overshoot_worst=max(result.overshoot for result in part),
                bias_worst=max((result.bias for result in part), key=abs),
                energy_mean_s=float(np.mean([result.energy_s for result in part])),
                travel_mean=float(np.mean([result.travel for result in part])),
                full_share=float(np.mean([result.full_share for result in part])),
                bound_s=float(np.mean([bounds[(*step, result.draw)] for result in part])),
            )
        )
    return rows


def _verdict(spec: Spec, scores: dict[str, float], rows: Sequence[Row]) -> tuple[str, str]:
    won = 1 - min(scores["tuned"], scores["baseline"]) / scores["baseline"]
    beyond = [row for row in rows if row.bound_s > spec.settle_within_s]
    if beyond:
        row = max(beyond, key=lambda row: row.bound_s)
        needs = (
            f"full drive alone needs {row.bound_s:.0f} s"
            if np.isfinite(row.bound_s)
            else "it cannot be reached"
        )
        step = f"{row.start:g} to {row.target:g} degC"
        return (
            "actuator-limited",
            f"{step}: {spec.settle_within_s:g} s are asked, {needs}; no weight can mend that.",
        )
    ratios = [row.settle_mean_s / max(row.bound_s, 1.0) for row in rows]
    ratio = float(np.mean(ratios))
    against = (
        f"Settling takes {ratio:.2f} times what full drive alone needs to reach the band (mean of the steps)."
    )
    if won > _WON:
        return "improved", f"Score {100 * won:.0f} % below the default design on unseen draws. {against}"
    if ratio <= _NEAR:
        return "actuator-limited", f"Weights win {100 * won:.1f} %: the drive is the limit. {against}"
    return "flat", f"Weights win {100 * won:.1f} %, less than the {100 * _WON:.0f} % that count. {against}"


def _meets(result: StepResult, spec: Spec) -> bool:
    return (
        result.settle_s <= spec.settle_within_s  # False where NaN
        and result.overshoot <= spec.overshoot_degC
        and abs(result.bias) <= spec.bias_degC
    )


def _jsonable(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
