"""A log as a model names and measures its signals: which columns it takes, in which role, in which unit.

A column's name says little about its role: ``t_room`` is what a plant of a room predicts, and what a plant of
a heater is disturbed by.  Where a model is at hand, its roles hold.

Shares of full scale come as ``1`` (-1 to 1), ``percent`` or ``0_255``: one is a multiple of the other, so
they are converted.  A column without a unit may be a share or a bare number of the model's own unit; values
beyond 1 distinguish them.  Any other difference of units is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, column, log_name

__all__ = ["SHARES", "Signals", "match_log", "match_logs", "misfit", "roles_of"]

#: What full scale reads in the units of a share of it.
SHARES = {"1": 1.0, "percent": 100.0, "0_255": 255.0}
_SLACK = 1e-9  # beyond 1, by rounding


class Signals(Protocol):
    """What is asked of a plant or of a model here."""

    @property
    def inputs(self) -> tuple[str, ...]: ...
    @property
    def disturbances(self) -> tuple[str, ...]: ...
    @property
    def outputs(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> Mapping[str, str]: ...


def roles_of(model: Signals) -> dict[str, str]:
    """Return the role of each signal of a model."""
    groups = (("input", model.inputs), ("disturbance", model.disturbances), ("output", model.outputs))
    return {name: role for role, group in groups for name in group}


def misfit(model: Signals, log: Log) -> UserError | None:
    """Return why the model cannot take this log (a signal that is absent, a unit), None where it can."""
    lost = [f"{role} {name}" for name, role in roles_of(model).items() if name not in log]
    if lost:
        have = ", ".join(str(name) for name in log.data_vars)
        return UserError(f"has no {', no '.join(lost)}", file=log_name(log), hint=f"its columns are {have}")
    try:
        match_log(model, log)
    except UserError as error:
        return error
    return None


def match_log(model: Signals, log: Log) -> tuple[Log, list[str]]:
    """Return one log in the model's roles and units, and what was converted; see :func:`match_logs`."""
    logs, said = match_logs(model, [log])
    return logs[0], said


def match_logs(
    model: Signals, logs: Sequence[Log], *, keep_others: bool = False
) -> tuple[list[Log], list[str]]:
    """Return logs in the model's roles and units, and what was converted, a line a column.

    A log that fits as it is is returned itself.
    """
    largest = {name: _largest([column(log, name) for log in logs]) for name in roles_of(model)}
    out, said = [], dict[str, None]()
    for log in logs:
        matched, words = _matched(model, log, largest, keep_others)
        out.append(matched)
        said |= dict.fromkeys(words)
    return out, list(said)


def _matched(
    model: Signals, log: Log, largest: Mapping[str, float], keep_others: bool
) -> tuple[Log, list[str]]:
    known, changed, said = roles_of(model), {}, []
    for name in known:
        unit, want = str(log[name].attrs.get("units", "1")), model.units.get(name)
        if want is None or unit == want:
            continue
        low, high = getattr(model, "valid", {}).get(name, (0.0, 0.0))  # of what a plant was fitted to
        if unit not in SHARES or want not in SHARES or (want == "1" and max(-low, high) > 1 + _SLACK):
            raise UserError(
                f"is in {unit!r}, the plant's is in {want!r}",
                file=log_name(log),
                column=name,
                hint="convert it" if want != "1" else "convert it, or leave the unit away if it is the same",
            )
        if unit == "1" and largest[name] > 1 + _SLACK:
            changed[name] = column(log, name)
            said.append(f"{name}: has no unit and values up to {largest[name]:g}, taken as {want}")
        else:
            changed[name] = column(log, name) * (SHARES[want] / SHARES[unit])
            said.append(f"{name}: converted from {unit} to {want}")
    roles = {
        str(key): known.get(str(key), str(item.attrs.get("role")) if keep_others else "other")
        for key, item in log.items()
    }
    if not changed and all(item.attrs.get("role") == roles[str(key)] for key, item in log.items()):
        return log, said
    out = log.copy()
    for key, item in log.items():
        name = str(key)
        attrs = item.attrs | {"role": roles[name]}
        if name in changed:
            attrs["units"] = model.units[name]
        out[name] = ("time", changed.get(name, item.values), attrs)
    return out, said


def _largest(columns: Sequence[NDArray[np.float64]]) -> float:
    return max((float(np.nanmax(np.abs(values), initial=0.0)) for values in columns), default=0.0)
