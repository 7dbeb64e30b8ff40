"""A sampler loses no tick that could be had, counts those that could not, and lets others ask in between."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.rig.makers import PATIENCE_S
from thermogrip.rig.drivers.background_sampler import SWITCH_S, Sampler
from thermogrip.rig.interface import Reading
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant


class Slow(Twin):
    """A twin whose reading takes time on the sampler's clock, and which may fail."""

    takes: Callable[[], None]

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.numbers: list[float] = []  # of the readings, as their times

    def read(self) -> Reading:
        self.takes()
        self.numbers.append(float(len(self.numbers)))
        return replace(super().read(), time_s=self.numbers[-1])


class Measuring(Twin):
    """A twin that measures by itself: at each question it has two more readings, and has lost some."""

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.asked: list[float] = []
        self.taken, self.fail_at = 0, 10**9

    def sample_every(self, seconds: float) -> bool:
        self.asked.append(seconds)
        return True

    def take(self) -> tuple[list[Reading], int]:
        self.taken += 1
        if self.taken == self.fail_at:
            raise RuntimeError("unplugged")
        return [replace(self.read(), time_s=float(2 * self.taken + k)) for k in (0, 1)], 3


def wait_for(done: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not done() and time.monotonic() < end:
        time.sleep(0.005)
    assert done()


def sampler_of(plant: Plant, work: list[float], n: int) -> Sampler:
    """Return a sampler whose k-th reading takes ``work[k]`` seconds of a clock of its own."""
    now, rig, hold = [0.0], Slow(plant), threading.Event()
    pending = iter(work)

    def takes() -> None:
        took = next(pending, None)
        if took is None:
            hold.wait(0.01)  # the test is over: do not spin
            took = 0.0
        now[0] += took

    rig.takes = takes
    sleep = lambda seconds: now.__setitem__(0, now[0] + seconds)  # noqa: E731
    return Sampler(rig, 0.01, clock=lambda: now[0], sleep=sleep, keep=n)


@pytest.mark.parametrize(
    ("work", "missed"), [([0.001, 0.004, 0.009, 0.002], 0), ([0.001, 0.035, 0.001, 0.001], 3)]
)
def test_readings_come_on_the_grid_and_ticks_that_a_slow_one_swallowed_are_counted(
    plant: Plant, work: list[float], missed: int
) -> None:
    sampler = sampler_of(plant, work, 1000)
    with sampler:
        wait_for(lambda: len(sampler.late) >= 6)
    assert list(sampler.late)[:4] == pytest.approx(work)
    assert sampler.missed == missed


def test_every_reading_is_kept_until_it_is_taken_and_no_longer_than_stated(plant: Plant) -> None:
    sampler = sampler_of(plant, [0.001] * 12, 5)
    with sampler:
        wait_for(lambda: sampler.dropped >= 7)
    done = sampler.dropped + 5
    kept = sampler.take()
    assert len(kept) == 5
    assert done == len(sampler.rig.numbers)  # type: ignore[attr-defined]
    assert [reading.time_s for reading in kept] == sampler.rig.numbers[-5:]  # type: ignore[attr-defined]


def test_what_a_device_lost_is_counted_and_it_is_stopped(plant: Plant) -> None:
    rig, now = Measuring(plant), [100.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds
        time.sleep(0.001)

    sampler = Sampler(rig, 0.02, clock=lambda: now[0], sleep=sleep)
    with sampler:
        wait_for(lambda: rig.taken >= 5)
        assert sampler.by_device
        assert rig.asked == [0.02]
    assert rig.asked == [0.02, 0.0]
    assert sampler.missed == 3 * rig.taken
    assert [reading.time_s for reading in sampler.take()] == [float(k) for k in range(2, 2 * rig.taken + 2)]
    # it is asked in the middle between the ticks at which it measures, first half a period from the begin
    assert now[0] == pytest.approx(100.01 + 0.02 * (rig.taken - 1))
    assert max(sampler.late) == pytest.approx(0.0, abs=1e-9)


def test_what_was_read_before_a_failure_is_taken_first(plant: Plant) -> None:
    rig = Measuring(plant)
    rig.fail_at = 4
    with Sampler(rig, 0.001) as sampler:
        wait_for(lambda: sampler._failure is not None)
        assert len(sampler.take()) == 6
        with pytest.raises(RuntimeError, match="unplugged"):
            sampler.take()


def test_the_rig_is_asked_between_two_samples(plant: Plant) -> None:
    rig, inside, clash = Slow(plant), threading.Event(), []

    def takes() -> None:
        clash.append(inside.is_set())

    rig.takes = takes

    def ask() -> str:
        inside.set()
        time.sleep(0.05)
        inside.clear()
        return "done"

    with Sampler(rig, 0.005) as sampler:
        assert sampler.ask(ask) == "done"
        wait_for(lambda: len(clash) > 3)
    assert not any(clash)


def test_pythons_switching_is_as_before_afterwards(plant: Plant) -> None:
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.004)
    try:
        with Sampler(Twin(plant), 0.01):
            assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
        assert sys.getswitchinterval() == pytest.approx(0.004)
    finally:
        sys.setswitchinterval(before)


def test_a_grid_without_a_step_is_refused(plant: Plant) -> None:
    with pytest.raises(ValueError, match="every 0 s"):
        Sampler(Twin(plant), 0.0)
    assert not Sampler(Twin(plant), 0.01).by_device  # before it has asked
