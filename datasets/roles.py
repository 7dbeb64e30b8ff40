"""Roles of the columns of a log: input, disturbance, output or other, and what each guess rests on.

Names come first, then units.  Where they show no input or no output, the data do (:func:`roles_of_data`).
A guess that decides what a fit sees (a role that the course of a column alone shows, a column left out that
helps to predict an output) is reported as a doubt.  Whoever states the roles has none.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.evidence import (
    EVIDENCE,
    Columns,
    comes_to,
    explains,
    is_held,
    is_moved,
    one_signal,
    predictive_gain,
    responds,
    role_doubts,
    some_rows,
)
from thermogrip.datasets.repair import find_spikes
from thermogrip.datasets.units import DRIVE, find_column

_Guesses: TypeAlias = dict[str, tuple[str, str]]  # role and reason, by name

_SETPOINT = re.compile(
    r"^(t_?)?(setpoint|set_point|target|sp|set)(_?\d+)?(_.*)?$|^reference(_.*|\d*)$"
    r"|_(setpoint|set_point|target|sp|set|goal|soll(wert)?)(_?\d+)?$|^(goal|desired)(_.*|\d*)$"
    r"|^(soll(wert)?|ziel(wert|temperatur)?|consign[ae])(_.*|\d*)$"
)
_SET_DRIVE = re.compile(r"^(set|soll)(_.*|\d*)$|_(set|soll)$|^(goal|desired)")  # set_percent is of a drive
_OF_DRIVES = ("percent", "V", "A", "W", "0_255")
_OUTDOORS = re.compile(
    r"(^|_)(outside|outdoors?|weather|wind|cloud|rain|sol)(_|$)|solar|irradia|^(to|te|text|toa|oat|ghi)$"
)
_ROOM = re.compile(r"ambient|(^|_)(amb|room)(_|$)")
_INPUT = re.compile(
    DRIVE.pattern + r"|(^|_)(pwm|duty|heater|relay)$|^[a-z]?\d?@$"  # @ is the duty of a printer's board
)
_READING = re.compile(r"_(temp|temperature)$")  # of a heater too: heater_bed_temp
_TEMPERATURE = re.compile(r"^(t|temp|temperature)(\d*|_.*)$|" + _READING.pattern)  # of the plant or around it
_OUTPUT = re.compile(
    r"^(y|level|outlet|position|speed|pv|angle|velocity|response|measured)(\d*|_.*)$|" + _TEMPERATURE.pattern
)
_HUMIDITY = re.compile(r"humid|moisture|(^|_)rh(_|\d*$)")  # in percent, as drives are
_INFLOW = re.compile(r"(^|_)(inlet|inflow|supply_air)(_|$)")
_BOOKKEEPING = re.compile(
    r"^(error|err|control_error|proportional|integral|derivative|[pid]_?(term|part|action)|k_?[pidc]|pid_[pid]"
    r"|ms|msec|second|minute|hour|day|month|year|week|weekday|row|index|id|iteration|sample|record|counter"
    r"|i[as]e|mean|std_?(dev)?|min|max|dew_?point|feels_like|heat_index|batt(ery)?(_level|_u?v)?)(_of_[a-z]+|_?no|_?\d+)?$"
)
_ESTIMATE = re.compile(r"(_?hat|_(est(imated?)?|pred(icted)?|filt(ered)?|avg|average|smooth(ed)?))$")
_MODES = {"auto", "automatic", "manual", "mode", "status"}  # of a controller
IS_SET_POINT = "its name is that of a set point"
_IS_BOOKKEEPING = "its name is that of a clock, a controller's term or a computed value"
NO_CLUE = "neither its name nor its unit shows what it is"
_NEVER_MOVES, _COUNTS_ROWS = "it never moves", "it counts rows or time"
BY_UNIT = "its unit is degC"
FOLLOWS = "its course follows"
_TOGETHER, _OF_CONTROLLER = "it always moves with", "beside a set point it is the controller's:"
_ESTABLISHED = (_TOGETHER, _OF_CONTROLLER, "it is ", _NEVER_MOVES, _COUNTS_ROWS)  # by the course itself
FOLLOWED = "settles at its levels, as at a set point"


@dataclass(frozen=True)
class Roles:
    """Roles of the columns of a log."""

    of: dict[str, str]  # by name
    reasons: dict[str, str] = field(default_factory=dict)  # of those that are guesses
    doubts: tuple[str, ...] = ()  # guesses that decide, a line each


def is_room_temperature(name: str, unit: str) -> bool:
    """Tell whether a measured disturbance is the temperature of the surroundings: no other quantity, and not
    that of what flows in."""
    return unit == "degC" and not _INFLOW.search(_name_words(name))


def guess_role(name: str, unit: str) -> str:
    """Return the role that a name and a unit suggest: input, disturbance, output or other."""
    return explain_role(name, unit)[0]


def explain_role(name: str, unit: str) -> tuple[str, str]:
    """Return the role that a name and a unit suggest, and why: names come first, then units."""
    words, celsius = _name_words(name), unit == "degC"
    set_drive = _SET_DRIVE.search(words) and unit in _OF_DRIVES
    rows = (
        (_SETPOINT.search(words) and not set_drive, "other", IS_SET_POINT),
        (_BOOKKEEPING.match(words), "other", _IS_BOOKKEEPING),
        (_OUTDOORS.search(words) or _ROOM.search(words), "disturbance",
         "its name is that of the surroundings"),
        (_INFLOW.search(words) and (celsius or "temp" in words), "disturbance",
         "its name is that of what flows in"),
        (_INPUT.search(words) and unit not in ("degC", "s") and not _READING.search(words), "input",
         "its name is that of a drive"),
        (_OUTPUT.search(words) and unit != "s", "output", "its name is that of a reading"),
        (celsius, "output", BY_UNIT),
        (unit == "percent" and _HUMIDITY.search(words), "output", "its name is that of a reading"),
        (unit in ("percent", "V", "0_255"), "input", f"its unit is {unit}"),
    )  # fmt: skip
    return next(((role, why) for applies, role, why in rows if applies), ("other", NO_CLUE))


def assign_roles(
    units: dict[str, str],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    given: Mapping[str, str] | None = None,
    columns: Columns | None = None,
    file: str | None = None,
) -> Roles:
    """Return the role of each variable of ``units`` (name -> unit), and what the guesses among them rest on.

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
    stated = dict(given or {}) | chosen
    guesses = {n: explain_role(n, unit) for n, unit in units.items() if n not in stated}
    made_of = {f"asked_{n}": f"it is what was asked of {n}" for n in units}
    made_of |= {n: f"it is made of {of}" for n in units if (of := _ESTIMATE.sub("", n)) != n and of in units}
    guesses |= {n: ("other", made_of[n]) for n in guesses if n in made_of}
    evidence: _Guesses = {}  # of the data alone
    if columns is not None:
        if all(len(values) >= EVIDENCE.fewest_rows for values in columns.values()):
            guesses |= _copied_columns(columns, guesses, units)
        # one spike hides every effect; repairs reject it once roles are known
        read = [n for n, (role, _) in guesses.items() if role != "input" and not is_held(columns[n])]
        spikes = {n: find_spikes(columns[n], floor=None) for n in read}
        columns = {**columns, **{n: np.where(spikes[n], np.nan, columns[n]) for n in read}}
        if any(_SETPOINT.search(_name_words(name)) for name in units):
            guesses |= _controllers(guesses)
        evidence |= _followed_levels(columns, guesses)
        known = guesses | evidence
        fixed = {name: role for name, (role, why) in known.items() if why != NO_CLUE} | stated
        if not {"input", "output"} <= {*fixed.values()}:
            evidence |= roles_of_data(columns, units, fixed)
        evidence |= _moved_otherwise(columns, guesses | evidence, stated, find_causes=not lists["input"])
        guesses |= evidence
    roles, reasons = {}, {}
    for name in units:
        guess, why = guesses.get(name, (stated.get(name, "other"), ""))
        roles[name] = chosen.get(name, "other" if lists.get(guess) is not None else guess)
        if why and roles[name] == guess:
            reasons[name] = why
    doubts = [f"{name} is left out: {why}" for name, why in reasons.items() if why.startswith(_TOGETHER)]
    if columns is not None and lists["input"] is None:  # what was not listed was not meant
        goals = [n for n, why in reasons.items() if why == IS_SET_POINT and n not in evidence]
        words = {_name_words(name) for name in units}
        of_readings = [n for n in goals if _name_words(n).rpartition("_")[0] in words]  # called as they are
        sound = (*_ESTABLISHED, *([_IS_BOOKKEEPING] if goals else []))
        unsure = {n: why for n, why in reasons.items() if not why.startswith(sound)}
        unsure = {n: why for n, why in unsure.items() if n not in (*evidence, *of_readings)}
        doubts += role_doubts(columns, roles, unsure, goals)
    doubts += _kelvin_doubts(columns or {}, [n for n in reasons if roles[n] == "output" and units[n] == "1"])
    # a role that the course of a column alone shows: whoever states the roles has no doubt
    doubts += [
        f"{name} is {'left out' if role == 'other' else f'taken as {role}'}: {why}"
        for name, (role, why) in evidence.items()
        if reasons.get(name) == why and (role != "other" or why.endswith(FOLLOWED))
    ]
    return Roles(roles, reasons, tuple(doubts))


def _kelvin_doubts(columns: Columns, outputs: Sequence[str]) -> Iterator[str]:
    """Yield a line for each output without a unit that may be in kelvin, its tenths or its hundredths."""
    for name in [name for name in outputs if name in columns]:
        median = float(np.nanmedian(columns[name]))
        if any(250 < median * part < 350 for part in (1, 0.1, 0.01)):
            yield f"{name} has no unit and a median of {median:.4g}: kelvin, or a part of it? State its unit"


def _controllers(guesses: _Guesses) -> _Guesses:
    """Return the columns that are what a controller calls them, where a set point shows that it does: what it
    reads, what it drives, and its terms."""
    by_name = {name.lower(): name for name in guesses}
    reads, drives = by_name.keys() & {"input", "pv"}, by_name.keys() & {"output", "op", "out", "co"}
    terms = by_name.keys() & {"p", "i", "d"}
    is_loop = drives and (reads or any(role == "output" for role, _ in guesses.values()))
    meanings = (
        (reads if is_loop else (), "output", "what it reads"),
        (drives if is_loop else (), "input", "what it drives"),
        (by_name.keys() & _MODES, "other", "its mode"),
        (terms if len(terms) > 1 else (), "other", "one of its terms"),
    )
    return {by_name[n]: (role, f"{_OF_CONTROLLER} {what}") for names, role, what in meanings for n in names}


def roles_of_data(columns: Columns, units: Mapping[str, str], fixed: Mapping[str, str]) -> _Guesses:
    """Return role and reason, as the data show them, of the columns (n_row,) that ``fixed`` gives no role."""
    out: _Guesses = {}
    for name in [name for name in columns if name not in fixed]:
        values = columns[name][np.isfinite(columns[name])]
        steps, rows = np.diff(values), max(values.size, 1)
        usual = np.median(steps) if steps.size else 0.0
        even = np.abs(steps - usual) < EVIDENCE.exact * np.abs(usual)
        if not steps.any():
            out[name] = "other", _NEVER_MOVES
        elif rows >= EVIDENCE.fewest_rows and np.mean(even) >= EVIDENCE.counter_share:
            out[name] = "other", _COUNTS_ROWS
        # held between few large moves
        elif is_held(values):
            out[name] = "input", f"it is held between {np.count_nonzero(steps)} moves in {rows} rows"
    at_ends = [n for n, (role, _) in out.items() if role == "input" and not np.diff(columns[n])[1:-1].any()]
    likely = columns.keys() - {*fixed, *at_ends, *(n for n, (role, _) in out.items() if role == "other")}
    if len(likely) > 1:  # beside one alone it is all that can have moved it
        out |= dict.fromkeys(at_ends, ("other", f"{_NEVER_MOVES} but in its first or last row"))
    roles = {**fixed, **{name: role for name, (role, _) in out.items()}}
    names = [n for n in columns if roles.get(n) != "other" and np.nanmax(columns[n]) > np.nanmin(columns[n])]
    gain = predictive_gain([columns[name] for name in names])
    open_, net = [n for n in names if n not in roles], dict(zip(names, (gain - gain.T).sum(axis=1)))
    for name in open_:
        help_ = gain[:, names.index(name)]
        # its next value is predicted by another column's past
        if help_.max() > EVIDENCE.strong_gain:
            out[name] = "output", f"{FOLLOWS} {names[int(help_.argmax())]}"
    roles |= {name: role for name, (role, _) in out.items()}
    has_held_input = any(roles.get(n) == "input" and is_held(columns[n]) for n in names)
    for name in [n for n in open_ if n not in roles]:
        role = "disturbance" if has_held_input or units[name] == "degC" else "input"
        out[name] = role, "no other column predicts its course"
    roles |= {name: role for name, (role, _) in out.items()}
    if len(open_) == 1 and "output" not in roles.values():
        roles[open_[0]], out[open_[0]] = "output", ("output", "there is nothing else to predict")
    elif open_ and "input" not in roles.values():
        lead = dict(zip(names, gain.sum(axis=1)))
        for name in [n for n in open_ if net[n] > 0] or [max(open_, key=lambda n: lead[n])]:
            roles[name], out[name] = "input", ("input", "no other predicts the others more")
    if len(open_) > 1 and "output" not in roles.values():
        name = min(reversed(open_), key=lambda n: net[n])
        out[name] = "output", "the others predict it more than it predicts them"
    return out


def _followed_levels(columns: Columns, guesses: _Guesses) -> _Guesses:
    """Return the held columns whose levels a reading comes to while another column drives it, as set points,
    and the readings that no name shows, as outputs."""
    likely = [n for n in columns if guesses.get(n, ("", ""))[1] in (NO_CLUE, BY_UNIT)]
    held_names = [n for n in likely if is_held(columns[n])]
    out: _Guesses = {}
    for goal in held_names:
        moving = [n for n in columns if n not in held_names]
        read = [n for n in moving if guesses.get(n, ("output", ""))[0] in ("output", "other")]
        reading = next((n for n in read if comes_to(columns[n], columns[goal])), None)
        if reading is None:
            continue
        drives = [n for n, (role, why) in guesses.items() if role == "input" or why == NO_CLUE]
        if any(is_moved(columns, reading, [n]) for n in drives if n not in (goal, reading)):
            out[goal] = "other", f"{reading} {FOLLOWED}"
            if guesses.get(reading, ("", ""))[1] == NO_CLUE:
                out[reading] = "output", f"it settles at the levels of {goal}"
    return out


def _moved_otherwise(
    columns: Columns, guesses: _Guesses, stated: Mapping[str, str], *, find_causes: bool
) -> _Guesses:
    """Return what moves, or is moved, otherwise than its name says: rooms that a drive heats are outputs,
    held columns that help to predict an output inputs, readings that no drive moves disturbances."""
    roles = {name: role for name, (role, _) in guesses.items()} | dict(stated)
    drives, outputs, surroundings = (
        [n for n in columns if roles[n] == role] for role in ("input", "output", "disturbance")
    )
    out = {}
    # a rig warms the room around it too: beside another output only what is called a room is one
    rooms = re.compile(r"(^|_)room(_|$)") if outputs else _ROOM
    for name in [n for n in surroundings if n in guesses and rooms.search(_name_words(n))]:
        drive = next((n for n in drives if is_moved(columns, name, [n])), None)
        if drive is not None and not _OUTDOORS.search(_name_words(name)):  # weather is heated by nobody
            out[name] = "output", f"it follows the drive {drive}, as no surroundings do"
    outputs += out
    if not drives or not outputs or not find_causes:
        return out
    causes = {}
    for name in [n for n, (_, why) in guesses.items() if why == NO_CLUE and is_held(columns[n])]:
        helped = next((n for n in outputs if is_moved(columns, n, [name], drives)), None)
        if helped is not None:
            causes[name] = "input", f"it is held between its moves and helps to predict {helped}"
    drives += causes
    out |= causes
    unnamed = [n for n in outputs if guesses.get(n, ("", ""))[1].startswith((BY_UNIT, FOLLOWS))]
    unmoved = [n for n in outputs if not responds(columns, n, drives, outputs)]
    moved = [n for n in outputs if n not in unmoved]
    for name in [n for n in unmoved if n in guesses and moved]:
        of_temperature = _TEMPERATURE.search(_name_words(name))  # it may follow what a drive moves
        if name in unnamed or (of_temperature and not is_moved(columns, name, moved)):
            out[name] = "disturbance", f"it does not respond to {', '.join(drives)}"
    return out


def _name_words(name: str) -> str:
    """Return a name in lower case with its words apart: ``BeerSet`` and ``Beer-Set`` as ``beer_set``."""
    return re.sub(r"[-.:]+|(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def _copied_columns(columns: Columns, guesses: _Guesses, units: Mapping[str, str]) -> _Guesses:
    """Return the columns that are one signal with another, or a set point less a reading, and of what."""
    moving = {n: some_rows(v) for n, v in columns.items() if np.ptp(v) > 0}  # of lost values none
    out: _Guesses = {}
    # of two copies the one with a clue, else the first, stays
    order = sorted(moving, key=lambda n: (n in guesses) + (guesses.get(n, ("", ""))[1] == NO_CLUE))
    for place, name in enumerate(order):
        if name not in guesses:
            continue
        (role, why), values = guesses[name], moving[name]
        # one signal within their steps: each is a multiple of the other and a constant
        for other in [n for n in order[:place] if n not in out]:
            role_of_other = guesses.get(other, (role, ""))[0]
            # what is read is no copy of what is driven, a multiple of it under a proportional controller
            if not one_signal(values, moving[other]) or {role, role_of_other} == {"input", "output"}:
                continue
            # no fit estimates the effects of two inputs that always move together: one stays for both
            drives = role == role_of_other == "input"
            drives |= guesses.get(other, ("", ""))[1] == NO_CLUE == why and is_held(values)
            if drives and units[name] == units[other]:
                says = f"{_TOGETHER} {other}, and their effects cannot be estimated separately"
                out[name] = "other", f"{says}: {other} is kept for both"
            # of two states every pair would be copies
            elif min(np.unique(v).size for v in (values, moving[other])) > 2:
                out[name] = "other", f"it is {other} in another unit"
            break
        if name in out or why != NO_CLUE:
            continue
        goals = [n for n in moving if n != name and (_SETPOINT.search(_name_words(n)) or is_held(moving[n]))]
        goals = [n for n in goals if not one_signal(values, moving[n])]
        pairs = ((g, n) for g in goals for n in order[:place] if n not in (*goals, *out))
        both = next(((g, n) for g, n in pairs if explains(values, moving[g], moving[n])), None)
        if both is not None:
            out[name] = "other", f"it is computed from {both[0]} and {both[1]}"
    return out
