"""Drives that hold a temperature, and the steady curve with its turns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.mpc.plant.steady_state import holding_drive, steady_curve
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

ROOM = np.array([25.0])


def test_the_gain_turns_over_where_heat_equals_twice_joule(reversing_tank):
    curve = steady_curve(PredictionModel(reversing_tank, dt=2.0), "drive", "t_surface", ROOM)
    assert len(curve.turns) == 1
    assert curve.turns[0] == pytest.approx(-0.55, abs=0.05)  # heat / (2 joule), on a grid of 0.05
    assert curve.rising == (curve.turns[0], 1.0)


@pytest.mark.parametrize(
    ("steady", "turns", "rising"),
    [
        (lambda u: np.clip(u, -0.5, 0.5), (), (-1.0, 1.0)),  # flat at both ends is no turn
        (lambda u: -u, (), (-1.0, 1.0)),
        (lambda u: 0.0 * u, (), (0.0, 0.0)),  # the drive moves nothing
        (lambda u: -((u - 0.5) ** 2), (0.5,), (-1.0, 0.5)),
        (lambda u: (u + 0.5) ** 2, (-0.5,), (-0.5, 1.0)),
        (lambda u: u - 1.5 * np.maximum(np.abs(u) - 0.5, 0) * np.sign(u), (-0.5, 0.5), (-0.5, 0.5)),
    ],
)
def test_the_gain_keeps_its_sign_between_the_turns_beside_the_neutral_drive(steady, turns, rising):
    model = SimpleNamespace(
        drives=("q", "drive"), outputs=("t",), neutral=np.zeros(2), lowest=-np.ones(2), highest=np.ones(2),
        steady_output=lambda u, d: np.array([steady(u[1]) + d[0] + 9.0 * u[0]]),
    )  # fmt: skip
    curve = steady_curve(model, "drive", "t", [20.0], n=9)
    assert curve.turns == pytest.approx(turns)
    assert curve.rising == pytest.approx(rising)


def test_the_holding_drive_holds_and_says_what_it_misses(tank):
    model = PredictionModel(tank, dt=2.0)
    held = holding_drive(model, ("t_surface",), [38.0], ROOM)
    assert held.miss < 1e-6
    # the skin reads 0.98 of the tank, which a drive of 1 warms by 0.11 K a second
    assert held.u == pytest.approx([13.0 / 0.98 * (1 - np.exp(-1 / 700)) / 0.11])
    assert held.y == pytest.approx([25.0 + 13.0 / 0.98, 38.0])
    for target, u in ((500.0, 1.0), (-300.0, -1.0)):
        beyond = holding_drive(model, ("t_surface",), [target], ROOM)
        assert beyond.u == pytest.approx([u])
        assert beyond.miss == pytest.approx(abs(target - 25.0 - 0.98 * u * 0.11 / (1 - np.exp(-1 / 700))))


def test_of_two_drives_that_hold_the_smaller_is_taken(reversing_tank):
    model = PredictionModel(reversing_tank, dt=2.0)
    held = holding_drive(model, ("t_surface",), [18.0], ROOM)
    assert held.miss < 1e-6
    assert held.u[0] > -0.55


def test_what_balances_an_integrator_may_lie_beyond_its_drive():
    model = StateSpaceModel(
        ("q",), ("leak",), ("t",), A=[[1.0]], B=[[0.5]], E=[[0.1]], C=[[1.0]], dt=1.0, y0=[25.0]
    )
    valid = {"q": (-1.0, 1.0), "t": (20.0, 60.0)}
    plant = Plant(model, {}, dt=1.0, units={"q": "1", "leak": "1"}, valid=valid)
    prediction = PredictionModel(plant, dt=1.0)
    for leak in (2.0, -8.0):
        held = holding_drive(prediction, ("t",), [40.0], [leak])
        assert held.u == pytest.approx([-0.2 * leak])
        assert held.y == pytest.approx([40.0])
        assert held.miss == pytest.approx(0.0, abs=1e-6)
