"""Polynomial difference equations: steps by hand, where a run has diverged, their text, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.polynomial import SindyModel


def model(**change: Any) -> SindyModel:
    """a+ = 0.5 a + 0.1 a^2 q + 2 + 0.25 r^2,  b+ = 1 - 0.3 b[k-1] r."""
    content: dict[str, Any] = {
        "inputs": ("q",), "disturbances": ("r",), "outputs": ("a", "b"), "switches": (),
        "dt": 2.0, "memory": 2, "low": [0.0, 0.0], "high": [20.0, 10.0],
        "exponents": [[1, 0, 0, 0, 0, 0], [2, 0, 0, 0, 1, 0], [0] * 6, [0, 0, 0, 1, 0, 1], [0] * 5 + [2]],
        "coefficients": [[0.5, 0.1, 2.0, 0.0, 0.25], [0.0, 0.0, 1.0, -0.3, 0.0]],
    }  # fmt: skip
    return SindyModel(**(content | change))


def test_a_step_by_hand_is_that_of_a_free_run():
    first, x = model(), [2.0, 3.0, 5.0, 7.0]
    after = first.step(x, [4.0], [6.0], (), 2.0)
    assert after == pytest.approx([1 + 1.6 + 2 + 9, 1 - 0.3 * 42, 2.0, 3.0])
    twice = [0.5 * 13.6 + 0.4 * 13.6**2 + 11, 1 - 0.3 * 3 * 6, 13.6, -11.6]
    assert first.step(x, [4.0], [6.0], (), 4.0) == pytest.approx(twice)
    assert first.output(x, ()) == [2.0, 3.0]
    u, d = np.full((1, 2, 1), 4.0), np.full((1, 2, 1), 6.0)
    for dt, rows in ((2.0, 2), (0.7, 2), (4.0, 1)):  # the step of a gap may be less than the model's
        y, end = first.rollout([x, x], u[:, :rows], d[:, :rows], (), dt)
        np.testing.assert_allclose(end, [twice] * 2)
        np.testing.assert_allclose(y[1, [0, -1]], [[2.0, 3.0], twice[:2]])
    # each member of a batch has its own drive
    y, _ = first.rollout([x, x], np.array([[[4.0]], [[0.0]]]), d[:, :1], (), 2.0)
    np.testing.assert_allclose(y[:, 1], [[13.6, -11.6], [12.0, -11.6]])
    assert (first.n_x, first.stable, first.spread.tolist()) == (4, True, np.eye(4).tolist())


@pytest.mark.parametrize(("low", "high", "peak", "gone"), [
    (0.0, 1.0, 10.49, False), (0.0, 1.0, 10.5, True), (0.0, 1.0, -9.49, False), (0.0, 1.0, -9.5, True),
    (2.0, 4.0, 22.9, False), (2.0, 4.0, 23.0, True), (0.0, 1.0, np.nan, True),
])  # fmt: skip
def test_a_run_ten_ranges_from_the_middle_has_diverged_for_good(
    low: float, high: float, peak: float, gone: bool
):
    plain = model(disturbances=(), outputs=("a",), memory=1, exponents=[[0, 1]], coefficients=[[1.0]],
                  low=[low], high=[high])  # fmt: skip
    u = np.array([0.5, peak, 0.6])[None, :, None]
    y, end = plain.rollout([[0.1]], u, np.zeros((1, 3, 0)), (), 2.0)
    assert y[0, :, 0].tolist() == ([0.1, 0.5, np.inf, np.inf] if gone else [0.1, 0.5, peak, 0.6])
    assert end.tolist() == [[np.inf if gone else 0.6]]
    y, end = plain.rollout([[0.1]], u[:, [0, 2, 1]], np.zeros((1, 3, 0)), (), 2.0)
    assert end[0, 0] == y[0, -1, 0] == (np.inf if gone else peak)
    assert SindyModel.from_dict(plain.to_dict()).memory == 1


def test_at_rest_past_readings_are_the_present_ones_and_what_is_not_read_is_in_the_middle():
    assert model(low=[4.0, 0.0]).rest([np.nan, 4.0], [1.0], [2.0], ()).tolist() == [12.0, 4.0, 12.0, 4.0]


def test_equations_are_written_in_the_names_of_the_signals():
    assert model().equations() == ("a[k+1] = 0.5 a + 0.1 a^2 q + 2 + 0.25 r^2", "b[k+1] = 1 - 0.3 b[k-1] r")
    none = model(coefficients=np.zeros((2, 5)))
    assert none.equations() == ("a[k+1] = 0", "b[k+1] = 0")


def test_a_model_comes_back_from_its_dict():
    content = model(spread=np.diag([1.0, 2.0, 3.0, 4.0])).to_dict()
    again = SindyModel.from_dict(content)
    assert again.to_dict() == content
    assert (content["kind"], content["memory"], content["dt"]) == ("sindy", 2, 2.0)
    assert (
        SindyModel.from_dict(content | {"exponents": (10 * again.exponents).tolist()}).exponents.max() == 20
    )


@pytest.mark.parametrize(
    "change",
    [
        {"exponents": [[1, 0, 0, 0, 0]] * 5},
        {"exponents": [[0, 0, 0, 0, 0, 0]] * 4},
        {"exponents": [[0, 0, 0, 0, 0, -1]] * 5},
        {"exponents": [[0, 0, 0, 0, 0, 21]] * 5},
        {"coefficients": [[1.0] * 5]},
        {"coefficients": [[float("nan")] * 5] * 2},
        {"memory": 0},
        {"memory": 1001},
        {"dt": 0.0},
        {"dt": None},
        {"spread": [[-1.0]]},
        {"outputs": None},
    ],
)
def test_what_is_no_model_is_refused(change: dict[str, Any]):
    with pytest.raises(ValueError, match="coefficients finite"):
        model(coefficients=[[np.nan] * 5] * 2)
    with pytest.raises(UserError, match=r"not a SINDy model .*; save it again"):
        SindyModel.from_dict(model().to_dict() | change)
