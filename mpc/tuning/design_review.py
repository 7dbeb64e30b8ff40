r"""Design review: what would go wrong with this controller, found before the rig finds it.

Each check passes, warns or fails, with its numbers and the fix (``docs/explanation/mpc.md`` lists them).
None needs the rig.  What a loop does is found by running it, on the plant and on draws of it: every step of
the spec, the loads that a tuning tries (:mod:`thermogrip.mpc.tuning.objective`), and the first step on plants
that have what the model lacks.  Limits of outputs that the steps must break, and a gain that changes its
sign, are seen there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import Spec, spec_from_dict
from thermogrip.mpc.plant.prediction import holding_drive
from thermogrip.mpc.tuning.objective import (
    Case,
    StepResult,
    judged_draws,
    judged_seed,
    lacking,
    load_seconds,
    loads_of,
    made_for_trials,
    meets_spec,
    run_trials,
    steps_on,
)
from thermogrip.sysid.plant.plant import said_not_good

#: A controller of any kind.
Reviewed: TypeAlias = Controller | PIController
_RANK = {"pass": 0, "warn": 1, "fail": 2}
_FAR_BEYOND = 3.0  # bands
_BARELY_BEYOND = 0.01  # of the range of the logs, outside of it
#: What a plant may have that its model lacks, where the spec does not state it: see the keys of a spec.
_DOUBTS = {"extra_lag": 0.5, "extra_delay": 0.5, "lost_gain": 0.15}


@dataclass(frozen=True)
class Check:
    """One finding of the review.

    Attributes
    ----------
    name : str
    verdict : str
        ``"pass"``, ``"warn"`` or ``"fail"``.
    finding : str
        With numbers.
    fix : str
        What to do; empty where it passes.
    """

    name: str
    verdict: str
    finding: str
    fix: str = ""


def _graded(
    name: str, finding: str, *, fail: tuple[bool, str] = (False, ""), warn: tuple[bool, str] = (False, "")
) -> Check:
    """Return the check of a finding that fails, else warns, where the condition holds, with its fix."""
    for verdict, (holds, fix) in (("fail", fail), ("warn", warn)):
        if holds:
            return Check(name, verdict, finding, fix)
    return Check(name, "pass", finding)


def review(
    controller: Reviewed,
    *,
    wanted: tuple[float, float] | None = None,
    rooms: Sequence[float] | None = None,
    draws: int | None = None,
) -> list[Check]:
    """Return the findings about a controller's design; one that was tuned meets its spec where none fails.

    Parameters
    ----------
    controller : Controller or PIController
    wanted : (float, float), optional
        The range of targets [degC]; by default that of its spec's steps, else what the logs showed.
    rooms : sequence of float, optional
        Room temperatures in which the range must be reachable [degC]; by default the design's, and those of
        the logs are tried.
    draws : int, optional
        Draws, besides the plant itself, that close the loop; by default those of its tuning, else 2.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> from thermogrip.mpc import design_controller
    >>> found = review(design_controller(plant, dt=5.0), wanted=(30.0, 60.0), draws=1)
    >>> for check in found:
    ...     if check.verdict != "pass":
    ...         print(check.verdict, check.name)
    warn settles where the model lacks structure
    warn targets lie where the logs were
    """
    spec, noted = spec_of(controller, wanted)
    steps = np.array(spec.steps)
    targets = steps[:, 1] if noted else steps
    span = (float(targets.min()), float(targets.max())) if wanted is None else wanted
    plant, seed = controller.plant, controller.notes.get("seed")
    count = draws if draws is not None else spec.check_draws if noted else 2
    judged = sorted({0, *judged_draws(plant, count)})
    noise = judged_seed(plant, seed if isinstance(seed, int) else 0)
    return [
        reachable(controller, spec, span, rooms),
        meets_each_step(controller, spec, judged, noise, noted=noted),
        after_loads(controller, spec, judged[:3]),
        lacks_structure(controller, spec, judged[-1], noise, noted=noted),
        valid_range(controller, span),
        plant_is_good(controller),
    ]


def spec_of(controller: Reviewed, wanted: tuple[float, float] | None) -> tuple[Spec, bool]:
    """Return the spec that the controller was tuned for, else a step; and whether there was one."""
    notes = controller.notes.get("spec")
    if isinstance(notes, Mapping):
        # a file that tells every default may have one that is longer than its steps, or a key that is gone
        long = "settle_within_s" in notes and notes["settle_within_s"] > notes.get("hold_s", np.inf)
        known = Spec.model_fields.keys() - ({"settle_within_s"} if long else set())
        return spec_from_dict({key: value for key, value in notes.items() if key in known}), True
    low, high = wanted or controller.plant.valid.get(controller.controlled[0], (20.0, 40.0))
    return Spec(steps=[(low, max(low + 1.0, high))], relays=controller.design.relays or None), False


def passes(checks: Iterable[Check]) -> bool:
    """Return whether no check fails."""
    return all(check.verdict != "fail" for check in checks)


def settle_limit_s(controller: Reviewed) -> float:
    """Return after how long a target is given up [s]: twice what the spec allows a step, which may be
    shorter; where there is none, the spec that would be taken of the plant."""
    spec, noted = spec_of(controller, None)
    return 2 * (spec if noted else Spec.of(controller.plant)).settle_within_s


def meets_each_step(
    controller: Reviewed, spec: Spec, draws: Sequence[int], seed: int, *, noted: bool
) -> Check:
    """Every step of the spec must be as asked on the plant and on draws; nothing fails that nobody asked
    for."""
    cases = steps_on(spec, draws)
    results_of_all = run_trials(_fresh(controller), controller.plant, spec, cases, seed=seed)
    words, verdicts = [], []
    for step in spec.steps:
        results = [result for result in results_of_all if result.case.step == step]
        of_step = [_step_verdict(result, spec, noted=noted) for result in results]
        late = [float(np.nan_to_num(result.settle_s, nan=np.inf)) for result in results]
        worst_of = max(range(len(results)), key=lambda k: (_RANK[of_step[k][1]], late[k]))
        words.append(f"{step[0]:g} to {step[1]:g} degC: {of_step[worst_of][0]}")
        verdicts.append(of_step[worst_of][1])
    finding = f"the worst of {len(draws)}: {'; '.join(words)}" if len(draws) > 1 else "; ".join(words)
    fix = "ask for less, or identify on logs in which the drive is held for longer, and tune again"
    name = "settles as asked where the model is right"
    return _graded(name, finding, fail=("fail" in verdicts, fix), warn=(set(verdicts) != {"pass"}, fix))


def after_loads(controller: Reviewed, spec: Spec, draws: Sequence[int]) -> Check:
    """After a load the loop must come back into the band: one that swings or keeps an offset does not."""
    plant, target = controller.plant, spec.steps[0][1]
    loads = loads_of(plant, spec, controller.design)
    seconds = 2 * load_seconds(controller.design)
    cases = [Case(target, target, draw, load=load, seconds=seconds) for load in loads for draw in draws]
    results = run_trials(_fresh(controller), plant, spec, cases)
    words = []
    for load in loads:
        of_load = [result for result in results if result.case.load == load]
        back = np.max([result.settle_s for result in of_load])  # NaN where one does not settle
        ends = f"back in {back:.0f} s" if np.isfinite(back) else f"not back after {seconds:.0f} s"
        words.append(f"{load.words}: {ends}, {max(result.overshoot for result in of_load):.2f} off at most")
    fix = "tune again: a load that stays must be met"
    lost = not all(np.isfinite(result.settle_s) for result in results)
    return _graded("comes back after a load", "; ".join(words), fail=(lost, fix))


def _fresh(controller: Reviewed) -> Reviewed:
    """Return the same controller for trials, which has not run."""
    kind = "PI" if isinstance(controller, PIController) else "MPC"
    return made_for_trials(kind, controller.plant, controller.design)


def lacks_structure(controller: Reviewed, spec: Spec, draw: int, seed: int, *, noted: bool) -> Check:
    """The spec's first step must settle on plants that have what their model lacks; nothing fails of what
    the spec does not state."""
    plant, controlled = controller.plant, controller.design.controlled
    doubts = {key: share for key, share in _DOUBTS.items() if not getattr(spec, key)}
    doubted, stated = spec.model_copy(update=doubts), lacking(plant, spec, controlled)
    start, target = spec.steps[0]
    cases = [Case(start, target, draw, structure) for structure in lacking(plant, doubted, controlled)]
    words, verdicts = [], []
    for result in run_trials(_fresh(controller), plant, doubted, cases, seed=seed):
        structure = result.case.lacks
        ends, verdict = _step_verdict(result, spec, noted=noted and structure in stated)
        words.append(f"{structure}: {ends}")
        verdicts.append(verdict if structure in stated else min(verdict, "warn", key=_RANK.__getitem__))
    fix = "identify on a log of the closed loop and tune again; a design that moves less tolerates more"
    finding = f"{start:g} to {target:g} degC, each alone: {'; '.join(words)}"
    name = "settles where the model lacks structure"
    return _graded(name, finding, fail=("fail" in verdicts, fix), warn=(set(verdicts) != {"pass"}, fix))


def _step_verdict(result: StepResult, spec: Spec, *, noted: bool = False) -> tuple[str, str]:
    """Return what a step did, in words, and graded: by the spec itself where that was ``noted``."""
    settled = bool(np.isfinite(result.settle_s))
    late = noted and not result.settle_s <= spec.settle_within_s
    over, off = result.overshoot / spec.overshoot_degC, abs(result.bias) / spec.bias_degC
    lost = not settled and max(abs(result.bias), result.overshoot) > _FAR_BEYOND * spec.band_degC
    figures = [
        f"settles in {result.settle_s:.0f} s" if settled else "never settles",
        f"overshoot {result.overshoot:.2f}",
        f"offset {result.bias:.2f}",
    ]
    gone = (late, over > 1, off > 1)
    limits = (f"{spec.settle_within_s:g} s", f"{spec.overshoot_degC:g}", f"{spec.bias_degC:g}")
    sentences = [figure + f" (asked {most})" * broken for figure, broken, most in zip(figures, gone, limits)]
    if noted:
        return ", ".join(sentences), "pass" if meets_spec(result, spec) else "fail"
    return ", ".join(sentences), "fail" if lost else "pass" if settled and not any(gone) else "warn"


def reachable(
    controller: Reviewed, spec: Spec, span: tuple[float, float], asked: Sequence[float] | None = None
) -> Check:
    """Each end of the wanted range [degC] must be held by a drive inside its limits, in every room [degC]
    that was asked for: else in the design's, and those of the logs are warned of."""
    design, model, plant = controller.design, controller.model, controller.plant
    low, high = np.array([design.drive_range[name] for name in model.drives]).T
    required = [design.ambient] if asked is None else asked
    rooms = list(required if model.rooms.any() else required[:1])
    for name in model.disturbances if asked is None else ():
        rooms += np.round(plant.valid.get(name, ()) if plant.is_room(name) else (), 1).tolist()
    rooms = list(dict.fromkeys(rooms))
    missed, missed_elsewhere, barely_held = list[str](), list[str](), list[str]()
    for room in rooms:
        out_of_reach = missed if room in required else missed_elsewhere
        for target in span:
            d = model.undisturbed(room)
            holding = holding_drive(model, design.controlled, np.full(len(design.controlled), target), d)
            outside = np.any(holding.u < low - 1e-6) or np.any(holding.u > high + 1e-6)
            text = f"{target:g} degC in a room of {room:g} degC"
            if not np.isfinite(holding.y).all():
                out_of_reach.append(f"{text} (nothing comes to rest)")
            elif holding.miss > spec.bias_degC:
                out_of_reach.append(f"{text} (misses by {holding.miss:.1f} degC)")
            elif outside:
                out_of_reach.append(f"{text} (needs a drive of {', '.join(f'{u:.2f}' for u in holding.u)})")
            elif np.any(np.minimum(holding.u - low, high - holding.u) < 0.03 * model.span):
                barely_held.append(text)
    name = "targets can be held in steady state"
    if missed or missed_elsewhere:
        fix = "narrow the targets, widen drive_limits, or let the rig heat or cool more"
        finding = f"out of reach: {', '.join(missed + missed_elsewhere)}"
        return Check(name, "fail" if missed else "warn", finding, fix)
    if barely_held:
        fix = "expect slow settling there, leave some drive in reserve"
        return Check(name, "warn", f"within 3 % of the drive's limit: {', '.join(barely_held)}", fix)
    others = zip(model.disturbances, model.undisturbed(rooms[0]).tolist(), model.rooms, strict=True)
    amid = [f"{name} of {d:.4g}" for name, d, room in others if not room]
    if model.rooms.any() or not amid:
        amid = [f"rooms of {', '.join(f'{r:g}' for r in rooms)} degC", *amid]
    return Check(name, "pass", f"{span[0]:g} to {span[1]:g} degC in {', '.join(amid)}")


def valid_range(controller: Reviewed, span: tuple[float, float]) -> Check:
    """A plant is known where its logs have been."""
    name, valid = "targets lie where the logs were", controller.plant.valid
    if not all(output in valid for output in controller.controlled):
        return Check(name, "warn", "the plant does not say where its logs were", "identify it again")
    beyond = dict.fromkeys(words for target in span for words in beyond_logs(controller, target))
    if beyond:
        fix = "record a log that goes there, or treat the result with care"
        return Check(name, "warn", "; ".join(beyond), fix)
    ends = [(output, *valid[output]) for output in controller.controlled]
    logged = (f"{output} was {low:.1f} to {high:.1f} degC in the logs" for output, low, high in ends)
    return Check(name, "pass", "; ".join(logged))


def plant_is_good(controller: Reviewed) -> Check:
    """What rests on a plant that its own logs contradict looks as sound as what rests on a good one."""
    name, verdict = "identify calls the plant good", controller.plant.verdict
    fix = "identify on longer logs, or on logs that excite it more, and tune again"
    answer = verdict.partition(". ")[0] or f"no verdict, of {len(controller.plant.logs)} logs"
    if said_not_good(verdict):
        return Check(name, "warn", answer, fix)
    return Check(name, "pass", answer)


def beyond_logs(
    controller: Reviewed, target: float | Mapping[str, float], *, grasps: bool = False
) -> list[str]:
    """Return a sentence for each thing that a session will do and the plant's logs have not done."""
    wanted = target if isinstance(target, Mapping) else dict.fromkeys(controller.controlled, float(target))
    sentences = []
    for output, value in wanted.items():
        low, high = controller.plant.valid.get(output, (-np.inf, np.inf))
        margin = _BARELY_BEYOND * (high - low)
        if not low - margin <= value <= high + margin:
            logged = f"{output} was {low:.1f} to {high:.1f} degC in them"
            sentences.append(
                f"{value:g} degC lies outside the logs that the plant was identified from: {logged}"
            )
    if grasps and controller.plant.valid.get("pump", (0.0, 1.0))[0] > 0:
        sentences.append(
            "the pump never stood in the logs that the plant was identified from: how its skin cools during "
            "a grasp is a guess; add a log in which it does"
        )
    return sentences
