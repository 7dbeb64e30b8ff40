"""What a tuner searches: the parameters, the design that they make, and its score on trials.

A :class:`Search` is made of plain data (its plant travels as JSON; of a class of the user's own, its file and
name travel, and the file is run where it arrives), so that other processes can evaluate designs too.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.mpc.controllers.lqr import LQRController
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import Design, make_blocks
from thermogrip.mpc.design.simc import PILoop
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.interface import Controller as AnyController
from thermogrip.mpc.native.build import wanted
from thermogrip.mpc.tuning.trials import StepResult, bounds_of, check_steps, draws_of, run_trials, score

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = [
    "LQR_PARAMETERS",
    "MPC_PARAMETERS",
    "PI_PARAMETERS",
    "Search",
    "Trial",
    "parameters_of",
    "scaled_loops",
]

#: What the search varies: name, smallest, largest; all on a logarithmic scale.
MPC_PARAMETERS = (
    ("move", 0.02, 500.0),
    ("terminal", 0.3, 300.0),
    ("overshoot_share", 0.05, 0.9),
    ("drive_walk", 1e-4, 2e-2),
    ("output_walk", 2e-4, 2e-2),
)
PI_PARAMETERS = (("Kc", 0.1, 10.0), ("Ti", 0.2, 10.0), ("Tt", 0.05, 5.0), ("feedforward", 0.05, 1.0))
LQR_PARAMETERS = (
    ("move", 0.02, 500.0),
    ("drive", 1e-4, 100.0),
    ("drive_walk", 1e-4, 2e-2),
    ("output_walk", 2e-4, 2e-2),
)

_CHECK_FROM = 100  # draws of the comparison, apart from those of the search


@dataclass(frozen=True)
class Trial:
    """One design that was tried, over all steps and draws."""

    controller: str  # ``"MPC"``, ``"LQR"`` or ``"PI"``
    parameters: dict[str, float]  # what made it
    score: float  # lower is better, see :func:`thermogrip.mpc.tuning.trials.score`
    settle_s: float  # means over steps and draws; NaN where one did not settle
    overshoot: float  # the worst [degC]
    energy_s: float  # means over steps and draws; NaN where one did not settle


class Search:
    """Evaluates designs on the search's draws; made of plain data, so that it travels to other processes."""

    def __init__(self, plant: Plant, spec: Spec, baseline: Design, seed: int) -> None:
        self.plant, self.spec, self.baseline, self.seed = plant, spec, baseline, seed
        self._compiled = wanted()
        self.draws = draws_of(plant, spec.search_draws)
        self.certain = self.draws == [0]  # no draws: the comparison takes the same plant, and fresh noise
        self.check_seed = seed + 1 if self.certain else seed
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
        own = getattr(self.plant.model, "code", None)
        where = None if own is None else (str(Path(own.file).resolve()), own.name)
        return {**self.__dict__, "plant": self.plant.to_dict(), "own": where}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from thermogrip.sysid.plant.plant import Plant

        where = state.pop("own")
        self.__dict__.update(state)
        model = None
        if where is not None:
            from thermogrip.sysid.models.user_class import load_object
            from thermogrip.sysid.models.user_model import own_model

            model = own_model(load_object(*where))
        self.plant = Plant.from_dict(state["plant"], model=model)

    def design(self, parameters: dict[str, float]) -> Design:
        """Return the baseline with these parameters; those that are not named stay."""
        base = self.baseline
        noise = replace(
            base.noise,
            drive=parameters.get("drive_walk", base.noise.drive),
            output=parameters.get("output_walk", base.noise.output),
        )
        horizon = max(10, round(parameters.get("horizon", sum(base.blocks))))
        count = max(2, round(parameters.get("blocks", len(base.blocks))))
        same = (horizon, count) == (sum(base.blocks), len(base.blocks))
        share = parameters.get("overshoot_share")
        return replace(
            base,
            blocks=base.blocks if same else make_blocks(horizon, count),
            move=parameters.get("move", base.move),
            terminal=parameters.get("terminal", base.terminal),
            drive=parameters.get("drive", base.drive),
            overshoot=base.overshoot if share is None else share * self.spec.overshoot_degC,
            noise=noise,
            drive_range=_capped(base.drive_range, parameters.get("drive_share", 1.0)),
        )

    def evaluate(self, parameters: dict[str, float]) -> Trial:
        """Return the trial of an MPC."""
        return self._trial("MPC", parameters, self._controller(self.design(parameters)), self.lengths)

    def evaluate_at_length(self, item: tuple[str, dict[str, float]]) -> Trial:
        """Return the trial of an ``"MPC"``, ``"PI"`` or ``"LQR"`` at full length: slow ones settle too."""
        name, parameters = item
        loops = scaled_loops(self.baseline.loops, parameters) if name == "PI" else ()
        made = self.pi(loops) if name == "PI" else self.made(name, self.design(parameters))
        return self._trial(name, parameters, made, [self.spec.hold_s] * len(self.spec.steps))

    def evaluate_lqr(self, parameters: dict[str, float]) -> Trial:
        """Return the trial of a linear-quadratic regulator."""
        return self._trial("LQR", parameters, self.lqr(self.design(parameters)), self.lengths)

    def evaluate_pi(self, factors: dict[str, float]) -> Trial:
        """Return the trial of a PI controller."""
        loops = scaled_loops(self.baseline.loops, factors)
        return self._trial("PI", factors, self.pi(loops), self.pi_lengths)

    def lqr(self, design: Design) -> LQRController:
        """Return the linear-quadratic regulator of a design, its filter in C where there is a compiler."""
        return LQRController(self.plant, design, observer=self._controller(design).observer)

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
            patience_s=base.patience_s,
        )

    def check(self, item: tuple[str, Design, int]) -> list[StepResult]:
        """Return the results of a controller on one draw, at full length."""
        name, design, draw = item
        return run_trials(self.made(name, design), self.plant, self.spec, [draw], seed=self.check_seed)

    def made(self, name: str, design: Design) -> AnyController:
        """Return the controller of a design: ``"PI"`` and ``"LQR"`` are such, any other name is an MPC."""
        if name == "PI":
            return self.pi(design.loops)
        return self.lqr(design) if name == "LQR" else self._controller(design)

    def _controller(self, design: Design) -> Controller:
        if self._compiled:
            try:
                return Controller(self.plant, design, compiled=True)
            except (RuntimeError, NotImplementedError, TypeError, OSError) as error:
                # a gcc without headers, a step that has no C, a home that cannot be written
                warnings.warn(f"trials run in Python, ten times slower: {error}", stacklevel=2)
                self._compiled = False
        return Controller(self.plant, design)

    def _trial(
        self, name: str, parameters: dict[str, float], controller: AnyController, lengths: Sequence[float]
    ) -> Trial:
        results = run_trials(controller, self.plant, self.spec, self.draws, lengths=lengths, seed=self.seed)
        return Trial(
            controller=name,
            parameters=dict(parameters),
            score=score(results, self.spec, self.bounds),
            settle_s=float(np.mean([result.settle_s for result in results])),
            overshoot=max(result.overshoot for result in results),
            energy_s=float(np.mean([result.energy_s for result in results])),
        )


def _capped(ranges: dict[str, tuple[float, float]], share: float) -> dict[str, tuple[float, float]]:
    """Return this share of each range, about no drive."""
    return {
        name: (min(low, 0.0) * share + max(low, 0.0), max(high, 0.0) * share + min(high, 0.0))
        for name, (low, high) in ranges.items()
    }


def parameters_of(design: Design, spec: Spec) -> dict[str, float]:
    """Return the parameters of the MPC that make a design."""
    return {
        "move": design.move,
        "terminal": design.terminal,
        "overshoot_share": design.overshoot / spec.overshoot_degC,
        "drive_walk": design.noise.drive,
        "output_walk": design.noise.output,
        "horizon": float(sum(design.blocks)),
        "blocks": float(len(design.blocks)),
    }


def scaled_loops(loops: tuple[PILoop, ...], factors: dict[str, float]) -> tuple[PILoop, ...]:
    """Return PI loops with each number times its factor; the feed-forward is the number itself."""
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
