"""Reports: one self-contained HTML page made of sections, tables and figures.

A report is a list of :class:`Section`; each says its verdict in words first and shows the evidence under it.
A :class:`Plot` can be zoomed and read point by point; on paper and without scripts it is the same figure at
rest, as all others are: inline SVG.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.files import provenance, write_atomic
from thermogrip.media.rendering import printable
from thermogrip.report.charts import Chart, Curve, Panel, draw_chart, thinned
from thermogrip.report.console import short

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

#: A sign and a word, so that a verdict does not depend on its colour.
ICONS = {"plain": "i Result", "good": "\u2713 Good", "warn": "! Caution", "bad": "\u2715 Bad"}
TONES = tuple(ICONS)
#: Cells of tables that are verdicts.
VERDICTS = {
    "pass": "good",
    "ok": "good",
    "warn": "warn",
    "misfit": "warn",
    "fail": "bad",
    "ill": "bad",
    "changing": "bad",
}


@dataclass(frozen=True)
class PageSettings:
    """How large a page may be: with these it is under 3 MB."""

    numbers: int = 200_000  # in all charts of a page, at most
    points: int = 2400  # in a curve, at most: more than a screen is wide
    fewest_points: int = 200  # in a curve of a page of many


SETTINGS = PageSettings()
_SUPERSCRIPT = re.compile(r"(\$\^\{-?[0-9.]+\}\$)")
_DOLLAR = re.compile(r"(?<!\\)\$")


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
            [(short(cell), _is_number(cell) or number) for cell, number in zip(row, over)]
            for row in self.rows
        ]

    @property
    def heads(self) -> list[tuple[str, bool]]:
        """Return (name, right-aligned) for every column."""
        return list(zip(self.head, self._over_numbers()))

    def _over_numbers(self) -> list[bool]:
        """Return for every column whether it holds numbers, and nothing else where one is missing."""
        columns = [[row[k] for row in self.rows if row[k] is not None] for k in range(len(self.head))]
        return [any(map(_is_number, cells)) and all(map(_is_number, cells)) for cells in columns]


@dataclass(frozen=True)
class Picture:
    """A matplotlib figure with the sentence that says what it shows."""

    figure: Figure
    caption: str
    kind: str = "picture"

    @property
    def data_uri(self) -> str:
        """Return the figure as a ``data:`` address."""
        return _data_uri(self.figure)


@dataclass(frozen=True)
class Plot:
    """A chart that can be zoomed, with the sentence that says what it shows."""

    chart: Chart
    caption: str
    kind: str = "plot"

    @property
    def data_uri(self) -> str:
        """Return the chart at rest as a ``data:`` address."""
        return _data_uri(draw_chart(self.chart))

    @property
    def size(self) -> Iterator[tuple[int, int]]:
        """Yield the points and the numbers a point of every curve."""
        for panel in chain.from_iterable(self.chart.columns):
            for curve in panel.curves:
                yield len(curve.x), 2 + 2 * (curve.low is not None)

    def data(self, most: int) -> Markup:
        """Return the chart as JSON that may stand in a script element, at most so many points a curve."""
        from markupsafe import Markup

        arrays: dict[str, int] = {}

        def place(values: Array | None) -> int | None:
            return None if values is None else arrays.setdefault(_packed(values), len(arrays))

        def plain_curve(curve: Curve) -> dict[str, Any]:
            few = thinned(curve, most)
            look = {"label": printable(few.label), "colour": few.colour, "width": few.width, "dash": few.dash}
            numbers = {name: place(getattr(few, name)) for name in ("x", "y", "low", "high")}
            return look | numbers | {"step": few.step}

        unit = re.search(r"\[(.+)\]", self.chart.x_label)

        def plain_panel(panel: Panel, *, last: bool) -> dict[str, Any]:
            words = {"label": printable(panel.label), "title": printable(panel.title)}
            look = {"height": panel.height, "log": panel.log, "shaded": panel.shaded, "marks": panel.marks}
            axis = {"last": last, "unit": f" {unit[1]}" if unit else ""}
            return words | look | axis | {"curves": [plain_curve(curve) for curve in panel.curves]}

        columns = [
            [plain_panel(panel, last=panel is column[-1]) for panel in column]
            for column in self.chart.columns
        ]
        head = {"x_label": self.chart.x_label, "log": self.chart.log}
        text = json.dumps(head | {"columns": columns, "arrays": list(arrays)}, allow_nan=False)
        return Markup(text.replace("<", "\\u003c"))


Part: TypeAlias = Text | Commands | Table | Picture | Plot


@dataclass(frozen=True)
class Section:
    """A question as heading, its answer in a sentence whose colour is the tone, and the evidence: the first
    ``shown`` parts, mostly one picture, stand open, the others are folded."""

    title: str
    parts: tuple[Part, ...]
    verdict: str = ""
    tone: str = "plain"
    shown: int = 1

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise ValueError(f"tone {self.tone!r} is none of {TONES}")


def html_page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return the page as text; ``lead`` says in a sentence or two what was done."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup, escape

    loader = PackageLoader("thermogrip", "templates")
    env = Environment(
        loader=loader,
        autoescape=True,  # names in files are other people's text
        undefined=StrictUndefined,
        finalize=lambda value: printable(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.filters["breakable"] = lambda name: escape(printable(name)).replace("_", Markup("_<wbr>"))
    template = env.get_template("report.html.j2")
    plots = [evidence for section in sections for evidence in section.parts if isinstance(evidence, Plot)]
    # styles, figures and script are in the page, which opens without a network; its content security policy
    # names the hashes of this script and this style alone
    script, style = _asset("report.js"), _asset("uPlot.min.css") + _asset("report.css")
    if plots:  # https://github.com/leeoniya/uPlot, version 1.6.32
        script = f"/*! {_asset('uPlot.LICENSE')} */\n{_asset('uPlot.iife.min.js')}\n{script}"
    signs = {"icons": ICONS, "marks": {tone: icon.split()[0] for tone, icon in ICONS.items()}}
    sources = {name: Markup(text) for name, text in (("style", style), ("script", script))}
    hashes = {f"{name}_hash": _source(text) for name, text in sources.items()}
    result = {"title": title, "lead": lead, "sections": sections, "points": _points(plots)}
    return template.render(**result, **signs, **sources, **hashes, verdicts=VERDICTS, provenance=provenance())


def write_report(path: Path, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write the page to ``path``, whole or not at all."""
    write_atomic(path, html_page(title, lead, sections))


def _points(plots: Sequence[Plot]) -> int:
    """Return the points that a curve may have, so that the page stays small."""
    sizes = [size for plot in plots for size in plot.size]
    most = SETTINGS.points
    while most > SETTINGS.fewest_points and sum(per * min(n, most) for n, per in sizes) > SETTINGS.numbers:
        most = int(0.9 * most)
    return most


@cache
def _asset(name: str) -> str:
    return (resources.files("thermogrip") / "templates" / name).read_text(encoding="utf-8")


def _source(text: str) -> str:
    """Return the hash of an inline script or style as a content security policy has it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _packed(values: Array) -> str:
    """Return numbers as base64 of little-endian float32."""
    # infinity too: the page's axes cannot have it
    with_gaps = np.where(np.isfinite(values), values, np.nan)
    return base64.b64encode(np.asarray(with_gaps, dtype="<f4").tobytes()).decode()


def _is_number(cell: Any) -> bool:
    return isinstance(cell, int | float)


def literal(figure: Figure) -> Figure:
    """Return the figure with every text in it set literally: no formula, no control character."""
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
    # only the superscripts of thermogrip's own units are formulas: every second piece
    pieces = _SUPERSCRIPT.split(printable(text))
    return "".join(piece if place % 2 else _DOLLAR.sub(r"\\$", piece) for place, piece in enumerate(pieces))


@contextmanager
def _letters() -> Iterator[None]:
    """Draw a label in letters that the font has not without a warning: the tables have the word."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def _data_uri(figure: Figure) -> str:
    from matplotlib import rc_context

    literal(figure)
    svg = io.BytesIO()
    look: dict[str, Any] = {"facecolor": "none"}  # the page's own paper shows, in the dark too
    for axes in figure.axes:
        axes.set_facecolor("none")
    with rc_context({"svg.hashsalt": "thermogrip"}), _letters():  # its ids are no random ones
        figure.savefig(svg, format="svg", dpi=130, metadata={"Date": None, "Creator": None}, **look)
    return "data:image/svg+xml;base64," + base64.b64encode(svg.getvalue()).decode()
