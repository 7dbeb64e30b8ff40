"""Every figure shows what the tables say: its artists are those of its record."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from tests.report.conftest import described
from thermogrip.classify.figures import (
    accuracy_figure,
    confusion_figure,
    effusivity_figure,
    reliability_figure,
)
from thermogrip.datasets.errors import UserError

DRAWN = Path(__file__).with_name("figures.txt")
NINE = tuple("abcdefghi")  # one more than there are colours and markers


def strip(name: str, median: float, low: float, high: float) -> Any:
    """Return the posterior of one grasp."""
    return SimpleNamespace(grasp_id=name, effusivity=median, effusivity_p05=low, effusivity_p95=high)


def fine_print(figure: Figure) -> Iterator[str]:
    """Yield lines on the texts, ticks, images and edges of a figure."""
    if figure._suptitle is not None:  # type: ignore[attr-defined]
        yield f"  above {figure.get_suptitle()!r} {figure._suptitle.get_fontsize():g}"  # type: ignore[attr-defined]
    for k, axes in enumerate(figure.axes):
        for axis in (axes.xaxis, axes.yaxis):
            own = isinstance(axis.get_major_locator(), FixedLocator)  # others depend on the size of type
            ticks = [t.get_text() for t in axis.get_ticklabels()] if own else "auto"
            first = (axis.get_ticklabels() or [axis.label])[0]
            minor, size = len(axis.get_minor_locator()()), first.get_fontsize()
            yield f"  {k}: ticks {ticks} {size:g} {first.get_rotation():g} {first.get_ha()} {minor}"
        for text in axes.texts:
            at = " ".join(f"{x:.4g}" for x in text.get_position())
            how = f"{text.get_fontsize():g} {text.get_rotation():g} {text.get_ha()} {text.get_va()}"
            yield f"  {k}: text {text.get_text()!r} {at} {how} {to_hex(text.get_color())}"
        for image in axes.images:
            shares = np.round(np.asarray(image.get_array()), 4).tolist()
            yield f"  {k}: image {shares} {image.get_clim()} {image.get_cmap().name}"
        yield from sorted({f"  {k}: edge {_edge(line)}" for line in axes.get_lines()})
        for found in axes.collections:
            ends = [np.round(path.vertices, 4).tolist() for path in found.get_paths()]
            yield f"  {k}: strokes {found.get_alpha()} {ends}"
        for bar in axes.patches:
            yield f"  {k}: bar {np.round(bar.get_bbox().extents, 4).tolist()}"


def _edge(line: Any) -> str:
    colours = f"{to_hex(line.get_markerfacecolor())} {to_hex(line.get_markeredgecolor())}"
    return f"{colours} {line.get_markeredgewidth():g} {line.get_clip_on()} {line.get_solid_capstyle()}"


def compared() -> Any:
    """Return nine classifiers that were scored in two conditions, the first and the last in one apart."""
    rows = [
        {"classifier": c, "condition": condition, "apart": condition == "dry", "n": 20 - 3 * i,
         "n_test": 20 - 3 * i, "low": 0.3,
         "accuracy": 0.4 + 0.05 * k, "high": 0.85 + 0.01 * k, "log_loss_chance": np.log(3 + i)}
        for k, c in enumerate(NINE)
        for i, condition in enumerate(("pooled", "dry", "wet"))
        if condition != "dry" or c in "ai"
    ]  # fmt: skip
    bins = lambda k: [  # noqa: E731
        {"low": 0.4, "high": 0.5, "n": 6, "confidence": 0.47, "accuracy": 0.3 + k / 50, "accuracy_low": 0.1,
         "accuracy_high": 0.6},
        {"low": 0.9, "high": 1.0, "n": 15, "confidence": 0.97, "accuracy": 1.0, "accuracy_low": 0.8,
         "accuracy_high": 1.0},
    ]  # fmt: skip
    counts = np.array([[6.0, 0.0, 2.0], [0.25, 1.25, 1.0], [0.0, 0.0, 0.0]])
    return SimpleNamespace(
        classifiers=NINE, repeats=3, conditions=("dry", "wet"), scores=lambda: rows,
        calibration=lambda name, _: bins(NINE.index(name)),
        confusion=lambda name, _: ([] if name == "c" else ["iron", "wood", "zinc"], counts + (name == "b")),
    )  # fmt: skip


def several(count: int, condition: str = "wet") -> Any:
    """Return some of them in one condition."""
    found = compared()
    rows = [r for r in found.scores() if r["classifier"] in NINE[:count] and r["condition"] == condition]
    return SimpleNamespace(**vars(found) | {"classifiers": NINE[:count], "scores": lambda: rows})


STRIPS = [strip(c, 300.0 * (k + 1), 250.0 * (k + 1), 420.0 * (k + 1)) for k, c in enumerate("abcdefghi")]
LIBRARY = {
    "cork": 200.0,
    "oak": 400.0,
    "fir": 405.0,
    "ash": 410.0,
    "elm": 415.0,
    "glass": 1400.0,
    "ice": 1430.0,
}
FIGURES: dict[str, Callable[[], Figure]] = {
    "accuracy": lambda: accuracy_figure(compared()),
    "accuracy of two": lambda: accuracy_figure(several(2, "wet")),
    "accuracy apart": lambda: accuracy_figure(several(1, "dry")),
    **{
        f"confusion of {n}": lambda n=n: confusion_figure(several(n + (n > 2)), "wet")
        for n in (1, 4, 5, 6, 7)
    },
    "reliability": lambda: reliability_figure(compared(), "dry"),
    "strips": lambda: effusivity_figure(STRIPS, LIBRARY),
    "strips of nobody knows what": lambda: effusivity_figure(STRIPS[:2], {"air": 1.0, "copper": 36e3}),
}


def test_each_figure_shows_what_it_should_in_the_colours_widths_and_units_of_the_record() -> None:
    """``figures.txt`` has every artist; THERMOGRIP_FIGURES=write writes it anew: read the difference."""
    made = {name: draw() for name, draw in FIGURES.items()}
    found = [
        line
        for name, figure in made.items()
        for line in (f"# {name}", *described(figure), *fine_print(figure))
    ]
    if os.environ.get("THERMOGRIP_FIGURES") == "write":
        DRAWN.write_text("\n".join(found) + "\n", encoding="utf-8")
    assert found == DRAWN.read_text(encoding="utf-8").splitlines()


def untested() -> Any:
    return SimpleNamespace(classifiers=("a",), conditions=("dry", "wet"), confusion=lambda *_: ([], None))


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: confusion_figure(untested(), "c"), "tested in 'c'; there are dry, wet"),
        (lambda: effusivity_figure([], {}), "no posterior to draw"),
    ],
)
def test_nothing_is_not_drawn(draw: Callable[[], Figure], message: str) -> None:
    with pytest.raises(UserError, match=message):
        draw()
