"""Grasps to and from disk; ``docs/reference/files.md`` has their columns.

As CSV a condition is two files, ``NAME.csv``, long, one row a sample, and ``NAME_meta.csv``, one row a grasp;
in a Parquet file each row repeats what is known of its grasp.  A missing ``session`` is the
file, a missing ``block`` the material: so no block is split between training and test by accident.

The grasps of one file share one time axis.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.files import file_format, file_stem, write_atomic
from thermogrip.datasets.netcdf import numbers_and_unit, open_netcdf, write_netcdf
from thermogrip.datasets.schema import GRASP_LABELS, GRASP_NUMBERS, check_grasps, make_grasps, with_lead_in
from thermogrip.datasets.tables import Table, read_csv_table, read_parquet_table
from thermogrip.datasets.units import join_header, split_header, to_record_unit
from thermogrip.media.rendering import csv_cell

if TYPE_CHECKING:
    import xarray as xr
    from pandas import DataFrame, Index, Series

    from thermogrip.datasets.schema import Grasps

#: What is taken for grasps: themselves, paths of files; one or several.
Records: TypeAlias = "Grasps | str | Path | Sequence[Grasps | str | Path]"

# name in the meta file (without unit) -> name in the record
_FROM_META = {"t_object_nominal": "t_object", "t_gripper_set": "t_gripper"}
#: Names in the meta file of what a record calls otherwise.
META_NAMES = {ours: theirs for theirs, ours in _FROM_META.items()}
_META_HEADERS = {name: join_header(META_NAMES.get(name, name), unit) for name, unit in GRASP_NUMBERS.items()}
_ENDINGS = (".csv", ".csv.gz", ".csv.xz")
_SAMPLES = {"time": "s", "t_surface": "degC", "t_surface_2": "degC"}  # what a sample has, and its unit
_NUMBERS = _SAMPLES | GRASP_NUMBERS
_SAMPLE_PREFIXES = ("grasp_id", "time", "t_surface")


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
    kind = file_format(path)
    if kind == "netcdf":
        return _of_dataset(open_netcdf(path), path, name)
    if kind == "parquet":
        samples = read_parquet_table(path, text=_is_text, tolerated=0.0)
        return _of_tables(samples, None, name or file_stem(path))
    if kind != "csv":
        raise UserError("grasps are CSV, NetCDF or Parquet", file=path, hint="use one of them")
    samples = read_csv_table(path, text=_is_text)
    return _of_tables(samples, read_csv_table(meta_path(path), text=_is_text), name or file_stem(path))


def as_grasps(grasps: Records) -> list[Grasps]:
    """Return records as they are, and those of files as they are read."""
    records = list(grasps) if isinstance(grasps, Sequence) and not isinstance(grasps, str) else [grasps]
    return [read_grasps(record) if isinstance(record, str | Path) else record for record in records]


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
    facts = grasps.drop_dims("time").to_dataframe().reset_index().map(csv_cell)
    header = ["grasp_id", *(_META_HEADERS.get(name, name) for name in facts.columns[1:])]
    meta_path = Path(path).with_name(f"{file_stem(path)}_meta.csv")
    write_atomic(meta_path, facts.to_csv(index=False, header=header, lineterminator="\n"))
    channels = [name for name in ("t_surface", "t_surface_2") if name in grasps]
    samples = grasps[channels].to_dataframe(["grasp", "time"])[channels].dropna(how="all").reset_index()
    samples["grasp"] = samples["grasp"].map(csv_cell)
    header = ["grasp_id", "time_s", *(f"{name}_degC" for name in channels)]
    return write_atomic(path, samples.to_csv(index=False, header=header, lineterminator="\n"))


def _is_text(header: str) -> bool:
    """Tell whether a column of grasps is left as text: its name is that of no number."""
    return not header.startswith(("time", "t_surface")) and _name_and_unit(header)[0] not in GRASP_NUMBERS


def _name_and_unit(header: str, file: str | None = None) -> tuple[str, str]:
    """Return what a record calls a column, and its unit; no name where it means nothing."""
    prefixes = (*_SAMPLE_PREFIXES, *GRASP_LABELS, *GRASP_NUMBERS)
    if not re.fullmatch(r"\S+", header) or not header.lower().startswith(prefixes):
        return "", ""
    name, unit = split_header(header, file=file)
    return name.lower() if name.lower() in GRASP_LABELS else _FROM_META.get(name, name), unit  # "Material"


def _in_record_unit(name: str, values: Array, unit: str, file: str | Path, column: str) -> Array:
    """Return the numbers of a variable in the unit that a record has it in; UserError where theirs is of
    another kind."""
    numbers, unit_after = to_record_unit(values, unit)
    if unit_after != (wanted := _NUMBERS[name]):
        problem = "has no unit" if unit in ("", "1") else f"unit {unit!r} does not fit"
        hint = f"give it in {wanted}, in a table as {name}_{wanted}"
        raise UserError(problem, file=file, column=column, hint=hint)
    return numbers


def _columns(table: Table, wanted: Collection[str]) -> tuple[dict[str, Any], list[str]]:
    """Return ``grasp_id`` and columns of these names in a record, in its units, and what was converted or is
    not used."""
    if "grasp_id" not in table.text:
        hint = "a grasp file has grasp_id,time_s,t_surface_degC, its meta file grasp_id,material,..."
        raise UserError("no column grasp_id", file=table.file, hint=hint)
    columns: dict[str, Any] = {"grasp_id": np.asarray(table.text["grasp_id"])}
    notes, unused = [], []
    for header in [header for header in (*table.text, *table.numbers) if header != "grasp_id"]:
        name, unit = _name_and_unit(header, table.file)
        if name in columns:
            raise UserError(f"gives {name} a second time", file=table.file, column=header, hint="keep one")
        if name in GRASP_LABELS and name in wanted:
            columns[name] = np.asarray(table.text[header])
        elif name in wanted:
            columns[name] = _in_record_unit(name, table.numbers[header], unit, table.file, header)
            if (wanted_unit := _NUMBERS[name]) != unit:
                notes.append(f"{name}: converted from {unit} to {wanted_unit}")
        elif not header.startswith("pump"):  # which is off in every grasp of the rig
            unused.append(header)
    if unused:
        known = ", ".join([*_META_HEADERS.values(), *GRASP_LABELS])
        notes.append(f"{Path(table.file).name}: not used: {', '.join(unused)}; known are {known}")
    return columns, notes


def _check_samples(columns: Mapping[str, Any], table: Table) -> None:
    """Raise :class:`UserError` where the samples of a table lack a time, a temperature or their grasp."""
    for need, header in (("time", "time_s"), ("t_surface", "t_surface_degC")):
        if need not in columns:
            hint = f"rename one: it has {', '.join([*table.text, *table.numbers])}"
            raise UserError(f"no column {header}", file=table.file, hint=hint)
    for lost, problem, where, hint in (
        (~np.isfinite(columns["time"]), "has no time", None, "remove the row"),
        (columns["grasp_id"] == "", "is empty", "grasp_id", "name the grasp"),
    ):
        for line in table.lines[lost][:1]:
            raise UserError(problem, file=table.file, row=int(line), column=where, hint=hint)


def _onto_one_axis(samples: DataFrame, file: str, repairs: list[str]) -> tuple[Array, dict[str, Array]]:
    """Return the common time axis (n_time,) and the channels (n_grasp, n_time), grasps in order of their
    first rows; what is repaired is added to the repairs."""
    steps = samples.groupby("grasp_id", sort=False)["time"].diff()
    if (back := np.flatnonzero(steps < 0)).size:
        grasp, end = samples[["grasp_id", "time"]].iloc[back[0]]
        problem = f"grasp {grasp!r}: time runs back from {end - steps.iloc[back[0]]:g} s to {end:g} s"
        raise UserError(problem, file=file, hint="sort its rows, or give each grasp its own grasp_id")
    repeated = samples["grasp_id"][steps == 0].value_counts(sort=False)
    repairs += [f"grasp {grasp}: {n} repeated time stamp(s) dropped" for grasp, n in repeated.items()]
    samples = samples[steps != 0]
    by_grasp = samples.groupby("grasp_id", sort=False)
    step = _common_step(by_grasp["time"].agg(lambda stamps: _grid_of(stamps.to_numpy())[0]), file)
    time = samples["time"].to_numpy()
    axis = np.unique(time)
    # where stamps jitter each grasp is interpolated linearly onto the common step, and left NaN where the
    # nearest samples are more than 1.5 steps apart
    mean_step, deviation = _grid_of(axis, step)
    if max(deviation, abs(mean_step - step)) > 0.02 * step:
        first, last = np.ceil(time.min() / step - 1e-6), np.floor(time.max() / step + 1e-6)
        axis = np.round(step * np.arange(first, last + 1), 9)
        repairs.append(f"time stamps jitter: interpolated onto a step of {step:g} s")
    return axis, {
        name: np.stack([_on_axis(axis, rows["time"], rows[name], step) for _, rows in by_grasp])
        for name in samples.columns.drop(["grasp_id", "time"])
    }


def _grid_of(time: Array, usual: float | None = None) -> tuple[float, float]:
    """Return the mean step of time stamps, in which a hole counts as the steps that it is long, and their
    largest deviation from a grid of it; NaN of one sample.  ``usual`` is about the step, else the median."""
    moves = np.diff(time)
    if not moves.size:
        return np.nan, np.nan
    counts = np.maximum(np.round(moves / (usual or np.median(moves))), 1)
    step = float(moves.sum() / counts.sum())  # a median of rounded stamps drifts over a long recording
    return step, float(np.abs(np.cumsum(moves - step * counts)).max())


def _common_step(steps: Series[float], file: str) -> float:
    """Return the median of the grasps' steps [s]."""
    if steps.isna().all():
        raise UserError("no grasp has two samples", file=file, hint="give the whole recording of each grasp")
    step = float(steps.median())
    odd = steps[(steps / step - 1).abs() > 0.2]  # NaN compares false
    for grasp, its_step in odd[:1].items():
        problem = f"grasp {grasp!r} has a step of {its_step:g} s, the others {step:g} s"
        raise UserError(problem, file=file, hint="give grasps of another rate a file of their own")
    plain = float(f"{step:.2g}")
    return plain if abs(plain / step - 1) < 0.01 else float(f"{step:.4g}")


def _on_axis(axis: Array, time: Series[float], values: Series[float], step: float) -> Array:
    """Return a grasp on the axis: as it is where it has a sample, NaN where none is near."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.full(axis.size, np.nan)
    t = time[finite].to_numpy()
    after = np.clip(np.searchsorted(t, axis), 0, t.size - 1)
    before = np.clip(np.searchsorted(t, axis, side="right") - 1, 0, t.size - 1)
    inside = (axis >= t[0] - 0.5 * step) & (axis <= t[-1] + 0.5 * step)
    has_neighbours = inside & (t[after] - t[before] <= 1.5 * step)
    return np.where(has_neighbours, np.interp(axis, t, values[finite]), np.nan)


def meta_path(path: str | Path) -> Path:
    """Return the meta file of a CSV file; UserError where there is none."""
    stem = file_stem(path)
    choices = [Path(path).with_name(f"{stem}_meta{ending}") for ending in _ENDINGS]
    meta_path = next((p for p in choices if p.exists()), None)
    if meta_path is None:
        hint = f"put {choices[0].name} beside it: grasp_id,material,t_object_nominal_degC,..."
        raise UserError("its meta file is missing", file=path, hint=hint)
    return meta_path


def _rows_of_facts(table: Table, order: Index[str], file: str) -> NDArray[np.intp]:
    """Return for each grasp of a file the first row that has its facts in a table; UserError where another
    row has others, or the table names other grasps."""
    import pandas as pd

    known = ("grasp_id", *GRASP_LABELS, *GRASP_NUMBERS)
    columns = {**table.text, **table.numbers}
    facts = pd.DataFrame({h: cells for h, cells in columns.items() if _name_and_unit(h)[0] in known})
    facts = facts.drop_duplicates()  # NaN is as good as NaN
    for grasp in facts["grasp_id"][facts["grasp_id"].duplicated()][:1]:
        two_rows = facts[facts["grasp_id"] == grasp][:2]
        header = two_rows.nunique(dropna=False).idxmax()
        (earlier, cell), (first, line) = two_rows[header], table.lines[two_rows.index]
        problem = f"{cell} of grasp {grasp!r} was {earlier} in row {first}"
        hint = "give each grasp its own grasp_id, and the same facts in all of its rows"
        raise UserError(problem, file=table.file, row=int(line), column=header, hint=hint)
    without_samples = facts["grasp_id"][~facts["grasp_id"].isin(order)][:1]
    for grasp, line in zip(without_samples, table.lines[without_samples.index]):
        problem = f"grasp {grasp!r} has no samples in {Path(file).name}"
        raise UserError(problem, file=table.file, row=int(line), hint="remove the row or add the samples")
    for grasp in order[~order.isin(facts["grasp_id"])][:1]:
        raise UserError(f"no row for grasp {grasp!r} of {Path(file).name}", file=table.file, hint="add it")
    return np.asarray(facts.index[pd.Index(facts["grasp_id"]).get_indexer(order)])


def _of_tables(table: Table, meta: Table | None, name: str) -> Grasps:
    """Return the grasps of a table with a row a sample, and of one with a row a grasp, if there is one."""
    import pandas as pd

    known = (*GRASP_NUMBERS, *GRASP_LABELS)
    columns, notes = _columns(table, _SAMPLES if meta else (*_SAMPLES, *known))
    _check_samples(columns, table)
    samples = pd.DataFrame({name: columns[name] for name in ("grasp_id", *_SAMPLES) if name in columns})
    samples["time"] = samples["time"].round(6)
    order = pd.Index(samples["grasp_id"].unique())
    facts, of_meta = (columns, []) if meta is None else _columns(meta, known)
    rows = _rows_of_facts(meta or table, order, table.file)
    repairs = [*table.notes, *notes, *of_meta]
    axis, channels = _onto_one_axis(samples, table.file, repairs)
    facts = {fact: facts[fact][rows] for fact in known if fact in facts}
    attrs = {"name": name, "repairs": "\n".join(repairs)}
    return _record(table.file, name, order.tolist(), axis, channels | facts, attrs)


def _of_dataset(data: xr.Dataset, path: str | Path, called: str | None = None) -> Grasps:
    """Return the grasps of what a NetCDF file holds."""
    schema = data.attrs.get("schema", "thermogrip.grasps")
    if schema != "thermogrip.grasps":
        raise UserError(f"holds a {schema}, not grasps", file=path, hint="give a file of grasps")
    for need in ("grasp", "time", "t_surface"):
        if need not in data.variables:
            raise UserError(f"no {need}", file=path, hint="give a file of grasps")
    numbers: dict[str, Any] = {}
    for name in [name for name in _NUMBERS if name in data.variables]:
        values, unit = numbers_and_unit(data[name], name, str(path))
        numbers[name] = _in_record_unit(name, values, unit, path, name)
    labels = {name: data[name].values.tolist() for name in GRASP_LABELS if name in data}
    axis, ids = numbers.pop("time"), data["grasp"].values.astype(str).tolist()
    stem = called or file_stem(path)
    attrs = data.attrs | {"name": called or data.attrs.get("name", stem)}
    with reading("is no record of grasps", file=path, hint="give dims (grasp, time)"):
        return _record(path, stem, ids, axis, numbers | labels, attrs)


def _record(
    file: str | Path,
    stem: str,
    ids: Sequence[str],
    axis: Array,
    variables: dict[str, Any],
    attrs: dict[Any, Any],
) -> Grasps:
    """Return the grasps of a file, each with the session and the block that it has where none is stated;
    UserError where one has no sample before or after contact."""
    unstated = np.full(len(ids), "")
    material = variables.get("material", unstated)
    for label, default in (("material", ""), ("session", stem), ("block", material)):
        stated = np.asarray(variables.get(label, unstated), dtype=str)
        variables[label] = np.where(stated == "", default, stated)
    grasps = make_grasps(axis, grasp_id=ids, name=str(file), **variables)  # whose faults name the file
    grasps.attrs |= attrs
    grasps = with_lead_in(grasps)
    time, finite = grasps["time"].values, np.isfinite(grasps["t_surface"].values)
    for side, inside, hint in (
        ("before", time < 0, "record from 2 s before, or give t_gripper_set_degC"),
        ("after", time > 0, "is this a grasp? remove it or record the contact"),
    ):
        for grasp in grasps["grasp"].values[~finite[:, inside].any(axis=1)][:1]:
            problem = f"grasp {str(grasp)!r} has no sample {side} the closed message at 0 s"
            raise UserError(problem, file=file, hint=hint)
    return grasps
