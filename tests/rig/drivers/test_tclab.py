"""A TCLab behind its driver, and behind the client that its makers wrote."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.rig.makers import Bench, Constant, DirectPort, SteppedClock, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.drivers.connect import open_rig
from thermogrip.rig.drivers.tclab import TCLabRig
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.tclab_firmware import LSB, TCLAB_VERSION, TCLabCore
from thermogrip.rig.simulation.virtual_device import VirtualDevice

OFF = {"q1": 0.0, "q2": 0.0}
HALF = {"q1": 50.0, "q2": 0.0}


class Lab(Bench):
    def __init__(self, **device: float) -> None:
        super().__init__(make_lab(), protocol="tclab", options={"timeout": 0.02}, **device)
        self.lab = self.rig

    def scan(self, times: int) -> None:
        for _ in range(times):
            self.clock.sleep(1.0)
            self.lab.read()


@pytest.fixture
def bench() -> Iterator[Lab]:
    made = Lab()
    yield made
    made.close()


def core() -> TCLabCore:
    lab = TCLabCore()
    lab.sample([25_000, 30_000], flow=False, now_ms=0)
    return lab


@pytest.mark.parametrize(
    ("said", "answered"),
    [(b"VER\r\n", TCLAB_VERSION.encode() + b"\r\n"), (b"Q1 50\n", b"50.000\r\n"),
     (b"Q1 120\n", b"100.000\r\n"), (b"q1 50\r", b"50.000\r\n"), (b"Q2 -3\r\n", b"0.000\r\n"),
     (b"Q1 nonsense\r\n", b"0.000\r\n"), (b"Q1 12.5abc\r\n", b"12.500\r\n"), (b"Q1 5-3\r\n", b"5.000\r\n"),
     (b"R2\r\n", b"0.000\r\n"),
     (b"P1 300\r\n", b"255.00\r\n"), (b"P1 -5\r\n", b"0.00\r\n"), (b"LED 7\r\n", b"7.00\r\n"),
     (b"A\r\n", b"Start\r\n"), (b"X\r\n", b"Stop\r\n"), (b"hello\r\n", b"HELLO\r\n"),
     (b"\r\n\r\n", b""), (b"Q1", b"")],
)  # fmt: skip
def test_the_board_answers_as_its_sketch_does(said: bytes, answered: bytes) -> None:
    assert core().receive(said, 0) == answered


@pytest.mark.parametrize(
    ("said", "drive"),
    [(b"Q1 30\r\nQ2 40\r\n", (300_000, 400_000)), (b"Q1 30\r\nwhat\r\n", (0, 0)),
     (b"P1 100\r\nQ1 50\r\n", (250_000, 0))],
)  # fmt: skip
def test_heaters_have_ceilings_and_an_unknown_word_ends_them(said: bytes, drive: tuple[int, int]) -> None:
    lab = core()
    lab.receive(said, 0)
    assert lab.outputs.drive == drive
    if b"P1" not in said:
        assert [1e4 * float(line) for line in lab.receive(b"SCAN\r\n", 0).split()[2:]] == list(drive)


def test_temperatures_are_tenths_of_the_converters_step() -> None:
    value = float(core().receive(b"T1\r\n", 0))
    tenths = (value + 50.0) / LSB * 10
    assert tenths == pytest.approx(round(tenths), abs=0.02)
    assert value == pytest.approx(25.0, abs=LSB / 20 + 0.001)


@pytest.mark.parametrize("fault", ["sensor_open", "sensor_short"])
def test_a_lost_sensor_reads_nan(bench: Lab, fault: str) -> None:
    bench.device.fault(fault, sensor="t2")
    bench.clock.sleep(0.2)
    assert np.isnan(bench.lab.read().values["t2"])


def test_a_reset_shows_in_the_heaters(bench: Lab) -> None:
    bench.lab.apply(HALF, 1)
    bench.device.fault("reset")
    reading = bench.lab.read()
    assert reading.drive == OFF
    assert any(notice.kind == "reset" for notice in bench.lab.notices())


def test_nothing_ends_the_heaters_of_a_board_whose_host_is_gone(bench: Lab) -> None:
    bench.lab.apply(HALF, 1)
    bench.device.fault("cable_pulled")
    bench.clock.sleep(300.0)
    assert bench.lab.read().drive == bench.device.truth().drive == HALF  # reported as they were set
    with pytest.raises(PortError):
        bench.lab.apply(OFF, 0)
    bench.lab.close()
    assert any("PULL THE PLUG" in notice.text for notice in bench.lab.notices())


class ListensLater(DirectPort):
    """A port whose back-off has no try due for a while."""

    def try_open(self) -> bool:
        return self.is_open


def test_closing_does_not_wait_for_the_next_try_to_open(bench: Lab) -> None:
    bench.lab.port = ListensLater(bench.device)
    bench.lab.apply(HALF, 1)
    bench.device.fault("cable_pulled")
    bench.scan(1)
    bench.device.clear()
    bench.lab.close()
    assert bench.device.truth().drive == OFF


@pytest.mark.parametrize("spoilt", [b"Q1", b"Q2"])
def test_a_heater_that_answers_nonsense_does_not_keep_the_other_on(bench: Lab, spoilt: bytes) -> None:
    bench.lab.apply({"q1": 33.333, "q2": 66.667}, 1)
    assert bench.device.truth().drive == bench.lab.read().drive == {"q1": 33.333, "q2": 66.667}
    whole = bench.device.exchange
    bench.device.exchange = (  # type: ignore[method-assign]
        lambda data: b"7.000\r\n" if data.startswith(spoilt) else whole(data)
    )
    with pytest.raises(PortError, match=r"took 7 % where q. = (33\.333|66\.667) %"):
        bench.lab.apply({"q1": 33.333, "q2": 66.667}, 1)
    bench.lab.close()
    assert bench.device.truth().drive == OFF
    assert not any("PULL THE PLUG" in notice.text for notice in bench.lab.notices())


class Half(Constant):
    """Half power; somebody trips over the cable after 20 s."""

    def __init__(self, device: VirtualDevice) -> None:
        super().__init__({"q1": 50.0, "q2": 50.0})
        self.device = device

    def step(self, reading: Readings, target: Target) -> Move:
        if reading["time_s"] == 20.0:
            self.device.fault("cable_pulled")
        return super().step(reading, target)


@pytest.mark.parametrize(("protocol", "ends"), [("tclab", False), ("thermogrip", True)])
def test_what_is_reported_of_a_pulled_cable_is_true_of_the_board(protocol: str, ends: bool) -> None:
    clock = SteppedClock()
    device = VirtualDevice(make_lab(), protocol=protocol, link="none", clock=clock, t_start=25.0)
    rig = open_rig(DirectPort(device), protocol, clock=clock, sleep=clock.sleep)
    session = run_session(rig, Half(device), {"t1": 40.0}, clock=clock)
    clock.sleep(60.0)
    assert any(device.truth().drive.values()) is not ends
    power = next(event.text for event in session.events if event.kind == "power")
    assert session.trip.kind == "cable"
    for said in (power, session.trip.line()):
        assert ("PULL THE PLUG" in said) is not ends
        assert ("expiry switches it off within 2 s" in said or "switched off by itself" in said) is ends


def test_a_spoilt_line_is_asked_again_and_a_jump_three_times(bench: Lab) -> None:
    bench.lab.read()
    true = 25.0
    bench.device.fault("garbage", rate=0.05)
    wrong = lost = 0
    for _ in range(500):
        bench.clock.sleep(1.0)
        reading = bench.lab.read()
        if np.isnan(reading.values["t1"]):
            lost += 1
        elif abs(reading.values["t1"] - true) > bench.lab.jump:
            wrong += 1
    assert wrong == 0
    assert lost < 50
    bench.device.clear()


@pytest.mark.parametrize(
    ("passed", "scans", "read", "heater"),
    [(1.0, [(28.0, 0.0)], 28.0, 0.0), (10.0, [(28.1, 0.0), (25.1, 0.0), (25.2, 0.0)], 25.2, 0.0),
     (10.1, [(129.9, 0.0)], 129.9, 0.0), (10.1, [(130.0, 0.0)] * 3, np.nan, 0.0),
     (10.1, [(-49.8, 0.0)], -49.8, 0.0), (10.1, [(-49.9, 0.0)] * 3, np.nan, 0.0),
     (1.0, [(129.9, 0.0)] * 3, 129.9, 0.0), (1.0, [(130.0, 0.0)] * 3, np.nan, 0.0),
     (1.0, [(25.0, 0.002)], 25.0, 0.002), (1.0, [(25.0, 0.003)] * 3, 25.0, 0.003)],
)  # fmt: skip
def test_a_scan_that_cannot_be_right_is_asked_three_times(
    bench: Lab, passed: float, scans: list[tuple[float, float]], read: float, heater: float
) -> None:
    lab, left = bench.lab, [(25.0, 0.0), *scans]
    lab._set[0] = 70.0  # a heater may be beyond what a temperature may be
    lab._scan = lambda: [left[0][0], 25.0, 70.0 + left[0][1], left.pop(0)[1]]
    lab.read()
    bench.clock.sleep(passed)
    found = lab.read()
    np.testing.assert_array_equal([found.values["t1"], *found.drive.values()], [read, 70.0 + heater, heater])
    assert left == []
    kinds = {notice.kind for notice in lab.notices()}
    assert ("damaged" in kinds, "reset" in kinds) == (len(scans) == 3, heater > 0.002)


class SlowPort(DirectPort):
    """A port that gives a line every 0.15 s of a clock of its own, ended one way or the other."""

    def __init__(self, device: VirtualDevice, ends: tuple[bytes, ...]) -> None:
        super().__init__(device)
        self.ends, self.now, self.lines = ends, 0.0, 0

    def read(self, seconds: float) -> bytes:
        self.answer += self.device.exchange(b"")
        if seconds < 0.15 or not self.answer:
            self.now += seconds
            return b""
        self.now += 0.15
        line, _, self.answer = self.answer.partition(b"\r\n")
        self.lines += 1
        return line + self.ends[self.lines % len(self.ends)]


@pytest.mark.parametrize("ends", [(b"\r\n",), (b"\n",), (b"\r\n", b"\n", b"\n")])
def test_a_board_that_is_slow_or_ends_its_lines_otherwise_is_read(
    ends: tuple[bytes, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    device = VirtualDevice(make_lab(), protocol="tclab", link="none", clock=SteppedClock(), t_start=25.0)
    port = SlowPort(device, ends)
    port.answer = f"{TCLAB_VERSION}\r\n".encode()  # of whoever asked before, and still under way
    monkeypatch.setattr("thermogrip.rig.drivers.tclab.time.monotonic", lambda: port.now)
    lab = TCLabRig(port)
    lab.apply(HALF, 1)
    assert lab.read().values == pytest.approx({"t1": 25.0, "t2": 25.0}, abs=0.5)
    assert lab.read().drive == HALF
    assert lab.notices() == []
    lab.close()


def test_half_a_number_is_no_number(bench: Lab) -> None:
    port = bench.lab.port
    assert isinstance(port, DirectPort)
    answers = [b"25.", b"25.123\r\n25.0\r\n0.000\r\n0.000\r\n", b"25.123\r\n25.000\r\n0.000\r\n0.000\r\n"]
    heard = iter(answers)
    port.device.exchange = lambda data: next(heard) if data else b""  # type: ignore[method-assign]
    assert bench.lab.read().values == {"t1": 25.123, "t2": 25.0}
    port.device.exchange = VirtualDevice.exchange.__get__(port.device)  # type: ignore[method-assign]


def test_it_cannot_grasp(bench: Lab) -> None:
    with pytest.raises(UserError, match="cannot grasp"):
        bench.lab.grasp("copper", 20.0)


def test_a_silent_port_is_no_tclab() -> None:
    device = VirtualDevice(make_lab(), protocol="tclab", link="none", clock=SteppedClock())
    device.fault("silence")
    port, written = DirectPort(device), []
    port.write = written.append
    with pytest.raises(PortError, match="no TCLab answers"):
        TCLabRig(port, greeting=0.05, timeout=0.01)
    assert written == [b"VER\r\n"] * 5


def test_a_board_that_does_not_answer_is_asked_three_times_and_then_once(bench: Lab) -> None:
    port, written = bench.lab.port, []
    bench.lab.apply(HALF, 1)
    write, port.write = port.write, lambda data: written.append(data) or write(data)
    bench.lab.apply(HALF, 1)
    assert written == [b"Q1 50.000\r\n", b"Q2 0.000\r\n"]  # once where the board took it
    bench.lab.notices()
    bench.device.fault("silence")
    for n, kinds in ((3, ["repeated"] * 3 + ["link"]), (1, [])):
        written.clear()
        with pytest.raises(PortError, match="does not answer"):
            bench.lab.apply(HALF, 1)
        assert written == ([b"Q1 50.000\r\n"] * 3 if n == 3 else [b"VER\r\n"])  # who is there now?
        assert [notice.kind for notice in bench.lab.notices()] == kinds


def test_the_makers_own_client_runs_against_the_virtual_board(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    client = pytest.importorskip("tclab")
    with VirtualDevice(make_lab(), protocol="tclab", clock=SteppedClock(), t_start=25.0) as device:
        found = [(device.port, "virtual", "USB VID:PID=2341:8036")]  # it takes only an Arduino
        monkeypatch.setattr(client.tclab.list_ports, "comports", lambda: found)
        with client.TCLab(port=device.port) as lab:
            assert lab.version == TCLAB_VERSION
            assert abs(lab.T1 - 25.0) < 0.5
            assert abs(lab.T2 - 25.0) < 0.5
            assert lab.Q1(40) == 40.0
            assert lab.Q2(150) == 100.0
            assert lab.Q1() == 40.0
            lab.U2 = 20
            assert lab.U2 == 20.0
            assert lab.LED(50) == 50.0
            lab.P1 = 150
            assert lab.P1 == 150.0
            lab.P1 = 200
            assert device.truth().drive == {"q1": 40.0, "q2": 20.0}
            t1, t2, q1, q2 = lab.scan()
            assert (q1, q2) == (40.0, 20.0)
            assert min(t1, t2) > 20.0
            history = client.Historian(lab.sources)
            for k in range(3):
                history.update(k)
            assert history.columns == ["Time", "T1", "T2", "Q1", "Q2"]
            assert [row[3:] for row in history.log] == [(40.0, 20.0)] * 3
        assert device.truth().drive == OFF
    assert "connected on port" in capsys.readouterr().out
