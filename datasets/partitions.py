"""Answers to more grasps than fit in memory, part by part, so that an ended run goes on where it stopped.

Files are read one at a time, and one of many single touches is answered in parts of :data:`PART` grasps, each
as a file of its own.  What was answered is kept beside the output in ``NAME.partial``, a line of JSON a part,
forced to disk before the next part begins (with several workers, before that of a later file).  Ctrl-C,
``kill -9`` and a full disk leave whole lines and at most the beginning of one.  The same command takes those
of its lines that are of the same files (name, size, time of writing) in the same order, cuts off the rest,
and goes on: as a part's answer depends on nothing but the part, the end is the same bytes.  Memory holds one
file and one part, whatever the number of files.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thermogrip import __version__
from thermogrip.datasets.atomic_files import atomic_path, open_append
from thermogrip.datasets.errors import UserError, as_user_error, os_faults
from thermogrip.datasets.grasp_files import (
    grasp_file_parts,
    list_grasp_files,
    read_grasps,
    read_stored_grasps,
)
from thermogrip.datasets.media import csv_text
from thermogrip.datasets.parallel import Progress, Workers, in_order
from thermogrip.datasets.schema import label_values, log_name
from thermogrip.datasets.zarr_store import is_store, store_slices

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
    """Return the files of grasps in paths and folders, and the slices of Zarr stores, unread; ``plain`` as of
    :func:`~thermogrip.datasets.grasp_files.read_grasps`."""
    found = []
    for path in list_grasp_files(paths):
        marks = stamps(grasp_file_parts(path))
        size = sum(mark[1] for mark in marks)
        if is_store(path):
            slices, newest = store_slices(path), max(mark[2] for mark in marks)
            for start, stop in slices:
                read = partial(read_stored_grasps, path.absolute(), start, stop)
                stamp = [[str(path), size, newest], start, stop]
                found.append(Source(f"{path.name}[{start}:{stop}]", size // len(slices), stamp, read))
            continue
        found.append(Source(path.name, size, marks, partial(read_grasps, path.absolute(), plain=plain)))
    return found


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
        self.grasps, self._own = 0, False
        self._answered = 0.0  # share of the file to go on with

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
        with os_faults(self.path):
            file = open_append(self.path)
        try:
            _lock(file, self.path)
            self._own = True
            at, part, end = self._known(given)
            os.ftruncate(file, end)
            if not end:
                self._append(file, self._head)
            tasks = [Task(each, 0, prepare, answer) for each in given[at:]]
            tasks[:1] = [task._replace(first=part) for task in tasks[:1]]
            self._find(file, tasks, given, progress, workers, warn)
        except BaseException:
            if self._own and not self.grasps:
                self.remove()
            raise
        finally:
            os.close(file)
        return self

    def _find(
        self, file: int, tasks: list[Task], given: Sequence[Source], progress: Progress, workers: Workers,
        warn: Callable[[str], None],
    ) -> None:  # fmt: skip
        whole, begin, before = max(sum(each.size for each in given), 1), time.monotonic(), self.grasps
        done, names = whole - sum(task.source.size for task in tasks), set[str]()
        ahead = tasks[0].source.size * self._answered if tasks else 0.0
        progress((done + ahead) / whole, "grasps")  # with which share this run begins
        alone = workers == 1 or len(tasks) == 1
        answered = (task.lines() for task in tasks) if alone else in_order(_whole, tasks, workers)
        for task, lines in zip(tasks, answered):
            for line in lines:
                if line["part"] == task.first and line["name"] in names:
                    raise UserError("is given twice", file=task.source.name, hint="give each file once")
                names.add(line["name"])
                for words in line.pop("warnings", ()):
                    warn(words)
                self._append(file, line)
                self.grasps += line["grasps"]
                rate = (self.grasps - before) / max(time.monotonic() - begin, 1e-3)
                words = f"grasps: {self.grasps}, {rate:.3g}/s, {task.source.name}"
                progress((done + task.source.size * (line["part"] + 1) / line["parts"]) / whole, words)
            done += task.source.size

    def _known(self, given: Sequence[Source]) -> tuple[int, int, int]:
        """Return the file and the part to go on with, and where in the file of answers."""
        at = part = end = 0
        for line, last in self._lines():
            if not end:
                if line != self._head:
                    break
            elif at == len(given) or [line.get("of"), line.get("part")] != [given[at].stamp, part]:
                break
            else:
                self.grasps += line["grasps"]
                at, part = (at + 1, 0) if part + 1 == line["parts"] else (at, part + 1)
                self._answered = part / line["parts"]
            end = last
        return at, part, end

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
        return (line for line, _ in islice(self._lines(), 1, None))

    def _append(self, file: int, line: dict[str, Any]) -> None:
        """Write one line and force it to disk."""
        rest = memoryview(json.dumps(line, default=_as_python).encode() + b"\n")
        with os_faults(self.path):
            while rest:
                rest = rest[os.write(file, rest) :]
            os.fsync(file)

    def write(self, out: Path, cell: Callable[[Any], Any]) -> None:
        """Write the ``rows`` of all parts as CSV or, by the ending of ``out``, Parquet, whole or not at all.

        Columns are those of all rows in order of appearance, and ``cell`` returns what CSV has for a value.
        """
        names = list(dict.fromkeys(name for part in self for row in part["rows"] for name in row))
        with atomic_path(out) as path:
            if out.suffix == ".parquet":
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

    def remove(self) -> None:
        """Remove what is kept on disk."""
        with suppress(OSError):
            self.path.unlink()


def _lock(file: int, path: Path) -> None:
    """Refuse a file that another process writes, where the system knows such locks."""
    if find_spec("fcntl") is None:
        return
    import fcntl

    busy = {"file": path, "hint": "wait for that run, or choose another --out"}
    with as_user_error(BlockingIOError, "is being written by another run", **busy):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _as_python(value: Any) -> Any:
    return value.item()
