"""Logs to and from disk: text with units in the header, NetCDF, Parquet, MATLAB, Excel; bags.

Temperatures become degC and times s while reading, and nowhere else.  Findings and repairs
(:mod:`thermogrip.datasets.repair`) are in ``attrs["repairs"]``, a line each.  A record that thermogrip
itself wrote as NetCDF or Parquet is marked in its metadata and is read back exactly, without repairs.
"""

from __future__ import annotations

import gzip
import lzma
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from thermogrip.datasets import repair
from thermogrip.datasets.arrays import Array
from thermogrip.datasets.clock import CLOCK, EPOCH, Clock, clock_of, read_clock
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.evidence import effect_doubts, is_held
from thermogrip.datasets.files import atomic_path, file_format, file_stem, split_cut, write_atomic
from thermogrip.datasets.roles import Roles, assign_roles, guess_role
from thermogrip.datasets.schema import check_log, cut, hash_columns, make_log
from thermogrip.datasets.tables import (
    Table,
    check_header,
    frame_table,
    read_excel_table,
    read_matlab_table,
    read_parquet_table,
    read_text_table,
    switched,
    unused,
)
from thermogrip.datasets.units import Header, join_header, read_header, to_record_unit
from thermogrip.media.rendering import csv_cell

if TYPE_CHECKING:
    from pandas import DataFrame

    from thermogrip.datasets.schema import Log

#: What is taken for logs: themselves, DataFrames, paths of files; one or several.
Logs: TypeAlias = "Log | DataFrame | str | Path | Sequence[Log | DataFrame | str | Path]"

MOST_SIGNALS = 40  # of a table with a reading of one of them in a row
LOST_SHARE = 0.25  # of an output: one of the four blocks of a log that are held out would have no reading
NO_NUMBERS = "is left out: its cells are no numbers"
_MOST_READ = 9e37  # instruments write 9.9e37 for an overload (SCPI-99), loggers a float's largest, 3.4e38
MOST_STATES = 12  # words of a column that may be the states of a program


@dataclass(frozen=True)
class _Columns:
    """The columns of a table in the units of records."""

    clock: Clock
    values: dict[str, Array]  # by name
    units: dict[str, str]
    names_of: dict[str, str]  # the name that each header became
    repairs: list[str]  # what was converted and left out


def read_log(
    path: str | Path | DataFrame,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    *,
    known: Mapping[str, str] | None = None,
    columns: Sequence[str] | None = None,
    dt: float | None = None,
) -> Log:
    """Return the log in a file, or in a pandas DataFrame.

    Parameters
    ----------
    path : str, Path or DataFrame
        Text (``.csv``, ``.csv.gz``, ``.csv.xz``, ``.txt``, ``.dat``, ``.tsv``), ``.nc``, ``.parquet``,
        ``.mat``, ``.xlsx``, or a robot's ``.bag``, ``.db3``, ``.mcap`` (:mod:`~thermogrip.datasets.rosbag`)
        or the folder of a ROS 2 bag, optionally cut: ``"run.csv@120:1800"``.
    inputs, outputs, disturbances : sequence of str, optional
        Names of the variables in each role.  Where a list is absent the role is guessed from name and unit;
        where it is given it is complete.
    known : dict of name -> role, optional
        Roles that a model gives to its signals; they stand in for the guess.  Names that the file lacks are
        not looked for.
    columns : sequence of str, optional
        Headers in place of those of a text, ``.mat`` or ``.xlsx`` file, one a column; ``-`` leaves one out.
    dt : float, optional
        Time between rows [s], in place of the file's times.

    Returns
    -------
    log : Log
        Temperatures in degC, time in s.  ``attrs["repairs"]`` has a line a repair, ``attrs["guesses"]`` a
        line a guessed role with its reason, ``attrs["role_doubts"]`` and ``attrs["clock_doubts"]`` one a
        guess that decides what a fit sees (``attrs["reading_doubts"]`` those that stated roles do not
        settle), ``attrs["name"]`` the file's stem and cut, ``attrs["sha256"]`` the hash of the file's data,
        ``attrs["began"]`` the date and time of the first row, if the file has a clock.

    Raises
    ------
    UserError
        If the file cannot be read or a column, a cell or the time axis breaks a rule; the line names which.

    Examples
    --------
    >>> from thermogrip.datasets.examples import example_path
    >>> log = read_log(f"{example_path('step_up_down')}@:600")
    >>> log.sizes["time"], log["t_tank"].attrs["units"], log["pump"].attrs["role"]
    (1200, 'degC', 'input')
    >>> print(log.attrs["repairs"].splitlines()[0])
    t_tank: converted from K to degC
    """
    if not isinstance(path, str | Path):
        file = Path("DataFrame")
        start, stop = -np.inf, np.inf
        if columns is not None:
            raise UserError("has names of its own", file=file, hint="rename its columns")
        table = frame_table(path, str(file))
    else:
        file, start, stop = split_cut(path)
        table = _one_column_a_signal(_read_table(file, columns))
    of_model = [name for name, role in (known or {}).items() if role != "other"]
    named = [*(inputs or ()), *(outputs or ()), *(disturbances or ()), *of_model]
    check_header([*table.numbers, *table.text], named, str(file))
    if table.meta.get("schema") not in (None, "thermogrip.log"):
        raise UserError(f"holds a {table.meta['schema']}, not a log", file=file, hint="give a log")
    read = _convert(table, dt)
    if not read.values:
        content = "a time column and nothing else" if read.clock.columns else "no column of numbers"
        raise UserError(f"has {content}", file=file, hint="add inputs and outputs")
    lists = {"inputs": inputs, "outputs": outputs, "disturbances": disturbances}
    in_file = {name: table.attrs.get(header, {}).get("role", "") for header, name in read.names_of.items()}
    of_known = {name: role for name, role in (known or {}).items() if name in read.units}
    stated = {name: role for name, role in in_file.items() if role} | of_known
    roles = assign_roles(read.units, given=stated, columns=read.values, file=str(file), **lists)
    if table.meta.get("schema") == "thermogrip.log":
        repairs = [line for line in table.meta.get("repairs", "").splitlines() if line]
        log = _made(_Repaired(read.clock.seconds, read.values, repairs), read, roles, file)
        log.attrs.update({k: v for k, v in table.meta.items() if k not in ("schema", "version")})
    else:
        repaired = _repair(read.clock, read.values, read.units, roles.of, table)
        unusual, doubted = _reading_doubts(read, roles, repaired)
        repairs = [*read.repairs, *repaired.repairs, *unusual]  # whoever states the roles is warned
        of_clock = [line for line in repairs if isinstance(line, repair.ClockDoubt)]
        doubted += [line for line in repairs if isinstance(line, repair.Doubt) and line not in of_clock]
        if outputs is None:
            roles = _without_half_lost(roles, repaired.time, repaired.columns)
        log = _made(repaired._replace(repairs=repairs), read, roles, file)
        log.attrs["clock_doubts"] = "\n".join(filter(None, [read.clock.doubt, *of_clock]))
        log.attrs["reading_doubts"] = "\n".join(line for line in doubted if NO_NUMBERS not in line)
        log.attrs["role_doubts"] = "\n".join([*doubted, *unusual, *roles.doubts])
    for header, name in read.names_of.items():
        if (words := table.attrs.get(header, {}).get("flag_meanings")) and name in log:
            log[name].attrs["flag_meanings"] = words
    return _cut(log, start, stop) if (start, stop) != (-np.inf, np.inf) else log


def _made(repaired: _Repaired, read: _Columns, roles: Roles, file: Path) -> Log:
    """Return the log with what is known of its file: the hash of its data, its date, and why roles are so."""
    variables = {name: (cells, read.units[name], roles.of[name]) for name, cells in repaired.columns.items()}
    # a fault found here names the file
    log = make_log(repaired.time, variables, name=str(file), repairs=repaired.repairs)
    log.attrs["name"] = file_stem(file)
    log.attrs["sha256"] = hash_columns({"time": read.clock.seconds, **read.values})
    finite = read.clock.seconds[np.isfinite(read.clock.seconds)]
    began = read.clock.zero + float(finite.min(initial=np.inf))
    if EPOCH[0] <= began <= EPOCH[1]:
        log.attrs["began"] = str(np.datetime64(round(began), "s")) + "Z"
    log.attrs["guesses"] = "\n".join(f"{name}: {why}" for name, why in roles.reasons.items())
    return log


def as_logs(logs: Logs, *lists: Sequence[str] | None, known: Mapping[str, str] | None = None) -> list[Log]:
    """Return logs as they are, DataFrames and files as :func:`read_log` reads them in these roles."""
    from xarray import Dataset

    several = list(logs) if isinstance(logs, Sequence) and not isinstance(logs, str) else [logs]
    read = [log if isinstance(log, Dataset) else read_log(log, *lists, known=known) for log in several]
    for place, log in enumerate(read):
        log.attrs["name"] += f" {place + 1}" if log.attrs["name"] == "DataFrame" and len(several) > 1 else ""
    return read


def write_log(log: Log, path: str | Path) -> Path:
    """Write a log in one step and return the path.

    Parameters
    ----------
    log : Log
    path : str or Path
        ``.csv``, ``.csv.gz`` and ``.csv.xz`` keep units (in the header) and every digit of the numbers,
        ``.nc`` and ``.parquet`` roles and repairs as well.

    Raises
    ------
    UserError
        If the ending is unknown, a variable's unit has no header suffix, or the disk refuses.

    Examples
    --------
    >>> import tempfile
    >>> pump, t_tank = ([0, 1], "1", "input"), ([25.0, 0.1 + 0.2], "degC", "output")
    >>> log = make_log([0.0, 0.5], {"pump": pump, "t_tank": t_tank})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_log(log, Path(folder) / "run.csv")
    ...     print(path.read_text().split()[2], read_log(path)["t_tank"].values[1] == 0.1 + 0.2)
    0.5,1.0,0.30000000000000004 True
    """
    check_log(log)
    kind = check_written(path)
    if kind == "csv":
        return write_atomic(path, _as_csv(log, Path(path).suffix.lower()))
    if kind == "parquet":
        return _write_parquet(log, path)
    from thermogrip.datasets.netcdf import write_netcdf

    return write_netcdf(log, path)


def check_written(path: str | Path) -> str:
    """Return the format that a log is written in, by the path's ending; UserError where it is only read."""
    kind = file_format(path)
    if kind not in ("csv", "netcdf", "parquet"):
        problem = f"logs are not written with the ending {Path(path).suffix}"
        raise UserError(problem, file=path, hint="write .csv, .nc or .parquet")
    return kind


def _read_netcdf_table(path: str | Path) -> Table:
    """Return the variables over ``time`` of a NetCDF file as a table."""
    from thermogrip.datasets.netcdf import numbers_and_unit, open_netcdf

    data = open_netcdf(path)
    if "time" not in data.dims or "time" not in data.variables:
        hint = "give it a dimension and a variable 'time' in seconds"
        raise UserError("no time axis", file=path, hint=hint)
    not_over_time = [str(name) for name, variable in data.data_vars.items() if variable.dims != ("time",)]
    numbers: dict[str, Array] = {}
    attrs: dict[str, dict[str, str]] = {}
    for name in ["time", *map(str, data.drop_vars(not_over_time).data_vars)]:
        numbers[name], unit = numbers_and_unit(data[name], name, str(path))
        in_file = {str(key): str(value) for key, value in data[name].attrs.items()} | {"units": unit}
        attrs[name] = {key: in_file[key] for key in ("units", "role", "flag_meanings") if in_file.get(key)}
    meta = {str(key): str(value) for key, value in data.attrs.items()}
    notes = (f"left out, not over time alone: {', '.join(not_over_time)}",) if not_over_time else ()
    return Table(str(path), numbers, {}, np.arange(1, data.sizes["time"] + 1), attrs, meta, notes)


def _read_table(file: Path, columns: Sequence[str] | None) -> Table:
    kind = "rosbag" if os.path.isdir(file) else file_format(file)
    if kind in ("csv", "text"):
        return read_text_table(file, columns)
    if kind in ("matlab", "excel"):
        return read_matlab_table(file, columns) if kind == "matlab" else read_excel_table(file, columns)
    if columns is not None:
        raise UserError("has names of its own", file=file, hint="leave --columns out")
    if kind != "rosbag":
        return _read_netcdf_table(file) if kind == "netcdf" else read_parquet_table(file)
    from thermogrip.datasets.rosbag import read_rosbag_table

    return read_rosbag_table(file)


def _convert(table: Table, dt: float | None) -> _Columns:
    """Return the columns of a table in the units of records, and its clock."""
    headers = [*table.numbers, *table.text]
    read = {header: read_header(header, headers) for header in headers}
    read |= {h: Header(h, attrs["units"], 1.0) for h, attrs in table.attrs.items() if "units" in attrs}
    clock = clock_of(table, read, dt)
    table = _states_as_columns(table, clock)
    read |= {h: Header(read_header(h).name, "1", 1.0) for h in table.numbers if h not in read}
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    names_of = dict.fromkeys(clock.columns, "time")
    repairs, renamed = [*table.notes, *clock.notes], []
    for header, values in table.numbers.items():
        if header in clock.columns:
            continue
        name, unit, scale = read[header]
        if not np.isfinite(values).any():
            repairs.append(f"{header}: has no number in any row, left out")
            continue
        names_of[header] = name = unused(name or "c", ["time", *columns])
        beyond = np.isfinite(values) & (np.abs(values) > _MOST_READ)
        if beyond.any():
            values = np.where(beyond, np.nan, values)
            repairs.append(f"{name}: {beyond.sum()} reading(s) beyond {_MOST_READ:g} taken as lost")
        columns[name], units[name] = to_record_unit(values if scale == 1 else values * scale, unit)
        if header not in (name, f"{name}_{unit}"):
            renamed.append(f"{header!r} as {name}" + ("" if unit == "1" else f" [{unit}]"))
        if scale != 1:
            repairs.append(f"{name}: converted to {unit} (times {scale:g})")
        if units[name] != unit:
            repairs.append(f"{name}: converted from {unit} to {units[name]}")
        is_set = guess_role(name, units[name]) == "input" or is_held(columns[name])
        if table.meta.get("schema") != "thermogrip.log" and not is_set:
            columns[name], lost = repair.drop_codes(name, columns[name])
            repairs += lost
    words = [header for header in table.text if header not in clock.columns]
    repairs += [f"read {', '.join(renamed)}"] if renamed else []
    repairs += [f"left out, no numbers: {', '.join(words)}"] if words else []
    for header in words:
        cells = [cell for cell in table.text[header] if any(map(str.isdigit, cell))]
        if len({*cells}) > MOST_STATES and 2 * len(cells) > len(table.lines) and read_clock(cells) is None:
            repairs.append(repair.Doubt(f"{header} {NO_NUMBERS} ({cells[0]})"))
    return _Columns(clock, columns, units, names_of, repairs)


def _states_as_columns(table: Table, clock: Clock) -> Table:
    """Return a table with a column of 0 and 1 for each of a few words, but ``off`` or the most frequent."""
    numbers, text = dict(table.numbers), dict(table.text)
    notes = []
    for header in [header for header in table.text if header not in clock.columns]:
        counts = Counter(cell for cell in text[header] if cell)
        # words in single rows are notes of what was done
        lasting = {word for word, following in pairwise(text[header]) if word == following != ""}
        few_words = len(lasting) > 1 and len(counts) <= MOST_STATES and counts.total() >= 5 * len(counts)
        if not few_words or not all(any(map(str.isalpha, word)) for word in counts):  # numbers, misspelt
            continue
        cells = text.pop(header)
        resting_state = max(counts, key=lambda word: (word.lower() in ("off", "idle", "0"), counts[word]))
        made = []
        for state in sorted(counts.keys() - {resting_state}):
            made.append(unused(f"{header}_{state}", numbers))
            numbers[made[-1]] = np.array([float(cell == state) if cell else np.nan for cell in cells])
        as_columns = f"columns of 0 and 1 ({', '.join(made)}), all 0 in {resting_state}"
        notes.append(f"{header}: words read as {as_columns}")
    return replace(table, numbers=numbers, text=text, notes=(*table.notes, *notes))


def _one_column_a_signal(table: Table) -> Table:
    """Return a home hub's table, a reading of one signal in a row, with a column a signal; others as are."""
    clocks = [h for h, cells in table.text.items() if read_clock(cells[:20]) is not None]
    clocks += [h for h in table.numbers if read_header(h).name in ("time", "timestamp")]
    states = {h: switched(cells) for h, cells in table.text.items() if h not in clocks}
    named = [h for h in states if states[h] is None and 2 <= len({*table.text[h]}) <= MOST_SIGNALS]
    stamps = {h: table.text.get(h) or table.numbers[h].tolist() for h in clocks}
    clocks = [h for h in clocks if len({*stamps[h]}) > 1]
    if len(named) > 1 and clocks:
        finest = max(named, key=lambda h: len({*table.text[h]}))
        if len({*zip(*(table.text[h] for h in named))}) == len({*table.text[finest]}):
            named = [finest]  # of each signal the others say its kind or unit
        elif 2 * len({*stamps[clocks[0]]}) <= len(table.lines):
            # beside each stamp a signal stands once, words of its quality do not
            named = [max(named, key=lambda h: len({*zip(stamps[clocks[0]], table.text[h])}))]
    if not clocks or len(named) != 1:
        return table
    signals = [name.rpartition(".")[2] for name in table.text[named[0]]]
    columns = {**table.numbers, **{h: v for h, v in states.items() if v is not None}}
    readings = {h: v for h, v in columns.items() if h not in clocks and np.isfinite(v).any()}
    count = len({*signals})
    # a column with a number for each signal is its name once more
    values = [h for h, v in readings.items() if len({*zip(signals, v)}) > count or np.unique(v).size < count]
    if len(values) != 1 or len(table.lines) < 5 * count:
        return table
    clock, value = clocks[0], readings[values[0]]
    clock_of_text = read_clock(table.text[clock]) if clock in table.text else None
    time = table.numbers[clock] if clock_of_text is None else clock_of_text[0]
    order = np.argsort(time, kind="stable")
    times, first = np.unique(time[order], return_index=True)
    text = {clock: [table.text[clock][row] for row in order[first]]} if clock in table.text else {}
    numbers = {} if text else {clock: times}
    rows_of = {signal: order[np.asarray(signals)[order] == signal] for signal in dict.fromkeys(signals)}
    for signal, rows in rows_of.items():
        newest = np.searchsorted(time[rows], times, side="right") - 1
        numbers[signal] = np.where(newest < 0, np.nan, value[rows[newest]])
    names = ", ".join(sorted({*signals}))
    notes = [f"a reading of one signal in a row: {names} each hold until their next reading"]
    steps = np.concatenate([np.diff(time[rows]) for rows in rows_of.values()])
    period = float(np.median(steps))
    even = np.mean(np.abs(steps - period) < CLOCK.evenness * period) >= CLOCK.monotone_share
    if even and times.size >= 2 * max(map(len, rows_of.values())):
        says = f"signals are read in turn, each every {period:.3g} s"
        notes.append(repair.Doubt(f"{says}: average the log over that (--average {period:.3g})"))
    lines = np.arange(1, times.size + 1)
    return replace(table, numbers=numbers, text=text, lines=lines, notes=(*table.notes, *notes))


class _Repaired(NamedTuple):
    """Time and columns of a log, and a line a finding."""

    time: Array
    columns: dict[str, Array]
    repairs: list[str]


def _repair(
    clock: Clock, columns: dict[str, Array], units: dict[str, str], roles: dict[str, str], table: Table
) -> _Repaired:
    """Return the repaired time and columns."""
    again = np.diff(clock.seconds) == 0
    alike = np.all([(v[1:] == v[:-1]) | np.isnan(v[1:]) for v in columns.values()], axis=0)
    # else the clock is coarse; where nothing moves nobody can tell
    written_twice = again.any() and alike[again].all() and 2 * alike[~again].sum() < (~again).sum()
    once = np.append(True, ~(again & written_twice))
    ordered = repair.order_rows(clock.seconds[once], table.lines[once], table.file, *sorted(clock.columns))
    time, repairs = ordered.time, ordered.repairs
    if written_twice:
        repairs.append(f"{again.sum()} rows dropped that repeat the one before and its time")
    columns = {name: values[once][ordered.rows] for name, values in columns.items()}
    lines = table.lines[once][ordered.rows]
    left_out = {"a program filled all columns": repair.filled_rows(columns, roles)}
    for name in [name for name in columns if roles[name] == "input"]:
        left_out[f"{name} is not known"] = repair.unknown_rows(columns[name], time)
    for why, rows in left_out.items():
        which = repair.name_rows(lines[rows])
        repairs += [f"{rows.sum()} row(s) left out in which {why}: {which}"] if rows.any() else []
    kept = ~np.any([*left_out.values()], axis=0)
    time, columns = time[kept], {name: values[kept] for name, values in columns.items()}
    if time.size < 2:
        why_few = [*repairs, *(note for note in table.notes if isinstance(note, repair.Doubt))]
        problem = "; ".join([f"{time.size} row(s) are not a log", *why_few])
        raise UserError(problem, file=table.file, hint="give at least two rows")
    repairs += repair.doubt_repeats([*columns.values()], lines[kept])
    if time[0] >= EPOCH[0]:
        repairs.append(f"time is a clock of seconds since 1970: counted from the first row, {time[0]:.0f} s")
        time = np.round(time - time[0], 6)
    repairs += repair.describe_steps(time)
    inputs, stuck = [values for name, values in columns.items() if roles[name] == "input"], False
    for name, values in columns.items():
        if roles[name] == "output" and inputs and time.size >= repair.SPIKE_WINDOW:
            moving, findings = repair.drop_stuck(name, values, inputs)
            repairs, stuck = repairs + findings, stuck or bool(findings)
            if np.isfinite(moving).any():
                values = moving
            else:  # nothing is left of it to be predicted
                roles[name] = "other"
        columns[name], findings = _repair_column(name, values, time, units[name], roles[name], table.file)
        repairs += findings
    finite_outputs = [np.isfinite(v) for n, v in columns.items() if roles[n] == "output"]
    read = np.any(finite_outputs or [np.ones(time.size, dtype=bool)], axis=0)
    if stuck and not (read[0] and read[-1]):  # a held-out part without any reading has no error
        first, last = int(read.argmax()), int(read.size - read[::-1].argmax())
        count = read.size - (last - first)
        repairs.append(f"{count} rows at the ends of the log, in which no output reads, left out")
        time, columns = time[first:last], {name: v[first:last] for name, v in columns.items()}
    repairs += repair.describe_gaps(time, {n: v for n, v in columns.items() if roles[n] == "input"})
    return _Repaired(time, columns, repairs)


def _reading_doubts(read: _Columns, roles: Roles, log: _Repaired) -> tuple[list[str], list[str]]:
    """Return what is unusual in readings, as in many sound logs, and what hardly any sound log has."""
    drives = {name: values for name, values in log.columns.items() if roles.of[name] == "input"}
    readings = {name: v for name, v in log.columns.items() if roles.of[name] in ("output", "disturbance")}
    unusual, doubts = [], []
    for name, values in readings.items():
        if roles.of[name] == "disturbance" and read.units[name] != "degC":
            values = np.where(values == 0, np.nan, values)  # at night and in a calm no sensor ends
        unusual.append(repair.doubt_readings(name, values, [*drives.values()], log.time))
    for name, values in drives.items():
        doubts += [repair.doubt_full_scale(name, values, read.units[name]), repair.doubt_moves(name, values)]
    for name in [name for name in readings if roles.of[name] == "output"]:
        doubts.append(repair.doubt_rows(name, readings[name]))
        unusual += [repair.doubt_lead(name, readings[name], *drive, log.time) for drive in drives.items()]
    of_role = ([n for n in log.columns if roles.of[n] == role] for role in ("input", "output", "disturbance"))
    after_gap = np.isin(np.arange(log.time.size), repair.gap_rows(log.time) + 1)
    sensed = {name: np.where(after_gap, np.nan, values) for name, values in readings.items()}
    doubts += effect_doubts(log.columns | sensed, *of_role)
    return [*filter(None, unusual)], [*filter(None, doubts)]


def _without_half_lost(roles: Roles, time: Array, columns: Mapping[str, Array]) -> Roles:
    """Return roles without the outputs that miss a long part of what others have, which a fit would lose."""
    lost = {n: float(np.isnan(v).mean()) for n, v in columns.items() if roles.of[n] == "output"}
    whole = next((n for n, share in lost.items() if share < LOST_SHARE / 5), None)
    reasons, doubts = {}, []
    for name in [n for n, share in lost.items() if share > LOST_SHARE and whole is not None]:
        why = f"it has no reading in {100 * lost[name]:.0f} % of the rows, {whole} has"
        first, *_, last = time[np.isfinite(columns[name])]
        log_cut = f"LOG@{first:.6g}:{last:.6g}"
        doubts.append(f"{name} is left out: {why}; to fit it too, cut the log to where it reads: {log_cut}")
        reasons[name] = why
    roles_left = roles.of | dict.fromkeys(reasons, "other")
    return Roles(roles_left, roles.reasons | reasons, (*roles.doubts, *doubts))


def _repair_column(
    name: str, values: Array, time: Array, unit: str, role: str, file: str
) -> tuple[Array, list[str]]:
    repairs: list[str] = []
    values = np.where(np.isinf(values), np.nan, values)
    if role in ("input", "disturbance"):
        values, repairs = repair.fill_lost(name, values, time if role == "disturbance" else None)
    elif role == "output":
        lost = int(np.isnan(values).sum())
        floor = repair.SPIKE_FLOOR_K if unit == "degC" else None
        values, repairs = repair.reject_spikes(name, values, time, floor=floor)
        if lost:
            repairs = [f"{name}: {lost} lost sample{'' if lost == 1 else 's'} left empty", *repairs]
    if unit == "degC" and role in ("output", "disturbance"):
        repairs = repairs + repair.check_plausible(name, values, file)
    return values, repairs


def _cut(log: Log, start: float, stop: float) -> Log:
    log_part = cut(log, start, stop)
    first, last = (f"{end:.10g}" if np.isfinite(end) else "" for end in (start, stop))
    log_part.attrs["name"] = f"{log.attrs['name']}@{first}:{last or 'end'}"
    repairs = [line for line in str(log.attrs["repairs"]).splitlines() if line]
    note = f"taken from {f'{first} s' if first else 'the start'} to {f'{last} s' if last else 'the end'}"
    repairs.append(f"{note}; the lines above speak of the whole log" if repairs else note)
    log_part.attrs["repairs"] = "\n".join(repairs)
    return log_part


def _as_csv(log: Log, ending: str) -> bytes:
    """Return a log as text, packed as its ending says; each number reads back as the same double."""
    names = [join_header(str(n), v.attrs["units"], [*log]) for n, v in log.data_vars.items()]
    header = [str(csv_cell(name)) for name in names]
    data = log.to_dataframe().to_csv(header=header, index_label="time_s", lineterminator="\n").encode()
    if ending == ".gz":
        return gzip.compress(data, mtime=0)  # without a date the same log is the same file
    return lzma.compress(data) if ending == ".xz" else data


def _write_parquet(log: Log, path: str | Path) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    fields = [pa.field("time", pa.float64(), metadata={"units": "s"})]
    for name, variable in log.data_vars.items():
        kept_attrs = {key: variable.attrs[key] for key in ("units", "role")}
        fields.append(pa.field(str(name), pa.float64(), metadata=kept_attrs))
    schema = pa.schema(fields, metadata={str(key): str(value) for key, value in log.attrs.items()})
    arrays = [pa.array(log[field.name].values, from_pandas=False) for field in fields]
    table = pa.Table.from_arrays(arrays, schema=schema)
    with atomic_path(path) as temporary:
        parquet.write_table(table, temporary, write_page_checksum=True)
    return Path(path)
