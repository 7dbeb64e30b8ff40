"""The step in Python, but for what it shares with the one in C."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.controllers.base import targets_ahead
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design

REST = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
NAN = float("nan")


def test_the_pi_takes_over_without_a_bump(tank, monkeypatch):
    controller = ReferenceController(tank, default_design(tank, dt=2.0, patience_s=6.0))
    controller.reset(REST)
    for _ in range(4):
        before = controller.step({**REST, "t_surface": 37.9, "t_tank": 39.0}, 38.0).drive

    def broken(*args, **kwargs):
        raise np.linalg.LinAlgError("planted")

    monkeypatch.setattr(type(controller.optimiser), "solve", broken)
    controller._follows.plan = None
    move = controller.step({**REST, "t_surface": 37.9, "t_tank": 39.0}, 38.0)
    assert move.status == "fallback_pi"
    assert move.drive == pytest.approx(before, abs=0.02)


def test_of_a_trajectory_each_sample_has_its_target_and_what_is_none_has_the_one_of_now():
    line, at = {"a": [28.0, 29.0, 30.0, NAN, 31.0]}, 1 + np.arange(1, 5)
    ahead = targets_ahead(line, ("a", "b"), np.array([28.0, 33.0]), at, -60.0, 200.0)
    np.testing.assert_array_equal(ahead, [[30.0, 33.0], [28.0, 33.0], [31.0, 33.0], [31.0, 33.0]])
    assert targets_ahead({"a": 28.0}, ("a",), np.array([28.0]), at, -60.0, 200.0) is None
