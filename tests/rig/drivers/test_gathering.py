"""Readings that a device takes by its own clock arrive whole, in order, with the time at which they were."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermogrip.rig.clock import SteppedClock
from thermogrip.rig.drivers.background_sampler import Sampler
from thermogrip.rig.drivers.gathering import DeviceClock, Gathering
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.interface import Reading, SamplingRig
from thermogrip.rig.serial.protocol import Kept, Request, Taken, parse_request
from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
from thermogrip.sysid.plant.plant import Plant

DT = 0.01
PATIENCE_S = 60.0  # of a loaded machine


class Bench:
    """A device, its driver, and the clock of both."""

    def __init__(self, plant: Plant) -> None:
        self.clock = SteppedClock()
        self.device = VirtualDevice(plant, link="none", clock=self.clock, t_start=25.0)
        self.rig = DeviceRig(
            DirectPort(self.device), clock=self.clock, sleep=self.clock.sleep, timeout=0.002, greeting=0.1
        )
        self.got: list[Reading] = []
        self.lost = 0

    def take(self) -> None:
        readings, lost = self.rig.take()
        self.got += readings
        self.lost += lost

    def ticks(self) -> list[int]:
        """Return which ticks there are readings of."""
        return [round((reading.time_s - self.got[0].time_s) / DT) for reading in self.got]


@pytest.fixture
def bench(plant: Plant) -> Iterator[Bench]:
    made = Bench(plant)
    assert made.rig.sample_every(DT)
    yield made
    made.rig.close()


def test_a_device_with_our_firmware_may_sample_by_itself(bench: Bench) -> None:
    assert isinstance(bench.rig, SamplingRig)


def test_a_host_that_was_held_up_loses_nothing(bench: Bench) -> None:
    for held_up in (0.01, 0.05, 0.2, 0.01, 0.13):
        bench.clock.sleep(held_up)
        bench.take()
    assert bench.lost == 0
    assert bench.ticks() == list(range(len(bench.got)))
    assert len(bench.got) == round(bench.clock() / DT) + 1


def test_a_reading_has_the_time_at_which_it_was_measured(bench: Bench) -> None:
    bench.clock.sleep(0.105)
    bench.take()
    assert [reading.time_s for reading in bench.got] == pytest.approx([DT * k for k in range(11)], abs=1e-9)


def test_a_reading_says_what_was_applied_then(bench: Bench) -> None:
    bench.clock.sleep(0.015)
    bench.rig.apply({"drive": 0.5}, 1)
    bench.clock.sleep(0.015)
    bench.take()
    assert [(r.drive["drive"], r.pump) for r in bench.got] == [(0.0, 0), (0.0, 0), (0.5, 1), (0.5, 1)]


def test_what_the_device_could_not_keep_is_counted(bench: Bench) -> None:
    bench.clock.sleep(1.0)
    bench.take()
    made = round(1.0 / DT) + 1
    assert len(bench.got) + bench.lost == made
    assert bench.lost > made // 2
    bench.clock.sleep(0.1)
    bench.take()
    assert len(bench.got) + bench.lost == made + 10
    assert bench.ticks() == list(range(len(bench.got)))


def test_over_a_bad_line_every_reading_comes_once(bench: Bench) -> None:
    bench.device.fault("garbage", rate=0.3)
    for _ in range(100):
        bench.clock.sleep(0.05)
        bench.take()
    bench.device.clear()
    bench.take()
    assert bench.lost == 0
    assert bench.ticks() == list(range(501))


def test_a_cable_that_is_out_for_less_than_the_device_keeps_costs_nothing(bench: Bench) -> None:
    bench.clock.sleep(0.05)
    bench.take()
    bench.device.fault("cable_pulled")
    bench.take()
    bench.clock.sleep(0.12)
    bench.device.clear("cable_pulled")
    bench.take()
    bench.take()
    assert bench.lost == 0
    assert bench.ticks() == list(range(18))


def test_a_reset_costs_what_was_not_fetched_and_it_is_counted(bench: Bench) -> None:
    bench.clock.sleep(0.1)
    bench.take()
    bench.clock.sleep(0.06)
    bench.device.fault("reset")
    bench.clock.sleep(0.04)
    bench.take()  # begins anew
    bench.clock.sleep(0.1)
    bench.take()
    assert len(bench.got) + bench.lost == round(0.3 / DT) + 1
    assert bench.lost == 9  # those of 0.11 s to 0.19 s
    assert any(notice.kind == "reset" for notice in bench.rig.notices())


def test_a_device_that_cannot_keep_the_time_is_to_be_polled(bench: Bench) -> None:
    assert not bench.rig.sample_every(1 / 3)
    assert not bench.rig.sample_every(0.005)
    with pytest.raises(RuntimeError, match="sample_every"):
        bench.rig.take()


def test_an_older_firmware_is_to_be_polled(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    def of_old(words: Sequence[str]) -> Request | str:
        return "unknown" if words[0] in ("sample", "take") else parse_request(words)

    monkeypatch.setattr("thermogrip.rig.firmware.reference.parse_request", of_old)
    old = Bench(plant)
    assert not old.rig.sample_every(DT)
    with Sampler(old.rig, DT, clock=old.clock, sleep=old.clock.sleep) as sampler:
        assert not sampler.by_device
    assert sampler.take()
    old.rig.close()


@given(
    st.lists(st.tuples(st.floats(0.0005, 0.1), st.floats(0, 1), st.floats(0, 0.05)), min_size=1, max_size=60),
    st.floats(-5e-3, 5e-3),
    st.integers(0, 2**32 - 1),
)
def test_times_are_off_by_no_more_than_the_last_exchange_took(
    exchanges: list[tuple[float, float, float]], drift: float, start: int
) -> None:
    clock, now = DeviceClock(), 0.0
    for took, share, pause in exchanges:
        now += pause
        answered = now + share * took
        uptime = (start + int(1000 * answered * (1 + drift))) % 2**32
        clock.see(now, now + took, uptime)
        now += took
        assert abs(clock.time(uptime) - answered) <= took + 0.001


def test_a_slow_exchange_moves_nothing() -> None:
    clock = DeviceClock()
    clock.see(1.0, 1.001, 1000)
    before = clock.time(5000)
    clock.see(2.0, 2.5, 2100)
    assert clock.time(5000) == before


def test_times_never_go_back_though_the_offset_does() -> None:
    clock, gathering, times = DeviceClock(), Gathering(10), []
    clock.see(0.0, 0.050, 0)  # the answer was held up
    for k, sent in enumerate((0.050, 0.051)):
        clock.see(sent, sent + 0.0001, 50 + k)
        kept = (Kept(k, 0, (0,), (1,)),)
        times += [t for t, _ in gathering.take(Taken(50 + k, k, k + 1, kept), clock)]
    assert all(b > a for a, b in pairwise(times))


def test_the_sampler_lets_the_device_measure_and_misses_nothing_when_it_is_held_up(plant: Plant) -> None:
    bench = Bench(plant)
    clock = bench.clock
    with Sampler(bench.rig, DT, clock=clock, sleep=clock.sleep) as sampler:
        assert sampler.by_device
        for _ in range(3):
            sampler.ask(lambda: clock.sleep(0.12))  # nobody can ask for a reading meanwhile
            asked, end = len(sampler.late), time.monotonic() + PATIENCE_S
            while len(sampler.late) < asked + 3 and time.monotonic() < end:
                time.sleep(0.001)
    times = [reading.time_s for reading in sampler.take()]
    bench.rig.close()
    assert len(times) >= 36
    assert [b - a for a, b in pairwise(times)] == pytest.approx([DT] * (len(times) - 1), abs=1e-9)
    assert sampler.missed == 0
    assert max(sampler.late) > 0.1  # it was late, and yet it has them
