"""The run folder: a session sample by sample, read back, repaired after a crash, and exported.

Its files, and which folders are refused, are described in ``docs/reference/files.md``.

Lines of text are the one format that a killed process leaves whole; everything else is exported from it
later.  A session waits for no disk.  A line counts if it is whole: ended, of the header's width, every cell a
number or empty; a bad one with whole ones after it is damage, skipped and reported.
"""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from itertools import count
from math import isfinite
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from thermogrip.datasets.errors import UserError, os_faults
from thermogrip.datasets.files import (
    hash_file,
    make_folder,
    note_written,
    parse_json,
    read_bytes,
    read_json,
    write_atomic,
    write_json,
)
from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.log_files import write_log
from thermogrip.datasets.schema import Grasps, Log
from thermogrip.media.rendering import csv_text, from_csv
from thermogrip.rig.guard.sensor_checks import room_sensors
from thermogrip.rig.interface import Event
from thermogrip.rig.records.mcap_export import write_mcap
from thermogrip.rig.session.loop import log_of_rows
from thermogrip.rig.session.session import Session
from thermogrip.rig.session.signals import hold_signals

SCHEMA, VERSION = "thermogrip.run", 1
MOST_WAITING = 6000  # lines for a disk that hangs: ten minutes of the fastest rows (of a grasp, 10 a second)
# for which a row holds up its caller: less than half of the shortest sample (0.05 s), more than Python needs
# to change threads (5 ms), so that a disk that is well has the row when the call returns
_AT_ONCE_S = 0.02
FILES = ("run.json", "samples.csv", "events.jsonl", "grasps.csv", "grasps_meta.csv")
_GRASPS = ("grasps.csv", "grasps_meta.csv")
_SUMS = "SHA256SUMS"
NAMES = (*FILES, _SUMS)  # of everything that a run may leave


class RunFolder:
    """Write a session as it happens; a context manager.

    The folder is made if absent, refused if it is a symbolic link, or holds one, a run, or a file of a run's
    names. ``about`` is what is run (JSON-able); which files were read is in the provenance of ``run.json``.
    """

    def __init__(
        self,
        path: str | Path,
        about: Mapping[str, Any] | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path, self.about = Path(path), dict(about or {})
        if self.path.is_symlink():
            raise UserError("is a link", file=self.path, hint="name the folder that it leads to")
        began = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        self._made = {"began": began}
        # a run that cannot begin leaves no file behind
        with ExitStack() as undo, os_faults(self.path):
            make_folder(self.path)
            refuse_used(self.path)
            self._samples = _Lines(self.path / "samples.csv")
            undo.callback(self._samples.remove)
            self._events = _Lines(self.path / "events.jsonl")
            undo.callback(self._events.remove)
            self._write_about({"verdict": "running"})  # at last, for it forces the names of all to disk
            undo.pop_all()
        self._header: tuple[str, ...] = ()
        self._disk = _Disk(self._samples, self._events)
        self._clock, self._forced = clock, clock()
        self._closed = False

    def sample(self, row: Mapping[str, float]) -> None:
        """Take one row; the first one sets the columns, and others are a ValueError.  OSError where the disk
        is full or gone, or was at an earlier line."""
        if not self._header:
            self._header = tuple(row)
            self._write(self._samples, csv_text([self._header]).encode())
        if tuple(row) != self._header:
            raise ValueError(f"columns changed from {self._header} to {tuple(row)}")
        # an empty cell where a reading is lost
        line = ",".join(f"{value:.9g}" if value == value else "" for value in row.values())
        due = self._clock() - self._forced >= 1.0
        self._write(self._samples, line.encode() + b"\n", force=due)
        self._disk.check(_AT_ONCE_S)

    def event(self, event: Event) -> None:
        """Take one event, which is forced to disk, for events are few and give the reasons; a disk that
        refuses it is reported by the next row."""
        self._write(self._events, event_line(event), force=True)

    def _write(self, file: _Lines, line: bytes, *, force: bool = False) -> None:
        if self._closed:
            raise OSError(errno.EBADF, "the run folder is closed")
        if force:
            self._forced = self._clock()
        self._disk.write(file, line, force=force)

    def sync(self) -> None:
        """Wait until everything is written and forced to disk; OSError where the disk refuses."""
        self._disk.drain()

    def finish(self, session: Session) -> None:
        """Write the verdict, and the grasp where there is one; call it before :meth:`close`."""
        if session.grasps is not None:
            write_grasps(session.grasps, self.path / "grasps.csv")
        figures = {
            "settle_time": session.settle_time,
            "overshoot": session.overshoot,
            "bias": session.bias,
            "contact_s": session.contact,
        }
        finite = {key: value if value == value else None for key, value in figures.items()}  # JSON has no NaN
        trip = {} if session.trip is None else {"trip": asdict(session.trip)}
        self._end({"verdict": session.verdict, "advice": session.advice, **finite, **trip})

    def played(self, ended: str) -> None:
        """Write that a schedule was played, or what ended it; call it before :meth:`close`."""
        self._end({"verdict": "tripped" if ended else "played", "advice": ended})

    def _end(self, result: Mapping[str, Any]) -> None:
        """Wait for the disk and write the result; UserError where it refuses, if no row has said so."""
        already_reported = (UserError,) if self._disk.refused else ()
        with suppress(*already_reported), os_faults(self.path):
            self.sync()
        with suppress(*already_reported):
            self._write_about(result)

    def close(self) -> None:
        """Close the files and write their sums, which no signal interrupts; may be called twice."""
        if self._closed:
            return
        with hold_signals():
            self._closed = True
            with suppress(OSError):  # a disk that is gone cannot be forced
                self.sync()
            self._disk.close()
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
                with suppress(UserError):  # what ends it is more important than what can be written of it
                    self._write_about({"verdict": ended, "advice": f"{kind.__name__}: {error}"})
            self.close()

    def _write_about(self, result: Mapping[str, Any]) -> None:
        content = {"about": self.about, **self._made, **result}
        write_json(self.path / "run.json", content, schema=SCHEMA, version=VERSION)


def write_sums(folder: Path) -> Path:
    """Write ``SHA256SUMS`` of a run folder (``sha256sum -c`` reads it) and return its path."""
    lines = [f"{hash_file(folder / name)}  {name}\n" for name in FILES if (folder / name).exists()]
    return write_atomic(folder / _SUMS, "".join(lines))


def refuse_links(folder: Path) -> None:
    """Raise UserError where a folder holds a symbolic link: what is written would land somewhere else."""
    link = min((entry.name for entry in os.scandir(folder) if entry.is_symlink()), default="")
    if link:
        raise UserError(f"{link} is a link", file=folder, hint="put the file in its place, or remove it")


def refuse_used(folder: Path) -> None:
    """Raise UserError where a folder holds a run, a file of a run's names, or a link."""
    refuse_links(folder)
    used = next((name for name in NAMES if (folder / name).exists()), "")
    if used:
        problem = "holds a run already" if used == FILES[0] else f"holds a {used} that would be overwritten"
        raise UserError(problem, file=folder, hint="choose another folder")


def event_line(event: Event) -> bytes:
    """Return an event as a line of ``events.jsonl``; what is no character (a lone surrogate) is ``?``."""
    content = {key: value for key, value in vars(event).items() if key != "data" or value}
    return json.dumps(content, ensure_ascii=False).encode("utf-8", "replace") + b"\n"


class _Disk:
    """Two threads that wait for the disk: one that takes seconds to force lines takes others meanwhile."""

    # one writes the lines, each at once and in one ``write``, the other forces them to disk, once a second
    # and after each event; the caller gets an OSError at that row or the next, and the loop switches off

    def __init__(self, *files: _Lines) -> None:
        self._files = files
        self._writer = ThreadPoolExecutor(1, "run-folder-write")
        self._forcer = ThreadPoolExecutor(1, "run-folder-force")
        self._waiting: deque[Future[None]] = deque()  # lines that are not written yet
        self._force_asked = False
        self._fault: OSError | None = None
        self.refused = False  # whether a fault was reported to a caller

    def write(self, file: _Lines, line: bytes, *, force: bool) -> None:
        """Hand over a line."""
        while self._waiting and self._waiting[0].done():
            self._waiting.popleft()
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append(self._writer.submit(self._write, file, line, force))
        else:
            self._fault = OSError(errno.ETIMEDOUT, f"the disk has not taken the last {MOST_WAITING} lines")

    def check(self, wait_s: float | None = None) -> None:
        """Wait so long at most until every line is written; OSError where the disk has refused one."""
        self._wait(wait_s)
        fault, self._fault = self._fault, None
        if fault is not None:
            self.refused = True
            raise fault

    def drain(self) -> None:
        """Wait until every line is written and forced; OSError as above."""
        self._wait()
        self._forcer.submit(self._force).result()
        self.check()

    def close(self) -> None:
        """Wait for both threads and close the files."""
        self._writer.shutdown()
        self._forcer.shutdown()
        for file in self._files:
            file.close()

    def _wait(self, seconds: float | None = None) -> None:
        if self._waiting:
            wait([self._waiting[-1]], seconds)  # they are written in their order

    def _write(self, file: _Lines, line: bytes, force: bool) -> None:
        try:
            file.write(line)
        except OSError as error:
            self._fault = error
        if force and not self._force_asked:
            self._force_asked = True
            self._forcer.submit(self._force)

    def _force(self) -> None:
        self._force_asked = False  # a line that is written from now on asks anew
        try:
            for file in self._files:
                file.sync()
        except OSError as error:
            self._fault = error


class _Lines:
    """A file to which whole lines are appended, or nothing."""

    def __init__(self, path: Path) -> None:
        self._path = path
        in_bytes = getattr(os, "O_BINARY", 0)  # else Windows writes line ends of two bytes
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | in_bytes, 0o666)
        note_written(path)
        self._size = 0

    def write(self, line: bytes) -> None:
        unwritten = memoryview(line)
        try:
            while unwritten:
                unwritten = unwritten[_write_bytes(self._file, unwritten) :]
        except OSError:
            with suppress(OSError):  # a part of it may have fitted on a full disk; the reader drops it, too
                os.ftruncate(self._file, self._size)
                os.lseek(self._file, self._size, os.SEEK_SET)
            raise
        self._size += len(line)

    def sync(self) -> None:
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)

    def remove(self) -> None:
        self.close()
        self._path.unlink()


def _write_bytes(file: int, data: memoryview) -> int:
    """Write to a file descriptor: the one place where a test can fill the disk."""
    return os.write(file, data)


_CSV_NUMBER = re.compile(rb"-?(?:\d+(?:\.\d+)?(?:e[+-]?\d+)?|inf)")


@dataclass(frozen=True)
class Run:
    """The contents of a run folder."""

    about: dict[str, Any]  # ``run.json``
    log: Log | None  # every whole row; None where there are fewer than two
    events: tuple[Event, ...]
    grasps: Grasps | None  # as the run wrote them; None where it was ended before
    lost: tuple[str, ...]  # what of the files could not be read, a line each

    @property
    def bad(self) -> str:
        """Why the operator marked the trial bad, "" where nobody did."""
        return next((e.text or "bad" for e in reversed(self.events) if e.kind == "bad"), "")


@dataclass(frozen=True)
class Recovery:
    """What :func:`recover` did."""

    changed: bool  # false where the folder was whole
    findings: tuple[str, ...]  # a line each
    run: Run


@dataclass(frozen=True)
class _Whole:
    """The whole lines of a file, and what was lost, a line each."""

    lines: list[bytes]
    lost: tuple[str, ...]


def read_run(folder: str | Path) -> Run:
    """Return the contents of a run folder; the run may have been killed, or go on.

    Parameters
    ----------
    folder : str or Path
        That a :class:`~thermogrip.rig.records.run_folder.RunFolder` wrote.

    Raises
    ------
    UserError
        If it is no run folder.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> with RunFolder(Path(mkdtemp()) / "run") as run:
    ...     for k in range(3):
    ...         run.sample({"time_s": k, "t_surface_degC": 25 + k / 2})
    >>> read_run(run.path).log["t_surface"].values
    array([25. , 25.5, 26. ])
    """
    path = Path(folder)
    if not (path / "samples.csv").is_file() and not (path / "run.json").is_file():
        raise UserError("is no run folder", file=path, hint="give the folder of --out")
    about: dict[str, Any] = {"about": {}, "verdict": "running"}  # where it is lost
    if (path / "run.json").is_file():
        about = read_json(path / "run.json", SCHEMA, VERSION)
    header, rows, samples = _read_samples(path / "samples.csv")
    events, whole = _events(path / "events.jsonl")
    lost = samples.lost + whole.lost
    rooms = _rooms(header, events)
    log = log_of_rows(rows, rooms, name=path.name, repairs=samples.lost) if len(rows) > 1 else None
    grasps = None
    if all((path / name).is_file() for name in _GRASPS):
        try:
            grasps = read_grasps(path / "grasps.csv")
        except UserError as error:
            lost = (*lost, f"{Path(error.file or _GRASPS[0]).name}: {error.problem}")
    return Run(about, log, events, grasps, lost)


def recover(folder: str | Path) -> Recovery:
    """Return what was done to bring the folder of a run that was cut off into the state of a clean end."""
    path = Path(folder)
    changed = sums_agree(path)
    if changed == []:
        return Recovery(False, ("every file is as the run left it",), read_run(path))
    if changed:
        hint = "restore that file, or remove SHA256SUMS to take it as it is"
        raise UserError(f"was changed after the run ended ({', '.join(changed)})", file=path, hint=hint)
    run = read_run(path)
    refuse_links(path)
    findings = list(run.lost)
    samples, events = path / "samples.csv", path / "events.jsonl"
    for name, whole in ((samples.name, _read_samples(samples).whole), (events.name, _events(events)[1])):
        if whole.lost:
            copies = (f"{name}.damaged" + ("" if k == 1 else f"-{k}") for k in count(1))
            damaged_name = next(copy for copy in copies if not (path / copy).exists())
            write_atomic(path / damaged_name, read_bytes(path / name))
            findings.append(f"{name} as it was found is kept as {damaged_name}")
            write_atomic(path / name, b"".join(line + b"\n" for line in whole.lines))
    verdict = run.about.get("verdict", "running")
    if verdict == "running":
        findings.append("the run did not end by itself: its verdict is now interrupted")
        content = {key: value for key, value in run.about.items() if key not in ("schema", "version")}
        write_json(path / "run.json", {**content, "verdict": "interrupted"}, schema=SCHEMA, version=VERSION)
    (path / ".reserve").unlink(missing_ok=True)  # which version 0.2.0 kept
    write_sums(path)
    rows = 0 if run.log is None else run.log.sizes["time"]
    findings.append(f"{rows} rows and {len(run.events)} events are whole")
    return Recovery(True, tuple(findings), read_run(path))


def mark_bad(folder: str | Path, why: str) -> None:
    """Mark a trial bad: an event is added, nothing is removed, and collections of grasps leave it out."""
    path = Path(folder)
    run = read_run(path)
    refuse_links(path)
    last_s = 0.0 if run.log is None else float(run.log["time"].values[-1])
    before = b"".join(one + b"\n" for one in _events(path / "events.jsonl")[1].lines)
    write_atomic(path / "events.jsonl", before + event_line(Event(last_s, "bad", why)))
    if (path / "SHA256SUMS").is_file():
        write_sums(path)


def export_run(folder: str | Path, out: str | Path) -> Path:
    """Write the log of a run folder as ``.nc``, ``.parquet``, ``.csv`` or ``.mcap`` and return the path."""
    run, path = read_run(folder), Path(out)
    if run.log is None:
        raise UserError("has fewer than two rows", file=folder, hint="give a run that recorded something")
    if path.suffix.lower() != ".mcap":
        return write_log(run.log, path)
    write_mcap(path, run.log, run.events, run.about)
    return path


def sums_agree(folder: Path) -> list[str] | None:
    """Return the files that do not agree with SHA256SUMS; None where there are no sums."""
    sums = folder / "SHA256SUMS"
    if not sums.is_file():
        return None
    wrong = []
    for line in read_bytes(sums).decode("utf-8", "replace").splitlines():
        digest, _, name = line.partition("  ")
        if name not in FILES:  # no path of somebody else's making is opened
            wrong.append(name[:80] or "SHA256SUMS")
        elif not (folder / name).is_file() or hash_file(folder / name) != digest:
            wrong.append(name)
    return wrong


def _whole_lines(path: Path, good: Any) -> _Whole:
    """Return the lines that are whole; the first line without an end is never."""
    if not path.is_file():
        return _Whole([], ())
    data = read_bytes(path)
    body, _, unended = data.rpartition(b"\n")
    lines = body.split(b"\n") if body or data.startswith(b"\n") else []
    flags = [good(number, line) for number, line in enumerate(lines)]
    last = max((number for number, ok in enumerate(flags) if ok), default=-1)
    lost = [
        f"{path.name}, line {number + 1}: is damaged ({len(lines[number])} bytes); left out"
        for number in range(last)
        if not flags[number]
    ]
    # half a line, or the zeros that a file system may leave after a power cut
    tail = sum(len(line) + 1 for line in lines[last + 1 :]) + len(unended)
    if tail:
        lost.append(f"{path.name}: the last {tail} bytes are no whole line (cut off while it was written)")
    return _Whole([line for line, ok in zip(lines, flags) if ok], tuple(lost))


class _Samples(NamedTuple):
    """What a file of samples holds."""

    header: list[str]
    rows: list[dict[str, float]]
    whole: _Whole


def _read_samples(path: Path) -> _Samples:
    width = 0

    def good(at: int, line: bytes) -> bool:
        nonlocal width
        cells = line.split(b",")
        if at == 0:
            width = len(_header_names(line))
            return line.startswith(b"time_s") and b"\0" not in line
        return (
            len(cells) == width and all(not c or _CSV_NUMBER.fullmatch(c) for c in cells) and bool(cells[0])
        )

    whole = _whole_lines(path, good)
    if not whole.lines or not whole.lines[0].startswith(b"time_s"):
        return _Samples([], [], whole)
    header = _header_names(whole.lines[0])
    rows = [
        dict(zip(header, (float(cell) if cell else float("nan") for cell in line.split(b","))))
        for line in whole.lines[1:]
    ]
    return _Samples(header, rows, whole)


def _header_names(line: bytes) -> list[str]:
    try:
        return [from_csv(cell) for cell in next(csv.reader([line.decode("utf-8", "replace")]), [])]
    except csv.Error:
        return []


def _events(path: Path) -> tuple[tuple[Event, ...], _Whole]:
    whole_events: list[Event] = []

    def good(at: int, line: bytes) -> bool:
        try:
            one = parse_json(line.decode())
            time_s, data = float(one["time_s"]), dict(one.get("data", {}))
            if not isfinite(time_s):
                return False
            whole_events.append(Event(time_s, str(one["kind"]), str(one["text"]), data))
        except Exception:  # whatever a damaged line makes it stumble over
            return False
        return True

    whole = _whole_lines(path, good)
    return tuple(whole_events), whole


def _rooms(header: list[str], events: tuple[Event, ...]) -> frozenset[str]:
    """Return the room's sensors as the session recorded them, by name for a run of an older version."""
    readings = {h.removesuffix("_degC") for h in header if h.endswith("_degC")}
    recorded = next((e.data["rooms"] for e in events if e.kind == "phase" and "rooms" in e.data), None)
    return (
        frozenset(readings.intersection(map(str, recorded)))
        if isinstance(recorded, list)
        else room_sensors(readings)
    )
