"""What every rig must do, twin or hardware: one test, run over each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.rig.interface import Rig
from thermogrip.rig.twin import Twin
from thermogrip.sysid.plant import Plant

RIGS: dict[str, Callable[[Plant], Rig]] = {"twin": lambda plant: Twin(plant, seed=3)}


@pytest.fixture(params=sorted(RIGS))
def rig(request: pytest.FixtureRequest, plant: Plant) -> Rig:
    made: Rig = RIGS[request.param](plant)
    return made


def test_a_reading_names_every_sensor_and_what_is_applied(rig: Rig) -> None:
    reading = rig.read()
    assert all(np.isfinite(value) for value in reading.values.values())
    assert set(reading.drive) == set(rig.units)
    assert reading.pump in (0, 1)
    assert reading.as_controller_reading() == {"time_s": reading.time_s, **reading.values}


def test_what_is_applied_is_read_back(rig: Rig) -> None:
    rig.apply(dict.fromkeys(rig.units, 0.25), 0)
    assert set(rig.read().drive.values()) == {0.25}
    assert rig.read().pump == 0


def test_the_clock_is_the_rigs_and_moves_only_while_waiting(rig: Rig) -> None:
    before = rig.read().time_s
    assert rig.read().time_s == before
    for _ in range(7):
        rig.wait(0.1)
    assert rig.read().time_s - before == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize("value", [1e6, -1e6, float("nan"), float("inf")])
def test_a_drive_out_of_range_raises_and_changes_nothing(rig: Rig, value: float) -> None:
    rig.apply(dict.fromkeys(rig.units, 0.25), 1)
    with pytest.raises(ValueError, match="outside"):
        rig.apply(dict.fromkeys(rig.units, value), 1)
    assert set(rig.read().drive.values()) == {0.25}


def test_an_unknown_or_missing_input_raises(rig: Rig) -> None:
    with pytest.raises(ValueError, match="inputs are"):
        rig.apply({"afterburner": 0.1}, 1)
    with pytest.raises(ValueError, match="inputs are"):
        rig.apply({}, 1)


def test_close_switches_everything_off_for_good_and_may_be_called_twice(rig: Rig) -> None:
    rig.apply(dict.fromkeys(rig.units, 0.5), 1)
    rig.close()
    rig.close()
    assert set(rig.read().drive.values()) == {0.0}
    assert rig.read().pump == 0
    with pytest.raises(RuntimeError, match="closed"):
        rig.apply(dict.fromkeys(rig.units, 0.5), 0)


def test_it_cannot_wait_backwards(rig: Rig) -> None:
    with pytest.raises(ValueError, match="wait"):
        rig.wait(-1.0)
