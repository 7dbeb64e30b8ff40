"""What can be seen of a change, and the sentences about it."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest

from tests.mpc.tuning.test_pareto import PowerLaw
from thermogrip.mpc.tuning import sensitivity
from thermogrip.mpc.tuning.objective import Trial
from thermogrip.mpc.tuning.sensitivity import Sensitivity, _unseen, sensitivity_of, sensitivity_words


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
    ]  # fmt: skip
    ends = "at 30 % less, 101 s at 30 % more, 100 s as it is"
    assert sensitivity_words(items) == [
        f"else matters (now 2): settling 100 s {ends}",
        f"the horizon matters (now 2): settling not on every draw {ends}",
        f"the number of blocks matters (now 2): settling 100 s {ends}; overshoot up to 0.34 K",
        f"the terminal weight matters (now 2): settling 100 s {ends}; overshoot up to 0.20 K",
        "settling does not depend on the move weight (now 2) between 1.23 and 20",
    ]
    assert found("move", np.inf).to_dict() == vars(found("move", 0.0)) | {"elasticity": None}
