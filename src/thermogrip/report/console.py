"""What the command line says and where: tables and answers on stdout, progress and errors on stderr.

Names, notes and messages are other people's text: what would steer a terminal is written out.

A verb builds one answer (a dict) and, for people, a few tables.  With ``--json`` the answer is the only thing
on stdout; numbers that are not finite become ``null`` because JSON has no word for them.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeAlias

from thermogrip.datasets.media import printable
from thermogrip.datasets.parallel import Progress

#: Head and rows of a table.
Cells: TypeAlias = tuple[tuple[str, ...], tuple[tuple[Any, ...], ...]]
#: The columns of a table: their names, and what each shows of an item.
Columns: TypeAlias = Sequence[tuple[str, Callable[[Any], Any]]]


@dataclass(frozen=True)
class Console:
    """What one verb prints; with ``as_json`` stdout has the JSON answer and nothing else."""

    as_json: bool = False

    def say(self, text: str) -> None:
        """Print one line for people."""
        if not self.as_json:
            sys.stdout.write(printable(text) + "\n")

    def warn(self, text: str) -> None:
        """Print one warning on stderr, with ``--json`` too."""
        sys.stderr.write(f"thermogrip: warning: {printable(text)}\n")

    def table(self, title: str, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Print a table for people; numbers stand to the right."""
        if self.as_json:
            return
        from rich import box
        from rich.console import Console as RichConsole
        from rich.table import Table

        table = Table(
            title=printable(title),
            title_justify="left",
            title_style="bold",
            box=box.SIMPLE_HEAD,
            pad_edge=False,
        )
        for k, name in enumerate(head):
            numeric = all(isinstance(row[k], int | float) or row[k] is None for row in rows)
            table.add_column(printable(name), justify="right" if numeric else "left", overflow="fold")
        for row in rows:
            table.add_row(*(printable(short(cell)) for cell in row))
        console = RichConsole(file=sys.stdout, highlight=False, markup=False, emoji=False)
        if not console.is_terminal:
            console.width = max(console.width, 140)
        with console.capture() as shown:  # it would make a closed pipe exit code 1
            console.print(table)
        sys.stdout.write(shown.get())

    def answer(self, result: Mapping[str, Any]) -> None:
        """Print the JSON answer where ``--json`` asked for it."""
        if self.as_json:
            sys.stdout.write(json.dumps(plain(result), indent=1, allow_nan=False) + "\n")

    @contextmanager
    def progress(self, title: str) -> Iterator[Progress]:
        """Show a bar on stderr while the block runs, which waits but never goes back where work turns out
        longer; without a terminal, a line whenever the work changes."""
        if not sys.stderr.isatty():
            yield _onward(_lines(title))
            return
        from rich.console import Console as RichConsole
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress

        columns = (
            TextColumn(printable(title), markup=False),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}", markup=False),
        )
        with RichProgress(*columns, console=RichConsole(stderr=True), transient=True) as bars:
            task = bars.add_task("", total=1.0)

            def show(fraction: float, what: str) -> None:
                bars.update(task, completed=fraction, description=printable(what))

            yield _onward(show)


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
    if isinstance(value, float):
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
        return f"{cell:.4g}" if math.isfinite(cell) else "-"
    return str(cell)


def _onward(show: Progress) -> Progress:
    """Return a callback that passes on the largest fraction so far, inside 0 to 1."""
    most = 0.0

    def forward(fraction: float, what: str) -> None:
        nonlocal most
        most = min(max(most, fraction), 1.0)
        show(most, what)

    return forward


def _lines(title: str) -> Progress:
    """Return a callback that writes a line a change, at most one for each twentieth of the work."""
    last: list[Any] = [-1, ""]
    begin = time.monotonic()

    def show(fraction: float, what: str) -> None:
        stage, step = what.split(":")[0], int(20 * fraction)
        if stage != last[1] or step != last[0]:
            done = f"{100 * fraction:3.0f} % {time.monotonic() - begin:4.0f} s"
            sys.stderr.write(f"{printable(title)} {done} {printable(what)}\n")
            sys.stderr.flush()
        last[:] = [step, stage]

    return show
