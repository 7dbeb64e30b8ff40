r"""Review, what the plant allows: delay, reach, the gain's sign, a Peltier's optimum, limits, what logs saw.

**Peltier.**  The cold face takes Q = S I T_c - I^2 R / 2 - K (T_h - T_c) out, T_c in kelvin, which is
largest at I* = S T_c / R; beyond it more current cools less.  Only S I and I^2 R can be told from
temperatures, so I* is given as a share of full drive, which needs no more.  With a heatsink that warms up
the whole plant turns over earlier still; that is what the check of the gain's sign follows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.plant.prediction import step_response
from thermogrip.mpc.plant.steady_state import holding_drive, steady_curve
from thermogrip.mpc.review.check import Check
from thermogrip.mpc.tuning.trials import draws_of

__all__ = [
    "beyond_logs",
    "gain_sign",
    "horizon",
    "limits",
    "peltier_optimum",
    "reachable",
    "room_to_move",
    "valid_range",
]

_KELVIN = 273.15


def horizon(controller: Controller) -> Check:
    """The drive must be taken back while what it did has not arrived: the horizon has to see that far."""
    design = controller.design
    verdict, finding = "pass", []
    for output in design.controlled:
        answers = [step_response(controller.plant, drive, output) for drive in controller.model.drives]
        best = max(answers, key=lambda answer: abs(answer.gain))
        need, good = 2 * best.delay, min(4 * best.delay, best.delay + best.lag)
        told = "four delays" if good < best.delay + best.lag else "delay and lag"
        finding.append(
            f"{output}: horizon {design.horizon_s:.0f} s, wanted {good:.0f} s: {told} "
            f"(delay {best.delay:.0f} s, lag {best.lag:.0f} s)"
        )
        if design.horizon_s < need:
            verdict = "fail"
        elif design.horizon_s < good and verdict == "pass":
            verdict = "warn"
    fix = "" if verdict == "pass" else "lengthen the horizon to four delays (blocks), or sample more slowly"
    return Check("horizon covers delay and lag", verdict, "; ".join(finding), fix)


def reachable(controller: Controller, span: tuple[float, float], rooms: Sequence[float]) -> Check:
    """Each end of the wanted range [degC] must be held by a drive inside its limits, in every room [degC]."""
    design, model = controller.design, controller.model
    low, high = np.array([design.drive_range[name] for name in model.drives]).T
    missed, near = [], []
    for room in rooms if model.n_d else rooms[:1]:
        for target in span:
            d = np.full(model.n_d, room)
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
    return Check(
        name, "pass", f"{span[0]:g} to {span[1]:g} degC in rooms of {', '.join(f'{r:g}' for r in rooms)} degC"
    )


def gain_sign(controller: Controller) -> Check:
    """A Peltier element cools less beyond its optimum current: dT/du changes sign there."""
    design, model = controller.design, controller.model
    name, d = "gain keeps its sign over the drive", np.full(controller.model.n_d, controller.design.ambient)
    seen, bad = [], []
    for drive, (low, high) in design.drive_range.items():
        curve = steady_curve(model, drive, design.controlled[0], d)
        if not np.isfinite(curve.y).any():
            finding = f"{drive}: {design.controlled[0]} comes to rest at no drive (it only adds up)"
            return Check(name, "warn", finding, "judge by the closed loops of tune: there is no steady state")
        inside = [turn for turn in curve.turns if low < turn < high]
        seen.append(f"{drive}: {np.nanmin(curve.y):.1f} to {np.nanmax(curve.y):.1f} degC in steady state")
        if inside:
            bad.append(
                f"{drive} turns over at {', '.join(f'{turn:.2f}' for turn in inside)} of {low:g} to {high:g}"
            )
            seen.append(f"rising from {curve.rising[0]:.2f} to {curve.rising[1]:.2f}")
    if bad:
        fix = "set drive_limits to the rising part, or accept it: the prediction sees the turn, a PI does not"
        return Check(name, "warn", "; ".join(bad + seen), fix)
    return Check(name, "pass", "; ".join(seen))


def peltier_optimum(controller: Controller, span: tuple[float, float], draws: int) -> Check:
    """Beyond I* = S T_c / R a Peltier element cools less; the drive's range must end before."""
    name, network = (
        "current stays below the Peltier optimum",
        getattr(controller.plant.model, "network", None),
    )
    elements = getattr(network, "peltiers", {})
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
    if beyond:
        return Check(name, "warn", "; ".join(seen), f"set drive_limits: {', '.join(beyond)}")
    if near:
        return Check(
            name, "warn", "; ".join(seen), "the last tenth of the current hardly cools: leave it out"
        )
    return Check(name, "pass", "; ".join(seen))


def room_to_move(controller: Controller) -> Check:
    """Range and slew must neither exclude each other nor make every move a jump across the range."""
    design = controller.design
    verdict, seen = "pass", []
    for name, (low, high) in design.drive_range.items():
        share = design.slew_per_s[name] * design.dt / (high - low)
        seen.append(f"{name}: {low:g} to {high:g}, {100 * share:.1f} % of it a sample")
        if not low <= 0 <= high:
            verdict = "fail"
        elif share < 0.002 and verdict == "pass":
            verdict = "warn"
    fix = {
        "pass": "",
        "warn": "raise slew_per_s: crossing the range takes over 500 samples",
        "fail": "let the drive range contain 0: that is where a failing loop goes",
    }[verdict]
    return Check("hard limits leave room", verdict, "; ".join(seen), fix)


def limits(controller: Controller, span: tuple[float, float]) -> Check:
    """A soft limit that the wanted range must break is a conflict, settled by price at every sample."""
    design, model = controller.design, controller.model
    name = "soft limits agree with the targets"
    if not design.limits:
        return Check(name, "pass", "no limits of outputs")
    d, broken = np.full(model.n_d, design.ambient), []
    for target in span:
        held = holding_drive(model, design.controlled, np.full(len(design.controlled), target), d)
        for output, (low, high) in design.limits.items():
            value = float(held.y[model.outputs.index(output)])
            if not low <= value <= high:
                broken.append(f"{output} is {value:.1f} degC when {target:g} degC is held")
    seen = ", ".join(f"{key} {low:g} to {high:g} degC" for key, (low, high) in design.limits.items())
    if broken:
        return Check(name, "fail", f"{seen}: {'; '.join(broken)}", "widen the limits or narrow the targets")
    return Check(name, "pass", seen)


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
        outside += [f"{target:g} degC" for target in span if not low - 0.5 <= target <= high + 0.5]
    if outside:
        fix = "record a log that goes there, or treat the result with care"
        return Check(name, "warn", f"{'; '.join(seen)}; beyond: {', '.join(outside)}", fix)
    return Check(name, "pass", "; ".join(seen))


def beyond_logs(
    controller: Controller, target: float | Mapping[str, float], *, grasps: bool = False
) -> list[str]:
    """Return a sentence for each thing that a session will do and the plant's logs have not done.

    Parameters
    ----------
    controller : Controller
    target : float or mapping of str to float
        [degC].
    grasps : bool, optional
        Whether the session stops the pump to grasp.
    """
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
