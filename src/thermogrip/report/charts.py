"""Charts: curves over a shared axis in panels, as data.

A :class:`Chart` is what a page draws anew at every zoom (:mod:`thermogrip.report.html`) and what
:func:`draw_chart` sets as a matplotlib figure, for print and for readers without scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.media.rendering import panels

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# after Okabe and Ito: eight colours that are distinct under every kind of colour-vision deficiency
PALETTE = ("#1f5fa8", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8a5a00")
DASHES = ("-", "--", ":", "-.")
INK = "#1d2733"  # of targets
SOFT = "#8795a3"  # of limits
SHADE = "#e6eaef"  # of what is not scored
_STILL = 400  # points of a curve on paper


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a panel, or marks, or a band."""

    label: str  # curves of one label share an entry of the legend; "": none
    x: Array  # (n,), of the chart's axis
    y: Array  # (n,), NaN where there is a gap
    colour: str = PALETTE[0]
    width: float = 1.3
    dash: str = "-"  # as matplotlib has it: "-", "--", ":", "-.", and "" for marks alone
    step: bool = False  # a value holds until the next
    low: Array | None = None  # (n,), the ends of a band
    high: Array | None = None


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over one axis."""

    label: str  # what is drawn, with its unit
    curves: tuple[Curve, ...]
    title: str = ""
    height: float = 1.0
    log: bool = False
    shaded: tuple[tuple[float, float], ...] = ()  # stretches of x on grey
    marks: tuple[float, ...] = ()  # dotted across, at these x


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels in columns; those of a column share their axis."""

    columns: tuple[tuple[Panel, ...], ...]
    x_label: str = "time [s]"  # however long: a stretch of it is LOG@START:STOP
    log: bool = False  # the axis
    wide: float = 5.2  # of a column on paper [inch]
    across: int = 99  # columns beside each other on paper, at most


def thin(columns: Sequence[Array], most: int) -> NDArray[np.intp]:
    """Return at most ``most`` rows that show what all do, peaks too, as every n-th row would not: of each bin
    its last, of every column the extremes and a gap."""
    n = len(columns[0])
    if n <= most:
        return np.arange(n)
    kept_rows = {0}
    rows = 1 + sum(2 + (not np.isfinite(values).all()) for values in columns)  # that a bin may keep
    for bin_rows in np.array_split(np.arange(n), max(1, (most - 1) // rows)):
        kept_rows.add(int(bin_rows[-1]))
        for values in columns:
            finite = np.isfinite(values[bin_rows])
            if finite.any():
                finite_rows = bin_rows[finite]
                extremes = values[finite_rows].argmin(), values[finite_rows].argmax()
                kept_rows |= {int(finite_rows[extreme]) for extreme in extremes}
            if not finite.all():
                kept_rows.add(int(bin_rows[~finite][0]))
    return np.array(sorted(kept_rows))


def thinned(curve: Curve, most: int) -> Curve:
    """Return a curve of at most so many points."""
    lines = [line for line in (curve.y, curve.low, curve.high) if line is not None]
    if len(curve.x) <= most:
        return curve
    keep = thin(lines, most)
    x, y, *ends = (np.asarray(line)[keep] for line in (curve.x, *lines))
    low, high = ends or (None, None)
    return replace(curve, x=x, y=y, low=low, high=high)


def stretches(x: Array, inside: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """Return the (first, last) x of each run of rows that are ``inside``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    last = len(x) - 1
    return tuple((float(x[a]), float(x[min(b, last)])) for a, b in zip(edges[::2], edges[1::2]))


def draw_chart(chart: Chart) -> Figure:
    """Return a chart as a figure for paper."""
    heights, across = [panel.height for panel in chart.columns[0]], min(chart.across, len(chart.columns))
    down = -(-len(chart.columns) // across)
    size = (chart.wide * across, 0.5 + down * (0.3 + 1.25 * sum(heights)))
    figure, axes = panels(down * len(heights), across, size=size, heights=heights * down)
    for axis in axes.ravel():
        axis.set_axis_off()
    for k, column in enumerate(chart.columns):
        first_row = k // across * len(heights)
        column_axes = axes[first_row : first_row + len(heights), k % across]
        for panel, axis in zip(column, column_axes):
            axis.set_axis_on()
            if axis is not column_axes[0]:
                axis.sharex(column_axes[0])
            axis.tick_params(labelbottom=panel is column[-1])
            _draw(axis, panel)
            if chart.log:
                axis.set_xscale("log")
        column_axes[len(column) - 1].set_xlabel(chart.x_label)
    entries: dict[str, Artist] = {}
    for axis in axes.T.ravel():
        for handle, label in zip(*axis.get_legend_handles_labels()):
            entries.setdefault(label, handle)
    if entries:
        look: dict[str, Any] = {"ncols": 6, "frameon": False, "fontsize": 8}
        figure.legend(list(entries.values()), list(entries), loc="outside upper center", **look)
    return figure


def _draw(axis: Axes, panel: Panel) -> None:
    """Draw one panel."""
    if panel.log:
        axis.set_yscale("log")
    for begin, end in panel.shaded:
        axis.axvspan(begin, end, color=SHADE, lw=0, zorder=0)
    for mark in panel.marks:
        axis.axvline(mark, color=INK, lw=0.9, ls=":")
    labels_shown = {""}
    for curve in (thinned(curve, _STILL) for curve in panel.curves):
        look: dict[str, Any] = {
            "color": curve.colour,
            "label": None if curve.label in labels_shown else curve.label,
        }
        labels_shown.add(curve.label)
        if curve.low is not None and curve.high is not None:
            held: Any = {"step": "post"} if curve.step else {}
            axis.fill_between(curve.x, curve.low, curve.high, color=curve.colour, alpha=0.18, lw=0, **held)
        if curve.dash:
            steps = "steps-post" if curve.step else "default"
            axis.plot(curve.x, curve.y, lw=curve.width, ls=curve.dash, drawstyle=steps, **look)
        else:
            axis.plot(curve.x, curve.y, "x", ms=4, **look)
    axis.set_ylabel(panel.label)
    if panel.title:
        axis.set_title(panel.title, fontsize=9)


def with_unit(name: str, unit: str) -> str:
    """Return the variable with its unit, where it has one."""
    return name if unit == "1" else f"{name} [{unit}]"


def difference_unit(unit: str) -> str:
    """Return the unit of a difference: kelvin of temperatures."""
    return "K" if unit == "degC" else unit
