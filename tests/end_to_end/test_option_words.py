"""What the words of an option stand for, and what is refused before any work is done."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.cli import batch, rig, run
from thermogrip.cli.main import app
from thermogrip.cli.options import choice, comma, crew, new_file, new_folder
from thermogrip.cli.training_data import touched_part, training_part
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.report.console import Console
from thermogrip.rig.guard.plant_mismatch import USUAL_DRIFT
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.models.network import load_network


def test_a_list_of_words_is_cut_at_commas_and_names_something() -> None:
    assert comma(" t_tank ,,t_surface ") == ("t_tank", "t_surface")
    assert comma(None) is None
    with pytest.raises(UserError, match="',' names nothing"):
        comma(",")
    assert crew(3, None) == 3
    assert choice("--kind", "b", ("a", "b")) == "b"
    with pytest.raises(UserError, match="--kind 'c' is unknown; use a, b"):
        choice("--kind", "c", ("a", "b"))


def test_a_file_and_a_folder_to_write_are_not_each_other_and_are_made_room_for(tmp_path: Path) -> None:
    (tmp_path / "file.html").touch()
    new = tmp_path / "deep" / "page.HTML"
    assert new_file(new, (".html",)) == new
    assert new.parent.is_dir()
    assert new_file(tmp_path / "file.html", (".html",)) == tmp_path / "file.html"
    for wrong, words in ((tmp_path / "page.txt", "cannot write a .txt"), (tmp_path / "page", "a nameless")):
        with pytest.raises(UserError, match=words):
            new_file(wrong, (".html",))
    with pytest.raises(UserError, match="is a folder"):
        new_file(tmp_path)
    assert new_folder(tmp_path) == tmp_path
    assert new_folder(tmp_path / "one" / "two").is_dir()
    with pytest.raises(UserError, match="is a file"):
        new_folder(tmp_path / "file.html")
    with pytest.raises(UserError, match="cannot make this folder"):
        new_folder(tmp_path / "file.html" / "below")


def test_a_verb_does_nothing_more_than_it_was_asked_but_a_batch_on_a_rig_asks_its_operator() -> None:
    on = {
        (command.name, name)
        for command in app.registered_commands
        for name, option in signature(command.callback).parameters.items()
        if option.default is True
    }
    assert on == {("batch", "ask")}


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


def test_an_object_has_a_material_and_a_temperature_or_there_is_none() -> None:
    assert run._what_to_grasp(None, None) is None
    assert run._what_to_grasp(0.0, "copper") == ("copper", 0.0)
    for half in ((18.0, None), (None, "copper")):
        with pytest.raises(UserError, match="one of --object and --material is missing"):
            run._what_to_grasp(*half)


@pytest.mark.parametrize(("port", "twin"), [(None, None), ("COM3", Path("plant.json"))])
def test_either_a_port_or_a_twin_is_given(port: str | None, twin: Path | None) -> None:
    with pytest.raises(UserError, match="give --port DEV, or --twin PLANT"):
        run.one_rig(port, twin)
    run.one_rig("COM3", None)
    run.one_rig(None, Path("plant.json"))


def test_files_of_a_run_are_those_that_are_named_and_there(tmp_path: Path) -> None:
    learn = tmp_path / "rig.json"
    assert run.files_of(learn, plant=None, guard=Path("g.toml")) == {"guard": Path("g.toml")}
    learn.touch()
    assert run.files_of(learn, plant=Path("p.json")) == {"plant": Path("p.json"), "learn": learn}
    assert run.files_of(None) == {}


def test_a_first_touch_tells_median_and_sd_of_its_90_percent_interval(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    row = SimpleNamespace(t_object=40.0, t_object_p05=40.0 - 1.645 * 0.6, t_object_p95=40.0 + 1.645 * 0.6)
    monkeypatch.setattr("thermogrip.sysid.effusivity.posterior.effusivity_posterior", lambda *_: [row])
    assert batch._first_touch(None) == pytest.approx((40.0, 0.6))


def test_a_rig_that_nobody_knows_drifts_as_is_usual_or_as_the_guard_file_says(tmp_path: Path) -> None:
    plant, file = plant_from_prior(load_network("tclab")), tmp_path / "rig.json"
    assert rig._drift_of(file, plant, 0.0).drift == USUAL_DRIFT
    rig._drift_of(file, plant, 0.1).save(file)
    assert rig._drift_of(file, plant, 0.0).drift == rig._drift_of(file, plant, 0.1).drift == 0.1
    with pytest.raises(UserError, match=r"was learnt with a drift of 0\.1, the guard file says 0\.15"):
        rig._drift_of(file, plant, 0.15)


def test_faults_come_in_the_order_of_their_times_and_not_before(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    came: list[tuple[float, str]] = []

    class Stepped:
        """A device on a clock that the verb's waiting moves on."""

        port, time = "nowhere", 0.0

        def __init__(self, *_: object, **__: object) -> None: ...
        def __enter__(self) -> None: ...
        def __exit__(self, *_: object) -> None: ...
        def fault(self, name: str) -> None:
            came.append((Stepped.time, name))

    def wait(_: float) -> None:
        Stepped.time += 1.0

    monkeypatch.setattr("thermogrip.rig.simulation.virtual_device.VirtualDevice", Stepped)
    monkeypatch.setattr(rig, "time", SimpleNamespace(sleep=wait))
    words = ["virtual", "--plant", "plant.json", "--socket", "0", "--seconds", "12"]
    done = bench.run(*words, "--fault", "6:silence", "--fault", "2:sensor_open", "--fault", "900:reset")
    assert done.code == 0, done.err
    assert came == [(2.0, "sensor_open"), (6.0, "silence")]
    assert Stepped.time == 12.0


def test_the_bar_of_validate_is_at_the_share_of_logs_that_are_done(bench: Bench) -> None:
    done = bench.run("validate", "plant.json", "good.csv@:100", "good.csv@100:200", "--json")
    assert done.code == 0, done.err
    told = [line.split()[1] for line in done.err.splitlines() if line.startswith("validate")]
    assert told == ["0", "50"]


def marked(split: list[str]) -> Grasps:
    """Return a grasp for each mark."""
    n = len(split)
    return make_grasps([-1.0, 0.0, 1.0], np.full((n, 3), 23.0), [f"g{k}" for k in range(n)], split=split)


@pytest.mark.parametrize(
    ("split", "given", "kept"),
    [
        (["train", "test", "train"], None, ["g0", "g2"]),
        (["train", "test", "train"], "train", ["g0", "g2"]),
        (["train", "test", "train"], "all", ["g0", "g1", "g2"]),
        (["", ""], None, ["g0", "g1"]),
        (["", ""], "all", ["g0", "g1"]),
    ],
)
def test_what_is_marked_train_teaches_or_all_where_nothing_is(
    split: list[str], given: str | None, kept: list[str]
) -> None:
    [part] = training_part(Console(), [marked(split)], given)
    assert part["grasp"].values.tolist() == kept


def test_a_file_without_training_grasps_is_left_out_and_told(capsys: pytest.CaptureFixture[str]) -> None:
    parts = training_part(Console(), [marked(["test"]), marked(["train"])], None)
    assert len(parts) == 1
    assert "no grasp is marked train, it is left out" in capsys.readouterr().err
    with pytest.raises(UserError, match="no grasp is marked train; use --split all"):
        training_part(Console(), [marked(["test"])], None)
    with pytest.raises(UserError, match="has no split"):
        training_part(Console(), [marked([""])], "train")


def test_grasps_that_touched_nothing_do_not_teach(capsys: pytest.CaptureFixture[str]) -> None:
    time = np.arange(-8, 41) / 4.0
    rise = 23.0 + 8.0 * -np.expm1(-np.maximum(time, 0.0))
    still = np.full(time.size, 23.0)
    record = make_grasps(time, [rise, still, still], ["a", "b", "c"], t_object=[43.0] * 3, name="mine")
    [part] = touched_part(Console(), [record])
    assert part["grasp"].values.tolist() == ["a"]
    assert "mine: 2 left out: no contact" in capsys.readouterr().err
    with pytest.raises(UserError, match="no grasp shows a contact"):
        touched_part(Console(), [record.isel(grasp=[1, 2])])
