"""Our firmware behind its driver: every failure is told, none is believed, and drives end by themselves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from thermogrip.rig.clock import SteppedClock
from thermogrip.rig.drivers.thermogrip import TTL_S, DeviceRig
from thermogrip.rig.interface import DeviceRefusedError
from thermogrip.rig.serial.port import Port, PortError
from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
from thermogrip.sysid.plant.plant import Plant

DRIVE = {"drive": 0.5}


class Bench:
    """A device, its driver, and the clock of both."""

    def __init__(self, plant: Plant, link: str) -> None:
        self.clock = SteppedClock()
        self.device = VirtualDevice(plant, link=link, clock=self.clock, t_start=25.0)
        if link != "none":
            self.device.start()
        port = DirectPort(self.device) if link == "none" else Port(self.device.port, clock=self.clock)
        self.rig = DeviceRig(
            port, clock=self.clock, sleep=self.clock.sleep, timeout=2.0 if link == "pty" else 0.05
        )

    def kinds(self) -> set[str]:
        return {notice.kind for notice in self.rig.notices()}

    def close(self) -> None:
        self.rig.close()
        self.device.stop()


@pytest.fixture(params=["none", "pty"])
def bench(request: pytest.FixtureRequest, plant: Plant) -> Iterator[Bench]:
    made = Bench(plant, request.param)
    yield made
    made.close()


@pytest.fixture
def direct(plant: Plant) -> Iterator[Bench]:
    made = Bench(plant, "none")
    yield made
    made.close()


def test_readings_are_the_plants(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.rig.wait(100.0)
    read, true = bench.rig.read().values, bench.device.true_temperatures
    assert true["t_tank"] > 35.0
    assert all(read[name] == pytest.approx(value, abs=0.4) for name, value in true.items())


def test_a_drive_that_nobody_renews_ends_within_its_time(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.clock.sleep(TTL_S - 0.01)
    assert bench.device.applied_drive == DRIVE
    bench.clock.sleep(0.01)
    assert bench.device.applied_drive == {"drive": 0.0}
    assert bench.rig.read().drive == {"drive": 0.0}
    assert bench.kinds() == {"expired"}


@pytest.mark.parametrize("step", [0.02, 0.1, 0.7, 2.5])
def test_a_drive_holds_while_waits_follow_each_other(direct: Bench, step: float) -> None:
    direct.rig.apply(DRIVE, 1)
    for _ in range(round(6.0 / step)):
        direct.rig.wait(step)
    assert direct.device.applied_drive == DRIVE
    assert direct.rig.read().drive == DRIVE
    assert not direct.kinds()


def test_a_program_that_stood_still_does_not_renew_what_it_wanted_before(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        direct.clock.sleep(seconds + 10.0 * (len(slept) == 2))  # the second sleep lasts 10 s too long

    direct.rig._sleep = sleep
    direct.rig.wait(20.0)
    assert direct.rig.read().drive == {"drive": 0.0}
    assert "expired" in direct.kinds()


def test_an_open_sensor_reads_nan_and_latches_the_device(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.device.fault("sensor_open", sensor="t_tank")
    bench.clock.sleep(0.5)
    reading = bench.rig.read()
    assert np.isnan(reading.values["t_tank"])
    assert np.isfinite(reading.values["t_surface"])
    assert bench.device.applied_drive == {"drive": 0.0}
    with pytest.raises(DeviceRefusedError, match="open:t_tank") as refused:
        bench.rig.apply(DRIVE, 1)
    assert refused.value.code == "latched"
    bench.rig.apply({"drive": 0.0}, 0)  # off is always obeyed
    with pytest.raises(DeviceRefusedError, match="still there"):
        bench.rig.clear()
    bench.device.clear("sensor_open")
    bench.clock.sleep(0.2)
    bench.rig.clear()
    bench.rig.apply(DRIVE, 1)
    assert bench.device.applied_drive == DRIVE
    assert "latched" in bench.kinds()


def test_a_pulled_cable_is_no_reading_and_an_unconfirmed_drive(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.device.fault("cable_pulled")
    reading = bench.rig.read()
    assert all(np.isnan(value) for value in reading.values.values())
    assert reading.drive == {"drive": 0.0}
    with pytest.raises(PortError):
        bench.rig.apply(DRIVE, 1)
    bench.rig.wait(TTL_S)
    assert bench.device.applied_drive == {"drive": 0.0}
    bench.device.clear("cable_pulled")
    bench.clock.sleep(10.0)  # longer than any back-off
    assert all(np.isfinite(value) for value in bench.rig.read().values.values())
    bench.rig.apply(DRIVE, 1)
    assert bench.device.applied_drive == DRIVE
    told = [notice.text for notice in bench.rig.notices() if notice.kind == "link"]
    assert "lost" in told[0]
    assert told[-1] == "answers again"


def test_a_drive_is_never_renewed_by_itself_after_the_cable_was_out(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    direct.device.fault("cable_pulled")
    direct.rig.wait(1.0)
    direct.device.clear("cable_pulled")
    direct.rig.wait(30.0)
    assert direct.device.applied_drive == {"drive": 0.0}


def test_a_reset_is_told_and_nothing_is_driven_until_the_loop_says_so(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.device.fault("reset", cause="watchdog")
    bench.rig.wait(5.0)
    assert bench.device.applied_drive == {"drive": 0.0}
    bench.rig.read()
    told = [notice.text for notice in bench.rig.notices() if notice.kind == "reset"]
    assert len(told) == 1
    assert "watchdog, boot 2" in told[0]
    bench.rig.apply(DRIVE, 1)
    assert bench.device.applied_drive == DRIVE


def test_a_reset_whose_line_was_lost_is_told_all_the_same(direct: Bench) -> None:
    direct.rig.read()
    direct.device.fault("silence")
    direct.device.fault("reset")
    direct.device.exchange(b"")
    direct.device.clear("silence")
    direct.rig.read()
    assert "reset" in direct.kinds()


def test_silence_is_no_reading_and_the_drive_ends(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    direct.device.fault("silence")
    assert np.isnan(direct.rig.read().values["t_tank"])
    direct.rig.wait(3.0)
    assert direct.device.applied_drive == {"drive": 0.0}
    direct.device.clear()
    assert np.isfinite(direct.rig.read().values["t_tank"])


def test_a_line_that_spoils_half_of_what_it_carries_gives_right_readings_or_none(direct: Bench) -> None:
    direct.rig.timeout = 0.001
    direct.device.fault("garbage", rate=0.5)
    right = none = 0
    for k in range(300):
        value = (k % 101) / 200
        try:
            direct.rig.apply({"drive": value}, 1)
        except PortError:
            none += 1
            continue
        reading = direct.rig.read()
        if np.isnan(reading.values["t_tank"]):
            none += 1
            continue
        right += 1
        assert reading.drive == {"drive": value}
        assert reading.values["t_tank"] == pytest.approx(direct.device.true_temperatures["t_tank"], abs=0.4)
    assert right > 150
    direct.device.clear()


def test_no_drive_while_the_pump_is_off(bench: Bench) -> None:
    with pytest.raises(DeviceRefusedError, match="pump is off"):
        bench.rig.apply(DRIVE, 0)
    bench.rig.apply({"drive": 0.0}, 0)


def test_a_pump_that_stands_still_switches_off(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    direct.device.fault("pump_stall")
    direct.rig.wait(4.0)
    with pytest.raises(DeviceRefusedError, match="pump"):
        direct.rig.apply(DRIVE, 1)
    assert direct.device.applied_drive == {"drive": 0.0}


def test_a_driver_that_is_stuck_is_cut_with_its_supply(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.device.fault("driver_stuck", share=-1.0)
    assert bench.device.applied_drive == {"drive": -1.0}
    bench.rig.apply({"drive": 0.0}, 0)
    assert bench.device.applied_drive == {"drive": 0.0}


def test_the_gripper_closes_on_what_is_there(direct: Bench) -> None:
    direct.device.place("copper", 45.0)
    direct.rig.grasp("copper", 45.0)
    direct.rig.wait(5.0)
    touched = direct.rig.read().values["t_surface"]
    direct.rig.release()
    assert touched > 30.0


def test_close_never_raises_and_says_what_it_could_not_do(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    direct.device.fault("cable_pulled")
    direct.rig.close()
    assert any("ends within 2 s" in notice.text for notice in direct.rig.notices())


def test_a_port_where_nobody_speaks_our_protocol_is_refused(plant: Plant) -> None:
    device = VirtualDevice(plant, link="none", clock=SteppedClock())
    device.fault("silence")
    with pytest.raises(PortError, match="nothing here speaks our protocol"):
        DeviceRig(DirectPort(device), greeting=0.1, timeout=0.01)


def test_another_device_on_the_same_port_is_not_taken_for_the_first(direct: Bench, plant: Plant) -> None:
    from tests.rig.lab import make_lab

    direct.device.fault("cable_pulled")
    direct.rig.read()
    port = direct.rig.port
    assert isinstance(port, DirectPort)
    port.device = VirtualDevice(make_lab(), link="none", clock=direct.clock)
    with pytest.raises(PortError, match="another device"):
        direct.rig.apply(DRIVE, 1)
