"""Records and tables in NetCDF-4 files, through h5netcdf.

NetCDF has the unit of each variable as an attribute, so the names need no suffix.  HDF5 stores arrays and
text; opening a file runs no code.  Files of other programs may name units by the CF conventions.
"""

from __future__ import annotations

import math
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, os_faults, reading
from thermogrip.datasets.files import atomic_path, check_source
from thermogrip.datasets.limits import MOST_BYTES, check_unpacked, in_own_process, most_unpacked
from thermogrip.datasets.units import UNITS, any_unit

if TYPE_CHECKING:
    import xarray as xr

_MOST_MEMBERS = 4096  # of a file
_PART = 16 << 20  # bytes of text that are looked at in one piece
_not_damaged = partial(reading, "is damaged or not NetCDF-4", hint="copy or write it again")


def open_netcdf(path: str | Path) -> xr.Dataset:
    """Return the dataset in a NetCDF-4 file, loaded, with times as numbers and text as str; UserError if it
    is missing, unreadable, damaged, or not NetCDF-4."""
    check_source(path)
    with os_faults(path), Path(path).open("rb") as stream:
        magic = stream.read(8)
    if magic[:3] == b"CDF":
        raise UserError("is NetCDF-3", file=path, hint="convert it with: nccopy -k nc4 OLD NEW")
    if magic != b"\x89HDF\r\n\x1a\n":
        raise UserError("is not NetCDF", file=path, hint="give a NetCDF-4 file or the right ending")
    import_module("xarray"), import_module("h5netcdf")  # here, so that each reader need not load them
    return in_own_process(_open_dataset, path)


def _open_dataset(path: Path) -> xr.Dataset:
    import xarray as xr

    check_netcdf(path)
    options: dict[str, Any] = {"engine": "h5netcdf", "decode_times": False, "decode_timedelta": False}
    with _not_damaged(file=path), xr.open_dataset(path, **options) as opened:
        data = opened.load()
    # text of variable length is read as arrays of objects
    texts = [key for key, variable in data.variables.items() if variable.dtype.kind in "OS"]
    data = data.assign({key: data[key].astype(str) for key in texts})
    if "grasp_id" in data.variables and data["grasp_id"].dims == ("grasp",) and "grasp" not in data.variables:
        # version 0.2 had the names of grasps there
        data = data.assign_coords(grasp=data["grasp_id"].astype(str).values).drop_vars("grasp_id")
    return data


def check_netcdf(path: str | Path) -> None:
    """Refuse a NetCDF-4 file that is damaged, declares more than it may hold, or has its data in others."""
    h5py = import_module("h5py")
    packed = Path(path).stat().st_size
    declared = members = 0
    # damage here leaves h5netcdf half built, and complaining when it is collected
    with _not_damaged(file=path), h5py.File(path, "r") as opened:
        opened.attrs.get("_nc3_strict")
        groups = [opened]
        while groups:
            group = groups.pop()
            members += len(group)
            if members > _MOST_MEMBERS:  # a group may hold itself
                raise UserError(f"has more than {_MOST_MEMBERS} members", file=path, hint="leave some out")
            for name in group:
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    hint = "write the data themselves"
                    raise UserError("is a link, not data", file=path, column=name, hint=hint)
                member = group[name]
                if isinstance(member, h5py.Group):
                    groups.append(member)
                elif isinstance(member, h5py.Dataset):
                    if member.is_virtual or member.external:
                        problem, hint = "is stored in another file", "copy it into this"
                        raise UserError(problem, file=path, column=name, hint=hint)
                    declared += _in_memory(member)
                    check_unpacked(packed, declared, file=path, what="declares")


def _in_memory(variable: Any) -> int:
    """Return the bytes that a variable may take as an array: of float, of text, or of one chunk of it."""
    h5py = import_module("h5py")
    size, cell_bytes = int(variable.size), max(8, int(variable.dtype.itemsize))
    chunk = math.prod(variable.chunks or ()) * cell_bytes
    if h5py.check_string_dtype(variable.dtype) is None and h5py.check_vlen_dtype(variable.dtype) is None:
        return max(size * cell_bytes, chunk)
    # each text may be one and the same long one: they are measured in parts that no length can make large
    longest = int(variable.file.id.get_filesize())
    rows_at_once, text_bytes = max(1, _PART // longest), 0
    if size * longest <= _PART or size * cell_bytes > MOST_BYTES or variable.ndim != 1:
        return max(size * (cell_bytes if variable.ndim == 1 else longest), chunk)
    for start in range(0, size, rows_at_once):
        text_bytes += sum(len(text) + 64 for text in variable[start : start + rows_at_once])
        if text_bytes > most_unpacked(longest):
            break
    return max(text_bytes, chunk)


def write_netcdf(data: xr.Dataset, path: str | Path) -> Path:
    """Write a record as NetCDF-4 in one step, and return the path."""
    packed = {"zlib": True, "complevel": 4, "fletcher32": True, "_FillValue": np.nan}
    floats = [name for name, values in data.data_vars.items() if values.dtype.kind == "f" and values.ndim]
    encoding: dict[Any, Any] = dict.fromkeys(floats, packed)
    encoding |= {name: {"_FillValue": None} for name in data.coords}
    with atomic_path(path) as temporary:
        data.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)
    return Path(path)


def numbers_and_unit(variable: xr.DataArray, name: str, file: str) -> tuple[Array, str]:
    """Return a variable's numbers and its unit, "" where it states none; UserError where it holds no numbers
    or an unknown unit."""
    if variable.dtype.kind not in "fiub":
        raise UserError(f"holds {variable.dtype}, not numbers", file=file, column=name, hint="leave it out")
    stated = variable.attrs.get("units")
    unit = "" if stated is None else convention_unit(str(stated), name, file)
    return np.asarray(variable.values, dtype=float), unit


def convention_unit(unit: str, name: str, file: str) -> str:
    """Return the unit of records that a program means, by the CF conventions or as a header would have it."""
    word = unit.replace("degree_", "deg").replace("degrees_", "deg")  # degree_C, degrees_Celsius
    known_unit, scale = ("0_255", 1.0) if unit == repr(1 / 255) else any_unit(word)
    if unit in ("", "1"):
        return "1"
    if not known_unit or scale != 1.0:
        hint = f"use one of {' '.join(UNITS)} 1"
        raise UserError(f"unit {unit!r} is unknown", file=file, column=name, hint=hint)
    return known_unit
