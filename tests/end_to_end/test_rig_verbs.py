"""virtual, record and run on a port: a device in a process of its own, and the verbs that drive it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from tests.rig.makers import SteppedClock
from thermogrip.cli.main import main
from thermogrip.datasets.log_files import read_log
from thermogrip.mpc import Controller
from thermogrip.rig.drivers.connect import open_rig
from thermogrip.rig.drivers.tclab import TCLabRig
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

PATIENCE_S = 60.0  # of a loaded machine; nothing waits so long that goes as it should


def lab_plant() -> Plant:
    """Return two heaters without a room."""
    a = np.array([[1 - 1 / 200, 0.0005], [0.0005, 1 - 1 / 200]])
    model = StateSpaceModel(
        ("q1", "q2"), (), ("t1", "t2"), A=a, B=np.eye(2) * 0.0015, C=np.eye(2), dt=1.0, y0=[25.0, 25.0]
    )
    units = {"q1": "percent", "q2": "percent", "t1": "degC", "t2": "degC"}
    return Plant(model, {}, dt=1.0, units=units, valid={"q1": (0.0, 100.0), "q2": (0.0, 100.0)})


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    return lab_plant().save(tmp_path / "plant.json")


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[VirtualDevice]:
    """A board on a pty, on one stepped clock with the verbs that drive it."""
    clock = SteppedClock()
    monkeypatch.setattr("thermogrip.rig.clock.ScaledClock", {5.0: clock}.__getitem__)
    monkeypatch.setitem(TCLabRig.__init__.__kwdefaults__, "timeout", PATIENCE_S)
    with VirtualDevice(lab_plant(), protocol="tclab", clock=clock, t_start=25.0) as made:
        yield made


def test_virtual_prints_its_port_and_serves_until_it_is_stopped(plant_file: Path) -> None:
    words = [sys.executable, "-P", "-m", "thermogrip", "virtual", "--protocol", "tclab"]
    words += ["--plant", str(plant_file), "--socket", "0", "--json"]
    served = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert served.stdout is not None
    said = "".join(iter(served.stdout.readline, "}\n")) + "}"
    rig = open_rig(json.loads(said)["port"])
    rig.timeout = PATIENCE_S
    assert rig.units == {"q1": "percent", "q2": "percent"}
    assert rig.read().values["t1"] == pytest.approx(23.0, abs=20.0)
    rig.close()
    served.send_signal(signal.SIGTERM)
    _, complaint = served.communicate(timeout=600)
    assert served.returncode == 130, complaint


def test_a_schedule_ends_where_the_guard_trips_and_the_answer_is_no(
    device: VirtualDevice, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    schedule, guard, out = (tmp_path / name for name in ("schedule.csv", "guard.toml", "log"))
    rows = [f"{k},100,0" for k in range(60)]
    schedule.write_text("\n".join(["time_s,q1_percent,q2_percent", *rows]) + "\n")
    guard.write_text("[limits]\nt1 = [5, 27]\n")
    words = ["record", str(schedule), "--port", device.port, "--protocol", "tclab", "--speed", "5"]
    words += ["--sample", "0.5", "--guard", str(guard), "--seed", "3", "--out", str(out), "--json"]
    assert main(words) == 3
    answer = json.loads(capsys.readouterr().out)
    log = read_log(out / "samples.csv", inputs=["q1", "q2"], outputs=["t1", "t2"])
    assert (answer["rows"], answer["out"]) == (log.sizes["time"], str(out))
    assert answer["ended"].startswith("limit: t1")
    assert np.diff(log["time"].values).tolist() == [0.5] * (log.sizes["time"] - 1)
    assert 25.0 < float(log["t1"][-1]) <= 27.5
    about = json.loads((out / "run.json").read_text())
    assert (about["verdict"], about["about"]["sample_s"], about["about"]["seed"]) == ("tripped", 0.5, 3)
    assert device.truth().drive == {"q1": 0.0, "q2": 0.0}


def test_record_writes_what_the_schedule_did(device: VirtualDevice, tmp_path: Path) -> None:
    schedule = tmp_path / "schedule.csv"
    rows = [f"{k},{40 if k >= 5 else 0},{20 if k >= 10 else 0}" for k in range(20)]
    schedule.write_text("\n".join(["time_s,q1_percent,q2_percent", *rows]) + "\n")
    words = ["record", str(schedule), "--port", device.port, "--speed", "5", "--out", str(tmp_path / "log")]
    assert main(words) == 0
    log = read_log(tmp_path / "log" / "samples.csv", inputs=["q1", "q2"], outputs=["t1", "t2"])
    assert json.loads((tmp_path / "log" / "run.json").read_text())["verdict"] == "played"
    assert set(log["q1"].values) == {0.0, 40.0}
    assert set(log["q2"].values) == {0.0, 20.0}
    assert log["time"].values.tolist() == [float(k) for k in range(20)]
    assert log["q1"].values.tolist() == [40.0 * (k >= 5) for k in range(20)]
    assert device.truth().drive == {"q1": 0.0, "q2": 0.0}


def test_run_drives_the_rig_on_a_port_and_leaves_it_off(
    device: VirtualDevice, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    controller = tmp_path / "controller.json"
    Controller(lab_plant()).save(controller)
    words = ["run", str(controller), "--port", device.port, "--speed", "5", "--target", "t1=40,t2=35"]
    words += ["--settle-timeout", "20", "--out", str(tmp_path / "run"), "--json"]
    assert main(words) == 3  # 20 s are too short for it, which is an answer
    answer = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "not settled", answer
    assert max(moment.drive["q1"] for moment in device.trace) > 0.0
    assert device.truth().drive == {"q1": 0.0, "q2": 0.0}
    made = json.loads((tmp_path / "run" / "run.json").read_text())
    assert made["about"]["port"] == device.port
    assert made["provenance"]["inputs"][str(controller)] == sha256(controller.read_bytes()).hexdigest()
