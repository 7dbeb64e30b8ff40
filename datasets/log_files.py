"""Logs and grasps to and from disk: CSV with units in the header, NetCDF, Parquet; logs from bags.

A CSV file is a table with one row a sample; the header has the units (:mod:`thermogrip.datasets.units`)::

    time_s,drive,pump,t_tank_K,t_surface_degC,t_ambient_degC

Temperatures become degC and times s while reading, and nowhere else.  Findings and repairs
(:mod:`thermogrip.datasets.repair`) are in ``attrs["repairs"]``, a line each.  A record that thermogrip
itself wrote as NetCDF or Parquet is marked in its metadata and is read back exactly, without repairs.

A log may be cut: ``run.csv@120:1800`` is its seconds 120 <= t < 1800 and either end may be empty, so that
``run.csv@:1350`` and ``run.csv@1350:`` share no sample.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import atomic_path, source_size, write_atomic
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import check_size
from thermogrip.datasets.media import csv_text
from thermogrip.datasets.netcdf import convention_unit, open_netcdf, write_netcdf
from thermogrip.datasets.repair import (
    SPIKE_FLOOR_K,
    check_plausible,
    describe_gaps,
    describe_steps,
    drop_repeated,
    fill_disturbance,
    fill_input,
    from_first_row,
    reject_spikes,
)
from thermogrip.datasets.schema import check_log, hash_columns, make_log, names
from thermogrip.datasets.tables import (
    Table,
    check_table,
    file_format,
    file_stem,
    read_csv_table,
    read_parquet_table,
)
from thermogrip.datasets.units import (
    assign_roles,
    explain_role,
    find_column,
    join_header,
    split_header,
    to_record_unit,
)

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log

Floats = NDArray[np.float64]

_CUT = re.compile(r"^(?P<path>.+)@(?P<start>[^@:/\\]*):(?P<stop>[^@:/\\]*)$")


def read_log(
    path: str | Path,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    *,
    known: Mapping[str, str] | None = None,
) -> Log:
    """Return the log in a file.

    Parameters
    ----------
    path : str or Path
        ``.csv``, ``.csv.gz``, ``.csv.xz``, ``.nc``, ``.parquet``, or a robot's ``.bag``, ``.db3``, ``.mcap``
        (:mod:`~thermogrip.datasets.rosbag`) or the folder of a ROS 2 bag, optionally cut:
        ``"run.csv@120:1800"``.
    inputs, outputs, disturbances : sequence of str, optional
        Names of the variables in each role.  Where a list is absent the role is guessed from name and unit;
        where it is given it is complete.
    known : dict of name -> role, optional
        Roles that a model gives to its signals; they stand in for the guess.  Names that the file lacks are
        not looked for.

    Returns
    -------
    log : Log
        Temperatures in degC, time in s.  ``attrs["repairs"]`` has a line a repair, ``attrs["guesses"]`` a
        line a guessed role with its reason, ``attrs["name"]`` the file's stem and cut, ``attrs["sha256"]``
        the hash of the file's data.

    Raises
    ------
    UserError
        If the file cannot be read or a column, a cell or the time axis breaks a rule; the line names which.

    Examples
    --------
    >>> from thermogrip.datasets.examples import example_path
    >>> log = read_log(f"{example_path('step_up_down')}@:600")
    >>> log.sizes["time"], log["t_tank"].attrs["units"], names(log, "input")
    (1200, 'degC', ('drive', 'pump'))
    >>> print(log.attrs["repairs"].splitlines()[0])
    t_tank: converted from K to degC
    """
    file, start, stop = split_cut(path)
    table = _TABLES[_format(file)](file)
    if table.meta.get("schema") not in (None, "thermogrip.log"):
        raise UserError(f"holds a {table.meta['schema']}, not a log", file=file, hint="give a log")
    columns, units, repairs = _convert(table)
    sha256 = hash_columns(columns)
    time = columns.pop("time")
    del units["time"]
    if not columns:
        raise UserError("has a time column and nothing else", file=file, hint="add inputs and outputs")
    lists = {"inputs": inputs, "outputs": outputs, "disturbances": disturbances}
    of_model = {name: role for name, role in (known or {}).items() if name in units}
    in_file = _given_roles(table)
    roles = assign_roles(units, given=in_file | of_model, file=str(file), **lists)
    own = table.meta.get("schema") == "thermogrip.log"
    if own:
        repairs = [line for line in table.meta.get("repairs", "").splitlines() if line]
    else:
        time, columns, found = _repair(time, columns, units, roles, table)
        repairs += found
    listed = {find_column(word, units) for some in lists.values() for word in some or ()}
    known_roles = {*in_file, *of_model, *listed}
    guessed = {n: explain_role(n, units[n]) for n in columns if n not in known_roles}
    guesses = [f"{name}: {why}" for name, (role, why) in guessed.items() if role == roles[name]]
    variables = {name: (columns[name], units[name], roles[name]) for name in columns}
    log = make_log(time, variables, name=str(file), repairs=repairs)  # a fault found here names the file
    log.attrs["name"] = file_stem(file)
    for header, attrs in table.attrs.items():
        if (words := attrs.get("flag_meanings")) and (flagged := _name_and_unit(header, table)[0]) in log:
            log[flagged].attrs["flag_meanings"] = words
    log.attrs["sha256"] = sha256
    log.attrs["guesses"] = "\n".join(guesses)
    if own:
        log.attrs.update({k: v for k, v in table.meta.items() if k not in ("schema", "version")})
    return _cut(log, start, stop, file) if (start, stop) != (-np.inf, np.inf) else log


def check_log_file(path: str | Path) -> None:
    """Refuse what is no log by its name, its beginning and what it declares; nothing heavy is loaded."""
    file, _, _ = split_cut(path)
    if _format(file) != "rosbag":
        check_table(file)
    elif not os.path.isdir(file):
        check_size(source_size(file), file=file)


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
    kind = file_format(path)
    if kind == "csv":
        return write_atomic(path, _pack(_to_csv(log), path))
    if kind == "netcdf":
        return write_netcdf(log, path)
    if kind == "rosbag":
        raise UserError("logs are not written as bags", file=path, hint="write .csv, .nc or .parquet")
    return _write_parquet(log, path)


def split_cut(path: str | Path) -> tuple[Path, float, float]:
    """Return the file, the start and the stop [s] of ``PATH@START:STOP``.

    A path that exists is not cut, whatever its name.
    """
    match = _CUT.match(str(path))
    if match is None or os.path.exists(path):
        return Path(path), -np.inf, np.inf
    ends = []
    for text, empty in ((match["start"], -np.inf), (match["stop"], np.inf)):
        try:
            ends.append(float(text) if text.strip() else empty)
        except ValueError:
            hint = "write PATH@START:STOP in seconds"
            raise UserError(f"{text!r} is not a time", file=str(path), hint=hint) from None
    start, stop = ends
    if not start < stop:
        raise UserError(f"the cut {start:g}:{stop:g} is empty", file=str(path), hint="write the start first")
    return Path(match["path"]), start, stop


def _format(path: Path) -> str:
    """Return the format of a log: that of a folder is known by what is in it."""
    if not os.path.isdir(path):
        return file_format(path)
    from thermogrip.datasets.rosbag import bag_parts

    if not bag_parts(path):
        raise UserError("is a folder, and no ROS 2 bag", file=path, hint="name a file in it")
    return "rosbag"


def _read_rosbag(path: str | Path) -> Table:
    from thermogrip.datasets.rosbag import read_rosbag_table

    return read_rosbag_table(path)


def _read_netcdf_table(path: str | Path) -> Table:
    """Return the variables over ``time`` of a NetCDF file as a table."""
    data = open_netcdf(path)
    if "time" not in data.dims or "time" not in data.variables:
        raise UserError(
            "no time axis", file=path, hint="give it a dimension and a variable 'time' in seconds"
        )
    numbers, attrs, left = {}, {}, []
    for key in ["time", *data.data_vars]:
        name, variable = str(key), data[key]
        if variable.dims != ("time",):
            left.append(name)
            continue
        if variable.dtype.kind not in "fiub":
            raise UserError(
                f"holds {variable.dtype}, not numbers", file=path, column=name, hint="leave it out"
            )
        numbers[name] = np.asarray(variable.values, dtype=float)
        unit = variable.attrs.get("units")
        attrs[name] = {"role": str(variable.attrs.get("role", ""))}
        if "flag_meanings" in variable.attrs:
            attrs[name]["flag_meanings"] = str(variable.attrs["flag_meanings"])
        if unit is not None:
            attrs[name]["units"] = convention_unit(str(unit), name, str(path))
    meta = {str(key): str(value) for key, value in data.attrs.items()}
    notes = (f"left out, not over time alone: {', '.join(left)}",) if left else ()
    return Table(str(path), numbers, {}, np.arange(1, data.sizes["time"] + 1), attrs, meta, notes)


_TABLES = {
    "csv": read_csv_table, "netcdf": _read_netcdf_table,
    "parquet": read_parquet_table, "rosbag": _read_rosbag,
}  # fmt: skip


def _convert(table: Table) -> tuple[dict[str, Floats], dict[str, str], list[str]]:
    """Return columns in record units by name (``time`` among them), their units, and what was converted."""
    columns: dict[str, Floats] = {}
    units: dict[str, str] = {}
    repairs = list(table.notes)
    for header, values in table.numbers.items():
        name, unit = _name_and_unit(header, table)
        if name in columns:
            raise UserError(
                f"gives the variable {name} a second time", file=table.file, column=header, hint="rename it"
            )
        columns[name], units[name] = to_record_unit(values, unit)
        if units[name] != unit:
            repairs.append(f"{name}: converted from {unit} to {units[name]}")
        if name != "time" and not np.isfinite(values).any():
            raise UserError(
                "has no number in any row", file=table.file, column=header, hint="leave the column out"
            )
    if units.get("time") != "s":
        raise UserError("no time column", file=table.file, hint=_time_hint(table))
    return columns, units, repairs


def _given_roles(table: Table) -> dict[str, str]:
    """Return the role of each variable whose column has one."""
    roles = {header: attrs["role"] for header, attrs in table.attrs.items() if attrs.get("role")}
    return {_name_and_unit(header, table)[0]: role for header, role in roles.items()}


def _name_and_unit(header: str, table: Table) -> tuple[str, str]:
    """Return name and unit, from the column's attributes where it has them, else from its header."""
    unit = table.attrs.get(header, {}).get("units")
    return (header, unit) if unit is not None else split_header(header, file=table.file)


def _time_hint(table: Table) -> str:
    known = re.compile(r"(time|timestamp|datetime|date|seconds|elapsed)(_|$)|t(_s|_ms|_min)?$")
    like = next((header for header in table.numbers if known.match(header.lower())), None)
    return (
        f"rename {like!r} to time_s, time_ms or time_min" if like else "add time_s, the seconds of each row"
    )


def _repair(
    time: Floats, columns: dict[str, Floats], units: dict[str, str], roles: dict[str, str], table: Table
) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Return the repaired time and columns, and a line a finding."""
    keep, repairs = drop_repeated(time, table.lines, table.file)
    time = time[keep]
    columns = {name: values[keep] for name, values in columns.items()}
    if time.size < 2:
        raise UserError(f"{time.size} row(s) are not a log", file=table.file, hint="give at least two rows")
    time, found = from_first_row(time)
    repairs += found + describe_steps(time)
    for name, values in columns.items():
        columns[name], found = _repair_column(name, values, time, units[name], roles[name], table.file)
        repairs += found
    time, columns, found = _drop_unknown_start(time, columns, roles, table.file)
    repairs += found + describe_gaps(time, {n: v for n, v in columns.items() if roles[n] == "input"})
    return time, columns, repairs


def _repair_column(
    name: str, values: Floats, time: Floats, unit: str, role: str, file: str
) -> tuple[Floats, list[str]]:
    values = np.where(np.isinf(values), np.nan, values)
    if role == "input":
        return fill_input(name, values)
    if role == "disturbance":
        filled, repairs = fill_disturbance(name, values, time)
        return filled, repairs + (check_plausible(name, filled, file) if unit == "degC" else [])
    if role != "output":
        return values, []
    lost = int(np.isnan(values).sum())
    repairs = [f"{name}: {lost} lost sample{'' if lost == 1 else 's'} left empty"] if lost else []
    values, found = reject_spikes(name, values, time, floor=SPIKE_FLOOR_K if unit == "degC" else None)
    return values, repairs + found + (check_plausible(name, values, file) if unit == "degC" else [])


def _drop_unknown_start(
    time: Floats, columns: dict[str, Floats], roles: dict[str, str], file: str
) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Drop the rows before every input has its first value: there is nothing to hold."""
    first = max((int(np.isfinite(v).argmax()) for n, v in columns.items() if roles[n] == "input"), default=0)
    if first == 0:
        return time, columns, []
    if time.size - first < 2:
        raise UserError(
            "an input is unknown until the last row", file=file, hint="give its value from the start"
        )
    columns = {name: values[first:] for name, values in columns.items()}
    return time[first:], columns, [f"{first} row(s) before the first value of an input dropped"]


def _cut(log: Log, start: float, stop: float, file: Path) -> Log:
    from thermogrip.datasets.resample import cut

    part = cut(log, start, stop)
    part.attrs["name"] = f"{log.attrs['name']}@{_end(start)}:{_end(stop) or 'end'}"
    repairs = [line for line in str(log.attrs["repairs"]).splitlines() if line]
    first = f"{_end(start)} s" if np.isfinite(start) else "the start"
    last = f"{_end(stop)} s" if np.isfinite(stop) else "the end"
    repairs.append(f"taken from {first} to {last}; the lines above speak of the whole log")
    part.attrs["repairs"] = "\n".join(repairs if len(repairs) > 1 else [repairs[0].split(";")[0]])
    return part


def _end(value: float) -> str:
    return f"{value:.10g}" if np.isfinite(value) else ""


def _to_csv(log: Log) -> str:
    header = ["time_s"] + [join_header(str(n), log[n].attrs["units"]) for n in log.data_vars]
    columns = [log["time"].values] + [log[n].values for n in log.data_vars]
    # repr is the shortest text that reads back as the same double
    cells = [["" if v != v else repr(v) for v in column.tolist()] for column in columns]
    return csv_text([header]) + "".join(",".join(row) + "\n" for row in zip(*cells, strict=True))


def _pack(text: str, path: str | Path) -> bytes:
    import gzip
    import lzma

    data = text.encode()
    ending = Path(path).suffix.lower()
    if ending == ".gz":
        return gzip.compress(data, mtime=0)  # without a date the same log is the same file
    return lzma.compress(data) if ending == ".xz" else data


def _write_parquet(log: Log, path: str | Path) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    fields = [pa.field("time", pa.float64(), metadata={"units": "s"})]
    for name in names(log, "input") + names(log, "disturbance") + names(log, "output") + names(log, "other"):
        kept = {key: log[name].attrs[key] for key in ("units", "role")}
        fields.append(pa.field(name, pa.float64(), metadata=kept))
    order = [f.name for f in fields[:1]] + [str(n) for n in log.data_vars]
    by_name = {f.name: f for f in fields}
    meta = {str(key): str(value) for key, value in log.attrs.items()}
    schema = pa.schema([by_name[n] for n in order], metadata=meta)
    table = pa.Table.from_arrays([pa.array(log[n].values, from_pandas=False) for n in order], schema=schema)
    with atomic_path(path) as temporary:
        parquet.write_table(table, temporary, write_page_checksum=True)
    return Path(path)
