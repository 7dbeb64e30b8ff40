"""A bench of small files for the command line: a log, a plant, two sets of grasps, all as they should be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.end_to_end.drawn import faults_of
from thermogrip.cli.main import main
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

HEADER = "time_s,drive,pump,t_tank_degC,t_surface_degC,t_ambient_degC"


@dataclass(frozen=True)
class Outcome:
    """What one command line did."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> list[str]:
        """The lines on stderr without warnings and progress."""
        lines = self.err.splitlines()
        return [line for line in lines if line.startswith("thermogrip:") and ": warning:" not in line]


@dataclass(frozen=True)
class Bench:
    """A folder of small files and a way to run command lines on them."""

    path: Path
    capsys: pytest.CaptureFixture[str]

    def run(self, *words: object) -> Outcome:
        """Run one command line in this process; what it draws on a page is looked at."""
        self.capsys.readouterr()
        code = main([str(word) for word in words])
        out, err = self.capsys.readouterr()
        for word in map(str, words):
            for page in (Path(word), Path(word, "report.html")):
                if page.suffix == ".html" and page.is_file():
                    assert list(faults_of(page.read_text(encoding="utf-8"))) == [], f"{page} of {words}"
        return Outcome(code, out, err)

    def write(self, name: str, text: str | bytes) -> Path:
        """Write a file into the folder."""
        path = self.path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path


def small_plant() -> Plant:
    """Return a tank with a drive and a skin behind a pump: 300 s and 15 s, 0.4 K/s at full drive."""
    dt = 0.5
    model = StateSpaceModel(
        ("drive", "pump"),
        ("t_ambient",),
        ("t_tank", "t_surface"),
        A=np.array([[1 - dt / 300, 0.0], [0.0, 1 - dt / 2000]]),
        B=np.array([[dt * 0.4, 0.0], [0.0, 0.0]]),
        E=np.array([[dt / 300], [dt / 2000]]),
        C=np.eye(2),
        dt=dt,
        switches=("pump",),
        A_switch={"pump": np.array([[0.0, 0.0], [dt / 15, -dt / 15]])},
    )
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_tank": "degC", "t_surface": "degC"}
    noise = {"t_tank": 0.05, "t_surface": 0.05}
    return Plant(model, {}, dt=dt, units=units, noise=noise, valid={"drive": (-1.0, 1.0)}, logs=("made",))


def small_log_rows(n: int = 600) -> list[str]:
    """Return the rows of a log of the small plant at 0.5 s, a square wave with small noise."""
    rng = np.random.default_rng(0)
    drive = 0.4 * np.sign(np.sin(np.arange(n) / 25.0) + 0.3 * np.sin(np.arange(n) / 7.0) + 1e-9)
    plant = small_plant()
    u = np.column_stack([drive, np.ones(n)])[None]
    d = np.full((1, n, 1), 25.0)
    y, _ = plant.model.rollout(np.full((1, 2), 25.0), u, d, plant.p[None], plant.dt)
    y = y[0, :n] + rng.normal(0, 0.02, (n, 2))
    return [f"{0.5 * k},{drive[k]:.2f},1,{y[k, 0]:.4f},{y[k, 1]:.4f},25.0" for k in range(n)]


def small_grasps(first: int = 0) -> tuple[str, str]:
    """Return samples and meta CSV of 12 made grasps of copper and wood at 43 degC, gripper 23 degC."""
    rng = np.random.default_rng(first)
    time = np.round(np.arange(-2.0, 10.05, 0.1), 6)
    samples = ["grasp_id,time_s,t_surface_degC,pump"]
    meta = [
        "grasp_id,material,experiment,repeat,split,t_object_nominal_degC,t_gripper_set_degC,t_ambient_degC"
    ]
    for k in range(12):
        name, gain = (("copper", 12.0), ("wood", 3.0))[k % 2]
        trace = 23 + gain * (1 - np.exp(-np.maximum(time, 0) / 2.5)) + rng.normal(0, 0.04, time.size)
        samples += [f"g{first + k:03d},{t:g},{y:.3f},0" for t, y in zip(time, trace)]
        meta.append(f"g{first + k:03d},{name},made,{k // 2},{'train' if k < 8 else 'test'},43,23,25")
    return "\n".join(samples) + "\n", "\n".join(meta) + "\n"


@pytest.fixture
def bench(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a bench in a fresh folder, which is the working folder of the test."""
    monkeypatch.chdir(tmp_path)
    made = Bench(tmp_path, capsys)
    made.write("good.csv", "\n".join([HEADER, *small_log_rows()]) + "\n")
    small_plant().save(tmp_path / "plant.json")
    (tmp_path / "made.json").mkdir()
    for name, first in (("grasps", 0), ("more", 100)):
        samples, meta = small_grasps(first)
        made.write(f"{name}.csv", samples)
        made.write(f"{name}_meta.csv", meta)
    return made


__all__ = ["HEADER", "Bench", "Outcome", "small_grasps", "small_log_rows", "small_plant"]
