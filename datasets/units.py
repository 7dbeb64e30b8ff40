"""Units in column headers.

A header is ``name`` or ``name_unit``; the units are ``_degC _K _degF _percent _V _A _W _s _ms _min
_0_255``, none is dimensionless.  Kelvin and Fahrenheit become degC here, and only here; ms and min become s::

    T[degC] = T[K] - 273.15 = (T[degF] - 32) / 1.8

:func:`split_header`, which reads what thermogrip writes, refuses a suffix like another unit (``_C``,
``_mV``); :func:`read_header` reads units as people write them, in brackets or after a comma.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names

UNITS = ("degC", "K", "degF", "percent", "V", "A", "W", "s", "ms", "min", "0_255")
_SUFFIXES = " ".join(f"_{unit}" for unit in UNITS)

_TIME_UNITS, _TEMPERATURE_UNITS = ("s", "ms", "min"), ("degC", "K", "degF")

# suffix as people write it -> unit, "" where the toolkit has none, and the factor to it
_SPELT = {"degC": "C celsius Celsius deg degCelsius", "degF": "F fahrenheit Fahrenheit"}
_SPELT |= {"K": "degK kelvin Kelvin", "percent": "pct perc %", "V": "volt volts", "A": "amp amps ampere"}
_SPELT |= {"W": "watt watts", "s": "sec secs seconds second", "ms": "milliseconds msec millis"}
_SPELT |= {"min": "minutes minute mins", "": "Hz kHz Pa kPa bar rpm kg mm Ohm ohm kOhm J kJ N lpm LPM"}
_MULTIPLES = {
    "s": dict.fromkeys(("h", "hr", "hour", "hours"), 3.6e3)
    | {"us": 1e-6, "micros": 1e-6, "ns": 1e-9, "days": 86.4e3, "weeks": 604.8e3},
    "V": {"mV": 1e-3, "kV": 1e3},
    "A": {"mA": 1e-3, "uA": 1e-6},
    "W": {"mW": 1e-3, "kW": 1e3},
    "K": {"mK": 1e-3},
}
_FOREIGN = {word: (unit, 1.0) for unit, words in _SPELT.items() for word in words.split()}
_FOREIGN |= {word: (unit, factor) for unit, those in _MULTIPLES.items() for word, factor in those.items()}
_ANY_CASE = {word.lower(): word for word in (*_FOREIGN, *UNITS) if len(word) > 2 or word == "ms"}
_UNIT_AT_END = re.compile(
    r"(?P<name>.*?)\s*(?:[\[({](?P<inside>[^\])}]*)[\])}]"
    r"|(?P<mark>[_,/;:]|\s(?:in\s)?)\s*(?P<after>[^\s_,/;:()\[\]{}]+))"
)
_BRACKETED = re.compile(r"[\[(]\s*[^\])]*\s*[\])]\s*$")

#: How the name of a drive begins; a letter behind it numbers it and is no unit (``pump_a``).
DRIVE = re.compile(
    r"^(drive|pump|pwm|duty|heater|heating|cooler|cooling|peltier|tec|valve|fan|flow|cmd|command|power|input"
    r"|actuator|control|relay|mv|q[hc]|[qu])(\d*|_.*)$"
)
_LONGEST_HEADER = 200  # characters of a header that is looked through for a unit
_RATE = re.compile(r".+_(?:[mN]?[lL]|m|Nm3|m3|k?g|gal|rev|K|C|degC)_(?:s|min)")  # per time, which no time is


def split_header(header: str, *, file: str | None = None) -> tuple[str, str]:
    """Return the variable name and the unit of a column header (``"1"`` without a suffix); UserError if the
    suffix is like a unit that is not read, or nothing is left as a name."""
    header = header.strip()
    unit = next((unit for unit in UNITS if header.endswith(f"_{unit}") and not _RATE.fullmatch(header)), "1")
    name, read = header.removesuffix(f"_{unit}") if unit != "1" else header, read_header(header)
    if unit == "1" and read.unit != "1":
        rename = f"rename the column to {read.name}_{read.unit}"
        hint = rename if read.scale == 1 else f"convert it and {rename}"
        raise UserError("unit is spelt another way", file=file, column=header, hint=hint)
    foreign = _BRACKETED.search(header) or _FOREIGN.get(header.rpartition("_")[2]) == ("", 1.0)
    if unit == "1" and foreign:
        raise UserError("unit is unknown", file=file, column=header, hint=f"use one of {_SUFFIXES}, or none")
    if not re.fullmatch(r"[^\s,;\"'/]+", name):
        problem = f"{name!r} is no name for a variable"
        raise UserError(problem, file=file, column=header, hint="name the column")
    return name, unit


class Header(NamedTuple):
    """A column's header, read."""

    name: str
    unit: str
    scale: float  # factor from the column's values to that unit


def read_header(header: str, others: Sequence[str] = ()) -> Header:
    """Return name, unit and the factor to that unit of a column header as any program writes it; a word
    that is no unit stays a part of the name, which is empty where the header has none."""
    header = header.strip()
    read = _read_to_end(header, others)
    if read != Header(_bare_name(header), "1", 1.0) or len(header) > _LONGEST_HEADER:
        return read
    # Time (min) Run 1; Temp, degC (sensor 3)
    for bracket in reversed([*re.finditer(r"[\[(]|(?<=[\])])", header)]):
        before = _read_to_end(header[: bracket.start()].rstrip(), others)
        if before.unit != "1":
            return before._replace(name=_bare_name(f"{before.name} {header[bracket.start() :]}"))
    return read


def _read_to_end(header: str, others: Sequence[str]) -> Header:
    """Return the header, read with its unit last."""
    # a letter that others continue is no unit: zone_a, zone_b, zone_c
    series = any(f"{header[:-1]}{letter}" in others for letter in "abdeABDE" if letter != header[-1:])
    for unit in UNITS if _RATE.fullmatch(header) is None else ():
        if header.endswith(f"_{unit}") and not (series and len(unit) == 1):
            return Header(_bare_name(header.removesuffix(f"_{unit}")), unit, 1.0)
    match = _UNIT_AT_END.fullmatch(header) if len(header) <= _LONGEST_HEADER else None
    if match is None:
        return Header(_bare_name(header), "1", 1.0)
    name, inside = match["name"], match["inside"]
    word = (match["after"] if inside is None else inside).strip()
    if inside is not None and word in ("", "-", "1"):
        return Header(_bare_name(name), "1", 1.0)
    unit, scale = any_unit(word)
    timed = unit in _TIME_UNITS and re.search(r"(?i:time|elapsed)|^t$", name) is None
    if inside is None and unit and len(word) == 1 and word != "%":
        lower = word.islower() and DRIVE.match(name.lower())
        unit = "" if series or lower or (match["mark"] or "").isspace() else unit
    if (inside is None and timed) or (word == "deg" and not re.match(r"(?i)t\d*(_|$)|.*temp", name)):
        unit = ""
    return Header(_bare_name(name), unit, scale) if unit else Header(_bare_name(header), "1", 1.0)


def any_unit(word: str) -> tuple[str, float]:
    """Return the unit that a word means and the factor to it; an empty one where it means none."""
    degrees = any(sign in word for sign in "°º˚℃")
    word = re.sub(r"[°º˚\s]", "", word).replace("℃", "C").replace("µ", "u").replace("μ", "u")
    word = {"0-255": "0_255", "c": "C", "f": "F", "k": "K"}.get(word, word)
    word = word if word in UNITS or word in _FOREIGN else _ANY_CASE.get(word.lower(), word)
    if word in UNITS:
        return word, 1.0
    return _FOREIGN.get(word, ("degC" if degrees and not word else "", 1.0))


def _bare_name(name: str) -> str:
    return re.sub(r"[\s,;\"'/()\[\]{}]+", "_", name).strip("_")


def join_header(name: str, unit: str, others: Sequence[str] = ()) -> str:
    """Return the column header that is read as this name and unit, among columns of other names."""
    header = name if unit == "1" else f"{name}_{unit}"
    if read_header(header, others) != Header(name, unit, 1.0):
        problem = f"cannot stand in a header with unit {unit!r}"
        raise UserError(problem, column=name, hint=f"use {_SUFFIXES}, or rename")
    return header


def to_record_unit(values: Array, unit: str) -> tuple[Array, str]:
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


def find_column(entry: str, units: Mapping[str, str], file: str | None = None) -> str:
    """Return the variable that a user's word means: its name or its header, in whatever case."""
    entry = entry.strip()
    if entry in units:
        return entry
    name, unit, _ = read_header(entry)
    unit = to_record_unit(np.empty(0), unit)[1]
    # of heater_degC and heater_percent the second is called heater_2
    numbered = re.compile(re.escape(name) + r"(_\d+)?", re.IGNORECASE)
    of_unit = {n for n in units if unit != "1" and units[n] == unit and numbered.fullmatch(n)}
    likely = {entry, _bare_name(entry), name}
    for candidates in (
        of_unit & likely,
        of_unit,
        likely & {*units},
        {n for n in units if n.lower() in {word.lower() for word in likely}},
    ):
        if len(candidates) == 1:
            return candidates.pop()
    raise UserError("no such column", file=file, column=entry, hint=known_names(entry, units, "it has {}"))
