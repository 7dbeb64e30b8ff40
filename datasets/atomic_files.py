"""Whole files or none: atomic writing, and JSON that says what it is.

A file is written beside its target, forced to disk, then renamed over it, which is atomic on POSIX and
Windows: Ctrl-C, a full disk or ``kill -9`` leave the old one in place.  A symbolic link of the target's name
is replaced, where it leads to is left alone.  Every JSON file of the toolkit has the keys ``schema``,
``version`` (an integer) and ``provenance`` (:mod:`thermogrip.datasets.provenance`); reading it runs no code.
"""

from __future__ import annotations

import json
import os
import re
import stat
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from thermogrip.datasets.errors import UserError, as_user_error, os_fault, os_faults
from thermogrip.datasets.limits import check_content, check_size, check_source, most_bytes, read_within
from thermogrip.datasets.provenance import KEY, hash_file, note_written, provenance

#: A document's part of what a file of records may have (:mod:`thermogrip.datasets.limits`): 8 MiB, 1 MiB.
JSON_SHARE, _TOML_SHARE = 256, 2048
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_LONG_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}""", re.ASCII
)  # possessive: linear in the text


def make_folder(path: str | Path) -> None:
    """Make a folder, and those above it, where there is none, and force their names to disk; UserError where
    that is refused."""
    folder = Path(path)
    with os_faults(path):
        missing = [place for place in (folder, *folder.parents) if not place.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        for place in missing:
            _sync_folder(place.parent)


# Windows writes a line end of two bytes unless it is asked not to; a child process gets no copy on either
_AS_WRITTEN = sum(getattr(os, name, 0) for name in ("O_BINARY", "O_NOINHERIT", "O_CLOEXEC"))
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)  # Windows has none


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, synced and renamed to it on success and removed on any
    exception, Ctrl-C included."""
    target = Path(path)
    if os.path.isdir(target):  # Path.is_dir raises on a name that is too long
        raise UserError("is a folder", file=target, hint="name a file")
    temporary: Path | None = None
    try:
        # the suffix stays, since writers choose their format or compression by it
        prefix = f".{target.stem[:40]}-"
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=target.suffix, dir=target.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _sync_file(temporary, _mode_of(target))
        os.replace(temporary, target)
        note_written(target)
        _sync_folder(target.parent)
        temporary = None
    except OSError as error:
        raise os_fault(error, target) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


def write_atomic(path: str | Path, content: bytes | str) -> Path:
    """Write ``content`` to ``path`` in one step and return the path; text as UTF-8, with ``?`` for what is no
    character, as in the name of a file that is no text."""
    data = content.encode("utf-8", "replace") if isinstance(content, str) else content
    flags = os.O_WRONLY | os.O_TRUNC | _NO_LINK | _AS_WRITTEN
    with atomic_path(path) as temporary, open(os.open(temporary, flags), "wb") as file:
        file.write(data)
    return Path(path)


def open_new(path: str | Path) -> int:
    """Return the descriptor of a new file for writing; OSError if its name is there, if only as a link."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK | _AS_WRITTEN, 0o666)
    note_written(path)
    return handle


def read_bytes(path: str | Path, *, share: int = 1) -> bytes:
    """Return the bytes of a file, at most one ``share``-th of what any file may hold."""
    # a null byte in the name is a ValueError
    with as_user_error(ValueError, "{error}", file=repr(str(path)), hint="check the path"), os_faults(path):
        check_size(check_source(path), file=path, share=share)
        with open(path, "rb") as stream:
            data = read_within(stream, most_bytes(share))
    check_size(len(data), file=path, share=share)  # a pipe says no size, and a file may grow
    return data


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits."""
    check_source(path)
    with os_faults(path):
        return hash_file(path)


def write_json(path: str | Path, content: Mapping[str, Any], *, schema: str, version: int) -> Path:
    """Write a JSON object of finite numbers with ``schema``, ``version`` and provenance, return the path."""
    whole = {"schema": schema, "version": version} | dict(content) | {KEY: provenance()}
    return write_atomic(path, json.dumps(whole, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def read_toml(path: str | Path, *, hint: str) -> dict[str, Any]:
    """Return the content of a TOML file; ``hint`` says where a good one comes from."""
    raw = read_bytes(path, share=_TOML_SHARE)
    too_deep = as_user_error(RecursionError, "is nested too deeply", file=path, hint=hint)
    # no TOML, no text, or an integer of thousands of digits
    with too_deep, as_user_error(ValueError, "is not TOML ({error})", file=path, hint=hint):
        text = raw.decode("utf-8")
        if _LONG_KEY.search(text):  # tomllib takes the square of the parts of a key
            raise UserError("has a key of more than 32 parts", file=path, hint=hint)
        content = tomllib.loads(text)
    check_content(content, file=path)
    return content


def read_json(path: str | Path, schema: str, version: int) -> dict[str, Any]:
    """Return the JSON object in ``path``, which must have this schema and no newer version."""
    raw = read_bytes(path, share=JSON_SHARE)
    place: dict[str, Any] = {"file": path, "hint": f"it must be a JSON file of schema {schema!r}"}
    with as_user_error(UnicodeDecodeError, "is not text, so it is not JSON", **place):
        text = raw.decode("utf-8")
    too_deep = as_user_error(RecursionError, "is nested too deeply", **place)
    with too_deep, as_user_error(ValueError, "is not JSON ({error})", **place):
        try:
            content: dict[str, Any] = parse_json(text)
        except json.JSONDecodeError as error:
            problem = f"is not JSON ({error.msg}, column {error.colno})"
            raise UserError(problem, **place, row=error.lineno) from error
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
    if not isinstance(content, dict) or content.get("schema") != schema:
        stated = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise UserError(
            f"schema is {stated!r}, not {schema!r}", file=file, hint="give the file of that stage"
        )
    stated = content.get("version")
    if not isinstance(stated, int) or isinstance(stated, bool) or not 1 <= stated <= version:
        problem = f"version {repr(stated)[:20]} is not between 1 and {version}"
        raise UserError(problem, file=file, hint="update thermogrip or write the file anew")


def _sync_file(path: Path, mode: int) -> None:
    """Set a file's permissions and force it to disk."""
    handle = os.open(path, os.O_RDWR | _NO_LINK)  # Windows syncs only what is writable
    try:
        if hasattr(os, "fchmod"):
            os.fchmod(handle, mode)
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync_folder(path: Path) -> None:
    """Force a folder's names to disk; Windows cannot open one, and need not."""
    if os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _mode_of(target: Path) -> int:
    """Return the permissions of the file that is replaced, else what the umask leaves (not 0600)."""
    with suppress(OSError):
        mode = os.lstat(target).st_mode
        if stat.S_ISREG(mode):  # a link is replaced, and where it leads to is not asked
            return mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
