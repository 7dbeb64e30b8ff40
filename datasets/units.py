"""Units in column headers, and the roles that names suggest.

A header is ``name`` or ``name_unit``; the units are ``_degC _K _degF _percent _V _A _W _s _ms _min
_0_255``.  A header without one of them is dimensionless.  Kelvin and Fahrenheit become degC here, and only
here; ms and min become s::

    T[degC] = T[K] - 273.15 = (T[degF] - 32) / 1.8

A suffix like another unit (``_C``, ``_mV``, ``_sec``) is refused by :func:`split_header`, which reads what
thermogrip writes.  Logs come from anywhere: :func:`read_header` reads units as people write them, in brackets
or after a comma, and their multiples.

**Roles.**  Names come first, then units.  Where they show no input or no output, the data do
(:func:`roles_of_data`): a column that is held between few large moves is an input, one whose next value
another column's past helps to predict is an output.  With n lags and N rows the help of column i for
column j is the gain in the Bayesian information criterion,

    G_ij = N log(RSS_j / RSS_ij) - n log N,

RSS_j of j on its own past, RSS_ij with that of i beside it (Granger 1969); beyond 10, with 2 lags and with 6
(few leave of a smooth input what its output tells of it), it counts.
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
_TO_CONVERT = {
    "h": 3600.0, "hr": 3600.0, "hour": 3600.0, "hours": 3600.0, "us": 1e-6, "ns": 1e-9, "days": 86400.0,
    "mV": 1e-3, "kV": 1e3, "mA": 1e-3, "uA": 1e-6, "mW": 1e-3, "kW": 1e3, "mK": 1e-3,
}  # fmt: skip
_ANY_CASE = {word.lower(): word for word in (*_FOREIGN, *UNITS) if len(word) > 2 or word == "ms"}
_UNIT_AT_END = re.compile(
    r"(?P<name>.*?)\s*(?:[\[({](?P<inside>[^\])}]*)[\])}]"
    r"|(?P<mark>[_,/;:]|\s(?:in\s)?)\s*(?P<after>[^\s_,/;:()\[\]{}]+))"
)
_BRACKETED = re.compile(r"[\[(]\s*[^\])]*\s*[\])]\s*$")

_SETPOINT = re.compile(
    r"^(t_?)?(setpoint|set_point|target|sp|set)(_?\d+)?(_.*)?$|^reference(_.*|\d*)$"
    r"|_(setpoint|set_point|target|sp|set)(_?\d+)?$|^(goal|desired)(_.*|\d*)$"
)
_SET_DRIVE = re.compile(r"^set(_.*|\d*)$|_set$|^(goal|desired)")  # set_percent is what a drive is set to
_OF_DRIVES = ("percent", "V", "A", "W", "0_255")
_AMBIENT = re.compile(
    r"ambient|(^|_)(amb|room|outside|outdoors?|sol|weather|wind)(_|$)|solar|irradia|^(to|te|text|toa|ghi)$"
)
_INPUT = re.compile(
    r"^(drive|pump|pwm|duty|heater|heating|cooler|cooling|peltier|tec|valve|fan|flow|cmd|command|power|input"
    r"|actuator|control|relay|mv|q[hc]|[qu])(\d*|_.*)$"
)
_OUTPUT = re.compile(
    r"^(t|y|temp|temperature|level|outlet|position|speed|pv|angle|velocity|response|measured)(\d*|_.*)$"
)
_LONGEST = 200  # characters of a header that is looked through for a unit
NO_CLUE = "neither its name nor its unit shows what it is"
_HELD_SHARE, _HELD_SIZE = 0.5, 0.05  # of rows with a move; of the range that its median has, at least
_LAGS, _STRONG, _MOST_ROWS = (2, 6), 10.0, 20_000


def split_header(header: str, *, file: str | None = None) -> tuple[str, str]:
    """Return the variable name and the unit of a column header (``"1"`` without a suffix).

    UserError if the suffix is like a unit that is not read, or nothing is left as a name.
    """
    header = header.strip()
    for unit in UNITS:
        if header.endswith(f"_{unit}"):
            return _named(header.removesuffix(f"_{unit}"), header, file), unit
    name, unit, scale = read_header(header)
    if unit != "1":
        rename = f"rename the column to {name}_{unit}"
        hint = rename if scale == 1 else f"convert it and {rename}"
        raise UserError("unit is spelt another way", file=file, column=header, hint=hint)
    if _BRACKETED.search(header) or _FOREIGN.get(header.rpartition("_")[2]) == "":
        raise UserError("unit is unknown", file=file, column=header, hint=f"use one of {_listed()}, or none")
    return _named(header, header, file), "1"


def read_header(header: str, others: Sequence[str] = ()) -> tuple[str, str, float]:
    """Return name, unit and the factor to that unit of a column header as any program writes it.

    A word that is no unit stays a part of the name; so does a letter that others of ``others`` continue
    (``zone_a``, ``zone_b``, ``zone_c``).  The name is empty where the header has none.
    """
    header = header.strip()
    for unit in UNITS:
        if header.endswith(f"_{unit}"):
            return _plain(header.removesuffix(f"_{unit}")), unit, 1.0
    found = _UNIT_AT_END.fullmatch(header) if len(header) <= _LONGEST else None
    if found is None:
        return _plain(header), "1", 1.0
    name, inside = found["name"], found["inside"]
    word = (found["after"] if inside is None else inside).strip()
    if inside is not None and word in ("", "-", "1"):
        return _plain(name), "1", 1.0
    unit, scale = _any_unit(word)
    timed = unit in _TIMES and re.search(r"(?i:time|elapsed)|^t$", name) is None
    if inside is None and unit and len(word) == 1 and word != "%":
        series = any(f"{header[:-1]}{letter}" in others for letter in "aAbBdDeE")
        lower = word.islower() and _INPUT.match(name.lower())
        unit = "" if series or lower or (found["mark"] or "").isspace() else unit
    if (inside is None and timed) or (word == "deg" and not re.match(r"(?i)t\d*(_|$)|.*temp", name)):
        unit = ""
    return (_plain(name), unit, scale) if unit else (_plain(header), "1", 1.0)


def _any_unit(word: str) -> tuple[str, float]:
    """Return the unit that a word means and the factor to it; an empty one where it means none."""
    degrees = any(sign in word for sign in "°º˚℃")
    word = re.sub(r"[°º˚\s]", "", word).replace("℃", "C").replace("µ", "u").replace("μ", "u")
    word = {"0-255": "0_255", "c": "C", "f": "F", "k": "K"}.get(word, word)
    word = word if word in UNITS or word in _FOREIGN else _ANY_CASE.get(word.lower(), word)
    unit = word if word in UNITS else _FOREIGN.get(word, "_degC" if degrees and not word else "").lstrip("_")
    return unit, _TO_CONVERT.get(word, 1.0)


def _plain(name: str) -> str:
    return re.sub(r"[\s,;\"'/()\[\]{}]+", "_", name).strip("_")


def _named(name: str, header: str, file: str | None) -> str:
    if not name or not re.fullmatch(r"[^\s,;\"'/]+", name):
        raise UserError(
            f"{name!r} is no name for a variable", file=file, column=header, hint="name the column"
        )
    return name


def _listed() -> str:
    return " ".join(f"_{unit}" for unit in UNITS)


def rename_hint(name: str, headers: Sequence[str]) -> str:
    """Return which column to rename where ``name``, a time or a temperature, is missing."""
    wanted = _TIMES if name == "time" else _TEMPERATURES
    for header in headers:
        unit = read_header(header)[1]
        if unit in wanted and not header.startswith("time"):
            return f"rename {header!r} to {name}_{unit}"
    like = next(
        (h for h in headers if name == "time" and re.match(r"(time|stamp|seconds|t$)", h.lower())), ""
    )
    return f"rename {like!r} to time_s or time_ms" if like else f"it has {', '.join(headers)}"


def join_header(name: str, unit: str, others: Sequence[str] = ()) -> str:
    """Return the column header that is read as this name and unit, among columns of other names."""
    header = name if unit == "1" else f"{name}_{unit}"
    if read_header(header, others) != (name, unit, 1.0):
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
    return "other", NO_CLUE


def roles_of_data(
    columns: Mapping[str, NDArray[np.float64]], units: Mapping[str, str], fixed: Mapping[str, str]
) -> dict[str, tuple[str, str]]:
    """Return role and reason, as the data show them, of the columns (n_row,) that ``fixed`` gives no role."""
    out: dict[str, tuple[str, str]] = {}
    for name in [name for name in columns if name not in fixed]:
        values = columns[name][np.isfinite(columns[name])]
        moves = np.abs(np.diff(values))
        moves, rows = moves[moves > 0], max(values.size, 1)
        if not moves.size:
            out[name] = "other", "it never moves"
        elif moves.size <= _HELD_SHARE * rows and np.median(moves) >= _HELD_SIZE * np.ptp(values):
            out[name] = "input", f"it is held between {moves.size} moves in {rows} rows"
    roles = {**fixed, **{name: role for name, (role, _) in out.items()}}
    names = [n for n in columns if roles.get(n) != "other" and np.nanmax(columns[n]) > np.nanmin(columns[n])]
    chosen = [columns[name][:_MOST_ROWS] for name in names]
    gain = np.minimum.reduce([_predictive_gain(chosen, lags) for lags in _LAGS])
    open_, net = [n for n in names if n not in roles], dict(zip(names, (gain - gain.T).sum(axis=1)))
    for name in open_:
        help_ = gain[:, names.index(name)]
        if help_.max() > _STRONG:
            out[name] = "output", f"its course follows {names[int(help_.argmax())]}"
        else:
            why = "no other column predicts its course"
            out[name] = ("disturbance" if units[name] == "degC" else "input"), why
    roles |= {name: role for name, (role, _) in out.items()}
    if open_ and "input" not in roles.values():
        lead = dict(zip(names, gain.sum(axis=1)))
        for name in [n for n in open_ if net[n] > 0] or [max(open_, key=lambda n: lead[n])]:
            more = "it predicts the others more than they predict it"
            roles[name], out[name] = "input", ("input", more if net[name] > 0 else "no other is likelier one")
    if len(open_) > 1 and "output" not in roles.values():
        name = min(reversed(open_), key=lambda n: net[n])
        out[name] = "output", "the others predict it more than it predicts them"
    return out


def _predictive_gain(columns: Sequence[NDArray[np.float64]], lags: int) -> NDArray[np.float64]:
    """Return G (n, n) of the module's theory, 0 where it is negative; row i helps column j."""
    gain, scaled = np.zeros((len(columns), len(columns))), []
    for values in columns:
        at, known = np.arange(values.size), np.isfinite(values)
        filled = np.interp(at, at[known], values[known]) if known.any() else np.zeros(values.size)
        scaled.append((filled - filled.mean()) / (np.std(filled) or 1.0))
    rows = min((len(values) for values in scaled), default=0) - lags
    if rows < 5 * lags:
        return gain
    past = [np.stack([v[lags - k : len(v) - k] for k in range(1, lags + 1)], axis=1) for v in scaled]

    def left(y: NDArray[np.float64], *some: NDArray[np.float64]) -> float:
        x = np.column_stack([np.ones(rows), *some])
        return float(np.sum((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2)) + 1e-12 * rows

    for j, values in enumerate(scaled):
        own = left(values[lags:], past[j])
        for i in (i for i in range(len(columns)) if i != j):
            both = left(values[lags:], past[j], past[i])
            gain[i, j] = max(0.0, rows * np.log(own / both) - lags * np.log(rows))
    return gain


def assign_roles(
    units: dict[str, str],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    given: dict[str, str] | None = None,
    columns: Mapping[str, NDArray[np.float64]] | None = None,
    file: str | None = None,
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the role of each variable of ``units`` (name -> unit), and the reason for each that is a guess.

    The lists hold names with or without the unit suffix; a list that is given is complete: no other variable
    gets its role. ``given`` (name -> role) replaces guesses.  Where names and units show no input or no
    output, ``columns``, the data, are asked.
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
    guesses = {n: explain_role(n, unit) for n, unit in units.items() if n not in {**(given or {}), **chosen}}
    clear = {name: role for name, (role, why) in guesses.items() if why != NO_CLUE}
    fixed = clear | (given or {}) | chosen
    if columns is not None and not {"input", "output"} <= {*fixed.values()}:
        guesses |= roles_of_data(columns, units, fixed)
    roles, reasons = {}, {}
    for name in units:
        guess, why = guesses.get(name, ((given or {}).get(name, "other"), ""))
        roles[name] = chosen.get(name, "other" if lists.get(guess) is not None else guess)
        if why and roles[name] == guess:
            reasons[name] = why
    return roles, reasons


def find_column(entry: str, units: Mapping[str, str], file: str | None = None) -> str:
    """Return the variable that a user's word means: its name or its header, in whatever case."""
    entry = entry.strip()
    if entry in units:
        return entry
    likely = {entry, _plain(entry), read_header(entry)[0]}
    for found in (likely & {*units}, {n for n in units if n.lower() in {word.lower() for word in likely}}):
        if len(found) == 1:
            return found.pop()
    raise UserError("no such column", file=file, column=entry, hint=f"it has {', '.join(units)}")
