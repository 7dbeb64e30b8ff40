"""Figures of decisions draw without a warning and show the numbers that they are given."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest

from thermogrip.classify.decisions.next_touch import NextTouch
from thermogrip.classify.decisions.stopping_rule import StopRule, Windows
from thermogrip.classify.figures import contact_time_figure, next_touch_figure, stop_time_figure
from thermogrip.datasets.errors import UserError

TRUE = np.array([0, 1])


@pytest.fixture
def seen() -> Windows:
    p = np.array([[[0.6, 0.4], [0.97, 0.03], [0.99, 0.01]], [[0.7, 0.3], [0.96, 0.04], [0.1, 0.9]]])
    return Windows(np.array([0.5, 1.0, 10.0]), np.log(p), np.full((2, 3), np.inf))


def test_contact_time_shows_accuracy_and_confidence(seen: Windows) -> None:
    figure = contact_time_figure({"a": (seen, TRUE), "b": (seen, TRUE)})
    right, stated = figure.axes[0].get_lines()
    assert right.get_ydata().tolist() == [0.5, 0.5, 1.0]
    np.testing.assert_allclose(stated.get_ydata(), [0.65, 0.965, 0.945])
    figure.savefig(BytesIO())


def test_stop_times_mark_the_wrong_names(seen: Windows) -> None:
    figure = stop_time_figure(StopRule(sure=0.95), {"a": (seen, TRUE)})
    curve, wrong, _ = figure.axes[0].get_lines()
    assert curve.get_xdata().tolist() == [0.5, 1.0, 1.0]
    assert wrong.get_xdata().tolist() == [1.0]  # the second contact stopped for the wrong candidate
    figure.savefig(BytesIO())


def test_a_next_touch_is_drawn_over_temperature() -> None:
    t = np.array([20.0, 30.0])
    choice = NextTouch(
        t_gripper=t, information=np.array([1.0, 0.2]), accuracy=np.array([0.8, 0.5]), seconds=t, value=t,
        entropy=1.2, accuracy_now=0.45,
    )  # fmt: skip
    figure = next_touch_figure({"copper": choice})
    assert figure.axes[0].get_lines()[0].get_ydata().tolist() == [1.0, 0.2]
    figure.savefig(BytesIO())
    with pytest.raises(UserError, match="nothing to draw"):
        next_touch_figure({})
