"""What the guard allows, read from TOML: every key with its unit, its default, and the range it may have.

The template, ``guard.toml``, is the documentation; ``thermogrip init guard`` writes it.  A file that
is wrong anywhere is refused as a whole: a limit that is not understood would be a limit that is not kept.
No file can switch a check off: each number has a range in which the check still works.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

from thermogrip.datasets.atomic_files import read_toml
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.units import split_header
from thermogrip.rig.guard.guard import GuardSettings
from thermogrip.rig.guard.model_checks import ModelSettings
from thermogrip.rig.guard.plant_mismatch import MOST_DRIFT
from thermogrip.rig.guard.rule_checks import RuleSettings
from thermogrip.rig.guard.sensor_checks import SensorSettings

GUARD_TEMPLATE = (files(__package__) / "guard.toml").read_text(encoding="utf-8")

_TEMPLATE_HINT = "`thermogrip init guard` shows every key with its unit"


@dataclass(frozen=True)
class _Key:
    """A key: the setting that it is, and the least and the most that it may be."""

    setting: str
    low: float
    high: float
    form: str = "number"  # or whole, pair, list


_TOP = {
    "skin_degC": _Key("skin_limits", -50, 150, "pair"),
    "others_degC": _Key("other_limits", -50, 150, "pair"),
    "stale_s": _Key("stale_s", 0.5, 60),
    "expiry_s": _Key("expiry_s", 0.5, 2),
    "clock_slack_s": _Key("clock_slack_s", 0.1, 60),
    "drive_slack": _Key("drive_slack", 0.005, 0.5),
    "forget_s": _Key("forget_s", 0, 3600),
}
_TABLES: dict[str, tuple[str, type[Any], dict[str, _Key]]] = {
    "sensors": (
        "sensors",
        SensorSettings,
        {
            "believable_degC": _Key("plausible", -50, 150, "pair"),
            "rate_K_per_s": _Key("rate", 0.05, 100),
            "slack_K": _Key("slack", 0, 10),
            "bad_in_a_row": _Key("bad_in_a_row", 1, 20, "whole"),
            "noise_K": _Key("noise", 0.001, 5),
            "alpha": _Key("alpha", 1e-15, 1e-3),
            "pair_limit_K": _Key("pair_limit", 0.1, 50),
            "pair_s": _Key("pair_s", 0, 3600),
        },
    ),
    "model": (
        "model",
        ModelSettings,
        {
            "windows_s": _Key("windows", 2, 600, "list"),
            "floors_K": _Key("floors", 0.05, 20, "list"),
            "share": _Key("share", 0, 2),
            "switching_K": _Key("switching", 0, 20),
            "smooth_s": _Key("smooth", 0, 60),
            "jump_k": _Key("jump_k", 3, 100),
            "jump_floor_K": _Key("jump_floor", 0.1, 50),
            "bias_limit_K": _Key("bias_limit", 0.1, 20),
            "drive_limit": _Key("drive_limit", 0.01, 0.45),
            "warm_up_s": _Key("warm_up", 0, 3600),
            "drift": _Key("drift", 0, MOST_DRIFT),
            "state_K_per_sqrt_s": _Key("state", 1e-4, 1),
            "drive_per_sqrt_s": _Key("drive", 1e-5, 0.1),
            "output_K_per_sqrt_s": _Key("output", 1e-5, 1),
            "reading_K": _Key("reading", 0.001, 5),
        },
    ),
    "no_model": (
        "rules",
        RuleSettings,
        {
            "window_s": _Key("window", 5, 3600),
            "drive": _Key("drive", 0.01, 1),
            "least_K": _Key("least", 0.05, 50),
            "far_K": _Key("far", 0.5, 100),
            "wrong_K": _Key("wrong", 0.05, 50),
            "near_K": _Key("near", 0.05, 50),
            "leave_K": _Key("leave", 0.1, 50),
            "area_K_s": _Key("area", 1, 1e5),
        },
    ),
}


def read_guard(path: str | Path) -> GuardSettings:
    """Read what the guard allows from a TOML file.

    Parameters
    ----------
    path : str or Path
        As ``thermogrip init guard`` writes it; what is left out has its default.

    Returns
    -------
    settings : GuardSettings

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
    values = _values(single, _TOP, GuardSettings(), "", file)
    if "room_sensors" in content:
        values["rooms"] = _names(content["room_sensors"], file)
    values["limits"] = {name: _limit(name, pair, file) for name, pair in tables.get("limits", {}).items()}
    for name, (setting, kind, keys) in _TABLES.items():
        found = _values(tables.get(name, {}), keys, kind(), f"{name}.", file)
        if name == "sensors":
            found["pairs"] = _pairs(content.get("pairs", []), file)
        values[setting] = kind(**found)
    settings = GuardSettings(**values, file="" if file is None else str(file))
    for problem, hint in _faults(settings):
        raise UserError(problem, file=file, hint=hint)
    return settings


def _values(
    table: Mapping[str, Any], keys: Mapping[str, _Key], usual: Any, where: str, file: str | Path | None
) -> dict[str, Any]:
    """Return the settings of a table by name; a key that is unknown, or a value outside, is refused."""
    found = {}
    for name, value in table.items():
        if name not in keys:
            raise UserError(f"{where}{name}: no such key", file=file, hint=_instead(name, keys))
        key = keys[name]
        found[key.setting] = _value(f"{where}{name}", value, key, getattr(usual, key.setting), file)
    return found


def _instead(name: str, keys: Mapping[str, _Key]) -> str:
    """Return what to do about an unknown key: its unit, its table, or a similar key."""
    near = [key for key in keys if key.startswith(f"{name}_")] or get_close_matches(name, keys, 1)
    tables = [table for table, (_, _, others) in _TABLES.items() if name in others]
    if tables:
        return f"write it below [{tables[0]}]"
    return f"write {near[0]}; {_TEMPLATE_HINT}" if near else _TEMPLATE_HINT


def _value(name: str, value: Any, key: _Key, usual: Any, file: str | Path | None) -> Any:
    hint = f"write one that is, or leave it out for {_text(usual)}"
    if key.form in ("pair", "list"):
        n = 2 if key.form == "pair" else len(value) if isinstance(value, list) else 0
        if not isinstance(value, list) or len(value) != n or not 1 <= n <= 6:
            what = "a pair [lowest, highest]" if key.form == "pair" else "a list of 1 to 6 numbers"
            raise UserError(f"{name}: {value!r} is not {what}", file=file, hint=hint)
        return tuple(_number(name, one, key, hint, file) for one in value)
    number = _number(name, value, key, hint, file)
    if key.form == "whole":
        if number != int(number):
            raise UserError(f"{name}: {value!r} is not a whole number", file=file, hint=hint)
        return int(number)
    return number


def _number(name: str, value: Any, key: _Key, hint: str, file: str | Path | None) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{name}: {value!r} is not a number", file=file, hint=hint)
    if not key.low <= value <= key.high:  # also false for NaN
        raise UserError(f"{name}: {value:g} is not from {key.low:g} to {key.high:g}", file=file, hint=hint)
    return float(value)


def _limit(name: str, pair: Any, file: str | Path | None) -> tuple[float, float]:
    try:
        bare, unit = split_header(name)
    except UserError:
        bare, unit = name.rpartition("_")[0], ""  # as people write degrees: t_tank_C
    if unit != "1":
        hint = f"write {bare}, and its limits in degC"
        raise UserError(f"limits.{name}: is not the name of a sensor", file=file, hint=hint)
    low, high = _value(f"limits.{name}", pair, _TOP["others_degC"], GuardSettings().other_limits, file)
    return low, high


def _names(value: Any, file: str | Path | None) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise UserError("room_sensors: is no list of names", file=file, hint='write room_sensors = ["t_lab"]')
    return tuple(value)


def _pairs(tables: Any, file: str | Path | None) -> dict[tuple[str, str], float]:
    """Return by how much two sensors of one temperature may differ [K]."""
    found = {}
    hint = 'write [[pairs]], sensors = ["a", "b"], limit_K = 4.0'
    for table in tables if isinstance(tables, list) else [tables]:
        if not isinstance(table, dict) or set(table) != {"sensors", "limit_K"}:
            raise UserError("pairs: needs sensors and limit_K, nothing else", file=file, hint=hint)
        names = table["sensors"]
        if not isinstance(names, list) or len(names) != 2 or not all(isinstance(n, str) for n in names):
            raise UserError("pairs.sensors: is not two names", file=file, hint=hint)
        limit = _number("pairs.limit_K", table["limit_K"], _Key("", 0.1, 50), hint, file)
        found[str(names[0]), str(names[1])] = limit
    return found


def _faults(settings: GuardSettings) -> Sequence[tuple[str, str]]:
    """Return (problem, hint) for numbers that contradict each other."""
    found = []
    low, high = settings.sensors.plausible
    ranges = {"skin_degC": settings.skin_limits, "others_degC": settings.other_limits}
    ranges |= {f"limits.{name}": pair for name, pair in settings.limits.items()}
    for name, (least, most) in {"sensors.believable_degC": (low, high), **ranges}.items():
        if not least < most:
            found.append((f"{name}: {least:g} to {most:g} is empty", "write the lower one first"))
        elif not low <= least <= most <= high:
            problem = f"{name}: {least:g} to {most:g} reaches beyond the plausible range, {low:g} to {high:g}"
            found.append((problem, "narrow it, or widen sensors.believable_degC"))
    w = settings.model
    if len(w.windows) != len(w.floors):
        problem = f"model: {len(w.windows)} windows_s and {len(w.floors)} floors_K"
        found.append((problem, "write a floor for each window"))
    if list(w.windows) != sorted(set(w.windows)):
        found.append((f"model.windows_s: {_text(w.windows)} do not rise", "write the shortest first"))
    elif not w.smooth < w.windows[0]:
        problem = f"model.smooth_s: {w.smooth:g} is not less than the shortest window, {w.windows[0]:g}"
        found.append((problem, "shorten it"))
    return found


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{one:g}" for one in value) + "]"
    return f"{value:g}"
