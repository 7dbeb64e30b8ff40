"""record, virtual: a schedule on a rig, a device that is simulated, and the guard of either."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.cli.conftest import Bench, StandIn, shares
from thermogrip.cli import rig
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.rig.guard.plant_mismatch import USUAL_DRIFT
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.models.network import load_network


@pytest.mark.parametrize(("ended", "code"), [("", 0), ("limit: too hot", 3)])
def test_a_schedule_is_played_and_its_rows_are_counted(
    ended: str, code: int, bench: Bench, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Folder:
        def __init__(self, *args: Any, **options: Any) -> None:
            folders.append((args, options))

        def __enter__(self) -> Folder:
            return self

        def __exit__(self, *_: object) -> None: ...
        def played(self, why: str) -> None:
            folders.append(why)

    def play(*_: Any, progress: Any, **__: Any) -> Any:
        progress(0.5, "q1")
        return SimpleNamespace(sizes={"time": 77}), ended

    folders: list[Any] = []
    closed: list[bool] = []
    made = SimpleNamespace(units={"drive": "1"}, close=lambda: closed.append(True))
    opened = stand_in("thermogrip.rig.drivers.connect.open_rig", made)
    tried = stand_in("thermogrip.rig.session.schedule_player.Playback")
    plays = stand_in("thermogrip.rig.session.schedule_player.play", play)
    guards = stand_in("thermogrip.cli.rig.guard_of", "a guard")
    monkeypatch.setattr("thermogrip.rig.records.recorder.RunFolder", Folder)
    bench.write("g.toml", "")
    words = ["record", "good.csv", "--port", "COM3", "--out", "r"]
    done = bench.run(*words, "--sample", "0.5", "--guard", "g.toml", "--speed", "4", "--protocol", "tclab",
                     "--seed", "3")  # fmt: skip
    assert (done.code, closed) == (code, [True]), done
    [opens], [call] = opened, plays
    assert (opens.args, opens.clock.speed) == (("COM3", "tclab"), 4.0)
    assert (tried[0].args[0].attrs["name"], tried[0].args[1:]) == ("good", ({"drive": "1"}, 0.5))
    assert guards[0].args == (Path("g.toml"), None)
    assert (call.args[0], call.args[1].attrs["name"], call.dt) == (made, "good", 0.5)
    assert (call.guard, call.clock is opens.clock) == ("a guard", True)
    about = {"schedule": "good.csv", "port": "COM3", "sample_s": 0.5, "seed": 3}
    assert folders == [((Path("r"), about), {"files": {"guard": Path("g.toml")}}), ended]
    assert shares(done.err, "record") == [50]
    assert done.out == (f"{ended}\n" if ended else "") + "wrote 77 rows to r/samples.csv\n"
    assert json.loads(bench.run(*words, "--json").out) == {"rows": 77, "ended": ended, "out": "r"}
    assert (plays[1].dt, opened[1].args[1], folders[2][1]) == (1.0, None, {"files": {}})


def test_a_schedule_that_cannot_be_played_is_refused_by_its_name_and_the_port_is_closed(
    bench: Bench, stand_in: StandIn
) -> None:
    closed: list[bool] = []
    made = SimpleNamespace(units={}, close=lambda: closed.append(True))
    stand_in("thermogrip.rig.drivers.connect.open_rig", made)
    stand_in("thermogrip.rig.session.schedule_player.Playback", UserError("too high", hint="lower"))
    done = bench.run("record", "good.csv", "--port", "COM3", "--out", "r")
    assert (done.code, done.said, closed) == (2, ["thermogrip: good.csv: too high; lower"], [True])
    assert not (bench.path / "r").exists()


def test_a_guard_has_its_file_or_the_defaults_and_learns_only_of_a_plant(
    stand_in: StandIn, tmp_path: Path
) -> None:
    settings = SimpleNamespace(model=SimpleNamespace(drift=0.125))
    read = stand_in("thermogrip.rig.guard.settings.read_guard", settings)
    guards = stand_in("thermogrip.rig.guard.guard.Guard", "a guard")
    stand_in("thermogrip.rig.guard.guard.GuardSettings", settings)
    drifts = stand_in("thermogrip.cli.rig._drift_of", "a drift")
    assert rig.guard_of(None, None) == "a guard"
    rig.guard_of(Path("g.toml"), "a plant")
    rig.guard_of(None, None, tmp_path)
    assert not drifts
    rig.guard_of(None, "a plant", tmp_path)
    assert [call.args for call in guards] == [
        (None, settings), ("a plant", settings), (None, settings), ("a plant", settings),
    ]  # fmt: skip
    assert [call.drift for call in guards] == [None, None, None, "a drift"]
    assert [call.args for call in read] == [(Path("g.toml"),)]
    assert drifts[0].args == (tmp_path, "a plant", 0.125)


def test_a_rig_that_nobody_knows_drifts_as_is_usual_or_as_the_guard_file_says(tmp_path: Path) -> None:
    plant, file = plant_from_prior(load_network("tclab")), tmp_path / "rig.json"
    assert rig._drift_of(file, plant, 0.0).drift == USUAL_DRIFT
    rig._drift_of(file, plant, 0.1).save(file)
    assert rig._drift_of(file, plant, 0.0).drift == rig._drift_of(file, plant, 0.1).drift == 0.1
    with pytest.raises(UserError, match=r"was learnt with a drift of 0\.1, the guard file says 0\.15"):
        rig._drift_of(file, plant, 0.15)
    with pytest.raises(UserError, match=r"cannot write a \.txt file here"):
        rig._drift_of(tmp_path / "rig.txt", plant, 0.1)


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
    monkeypatch.setattr(rig, "time", SimpleNamespace(sleep=made.wait))
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


@pytest.mark.parametrize("text", ["nan:silence", "-5:silence", "silence", "inf:silence"])
def test_a_fault_without_a_time_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["virtual", f"--fault={text}", "--seconds", "0"]) == 2
    assert capsys.readouterr().err == f"thermogrip: --fault {text!r} has no time; write 60:sensor_open\n"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--protocol", "morse"], "use thermogrip, tclab"),
        (["--pty", "--socket", "0"], "both given"),
        (["--fault", "soon:sensor_open"], "has no time"),
        (["--fault", "5:ghost"], "--fault 'ghost' is unknown"),
        (["--plant", "nothing.json"], "nothing.json"),
    ],
)
def test_a_device_that_cannot_be_is_one_line(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["virtual", *options]) == 2
    assert said in capsys.readouterr().err
