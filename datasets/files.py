"""Files on disk: what a name says, whole files or none, and where each comes from.

Ctrl-C, a full disk or ``kill -9`` leave the old file in place.  Every JSON file of the toolkit has the keys
``schema``, ``version`` (an integer) and ``provenance``: version, date, command, seed, and the SHA-256 of what
was read; a page has it in its foot.  Two runs of one command with one seed differ in this alone.  Reading a
file runs no code.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shlex
import shutil
import stat
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from thermogrip.datasets.errors import UserError, as_user_error, os_faults
from thermogrip.datasets.limits import MOST_BYTES, check_content, check_size, read_within

FORMATS = {
    ".csv": "csv", ".csv.gz": "csv", ".csv.xz": "csv",
    ".txt": "text", ".dat": "text", ".tsv": "text", ".tab": "text", ".asc": "text", ".log": "text",
    ".lvm": "text", ".txt.gz": "text", ".txt.xz": "text", ".dat.gz": "text", ".dat.xz": "text",
    ".mat": "matlab", ".xlsx": "excel",
    ".nc": "netcdf", ".h5": "netcdf", ".hdf5": "netcdf",
    ".parquet": "parquet", ".pq": "parquet",
    ".bag": "rosbag", ".db3": "rosbag", ".mcap": "rosbag",
}  # fmt: skip
_CUT = re.compile(r"^(?P<path>.+)@(?P<start>[^@:/\\]*):(?P<stop>[^@:/\\]*)$")
_JSON_BYTES, _TOML_BYTES = 8 << 20, 1 << 20  # that a document may have
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_LONG_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}""", re.ASCII
)  # possessive: linear in the text
KEY = "provenance"
_ROOMS = tuple(
    str(Path(__file__).resolve().parent.parent / room) + os.sep
    for room in ("datasets", "sysid", "mpc", "rig", "classify")
)  # what they bring belongs to the version


def file_format(path: str | Path) -> str:
    """Return ``"csv"``, ``"netcdf"``, ``"parquet"`` or ``"rosbag"`` by a file name's ending."""
    ending = _ending(path)
    if ending not in FORMATS:
        raise UserError(f"ending {ending!r} is unknown", file=path, hint=f"use one of {' '.join(FORMATS)}")
    return FORMATS[ending]


def file_stem(path: str | Path) -> str:
    """Return the file name without its ending."""
    return Path(path).name[: -len(_ending(path)) or None]


def _ending(path: str | Path) -> str:
    return next((e for e in FORMATS if Path(path).name.lower().endswith(e)), Path(path).suffix.lower())


class CutFile(NamedTuple):
    """A file, and the part of it that is meant."""

    file: Path
    start: float  # [s], -inf from the first row on
    stop: float  # [s], inf to the last one


def split_cut(path: str | Path) -> CutFile:
    """Return file, start and stop [s] of ``PATH@START:STOP``; a path that exists is whole, whatever it is."""
    match = _CUT.match(str(path))
    if match is None or os.path.exists(path):
        return CutFile(Path(path), -math.inf, math.inf)
    ends = []
    for text, empty in ((match["start"], -math.inf), (match["stop"], math.inf)):
        hint = "write PATH@START:STOP in seconds"
        with as_user_error(ValueError, f"{text!r} is not a time", file=str(path), hint=hint):
            ends.append(float(text) if text.strip() else empty)
    start, stop = ends
    if not start < stop:
        raise UserError(f"the cut {start:g}:{stop:g} is empty", file=str(path), hint="write the start first")
    return CutFile(Path(match["path"]), start, stop)


@dataclass
class _Work:
    """One command while it runs."""

    words: Sequence[str]
    seed: int | None = None
    read: dict[str, str] = field(default_factory=dict)  # path -> SHA-256, "" until it is asked for
    written: set[str] = field(default_factory=set)


_WORK: ContextVar[_Work | None] = ContextVar("work", default=None)


@contextmanager
def work(words: Sequence[str]) -> Iterator[None]:
    """Gather what one command, the words as typed, reads and writes: readers and writers of files report it,
    and a writer asks :func:`provenance`."""
    token = _WORK.set(_Work(words))
    try:
        yield
    finally:
        _WORK.reset(token)


def note_seed(seed: int | None) -> None:
    """Report the seed of the command."""
    if now := _WORK.get():
        now.seed = seed


def note_written(path: str | Path) -> None:
    """Report a file that was written."""
    if now := _WORK.get():
        now.written.add(os.path.abspath(path))


def provenance() -> dict[str, Any]:
    """Return the provenance of what is being written, as plain JSON."""
    from thermogrip import __version__

    now = _WORK.get() or _Work([Path(sys.argv[0]).name, *sys.argv[1:]])
    try:
        folder = os.getcwd()
    except OSError:  # it was removed, which must not cost what is being written
        folder = ""
    below = folder.rstrip(os.sep) + os.sep
    for name in now.read:
        with suppress(UserError):  # it is gone
            now.read[name] = now.read[name] or (hash_file(name) if os.path.isfile(name) else "")
    return {
        "thermogrip": __version__,
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "command": shlex.join(now.words),
        "seed": now.seed,
        "inputs": {name.removeprefix(below): digest for name, digest in now.read.items()},
    }


def hash_file(path: str | Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits."""
    with os_faults(path), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_source(path: str | Path) -> int:
    """Return the size of a file [bytes], 0 where it is a pipe; UserError where there is none to read."""
    with os_faults(path):
        about = os.stat(path)
    if stat.S_ISDIR(about.st_mode):
        raise UserError("is a folder", file=path, hint="name a file")
    # what a shell makes of <(command), and stdin
    handed = str(path).startswith(("/dev/fd/", "/proc/self/fd/")) or str(path) == "/dev/stdin"
    if not stat.S_ISREG(about.st_mode) and not (handed and stat.S_ISFIFO(about.st_mode)):
        raise UserError("is no file but a device, a pipe or a socket", file=path, hint="name a file")
    now, name = _WORK.get(), os.path.abspath(path)  # files of the package and of the command do not count
    if now and name not in now.written and not os.path.realpath(name).startswith(_ROOMS):
        now.read.setdefault(name, "")
    return about.st_size if stat.S_ISREG(about.st_mode) else 0


def make_folder(path: str | Path) -> None:
    """Make a folder, and those above it, where there is none, and force their names to disk; UserError where
    that is refused."""
    folder = Path(path)
    with os_faults(path):
        missing = [place for place in (folder, *folder.parents) if not place.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        for place in missing:
            _sync_folder(place.parent)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, synced and renamed to it on success and removed on any
    exception, Ctrl-C included."""
    target = Path(path)
    if os.path.isdir(target):  # Path.is_dir raises on a name that is too long
        raise UserError("is a folder", file=target, hint="name a file")
    # nobody else may write to this folder, so that no link can be put in the file's place
    with os_faults(target), TemporaryDirectory(prefix=".", dir=target.parent) as folder:
        temporary = Path(folder) / target.name  # writers choose their format or compression by the suffix
        yield temporary
        _sync(temporary, os.O_RDWR)  # Windows syncs only what is writable
        if target.is_file() and not target.is_symlink():  # a link is replaced, whatever it leads to
            shutil.copymode(target, temporary)
        os.replace(temporary, target)  # which is atomic on POSIX and Windows
        note_written(target)
        _sync_folder(target.parent)


def write_atomic(path: str | Path, content: bytes | str) -> Path:
    """Write ``content`` to ``path`` in one step and return the path; text as UTF-8, with ``?`` for what is no
    character, as in the name of a file that is no text."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode("utf-8", "replace") if isinstance(content, str) else content)
    return Path(path)


def read_bytes(path: str | Path, *, most: int = MOST_BYTES) -> bytes:
    """Return the bytes of a file that has no more of them than it may."""
    # a null byte in the name is a ValueError
    with as_user_error(ValueError, "{error}", file=repr(str(path)), hint="check the path"), os_faults(path):
        check_size(check_source(path), file=path, most=most)
        with open(path, "rb") as stream:
            data = read_within(stream, most)
    check_size(len(data), file=path, most=most)  # a pipe says no size, and a file may grow
    return data


def write_json(path: str | Path, content: Mapping[str, Any], *, schema: str, version: int) -> Path:
    """Write a JSON object of finite numbers with ``schema``, ``version`` and provenance, return the path."""
    whole = {"schema": schema, "version": version} | dict(content) | {KEY: provenance()}
    return write_atomic(path, json.dumps(whole, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def read_toml(path: str | Path, *, hint: str) -> dict[str, Any]:
    """Return the content of a TOML file; ``hint`` says where a good one comes from."""
    raw = read_bytes(path, most=_TOML_BYTES)
    too_deep = as_user_error(RecursionError, "is nested too deeply", file=path, hint=hint)
    # no text, no TOML, or an integer of thousands of digits
    with too_deep, as_user_error(ValueError, "is not TOML ({error})", file=path, hint=hint):
        text = raw.decode("utf-8")
        if _LONG_KEY.search(text):  # tomllib takes the square of the parts of a key
            raise UserError("has a key of more than 32 parts", file=path, hint=hint)
        content = tomllib.loads(text)
    check_content(content, file=path)
    return content


def read_json(path: str | Path, schema: str, version: int) -> dict[str, Any]:
    """Return the JSON object in ``path``, which must have this schema and no newer version."""
    raw = read_bytes(path, most=_JSON_BYTES)
    place: dict[str, Any] = {"file": path, "hint": f"it must be a JSON file of schema {schema!r}"}
    too_deep = as_user_error(RecursionError, "is nested too deeply", **place)
    with too_deep, as_user_error(ValueError, "is not JSON ({error})", **place):  # or no text
        content: dict[str, Any] = parse_json(raw.decode("utf-8"))
    check_json(content, schema, version, file=path)
    check_content(content, file=path)
    return content


def parse_json(text: str, **options: Any) -> Any:
    """Return what a JSON text holds; ValueError where it is none, or has half a character (a lone surrogate),
    which can be shown and written nowhere; RecursionError where it is nested too deeply."""
    content = json.loads(text, **options)
    if _SURROGATE.search(text):  # half of a pair, as a rule
        json.dumps(content, ensure_ascii=False).encode()
    return content


def check_json(content: Any, schema: str, version: int, *, file: str | Path | None = None) -> None:
    """Raise :class:`UserError` where content is no JSON object of the schema, or newer than ``version``."""
    stated = content if isinstance(content, dict) else {"schema": type(content).__name__}
    if stated.get("schema") != schema:
        problem = f"schema is {stated.get('schema')!r}, not {schema!r}"
        raise UserError(problem, file=file, hint="give the file of that stage")
    number = stated.get("version")
    if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= version:
        problem = f"version {repr(number)[:20]} is not between 1 and {version}"
        raise UserError(problem, file=file, hint="update thermogrip or write the file anew")


def _sync_folder(path: Path) -> None:
    """Force a folder's names to disk; Windows cannot open one, and need not."""
    if os.name != "nt":
        _sync(path, os.O_RDONLY)


def _sync(path: Path, flags: int) -> None:
    """Force a file or a folder's names to disk."""
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
