"""PI loops by Skogestad's rule from step responses in closed form, and which drive is whose."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.mpc.design.test_design import block
from tests.mpc.makers import make_tank
from thermogrip.mpc.design.simc import PILoop, default_controlled, pair_loops, simc
from thermogrip.mpc.plant.prediction import step_response
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


@pytest.mark.parametrize(
    ("delay", "lag", "tau_c", "closed", "integral"),
    [
        (10, 50.0, None, 9.99, 50.99),  # as fast as its delay; the lag is shorter than eight delays
        (10, 400.0, None, 9.9988, 8 * 9.9988),
        (10, 400.0, 30.0, 30.0, 4 * (30.0 + 9.9988)),
        (1, 50.0, None, 2.0, 4 * (2.0 + 1.0)),  # no faster than two steps of the plant
    ],
)
def test_simc_of_a_delayed_lag_is_its_closed_form(delay, lag, tau_c, closed, integral):
    plant = block(delay, lag)
    answer, loop = step_response(plant, "q", "t"), simc(plant, "q", "t", tau_c=tau_c)
    late = max(answer.delay, 1.0)
    assert late == pytest.approx({10: 10.0, 1: 1.0}[delay], abs=0.011)
    # 100 percent of drive give 50 degC
    assert loop.Kc == pytest.approx(100 * answer.lag / (answer.gain * (closed + late)), rel=1e-4)
    assert answer.lag / answer.gain == pytest.approx((lag + 1) / 50, rel=2e-3)
    assert loop.Ti == loop.Tt == pytest.approx(integral, rel=1e-3)
    assert (loop.drive, loop.output, loop.feedforward) == ("q", "t", 1.0)
    assert PILoop(**loop.to_dict()) == loop


def test_a_drive_of_the_other_sign_has_a_loop_of_the_other_sign_and_one_of_no_gain_has_none():
    cools, heats = (simc(block(10, 50.0, gain=gain), "q", "t") for gain in (-0.5, 0.5))
    assert (cools.Kc, cools.Ti) == pytest.approx((-heats.Kc, heats.Ti))
    with pytest.raises(ValueError, match="drive q does not move t"):
        simc(block(10, 50.0, gain=0.0), "q", "t")
    # the gain is for a range of 2 from -1 to 1
    tank, answer = make_tank(), step_response(make_tank(), "drive", "t_surface")
    loop = simc(tank, "drive", "t_surface", tau_c=answer.delay)
    assert loop.Kc == pytest.approx(2 * answer.lag / (answer.gain * 2 * answer.delay))


@pytest.mark.parametrize(
    ("drives", "outputs", "controlled"),
    [(1, "t_surface t_tank", "t_surface"), (1, "t_pipe t_tank", "t_tank"), (2, "t_surface a b", "a b")],
)
def test_the_skin_is_controlled_by_one_drive_and_by_several_the_last_outputs(
    drives: int, outputs: str, controlled: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("thermogrip.mpc.design.simc.drive_names", lambda plant: tuple("uv"[:drives]))
    plant: Any = SimpleNamespace(outputs=tuple(outputs.split()))
    assert default_controlled(plant) == tuple(controlled.split())


def test_each_output_takes_the_drive_of_largest_gain_that_is_free():
    gains = np.array([[0.2, -0.3], [0.0, 0.4], [0.1, 0.1], [0.5, 0.6]])  # of a, b, c, d by p, q
    model = StateSpaceModel(
        ("p", "q"), (), tuple("abcd"), A=np.diag([0.9] * 4), B=gains, C=np.eye(4), dt=1.0, y0=[25.0] * 4
    )
    valid = {"p": (0.0, 1.0), "q": (0.0, 1.0)}
    plant = Plant(model, {}, dt=1.0, units=dict.fromkeys(tuple("pqabcd"), "1"), valid=valid)
    # b is left to q, which is a's; c gets p, and for d no drive is left
    assert [(loop.drive, loop.output) for loop in pair_loops(plant, tuple("abcd"))] == [
        ("q", "a"),
        ("p", "c"),
    ]
    assert [(loop.drive, loop.output) for loop in pair_loops(plant, ("d", "a"))] == [("q", "d"), ("p", "a")]
