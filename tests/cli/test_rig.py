"""run, batch, recover, record, virtual: what reaches the rig's room, what is kept, printed and answered."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.cli.conftest import Bench, StandIn, shares, words_of
from tests.end_to_end.conftest import small_plant
from thermogrip.cli import rig as verbs
from thermogrip.cli.main import main
from thermogrip.cli.rig import RigOptions, ShowOptions
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.relays import Relay
from thermogrip.rig import Session
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.records.batch import Batch, Trial
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("38", 38.0),
        ("10", 10.0),
        ("930", 930.0),
        ("t1=40, t2=35", {"t1": 40.0, "t2": 35.0}),
        ("t=10", {"t": 10.0}),
    ],
)
def test_targets_are_one_temperature_or_one_for_each_output(text: str, value: object) -> None:
    assert verbs.targets_of(text) == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("warm", "is no temperature"),
        ("t1=40,35", "'35' is no NAME=NUMBER"),
        ("t1=40,t1=35", "names t1 twice"),
        ("nan", "is no temperature"),
        ("t1=40,t2=inf", "is no temperature"),
    ],
)
def test_a_target_that_is_none_is_refused(text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        verbs.targets_of(text)


class AnyGuard(str):
    """A guard that allows every target."""

    def check_target(self, name: str, value: float) -> None:
        """Allow it."""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--target 30 --object 18", "one of --object and --material is missing"),
        ("--target 30 --material copper", "one of --object and --material is missing"),
        ("--target t_tank=30", "--target names t_tank; give one for each of t_surface"),
    ],
)
def test_what_a_session_lacks_is_one_line(words: str, said: str, ran: SimpleNamespace) -> None:
    done = ran.bench.run("run", "c.json", "--twin", "plant.json", *words.split(), "--out", "r")
    assert (done.code, len(done.said), ran.sessions) == (2, 1, [])
    assert said in done.said[0]


@pytest.mark.parametrize(
    ("given", "said"),
    [({}, "no rig is given; give --port DEV, or --twin PLANT"),
     ({"port": "COM3", "twin": Path("p.json")}, "--port and --twin are both given; give --port DEV, or"),
     ({"port": "COM3", "start": 25.0}, "--from and --draw are of the twin; leave them away with --port"),
     ({"port": "COM3", "draw": 2}, "--from and --draw are of the twin; leave them away with --port")],
)  # fmt: skip
def test_either_a_port_or_a_twin_is_given(given: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        RigOptions(**given).check()
    RigOptions(port="COM3").check()
    RigOptions(twin=Path("p.json"), draw=2, start=25.0).check()


def test_a_rig_on_a_port_drives_what_the_controller_moves(stand_in: StandIn) -> None:
    closed: list[bool] = []
    board = SimpleNamespace(units={"q1": "percent", "q2": "percent"}, close=lambda: closed.append(True))
    opened = stand_in("thermogrip.rig.drivers.connect.open_rig", board)
    clock, options = SimpleNamespace(sleep="its sleep"), RigOptions(port="COM3", protocol="tclab")

    def of(*inputs: str) -> Any:
        return SimpleNamespace(plant=SimpleNamespace(inputs=inputs), design=SimpleNamespace(relays={}))

    assert options.open(clock, of("q1", "pump"), pace=None, seed=3) is board
    assert (opened[0].args, opened[0].sleep) == (("COM3", "tclab"), "its sleep")
    assert not closed
    with pytest.raises(UserError, match="the rig drives q1, q2, not heat; use its own controller"):
        options.open(clock, of("q1", "heat"), pace=None, seed=3)
    assert closed == [True]


@pytest.mark.parametrize(
    ("rig", "show", "pace"),
    [({"twin": "p"}, {}, None), ({"twin": "p"}, {"live": 0}, 10.0), ({"twin": "p"}, {"foxglove": 8765}, 10.0),
     ({"twin": "p", "speed": 3.0}, {"live": 0}, 3.0), ({"twin": "p", "speed": 3.0}, {}, 3.0),
     ({"port": "p", "speed": 3.0}, {"live": 0}, None)],
)  # fmt: skip
def test_a_twin_that_is_watched_runs_ten_times_as_fast_as_real_time(
    rig: dict[str, Any], show: dict[str, Any], pace: float | None
) -> None:
    assert RigOptions(**rig).pace(ShowOptions(**show)) == pace


@pytest.mark.parametrize("own", [False, True])
def test_a_twin_is_a_draw_of_its_plant_within_the_controller_s_ranges(own: bool, stand_in: StandIn) -> None:
    units = {"a": "percent", "b": "0_255", "c": "1", "e": "W"}
    plant = SimpleNamespace(draw=lambda k: ("draw", k), units=units, room=20.5)
    loaded = stand_in("thermogrip.sysid.plant.plant.Plant.load", UserError("own") if own else plant)
    again = stand_in("thermogrip.cli.options.load_plant", plant)
    twins = stand_in("thermogrip.rig.simulation.twin.Twin", "a twin")
    ranges = dict.fromkeys("abcde", (0.0, 100.0)) | {"d": (0.0, 5.0)}  # d has no unit: 1
    controller = SimpleNamespace(design=SimpleNamespace(drive_range=ranges, relays={}))
    options = RigOptions(twin=Path("p.json"), draw=4, start=28.0, network="own.py:Own")
    assert options.open("clock", controller, pace=None, seed=3) == "a twin"
    [twin] = twins
    assert (twin.args, twin.seed, twin.t_start, twin.ambient) == ((("draw", 4),), 3, 28.0, 20.5)
    assert twin.limits == {"e": (0.0, 100.0)}
    assert [call.args for call in again] == [(Path("p.json"), "own.py:Own")] * own
    if own:
        with pytest.raises(UserError, match="own"):  # no class was named
            replace(options, network=None).open("clock", controller, pace=None, seed=3)
    assert loaded[0].args[-1] == Path("p.json")


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
    made.rigs = stand_in("thermogrip.cli.rig.RigOptions.open", made.rig)
    made.guards = stand_in("thermogrip.cli.rig.guard_of", AnyGuard("a guard"))
    made.sessions = stand_in("thermogrip.rig.session.session.run_session", session)
    made.beyond = stand_in("thermogrip.mpc.tuning.design_review.beyond_logs", ["40 degC is beyond the logs"])
    made.sections = stand_in("thermogrip.report.control.session_sections", ["a section"])
    made.pages = stand_in("thermogrip.report.html.write_report")
    monkeypatch.setattr("thermogrip.rig.records.run_folder.RunFolder", Folder)
    return made


def test_words_reach_the_session_on_a_twin(ran: SimpleNamespace, stand_in: StandIn) -> None:
    (ran.bench.path / "model").mkdir()
    ran.bench.write("g.toml", "")
    stops = stand_in("thermogrip.classify.decisions.stopping_rule.session_stop", "stop")
    words = (
        "run c.json --target 40 --twin plant.json --draw 2 --from 28 --hold 30 --object 18 --material copper"
    )
    words += " --grasp-time 4 --stop-early model --settle-timeout 600 --guard g.toml --seed 5"
    done = ran.bench.run(*words.split(), "--out", "r", "--report", "r.html")
    assert (done.code, ran.closed, ran.finished) == (0, [True], [ran.session]), done
    [rig], [session], [folder] = ran.rigs, ran.sessions, ran.folders
    assert (rig.args[0], rig.seed) == (RigOptions(twin=Path("plant.json"), draw=2, start=28.0), 5)
    assert (session.args[0], session.args[2]) == (ran.rig, 40.0)
    assert (session.output, session.hold, session.grasp) == ("t_surface", 30.0, ("copper", 18.0))
    assert (session.grasp_time, session.settle_timeout, session.stop) == (4.0, 600.0, "stop")
    assert (session.clock, session.guard, stops[0].args) == (None, "a guard", (Path("model"),))
    assert ran.guards[0].args[0] == Path("g.toml")
    assert ran.guards[0].args[1].inputs == ("drive", "pump")
    assert folder.args == (
        Path("r"),
        {"controller": "c.json", "target_degC": 40.0, "twin": "plant.json", "draw": 2, "from_degC": 28.0,
         "hold_s": 30.0, "object_degC": 18.0, "material": "copper", "seed": 5},
    )  # fmt: skip
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


def test_a_run_on_a_slow_twin_says_its_world_and_waits_as_long_as_its_spec(bench: Bench) -> None:
    kept = np.exp(-20.0 / 4000.0)
    model = StateSpaceModel(
        ("q",), ("lamp", "room"), ("t",),
        A=[[kept]], B=[[20 * (1 - kept)]], E=[[3 * (1 - kept), 1 - kept]], C=[[1.0]], dt=20.0,
    )  # fmt: skip
    valid = {"q": (0.0, 1.0), "lamp": (0.0, 1.0), "room": (17.5, 22.9), "t": (20.0, 35.0)}
    plant = Plant(model, {}, dt=20.0, units={"lamp": "1"}, valid=valid, nominal={"lamp": 1.0})
    relays = {"q": Relay(on_s=40.0, off_s=60.0)}
    Controller(plant, default_design(plant, relays=relays)).save(bench.path / "c.json")
    plant.save(bench.path / "plant.json")
    words = ["run", "c.json", "--twin", "plant.json", "--from", "24", "--target", "30", "--out", "r"]
    done = bench.run(*words)
    limit, switched, world, *_ = done.out.splitlines()
    assert switched == "Switched, at least: q (40 s on, 60 s off)"
    assert limit == "Gives up settling after 24000 s, twice what the spec allows a step"
    assert world == "The twin's world, from the middle of its plant's logs: lamp 1, room 20.2"
    assert done.code == 0, done


def test_words_reach_the_session_on_a_port(ran: SimpleNamespace) -> None:
    ran.session = Session(None, None, (), "not settled", "wait longer", float("nan"), 0.125, float("nan"))
    words = ["run", "c.json", "--target", "t_surface=40", "--port", "socket://rig", "--out", "r"]
    words += ["--speed", "5"]
    done = ran.bench.run(*words, "--protocol", "tclab")
    assert (done.code, ran.closed, ran.pages) == (3, [True], [])
    [rig], [session], [folder] = ran.rigs, ran.sessions, ran.folders
    assert rig.args[0] == RigOptions(port="socket://rig", protocol="tclab", speed=5.0)
    assert (session.clock is rig.args[1], rig.args[1].speed) == (True, 5.0)
    assert (session.args[2], session.grasp, session.stop) == ({"t_surface": 40.0}, None, None)
    assert (session.hold, session.grasp_time, session.settle_timeout) == (0.0, 10.0, 900.0)
    assert folder.args[1]["port"] == "socket://rig"
    assert "twin" not in folder.args[1]
    assert not ran.beyond[0].grasps
    said = words_of(done.out)
    assert "socket://rig, to t_surface=40 degC verdict" in said
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


PORT = ["--port", "socket://rig", "--speed", "3", "--protocol", "tclab"]


@pytest.mark.parametrize(
    ("where", "about", "asks", "on_rig"),
    [
        (PORT, {"port": "socket://rig"}, True, True),
        ([*PORT, "--no-ask"], {"port": "socket://rig"}, False, True),
        (["--twin", "plant.json", "--draw", "3", "--seed", "5"], {"twin": "plant.json", "draw": 3, "seed": 5},
         False, False),
    ],
)  # fmt: skip
def test_a_batch_keeps_on_what_it_ran_and_fails_while_a_trial_is_left(
    where: list[str], about: dict[str, object], asks: bool, on_rig: bool, bench: Bench, stand_in: StandIn
) -> None:
    left, code = (1, 3) if asks else (0, 0)

    def ran(opened: Any, *_: Any, progress: Any, **__: Any) -> Batch:
        progress(0.5, "trial 1")
        rigs.extend([opened(), opened()])
        return Batch((bench.path,) * (2 - left), left, "stopped", "go on", 1)

    rigs: list[Any] = []
    batches = stand_in("thermogrip.rig.records.batch.run_batch", ran)
    opened = stand_in("thermogrip.cli.rig.RigOptions.open", "a rig")
    guards = stand_in("thermogrip.cli.rig.guard_of", "a guard")
    stops = stand_in("thermogrip.classify.decisions.stopping_rule.session_stop", "stop")
    Controller(small_plant()).save(bench.path / "c.json")
    bench.write("plan.csv", "material,target_degC\ncopper,30\nwood,30\n")
    bench.write("g.toml", "")
    (bench.path / "model").mkdir()
    words = ["batch", "c.json", "plan.csv", *where, "--grasp-time", "4", "--settle-timeout", "60"]
    done = bench.run(*words, "--guard", "g.toml", "--out", "out")
    assert (done.code, rigs) == (code, ["a rig"] * 2), done
    [call] = batches
    assert (call.about, call.output, call.guard) == (about, "t_surface", "a guard")
    assert (call.grasp_time, call.settle_timeout, call.stop) == (4.0, 60.0, None)
    assert [getattr(call, name) is not None for name in ("ready", "judge", "clock")] == [asks, asks, on_rig]
    assert (type(call.args[1]), len(call.args[2]), call.args[3]) == (Controller, 2, Path("out"))
    assert guards[0].args == (Path("g.toml"), call.args[1].plant)
    rig, again = opened
    assert rig.say is not None  # what is round a twin
    assert again.say is None
    on_port = RigOptions(port="socket://rig", protocol="tclab", speed=3.0)
    assert rig.args[0] == (on_port if on_rig else RigOptions(twin=Path("plant.json"), draw=3))
    assert (rig.args[1].speed, rig.seed, rig.args[2]) == (
        3.0 if on_rig else 1.0, 0 if on_rig else 5, call.args[1],
    )  # fmt: skip
    assert done.out.splitlines() == [f"{2 - left} of 2 grasps are good: stopped", "go on"]
    assert shares(done.err, "batch") == [50]
    answer = json.loads(bench.run(*words, "--stop-early", "model", "--json", "--out", "out").out)
    assert answer == {"verdict": "stopped", "advice": "go on", "good": 2 - left, "left": left}
    assert (batches[1].ready, batches[1].judge, batches[1].stop) == (None, None, "stop")
    assert stops[0].args == (Path("model"),)
    bench.run("batch", "c.json", "plan.csv", "--twin", "plant.json", "--out", "out")
    assert (batches[2].grasp_time, batches[2].settle_timeout, opened[-1].args[0].draw) == (10.0, 900.0, 0)


@pytest.fixture
def of_batch(bench: Bench, stand_in: StandIn) -> SimpleNamespace:
    """Return what ``batch`` asks its run of one trial on a rig to do; without advice it prints none."""
    Controller(small_plant()).save(bench.path / "c.json")
    bench.write("plan.csv", "material,target_degC\ncopper,30\n")
    calls = stand_in("thermogrip.rig.records.batch.run_batch", Batch((bench.path,), 0, "done", "", 1))
    done = bench.run("batch", "c.json", "plan.csv", *PORT, "--out", "out")
    assert (done.code, done.out.splitlines()[1:]) == (0, ["1 of 1 grasps are good: done"])
    return calls[0]


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
    said: str, goes_on: bool, bad: str, of_batch: SimpleNamespace, stand_in: StandIn
) -> None:
    stand_in("typer.prompt", said)
    assert of_batch.ready(0, Trial("copper", 30.0, 18.0)) is goes_on
    assert of_batch.judge(0, Trial("copper", 30.0), SimpleNamespace(contact=0.1)) == bad


@pytest.mark.parametrize(
    ("trial", "words"),
    [
        (Trial("copper", 30.0, 18.0), "trial 1 of 1: copper, 18.0 degC, skin to 30 degC; "),
        (Trial("", 30.5), "trial 1 of 1: unknown, unknown temperature, skin to 30.5 degC; "),
    ],
)
def test_the_operator_is_asked_for_the_next_object(
    trial: Trial, words: str, of_batch: SimpleNamespace, stand_in: StandIn
) -> None:
    asked = stand_in("typer.prompt", "")
    of_batch.ready(0, trial)
    assert asked[0].args == (f"{words}Enter when it is ready, q to stop",)
    assert (asked[0].default, asked[0].show_default) == ("", False)


@pytest.mark.parametrize(("contact", "warned"), [(0.1, False), (float("nan"), True)])
def test_no_contact_is_reported_to_the_operator(
    contact: float, warned: bool, of_batch: SimpleNamespace, stand_in: StandIn,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    stand_in("typer.prompt", "")
    of_batch.judge(0, Trial("copper", 30.0), SimpleNamespace(contact=contact))
    assert ("the skin felt nothing" in capsys.readouterr().err) == warned


@pytest.mark.parametrize(("said", "again"), [("c", True), ("Cleared", True), ("", False), ("no", False)])
def test_after_a_trip_the_operator_is_asked_whether_it_is_cleared(
    said: str, again: bool, of_batch: SimpleNamespace, stand_in: StandIn
) -> None:
    asked = stand_in("typer.prompt", said)
    trip = Trip("limit", 1.0, "t_surface", "3 to 55 degC", "61 degC")
    assert of_batch.cleared(0, Trial("copper", 30.0), trip) is again
    assert asked[0].args == (f"{trip.line()}; c when it is cleared, Enter to end the batch",)


@pytest.mark.parametrize(("words", "shown"), [([], "0"), (["8642"], "8642"), (["--seed", "3"], "0")])
def test_live_may_stand_alone(words: list[str], shown: str, ran: SimpleNamespace, stand_in: StandIn) -> None:
    made = stand_in("thermogrip.cli.rig.ShowOptions.watch", UserError("seen"))
    given = ["run", "c.json", "--target", "40", "--twin", "plant.json", "--out", "r"]
    assert ran.bench.run(*given, "--live", *words).code == 2
    assert made[0].args[0] == ShowOptions(live=int(shown))
    assert (made[0].args[1], made[0].args[3:]) == ("run", (Path("r"), 10.0))
    ran.bench.run(*given, "--foxglove")
    assert made[1].args[0] == ShowOptions(foxglove=8765)


def test_a_first_touch_reports_median_and_sd_of_its_90_percent_interval(
    of_batch: SimpleNamespace, stand_in: StandIn
) -> None:
    row = SimpleNamespace(t_object=40.0, t_object_p05=40.0 - 1.645 * 0.6, t_object_p95=40.0 + 1.645 * 0.6)
    stand_in("thermogrip.sysid.effusivity.gripper_model.load_default_gripper", "the gripper")
    asked = stand_in("thermogrip.sysid.effusivity.posterior.effusivity_posterior", [row, None])
    assert of_batch.first_touch("a grasp") == pytest.approx((40.0, 0.6))
    assert asked[0].args == ("the gripper", "a grasp")


def test_a_schedule_that_cannot_be_played_is_refused_by_its_name_and_the_port_is_closed(
    bench: Bench, stand_in: StandIn
) -> None:
    closed: list[bool] = []
    made = SimpleNamespace(units={}, close=lambda: closed.append(True))
    stand_in("thermogrip.rig.drivers.connect.open_rig", made)
    stand_in("thermogrip.rig.session.session.Playback", UserError("too high", hint="lower"))
    done = bench.run("record", "good.csv", "--port", "socket://rig", "--out", "r")
    assert (done.code, done.said, closed) == (2, ["thermogrip: good.csv: too high; lower"], [True])
    assert not (bench.path / "r").exists()


@pytest.mark.parametrize("words", ["run c.json --target 38", "batch c.json plan.csv", "record good.csv"])
def test_a_guard_file_that_is_wrong_is_refused_before_a_port_is_opened(
    words: str, bench: Bench, stand_in: StandIn
) -> None:
    Controller(small_plant()).save(bench.path / "c.json")
    bench.write("plan.csv", "material,target_degC\ncopper,30\n")
    bench.write("g.toml", "stale_ms = 500\n")
    opened = stand_in("thermogrip.rig.drivers.connect.open_rig", SimpleNamespace(units={"drive": "1"}))
    done = bench.run(*words.split(), "--port", "socket://rig", "--guard", "g.toml", "--out", "r")
    assert (done.code, len(done.said), opened) == (2, 1, [])
    assert done.said[0].startswith("thermogrip: g.toml: stale_ms: no such key")
    assert not (bench.path / "r").exists()


def test_of_a_faster_virtual_device_the_program_may_be_as_late_in_seconds_of_the_computer() -> None:
    for speed, expiry_s in ((1.0, 2.0), (0.5, 2.0), (4.0, 8.0)):
        assert verbs.guard_of(None, None, speed=speed).settings.expiry_s == expiry_s


class Stepped:
    """A device on a clock that the verb's waiting moves on."""

    def __init__(self) -> None:
        self.port, self.time, self.events = "nowhere", 0.0, list[Any]()

    def made(self, *args: Any, **options: Any) -> Stepped:
        self.args, self.options = args, options
        return self

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        self.events.append("closed")

    def fault(self, name: str) -> None:
        self.events.append((self.time, name))

    def place(self, *what: object) -> None:
        self.events.append(what)

    def wait(self, seconds: float) -> None:
        assert seconds == 0.05
        self.time += 1.0


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Stepped:
    made = Stepped()
    monkeypatch.setattr("thermogrip.rig.simulation.virtual_device.VirtualDevice", made.made)
    monkeypatch.setattr(verbs, "time", SimpleNamespace(sleep=made.wait))
    return made


def test_a_device_is_what_the_words_say(bench: Bench, device: Stepped) -> None:
    words = "virtual --protocol tclab --plant plant.json --socket 4000 --speed 3 --from 28 --ambient 21"
    words += " --object 18 --material copper --seed 5 --seconds 0 --json"
    done = bench.run(*words.split())
    assert (done.code, json.loads(done.out)) == (0, {"port": "nowhere", "protocol": "tclab"})
    assert device.args[0].inputs == ("drive", "pump")
    clock = device.options.pop("clock")
    assert clock.speed == 3.0
    assert device.options == {
        "protocol": "tclab", "link": "socket", "socket_port": 4000, "seed": 5, "ambient": 21.0,
        "t_start": 28.0,
    }  # fmt: skip
    assert device.events == [("copper", 18.0), "closed"]


@pytest.mark.parametrize(
    ("words", "link", "port"), [("", "pty", 0), ("--pty", "pty", 0), ("--socket 0", "socket", 0)]
)
def test_a_device_is_on_a_pseudo_terminal_where_no_socket_is_named(
    words: str, link: str, port: int, bench: Bench, device: Stepped
) -> None:
    done = bench.run("virtual", *words.split(), "--material", "copper", "--seconds", "0")
    assert (done.code, done.out, device.args) == (0, "nowhere\n", (None,))
    options = device.options
    assert (options["link"], options["socket_port"], options["protocol"]) == (link, port, "thermogrip")
    assert (options["clock"].speed, options["ambient"], options["t_start"]) == (1.0, 23.0, None)
    assert device.events == ["closed"]  # nothing is grasped without a temperature


def test_faults_come_in_the_order_of_their_times_and_not_before(bench: Bench, device: Stepped) -> None:
    faults = ("6:silence", "2:sensor_open", "900:reset", "0:garbage")
    words = [word for fault in faults for word in ("--fault", fault)]
    done = bench.run("virtual", "--socket", "0", "--seconds", "12", *words)
    assert done.code == 0, done.err
    assert device.events == [(0.0, "garbage"), (2.0, "sensor_open"), (6.0, "silence"), "closed"]
    assert device.time == 12.0


@pytest.mark.parametrize("text", ["nan:silence", "-5:silence", "silence", "inf:silence", "soon:reset"])
def test_a_fault_without_a_time_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["virtual", f"--fault={text}", "--seconds", "0"]) == 2
    assert capsys.readouterr().err == f"thermogrip: --fault {text!r} has no time; write 60:sensor_open\n"


@pytest.mark.parametrize(
    ("options", "said"),
    [(["--pty", "--socket", "0"], "both given"), (["--fault", "5:ghost"], "--fault 'ghost' is unknown")],
)
def test_a_device_that_cannot_be_is_one_line(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["virtual", *options]) == 2
    assert said in capsys.readouterr().err


def test_an_address_without_its_scheme_is_refused_before_the_rig_is_opened(bench: Bench) -> None:
    done = bench.run("record", "s.csv", "--port", "x", "--out", "d", "--bridge", "localhost:9090")
    said = "thermogrip: --bridge 'localhost:9090' is no address; write ws://localhost:9090"
    assert (done.code, done.said) == (2, [said])
