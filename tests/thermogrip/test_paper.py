"""The paper's cases as this project states them."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.studies.paper import CASES, Case, _copies, _interval, _published


@pytest.fixture(scope="module")
def examples() -> dict[str, object]:
    return dict(load_example_grasps())


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_case_is_the_bundled_condition_of_that_name(case: Case, examples: dict[str, object]) -> None:
    grasps = examples[case.record]
    assert set(grasps["material"].values.astype(str)) == set(case.materials)
    assert np.all(grasps["t_object"].values == case.t_object)
    assert np.all(grasps["t_gripper"].values == case.t_gripper)
    assert grasps["time"].values[-1] == pytest.approx(case.seconds)


def test_published_accuracies_are_those_of_the_paper() -> None:
    said = {case.name: _published(case)[0] for case in CASES}
    assert said["1-A"] == "100 %"
    assert said["1-B"] == "40 %"
    assert [said[name] for name in said if name.startswith("2-")] == ["33.33 %", "66.66 %", *["100 %"] * 3]
    assert [said[f"3-{letter}"] for letter in "ABC"] == ["100 %"] * 3


def test_three_of_three_supports_more_than_29_percent() -> None:
    low, high = _interval(next(case for case in CASES if case.name == "3-A"))
    assert (low, high) == (pytest.approx(0.025 ** (1 / 3)), 1.0)


@pytest.mark.slow
def test_copies_of_a_grasp_are_recognised_better_than_other_grasps(examples: dict[str, object]) -> None:
    case = CASES[0]
    row = _copies((case, examples[case.record], True, 0))
    assert (row["train_grasps"], row["copies_n"], row["one_n"], row["others_n"]) == (5, 100, 5, 35)
    assert row["copies_right"] / row["copies_n"] > row["others_right"] / row["others_n"]
