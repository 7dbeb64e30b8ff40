"""Whole files or none: atomic writing, and JSON that says what it is.

Ctrl-C, a full disk or ``kill -9`` leave the old file in place.  Every JSON file of the toolkit has the keys
``schema``, ``version`` (an integer) and ``provenance`` (:mod:`thermogrip.datasets.provenance`); reading it
runs no code.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from thermogrip.datasets.errors import UserError, as_user_error, os_faults
from thermogrip.datasets.limits import check_content, check_size, check_source, most_bytes, read_within
from thermogrip.datasets.provenance import KEY, note_written, provenance

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


def read_bytes(path: str | Path, *, share: int = 1) -> bytes:
    """Return the bytes of a file, at most one ``share``-th of what any file may hold."""
    # a null byte in the name is a ValueError
    with as_user_error(ValueError, "{error}", file=repr(str(path)), hint="check the path"), os_faults(path):
        check_size(check_source(path), file=path, share=share)
        with open(path, "rb") as stream:
            data = read_within(stream, most_bytes(share))
    check_size(len(data), file=path, share=share)  # a pipe says no size, and a file may grow
    return data


def write_json(path: str | Path, content: Mapping[str, Any], *, schema: str, version: int) -> Path:
    """Write a JSON object of finite numbers with ``schema``, ``version`` and provenance, return the path."""
    whole = {"schema": schema, "version": version} | dict(content) | {KEY: provenance()}
    return write_atomic(path, json.dumps(whole, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def read_toml(path: str | Path, *, hint: str) -> dict[str, Any]:
    """Return the content of a TOML file; ``hint`` says where a good one comes from."""
    raw = read_bytes(path, share=_TOML_SHARE)
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
    raw = read_bytes(path, share=JSON_SHARE)
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
    if not isinstance(content, dict) or content.get("schema") != schema:
        stated = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise UserError(
            f"schema is {stated!r}, not {schema!r}", file=file, hint="give the file of that stage"
        )
    stated = content.get("version")
    if not isinstance(stated, int) or isinstance(stated, bool) or not 1 <= stated <= version:
        problem = f"version {repr(stated)[:20]} is not between 1 and {version}"
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
