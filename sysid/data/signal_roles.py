"""What each column of several logs is taken for, why, and which guesses decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.schema import Log, column, log_name, names
from thermogrip.sysid.plant.log_grid import roles_of

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel


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
    still = [name for name in u if not moves(logs, name)] if network is not None else []
    if not still or network is None:
        return []
    still = [name for name in still if name not in network.switches]
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
    """Return the guesses of clock and roles that decide what was fitted; roles that are named are none."""
    kinds = ["clock_doubts"] + ([] if named_all else ["role_doubts"])
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
