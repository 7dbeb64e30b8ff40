"""A program that is held up while it records a grasp: the device has measured, and the rows are filled in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.rig.clock import SteppedClock
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.records.recorder import RunFolder
from thermogrip.rig.records.run_folder import read_run
from thermogrip.rig.session.session import PHASES, Session, run_session
from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
from thermogrip.sysid.plant.plant import Plant

HELD_UP = 0.37


class Late(DeviceRig):
    """A rig whose program is held up now and then while the gripper is closed."""

    by_device, waits, closed_ = True, 0, False

    def sample_every(self, seconds: float) -> bool:
        return self.by_device and super().sample_every(seconds)

    def grasp(self, material: str, t_object: float) -> None:
        super().grasp(material, t_object)
        self.closed_ = True

    def wait(self, seconds: float) -> None:
        super().wait(seconds)
        self.waits += self.closed_
        if self.closed_ and self.waits % 20 == 7:
            self._sleep(HELD_UP)


def grasp(plant: Plant, controller: Any, path: Path, *, by_device: bool) -> Session:
    clock = SteppedClock()
    device = VirtualDevice(plant, link="none", clock=clock, t_start=25.0)
    device.place("copper", 45.0)
    rig = Late(DirectPort(device), clock=clock, sleep=clock.sleep)
    rig.by_device = by_device
    with RunFolder(path) as folder:
        session = run_session(rig, controller, 30.0, grasp=("copper", 45.0), clock=clock, recorder=folder)
        folder.finish(session)
    rig.close()
    return session


@pytest.mark.parametrize("by_device", [True, False])
def test_no_row_of_a_grasp_is_missing_where_the_device_measures(
    plant: Plant, controller: Any, tmp_path: Path, by_device: bool
) -> None:
    session = grasp(plant, controller, tmp_path / "run", by_device=by_device)
    assert session.verdict == "settled"
    assert session.grasps is not None
    contact = session.log["phase"].values == PHASES.index("contact")
    apart = np.diff(session.log["time"].values[contact])
    assert (apart.max() > HELD_UP) == (not by_device)
    assert not by_device or apart.max() < 0.2
    assert apart.min() > 0.04
    assert np.ptp(session.log["time"].values[contact]) == pytest.approx(10.0, abs=0.1)
    run = read_run(tmp_path / "run")
    assert run.log is not None
    np.testing.assert_allclose(run.log["t_surface"].values, session.log["t_surface"].values)
    np.testing.assert_allclose(run.log["time"].values, session.log["time"].values)


def test_filled_rows_lie_on_the_curve_of_the_others(plant: Plant, controller: Any, tmp_path: Path) -> None:
    session = grasp(plant, controller, tmp_path / "run", by_device=True)
    assert session.grasps is not None
    time, skin = session.grasps["time"].values, session.grasps["t_surface"].values[0]
    late = (time > 1.0) & (time < 9.5)  # after the step of the touch
    smooth = np.polynomial.Polynomial.fit(time[late], skin[late], 6)
    assert np.abs(skin[late] - smooth(time[late])).max() < 0.3  # noise of 0.04 K, a quantum of 0.06 K
