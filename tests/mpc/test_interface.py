"""What a number of a reading is, and what the room offers."""

from __future__ import annotations

import math

import pytest

from thermogrip import mpc
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.interface import Move, number


@pytest.mark.parametrize("value", [None, "warm", [], math.nan])
def test_what_is_no_number_is_none(value: object):
    assert math.isnan(number({"t": value}, "t"))  # type: ignore[dict-item]
    assert math.isnan(number({}, "t"))
    assert number({"t": "2.5"}, "t") == 2.5  # type: ignore[dict-item]


def test_a_move_says_no_more_than_it_must():
    assert Move(0.5) == Move(0.5, pump=1, status="ok", advice="", seconds=0.0)

    assert Move({"q1": 1.0, "q2": 2.0}).drives(("q2", "q1")) == [2.0, 1.0]
    assert Move(3).drives(("q",)) == [3.0]


def test_the_room_offers_what_it_lists_and_nothing_else():
    for name in mpc.__all__:
        assert getattr(mpc, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        getattr(mpc, "nothing")  # noqa: B009


@pytest.mark.parametrize("name", ["mpc", "pi"])
def test_a_controller_starts_from_the_drive_that_its_first_reading_has(tank, name: str):
    """Asked for less where 40 % holds 30 degC, each goes down from there by the slew of a sample."""
    design = default_design(tank, dt=2.0, slew_per_s={"drive": 0.05})
    made = {"mpc": lambda: Controller(tank, design), "pi": lambda: PIController(tank, design)}[name]()
    reading = {"t_tank": 30.2, "t_surface": 30.0, "t_ambient": 25.0}
    made.reset(reading | {"drive": 0.4})
    assert made.step(reading, 20.0).drive == pytest.approx(0.3)
    made.reset(reading)
    assert made.step(reading, 20.0).drive == pytest.approx(-0.1)
