r"""Closed-loop trials of a design: steps on draws of the plant, their score, the actuator's bound.

**Score.**  A step's settling time counts in units of the bound, so that short and long steps weigh alike;
what the spec forbids is charged on top, steeply:

    score = (settle + energy_weight E) / bound + 10 (overshoot - 0.9 allowed)+ + 10 (|bias| - 0.9 allowed)+

A step that never settles is charged its whole length and twice its last error.  Over the runs, the score
is the mean plus half of what the worst is above it: the draws stand for what the plant may be.

**Bound.**  Before :func:`thermogrip.mpc.tuning.minimum_time.full_drive_bound` no drive inside its limits
brings the skin into the band.  Staying there takes longer still, since the drive must be taken back in time,
so a settling time near the bound cannot be improved by weights: the actuator is the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings, simulate_closed_loop
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.interface import Controller
from thermogrip.mpc.tuning.minimum_time import full_drive_bound

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = [
    "Bounds",
    "StepResult",
    "bounds_of",
    "check_steps",
    "draws_of",
    "full_drive_bound",
    "run_trials",
    "score",
    "trial",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepResult:
    """One step on one draw; of the worst output where several are controlled."""

    start: float  # [degC]
    target: float
    draw: int  # which draw of the plant was the truth
    settle_s: float  # NaN where it did not settle
    overshoot: float  # [degC]; the bias is signed, of the output where it is largest
    bias: float
    last_error: float
    energy_s: float  # see :class:`thermogrip.mpc.closed_loop.simulate.Segment`
    travel: float
    full_share: float
    length_s: float


def draws_of(plant: Plant, count: int) -> list[int]:
    """Return which draws to try: 1 to count, or the plant itself alone where it has no uncertainty."""
    return list(range(1, count + 1)) if plant.uncertain else [0]


def surroundings_of(spec: Spec, controlled: Sequence[str], disturbances: Sequence[str]) -> Surroundings:
    """Return the room and the sensors of the trials: the controlled ones are off, and the room's are."""
    offset = dict.fromkeys(controlled, spec.sensor_offset_degC)
    offset |= dict.fromkeys(disturbances, 1.5 * spec.sensor_offset_degC)
    return Surroundings(ambient=spec.ambient_degC, noise=spec.noise_degC, offset=offset)


def trial(
    controller: Controller,
    plant: Plant,
    spec: Spec,
    step: tuple[float, float],
    draw: int,
    length_s: float,
    seed: int,
) -> ClosedLoop:
    """Run a step (start, target) [degC] of the spec on one draw of the plant for so many seconds, wholly
    in C where the controller is in C.
    """
    loop: Callable[..., ClosedLoop] = simulate_closed_loop
    if getattr(controller, "c", None) is not None:
        from thermogrip.mpc.closed_loop.simulate_native import compiled_loop as loop
    return loop(
        controller,
        plant.draw(draw),
        [(step[1], length_s)],
        start=step[0],
        surroundings=surroundings_of(spec, tuple(getattr(controller, "controlled", ())), plant.disturbances),
        band=spec.band_degC,
        seed=1000 * seed + draw,
    )


def run_trials(
    controller: Controller,
    plant: Plant,
    spec: Spec,
    draws: Sequence[int],
    *,
    lengths: Sequence[float] | None = None,
    seed: int = 0,
) -> list[StepResult]:
    """Run every step of the spec on these draws; ``lengths`` are seconds by step, ``hold_s`` where absent."""
    results = []
    for at, step in enumerate(spec.steps):
        length = spec.hold_s if lengths is None else lengths[at]
        for draw in draws:
            results.append(_result(trial(controller, plant, spec, step, draw, length, seed), step, draw))
    return results


Bounds = dict[tuple[float, float, int], float]


def score(results: Sequence[StepResult], spec: Spec, bounds: Bounds) -> float:
    """Return the score of a set of trials, see the module's text; lower is better; ``bounds`` are shortest
    times [s].
    """
    costs = []
    for result in results:
        bound = bounds[(result.start, result.target, result.draw)]
        unit = max(bound if np.isfinite(bound) else result.length_s, 1.0)
        settled = np.isfinite(result.settle_s)
        cost = result.settle_s / unit if settled else result.length_s / unit + 2 * abs(result.last_error)
        cost += 10 * max(0.0, result.overshoot - 0.9 * spec.overshoot_degC)
        cost += 10 * max(0.0, abs(result.bias) - 0.9 * spec.bias_degC) if settled else 0.0
        costs.append(cost + spec.energy_weight * result.energy_s / unit)
    return float(np.mean(costs) + 0.5 * (np.max(costs) - np.mean(costs)))


def bounds_of(plant: Plant, design: Design, spec: Spec, draws: Sequence[int]) -> Bounds:
    """Return :func:`full_drive_bound` of every step of the spec on these draws."""
    found: Bounds = {}
    for draw in draws:
        drawn = plant.draw(draw)
        for step in spec.steps:
            found[(*step, draw)] = full_drive_bound(drawn, design, step, spec)
    return found


def check_steps(bounds: Bounds) -> None:
    """Raise UserError where no step can be reached at all."""
    if bounds and not any(np.isfinite(bound) for bound in bounds.values()):
        first = next(iter(bounds))
        raise UserError(
            f"steps: full drive does not reach {first[1]:g} degC, nor any other target",
            hint="choose nearer targets, a wider drive range, or a longer hold_s",
        )


def _result(run: ClosedLoop, step: tuple[float, float], draw: int) -> StepResult:
    parts = run.segments
    settles = [part.settle_s for part in parts]
    worst = max(parts, key=lambda part: abs(part.bias))
    last = max((run.outputs[p.output][-1] - p.target for p in parts), key=abs)
    return StepResult(
        start=step[0],
        target=step[1],
        draw=draw,
        settle_s=float(np.max(settles)),  # NaN wins, as it should
        overshoot=max(part.overshoot for part in parts),
        bias=worst.bias,
        last_error=float(last),
        energy_s=parts[0].energy_s,
        travel=parts[0].travel,
        full_share=parts[0].full_share,
        length_s=parts[0].end_s - parts[0].begin_s,
    )
