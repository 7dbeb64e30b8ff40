"""A batch in words: it goes on where it was stopped, does bad trials again, and labels its grasps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.interface import Reading
from thermogrip.rig.records import batch
from thermogrip.rig.records.batch import Trial, collect, read_plan, run_batch
from thermogrip.rig.records.run_folder import read_run
from thermogrip.rig.serial.port import PortError
from thermogrip.rig.session.session import Session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip
from thermogrip.sysid.plant.plant import Plant

PLAN = [
    Trial("copper", 32.0, 18.0, 0.4, {"block": "c1", "repeat": 1.0}),
    Trial("wood", 32.0, 18.0, 0.4, {"block": "w1", "repeat": 1.0}),
    Trial("iron", 30.0, 45.0, None, {"block": "i1", "split": "test"}),
]
COLUMNS = "material,t_object_degC,target_degC"


def twin(plant: Plant, seed: int = 1) -> Twin:
    return Twin(plant, seed=seed, contact=Grip())


def test_every_trial_becomes_a_labelled_grasp(plant: Plant, controller: Any, tmp_path: Path) -> None:
    batch = run_batch(twin(plant), controller, PLAN, tmp_path, guard=Guard(plant), grasp_time=3.0)
    assert (batch.verdict, batch.left, batch.sessions) == ("done", 0, 3)
    grasps = read_grasps(tmp_path / "grasps.csv")
    assert grasps["material"].values.tolist() == ["copper", "wood", "iron"]
    assert grasps["block"].values.tolist() == ["c1", "w1", "i1"]
    assert grasps["t_object"].values.tolist() == [18.0, 18.0, 45.0]
    assert grasps["t_gripper"].values.tolist() == [32.0, 32.0, 30.0]
    assert grasps["t_object_sd"].values.tolist()[:2] == [0.4, 0.4]
    fall = grasps["t_surface"].values[:, -1] - 32.0
    assert fall[0] < fall[1] < 0  # copper draws more heat than wood


def test_a_batch_goes_on_where_it_was_stopped(plant: Plant, controller: Any, tmp_path: Path) -> None:
    asked: list[int] = []

    def ready(k: int, trial: Trial) -> bool:
        asked.append(k)
        return len(asked) < 3

    rig = twin(plant)
    first = run_batch(rig, controller, PLAN, tmp_path, ready=ready, grasp_time=2.0)
    assert (first.verdict, first.left) == ("stopped", 1)
    assert asked == [0, 1, 2]
    kept = (tmp_path / "0001" / "samples.csv").read_bytes()
    second = run_batch(rig, controller, PLAN, tmp_path, grasp_time=2.0)
    assert (second.verdict, second.sessions) == ("done", 1)
    assert (tmp_path / "0001" / "samples.csv").read_bytes() == kept


def test_a_trial_that_is_called_bad_is_kept_and_done_again(
    plant: Plant, controller: Any, tmp_path: Path
) -> None:
    said: list[int] = []

    def judge(k: int, trial: Trial, session: Session) -> str:
        said.append(k)
        return "it slipped" if said == [0, 1] else ""

    batch = run_batch(twin(plant), controller, PLAN, tmp_path, judge=judge, grasp_time=2.0)
    assert [run.name for run in batch.done] == ["0001", "0002-2", "0003"]
    assert read_run(tmp_path / "0002").bad == "it slipped"
    assert collect(tmp_path)["grasp"].values.tolist() == ["0001", "0002-2", "0003"]


class Loose(Twin):
    """A twin whose cable is out for one call at a time."""

    out_at = 60.0

    def apply(self, drive: Any, pump: int) -> None:
        if self.time >= self.out_at:
            self.out_at = np.inf
            raise PortError("lost", "was lost", file="/dev/ttyACM0", hint="check cable and power")
        super().apply(drive, pump)


def test_a_cable_that_was_out_costs_one_trial_again(plant: Plant, controller: Any, tmp_path: Path) -> None:
    opened: list[Twin] = []

    def source() -> Twin:
        opened.append(Loose(plant, contact=Grip()) if not opened else twin(plant, 2))
        return opened[-1]

    batch = run_batch(source, controller, PLAN[:2], tmp_path, guard=Guard(plant), grasp_time=2.0)
    assert batch.verdict == "done"
    assert len(opened) == 2
    assert opened[0].closed
    assert opened[1].closed
    bad = read_run(tmp_path / "0001")
    assert bad.about["trip"]["kind"] == "cable"
    assert batch.done[0].name == "0001-2"


class Masked(Twin):
    """A twin whose skin sensor is gone after a while."""

    def read(self) -> Reading:
        true = super().read()
        if true.time_s < 30:
            return true
        return Reading(true.time_s, {**true.values, "t_surface": np.nan}, true.drive, true.pump)


def test_a_lost_sensor_stops_the_batch_with_power_off(plant: Plant, controller: Any, tmp_path: Path) -> None:
    rig = Masked(plant, contact=Grip())
    batch = run_batch(rig, controller, PLAN, tmp_path)
    assert (batch.verdict, batch.left, batch.sessions) == ("tripped", 3, 1)
    assert "plug" in batch.advice
    assert not any(rig.read().drive.values())


def test_another_plan_in_the_same_folder_is_refused(plant: Plant, controller: Any, tmp_path: Path) -> None:
    run_batch(twin(plant), controller, PLAN[:1], tmp_path, grasp_time=1.0)
    with pytest.raises(UserError, match="another plan"):
        run_batch(twin(plant), controller, PLAN, tmp_path)


def test_the_temperature_of_an_object_may_come_from_a_sensor(
    plant: Plant, controller: Any, tmp_path: Path
) -> None:
    trial = Trial("copper", 30.0, "t_tank")
    batch = run_batch(twin(plant), controller, [trial], tmp_path, grasp_time=1.0)
    assert batch.verdict == "done"
    t_object = float(collect(tmp_path)["t_object"].values[0])
    log = read_run(batch.done[0]).log
    assert t_object in log["t_tank"].values
    with pytest.raises(UserError, match="no sensor 't_nose'"):
        run_batch(twin(plant), controller, [Trial("copper", 30.0, "t_nose")], tmp_path / "b")


def test_a_first_touch_may_tell_the_temperature_for_the_second(
    plant: Plant, controller: Any, tmp_path: Path
) -> None:
    touches = [
        Trial("copper", t, None, None, {"touch_group": "b1", "touch": n})
        for n, t in ((1.0, 30.0), (2.0, 33.0))
    ]
    asked: list[float] = []

    def first_touch(grasps: Any) -> tuple[float, float]:
        asked.append(float(grasps["t_gripper"].values[0]))
        return 25.5, 0.7

    batch = run_batch(twin(plant), controller, touches, tmp_path, first_touch=first_touch, grasp_time=1.0)
    assert batch.verdict == "done"
    assert asked == [30.0]
    grasps = collect(tmp_path)
    assert np.isnan(grasps["t_object"].values[0])
    assert float(grasps["t_object"].values[1]) == 25.5
    assert float(grasps["t_object_sd"].values[1]) == 0.7


def test_a_plan_is_read_with_its_labels(tmp_path: Path) -> None:
    text = (
        "material,t_object_degC,target_degC,block,repeat\nCu,43,23,c1,2\nwood,,38,,\niron,t_block,38,i1,1\n"
    )
    (tmp_path / "plan.csv").write_text(text.replace("Cu", "copper"))
    plan = read_plan(tmp_path / "plan.csv")
    assert plan[0] == Trial("copper", 23.0, 43.0, None, {"block": "c1", "repeat": 2.0})
    assert plan[1] == Trial("wood", 38.0)
    assert plan[2].t_object == "t_block"


@pytest.mark.parametrize(
    ("text", "said"),
    [(f"{COLUMNS}\ncopper,43,warm", "row 2, column target_degC: 'warm' is not a number"),
     (f"{COLUMNS}\ncopper,43,", "row 2, column target_degC: is empty"),
     (f"{COLUMNS}\nkryptonite,43,23", "row 2, column material"),
     (f"{COLUMNS}\ncopper,43,nan", "row 2, column target_degC: 'nan' is not a number"),
     ("material,target_degC,colour\n,,", "row 1: has the unknown column 'colour'; use block, "),
     ("material,t_object_degC\n,", "row 1: lacks material or target_degC; use block, "),
     ("target_degC,block\n,", "row 1: lacks material or target_degC; use block, ")],
)  # fmt: skip
def test_a_wrong_plan_names_row_and_column(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "plan.csv").write_text(f"{text}\n")
    with pytest.raises(UserError) as caught:
        read_plan(tmp_path / "plan.csv")
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("t_object", "labels", "asked", "expected"),
    [
        (None, {"touch_group": "b"}, True, 25.5),
        (20.0, {"touch_group": "b"}, True, 20.0),
        (None, {}, True, None),
        (None, {"touch_group": "b"}, False, None),
    ],
)
def test_a_temperature_that_is_known_is_not_asked_of_the_first_touch(
    t_object: float | None, labels: dict[str, str], asked: bool, expected: float | None,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(batch, "good_run", lambda path, k: path)
    monkeypatch.setattr(batch, "read_grasps", lambda path: path)
    trial = Trial("wood", 30.0, t_object, None, labels)
    first_touch = (lambda _: (25.5, 0.7)) if asked else None
    assert batch._with_temperature(trial, 1, [trial, trial], tmp_path, first_touch).t_object == expected
