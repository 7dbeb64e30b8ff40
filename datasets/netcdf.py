"""Records and tables in NetCDF-4 files, through h5netcdf.

NetCDF has the unit of each variable as an attribute, so the names need no suffix. HDF5 stores arrays and
text; opening a file runs no code. Files are written by the CF conventions, so that xarray, Panoply, ncview
and their like show them as they are meant; those of others, and older ones, need not be.

What CF 1.11 [1]_ asks of a file, and how a record gives it:

- ``Conventions`` and ``title`` stand in its attributes.
- Units are UDUNITS [2]_.  It knows ``degC``, ``percent``, ``s``; what is counted from 0 to 255 has the unit
  1/255, as a number.  A temperature says in ``units_metadata`` whether it is one or a difference of two.
- A coordinate variable is numeric, increases, and misses nothing.  The names of grasps are text: they are an
  auxiliary coordinate, ``grasp_id(grasp)``, which the data name in ``coordinates``.
- What is an index into words (the phase of a session) has ``flag_values`` of its own type beside
  ``flag_meanings``.
- Every number has a ``long_name``.  None has a ``standard_name``: there is none for a skin that touches
  something, and that of ``time`` needs a date to count from, which a log does not have.

References
----------
.. [1] https://cfconventions.org/Data/cf-conventions/cf-conventions-1.11/cf-conventions.html, sections 2.2 to
       2.6, 3.1, 3.5 and 6.1.
.. [2] https://docs.unidata.ucar.edu/udunits/current/
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import atomic_path
from thermogrip.datasets.errors import UserError, os_faults, reading
from thermogrip.datasets.limits import check_source, check_unpacked, most_bytes, most_unpacked
from thermogrip.datasets.units import UNITS, to_record_unit

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11"
UNIT_OF_BYTE = repr(1 / 255)

_ADDED = ("Conventions", "title", "source")
_LONG_NAMES = {
    "t_surface": "temperature of the skin",
    "t_surface_2": "temperature of the skin, second sensor",
    "t_object": "temperature of the object before contact",
    "t_object_sd": "standard deviation of the temperature of the object",
    "t_gripper": "temperature of the skin before contact",
    "t_ambient": "temperature of the room",
    "repeat": "count of repeats",
    "touch": "count of touches of one block",
    "rest": "time since the touch before",
}
_MOST_MEMBERS = 4096  # of a file
_PART = 16 << 20  # bytes of text that are looked at in one piece

# how other programs write the units that thermogrip reads
_ALIASES = {
    "celsius": "degC", "Celsius": "degC", "degree_Celsius": "degC", "degrees_Celsius": "degC", "°C": "degC",
    "degree_C": "degC", "degrees_C": "degC", "kelvin": "K", "Kelvin": "K", "degK": "K", "°F": "degF",
    "fahrenheit": "degF", "Fahrenheit": "degF", "%": "percent", "volt": "V", "ampere": "A", "watt": "W",
    "second": "s", "seconds": "s", "sec": "s", "milliseconds": "ms", "minutes": "min", "minute": "min",
    "": "1", UNIT_OF_BYTE: "0_255",
}  # fmt: skip


def check_netcdf(path: str | Path) -> None:
    """Refuse what is no NetCDF-4 file, or declares more than it may hold, before xarray is loaded."""
    check_source(path)
    with os_faults(path), Path(path).open("rb") as stream:
        magic = stream.read(8)
    if magic[:3] == b"CDF":
        raise UserError("is NetCDF-3", file=path, hint="convert it with: nccopy -k nc4 OLD NEW")
    if magic != b"\x89HDF\r\n\x1a\n":
        raise UserError("is not NetCDF", file=path, hint="give a NetCDF-4 file or the right ending")
    h5py = import_module("h5py")
    # damage here leaves h5netcdf half built, and complaining when it is collected
    with _not_damaged(path), h5py.File(path, "r") as tried:
        tried.attrs.get("_nc3_strict")
        check_hdf5(tried, path)


def open_netcdf(path: str | Path) -> xr.Dataset:
    """Return the dataset in a NetCDF-4 file, loaded, with times as numbers and text as str; UserError if it
    is missing, unreadable, damaged, or not NetCDF-4."""
    check_netcdf(path)
    import xarray as xr

    options: dict[str, Any] = {"engine": "h5netcdf", "decode_times": False, "decode_timedelta": False}
    with _not_damaged(path), xr.open_dataset(path, **options) as data:
        return from_cf(text_as_str(data.load()))


def _not_damaged(path: str | Path) -> AbstractContextManager[None]:
    return reading("is damaged or not NetCDF-4", file=path, hint="copy or write it again")


def check_hdf5(opened: Any, path: str | Path) -> None:
    """Refuse an open ``h5py.File`` that declares more than it may hold, or data that stand in other files."""
    h5py = import_module("h5py")
    packed, declared, members = Path(path).stat().st_size, 0, 0
    groups = [opened]
    while groups:
        group = groups.pop()
        members += len(group)
        if members > _MOST_MEMBERS:  # a group may hold itself
            raise UserError(f"has more than {_MOST_MEMBERS} members", file=path, hint="leave some out")
        for name in group:
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                hint = "write the data themselves"
                raise UserError("is a link, not data", file=path, column=name, hint=hint)
            member = group[name]
            if isinstance(member, h5py.Group):
                groups.append(member)
            elif isinstance(member, h5py.Dataset):
                if member.is_virtual or member.external:
                    hint = "copy it into this"
                    raise UserError("is stored in another file", file=path, column=name, hint=hint)
                declared += _in_memory(member)
                check_unpacked(packed, declared, file=path, what="declares")


def _in_memory(variable: Any) -> int:
    """Return the bytes that a variable may take as an array: of float, of text, or of one chunk of it."""
    h5py = import_module("h5py")
    size, each = int(variable.size), max(8, int(variable.dtype.itemsize))
    chunk = math.prod(variable.chunks or ()) * each
    if h5py.check_string_dtype(variable.dtype) is None and h5py.check_vlen_dtype(variable.dtype) is None:
        return max(size * each, chunk)
    # each text may be one and the same long one: they are measured in parts that no length can make large
    longest = int(variable.file.id.get_filesize())
    part, found = max(1, _PART // longest), 0
    if size * longest <= _PART or size * each > most_bytes() or variable.ndim != 1:
        return max(size * (each if variable.ndim == 1 else longest), chunk)
    for start in range(0, size, part):
        found += sum(len(text) + 64 for text in variable[start : start + part])
        if found > most_unpacked(longest):
            break
    return max(found, chunk)


def write_netcdf(data: xr.Dataset, path: str | Path) -> Path:
    """Write a record as NetCDF-4 by the CF conventions, in one step, and return the path."""
    data = as_cf(data)
    packed = {"zlib": True, "complevel": 4, "fletcher32": True, "_FillValue": np.nan}
    encoding: dict[Any, dict[str, Any]] = {
        name: packed
        for name, variable in data.data_vars.items()
        if variable.dtype.kind == "f" and variable.ndim
    }
    encoding |= {name: {"_FillValue": None} for name in data.coords}
    with atomic_path(path) as temporary:
        data.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)
    return Path(path)


def record_unit(variable: xr.DataArray, name: str, file: str) -> tuple[NDArray[np.float64], str]:
    """Return a variable's numbers and unit as records have them; UserError where it has none."""
    if variable.dtype.kind not in "fiub":
        raise UserError(f"holds {variable.dtype}, not numbers", file=file, column=name, hint="leave it out")
    if "units" not in variable.attrs:
        raise UserError("has no unit", file=file, column=name, hint="set its attribute units")
    unit = convention_unit(str(variable.attrs["units"]), name, file)
    return to_record_unit(np.asarray(variable.values, dtype=float), unit)


def convention_unit(unit: str, name: str, file: str) -> str:
    known = _ALIASES.get(unit, unit)
    if known not in (*UNITS, "1"):
        hint = f"use one of {' '.join(UNITS)} 1"
        raise UserError(f"unit {unit!r} is unknown", file=file, column=name, hint=hint)
    return known


def text_as_str(data: xr.Dataset) -> xr.Dataset:
    """Turn the object arrays that variable-length text is read as into arrays of str."""
    for key, variable in data.variables.items():
        if variable.dtype.kind in "OS":
            text = np.asarray(
                [v.decode() if isinstance(v, bytes) else str(v) for v in variable.values.ravel()]
            )
            data[key] = (variable.dims, text.reshape(variable.shape), variable.attrs)
    return data


def as_cf(data: xr.Dataset) -> xr.Dataset:
    """Return a record as a file of it is to be."""
    out = data.copy()
    of_grasps = "grasp" in out.dims
    if "grasp" in out.coords:
        out = out.drop_vars("grasp").assign_coords(grasp_id=("grasp", data["grasp"].values))
    out.attrs = {
        "Conventions": CONVENTIONS,
        "title": str(data.attrs.get("name", "record")),
        "source": "thermogrip",
    }
    out.attrs |= data.attrs
    for key in [*out.data_vars, "time"]:
        if key in out.variables:
            out[key] = _variable(str(key), out[key].variable, of_grasps)
    return out


def from_cf(data: xr.Dataset) -> xr.Dataset:
    """Return the record that a file holds; without what :func:`as_cf` added."""
    if "grasp_id" in data.variables and data["grasp_id"].dims == ("grasp",) and "grasp" not in data.variables:
        names = data["grasp_id"].values.astype(str)
        data = data.drop_vars("grasp_id").assign_coords(grasp=("grasp", names))
    if str(data.attrs.get("schema", "")).startswith("thermogrip."):
        data.attrs = {key: value for key, value in data.attrs.items() if key not in _ADDED}
    return data


def _variable(name: str, variable: xr.Variable, of_grasps: bool) -> xr.Variable:
    attrs: dict[Any, Any] = dict(variable.attrs)
    values = variable.values
    if values.dtype.kind not in "fiu":
        return variable
    if name == "time":
        attrs["long_name"] = "time since the gripper closed" if of_grasps else "time of the log"
    elif of_grasps:
        attrs.setdefault("long_name", _LONG_NAMES.get(name, name))
    else:
        attrs.setdefault("long_name", f"{name} ({attrs.get('role', 'other')})")
    if attrs.get("units") == "degC":
        attrs["units_metadata"] = f"temperature: {'difference' if name.endswith('_sd') else 'on_scale'}"
    if attrs.get("units") == "0_255":
        attrs["units"] = UNIT_OF_BYTE
    if "flag_meanings" in attrs:
        if np.array_equal(values, values.astype(np.int8)):
            values = values.astype(np.int8)
        attrs["flag_values"] = np.arange(len(str(attrs["flag_meanings"]).split()), dtype=values.dtype)
    return type(variable)(variable.dims, values, attrs)
