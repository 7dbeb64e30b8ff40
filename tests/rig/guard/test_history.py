"""What was applied, as native steps: the same whether it was told at once or bit by bit."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.rig.guard.history import InputSteps
from thermogrip.rig.guard.kalman_filter import FilterSettings, RigFilter, RigModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

NOTHING = np.zeros(0)


def heater() -> RigFilter:
    """A filter that keeps ten steps of 1 s, at rest at 25 degC."""
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    made = RigFilter(RigModel(Plant(block, {}, dt=1.0, units={"q": "1"})), FilterSettings(), 10)
    made.reset(0.0, np.array([25.0]), NOTHING)
    return made


@pytest.mark.parametrize("silence", [5, 15, 40])
def test_a_long_silence_is_carried_as_many_short_waits_are(silence: int) -> None:
    once, often = heater(), heater()
    for made in (once, often):
        made.predict(1.0, np.array([0.2]), NOTHING)
    once.predict(1.0 + silence, np.array([0.8]), NOTHING)
    for k in range(silence):
        often.predict(2.0 + k, np.array([0.8]), NOTHING)
    np.testing.assert_allclose(once.expected, often.expected, rtol=1e-12)


def test_steps_that_are_forgotten_are_refused() -> None:
    steps = InputSteps(dt=1.0, start=0.0, time=0.0)
    for k in range(1, 8):
        steps.add(float(k), np.array([float(k)]), NOTHING, keep=3)
    assert steps.rows(4)[0].tolist() == [[5.0], [6.0], [7.0]]
    with pytest.raises(ValueError, match="the oldest that is kept is 4"):
        steps.rows(3)
