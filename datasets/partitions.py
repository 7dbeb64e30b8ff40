"""Answers to more grasps than fit in memory, part by part, so that an ended run goes on where it stopped.

Files are read one at a time, and one of many single touches is answered in parts of :data:`PART` grasps, each
as a file of its own.  What was answered is kept beside the output in ``NAME.partial``, a line of JSON a part,
forced to disk before the next part begins (with several workers, before that of a later file).  Ctrl-C,
``kill -9`` and a full disk leave whole lines and at most the beginning of one.  The same command takes those
of its lines that are of its files as they are (name, size, time of writing) and answers what is missing: as a
part's answer depends on nothing but the part, the end is the same bytes.  Lines to another command stay until
this one is done, behind a line with the question of theirs.  Memory holds one file and one part, and where
the lines of the others begin.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thermogrip import __version__
from thermogrip.datasets.atomic_files import atomic_path, open_append
from thermogrip.datasets.errors import UserError, as_user_error, os_faults
from thermogrip.datasets.file_names import matching_files
from thermogrip.datasets.grasp_files import (
    distinct_names,
    grasp_file_parts,
    list_grasp_files,
    read_grasps,
)
from thermogrip.datasets.media import csv_text
from thermogrip.datasets.parallel import Progress, Workers, in_order
from thermogrip.datasets.schema import label_values, log_name

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

#: Single touches of one file that are answered at once.
PART = 500


class Source(NamedTuple):
    """A file of grasps: its name, size [byte] and what shows that it is as it was, and how it is read."""

    name: str
    size: int
    stamp: list[Any]
    read: Callable[[], Grasps]


def sources(paths: Sequence[str | Path], *, plain: bool = False) -> list[Source]:
    """Return the files of grasps in paths and folders, unread; ``plain`` as of
    :func:`~thermogrip.datasets.grasp_files.read_grasps`."""
    found = []
    files = list_grasp_files(paths)
    for path, name in zip(files, distinct_names(files)):
        marks = stamps(grasp_file_parts(path))
        size = sum(mark[1] for mark in marks)
        read = partial(read_grasps, path.absolute(), plain=plain, name=name)
        found.append(Source(path.name, size, marks, read))
    return found


def check_apart(out: str | Path, paths: Sequence[str | Path]) -> None:
    """Refuse an output that is among the files that are read, or would be the next time."""
    place, hint = Path(os.path.realpath(out)), "choose another name or folder for --out"
    for given in paths:
        if place.match(os.path.realpath(given)) and not os.path.isdir(given):
            raise UserError("is to be read and written", file=out, hint=hint)
        for path in map(Path, matching_files(given)):
            if path.is_dir():
                folder = path.resolve()
                if place.parent == folder:
                    raise UserError("is in a folder that is read", file=out, hint=hint)
            elif place in [part.resolve() for part in grasp_file_parts(path)]:
                raise UserError("is to be read and written", file=out, hint=hint)


def stamps(paths: Sequence[str | Path]) -> list[Any]:
    """Return name, size and time of writing of files, those in folders too."""
    found: list[Any] = []
    for path in map(Path, paths):
        with os_faults(path):
            if path.is_dir():
                found += stamps(sorted(path.iterdir()))
            else:
                about = path.stat()
                found.append([str(path), about.st_size, about.st_mtime_ns])
    return found


def parts_of(record: Grasps) -> list[Grasps]:
    """Return the parts of a record that are answered at once: it itself where touches hang together."""
    n = record.sizes["grasp"]
    if n <= PART or (label_values(record, "touch_group") != "").any():
        return [record]
    return [record.isel(grasp=at) for at in np.array_split(np.arange(n), -(-n // PART))]


class Task(NamedTuple):
    """A file that is answered from one of its parts on, by itself and wherever it can be read."""

    source: Source
    first: int
    prepare: Callable[[Grasps], Grasps]
    answer: Callable[[Grasps], dict[str, Any]]

    def lines(self) -> Iterator[dict[str, Any]]:
        """Yield the answers of its parts."""
        parts = parts_of(self.prepare(self.source.read()))
        for k, grasps in islice(enumerate(parts), self.first, None):
            own = {"of": self.source.stamp, "part": k, "parts": len(parts), "grasps": grasps.sizes["grasp"]}
            yield own | {"name": log_name(grasps)} | self.answer(grasps)


def _whole(task: Task) -> list[dict[str, Any]]:
    return list(task.lines())


class Answers:
    """The answers of the parts, in order, as often as they are iterated over; on disk until removed.

    ``answer`` returns of a part what JSON holds, with ``warnings`` that are given to ``warn`` and not kept;
    ``prepare`` is called once a file that is read, and what it returns is divided into parts.  With several
    ``workers`` each answers a file at a time, which it reads itself.  ``question`` is all else that the
    answers depend on: those to another one are not gone on with.
    """

    def __init__(self, out: Path, question: Sequence[Any]) -> None:
        self.path = out.with_name(f"{out.name}.partial")
        head = {"partial": 1, "thermogrip": __version__, "question": list(question)}
        self._head: dict[str, Any] = json.loads(json.dumps(head, default=str))
        self.grasps = 0
        self._others = 0  # grasps of lines that are not used
        self._file = -1  # locked until it is closed
        self._end = 0  # of its last line
        self._places: list[list[int]] = []  # where the lines of each source begin

    def find(
        self,
        given: Sequence[Source],
        prepare: Callable[[Grasps], Grasps],
        answer: Callable[[Grasps], dict[str, Any]],
        progress: Progress,
        *,
        workers: Workers = 1,
        warn: Callable[[str], None] = lambda _: None,
    ) -> Answers:
        """Answer every part that has no answer yet; return the answers of all."""
        self._file = _locked(self.path)
        try:
            known = self._known()
        except BaseException:
            self.close()
            raise
        try:
            self._places = [[place for place, _ in known.get(_key(each), ())] for each in given]
            parts = [known[_key(each)][0][1]["parts"] if at else 1 for each, at in zip(given, self._places)]
            self.grasps = sum(line["grasps"] for each in given for _, line in known.get(_key(each), ()))
            self._others -= self.grasps
            if self._others:
                more = "are of files as they were, or to another command, and are not used"
                warn(f"{self.path}: {self._others} answers in it {more}")
            tasks = {
                k: Task(each, len(at), prepare, answer)
                for k, (each, at, n) in enumerate(zip(given, self._places, parts))
                if len(at) < n
            }
            whole = max(sum(each.size for each in given), 1)
            done = sum(each.size * len(at) / n for each, at, n in zip(given, self._places, parts))
            self._find(tasks, done / whole, whole, progress, workers, warn)
        except BaseException:
            if not self.grasps + self._others:
                self.remove()
            self.close()
            raise
        return self

    def _find(
        self, tasks: dict[int, Task], done: float, whole: int, progress: Progress, workers: Workers,
        warn: Callable[[str], None],
    ) -> None:  # fmt: skip
        begin, before = time.monotonic(), self.grasps
        progress(done, "grasps")  # with which share this run begins
        alone = workers == 1 or len(tasks) == 1
        todo = [*tasks.values()]
        answered = (task.lines() for task in todo) if alone else in_order(_whole, todo, workers)
        for (at, task), lines in zip(tasks.items(), answered):
            for line in lines:
                for words in line.pop("warnings", ()):
                    warn(words)
                self._places[at].append(self._append(line))
                self.grasps += line["grasps"]
                rate = (self.grasps - before) / max(time.monotonic() - begin, 1e-3)
                done += task.source.size / line["parts"] / whole
                progress(done, f"grasps: {self.grasps}, {rate:.3g}/s, {task.source.name}")

    def _known(self) -> dict[str, list[tuple[int, dict[str, Any]]]]:
        """Return the lines to this question of each file, and where they begin; what is torn is cut off."""
        found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
        ours = False
        for line, end in self._lines():
            if "partial" in line:
                ours = line == self._head
            elif not self._end:
                hint = "move it away, or choose another --out"
                raise UserError("is no file of kept answers", file=self.path, hint=hint)
            else:
                self._others += line["grasps"]
                lines = found.setdefault(json.dumps(line["of"]), []) if ours else []
                if line["part"] == len(lines):
                    lines.append((self._end, {name: line[name] for name in ("parts", "grasps")}))
            self._end = end
        os.ftruncate(self._file, self._end)
        if not ours:
            self._append(self._head)
        return found

    def _lines(self) -> Iterator[tuple[dict[str, Any], int]]:
        """Yield each whole line and where it ends."""
        end = 0
        with os_faults(self.path), open(self.path, "rb") as file:
            for raw in file:
                end += len(raw)
                try:
                    line = json.loads(raw) if raw.endswith(b"\n") else None
                except ValueError:
                    line = None
                if not isinstance(line, dict):
                    return
                yield line, end

    def __iter__(self) -> Iterator[dict[str, Any]]:
        with os_faults(self.path), open(self.path, "rb") as file:
            for place in chain.from_iterable(self._places):
                file.seek(place)
                yield json.loads(file.readline())

    def _append(self, line: dict[str, Any]) -> int:
        """Write one line and force it to disk; return where it begins."""
        rest = memoryview(json.dumps(line, default=_as_python).encode() + b"\n")
        place, self._end = self._end, self._end + len(rest)
        with os_faults(self.path):
            while rest:
                rest = rest[os.write(self._file, rest) :]
            os.fsync(self._file)
        return place

    def write(self, out: Path, cell: Callable[[Any], Any]) -> None:
        """Write the ``rows`` of all parts as CSV or, by the ending of ``out``, Parquet, whole or not at all.

        Columns are those of all rows in order of appearance, and ``cell`` returns what CSV has for a value.
        """
        names = list(dict.fromkeys(name for part in self for row in part["rows"] for name in row))
        with atomic_path(out) as path:
            if out.suffix.lower() == ".parquet":
                self._write_parquet(path, names)
                return
            with open(path, "w", encoding="utf-8", newline="") as file:
                file.write(csv_text([names]))
                for part in self:
                    file.write(csv_text([cell(row.get(name)) for name in names] for row in part["rows"]))

    def _write_parquet(self, path: Path, names: list[str]) -> None:
        """Write a row group a part; a column with a text in any row is text."""
        import pyarrow as pa
        from pyarrow.parquet import ParquetWriter

        texts = {name for part in self for row in part["rows"] for name in row if isinstance(row[name], str)}
        schema = pa.schema([(name, pa.string() if name in texts else pa.float64()) for name in names])
        with ParquetWriter(path, schema) as file:
            for part in self:
                columns = [pa.array([row.get(f.name) for row in part["rows"]], f.type) for f in schema]
                file.write_table(pa.table(columns, schema=schema))

    def close(self) -> None:
        """Let another run have the file."""
        file, self._file = self._file, -1
        if file >= 0:
            os.close(file)

    def remove(self) -> None:
        """Remove what is kept on disk."""
        if os.name == "nt":  # where no open file can be removed
            self.close()
        with suppress(OSError):
            self.path.unlink()
        self.close()


def _key(source: Source) -> str:
    """Return what a line of this source has as ``of``."""
    return json.dumps(source.stamp)


def _locked(path: Path) -> int:
    """Return the descriptor of a file that no other process writes, where the system knows such locks."""
    while True:
        with os_faults(path):
            file = open_append(path)
        if find_spec("fcntl") is None:
            return file
        import fcntl

        busy = {"file": path, "hint": "wait for that run, or choose another --out"}
        try:
            with as_user_error(BlockingIOError, "is being written by another run", **busy):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file), os.stat(path)):
                    return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # the run that had it has ended and removed it


def _as_python(value: Any) -> Any:
    return value.item()
