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
from thermogrip.classify.estimators.bayes import BayesClassifier
from thermogrip.classify.figures import (
    accuracy_figure,
    confusion_figure,
    curve_figure,
    effusivity_figure,
    feature_figure,
    reliability_figure,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

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


def points(
    over: str, at: tuple[float, ...], names: tuple[str, ...], chance: float = 1.1
) -> list[dict[str, Any]]:
    """Return a curve, its points in no order."""
    return [
        {"classifier": name, over: x, "accuracy": 0.05 * x + 0.03 * k, "low": 0.04 * x, "high": 0.08 * x,
         "log_loss": 1.3 - 0.1 * x + 0.01 * k, "log_loss_chance": chance + (0.2 if x > 6 else 0)}
        for k, name in enumerate(names)
        for x in at
    ]  # fmt: skip


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
    "strips": lambda: effusivity_figure(STRIPS, LIBRARY, materials=[*"zyxwvutsz"[:8], "q"]),
    "strips of nobody knows what": lambda: effusivity_figure(STRIPS[:2], {"air": 1.0, "copper": 36e3}),
    "curve of grasps": lambda: curve_figure(points("train_per_class", (5, 2), NINE), "train_per_class"),
    "curve of time": lambda: curve_figure(points("contact_s", (10.0, 3.0), ("a", "b")), "contact_s"),
    "curve of warmth": lambda: curve_figure(points("difference_K", (4.0, 1.0), ("a",), 0.5), "difference_K"),
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
        (lambda: curve_figure([], "contact_s"), "there is no curve to draw"),
    ],
)
def test_nothing_is_not_drawn(draw: Callable[[], Figure], message: str) -> None:
    with pytest.raises(UserError, match=message):
        draw()


def test_each_feature_has_the_density_of_every_class_above_its_grasps(three: Grasps) -> None:
    model = BayesClassifier().fit(three)
    read = model.reader_.read(three)
    figure = feature_figure(model, read, three["material"].values.astype(str))
    means, scales = model.marginals()
    x, noise = read.normalised()
    for j, name in enumerate(model.feature_names_):
        axis = figure.axes[j]
        assert axis.get_xlabel().replace("change at ", "change_").replace(" s", "s") == name.replace(
            "late_slope", "lateslope"
        )
        curves = [line for line in axis.get_lines() if len(line.get_xdata()) == 400]
        for m, curve in enumerate(curves):
            at, height = curve.get_xdata(), np.asarray(curve.get_ydata())
            assert at[height.argmax()] == pytest.approx(means[m, j], abs=0.02 * np.ptp(at))
            z = (at - means[m, j]) / scales[m, j]
            t = (1 + z**2 / model.dof_) ** (-(model.dof_ + 1) / 2)
            np.testing.assert_allclose(height, t * scales[:, j].min() / scales[m, j])
        points = [line for line in axis.get_lines() if len(line.get_xdata()) == 8]
        np.testing.assert_allclose(np.concatenate([p.get_xdata() for p in points]), x[:, j])
        bars = np.concatenate([np.array(c.get_segments())[:, :, 0] for c in axis.collections])
        np.testing.assert_allclose(np.ptp(bars, axis=1), 2 * np.sqrt(noise[:, j, j]))
    kelvin = three.drop_vars("t_object")
    model = BayesClassifier().fit(kelvin)
    figure = feature_figure(model, model.reader_.read(kelvin), three["material"].values.astype(str))
    assert [a.get_xlabel() for a in figure.axes[:6:5]] == ["change at 0.5 s [K]", "late slope [K/s]"]
