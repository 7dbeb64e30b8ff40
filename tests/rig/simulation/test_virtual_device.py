"""The device that is not there: its faults sit where real ones do, and its time is its own."""

from __future__ import annotations

import time

import pytest

from tests.rig.makers import PATIENCE_S, STILL, Bench, DirectPort, SteppedClock, make_lab
from thermogrip.rig.clock import ScaledClock
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.firmware.reference import Board, Sensor
from thermogrip.rig.serial.port import Port, PortError
from thermogrip.rig.serial.protocol import Channel
from thermogrip.rig.simulation.virtual_device import FAULTS, VirtualDevice, example_plant
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


def shown(device: VirtualDevice, name: str) -> float | str:
    device.truth()  # up to now
    values = dict(zip((s.name for s in device.bench.board.sensors), device.core._values))
    value = values[name]
    return value if isinstance(value, str) else value / 1000


def test_how_its_time_is_cut_does_not_matter(plant: Plant) -> None:
    def run(pieces: int) -> list[float]:
        bench = Bench(plant, seed=1)
        bench.rig.apply({"drive": 1.0}, 1)
        for _ in range(pieces):
            bench.clock.sleep(3.0 / pieces)
            bench.device.truth()
        return [*bench.device.truth().temperatures.values(), *bench.rig.read().values.values()]

    assert run(1) == pytest.approx(run(60), abs=1e-9)


def test_a_drive_ends_between_two_samples_where_its_time_is_over(plant: Plant) -> None:
    bench = Bench(plant, ambient=25.0, **STILL)
    device = bench.device
    bench.clock.sleep(0.05)
    bench.rig.apply({"drive": 1.0}, 1)
    bench.clock.sleep(60.0)
    device.truth()
    exact = 2.0 * 0.4  # K: 0.4 K/s for two seconds, hardly cooled since
    assert device.trace[21].drive == {"drive": 0.0}
    peak = max(moment.temperatures["t_tank"] for moment in device.trace) - 25.0
    assert peak == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize(
    ("fault", "options", "expected"),
    [("sensor_open", {}, "open"), ("sensor_short", {}, "short"), ("sensor_stuck", {}, 25.0),
     ("sensor_offset", {"kelvin": 7.0}, "7 more"), ("sensor_drift", {"rate": -0.1}, "6 less"),
     ("sensor_lag", {"seconds": 20.0}, "20 s ago"), ("sensor_nan", {}, -273.15)],
)  # fmt: skip
def test_a_sensors_fault_is_in_the_sensor_alone(
    plant: Plant, fault: str, options: dict[str, float], expected: float | str
) -> None:
    bench, past = Bench(plant, ambient=25.0, **STILL), {}
    device, rig, clock = bench.device, bench.rig, bench.clock
    device.fault(fault, sensor="t_tank", **options)
    device.bench.stuck = 1.0  # warms it whatever the latch says
    for k in range(60):
        if not device.core.faults:
            rig.apply({"drive": 0.1}, 1)
        clock.sleep(1.0)
        past[k + 1] = device.truth().temperatures["t_tank"]
    true, got = past[60], shown(device, "t_tank")
    want = {"7 more": true + 7.0, "6 less": true - 6.0, "20 s ago": past[40]}.get(expected, expected)
    assert got == want if isinstance(want, str) else got == pytest.approx(want, abs=0.001)
    assert shown(device, "t_surface") == pytest.approx(device.truth().temperatures["t_surface"], abs=0.001)
    device.clear(fault)
    clock.sleep(0.1)
    assert shown(device, "t_tank") == pytest.approx(device.truth().temperatures["t_tank"], abs=0.05)


def test_a_stalled_pump_moves_no_water(plant: Plant) -> None:
    bench = Bench(plant, t_start=40.0, ambient=20.0)
    device = bench.device
    device.fault("pump_stall")
    bench.rig.apply({"drive": 0.0}, 1)
    assert device.truth().pump == 0
    device.clear("pump_stall")
    assert device.truth().pump == 1


def test_a_device_fits_its_plant_and_counts_its_resets(plant: Plant, clock: SteppedClock) -> None:
    gripper, lab = (VirtualDevice(one, link="none", clock=clock, **STILL) for one in (plant, make_lab()))
    assert gripper.bench.board == Board(
        (Channel("drive", "1", -10_000, 10_000),),
        (
            Sensor("t_tank", 2_000, 60_000),
            Sensor("t_surface", 3_000, 55_000),
            Sensor("t_ambient", guarded=False),
        ),
    )
    assert (lab.bench.board.pump, lab.bench.board.tachometer) == (False, False)
    assert lab.bench.board.sensors[:2] == (Sensor("t1", 2_000, 80_000), Sensor("t2", 2_000, 80_000))
    for cause, boot in (({}, 2), ({"cause": "watchdog"}, 3)):
        gripper.fault("reset", **cause)
        assert (gripper.core.cause, gripper.core.boot) == (cause.get("cause", "external"), boot)
    clock.sleep(5.0)
    gripper.core.boot = 65_535
    gripper.fault("reset")
    assert gripper.core.boot == 0  # 16 bits
    gripper.fault("sensor_offset")  # the skin's, and of 3 K
    gripper.fault("sensor_drift", sensor="t_tank")  # of 20 mK/s
    gripper.fault("driver_stuck")
    clock.sleep(10.0)
    assert (shown(gripper, "t_surface"), shown(gripper, "t_tank")) == (28.0, 25.2)
    assert gripper.truth().drive == {"drive": 0.0}  # without a supply
    gripper.clear("sensor_drift")
    assert (gripper.bench.stuck, list(gripper.bench._faults)) == (1.0, ["t_surface"])
    assert gripper.ordered == -float("inf")


def test_every_fault_can_be_set_and_cleared(plant: Plant) -> None:
    bench = Bench(plant)
    for name in FAULTS:
        bench.device.fault(name)
        bench.clock.sleep(0.5)
        bench.device.clear()
    bench.clock.sleep(0.5)
    bench.rig.clear()
    bench.rig.apply({"drive": 0.2}, 1)
    assert bench.device.truth().drive == {"drive": 0.2}


@pytest.mark.parametrize(("name", "sensor"), [("ghost", None), ("sensor_open", "t_nose")])
def test_an_unknown_fault_or_sensor_is_refused(plant: Plant, name: str, sensor: str | None) -> None:
    with pytest.raises(ValueError, match="no fault"):
        VirtualDevice(plant, link="none").fault(name, sensor=sensor)


def test_what_it_cannot_be_is_refused(plant: Plant) -> None:
    with pytest.raises(ValueError, match="none of"):
        VirtualDevice(plant, protocol="morse", link="none")
    with pytest.raises(ValueError, match="none of"):
        VirtualDevice(plant, link="string")
    with pytest.raises(ValueError, match="two heaters"):
        VirtualDevice(plant, protocol="tclab", link="none")
    with pytest.raises(ValueError, match="no cable"):
        _ = VirtualDevice(plant, link="none").port


def test_a_port_without_its_cable_says_that_it_is_closed(clock: SteppedClock) -> None:
    device = VirtualDevice(make_lab(), link="none", clock=clock)
    port = DirectPort(device)
    port.close()
    device.fault("cable_pulled")
    assert not port.try_open()
    for call, words in ((port.open, "is not there"), (lambda: port.read(0.0), "was lost")):
        with pytest.raises(PortError, match=words):
            call()
    device.clear()  # without a name: all faults
    assert port.try_open()
    assert (port.opened, port.try_open(), port.opened) == (2, True, 2)


def test_every_line_is_spoilt_at_a_rate_of_one_and_half_of_them_by_default(clock: SteppedClock) -> None:
    device, lines = VirtualDevice(make_lab(), link="none", clock=clock), b"7 read*06EC819405\n" * 400
    for options, least, most in (({"rate": 1.0}, 360, 400), ({}, 150, 250), ({"rate": 0.0}, 0, 0)):
        device.fault("garbage", **options)
        whole = device._spoilt(lines).split(b"\n").count(b"7 read*06EC819405")
        assert least <= 400 - whole <= most
    assert device._spoilt(b"") == b""


def test_a_bundled_board_is_off_its_network_so_that_a_fit_finds_something() -> None:
    board, usual = example_plant("tclab", room=19.0), example_plant("tclab")
    off = {"G_amb": 0.013, "G_between": 0.006, "power_1": 0.86, "power_2": 0.61, "lag_1": 16.0, "lag_2": 19.0}
    assert {name: board.values[name] for name in off} == {name: usual.values[name] for name in off} == off
    assert board.values["t_room"] == 19.0 != usual.values["t_room"]


def test_a_day_takes_no_memory(clock: SteppedClock) -> None:
    device = VirtualDevice(make_lab(), link="none", clock=clock, keep=100)
    clock.sleep(200.0)
    device.truth()
    assert len(device.trace) == 100
    assert len(device.bench.twin.history) <= 4


def test_a_device_on_the_computers_clock_runs_by_itself() -> None:
    with VirtualDevice(make_lab(), clock=ScaledClock(50.0)) as device:
        rig = DeviceRig(Port(device.port), timeout=PATIENCE_S, greeting=PATIENCE_S)
        before = device.time
        end = time.monotonic() + PATIENCE_S
        while device.time < before + 10.0 and time.monotonic() < end:
            time.sleep(0.02)
        assert device.time >= before + 10.0
        assert rig.read().values["t1"] == pytest.approx(25.0, abs=1.0)
        rig.close()


def test_an_unheated_tclab_stays_at_the_temperature_of_its_room(clock: SteppedClock) -> None:
    device = VirtualDevice(protocol="tclab", link="none", clock=clock, ambient=18.0)
    clock.sleep(60.0)
    assert list(device.truth().temperatures.values()) == pytest.approx([18.0, 18.0], abs=1e-6)


def test_a_device_that_the_computer_holds_up_counts_no_time_meanwhile(plant: Plant) -> None:
    class Jumping(ScaledClock):
        """Slow, and a minute later after a while in which nobody served."""

        late = 0.0

        def __call__(self) -> float:
            return super().__call__() + self.late

    clock = Jumping(0.01)
    with VirtualDevice(plant, clock=clock, link="socket") as device:
        rig = DeviceRig(Port(device.port))
        rig.apply({"drive": 0.5}, 1)
        clock.late = 60.0
        assert device.truth().drive == {"drive": 0.5}
        assert rig.read().drive == {"drive": 0.5}
        rig.close()
