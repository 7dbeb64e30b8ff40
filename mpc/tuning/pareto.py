"""What may be traded for what: designs of which none is better in settling, overshoot and energy at once.

A design is *dominated* where another is at least as good in all three and better in one.  Those that are left
are the choice that the plant offers; the weights of a spec only say which of them is wanted.  Differences
that nobody could see (a second, a quantum of the sensor, half a per cent of energy) do not count: the
objectives are rounded to them before they are compared.

What a user can trade on a saturated plant is mostly the drive itself, so the scan beside the search's own
trials caps it (to 90, 75, 60 and 50 % of its range), and makes moves cheaper and dearer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Mask
from thermogrip.mpc.tuning.objective import Trial

#: Differences that do not count: settling [s], overshoot [degC], energy [share of the largest].
RESOLUTION = (1.0, 0.05, 0.005)

_CAPS = (0.9, 0.75, 0.6, 0.5)
_MOVES = (0.1, 10.0, 100.0)
_KEPT = 6  # of the search's own trials


@dataclass(frozen=True)
class Pareto:
    """Designs over the same runs, and which of them nothing beats."""

    trials: tuple[Trial, ...]  # all at the spec's full length, on the search's draws
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


def scan_of(best: dict[str, float], history: Sequence[Trial]) -> list[tuple[str, dict[str, float]]]:
    """Return what to run at full length: the search's trials that stand out, then caps and dearer moves."""
    points = [(trial.settle_s, trial.overshoot, trial.score) for trial in history]
    shown = [
        trial for trial, kept in zip(history, non_dominated(points)) if kept and trial.parameters != best
    ]
    shown = sorted(shown, key=lambda trial: trial.score)[:_KEPT]
    found = [("tuned", dict(best)), *(("tried by the search", dict(trial.parameters)) for trial in shown)]
    own = best.get("drive_share", 1.0)
    found += [(f"{100 * cap:.0f} % of the drive", {**best, "drive_share": cap}) for cap in _CAPS if cap < own]
    for factor in _MOVES:
        found.append((f"moves {factor:g} times as dear", {**best, "move": factor * best["move"]}))
    return found


def front_of(trials: Sequence[Trial], names: Sequence[str]) -> Pareto:
    """Return the trials with those marked that are not dominated, differences of no account aside."""
    points = np.array([(trial.settle_s, trial.overshoot, trial.energy_s) for trial in trials], dtype=float)
    known = points[:, 2][np.isfinite(points[:, 2])]
    unit = np.array(RESOLUTION)
    unit[2] *= max(float(known.max()) if known.size else 1.0, 1e-9)
    best = non_dominated(np.round(points.reshape(-1, 3) / unit))
    return Pareto(tuple(trials), tuple(names), tuple(bool(value) for value in best))


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
