"""What of the logs is fitted: what each column is taken for and why, and rest before an only move.

A step test is often recorded from the step on: a row or two of the plant at rest, the step, and no other
move. What a plant does from an unknown start is then the same as what the step does to it, so no gain follows
from such a log alone. It does if the plant rested before the first row, as its readings up to the step say
where they are flat.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.schema import Log, column, columns, log_name, names
from thermogrip.sysid.data.data_quality import reading_excess
from thermogrip.sysid.plant.log_grid import MOVED, quantum, roles_of, rows_of
from thermogrip.sysid.plant.plant_data import fit_logs

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel

_EARLY = 10  # rows: more of them before the move are a rest of their own
_ADDED = 50  # rows
_FLAT = 6.0  # sd of the readings' noise: ten of them differ by more once in a thousand times


@dataclass(frozen=True)
class SignalRole:
    """What a column of the logs was taken for."""

    name: str
    unit: str
    role: str  # ``"input"``, ``"disturbance"``, ``"output"`` or ``"left out"``
    why: str  # who states the role, or what the guess rests on
    guessed: bool


def without_still(logs: list[Log]) -> list[Log]:
    """Return the logs with guessed inputs and outputs that never move as ``other``, if others of them do."""
    guesses = _guesses(logs)
    for role in ("input", "output"):
        group = names(logs[0], role)
        still = [name for name in group if not moves(logs, name)]
        if len(still) < len(group):
            changed = [name for name in still if name in guesses]
            logs = [
                log.assign({n: log[n].assign_attrs(role="other") for n in changed if n in log})
                for log in logs
            ]
    return logs


def still_inputs(network: GreyModel | None, logs: Sequence[Log], u: Sequence[str]) -> list[str]:
    """Return the inputs of a network, switches aside, that never move, if others of them do."""
    if network is None:
        return []
    still = [name for name in u if name not in network.switches and not moves(logs, name)]
    return still if len(still) < len(u) else []


def moves(logs: Sequence[Log], name: str) -> bool:
    """Tell whether the readings of a column, if it has any, differ over the logs."""
    values = np.concatenate([column(log, name) for log in logs if name in log])
    return not np.isfinite(values).any() or bool(np.nanmax(values) > np.nanmin(values))


def _guesses(logs: Sequence[Log]) -> dict[str, str]:
    """Return by column what the guess of its role rests on; the first log has precedence."""
    lines = [line for log in reversed(logs) for line in str(log.attrs.get("guesses", "")).splitlines()]
    return dict(line.split(": ", 1) for line in lines if ": " in line)


def role_doubts(logs: Sequence[Log], *, named_all: bool) -> tuple[str, ...]:
    """Return what is in doubt and decides what was fitted: where roles are named, clock and readings."""
    kinds = ["clock_doubts", "reading_doubts" if named_all else "role_doubts"]
    lines = [line for log in logs for kind in kinds for line in str(log.attrs.get(kind, "")).splitlines()]
    return tuple(dict.fromkeys(lines))


def signal_roles(
    logs: Sequence[Log],
    groups: tuple[Sequence[str], Sequence[str], Sequence[str]],
    lists: Mapping[str, Sequence[str] | None],
    network: GreyModel | None,
    still: Sequence[str] = (),
) -> tuple[tuple[SignalRole, ...], list[str]]:
    """Return what each column of the logs was taken for, and, where no list names them, a line for each log
    with signals that the first one does not have."""
    units, guesses = dict[str, str](), _guesses(logs)
    for log in reversed(logs):  # the first log has precedence
        units |= {str(name): str(item.attrs.get("units", "1")) for name, item in log.items()}
    of_network = {} if network is None else roles_of(network)
    taken = {name: r for r, group in zip(("input", "disturbance", "output"), groups) for name in group}
    out = []
    for name in (*taken, *(n for n in units if n not in taken)):
        role = taken.get(name, "left out")
        why, guessed = "given by the log", False
        if role != "left out" and name in (lists[f"{role}s"] or ()):
            why = "named"
        elif of_network.get(name) == role and network is not None:
            why = f"network {network.name}"
            if name in still:
                why += "; it never moves: what it does is known from the prior only"
        elif name in guesses:
            why, guessed = guesses[name], True
            taken_for = why.startswith(
                ("its name is that of a drive", "its name is that of a read", "its unit")
            )
            if role == "left out" and taken_for and not moves(logs, name):
                why += ", but it never moves"
        elif role == "left out":
            why = "not named"
        out.append(SignalRole(name, units[name], role, why, guessed))
    unused = []
    for log in logs[1:] if all(words is None for words in lists.values()) else ():
        signals_of = (name for role in ("input", "output", "disturbance") for name in names(log, role))
        if more := ", ".join(name for name in signals_of if name not in taken):
            unused.append(f"{log_name(log)}: {more} left out, for {log_name(logs[0])} has no such signal")
    return tuple(out), unused


def with_rest(
    logs: Sequence[Log], inputs: Sequence[str], outputs: Sequence[str]
) -> tuple[list[Log], list[str]]:
    """Return the logs, and a line for each to which rows of rest were added at its start: of logs whose
    inputs move in their first ten rows alone, those with flat readings up to the move."""
    moved = _moved_rows(logs, inputs)
    if not _moved_early_alone(moved):
        return list(logs), []
    out, notes = [], []
    for log, rows in zip(logs, moved):
        if not len(rows) or not (at_rest := _first_readings(log, outputs, int(rows[0]) + 1)):
            out.append(log)
            continue
        time = np.asarray(log["time"].values, dtype=float)
        before = time[0] - float(np.median(np.diff(time))) * np.arange(_ADDED, 0, -1)
        longer = log.isel(time=np.r_[np.zeros(_ADDED, dtype=int), : len(time)])
        longer = longer.assign_coords(time=("time", np.r_[before, time], log["time"].attrs))
        for name, value in at_rest.items():
            longer[name] = longer[name].copy(data=np.r_[np.full(_ADDED, value), log[name].values])
        out.append(longer.assign_attrs(sha256=fit_logs([log])[0].sha256))
        notes.append(
            f"{log_name(log)}: begins with the only move of an input; taken to have rested at its first "
            f"readings before ({_ADDED} rows of that are in the fit): record a minute of rest to make sure"
        )
    return out, notes


def doubt_of_gains(logs: Sequence[Log], inputs: Sequence[str]) -> list[str]:
    """Return a line where the inputs of all logs, with the rest that was added, move in first rows alone."""
    if not _moved_early_alone(_moved_rows(logs, inputs)):
        return []
    name = inputs[0] if len(inputs) == 1 else "each input"
    return [
        f"{name} moves in the first rows alone, where the plant was not at rest: no gain follows from that "
        "(record a minute of rest before the move, or move it again)"
    ]


def _moved_rows(logs: Sequence[Log], inputs: Sequence[str]) -> list[NDArray[np.int64]]:
    """Return for each log the rows at which an input is another than before."""
    u = [columns(log, inputs) for log in logs]
    least = MOVED * np.ptp(np.concatenate(u), axis=0)
    changes = [np.any(np.abs(np.diff(inputs_of_log, axis=0)) > least, axis=1) for inputs_of_log in u]
    return [np.flatnonzero(change) + 1 for change in changes]


def _moved_early_alone(moved: Sequence[NDArray[np.int64]]) -> bool:
    return any(map(len, moved)) and all(rows[-1] <= _EARLY for rows in moved if len(rows))


def _first_readings(log: Log, outputs: Sequence[str], n: int) -> dict[str, float]:
    """Return the mean of the first n readings of each output; none where those of one move, or are lost."""
    whole = columns(log, outputs)
    noise = reading_excess([rows_of(log, (), outputs, ())], outputs, np.inf)
    means = {}
    for name, y in zip(outputs, whole.T):
        first: Array = y[:n][np.isfinite(y[:n])]
        if not first.size or np.ptp(first) > max(1.01 * quantum(y), _FLAT * noise[name]):
            return {}
        means[name] = float(first.mean())
    return means
