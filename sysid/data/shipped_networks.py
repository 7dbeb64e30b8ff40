"""Which of the networks that come with the package the columns of logs can be.

A network fits logs that have a column for each of its signals, of the same name in whatever case, and then
has the columns' names.  One whose inputs the logs do not move is none, unless it is asked for: nothing could
be learnt about them.  Columns of other names are not matched by role and unit: on five public sets for which
one network alone would have fitted so, a black box was kept, after up to 1.6 times the CPU time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.roles import guess_role, is_room_temperature
from thermogrip.datasets.schema import Log, column
from thermogrip.sysid.data.preparation import moves
from thermogrip.sysid.models.network_spec import (
    SHARES,
    Disturbance,
    Input,
    Network,
    builtin_networks,
    named_network,
    network_from_dict,
)
from thermogrip.sysid.plant.log_grid import misfit

if TYPE_CHECKING:
    from thermogrip.sysid.models.network import NetworkModel

# keys of elements that name signals or places
_NAMING = ("between", "from", "to", "surroundings", "node", "face", "sink", "switch", "input")
_BESIDE_SENSOR = 1.0  # K, by which the air at the plant may differ from that at a sensor in its room


def shipped_network(logs: Sequence[Log]) -> NetworkModel | None:
    """Return the network of the package whose signals all logs have, under the columns' names, if any."""
    for network in map(named_network, builtin_networks()):
        columns = _by_name(network, logs[0])
        if columns is None:
            continue
        from thermogrip.sysid.models.network import NetworkModel  # only where it is one

        model = NetworkModel(renamed(network, columns))
        moved = [name for name in model.inputs if name not in model.switches]
        if all(misfit(model, log) is None for log in logs) and all(moves(logs, name) for name in moved):
            return model
    return None


def in_columns(model: NetworkModel, log: Log) -> NetworkModel:
    """Return a network under the names of a log's columns where these differ in case alone, else as it is."""
    columns = _by_name(model.network, log, needs_inputs=False)
    if columns is None or all(old == new for old, new in columns.items()):
        return model
    return type(model)(renamed(model.network, columns))


def in_log_units(model: NetworkModel, logs: Sequence[Log]) -> NetworkModel:
    """Return a network with ``full_scale``, ``range`` and ``step`` of inputs and disturbances in the logs'
    units."""
    tables: dict[str, dict[str, Input | Disturbance]] = {
        "inputs": dict(model.network.inputs),
        "disturbances": dict(model.network.disturbances),
    }
    changed = False
    for table in tables.values():
        for name, item in table.items():
            columns = [log for log in logs if name in log]
            unit = str(columns[0][name].attrs.get("units", "1")) if columns else item.unit
            if unit == item.unit or not {unit, item.unit} <= {*SHARES}:
                continue
            largest = max(float(np.nanmax(np.abs(column(log, name)), initial=0.0)) for log in columns)
            # a number of the network's own unit, which is not written
            bare = unit == "1" and largest > 1 + 1e-9
            own, theirs = (1.0, 1.0) if bare else (SHARES[item.unit], SHARES[unit])
            scaled: dict[str, Any] = {"unit": unit, "full_scale": item.full_scale * theirs / own}
            if isinstance(item, Input):
                scaled["range"] = tuple(end * theirs / own for end in item.range)
                scaled["step"] = None if item.step is None else item.step * theirs / own
            table[name] = item.model_copy(update=scaled)
            changed = True
    return type(model)(model.network.model_copy(update=tables)) if changed else model


def in_logged_room(model: NetworkModel, logs: Sequence[Log]) -> tuple[NetworkModel, list[str]]:
    """Return a network whose room nobody measures with the prior that a column of a room's name in all logs
    has of it, and a line on it."""
    network = model.network
    rooms = [item.temperature for item in network.boundaries.values() if _is_room(item.temperature, "degC")]
    signals = {*network.inputs, *network.disturbances, *network.outputs}
    units = {str(name): str(item.attrs.get("units", "1")) for name, item in logs[0].items()}
    logged = [n for n, unit in units.items() if n not in signals and _is_room(n, unit)]
    if len(rooms) != 1 or len(logged) != 1 or any(logged[0] not in log for log in logs):
        return model, []
    (room,), (name,) = rooms, logged
    readings = np.concatenate([column(log, name) for log in logs])
    value, prior = float(np.nanmean(readings)), network.parameters[room]
    if prior.fixed or not prior.bounds[0] <= value <= prior.bounds[1]:
        return model, []
    sd = float(np.hypot(_BESIDE_SENSOR, np.nanstd(readings)))
    prior_of_logs = prior.model_copy(
        update={"value": value, "sd": sd, "low": prior.bounds[0], "high": prior.bounds[1]}
    )
    parameters = dict(network.parameters) | {room: prior_of_logs}
    note = f"{room} of the network: {value:.1f} degC, within {sd:.1f}, as {name} of the logs reads"
    return type(model)(network.model_copy(update={"parameters": parameters})), [note]


def _is_room(name: str, unit: str) -> bool:
    return guess_role(name, unit) == "disturbance" and is_room_temperature(name, unit)


def renamed(network: Network, columns: Mapping[str, str]) -> Network:
    """Return the network with these names of its inputs, disturbances and outputs."""
    if all(old == new for old, new in columns.items()):
        return network

    def element(item: dict[str, Any]) -> dict[str, Any]:
        return {key: over(value) if key in _NAMING else value for key, value in item.items()}

    def over(value: Any) -> Any:
        return [columns.get(v, v) for v in value] if isinstance(value, list) else columns.get(value, value)

    content = network.model_dump(by_alias=True, exclude_none=True, mode="json")
    for group, table in content.items():
        if group in ("inputs", "disturbances", "outputs"):
            content[group] = {columns.get(name, name): element(item) for name, item in table.items()}
        elif isinstance(table, dict) and group != "parameters":
            content[group] = {name: element(item) for name, item in table.items()}
    return network_from_dict(content)


def _by_name(network: Network, log: Log, *, needs_inputs: bool = True) -> dict[str, str] | None:
    """Return the column of each signal that is called like it, in whatever case; None where one is absent."""
    written: dict[str, list[str]] = {}
    for name in log.data_vars:
        written.setdefault(str(name).lower(), []).append(str(name))
    signals = (*network.inputs, *network.disturbances, *network.outputs)
    columns_of = {name: written.get(name.lower(), []) for name in signals}
    columns_of |= {name: [name] for name in columns_of if name in log}
    if not needs_inputs:
        upper = all(same[0].isupper() for same in columns_of.values() if same)
        columns_of |= {n: [n.upper() if upper else n] for n in network.inputs if not columns_of[n]}
    return (
        {name: same[0] for name, same in columns_of.items()} if all(map(len, columns_of.values())) else None
    )
