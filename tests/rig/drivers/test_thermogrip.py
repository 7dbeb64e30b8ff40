"""Our firmware behind its driver: every failure is noted, none is hidden, and drives end by themselves."""

from __future__ import annotations

import time
from collections.abc import Iterator
from unittest.mock import Mock

import numpy as np
import pytest

from tests.rig.makers import Bench, Constant, DirectPort, SteppedClock, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.rig.drivers.connect import open_rig, recognise
from thermogrip.rig.drivers.thermogrip import TTL_S, DeviceRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.interface import DeviceRefusedError
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.serial.protocol import Hello, HostEnd
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.sysid.plant.plant import Plant

DRIVE = {"drive": 0.5}


@pytest.fixture(params=["none", "pty"])
def bench(request: pytest.FixtureRequest, plant: Plant) -> Iterator[Bench]:
    made = Bench(plant, link=request.param, options={"timeout": 2.0 if request.param == "pty" else 0.05})
    yield made
    made.close()


@pytest.fixture
def direct(plant: Plant) -> Iterator[Bench]:
    made = Bench(plant, options={"timeout": 0.05})
    yield made
    made.close()


def test_readings_are_the_plants(bench: Bench) -> None:
    assert (TTL_S, bench.rig.expires_s) == (2.0, 2.0)
    for _ in range(100):
        bench.rig.apply(DRIVE, 1)
        bench.rig.wait(1.0)
    read, true = bench.rig.read().values, bench.device.truth().temperatures
    assert true["t_tank"] > 35.0
    assert all(read[name] == pytest.approx(value, abs=0.4) for name, value in true.items())


def test_a_drive_that_nobody_renews_ends_within_its_time(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.clock.sleep(TTL_S - 0.01)
    assert bench.device.truth().drive == DRIVE
    bench.clock.sleep(0.01)
    assert bench.device.truth().drive == {"drive": 0.0}
    assert bench.rig.read().drive == {"drive": 0.0}
    assert bench.kinds() == {"expired"}


def test_an_open_sensor_reads_nan_and_latches_the_device(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.device.fault("sensor_open", sensor="t_tank")
    bench.clock.sleep(0.5)
    reading = bench.rig.read()
    assert np.isnan(reading.values["t_tank"])
    assert np.isfinite(reading.values["t_surface"])
    assert bench.device.truth().drive == {"drive": 0.0}
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
    assert bench.device.truth().drive == DRIVE
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
    assert bench.device.truth().drive == {"drive": 0.0}
    bench.device.clear("cable_pulled")
    bench.clock.sleep(10.0)  # longer than any back-off
    assert all(np.isfinite(value) for value in bench.rig.read().values.values())
    bench.rig.apply(DRIVE, 1)
    assert bench.device.truth().drive == DRIVE
    reported = [notice.text for notice in bench.rig.notices() if notice.kind == "link"]
    assert "lost" in reported[0]
    assert reported[-1] == "answers again"


def test_a_reset_is_noted_and_nothing_is_driven_until_the_loop_asks_for_it(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    bench.device.fault("reset", cause="watchdog")
    bench.rig.wait(5.0)
    assert bench.device.truth().drive == {"drive": 0.0}
    bench.rig.read()
    reported = [notice.text for notice in bench.rig.notices() if notice.kind == "reset"]
    assert len(reported) == 1
    assert "watchdog, boot 2" in reported[0]
    bench.rig.apply(DRIVE, 1)
    assert bench.device.truth().drive == DRIVE


def test_a_reset_whose_line_was_lost_is_noted_all_the_same(direct: Bench) -> None:
    direct.rig.read()
    direct.device.fault("silence")
    direct.device.fault("reset")
    direct.device.exchange(b"")
    direct.device.clear("silence")
    direct.rig.read()
    assert "reset" in direct.kinds()


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
        assert reading.values["t_tank"] == pytest.approx(
            direct.device.truth().temperatures["t_tank"], abs=0.4
        )
    assert right > 150
    direct.device.clear()


def test_a_driver_that_is_stuck_is_cut_with_its_supply(bench: Bench) -> None:
    bench.rig.apply(DRIVE, 1)
    for share in (0.25, -1.0):
        bench.device.fault("driver_stuck", share=share)
        assert bench.device.truth().drive == {"drive": share}
    bench.rig.apply({"drive": 0.0}, 0)
    assert bench.device.truth().drive == {"drive": 0.0}


def test_close_never_raises_and_says_what_it_could_not_do(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    direct.device.fault("cable_pulled")
    direct.rig.close()
    assert any("ends within 2 s" in notice.text for notice in direct.rig.notices())


LANGUAGES = {"thermogrip": {"drive": 0.5}, "tclab": {"q1": 50.0, "q2": 0.0}}


@pytest.mark.parametrize("lost", ["cable_pulled", "silence"])  # the port is another one, or the adapter's
@pytest.mark.parametrize("protocol", LANGUAGES)
@pytest.mark.parametrize("driven_before", [True, False])
def test_no_drive_reaches_another_board_that_answers_on_the_same_port(
    protocol: str, lost: str, driven_before: bool, plant: Plant
) -> None:
    """Another one of the same kind, as often reset and greeted by somebody before."""
    lab = protocol == "tclab"
    bench = Bench(make_lab() if lab else plant, protocol=protocol, options={"timeout": 0.05})
    rig, port, wait = bench.rig, bench.rig.port, bench.rig.wait
    other = VirtualDevice(bench.device.bench.twin.plant, protocol=protocol, link="none", clock=bench.clock)
    other.exchange(b"Q1 0\r\n" if lab else HostEnd().ask(Hello()))
    controller = Constant(LANGUAGES[protocol] if driven_before else dict.fromkeys(LANGUAGES[protocol], 0.0))

    def swap(seconds: float) -> None:
        wait(seconds)
        if bench.clock() >= 10.0 and port.device is bench.device:
            bench.device.fault(lost)
            rig.read()
            port.device, controller.drive = other, LANGUAGES[protocol]

    rig.wait = swap
    output = "t1" if lab else "t_surface"
    trip = run_session(rig, controller, {output: 35.0}, guard=Guard(skin=output), clock=bench.clock).trip
    assert (trip.kind, trip.time_s < 15.0) == ("cable", True)
    assert "another" in trip.measured
    bench.clock.sleep(10.0)
    other.truth()
    assert len(other.trace) > 150
    assert not any(any(moment.drive.values()) for moment in other.trace)
    rig.close()


def test_a_board_that_comes_back_is_driven_on_where_its_number_says_so(direct: Bench) -> None:
    direct.rig.apply(DRIVE, 1)
    direct.device.fault("silence")
    direct.rig.read()
    direct.device.clear()
    direct.rig.apply(DRIVE, 1)
    assert direct.device.truth().drive == DRIVE


@pytest.mark.parametrize(
    ("heard", "asked", "said", "repeated"),
    [(b"", [3, 1], ["did not answer within 0.15 s", "did not answer within 0.05 s"], 2),
     (b"noise\n", [12, 12], ["was asked 12 times and only damaged answers came"] * 2, 24)],
)  # fmt: skip
def test_a_question_is_asked_so_often_and_once_where_nothing_was_heard(
    direct: Bench, heard: bytes, asked: list[int], said: list[str], repeated: int
) -> None:
    port, written = direct.rig.port, []
    port.write, port.read = written.append, lambda seconds: heard
    for n, text in zip(asked, said):
        written.clear()
        with pytest.raises(PortError, match=text):
            direct.rig.apply(DRIVE, 1)
        assert len(written) == n
        assert {data.lstrip(b"\n") for data in written} == {written[0]}  # with the same number
    del port.write, port.read
    direct.rig.apply(DRIVE, 1)
    notes = [(notice.kind, notice.text) for notice in direct.rig.notices()]
    assert notes.count(("repeated", "no answer; asked again")) == repeated
    assert notes.count(("damaged", "a line came damaged (check)")) == (24 if heard else 0)
    links = [text for kind, text in notes if kind == "link"]
    assert (len(links), links[-1]) == (2, "answers again")


class Flood(DirectPort):
    """A port that never stops talking, and never ends a line."""

    def write(self, data: bytes) -> None: ...

    def read(self, seconds: float) -> bytes:
        return b"\x00" * 64


def test_a_device_that_never_stops_talking_is_not_waited_for_for_ever(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, real = SteppedClock(), SteppedClock()
    device = VirtualDevice(plant, link="none", clock=clock)
    # what waits for a line asks the computer's clock: here it goes on by a millisecond each time
    monkeypatch.setattr(time, "monotonic", lambda: real.sleep(0.001) or real())
    with pytest.raises(PortError, match="nothing here speaks"):
        DeviceRig(Flood(device), clock=clock, sleep=clock.sleep, timeout=0.02, greeting=0.1)
    with pytest.raises(PortError, match="says only"):
        recognise(Flood(device), seconds=1.0)
    for seconds, rounds in ((0.0, 1), (3.0, 3)):  # of two questions and 0.5 s each
        port = Mock(url="COM3", **{"read.return_value": b""})
        with pytest.raises(PortError, match="says nothing; check power and firmware"):
            recognise(port, seconds=seconds)
        assert port.write.call_count == port.drop_input.call_count == 2 * rounds
    assert real() < 10.0


def test_a_port_that_vanishes_between_opening_and_reading_is_one_line(plant: Plant) -> None:
    clock = SteppedClock()
    with VirtualDevice(plant, clock=clock) as device:
        rig = open_rig(device.port, clock=clock, sleep=clock.sleep)
    with pytest.raises(UserError) as refused:
        run_session(rig, Constant(), 30.0, clock=clock)
    assert "\n" not in str(refused.value)
    rig.close()
