"""Which fault explains a window whose residual is too large?

The window is simulated again under each fault that may have happened in it, from several onsets on: the
driver gives nothing, gives everything, gives half, is wired the wrong way round, or the pump stands still.
With e = reading less path, summed over the readings of the window and the outputs,

    cost = rarity * sum e^2,

rarity more than 1 for what hardly happens (nobody rewires a rig that runs).  A sensor that is wrong alone
leaves the other outputs on the model's path, and one that is late follows that path some seconds behind.

The cheapest is the explanation if its cost is a small part of that without any fault, and the next best is
named as well where the readings cannot distinguish the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermogrip.rig.guard.kalman_filter import Estimate, History, RigModel
from thermogrip.sysid.models.model import Array

__all__ = ["Cause", "by_danger", "explain_window"]


@dataclass(frozen=True)
class Cause:
    """What may have happened: kind and subject of the trip, in words, and how much rarer than others."""

    kind: str
    subject: str
    text: str
    rarity: float = 1.0


_NO_FAULT = Cause("model", "", "")
_DRIVER, _MODULE = "the driver", "the module"
_NOTHING = Cause("driver", _DRIVER, "the driver gives nothing")
_FULL_DRIVE = Cause("driver", _DRIVER, "the driver is stuck at full drive", 1.2)
_FULL_COOLING = Cause("driver", _DRIVER, "the driver is stuck at full cooling", 1.2)
_REVERSED = Cause("reversed", _MODULE, "the module is wired the wrong way round", 2.0)  # nobody rewires a rig
_HALF = Cause("driver", _DRIVER, "the driver gives half of what is asked")
_PUMP = Cause("pump", "the pump", "the pump stands still")
_DANGER = ("driver", "reversed", "pump", "drift", "model")  # the most dangerous first: it does not obey
_ONSETS = (0.0, 0.25, 0.5, 0.75, 0.85, 0.9, 0.95)  # of a window, where something may have gone wrong
_LATE_S, _LATE_RARITY = (3.0, 5.0, 8.0), 1.2
_WRONG_COST = 0.15  # of its own errors, for a sensor that may read anything
_EXPLAINS = 0.35  # of the unexplained cost, that an explanation must stay below
_ALIKE = 2.5  # times the best cost, below which the next best is as good


def explain_window(model: RigModel, past: History, seconds: float) -> list[Cause]:
    """Return what explains the readings of the last seconds best: one cause, two that are alike, or none."""
    begin = past.begin(past.now - seconds)
    if begin is None:
        return []
    applied, rows = past.steps.rows(begin.step)
    causes, u = _hypotheses(model, applied, begin.w)
    d = np.repeat(rows[None], len(causes), axis=0)
    y = model.run(np.repeat(begin.x[None], len(causes), axis=0), u, d) + model.offsets + begin.b
    errors = past.errors(begin, y)
    cost = np.nansum(errors**2, axis=(1, 2))
    best: dict[Cause, float] = {}
    for cause, c in zip(causes[1:], cost[1:]):
        best[cause] = min(cause.rarity * float(c), best.get(cause, np.inf))
    best |= _sensor_costs(model, past, begin, y[0])
    ranked = sorted(best, key=lambda cause: (best[cause], cause.text))
    if not ranked or best[ranked[0]] >= _EXPLAINS * float(cost[0]):
        return []
    return ranked[:1] + [cause for cause in ranked[1:2] if best[cause] < _ALIKE * best[ranked[0]]]


def by_danger(causes: Sequence[Cause], output: str) -> list[tuple[str, str]]:
    """Return kind and subject of each cause, the most dangerous first; without one the output's model."""
    found = dict.fromkeys((cause.kind, cause.subject) for cause in causes) or [("model", output)]
    return sorted(found, key=lambda pair: _DANGER.index(pair[0]))


def _hypotheses(model: RigModel, u: Array, w: Array) -> tuple[list[Cause], Array]:
    """Return causes (no fault first) and inputs (B, N, n_u) of what was applied (N, n_u) with biases w.

    The biases of the drives hold until the onset, and not for what a broken driver gives.
    """
    causes, rows = [_NO_FAULT], [model.biased(u, w)]
    for part in _ONSETS:
        since = int(part * len(u))
        for cause, wrong in _wrong_drives(model, u[since:]) + _wrong_pump(model, u[since:]):
            causes.append(cause)
            rows.append(np.concatenate([rows[0][:since], wrong]))
    return causes, np.array(rows)


def _wrong_drives(model: RigModel, u: Array) -> list[tuple[Cause, Array]]:
    out = []
    for at, half, (low, high) in zip(model.drive_at, model.half, model.ranges):
        faults = [(_NOTHING, np.clip(0.0, low, high)), (_FULL_DRIVE, high), (_HALF, 0.5 * u[:, at])]
        if low < 0:
            faults += [(_FULL_COOLING, low), (_REVERSED, np.clip(-u[:, at], low, high))]
        for cause, values in faults:
            changed = u.copy()
            changed[:, at] = values
            if np.max(np.abs(changed[:, at] - u[:, at]), initial=0.0) > 0.1 * half:
                out.append((cause, changed))
    return out


def _wrong_pump(model: RigModel, u: Array) -> list[tuple[Cause, Array]]:
    if "pump" not in model.plant.inputs:
        return []
    at = model.plant.inputs.index("pump")
    if not u[:, at].max(initial=0.0) > 0.5:
        return []
    still = u.copy()
    still[:, at] = 0.0
    return [(_PUMP, still)]


def _sensor_costs(model: RigModel, past: History, begin: Estimate, path: Array) -> dict[Cause, float]:
    """Return the cost where one sensor alone is wrong, or late, given the model's path (N + 1, n_y)."""
    own = np.nansum(past.errors(begin, path[None])[0] ** 2, axis=0)
    found = {}
    for k, name in enumerate(model.plant.outputs):
        others = float(own.sum() - own[k])
        if len(own) > 1:
            found[Cause("drift", name, f"{name} alone is wrong")] = others + _WRONG_COST * float(own[k])
        late = [_late(path, k, seconds / model.plant.dt) for seconds in _LATE_S]
        least = float(np.nansum(past.errors(begin, np.array(late))[:, :, k] ** 2, axis=1).min())
        found[Cause("drift", name, f"{name} is late")] = others + _LATE_RARITY * least
    return found


def _late(path: Array, k: int, steps: float) -> Array:
    """Return a path (N + 1, n_y) whose output k comes so many steps late."""
    shift = min(round(steps), len(path) - 1)
    out = path.copy()
    out[:, k] = np.concatenate([np.full(shift, path[0, k]), path[: len(path) - shift, k]])
    return out
