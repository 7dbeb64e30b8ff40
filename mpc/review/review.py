r"""Design review: what would go wrong with this controller, found before the rig finds it.

Each check passes, warns or fails, with its numbers and the fix.  None of them needs the rig.

What the plant allows: the horizon must see past the delay, and
past the point where braking must begin; each temperature of the wanted range must be held by a drive inside
its limits, in a cold and in a warm room; the gain must not turn over inside the drive's range, nor the
current pass a Peltier's optimum; hard limits must leave room to move, soft ones must not forbid the wanted
range; targets must lie where the logs were.

What the loop does by itself: the disturbance states must be
detectable; the observer must forget its errors; the loop must be stable, on the plant and on draws of it,
and leave no offset; the QP must be well conditioned and scaled, and its weights must do something.

What it costs (here): the slowest step, its iterations at the worst moment, and who stands in when it fails.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.mpc.native.design_struct import ITERATION_LIMIT
from thermogrip.mpc.plant.prediction import step_response
from thermogrip.mpc.review import checks
from thermogrip.mpc.review.checks import Check, worst

__all__ = ["Check", "review", "worst"]

Array = NDArray[np.float64]


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
        The range of targets [degC]; by default that of its spec's steps, else what the logs showed.
    rooms : sequence of float, optional
        Room temperatures in which the range must be reachable [degC].
    draws : int, optional
        Posterior draws on which the closed loop is checked.

    Returns
    -------
    list of Check
    """
    starts, targets = _steps(controller)
    span = (min(targets), max(targets)) if wanted is None else wanted
    swing = (min(starts + targets), max(starts + targets)) if wanted is None else wanted
    loops = checks.loops_of(controller, draws)
    return [
        checks.horizon(controller),
        checks.reachable(controller, span, rooms),
        checks.gain_sign(controller),
        checks.peltier_optimum(controller, span, draws),
        checks.detectable(controller),
        checks.observer_stable(controller, loops[0]),
        checks.offset_free(loops),
        checks.eigenvalues(loops),
        checks.hessian(controller),
        checks.scaling(controller),
        checks.weights(controller),
        checks.room_to_move(controller),
        checks.limits(controller, span),
        *_effort(controller, swing),
        _stand_in(controller),
        checks.valid_range(controller, span),
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


class _Counted:
    """A controller whose steps are counted."""

    def __init__(self, controller: Controller) -> None:
        self.controller, self.dt, self.controlled = controller, controller.dt, controller.controlled
        self.iterations: list[int] = []

    def reset(self, reading: Readings) -> None:
        self.controller.reset(reading)

    def step(self, reading: Readings, target: Target) -> Move:
        move = self.controller.step(reading, target)
        self.iterations.append(self.controller.last_iterations)
        return move


def _effort(controller: Controller, span: tuple[float, float]) -> list[Check]:
    """Measured on swings across the range and back, where the active set changes most."""
    fresh = _Counted(Controller(controller.plant, controller.design))
    ends = [dict.fromkeys(controller.controlled, end) for end in (span[1], span[0], span[1])]
    schedule = [(end, 40 * controller.dt) for end in ends]
    run = simulate_closed_loop(fresh, controller.plant, schedule, start=span[0])
    ms, dt, deadline = 1e3 * run.seconds[1:], controller.dt, controller.design.deadline_s
    p99, slowest = float(np.percentile(ms, 99)), float(np.max(ms))
    finding = (
        f"{len(ms)} steps on swings across the range: median {float(np.median(ms)):.1f} ms, "
        f"p99 {p99:.1f} ms, slowest {slowest:.1f} ms; deadline {1e3 * deadline:.0f} ms, sample {dt:g} s"
    )
    name = "step time fits the sample time"
    fix = "shorten the horizon, take fewer blocks or sample more slowly"
    if slowest > 1e3 * deadline:
        time = Check(name, "fail", finding, fix)
    elif p99 > 250 * dt:
        time = Check(name, "warn", finding, "leave more time: another process may take the processor")
    else:
        time = Check(name, "pass", finding)
    return [time, _iterations(controller, fresh.iterations)]


def _iterations(controller: Controller, counted: list[int]) -> Check:
    name, limit = "QP ends long before its limit", ITERATION_LIMIT
    rows = 2 * controller.optimiser.n_b * controller.model.n_u
    soft = len(controller.optimiser.qp.soft) - rows
    finding = f"{rows} hard and {soft} soft rows; at most {max(counted)} iterations of {limit} allowed"
    if max(counted) >= limit:
        return Check(name, "fail", finding, "take fewer blocks, a shorter horizon, or fewer limits")
    if max(counted) > limit // 4:
        return Check(
            name, "warn", finding, "take fewer blocks or fewer limits: the worst case may not end in time"
        )
    return Check(name, "pass", finding)


def _stand_in(controller: Controller) -> Check:
    """Where the optimiser fails the PI takes over; it must be there, and push the right way."""
    name, loops = "a PI controller stands in", controller.design.loops
    alone = [output for output in controller.controlled if output not in {loop.output for loop in loops}]
    said = "; ".join(f"{p.drive} by {p.output}: Kc {p.Kc:.3g}, Ti {p.Ti:.0f} s" for p in loops)
    if alone:
        return Check(
            name, "warn", f"{len(alone)} outputs without", "tune again: a failing solver ends in off"
        )
    # by the step response, which an output that only adds up has too
    gains = [step_response(controller.plant, loop.drive, loop.output).gain for loop in loops]
    wrong = [loop.output for loop, gain in zip(loops, gains, strict=True) if gain * loop.Kc < 0]
    if wrong:
        return Check(name, "fail", said, f"tune again: the PI of {', '.join(wrong)} pushes the wrong way")
    return Check(name, "pass", said)
