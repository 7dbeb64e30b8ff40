"""Records in a Zarr store: a folder with a file a chunk, of which a slice of the grasps is read at a time.

A store names the codecs that unpack its chunks, and one of them may be Python's pickle, which runs code.  So
its metadata are read as JSON first, and arrays whose codecs are not known to unpack bytes and nothing else
are refused.  Variables, dimensions, units and attributes are those of a NetCDF file
(:mod:`~thermogrip.datasets.netcdf`).

A chunk without a file holds the fill value, by the format of Zarr.  A store that was copied in part looks
alike, so readings without a file are noted among the repairs, and refused where they would be numbers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from thermogrip.datasets.atomic_files import read_bytes
from thermogrip.datasets.errors import UserError, as_user_error
from thermogrip.datasets.limits import check_size
from thermogrip.datasets.netcdf import from_cf, text_as_str

if TYPE_CHECKING:
    import xarray as xr

_GROUPS, _ARRAYS = ("zarr.json", ".zgroup"), ("zarr.json", ".zarray")
#: Codecs that change bytes into bytes, numbers or text.
_KNOWN = frozenset({
    "blosc", "zstd", "gzip", "zlib", "lz4", "lzma", "bz2", "bytes", "crc32c", "crc32", "adler32",
    "fletcher32", "shuffle", "delta", "transpose", "sharding_indexed", "vlen-utf8", "fixedscaleoffset",
    "quantize", "bitround",
})  # fmt: skip
_SLICE = 2000  # grasps that are read at once, to whole chunks
_DAMAGE = (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError)


class _Array(NamedTuple):
    """What the metadata of an array say."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    codecs: tuple[str, ...]
    fill: Any = None
    chunk_name: str = ""  # how it begins
    separator: str = "."  # of the places in it

    def absent(self, folder: Path, start: int, stop: int) -> list[str]:
        """Return the names of chunks without a file, of the rows from ``start`` to ``stop``."""
        rows = range(start // self.chunks[0], -(-stop // self.chunks[0]))
        others = (range(-(-n // chunk)) for n, chunk in zip(self.shape[1:], self.chunks[1:]))
        names = (self.chunk_name + self.separator.join(map(str, at)) for at in product(rows, *others))
        return [name for name in names if not (folder / name).is_file()]


def is_store(path: str | Path) -> bool:
    """Return whether a path is a folder that is a Zarr store."""
    return any(Path(path, name).is_file() for name in _GROUPS)


def store_slices(path: str | Path) -> list[tuple[int, int]]:
    """Return the slices of grasps that a store is read in, each of whole chunks of ``t_surface``."""
    arrays = _checked(Path(path))
    if "t_surface" not in arrays or len(arrays["t_surface"].shape) != 2:
        problem = "has no array t_surface over grasp and time"
        raise UserError(problem, file=path, hint="write it as a NetCDF file is written")
    (n, _), (chunk, _) = arrays["t_surface"].shape, arrays["t_surface"].chunks
    each = chunk * max(1, round(_SLICE / chunk))
    return [(start, min(start + each, n)) for start in range(0, n, each)]


def open_store(path: str | Path, start: int = 0, stop: int | None = None) -> xr.Dataset:
    """Return the grasps from ``start`` to ``stop`` of a store, loaded; UserError if it cannot be read, holds
    other codecs than those that unpack bytes, or too much."""
    arrays = _checked(Path(path))
    lost = _lost_readings(Path(path), arrays, start, stop)
    if find_spec("zarr") is None:
        raise UserError("needs the package zarr", file=path, hint="pip install thermogrip[zarr]")
    import xarray as xr

    for name, array in arrays.items():
        share = array.shape[0] if stop is None or name == "time" else min(stop - start, array.shape[0])
        parts = -(-share // array.chunks[0]) * array.chunks[0] if array.chunks[0] else 0
        check_size(8 * parts * math.prod(array.shape[1:]), file=path, what=f"{name} declares")
        check_size(8 * math.prod(array.chunks), file=path, what=f"a chunk of {name} declares")
    options: dict[str, Any] = {"consolidated": False, "decode_times": False, "decode_timedelta": False}
    hint = "copy or write it again"
    with as_user_error(_DAMAGE, "is damaged or no Zarr store ({error})", file=path, hint=hint):
        data = xr.open_zarr(path, chunks=None, **options)
        if "grasp" in data.dims:
            data = data.isel(grasp=slice(start, stop))
        if lost:
            data.attrs["repairs"] = "\n".join(filter(None, [str(data.attrs.get("repairs", "")), lost]))
        return from_cf(text_as_str(data.load()))


def _lost_readings(store: Path, arrays: dict[str, _Array], start: int, stop: int | None) -> str:
    """Return in words which readings have no file; UserError where they would be numbers."""
    array = arrays.get("t_surface")
    if array is None or 0 in array.chunks:
        return ""
    absent = array.absent(store / "t_surface", start, array.shape[0] if stop is None else stop)
    if not absent:
        return ""
    words, hint = (
        f"{len(absent)} chunk(s) of t_surface have no file, {absent[0]} first",
        "copy the store again",
    )
    if array.fill not in ("NaN", None):
        raise UserError(words, file=store, column="t_surface", hint=hint)
    return f"{words}: no readings there, or {hint}"


def _checked(store: Path) -> dict[str, _Array]:
    """Return the arrays of a store by name; UserError if one cannot be what is read."""
    found = {}
    for folder in sorted(p for p in store.iterdir() if p.is_dir()):
        for name in _ARRAYS:
            if (folder / name).is_file():
                found[folder.name] = _described(folder / name)
                break
    if not found:
        raise UserError("holds no array", file=store, hint="name the folder of the group with t_surface")
    for name, array in found.items():
        odd = sorted(set(array.codecs) - _KNOWN)
        if odd:
            problem = f"is packed with {odd[0]}, which is not read"
            raise UserError(problem, file=store, column=name, hint="write it with zstd or blosc")
        if len(array.chunks) != len(array.shape) or not array.shape or min(*array.shape, *array.chunks) < 0:
            raise UserError("has no shape of a record", file=store, column=name, hint="write it again")
    return found


def _described(file: Path) -> _Array:
    """Return what the metadata of an array say, of format 2 or 3."""
    wrong = (ValueError, KeyError, TypeError, RecursionError)
    with as_user_error(wrong, "is no metadata of a Zarr array", file=file, hint="copy the store again"):
        data = read_bytes(file)
        check_size(len(data), file=file, share=2048)
        about = json.loads(data)
        shape = tuple(int(n) for n in about["shape"])
        if about["zarr_format"] == 2:
            own = [about.get("compressor"), *(about.get("filters") or ())]
            codecs, separator = tuple(str(c["id"]) for c in own if c), about.get("dimension_separator", ".")
            return _Array(shape, tuple(map(int, about["chunks"])), codecs, about["fill_value"], "", separator)
        chunks = about["chunk_grid"]["configuration"]["chunk_shape"]
        keys = about["chunk_key_encoding"]
        begin, usual = ("c", "/") if keys["name"] == "default" else ("", ".")
        separator = str(keys.get("configuration", {}).get("separator", usual))
        begin += separator if begin else ""
        return _Array(
            shape,
            tuple(map(int, chunks)),
            tuple(_names(about["codecs"])),
            about["fill_value"],
            begin,
            separator,
        )


def _names(codecs: Any) -> Iterator[str]:
    """Yield the names of codecs, those inside shards too."""
    for codec in codecs:
        name = codec if isinstance(codec, str) else str(codec["name"])
        yield name.removeprefix("numcodecs.")
        inside = {} if isinstance(codec, str) else codec.get("configuration", {})
        for key in ("codecs", "index_codecs"):
            yield from _names(inside.get(key, ()))
