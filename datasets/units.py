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
(of a smooth input few leave what its output contains of it), it counts.

A column that is computed from others is neither: a copy in another unit or on another scale (counts of a
converter), or what is left between a set point and a reading.  Where some inputs are held, a column that
moves in every row is none of them: not by a unit alone, and not because nothing predicts it.  Such a column
is an output where its values lie as those of one (a second sensor), else a disturbance.  Beside a set point
``input`` and ``output`` are a controller's, the reading and the drive.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.limits import MOST_NUMBER

UNITS = ("degC", "K", "degF", "percent", "V", "A", "W", "s", "ms", "min", "0_255")
_SUFFIXES = " ".join(f"_{unit}" for unit in UNITS)

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
    r"ambient|(^|_)(amb|room|outside|outdoors?|sol|weather|wind|cloud|rain|dew)(_|$)|solar|irradia"
    r"|^(to|te|text|toa|oat|ghi)$"
)
_INPUT = re.compile(
    r"^(drive|pump|pwm|duty|heater|heating|cooler|cooling|peltier|tec|valve|fan|flow|cmd|command|power|input"
    r"|actuator|control|relay|mv|q[hc]|[qu])(\d*|_.*)$"
)
_OUTPUT = re.compile(
    r"^(t|y|temp|temperature|level|outlet|position|speed|pv|angle|velocity|response|measured)(\d*|_.*)$"
)
_INFLOW = re.compile(r"(^|_)(inlet|inflow|supply_air)(_|$)")
_BOOKKEEPING = re.compile(
    r"^(error|err|control_error|integral|derivative|[pid]_?(term|part|action)|k_?[pidc]|pid_[pid]"
    r"|hour|day|month|year|week|weekday|row|index|id|iteration|sample|record|counter)(_of_[a-z]+|_?no|_?\d+)?$"
)
_LONGEST = 200  # characters of a header that is looked through for a unit
NO_CLUE = "neither its name nor its unit shows what it is"
_HELD_SHARE, _HELD_SIZE = 0.5, 0.05  # of rows with a move; of the range that its median has, at least
_FEW = 20  # rows: too few to distinguish chance from rule
_COUNTS = 0.9  # of the rows have the same step
_SHOWS = 5  # moves of two columns, by which they may be copies
_TURNS = 20  # of a column's course, without which two that rise together look like copies
_COARSE = 0.03  # of a column's standard deviation: coarser steps hide what a second sensor reads
_SHARED = 1 / 3  # of the wider one of two ranges: two sensors of one plant
_EXACT, _ROUNDED = 1e-6, 0.05  # of a column's range; of its standard deviation, that rounding takes at most
_LAGS, _STRONG, _MOST_ROWS = (2, 6), 10.0, 20_000


def split_header(header: str, *, file: str | None = None) -> tuple[str, str]:
    """Return the variable name and the unit of a column header (``"1"`` without a suffix); UserError if the
    suffix is like a unit that is not read, or nothing is left as a name."""
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
        raise UserError("unit is unknown", file=file, column=header, hint=f"use one of {_SUFFIXES}, or none")
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
        problem = f"{name!r} is no name for a variable"
        raise UserError(problem, file=file, column=header, hint="name the column")
    return name


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
        problem = f"cannot stand in a header with unit {unit!r}"
        raise UserError(problem, column=name, hint=f"use {_SUFFIXES}, or rename")
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


def is_room_temperature(name: str, unit: str) -> bool:
    """Tell whether a measured disturbance is the temperature of the surroundings: no other quantity, and not
    that of what flows in."""
    return unit == "degC" and not _INFLOW.search(name.lower())


def guess_role(name: str, unit: str) -> str:
    """Return the role that a name and a unit suggest: input, disturbance, output or other."""
    return explain_role(name, unit)[0]


def explain_role(name: str, unit: str) -> tuple[str, str]:
    """Return the role that a name and a unit suggest, and why: names come first, then units."""
    lower, celsius = name.lower(), unit == "degC"
    set_drive = _SET_DRIVE.search(lower) and unit in _OF_DRIVES
    rows = (
        (_SETPOINT.search(lower) and not set_drive, "other", "its name is that of a set point"),
        (_BOOKKEEPING.match(lower), "other",
         "its name is that of a number of the clock's or the controller's"),
        (_AMBIENT.search(lower), "disturbance", "its name is that of the surroundings"),
        (_INFLOW.search(lower) and (celsius or "temp" in lower), "disturbance",
         "its name is that of what flows in"),
        (_INPUT.match(lower) and unit not in ("degC", "s"), "input", "its name is that of a drive"),
        (_OUTPUT.match(lower) and unit != "s", "output", "its name is that of a reading"),
        (celsius, "output", "its unit is degC"),
        (unit in ("percent", "V", "0_255"), "input", f"its unit is {unit}"),
    )  # fmt: skip
    return next(((role, why) for applies, role, why in rows if applies), ("other", NO_CLUE))


def roles_of_data(
    columns: Mapping[str, NDArray[np.float64]], units: Mapping[str, str], fixed: Mapping[str, str]
) -> dict[str, tuple[str, str]]:
    """Return role and reason, as the data show them, of the columns (n_row,) that ``fixed`` gives no role."""
    out: dict[str, tuple[str, str]] = {}
    for name in [name for name in columns if name not in fixed]:
        values = columns[name][np.isfinite(columns[name])]
        steps, rows = np.diff(values), max(values.size, 1)
        if not steps.any():
            out[name] = "other", "it never moves"
        elif rows >= _FEW and _mostly_even(steps):
            out[name] = "other", "it counts rows or time"
        elif _is_held(values):
            out[name] = "input", f"it is held between {np.count_nonzero(steps)} moves in {rows} rows"
    roles = {**fixed, **{name: role for name, (role, _) in out.items()}}
    names = [n for n in columns if roles.get(n) != "other" and np.nanmax(columns[n]) > np.nanmin(columns[n])]
    chosen = [columns[name][:_MOST_ROWS] for name in names]
    gain = np.minimum.reduce([_predictive_gain(chosen, lags) for lags in _LAGS])
    open_, net = [n for n in names if n not in roles], dict(zip(names, (gain - gain.T).sum(axis=1)))
    for name in open_:
        help_ = gain[:, names.index(name)]
        if help_.max() > _STRONG:
            out[name] = "output", f"its course follows {names[int(help_.argmax())]}"
    roles |= {name: role for name, (role, _) in out.items()}
    held = next((n for n in names if roles.get(n) == "input" and _is_held(columns[n])), None)
    read = [n for n in names if roles.get(n) == "output"]
    for name in [n for n in open_ if n not in roles]:
        why = "no other column predicts its course"
        out[name] = ("disturbance" if held or units[name] == "degC" else "input"), why
        like = next((n for n in read if held and _overlap(columns[name], columns[n]) >= _SHARED), None)
        if like is not None:
            out[name] = "output", f"its values lie as those of {like}"
    roles |= {name: role for name, (role, _) in out.items()}
    clear = {role for name, role in roles.items() if name not in open_}
    if len(open_) == 1 and "disturbance" in clear and "output" not in clear:
        roles[open_[0]], out[open_[0]] = "output", ("output", "there is nothing else to predict")
    elif open_ and "input" not in roles.values():
        lead = dict(zip(names, gain.sum(axis=1)))
        for name in [n for n in open_ if net[n] > 0] or [max(open_, key=lambda n: lead[n])]:
            more = "it predicts the others more than they predict it"
            roles[name], out[name] = "input", ("input", more if net[name] > 0 else "no other is likelier one")
    if len(open_) > 1 and "output" not in roles.values():
        name = min(reversed(open_), key=lambda n: net[n])
        out[name] = "output", "the others predict it more than it predicts them"
    return out


def _mostly_even(steps: NDArray[np.float64]) -> bool:
    usual = np.median(steps)
    return bool(np.mean(np.abs(steps - usual) < _EXACT * np.abs(usual)) >= _COUNTS)


def _is_held(values: NDArray[np.float64]) -> bool:
    """Tell whether a column moves in few rows, and then far, as what a person or a relay sets does."""
    known = values[np.isfinite(values)]
    moves = np.abs(np.diff(known))
    held = 0 < np.count_nonzero(moves) <= _HELD_SHARE * known.size
    return bool(held and np.median(moves[moves > 0]) >= _HELD_SIZE * np.ptp(known))


def _overlap(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the share of the wider range of two columns that both have."""
    low, high = np.nanmin([one, other], axis=1), np.nanmax([one, other], axis=1)
    return float((high.min() - low.max()) / (high - low).max())


def _unlike_inputs(
    columns: Mapping[str, NDArray[np.float64]], guesses: Mapping[str, tuple[str, str]], stated: Sequence[str]
) -> dict[str, tuple[str, str]]:
    """Return the columns that are inputs by unit alone and move in most rows while one of them or of the
    ``stated`` is held; where none is, a controller moves them."""
    by_unit = [n for n, (role, why) in guesses.items() if role == "input" and why.startswith("its unit")]
    likely = [n for n, (role, why) in guesses.items() if role == "input" or why == NO_CLUE]
    held = next((name for name in (*stated, *likely) if _is_held(columns[name])), None)
    finite = {name: columns[name][np.isfinite(columns[name])] for name in by_unit}
    moving = [n for n, v in finite.items() if np.count_nonzero(np.diff(v)) > _HELD_SHARE * len(v)]
    why = f"it moves in most rows, and {held} is held between its moves, as inputs are"
    return dict.fromkeys(moving if held else (), ("other", why))


def _computed(
    columns: Mapping[str, NDArray[np.float64]], guessed: Mapping[str, bool]
) -> dict[str, tuple[str, str]]:
    """Return the columns that are copies of others, or of a set point less a reading, with what they are of.

    ``guessed``: name -> whether a clue says what the column is, for those whose role is no user's; of two
    copies the one with a clue, else the first, stays.
    """
    shown = {n: v[:_MOST_ROWS] for n, v in columns.items() if np.ptp(v) > 0}  # of lost values none
    out: dict[str, tuple[str, str]] = {}
    order = sorted(shown, key=lambda n: (n in guessed) + (not guessed.get(n, True)))
    for at, name in enumerate(order):
        if name not in guessed:
            continue
        kept = [n for n in order[:at] if n not in out]
        own = shown[name]
        of = next((n for n in kept if _explains(own, shown[n]) or _rescaled(own, shown[n])), None)
        if of is not None:
            out[name] = "other", f"it is {of} in another unit"
            continue
        goals = [n for n in shown if n != name and (_SETPOINT.search(n.lower()) or _is_held(shown[n]))]
        pairs = ((g, n) for g in goals for n in kept if n not in goals) if not guessed[name] else ()
        both = next(((g, n) for g, n in pairs if _explains(shown[name], shown[g], shown[n])), None)
        if both is not None:
            out[name] = "other", f"it is computed from {both[0]} and {both[1]}"
    return out


def _explains(y: NDArray[np.float64], *some: NDArray[np.float64]) -> bool:
    """Tell whether a column is a sum of multiples of others but for rounding; of few moves nobody can."""
    if min(np.count_nonzero(np.diff(v)) for v in (y, some[-1])) < _SHOWS:
        return False
    x = np.column_stack([np.ones(y.size), *some])
    head = slice(0, 200)  # most that are no copies show it here
    moves = np.abs(np.diff(y))
    least = max(_EXACT * float(np.ptp(y)), float(moves[moves > 0].min(initial=np.inf)))
    for rows in (head, slice(None)):
        left = y[rows] - x[rows] @ np.linalg.lstsq(x[rows], y[rows], rcond=None)[0]
        if np.abs(left).max() > least or left.std() > _ROUNDED * y.std():
            return False
    return True


def _rescaled(*pair: NDArray[np.float64]) -> bool:
    """Tell whether two columns that often turn rise or fall with each other, but for fine rounding."""
    exact, fine = [], []
    for y, x in (pair, pair[::-1]):
        moves = np.diff(y)[np.diff(y) != 0]
        if np.count_nonzero(np.diff(np.sign(moves))) < _TURNS:
            return False
        in_order, least = y[np.argsort(x, kind="stable")], (1 + _EXACT) * np.abs(moves).min()
        exact.append(min((np.maximum.accumulate(s) - s).max() for s in (in_order, -in_order)) <= least)
        fine.append(exact[-1] and least <= _COARSE * y.std())
    return all(exact) or any(fine)


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
                problem = f"is listed as {chosen[name]} and as {role}"
                raise UserError(problem, file=file, column=name, hint="choose one")
            chosen[name] = role
    stated = (given or {}) | chosen
    guesses = {n: explain_role(n, unit) for n, unit in units.items() if n not in stated}
    if columns is not None:  # what is beyond all use is no reading, and its squares are none either
        columns = {n: np.where(np.abs(v) <= MOST_NUMBER, v, np.nan) for n, v in columns.items()}
    if columns is not None and all(len(values) >= _FEW for values in columns.values()):
        guesses |= _computed(columns, {n: why != NO_CLUE for n, (_, why) in guesses.items()})
        guesses |= _unlike_inputs(columns, guesses, [n for n, role in stated.items() if role == "input"])
    by_name = {name.lower(): name for name in guesses}
    if {"input", "output"} <= by_name.keys() and any(_SETPOINT.search(name.lower()) for name in units):
        why = "beside a set point it is the controller's:"
        guesses[by_name["input"]] = "output", f"{why} what it reads"
        guesses[by_name["output"]] = "input", f"{why} what it drives"
    fixed = {name: role for name, (role, why) in guesses.items() if why != NO_CLUE} | stated
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
    raise UserError("no such column", file=file, column=entry, hint=known_names(entry, units, "it has {}"))
