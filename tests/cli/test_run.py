"""run: targets, rigs and twins, what reaches the session, what is kept, printed and answered."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.cli.conftest import Bench, StandIn, shares, words_of
from tests.end_to_end.conftest import small_plant
from thermogrip.cli import run
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.rig import Session


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("38", 38.0),
        ("10", 10.0),
        ("50", 50.0),
        ("t1=40, t2=35", {"t1": 40.0, "t2": 35.0}),
        ("t=10", {"t": 10.0}),
    ],
)
def test_targets_are_one_temperature_or_one_for_each_output(text: str, value: object) -> None:
    assert run._targets(text) == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("warm", "is no temperature"),
        ("t1=40,35", "is no temperature"),
        ("t1=40,t1=35", "names an output twice"),
        ("9.9", "--target 9.9 degC is outside the rig's range; choose one from 10 to 50 degC"),
        ("50.1", "outside"),
        ("nan", "outside"),
        ("t1=40,t2=51", "--target 51 degC is outside"),
    ],
)
def test_a_target_that_is_none_or_burns_is_refused(text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        run._targets(text)


def test_targets_go_to_the_outputs_that_are_regulated() -> None:
    assert run._for_outputs(38.0, ("t1", "t2")) == {"t1": 38.0, "t2": 38.0}
    assert run._for_outputs(38.0, ("t1",)) == 38.0
    assert run._for_outputs({"t2": 1.0, "t1": 2.0}, ("t1", "t2")) == {"t2": 1.0, "t1": 2.0}
    with pytest.raises(UserError, match="--target names t1; give one for each of t1, t2"):
        run._for_outputs({"t1": 1.0}, ("t1", "t2"))
    assert run._said({"t1": 40.0, "t2": 35.5}) == "t1 40, t2 35.5"
    assert run._said(38.25) == "38.25"


def test_an_object_has_a_material_and_a_temperature_or_there_is_none() -> None:
    assert run._what_to_grasp(None, None) is None
    assert run._what_to_grasp(0.0, "copper") == ("copper", 0.0)
    for half in ((18.0, None), (None, "copper")):
        with pytest.raises(UserError, match="one of --object and --material is missing"):
            run._what_to_grasp(*half)


@pytest.mark.parametrize(
    ("port", "twin", "words"),
    [(None, None, "no rig is given; "), ("COM3", Path("plant.json"), "--port and --twin are both given; ")],
)
def test_either_a_port_or_a_twin_is_given(port: str | None, twin: Path | None, words: str) -> None:
    with pytest.raises(UserError, match=f"{words}give --port DEV, or --twin PLANT"):
        run.one_rig(port, twin)
    run.one_rig("COM3", None)
    run.one_rig(None, Path("plant.json"))


def test_files_of_a_run_are_those_that_are_named_and_there(tmp_path: Path) -> None:
    learn = tmp_path / "rig.json"
    assert run.files_of(learn, plant=None, guard=Path("g.toml")) == {"guard": Path("g.toml")}
    learn.touch()
    assert run.files_of(learn, plant=Path("p.json")) == {"plant": Path("p.json"), "learn": learn}
    assert run.files_of(None) == {}


def rig_of(port: str | None, twin: Path | None, inputs: tuple[str, ...] = ("q1",), **changes: Any) -> Any:
    clock = SimpleNamespace(sleep="its sleep")
    controller = SimpleNamespace(plant=SimpleNamespace(inputs=inputs))
    options = {"seed": 3, "t_start": None, "draw": 0} | changes
    draw = options.pop("draw")
    return run.rig_of(port, "tclab", clock, twin, "own.py:Own", draw, controller, **options)


def test_a_rig_on_a_port_drives_what_the_controller_moves(stand_in: StandIn) -> None:
    closed: list[bool] = []
    rig = SimpleNamespace(units={"q1": "percent", "q2": "percent"}, close=lambda: closed.append(True))
    opened = stand_in("thermogrip.rig.drivers.connect.open_rig", rig)
    assert rig_of("COM3", None, ("q1", "pump")) is rig
    assert (opened[0].args, opened[0].sleep) == (("COM3", "tclab"), "its sleep")
    for option in ({"t_start": 25.0}, {"draw": 2}):
        with pytest.raises(UserError, match="--from and --draw are of the twin; leave them away with --port"):
            rig_of("COM3", None, **option)
    assert not closed
    with pytest.raises(UserError, match="the rig drives q1, q2, not heat; use its own controller"):
        rig_of("COM3", None, ("q1", "heat"))
    assert closed == [True]


@pytest.mark.parametrize("own", [False, True])
def test_a_twin_is_a_draw_of_its_plant_within_the_controller_s_ranges(own: bool, stand_in: StandIn) -> None:
    units = {"a": "percent", "b": "0_255", "c": "1", "e": "W"}
    plant = SimpleNamespace(draw=lambda k: ("draw", k), units=units)
    loaded = stand_in("thermogrip.sysid.plant.plant.Plant.load", UserError("own") if own else plant)
    again = stand_in("thermogrip.cli.run.load_plant", plant)
    twins = stand_in("thermogrip.rig.simulation.twin.Twin", "a twin")
    ranges = dict.fromkeys("abcde", (0.0, 100.0)) | {"d": (0.0, 5.0)}  # d has no unit: 1
    controller = SimpleNamespace(design=SimpleNamespace(drive_range=ranges))
    given = (None, "clock", Path("p.json"), "own.py:Own", 4, controller)
    assert run.rig_of(None, *given, seed=3, t_start=28.0) == "a twin"
    [twin] = twins
    assert (twin.args, twin.seed, twin.t_start) == ((("draw", 4),), 3, 28.0)
    assert twin.limits == {"e": (0.0, 100.0)}
    assert [call.args for call in again] == [(Path("p.json"), "own.py:Own")] * own
    if own:
        with pytest.raises(UserError, match="own"):  # no class was named
            run.rig_of(None, *given[:3], None, *given[4:], seed=3, t_start=28.0)
    assert loaded[0].args == (Path("p.json"),)


@pytest.fixture
def ran(bench: Bench, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return a bench with a controller, whose sessions, rigs and run folders are stand-ins."""

    class Folder:
        def __init__(self, *args: Any, **options: Any) -> None:
            made.folders.append(SimpleNamespace(args=args, **options))

        def __enter__(self) -> Folder:
            return self

        def __exit__(self, *_: object) -> None: ...
        def finish(self, session: Session) -> None:
            made.finished.append(session)

    def session(*_: Any, progress: Any, **__: Any) -> Session:
        progress(0.5, "settle")
        return made.session

    Controller(small_plant()).save(bench.path / "c.json")
    made = SimpleNamespace(bench=bench, folders=[], finished=[], closed=[])
    made.session = Session(None, None, (), "settled", "", 81.25, 0.125, -0.0625)
    made.rig = SimpleNamespace(close=lambda: made.closed.append(True))
    made.rigs = stand_in("thermogrip.cli.run.rig_of", made.rig)
    made.guards = stand_in("thermogrip.cli.run.guard_of", "a guard")
    made.sessions = stand_in("thermogrip.rig.session.session.run_session", session)
    made.beyond = stand_in("thermogrip.mpc.design_review.beyond_logs", ["40 degC is beyond the logs"])
    made.sections = stand_in("thermogrip.report.control.session_sections", ["a section"])
    made.pages = stand_in("thermogrip.report.html.write_report")
    monkeypatch.setattr("thermogrip.rig.records.recorder.RunFolder", Folder)
    return made


def test_words_reach_the_session_on_a_twin(ran: SimpleNamespace, stand_in: StandIn) -> None:
    (ran.bench.path / "model").mkdir()
    ran.bench.write("g.toml", "")
    stops = stand_in("thermogrip.classify.decisions.online.session_stop", "stop")
    words = (
        "run c.json --target 40 --twin plant.json --draw 2 --from 28 --hold 30 --object 18 --material copper"
    )
    words += (
        " --grasp-time 4 --stop-early model --settle-timeout 600 --guard g.toml --learn rig.json --seed 5"
    )
    done = ran.bench.run(*words.split(), "--out", "r", "--report", "r.html")
    assert (done.code, ran.closed, ran.finished) == (0, [True], [ran.session]), done
    [rig], [session], [folder] = ran.rigs, ran.sessions, ran.folders
    assert (rig.args[0], rig.args[3:6], rig.seed, rig.t_start) == (
        None,
        (Path("plant.json"), None, 2),
        5,
        28.0,
    )
    assert (session.args[0], session.args[2]) == (ran.rig, 40.0)
    assert (session.output, session.hold, session.grasp) == ("t_surface", 30.0, ("copper", 18.0))
    assert (session.grasp_time, session.settle_timeout, session.stop) == (4.0, 600.0, "stop")
    assert (session.clock, session.guard, stops[0].args) == (None, "a guard", (Path("model"),))
    assert ran.guards[0].args[::2] == (Path("g.toml"), Path("rig.json"))
    assert ran.guards[0].args[1].inputs == ("drive", "pump")
    assert folder.args == (
        Path("r"),
        {"controller": "c.json", "target_degC": 40.0, "twin": "plant.json", "draw": 2, "from_degC": 28.0,
         "hold_s": 30.0, "object_degC": 18.0, "material": "copper", "seed": 5},
    )  # fmt: skip
    files = {"controller": "c.json", "plant": "plant.json", "guard": "g.toml"}
    assert folder.files == {name: Path(file) for name, file in files.items()}
    assert (ran.beyond[0].args[1], ran.beyond[0].grasps) == (40.0, True)
    assert "warning: 40 degC is beyond the logs" in done.err
    assert shares(done.err, "run") == [50]
    [page] = ran.pages
    assert page.args[:2] == (Path("r.html"), "A session")
    assert page.args[2].startswith("One session on plant.json, draw 2: ")
    [section] = ran.sections
    assert (section.args[0], section.args[1], section.args[3]) == (ran.session, [], "plant.json, draw 2")
    assert isinstance(section.args[2], Controller)
    said = words_of(done.out)
    assert said.startswith("plant.json, draw 2, to 40 degC verdict settled after [s] overshoot [K] bias [K]")
    assert said.endswith("settled 81.25 0.125 -0.0625 wrote r")


def test_words_reach_the_session_on_a_port(ran: SimpleNamespace) -> None:
    ran.session = Session(None, None, (), "not settled", "wait longer", float("nan"), 0.125, float("nan"))
    words = ["run", "c.json", "--target", "t_surface=40", "--port", "COM3", "--speed", "5", "--out", "r"]
    done = ran.bench.run(*words, "--protocol", "tclab")
    assert (done.code, ran.closed, ran.pages) == (3, [True], [])
    [rig], [session], [folder] = ran.rigs, ran.sessions, ran.folders
    assert (rig.args[:2], rig.args[3:6], rig.t_start) == (("COM3", "tclab"), (None, None, 0), None)
    assert (session.clock is rig.args[2], rig.args[2].speed) == (True, 5.0)
    assert (session.args[2], session.grasp, session.stop) == ({"t_surface": 40.0}, None, None)
    assert (session.hold, session.grasp_time, session.settle_timeout) == (0.0, 10.0, 900.0)
    assert folder.args[1]["port"] == "COM3"
    assert "twin" not in folder.args[1]
    assert not ran.beyond[0].grasps
    said = words_of(done.out)
    assert said.startswith("COM3, to t_surface 40 degC verdict")
    assert said.endswith("not settled - 0.125 - wait longer wrote r")
    assert json.loads(ran.bench.run(*words, "--json").out) == {
        "verdict": "not settled", "advice": "wait longer", "settle_time": None, "overshoot": 0.125,
        "bias": None, "out": "r",
    }  # fmt: skip


def test_a_contact_ends_early_only_where_there_is_one(ran: SimpleNamespace) -> None:
    (ran.bench.path / "model").mkdir()
    words = ["run", "c.json", "--target", "40", "--twin", "plant.json", "--stop-early", "model", "--out", "r"]
    done = ran.bench.run(*words)
    assert (done.code, done.said) == (
        2, ["thermogrip: --stop-early without a grasp; give --object and --material too"],
    )  # fmt: skip
    assert not ran.rigs
