"""The run folder: a session sample by sample, readable after a crash.

Its files, and which folders are refused, are described in ``docs/reference/files.md``.
Lines of text are the one format that a killed process leaves whole; everything else is exported from it
later. Each line is one ``write``, so that ``kill -9`` loses none, and the files are forced to disk once a
second, so that a power cut loses at most the last one.

**A full disk.**  A part of a line that still fitted is cut off again.  The folder keeps ``RESERVE`` bytes in
a file of their own from the start; they are given back then, so that the line at hand, the reason and the
verdict still find room.  The caller gets the ``OSError``, and the loop switches off.  What was on
disk stays.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any

from thermogrip.datasets.atomic_files import file_hash, open_new, write_atomic, write_json
from thermogrip.datasets.errors import UserError, os_faults
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.datasets.media import csv_text
from thermogrip.rig.interface import Event
from thermogrip.rig.session.session import Session
from thermogrip.rig.session.signals import hold_signals

SCHEMA, VERSION = "thermogrip.run", 1
RESERVE = 1 << 18  # bytes, for the last words of a run on a full disk
FILES = ("run.json", "samples.csv", "events.jsonl", "grasps.csv", "grasps_meta.csv")
_RESERVE, _SUMS = ".reserve", "SHA256SUMS"
NAMES = (*FILES, _RESERVE, _SUMS)  # of everything that a run may leave
_PACKAGES = ("thermogrip", "numpy", "scipy", "xarray", "casadi", "daqp", "pyserial")


class RunFolder:
    """Write a session as it happens; a context manager.

    Parameters
    ----------
    path : str or Path
        The folder; made if absent, refused if it is a symbolic link, or holds one, a run, or a file of a
        run's names.
    about : dict, optional
        What is run: controller, plant, target, seed (JSON-able).
    files : mapping of str to Path, optional
        Files that the run depends on (controller, plant); their hashes go into ``run.json``.
    clock : callable, optional
        Tells when a second is over and the files are forced to disk [s].

    Raises
    ------
    UserError
        If the folder holds a run or a link, or cannot be made.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> with RunFolder(Path(mkdtemp()) / "run") as run:
    ...     run.sample({"time_s": 0.0, "t_surface_degC": 25.0625})
    >>> print((run.path / "samples.csv").read_text(), end="")
    time_s,t_surface_degC
    0,25.0625
    """

    def __init__(
        self,
        path: str | Path,
        about: Mapping[str, Any] | None = None,
        *,
        files: Mapping[str, Path] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path, self.about = Path(path), dict(about or {})
        if self.path.is_symlink():
            raise UserError("is a link", file=self.path, hint="name the folder that it leads to")
        self._made = provenance(files or {})
        # a run that cannot begin leaves no file behind
        with ExitStack() as undo, os_faults(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            refuse_used(self.path)
            self._reserve = _Reserve(self.path / _RESERVE)
            undo.callback(self._reserve.give_back)
            self._write_about({"verdict": "running"})
            undo.callback((self.path / "run.json").unlink)
            self._samples = _Lines(self.path / "samples.csv", self._reserve)
            undo.callback(self._samples.remove)
            self._events = _Lines(self.path / "events.jsonl", self._reserve)
            undo.pop_all()
        self._header: tuple[str, ...] = ()
        self._clock, self._synced = clock, clock()
        self._closed = False

    def sample(self, row: Mapping[str, float]) -> None:
        """Write one row; the first one sets the columns, and others are a ValueError.

        OSError where the disk is full or gone; the row is on disk if the reserve had room for it.
        """
        if not self._header:
            self._header = tuple(row)
            self._samples.write(csv_text([self._header]).rstrip("\n"))
        if tuple(row) != self._header:
            raise ValueError(f"columns changed from {self._header} to {tuple(row)}")
        self._samples.write(",".join(_number(value) for value in row.values()))
        if self._clock() - self._synced >= 1.0:
            self.sync()

    def event(self, event: Event) -> None:
        """Write one event and force it to disk, for events are few and give the reasons; OSError as above."""
        line: dict[str, Any] = {"time_s": event.time_s, "kind": event.kind, "text": event.text}
        if event.data:
            line["data"] = dict(event.data)
        self._events.write(json.dumps(line, ensure_ascii=False))
        self.sync()

    def sync(self) -> None:
        """Force what was written to disk."""
        self._synced = self._clock()
        self._samples.sync()
        self._events.sync()

    def finish(self, session: Session) -> None:
        """Write the verdict, and the grasp where there is one; call it before :meth:`close`."""
        self._reserve.give_back()
        if session.grasps is not None:
            write_grasps(session.grasps, self.path / "grasps.csv")
        figures = {
            "settle_time": session.settle_time, "overshoot": session.overshoot, "bias": session.bias,
            "contact_s": session.contact,
        }  # fmt: skip
        finite = {key: value if value == value else None for key, value in figures.items()}  # JSON has no NaN
        trip = {} if session.trip is None else {"trip": session.trip.as_dict()}
        self._write_about({"verdict": session.verdict, "advice": session.advice, **finite, **trip})

    def played(self, ended: str) -> None:
        """Write that a schedule was played, or what ended it; call it before :meth:`close`."""
        self._reserve.give_back()
        self._write_about({"verdict": "tripped" if ended else "played", "advice": ended})

    def close(self) -> None:
        """Close the files and write their sums, which no signal interrupts; may be called twice."""
        if self._closed:
            return
        with hold_signals():
            self._closed = True
            self._reserve.give_back()
            with suppress(OSError):  # a disk that is gone cannot be forced
                self.sync()
            self._samples.close()
            self._events.close()
            with suppress(UserError):  # no room for the sums: what is there is whole without them
                write_sums(self.path)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with hold_signals():
            if kind is not None and not self._closed:
                ended = "interrupted" if issubclass(kind, KeyboardInterrupt) else "failed"
                self._reserve.give_back()
                with suppress(UserError):  # what ends it is more important than what can be written of it
                    self._write_about({"verdict": ended, "advice": f"{kind.__name__}: {error}"})
            self.close()

    def _write_about(self, result: Mapping[str, Any]) -> None:
        content = {"about": self.about, **self._made, **result}
        write_json(self.path / "run.json", content, schema=SCHEMA, version=VERSION)


def provenance(files: Mapping[str, Path]) -> dict[str, Any]:
    """Return the provenance of a run: versions, git commit, hashes of its files, command, when it began."""
    found = {}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return {
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": {"python": platform.python_version(), **found},
        "git": _commit(Path(__file__).resolve().parent),
        "command": sys.argv[:],
        "files": {name: {"path": str(path), "sha256": file_hash(path)} for name, path in files.items()},
    }


def write_sums(folder: Path) -> Path:
    """Write ``SHA256SUMS`` of a run folder (``sha256sum -c`` reads it) and return its path."""
    lines = [f"{file_hash(folder / name)}  {name}\n" for name in FILES if (folder / name).exists()]
    return write_atomic(folder / _SUMS, "".join(lines))


def refuse_links(folder: Path) -> None:
    """Raise UserError where a folder holds a symbolic link: what is written would land somewhere else."""
    link = min((entry.name for entry in os.scandir(folder) if entry.is_symlink()), default="")
    if link:
        raise UserError(f"{link} is a link", file=folder, hint="put the file in its place, or remove it")


def refuse_used(folder: Path) -> None:
    """Raise UserError where a folder holds a run, a file of a run's names, or a link."""
    refuse_links(folder)
    if (folder / "run.json").exists():
        raise UserError("holds a run already", file=folder, hint="choose another folder")
    there = next((name for name in NAMES if (folder / name).exists()), "")
    if there:
        problem = f"holds a {there} that would be overwritten"
        raise UserError(problem, file=folder, hint="choose another folder")


class _Lines:
    """A file to which whole lines are appended, or nothing."""

    def __init__(self, path: Path, reserve: _Reserve) -> None:
        self._path, self._reserve = path, reserve
        self._file = open_new(path)
        self._size = 0

    def write(self, line: str) -> None:
        data = line.encode() + b"\n"
        try:
            self._append(data)
        except OSError as first:
            self._cut()
            if not self._reserve.give_back():
                raise
            try:
                self._append(data)
            except OSError:
                self._cut()
                raise
            raise first  # the line is on disk, and the caller knows that it was the last but a few

    def _append(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            left = left[_write(self._file, left) :]
        self._size += len(data)

    def _cut(self) -> None:
        with suppress(OSError):  # the reader drops half a line, too
            os.ftruncate(self._file, self._size)
            os.lseek(self._file, self._size, os.SEEK_SET)

    def sync(self) -> None:
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)
        self._file = -1  # a later write is an OSError, never into another file of that number

    def remove(self) -> None:
        self.close()
        self._path.unlink()


class _Reserve:
    """Disk space that is kept so that it can be given back."""

    def __init__(self, path: Path) -> None:
        self._path = path
        file = open_new(path)
        try:
            with open(file, "wb") as reserve:
                reserve.write(os.urandom(RESERVE))  # not zeros, which some disks store as nothing
        except OSError:
            self.give_back()
            raise

    def give_back(self) -> bool:
        """Free the space; say whether there was some."""
        try:
            self._path.unlink()
        except OSError:
            return False
        return True


def _write(file: int, data: memoryview) -> int:
    """Write to a file descriptor: the one place where a test can fill the disk."""
    return os.write(file, data)


def _commit(folder: Path) -> str:
    """Return the commit that is checked out, "" where this is no checkout; no program is started for it."""
    for parent in folder.parents:
        head = parent / ".git" / "HEAD"
        if head.is_file():
            text = head.read_text(encoding="utf-8").strip()
            if not text.startswith("ref: "):
                return text
            name = text.removeprefix("ref: ")
            if (parent / ".git" / name).is_file():
                return (parent / ".git" / name).read_text(encoding="utf-8").strip()
            packed = parent / ".git" / "packed-refs"
            lines = packed.read_text(encoding="utf-8").splitlines() if packed.is_file() else []
            return next((line.split()[0] for line in lines if line.endswith(f" {name}")), "")
    return ""


def _number(value: float) -> str:
    """Return a number as the CSV has it; an empty cell where it is lost."""
    return f"{value:.9g}" if value == value else ""
