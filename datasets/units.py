"""Units in column headers, and the roles that names suggest.

A header is ``name`` or ``name_unit``; the units are ``_degC _K _degF _percent _V _A _W _s _ms _min
_0_255``.  A header without one of them is dimensionless.  Kelvin and Fahrenheit become degC here, and only
here; ms and min become s::

    T[degC] = T[K] - 273.15 = (T[degF] - 32) / 1.8

A suffix like another unit (``_C``, ``_mV``, ``_sec``) is refused rather than guessed, since a temperature
that is read in the wrong unit is still a number.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError

UNITS = ("degC", "K", "degF", "percent", "V", "A", "W", "s", "ms", "min", "0_255")

_TIMES, _TEMPERATURES = ("s", "ms", "min"), ("degC", "K", "degF")

# suffix as people write it -> what to write instead ("" where the toolkit has no such unit)
_FOREIGN = {
    "C": "_degC", "F": "_degF", "celsius": "_degC", "Celsius": "_degC", "degK": "_K", "kelvin": "_K",
    "Kelvin": "_K", "fahrenheit": "_degF", "Fahrenheit": "_degF", "deg": "_degC", "pct": "_percent",
    "perc": "_percent", "%": "_percent", "sec": "_s", "secs": "_s", "seconds": "_s", "second": "_s",
    "msec": "_ms", "minutes": "_min", "minute": "_min", "mins": "_min", "h": "_s", "hr": "_s", "hours": "_s",
    "hour": "_s", "us": "_s", "ns": "_s", "days": "_s", "mV": "_V", "kV": "_V", "volt": "_V", "volts": "_V",
    "mA": "_A", "uA": "_A", "amp": "_A", "amps": "_A", "ampere": "_A", "mW": "_W", "kW": "_W", "watt": "_W",
    "watts": "_W", "mK": "_K", "Hz": "", "kHz": "", "Pa": "", "kPa": "", "bar": "", "rpm": "", "kg": "",
    "mm": "", "Ohm": "", "ohm": "", "kOhm": "", "J": "", "kJ": "", "N": "", "lpm": "", "LPM": "",
}  # fmt: skip
# those of them that are other units, not other spellings
_TO_CONVERT = {"h", "hr", "hour", "hours", "us", "ns", "days", "mV", "kV", "mA", "uA", "mW", "kW", "mK"}
_ODD_CASE = {unit.lower(): f"_{unit}" for unit in ("degC", "degF", "percent", "ms", "min")}
_BRACKETED = re.compile(r"[\[(]\s*[^\])]*\s*[\])]\s*$")

_SETPOINT = re.compile(
    r"^(t_?)?(setpoint|set_point|target|sp|set)(_?\d+)?(_.*)?$|^reference(_.*|\d*)$"
    r"|_(setpoint|set_point|target|sp|set)(_?\d+)?$|^(goal|desired)(_.*|\d*)$"
)
_SET_DRIVE = re.compile(r"^set(_.*|\d*)$|_set$|^(goal|desired)")  # set_percent is what a drive is set to
_OF_DRIVES = ("percent", "V", "A", "W", "0_255")
_AMBIENT = re.compile(r"ambient|(^|_)(amb|room|outside|outdoor)(_|$)")
_INPUT = re.compile(
    r"^(drive|pump|pwm|duty|heater|cooler|peltier|tec|valve|fan|flow|cmd|command|power|[qu])(\d*|_.*)$"
)
_OUTPUT = re.compile(r"^(t|y|temp|temperature|level|outlet|position|speed)(\d*|_.*)$")


def split_header(header: str, *, file: str | None = None) -> tuple[str, str]:
    """Return the variable name and the unit of a column header (``"1"`` without a suffix).

    UserError if the suffix is like a unit that is not read, or nothing is left as a name.
    """
    header = header.strip()
    for unit in UNITS:
        if header.endswith(f"_{unit}"):
            return _named(header.removesuffix(f"_{unit}"), header, file), unit
    name, _, suffix = header.rpartition("_")
    _refuse_foreign(header, name, suffix, file)
    return _named(header, header, file), "1"


def _named(name: str, header: str, file: str | None) -> str:
    if not name or not re.fullmatch(r"[^\s,;\"'/]+", name):
        raise UserError(
            f"{name!r} is no name for a variable", file=file, column=header, hint="name the column"
        )
    return name


def _refuse_foreign(header: str, name: str, suffix: str, file: str | None) -> None:
    bracketed = _BRACKETED.search(header)
    if bracketed:
        plain = bracketed.group().strip().strip("[]()").replace("°", "").strip()
        unit = f"_{plain}" if plain in UNITS else _FOREIGN.get(plain, "")
        before = "_".join(header[: bracketed.start()].split()).rstrip("_")
        hint = f"write the unit as a suffix, one of {_listed()}"
        if unit and before and plain not in _TO_CONVERT:
            hint = f"rename the column to {before}{unit}"
        raise UserError(
            f"unit {bracketed.group().strip()!r} in brackets", file=file, column=header, hint=hint
        )
    better = _FOREIGN.get(suffix, _ODD_CASE.get(suffix.lower()))
    if suffix in ("c", "f", "k") and re.match(r"t\d*(_|$)|temp", name):  # pump_a, pump_b, pump_c are no units
        better = {"c": "_degC", "f": "_degF", "k": "_K"}[suffix]
    if "°" in suffix:
        better = "_degC"
    if not name or better is None:
        return
    hint = f"rename the column to {name}{better}" if better else f"use one of {_listed()}, or no unit suffix"
    if suffix in _TO_CONVERT:
        hint = f"convert it and rename the column to {name}{better}"
    raise UserError(f"unit '_{suffix}' is unknown", file=file, column=header, hint=hint)


def _listed() -> str:
    return " ".join(f"_{unit}" for unit in UNITS)


def rename_hint(name: str, headers: Sequence[str]) -> str:
    """Return which column to rename where ``name``, a time or a temperature, is missing."""
    wanted = _TIMES if name == "time" else _TEMPERATURES
    for header in headers:
        bracketed = _BRACKETED.search(header)
        inside = bracketed.group().strip("[]() \N{DEGREE SIGN}") if bracketed else ""
        ends = next((unit for unit in wanted if header.endswith(f"_{unit}")), inside)
        unit = _FOREIGN.get(ends, f"_{ends}").removeprefix("_")
        if unit in wanted and not header.startswith("time"):
            return f"rename {header!r} to {name}_{unit}"
    like = next(
        (h for h in headers if name == "time" and re.match(r"(time|stamp|seconds|t$)", h.lower())), ""
    )
    return f"rename {like!r} to time_s or time_ms" if like else f"it has {', '.join(headers)}"


def join_header(name: str, unit: str) -> str:
    """Return the column header that :func:`split_header` reads as this name and unit."""
    header = name if unit == "1" else f"{name}_{unit}"
    if split_header(header) != (name, unit):
        raise UserError(
            f"cannot stand in a header with unit {unit!r}", column=name, hint=f"use {_listed()}, or rename"
        )
    return header


def to_record_unit(values: NDArray[np.float64], unit: str) -> tuple[NDArray[np.float64], str]:
    """Return the values in the unit of the records (degC for temperatures, s for times, else as they are)."""
    if unit == "K":
        return np.round(values - 273.15, 10), "degC"  # 298.15 - 273.15 is 25 - 2e-14 in binary
    if unit == "degF":
        return (values - 32.0) / 1.8, "degC"
    if unit == "ms":
        return values / 1000.0, "s"
    if unit == "min":
        return values * 60.0, "s"
    return values, unit


def guess_role(name: str, unit: str) -> str:
    """Return the role that a name and a unit suggest: input, disturbance, output or other.

    Names come first (``drive``, ``pump``, ``q1``, ``flow`` ... are inputs, ``t_...``, ``level`` outputs, a
    setpoint is neither), then units: percent, V and 0_255 are what a controller moves, other temperatures
    are outputs.
    """
    return explain_role(name, unit)[0]


def explain_role(name: str, unit: str) -> tuple[str, str]:
    """Return the role that a name and a unit suggest, and why."""
    lower = name.lower()
    if _SETPOINT.search(lower) and not (_SET_DRIVE.search(lower) and unit in _OF_DRIVES):
        return "other", "its name is that of a set point"
    if _AMBIENT.search(lower):
        return "disturbance", "its name is that of the surroundings"
    if _INPUT.match(lower) and unit not in ("degC", "s"):
        return "input", "its name is that of a drive"
    if _OUTPUT.match(lower) and unit != "s":
        return "output", "its name is that of a reading"
    if unit == "degC":
        return "output", "its unit is degC"
    if unit in ("percent", "V", "0_255"):
        return "input", f"its unit is {unit}"
    return "other", "neither its name nor its unit shows what it is"


def assign_roles(
    units: dict[str, str],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    given: dict[str, str] | None = None,
    file: str | None = None,
) -> dict[str, str]:
    """Return the role of each variable of ``units`` (name -> unit).

    The lists hold names with or without the unit suffix; a list that is given is complete: no other variable
    gets its role. ``given`` (name -> role) replaces guesses.
    """
    lists = {"input": inputs, "output": outputs, "disturbance": disturbances}
    chosen: dict[str, str] = {}
    for role, wanted in lists.items():
        for entry in wanted or ():
            name = find_column(entry, units, file)
            if chosen.get(name, role) != role:
                raise UserError(
                    f"is listed as {chosen[name]} and as {role}", file=file, column=name, hint="choose one"
                )
            chosen[name] = role
    roles = {}
    for name, unit in units.items():
        guess = (given or {}).get(name) or guess_role(name, unit)
        complete = lists.get(guess) is not None
        roles[name] = chosen.get(name, "other" if complete else guess)
    return roles


def find_column(entry: str, units: Mapping[str, str], file: str | None = None) -> str:
    """Return the variable that a user's word means: its name, with or without the unit suffix."""
    entry = entry.strip()
    if entry in units:
        return entry
    stripped = next((entry.removesuffix(f"_{u}") for u in UNITS if entry.endswith(f"_{u}")), entry)
    if stripped not in units:
        raise UserError("no such column", file=file, column=entry, hint=f"it has {', '.join(units)}")
    return stripped
