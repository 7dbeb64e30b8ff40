"""Files of grasps as a command line names them: several, folders, patterns."""

from __future__ import annotations

import os
from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

from thermogrip.datasets.errors import UserError, os_faults
from thermogrip.datasets.files import file_stem

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

_ENDINGS = (".csv", ".csv.gz", ".csv.xz", ".nc", ".parquet", ".pq")  # of the files of a folder


def read_grasp_files(paths: Sequence[str | Path]) -> list[Grasps]:
    """Return the records of several files as of :func:`read_grasps`; a folder is all its grasp files, in
    order of name, and no file may be given twice."""
    from thermogrip.datasets.grasp_files import read_grasps
    from thermogrip.datasets.schema import log_name

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
    for path in (Path(name) for pattern in paths for name in matching_files(pattern)):
        if not path.is_dir():
            files.append(path)
            continue
        with os_faults(path):
            inside = sorted(path.iterdir())
        tables = [file for file in inside if file.name.lower().endswith(_ENDINGS) and file.name[0] != "."]
        files += [file for file in tables if not file_stem(file).endswith("_meta")]
        if not tables:
            has_folders = any(file.is_dir() for file in inside)
            deeper = f", or a pattern in quotes: '{path}/*/*.parquet'" if has_folders else ""
            hint = f"give a folder with .csv, .nc or .parquet in it{deeper}"
            raise UserError("holds no grasp files", file=path, hint=hint)
    return files


def distinct_names(files: Sequence[Path]) -> list[str | None]:
    """Return for each file None, or where another one has its stem its path below the folder that all of this
    stem have in common; UserError where a file is given twice."""
    places = [os.path.abspath(file) for file in files]
    names: list[str | None] = []
    for file, place in zip(files, places):
        if places.count(place) > 1:
            raise UserError("is given twice", file=file, hint="give each file once")
        alike = [other for other in places if file_stem(other) == file_stem(file)]
        names.append(os.path.relpath(place, os.path.commonpath(alike)) if len(alike) > 1 else None)
    return names


def matching_files(path: str | Path) -> list[str]:
    """Return what a pattern with *, ? or [] that a shell left names, in order, without meta files of grasps;
    else the path itself."""
    matches = [] if os.path.exists(path) else sorted(glob(str(path), recursive=True))
    return [name for name in matches if not file_stem(name).endswith("_meta")] or [str(path)]
