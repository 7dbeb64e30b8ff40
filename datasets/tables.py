"""Tables of numbers on disk: text (plain, gzip or xz), Parquet, MATLAB, Excel, read without running code.

The whole file is parsed at once; only where a row or a cell does not fit is it read line by line, to name
them.  A last line that was cut off (a logger that lost power) is dropped and noted; any other ragged line is
refused.

:func:`read_csv_table` reads what thermogrip writes.  :func:`read_text_table` reads what any logger writes:
the separator is the one of comma, semicolon, tab, bar and blanks that makes the first lines rows of equal
length whose cells are numbers; the header is the last line of words before them.  What it passes over or
takes for something is noted; a row or a cell that is broken is left out as long as they are few.
"""

from __future__ import annotations

import csv
import gzip
import io
import lzma
import re
import shlex
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets import limits
from thermogrip.datasets.atomic_files import read_bytes
from thermogrip.datasets.errors import UserError, as_user_error, os_faults, reading
from thermogrip.datasets.media import from_csv
from thermogrip.datasets.repair import name_rows
from thermogrip.datasets.units import read_header

if TYPE_CHECKING:
    from pandas import DataFrame

MOST_COLUMNS = 4096  # of a table
_MOST_EMPTY = 1_000_000  # lines without a cell that are passed over

_NULLS = ["", "nan", "NaN", "NAN", "NA", "na", "N/A", "null", "NULL", "None", "-nan", "#N/A"]
_LOST = [*_NULLS, "-", "--", "---", "?", "*", "NaT", "unknown", "unavailable"]
_COMMENT = ("#", "%", "//")  # how a line begins that is no row
_LEFT_OUT = "\x1f"  # how the name of a column begins that is not kept
_NAMELESS = "columns named c1 to c{} by position; --columns a,b,... names them"
_HEAD_LINES = 200  # of a file, that show how it is a table
#: A date, a time of day, or both, as a whole cell.
STAMP = re.compile(
    r"()(?:(\d{1,4})[-/.](\d{1,2}|[A-Za-z]{3})[-/.](\d{1,4})(?:,?\s+|T|$))?"
    r"(?:(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?)?\s*([AaPp][Mm])?\s*(Z|UTC|[+-]\d{2}:?\d{2})?$"
)
_LINE_STAMP = re.compile(
    r"\W{0,2}((?:\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[ T]+)?\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?)|Stats (\d+\.\d+):"
)  # how a line of a program's log begins: a stamp, or Klipper's seconds
_TERMINAL = re.compile(
    rb"(?m)^\[?((?:\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[ T]+)?\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?)(?:\]|\s+->)[ \t]*"
)  # of PuTTY and others, and of Arduino's serial monitor
_ESPHOME = re.compile(r"\[(\d{2}:\d{2}:\d{2}[.\d]*)\].*?: '([^',]+)': Sending state ([-+.\d]+|ON|OFF)\b")
_OF_HEATERS = ("target", "temp", "pwm")  # of a section of Klipper's statistics; what follows is the host's
_NAME = re.compile(r"[A-Za-z_@][^:=,;]{0,63}")
_LABELLED = re.compile(r"[A-Za-z_@][^:=,;]{0,63}?[:=]([-+.\deE]{1,30}|nan|NaN)")  # a cell, name and number
_LABELLED_LINES = 10  # with the same names, that are no chance
_MANY = 0.9  # share of a column's cells, or of a table's lines, that decide what the others should be
_MOST_BROKEN = 0.05  # share of rows with too few or too many cells that are left out
_SWITCH = {
    "on": 1.0, "off": 0.0, "true": 1.0, "false": 0.0, "yes": 1.0, "no": 0.0, "open": 1.0, "closed": 0.0,
    "heating": 1.0, "cooling": 1.0, "active": 1.0, "running": 1.0, "idle": 0.0, "inactive": 0.0,
    "stopped": 0.0,
}  # fmt: skip
_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|infinity)", re.ASCII | re.IGNORECASE
)


@dataclass(frozen=True)
class Table:
    """Columns of one file: numbers as float, text as str, and the file's line of each row."""

    file: str
    numbers: dict[str, NDArray[np.float64]]
    text: dict[str, list[str]]
    lines: NDArray[np.int64]
    attrs: dict[str, dict[str, str]] = field(default_factory=dict)  # by column: ``units``, ``role``
    meta: dict[str, str] = field(default_factory=dict)  # the format's entries for the whole file
    notes: tuple[str, ...] = ()  # what the reader repaired


def read_csv_table(
    path: str | Path,
    *,
    text: Callable[[str], bool] | frozenset[str] | None = frozenset(),
    data: bytes | None = None,
) -> Table:
    """Return the columns of a CSV file, plain, ``.gz`` or ``.xz``.

    Lines that start with ``#`` before the header are skipped. The separator is a comma, or a semicolon or tab
    if the header has no comma; then numbers may have a decimal comma, which is noted. ``text`` names the
    columns to leave as text, or states that of a header; None is all of them; ``data`` is what the file
    holds, where that is known.
    """
    data = _text_of(path) if data is None else data
    layout = Layout(*_header(data, str(path)), ())
    is_text = text if callable(text) else lambda name: text is None or name in text
    words = frozenset(name for name in layout.names if is_text(name))
    return _parse_table(data, layout, str(path), words, broken=0.0)


@dataclass(frozen=True)
class Layout:
    """How a text file is a table."""

    names: list[str]  # of the columns, by position where the file has none
    skip: int  # lines before the first row
    separator: str
    notes: tuple[str, ...]


def read_text_table(path: str | Path, columns: Sequence[str] | None = None) -> Table:
    """Return the columns of a text table that any program wrote; ``columns`` are names in place of the file's
    own, one a column, ``-`` to leave one out."""
    return parse_text(_text_of(path), str(path), columns)


def parse_text(data: bytes, file: str, columns: Sequence[str] | None = None) -> Table:
    """Return the table in the text of a file; see :func:`read_text_table`."""
    data, coded = _any_coding(data)
    if data.startswith(b"LabVIEW Measurement"):
        head, _, rows = data.rpartition(b"***End_of_Header***")
        data = b"\n" * head.count(b"\n") + rows.lstrip(b"\t\r")
    data, labelled = _without_labels(data)
    if not labelled:
        data = _stamps_as_column(data)
    layout = find_layout(data, file)
    names, notes = layout.names, (*coded, *labelled, *layout.notes)
    if columns is not None:
        have = len([name for name in names if not name.startswith(_LEFT_OUT)])
        if len(columns) != have:
            raise _other_count(file, have, len(columns))
        given: list[str] = []
        for name in columns:
            given.append(unused(_LEFT_OUT if name == "-" else name, given))
        names = [*given, *names[have:]]
        notes = tuple(note for note in notes if "--columns" not in note)
    if layout.separator == " ":  # one run at a time: [ ]+$ would look at each of its blanks again
        data = re.sub(rb"(?m)^ | ?\r?$", b"", re.sub(rb"[ \t]+", b" ", data))
    table = _parse_table(data, replace(layout, names=names, notes=notes), file)
    kept = {name: values for name, values in table.numbers.items() if not name.startswith(_LEFT_OUT)}
    return replace(table, numbers=kept)


def check_header(headers: Sequence[str], names: Sequence[str], file: str) -> None:
    """Refuse names where a table has no header, with the ``--columns`` that would give them to it."""
    known = {header.lower() for header in headers}
    spare = len(headers) - len(names)
    if not names or spare < 0 or known != {f"c{at + 1}" for at in range(len(headers))}:
        return
    if not known & {name.strip().lower() for name in names}:
        words = [*["time_s"][:spare], *names, *["-"] * (spare - 1)]
        hint = f"name its columns in their order, such as --columns {','.join(words)} (-: left out)"
        raise UserError("has no header", file=file, hint=hint)


def find_layout(data: bytes, file: str) -> Layout:
    """Return how a text is a table, from its first lines."""
    head: list[tuple[int, str]] = []
    for at, raw in enumerate(_lines(data[: 1 << 20]), start=1):
        if len(head) < _HEAD_LINES and raw.strip():
            head.append((at, raw.decode("utf-8", errors="replace").strip("\r\n")))
    best: tuple[float, int, str, list[list[str]]] | None = None  # share of rows that fit, the first of them
    for separator in "\t;|, ":
        rows = [_split(line, separator) for _, line in head]
        starts = [k for k in range(len(rows)) if _is_row(rows, k, separator)]
        if not starts:
            continue
        # a preamble may have a line like a row, of another length than the rows of the table
        others = (k for k in starts if len(rows[k]) not in (1, len(rows[starts[0]])))
        first = starts[0]
        if _like_first(rows[first:], separator) < _MANY:
            first = next((k for k in others if _like_first(rows[k:], separator) >= _MANY), first)
        n, below = len(rows[first]), rows[first:]
        fit = float(np.mean([len(r) == n and _values(r, separator) for r in below])) if n > 1 else 0.0
        if best is None or fit > best[0] + 1e-9:
            best = fit, first, separator, below
    if best is None:
        return Layout(*_header(data, file), ())
    _, first, separator, rows = best
    n = len(rows[0])
    if n > MOST_COLUMNS:
        raise UserError(f"has {n} columns, more than {MOST_COLUMNS}", file=file, hint="leave some out")
    names, used = _names_above(head[:first], n, separator)
    hollow = not names[-1] and all(row[-1] == "" for row in rows)  # every line ends with a separator
    nameless = [f"c{at}" for at, name in enumerate(names[: n - hollow], 1) if not name]
    notes = []
    if len(nameless) == n - hollow:
        above = len(_split(head[first - 1][1].lstrip("#%/ "), separator)) if first else 0
        why = f"{above} names above rows of {n} cells" if above > n else "no header"
        notes = [f"{why}: {_NAMELESS.format(n - hollow)}"]
    if nameless and not notes:
        notes.append(f"without a name: {', '.join(nameless)}")
    for at, name in enumerate(names):
        names[at] = unused(name or f"c{at + 1}", names[:at], "{1}_{0}")  # the unit at the end stays there
        if name and names[at] != name:
            notes.append(f"{name} occurs again: named {names[at]}")
    if hollow:
        names[-1] = f"{_LEFT_OUT}end"
    passed = sum(not line.startswith(_COMMENT) for _, line in head[:first]) - used
    if passed:
        notes.append(f"{passed} line(s) before the table passed over")
    return Layout(names, head[first][0] - 1, separator, tuple(notes))


def unused(name: str, others: Container[str], numbered: str = "{0}_{1}") -> str:
    """Return a name that is not among others: itself, or with a number."""
    return next(n for n in chain([name], (numbered.format(name, k) for k in count(2))) if n not in others)


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    except (csv.Error, StopIteration):
        return []


def _is_value(cell: str, separator: str) -> bool:
    plain = cell if separator == "," else cell.replace(",", ".")
    return bool(_NUMBER.fullmatch(plain) or STAMP.fullmatch(cell)) or cell in _LOST or cell.lower() in _SWITCH


def _values(row: Sequence[str], separator: str) -> float:
    """Return the share of a row's cells that are numbers, times or lost."""
    return sum(_is_value(cell, separator) for cell in row) / max(len(row), 1)


def _like_first(rows: Sequence[Sequence[str]], separator: str) -> float:
    """Return the share of lines that are as long as the first one, and of which at least half are numbers."""
    n = len(rows[0])
    return float(np.mean([len(row) == n and _values(row, separator) >= 0.5 for row in rows]))


def _is_row(rows: Sequence[Sequence[str]], k: int, separator: str) -> bool:
    """Tell whether line k is one of numbers, as long as the next or the one before."""
    row, cells = rows[k], [cell for cell in rows[k] if cell]
    beside = [len(other) for other in (*rows[max(k - 1, 0) : k], *rows[k + 1 : k + 2])]
    return bool(cells) and _values(cells, separator) >= 0.5 and (not beside or len(row) in beside)


def _names_above(lines: Sequence[tuple[int, str]], n: int, separator: str) -> tuple[list[str], int]:
    """Return the names of n columns, empty where the file has none, and how many lines gave them."""
    found: list[list[str]] = []
    for _, line in reversed(lines):
        comment = line.startswith(_COMMENT)
        cells = _split(line.lstrip("#%/ ") if comment else line, separator)
        if separator == " " and len(cells) != n:
            cells = [cell.strip() for cell in re.split(r"\s{2,}|\t|,|;", line.strip("#%/ "))]
        if len(cells) in (n, n - 1) and any(cells) and len(found) < 2 and not (comment and found):
            found.append([*cells, ""][:n])
        if found and not _are_units(found[0]):
            break
    if not found:
        return [""] * n, 0
    names = found[-1] if len(found) == 2 else found[0]
    if len(found) == 2:
        names = [f"{a} [{b.strip('[]()')}]" if b else a for a, b in zip(names, found[0])]
    used = sum(not line.startswith(_COMMENT) for _, line in lines[-len(found) :])
    return [from_csv(name) for name in names], used


def _are_units(cells: Sequence[str]) -> bool:
    """Tell whether a line under the names has their units."""
    words = [cell for cell in cells if cell]
    return bool(words) and all(read_header(f"x [{word.strip('[]()')}]")[1] != "1" for word in words)


def _any_coding(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return text in UTF-8; what is not is taken as Windows-1252, and that is noted."""
    if data.isascii():
        return data, ()
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace").encode(), ("text is not UTF-8: read as Windows-1252",)
    return data, ()


def _without_labels(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return the lines of a log that have readings beside their names, as a table with a header.

    So write serial plotters (``T1:23.5,T2:24.0``), printer hosts (``T:22.1 /200.0 @:127``, a target behind
    its reading) and Klipper (``extruder: target=200 temp=22.1 pwm=0.9``); lines without them are passed over.
    """
    head = [line.decode("utf-8", "replace") for line in islice(_lines(data[: 1 << 20]), 5 * _HEAD_LINES)]
    known = Counter(tuple(_labelled(line)) for line in head)
    del known[()]
    if any(_ESPHOME.match(line) for line in head):
        found = (_ESPHOME.match(line.decode("utf-8", "replace")) for line in _lines(data))
        rows = (line.expand(r"\1,\2,\3") if line else "" for line in found)
        return "\n".join(["time,name,state", *rows]).encode(), ("lines of an ESPHome log",)
    names, count = max(known.items(), key=lambda item: (item[1], len(item[0])), default=((), 0))
    if not names or count < min(_LABELLED_LINES, max(2, _MANY * sum(map(bool, head)))):
        return data, ()
    out: list[str] = []
    for raw in _lines(data):
        cells = _labelled(raw.decode("utf-8", "replace"))
        out.append(",".join(cells[name] for name in names) if cells.keys() >= {*names} else "")
    passed = sum(not line and bool(raw.strip()) for line, raw in zip(out, _lines(data)))
    head_row = next((at for at, line in enumerate(out) if line), 0)
    out[max(head_row - 1, 0) : head_row] = [",".join(names)]  # in place of a line before, if there is one
    notes = [f"lines have readings beside their names: {', '.join(names)}"]
    notes += [f"{passed} line(s) without them passed over"] if passed else []
    return "\n".join(out).encode() + b"\n", tuple(notes)


def _stamps_as_column(data: bytes) -> bytes:
    """Return the lines of a terminal that begin with a stamp in brackets, or before an arrow, as a table with
    the stamps as its first column."""
    head = [line for line in islice(_lines(data[: 1 << 20]), _HEAD_LINES) if line.strip()]
    stamped = [match for line in head if (match := _TERMINAL.match(line))]
    if not head or len(stamped) < _MANY * len(head):
        return data
    rest = stamped[-1].string[stamped[-1].end() :]
    separator = next((sign for sign in (b"\t", b";", b"|", b",") if sign in rest), b" ")
    before, _, after = data.partition(stamped[0][0])
    names = before.rstrip().rpartition(b"\n")[2]
    if len(names.split(separator)) == len(rest.split(separator)):
        before = before.replace(names, b"time" + separator + names)
    return before + _TERMINAL.sub(
        lambda match: match[1].replace(b" ", b"T") + separator, stamped[0][0] + after
    )


def _labelled(line: str) -> dict[str, str]:
    """Return the numbers of a line by the names beside them, and its stamp."""
    stamp, section, last = _LINE_STAMP.match(line), "", ""
    cells: dict[str, str] = {}
    if stamp is not None:
        cells["time" if stamp[1] else "time_s"] = (stamp[1] or stamp[2]).replace(",", ".")
        line = line[stamp.end() :]
    words: list[str] = []
    for piece in re.split(r"[,;\t]", line.replace("/", " /")):
        joined = re.sub(r" ?([:=/]) (?=[-+.\dn])| (=)(?=[-+.\dn])", r"\1\2", piece.strip())
        words += [joined] if _LABELLED.fullmatch(joined) else joined.split()
    for word in words:
        mark = next((sign for sign in "=:" if sign in word), "")
        name, _, value = word.partition(mark) if mark else ("", "", word)
        name = name.strip()
        if last and word.startswith("/") and _NUMBER.fullmatch(word[1:]):
            cells[unused(f"{last}_target", cells)] = word[1:]
        elif _NAME.fullmatch(name) and (_NUMBER.fullmatch(value) or value in ("nan", "NaN")):
            last = f"{section}_{name}" if section and name in _OF_HEATERS else name
            cells[unused(last, cells)] = value
        elif mark == ":" and not value:
            section = name
    return cells if len(cells) > (stamp is not None) else {}


def _parse_table(
    data: bytes, layout: Layout, file: str, words: frozenset[str] = frozenset(), broken: float = _MOST_BROKEN
) -> Table:
    """Return the table in a text: columns of numbers as they are, others cell by cell.

    ``words`` are columns to leave as text; up to a share ``broken`` of the rows, and twice as many cells of a
    column, may be left out.  All that is wrong beyond that is named in one error.
    """
    names, separator, skip = layout.names, layout.separator, layout.skip
    body, notes = _drop_cut_line(data, len(names), separator)
    faults: list[UserError] = []
    odd: list[int] = []
    try:
        body.decode("utf-8")
    except UnicodeDecodeError as error:  # Arrow writes a traceback for a row that it cannot hand over
        row = body.count(b"\n", 0, error.start) + 1
        raise UserError("is not UTF-8 text", file=file, row=row, hint="save the file as UTF-8") from error
    table, counts = _parse(body, skip, separator, names)
    if counts or table is None:
        odd = [at for at, cells in _rows(body, skip, separator, file) if len(cells) != len(names)]
    if odd and len(odd) > broken * (len(odd) + (table.num_rows if table is not None else 0)):
        more = f"; {len(odd) - 1} more rows do not fit" if len(odd) > 1 else ""
        problem = f"has {counts[0] if counts else 0} cell(s), the header has {len(names)}{more}"
        faults.append(UserError(problem, file=file, row=odd[0], hint="complete or remove the row"))
    elif odd:
        notes += (f"{len(odd)} row(s) with too few or too many cells left out ({name_rows(odd, 5)})",)
    if table is None:
        # Arrow refuses a header whose line has no end as well
        bare = next(_rows(body, skip, separator, file), None) is None
        problem = "has a header but no rows" if bare else "is not a table"
        hint = "give at least two rows" if bare else "open it in an editor and compare its rows"
        raise faults[0] if faults else UserError(problem, file=file, hint=hint)
    _check_empty(body, table.num_rows + len(odd), file)
    lines = _line_numbers(body, skip, table.num_rows + len(odd))
    lines = lines[~np.isin(lines, odd)]
    if len(lines) != table.num_rows:  # a quoted cell may have line ends
        lines = np.arange(skip + 1, skip + 1 + table.num_rows)
    if not lines.size and not faults:
        raise UserError("has a header but no rows", file=file, hint="give at least two rows")
    numbers: dict[str, NDArray[np.float64]] = {}
    text: dict[str, list[str]] = {}
    for name in names:
        column = table.column(name)
        if name in words:
            text[name] = [from_csv(cell.strip()) for cell in column.to_pylist()]
        elif (values := _plain_numbers(column)) is not None:
            numbers[name] = values
        elif not name.startswith(_LEFT_OUT):
            notes += _read_cells(name, column, (numbers, text, faults), lines, separator, broken, file)
    if faults:
        raise _joined(faults, names if broken else ())  # what may be broken is a log
    notes = tuple(dict.fromkeys([*layout.notes, *notes]))
    return Table(file, numbers, text, lines, notes=notes)


def _read_cells(
    name: str,
    column: Any,
    found: tuple[dict[str, NDArray[np.float64]], dict[str, list[str]], list[UserError]],
    lines: NDArray[np.int64],
    separator: str,
    broken: float,
    file: str,
) -> tuple[str, ...]:
    """Put a column of text among the numbers, the words or the faults that were found; return the notes."""
    numbers, text, faults = found
    cells, values, comma = _cell_numbers(column, separator)
    lost = cells.isin(_LOST if broken else _NULLS)
    wrong = np.flatnonzero(np.isnan(values) & ~lost)
    first = cells.iloc[wrong[0]] if wrong.size else ""
    states = switched(cells) if broken and cells.iloc[wrong].str.lower().nunique() > 1 else None
    if states is not None and np.isfinite(values).any():
        text[name] = cells.to_list()  # numbers and both states of a switch: the readings of several signals
        return ()
    if wrong.size <= 2 * broken * int((~lost).sum()):
        numbers[name] = values
        where = f"{name_rows(lines[wrong], 5)}: {_shown(first)}"
        words = (
            (f"{name}: {wrong.size} cell(s) that are no numbers left empty ({where})",) if wrong.size else ()
        )
        return (*words, *(["numbers have a decimal comma"] if comma else []))
    if broken and (states := switched(cells)) is not None:
        numbers[name] = states
        return (f"{name}: words as {_shown(first)} read as 0 and 1",)
    if broken and (wrong.size >= _MANY * int((~lost).sum()) or (first and STAMP.fullmatch(first))):
        text[name] = cells.to_list()
    else:
        faults.append(_cell_fault(first, file, int(lines[wrong[0]]), name))
    return ()


def _cell_numbers(column: Any, separator: str) -> tuple[Any, NDArray[np.float64], bool]:
    """Return the stripped cells, their numbers (NaN where they are none), and if decimals have a comma."""
    import pandas as pd

    cells = plain = column.to_pandas().astype(str).str.strip()
    comma = separator != "," and bool(cells.str.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?").any())
    comma = comma and not cells.str.contains(".", regex=False).any()
    if comma:
        plain = cells.str.replace(",", ".")
    return cells, np.asarray(pd.to_numeric(plain, errors="coerce"), dtype=float), comma


def switched(cells: Sequence[str]) -> NDArray[np.float64] | None:
    """Return the numbers of cells that are numbers or the two states of a switch, NaN where one is lost; None
    where there are other words, or two of one meaning."""
    import pandas as pd

    words = pd.Series(cells, dtype=object).astype(str).str.strip().str.lower()
    values = pd.to_numeric(words, errors="coerce")
    states = {*words[values.isna()]} - {lost.lower() for lost in _LOST}
    if not states <= {*_SWITCH} or len({_SWITCH[state] for state in states}) < len(states):
        return None
    return np.asarray(values.fillna(words.map(_SWITCH)), dtype=float)


def _shown(cell: str) -> str:
    return repr(cell if len(cell) <= 40 else cell[:37] + "...")


def _joined(faults: Sequence[UserError], names: Sequence[str]) -> UserError:
    """Return all that is wrong with a file as one error, of a log with what reads the rest of it."""
    first, bad = faults[0], {fault.column for fault in faults}
    kept = ",".join("-" if name in bad else name.replace(",", " ") for name in names)
    hint = first.hint
    if bad - {None} and len(bad) < len(names):
        command = shlex.join(["thermogrip", "identify", str(first.file), "--columns", kept])
        hint = f"{hint}, or leave columns out: {command}"
    if len(faults) == 1:
        return UserError(first.problem, file=first.file, row=first.row, column=first.column, hint=hint)
    each = [f"row {f.row}" + (f", column {f.column}" if f.column else "") + f": {f.problem}" for f in faults]
    return UserError(f"{len(faults)} faults: " + "; ".join(each), file=first.file, hint=hint)


def read_matlab_table(path: str | Path, columns: Sequence[str] | None = None) -> Table:
    """Return the columns of a MATLAB file (up to version 7): vectors and columns of matrices of one length (a
    matrix alone without names); a scalar ``Ts``, ``dt`` or ``fs`` is the step (``meta["dt"]``)."""
    raw = read_bytes(path)
    if raw[:10] == b"MATLAB 7.3":
        raise UserError("is MATLAB 7.3", file=path, hint="save('x.mat', ..., '-v7') in MATLAB, or export CSV")
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadWarning

    with reading("is no MATLAB file, or is damaged", file=path, hint="save it again"):
        source: Any = io.BytesIO(_unpacked_matlab(raw, path))  # the stubs know names only
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MatReadWarning)  # of objects without names
            found = loadmat(source, simplify_cells=True)
    arrays = dict(_matlab_arrays({k: v for k, v in found.items() if not k.startswith("__")}))
    lengths = [values.shape[0] for values in arrays.values() for _ in range(values.shape[1])]
    if not lengths:
        hint = "save the signals as vectors or a matrix (timeseries and tables are objects of MATLAB's own)"
        raise UserError("has no columns of numbers", file=path, hint=hint)
    n = max(set(lengths), key=lambda length: (length * lengths.count(length), length))
    parts = {name: values for name, values in arrays.items() if values.shape[0] == n}
    numbers = {
        name if values.shape[1] == 1 else f"{name}_{at + 1}": values[:, at]
        for name, values in parts.items()
        for at in range(values.shape[1])
    }
    left = [name for name in arrays if name not in parts]
    notes = [f"left out, of another length: {', '.join(left)}"] if left else []
    if len(parts) == 1 and len(numbers) > 1:
        numbers = {f"c{at}": values for at, values in enumerate(numbers.values(), 1)}
        if columns is None:
            notes.append(f"no header: {_NAMELESS.format(len(numbers))}")
    if columns is not None:
        if len(columns) != len(numbers):
            raise _other_count(path, len(numbers), len(columns))
        numbers = {name: v for name, v in zip(columns, numbers.values()) if name != "-"}
    scalars = dict(_matlab_scalars(found))
    step = scalars.get("ts") or scalars.get("dt") or 1 / scalars.get("fs", 1.0)
    meta = {"dt": repr(float(step))}
    return Table(str(path), numbers, {}, np.arange(1, n + 1), meta=meta, notes=tuple(notes))


def _matlab_arrays(found: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield name and columns (n_row, n_column) of each array of numbers, those of structures among them."""
    for name, value in found.items():
        if isinstance(value, dict) and depth < 4:
            yield from _matlab_arrays(value, depth + 1)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.ndim in (1, 2):
            rows = value[:, None] if value.ndim == 1 else value if len(value) >= value.shape[1] else value.T
            if len(rows) > 1 and rows.shape[1]:
                yield name, np.asarray(rows, dtype=float)


def _matlab_scalars(found: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, float]]:
    """Yield name, in small letters, and value of each number above zero, those of structures first."""
    for value in found.values():
        if isinstance(value, dict) and depth < 4:
            yield from _matlab_scalars(value, depth + 1)
    yield from ((k.lower(), v) for k, v in found.items() if isinstance(v, int | float) and v > 0)


def _unpacked_matlab(raw: bytes, path: str | Path) -> bytes:
    """Return a MATLAB 5 file with its parts unpacked, so that what is read is no larger than what is here."""
    if raw[126:128] not in (b"IM", b"MI"):
        return raw
    order: Literal["little", "big"] = "little" if raw[126:128] == b"IM" else "big"
    out, at, total = [raw[:128]], 128, 0
    while at < len(raw):
        kind, size = (int.from_bytes(raw[at + k : at + k + 4], order) for k in (0, 4))
        part, at = raw[at : at + 8 + size], at + 8 + size
        if kind == 15:  # miCOMPRESSED
            unpacker = zlib.decompressobj()
            part = unpacker.decompress(part[8:], limits.most_unpacked(len(raw)) - total + 1)
            total += len(part)
            limits.check_unpacked(len(raw), total, file=path)
        if at > len(raw):
            raise ValueError("it was cut off")
        out.append(part)
    return b"".join(out)


def read_excel_table(path: str | Path, columns: Sequence[str] | None = None) -> Table:
    """Return the first sheet of an Excel workbook, read as its text would be."""
    raw = read_bytes(path)
    absent, hint = "needs the package openpyxl", "pip install openpyxl, or export CSV"
    with reading("is no Excel workbook, or is damaged", file=path, hint="export CSV"):
        with zipfile.ZipFile(io.BytesIO(raw)) as packed:
            limits.check_unpacked(len(raw), sum(entry.file_size for entry in packed.infolist()), file=path)
        import pandas as pd

        with as_user_error(ImportError, absent, file=path, hint=hint):
            frame = pd.read_excel(io.BytesIO(raw), header=None, engine="openpyxl")
    return parse_text(frame.to_csv(index=False, header=False).encode(), str(path), columns)


def _other_count(file: str | Path, have: int, named: int) -> UserError:
    hint = "write a name for each, - to leave one out"
    return UserError(f"has {have} columns, --columns names {named}", file=file, hint=hint)


def read_parquet_table(path: str | Path) -> Table:
    """Return the numeric columns of a Parquet file, with the units and roles of its columns."""
    import pyarrow as pa

    numbers, attrs = {}, {}
    raw = read_bytes(path)
    with _sound_parquet(path):
        with _open_parquet(path, io.BytesIO(raw), len(raw)) as opened:
            table = opened.read()
        for entry in table.schema:
            numbers[entry.name] = _to_float(table.column(entry.name).cast(pa.float64()))
            attrs[entry.name] = _decode(entry.metadata)
        meta = _decode(table.schema.metadata)
    return Table(str(path), numbers, {}, np.arange(1, table.num_rows + 1), attrs, meta)


def read_parquet_frame(path: str | Path) -> DataFrame:
    """Return a Parquet file with columns of numbers and text."""
    raw = read_bytes(path)
    with (
        _sound_parquet(path),
        _open_parquet(path, io.BytesIO(raw), len(raw), text=True) as opened,
    ):
        frame: DataFrame = opened.read().to_pandas()
        return frame


def _open_parquet(path: str | Path, source: Any, packed: int, *, text: bool = False) -> Any:
    """Return the open file, its columns and sizes checked; ``text`` may be in some."""
    import pyarrow.parquet as parquet

    limits.check_size(packed, file=path)
    with _sound_parquet(path):
        opened = parquet.ParquetFile(source, page_checksum_verification=True)
        _check_parquet(opened, packed, path, text)
    return opened


def _sound_parquet(path: str | Path) -> AbstractContextManager[None]:
    return reading("is not Parquet, or is damaged", file=path, hint="write or copy it again")


def _check_parquet(opened: Any, packed: int, path: str | Path, text: bool) -> None:
    """Refuse columns that are no numbers, nor ``text`` where it may be, and a table that would be too large,
    before any of it is read."""
    import pyarrow.types as kinds

    known: list[Any] = [kinds.is_floating, kinds.is_integer, kinds.is_boolean]
    known += [kinds.is_string, kinds.is_large_string, kinds.is_dictionary, kinds.is_null] if text else []
    for entry in opened.schema_arrow:
        if not any(is_one(entry.type) for is_one in known):
            problem = f"holds {entry.type}, not numbers"
            raise UserError(problem, file=path, column=entry.name, hint="leave it out")
    about, columns = opened.metadata, len(opened.schema_arrow)
    if columns > MOST_COLUMNS:
        raise UserError(f"has {columns} columns, more than {MOST_COLUMNS}", file=path, hint="leave some out")
    groups = [about.row_group(at) for at in range(about.num_row_groups)]
    rows = max(about.num_rows, sum(group.num_rows for group in groups))
    pages = sum(group.column(at).total_uncompressed_size for group in groups for at in range(columns))
    limits.check_unpacked(packed, max(8 * rows * columns, pages), file=path, what="declares")


def _decode(metadata: dict[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (metadata or {}).items()}


def _to_float(column: Any) -> NDArray[np.float64]:
    """Return a column of float, NaN where it is null."""
    return np.array(column.fill_null(np.nan).to_numpy(), dtype=float)


def _text_of(path: str | Path) -> bytes:
    """Return the text of a file, unpacked, within the limits of :mod:`thermogrip.datasets.limits`."""
    limits.check_size(limits.check_source(path), file=path)
    openers: dict[str, Any] = {".gz": gzip.open, ".xz": lzma.open}
    opener = openers.get(Path(path).suffix.lower())
    spoilt = reading("is damaged or not compressed as its name says", file=path, hint="copy it again")
    with os_faults(path), open(path, "rb") as file, spoilt:
        if opener is None:
            data = limits.read_within(file, limits.most_bytes())
        else:
            with opener(file, "rb") as stream:
                _check_text(stream.read(4096), path)
                stream.seek(0)
                data = limits.unpack_within(stream, file, file=path)
    limits.check_size(len(data), file=path)  # a pipe says no size, and a file may grow
    data = _as_utf8(data, path).removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    _check_text(data[:4096], path)
    if not data.strip():
        raise UserError("is empty", file=path, hint="give a header and at least two rows")
    return data


def _check_text(start: bytes, path: str | Path) -> None:
    if not start.startswith((b"\xff\xfe", b"\xfe\xff")) and (b"\0" in start or start[:1] == b"\x80"):
        raise UserError("is not text, so it is not CSV", file=path, hint="export it as comma-separated text")


def _as_utf8(data: bytes, path: str | Path) -> bytes:
    """Return UTF-16 text, as spreadsheets write it, in UTF-8; any other bytes as they are."""
    if not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data
    with as_user_error(UnicodeDecodeError, "is damaged UTF-16 text", file=path, hint="save it as UTF-8"):
        return data.decode("utf-16").encode("utf-8")


def _header(data: bytes, file: str) -> tuple[list[str], int, str]:
    """Return column names, the number of lines before the first row, and the separator."""
    lines = enumerate(io.BytesIO(data), start=1)
    first = next(((at, raw) for at, raw in lines if raw.strip() and not raw.startswith(b"#")), None)
    if first is None:
        raise UserError("has only comments", file=file, hint="give a header and at least two rows")
    skip, raw = first
    at: dict[str, Any] = {"file": file, "row": skip}
    with as_user_error(UnicodeDecodeError, "the header is not UTF-8 text", **at, hint="save it as UTF-8"):
        line = raw.decode("utf-8").strip()
    separator = next((s for s in ",;\t" if s in line), ",")
    # such as a carriage return alone between two names
    hint = "end every line with a line feed"
    with as_user_error(csv.Error, "the header is no line of names", **at, hint=hint):
        header = [from_csv(cell.strip()) for cell in next(csv.reader([line], delimiter=separator))]
    if len(header) > MOST_COLUMNS:
        problem = f"the header has {len(header)} names, more than {MOST_COLUMNS}"
        raise UserError(problem, **at, hint="leave out what is not needed")
    for k, name in enumerate(header):
        if not name:
            raise UserError(f"column {k + 1} has no name", **at, hint="name it or remove it")
        if name in header[:k]:
            raise UserError("occurs twice", **at, column=name, hint="rename one of them")
    if all(_NUMBER.fullmatch(name) for name in header):
        hint = "write a first line such as time_s,drive,t_tank_degC"
        raise UserError("has no header, only numbers", **at, hint=hint)
    return header, skip, separator


def _parse(data: bytes, skip: int, separator: str, names: Sequence[str]) -> tuple[Any, list[int]]:
    """Return the columns of text as a pyarrow table, None where they are none, and the number of cells of
    each row that has too few or too many."""
    import pyarrow as pa
    import pyarrow.csv as arrow_csv

    counts: list[int] = []

    def leave_out(row: Any) -> str:
        counts.append(row.actual_columns)
        return "skip"

    block = min(len(data) + 1, 1 << 30)
    try:
        table = arrow_csv.read_csv(
            pa.BufferReader(data),
            read_options=arrow_csv.ReadOptions(
                use_threads=False, skip_rows=skip, column_names=list(names), block_size=block
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=separator, invalid_row_handler=leave_out),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid:
        return None, counts
    return table, counts


def _plain_numbers(column: Any) -> NDArray[np.float64] | None:
    """Return the numbers of a column of text that has nothing else, NaN where a cell is empty, or None."""
    import pyarrow as pa
    import pyarrow.compute as compute

    cells = compute.utf8_trim_whitespace(column)
    empty = compute.is_in(cells, value_set=pa.array(_NULLS))
    try:
        return _to_float(compute.if_else(empty, pa.scalar(None, pa.string()), cells).cast(pa.float64()))
    except pa.ArrowInvalid:
        return None


def _drop_cut_line(data: bytes, n_columns: int, separator: str) -> tuple[bytes, tuple[str, ...]]:
    """Drop an unfinished last line: no line end and too few cells."""
    body, _, last = data.rpartition(b"\n")
    cells = last.count(separator.encode()) + 1
    if not last.strip() or cells >= n_columns:
        return data, ()
    row = body.count(b"\n") + 2
    return body + b"\n", (f"row {row} is the last and was cut off ({cells} of {n_columns} cells): dropped",)


def _rows(data: bytes, skip: int, separator: str, file: str) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each non-empty row."""
    for line, raw in enumerate(_lines(data), start=1):
        if raw and line > skip:
            try:
                yield line, next(csv.reader([raw.decode("utf-8")], delimiter=separator))
            except UnicodeDecodeError as error:
                hint = "save the file as UTF-8"
                raise UserError("is not UTF-8 text", file=file, row=line, hint=hint) from error
            except csv.Error as error:
                problem = f"cannot be split ({error})"
                raise UserError(problem, file=file, row=line, hint="correct the row") from error


def _cell_fault(cell: str, file: str, line: int, name: str) -> UserError:
    comma = re.fullmatch(r"\s*[+-]?\d+,\d+\s*", cell)
    hint = "write a decimal point" if comma else "write a number, leave the cell empty, or drop the column"
    if cell.strip() and STAMP.fullmatch(cell.strip()):
        hint = "write seconds since the first row"
    return UserError(f"{_shown(cell)} is not a number", file=file, row=line, column=name, hint=hint)


def _line_numbers(data: bytes, skip: int, n_rows: int) -> NDArray[np.int64]:
    """Return the file's line of each row; only in a file with empty lines they are counted."""
    if data.count(b"\n") - skip + (not data.endswith(b"\n")) == n_rows:
        return np.arange(skip + 1, skip + 1 + n_rows)
    lines = (at for at, raw in enumerate(_lines(data), start=1) if at > skip and raw)
    return np.fromiter(islice(lines, n_rows), dtype=np.int64)


def _lines(data: bytes) -> Iterator[bytes]:
    """Yield the lines without their ends; a list of all of them would be larger than the table."""
    for raw in io.BytesIO(data):
        yield from raw.splitlines()


def _check_empty(data: bytes, n_rows: int, file: str) -> None:
    """Refuse millions of empty lines: they are no table, and walking them takes minutes."""
    empty = data.count(b"\n") - n_rows
    if empty > max(n_rows, _MOST_EMPTY):
        raise UserError(f"has {empty} empty lines", file=file, hint="remove them")
