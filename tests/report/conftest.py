"""A figure in words: every artist with what it shows and how it is drawn, a line each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from thermogrip.datasets.arrays import Array
from thermogrip.report.html import Section

T = TypeVar("T")


def part(section: Section, at: int, kind: type[T]) -> T:
    """Return a part of a section, which must be of this kind."""
    found = section.parts[at]
    assert isinstance(found, kind)
    return found


def described(figure: Figure) -> Iterator[str]:
    """Yield lines on the size of a figure, the style of its panels, their artists and its legends."""
    figure.draw_without_rendering()
    constrained = type(figure.get_layout_engine()).__name__
    grid: Any = figure.axes[0].get_gridspec()
    heights = _numbers(grid.get_height_ratios())
    yield f"figure {_numbers(figure.get_size_inches())} {constrained} rows {heights}"
    yield from sorted({f"  style {_style(axes)}" for axes in figure.axes})
    for k, axes in enumerate(figure.axes):
        yield from (f"  {k}: {line}" for line in _panel(axes))
    for legend in figure.legends:
        yield f"  legend {_legend(legend)}"


def _style(axes: Axes) -> str:
    """Return what panels have in common: sizes of type, grid, frame."""
    texts = (axes.title, axes.xaxis.label, axes.yaxis.label)
    grid = (axes.xaxis.get_gridlines() or axes.yaxis.get_gridlines())[0]  # a colour bar has those of y
    frame = "".join(side[0] for side, spine in axes.spines.items() if spine.get_visible())
    ticks = {**axes.xaxis.get_tick_params(), **axes.yaxis.get_tick_params()}
    shown = " ".join(f"{key}={value}" for key, value in sorted(ticks.items()) if "grid" not in key)
    lines = f"{grid.get_visible()} {grid.get_linewidth():g} {to_hex(grid.get_color())} {axes.get_axisbelow()}"
    return f"type {_numbers([text.get_fontsize() for text in texts])} grid {lines} frame {frame} {shown}"


def _panel(axes: Axes) -> Iterator[str]:
    labels = [text.get_text() for text in axes.get_yticklabels()]
    few = f" ticks {labels}" if len(labels) < 3 else ""
    yield (
        f"{axes.get_title()!r}, x {axes.get_xlabel()!r} {axes.get_xscale()} {_numbers(axes.get_xlim())}, "
        f"y {axes.get_ylabel()!r} {_numbers(axes.get_ylim())}{few}{'' if axes.axison else ' off'}"
    )
    for line in axes.get_lines():
        x, y = (np.asarray(line.get_data()[k], dtype=float) for k in (0, 1))
        mark = f"{line.get_marker()} {line.get_markersize():g} " if line.get_marker() != "None" else ""
        yield (
            f"line {line.get_label()!r} {_data(x)} {_data(y)} {to_hex(line.get_color())} {mark}"
            f"{line.get_linewidth():g} {line.get_linestyle()} {line.get_alpha()} {line.get_drawstyle()[:10]} "
            f"{line.get_zorder():g}"
        )
    patches: list[Any] = list(axes.patches)
    bars = [patch for patch in patches if patch.get_path().vertices.shape == (5, 2)]
    if len(bars) > 2:
        heights = np.array([bar.get_height() for bar in bars])
        yield f"{len(bars)} bars {_data(heights)} {_fill(bars[0])}"
    found: Any
    for found in (*axes.collections, *(bars if len(bars) <= 2 else bars[:0])):
        box = found.get_datalim(axes.transData) if found in axes.collections else found.get_bbox()
        yield f"{type(found).__name__} {_numbers(box.extents)} {_fill(found)}"
    if axes.get_legend() is not None:
        yield f"legend {_legend(axes.get_legend())}"


def _fill(found: Any) -> str:
    colours = (np.atleast_2d(c)[:1] for c in (found.get_facecolor(), found.get_edgecolor()))
    text = " ".join(to_hex(c[0], keep_alpha=True) for c in colours if c.size)
    return f"{text} {_numbers(np.atleast_1d(found.get_linewidth())[:1])}"


def _legend(legend: Any) -> str:
    texts = [text.get_text() for text in legend.get_texts()]
    size = legend.get_texts()[0].get_fontsize()
    return f"{texts} {size:g} {legend._ncols} {legend.get_frame_on()} {legend._loc} {legend._outside_loc}"


def _numbers(values: Sequence[float] | Any) -> str:
    return " ".join(f"{value:.4g}" for value in np.asarray(values, dtype=float))


def _data(values: Array) -> str:
    """Return the number of points, their mean, and the first and the last."""
    ends = [values.mean(), values[0], values[-1]] if values.size else []
    return f"{values.size}({_numbers(ends)})"
