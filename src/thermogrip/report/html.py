"""Reports: one self-contained HTML page made of sections, tables and figures.

A report is a list of :class:`Section`; each says its verdict in words first and shows the evidence under it.
Figures go in as inline SVG (as PNG where the SVG would be large), so that the page is one file which opens
without a network and without scripts.  Every text is escaped by the template.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from thermogrip import __version__
from thermogrip.datasets.atomic_files import write_atomic
from thermogrip.datasets.media import printable
from thermogrip.report.console import short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TONES = ("plain", "good", "warn", "bad")
_SUPERSCRIPT = re.compile(r"(\$\^\{-?[0-9.]+\}\$)")
_DOLLAR = re.compile(r"(?<!\\)\$")
#: An SVG larger than this goes in as PNG [bytes].
SVG_LIMIT = 250_000


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    kind: str = "text"


@dataclass(frozen=True)
class Commands:
    """Commands as typed, a line each."""

    lines: tuple[str, ...]
    kind: str = "commands"


@dataclass(frozen=True)
class Table:
    """A table; numbers are shortened to four digits and stand to the right."""

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    caption: str = ""
    dense: bool = False  # small type and unbroken cells: many columns of numbers with their intervals
    kind: str = "table"

    @property
    def cells(self) -> list[list[tuple[str, bool]]]:
        """Return (text, right-aligned) for every cell: a number, or its absence among numbers."""
        over = self._over_numbers()
        return [
            [(short(cell), _number(cell) or number) for cell, number in zip(row, over)] for row in self.rows
        ]

    @property
    def heads(self) -> list[tuple[str, bool]]:
        """Return (name, right-aligned) for every column."""
        return list(zip(self.head, self._over_numbers()))

    def _over_numbers(self) -> list[bool]:
        """Return for every column whether it holds numbers, and nothing else where one is missing."""
        columns = [[row[k] for row in self.rows if row[k] is not None] for k in range(len(self.head))]
        return [any(map(_number, cells)) and all(map(_number, cells)) for cells in columns]


@dataclass(frozen=True)
class Picture:
    """A matplotlib figure with the sentence that says what it shows."""

    figure: Figure
    caption: str
    kind: str = "picture"

    @property
    def data_uri(self) -> str:
        """Return the figure as a ``data:`` address, SVG or PNG."""
        return _data_uri(self.figure)


Part: TypeAlias = Text | Commands | Table | Picture


@dataclass(frozen=True)
class Section:
    """A question as heading, its answer in a sentence whose colour is the tone, and the evidence."""

    title: str
    parts: tuple[Part, ...]
    verdict: str = ""
    tone: str = "plain"

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise ValueError(f"tone {self.tone!r} is none of {TONES}")


def html_page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return the page as text; ``lead`` says in a sentence or two what was done."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("thermogrip", "templates")
    env = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalize,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = env.get_template("report.html.j2")
    return template.render(title=title, lead=lead, sections=sections, version=__version__)


def write_report(path: Path, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write the page to ``path``, whole or not at all."""
    write_atomic(path, html_page(title, lead, sections))


def _number(cell: Any) -> bool:
    return isinstance(cell, int | float)


def _finalize(value: Any) -> Any:
    """Return what the template prints, text without control characters."""
    return printable(value) if type(value) is str else value


def literal(figure: Figure) -> Figure:
    r"""Return the figure with every text in it set literally: no formula, no control character.

    Only the superscripts that thermogrip's own units have are formulas.
    """
    from matplotlib.text import Text as FigureText
    from matplotlib.ticker import FixedFormatter, Formatter, FuncFormatter

    for text in figure.findobj(FigureText):
        if isinstance(text, FigureText):
            text.set_text(_literal(text.get_text()))

    def kept(formatter: Formatter) -> FuncFormatter:
        return FuncFormatter(lambda value, place: _literal(formatter(value, place)))

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            formatter = axis.get_major_formatter()
            if isinstance(formatter, FixedFormatter | FuncFormatter):  # it writes the ticks' texts when drawn
                axis.set_major_formatter(kept(formatter))
    return figure


def _literal(text: str) -> str:
    parts = _SUPERSCRIPT.split(printable(text))  # own superscripts are every second part
    return "".join(part if at % 2 else _DOLLAR.sub(r"\\$", part) for at, part in enumerate(parts))


def _data_uri(figure: Figure) -> str:
    literal(figure)
    svg = io.BytesIO()
    with warnings.catch_warnings():
        # a label in letters that the font has not: the tables have the word
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    if svg.tell() <= SVG_LIMIT:
        return "data:image/svg+xml;base64," + base64.b64encode(svg.getvalue()).decode()
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=130)
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode()
