"""From a board that nobody has seen to its target: record, identify, control, on one stepped clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Log, make_log
from thermogrip.mpc import Controller
from thermogrip.rig.clock import SteppedClock
from thermogrip.rig.drivers.connect import open_rig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.records.recorder import RunFolder
from thermogrip.rig.session.schedule_player import Playback, play
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
from thermogrip.sysid import identify

from .lab import make_lab

UNITS = {"q1": "percent", "q2": "percent"}


def schedule(minutes: float, *, high: float = 60.0, seed: int = 0) -> Log:
    """Return steps of a random height and length for both heaters."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 60.0 * minutes)
    drives = {}
    for name in UNITS:
        lengths = rng.integers(20, 200, size=time.size)
        levels = rng.uniform(0.0, high, size=time.size)
        drives[name] = (np.repeat(levels, lengths)[: time.size], "percent", "input")
    return make_log(time, drives, name="schedule")


def test_a_tclab_is_recorded_identified_and_brought_to_its_target(tmp_path: Path) -> None:
    clock = SteppedClock()
    with VirtualDevice(make_lab(), protocol="tclab", clock=clock, ambient=22.0, seed=2) as device:
        rig = open_rig(device.port, clock=clock, sleep=clock.sleep)
        with RunFolder(tmp_path / "log", {}) as folder:
            log, ended = play(rig, schedule(25.0), dt=2.5, clock=clock, recorder=folder)
        assert ended == ""
        assert device.applied_drive == {"q1": 0.0, "q2": 0.0}
        written = read_log(tmp_path / "log" / "samples.csv", inputs=["q1", "q2"], outputs=["t1", "t2"])
        np.testing.assert_allclose(written["t1"].values, log["t1"].values, atol=1e-6)

        plant = identify(written, models=("oe",), average=5.0, draws=0).plant
        regulator = Controller(plant)
        targets = {"t1": 45.0, "t2": 38.0}
        with RunFolder(tmp_path / "run", {}) as folder:
            session = run_session(
                rig,
                regulator,
                targets,
                guard=Guard(plant),
                clock=clock,
                settle_timeout=1500.0,
                recorder=folder,
            )
            folder.finish(session)
        true = device.true_temperatures
        rig.close()
    assert session.verdict == "settled", session.advice
    assert true == pytest.approx(targets, abs=0.6)
    assert device.applied_drive == {"q1": 0.0, "q2": 0.0}


def test_our_device_plays_a_schedule_and_pauses_the_drive_with_the_pump(plant: object) -> None:
    clock = SteppedClock()
    device = VirtualDevice(make_lab(), link="none", clock=clock)
    rig = open_rig(DirectPort(device), clock=clock, sleep=clock.sleep)
    plan = schedule(1.0)
    plan["pump"] = ("time", np.where(np.arange(60) < 30, 1.0, 0.0))
    log, ended = play(rig, plan, clock=clock)
    assert ended == ""
    assert log.sizes["time"] == 60
    np.testing.assert_allclose(log["q1"].values[:30], plan["q1"].values[:30])
    assert not log["q1"].values[30:].any()
    rig.close()


def test_a_sensor_that_is_lost_while_a_schedule_is_played_ends_it_with_everything_off(tmp_path: Path) -> None:
    clock = SteppedClock()
    device = VirtualDevice(make_lab(), protocol="tclab", link="none", clock=clock)
    rig = open_rig(DirectPort(device), clock=clock, sleep=clock.sleep)

    def progress(done: float, what: str) -> None:
        if done > 0.5:
            device.fault("sensor_open", sensor="t1")

    log, ended = play(rig, schedule(2.0), clock=clock, progress=progress)
    assert "t1" in ended
    assert device.applied_drive == {"q1": 0.0, "q2": 0.0}
    assert 60 <= log.sizes["time"] < 90
    rig.close()


@pytest.mark.parametrize("left_out", ["q1", "unit"])
def test_a_schedule_that_does_not_fit_the_rig_is_refused(left_out: str) -> None:
    plan = schedule(1.0)
    if left_out == "q1":
        plan = plan.drop_vars("q1")
    else:
        plan["q1"].attrs["units"] = "1"
    with pytest.raises(ValueError, match="no q1 in percent"):
        Playback(plan, UNITS, 1.0)
