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

import numpy as np

from thermogrip.rig.guard.kalman_filter import Estimate, History, RigModel
from thermogrip.sysid.models.model import Array

__all__ = ["explain_window", "kinds_of"]

# what explains a window as well may be less likely: nobody rewires a rig that runs
_RARE = (("stuck at full", 1.2), ("wrong way", 2.0))
_NEEDS_BOTH_WAYS = ("the driver is stuck at full cooling", "the module is wired the wrong way round")
_ONSETS = (0.0, 0.25, 0.5, 0.75, 0.85, 0.9, 0.95)  # of a window, where something may have gone wrong
_LATE_S, _LATE_RARITY = (3.0, 5.0, 8.0), 1.2
_WRONG_COST = 0.15  # of its own errors, for a sensor that may read anything
_EXPLAINS = 0.35  # of the unexplained cost, that an explanation must stay below
_ALIKE = 2.5  # times the best cost, below which the next best is as good


def explain_window(model: RigModel, past: History, seconds: float) -> str:
    """Return the best explanation of the last seconds, or two joined by ", or "; "" where none is good."""
    begin = past.begin(past.now - seconds)
    if begin is None:
        return ""
    applied, rows = past.steps.rows(begin.step)
    labels, u = _hypotheses(model, applied, begin.w)
    d = np.repeat(rows[None], len(labels), axis=0)
    y = model.run(np.repeat(begin.x[None], len(labels), axis=0), u, d) + model.offsets + begin.b
    errors = past.errors(begin, y)
    cost = np.nansum(errors**2, axis=(1, 2))
    best: dict[str, float] = {}
    for label, c in zip(labels, cost):
        rarity = next((r for words, r in _RARE if words in label), 1.0)
        best[label] = min(rarity * float(c), best.get(label, np.inf))
    best |= _sensor_costs(model, past, begin, y[0])
    ranked = sorted((c, label) for label, c in best.items() if label)
    if not ranked or ranked[0][0] >= _EXPLAINS * float(cost[0]):
        return ""
    near = [label for k, (c, label) in enumerate(ranked[:2]) if k == 0 or c < _ALIKE * ranked[0][0]]
    return ", or ".join(near)


def kinds_of(because: str, output: str) -> list[tuple[str, str]]:
    """Return kind and subject of each explanation, the most dangerous first: a driver that does not obey."""
    found = [_kind_of(part, output) for part in because.split(", or ")] if because else [("model", output)]
    order = ("driver", "reversed", "pump", "drift", "model")
    return sorted(dict.fromkeys(found), key=lambda pair: order.index(pair[0]))


def _hypotheses(model: RigModel, u: Array, w: Array) -> tuple[list[str], Array]:
    """Return labels ("": no fault) and inputs (B, N, n_u), given what was applied (N, n_u) and its biases w.

    The biases of the drives hold until the onset, and not for what a broken driver gives.
    """
    labels, rows = [""], [model.biased(u, w)]
    for part in _ONSETS:
        since = int(part * len(u))
        for label, wrong in _wrong_drives(model, u[since:]) + _wrong_pump(model, u[since:]):
            labels.append(label)
            rows.append(np.concatenate([rows[0][:since], wrong]))
    return labels, np.array(rows)


def _wrong_drives(model: RigModel, u: Array) -> list[tuple[str, Array]]:
    out = []
    for at, half, (low, high) in zip(model.drive_at, model.half, model.ranges):
        for label, values in (
            ("the driver gives nothing", np.clip(0.0, low, high)),
            ("the driver is stuck at full drive", high),
            ("the driver is stuck at full cooling", low),
            ("the module is wired the wrong way round", np.clip(-u[:, at], low, high)),
            ("the driver gives half of what is asked", 0.5 * u[:, at]),
        ):
            if low >= 0 and label in _NEEDS_BOTH_WAYS:
                continue
            changed = u.copy()
            changed[:, at] = values
            if np.max(np.abs(changed[:, at] - u[:, at]), initial=0.0) > 0.1 * half:
                out.append((label, changed))
    return out


def _wrong_pump(model: RigModel, u: Array) -> list[tuple[str, Array]]:
    if "pump" not in model.plant.inputs:
        return []
    at = model.plant.inputs.index("pump")
    if not u[:, at].max(initial=0.0) > 0.5:
        return []
    still = u.copy()
    still[:, at] = 0.0
    return [("the pump stands still", still)]


def _sensor_costs(model: RigModel, past: History, begin: Estimate, path: Array) -> dict[str, float]:
    """Return the cost where one sensor alone is wrong, or late, given the model's path (N + 1, n_y)."""
    own = np.nansum(past.errors(begin, path[None])[0] ** 2, axis=0)
    found = {}
    for k, name in enumerate(model.plant.outputs):
        others = float(own.sum() - own[k])
        if len(own) > 1:
            found[f"{name} alone is wrong"] = others + _WRONG_COST * float(own[k])
        late = [_late(path, k, seconds / model.plant.dt) for seconds in _LATE_S]
        errors = past.errors(begin, np.array(late))[:, :, k]
        found[f"{name} is late"] = others + _LATE_RARITY * float(np.nansum(errors**2, axis=1).min())
    return found


def _late(path: Array, k: int, steps: float) -> Array:
    """Return a path (N + 1, n_y) whose output k comes so many steps late."""
    shift = min(round(steps), len(path) - 1)
    out = path.copy()
    out[:, k] = np.concatenate([np.full(shift, path[0, k]), path[: len(path) - shift, k]])
    return out


def _kind_of(because: str, output: str) -> tuple[str, str]:
    if "pump" in because:
        return "pump", "the pump"
    if "wrong way" in because:
        return "reversed", "the module"
    if "driver" in because:
        return "driver", "the driver"
    if "alone is wrong" in because or "is late" in because:
        return "drift", because.split()[0]
    return "model", output
