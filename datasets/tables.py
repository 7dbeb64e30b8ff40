"""Tables of numbers on disk: text (plain, gzip or xz), Parquet, MATLAB, Excel, read without running code.

:func:`read_csv_table` reads what thermogrip writes, and refuses what is broken.  :func:`read_text_table`
reads what any logger writes: the separator is the one of comma, semicolon, tab, bar and blanks whose rows of
equal length hold most numbers; the header is the last line of words before them.  What it passes over or
takes for something is noted; broken rows and cells are left out as long as they are few.
"""

from __future__ import annotations

import csv
import gzip
import io
import lzma
import math
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets import limits
from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, as_user_error, reading
from thermogrip.datasets.files import check_source, read_bytes
from thermogrip.datasets.repair import Doubt, name_rows
from thermogrip.datasets.units import read_header
from thermogrip.media.rendering import from_csv

if TYPE_CHECKING:
    from pandas import DataFrame

MOST_COLUMNS = 4096  # of a table; one of thermogrip has twelve

_LOST_CELLS = frozenset(
    ["", "nan", "NaN", "NAN", "NA", "na", "N/A", "null", "NULL", "None", "-nan", "#N/A", "<NA>", "NaT",
     "-", "--", "---", "?", "*", "unknown", "unavailable"]
)  # fmt: skip
_COMMENT = ("#", "%", "//")  # how a line begins that is no row
_GOOD = frozenset(["good", "ok", "valid"])  # what servers of readings (OPC) call those that are some
_LEFT_OUT = "\x1f"  # how the name of a column begins that is not kept
_NAMELESS = "columns named c1 to c{} by position; --columns a,b,... names them"
_HEAD = 1 << 20  # characters of a text that are looked through for its lines' kind
_HEAD_LINES = 200  # of a file, that show how it is a table: the longest preamble seen has 40
#: A date, a time of day, or both, as a whole cell.
STAMP = re.compile(
    r"()(?:(\d{1,4})[-/.](\d{1,2}|[A-Za-z]{3})[-/.](\d{1,4})(?:,?\s+|T|$))?"
    r"(?:(\d{1,3}):(\d{2}(?:\.\d+)?|\d(?=:))(?::(\d{1,2}(?:[.,:]\d+)?))?)?\s*([AaPp][Mm])?\s*(Z|UTC|[+-]\d{2}:?\d{2})?$"
)
_TIME_OF_DAY = r"((?:\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[ T]+)?\d{1,2}:\d{2}:\d{2}(?:[.,:]\d+)?)"
_KLIPPER = "Stats "  # then seconds, and sections of the board, the host and heaters
_LINE_STAMP = re.compile(r"\W{0,2}" + _TIME_OF_DAY + rf"|{_KLIPPER}(\d+\.\d+):")  # begins a line
_TERMINAL = re.compile(r"(?m)^\[?" + _TIME_OF_DAY + r"(?:\]|\s+->)[ \t]*")  # PuTTY, Arduino's monitor
_ESPHOME = re.compile(r"\[(\d{2}:\d{2}:\d{2}[.\d]*)\].*?: '([^',]+)': Sending state ([-+.\d]+|ON|OFF)\b")
_OF_HEATERS = ("target", "temp", "pwm")  # of a section of Klipper's statistics; what follows is the host's
# a reading beside its name, which has blanks where it is alone between separators; a target behind it; the
# name of a section
_LABELLED = re.compile(
    r"(?:(?:^|[,;\t]) *(?P<alone>[A-Za-z_@][^:=,;/]{0,63}?) ?[:=](?=[^:=,;]*(?:[,;\t]|$))"
    r"|(?<!\S)(?P<name>[A-Za-z_@][^:=,;/\s]{0,63}) ?[:=]|/)"
    r" ?(?P<value>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?inf|nan|NaN)"
    r" ?(?P<unit>[\u00b0\u00ba]?[CF]|%|)(?=[\s,;/]|$)"
    r"|(?<!\S)(?P<section>[^:=,;\s]+):(?=\s)"
)
_LABELLED_LINES = 10  # with the same names, that are no chance
_MOST = 0.9  # share of a column's cells, or of a table's lines, that decide what the others should be
_TOLERATED = 0.05  # share of rows with too few or too many cells that are left out, as a bad serial line has
_SWITCH = {
    "on": 1.0, "off": 0.0, "true": 1.0, "false": 0.0, "yes": 1.0, "no": 0.0, "open": 1.0, "closed": 0.0,
    "heating": 1.0, "cooling": 1.0, "active": 1.0, "running": 1.0, "idle": 0.0, "inactive": 0.0,
    "stopped": 0.0,
}  # fmt: skip
_NUMBER_CELL = re.compile(
    r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|infinity)", re.ASCII | re.IGNORECASE
)
# what programs print within numbers: a mark between thousands, blanks behind a sign
_PRINTED_BLANKS = re.compile(r"(?<=\d)[\xa0\u2009\u202f'\u2019](?=\d{3}(?!\d))|(?<=^[+-])\s+(?=\d)")
_OPEN = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")  # a number with a mark of decimals, or of thousands
_GROUPED = re.compile(r"[+-]?\d{1,3}(\.\d{3})+(,\d+)?")  # one with marks of thousands
_DECIMAL_COMMA = re.compile(r"[+-]?(\d*|\d{1,3}(\.\d{3})+),\d+([eE][+-]?\d+)?")
_SCALES = re.compile(r"(?i)scal(e|ing)|factor|faktor|multipl|offset|\bx ?10+\b")
_WITH_UNIT = re.compile(r"([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*([^\W\d_]{1,4}|%|[°º]\s?[CFK])")


@dataclass(frozen=True)
class Table:
    """Columns of one file: numbers as float, text as str, and the file's line of each row."""

    file: str
    numbers: dict[str, Array]
    text: dict[str, list[str]]
    lines: NDArray[np.int64]
    attrs: dict[str, dict[str, str]] = field(default_factory=dict)  # by column: ``units``, ``role``
    meta: dict[str, str] = field(default_factory=dict)  # the format's entries for the whole file
    notes: tuple[str, ...] = ()  # what the reader repaired


@dataclass(frozen=True)
class Layout:
    """How a text file is a table."""

    names: list[str]  # of the columns, by position where the file has none
    skip: int  # lines before the first row
    separator: str
    notes: tuple[str, ...] = ()
    header: Sequence[str] = ()  # the cells of the line of names, where it may stand again


@dataclass
class Column:
    """What the cells of a column are: numbers, or text."""

    name: str
    numbers: Array | None = None
    text: list[str] | None = None
    notes: tuple[str, ...] = ()


def read_csv_table(path: str | Path, *, text: Callable[[str], bool] | None = None) -> Table:
    """Return the columns of a CSV file that has nothing broken; ``text`` tells which headers are of text."""
    file = str(path)
    content, _ = _decoded(_bytes_of(path), file, strict=True)
    with as_user_error(csv.Error, "the header is no line of names", file=file, hint="correct it"):
        layout = _first_line_as_names(content, file)
    for place, name in enumerate(layout.names):
        if not name or name in layout.names[:place]:
            problem = f"column {place + 1} has no name" if not name else f"column {name!r} occurs twice"
            raise UserError(problem, file=file, row=layout.skip, hint="name each column once")
    return _parse_table(content, layout, file, text or (lambda name: False), tolerated=0.0)


def read_text_table(path: str | Path, columns: Sequence[str] | None = None) -> Table:
    """Return the columns of any program's text; ``columns`` are other names for all, ``-`` leaves one out."""
    return parse_text(_bytes_of(path), str(path), columns)


def parse_text(data: bytes, file: str, columns: Sequence[str] | None = None) -> Table:
    """Return the table in the text of a file; see :func:`read_text_table`."""
    text, coded = _decoded(data, file)
    head = ""
    if text.startswith("LabVIEW Measurement"):
        head, mark, rows = text.rpartition("***End_of_Header***")
        if (parts := head.count(mark)) > 1:  # the file has a heading, and each part one
            coded = (*coded, Doubt(f"has {parts} parts with headings: only the last is read; cut the file"))
        text = "\n" * head.count("\n") + rows.lstrip("\t\r")
    if "X_Value\t" in text[: 1 << 20]:  # beside it LabVIEW names comments, which most rows lack
        text = re.sub(r"\tComment[\t\r ]*\n", "\n", text, count=1)
    text, labelled = _without_labels(text)
    if not labelled:
        text = _stamps_as_column(text)
    # milliseconds behind a comma, as Python's logging writes them: each line has a cell more than names
    under_names = re.search(r"(?m)^(.+)\n([^,\n]*\d:\d\d:\d\d,\d{3},.*)$", text[: 1 << 20])
    if under_names and under_names[1].count(",") == under_names[2].count(",") - 1:
        text = re.sub(r"(?m)^([^,\n]*\d:\d\d:\d\d),(?=\d{3},)", r"\1.", text)
    layout = find_layout(text, file, named=columns is not None)
    if layout.names[0] == "c1" and re.search(r"(?m)^X_Columns\W(One|Multi)", head):
        layout = replace(layout, names=["X_Value", *layout.names[1:]])
    notes = (*coded, *labelled, *layout.notes)
    if columns is not None:
        named = [name for name in layout.names if not name.startswith(_LEFT_OUT)]
        layout = replace(layout, names=[*_new_names(columns, len(named), file), *layout.names[len(named) :]])
        notes = tuple(note for note in notes if "--columns" not in note)
    if layout.separator == " ":  # one run at a time: [ ]+$ would look at each of its blanks again
        text = re.sub(r"(?m)^ | ?\r?$", "", re.sub(r"[ \t]+", " ", text))
    return _parse_table(text, replace(layout, notes=notes), file, lambda name: False, _TOLERATED)


def _new_names(columns: Sequence[str], n: int, file: str | Path) -> list[str]:
    """Return the names that a user gives to n columns, each once; those left out begin with a sign."""
    if len(columns) != n:
        hint = "write a name for each, - to leave one out"
        raise UserError(f"has {n} columns, --columns names {len(columns)}", file=file, hint=hint)
    names: list[str] = []
    for name in columns:
        names.append(unused(_LEFT_OUT if name == "-" else name, names))
    return names


def check_header(headers: Sequence[str], names: Sequence[str], file: str) -> None:
    """Refuse names where a table has no header, with the ``--columns`` that would give them to it."""
    places = {f"c{place}" for place in range(1, len(headers) + 1)}
    if names and {header.lower() for header in headers} == places and not places & {*map(str.lower, names)}:
        spare = len(headers) - len(names)
        words = [*["time_s"][:spare], *names, *["-"] * (spare - 1)]
        hint = f"name its columns in their order, such as --columns {','.join(words)} (-: left out)"
        raise UserError("has no header", file=file, hint=hint)


def find_layout(text: str, file: str, *, named: bool = False) -> Layout:
    """Return how a text is a table; names fewer than cells are refused, but where others are ``named``."""
    head = [(place, line) for place, line in enumerate(_iterate_lines(text, _HEAD), start=1) if line.strip()]
    head = head[:_HEAD_LINES]
    separator, first = _best_separator([line for _, line in head])
    if first is None:
        return _first_line_as_names(text, file)
    rows = [_split_cells(line, separator) for _, line in head[first:]]
    n = len(rows[0])
    if n > MOST_COLUMNS:
        raise UserError(f"has {n} columns, more than {MOST_COLUMNS}", file=file, hint="leave some out")
    header, used = _names_above([line for _, line in head[:first]], rows[0], separator)
    hollow = not header[-1] and all(row[-1] == "" for row in rows)  # every line ends with a separator
    nameless = [f"c{place}" for place, name in enumerate(header[: n - hollow], 1) if not name]
    above = _cells_of_names(head[first - 1][1], n, separator) if first else []
    # commas may be decimals, or the first column be without a name: each name would be another column's
    fewest = n - 1 if separator != "," or any("." in cell for row in rows for cell in row) else n / 2
    if max(fewest, 2) <= len(above) < n and _number_share(above) < 0.5 and not (hollow or named):
        hint = f"name all with --columns {','.join(['NAME'] * n)}, or write decimals with a point"
        raise UserError(f"has {len(above)} names above rows of {n} cells", file=file, hint=hint)
    notes = []
    if len(nameless) == n - hollow:
        why = f"{len(above)} names above rows of {n} cells" if len(above) not in (0, 1, n) else "no header"
        notes = [f"{why}: {_NAMELESS.format(n - hollow)}"]
    elif nameless:
        notes = [f"without a name: {', '.join(nameless)}"]
    names: list[str] = []
    for place, name in enumerate(header, start=1):
        names.append(unused(name or f"c{place}", names, "{1}_{0}"))  # the unit at the end stays there
        if name and names[-1] != name:
            notes.append(f"{name} occurs again: named {names[-1]}")
    if hollow:
        names[-1] = f"{_LEFT_OUT}end"
    passed = sum(not line.startswith(_COMMENT) for _, line in head[:first]) - used
    if passed:
        notes.append(f"{passed} line(s) before the table passed over")
    for place, line in head[:first]:
        if _SCALES.search(line) and not {*_cells_of_names(line, n, separator)} & {*header}:
            notes.append(Doubt(f"line {place} may change the numbers under it: {_quoted_cell(line)}"))
    return Layout(names, head[first][0] - 1, separator, tuple(notes), header)


def _best_separator(lines: Sequence[str]) -> tuple[str, int | None]:
    """Return the separator by which most of the lines are rows of numbers, and the first row's place."""
    most_values = -1.0
    best, best_first = ",", None
    for separator in "\t;|, ":
        rows = [[] if line.startswith(_COMMENT) else _split_cells(line, separator) for line in lines]
        # a preamble may have a line like a row, of another length than the rows of the table
        lengths = [len(row) if _number_share([*filter(None, row)]) >= 0.5 else 0 for row in rows]
        n = max(filter(None, lengths), key=lambda length: (lengths.count(length), length), default=0)
        values = sum(_number_share(row) for row in rows if len(row) == n > 1)
        if n and values > most_values + 1e-9:
            most_values = values
            places = [place for place, length in enumerate(lengths) if length == n]
            # a line of properties (`Size 8 Size 2`) has words, and half of a row's numbers at most
            numbers = [sum(_is_value(cell) for cell in row if cell) for row in rows]
            usual = np.median([numbers[place] for place in places])
            places = [k for k in places if _number_share(rows[k]) == 1 or numbers[k] > usual / 2]
            # one that is alone, without names above it, is of a preamble
            of_table = (k for k in places if k + 1 in places or (k and len(rows[k - 1]) == n))
            best, best_first = separator, next(of_table, places[0])
    return best, best_first


def unused(name: str, others: Container[str], numbered: str = "{0}_{1}") -> str:
    """Return a name that is not among others: itself, or with a number."""
    return next(n for n in chain([name], (numbered.format(name, k) for k in count(2))) if n not in others)


def _split_cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    except (csv.Error, StopIteration):
        return []


def _as_typed(cell: str) -> str:
    """Return a cell without what programs print within numbers; a minus may be no hyphen."""
    return _PRINTED_BLANKS.sub("", cell.replace("\u2212", "-"))


def _is_value(cell: str) -> bool:
    cell = _as_typed(cell)
    if _NUMBER_CELL.fullmatch(cell.replace(",", ".")) or STAMP.fullmatch(cell) or cell in _LOST_CELLS:
        return True
    with_unit = _WITH_UNIT.fullmatch(cell)
    return cell.lower() in _SWITCH or (with_unit is not None and _is_unit(with_unit[2]))


def _number_share(row: Sequence[str]) -> float:
    """Return the share of a row's cells that are numbers, times or lost."""
    return sum(_is_value(cell) for cell in row) / max(len(row), 1)


def _cells_of_names(line: str, n: int, separator: str) -> list[str]:
    """Return a line's cells as names of n columns: by any separator that gives so many, else as a row's."""
    line = line.lstrip("#%/ ") if line.startswith(_COMMENT) else line
    if line.rstrip().endswith(("[", "{")):  # a matrix begins, as MATLAB writes it
        return []
    as_rows, *by_others = (_split_cells(line, sign) for sign in (separator, *",;\t"))
    for cells in (as_rows, *by_others, re.split(r"\s{2,}|\t|,|;", line.strip())):
        within = "\0".join(map(str.strip, cells)).strip("\0").split("\0")
        if n in (len(cells), len(within)):
            return cells if len(cells) == n else within
    return as_rows


def _names_above(lines: Sequence[str], row: Sequence[str], separator: str) -> tuple[list[str], int]:
    """Return the names of a row's columns, empty where there is none, and the number of their lines."""
    n = len(row)
    headers: list[list[str]] = []  # the nearest first
    counted: list[bool] = []  # those that are no comments
    units = [""] * n
    for below, line in enumerate(reversed(lines)):
        comment, nearest = line.startswith(_COMMENT), below == 0
        cells = _split_cells(line.lstrip("#%/ ") if comment else line, separator)
        if nearest or separator == " ":
            cells = _cells_of_names(line, n, separator)
        words = [*filter(None, cells)]
        fits = len(cells) == n or len(cells) == n - 1 > 1
        no_states = [word for word in words if word.lower() not in _SWITCH]  # a name may be Heating
        if fits and words and _number_share(no_states) < 0.5 and not (comment and headers):
            headers.append([*cells, ""][:n])
            counted.append(not comment)
    if not headers:
        return units, 0
    # under the names may stand their units, with other words below what counts rows or times
    of_units = float(np.mean([_is_unit(word) for word in headers[0] if word]))
    has_units = len(headers) > 1 and (of_units > 0.5 or (of_units == 0.5 and n > 2))
    if has_units:
        units = headers.pop(0)
    # types and statistics of columns repeat themselves; of lines that begin with what each property of a
    # channel is (`Name a Name b`, `Type x Type y`), the first is the name
    of_properties = headers[0].count(headers[0][0]) > 1
    distinct = [len({*filter(None, header)}) for header in headers]
    best = max(range(len(headers)), key=lambda k: (distinct[k], k if of_properties else -k))
    above = zip(headers[best], units)
    names = [f"{name} [{unit.strip('[]()')}]" if _is_unit(unit) else name for name, unit in above]
    return [from_csv(name) for name in names], counted[best + has_units] + (has_units and counted[0])


def _is_unit(word: str) -> bool:
    return read_header(f"x [{word.strip('[]()')}]").unit != "1"


def _first_line_as_names(text: str, file: str) -> Layout:
    """Return the layout of a table whose first line, comments aside, is its header."""
    lines = ((place, line.strip()) for place, line in enumerate(_iterate_lines(text), start=1))
    skip, line = next(((place, line) for place, line in lines if line and line[0] != "#"), (0, ""))
    if not line:
        raise UserError("has only comments", file=file, hint="give a header and at least two rows")
    separator = next((sign for sign in ",;\t" if sign in line), ",")
    names = [from_csv(cell.strip()) for cell in next(csv.reader([line], delimiter=separator))]
    if len(names) > MOST_COLUMNS:
        problem = f"the header has {len(names)} names, more than {MOST_COLUMNS}"
        raise UserError(problem, file=file, row=skip, hint="leave out what is not needed")
    return Layout(names, skip, separator)


def _without_labels(text: str) -> tuple[str, tuple[str, ...]]:
    """Return the lines of a log that have readings beside their names, as a table with a header."""
    start = text.find(f"\n{_KLIPPER}") + 1  # behind a printer's settings
    head = list(islice(_iterate_lines(text[start:], _HEAD), 5 * _HEAD_LINES))
    if any(map(_ESPHOME.match, head)):
        matches = map(_ESPHOME.match, _iterate_lines(text))
        readings = (match.expand(r"\1,\2,\3") if match else "" for match in matches)
        return "\n".join(["time,name,state", *readings]), ("lines of an ESPHome log",)
    # so write serial plotters (T1:23.5,T2:24.0), printer hosts (T:22.1 /200.0 @:127, a target behind its
    # reading) and Klipper (extruder: target=200 temp=22.1 pwm=0.9); lines without them are passed over
    labels = Counter(tuple(_labelled_cells(line)) for line in head)
    del labels[()]
    names, count = max(labels.items(), key=lambda item: (item[1], len(item[0])), default=((), 0))
    if not names or count < min(_LABELLED_LINES, max(2, _MOST * sum(map(bool, head)))):
        return text, ()
    rows: list[str] = []
    passed = 0
    for line in _iterate_lines(text):
        cells = _labelled_cells(line)
        rows.append(",".join(cells[name] for name in names) if cells.keys() >= {*names} else "")
        passed += not rows[-1] and bool(line.strip())
    first = next((place for place, row in enumerate(rows) if row), 0)
    rows[max(first - 1, 0) : first] = [",".join(names)]  # in place of a line before, if there is one
    notes = [f"lines have readings beside their names: {', '.join(names)}"]
    notes += [f"{passed} line(s) without them passed over"] if passed else []
    return "\n".join(rows) + "\n", tuple(notes)


def _stamps_as_column(text: str) -> str:
    """Return a terminal's lines, each behind its stamp in brackets or before an arrow, with it as a cell."""
    head = [line for line in islice(_iterate_lines(text, _HEAD), _HEAD_LINES) if line.strip()]
    stamped = [match for line in head if (match := _TERMINAL.match(line))]
    if not head or len(stamped) < _MOST * len(head):
        return text
    cells = stamped[-1].string[stamped[-1].end() :]
    separator = next((sign for sign in "\t;|," if sign in cells), " ")
    before, _, after = text.partition(stamped[0][0])
    names = before.rstrip().rpartition("\n")[2]
    if len(names.split(separator)) == len(cells.split(separator)):
        before = before.replace(names, f"time{separator}{names}")
    rows = _TERMINAL.sub(lambda match: match[1].replace(" ", "T") + separator, stamped[0][0] + after)
    return before + rows


def _labelled_cells(line: str) -> dict[str, str]:
    """Return the numbers of a line by the names beside them, and its stamp."""
    stamp = _LINE_STAMP.match(line)
    of_klipper = stamp is not None and stamp[2]
    section = last = ""
    cells: dict[str, str] = {}
    if line.startswith("{"):  # JSON, an object a line
        line = re.sub(r'[{}"]', "", line)
    if stamp is not None:
        cells["time" if stamp[1] else "uptime_s"] = (stamp[1] or stamp[2]).replace(",", ".")
        line = line[stamp.end() :]
    for match in _LABELLED.finditer(line):
        name, value = match["alone"] or match["name"], match["value"]
        if match["section"]:
            section = match["section"]
        elif name in _OF_HEATERS or (name and not of_klipper):
            last = f"{section}_{name}" if section and name in _OF_HEATERS else name
            cells[unused(f"{last} [{match['unit']}]" if match["unit"] else last, cells)] = value
        elif last and not name:
            cells[unused(f"{last}_target", cells)] = value
    return cells if len(cells) > (stamp is not None) else {}


def _parse_table(
    text: str, layout: Layout, file: str, is_text: Callable[[str], bool], tolerated: float
) -> Table:
    """Return the table in a text; a share ``tolerated`` of rows, twice that of cells, may be left out."""
    names, n = layout.names, len(layout.names)
    rows, notes = list(_cell_rows(text, layout, file)), list(layout.notes)
    if rows and len(rows[-1][1]) < n and not text.endswith(("\n", "\r")):
        line, cells = rows.pop()
        notes.append(f"row {line} is the last and was cut off ({len(cells)} of {n} cells): dropped")
    comments = [line for line, cells in rows if tolerated and cells[0].startswith(_COMMENT)]
    if comments:
        notes.append(f"comments between rows passed over ({name_rows(comments, 5)})")
        rows = [(line, cells) for line, cells in rows if not cells[0].startswith(_COMMENT)]
    again: list[int] = []
    for line, cells in rows if any(layout.header) else ():
        if cells == layout.header:
            again.append(line)
        elif cells[0] and cells[0] in layout.header and _number_share(cells) == 0:
            problem = f"the header stands again with other columns: {_quoted_cell(','.join(cells))}"
            raise UserError(problem, file=file, row=line, hint="cut the file there in two")
    if again:  # the logger was started again
        notes.append(f"the header stands again in {name_rows(again, 5)}")
        rows = [(line, cells) for line, cells in rows if cells != layout.header]
    ragged = [line for line, cells in rows if len(cells) != n]
    if len(ragged) > tolerated * len(rows):
        more = f"; {len(ragged) - 1} more rows do not fit" if len(ragged) > 1 else ""
        problem = f"has {len(dict(rows)[ragged[0]])} cell(s), the header has {n}{more}"
        hint = "complete or remove the row"
        if len(ragged) > len(rows) / 2:
            hint = "write one table, with the same columns in each row (lines of several kinds are none)"
        raise UserError(problem, file=file, row=ragged[0], hint=hint)
    if ragged:
        notes.append(f"{len(ragged)} row(s) with too few or too many cells left out ({name_rows(ragged, 5)})")
    rows = [(line, cells) for line, cells in rows if len(cells) == n]
    if not rows:
        raise UserError("has a header but no rows", file=file, hint="give at least two rows")
    lines = np.array([line for line, _ in rows], dtype=np.int64)
    by_name = zip(names, zip(*(cells for _, cells in rows)))
    cells_of = {name: cells for name, cells in by_name if not name.startswith(_LEFT_OUT)}
    columns = [
        Column(name, text=[from_csv(cell.strip()) for cell in cells])
        if is_text(name)
        else read_column(name, cells, lines, file, tolerated)
        for name, cells in cells_of.items()
    ]
    if tolerated:
        for column in columns:
            words = {cell.lower() for cell in column.text or ()}
            if words & _GOOD and words - _GOOD:
                says = f"{column.name} does not call each reading good"
                notes.append(Doubt(f"{says}: leave those cells empty that it does not"))
        numbers = [(c.name, cells) for c, cells in zip(columns, cells_of.values()) if c.numbers is not None]
        notes += _open_marks(dict(numbers))
    return _table_of(columns, file, lines, notes)


def _open_marks(cells_of: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a line for each column whose mark may be of decimals or of thousands (``1,250``)."""
    if not any("," in cells[0] + cells[-1] for cells in cells_of.values()):
        return []
    marked = {name: [c.strip() for c in cells if "," in c or "." in c] for name, cells in cells_of.items()}
    opened = {name: cells[0] for name, cells in marked.items() if cells and all(map(_OPEN.fullmatch, cells))}
    decimal = {re.sub(r"[^,.]", "", cell)[-1] for name in marked.keys() - opened for cell in marked[name]}
    return [
        Doubt(f"{name}: is {cell} a number of thousands? It is read as {cell.replace(',', '.')}")
        for name, cell in opened.items()
        if decimal - {cell.strip("+-0123456789")} or (not decimal and "," in cell)
    ]


def _table_of(columns: Sequence[Column], file: str, lines: NDArray[np.int64], notes: Sequence[str]) -> Table:
    numbers = {column.name: column.numbers for column in columns if column.numbers is not None}
    text = {column.name: column.text for column in columns if column.text is not None}
    all_notes = dict.fromkeys([*notes, *(note for column in columns for note in column.notes)])
    return Table(file, numbers, text, lines, notes=tuple(all_notes))


def _cell_rows(text: str, layout: Layout, file: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the first line and the cells of each row that is not empty."""
    stream = islice(io.StringIO(text, newline=""), layout.skip, None)
    reader = csv.reader(stream, delimiter=layout.separator)
    line = layout.skip + 1
    try:
        for cells in reader:
            if cells:
                yield line, cells
            line = layout.skip + reader.line_num + 1
    except csv.Error as error:
        raise UserError(f"cannot be split ({error})", file=file, row=line, hint="correct the row") from error


def read_column(
    name: str, cells: Sequence[str], lines: NDArray[np.int64], file: str, tolerated: float = _TOLERATED
) -> Column:
    """Return cells as numbers, a switch, or words; UserError for more that are none than are tolerated."""
    joined = "".join(cells)
    if joined.isascii() and "_" not in joined:  # which Python takes in numbers, and no file means so
        with suppress(ValueError):
            return Column(name, np.fromiter(map(float, cells), dtype=float, count=len(cells)))
    printed = [cell.strip() for cell in cells]
    cells = [_as_typed(cell) for cell in printed]
    values, wrong = _numbers_of(cells)
    notes = [] if cells == printed else ["numbers are as printed: a long minus, marks between thousands"]
    by_comma = wrong.size and any(map(_DECIMAL_COMMA.fullmatch, cells))
    if by_comma and all("." not in cell or _GROUPED.fullmatch(cell) for cell in cells):
        values, wrong = _numbers_of([cell.replace(".", "").replace(",", ".") for cell in cells])  # 1.234,5
        notes.append("numbers have a decimal comma")
    cells_known = len(cells) - sum(cell in _LOST_CELLS for cell in cells)
    if tolerated and wrong.size and (united := _without_unit(name, cells)) is not None:
        named, bare, factors = united
        column = read_column(named, bare, lines, file, tolerated)
        return replace(column, numbers=None if column.numbers is None else column.numbers * factors)
    first = cells[wrong[0]] if wrong.size else ""
    states = switched(cells) if tolerated else None
    if states is not None and np.isfinite(values).any() and len({cells[row].lower() for row in wrong}) > 1:
        return Column(name, text=cells)  # numbers and both states of a switch: readings of several signals
    if wrong.size <= 2 * tolerated * cells_known:
        if wrong.size:
            where = f"{name_rows(lines[wrong], 5)}: {_quoted_cell(first)}"
            notes = [f"{name}: {wrong.size} cell(s) that are no numbers left empty ({where})", *notes]
        return Column(name, values, notes=tuple(notes))
    if states is not None:
        return Column(name, states, notes=(f"{name}: words as {_quoted_cell(first)} read as 0 and 1",))
    if tolerated and (wrong.size >= _MOST * cells_known or STAMP.fullmatch(first)):
        return Column(name, text=["" if cell in _LOST_CELLS else cell for cell in cells])
    hint = f"write a number, leave the cell empty, or drop the column{' (- in --columns)' * bool(tolerated)}"
    if re.fullmatch(r"[+-]?\d+,\d+", first):
        hint = "write a decimal point"
    elif STAMP.fullmatch(first):
        hint = "write seconds since the first row"
    problem = f"{_quoted_cell(first)} is not a number"
    raise UserError(problem, file=file, row=int(lines[wrong[0]]), column=name, hint=hint)


def _numbers_of(cells: Sequence[str]) -> tuple[Array, NDArray[np.int64]]:
    """Return the numbers of cells, NaN where one is none, and which cells are neither numbers nor lost."""
    values = [float(cell) if _NUMBER_CELL.fullmatch(cell) else np.nan for cell in cells]
    wrong = [row for row, value in enumerate(values) if value != value and cells[row] not in _LOST_CELLS]
    return np.array(values), np.array(wrong, dtype=np.int64)


def _without_unit(name: str, cells: Sequence[str]) -> tuple[str, list[str], list[float]] | None:
    """Return a column's name, its cells without the units of one quantity (``1.2 kW``), and factors."""
    matches = [None if cell in _LOST_CELLS else _WITH_UNIT.fullmatch(cell) for cell in cells]
    if any(match is None and cell not in _LOST_CELLS for match, cell in zip(matches, cells)):
        return None
    read = {match[2]: read_header(f"x [{match[2]}]") for match in matches if match is not None}
    units = {header.unit for header in read.values()}
    if len(units) != 1 or "1" in units:
        return None
    named = name if read_header(name).unit != "1" else f"{name} [{next(iter(read))}]"
    scale = read_header(named).scale
    factors = [1.0 if match is None else read[match[2]].scale / scale for match in matches]
    return named, ["" if match is None else match[1] for match in matches], factors


def switched(cells: Sequence[str]) -> Array | None:
    """Return cells of numbers and a switch's two states as numbers; None where there are other words."""
    words = ["" if cell.strip() in _LOST_CELLS else cell.strip().lower() for cell in cells]
    values, wrong = _numbers_of(words)
    broken = [words[row] for row in wrong if any(map(str.isdigit, words[row]))]  # damaged
    states = {words[row] for row in wrong} - {*broken}
    if not states <= {*_SWITCH} or len({_SWITCH[state] for state in states}) < len(states):
        return None
    if len(broken) > _TOLERATED * (len(wrong) - len(broken)):
        return None
    values[wrong] = [_SWITCH.get(words[row], np.nan) for row in wrong]
    return values


def _quoted_cell(cell: str) -> str:
    return repr(cell if len(cell) <= 40 else cell[:37] + "...")


def frame_table(
    frame: DataFrame, file: str, *, text: Callable[[str], bool] | None = None, tolerated: float = _TOLERATED
) -> Table:
    """Return the columns of a DataFrame, its index among them unless that only counts rows."""
    import pandas as pd

    if not isinstance(frame.index, pd.RangeIndex):
        frame = frame.rename_axis(str(frame.index.name or "time")).reset_index()
    lines = np.arange(1, len(frame) + 1)
    columns: list[Column] = []
    for place, name in enumerate(map(str, frame.columns)):
        values = frame.iloc[:, place]
        if text is not None and text(name):
            words = values.astype(object).where(values.notna(), "").astype(str)
            columns.append(Column(name, text=words.tolist()))
        elif values.dtype.kind == "m":
            columns.append(Column(f"{name}_s", values.dt.total_seconds().to_numpy(dtype=float)))
        elif values.dtype.kind in "fiub":
            columns.append(Column(name, values.to_numpy(dtype=float, na_value=np.nan)))
        else:
            cells = [str(cell) for cell in values]
            columns.append(read_column(name, cells, lines, file, tolerated=tolerated))
    return _table_of(columns, file, lines, ())


def read_matlab_table(path: str | Path, columns: Sequence[str] | None = None) -> Table:
    """Return the columns of a MATLAB file (up to version 7): vectors and columns of matrices of one length (a
    matrix alone without names); a scalar ``Ts``, ``dt`` or ``fs`` is the step (``meta["dt"]``)."""
    check_source(path)
    import_module("scipy.io.matlab")  # here, so that each reader need not load it
    return limits.in_own_process(partial(_matlab_table, columns=columns), path)


def _matlab_table(path: Path, columns: Sequence[str] | None) -> Table:
    raw = read_bytes(path)
    if raw[:10] == b"MATLAB 7.3":
        raise UserError("is MATLAB 7.3", file=path, hint="save('x.mat', ..., '-v7') in MATLAB, or export CSV")
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadWarning

    source: Any = io.BytesIO(raw)  # the stubs know names only
    hint = "save the signals alone, as vectors or a matrix (no timeseries, datetimes, tables, functions)"
    with reading("is no MATLAB file, or is damaged", file=path, hint="save it again"):
        with as_user_error(TypeError, "has MATLAB's own objects among its variables", file=path, hint=hint):
            declared = sum(8 * math.prod(shape) for _, shape, _ in whosmat(source))
        limits.check_unpacked(len(raw), declared, file=path, what="declares")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MatReadWarning)  # of objects without names
            content = loadmat(source, simplify_cells=True)
    members = [*_matlab_members({k: v for k, v in content.items() if not k.startswith("__")})]
    arrays: dict[str, Array] = {}
    for name, value in members:
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.ndim in (1, 2):
            matrix = value[:, None] if value.ndim == 1 else value
            signals = matrix if len(matrix) >= matrix.shape[1] else matrix.T
            if len(signals) > 1 and signals.shape[1]:
                arrays[name] = np.asarray(signals, dtype=float)
    lengths = [values.shape[0] for values in arrays.values() for _ in range(values.shape[1])]
    if not lengths:
        raise UserError("has no columns of numbers", file=path, hint=hint)
    n = max(set(lengths), key=lambda length: (length * lengths.count(length), length))
    arrays_kept = {name: values for name, values in arrays.items() if values.shape[0] == n}
    numbers = {
        name if values.shape[1] == 1 else f"{name}_{place + 1}": values[:, place]
        for name, values in arrays_kept.items()
        for place in range(values.shape[1])
    }
    other_lengths = [name for name in arrays if name not in arrays_kept]
    notes = [f"left out, of another length: {', '.join(other_lengths)}"] if other_lengths else []
    if len(arrays_kept) == 1 and len(numbers) > 1:
        numbers = {f"c{place}": values for place, values in enumerate(numbers.values(), 1)}
        if columns is None:
            notes.append(f"no header: {_NAMELESS.format(len(numbers))}")
    if columns is not None:
        names = _new_names(columns, len(numbers), path)
        numbers = {k: v for k, v in zip(names, numbers.values()) if not k.startswith(_LEFT_OUT)}
    scalars = {name.lower(): value for name, value in members if isinstance(value, int | float) and value > 0}
    if "fs" in scalars:
        scalars.setdefault("dt", 1 / scalars["fs"])
    step = scalars.get("ts", scalars.get("dt"))
    meta = {} if step is None else {"dt": repr(float(step))}
    return Table(str(path), numbers, {}, np.arange(1, n + 1), meta=meta, notes=tuple(notes))


def _matlab_members(found: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield name and value of what a file holds, that of structures first."""
    for value in found.values():
        if isinstance(value, dict) and depth < 4:
            yield from _matlab_members(value, depth + 1)
    yield from found.items()


def read_excel_table(path: str | Path, columns: Sequence[str] | None = None) -> Table:
    """Return the largest sheet of an Excel workbook, read as its text would be."""
    raw = read_bytes(path)
    absent, hint = "needs the package openpyxl", "pip install openpyxl, or export CSV"
    with reading("is no Excel workbook, or is damaged", file=path, hint="export CSV"):
        with zipfile.ZipFile(io.BytesIO(raw)) as packed:
            limits.check_unpacked(len(raw), sum(entry.file_size for entry in packed.infolist()), file=path)
        import pandas as pd

        with as_user_error(ImportError, absent, file=path, hint=hint):
            sheets = pd.read_excel(io.BytesIO(raw), sheet_name=None, header=None, engine="openpyxl")
    largest = max(sheets, key=lambda name: sheets[name].size)
    table = parse_text(sheets[largest].to_csv(index=False, header=False).encode(), str(path), columns)
    others = ", ".join(name for name in sheets if name != largest and sheets[name].size)
    notes = [f"the sheet {largest} is read, the largest; others: {others}"] if others else []
    return replace(table, notes=(*notes, *table.notes))


def read_parquet_table(
    path: str | Path, *, text: Callable[[str], bool] | None = None, tolerated: float = _TOLERATED
) -> Table:
    """Return the columns of a Parquet file, with their units and roles; see :func:`frame_table`."""
    raw = read_bytes(path)
    import pyarrow.parquet as parquet

    with (
        reading("is not Parquet, or is damaged", file=path, hint="write or copy it again"),
        parquet.ParquetFile(io.BytesIO(raw), page_checksum_verification=True) as opened,
    ):
        _check_parquet(opened, len(raw), path)
        content = opened.read()
        frame = content.to_pandas(ignore_metadata=True)
        table = frame_table(frame, str(path), text=text, tolerated=tolerated)
        attrs = {entry.name: _decode(entry.metadata) for entry in content.schema}
        return replace(table, attrs=attrs, meta=_decode(content.schema.metadata))


def _check_parquet(opened: Any, packed: int, path: str | Path) -> None:
    """Refuse what is no column of a table, and a table that would be too large, before any of it is read."""
    import pyarrow.types as kinds

    for entry in opened.schema_arrow:
        if kinds.is_nested(entry.type):
            raise UserError(f"holds {entry.type}", file=path, column=entry.name, hint="leave it out")
    about, columns = opened.metadata, len(opened.schema_arrow)
    if columns > MOST_COLUMNS:
        raise UserError(f"has {columns} columns, more than {MOST_COLUMNS}", file=path, hint="leave some out")
    groups = [about.row_group(place) for place in range(about.num_row_groups)]
    rows = max(about.num_rows, sum(group.num_rows for group in groups))
    pages = sum(group.column(place).total_uncompressed_size for group in groups for place in range(columns))
    limits.check_unpacked(packed, max(8 * rows * columns, pages), file=path, what="declares")


def _decode(metadata: dict[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (metadata or {}).items()}


def _bytes_of(path: str | Path) -> bytes:
    """Return a file of text, unpacked, within the limits of :mod:`thermogrip.datasets.limits`."""
    data = read_bytes(path)
    opener: Any = {".gz": gzip.open, ".xz": lzma.open}.get(Path(path).suffix.lower())
    if opener is None:
        return data
    spoilt = reading("is damaged or not compressed as its name says", file=path, hint="copy it again")
    with spoilt, opener(io.BytesIO(data), "rb") as stream:
        unpacked = limits.read_within(stream, limits.most_unpacked(len(data)))
    limits.check_unpacked(len(data), len(unpacked), file=path)
    return unpacked


def _decoded(data: bytes, file: str, *, strict: bool = False) -> tuple[str, tuple[str, ...]]:
    """Return text in UTF-8, UTF-16 where its mark says so, else in Windows-1252, which is noted."""
    notes: tuple[str, ...] = ()
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    if not wide and (b"\0" in data[:4096] or data[:1] == b"\x80"):
        raise UserError("is not text, so it is not CSV", file=file, hint="export it as comma-separated text")
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        if wide:
            raise UserError("is damaged UTF-16 text", file=file, hint="save it as UTF-8") from error
        if strict:
            row = data.count(b"\n", 0, error.start) + 1
            raise UserError("is not UTF-8 text", file=file, row=row, hint="save the file as UTF-8") from error
        text = data.decode("cp1252", "replace")  # of spreadsheets
        notes = ("text is not UTF-8: read as Windows-1252; if names look wrong, save it as UTF-8",)
    if not text.strip():
        raise UserError("is empty", file=file, hint="give a header and at least two rows")
    return text if "\n" in text else text.replace("\r", "\n"), notes


def _iterate_lines(text: str, most: int | None = None) -> Iterator[str]:
    """Yield the lines without their ends, of at ``most`` so many characters; a list would be large."""
    return (line.rstrip("\n") for line in io.StringIO(text[:most], newline=None))
