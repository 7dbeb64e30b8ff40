"""What a free run says of its plant, by how large its error is beside the one that the plant states.

With hours of readings a test finds what is real and does not matter: on most logs of a real board of another
day a residual correlates with its inputs. So the verdict goes by size. A plant states for this run the rms
error X of each output, and the ends that 9 of 10 runs lie within
(:mod:`thermogrip.sysid.validation.prediction_bands`). With e the error and b that of the best decay without
input, both of the same readings,

    better          e below the low end, every output
    as stated       e within the ends
    worse           e above the high end of any output, or above X and no better than without input
                    (e > 0.8 b), or above X and most of it one gain
    another plant   worse, without one cause, and no better than without input; or the run diverged
    no test         the rows are those of the fit; or no right plant could have done better than without
                    input, X > 0.8 b, and this one did not do clearly worse than that (e > b / 0.8)

What is worse is so by its *gain*, an effect of the inputs that comes *slowly*, an *offset* or its *start*
where one of them is most of the squared error of the worst output, else by its *dynamics*.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from thermogrip.sysid.validation.prediction_bands import Band, InputEffect

__all__ = ["MOST", "NO_BETTER", "Cause", "Standing", "Verdict", "judge"]

NO_BETTER = 0.8  # of the no-input error: a free run above it has not shown that the input matters
MOST = 0.5  # of the squared error

Standing: TypeAlias = Literal["as stated", "better", "worse", "another plant", "no test"]
Cause: TypeAlias = Literal["", "gain", "slow", "offset", "start", "dynamics", "seen", "too little input"]

_MEANING: dict[Standing, str] = {
    "as stated": "the error is as stated",
    "better": "the error is smaller than stated",
    "worse": "the error is larger than stated",
    "another plant": "this is another plant, predicted no better than without input",
    "no test": "no test of the plant",
}
_BECAUSE: dict[Cause, str] = {
    "": "",
    "slow": "slow terms are missing, for inputs do more or less later",
    "offset": "most of it is a constant offset",
    "start": "most of it is the start, for the readings of the warm-up do not set the slow states",
    "dynamics": "the plant is not what it was in the fit, or was never run like this",
    "seen": "the rows are in the fit; another log is a test",
    "too little input": "the inputs do too little here",
}


@dataclass(frozen=True)
class Verdict:
    """How far a free run bears its plant out."""

    standing: Standing
    over_stated: dict[str, float]  # error over the stated one, by output
    cause: Cause = ""  # by what it is worse, or why it is no test
    gain: float | None = None  # by how large a share inputs did more than in the fit, where that is the cause

    def __str__(self) -> str:
        times = ", ".join(f"{name} {ratio:.2g}" for name, ratio in self.over_stated.items())
        because = _BECAUSE.get(self.cause, "")
        if self.gain is not None:
            because = f"inputs do {100 * abs(self.gain):.0f} % {'more' if self.gain > 0 else 'less'}"
        words = _MEANING[self.standing] + (f": {because}" if because else "")
        return f"{words} (times the stated error: {times})"


def judge(
    band: Band,
    errors: Mapping[str, float],
    no_input: Mapping[str, float],
    *,
    causes: Mapping[str, Mapping[Cause, float]],
    by_inputs: InputEffect | None,
    seen: bool,
) -> Verdict:
    """Return the verdict on a run, by output: its rms errors, those of the no-input baseline, and of the
    start and of an offset the share of its squared error. ``seen``: its rows were in the fit."""
    stated = {name: size for name, size in band.expected.items() if size > 0}
    over = {name: error / stated[name] if name in stated else float("nan") for name, error in errors.items()}
    hopeless = {name for name, size in stated.items() if size > NO_BETTER * no_input[name]}
    most = {name: no_input[name] * (1 / NO_BETTER if name in hopeless else NO_BETTER) for name in stated}
    lost = {name for name in stated if not errors[name] <= most[name]}
    worse = [
        name
        for name in stated
        if not errors[name] <= band.likely[name][1]
        or (over[name] > 1 and (name in lost or by_inputs is not None))
    ]
    if worse:
        worst = max(worse, key=lambda name: over[name])
        if not np.isfinite(errors[worst]):
            return Verdict("another plant", over, "dynamics")
        if by_inputs is not None and by_inputs.lag_s == 0:
            return Verdict("worse", over, "gain", by_inputs.gain)
        if by_inputs is not None:
            return Verdict("worse", over, "slow")
        shares = causes.get(worst, {})
        cause = max(shares, key=lambda each: shares[each], default=None)
        if cause is not None and shares[cause] > MOST:
            return Verdict("worse", over, cause)
        return Verdict("another plant" if worst in lost else "worse", over, "dynamics")
    if seen:
        return Verdict("no test", over, "seen")
    if stated and len(hopeless) == len(stated):
        return Verdict("no test", over, "too little input")
    better = bool(stated) and all(errors[name] < band.likely[name][0] for name in stated)
    return Verdict("better" if better else "as stated", over)
