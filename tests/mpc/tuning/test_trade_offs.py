"""Designs that nothing beats, and what each parameter does."""

from __future__ import annotations

from math import nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from thermogrip.mpc.tuning import trade_offs as sensitivity
from thermogrip.mpc.tuning.figures import _note_all, pareto_figure, sensitivity_figure, step_time_figure
from thermogrip.mpc.tuning.objective import Trial
from thermogrip.mpc.tuning.trade_offs import (
    Sensitivity,
    _unseen,
    front_of,
    non_dominated,
    scan_of,
    sensitivity_of,
    sensitivity_words,
)

VALUES = st.sampled_from([0.0, 1.0, 2.0, 3.0, float("nan"), float("inf")])


@given(st.lists(st.tuples(VALUES, VALUES, VALUES), min_size=1, max_size=12))
def test_kept_are_those_that_no_other_beats_by_the_definition(points):
    def beats(a, b):
        return all(x <= y for x, y in zip(a, b)) and any(x < y for x, y in zip(a, b))

    finite = [all(np.isfinite(p)) for p in points]
    wanted = [
        ok and not any(other_ok and beats(other, p) for other, other_ok in zip(points, finite))
        for p, ok in zip(points, finite)
    ]
    assert non_dominated(points).tolist() == wanted


def trial_of(settle, overshoot, energy, controller="MPC", **parameters) -> Trial:
    return Trial(controller, {"move": 1.0, **parameters}, 1.0, settle, overshoot, energy)


def test_what_nobody_could_see_beats_nothing_and_what_never_settles_is_beaten():
    trials = [
        trial_of(100.0, 0.10, 200.0),
        trial_of(100.3, 0.11, 200.2),
        trial_of(140.0, 0.10, 150.0),
        trial_of(140.0, 0.20, 160.0),
        trial_of(float("nan"), 0.0, 10.0),
    ]
    front = front_of(trials, list("abcde"))
    assert front.best == (True, True, True, False, False)
    assert front.rows()[4]["settle_s"] is None


def test_the_scan_has_the_best_first_and_no_trial_twice():
    best = {"move": 1.0, "terminal": 10.0}
    history = [Trial("MPC", best, 1.0, 100.0, 0.1, 200.0), trial_of(90.0, 0.2, 200.0, move=0.3)]
    found = scan_of(best, history)
    assert found[0] == ("tuned", best)
    assert [parameters for _, parameters in found].count(best) == 1
    assert {parameters.get("drive_share", 1.0) for _, parameters in found} > {1.0, 0.5}
    ramps = [parameters.get("ramp") for _, parameters in scan_of(best, history, ramps=True)]
    assert [times for times in ramps if times] == [1.3, 1.7]
    ramped = scan_of(best | {"ramp": 1.3}, history, ramps=True)
    assert [name for name, _ in ramped if "ramp" in name] == ["targets ramp for 1.7 times the minimum time"]


def test_a_trial_that_moves_least_is_run_at_full_length_too():
    best = {"move": 1.0}
    still = Trial("MPC", {"move": 9.0}, 1.2, 110.0, 0.1, 200.0, travel=1.0)
    beaten = Trial("MPC", {"move": 8.0}, 1.3, 120.0, 0.1, 200.0, travel=2.0)
    found = scan_of(best, [Trial("MPC", best, 1.0, 100.0, 0.1, 200.0, travel=2.0), still, beaten])
    assert [parameters for name, parameters in found if name == "tried by the search"] == [{"move": 9.0}]


@pytest.mark.parametrize(
    ("one", "other", "kept"),
    [
        ((100.0, 0.1, 200.0), (100.4, 0.1, 200.0), True),  # what rounds to the same is the same
        ((100.0, 0.1, 200.0), (100.6, 0.1, 200.0), False),
        ((100.0, 0.1, 200.0), (100.0, 0.12, 200.0), True),
        ((100.0, 0.1, 200.0), (100.0, 0.13, 200.0), False),
        ((100.0, 0.1, 199.6), (100.0, 0.1, 200.0), True),
        ((100.0, 0.1, 199.4), (100.0, 0.1, 200.0), False),
    ],
)
def test_a_second_a_quantum_and_half_a_per_cent_of_the_largest_energy_count(one, other, kept):
    front = front_of([trial_of(*one), trial_of(*other, "PI", move=4.0)], ["a", "b"])
    assert front.best == (True, kept)
    assert front.rows()[1] == {
        "name": "b", "controller": "PI", "settle_s": other[0], "overshoot_degC": other[1],
        "energy_s": other[2], "best": kept, "knobs": {"move": 4.0},
    }  # fmt: skip


def test_the_scan_has_six_of_the_search_by_score_smaller_drives_other_move_weights_and_filters():
    best = {"move": 2.0, "drive_share": 0.75}
    scores = [4.0, 1.0, 7.0, 3.0, 8.0, 2.0, 6.0, 5.0]
    history = [Trial("MPC", {"move": float(k)}, s, 100.0 - k, 0.1 + k, 1.0) for k, s in enumerate(scores, 10)]
    history += [Trial("MPC", best, 9.0, 1.0, 0.1, 1.0), Trial("MPC", {"move": 9.0}, 9.0, 95.0, 0.3, 1.0)]
    found = scan_of(best, history)
    by_score = [11.0, 15.0, 13.0, 10.0, 17.0, 16.0]
    assert found[0] == ("tuned", best)
    assert found[1:7] == [("tried by the search", {"move": move}) for move in by_score]
    assert found[7:] == [
        ("60 % of the drive", best | {"drive_share": 0.6}),
        ("50 % of the drive", best | {"drive_share": 0.5}),
        ("moves 0.1 times as dear", best | {"move": 0.2}), ("moves 0.3 times as dear", best | {"move": 0.6}),
        ("moves 3 times as dear", best | {"move": 6.0}),
        ("moves 10 times as dear", best | {"move": 20.0}), ("moves 30 times as dear", best | {"move": 60.0}),
        ("moves 100 times as dear", best | {"move": 200.0}),
        *((f"errors below {share:g} of the allowed bias move nothing", best | {"still": share})
          for share in (0.03, 0.1, 0.3)),
    ]  # fmt: skip
    trusting = {"move": 2.0, "state_walk": 0.01}
    assert scan_of(trusting, history[:1])[-2:] == [
        ("states 0.3 times as noisy to the filter", trusting | {"state_walk": 0.003}),
        ("states 0.1 times as noisy to the filter", trusting | {"state_walk": 0.001}),
    ]
    whole = [name for name, _ in scan_of({"move": 2.0}, history[:1])]
    assert whole[:6] == [
        "tuned",
        "tried by the search",
        *(f"{cap} % of the drive" for cap in (90, 75, 60, 50)),
    ]


class PowerLaw:
    """A search whose score is a power of one parameter; settling follows, or jumps at 4."""

    spec = None

    def __init__(self, power: float, jump: bool = False) -> None:
        self.power, self.jump = power, jump

    def evaluate(self, parameters, *, noises=3):
        value = parameters["move"]
        settle = 130.0 if self.jump and value > 4 else 100.0
        return Trial("MPC", parameters, value**self.power, settle, 0.1, 50.0)

    def design(self, parameters):
        return SimpleNamespace(parameters=parameters)


@pytest.fixture(autouse=True)
def _plain_knobs(monkeypatch):
    monkeypatch.setattr(sensitivity, "parameters_of", lambda design, spec: design.parameters)


@pytest.mark.parametrize("power", [-0.7, 0.5, 1.0])
def test_the_elasticity_of_a_power_law_is_its_power(power):
    search, best = PowerLaw(power), {"move": 2.0}
    found = sensitivity_of((search, "move", best, search.evaluate(best)))
    # sinh(p ln 1.3) / ln 1.3 is the central difference of exp(p z)
    assert found.elasticity == pytest.approx(np.sinh(power * np.log(1.3)) / np.log(1.3), rel=1e-12)
    assert (found.free_low, found.free_high) == (2.0, 2.0)
    assert "matters" in sensitivity_words([found])[0]


def test_a_flat_knob_is_free_as_far_as_it_was_tried_and_a_jump_ends_it():
    flat, jump = PowerLaw(0.0), PowerLaw(0.0, jump=True)
    best = {"move": 2.0}
    free = sensitivity_of((flat, "move", best, flat.evaluate(best)))
    assert (free.free_low, free.free_high) == (pytest.approx(0.2), pytest.approx(20.0))
    assert sensitivity_words([free]) == [
        "settling does not depend on the move weight (now 2) between 0.2 and 20"
    ]
    ends = sensitivity_of((jump, "move", best, jump.evaluate(best)))
    assert (ends.free_low, ends.free_high) == (pytest.approx(0.2), pytest.approx(2.6))


def test_figures_show_what_they_are_given():
    front = front_of([trial_of(100.0, 0.1, 200.0), trial_of(float("nan"), 0.1, 1.0)], ["tuned", "lost"])
    search, best = PowerLaw(0.5), {"move": 2.0}
    found = sensitivity_of((search, "move", best, search.evaluate(best)))
    drawn = pareto_figure(front)
    (shown,) = [p for c in drawn.axes[0].collections for p in np.asarray(c.get_offsets()).tolist()]
    assert shown == [100.0, 200.0]  # settling and energy; what did not settle has no place
    empty = pareto_figure(front_of([trial_of(float("nan"), 0.1, 1.0)], ["lost"]))
    assert sum(len(c.get_offsets()) for c in empty.axes[0].collections) == 0
    same = [trial_of(100.0, 0.1, 200.0), trial_of(100.1, 0.1, 200.1), trial_of(300.0, 0.1, 90.0)]
    labels = pareto_figure(front_of(same, ["tuned", "LQR, tuned", "60 % of the drive"])).axes[0].texts
    assert [label.get_text() for label in labels] == ["tuned, LQR", "60 % of the drive"]  # none on another
    steps = step_time_figure({"controller": [0.001, 0.002]}, 0.5, 1.0)
    said = [text.get_text() for text in steps.axes[0].get_legend().get_texts()]
    assert any("median 1.5 ms" in line and "slowest 2 ms" in line for line in said)
    assert "deadline 500 ms" in said
    bars = sensitivity_figure([found])
    (parameter,) = [label.get_text() for label in bars.axes[0].get_yticklabels()]
    assert parameter == f"{sensitivity.PARAMETER_WORDS['move']}, 2"
    (effect,) = [text.get_text().strip() for text in bars.axes[0].texts]
    assert effect.endswith(" % at 30 % more")
    assert float(effect.split()[1]) == pytest.approx(50 * np.log(1.3), abs=0.2)  # of a power law of 0.5
    for figure in (drawn, empty, steps, bars):
        figure.canvas.draw()


def test_designs_share_a_label_where_their_marks_are_one_to_the_eye():
    axis = Figure().subplots()
    axis.set(xlim=(0.0, 80.0), ylim=(0.0, 50.0))
    marks = {"A": (10, 20), "B, tuned": (15, 21), "C": (10, 30), "D": (30, 20), "E": (10, 1)}
    _note_all(axis, [{"name": name, "settle_s": x, "energy_s": y} for name, (x, y) in marks.items()])
    assert [text.get_text() for text in axis.texts] == ["E", "A, B", "C", "D"]


@pytest.mark.parametrize(
    ("here", "tried", "unseen"),
    [
        ((50.0, 0.1, 100.0), (51.0, 0.1, 100.0), True),  # a second, or a hundredth of a long settling,
        ((50.0, 0.1, 100.0), (51.1, 0.1, 100.0), False),
        ((50.0, 0.1, 100.0), (48.9, 0.1, 100.0), False),
        ((300.0, 0.1, 100.0), (303.0, 0.1, 100.0), True),
        ((300.0, 0.1, 100.0), (303.1, 0.1, 100.0), False),
        ((50.0, 0.1, 100.0), (50.0, 0.1199, 100.0), True),  # 0.02 degC,
        ((50.0, 0.1, 100.0), (50.0, 0.0799, 100.0), False),
        ((50.0, 0.1, 100.0), (50.0, 0.1, 101.0), True),  # and a hundredth of the cost are not seen
        ((50.0, 0.1, 100.0), (50.0, 0.1, 98.9), False),
        ((50.0, 0.1, 100.0), (nan, 0.1, 100.0), False),
        ((nan, 0.1, 100.0), (nan, 0.1, 100.0), True),
        ((nan, 0.1, 100.0), (50.0, 0.1, 100.0), True),
        ((nan, 0.1, 100.0), (50.0, 0.2, 100.0), False),
    ],
)
def test_what_is_seen_of_a_change(here, tried, unseen):
    trials = [Trial("MPC", {}, cost, settle, over, 1.0) for settle, over, cost in (tried, here)]
    assert _unseen(*trials) is unseen


@pytest.mark.parametrize("parameter", ["horizon", "blocks"])
def test_of_the_structure_thirty_per_cent_are_tried_and_what_the_design_makes_of_it_counts(
    parameter: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(
        sensitivity, "parameters_of", lambda design, spec: {parameter: round(design.parameters[parameter])}
    )
    search, best = PowerLaw(0.0), {"move": 2.0, parameter: 30.0}
    found = sensitivity_of((search, parameter, best, search.evaluate(best)))
    assert (found.free_low, found.value, found.free_high) == (23.0, 30.0, 39.0)


def found(knob: str, elasticity: float, **changes: Any) -> Sensitivity:
    usual = {"settle_low_s": 100.0, "settle_s": 100.4, "settle_high_s": 101.3, "overshoot_low": 0.1}
    usual |= {"overshoot_high": 0.2, "value": 2.0, "free_low": 2.0, "free_high": 2.0}
    return Sensitivity(knob=knob, elasticity=elasticity, **usual | changes)


def test_what_matters_comes_first_and_has_its_overshoot_where_settling_stays():
    wide = {"free_low": 1.234, "free_high": 19.96}
    items = [
        found("move", 0.9, **wide), found("terminal", 0.1), found("else", -0.4, settle_high_s=101.4),
        found("horizon", 0.2, free_low=1.0, settle_low_s=nan), found("blocks", 0.15, overshoot_low=0.34),
        found("state_walk", 0.05, overshoot_low=0.19),
    ]  # fmt: skip
    ends = "at 30 % less, 101 s at 30 % more, 100 s as it is"
    assert sensitivity_words(items) == [
        f"else matters (now 2): settling 100 s {ends}",
        f"the horizon matters (now 2): settling not on every draw {ends}",
        f"the number of blocks matters (now 2): settling 100 s {ends}; overshoot up to 0.34 K",
        f"the terminal weight matters (now 2): settling 100 s {ends}; overshoot up to 0.20 K",
        "the process noise of the states matters (now 2) for how the drives move; 30 % change neither "
        "settling (100 s) nor overshoot",
        "settling does not depend on the move weight (now 2) between 1.23 and 20",
    ]
    assert found("move", np.inf).to_dict() == vars(found("move", 0.0)) | {"elasticity": None}
