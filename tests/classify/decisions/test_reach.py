"""The time to another temperature is that of the plant at full drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.classify.decisions.reach import by_plant
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture
def plant() -> Plant:
    """One node of 200 s: full drive moves it by 0.2 K/s at first, to 40 K from the room in the end."""
    dt = 0.5
    model = StateSpaceModel(
        ("drive",), ("t_ambient",), ("t_surface",),
        A=np.array([[1 - dt / 200]]), B=np.array([[dt * 0.2]]), E=np.array([[dt / 200]]), C=np.eye(1), dt=dt,
    )  # fmt: skip
    units = {"drive": "1", "t_ambient": "degC", "t_surface": "degC"}
    return Plant(
        model, {}, dt=dt, units=units, noise={"t_surface": 0.01}, valid={"drive": (-0.5, 1.0)}, logs=("made",)
    )


def test_the_time_is_the_first_order_step(plant: Plant) -> None:
    seconds = by_plant(plant, 25.0, t_ambient=25.0)
    assert seconds(25.0) == 0.0
    assert seconds(40.0) == pytest.approx(-200 * np.log(1 - 15 / 40), abs=1.5)
    assert seconds(15.0) == pytest.approx(-200 * np.log(1 - 10 / 20), abs=1.5)  # half the drive downwards


def test_a_drive_of_unknown_range_goes_from_full_to_full(plant: Plant) -> None:
    seconds = by_plant(replace(plant, valid={}), 25.0, t_ambient=25.0)
    assert seconds(40.0) == pytest.approx(-200 * np.log(1 - 15 / 40), abs=1.5)
    assert seconds(10.0) == pytest.approx(-200 * np.log(1 - 15 / 40), abs=1.5)


def test_the_room_pulls_and_a_skin_that_is_no_hotter_is_not_heated(plant: Plant) -> None:
    """From 35 degC in a room of 25: full drive ends at 65, half of it downwards at 5.

    Ten seconds without drive come first, in which 0.5 K are lost, or 3 s of full drive.
    """
    seconds = by_plant(plant, 35.0, t_ambient=25.0)
    assert seconds(50.0) == pytest.approx(-200 * np.log(15 / 30), abs=3.0)
    assert seconds(20.0) == pytest.approx(-200 * np.log(15 / 30), abs=3.0)
    assert seconds(4.0) == np.inf


def test_switches_are_on() -> None:
    """A skin that a pump alone brings to the tank: without it nothing moves."""
    model = StateSpaceModel(
        ("drive", "pump"), ("t_ambient",), ("t_surface",), A=[[0.99, 0.0], [0.0, 1.0]],
        B=[[0.2, 0.0], [0.0, 0.0]], E=[[0.01], [0.0]], C=[[0.0, 1.0]], dt=0.5, switches=("pump",),
        A_switch={"pump": np.array([[0.0, 0.0], [0.05, -0.05]])},
    )  # fmt: skip
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_surface": "degC"}
    pumped = Plant(model, {}, dt=0.5, units=units, valid={"drive": (-1.0, 1.0)}, logs=("made",))
    assert 20.0 < by_plant(pumped, 25.0, t_ambient=25.0)(30.0) < 60.0


def test_what_the_plant_cannot_reach_takes_forever(plant: Plant) -> None:
    assert by_plant(plant, 25.0, t_ambient=25.0)(70.0) == np.inf


def test_a_plant_without_the_sensor_is_refused(plant: Plant) -> None:
    with pytest.raises(UserError, match="no 't_skin'"):
        by_plant(plant, 25.0, t_ambient=25.0, output="t_skin")
