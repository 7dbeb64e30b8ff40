"""Which designs nothing beats, by differences that can be seen, and how they are drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from thermogrip.mpc.tuning.figures import _note_all, pareto_figure, step_time_figure
from thermogrip.mpc.tuning.trade_offs import Trial, front_of, non_dominated


def trial_of(settle: float, overshoot: float, energy: float, **parameters: float) -> Trial:
    return Trial("MPC", parameters, 1.0, settle, overshoot, energy)


def test_what_another_beats_in_all_is_not_on_the_front():
    points = [(1.0, 4.0), (2.0, 2.0), (4.0, 1.0), (3.0, 3.0), (2.0, 2.0), (np.nan, 0.0)]
    assert non_dominated(points).tolist() == [True, True, True, False, True, False]


@pytest.mark.parametrize(
    ("other", "kept"),
    [
        ((100.3, 0.11, 200.2), True),  # no difference that anybody sees
        ((102.0, 0.1, 200.0), False),
        ((100.0, 0.21, 200.0), False),
        ((100.0, 0.1, 204.0), False),
        ((102.0, 0.1, 190.0), True),
    ],
)
def test_differences_that_nobody_sees_do_not_count(other: Any, kept: bool):
    first, second = trial_of(100.0, 0.1, 200.0), trial_of(*other, move=4.0)
    front = front_of([first, second], {id(first): "baseline"})
    assert [trial is second for trial in front.trials][1:] == [True] * kept
    assert front.names == ("baseline", "move x 4")[: 1 + kept]


def test_designs_that_have_names_are_kept_though_they_are_beaten():
    best, beaten = trial_of(100.0, 0.1, 200.0, move=1.0), trial_of(200.0, 0.3, 300.0)
    front = front_of([best, beaten, trial_of(np.nan, 0.1, 1.0)], {id(beaten): "PI"})
    assert (front.names, front.best) == (("by default", "PI"), (True, False))
    assert front.rows()[1] == {
        "name": "PI", "controller": "MPC", "settle_s": 200.0, "overshoot_degC": 0.3, "energy_s": 300.0,
        "best": False, "knobs": {},
    }  # fmt: skip


def test_figures_show_what_they_are_given():
    first, lost = trial_of(100.0, 0.1, 200.0), trial_of(float("nan"), 0.1, 1.0)
    drawn = pareto_figure(front_of([first, lost], {id(first): "tuned", id(lost): "PI"}))
    (shown,) = [p for c in drawn.axes[0].collections for p in np.asarray(c.get_offsets()).tolist()]
    assert shown == [100.0, 200.0]  # settling and energy; what did not settle has no place
    steps = step_time_figure({"controller": [0.001, 0.002]}, 0.5, 1.0)
    said = [text.get_text() for text in steps.axes[0].get_legend().get_texts()]
    assert any("median 1.5 ms" in line and "slowest 2 ms" in line for line in said)
    assert "deadline 500 ms" in said
    for figure in (drawn, steps):
        figure.canvas.draw()


def test_designs_share_a_label_where_their_marks_are_one_to_the_eye():
    axis = Figure().subplots()
    axis.set(xlim=(0.0, 80.0), ylim=(0.0, 50.0))
    marks = {"A": (10, 20), "B": (15, 21), "C": (10, 30), "D": (30, 20), "E": (10, 1)}
    _note_all(axis, [{"name": name, "settle_s": x, "energy_s": y} for name, (x, y) in marks.items()])
    assert [text.get_text() for text in axis.texts] == ["E", "A, B", "C", "D"]
