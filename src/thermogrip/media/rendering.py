"""Text of others, written so that no medium takes it for its own language.

Names of columns, files, materials, and what a device sends are anybody's text.  A terminal obeys an ESC
sequence, a spreadsheet computes ``=1+1``, and Markdown makes a link of ``[a](b)``.  One function a medium
takes that meaning away where the medium is written, so that records keep the text as it was; HTML's own
characters are escaped by the template, and ``$x$`` in figures by :func:`thermogrip.report.html.literal`.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

# C0 but tab and line feed, DEL, C1, line and paragraph separators, and what turns the direction of writing
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)
_USER = re.compile(r"(?<=://)[^/@\s]+(?=@)")
_FORMULA = re.compile(r"'*[=+\-@\t].")
_FLOAT_TEXT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|nan)", re.ASCII)
_MARKDOWN = re.compile(r"[\\`\[\]<>|*#!]")


def printable(text: str) -> str:
    r"""Return text with every control character written out."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def without_password(address: str) -> str:
    """Return an address without the user and the password that it may name (``ws://me:secret@robot``)."""
    return _USER.sub("...", address)


def csv_cell(cell: object) -> object:
    """Return a cell that is no formula (an apostrophe is put before it) and one line."""
    if not isinstance(cell, str):
        return cell
    text = printable(cell).replace("\n", "\\n")
    return "'" + text if _FORMULA.match(text) and not _FLOAT_TEXT.fullmatch(text) else text


def from_csv(cell: str) -> str:
    """Return the text that :func:`csv_cell` wrote; control characters stay written out."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    r"""Return rows as CSV text, lines ended by a line feed."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([csv_cell(cell) for cell in row] for row in rows)
    return out.getvalue()


def markdown(text: str) -> str:
    r"""Return text as Markdown shows it, on one line."""
    return _MARKDOWN.sub(lambda found: "\\" + found[0], printable(" ".join(text.split())))


def panels(
    down: int,
    across: int,
    *,
    size: tuple[float, float],
    heights: Sequence[float] | None = None,
    sharex: Any = False,
    sharey: Any = False,
    ticks: float = 8,
) -> tuple[Figure, NDArray[Any]]:
    """Return a figure and its (down, across) axes in thermogrip's style, without ``pyplot``, which asks for a
    window system and leaves global state behind."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(down, across, squeeze=False, sharex=sharex, sharey=sharey, height_ratios=heights)
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=ticks)
        axis.xaxis.label.set_fontsize(8)
        axis.yaxis.label.set_fontsize(8)
        axis.grid(True, lw=0.4, color="#e6eaef")
        axis.set_axisbelow(True)
    return figure, axes


class Shown:
    """Base of results that show a few facts of themselves."""

    def _facts(self) -> Mapping[str, object]:
        """Return what is shown, by name."""
        raise NotImplementedError

    def __repr__(self) -> str:
        lines = [printable(f"  {name:16}  {fact}") for name, fact in self._facts().items()]
        lines = lines if len(lines) < 12 else [*lines[:9], "  ...", lines[-1]]  # the last one is the verdict
        cut = [line if len(line) <= 110 else f"{line[:107]}..." for line in lines]
        return "\n".join([type(self).__name__, *cut])

    def _repr_html_(self) -> str:
        rows = ((escape(printable(f"{cell}")) for cell in fact) for fact in self._facts().items())
        body = "".join(f"<tr><th>{name}</th><td>{what}</td></tr>" for name, what in rows)
        return f'<table style="text-align: left"><caption>{type(self).__name__}</caption>{body}</table>'
