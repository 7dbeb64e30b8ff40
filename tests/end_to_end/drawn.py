"""What a page draws, read back from its own data, is finite and of the size of what was measured."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

_FEW = 3.0  # times the range of what was measured that anything beside it may lie away
_CHART = re.compile(r'<script type="application/json"[^>]*>(.*?)</script>', re.DOTALL)
_FIGURE = re.compile(r'src="data:image/svg\+xml;base64,([^"]+)"')
_PATH = re.compile(r'<path d="([^"]*)"')


def faults_of(page: str) -> Iterator[str]:
    """Yield what is wrong with the charts and figures of a page, a line each."""
    for text in _CHART.findall(page):
        chart = json.loads(text)
        arrays = [np.frombuffer(base64.b64decode(packed), "<f4") for packed in chart["arrays"]]
        for column in chart["columns"]:
            yield from _faults_of_column(column, arrays)
    for coded in _FIGURE.findall(page):
        svg = base64.b64decode(coded).decode()
        *_, width, height = map(float, re.findall(r'viewBox="([^"]*)"', svg)[0].split())
        for drawn in _PATH.findall(svg):
            numbers = np.array([float(word) for word in re.findall(r"[^\sA-Zz]+|nan|inf", drawn)])
            if not (np.abs(numbers) <= 2 * max(width, height)).all():
                yield f"figure: {drawn[:60]}"


def _faults_of_column(column: list[dict[str, Any]], arrays: list[Any]) -> Iterator[str]:
    """Yield the faults of panels over one axis: what was measured sets the size of all but the inputs."""
    measured = [arrays[c["y"]] for panel in column for c in panel["curves"] if c["label"] == "measured"]
    for panel in column:
        curves, scale = panel["curves"], np.log10 if panel["log"] else np.asarray
        rule = measured if measured and panel["label"] != "inputs" else [arrays[c["y"]] for c in curves]
        size = scale(np.concatenate(rule))
        low, high = np.nanmin(size), np.nanmax(size)
        span = max(high - low, 1.0)  # a unit, or a decade
        if panel["label"].startswith("error"):
            low = high = 0.0
        for curve in curves:
            where = f"{panel['title']} {panel['label']}, {curve['label']}"
            if not np.isfinite(arrays[curve["x"]]).all():
                yield f"{where}: its axis is no number"
            for values in (arrays[curve[end]] for end in ("y", "low", "high") if curve[end] is not None):
                if np.isnan(values).mean() > 0.5:  # gaps are NaN
                    yield f"{where}: no number"
                elif (
                    beyond := max(low - np.nanmin(scale(values)), np.nanmax(scale(values)) - high)
                ) > _FEW * span:
                    yield f"{where}: {beyond:.3g} beyond {low:.3g} to {high:.3g}"
