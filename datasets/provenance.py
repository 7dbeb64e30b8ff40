"""Where a result comes from: version, date, command, seed, and the SHA-256 of what was read.

Every JSON file has it under the key ``provenance``, every page in its foot.  Two runs of one command with one
seed differ in this alone; ``SOURCE_DATE_EPOCH`` sets the date.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thermogrip.datasets.errors import UserError, os_faults

KEY = "provenance"
_ROOMS = tuple(
    str(Path(__file__).resolve().parent.parent / room) + os.sep
    for room in ("datasets", "sysid", "mpc", "rig", "classify")
)  # what they bring belongs to the version
_EPOCH = re.compile("[0-9]{1,11}")


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
    if (epoch := os.environ.get("SOURCE_DATE_EPOCH", "")) and not _EPOCH.fullmatch(epoch):
        # numpy and matplotlib read it too, and raise
        raise UserError(f"SOURCE_DATE_EPOCH is {epoch!r}", hint="set it to seconds since 1970, or unset it")
    token = _WORK.set(_Work(words))
    try:
        yield
    finally:
        _WORK.reset(token)


def note_seed(seed: int | None) -> None:
    """Report the seed of the command."""
    if now := _WORK.get():
        now.seed = seed


def note_read(path: str | Path) -> None:
    """Report a file that is read; those of the package itself and those that the command wrote do not
    count."""
    now, name = _WORK.get(), os.path.abspath(path)
    if now and name not in now.written and not os.path.realpath(name).startswith(_ROOMS):
        now.read.setdefault(name, "")


def note_written(path: str | Path) -> None:
    """Report a file that was written."""
    if now := _WORK.get():
        now.written.add(os.path.abspath(path))


def provenance() -> dict[str, Any]:
    """Return the provenance of what is being written, as plain JSON."""
    from thermogrip import __version__

    now = _WORK.get() or _Work([Path(sys.argv[0]).name, *sys.argv[1:]])
    # https://reproducible-builds.org/specs/source-date-epoch/
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    seconds = int(epoch) if _EPOCH.fullmatch(epoch) else None
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
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds)),
        "command": shlex.join(now.words),
        "seed": now.seed,
        "inputs": {name.removeprefix(below): digest for name, digest in now.read.items()},
    }


def hash_file(path: str | Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits."""
    with os_faults(path), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
