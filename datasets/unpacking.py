"""Packed parts of a bag, unpacked within the limits of :mod:`thermogrip.datasets.limits`.

The readers of bags unpack a chunk whole, whatever comes out of it: lz4 grows 255 times, zstd and bz2 many
thousand times.  Here a chunk is unpacked up to what the file may still hold, and not a byte further.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

from thermogrip.datasets.limits import check_unpacked, most_unpacked

__all__ = ["Unpacker"]


class Unpacker:
    """Unpack the chunks of one file, which count together.

    Parameters
    ----------
    file : str or Path
        For its size and for the error.

    Examples
    --------
    >>> import bz2, tempfile
    >>> with tempfile.NamedTemporaryFile() as file:
    ...     Unpacker(file.name)("bz2", bz2.compress(b"warm"))
    b'warm'
    """

    def __init__(self, file: str | Path) -> None:
        self._file, self._packed, self._found = file, Path(file).stat().st_size, 0

    def __call__(self, packing: str, data: bytes) -> bytes:
        """Return what ``data``, packed with bz2, lz4 or zstd, holds.

        Raises
        ------
        UserError
            If the file would hold too much.
        KeyError, OSError, RuntimeError, ValueError
            If the packing is another, or the data are damaged.
        """
        left = most_unpacked(self._packed) - self._found
        found = _PACKINGS[packing](data, left + 1)
        self._found += len(found)
        check_unpacked(self._packed, self._found, file=self._file)
        return found

    def declare(self, size: int) -> None:
        """Refuse a chunk that says that it holds too much."""
        check_unpacked(self._packed, self._found + size, file=self._file, what="declares")


def _bz2(data: bytes, most: int) -> bytes:
    import bz2

    unpacker = bz2.BZ2Decompressor()
    found = unpacker.decompress(data, max_length=most)
    if len(found) < most and not unpacker.eof:
        raise EOFError("the chunk is cut off")
    return found


def _lz4(data: bytes, most: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    unpacker = LZ4FrameDecompressor()
    found: bytes = unpacker.decompress(data, max_length=most)
    if len(found) < most and not unpacker.eof:
        raise EOFError("the chunk is cut off")
    return found


def _zstd(data: bytes, most: int) -> bytes:
    import zstandard

    with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data)) as stream:
        return bytes(stream.read(most))


_PACKINGS: dict[str, Callable[[bytes, int], bytes]] = {"bz2": _bz2, "lz4": _lz4, "zstd": _zstd}
