r"""Which weights matter: what +-30 % of each does to the closed loop, and how far each may go unnoticed.

Of the cost J of a parameter k (a weight, the horizon, the number of blocks) the elasticity is taken by a
central difference over a third up and down,

    s = d ln J / d ln k ~ [J(1.3 k) - J(k / 1.3)] / (2 ln(1.3) J(k)),

so s = 0.5 says that one per cent more of the parameter costs half a per cent. Closed-loop cost is not smooth
(a settling time jumps by samples), so beside s is what can be trusted: the widest range around k, tried
by factors of 1.3, 3 and 10, over which neither settling, overshoot nor cost moves by more than can be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermogrip.mpc.tuning.objective import Record, Search, Trial, parameters_of

#: What each parameter is to a user.
PARAMETER_WORDS = {
    "move": "the move weight",
    "terminal": "the terminal weight",
    "overshoot_share": "the band's share of the overshoot",
    "drive_walk": "the process noise of the drive's bias",
    "output_walk": "the process noise of the output's bias",
    "horizon": "the horizon",
    "blocks": "the number of blocks",
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
            tried = search.evaluate(changed)
            ends.setdefault(side, tried)
            if not _unseen(tried, here):
                break
            # a horizon has a least length: what counts is what the design made of it
            free[side] = parameters_of(search.design(changed), search.spec)[parameter]
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
