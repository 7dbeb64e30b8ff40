"""Drives that act later than in the model are found, and the loop that they made swing settles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import network_plant
from thermogrip.mpc.closed_loop.simulate import Surroundings, Truth, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.estimator.late_drives import LateDriveMonitor, LateDrives, _Fit
from thermogrip.sysid.plant.plant import Plant

STEP = [(38.0, 300.0)]
AROUND = Surroundings(noise=0.02, quantum=0.0)


def gripper() -> Plant:
    """Return the gripper at its prior, of which no posterior is known."""
    plant = network_plant("gripper")
    return replace(plant, noise=dict.fromkeys(plant.outputs, 0.02))


def of(plant: Plant, *, looks: bool = True) -> Controller:
    """Return a controller, perhaps one that does not look for drives that are late."""
    controller = design_controller(plant, controlled=("t_surface",))
    if not looks:
        controller.lateness.note = lambda *_: False  # type: ignore[method-assign]
    return controller


def test_what_acts_has_the_integral_of_what_was_applied():
    rng, drives = np.random.default_rng(1), LateDrives(2, longest=20.0)
    drives.begin(np.array([0.5, -1.0]))
    drives.late = np.array([3.3, 7.1])
    fine, line = 0.01, [np.array([0.5, -1.0])] * 2000
    for _ in range(60):
        seconds, u = 0.01 * rng.integers(1, 300), rng.standard_normal(2)
        drives.apply(seconds, u)
        line += [u] * round(seconds / fine)
        begin, length = -0.01 * rng.integers(0, 400), 0.01 * rng.integers(1, 500)
        ahead = [*line, *([u] * 2000)]
        for j, late in enumerate(drives.late):
            first = len(line) + round((begin - late) / fine)
            mean = np.mean([row[j] for row in ahead[first : first + round(length / fine)]])
            assert drives.acting(begin, length, u)[j] == pytest.approx(mean, abs=1e-9)


def test_drives_that_are_not_late_act_as_they_are_to_the_last_bit():
    drives, u = LateDrives(1, longest=5.0), np.array([0.1])
    drives.apply(1.0, u)
    assert drives.acting(-1.0, 1.0, u) is u


@pytest.mark.parametrize(
    ("changes", "settling"),
    [({"move_delay_s": 4.5}, 1.8), ({"sensor_lag_s": 4.5}, 0.99)],
    ids=["a late drive", "all sensors slower"],
)
def test_what_every_output_shows_is_reported_in_a_window_and_not_taken_for_biases(
    changes: Mapping[str, float], settling: float
):
    plant, around = gripper(), replace(AROUND, **changes)
    controller = of(plant)
    run = simulate_closed_loop(controller, plant, STEP, surroundings=around)
    blind = simulate_closed_loop(of(plant, looks=False), plant, STEP, surroundings=around)
    assert run.status.index("mismatch") * controller.dt <= controller.lateness._window * controller.dt
    assert set(run.status[run.status.index("mismatch") :]) == {"mismatch"}
    assert run.advice[-1].startswith("drive acts later than in the model by about 4.")
    assert controller.lateness.late[0] == pytest.approx(4.5, abs=0.4)
    assert run.segments[0].settle_s < 180.0
    assert run.segments[0].overshoot < 0.1
    assert abs(run.segments[0].bias) < 0.01
    assert not any("later than" in advice for advice in blind.advice)  # it swings, and may say so
    assert blind.segments[0].settle_s > settling * run.segments[0].settle_s
    assert blind.segments[0].travel > 1.1 * run.segments[0].travel


@pytest.mark.parametrize(
    "changes",
    [{}, {"drive_share": 0.8}, {"move_delay_s": 1.0}],
    ids=["as the model", "weaker", "a little late"],
)
def test_drives_that_are_hardly_late_are_left_as_they_are(changes: Mapping[str, float]):
    plant = gripper()
    around = replace(AROUND, **changes)
    run = simulate_closed_loop(of(plant), plant, STEP, surroundings=around)
    blind = simulate_closed_loop(of(plant, looks=False), plant, STEP, surroundings=around)
    np.testing.assert_array_equal(run.drive["drive"], blind.drive["drive"])
    assert "mismatch" not in run.status


def test_the_filter_that_was_led_through_the_window_shows_what_is_read():
    plant = gripper()
    controller, world = of(plant), Truth(plant, 2.0, replace(AROUND, move_delay_s=4.5), None, 0)
    assert controller.dt == world.dt
    controller.reset(world.reading())
    while not controller.lateness.late.any():
        move = controller.step(world.reading(), 38.0)
        shown = world.y[-1]
        world.apply(move)
        assert world.time < 90.0
    np.testing.assert_allclose(controller.observer.reading(), shown, atol=0.1)
    assert np.max(np.abs(controller.observer.drive_bias)) < 0.03


def test_a_reset_forgets_that_drives_are_late():
    plant = gripper()
    controller = of(plant)
    simulate_closed_loop(controller, plant, [(38.0, 100.0)], surroundings=replace(AROUND, move_delay_s=4.5))
    assert controller.drives.late.any()
    controller.reset({"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0})
    assert not controller.drives.late.any()
    assert not controller.lateness.said


def test_a_lateness_that_is_known_already_leads_no_filter(monkeypatch: pytest.MonkeyPatch):
    controller = of(gripper())
    controller.reset({"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0})
    look, before = controller.lateness, controller.observer.now.copy()
    best = [0.0]

    def fitted(*given: object, lags: object = None) -> _Fit:
        late = np.asarray(given[3])
        return _Fit(100.0 if lags is not None else 50.0 + 9 * abs(late[0] - best[0]), 9.0, before, look.late)

    monkeypatch.setattr(LateDriveMonitor, "_fitted", fitted)
    monkeypatch.setattr(LateDriveMonitor, "_lead", lambda *given: None)
    assert not look._look(controller.observer)
    best[0] = 2.0
    assert look._look(controller.observer)
    assert look.late[0] == pytest.approx(2.0 * controller.dt, rel=0.1)
