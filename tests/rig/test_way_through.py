"""From a board that nobody has seen to its target: record, identify, control, on one stepped clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.rig.makers import SteppedClock, make_lab
from tests.rig.session.test_session import steps
from thermogrip.datasets.log_files import read_log
from thermogrip.mpc import Controller
from thermogrip.rig.drivers.connect import open_rig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.records.run_folder import RunFolder
from thermogrip.rig.session.session import play, run_session
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.sysid import identify


def test_a_tclab_is_recorded_identified_and_brought_to_its_target(tmp_path: Path) -> None:
    clock = SteppedClock()
    with VirtualDevice(make_lab(), protocol="tclab", clock=clock, ambient=22.0, seed=2) as device:
        rig = open_rig(device.port, clock=clock, sleep=clock.sleep)
        with RunFolder(tmp_path / "log", {}) as folder:
            log, ended = play(rig, steps(25.0), dt=2.5, clock=clock, recorder=folder)
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
