r"""Design review: what would go wrong with this controller, found before the rig finds it.

Each check passes, warns or fails, with its numbers and the fix (``docs/explanation/mpc.md`` lists them).
None needs the rig.

**What the plant allows.**  The cold face of a Peltier element takes Q = S I T_c - I^2 R / 2 - K (T_h - T_c)
out, T_c in kelvin, which is largest at I* = S T_c / R; beyond it more current cools less.  Only S I and I^2 R
are identifiable from temperatures, so I* is given as a share of full drive, which needs no more.  With a
heatsink that warms up the whole plant turns over earlier still; that is what the check of the gain's sign
follows.

**What the loop does by itself.**  While no limit is near the controller is a linear system
(:mod:`thermogrip.mpc.controllers.linear_equivalent`) from readings to drives. Together with a plant x+ = A x
+ B u, y = C x + q, it is one matrix M.  Its eigenvalues must lie inside the unit circle, on the plant and on
draws of it; those of the observer alone are of F (I - L H).  With a constant offset q of an output, in
steady state s = (I - M)^-1 b q, the controlled output must be back at its target: that is what free of
offset means.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.closed_loop.simulate import simulate_closed_loop
from thermogrip.mpc.controllers.linear_equivalent import LinearLaw, linear_law, linear_move
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.spec import Asked, Spec, spec_from_dict
from thermogrip.mpc.estimator.observer import choose_disturbances, detectability_margin
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.native.design_struct import ITERATION_LIMIT
from thermogrip.mpc.optimiser.rti import Optimiser
from thermogrip.mpc.plant.prediction import PredictionModel, holding_drive, steady_curve, step_response
from thermogrip.mpc.tuning.objective import (
    STRUCTURE,
    StepResult,
    draws_of,
    lacking,
    results_of,
    run_trials,
    surroundings_of,
    trial,
)
from thermogrip.sysid.models.model import BlackBox

#: The verdict of a check that had nothing to try: it neither passes nor warns.
NOT_TRIED = "not tried"
_RANK = {"pass": 0, "warn": 1, "fail": 2}
_FAR_BEYOND = 3.0  # bands
_LONGEST_S = 3600.0  # for which an error of the observer may last, where no spec says how long a step may
_TRIED = 2  # draws, besides the plant itself, on which the spec's steps are run
_KELVIN = 273.15
_SLOW = 0.9995  # an eigenvalue beyond which a loop hardly settles
_PLAY = 0.02  # of a drive's range
_IDLE = 1e-4  # relative change of the move below which a doubled weight does nothing
_ILL, _LOST = 1e8, 1e12  # condition of the Hessian


@dataclass(frozen=True)
class Check:
    """One finding of the review.

    Attributes
    ----------
    name : str
    verdict : str
        ``"pass"``, ``"warn"`` or ``"fail"``; ``"not tried"`` where there was nothing to try.
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


def worst(checks: Sequence[Check]) -> str:
    """Return the worst verdict of a review."""
    rank: Callable[[str], int] = _RANK.__getitem__
    return max((check.verdict for check in checks if check.verdict in _RANK), key=rank, default="pass")


def review(
    controller: Controller,
    *,
    wanted: tuple[float, float] | None = None,
    rooms: Sequence[float] | None = None,
    draws: int = 5,
) -> list[Check]:
    """Return the findings about a controller's design.

    Parameters
    ----------
    controller : Controller
    wanted : (float, float), optional
        The range of targets [degC]; by default that of its spec's steps, else what the logs showed.
    rooms : sequence of float, optional
        Room temperatures in which the range must be reachable [degC]; by default 7 degC below and 5 above
        the design's.
    draws : int, optional
        Posterior draws on which the closed loop is checked.

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
    warn every weight does something
    warn settles where the model lacks structure
    warn targets lie where the logs were
    """
    starts, targets = _steps(controller)
    span = (min(targets), max(targets)) if wanted is None else wanted
    swing = (min(starts + targets), max(starts + targets)) if wanted is None else wanted
    loops, usual = loops_of(controller, draws), controller.design.ambient
    return [
        horizon(controller),
        reachable(controller, span, (usual - 7.0, usual + 5.0) if rooms is None else rooms),
        gain_sign(controller),
        peltier_optimum(controller, span, draws),
        detectable(controller),
        observer_stable(controller, loops[0], swing),
        offset_free(loops),
        eigenvalues(loops),
        hessian(controller),
        scaling(controller),
        weights(controller),
        room_to_move(controller),
        limits(controller, span),
        as_asked(controller, swing),
        lacks_structure(controller, swing),
        has_play(controller, swing),
        *_effort(controller, swing),
        _stand_in(controller),
        valid_range(controller, span),
        called_good(controller),
    ]


def _steps(controller: Controller) -> tuple[list[float], list[float]]:
    """Return where the spec's steps start and where they go, else the ends of what the logs showed."""
    spec = controller.notes.get("spec")
    steps = spec.get("steps", []) if isinstance(spec, Mapping) else []
    try:
        starts, targets = ([float(value) for value in ends] for ends in zip(*steps)) if steps else ([], [])
    except (TypeError, ValueError) as error:
        raise UserError("notes: spec: steps are no pairs of numbers", hint="tune again") from error
    if targets:
        return starts, targets
    low, high = controller.plant.valid.get(controller.controlled[0], (20.0, 40.0))
    return [], [float(low), float(high)]


def as_asked(controller: Controller, swing: tuple[float, float]) -> Check:
    """Where the model is right, on the plant itself and on draws of it, every step of the spec must settle as
    asked; of targets that nobody asked for nothing fails."""
    name, plant = "settles as asked where the model is right", controller.plant
    spec, noted = _spec_of(controller, swing)
    numbers = sorted({0, *draws_of(plant, _TRIED)})
    found = run_trials(Controller(plant, controller.design), plant, spec, numbers)
    seen, graded = [], []
    for step in spec.steps:
        of_step = [r for r in found if (r.start, r.target) == step]
        words, verdicts = zip(*(_stepped(r, spec.asked(r.output), timed=noted) for r in of_step))
        worst_of = max(range(len(of_step)), key=lambda k: (_RANK[verdicts[k]], _late(of_step[k])))
        seen.append(f"{step[0]:g} to {step[1]:g} degC: {words[worst_of]}")
        never = any(not np.isfinite(r.settle_s) for r in of_step)
        graded.append("fail" if never and noted else verdicts[worst_of])
    finding = f"the worst of {len(numbers)}: {'; '.join(seen)}" if len(numbers) > 1 else "; ".join(seen)
    fix = "ask for less, or identify on logs in which the drive is held for longer, and tune again"
    return _graded(name, finding, fail=("fail" in graded, fix), warn=(set(graded) != {"pass"}, fix))


def _spec_of(controller: Controller, swing: tuple[float, float]) -> tuple[Spec, bool]:
    """Return the spec that the controller was tuned for, and whether there is one: else a step over the
    swing."""
    noted = controller.notes.get("spec")
    if isinstance(noted, Mapping):
        # a file that tells every default may have one that is longer than its steps
        long = "settle_within_s" in noted and noted["settle_within_s"] > noted.get("hold_s", np.inf)
        return spec_from_dict({k: v for k, v in noted.items() if not (long and k == "settle_within_s")}), True
    return Spec(steps=[(swing[0], max(swing[0] + 1.0, swing[1]))]), False


def _late(result: StepResult) -> float:
    return float(np.nan_to_num(result.settle_s, nan=np.inf))


def lacks_structure(controller: Controller, swing: tuple[float, float]) -> Check:
    """A plant may have what its model lacks: the spec's first step, with each of that in turn, must settle
    without more overshoot and offset than the spec allows."""
    name, plant = "settles where the model lacks structure", controller.plant
    spec, stated = _spec_of(controller, swing)
    spec = spec.model_copy(update={"steps": spec.steps[:1]})
    tried = lacking(plant, spec, controller.controlled)
    numbers = [STRUCTURE * at + draws_of(plant, 1)[0] for at in range(1, len(tried) + 1)]
    found = run_trials(Controller(plant, controller.design), plant, spec, numbers)
    if not tried:
        return Check(name, NOT_TRIED, "the spec's extra_lag, extra_delay and lost_gain are 0")
    (start, target), words = spec.steps[0], [tried[r.draw // STRUCTURE - 1][0] for r in found]
    tests = [_stepped(r, spec.asked(r.output)) for r in found]
    seen = [f"{of}: {said}" for of, (said, _) in zip(words, tests, strict=True)]
    graded = [verdict for _, verdict in tests]
    move = controller.design.move
    fix = f"raise the move weight (now {move:.3g}), or identify on a log of the closed loop and tune again"
    finding = f"{start:g} to {target:g} degC, each alone: {'; '.join(seen)}"
    # of defaults that nobody asked for it is a warning
    failed = stated and "fail" in graded
    return _graded(name, finding, fail=(failed, fix), warn=(set(graded) != {"pass"}, fix))


def has_play(controller: Controller, swing: tuple[float, float]) -> Check:
    """A valve or a gear may have play that no log shows: behind a little of it every step of the spec must
    settle without more overshoot and offset than the spec allows.  Of what nobody stated nothing fails."""
    plant, controlled = controller.plant, controller.controlled
    spec, _ = _spec_of(controller, swing)
    around = replace(surroundings_of(spec, controlled, plant), play=_PLAY)
    loop = Controller(plant, controller.design)
    found = [trial(loop, plant, spec, step, 0, spec.hold_s, 0, around=around) for step in spec.steps]
    results = [r for run, step in zip(found, spec.steps) for r in results_of(run, spec, step, 0)]
    tests = [_stepped(r, spec.asked(r.output)) for r in results]
    seen = [f"{r.start:g} to {r.target:g} degC: {said}" for r, (said, _) in zip(results, tests)]
    fix = f"make moves cheaper (weight now {controller.design.move:.3g}), or use a valve or gear without play"
    finding = f"play of {100 * _PLAY:g} % of each drive's range: {'; '.join(seen)}"
    bad = any(verdict != "pass" for _, verdict in tests)
    return _graded("settles where drives have play", finding, warn=(bad, fix))


def _stepped(result: StepResult, asked: Asked, *, timed: bool = False) -> tuple[str, str]:
    """Return what a step did, in words, and graded: it fails where it never settles, and goes three bands too
    far or ends as far off; its time counts where an output has one of its own, or where ``timed``."""
    within = asked.within_s if timed else asked.pace_s
    settled = bool(np.isfinite(result.settle_s))
    late = not settled or bool(within and result.settle_s > within)
    over, off = result.overshoot / asked.overshoot_degC, abs(result.bias) / asked.bias_degC
    lost = not settled and max(abs(result.bias), result.overshoot) > _FAR_BEYOND * asked.band_degC
    name = f"{result.output} " if result.output else ""
    parts = [
        f"settles in {result.settle_s:.0f} s" if settled else "never settles",
        f"overshoot {result.overshoot:.2f}",
        f"offset {result.bias:.2f}",
    ]
    gone = (late and within > 0, over > 1, off > 1)
    limits = (f"{within:g} s", f"{asked.overshoot_degC:g}", f"{asked.bias_degC:g}")
    said = [part + f" (asked {most})" * broken for part, broken, most in zip(parts, gone, limits)]
    verdict = "fail" if lost else "warn" if late or over > 1 or off > 1 else "pass"
    return f"{name}{', '.join(said)}", verdict


class _Counted(Controller):
    """A controller that keeps the iterations of its steps."""

    iterations: tuple[int, ...] = ()

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample."""
        move = super().step(reading, target)
        self.iterations += (self.last_iterations,)
        return move


def _effort(controller: Controller, span: tuple[float, float]) -> list[Check]:
    """Measured on swings across the range and back, where the active set changes most."""
    fresh = _Counted(controller.plant, controller.design)
    ends = [dict.fromkeys(controller.controlled, end) for end in (span[1], span[0], span[1])]
    schedule = [(end, 40 * controller.dt) for end in ends]
    run = simulate_closed_loop(fresh, controller.plant, schedule, start=span[0])
    ms, dt, deadline = 1e3 * run.seconds[1:], controller.dt, controller.design.deadline_s
    p99, slowest = float(np.percentile(ms, 99)), float(np.max(ms))
    finding = (
        f"{len(ms)} steps on swings across the range: median {float(np.median(ms)):.1f} ms, "
        f"p99 {p99:.1f} ms, slowest {slowest:.1f} ms; deadline {1e3 * deadline:.0f} ms, sample {dt:g} s"
    )
    time = _graded(
        "step time fits the sample time",
        finding,
        fail=(slowest > 1e3 * deadline, "shorten the horizon, take fewer blocks or sample more slowly"),
        warn=(p99 > 250 * dt, "leave more time: another process may take the processor"),
    )
    return [time, _iterations(controller, fresh.iterations)]


def _iterations(controller: Controller, counted: Sequence[int]) -> Check:
    name, limit = "QP ends long before its limit", ITERATION_LIMIT
    rows = 2 * controller.optimiser.n_b * controller.model.n_u
    soft = len(controller.optimiser.qp.soft) - rows
    finding = f"{rows} hard and {soft} soft rows; at most {max(counted)} iterations of {limit} allowed"
    late = "take fewer blocks or fewer limits: the worst case may not end in time"
    return _graded(
        name,
        finding,
        fail=(max(counted) >= limit, "take fewer blocks, a shorter horizon, or fewer limits"),
        warn=(max(counted) > limit // 4, late),
    )


def _stand_in(controller: Controller) -> Check:
    """Where the optimiser fails the PI takes over; it must be there, and push the right way."""
    name, loops = "a PI controller takes over", controller.design.loops
    alone = [output for output in controller.controlled if output not in {loop.output for loop in loops}]
    said = "; ".join(f"{p.drive} by {p.output}: Kc {p.Kc:.3g}, Ti {p.Ti:.0f} s" for p in loops)
    if alone:
        fix = "tune again: a failing solver ends in off"
        return Check(name, "warn", f"{len(alone)} outputs without", fix)
    # by the step response, which an output that only adds up has too
    gains = [step_response(controller.plant, loop.drive, loop.output).gain for loop in loops]
    wrong = [loop.output for loop, gain in zip(loops, gains, strict=True) if gain * loop.Kc < 0]
    fix = f"tune again: the PI of {', '.join(wrong)} pushes the wrong way"
    return _graded(name, said, fail=(bool(wrong), fix))


def horizon(controller: Controller) -> Check:
    """The drive must be taken back while what it did has not arrived: the horizon has to see that far."""
    design = controller.design
    short, near, finding = False, False, []
    for output in design.controlled:
        answers = [step_response(controller.plant, drive, output) for drive in controller.model.drives]
        best = max(answers, key=lambda answer: abs(answer.gain))
        need, good = 2 * best.delay, min(4 * best.delay, best.delay + best.lag)
        needed = "four delays" if good < best.delay + best.lag else "delay and lag"
        finding.append(
            f"{output}: horizon {design.horizon_s:.0f} s, wanted {good:.0f} s: {needed} "
            f"(delay {best.delay:.0f} s, lag {best.lag:.0f} s)"
        )
        short, near = short or design.horizon_s < need, near or design.horizon_s < good
    fix = "lengthen the horizon to four delays (blocks), or sample more slowly"
    return _graded("horizon covers delay and lag", "; ".join(finding), fail=(short, fix), warn=(near, fix))


def reachable(controller: Controller, span: tuple[float, float], rooms: Sequence[float]) -> Check:
    """Each end of the wanted range [degC] must be held by a drive inside its limits, in every room [degC]."""
    design, model = controller.design, controller.model
    low, high = np.array([design.drive_range[name] for name in model.drives]).T
    missed, near = [], []
    for room in rooms if model.rooms.any() else rooms[:1]:
        for target in span:
            d = model.undisturbed(room)
            found = holding_drive(model, design.controlled, np.full(len(design.controlled), target), d)
            outside = np.any(found.u < low - 1e-6) or np.any(found.u > high + 1e-6)
            text = f"{target:g} degC in a room of {room:g} degC"
            if not np.isfinite(found.y).all():
                missed.append(f"{text} (nothing comes to rest)")
            elif found.miss > 0.05:
                missed.append(f"{text} (misses by {found.miss:.1f} degC)")
            elif outside:
                missed.append(f"{text} (needs a drive of {', '.join(f'{u:.2f}' for u in found.u)})")
            elif np.any(np.minimum(found.u - low, high - found.u) < 0.03 * model.span):
                near.append(text)
    name = "targets can be held in steady state"
    if missed:
        fix = "narrow the targets, widen drive_limits, or cool the heatsinks better"
        return Check(name, "fail", f"out of reach: {', '.join(missed)}", fix)
    if near:
        fix = "expect slow settling there, leave some drive in reserve"
        return Check(name, "warn", f"within 3 % of the drive's limit: {', '.join(near)}", fix)
    others = zip(model.disturbances, model.undisturbed(rooms[0]).tolist(), model.rooms, strict=True)
    amid = [f"{name} of {d:.4g}" for name, d, room in others if not room]
    if model.rooms.any() or not amid:
        amid = [f"rooms of {', '.join(f'{r:g}' for r in rooms)} degC", *amid]
    return Check(name, "pass", f"{span[0]:g} to {span[1]:g} degC in {', '.join(amid)}")


def _known(model: PredictionModel) -> tuple[Array, Array]:
    """Return the least and the most of each drive (n_u,) that is known: to a black box, of its logs."""
    if not isinstance(model.model, BlackBox):
        return model.lowest, model.highest
    low, high = np.array([model.plant.valid.get(name, (-np.inf, np.inf)) for name in model.drives]).T
    return np.maximum(model.lowest, low), np.minimum(model.highest, high)


def gain_sign(controller: Controller) -> Check:
    """A Peltier element cools less beyond its optimum current: dT/du changes sign there."""
    design, model = controller.design, controller.model
    name, d = "gain keeps its sign over the drive", model.undisturbed(design.ambient)
    seen, bad = [], []
    for drive, (low, high) in design.drive_range.items():
        curve = steady_curve(model, drive, design.controlled[0], d)
        if not np.isfinite(curve.y).any():
            finding = f"{drive}: {design.controlled[0]} comes to rest at no drive (it only adds up)"
            fix = "evaluate by the closed loops of tune: there is no steady state"
            return Check(name, "warn", finding, fix)
        least, most = (float(ends[model.drives.index(drive)]) for ends in _known(model))
        inside = [turn for turn in curve.turns if max(low, least) < turn < min(high, most)]
        seen.append(f"{drive}: {np.nanmin(curve.y):.1f} to {np.nanmax(curve.y):.1f} degC in steady state")
        if inside:
            bad.append(
                f"{drive} turns over at {', '.join(f'{turn:.2f}' for turn in inside)} of {low:g} to {high:g}"
            )
            seen.append(f"rising from {curve.rising[0]:.2f} to {curve.rising[1]:.2f}")
    fix = "set drive_limits to the rising part, or accept it: the prediction sees the turn, a PI does not"
    return _graded(name, "; ".join(bad + seen), warn=(bool(bad), fix))


def peltier_optimum(controller: Controller, span: tuple[float, float], draws: int) -> Check:
    """Beyond I* = S T_c / R a Peltier element cools less; the drive's range must end before."""
    name = "current stays below the Peltier optimum"
    elements = getattr(getattr(controller.plant.model, "network", None), "peltiers", {})
    if not elements:
        return Check(name, "pass", "no Peltier element: 0 to check")
    picked = [controller.plant, *(controller.plant.draw(k) for k in draws_of(controller.plant, draws) if k)]
    seen, beyond, near = [], [], []
    for key, element in elements.items():
        low = controller.design.drive_range[element.input][0]
        shares = []
        for plant in picked:
            value = plant.values
            gain = value[element.cooling_gain] if element.cooling_gain else 1.0
            best = value[element.seebeck] * (min(span) + _KELVIN) / value[element.resistance]
            shares.append(best / (value[element.current] * gain))
        least = min(shares)
        seen.append(f"{key}: I* at {-shares[0]:.2f} of {element.input} at {min(span):g} degC")
        if len(shares) > 1:
            seen[-1] += f", {-least:.2f} on the worst of {len(shares) - 1} draws"
        seen[-1] += f", its range ends at {low:g}"
        if -low > least:
            beyond.append(f"{element.input} = [{-0.8 * least:.2f}, ...]")
        elif -low > 0.9 * least:
            near.append(element.input)
    fix = "the last tenth of the current hardly cools: leave it out"
    if beyond:
        fix = f"set drive_limits: {', '.join(beyond)}"
    return _graded(name, "; ".join(seen), warn=(bool(beyond or near), fix))


def room_to_move(controller: Controller) -> Check:
    """Range and slew must neither exclude each other nor make every move a jump across the range."""
    design = controller.design
    excluded, slow, seen = False, False, []
    for name, (low, high) in design.drive_range.items():
        share = design.slew_per_s[name] * design.dt / (high - low)
        seen.append(f"{name}: {low:g} to {high:g}, {100 * share:.1f} % of it a sample")
        excluded, slow = excluded or not low <= 0 <= high, slow or share < 0.002
    return _graded(
        "hard limits leave room",
        "; ".join(seen),
        fail=(excluded, "let the drive range contain 0: that is where a failing loop goes"),
        warn=(slow, "raise slew_per_s: crossing the range takes over 500 samples"),
    )


def limits(controller: Controller, span: tuple[float, float]) -> Check:
    """A soft limit that the wanted range must break is a conflict, settled by penalty at every sample."""
    design, model = controller.design, controller.model
    name = "soft limits agree with the targets"
    if not design.limits:
        return Check(name, "pass", "no limits of outputs")
    d, broken = model.undisturbed(design.ambient), []
    for target in span:
        held = holding_drive(model, design.controlled, np.full(len(design.controlled), target), d)
        for output, (low, high) in design.limits.items():
            value = float(held.y[model.outputs.index(output)])
            if not low <= value <= high:
                broken.append(f"{output} is {value:.1f} degC when {target:g} degC is held")
    seen = ", ".join(f"{key} {range_text(low, high)} degC" for key, (low, high) in design.limits.items())
    if broken:
        return Check(name, "fail", f"{seen}: {'; '.join(broken)}", "widen the limits or narrow the targets")
    return Check(name, "pass", seen)


def range_text(low: float, high: float) -> str:
    """Return a range in words; an end that is open is left out."""
    if high >= LARGEST:
        return f"at least {low:g}"
    return f"at most {high:g}" if low <= -LARGEST else f"{low:g} to {high:g}"


def valid_range(controller: Controller, span: tuple[float, float]) -> Check:
    """A plant is known where its logs have been; half a degree beyond is forgiven."""
    name = "targets lie where the logs were"
    outside, seen = [], []
    valid = controller.plant.valid
    if not all(output in valid for output in controller.controlled):
        return Check(name, "warn", "the plant does not say where its logs were", "identify it again")
    for output in controller.controlled:
        low, high = valid[output]
        seen.append(f"{output} was {low:.1f} to {high:.1f} degC in the logs")
        outside += [
            f"{output} at {target:g} degC" for target in span if not low - 0.5 <= target <= high + 0.5
        ]
    if outside:
        fix = "record a log that goes there, or treat the result with care"
        return Check(name, "warn", f"{'; '.join(seen)}; beyond: {', '.join(outside)}", fix)
    return Check(name, "pass", "; ".join(seen))


def called_good(controller: Controller) -> Check:
    """What rests on a plant that its own logs contradict looks as sound as what rests on a good one."""
    name, verdict = "identify calls the plant good", controller.plant.verdict
    head, bad, why = verdict.partition("; not good: ")
    fix = "identify on longer logs, or on logs that excite it more, and tune again"
    if bad:
        return Check(name, "warn", f"{head}; not good: {why.split(';')[0]}", fix)
    head, good, _ = verdict.partition("; good for ")
    return Check(name, "pass", head if good else f"no verdict, of {len(controller.plant.logs)} logs")


def beyond_logs(
    controller: Controller, target: float | Mapping[str, float], *, grasps: bool = False
) -> list[str]:
    """Return a sentence for each thing that a session will do and the plant's logs have not done: targets
    [degC] outside them, a pump that stops for ``grasps``."""
    wanted = target if isinstance(target, Mapping) else dict.fromkeys(controller.controlled, float(target))
    said = []
    for output, value in wanted.items():
        low, high = controller.plant.valid.get(output, (-np.inf, np.inf))
        if not low - 0.5 <= value <= high + 0.5:
            seen = f"{output} was {low:.1f} to {high:.1f} degC in them"
            said.append(f"{value:g} degC lies outside the logs that the plant was identified from: {seen}")
    if grasps and controller.plant.valid.get("pump", (0.0, 1.0))[0] > 0:
        said.append(
            "the pump never stood in the logs that the plant was identified from: how its skin cools during "
            "a grasp is a guess; add a log in which it does"
        )
    return said


def detectable(controller: Controller) -> Check:
    """Where the gain of a drive is small its bias can hardly be seen, so the test is made over the range."""
    name, model = "disturbances are detectable", controller.model
    if not controller.design.offset_free:
        fix = "set offset_free"
        return Check(name, "fail", "no disturbance states: the loop ends off its target", fix)
    chosen = choose_disturbances(model, controller.controlled, ambient=controller.design.ambient)
    d = model.undisturbed(controller.design.ambient)
    scale = np.array([0.01 if label.startswith("input") else 1.0 for label in chosen.names])
    margins, (low, high) = [], _known(model)
    for share in (0.1, 0.3, 0.5, 0.7, 0.9):
        u = low + share * (high - low)
        _, A, B, E = model.linearise(model.steady_state(u, d), u, d)
        into = B @ (chosen.on_drive * model.span[:, None]) + E @ chosen.on_disturbance
        margins.append(
            detectability_margin(A, model.C, into, chosen.on_output, scale=scale)
            if np.isfinite(A).all()
            else 0.0
        )
    finding = (
        f"{', '.join(chosen.names)}; 1 % of the drive or 1 degC shows as {min(margins):.2f} "
        f"to {max(margins):.2f} degC"
    )
    return _graded(
        name,
        finding,
        fail=(min(margins) <= 1e-6, "narrow drive_limits to where the gain keeps its sign"),
        warn=(min(margins) < 0.02, "expect slow removal of offsets where the gain is small"),
    )


def hessian(controller: Controller) -> Check:
    """A double has 16 digits: a Hessian of condition 1e8 takes half of them from the answer."""
    H, _, _ = linear_move(controller)
    values = np.linalg.eigvalsh(H)
    condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
    name, finding = "QP is well conditioned", f"{H.shape[0]} unknowns, condition {condition:.1e}"
    return _graded(
        name,
        finding,
        fail=(values[0] <= 0 or condition > _LOST, "raise the move weight"),
        warn=(condition > _ILL, "raise the move weight or take fewer blocks"),
    )


def scaling(controller: Controller) -> Check:
    """Drives are scaled by their ranges and temperatures count in degC, so the gains must be comparable."""
    name, (model, optimiser) = "variables are well scaled", (controller.model, controller.optimiser)
    graded = [j for j in range(model.n_u) if j not in model.on_off]
    response = np.abs(optimiser.at_rest[:, graded]).max(axis=0)
    # summed over the horizon: what a whole range of a drive moves on average
    moved = response / sum(controller.design.blocks)
    names = [model.drives[j] for j in graded]
    gains = ", ".join(f"{drive} {gain:.3g} degC" for drive, gain in zip(names, moved))
    finding = f"a whole range of a drive moves its output over the horizon by {gains}"
    least, most = float(np.min(moved)), float(np.max(moved))
    nothing = "leave out the drive that moves nothing, or widen its drive_limits"
    return _graded(
        name,
        finding,
        fail=(least < 1e-4 * max(1.0, most), nothing),
        warn=(
            most > 300 * least or most > 3000 or least < 0.05,
            "look at the units of the drives, and at drive_limits",
        ),
    )


def weights(controller: Controller) -> Check:
    """A weight that can be doubled without any change of the move is not worth thinking about."""
    name, design = "every weight does something", controller.design
    n_u = controller.model.n_u
    on_free, on_last = (gain[:n_u] for gain in linear_move(controller)[1:])
    idle, seen = [], []
    for key in ("move", "terminal", "drive"):
        value = getattr(design, key)
        if value == 0:
            continue
        doubled = Optimiser(controller.model, replace(design, **{key: 2 * value}))
        free, last = (gain[:n_u] for gain in linear_move(controller, doubled)[1:])
        change = float(np.linalg.norm(free - on_free) + np.linalg.norm(last - on_last))
        share = change / float(np.linalg.norm(on_free) + np.linalg.norm(on_last))
        seen.append(f"{key} {value:.3g} ({100 * share:.2g} %)")
        if share < _IDLE:
            idle.append(key)
    finding = f"doubled, they change the move by: {', '.join(seen)}"
    return _graded(
        name,
        finding,
        fail=(len(idle) == len(seen), "the move no longer depends on any weight: take them nearer to 1"),
        warn=(bool(idle), f"leave {', '.join(idle)} alone: tuning it changes nothing"),
    )


def loops_of(controller: Controller, draws: int) -> list[LinearLoop]:
    """Return the loop on the plant itself, and on draws of it."""
    law = linear_law(controller)
    return [
        _loop(controller, law, draw) for draw in (0, *(k for k in draws_of(controller.plant, draws) if k))
    ]


def eigenvalues(loops: Sequence[LinearLoop]) -> Check:
    """Largest eigenvalue of plant, observer and unconstrained move, around the middle of the range; a slow
    part of the plant that the loop leaves as it is, a heatsink say, is no fault of the loop."""
    name = "closed loop is stable"
    sizes = [largest_eigenvalue(loop.matrix) for loop in loops]
    nominal, worst = sizes[0], max(sizes)
    finding = f"largest eigenvalue {nominal:.4f} on the plant, {worst:.4f} on {len(loops) - 1} draws"
    if worst >= 1 - 1e-9:
        return Check(name, "fail", finding, "raise the move weight, or make the observer slower")
    slow = [(size, largest_eigenvalue(loop.A)) for size, loop in zip(sizes, loops) if size > _SLOW]
    if any(abs(size - own) > 0.1 * (1 - own) for size, own in slow):
        return Check(name, "warn", finding, "something settles very slowly; see the observer's drive noise")
    return Check(name, "pass", finding + (": a slow part of the plant, as without the loop" if slow else ""))


def observer_stable(controller: Controller, loop: LinearLoop, swing: tuple[float, float]) -> Check:
    """The estimate must forget where it started, disturbances included, before a step is to have settled."""
    name = "observer forgets its errors"
    size = largest_eigenvalue(loop.law.forgets)
    slow = -controller.dt / np.log(size) if 0 < size < 1 else float("inf")
    spec, noted = _spec_of(controller, swing)
    within = spec.settle_within_s if noted else _LONGEST_S
    finding = f"largest eigenvalue {size:.4f}: an error falls to a third in {slow:.0f} s"
    return _graded(
        name,
        finding + (f", a step has {within:.0f} s" if slow > within else ""),
        fail=(size >= 1 - 1e-9, "measure another output, or give the observer's drive noise a value"),
        warn=(slow > within, "raise the observer's drive and output noise: it learns too slowly"),
    )


def offset_free(loops: Sequence[LinearLoop]) -> Check:
    """What is left, in steady state, of 1 degC of offset of each output, on the plant and on draws."""
    name = "no offset is left in steady state"
    left = max(loop.left_of_offset() for loop in loops)
    finding = f"of an offset of 1 degC {left:.4f} degC is left, plant and {len(loops) - 1} draws"
    fix = "set offset_free; let an output that a drive can move be controlled"
    return _graded(name, finding, fail=(not left < 0.05, fix))


def largest_eigenvalue(matrix: Array) -> float:
    """Return the size of the largest eigenvalue of a matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """A plant under the linear law, as one linear map; targets 0, no noise."""

    law: LinearLaw
    A: Array
    B: Array
    C: Array
    rows: list[int]  # controlled outputs

    @property
    def matrix(self) -> Array:
        """The (n, n) map of (plant, controller) to the next sample."""
        law, by_y = self.law, slice(0, self.law.n_y)
        return np.block(
            [
                [self.A + self.B @ law.D[:, by_y] @ self.C, self.B @ law.C],
                [law.B[:, by_y] @ self.C, law.A],
            ]
        )

    def left_of_offset(self) -> float:
        """Return the largest reading of a controlled output that stays for 1 degC of offset of any output."""
        law, by_y, n_x = self.law, slice(0, self.law.n_y), len(self.A)
        entry = np.vstack([self.B @ law.D[:, by_y], law.B[:, by_y]])
        try:
            states = np.linalg.solve(np.eye(len(entry)) - self.matrix, entry)
        except np.linalg.LinAlgError:
            return float("inf")
        readings = self.C @ states[:n_x] + np.eye(law.n_y)
        return float(np.max(np.abs(readings[self.rows])))


def _loop(controller: Controller, law: LinearLaw, draw: int) -> LinearLoop:
    model, design = controller.model, controller.design
    truth = PredictionModel(controller.plant.draw(draw), dt=design.dt)
    _, A, B, _ = truth.linearise(*truth.at_rest(design.ambient))
    return LinearLoop(law, A, B, truth.C, [model.outputs.index(name) for name in design.controlled])
