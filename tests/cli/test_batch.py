"""batch, recover: what reaches the room, what the operator is asked, and the exit code."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.cli.conftest import Bench, StandIn, shares
from tests.end_to_end.conftest import small_plant
from thermogrip.cli import batch
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.report.console import Console
from thermogrip.rig.records.batch import Batch, Trial

PORT = ["--port", "COM7", "--speed", "3", "--protocol", "tclab"]


@pytest.mark.parametrize(
    ("where", "about", "asks", "on_rig"),
    [
        (PORT, {"port": "COM7"}, True, True),
        ([*PORT, "--no-ask"], {"port": "COM7"}, False, True),
        (["--twin", "plant.json", "--draw", "3", "--seed", "5"], {"twin": "plant.json", "draw": 3, "seed": 5},
         False, False),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("left", "code"), [(0, 0), (1, 3)])
def test_a_batch_keeps_on_what_it_ran_and_fails_while_a_trial_is_left(
    where: list[str], about: dict[str, object], asks: bool, on_rig: bool, left: int, code: int,
    bench: Bench, stand_in: StandIn,
) -> None:  # fmt: skip
    def ran(opened: Any, *_: Any, progress: Any, **__: Any) -> Batch:
        progress(0.5, "trial 1")
        rigs.append(opened())
        return Batch((bench.path,) * (2 - left), left, "stopped", "go on", 1)

    rigs: list[Any] = []
    batches = stand_in("thermogrip.rig.records.batch.run_batch", ran)
    opened = stand_in("thermogrip.cli.batch.rig_of", "a rig")
    guards = stand_in("thermogrip.cli.batch.guard_of", "a guard")
    stops = stand_in("thermogrip.classify.decisions.online.session_stop", "stop")
    Controller(small_plant()).save(bench.path / "c.json")
    bench.write("plan.csv", "material,target_degC\ncopper,30\nwood,30\n")
    bench.write("g.toml", "")
    (bench.path / "model").mkdir()
    words = ["batch", "c.json", "plan.csv", *where, "--grasp-time", "4", "--settle-timeout", "60"]
    done = bench.run(*words, "--guard", "g.toml", "--learn", "rig.json", "--out", "out")
    assert (done.code, rigs) == (code, ["a rig"]), done
    [call] = batches
    assert (call.about, call.output, call.guard) == (about, "t_surface", "a guard")
    assert (call.grasp_time, call.settle_timeout, call.stop) == (4.0, 60.0, None)
    assert [getattr(call, name) is not None for name in ("ready", "judge", "clock")] == [asks, asks, on_rig]
    assert (type(call.args[1]), len(call.args[2]), call.args[3]) == (Controller, 2, Path("out"))
    assert call.first_touch is batch._first_touch
    assert guards[0].args == (Path("g.toml"), call.args[1].plant, Path("rig.json"))
    files = {"controller": "c.json", "plan": "plan.csv", "guard": "g.toml"} | (
        {} if on_rig else {"plant": "plant.json"}
    )
    assert call.files == {name: Path(file) for name, file in files.items()}
    [rig] = opened
    twin = None if on_rig else Path("plant.json")
    assert rig.args[:2] == (("COM7", "tclab") if on_rig else (None, None))
    assert rig.args[3:] == (twin, None, 0 if on_rig else 3, call.args[1])
    assert (rig.args[2].speed, rig.seed, rig.t_start) == (3.0 if on_rig else 1.0, 0 if on_rig else 5, None)
    assert done.out.splitlines() == [f"{2 - left} of 2 grasps are good: stopped", "go on"]
    assert shares(done.err, "batch") == [50]
    answer = json.loads(bench.run(*words, "--stop-early", "model", "--json", "--out", "out").out)
    assert answer == {"verdict": "stopped", "advice": "go on", "good": 2 - left, "left": left}
    assert (batches[1].ready, batches[1].judge, batches[1].stop) == (None, None, "stop")
    assert stops[0].args == (Path("model"),)
    bench.run("batch", "c.json", "plan.csv", "--twin", "plant.json", "--out", "out")
    assert (batches[2].grasp_time, batches[2].settle_timeout, opened[2].args[5]) == (10.0, 900.0, 0)


def test_a_batch_that_is_done_has_no_advice(bench: Bench, stand_in: StandIn) -> None:
    Controller(small_plant()).save(bench.path / "c.json")
    bench.write("plan.csv", "material,target_degC\ncopper,30\n")
    stand_in("thermogrip.rig.records.batch.run_batch", Batch((bench.path,), 0, "done", "", 1))
    done = bench.run("batch", "c.json", "plan.csv", "--twin", "plant.json", "--out", "out")
    assert (done.code, done.out) == (0, "1 of 1 grasps are good: done\n")


@pytest.mark.parametrize(
    ("said", "goes_on", "bad"),
    [
        ("", True, ""),
        ("y", True, ""),
        ("OK", True, ""),
        ("yes", True, ""),
        ("q", False, "q"),
        (" Q ", False, "Q"),
        ("quit", False, "quit"),
        ("No", False, "No"),
        ("n", False, "n"),
        ("it slipped", True, "it slipped"),
    ],
)
def test_a_batch_stops_at_q_alone_and_keeps_what_nobody_calls_bad(
    said: str, goes_on: bool, bad: str, stand_in: StandIn
) -> None:
    stand_in("thermogrip.cli.batch.typer.prompt", said)
    assert batch._ready(Console(), 2)(0, Trial("copper", 30.0, 18.0)) is goes_on
    assert batch._judge(Console())(0, Trial("copper", 30.0), SimpleNamespace(contact=0.1)) == bad


@pytest.mark.parametrize(
    ("trial", "words"),
    [
        (Trial("copper", 30.0, 18.0), "trial 2 of 5: copper, 18.0 degC, skin to 30 degC; "),
        (Trial("", 30.5), "trial 2 of 5: unknown, unknown temperature, skin to 30.5 degC; "),
    ],
)
def test_the_operator_is_asked_for_the_next_object(trial: Trial, words: str, stand_in: StandIn) -> None:
    asked = stand_in("thermogrip.cli.batch.typer.prompt", "")
    batch._ready(Console(), 5)(1, trial)
    assert asked[0].args == (f"{words}Enter when it is ready, q to stop",)
    assert (asked[0].default, asked[0].show_default) == ("", False)


@pytest.mark.parametrize(("contact", "warned"), [(0.1, False), (float("nan"), True)])
def test_no_contact_is_reported_to_the_operator(
    contact: float, warned: bool, stand_in: StandIn, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in("thermogrip.cli.batch.typer.prompt", "")
    batch._judge(Console())(0, Trial("copper", 30.0), SimpleNamespace(contact=contact))
    assert ("the skin felt nothing" in capsys.readouterr().err) == warned


def test_a_first_touch_reports_median_and_sd_of_its_90_percent_interval(stand_in: StandIn) -> None:
    row = SimpleNamespace(t_object=40.0, t_object_p05=40.0 - 1.645 * 0.6, t_object_p95=40.0 + 1.645 * 0.6)
    stand_in("thermogrip.sysid.effusivity.gripper_model.load_default_gripper", "the gripper")
    asked = stand_in("thermogrip.sysid.effusivity.posterior.effusivity_posterior", [row, None])
    assert batch._first_touch("a grasp") == pytest.approx((40.0, 0.6))
    assert asked[0].args == ("the gripper", "a grasp")


@pytest.mark.parametrize("rows", [(30, 20), (30, 0), (30, None)])
def test_runs_are_repaired_one_by_one(rows: tuple[int | None, ...], bench: Bench, stand_in: StandIn) -> None:
    folders = [bench.path / "0001", bench.path / "0002"]
    logs = [None if n is None else SimpleNamespace(sizes={"time": n}) for n in rows]
    done_of = {
        folder: SimpleNamespace(
            findings=(f"cut {folder.name}",),
            changed=True,
            run=SimpleNamespace(log=log, about={"verdict": "ended"}),
        )
        for folder, log in zip(folders, logs)
    }
    found = stand_in("thermogrip.cli.batch._run_folders", folders)
    stand_in("thermogrip.rig.records.run_folder.recover", lambda folder: done_of[folder])
    marked = stand_in("thermogrip.rig.records.run_folder.mark_bad")
    written = stand_in("thermogrip.rig.records.export.export_run")
    (bench.path / "runs").mkdir()
    done = bench.run("recover", "runs")
    assert (done.code, found[0].args) == (3 if not rows[1] else 0, (Path("runs"),))
    assert done.out == "0001: cut 0001\n0002: cut 0002\n"
    assert json.loads(bench.run("recover", "runs", "--json").out) == {
        "runs": [
            {"run": str(folder), "changed": True, "said": [f"cut {folder.name}"], "rows": n or 0,
             "verdict": "ended"}
            for folder, n in zip(folders, rows)
        ]
    }  # fmt: skip
    for option in (("--out", "x.csv"), ("--bad", "why")):
        refused = bench.run("recover", "runs", *option)
        assert (refused.code, refused.said) == (
            2, ["thermogrip: runs: holds several runs; give the folder of one of them"],
        )  # fmt: skip
    assert not marked + written
    del folders[1]
    done = bench.run("recover", "runs", "--out", "x.csv", "--bad", "it slipped")
    assert done.out.splitlines() == ["0001: cut 0001", "0001: marked bad: it slipped", "wrote x.csv"]
    assert (marked[0].args, written[0].args) == ((folders[0], "it slipped"), (folders[0], Path("x.csv")))
    assert bench.run("recover", "runs", "--out", "x.txt").code == 2
