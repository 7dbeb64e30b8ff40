"""What the guard allows, read from TOML: every key with its unit, its default, and the range it may have.

The template, ``guard.toml``, is the documentation; ``thermogrip init guard`` writes it.  A file that
is wrong anywhere is refused as a whole: a limit that is not understood would be a limit that is not kept.
No file can switch a check off: each number has a range in which the check still works.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import Field, fields
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

from thermogrip.datasets.atomic_files import read_toml
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.units import split_header
from thermogrip.rig.guard.guard import GuardSettings, RuleSettings
from thermogrip.rig.guard.model_checks import ModelSettings
from thermogrip.rig.guard.sensor_checks import SensorSettings

GUARD_TEMPLATE = (files(__package__) / "guard.toml").read_text(encoding="utf-8")

_TEMPLATE_HINT = "`thermogrip init guard` shows every key with its unit"


_TABLES: dict[str, type[Any]] = {"sensors": SensorSettings, "model": ModelSettings, "no_model": RuleSettings}


def _setting_keys(kind: type[Any]) -> dict[str, Field[Any]]:
    """Return the settings of a kind by their keys (:func:`~thermogrip.datasets.limits.keyed`)."""
    return {one.metadata["key"]: one for one in fields(kind) if one.metadata}


def read_guard(path: str | Path) -> GuardSettings:
    """Return what the guard allows, from a TOML file.

    Parameters
    ----------
    path : str or Path
        As ``thermogrip init guard`` writes it; what is left out has its default.

    Raises
    ------
    UserError
        Naming the file and the key that is wrong.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "guard.toml"
    >>> n = path.write_text("[limits]\\nt_tank = [2, 65]\\n")
    >>> read_guard(path).limits
    {'t_tank': (2.0, 65.0)}
    """
    return guard_from_dict(read_toml(path, hint="`thermogrip init guard` writes one to edit"), file=path)


def guard_from_dict(content: Mapping[str, Any], *, file: str | Path | None = None) -> GuardSettings:
    """Return settings from plain values; a wrong or unknown key is a :class:`UserError` that names it."""
    tables = {name: content[name] for name in (*_TABLES, "limits") if name in content}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise UserError(f"{name}: is no table", file=file, hint=f"write [{name}] above its keys")
    single = {key: value for key, value in content.items() if key not in (*tables, "pairs", "room_sensors")}
    values = _table_values(single, GuardSettings, "", file)
    if "room_sensors" in content:
        values["rooms"] = _name_tuple(content["room_sensors"], file)
    values["limits"] = {name: _limit(name, pair, file) for name, pair in tables.get("limits", {}).items()}
    for name, kind in _TABLES.items():
        table_values = _table_values(tables.get(name, {}), kind, f"{name}.", file)
        if name == "sensors":
            table_values["pairs"] = _pairs(content.get("pairs", []), file)
        values["rules" if name == "no_model" else name] = kind(**table_values)
    settings = GuardSettings(**values, file="" if file is None else str(file))
    for problem, hint in _setting_faults(settings):
        raise UserError(problem, file=file, hint=hint)
    return settings


def _table_values(
    table: Mapping[str, Any], kind: type[Any], where: str, file: str | Path | None
) -> dict[str, Any]:
    """Return the settings of a table by name; a key that is unknown, or a value outside, is refused."""
    values_by_name, keys = {}, _setting_keys(kind)
    for name, value in table.items():
        if name not in keys:
            raise UserError(f"{where}{name}: no such key", file=file, hint=_instead(name, keys))
        values_by_name[keys[name].name] = _value(f"{where}{name}", value, keys[name], file)
    return values_by_name


def _instead(name: str, keys: Mapping[str, Any]) -> str:
    """Return what to do about an unknown key: its unit, its table, or a similar key."""
    similar = [key for key in keys if key.startswith(f"{name}_")] or get_close_matches(name, keys, 1)
    tables = [table for table, kind in _TABLES.items() if name in _setting_keys(kind)]
    if tables:
        return f"write it below [{tables[0]}]"
    return f"write {similar[0]}; {_TEMPLATE_HINT}" if similar else _TEMPLATE_HINT


def _value(name: str, value: Any, key: Field[Any], file: str | Path | None) -> Any:
    """Return a value of the form that the setting's type asks for: a number, a whole one, a pair, a list."""
    hint, span = f"write one that is, or leave it out for {_toml_text(key.default)}", key.metadata["range"]
    if "tuple" in str(key.type):
        pair = key.type == "tuple[float, float]"
        if not isinstance(value, list) or len(value) not in ((2,) if pair else range(1, 7)):
            form = "a pair [lowest, highest]" if pair else "a list of 1 to 6 numbers"
            raise UserError(f"{name}: {value!r} is not {form}", file=file, hint=hint)
        return tuple(_checked_number(name, one, span, hint, file) for one in value)
    number = _checked_number(name, value, span, hint, file)
    if key.type != "int":
        return number
    if number != int(number):
        raise UserError(f"{name}: {value!r} is not a whole number", file=file, hint=hint)
    return int(number)


def _checked_number(
    name: str, value: Any, span: tuple[float, float], hint: str, file: str | Path | None
) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{name}: {value!r} is not a number", file=file, hint=hint)
    if not span[0] <= value <= span[1]:  # also false for NaN
        raise UserError(f"{name}: {value:g} is not from {span[0]:g} to {span[1]:g}", file=file, hint=hint)
    return float(value)


def _limit(name: str, pair: Any, file: str | Path | None) -> tuple[float, float]:
    try:
        bare, unit = split_header(name)
    except UserError:
        bare, unit = name.rpartition("_")[0], ""  # as people write degrees: t_tank_C
    if unit != "1":
        hint = f"write {bare}, and its limits in degC"
        raise UserError(f"limits.{name}: is not the name of a sensor", file=file, hint=hint)
    low, high = _value(f"limits.{name}", pair, _setting_keys(GuardSettings)["others_degC"], file)
    return low, high


def _name_tuple(value: Any, file: str | Path | None) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise UserError("room_sensors: is no list of names", file=file, hint='write room_sensors = ["t_lab"]')
    return tuple(value)


def _pairs(tables: Any, file: str | Path | None) -> dict[tuple[str, str], float]:
    """Return by how much two sensors of one temperature may differ [K]."""
    pair_limits = {}
    hint = 'write [[pairs]], sensors = ["a", "b"], limit_K = 4.0'
    for table in tables if isinstance(tables, list) else [tables]:
        if not isinstance(table, dict) or set(table) != {"sensors", "limit_K"}:
            raise UserError("pairs: needs sensors and limit_K, nothing else", file=file, hint=hint)
        names = table["sensors"]
        if not isinstance(names, list) or len(names) != 2 or not all(isinstance(n, str) for n in names):
            raise UserError("pairs.sensors: is not two names", file=file, hint=hint)
        limit = _checked_number("pairs.limit_K", table["limit_K"], (0.1, 50), hint, file)
        pair_limits[str(names[0]), str(names[1])] = limit
    return pair_limits


def _setting_faults(settings: GuardSettings) -> Iterator[tuple[str, str]]:
    """Yield (problem, hint) for numbers that contradict each other."""
    low, high = settings.sensors.plausible
    ranges = {"skin_degC": settings.skin_limits, "others_degC": settings.other_limits}
    ranges |= {f"limits.{name}": pair for name, pair in settings.limits.items()}
    for name, (least, most) in {"sensors.believable_degC": (low, high), **ranges}.items():
        if not least < most:
            yield f"{name}: {least:g} to {most:g} is empty", "write the lower one first"
        elif not low <= least <= most <= high:
            problem = f"{name}: {least:g} to {most:g} reaches beyond the plausible range, {low:g} to {high:g}"
            yield problem, "narrow it, or widen sensors.believable_degC"
    w = settings.model
    if len(w.windows) != len(w.floors):
        yield (
            f"model: {len(w.windows)} windows_s and {len(w.floors)} floors_K",
            "write a floor for each window",
        )
    if list(w.windows) != sorted(set(w.windows)):
        yield f"model.windows_s: {_toml_text(w.windows)} do not rise", "write the shortest first"
    elif not w.smooth < w.windows[0]:
        problem = f"model.smooth_s: {w.smooth:g} is not less than the shortest window, {w.windows[0]:g}"
        yield problem, "shorten it"


def _toml_text(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{one:g}" for one in value) + "]"
    return f"{value:g}"
