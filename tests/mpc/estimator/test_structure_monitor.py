"""Plants that are draws of the posterior are not reported; those that lack structure are, in words."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import network_plant
from thermogrip.mpc.closed_loop.simulate import RecordedController, Surroundings, Truth
from thermogrip.mpc.controllers.loop_monitor import LoopMonitor
from thermogrip.mpc.controllers.mpc import design_controller
from thermogrip.mpc.estimator.structure_monitor import Misfit, StructureMonitor, _Row, _test_alternatives
from thermogrip.mpc.interface import Move
from thermogrip.sysid.plant.plant import Plant

DT = 4.0
TARGETS = ({"t1": 45.0, "t2": 38.0}, {"t1": 35.0, "t2": 45.0})


@cache
def kit() -> Plant:
    """Return two heaters whose numbers are known to 5 %."""
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    free = tuple(plant.model.parameters)
    scales, spread = dict.fromkeys(free, "log"), np.diag(np.full(len(free), 0.05**2))
    noise = dict.fromkeys(plant.outputs, 0.05)
    return replace(plant, free=free, scales=scales, covariance=spread, noise=noise)


def watched(plant: Plant, **changes: Any) -> RecordedController:
    """Return the default controller of a plant with a monitor beside it."""
    controller = design_controller(plant, **changes)
    return RecordedController(controller, LoopMonitor(plant, controller.design))


def loop(
    controller: RecordedController, truth: Plant, around: Surroundings | None = None, seed: int = 0
) -> list[Move]:
    """Return the moves of 200 s at each target."""
    world, moves = Truth(truth, DT, around or Surroundings(), None, seed), []
    controller.reset(world.reading())
    for k in range(100):
        moves.append(controller.step(world.reading(), TARGETS[k // 50]))
        world.apply(moves[-1])
    return moves


def told(moves: list[Move]) -> list[str]:
    return [move.advice for move in moves if move.status == "mismatch"]


@pytest.mark.parametrize("draw", [0, 1, 3])
def test_a_draw_of_the_posterior_is_not_reported(draw: int):
    controller = watched(kit(), dt=DT)
    assert not told(loop(controller, kit().draw(draw), seed=draw))
    assert controller.monitor.structure.denies


def test_a_drive_that_is_a_fifth_weaker_than_the_posterior_has_it_is_not_reported():
    numbers = replace(kit(), covariance=kit().covariance / 100)
    controller = watched(numbers, dt=DT)
    assert not told(loop(controller, numbers, Surroundings(drive_share=0.8)))
    assert controller.monitor.structure.denies


def test_drives_that_acted_a_sample_later_than_the_model_was_told_are_slower_by_a_sample():
    controller = design_controller(kit(), dt=DT)
    seen = StructureMonitor(kit(), controller.model, ("t1", "t2"))
    rows, world = [], Truth(kit(), DT, Surroundings(noise=0.01, quantum=0.0), None, 2)
    controller.reset(world.reading())
    for _ in range(30):
        reading = world.reading()
        move = controller.step(reading, TARGETS[0])
        y = np.array([reading["t1"], reading["t2"]])
        rows.append(
            (
                controller.observer.now.copy(),
                controller.observer.w.copy(),
                y,
                np.array([*move.drive.values()]),
            )
        )
        world.apply(move)
    start, w = rows[8][:2]
    for at, early in ((1, 0.0), (2, 1.0)):
        seen.restart()
        for k in range(8, 29):
            u = rows[k - 2 + at][3]  # what was applied before the reading, or a sample after it was
            seen._history.append(_Row(start, w, rows[k][2], rows[k][2], u, np.zeros(0)))
        found = seen.misfit(controller.observer)
        late = [size * one.unit for size, one in zip(found.size, seen.bank) if "acts" in one.words]
        np.testing.assert_allclose(late, early * DT, atol=1.5)


@pytest.mark.slow
def test_of_60_draws_none_is_reported():
    controller = watched(kit(), dt=DT)
    assert not [k for k in range(60) if told(loop(controller, kit().draw(k + 10), seed=k))]


@pytest.mark.parametrize(
    ("around", "words"),
    [
        (Surroundings(sensor_lag_s=8.0), "t[12] (is slower|has a second mass)"),
        # by the filter's lag or by the monitor, or by both drives together
        (
            Surroundings(move_delay_s=8.0),
            r"(t[12] is slower than the model|q1, q2 act later than in the model) by about (7|8)",
        ),
    ],
)
def test_what_the_model_lacks_is_reported_in_two_windows(around: Surroundings, words: str):
    moves = loop(watched(kit(), dt=DT), kit().draw(1), around, 1)
    assert [move.status for move in moves].index("mismatch") <= 40
    assert re.search(words, told(moves)[0])
    assert re.match("t[12] (is slower|has a second mass)|q1, q2 act later", told(moves)[-1])


@pytest.fixture(scope="module")
def bench():
    folder = Path(__file__).parents[3] / "benchmarks"
    if not folder.is_dir():
        pytest.skip("the benchmarks are not beside the tests")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder / "control"))
        import mismatch

        patch.setattr(mismatch, "SECONDS", 60.0)
        model = mismatch.model_of()
        yield mismatch, watched(model)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("every number off", None),
        ("gain -30 %", None),
        ("delay -50 %", r"t_surface is faster than the model by about 1\."),
        ("delay +50 %", "t_surface is slower than the model by about 0.[5-9]"),
        ("second layer inside", "t_surface has a second mass, for about 1[0-9] % of its heat"),
        ("dead zone 0.3 A", "current has a dead zone of about 0.[34]"),
    ],
)
def test_a_step_of_a_minute_shows_the_structure_and_not_the_numbers(bench, row: str, words: str | None):
    mismatch, controller = bench
    truth = next(case.truth for case in mismatch.CASES if case.name == row)
    said = told(list(mismatch.close_loop(controller, truth, 11, mismatch.TARGETS[:1]).moves))
    if words is None:
        assert not said
    else:
        assert re.search(words, said[-1]), said


def test_z_is_normal_where_the_readings_are_those_of_the_model():
    monitor = StructureMonitor(kit(), design_controller(kit(), dt=DT).model, ("t1", "t2"))
    rng = np.random.default_rng(5)
    J, a = rng.standard_normal((6, 80)), rng.standard_normal((len(monitor.bank), 80))
    tolerated, granted = np.array([(one.tolerated, one.granted) for one in monitor.bank]).T
    seen = []
    for _ in range(2000):
        r = rng.standard_normal(80) + rng.standard_normal(6) @ J
        r += (tolerated * rng.standard_normal(len(a))) @ (
            a * np.array([[one.granted] for one in monitor.bank])
        )
        at = int(rng.integers(len(a)))
        own = 0.0 if granted[at] else tolerated[at] * rng.standard_normal()
        found = _test_alternatives(monitor.bank, J, a, r + own * a[at])
        seen.append((found.z[at], found.chi))
    z, chi = np.array(seen).T
    assert abs(np.std(z) - 1) < 0.05
    assert abs(np.mean(chi) - 1) < 0.2
    np.testing.assert_allclose(_test_alternatives(monitor.bank, J, a, 3.0 * a[1]).size[1], 3.0)


def misfit(monitor: StructureMonitor, z: float, sd: float = 0.1, chi: float = 1.0) -> Misfit:
    sizes, spread = np.zeros(len(monitor.bank)), np.full(len(monitor.bank), sd)
    sizes[1] = z * sd
    return Misfit(sizes, spread, sizes / sd, chi)


def test_a_report_stays_until_a_window_that_would_show_it_does_not():
    monitor = StructureMonitor(kit(), design_controller(kit(), dt=DT).model, ("t1",))
    said = []
    for z, sd, chi in (
        *((4.9, 0.1, 1.0), (5.1, 0.1, 1.0), (0.0, 0.3, 1.0), (2.1, 0.1, 1.0), (1.9, 0.2, 1.0)),
        *((-9.0, 0.1, 1.0), (1.0, 0.1, 4.1), (400.0, 0.1, 1.0)),
    ):
        monitor._report(misfit(monitor, z, sd, chi))
        said.append(monitor.said)
        assert monitor.denies == (not monitor.said)
    assert [bool(text) for text in said] == [False, True, True, True, False, False, True, True]
    D = monitor._delays[0]
    assert said[1] == f"t1 is slower than the model by about {0.51 * D / 8:.2g} s: identify the plant anew"
    assert said[-1] == f"t1 is slower than the model by more than {2 * D:.2g} s: identify the plant anew"


def test_a_window_is_of_calls_at_the_sample_time_and_of_drives_near_the_model():
    controller = watched(kit(), dt=DT)
    loop(controller, kit())
    monitor, observer = controller.monitor.structure, controller.monitor.observer
    assert len(monitor._history) == 2 * monitor.window + 1
    reading = {"t1": 35.0, "t2": 45.0, "time_s": 396.0}
    for late, length in ((4.0, 2 * monitor.window + 1), (5.0, 1), (4.0, 2), (4.2, 3), (4.6, 1)):
        reading["time_s"] += late
        controller.step(reading, TARGETS[1])
        assert len(monitor._history) == length, late
    observer.w = np.array([0.5, 0.0])
    monitor.note(observer, np.zeros(2), np.zeros(2), np.zeros(0))
    assert not monitor._history


def test_a_lost_reading_counts_nothing_and_a_run_that_diverges_says_nothing():
    controller = watched(kit(), dt=DT)
    loop(controller, kit(), seed=3)
    monitor, observer = controller.monitor.structure, controller.monitor.observer
    whole = monitor.misfit(observer)
    rows = list(monitor._history)
    monitor._history[-3] = rows[-3]._replace(y=np.array([np.nan, rows[-3].y[1]]))
    part = monitor.misfit(observer)
    assert np.all(part.sd >= whole.sd * 0.995)
    np.testing.assert_allclose(part.size, whole.size, atol=1.5)
    for before, after in pairwise(range(len(rows))):
        monitor._history[after] = rows[before]._replace(u=np.full(2, 1e300))
    assert monitor.misfit(observer) is None


def test_a_plant_without_a_posterior_is_not_watched():
    controller = watched(replace(kit(), covariance=None), dt=DT)
    moves = loop(controller, kit().draw(1), Surroundings(move_delay_s=8.0))
    assert not controller.monitor.structure.said
    assert not told(moves[:20])
    drawn = np.array([kit().draw(k).p for k in range(1, 400)])
    sampled = StructureMonitor(replace(kit(), covariance=None, samples=drawn), controller.model, ("t1",))
    np.testing.assert_allclose(sampled.spread @ sampled.spread.T, kit().covariance, atol=6e-4)
