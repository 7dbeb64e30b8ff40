r"""Find the best controller of all kinds for what is wanted, and say whether weights were the limit.

An MPC is varied by five factors of its default design, a PI by three of SIMC's settings, each by its
logarithm, by NLopt's simplex search, and scored in closed loop on draws of the plant's posterior
(:mod:`thermogrip.mpc.tuning.objective`).  The default design, the best MPC and the best PI are then compared
on draws that the search has not seen; the one of the least score is what is saved, whatever its kind.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.parallel import Progress
from thermogrip.mpc.closed_loop.simulate import ClosedLoop
from thermogrip.mpc.controllers.controller_file import KEPT_DRAWS
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.design.relays import pairs_of_drives
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.design_review import Check, passes, review
from thermogrip.mpc.tuning.objective import (
    COSTS,
    Bounds,
    Case,
    Scales,
    Score,
    StepResult,
    apparent_delays,
    bounds_of,
    draws_of,
    judged_draws,
    judged_seed,
    lacking,
    load_seconds,
    loads_of,
    made_for_trials,
    run_trials,
    score,
    steps_on,
    trial,
)
from thermogrip.sysid.plant.plant_data import thin

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class SearchSettings:
    """How designs are searched and compared."""

    # Relative fall of the score that counts. On unseen draws the score of 79 designs of seven plants, over
    # their default's, is less than the mean of both errors over the default's on the truth by .06 in the
    # logarithm and a standard deviation of .09 from plant to plant (eight_plants.py): their sum, as a fall.
    won: float = 0.14
    # relative rise of steps or of loads from which an MPC is not taken, whatever it wins on the other: trials
    # are the model's word, and on two of eight plants the truth denied it
    worse: float = 0.03
    near: float = 1.25  # settling over bound that counts as the actuator's limit
    # by which a search first varies each parameter.  Score over the default's on unseen draws of four plants
    # (geometric mean): .971; subplex .982 from 2 and from 4 on; a compass search .970
    first_factor: float = 2.0
    last_factor: float = 1.1  # and below which it stops: a tenth of it moves a score by less than noise
    # where each part of the work ends, in shares of its time
    scaled: float = 0.15
    searched: float = 0.75
    compared: float = 0.9  # then come the runs that are shown, and the review


SEARCH = SearchSettings()
#: What a search varies, as a factor of the default design or of SIMC: name, smallest, largest.
MPC_PARAMETERS = {
    "move": (0.01, 1000.0),
    "bias": (0.03, 30.0),
    "state": (0.1, 10.0),
    "overshoot": (0.1, 4.0),
    "terminal": (0.03, 30.0),
}
PI_PARAMETERS = {"Kc": (0.2, 5.0), "Ti": (0.2, 5.0), "setpoint": (0.1, 1.0)}
#: Of a PI whose delay is below two steps of the plant: no log shows it, SIMC's gain is the highest tried.
PI_OF_UNSEEN_DELAY = PI_PARAMETERS | {"Kc": (0.2, 1.0), "Ti": (0.6, 5.0)}
_SCORED_PARTS = ("steps", "loads")  # in none of which a tuned MPC may be worse than the default design


@dataclass(frozen=True)
class Row:
    """One line of the comparison: a controller on one step or load, over the draws."""

    controller: str  # ``"baseline"``, ``"tuned"`` or ``"PI"``
    start: float  # [degC]
    target: float
    settle_mean_s: float  # NaN where it did not settle on some draw
    settle_worst_s: float
    overshoot_mean: float  # [degC], and the bias
    overshoot_worst: float
    bias_worst: float
    energy_mean_s: float  # over the draws
    travel_mean: float
    full_share: float
    bound_s: float  # before this no drive is in the band [s], mean over the draws; NaN of a load
    load: str = ""  # in words
    iae_mean: float = 0.0  # [degC s]

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON, None for what is not finite."""
        return {
            key: None if isinstance(value, float) and not np.isfinite(value) else value
            for key, value in vars(self).items()
        }


def rows_of(name: str, results: Sequence[StepResult], bounds: Bounds) -> list[Row]:
    """Return a controller's rows, one a step or load."""
    of_case: dict[Any, list[StepResult]] = {}
    for result in results:
        if not result.case.lacks:
            of_case.setdefault((result.case.step, result.case.load), []).append(result)
    return [_score_row(name, part, bounds) for part in of_case.values()]


def _score_row(name: str, part: Sequence[StepResult], bounds: Bounds) -> Row:
    def mean(figure: str) -> float:
        return float(np.mean([getattr(result, figure) for result in part]))

    def most(figure: str) -> float:
        return float(np.max([getattr(result, figure) for result in part]))

    first, draws = part[0].case, [result.case.draw for result in part]
    return Row(
        controller=name,
        start=first.start,
        target=first.target,
        settle_mean_s=mean("settle_s"),
        settle_worst_s=most("settle_s"),
        overshoot_mean=mean("overshoot"),
        overshoot_worst=most("overshoot"),
        bias_worst=max((result.bias for result in part), key=abs),
        energy_mean_s=mean("energy_s"),
        travel_mean=mean("travel"),
        full_share=mean("full_share"),
        bound_s=np.nan if first.load else float(np.mean([bounds[(*first.step, k)] for k in draws])),
        load=first.load.words if first.load else "",
        iae_mean=mean("iae"),
    )


@dataclass(frozen=True)
class Trial:
    """One design that was tried, over all trials."""

    controller: str  # ``"MPC"`` or ``"PI"``
    parameters: dict[str, float]  # factors of the default design, or of SIMC
    score: float  # lower is better, see :mod:`thermogrip.mpc.tuning.objective`
    results: tuple[StepResult, ...] = field(default=(), repr=False)


@dataclass(frozen=True)
class Tuning:
    """What the tuner found.

    Attributes
    ----------
    controller : Controller or PIController
        The best one of all kinds.
    verdict : str
        ``"improved"``, ``"flat"``, or ``"actuator-limited"``: change the hardware or the spec, not weights.
    finding : str
        Which controller is best and by how much, and the verdict in numbers, a few sentences.
    rows : tuple of Row
        Baseline, tuned and PI side by side, step by step and load by load, on the same draws.
    scores : dict of str to float
        By controller, on those draws; lower is better.
    history : tuple of Trial
        Every design that was tried.
    checks : tuple of Check
        What :func:`~thermogrip.mpc.tuning.design_review.review` finds in the controller.
    runs : dict of str to ClosedLoop
        One closed loop a step or load and controller, on one draw, for figures: ``"28 to 38, MPC"``.
    spec : Spec
    seed : int
    interrupted : bool
        Whether Ctrl-C ended the search; then all figures are of the search's draws.
    """

    controller: Controller | PIController
    verdict: str
    finding: str
    rows: tuple[Row, ...]
    scores: dict[str, float]
    history: tuple[Trial, ...]
    checks: tuple[Check, ...]
    runs: dict[str, ClosedLoop]
    spec: Spec
    seed: int
    interrupted: bool = False

    @property
    def meets_spec(self) -> bool:
        """Whether no check of the controller's review fails."""
        return passes(self.checks)

    def save(self, path: str | Path) -> Path:
        """Write the controller with what was found about it, and return the path."""
        return self.controller.save(path)


def tune(
    plant: Plant, spec: Spec | None = None, *, progress: Progress | None = None, seed: int = 0
) -> Tuning:
    """Return the best controller found for a spec, MPC or PI.

    Parameters
    ----------
    plant : Plant
        With its uncertainty where it has any: draws of it close the loop.
    spec : Spec, optional
        What is wanted; where absent, :meth:`Spec.of` the plant.
    progress : callable, optional
        Called with (fraction done, what is being done and the best so far).
    seed : int, optional
        Of the noise.

    Raises
    ------
    UserError
        If the spec does not fit the plant, the plant cannot be controlled, or no target can be reached.
    KeyboardInterrupt
        If it comes before there is a first answer; later the best so far is returned.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> from thermogrip.mpc import Spec
    >>> spec = Spec(steps=[(25.0, 35.0)], sample_time_s=5.0, output="t1", hold_s=200.0, evaluations=3)
    >>> found = tune(plant, spec)
    >>> sorted(found.scores), found.interrupted
    (['PI', 'baseline', 'tuned'], False)
    """
    show = progress or (lambda share, what: None)
    show(0.0, "what the plant can do")
    spec = Spec.of(plant) if spec is None else spec
    if plant.samples is not None:  # those that the controller's file will have, which its review tries
        plant = replace(plant, samples=thin(plant.samples, KEPT_DRAWS))
    bench = Bench(spec.widened(plant), spec, seed, show)
    tried: list[Trial] = []
    try:
        _search_designs(bench, tried, show)
        candidates = _best_of_each_kind(bench, tried)
        results = _compare_on_unseen(bench, candidates, show)
        interrupted = False
    except KeyboardInterrupt:
        if {trial_so_far.controller for trial_so_far in tried} != set(bench.ranges):
            raise
        candidates = _best_of_each_kind(bench, tried)
        results = {name: list(trial_so_far.results) for name, trial_so_far in candidates.items()}
        interrupted = True
    return _tuning(bench, tried, candidates, results, interrupted, show)


class Bench:
    """A plant and the trials on which its controllers are compared."""

    def __init__(self, plant: Plant, spec: Spec, seed: int, show: Progress) -> None:
        self.plant = plant
        self.spec = spec
        self.seed = seed
        self.draws = draws_of(plant, spec.search_draws)
        self.unseen, self.check_seed = judged_draws(plant, spec.check_draws), judged_seed(plant, seed)
        self.baseline = spec.design(plant)
        draws = sorted({*self.draws, *self.unseen})
        self.bounds = bounds_of(plant, self.baseline, spec, draws)
        controlled = self.baseline.controlled
        self.lacking = list(lacking(plant, spec, controlled))
        self.loads = loads_of(plant, spec, self.baseline)
        self.load_s = load_seconds(self.baseline)
        unseen_delay = max(apparent_delays(plant, controlled)) < 2 * plant.dt
        self.ranges = {"MPC": MPC_PARAMETERS}  # of the kinds that are searched
        if self.baseline.loops and not unknown_to_pi(spec):
            self.ranges["PI"] = PI_OF_UNSEEN_DELAY if unseen_delay else PI_PARAMETERS
        show(0.5 * SEARCH.scaled, "compiling the trials")
        self._c = Controller(plant, self.baseline).c  # in whose library trials of PI loops can run
        show(0.7 * SEARCH.scaled, "default design and the PI by SIMC")
        self.default: Score | None = None  # of the default design, on the search's draws
        self.lengths = self._lengths(draws)
        self.scales = self._scales()

    def _lengths(self, draws: Sequence[int]) -> dict[tuple[float, float], float]:
        """Return how long each step is run [s]."""
        made = self.made("MPC", self.baseline)
        results = run_trials(made, self.plant, self.spec, steps_on(self.spec, draws), seed=self.seed)
        least, most = min(self.load_s, self.spec.hold_s), self.spec.hold_s
        lengths = {}
        for step in self.spec.steps:
            slowest = np.max([result.settle_s for result in results if result.case.step == step])  # or NaN
            lengths[step] = float(np.clip(2 * np.nan_to_num(slowest, nan=most), least, most))
        return lengths

    def _scales(self) -> Scales:
        """Return what trials count in, of all draws."""
        moves: dict[Case, float] = {}
        iae: dict[Case, float] = {}
        for draws, seed in ((self.draws, self.seed), (self.unseen, self.check_seed)):
            for kind, design in (("PI", self.design("PI", {})), ("MPC", self.baseline)):
                for result in self.run(kind, design, draws, seed):
                    if result.case.lacks:
                        continue
                    key = result.case.key
                    iae[key] = min(result.iae, iae.get(key, np.inf))
                    if kind == "MPC" and np.isfinite(result.settle_s) and result.travel > 0:
                        moves[key] = result.travel
        return Scales(self.bounds, moves, iae)

    def design(self, kind: str, parameters: Mapping[str, float]) -> Design:
        """Return the design of an ``"MPC"`` or ``"PI"``; parameters that are not named stay."""
        base = self.baseline
        if kind == "PI":
            loops = tuple(
                replace(
                    loop,
                    Kc=parameters.get("Kc", 1.0) * loop.Kc,
                    Ti=parameters.get("Ti", 1.0) * loop.Ti,
                    setpoint=parameters.get("setpoint", 1.0),
                )
                for loop in base.loops
            )
            return replace(base, loops=loops)
        drift = parameters.get("bias", 1.0)
        noise = replace(
            base.noise,
            state=parameters.get("state", 1.0) * base.noise.state,
            load={name: parameters.get("state", 1.0) * sd for name, sd in base.noise.load.items()},
            drive={name: drift * sd for name, sd in base.noise.drive.items()},
            output=drift * base.noise.output,
        )
        return replace(
            base,
            noise=noise,
            move=parameters.get("move", 1.0) * base.move,
            terminal=parameters.get("terminal", 1.0) * base.terminal,
            overshoot=parameters.get("overshoot", 1.0) * base.overshoot,
        )

    def made(self, kind: str, design: Design) -> Controller | PIController:
        """Return a controller whose trials run in C where there is one."""
        return made_for_trials(kind, self.plant, design, c=self._c)

    def run(self, kind: str, design: Design, draws: Sequence[int], seed: int) -> list[StepResult]:
        """Return the results on these draws, what the plant lacks on the first alone."""
        cases = [
            replace(case, seconds=self.lengths[case.start, case.target])
            for case in steps_on(self.spec, draws)
        ]
        for words in self.lacking:  # which settle later
            cases += steps_on(self.spec, draws[:1], words)
        cases += self.loads_on(draws)
        return run_trials(self.made(kind, design), self.plant, self.spec, cases, seed=seed)

    def loads_on(self, draws: Sequence[int]) -> list[Case]:
        """Return every load on these draws."""
        target = self.spec.steps[0][1]
        return [
            Case(target, target, draw, load=load, seconds=self.load_s)
            for load in self.loads
            for draw in draws
        ]

    def evaluate(self, kind: str, parameters: Mapping[str, float]) -> Trial:
        """Return the trial of a design on the search's draws."""
        design, results = self.design(kind, parameters), []
        for noise in range(COSTS.noises):
            results += self.run(kind, design, self.draws, self.seed + noise)
        parts_of_score = score(results, self.spec, self.scales)
        cost = parts_of_score.total
        if kind == "MPC":
            self.default = self.default or parts_of_score  # which comes first
            worse = (
                getattr(parts_of_score, name) > (1 + SEARCH.worse) * getattr(self.default, name)
                for name in _SCORED_PARTS
            )
            cost = np.inf if any(worse) else cost
        return Trial(controller=kind, parameters=dict(parameters), score=float(cost), results=tuple(results))


def _search_designs(bench: Bench, tried: list[Trial], show: Progress) -> None:
    """Try designs of MPC and PI, into ``tried``; the defaults of both first."""
    most = bench.spec.evaluations
    ranges = bench.ranges
    counts = dict.fromkeys(ranges, 0)

    def evaluate(kind: str, parameters: Mapping[str, float]) -> Trial:
        tried.append(bench.evaluate(kind, parameters))
        counts[kind] += 1
        best = min(tried, key=lambda each: each.score)
        share = sum(counts.values()) / (most * len(ranges))
        words = f"{kind}: design {counts[kind]}; best so far: {best.controller}, score {best.score:.3f}"
        show(SEARCH.scaled + (SEARCH.searched - SEARCH.scaled) * share, words)
        return tried[-1]

    first = {kind: evaluate(kind, dict.fromkeys(limits, 1.0)) for kind, limits in ranges.items()}
    for kind, limits in ranges.items():
        minimise(partial(evaluate, kind), first[kind], limits, most - 1)


def minimise(
    evaluate: Callable[[Mapping[str, float]], Trial],
    first: Trial,
    limits: Mapping[str, tuple[float, float]],
    most: int,
) -> None:
    """Evaluate at most so many designs on the way down from a first one."""
    import nlopt

    names, (low, high) = list(limits), np.log(list(limits.values())).T
    start = np.log([first.parameters[name] for name in names])

    def cost(z: Array, gradient: Array) -> float:
        if np.array_equal(z, start):
            return first.score
        return evaluate(dict(zip(names, np.exp(z).tolist(), strict=True))).score

    if most < 1:
        return
    # J. A. Nelder, R. Mead, "A simplex method for function minimization", Computer Journal 7(4), 1965
    search = nlopt.opt(nlopt.LN_NELDERMEAD, len(names))
    search.set_min_objective(cost)
    search.set_lower_bounds(low)
    search.set_upper_bounds(high)
    search.set_initial_step(np.full(len(names), np.log(SEARCH.first_factor)))
    search.set_xtol_abs(np.log(SEARCH.last_factor))
    search.set_maxeval(most + 1)
    search.optimize(start)


def _best_of_each_kind(bench: Bench, tried: Sequence[Trial]) -> dict[str, Trial]:
    """Return the default design, the best MPC and the best PI."""
    of: dict[str, list[Trial]] = {kind: [t for t in tried if t.controller == kind] for kind in ("MPC", "PI")}
    best = {kind: min(trials, key=lambda each: each.score) for kind, trials in of.items() if trials}
    candidates = {"baseline": of["MPC"][0], "tuned": best["MPC"]}
    return candidates | ({"PI": best["PI"]} if "PI" in best else {})


def _compare_on_unseen(
    bench: Bench, candidates: Mapping[str, Trial], show: Progress
) -> dict[str, list[StepResult]]:
    """Return the results of the candidates on draws that the search has not seen."""
    results: dict[str, list[StepResult]] = {}
    for name, of in candidates.items():
        show(
            SEARCH.searched + (SEARCH.compared - SEARCH.searched) * len(results) / len(candidates),
            f"comparison: {name}",
        )
        design = bench.design(of.controller, of.parameters)
        results[name] = bench.run(of.controller, design, bench.unseen, bench.check_seed)
    return results


def _tuning(
    bench: Bench,
    tried: Sequence[Trial],
    candidates: Mapping[str, Trial],
    results: Mapping[str, list[StepResult]],
    interrupted: bool,
    show: Progress,
) -> Tuning:
    """Return what was found, with the best of the candidates for its controller."""
    spec, scored = bench.spec, {n: score(part, bench.spec, bench.scales) for n, part in results.items()}
    scores = {name: part.total for name, part in scored.items()}
    certain = bench.draws == [0]
    eligible = may_be_saved(results, certain=certain)
    saved = kept_of(scores, eligible)
    rows = tuple(row for name, part in results.items() for row in rows_of(name, part, bench.bounds))
    kept_rows = [row for row in rows if row.controller == saved and not row.load]
    least = min(scores[saved], scores["tuned"] if "tuned" in eligible else np.inf)
    verdict, words = verdict_of(spec, least, scores["baseline"], kept_rows)
    where = "on the search's own draws" if interrupted else "on unseen draws"
    if certain and not interrupted:
        where = "under fresh noise (no draws of the plant confirm a tuned MPC, so none is saved)"
    finding = f"{best_of(scored, eligible, where, unknown_to_pi(spec))} {words}"
    if interrupted:
        finding = f"Interrupted after {len(tried)} designs; this is the best of them. {finding}"
    notes = {
        "verdict": verdict,
        "finding": finding,
        "scores": scores,
        "spec": spec.model_dump(mode="json"),
        "seed": bench.seed,
        "rows": [row.to_dict() for row in rows],
    }
    controller = _final(bench, candidates, saved, notes)
    show(SEARCH.compared, "review")
    checks = tuple(review(controller))
    controller.notes["meets_spec"] = passes(checks)
    return Tuning(
        controller=controller,
        verdict=verdict,
        finding=finding,
        rows=rows,
        scores=scores,
        history=tuple(tried),
        checks=checks,
        runs={} if interrupted else _runs_as_used(bench, candidates, controller),
        spec=spec,
        seed=bench.seed,
        interrupted=interrupted,
    )


def _final(
    bench: Bench, candidates: Mapping[str, Trial], kept: str, notes: dict[str, Any]
) -> Controller | PIController:
    """Return the controller to save; the best PI also takes over when an MPC's optimiser fails."""
    best = candidates[kept]
    design = bench.design(best.controller, best.parameters)
    if best.controller == "PI":
        return PIController(bench.plant, design, notes=notes)
    if "PI" in candidates:
        design = replace(design, loops=bench.design("PI", candidates["PI"].parameters).loops)
    return Controller(bench.plant, design, notes=notes)


def may_be_saved(results: Mapping[str, Sequence[StepResult]], *, certain: bool) -> set[str]:
    """Return which settled at each target; a tuned MPC beside a default one where draws confirm it."""
    names = {
        name
        for name, part in results.items()
        if all(np.isfinite(result.settle_s) for result in part if not result.case.load)
    }
    # of a plant that is certain the search has seen all that the comparison shows, but for its noise
    return names - {"tuned"} if certain and "baseline" in names else names


def kept_of(scores: Mapping[str, float], eligible: Collection[str]) -> str:
    """Return which controller is saved: a tuned MPC only where it wins what counts, a PI where it is best."""
    # where draws differ so much that nothing settles on some of them, scores compare failures
    won = scores["tuned"] < (1 - SEARCH.won) * scores["baseline"]
    mpc = "tuned" if won and "tuned" in eligible else "baseline"
    return "PI" if "PI" in eligible and scores.get("PI", np.inf) < scores[mpc] else mpc


def unknown_to_pi(spec: Spec) -> list[str]:
    """Return what a spec asks for that a PI does not know: the MPC is taken there."""
    wishes = {
        "zones": spec.zones,
        "energy prices": spec.energy_price,
        "limits of outputs": spec.limits,
        "ramps": spec.ramp_per_s,
        "a heater and a cooler": pairs_of_drives(spec.relays or {}),
    }
    return [wish for wish, value in wishes.items() if value]


def best_of(
    parts: Mapping[str, Score], eligible: Collection[str], where: str, unknown: Sequence[str] = ()
) -> str:
    """Return the sentence that names the best controller, by how much, and where the other kind loses."""
    scores = {name: part.total for name, part in parts.items()}
    kept, mpc = kept_of(scores, eligible), kept_of(scores, {*eligible} - {"PI"})
    words = {"baseline": "default MPC", "tuned": "tuned MPC", "PI": "PI"}[kept]
    if "PI" not in parts:
        because = f"a PI does not know {', '.join(unknown)}" if unknown else "no PI can be made"
        return f"The {words} is what is saved: {because}."
    if scores["PI"] < scores[kept]:
        return f"The {words} is what is saved: the PI, which scores less, does not settle in every trial."
    other, loser = (mpc, "MPC") if kept == "PI" else ("PI", "PI")
    share = 100 * (1 - scores[kept] / scores[other])
    costs = {name: (getattr(parts[other], name), getattr(parts[kept], name)) for name in _SCORED_PARTS}
    worst = max(costs, key=lambda name: costs[name][0] - costs[name][1])
    loses = f"loses most on {worst} ({costs[worst][0]:.2f} for {costs[worst][1]:.2f})"
    saved = f"The {words} is best and is what is saved"
    return f"{saved}: it scores {share:.0f} % better than the best {loser} {where}, which {loses}."


def verdict_of(spec: Spec, least: float, default: float, rows: Sequence[Row]) -> tuple[str, str]:
    """Return the verdict, and its reason in a sentence from the kept controller's rows of steps."""
    slowest = max(rows, key=lambda row: row.bound_s)
    if slowest.bound_s > spec.settle_within_s:
        step, needs = f"{slowest.start:g} to {slowest.target:g}", f"takes at least {slowest.bound_s:.0f} s"
        needs = needs if np.isfinite(slowest.bound_s) else "cannot be reached"
        asked = f"{spec.settle_within_s:g} s are asked"
        return "actuator-limited", f"{step} {needs} at this drive, and {asked}: no weight changes that."
    won = 1 - least / default
    ratio = float(np.mean([row.settle_mean_s / max(row.bound_s, 1.0) for row in rows]))
    if won > SEARCH.won:
        return "improved", f"Its score is {100 * won:.0f} % below the default design's."
    if ratio <= SEARCH.near:
        return "actuator-limited", f"Tuning wins {100 * won:.1f} %: the drive is the limit."
    few = f"less than the {100 * SEARCH.won:.0f} % that count"
    return "flat", f"Tuning wins {100 * won:.1f} %, {few}."


def _runs_as_used(
    bench: Bench, candidates: Mapping[str, Trial], controller: Controller | PIController
) -> dict[str, ClosedLoop]:
    """Return every step and load on one unseen draw, of what is saved and of the best of the other kind."""
    saved = "PI" if isinstance(controller, PIController) else "MPC"
    designs = {saved: controller.design}
    if other := candidates.get("tuned" if saved == "PI" else "PI"):
        designs[other.controller] = bench.design(other.controller, other.parameters)
    draws = bench.unseen[:1]
    cases = {f"{case.start:g} to {case.target:g}": case for case in steps_on(bench.spec, draws)}
    cases |= {case.load.words: case for case in bench.loads_on(draws) if case.load}
    return {
        f"{title}, {kind}": trial(
            bench.made(kind, design), bench.plant, bench.spec, case, seed=bench.check_seed
        )
        for title, case in cases.items()
        for kind, design in designs.items()
    }
