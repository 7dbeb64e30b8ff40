"""What the command line says and where: tables and answers on stdout, progress and errors on stderr.

Names, notes and messages are other people's text: what would steer a terminal is written out.

A verb builds one answer (a dict) and, for people, a few tables.  With ``--json`` the answer is the only thing
on stdout.
"""

from __future__ import annotations

import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from itertools import zip_longest
from pathlib import Path
from shutil import get_terminal_size
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any, TypeAlias

from thermogrip.media.rendering import printable

if TYPE_CHECKING:
    from thermogrip.datasets.parallel import Progress


@dataclass(frozen=True)
class ConsoleSettings:
    """How wide text is, and from when on a bar says the time left (judged by eye)."""

    width: int = 100  # columns of what is written to no terminal
    begun_before_s: float = 0.5  # work that reports a share sooner was begun by somebody else
    foreseeable_share: float = 0.05  # of the work, before its time tells how long the rest will take


SETTINGS = ConsoleSettings()
#: Head and rows of a table.
Cells: TypeAlias = tuple[tuple[str, ...], tuple[tuple[Any, ...], ...]]
#: The columns of a table: their names, and what each shows of an item.
Columns: TypeAlias = Sequence[tuple[str, Callable[[Any], Any]]]


@dataclass(frozen=True)
class Console:
    """What one verb prints; with ``as_json`` stdout has the JSON answer and nothing else."""

    as_json: bool = False

    def say(self, text: str) -> None:
        """Print a sentence for people, as wide as the terminal (100 columns of what is none); lines that end
        stay as they are."""
        if not self.as_json:
            if "\n" not in text:
                indent = " " * (len(text) - len(text.lstrip()))
                lines = TextWrapper(_room(), subsequent_indent=indent)
                lines.break_long_words = lines.break_on_hyphens = False
                text = lines.fill(text)
            sys.stdout.write(printable(text) + "\n")

    def warn(self, text: str) -> None:
        """Print one warning on stderr, with ``--json`` too."""
        sys.stderr.write(f"{_anew()}thermogrip: warning: {printable(text)}\n")

    def table(
        self, title: str, head: Sequence[str], rows: Sequence[Sequence[Any]], *, wrap: bool = True
    ) -> None:
        """Print a table for people, as wide as the terminal (100 columns of what is none), or not wrapped;
        numbers stand to the right, a word is broken only after an underscore, where the columns are too many,
        and where they still are each row is a block of lines."""
        if not self.as_json:
            sys.stdout.write(_table(title, head, rows, _room() if wrap else sys.maxsize))

    def early(self, line: str, title: str, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Show on stderr, while work goes on, what is known so far: on a terminal a table, else one line."""
        terminal = sys.stderr.isatty()
        table = _anew() + _table(title, head, rows, get_terminal_size().columns) if terminal else ""
        sys.stderr.write(table or printable(line) + "\n")
        sys.stderr.flush()

    def answer(self, result: Mapping[str, Any]) -> None:
        """Print the JSON answer where ``--json`` asked for it."""
        if self.as_json:
            sys.stdout.write(json.dumps(plain(result), indent=1, allow_nan=False) + "\n")

    @contextmanager
    def progress(self, title: str) -> Iterator[Progress]:
        """Show on stderr how far the work is while the block runs: on a terminal a line that is written anew,
        else a line whenever the work changes, at most one for each twentieth of it."""
        try:
            yield _progress_lines(printable(title))
        finally:
            sys.stderr.write(_anew())


def _room() -> int:
    """Return the columns of stdout."""
    return get_terminal_size().columns if sys.stdout.isatty() else SETTINGS.width


def cells(columns: Columns, items: Iterable[Any]) -> Cells:
    """Return the table of some items, a row an item."""
    rows = (tuple(show(item) for _, show in columns) for item in items)
    return tuple(name for name, _ in columns), tuple(rows)


def plain(value: Any) -> Any:
    """Return the value as what JSON can hold: dicts, lists, text, numbers, null."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return plain(value.tolist())
    if isinstance(value, int):
        return value
    if isinstance(value, float):  # JSON has no word for what is not finite
        return value if math.isfinite(value) else None
    return str(value)


def short(cell: Any) -> str:
    """Return one table cell as text: four significant digits, a dash for what is absent."""
    if cell is None:
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if hasattr(cell, "item"):
        cell = cell.item()
    if isinstance(cell, float):
        return significant(cell, 4) if math.isfinite(cell) else "-"
    return str(cell)


def significant(value: float, digits: int) -> str:
    """Return a number with so many digits, without an exponent below a million.

    >>> significant(63970.4, 4), significant(1580.2, 3), significant(0.0712, 3), significant(2.5e7, 3)
    ('63970', '1580', '0.0712', '2.5e+07')
    """
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[Any]], width: int) -> str:
    """Return the text of a table that is so many columns wide."""
    cells = [[printable(name) for name in head], *([printable(short(c)) for c in row] for row in rows)]
    columns = range(len(head))
    numeric = [all(isinstance(row[k], int | float) or row[k] is None for row in rows) for k in columns]
    room = width - 2 * (len(head) - 1)
    wrapper = TextWrapper(break_on_hyphens=False)
    for breaks in (r"(\s+)", r"(\s+|(?<=_))"):  # names of logs and columns are long, and have no blanks
        wrapper.wordsep_simple_re = re.compile(breaks)
        least = [max(len(word) for row in cells for word in re.split(breaks, row[k])) for k in columns]
        wide = [max(len(row[k]) for row in cells) for k in columns]
        while sum(wide) > room and (open_ := [k for k in columns if wide[k] > least[k]]):
            wide[max(open_, key=lambda k: wide[k])] -= 1
        if sum(wide) <= room:
            break
    lines = [printable(title), ""]
    for row_number, row in enumerate(cells):
        if sum(wide) > room:
            named = [f"{name}: {cell}" if name else cell for name, cell in zip(cells[0], row)]
            lines += [*named, ""] if row_number else []
            continue
        wrapped = []
        for k in columns:
            wrapper.width = wide[k]
            wrapped.append(wrapper.wrap(row[k]))
        for line_cells in zip_longest(*wrapped, fillvalue=""):
            aligned = (
                words.rjust(w) if n else words.ljust(w) for words, w, n in zip(line_cells, wide, numeric)
            )
            lines.append("  ".join(aligned).rstrip())
        lines += ["  ".join("-" * w for w in wide)] if row_number == 0 else []
    return "\n".join([*lines, "", ""])


def _anew() -> str:
    """Return what clears the last line of a terminal; nothing where stderr is none."""
    return "\r\x1b[K" if sys.stderr.isatty() else ""


def _progress_lines(title: str) -> Progress:
    """Return a callback that writes how far the work is, with the time left where it is over 10 s."""
    last: list[Any] = [-1, "", 0.0]
    begin, first = time.monotonic(), list[float]()  # work that was begun before goes on at its share

    def show(fraction: float, what: str) -> None:
        # where work turns out to be longer than was thought, the bar waits: it never goes back
        fraction = min(max(fraction, last[2]), 1.0)
        stage = what.split(":")[0]
        step = int(20 * fraction)
        spent = time.monotonic() - begin
        clear = _anew()
        first[:] = first or [fraction if spent < SETTINGS.begun_before_s else 0.0]
        left_s = spent * (1 - fraction) / max(fraction - first[0], 1e-3)
        is_foreseeable = (
            fraction - first[0] > SETTINGS.foreseeable_share and spent > 1 and spent + left_s > 10
        )
        remaining = f", {left_s:.0f} s left" if is_foreseeable else ""
        line = f"{title} {100 * fraction:3.0f} % {spent:4.0f} s{remaining} {printable(what)}"
        if clear:
            sys.stderr.write(clear + f"[{'#' * step:.<20}] {line}"[: get_terminal_size().columns - 1])
        elif stage != last[1] or step != last[0]:
            sys.stderr.write(line + "\n")
        sys.stderr.flush()
        last[:] = [step, stage, fraction]

    return show
