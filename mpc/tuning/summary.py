"""What a tuning came to: a table of the controllers, and one of three verdicts.

* **actuator-limited**: the spec asks for less time than the drive allows, or the settling time is within a
  quarter of what the drive allows and the search won nothing: change the hardware or the spec, not the
  weights;
* **improved**: the score fell by more than 3 % against the default design on draws that the search has not
  seen;
* **flat**: it did not; the default is kept.

Whatever the verdict, it reports where a simpler controller, tuned with the same number of trials, is as good.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.objective import Bounds, Record, StepResult

_WON = 0.03  # relative fall of the score that counts
_NEAR = 1.25  # settling over bound that counts as the actuator's limit


@dataclass(frozen=True)
class Row(Record):
    """One line of the comparison: a controller on one step, over the draws."""

    controller: str  # ``"baseline"``, ``"tuned"``, ``"PI"`` or ``"LQR"``
    start: float  # [degC]
    target: float
    settle_mean_s: float  # NaN where it did not settle on some draw
    settle_worst_s: float
    overshoot_mean: float  # [degC]; the mean bias is of its size
    overshoot_worst: float
    bias_mean: float
    bias_worst: float
    energy_mean_s: float  # over the draws
    energy_worst_s: float
    travel_mean: float
    full_share: float
    bound_s: float  # before this no drive within the limits is in the band [s], mean over the draws


def rows_of(name: str, results: Sequence[StepResult], spec: Spec, bounds: Bounds) -> list[Row]:
    """Return a controller's rows, one a step of the spec."""
    return [
        _row(name, step, [result for result in results if (result.start, result.target) == step], bounds)
        for step in spec.steps
    ]


def _row(name: str, step: tuple[float, float], part: Sequence[StepResult], bounds: Bounds) -> Row:
    settle = np.array([result.settle_s for result in part])
    bias = np.array([result.bias for result in part])
    energy = np.array([result.energy_s for result in part])
    overshoot = np.array([result.overshoot for result in part])
    return Row(
        controller=name,
        start=step[0],
        target=step[1],
        settle_mean_s=float(np.mean(settle)),
        settle_worst_s=float(np.max(settle)),
        overshoot_mean=float(np.mean(overshoot)),
        overshoot_worst=float(np.max(overshoot)),
        bias_mean=float(np.mean(np.abs(bias))),
        bias_worst=float(bias[np.argmax(np.abs(bias))]),
        energy_mean_s=float(np.mean(energy)),
        energy_worst_s=float(np.max(energy)),
        travel_mean=float(np.mean([result.travel for result in part])),
        full_share=float(np.mean([result.full_share for result in part])),
        bound_s=float(np.mean([bounds[(*step, result.draw)] for result in part])),
    )


def meets_spec(result: StepResult, spec: Spec) -> bool:
    """Return whether one run is as wanted."""
    return (
        result.settle_s <= spec.settle_within_s  # False where NaN
        and result.overshoot <= spec.overshoot_degC
        and abs(result.bias) <= spec.bias_degC
    )


def verdict_of(
    spec: Spec, scores: Mapping[str, float], rows: Sequence[Row], *, unseen: str = "on unseen draws"
) -> tuple[str, str]:
    """Return the verdict and its numbers in words."""
    won = 1 - min(scores["tuned"], scores["baseline"]) / scores["baseline"]
    beyond = [row for row in rows if row.bound_s > spec.settle_within_s]
    if beyond:
        return "actuator-limited", _beyond(max(beyond, key=lambda row: row.bound_s), spec)
    ratio = float(np.mean([row.settle_mean_s / max(row.bound_s, 1.0) for row in rows]))
    against = f"{_limits(rows)} {_simpler(scores)}".strip()
    if won > _WON:
        return "improved", f"Score {100 * won:.0f} % below the default design {unseen}. {against}"
    if ratio <= _NEAR:
        return "actuator-limited", f"Weights win {100 * won:.1f} %: the drive is the limit. {against}"
    return "flat", f"Weights win {100 * won:.1f} %, less than the {100 * _WON:.0f} % that count. {against}"


def _beyond(row: Row, spec: Spec) -> str:
    """Return the sentence about a step that no controller can do in time."""
    step = f"{row.start:g} to {row.target:g} degC"
    if not np.isfinite(row.bound_s):
        return f"{step} cannot be reached at this drive; no weight changes that."
    takes = f"takes {row.settle_mean_s:.0f} s" if np.isfinite(row.settle_mean_s) else "does not settle"
    return (
        f"{step} cannot settle under {row.bound_s:.0f} s at this drive, and {spec.settle_within_s:g} s are "
        f"asked; yours {takes}; no weight changes that."
    )


def _limits(rows: Sequence[Row]) -> str:
    """Return each step's settling beside what the drive allows."""
    said = []
    for row in rows:
        settled = np.isfinite(row.settle_mean_s)
        takes = f"takes {row.settle_mean_s:.0f} s" if settled else "does not settle on every draw"
        step = f"{row.start:g} to {row.target:g}"
        said.append(f"{step} cannot settle under {row.bound_s:.0f} s at this drive, yours {takes}")
    return "; ".join(said) + "."


def _simpler(scores: Mapping[str, float]) -> str:
    """Return what a simpler controller makes of it, "" where the MPC is plainly better than both."""
    kept = min(scores["tuned"], scores["baseline"])
    near = {name: scores[name] for name in ("PI", "LQR") if name in scores and scores[name] < 1.03 * kept}
    if not near:
        return ""
    name = min(near, key=lambda key: near[key])
    share = 100 * (1 - near[name] / kept)
    how = "as well" if abs(share) < 0.5 else f"{abs(share):.1f} % {'better' if share > 0 else 'worse'}"
    missing = ", and knows neither limits of outputs nor where a gain turns over" if name == "LQR" else ""
    return f"{name}, tuned with as many trials, scores {how} on this spec{missing}."
