"""What the words of an option stand for, what is refused before any work, and what is reported of grasps."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.cli.conftest import Bench, StandIn
from thermogrip.cli import options
from thermogrip.cli.options import choice, comma, new_file, new_folder, workers_of
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console
from thermogrip.sysid.models.network import NetworkModel


def test_a_list_of_words_is_cut_at_commas_and_names_something() -> None:
    assert comma(" t_tank ,,t_surface ") == ("t_tank", "t_surface")
    assert comma(None) is None
    with pytest.raises(UserError, match="',' names nothing"):
        comma(",")
    assert choice("--kind", "b", ("a", "b")) == "b"
    with pytest.raises(UserError, match="--kind 'c' is unknown; use a, b"):
        choice("--kind", "c", ("a", "b"))
    asked = options.one_of("--kind", ("a", "b"))
    assert (asked(None), asked("a")) == (None, "a")
    with pytest.raises(UserError, match="--kind 'c' is unknown; use a, b"):
        asked("c")


def test_work_is_done_by_processes_or_by_the_cluster_that_is_named() -> None:
    assert workers_of(3, None) == 3
    assert workers_of(3, "tcp://10.0.0.1:8786") == "tcp://10.0.0.1:8786"
    with pytest.raises(UserError, match="write tcp://HOST:PORT"):
        workers_of(3, "localhost")


def test_a_file_and_a_folder_to_write_are_not_each_other_and_are_made_room_for(tmp_path: Path) -> None:
    (tmp_path / "file.html").touch()
    new = tmp_path / "deep" / "page.HTML"
    assert new_file(new, (".html",)) == new
    assert new.parent.is_dir()
    assert new_file(tmp_path / "file.html", (".html",)) == tmp_path / "file.html"
    refused = {"page.txt": "cannot be .* a .txt file; name it .*page.html", "page": "has no ending"}
    for wrong, words in refused.items():
        with pytest.raises(UserError, match=words):
            new_file(tmp_path / wrong, (".html", ".htm"))
    with pytest.raises(UserError, match="is a folder"):
        new_file(tmp_path)
    assert new_folder(tmp_path) == tmp_path
    assert new_folder(tmp_path / "one" / "two").is_dir()
    with pytest.raises(UserError, match="is a file"):
        new_folder(tmp_path / "file.html")
    with pytest.raises(UserError, match="not a folder; check the path"):
        new_folder(tmp_path / "file.html" / "below")


@pytest.mark.parametrize(("allowed", "refused"), [(0b011, False), (0b010, True), (0b001, True)])
def test_a_folder_is_written_where_one_may_write_and_enter(
    allowed: int, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: mode & allowed == mode)
    if refused:
        with pytest.raises(UserError, match="this folder cannot be written"):
            new_folder(tmp_path)
    else:
        new_folder(tmp_path)


OWN = """
from thermogrip.sysid.models.network import load_network

class Tank:
    pass

def board():
    return load_network("tclab")

def tank():
    return Tank()

def wrong():
    return 1 / 0

def refuses():
    from thermogrip.datasets.errors import UserError
    raise UserError("not today")
"""


def test_a_network_is_a_name_or_a_file_or_what_a_file_of_the_user_makes(
    bench: Bench, stand_in: StandIn
) -> None:
    own = stand_in("thermogrip.sysid.models.user_model.own_model", "an own model")
    bench.write("own.py", OWN)
    assert options.find_network("tclab").name == "tclab"
    bench.write("net.toml", bench.run("init", "network").out)
    assert options.find_network("net.toml").name == "my_rig"
    made = options.find_network("own.py:board")
    assert isinstance(made, NetworkModel)
    assert not own
    assert options.find_network("own.py:Tank") == options.find_network("own.py:tank") == "an own model"
    assert (own[0].args[0].__name__, type(own[1].args[0]).__name__) == ("Tank", "Tank")
    with pytest.raises(UserError, match=r"own.py: wrong fails with ZeroDivisionError: division by zero"):
        options.find_network("own.py:wrong")
    with pytest.raises(UserError, match=r"^not today$"):
        options.find_network("own.py:refuses")


def test_the_first_log_settles_the_roles_and_what_never_moves_is_no_signal(tmp_path: Path) -> None:
    rows = [(k, 40 * (k // 5 % 2), 55, 0, 20 + k % 5, 30) for k in range(30)]
    table = "time_s,a,heater_percent,fan_percent,t_1_degC,t_2_degC\n"
    for name, more in (("one", rows), ("two", [(k, k % 7 / 3, *row[2:]) for k, row in enumerate(rows)])):
        text = table + "".join(",".join(map(str, row)) + "\n" for row in more)
        (tmp_path / f"{name}.csv").write_text(text.replace("heater_percent,fan", "heater_percent,fan"))
    logs = options.load_logs([f"{tmp_path}/one.csv", f"{tmp_path}/two.csv"])
    for log in logs:
        roles = {str(name): item.attrs["role"] for name, item in log.items()}
        assert roles == {"a": "other", "heater": "other", "fan": "input", "t_1": "output", "t_2": "other"}
    assert "heater: it never moves" in logs[0].attrs["guesses"]
    given = options.load_logs([f"{tmp_path}/one.csv"], ["heater"], ["t_2"])
    assert given[0]["heater"].attrs["role"] == "input"


@pytest.mark.parametrize("repaired", [0, 1, 5, 6, 9])
def test_what_was_repaired_in_grasps_is_reported_five_times_and_then_counted(
    repaired: int, stand_in: StandIn, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in("thermogrip.sysid.effusivity.quality.check_grasps")
    stand_in("thermogrip.sysid.effusivity.quality.contact_faults", ["no contact?"])
    stand_in("thermogrip.sysid.effusivity.quality.touched_groups", ["p"])
    torn = stand_in("thermogrip.sysid.effusivity.quality.torn_groups", ["a block in two files"])
    lines = [f"row {k} dropped" for k in range(repaired)]
    record: Any = SimpleNamespace(attrs={"name": "mine", "repairs": "\n\n".join(lines)})
    clean: Any = SimpleNamespace(attrs={"name": "clean"})
    options.warn_of_contacts(Console().warn, [record, clean])
    more = [f"{repaired - 5} more like these"] if repaired > 5 else []
    said = [f"mine: {words}" for words in (*lines[:5], *more, "no contact?")]
    said += ["clean: no contact?", "a block in two files"]
    assert capsys.readouterr().err.splitlines() == [f"thermogrip: warning: {words}" for words in said]
    assert [*torn[0].args[0]] == [("mine", ["p"]), ("clean", ["p"])]


def test_a_port_that_is_not_there_is_refused_with_those_that_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    options.check_port(str(tmp_path))
    options.check_port("socket://10.0.0.7:5000")
    there = {"ttyACM*": [Path("/dev/ttyACM1"), Path("/dev/ttyACM0")]}
    monkeypatch.setattr(Path, "glob", lambda self, pattern: there.get(pattern, []))
    meant = "use /dev/ttyACM0, /dev/ttyACM1; check name, cable and power; did you mean '/dev/ttyACM0'?"
    with pytest.raises(UserError, match=re.escape(f"ttyACM0: no such port; {meant}")):
        options.check_port("ttyACM0")
    there.clear()
    with pytest.raises(UserError, match="no such port; none is here; check name, cable and power"):
        options.check_port("/dev/ttyACM0.gone")
    monkeypatch.setattr("sys.platform", "win32")
    options.check_port("COM3")  # no file
