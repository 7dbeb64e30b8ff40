r"""Design review: what would go wrong with this controller, found before the rig finds it.

Each check passes, warns or fails, with its numbers and the fix.  None of them needs the rig:

* the horizon must see past the delay, and past the point where braking must begin;
* each temperature of the wanted range must be held by a drive inside its limits, in a cold and in a warm
  room;
* a Peltier element's gain must not turn over inside the drive's range;
* the disturbance states must be detectable, or the loop is not free of offset;
* the QP must be well conditioned;
* the loop, unconstrained and linear, must have its eigenvalues inside the unit circle, on the plant and on
  draws of it.  With y+ = G (v - v0) the move is u = K (x_hat, w_hat, u_before, r), linear, so plant,
  observer and move make one matrix;
* hard limits must leave room to move, and soft ones must not forbid the wanted range;
* the slowest step must be far below the sample time;
* targets must lie where the logs were.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermogrip.mpc.closed_loop import simulate_closed_loop
from thermogrip.mpc.controller import Controller
from thermogrip.mpc.observer import choose_disturbances, detectability_margin
from thermogrip.mpc.prediction import PredictionModel, step_response
from thermogrip.mpc.steady import holding_drive, steady_curve
from thermogrip.mpc.trials import draws_of

__all__ = ["Check", "review"]

Array = NDArray[np.float64]

_RANK = {"pass": 0, "warn": 1, "fail": 2}


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


def review(
    controller: Controller,
    *,
    wanted: tuple[float, float] | None = None,
    rooms: Sequence[float] = (18.0, 30.0),
    draws: int = 5,
) -> list[Check]:
    """Return the findings about a controller's design.

    Parameters
    ----------
    controller : Controller
    wanted : (float, float), optional
        The range of targets [degC]; by default what its spec's steps span, else what the logs showed.
    rooms : sequence of float, optional
        Room temperatures in which the range must be reachable [degC].
    draws : int, optional
        Posterior draws on which the closed loop is checked.

    Returns
    -------
    list of Check
    """
    span = _wanted(controller) if wanted is None else wanted
    return [
        _horizon(controller),
        _reachable(controller, span, rooms),
        _gain_sign(controller),
        _detectable(controller),
        _hessian(controller),
        _eigenvalues(controller, draws),
        _room_to_move(controller),
        _limits(controller, span),
        _step_time(controller, span),
        _valid_range(controller, span),
    ]


def _wanted(controller: Controller) -> tuple[float, float]:
    steps = controller.notes.get("spec", {}).get("steps", [])
    values = [float(value) for step in steps for value in step]
    if values:
        return min(values), max(values)
    low, high = controller.plant.valid.get(controller.controlled[0], (20.0, 40.0))
    return float(low), float(high)


def _horizon(controller: Controller) -> Check:
    """The drive must be taken back while what it did has not arrived: the horizon has to see that far."""
    design = controller.design
    verdict, finding = "pass", []
    for output in design.controlled:
        answers = [step_response(controller.plant, drive, output) for drive in controller.model.drives]
        best = max(answers, key=lambda answer: abs(answer.gain))
        need, good = 2 * best.delay, min(4 * best.delay, best.delay + best.lag)
        finding.append(
            f"{output}: horizon {design.horizon_s:.0f} s, delay {best.delay:.0f} s, lag {best.lag:.0f} s"
        )
        if design.horizon_s < need:
            verdict = "fail"
        elif design.horizon_s < good and verdict == "pass":
            verdict = "warn"
    fix = "" if verdict == "pass" else "lengthen the horizon to four delays (blocks), or sample more slowly"
    return Check("horizon covers delay and lag", verdict, "; ".join(finding), fix)


def _reachable(controller: Controller, span: tuple[float, float], rooms: Sequence[float]) -> Check:
    design, model = controller.design, controller.model
    low, high = np.array([design.drive_range[name] for name in model.drives]).T
    missed, near = [], []
    for room in rooms if model.n_d else rooms[:1]:
        for target in span:
            d = np.full(model.n_d, room)
            found = holding_drive(model, design.controlled, np.full(len(design.controlled), target), d)
            outside = np.any(found.u < low - 1e-6) or np.any(found.u > high + 1e-6)
            text = f"{target:g} degC in a room of {room:g} degC"
            if found.miss > 0.05:
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


def _gain_sign(controller: Controller) -> Check:
    """A Peltier element cools less beyond its optimum current: dT/du changes sign there."""
    design, model = controller.design, controller.model
    name, d = "gain keeps its sign over the drive", np.full(controller.model.n_d, controller.design.ambient)
    seen, bad = [], []
    for drive, (low, high) in design.drive_range.items():
        curve = steady_curve(model, drive, design.controlled[0], d)
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


def _detectable(controller: Controller) -> Check:
    """Where the gain of a drive is small its bias can hardly be seen, so the test is made over the range."""
    name, model = "disturbances are detectable", controller.model
    if not controller.design.offset_free:
        fix = "set offset_free"
        return Check(name, "fail", "no disturbance states: the loop ends off its target", fix)
    chosen = choose_disturbances(model, controller.controlled, ambient=controller.design.ambient)
    d = np.full(model.n_d, controller.design.ambient)
    scale = np.array([0.01 if label.startswith("input") else 1.0 for label in chosen.names])
    margins = []
    for share in (0.1, 0.3, 0.5, 0.7, 0.9):
        u = model.lowest + share * model.span
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
    if min(margins) <= 1e-6:
        return Check(name, "fail", finding, "narrow drive_limits to where the gain keeps its sign")
    if min(margins) < 0.02:
        return Check(name, "warn", finding, "expect slow removal of offsets where the gain is small")
    return Check(name, "pass", finding)


def _hessian(controller: Controller) -> Check:
    H, _, _ = _linear_move(controller)
    values = np.linalg.eigvalsh(H)
    condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
    name, finding = "QP is well conditioned", f"{H.shape[0]} unknowns, condition {condition:.1e}"
    if values[0] <= 0 or condition > 1e12:
        return Check(name, "fail", finding, "raise the move weight")
    if condition > 1e8:
        return Check(name, "warn", finding, "raise the move weight or take fewer blocks")
    return Check(name, "pass", finding)


def _eigenvalues(controller: Controller, draws: int) -> Check:
    """Largest eigenvalue of plant, observer and unconstrained move, around the middle of the range."""
    name = "closed loop is stable"
    picked = [0, *[draw for draw in draws_of(controller.plant, draws) if draw]]
    sizes = [_largest_eigenvalue(controller, draw) for draw in picked]
    nominal, worst = sizes[0], max(sizes)
    finding = f"largest eigenvalue {nominal:.4f} on the plant, {worst:.4f} on {len(picked) - 1} draws"
    if worst >= 1 - 1e-9:
        return Check(name, "fail", finding, "raise the move weight, or make the observer slower")
    if worst > 0.9995:
        return Check(name, "warn", finding, "something settles very slowly; see the observer's drive noise")
    return Check(name, "pass", finding)


def _linear_move(controller: Controller) -> tuple[Array, Array, Array]:
    """Return H of the QP, and the first move's gains on the free response and on the drive before."""
    model, design, optimiser = controller.model, controller.design, controller.optimiser
    d = np.full(model.n_d, design.ambient)
    u = np.clip(np.zeros(model.n_u), model.lowest, model.highest)
    x = model.steady_state(u, d)
    x = model.rest(np.full(model.n_y, design.ambient), d) if not np.isfinite(x).all() else x
    plan = np.repeat(u[None, :], optimiser.n_b, axis=0)
    _, G = model.trajectory(x, plan, d, design.blocks)
    flat = G.reshape(optimiser.N, model.n_y, -1) * np.tile(model.span, optimiser.n_b)
    rows = [model.outputs.index(name) for name in design.controlled]
    return optimiser.linear_gains(flat, rows)


def _largest_eigenvalue(controller: Controller, draw: int) -> float:
    model, design = controller.model, controller.design
    truth = PredictionModel(controller.plant.draw(draw), dt=design.dt)
    d = np.full(model.n_d, design.ambient)
    u = np.clip(np.zeros(model.n_u), model.lowest, model.highest)
    loop = _LinearLoop(controller, truth, u, d)
    n = loop.size
    columns = [loop.step(row) for row in np.eye(n)]
    return float(np.max(np.abs(np.linalg.eigvals(np.stack(columns, axis=1)))))


class _LinearLoop:
    """Plant, observer with its settled gain, and the unconstrained move, as one linear map."""

    def __init__(self, controller: Controller, truth: PredictionModel, u: Array, d: Array) -> None:
        model, observer = controller.model, controller.observer
        self.A, self.B = truth.linearise(truth.rest(np.full(truth.n_y, d[0] if d.size else 25.0), d), u, d)[
            1:3
        ]
        self.C = truth.C
        x = model.rest(np.full(model.n_y, d[0] if d.size else 25.0), d)
        _, self.Am, self.Bm, Em = model.linearise(x, u, d)
        chosen = controller.disturbance
        into = self.Bm @ (chosen.on_drive * model.span[:, None]) + Em @ chosen.on_disturbance
        n_x, n_w = model.n_x, chosen.n_w
        self.F = np.block([[self.Am, into], [np.zeros((n_w, n_x)), np.eye(n_w)]])
        self.H = np.hstack([model.C, chosen.on_output])
        self.gain = observer.settled_gain(self.F)
        _, self.on_free, self.on_last = _linear_move(controller)
        self.blocks, self.n_x, self.n_u, self.n_z = controller.design.blocks, n_x, model.n_u, n_x + n_w
        self.rows = [model.outputs.index(name) for name in controller.controlled]
        self.n_t = truth.n_x
        self.size = self.n_t + self.n_z + self.n_u

    def step(self, state: Array) -> Array:
        """Return (plant, estimate before the reading, drive) one sample later; no target, no noise."""
        x, z, last = np.split(state, [self.n_t, self.n_t + self.n_z])
        z = z + self.gain @ (self.C @ x - self.H @ z)
        # the free response of the estimate, its biases held, without any drive
        free, ahead = [], z
        for _ in range(sum(self.blocks)):
            ahead = self.F @ ahead
            free.append((self.H @ ahead)[self.rows])
        u = self.on_free @ np.concatenate(free) + self.on_last @ last
        after = np.concatenate([self.Bm @ u, np.zeros(self.n_z - self.n_x)])
        return np.concatenate([self.A @ x + self.B @ u, self.F @ z + after, u])


def _room_to_move(controller: Controller) -> Check:
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


def _limits(controller: Controller, span: tuple[float, float]) -> Check:
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


def _step_time(controller: Controller, span: tuple[float, float]) -> Check:
    """Measured on a swing across the range, where the active set changes most."""
    fresh = Controller(controller.plant, controller.design)
    target = dict.fromkeys(controller.controlled, span[1])
    run = simulate_closed_loop(fresh, controller.plant, [(target, 60 * controller.dt)], start=span[0])
    slowest, dt = float(np.max(run.seconds[1:])), controller.dt
    finding = (
        f"slowest of 60 steps {1e3 * slowest:.1f} ms, median {1e3 * float(np.median(run.seconds)):.1f} ms, "
        f"sample {dt:g} s"
    )
    name = "step time fits the sample time"
    if slowest > controller.design.deadline_s:
        return Check(name, "fail", finding, "shorten the horizon, take fewer blocks or sample more slowly")
    if slowest > 0.25 * dt:
        return Check(name, "warn", finding, "leave more time: another process may take the processor")
    return Check(name, "pass", finding)


def _valid_range(controller: Controller, span: tuple[float, float]) -> Check:
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


def worst(checks: Sequence[Check]) -> str:
    """Return the worst verdict of a review.

    Examples
    --------
    >>> worst([Check("a", "pass", ""), Check("b", "warn", "")])
    'warn'
    """
    rank: Callable[[str], int] = _RANK.__getitem__
    return max((check.verdict for check in checks), key=rank, default="pass")
