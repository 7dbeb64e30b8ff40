"""Grasps to and from disk.

As CSV a condition is two files, ``NAME.csv``, long, one row a sample, and ``NAME_meta.csv``, one row a grasp:
``docs/reference/files.md`` has their columns.  A missing ``session`` is the file, a missing ``block`` the
material: so blocks are never split between training and test by accident of a missing column.

The grasps of one file share one time axis.  Where their stamps agree they are taken as they are; where they
jitter each grasp is interpolated linearly onto the common step, which is noted in ``attrs["repairs"]``, and
left NaN where the nearest samples are more than 1.5 steps apart.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import write_atomic
from thermogrip.datasets.errors import UserError, os_faults
from thermogrip.datasets.file_names import file_format, file_stem, matching_files
from thermogrip.datasets.media import csv_cell, csv_text
from thermogrip.datasets.netcdf import open_netcdf, record_unit, write_netcdf
from thermogrip.datasets.schema import (
    GRASP_LABELS,
    GRASP_NUMBERS,
    as_record,
    check_grasps,
    log_name,
    make_grasps,
    with_lead_in,
)
from thermogrip.datasets.tables import (
    Table,
    read_csv_table,
    read_parquet_frame,
)
from thermogrip.datasets.units import rename_hint, split_header, to_record_unit

if TYPE_CHECKING:
    import xarray as xr
    from pandas import DataFrame

    from thermogrip.datasets.schema import Grasps

Floats = NDArray[np.float64]
#: What is taken for grasps: themselves, long DataFrames, paths of files; one or several.
Records: TypeAlias = "Grasps | DataFrame | str | Path | Sequence[Grasps | DataFrame | str | Path]"
_OF_SAMPLES = ("grasp_id", "time", "t_surface", "pump")  # how the columns begin that change in a grasp

# name in the meta file (without unit) -> name in the record
_FROM_META = {"t_object_nominal": "t_object", "t_gripper_set": "t_gripper"}
#: Names in the meta file of what a record calls otherwise.
META_NAMES = {ours: theirs for theirs, ours in _FROM_META.items()}
_ENDINGS = (".csv", ".csv.gz", ".csv.xz")
_NEEDED = ("time", "t_surface")  # how the columns begin that are read as numbers


def read_grasps(path: str | Path, *, name: str | None = None) -> Grasps:
    """Return the grasps in a file.

    Parameters
    ----------
    path : str or Path
        A CSV file with its meta file beside it, NetCDF, or Parquet with a row a sample, in which each row
        repeats what is known of its grasp.
    name : str, optional
        What the record is called, by default as its file.

    Returns
    -------
    grasps : Grasps
        Dims (grasp, time), in the order of the file; unknown temperatures are NaN, unknown labels "".

    Raises
    ------
    UserError
        If a file is missing or malformed, the two files do not name the same grasps, or a grasp has no sample
        before or after the "closed" message at t = 0.

    Examples
    --------
    >>> from thermogrip.datasets.examples import example_path
    >>> grasps = read_grasps(example_path("exp1A_obj43_grip23"))
    >>> dict(grasps.sizes), str(grasps["material"].values[0]), float(grasps["t_object"][0])
    ({'grasp': 40, 'time': 121}, 'copper', 43.0)
    """
    if file_format(path) not in ("csv", "netcdf", "parquet"):
        raise UserError("grasps are CSV, NetCDF or Parquet", file=path, hint="use one of them")
    if file_format(path) == "parquet":
        frame = read_parquet_frame(path)
        if "grasp_id" not in frame:
            problem = "no column grasp_id"
            raise UserError(problem, file=path, hint="a grasp file has grasp_id,time_s,t_surface_degC")
        return from_frame(frame, name or file_stem(path), file=path)
    if file_format(path) == "netcdf":
        return _whole(_of_dataset(open_netcdf(path), path, name), path)
    samples, meta = _sample_table(path), _meta_path(path)
    return _of_tables(samples, _meta_table(meta), name or file_stem(path))


def _whole(grasps: Grasps, path: str | Path) -> Grasps:
    """Return grasps with their level before contact; UserError where one has no sample on either side."""
    grasps = with_lead_in(grasps)
    time, seen = grasps["time"].values, np.isfinite(grasps["t_surface"].values)
    for side, has, hint in (
        ("before", seen[:, time < 0].any(axis=1), "record from 2 s before, or give t_gripper_set_degC"),
        ("after", seen[:, time > 0].any(axis=1), "is this a grasp? remove it or record the contact"),
    ):
        if not has.all():
            grasp = str(grasps["grasp"].values[int(np.argmin(has))])
            problem = f"grasp {grasp!r} has no sample {side} the closed message at 0 s"
            raise UserError(problem, file=path, hint=hint)
    return grasps


def as_grasps(grasps: Records) -> list[Grasps]:
    """Return records as they are, those of files and DataFrames as they are read."""
    given = list(grasps) if isinstance(grasps, Sequence) and not isinstance(grasps, str) else [grasps]
    files: list[Any] = [read_grasps(each) if isinstance(each, str | Path) else each for each in given]
    import pandas as pd

    return [from_frame(each) if isinstance(each, pd.DataFrame) else each for each in files]


def from_frame(frame: DataFrame, name: str = "DataFrame", *, file: str | Path | None = None) -> Grasps:
    """Return the grasps of a table with a row a sample, in which each row repeats what is known of its grasp;
    columns as in the two files of :func:`read_grasps`.  What is refused is named by ``file`` and its row,
    the first one 1."""
    where = str(file or name)
    frame = frame.rename(columns=str).reset_index(drop=True)
    samples = [column for column in frame.columns if column.startswith(_OF_SAMPLES)]
    rest = frame.drop(columns=[column for column in samples if column != "grasp_id"])
    if "grasp_id" in rest:
        _check_cells(frame, where)
        rest = rest.drop_duplicates("grasp_id")
    long = _sample_table(where, frame[samples].to_csv(index=False).encode())
    meta = _meta_table(where, rest.to_csv(index=False).encode())
    return _of_tables(replace(long, lines=long.lines - 1), meta, name)


def _check_cells(frame: DataFrame, file: str) -> None:
    """Refuse a text where a number should be, and rows that say different things of one grasp."""
    import pandas as pd

    known = [name for name in frame.columns if _meta_name(name, file)[0] in (*GRASP_NUMBERS, *GRASP_LABELS)]
    for name in frame.columns:
        if not name.startswith(_NEEDED) and _meta_name(name, file)[0] not in GRASP_NUMBERS:
            continue
        cells = frame[name].astype(object)
        text = cells.map(lambda cell: isinstance(cell, str) and cell.strip().lower() not in ("", "nan"))
        wrong = text & pd.to_numeric(cells, errors="coerce").isna()
        if wrong.any():
            at = int(wrong.argmax())
            hint = "write a number, or leave the cell empty"
            raise UserError(f"{cells[at][:40]!r} is no number", file=file, row=at + 1, column=name, hint=hint)
    differ = frame[["grasp_id", *known]].drop_duplicates().duplicated("grasp_id")
    if not differ.any():
        return
    at = int(differ.index[differ][0])
    grasp = frame["grasp_id"][at]
    first = int((frame["grasp_id"] == grasp).argmax())
    name = next(each for each in known if frame[each].iloc[[first, at]].nunique(dropna=False) > 1)
    problem = f"{frame[name][at]!s} of grasp {grasp!r} was {frame[name][first]!s} in row {first + 1}"
    hint = "repeat in each row what is known of its grasp"
    raise UserError(problem, file=file, row=at + 1, column=name, hint=hint)


def write_grasps(grasps: Grasps, path: str | Path) -> Path:
    """Write grasps to a file and return its path.

    Parameters
    ----------
    grasps : Grasps
    path : str or Path
        ``.nc``, or ``.csv``, which gets ``NAME_meta.csv`` beside it.

    Raises
    ------
    UserError
        If the ending is unknown or the disk refuses.

    Examples
    --------
    >>> import tempfile
    >>> made = make_grasps([-0.1, 0.1], [[23.0, 24.5]], ["g0"], material=["iron"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     again = read_grasps(write_grasps(made, Path(folder) / "warm.csv"))
    >>> again.attrs["name"], again["t_surface"].values.tolist()
    ('warm', [[23.0, 24.5]])
    """
    check_grasps(grasps)
    if file_format(path) == "netcdf":
        return write_netcdf(grasps, path)
    if file_format(path) != "csv" or Path(path).suffix.lower() != ".csv":
        raise UserError("grasps are written as .csv or .nc", file=path, hint="use one of the two")
    stem = file_stem(path)
    write_atomic(Path(path).with_name(f"{stem}_meta.csv"), _meta_text(grasps))
    return write_atomic(path, _samples_text(grasps))


def read_grasp_files(paths: Sequence[str | Path]) -> list[Grasps]:
    """Return the records of several files as of :func:`read_grasps`; a folder is all its grasp files, in
    order of name, and no file may be given twice."""
    records: dict[str, Grasps] = {}
    files = list_grasp_files(paths)
    for file, name in zip(files, distinct_names(files)):
        grasps = read_grasps(file, name=name)
        if log_name(grasps) in records:  # two NetCDF files may call themselves alike
            grasps.attrs["name"] = str(file)
        records[log_name(grasps)] = grasps
    return list(records.values())


def list_grasp_files(paths: Sequence[str | Path]) -> list[Path]:
    """Return the grasp files in paths and folders, as of :func:`read_grasp_files`, unread."""
    files: list[Path] = []
    for path in (Path(name) for given in paths for name in matching_files(given)):
        files += _in_folder(path) if path.is_dir() else [path]
    return files


def distinct_names(files: Sequence[Path]) -> list[str | None]:
    """Return for each file None, or where another one has its stem a name with as many of the folders above
    it as tell them apart; UserError where a file is given twice."""
    places = [os.path.abspath(file) for file in files]
    seen: set[str] = set()
    for file, place in zip(files, places):
        if place in seen:
            raise UserError("is given twice", file=file, hint="give each file once")
        seen.add(place)
    names = [file_stem(file) for file in files]
    alike = {name for name, n in Counter(names).items() if n > 1}
    found: list[str | None] = [None] * len(files)
    depth = 1
    while alike:
        found = [
            "/".join(Path(place).parts[-depth:]) if name in alike else longer
            for name, place, longer in zip(names, places, found)
        ]
        names = [longer or name for name, longer in zip(names, found)]
        alike = {name for name, n in Counter(names).items() if n > 1}
        depth += 1
    return found


def grasp_file_parts(path: Path) -> list[Path]:
    """Return the files that hold the grasps of one: itself, and of a CSV its meta file."""
    return [path, _meta_path(path)] if file_format(path) == "csv" else [path]


def check_apart(out: str | Path, paths: Sequence[str | Path]) -> None:
    """Refuse an output that is among the files that are read, or would be the next time."""
    place, hint = Path(os.path.realpath(out)), "choose another name or folder for --out"
    for given in paths:
        if place.match(os.path.realpath(given)) and not os.path.isdir(given):
            raise UserError("is to be read and written", file=out, hint=hint)
        for path in map(Path, matching_files(given)):
            if path.is_dir():
                folder = path.resolve()
                if place.parent == folder:
                    raise UserError("is in a folder that is read", file=out, hint=hint)
            elif place in [part.resolve() for part in grasp_file_parts(path)]:
                raise UserError("is to be read and written", file=out, hint=hint)


def _in_folder(folder: Path) -> list[Path]:
    with os_faults(folder):
        endings = (*_ENDINGS, ".nc", ".parquet", ".pq")
        files = sorted(p for p in folder.iterdir() if p.name.lower().endswith(endings))
    files = [p for p in files if not file_stem(p).endswith("_meta") and not p.name.startswith(".")]
    if not files:
        hint = "give a folder with .csv, .nc or .parquet in it"
        if any(path.is_dir() for path in folder.iterdir()):
            hint += f", or a pattern in quotes: '{folder}/*/*.parquet'"
        raise UserError("holds no grasp files", file=folder, hint=hint)
    return files


def _sample_table(path: str | Path, data: bytes | None = None) -> Table:
    return read_csv_table(path, text=lambda header: not header.startswith(_NEEDED), data=data)


def _samples_of(table: Table) -> tuple[list[str], Floats, dict[str, Floats], list[str]]:
    """Return grasp_id of each row, its time [s], the temperature channels [degC], and what was repaired."""
    path = table.file
    if "grasp_id" not in table.text:
        problem = "no column grasp_id"
        raise UserError(problem, file=path, hint="a grasp file has grasp_id,time_s,t_surface_degC")
    channels, repairs = {}, list(table.notes)
    unused = [header for header in table.text if header not in ("grasp_id", "pump")]
    repairs += [f"not used: {', '.join(unused)}"] if unused else []
    for header, values in table.numbers.items():
        name, unit = split_header(header, file=str(path))
        channels[name], after = to_record_unit(values, unit)
        if name.startswith("t_surface") and after != "degC":
            raise UserError("is not a temperature", file=path, column=header, hint=f"write {name}_degC")
        if name == "time" and after != "s":
            raise UserError("is not a time", file=path, column=header, hint="write time_s or time_ms")
        if after != unit:
            repairs.append(f"{name}: converted from {unit} to {after}")
    for need, wanted in (("time", "time_s"), ("t_surface", "t_surface_degC")):
        if need not in channels:
            problem = f"no column {wanted}"
            raise UserError(problem, file=path, hint=rename_hint(need, [*table.text, *table.numbers]))
    time = channels["time"]
    if not np.isfinite(time).all():
        row = int(table.lines[np.argmin(np.isfinite(time))])
        raise UserError("has no time", file=path, row=row, hint="remove the row")
    if "" in table.text["grasp_id"]:
        row = int(table.lines[table.text["grasp_id"].index("")])
        raise UserError("is empty", file=path, row=row, column="grasp_id", hint="name the grasp")
    kept = {name: values for name, values in channels.items() if name in ("t_surface", "t_surface_2")}
    return table.text["grasp_id"], time, kept, repairs


def _in_order(ids: list[str]) -> tuple[list[str], NDArray[np.int64]]:
    """Return the names in order of first appearance and each row's index into them."""
    order = {name: at for at, name in enumerate(dict.fromkeys(ids))}
    return list(order), np.fromiter((order[name] for name in ids), dtype=np.int64, count=len(ids))


def _onto_one_axis(
    order: list[str], index: NDArray[np.int64], time: Floats, channels: dict[str, Floats], file: str
) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Return the common time axis (n_time,), the channels (n_grasp, n_time), and what was repaired."""
    by_grasp = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[by_grasp], np.arange(len(order) + 1))
    parts = [by_grasp[a:b] for a, b in pairwise(bounds)]
    repairs, steps = [], []
    for at, rows in enumerate(parts):
        parts[at], repeated = _increasing(time[rows], rows, order[at], file)
        steps.append(_step_of(time[parts[at]]))
        repairs += [f"grasp {order[at]}: {repeated} repeated time stamp(s) dropped"] if repeated else []
    step = _common_step(np.asarray(steps), order, file)
    axis = np.unique(np.round(time, 6))
    if _is_even(axis, step):
        return axis, {name: _placed(axis, time, values, parts) for name, values in channels.items()}, repairs
    axis = np.round(
        step * np.arange(np.ceil(time.min() / step - 1e-6), np.floor(time.max() / step + 1e-6) + 1), 9
    )
    repairs.append(f"time stamps jitter: interpolated onto a step of {step:g} s")
    return (
        axis,
        {name: _interpolated(axis, time, values, parts, step) for name, values in channels.items()},
        repairs,
    )


def _is_even(axis: Floats, step: float) -> bool:
    """Tell whether all stamps lie on one grid (with holes) to 2 % of its step."""
    moved = np.diff(axis) / step
    if moved.min(initial=np.inf) < 0.5:
        return False
    count = np.concatenate([[0.0], np.cumsum(np.round(moved))])
    exact = (axis[-1] - axis[0]) / count[-1]  # a median of rounded stamps drifts over a long recording
    return bool(np.abs(axis - axis[0] - exact * count).max() <= 0.02 * step)


def _increasing(
    time: Floats, rows: NDArray[np.int64], grasp: str, file: str
) -> tuple[NDArray[np.int64], int]:
    step = np.diff(time)
    if np.any(step < 0):
        at = int(np.argmax(step < 0))
        problem = f"grasp {grasp!r}: time runs back from {time[at]:g} s to {time[at + 1]:g} s"
        raise UserError(problem, file=file, hint="sort its rows, or give each grasp its own grasp_id")
    keep = np.concatenate([[True], step > 0])
    return rows[keep], int((~keep).sum())


def _common_step(steps: Floats, order: list[str], file: str) -> float:
    if not np.isfinite(steps).any():
        raise UserError("no grasp has two samples", file=file, hint="give the whole recording of each grasp")
    step = float(np.nanmedian(steps))
    odd = np.isfinite(steps) & (np.abs(steps / step - 1) > 0.2)
    if odd.any():
        at = int(odd.argmax())
        problem = f"grasp {order[at]!r} has a step of {steps[at]:g} s, the others {step:g} s"
        raise UserError(problem, file=file, hint="give grasps of another rate a file of their own")
    plain = float(f"{step:.2g}")
    return plain if abs(plain / step - 1) < 0.01 else float(f"{step:.4g}")


def _step_of(time: Floats) -> float:
    """Return the mean step, a hole counted as the steps that it is long; NaN for a single sample."""
    if time.size < 2:
        return np.nan
    step = np.diff(time)
    return float((time[-1] - time[0]) / np.maximum(np.round(step / np.median(step)), 1).sum())


def _placed(axis: Floats, time: Floats, values: Floats, parts: list[NDArray[np.int64]]) -> Floats:
    grid = np.full((len(parts), axis.size), np.nan)
    for at, rows in enumerate(parts):
        grid[at, np.searchsorted(axis, np.round(time[rows], 6))] = values[rows]
    return grid


def _interpolated(
    axis: Floats, time: Floats, values: Floats, parts: list[NDArray[np.int64]], step: float
) -> Floats:
    grid = np.full((len(parts), axis.size), np.nan)
    for at, rows in enumerate(parts):
        good = rows[np.isfinite(values[rows])]
        if not good.size:
            continue
        t = time[good]
        after = np.clip(np.searchsorted(t, axis), 0, t.size - 1)
        before = np.clip(np.searchsorted(t, axis, side="right") - 1, 0, t.size - 1)
        inside = (
            (axis >= t[0] - 0.5 * step) & (axis <= t[-1] + 0.5 * step) & (t[after] - t[before] <= 1.5 * step)
        )
        grid[at, inside] = np.interp(axis[inside], t, values[good])
    return grid


def _meta_path(path: str | Path) -> Path:
    stem = file_stem(path)
    choices = [Path(path).with_name(f"{stem}_meta{ending}") for ending in _ENDINGS]
    found = next((p for p in choices if p.exists()), None)
    if found is None:
        hint = f"put {choices[0].name} beside it: grasp_id,material,t_object_nominal_degC,..."
        raise UserError("its meta file is missing", file=path, hint=hint)
    return found


def _meta_table(path: str | Path, data: bytes | None = None) -> Table:
    def is_text(header: str) -> bool:
        return _meta_name(header, str(path))[0] not in GRASP_NUMBERS

    return read_csv_table(path, text=is_text, data=data)


def _meta_name(header: str, file: str | None = None) -> tuple[str, str]:
    """Return what a record calls a column of the meta file, and its unit; no name where it means nothing."""
    if not re.fullmatch(r"\S+", header) or not header.lower().startswith(
        ("grasp_id", *GRASP_LABELS, *GRASP_NUMBERS)
    ):
        return "", ""
    name, unit = split_header(header, file=file)
    return name.lower() if name.lower() in GRASP_LABELS else _FROM_META.get(name, name), unit  # "Material"


def _meta_of(table: Table, order: list[str], file: str) -> tuple[dict[str, Any], list[str]]:
    """Return the per-grasp columns in the order of the sample file, and a line on those that are left out."""
    path = Path(table.file)
    if "grasp_id" not in table.text:
        raise UserError("no column grasp_id", file=path, hint="give each grasp's name as in the sample file")
    rows = _matched(table, order, path, file)
    found: dict[str, Any] = {}
    strange = []
    for header in (*table.text, *table.numbers):
        name, unit = _meta_name(header, str(path))
        if name in found:
            raise UserError(f"gives {name} a second time", file=path, column=header, hint="keep one")
        if name in GRASP_NUMBERS:
            numbers, got = to_record_unit(table.numbers[header], unit)
            if got != GRASP_NUMBERS[name]:
                hint = f"it is in {GRASP_NUMBERS[name]}: write {name}_{GRASP_NUMBERS[name]}"
                raise UserError(f"unit {got!r} does not fit", file=path, column=header, hint=hint)
            found[name] = numbers[rows]
        elif name in GRASP_LABELS:
            found[name] = [table.text[header][at] for at in rows]
        elif name != "grasp_id":
            strange.append(header)
    known = [*(f"{META_NAMES.get(name, name)}_{unit}" for name, unit in GRASP_NUMBERS.items()), *GRASP_LABELS]
    line = f"{path.name}: not used: {', '.join(strange)}; known are {', '.join(known)}"
    return found, [line] if strange else []


def _matched(table: Table, order: list[str], path: Path, file: str) -> list[int]:
    """Return for each grasp its row in the meta file; both files must name the same grasps, each once."""
    rows: dict[str, int] = {}
    for at, grasp in enumerate(table.text["grasp_id"]):
        if grasp in rows:
            line = int(table.lines[at])
            raise UserError(f"grasp_id {grasp!r} occurs twice", file=path, row=line, hint="give each its own")
        rows[grasp] = at
    missing = next((g for g in order if g not in rows), None)
    if missing is not None:
        raise UserError(f"no row for grasp {missing!r} of {Path(file).name}", file=path, hint="add it")
    extra = next((g for g in rows if g not in set(order)), None)
    if extra is not None:
        line = int(table.lines[rows[extra]])
        problem = f"grasp {extra!r} has no samples in {Path(file).name}"
        raise UserError(problem, file=path, row=line, hint="remove the row or add the samples")
    return [rows[g] for g in order]


def _with_defaults(per_grasp: dict[str, Any], n: int, stem: str) -> dict[str, Any]:
    """Fill in the material, session and block where they are missing."""
    filled = dict(per_grasp)
    filled.setdefault("material", [""] * n)
    filled["session"] = [s or stem for s in filled.get("session", [""] * n)]
    filled["block"] = [b or m for b, m in zip(filled.get("block", [""] * n), filled["material"])]
    return filled


def _of_tables(samples: Table, meta: Table, name: str) -> Grasps:
    """Return the grasps of a table with a row a sample and one with a row a grasp."""
    ids, time, channels, repairs = _samples_of(samples)
    order, index = _in_order(ids)
    axis, gridded, more = _onto_one_axis(order, index, time, channels, samples.file)
    about, left_out = _meta_of(meta, order, samples.file)
    per_grasp = _with_defaults(about, len(order), name)
    per_grasp |= {"name": name, "t_surface_2": gridded.get("t_surface_2")}
    try:
        grasps = make_grasps(axis, gridded["t_surface"], order, **per_grasp)
    except UserError as error:  # which knows the record's name alone
        raise UserError(error.problem, file=samples.file, column=error.column, hint=error.hint) from error
    grasps.attrs["repairs"] = "\n".join(repairs + more + left_out)
    return _whole(grasps, samples.file)


def _of_dataset(data: xr.Dataset, path: str | Path, called: str | None = None) -> Grasps:
    """Return the grasps of what a NetCDF file holds."""
    schema = data.attrs.get("schema", "thermogrip.grasps")
    if schema != "thermogrip.grasps":
        raise UserError(f"holds a {schema}, not grasps", file=path, hint="give a file of grasps")
    stem = called or file_stem(path)
    data.attrs["name"] = called or data.attrs.get("name", stem)
    known = {"t_surface", "t_surface_2", *GRASP_NUMBERS, *GRASP_LABELS}
    data = data[[name for name in data.data_vars if name in known]]
    if "grasp" in data.coords:
        data = data.assign_coords(grasp=("grasp", data["grasp"].values.astype(str)))
    expected = {"time": "s", "t_surface": "degC", "t_surface_2": "degC", **GRASP_NUMBERS}
    for name in [n for n in expected if n in data.variables]:
        values, unit = record_unit(data[name], name, str(path))
        if unit != expected[name]:
            hint = f"it must be in {expected[name]}"
            raise UserError(f"unit {unit!r} does not fit", file=path, column=name, hint=hint)
        data[name] = (data[name].dims, values, {"units": unit})
    try:
        check_grasps(data)
    except UserError as error:
        raise UserError(error.problem, file=path, column=error.column, hint=error.hint) from error
    labels = {name: data[name].values.tolist() for name in ("material", "session", "block") if name in data}
    for name, values in _with_defaults(labels, data.sizes["grasp"], stem).items():
        data[name] = ("grasp", np.asarray(values, dtype=str))
    return as_record(data)


def _meta_text(grasps: Grasps) -> str:
    headers: list[str] = ["grasp_id"]
    columns: list[list[str]] = [[str(g) for g in grasps["grasp"].values]]
    for name, variable in grasps.data_vars.items():
        key = str(name)
        if key in GRASP_LABELS:
            headers.append(key)
            columns.append([str(v) for v in variable.values])
        elif key in GRASP_NUMBERS:
            unit = "" if GRASP_NUMBERS[key] == "1" else f"_{GRASP_NUMBERS[key]}"
            headers.append(META_NAMES.get(key, key) + unit)
            columns.append(["" if np.isnan(v) else repr(float(v)) for v in variable.values])
    return csv_text([headers, *zip(*columns, strict=True)])


def _samples_text(grasps: Grasps) -> str:
    """Return the long table; a sample that is NaN in every channel has no row."""
    channels = [name for name in ("t_surface", "t_surface_2") if name in grasps]
    table = grasps[channels].to_dataframe(["grasp", "time"])[channels].dropna(how="all").reset_index()
    table["grasp"] = table["grasp"].map(csv_cell)
    header = ["grasp_id", "time_s", *(f"{name}_degC" for name in channels)]
    return table.to_csv(index=False, header=header, lineterminator="\n")
