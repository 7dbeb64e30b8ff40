"""What a plant rests on: between which temperatures, and how many minutes of each kind of drive.

A model fitted on an hour of heating and two minutes of cooling is a model of heating.  Nothing in its errors
says so, for what is rare weighs little in them; the minutes do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Log, column
from thermogrip.sysid.plant.plant import Plant

__all__ = ["Evidence", "evidence"]

Array = NDArray[np.float64]

_LONGEST = 10.0  # [s] that a row may stand for; beyond it the input is unknown
_SMALL = 0.05  # of an input's range: that is no drive
THIN_MINUTES, THIN_SHARE = 15.0, 0.15  # below either, a side of the drive is thinly covered


@dataclass(frozen=True)
class Evidence:
    """What the logs of a fit cover.

    Parameters
    ----------
    ranges : dict of output -> (float, float)
        Seen in the logs (1st and 99th percentile), in the output's unit.
    minutes : dict of str -> float
        Minutes of each kind of drive, such as ``"drive < 0"`` or ``"pump off"``.
    total : float
        Minutes of all logs together.
    thin : tuple of str
        The kinds that rest on little.
    """

    ranges: dict[str, tuple[float, float]]
    minutes: dict[str, float]
    total: float
    thin: tuple[str, ...]

    def sentence(self, units: dict[str, str]) -> str:
        """Return it in words, for a verdict."""
        seen = ", ".join(
            f"{name} between {low:.3g} and {high:.3g} {units.get(name, '1')}".removesuffix(" 1")
            for name, (low, high) in self.ranges.items()
        )
        said = [f"the logs cover {seen} (98 % of the readings)"]
        for kind in self.thin:
            minutes = self.minutes[kind]
            said.append(
                f"{kind} rests on {minutes:.0f} of {self.total:.0f} minutes"
                if minutes
                else f"{kind} never occurs"
            )
        return "; ".join(said)


def evidence(plant: Plant, logs: Sequence[Log]) -> Evidence:
    """Return what ``logs`` cover of a plant's inputs and outputs.

    Parameters
    ----------
    plant : Plant
    logs : sequence of Log

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_log
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("drive",), (), ("t",), A=[[0.9]], B=[[1.0]], C=[[1.0]], dt=1.0)
    >>> drive = np.where(np.arange(3600) < 3300, 0.5, -0.5)
    >>> signals = {"drive": (drive, "1", "input"), "t": (20 + 10 * drive, "degC", "output")}
    >>> seen = evidence(Plant(block, {}, dt=1.0), [make_log(np.arange(3600.0), signals)])
    >>> seen.sentence({"t": "degC"})
    'the logs cover t between 15 and 25 degC (98 % of the readings); drive < 0 rests on 5 of 60 minutes'
    """
    spent = [_spent(log) for log in logs]
    total = float(sum(part.sum() for part in spent)) / 60
    minutes: dict[str, float] = {}
    thin = []
    for name in plant.inputs:
        values = [column(log, name) for log in logs]
        kinds = _kinds(name, values, on_off=name in plant.model.switches)
        for kind, chosen in kinds.items():
            minutes[kind] = float(sum(part[mask].sum() for part, mask in zip(spent, chosen))) / 60
            if minutes[kind] < min(THIN_MINUTES, THIN_SHARE * total):
                thin.append(kind)
    ranges = {}
    for name in plant.outputs:
        low, high = np.nanpercentile(np.concatenate([column(log, name) for log in logs]), [1, 99])
        ranges[name] = (float(low), float(high))
    return Evidence(ranges, minutes, total, tuple(thin))


def _spent(log: Log) -> Array:
    """Return the seconds that each row's input was held."""
    steps = np.diff(np.asarray(log["time"].values, dtype=float))
    held = np.append(steps, np.median(steps) if steps.size else 0.0)
    return np.asarray(np.minimum(held, _LONGEST))


def _kinds(name: str, values: Sequence[Array], *, on_off: bool) -> dict[str, list[NDArray[np.bool_]]]:
    """Return the kinds of drive of an input and which rows are of each."""
    if on_off:
        return {f"{name} on": [v > 0.5 for v in values], f"{name} off": [v <= 0.5 for v in values]}
    low, high = min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)
    small = _SMALL * max(abs(low), abs(high))
    if low < -small:  # an input that goes both ways, such as a Peltier behind an H bridge
        return {f"{name} > 0": [v > small for v in values], f"{name} < 0": [v < -small for v in values]}
    middle = (low + high) / 2
    return {
        f"{name} above {middle:.3g}": [v > middle for v in values],
        f"{name} below {middle:.3g}": [v <= middle for v in values],
    }
