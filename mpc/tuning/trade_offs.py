r"""What a tuning leaves to be chosen: designs that nothing beats, and how far each weight may go unnoticed.

A design is *dominated* where another is at least as good in settling, overshoot and energy and better in one.
Those that are left are the choice that the plant offers; the weights of a spec only say which of them is
wanted.  Differences that nobody could see (a second, a quantum of the sensor, half a per cent of energy) do
not count: the objectives are rounded to them before they are compared.

What a user can trade on a saturated plant is mostly the drive itself, so the scan beside the search's own
trials caps it (to 90, 75, 60 and 50 % of its range), lets targets ramp, and makes moves cheaper and dearer. A
filter that trusts readings less spares moves too; its bias takes longer to go than trials of the search last,
so try it here.

**Which weights matter.**  Of the cost J of a parameter k (a weight, the horizon, the number of blocks) the
elasticity is taken by a central difference over a third up and down,

    s = d ln J / d ln k ~ [J(1.3 k) - J(k / 1.3)] / (2 ln(1.3) J(k)),

so s = 0.5 says that one per cent more of the parameter costs half a per cent. Closed-loop cost is not smooth
(a settling time jumps by samples), so beside s is what can be trusted: the widest range around k, tried
by factors of 1.3, 3 and 10, over which neither settling, overshoot nor cost moves by more than can be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Mask
from thermogrip.mpc.tuning.objective import Record, Search, Trial, parameters_of

#: Differences that do not count: settling [s], overshoot [degC], energy [share of the largest].
RESOLUTION = (1.0, 0.05, 0.005)

_CAPS = (0.9, 0.75, 0.6, 0.5)
_MOVES = (0.1, 0.3, 3.0, 10.0, 30.0, 100.0)
_TRUST = (0.3, 0.1)
#: Errors that move nothing, in allowed biases, at which travel is priced.
STILL_SHARES = (0.03, 0.1, 0.3)
#: How many minimum times the targets of ramped designs take.
RAMPS = (1.3, 1.7)
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


def scan_of(
    best: dict[str, float], history: Sequence[Trial], *, ramps: bool = False
) -> list[tuple[str, dict[str, float]]]:
    """Return what to run at full length: the search's trials that stand out, then caps, ramps where there
    may be some, dearer moves and filters that trust readings less."""
    points = [(trial.settle_s, trial.overshoot, trial.score, trial.travel) for trial in history]
    shown = [
        trial for trial, kept in zip(history, non_dominated(points)) if kept and trial.parameters != best
    ]
    shown = sorted(shown, key=lambda trial: trial.score)[:_KEPT]
    found = [("tuned", dict(best)), *(("tried by the search", dict(trial.parameters)) for trial in shown)]
    own = best.get("drive_share", 1.0)
    found += [(f"{100 * cap:.0f} % of the drive", {**best, "drive_share": cap}) for cap in _CAPS if cap < own]
    for times in RAMPS if ramps else ():
        if times != best.get("ramp"):
            found.append((f"targets ramp for {times:g} times the minimum time", {**best, "ramp": times}))
    for factor in _MOVES:
        found.append((f"moves {factor:g} times as dear", {**best, "move": factor * best["move"]}))
    for share in STILL_SHARES:
        if share != best.get("still"):
            found.append(
                (f"errors below {share:g} of the allowed bias move nothing", {**best, "still": share})
            )
    for factor in _TRUST if "state_walk" in best else ():
        trusted = {**best, "state_walk": factor * best["state_walk"]}
        found.append((f"states {factor:g} times as noisy to the filter", trusted))
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


#: What each parameter is to a user.
PARAMETER_WORDS = {
    "move": "the move weight",
    "terminal": "the terminal weight",
    "overshoot_share": "the band's share of the overshoot",
    "state_walk": "the process noise of the states",
    "drive_walk": "the process noise of the drive's bias",
    "output_walk": "the process noise of the output's bias",
    "horizon": "the horizon",
    "blocks": "the number of blocks",
    "ramp": "the target's ramp",
    "still": "the price of travel, in allowed biases",
}

_FACTORS = (1.3, 3.0, 10.0)
_STRUCTURE = ("horizon", "blocks")  # a change of these takes seconds of gcc: 30 % must do
_SETTLE, _SHARE, _OVERSHOOT, _COST = 1.0, 0.01, 0.02, 0.01  # s or share of it, degC, share: not seen


@dataclass(frozen=True)
class Sensitivity(Record):
    """What one parameter does."""

    knob: str  # the tuning parameter; a key of files
    value: float  # what it is
    elasticity: float  # of the closed loop's cost, see the module's text
    # mean settling at value / 1.3, at value, at 1.3 value [s]; NaN where it did not settle on all draws
    settle_low_s: float
    settle_s: float
    settle_high_s: float
    overshoot_low: float  # worst overshoot at the two ends [degC]
    overshoot_high: float
    # between these nothing that can be seen changes; both are ``value`` where already 30 % matters
    free_low: float
    free_high: float


def sensitivity_of(item: tuple[Search, str, dict[str, float], Trial]) -> Sensitivity:
    """Return what a parameter does about the best ones; one item, so that processes can share the work."""
    search, parameter, best, here = item
    value = best[parameter]
    ends: dict[int, Trial] = {}
    free: dict[int, float] = {}
    for side in (-1, 1):
        free[side] = value
        for factor in _FACTORS[:1] if parameter in _STRUCTURE else _FACTORS:
            changed = {**best, parameter: value * factor**side}
            tried = search.evaluate(changed, noises=1)
            ends.setdefault(side, tried)
            if not _unseen(tried, here):
                break
            # a horizon has a least length: what counts is what the design made of it
            free[side] = parameters_of(search.design(changed), search.spec).get(parameter, changed[parameter])
    low, high = ends[-1], ends[1]
    slope = (high.score - low.score) / (2 * np.log(_FACTORS[0]) * here.score)
    return Sensitivity(
        knob=parameter,
        value=float(value),
        elasticity=float(slope),
        settle_low_s=low.settle_s,
        settle_s=here.settle_s,
        settle_high_s=high.settle_s,
        overshoot_low=low.overshoot,
        overshoot_high=high.overshoot,
        free_low=float(free[-1]),
        free_high=float(free[1]),
    )


def sensitivity_words(found: Sequence[Sensitivity]) -> list[str]:
    """Return what the sensitivities say, a sentence each, those that matter first."""
    ordered = sorted(found, key=lambda item: (_free(item), -abs(item.elasticity)))
    return [_words(item) for item in ordered]


def _free(item: Sensitivity) -> bool:
    return item.free_low < item.value < item.free_high


def _words(item: Sensitivity) -> str:
    name, now = PARAMETER_WORDS.get(item.knob, item.knob), f"(now {item.value:.3g})"
    if _free(item):
        between = f"{item.free_low:.3g} and {item.free_high:.3g}"
        return f"settling does not depend on {name} {now} between {between}"
    low, high, here = (_seconds(t) for t in (item.settle_low_s, item.settle_high_s, item.settle_s))
    said = f"{name} matters {now}: settling {low} at 30 % less, {high} at 30 % more, {here} as it is"
    most = max(item.overshoot_low, item.overshoot_high)
    changes = np.abs(np.array([item.settle_low_s, item.settle_high_s]) - item.settle_s)
    same = bool(np.all(changes < _SETTLE))
    if same and abs(item.overshoot_low - item.overshoot_high) <= _OVERSHOOT:
        end = f"30 % change neither settling ({here}) nor overshoot"
        return f"{name} matters {now} for how the drives move; {end}"
    return f"{said}; overshoot up to {most:.2f} K" if same else said


def _seconds(settle: float) -> str:
    return f"{settle:.0f} s" if np.isfinite(settle) else "not on every draw"


def _unseen(tried: Trial, here: Trial) -> bool:
    """Return whether nothing that can be seen has changed; False where it does not settle."""
    allowed = max(_SETTLE, _SHARE * here.settle_s) if np.isfinite(here.settle_s) else np.inf
    settled = np.isfinite(tried.settle_s) or not np.isfinite(here.settle_s)
    return bool(
        settled
        and not abs(tried.settle_s - here.settle_s) > allowed
        and abs(tried.overshoot - here.overshoot) <= _OVERSHOOT
        and abs(tried.score - here.score) <= _COST * here.score
    )
