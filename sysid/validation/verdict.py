"""What a free run says of its plant, by how large its error is beside the one that the plant states.

With hours of readings a test finds what is real and does not matter: on most logs of a real board of another
day a residual correlates with its inputs. So the verdict goes by size. With e the rms error of an output,
less the share that the start explains, and s the rms error that the plant's bands state for this run
(:mod:`thermogrip.sysid.validation.prediction_bands`), the plant is called another one where

    e > 2 s        of any output, or
    e > s          of any, and one gain that is off by more than two of its assumed sd is most of the error.

An error may be of one direction alone, a gain say, which a right plant has beyond 2 s in 4.6 % of its
runs; of many directions that is rarer.

The share of the start is taken out of the run's error and out of no baseline's: a run whose whole error is
beyond 2 s, and only without its start within it, is judged by its start, whatever no input would have done.

An output that does not beat a model without input (at most 0.8 of its error) is no ground to rely on the
plant. Where the stated error is itself that large, no right plant could have done it, and the log is no test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from thermogrip.sysid.validation.prediction_bands import Band

__all__ = ["EXCEEDS", "NO_BETTER", "Standing", "Verdict", "judge"]

EXCEEDS = 2.0  # times the stated error, from which a plant is called another one
NO_BETTER = 0.8  # of the no-input error: a free run above it has not shown that the input matters

Standing: TypeAlias = Literal["as stated", "seen", "changed", "start", "weak", "no test"]

_MEANING: dict[Standing, str] = {
    "as stated": "as was stated",
    "seen": "as was stated, over rows of its own fit; another log is a test",
    "changed": "by more than was stated: the plant is not what it was in the fit, or was never run like this",
    "start": "by its start: the readings of the warm-up do not set its slow states, score it after more",
    "weak": "as was stated, which is hardly better than no input",
    "no test": "as was stated, but the inputs do too little here to test the plant",
}


@dataclass(frozen=True)
class Verdict:
    """How far a free run bears its plant out."""

    standing: Standing
    over_stated: dict[str, float]  # error over the stated one, by output
    gain: float | None = (
        None  # by how large a share inputs did more than in the fit, where that is most of it
    )

    def __str__(self) -> str:
        times = ", ".join(f"{name} {ratio:.2g}" for name, ratio in self.over_stated.items())
        how = _MEANING[self.standing]
        if self.standing not in ("changed", "start") and max(self.over_stated.values(), default=0.0) > 1.0:
            how = how.replace("as was stated", "by more than was stated, but no more than chance may do", 1)
        return f"errs {how} (times the stated error: {times})"


def judge(
    band: Band,
    errors: Mapping[str, float],
    start: Mapping[str, float],
    no_input: Mapping[str, float],
    *,
    no_better: tuple[str, ...],
    gain: float | None,
    seen: bool,
) -> Verdict:
    """Return the verdict on a run, by output: its rms errors, which share of their squares is the start, and
    those of the no-input baseline. ``seen``: its rows were in the fit."""
    left = {name: error * np.sqrt(max(0.0, 1.0 - start.get(name, 0.0))) for name, error in errors.items()}
    over = {
        name: float(error / band.expected[name]) if band.expected[name] > 0 else float("nan")
        for name, error in left.items()
    }
    worst = max((ratio for ratio in over.values() if ratio == ratio), default=0.0)
    hopeless = [name for name in no_better if band.expected[name] > NO_BETTER * no_input[name]]
    if worst > EXCEEDS or (gain is not None and worst > 1.0):
        return Verdict("changed", over, gain)
    if any(error > EXCEEDS * band.expected[name] > 0 for name, error in errors.items()):
        return Verdict("start", over)
    if set(no_better) - set(hopeless):
        return Verdict("weak", over)
    if len(hopeless) == len(errors):
        return Verdict("no test", over)
    return Verdict("seen" if seen else "as stated", over)
