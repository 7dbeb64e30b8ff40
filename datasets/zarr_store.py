"""Records in a Zarr store: a folder with a file a chunk, of which a slice of the grasps is read at a time.

A store names the codecs that unpack its chunks, and one of them may be Python's pickle, which runs code.  So
its metadata are read as JSON first, and arrays whose codecs are not known to unpack bytes and nothing else
are refused.  Variables, dimensions, units and attributes are those of a NetCDF file
(:mod:`~thermogrip.datasets.netcdf`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from importlib.util import find_spec
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
        return from_cf(text_as_str(data.load()))


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
            return _Array(shape, tuple(map(int, about["chunks"])), tuple(str(c["id"]) for c in own if c))
        chunks = about["chunk_grid"]["configuration"]["chunk_shape"]
        return _Array(shape, tuple(map(int, chunks)), tuple(_names(about["codecs"])))


def _names(codecs: Any) -> Iterator[str]:
    """Yield the names of codecs, those inside shards too."""
    for codec in codecs:
        name = codec if isinstance(codec, str) else str(codec["name"])
        yield name.removeprefix("numcodecs.")
        inside = {} if isinstance(codec, str) else codec.get("configuration", {})
        for key in ("codecs", "index_codecs"):
            yield from _names(inside.get(key, ()))
