"""Tables of numbers on disk: CSV (plain, gzip or xz), NetCDF and Parquet, read without running code.

Reading is fast first and exact afterwards: the whole file is parsed at once, and only if that fails is it
read line by line to name the row and the column of the bad cell.  A last line that was cut off (a logger
that lost power) is dropped and noted; any other ragged line is refused.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import lzma
import os
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import os_fault, read_bytes, source_size
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import check_size, check_unpacked, most_bytes, read_within, unpack_within
from thermogrip.datasets.media import from_csv

FORMATS = {
    ".csv": "csv", ".csv.gz": "csv", ".csv.xz": "csv",
    ".nc": "netcdf", ".h5": "netcdf", ".hdf5": "netcdf",
    ".parquet": "parquet", ".pq": "parquet",
    ".bag": "rosbag", ".db3": "rosbag", ".mcap": "rosbag",
}  # fmt: skip

MOST_COLUMNS = 4096  # of a table
_BEGINNING = 16 << 20  # bytes of a file that are looked at before it is read
_MOST_EMPTY = 1_000_000  # lines without a cell that are passed over

_NULLS = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan", "#N/A"]
_DATE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}|\d{1,2}:\d{2}")  # how a date or a time of day begins
_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|infinity)", re.ASCII | re.IGNORECASE
)


@dataclass(frozen=True)
class Table:
    """Columns of one file: numbers as float, text as str, and the file's line of each row.

    ``attrs`` holds the format's entries for each column (``units``, ``role``), ``meta`` those for the whole
    file, ``notes`` what the reader repaired.
    """

    file: str
    numbers: dict[str, NDArray[np.float64]]
    text: dict[str, list[str]]
    lines: NDArray[np.int64]
    attrs: dict[str, dict[str, str]] = field(default_factory=dict)
    meta: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    separator: str = ","


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
    name = Path(path).name.lower()
    return next(
        (e for e in sorted(FORMATS, key=len, reverse=True) if name.endswith(e)), Path(path).suffix.lower()
    )


def read_csv_table(
    path: str | Path, *, text: Callable[[str], bool] | frozenset[str] | None = frozenset()
) -> Table:
    """Return the columns of a CSV file, plain, ``.gz`` or ``.xz``.

    Lines that start with ``#`` before the header are skipped. The separator is a comma, or a semicolon or tab
    if the header has no comma; then numbers may have a decimal comma, which is noted. ``text`` names the
    columns to leave as text, or states that of a header; None is all of them.
    """
    file = str(path)
    data = _text_of(path)
    header, skip, separator = _header(data, file)
    is_text = text if callable(text) else lambda name: text is None or name in text
    types = {name: "text" if is_text(name) else "number" for name in header}
    data, table, notes = _parse_as_written(data, skip, separator, types)
    if table is None:
        _name_fault(data, skip, separator, types, file)
        raise UserError(
            "is not a table of numbers", file=file, hint="open it in an editor and compare its rows"
        )
    _check_empty(data, table.num_rows, file)
    lines = _line_numbers(data, skip, table.num_rows)
    if not lines.size:
        raise UserError("has a header but no rows", file=file, hint="give at least two rows")
    numbers = {n: _to_float(table.column(n)) for n, kind in types.items() if kind == "number"}
    texts = [name for name, kind in types.items() if kind == "text"]
    strings = {name: [from_csv(v.strip()) for v in table.column(name).to_pylist()] for name in texts}
    return Table(file=file, numbers=numbers, text=strings, lines=lines, notes=notes, separator=separator)


def text_numbers(table: Table, header: str) -> NDArray[np.float64]:
    """Return the numbers (n_row,) of a column that was left as text, NaN where a cell is empty."""
    cells = table.text[header]
    values = np.full(len(cells), np.nan)
    for at, cell in enumerate(cells):
        if cell.lower() in ("", "nan", "na"):
            continue
        decimal_comma = table.separator != "," and re.fullmatch(r"[+-]?\d+,\d+", cell)
        try:
            values[at] = float(cell.replace(",", ".") if decimal_comma else cell)
        except ValueError:
            hint = "write a number, or leave the cell empty if it is unknown"
            row, problem = int(table.lines[at]), f"{cell!r} is not a number"
            raise UserError(problem, file=table.file, row=row, column=header, hint=hint) from None
    return values


def read_parquet_table(path: str | Path) -> Table:
    """Return the numeric columns of a Parquet file, with the units and roles of its columns."""
    import pyarrow as pa

    numbers, attrs = {}, {}
    raw = read_bytes(path)
    try:
        with _open_parquet(path, io.BytesIO(raw), len(raw)) as opened:
            table = opened.read()
        for entry in table.schema:
            numbers[entry.name] = _to_float(table.column(entry.name).cast(pa.float64()))
            attrs[entry.name] = _decode(entry.metadata)
        meta = _decode(table.schema.metadata)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise _no_parquet(path) from error
    return Table(str(path), numbers, {}, np.arange(1, table.num_rows + 1), attrs, meta)


def _open_parquet(path: str | Path, source: Any, packed: int) -> Any:
    """Return the open file, its columns and sizes checked."""
    import pyarrow as pa
    import pyarrow.parquet as parquet

    check_size(packed, file=path)
    try:
        opened = parquet.ParquetFile(source, page_checksum_verification=True)
        _check_parquet(opened, packed, path)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise _no_parquet(path) from error
    return opened


def _no_parquet(path: str | Path) -> UserError:
    return UserError("is not Parquet, or is damaged", file=path, hint="write or copy it again")


def _check_parquet(opened: Any, packed: int, path: str | Path) -> None:
    """Refuse columns that are no numbers, and a table that would be too large, before any of it is read."""
    for entry in opened.schema_arrow:
        if not _is_number(entry.type):
            problem = f"holds {entry.type}, not numbers"
            raise UserError(problem, file=path, column=entry.name, hint="leave it out")
    about, columns = opened.metadata, len(opened.schema_arrow)
    if columns > MOST_COLUMNS:
        raise UserError(f"has {columns} columns, more than {MOST_COLUMNS}", file=path, hint="leave some out")
    groups = [about.row_group(at) for at in range(about.num_row_groups)]
    rows = max(about.num_rows, sum(group.num_rows for group in groups))
    pages = sum(group.column(at).total_uncompressed_size for group in groups for at in range(columns))
    check_unpacked(packed, max(8 * rows * columns, pages), file=path, what="declares")


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))


def _decode(metadata: dict[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (metadata or {}).items()}


def _to_float(chunked: Any) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.asarray(chunked.to_numpy(zero_copy_only=False), dtype=float)
    return values.copy()


def check_table(path: str | Path) -> None:
    """Refuse a file that is no table of numbers by its name, its beginning and what it declares.

    It loads neither pandas nor xarray.  What a shell passes on is read once, so it is not looked at here.
    """
    kind = file_format(path)
    if os.path.exists(path) and not source_size(path) and not os.path.isfile(path):
        return
    if kind == "csv":
        text = _text_of(path, _BEGINNING)
        if len(text) < _BEGINNING // 2 or not text.startswith(b"#"):
            _header(text, str(path))
    elif kind == "parquet":
        _open_parquet(path, str(path), source_size(path)).close()
    elif kind == "netcdf":
        from thermogrip.datasets.netcdf import check_netcdf

        check_netcdf(path)


def _text_of(path: str | Path, most: int | None = None) -> bytes:
    """Return the text of a file, unpacked, within the limits of :mod:`thermogrip.datasets.limits`.

    ``most`` is how much of its beginning is enough [bytes].
    """
    check_size(source_size(path), file=path)
    openers: dict[str, Any] = {".gz": gzip.open, ".xz": lzma.open}
    opener = openers.get(Path(path).suffix.lower())
    try:
        with open(path, "rb") as file:
            if opener is None:
                data = read_within(file, most_bytes() if most is None else most)
            else:
                with opener(file, "rb") as stream:
                    _check_text(stream.read(4096), path)
                    stream.seek(0)
                    data = unpack_within(stream, file, file=path, most=most)
    except (gzip.BadGzipFile, lzma.LZMAError, zlib.error, EOFError) as error:
        problem = "is damaged or not compressed as its name says"
        raise UserError(problem, file=path, hint="copy it again") from error
    except OSError as error:
        raise os_fault(error, path) from error
    if most is None:
        check_size(len(data), file=path)  # a pipe says no size, and a file may grow
    data = _as_utf8(data, path, whole=most is None).removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    _check_text(data[:4096], path)
    if not data.strip():
        raise UserError("is empty", file=path, hint="give a header and at least two rows")
    return data


def _check_text(start: bytes, path: str | Path) -> None:
    if not start.startswith((b"\xff\xfe", b"\xfe\xff")) and (b"\0" in start or start[:1] == b"\x80"):
        raise UserError("is not text, so it is not CSV", file=path, hint="export it as comma-separated text")


def _as_utf8(data: bytes, path: str | Path, *, whole: bool) -> bytes:
    """Return UTF-16 text, as spreadsheets write it, in UTF-8; any other bytes as they are."""
    if not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data
    try:
        return codecs.getincrementaldecoder("utf-16")().decode(data, whole).encode("utf-8")
    except UnicodeDecodeError as error:
        raise UserError("is damaged UTF-16 text", file=path, hint="save it as UTF-8") from error


def _header(data: bytes, file: str) -> tuple[list[str], int, str]:
    """Return column names, the number of lines before the first row, and the separator."""
    lines = enumerate(io.BytesIO(data), start=1)
    first = next(((at, raw) for at, raw in lines if raw.strip() and not raw.startswith(b"#")), None)
    if first is None:
        raise UserError("has only comments", file=file, hint="give a header and at least two rows")
    skip, raw = first
    try:
        line = raw.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        raise UserError(
            "the header is not UTF-8 text", file=file, row=skip, hint="save it as UTF-8"
        ) from error
    separator = next((s for s in ",;\t" if s in line), ",")
    try:
        header = [from_csv(cell.strip()) for cell in next(csv.reader([line], delimiter=separator))]
    except csv.Error as error:  # such as a carriage return alone between two names
        raise UserError(
            "the header is no line of names", file=file, row=skip, hint="end every line with a line feed"
        ) from error
    if len(header) > MOST_COLUMNS:
        problem = f"the header has {len(header)} names, more than {MOST_COLUMNS}"
        raise UserError(problem, file=file, row=skip, hint="leave out what is not needed")
    seen: set[str] = set()
    for at, name in enumerate(header):
        if not name:
            raise UserError(f"column {at + 1} has no name", file=file, row=skip, hint="name it or remove it")
        if name in seen:
            raise UserError("occurs twice", file=file, row=skip, column=name, hint="rename one of them")
        seen.add(name)
    if all(_NUMBER.fullmatch(name) for name in header):
        hint = "write a first line such as time_s,drive,t_tank_degC"
        raise UserError("has no header, only numbers", file=file, row=skip, hint=hint)
    return header, skip, separator


def _parse_as_written(
    data: bytes, skip: int, separator: str, types: dict[str, str]
) -> tuple[bytes, Any, tuple[str, ...]]:
    """Return the bytes, their pyarrow table or None, and what had to be allowed for to get one."""
    tries: list[tuple[bytes, tuple[str, ...]]] = [(data, ())]
    cut, lost = _drop_cut_line(data, len(types), separator)
    tries += [(cut, lost)] if lost else []
    for body, dropped in tries:
        for decimal in "." if separator == "," else ".,":
            table = _parse(body, skip, separator, types, decimal)
            if table is not None:
                commas = () if decimal == "." else ("numbers have a decimal comma",)
                return body, table, (*dropped, *commas)
    return cut, None, lost


def _parse(data: bytes, skip: int, separator: str, types: dict[str, str], decimal: str) -> Any:
    """Return the pyarrow table, or None where a row or a cell does not fit."""
    import pyarrow as pa
    import pyarrow.csv as arrow_csv

    block = min(max(len(data), 1024) + 1, 1 << 30)
    try:
        return arrow_csv.read_csv(
            pa.BufferReader(data),
            read_options=arrow_csv.ReadOptions(
                use_threads=False, skip_rows=skip, column_names=list(types), block_size=block
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=separator),
            convert_options=arrow_csv.ConvertOptions(
                column_types={
                    n: pa.string() if kind == "text" else pa.float64() for n, kind in types.items()
                },
                null_values=_NULLS,
                strings_can_be_null=False,
                decimal_point=decimal,
            ),
        )
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
                raise UserError(
                    "is not UTF-8 text", file=file, row=line, hint="save the file as UTF-8"
                ) from error
            except csv.Error as error:
                raise UserError(
                    f"cannot be split ({error})", file=file, row=line, hint="correct the row"
                ) from error


def _name_fault(data: bytes, skip: int, separator: str, types: dict[str, str], file: str) -> None:
    """Raise the error that names the first bad row or cell."""
    for line, cells in _rows(data, skip, separator, file):
        if len(cells) != len(types):
            problem = f"has {len(cells)} cell(s), the header has {len(types)}"
            raise UserError(problem, file=file, row=line, hint="complete or remove the row")
        for (name, kind), cell in zip(types.items(), cells, strict=True):
            if kind == "number" and cell.strip() not in _NULLS and not _NUMBER.fullmatch(cell.strip()):
                comma = re.fullmatch(r"\s*[+-]?\d+,\d+\s*", cell)
                hint = (
                    "write a decimal point"
                    if comma
                    else "write a number, leave the cell empty, or drop the column"
                )
                if _DATE.match(cell.strip()):
                    hint = "write seconds since the first row"
                shown = cell if len(cell) <= 40 else cell[:37] + "..."
                raise UserError(f"{shown!r} is not a number", file=file, row=line, column=name, hint=hint)


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
