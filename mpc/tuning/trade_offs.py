r"""What a tuning leaves to be chosen: designs that nothing beats.

A design is *dominated* where another is at least as good in settling, overshoot and energy and better in one.
Those that remain are the choice that the plant offers; the weights of a spec only say which of them is
wanted.  Differences that nobody could see (a second, a quantum of the sensor, half a per cent of energy) do
not count: the objectives are rounded to them before they are compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Mask
from thermogrip.mpc.tuning.objective import StepResult

#: Differences that do not count: settling [s], overshoot [degC], energy [share of the largest].
RESOLUTION = (1.0, 0.05, 0.005)


@dataclass(frozen=True)
class Trial:
    """One design that was tried, over all trials."""

    controller: str  # ``"MPC"`` or ``"PI"``
    parameters: dict[str, float]  # factors of the default design, or of SIMC
    score: float  # lower is better, see :mod:`thermogrip.mpc.tuning.objective`
    settle_s: float  # means over steps and draws; NaN where one did not settle
    overshoot: float  # the worst [degC]
    energy_s: float
    travel: float = 0.0  # mean of how many full drives the drives move
    results: tuple[StepResult, ...] = field(default=(), repr=False)


@dataclass(frozen=True)
class Pareto:
    """Designs over the same runs, and which of them nothing beats."""

    trials: tuple[Trial, ...]
    names: tuple[str, ...]  # what each is, in words
    best: tuple[bool, ...]  # which are not dominated

    def rows(self) -> list[dict[str, Any]]:
        """Return a plain record a design, None where it did not settle."""
        return [
            {
                "name": name,
                "controller": trial.controller,
                "settle_s": _plain(trial.settle_s),
                "overshoot_degC": _plain(trial.overshoot),
                "energy_s": _plain(trial.energy_s),
                "best": best,
                "knobs": dict(trial.parameters),
            }
            for trial, name, best in zip(self.trials, self.names, self.best, strict=True)
        ]


def non_dominated(points: ArrayLike) -> Mask:
    """Return which points (n, k), to be made small, no other dominates (n,)."""
    values = np.asarray(points, dtype=float)
    finite = np.isfinite(values).all(axis=1)
    no_worse = np.all(values[:, None] <= values[None], axis=2)
    better = np.any(values[:, None] < values[None], axis=2)
    beaten = (no_worse & better & finite[:, None]).any(axis=0)
    return np.asarray(finite & ~beaten)


def front_of(trials: Sequence[Trial], known: Mapping[int, str]) -> Pareto:
    """Return the trials that are not dominated, differences of no account aside, and those that have names by
    their ``id``."""
    points = np.array([(trial.settle_s, trial.overshoot, trial.energy_s) for trial in trials], dtype=float)
    energies = points[:, 2][np.isfinite(points[:, 2])]
    unit = np.array(RESOLUTION)
    unit[2] *= max(float(energies.max()) if energies.size else 1.0, 1e-9)
    best = non_dominated(np.round(points.reshape(-1, 3) / unit)).tolist()
    shown = [at for at, trial in enumerate(trials) if best[at] or id(trial) in known]
    names = tuple(known.get(id(trials[at])) or _factors(trials[at]) for at in shown)
    return Pareto(tuple(trials[at] for at in shown), names, tuple(best[at] for at in shown))


def _factors(trial: Trial) -> str:
    """Return what makes a design, e.g. ``"move x 4"``."""
    changed = {name: value for name, value in trial.parameters.items() if value != 1.0}
    return ", ".join(f"{name} x {value:.2g}" for name, value in changed.items()) or "by default"


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
