"""What every rig must do: one test over the twin, our firmware and a TCLab, the last two through a pty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module

import numpy as np
import pytest

from tests.rig.makers import DirectPort, SteppedClock
from thermogrip.rig.drivers.connect import open_rig
from thermogrip.rig.interface import Rig, range_of
from thermogrip.rig.simulation.twin import Twin
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.sysid.plant.plant import Plant

from .makers import make_lab

LINKS = [f"{protocol} {link}" for protocol in ("thermogrip", "tclab") for link in ("pty", "socket")]


@pytest.fixture(params=["twin", *LINKS, "thermogrip none"])
def rig(request: pytest.FixtureRequest, plant: Plant) -> Iterator[Rig]:
    """Return a twin, or the driver of a virtual device on one stepped clock with it."""
    if request.param == "twin":
        yield Twin(plant, seed=3)
        return
    protocol, link = request.param.split()
    clock, behind = SteppedClock(), make_lab() if protocol == "tclab" else plant
    with VirtualDevice(behind, protocol=protocol, link=link, clock=clock, seed=3) as device:
        port = DirectPort(device) if link == "none" else device.port
        made = open_rig(port, clock=clock, sleep=clock.sleep)
        yield made
        made.close()  # before the device goes


def test_it_is_a_rig_whose_reading_names_every_sensor_and_what_is_applied(rig: Rig) -> None:
    assert isinstance(rig, Rig)
    assert rig.notices() == []
    assert rig.expires_s == (np.inf if "q1" in rig.units else 2.0 if hasattr(rig, "port") else 0.0)
    assert rig.has_pump is ("q1" not in rig.units)
    reading = rig.read()
    assert all(np.isfinite(value) for value in reading.values.values())
    assert set(reading.drive) == set(rig.units)
    assert reading.pump in (0, 1)
    assert reading.as_controller_reading() == {"time_s": reading.time_s, **reading.values}


def hold(rig: Rig, drive: dict[str, float], seconds: float) -> None:
    """Apply a drive and renew it every second, which it outlives on every device."""
    for _ in range(round(seconds)):
        rig.apply(drive, 1)
        rig.wait(1.0)


def test_what_is_applied_and_renewed_holds_while_time_passes_and_is_read_back(rig: Rig) -> None:
    hold(rig, dict.fromkeys(rig.units, 0.25), 30.0)
    assert set(rig.read().drive.values()) == {0.25}
    assert rig.read().pump == 1
    rig.apply(dict.fromkeys(rig.units, 0.0), 0)
    assert set(rig.read().drive.values()) == {0.0}
    assert rig.read().pump == 0


def test_what_is_driven_gets_warmer(rig: Rig) -> None:
    full = {"1": 1.0, "percent": 100.0}
    before = rig.read().values
    hold(rig, {name: full[unit] for name, unit in rig.units.items()}, 60.0)
    after = rig.read().values
    assert all(after[name] > before[name] + 3.0 for name in before if name != "t_ambient")


def test_the_clock_is_the_rigs_and_moves_only_while_waiting(rig: Rig) -> None:
    before = rig.read().time_s
    assert rig.read().time_s == before
    for _ in range(7):
        rig.wait(0.1)
    assert rig.read().time_s - before == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize("value", [1e7, -1e7, float("nan"), float("inf")])
def test_a_drive_out_of_range_raises_and_changes_nothing(rig: Rig, value: float) -> None:
    rig.apply(dict.fromkeys(rig.units, 0.25), 1)
    with pytest.raises(ValueError, match="outside"):
        rig.apply(dict.fromkeys(rig.units, value), 1)
    assert set(rig.read().drive.values()) == {0.25}


def test_what_no_rig_can_do_raises(rig: Rig) -> None:
    with pytest.raises(ValueError, match="inputs are"):
        rig.apply({"afterburner": 0.1}, 1)
    with pytest.raises(ValueError, match="inputs are"):
        rig.apply({}, 1)
    with pytest.raises(ValueError, match="neither 0 nor 1"):
        rig.apply(dict.fromkeys(rig.units, 0.0), 2)
    with pytest.raises(ValueError, match="wait"):
        rig.wait(-1.0)


def test_close_switches_everything_off_for_good_and_may_be_called_twice(rig: Rig) -> None:
    rig.apply(dict.fromkeys(rig.units, 0.5), 1)
    rig.close()
    rig.close()
    assert set(rig.read().drive.values()) == {0.0}
    assert rig.read().pump == 0
    rig.apply(dict.fromkeys(rig.units, 0.0), 0)
    with pytest.raises(RuntimeError, match="closed"):
        rig.apply(dict.fromkeys(rig.units, 0.5), 0)


CHANGING = {"Loop", "InputSteps", "DeviceCore", "MeanDrive", "_BadCount", "_Memory", "_Contact"}


@pytest.mark.parametrize(
    "module",
    ["thermogrip.rig.interface", "thermogrip.rig.records.batch", "thermogrip.rig.records.run_folder",
     "thermogrip.rig.session.loop", "thermogrip.rig.session.session", "thermogrip.rig.firmware.reference",
     "thermogrip.rig.guard.trip", "thermogrip.rig.guard.guard",
     "thermogrip.rig.guard.model_checks", "thermogrip.rig.guard.kalman_filter",
     "thermogrip.rig.guard.sensor_checks", "thermogrip.rig.simulation.virtual_device",
     "thermogrip.rig.simulation.twin", "thermogrip.rig.serial.protocol"],
)  # fmt: skip
def test_what_is_handed_on_cannot_be_changed(module: str) -> None:
    every = [
        one for one in vars(import_module(module)).values() if isinstance(one, type) and is_dataclass(one)
    ]
    made = [one for one in every if one.__module__ == module]
    assert made
    for one in made:
        assert one.__dataclass_params__.frozen == (one.__name__ not in CHANGING), one


@pytest.mark.parametrize(
    ("unit", "seen", "known"),
    [
        ("percent", (5.0, 40.0), (0.0, 100.0)),
        ("1", (0.1, 0.6), (-1.0, 1.0)),
        ("1", None, (-1.0, 1.0)),
        ("1", (0.0, 100.0), (0.0, 100.0)),  # percent, in a column that does not say so
        ("W", (0.0, 12.0), (0.0, 12.0)),
        ("W", None, None),
    ],
)
def test_the_range_of_a_drive_is_its_units_unless_the_logs_left_it(unit, seen, known):
    assert range_of(unit, seen) == known
