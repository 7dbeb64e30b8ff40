"""A batch in words: it goes on where it was stopped, does bad trials again, and labels its grasps."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.mpc.design.relays import Relay
from thermogrip.rig.drivers.relays import RelayRig
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import DeviceRefusedError
from thermogrip.rig.records import batch
from thermogrip.rig.records.batch import Batch, Trial, collect, good_run, next_folder, read_plan, run_batch
from thermogrip.rig.records.run_folder import read_run
from thermogrip.rig.session.session import Object, Session
from thermogrip.rig.session.snapshot import Operator, Snapshot
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


def test_a_batch_goes_on_after_its_computer_lost_power_in_a_trial(
    plant: Plant, controller: Any, tmp_path: Path
) -> None:
    """What is left then: the plan, a good trial, one with a torn last line and the verdict "running"."""
    first = run_batch(twin(plant), controller, PLAN, tmp_path, grasp_time=1.0)
    assert first.left == 0
    cut = tmp_path / "0002"
    about = json.loads((cut / "run.json").read_text())
    (cut / "run.json").write_text(json.dumps(about | {"verdict": "running"}))
    (cut / "samples.csv").write_bytes((cut / "samples.csv").read_bytes()[:-7] + bytes(7))
    for lost in ("grasps.csv", "grasps_meta.csv", "SHA256SUMS"):
        (cut / lost).unlink()
    (tmp_path / "grasps.csv").unlink()
    shutil.rmtree(tmp_path / "0003")
    again = run_batch(twin(plant), controller, PLAN, tmp_path, grasp_time=1.0)
    assert (again.verdict, again.left, again.sessions) == ("done", 0, 2)
    assert [run.name for run in again.done] == ["0001", "0002-2", "0003"]
    assert read_grasps(tmp_path / "grasps.csv")["material"].values.tolist() == ["copper", "wood", "iron"]
    assert (cut / "samples.csv").read_bytes().endswith(bytes(7))  # what was cut off is left as it is


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
        "material,t_object_degC,target_degC,block,repeat,rest_s,t_object_sd_degC\n"
        "Cu,43,23,c1,2,60,0.5\nwood,,38,,,,\niron,t_block,38,i1,1,,\n,inf1,38,,,,\n"
    )
    (tmp_path / "plan.csv").write_text(text.replace("Cu", "copper"))
    plan = read_plan(tmp_path / "plan.csv")
    assert plan[0] == Trial("copper", 23.0, 43.0, 0.5, {"block": "c1", "repeat": 2.0, "rest": 60.0})
    assert plan[1] == Trial("wood", 38.0)
    assert plan[2].t_object == "t_block"
    assert plan[3] == Trial("", 38.0, "inf1")


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


class Source:
    """A rig that is never asked; each opening is counted."""

    def __init__(self) -> None:
        self.opened, self.closed, self.asked = 0, 0, []

    def __call__(self) -> Source:
        self.opened += 1
        return self

    def close(self) -> None:
        self.closed += 1


def small_grasp(first: float = -0.2, n: int = 5, **labels: Any) -> Grasps:
    time = np.round(first + 0.1 * np.arange(n), 9)
    return make_grasps(
        time, [30.0 + time], ["g"], **{"material": ["copper"], **{k: [v] for k, v in labels.items()}}
    )


def scripted(monkeypatch: pytest.MonkeyPatch, outcomes: list[str], grasps: Any = small_grasp) -> Source:
    """Let sessions end as written: with a verdict, or tripped with a kind."""
    source = Source()

    def run(
        rig: Any, controller: Any, target: float, *, grasp: Any, recorder: Any, **options: Any
    ) -> Session:
        source.asked.append((target, grasp, options))
        how = outcomes.pop(0)
        trip = None if how in ("settled", "not settled") else Trip(how, 1.0, "t", "a", "b")
        made = grasps() if how == "settled" else None
        return Session(None, made, (), "tripped" if trip else how, f"after {how}", 9.0, 0.1, 0.2, trip=trip)

    monkeypatch.setattr(batch, "run_session", run)
    return source


BOTH = [Trial("copper", 32.0, 18.0, 0.4, {"block": "c1"}), Trial("", 30.0)]


@pytest.mark.parametrize(
    ("outcomes", "verdict", "sessions", "left", "opened"),
    [("settled settled", "done", 2, 0, 1), ("cable device settled settled", "done", 4, 0, 3),
     ("cable stale frozen", "tripped", 3, 2, 4), ("lost", "tripped", 1, 2, 1),
     ("settled jump", "tripped", 2, 1, 1)],
)  # fmt: skip
def test_a_trial_is_done_again_after_what_is_over_at_most_three_times(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, outcomes: str, verdict: str, sessions: int, left: int,
    opened: int,
) -> None:  # fmt: skip
    words = outcomes.split()
    source = scripted(monkeypatch, list(words))
    found = run_batch(source, None, BOTH, tmp_path)
    assert (found.verdict, found.sessions, found.left) == (verdict, sessions, left)
    assert found.advice == ("" if verdict == "done" else f"after {words[-1]}")
    assert (source.opened, source.closed) == (opened, opened)


@pytest.mark.parametrize(
    ("outcomes", "answers", "verdict", "sessions", "opened"),
    [("limit settled settled", [True], "done", 3, 2), ("limit", [False], "tripped", 1, 1),
     ("limit limit limit", [True] * 3, "tripped", 3, 4), ("operator", [], "tripped", 1, 1),
     ("cable settled settled", [], "done", 3, 2)],
)  # fmt: skip
def test_somebody_may_clear_a_trip_but_is_not_asked_after_a_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, outcomes: str, answers: list[bool], verdict: str,
    sessions: int, opened: int,
) -> None:  # fmt: skip
    source, asked = scripted(monkeypatch, outcomes.split()), []

    def cleared(k: int, trial: Trial, trip: Trip) -> bool:
        asked.append((k, trial, trip.kind))
        return answers[len(asked) - 1]

    found = run_batch(source, None, BOTH, tmp_path, cleared=cleared)
    assert (found.verdict, found.sessions, source.opened) == (verdict, sessions, opened)
    assert asked == [(0, BOTH[0], "limit")] * len(answers)


def test_a_cleared_trip_clears_the_latch_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Mock()
    source = batch._Source(lambda: rig)
    source.clear()
    rig.clear.side_effect = DeviceRefusedError("active", "the cause is still there")
    source.clear()  # the next session says so
    assert rig.clear.call_count == 2
    rig.units, rig.clear.side_effect = {"q": "percent"}, None
    batch._Source(lambda: RelayRig(rig, {"q": Relay("q")}, lambda: 0.0)).clear()
    assert rig.clear.call_count == 3


def test_a_trial_that_was_marked_while_it_ran_is_done_again_and_nobody_is_asked(
    plant: Plant, controller: Any, tmp_path: Path
) -> None:
    operator, asked, seen = Operator(), [], []
    operator.mark_bad("too early")  # nothing runs yet

    def listener(snapshot: Snapshot) -> None:
        if len(seen) == 3:
            operator.mark_bad("it slipped")
        seen.append(snapshot)

    found = run_batch(
        twin(plant), controller, PLAN[:1], tmp_path, grasp_time=1.0, operator=operator, listener=listener,
        judge=lambda k, trial, session: asked.append(k) or "",
    )  # fmt: skip
    assert (found.verdict, found.sessions, found.left) == ("done", 2, 0)
    assert read_run(tmp_path / "0001").bad == "it slipped"
    assert [event.kind for event in read_run(tmp_path / "0001").events].count("bad") == 1
    assert asked == [0]  # for the second one
    assert found.done == (tmp_path / "0001-2",)


def test_a_stop_that_is_asked_for_between_trials_ends_the_batch(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    operator = Operator()
    source = scripted(monkeypatch, ["settled"])

    def judge(k: int, trial: Trial, session: Session) -> str:
        operator.stop("the page")
        return ""

    found = run_batch(source, None, BOTH, tmp_path, operator=operator, judge=judge)
    assert (found.verdict, found.sessions, found.left) == ("stopped", 1, 1)


def test_what_records_may_stand_before_each_run_folder(plant: Plant, controller: Any, tmp_path: Path) -> None:
    stood: list[Path] = []

    @contextmanager
    def through(folder: Any) -> Iterator[Any]:
        stood.append(folder.path)
        yield folder

    run_batch(twin(plant), controller, PLAN[:2], tmp_path, grasp_time=1.0, through=through)
    assert stood == [tmp_path / "0001", tmp_path / "0002"]


def test_a_trial_that_does_not_settle_is_tried_three_times_and_a_bad_one_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    source = scripted(monkeypatch, ["not settled"] * 3)
    found = run_batch(source, None, BOTH, tmp_path / "a", ready=lambda k, trial: True)
    assert (found.verdict, found.advice, found.sessions) == ("not settled", "after not settled", 3)
    assert sorted(run.name for run in (tmp_path / "a").glob("0*")) == ["0001", "0001-2", "0001-3"]
    for why, left, verdict, n in ((["slipped"] * 3, 2, "stopped", 3), (["", "slipped", ""], 0, "done", 3)):
        folder, answers = tmp_path / verdict, list(why)
        scripted(monkeypatch, ["settled"] * 3)
        found = run_batch(source, None, BOTH, folder, judge=lambda *trial, said=answers: said.pop(0))
        assert (found.verdict, found.sessions, found.left) == (verdict, n, left)
        assert found.advice == ("trial 1 is bad: slipped" if left else "")
    assert [run.name for run in found.done] == ["0001", "0002-2"]
    assert read_run(folder / "0002").bad == "slipped"


def test_a_session_is_given_its_trial_and_the_record_describes_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    source, told = scripted(monkeypatch, ["settled"] * 2), []
    options = {"about": {"who": "me", "material": "?"}, "guard": "G", "stop": "S", "band": 0.5}
    run_batch(source, None, BOTH, tmp_path, progress=lambda *given: told.append(given), **options)
    assert told == [(0.0, "trial 1 of 2: copper"), (0.5, "trial 2 of 2: unknown")]
    first, second = source.asked
    assert first[:2] == (32.0, Object("copper", 18.0, 0.4, {"block": "c1"}, "0001"))
    assert first[2] == {"guard": "G", "stop": "S", "band": 0.5, "operator": None}
    assert (second[0], second[1].material, second[1].grasp_id, second[1].labels) == (30.0, "", "0002", {})
    assert np.isnan([second[1].t_object, second[1].t_object_sd]).all()
    about = read_run(tmp_path / "0001").about["about"]
    assert about == {"who": "me", "trial": 1, **asdict(BOTH[0])}
    stopped = run_batch(source, None, [*BOTH, BOTH[0]], tmp_path / "b", ready=lambda k, trial: False)
    assert stopped == Batch((), 3, "stopped", "run the same command again to go on", 0)
    with pytest.raises(UserError, match="the plan has no trial"):
        run_batch(source, None, [], tmp_path / "c")


def test_what_is_collected_are_the_good_grasps_on_one_grid(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    scripted(monkeypatch, ["lost"])
    run_batch(Source(), None, [*BOTH, *BOTH], tmp_path)
    with pytest.raises(UserError, match="no good grasp yet"):
        collect(tmp_path)
    made = [small_grasp(), small_grasp(-0.1, 6, block="b", touch=2.0), small_grasp(), small_grasp()]
    scripted(monkeypatch, ["settled"] * 4, lambda: made.pop(0))
    run_batch(Source(), None, [*BOTH, *BOTH], tmp_path)
    (tmp_path / "0003" / "run.json").write_text("{")  # damaged
    (tmp_path / "0004" / "grasps.csv").unlink()
    assert [good_run(tmp_path, k) is None for k in range(4)] == [False, False, True, True]
    assert (next_folder(tmp_path, 0).name, next_folder(tmp_path, 6).name) == ("0001-3", "0007")
    found = collect(tmp_path, name="mine")
    assert found["time"].values.tolist() == [-0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4]
    nan = np.nan
    want = [[29.8, 29.9, 30.0, 30.1, 30.2, nan, nan], [nan, 29.9, 30.0, 30.1, 30.2, 30.3, 30.4]]
    np.testing.assert_allclose(found["t_surface"].values, want)
    assert found["grasp"].values.tolist() == ["0001-2", "0002"]
    assert found["block"].values.tolist() == ["copper", "b"]  # one block a material where none is named
    np.testing.assert_array_equal(found["touch"].values, [nan, 2.0])
    assert found.attrs["name"] == "mine"
    assert collect(tmp_path).attrs["name"] == tmp_path.name
