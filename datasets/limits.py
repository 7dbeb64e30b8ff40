"""How large a file may be, and how far it may unpack: one limit for all readers, checked before the memory.

A few kilobytes can claim gigabytes (a compressed line of blanks, an array that was never written), so every
reader asks here, with what a file declares, before it allocates anything; ``docs/reference/files.md`` lists
the limits.
"""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar, cast
from warnings import catch_warnings, simplefilter

from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from thermogrip.datasets.arrays import Array

#: Levels of brackets in a document, and the largest number in it.
MOST_DEPTH, MOST_NUMBER = 64, 1e100

#: Sample times and steps [s]; the largest value, gain or coefficient of a model, in any unit.
STEP_RANGE, LARGEST = (1e-3, 86400.0), 1e12

MOST_BYTES = 2 << 30  # of a file
_PIECE = 4 << 20  # bytes that are read at once
# times the packed size: a log of 500 000 rows whose sensors never move grows 104 times with xz
_LARGEST_EXPANSION = 200
_FLOOR = 8 << 20  # bytes that any packed file may unpack to
_READ_S, _SLOWEST_DISK = 10.0, 1e6  # a small file takes .05; bytes a second from a disk of the network
_COPIES = 4  # of a file's content that its reader may hold: packed, unpacked, as arrays, and to be sent
_DAMAGED = "it is damaged: copy or write it again"
_Record = TypeVar("_Record")


def most_unpacked(packed: int) -> int:
    """Return the bytes that may come out of a file of ``packed`` bytes."""
    return min(MOST_BYTES, max(_FLOOR, _LARGEST_EXPANSION * packed))


def check_size(size: int, *, file: str | Path, what: str = "is", most: int | None = None) -> None:
    """Raise :class:`UserError` where a size [bytes] that was found or declared is beyond the limit."""
    most = MOST_BYTES if most is None else most
    if size > most:
        problem = f"{what} {_megabytes(size)}, more than the {_megabytes(most)} of a file"
        raise UserError(problem, file=file, hint="write it anew, or in parts")


def check_unpacked(packed: int, unpacked: int, *, file: str | Path, what: str = "unpacks to") -> None:
    """Raise :class:`UserError` where a file of ``packed`` bytes holds or declares too many bytes."""
    check_size(unpacked, file=file, what=what)
    if unpacked > most_unpacked(packed):
        growth = f"{_megabytes(unpacked)} or more from {_megabytes(packed)}"
        raise UserError(f"{what} {growth}, which no record does", file=file, hint="write it anew")


def read_within(stream: BinaryIO, most: int) -> bytes:
    """Return what a stream holds, at most ``most`` + 1 bytes; the caller compares the length."""
    content, bytes_left = io.BytesIO(), most + 1  # its value is no second copy, as that of a join is
    while bytes_left > 0 and (piece := stream.read(min(bytes_left, _PIECE))):
        content.write(piece)
        bytes_left -= len(piece)
    return content.getvalue()


def in_own_process(read: Callable[[Path], _Record], path: str | Path) -> _Record:
    """Return ``read(path)`` from a process of its own, for readers in C, which a damaged file may crash or
    keep for ever; UserError where it does.  Other systems than Linux read it in this one."""
    import multiprocessing as mp

    if sys.platform != "linux" or mp.current_process().daemon:
        return read(Path(path))
    receiver, sender = mp.get_context("fork").Pipe(duplex=False)
    reader = mp.get_context("fork").Process(target=_send_record, args=(sender, read, Path(path)), daemon=True)
    with catch_warnings():
        simplefilter("ignore", DeprecationWarning)  # of forks beside threads: none holds a reader's lock
        reader.start()
    sender.close()
    try:
        if not receiver.poll(_READ_S + os.stat(path).st_size / _SLOWEST_DISK):
            raise UserError("its reader does not come to an end", file=path, hint=_DAMAGED)
        record, fault = receiver.recv()
    except EOFError as error:
        raise UserError("its reader crashed", file=path, hint=_DAMAGED) from error
    finally:
        reader.kill()
        reader.join()
        receiver.close()
    if fault is not None:
        raise fault
    return cast("_Record", record)


def _send_record(sender: Any, read: Callable[[Path], Any], path: Path) -> None:
    import resource  # no Windows has it

    pages, (_, hard) = Path("/proc/self/statm").read_text().split()[0], resource.getrlimit(resource.RLIMIT_AS)
    most = int(pages) * resource.getpagesize() + _COPIES * MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most if hard < 0 else min(most, hard), hard))
    try:
        sender.send((read(path), None))
    except Exception as fault:
        sender.send((None, fault))


class Unpacker:
    """Unpack the chunks of one bag, which count together, to what the file may hold and not a byte further;
    readers would unpack chunks whole, which grow 255 times (lz4) or many thousand times (zstd, bz2)."""

    def __init__(self, file: str | Path) -> None:
        self._file, self._found = file, 0
        self._packed = Path(file).stat().st_size

    def __call__(self, packing: str, data: bytes) -> bytes:
        """Return what ``data``, packed with bz2, lz4 or zstd, holds; KeyError if it is with another."""
        packed: Any = import_module({"bz2": "bz2", "lz4": "lz4.frame", "zstd": "zstandard"}[packing])
        with packed.open(io.BytesIO(data), "rb") as stream:
            unpacked = read_within(stream, most_unpacked(self._packed) - self._found)
        self._found += len(unpacked)
        check_unpacked(self._packed, self._found, file=self._file)
        return unpacked


def check_content(
    content: dict[str, Any] | list[Any], *, file: str | Path | None = None, place: tuple[object, ...] = ()
) -> None:
    """Raise :class:`UserError` where a document is nested too deeply or has a number beyond all use;
    ``place`` are the keys above it."""
    for key, inner in content.items() if isinstance(content, dict) else enumerate(content):
        if isinstance(inner, dict | list):
            if len(place) + 1 == MOST_DEPTH:
                problem = f"is nested more than {MOST_DEPTH} levels deep"
                raise UserError(problem, file=file, hint="write it anew")
            check_content(inner, file=file, place=(*place, key))
        elif isinstance(inner, int | float) and not abs(inner) <= MOST_NUMBER:
            shown = f"{inner:g}" if isinstance(inner, float) else f"{str(inner)[:8]}..."
            finite = isinstance(inner, int) or math.isfinite(inner)
            keys = ".".join(str(step)[:40] for step in (*place, key))
            problem = f"{keys} is {shown}, {f'beyond {MOST_NUMBER:g}' if finite else 'not a finite number'}"
            raise UserError(problem, file=file, hint="write a number that can be")


def number_within(content: Mapping[str, Any], key: str, low: float, high: float) -> float:
    """Return a number of a document; ValueError where it is none or out of range, KeyError where missing."""
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} is {str(value)[:40]!r}, not a number")
    if not low <= value <= high:
        raise ValueError(f"{key} is {value:g}, not {low:g} to {high:g}")
    return float(value)


def array_within(content: Mapping[str, Any], key: str, largest: float = LARGEST) -> Array:
    """Return an array of a document; ValueError where an entry is not finite or beyond ``largest``."""
    import numpy as np  # the command line imports this module, and --help loads no heavy package

    with np.errstate(invalid="ignore"):  # of a NaN in another type
        values = np.asarray(content[key], dtype=float)
    if not (np.abs(values) <= largest).all():
        raise ValueError(f"{key} has an entry that is not within +-{largest:g}")
    return values


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.0f} MB" if size >= 1e7 else f"{size / 1e3:.0f} kB"
