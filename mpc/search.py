"""What a tuner searches: the knobs, the design that they make, and its score on trials.

A :class:`Search` is made of plain data (its plant travels as JSON), so that other processes can judge designs
too.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.mpc.compiled import wanted
from thermogrip.mpc.controller import Controller
from thermogrip.mpc.design import Design, make_blocks
from thermogrip.mpc.pid import PIController, PILoop
from thermogrip.mpc.spec import Spec
from thermogrip.mpc.trials import StepResult, bounds_of, check_steps, draws_of, run_trials, score

if TYPE_CHECKING:
    from thermogrip.sysid.plant import Plant

__all__ = ["KNOBS", "PI_KNOBS", "Search", "knobs_of", "scaled_loops"]

#: What the search varies: name, smallest, largest; all on a logarithmic scale.
KNOBS = (
    ("move", 0.02, 500.0),
    ("terminal", 0.3, 300.0),
    ("overshoot_share", 0.05, 0.9),
    ("drive_walk", 1e-4, 2e-2),
    ("output_walk", 2e-4, 2e-2),
)
PI_KNOBS = (("Kc", 0.1, 10.0), ("Ti", 0.2, 10.0), ("Tt", 0.05, 5.0), ("feedforward", 0.05, 1.0))

_CHECK_FROM = 100  # draws of the comparison, apart from those of the search


class Search:
    """Judges designs on the search's draws; made of plain data, so that it travels to other processes."""

    def __init__(self, plant: Plant, spec: Spec, baseline: Design, seed: int) -> None:
        self.plant, self.spec, self.baseline, self.seed = plant, spec, baseline, seed
        self._compiled = wanted()
        self.draws = draws_of(plant, spec.search_draws)
        # the comparison takes draws that the search has not seen
        self.unseen = [draw + _CHECK_FROM if draw else 0 for draw in draws_of(plant, spec.check_draws)]
        self.bounds = bounds_of(plant, baseline, spec, sorted({*self.draws, *self.unseen}))
        check_steps(self.bounds)
        slowest = [max(self.bounds[(*step, draw)] for draw in self.draws) for step in spec.steps]
        # long enough to see it settle and stay, short enough to try many; a PI takes longer, and costs less
        least = min(120.0, spec.hold_s)
        self.lengths = [float(np.clip(1.35 * bound + 40.0, least, spec.hold_s)) for bound in slowest]
        self.pi_lengths = [float(np.clip(2.5 * bound + 100.0, least, spec.hold_s)) for bound in slowest]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "plant": self.plant.to_dict()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from thermogrip.sysid.plant import Plant

        self.__dict__.update(state)
        self.plant = Plant.from_dict(state["plant"])

    def design(self, knobs: dict[str, float]) -> Design:
        """Return the baseline with these knobs."""
        base = self.baseline
        noise = replace(base.noise, drive=knobs["drive_walk"], output=knobs["output_walk"])
        horizon = max(10, round(knobs["horizon"]))
        return replace(
            base,
            blocks=base.blocks if horizon == sum(base.blocks) else make_blocks(horizon, len(base.blocks)),
            move=knobs["move"],
            terminal=knobs["terminal"],
            overshoot=knobs["overshoot_share"] * self.spec.overshoot_degC,
            noise=noise,
        )

    def judge(self, knobs: dict[str, float]) -> float:
        """Return the score of a design."""
        return self._score(self._controller(self.design(knobs)), self.lengths)

    def judge_pi(self, factors: dict[str, float]) -> float:
        """Return the score of a PI controller."""
        return self._score(self.pi(scaled_loops(self.baseline.loops, factors)), self.pi_lengths)

    def pi(self, loops: tuple[PILoop, ...]) -> PIController:
        """Return a PI controller under the same limits."""
        base = self.baseline
        return PIController(
            self.plant,
            dt=base.dt,
            loops=loops,
            controlled=base.controlled,
            drive_range=base.drive_range,
            slew_per_s=base.slew_per_s,
        )

    def check(self, item: tuple[str, Design, int]) -> list[StepResult]:
        """Return the results of a controller on one draw, at full length."""
        name, design, draw = item
        controller = self.pi(design.loops) if name == "PI" else self._controller(design)
        return run_trials(controller, self.plant, self.spec, [draw], seed=self.seed)

    def _controller(self, design: Design) -> Controller:
        if self._compiled:
            try:
                return Controller(self.plant, design, compiled=True)
            except (RuntimeError, NotImplementedError, TypeError, OSError) as error:
                # a gcc without headers, a step that has no C, a home that cannot be written
                warnings.warn(f"trials run in Python, ten times slower: {error}", stacklevel=2)
                self._compiled = False
        return Controller(self.plant, design)

    def _score(self, controller: Controller | PIController, lengths: Sequence[float]) -> float:
        results = run_trials(controller, self.plant, self.spec, self.draws, lengths=lengths, seed=self.seed)
        return score(results, self.spec, self.bounds)


def knobs_of(design: Design, spec: Spec) -> dict[str, float]:
    return {
        "move": design.move,
        "terminal": design.terminal,
        "overshoot_share": design.overshoot / spec.overshoot_degC,
        "drive_walk": design.noise.drive,
        "output_walk": design.noise.output,
    }


def scaled_loops(loops: tuple[PILoop, ...], factors: dict[str, float]) -> tuple[PILoop, ...]:
    return tuple(
        replace(
            loop,
            Kc=factors["Kc"] * loop.Kc,
            Ti=factors["Ti"] * loop.Ti,
            Tt=factors["Tt"] * loop.Tt,
            feedforward=factors["feedforward"],
        )
        for loop in loops
    )
