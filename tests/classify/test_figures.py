"""Every figure draws without a warning and shows what the tables say."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from thermogrip.classify import evaluate
from thermogrip.classify.evaluation.comparison import Comparison
from thermogrip.classify.figures import (
    accuracy_figure,
    confusion_figure,
    curve_figure,
    effusivity_figure,
    reliability_figure,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps


def strip(name: str, median: float, low: float, high: float) -> Any:
    """Return the posterior of one grasp."""
    return SimpleNamespace(grasp_id=name, effusivity=median, effusivity_p05=low, effusivity_p95=high)


@pytest.fixture
def comparison(three: Grasps, make_touches: Callable[..., Grasps]) -> Comparison:
    """Two classifiers, two conditions and one apart."""
    apart = make_touches(name="apart", seed=2).drop_vars("t_object")
    return evaluate(["bayes", "pca-lda"], [three, make_touches(name="b", seed=1), apart], probe=False)


def drawn(figure: object) -> int:
    """Return the size of the figure as PNG; drawing raises what it warns of."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=60)  # type: ignore[attr-defined]
    return len(buffer.getvalue())


def test_accuracy_shows_a_row_a_condition_and_its_count(comparison: Comparison) -> None:
    figure = accuracy_figure(comparison)
    assert drawn(figure) > 1000
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert labels == ["pooled  (n = 18)", "touches  (n = 9)", "b  (n = 9)", "apart  (n = 9)"]
    assert figure.axes[0].get_ylim() == (3.5, -0.5)  # the first row on top, each one whole
    assert figure.axes[0].get_xlim() == (-0.02, 1.02)
    marks = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 1]
    for line, row in zip(marks, comparison.scores(), strict=True):
        at = labels.index(f"{row['condition']}  (n = {row['n']})")
        assert line.get_xdata()[0] == row["accuracy"]
        assert abs(line.get_ydata()[0] - at) == pytest.approx(0.175)


def test_confusion_has_a_panel_a_classifier(comparison: Comparison) -> None:
    figure = confusion_figure(comparison)
    assert drawn(figure) > 1000
    assert [axis.get_title() for axis in figure.axes[:2]] == ["bayes", "pca-lda"]
    for axis, name in zip(figure.axes, comparison.classifiers):
        _, counts = comparison.confusion(name)
        written = {
            (int(t.get_position()[1]), int(t.get_position()[0])): float(t.get_text()) for t in axis.texts
        }
        assert written == {where: n for where, n in np.ndenumerate(counts) if n > 0}
    with pytest.raises(UserError, match="nothing was tested in 'c'; there are touches, b, apart"):
        confusion_figure(comparison, "c")


@pytest.mark.parametrize("condition", ["pooled", "apart"])
def test_reliability_is_the_calibration_table(comparison: Comparison, condition: str) -> None:
    figure = reliability_figure(comparison, condition)
    top, bottom = np.array(figure.axes, dtype=object).reshape(2, -1)
    for k, name in enumerate(comparison.classifiers):
        bins = comparison.calibration(name, condition)
        points = [line.get_xydata() for line in top[k].lines if line.get_linestyle() == "None"]
        np.testing.assert_allclose(points[0], [(b["confidence"], b["accuracy"]) for b in bins])
        middle = [bar.get_x() + bar.get_width() / 2 for bar in bottom[k].patches]
        np.testing.assert_allclose(middle, [(b["low"] + b["high"]) / 2 for b in bins])
        grasps = sum(bar.get_height() for bar in bottom[k].patches)
        (score,) = [s for s in comparison.scores() if (s["classifier"], s["condition"]) == (name, condition)]
        assert grasps == pytest.approx(score["n"])  # each test grasp is counted in one bar
    assert drawn(figure) > 1000


def test_strips_stand_on_a_logarithmic_axis_beside_the_library() -> None:
    rows = [strip("a", 3.6e4, 2e4, 6e4), strip("b", 400.0, 350.0, 450.0)]
    figure = effusivity_figure(rows, {"copper": 3.64e4, "wood": 367.0}, materials=["copper", "wood"])
    assert drawn(figure) > 1000
    assert figure.axes[0].get_xscale() == "log"
    assert {"copper", "wood"} <= {t.get_text() for t in figure.axes[0].texts}
    assert drawn(effusivity_figure(rows, {})) > 1000
    crowd = {"iron": 16142.0, "zinc": 17551.0, "brass": 19084.0, "copper": 36388.0, "wood": 367.0}
    figure = effusivity_figure(rows, crowd, materials=["copper", "wood"])
    assert {"wood", "iron, zinc", "brass", "copper"} <= {t.get_text() for t in figure.axes[0].texts}
    with pytest.raises(UserError, match="no posterior to draw"):
        effusivity_figure([], {})


def test_a_curve_has_a_line_a_classifier_and_an_axis_that_says_what_varies() -> None:
    def point(name: str, size: int, accuracy: float) -> dict[str, object]:
        spread = {"low": accuracy - 0.1, "high": accuracy + 0.1, "log_loss": 1 - accuracy}
        return {
            "classifier": name,
            "train_per_class": size,
            "accuracy": accuracy,
            "log_loss_chance": 1.1,
        } | spread

    rows = [point(name, size, 0.1 * size + 0.2) for name in ("bayes", "lstm") for size in (5, 2)]
    figure = curve_figure(rows, "train_per_class")
    left, right = figure.axes
    assert left.get_xlabel() == "training grasps of each material"
    assert [line.get_label() for line in right.get_lines()] == ["bayes", "lstm", "chance: log loss 1.10"]
    assert [round(float(x)) for x in right.get_lines()[0].get_xdata()] == [2, 5]
    assert left.get_xticks().tolist() == right.get_xticks().tolist() == [2, 5]
    times = [{**row, "contact_s": row["train_per_class"]} for row in rows]
    assert len(curve_figure(times, "contact_s").axes[0].get_xticks()) > 2  # an axis of its own round numbers
    with pytest.raises(UserError, match="there is no curve to draw"):
        curve_figure([], "contact_s")
