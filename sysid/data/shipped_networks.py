"""Which of the networks that come with the package the columns of logs can be.

A network fits logs that have a column for each of its signals: of the same name, in whatever case, or, where
no network's names are there, as many columns of each role in units that convert (a switch reads 0 or 1), in
the order in which they stand. The latter only where one network alone fits, and where an output is a
temperature by its unit or its name. The network then has the columns' names. One whose inputs the logs do not
move is none, unless it is asked for: nothing could be learnt about them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.roles import guess_role, is_room_temperature
from thermogrip.datasets.schema import Log, column, names
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import (
    Network,
    builtin_networks,
    named_network,
    network_from_dict,
)
from thermogrip.sysid.plant.log_grid import SHARES, misfit

# keys of elements that name signals or places
_NAMING = ("between", "from", "to", "surroundings", "node", "face", "sink", "switch", "input")
_BESIDE_SENSOR = 1.0  # K, by which the air at the plant may differ from that at a sensor in its room
_TEMPERATURE_NAME = re.compile(r"(t|tc|temp|temperature)[ _]?[a-z0-9]{0,2}", re.IGNORECASE)


def shipped_network(logs: Sequence[Log]) -> NetworkModel | None:
    """Return the network of the package whose signals all logs have, under the columns' names, if there is
    one."""
    networks = [named_network(name) for name in builtin_networks()]
    for network in networks:
        if (named := _fitting(network, _by_name(network, logs[0]), logs)) is not None:
            return named
    likely = [_fitting(network, _by_role(network, logs), logs) for network in networks]
    alone = [network for network in likely if network is not None]
    return alone[0] if len(alone) == 1 else None


def in_columns(model: NetworkModel, log: Log) -> NetworkModel:
    """Return a network under the names of a log's columns where these differ in case alone, else as it is."""
    columns = _by_name(model.network, log, needs_inputs=False)
    if columns is None or all(old == new for old, new in columns.items()):
        return model
    return NetworkModel(renamed(model.network, columns))


def in_log_units(model: NetworkModel, logs: Sequence[Log]) -> NetworkModel:
    """Return a network that takes its inputs in the logs' units, so that plant and controller speak them.

    A share of full scale is one in every unit: ``full_scale``, ``range`` and ``step`` are written in that of
    the logs.
    """
    inputs = dict(model.network.inputs)
    for name, item in inputs.items():
        columns = [log for log in logs if name in log]
        unit = str(columns[0][name].attrs.get("units", "1")) if columns else item.unit
        if unit == item.unit or not {unit, item.unit} <= {*SHARES}:
            continue
        largest = max(float(np.nanmax(np.abs(column(log, name)), initial=0.0)) for log in columns)
        bare = unit == "1" and largest > 1 + 1e-9  # a number of the network's own unit, which is not written
        network_share, theirs = (1.0, 1.0) if bare else (SHARES[item.unit], SHARES[unit])
        scaled = {"full_scale": item.full_scale * theirs / network_share, "unit": unit}
        scaled["range"] = tuple(end * theirs / network_share for end in item.range)
        scaled["step"] = None if item.step is None else item.step * theirs / network_share
        inputs[name] = item.model_copy(update=scaled)
    if all(item is model.network.inputs[name] for name, item in inputs.items()):
        return model
    return NetworkModel(model.network.model_copy(update={"inputs": inputs}))


def in_logged_room(model: NetworkModel, logs: Sequence[Log]) -> tuple[NetworkModel, list[str]]:
    """Return a network whose room nobody measures with the prior that the logs have of it, and a line on it.

    A room is a boundary with a name of surroundings.  All logs have one column of such a name, in degC, that
    is no signal of the network, whether it moves or not.
    """
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
    return NetworkModel(network.model_copy(update={"parameters": parameters})), [note]


def _is_room(name: str, unit: str) -> bool:
    return guess_role(name, unit) == "disturbance" and is_room_temperature(name, unit)


def _fitting(network: Network, columns: Mapping[str, str] | None, logs: Sequence[Log]) -> NetworkModel | None:
    """Return the network with these columns as its signals; None where it does not fit the logs."""
    if columns is None:
        return None
    try:
        model = NetworkModel(renamed(network, columns))
    except UserError:  # a column is called like one of its parts
        return None
    moved = [name for name in model.inputs if name not in model.switches]
    fits = all(misfit(model, log) is None for log in logs) and all(_moves(logs, name) for name in moved)
    return model if fits else None


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
    """Return the column of each signal that is called like it, in whatever case; None where one is absent. An
    input may be where it is not needed; it then has the case of the others."""
    written: dict[str, list[str]] = {}
    for name in log.data_vars:
        written.setdefault(str(name).lower(), []).append(str(name))
    columns_of = {
        name: written.get(name.lower(), []) for group in _tables(network).values() for name in group
    }
    columns_of |= {name: [name] for name in columns_of if name in log}
    if not needs_inputs:
        upper = all(same[0].isupper() for same in columns_of.values() if same)
        columns_of |= {n: [n.upper() if upper else n] for n in network.inputs if not columns_of[n]}
    return (
        {name: same[0] for name, same in columns_of.items()} if all(map(len, columns_of.values())) else None
    )


def _by_role(network: Network, logs: Sequence[Log]) -> dict[str, str] | None:
    """Return the column of each signal by role, unit and order; None where they are not as many."""
    log, columns_of = logs[0], dict[str, str]()
    for role, table in _tables(network).items():
        columns = [name for name in names(log, role) if _moves(logs, name)]
        wanted = [name for name, item in table.items() if not getattr(item, "switch", False)]
        switches = [name for name in table if name not in wanted]
        on_off = [name for name in columns if switches and set(column(log, name)) <= {0.0, 1.0}]
        graded = [name for name in columns if name not in on_off]
        if (len(on_off), len(graded)) != (len(switches), len(wanted)):
            return None
        if not all(_suits(log, name, table[of]) for name, of in zip(graded, wanted)):
            return None
        columns_of |= dict(zip([*wanted, *switches], [*graded, *on_off]))
    return columns_of


def _suits(log: Log, name: str, item: Any) -> bool:
    """Tell whether a column may be a signal: it has its unit, or one that converts; a temperature without a
    unit follows from its name, a drive of both signs by its readings."""
    has = str(log[name].attrs.get("units", "1"))
    if item.unit == "degC":
        return has == item.unit or (has == "1" and _TEMPERATURE_NAME.fullmatch(name) is not None)
    signed = bool(getattr(item, "range", (0, 0))[0] < 0)
    convertible = has == item.unit or (has in SHARES and item.unit in SHARES)
    return convertible and signed == bool(np.nanmin(column(log, name)) < 0)


def _tables(network: Network) -> dict[str, Mapping[str, Any]]:
    """Return the signals of each role."""
    return {"input": network.inputs, "disturbance": network.disturbances, "output": network.outputs}


def _moves(logs: Sequence[Log], name: str) -> bool:
    values = np.concatenate([column(log, name) for log in logs if name in log])
    return bool(np.nanmax(values, initial=-np.inf) > np.nanmin(values, initial=np.inf))
