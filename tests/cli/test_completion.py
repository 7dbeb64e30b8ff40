"""What a shell is offered: names of each option, and files of the kind that a verb takes."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from thermogrip.cli.completion import completer
from thermogrip.cli.main import app

OLD = Path(__file__).parents[1] / "files_of_0_1_0"


def offered(line: str) -> list[str]:
    """Return what bash is offered at the end of a command line."""
    words = f"thermogrip {line}"
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split(" ")) - 1)}
    asked["_THERMOGRIP_COMPLETE"] = "complete_bash"
    return CliRunner().invoke(app, env=asked, prog_name="thermogrip").output.split()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a plant, a controller, a log and a file of no kind."""
    (tmp_path / "plant.json").write_bytes((OLD / "plant_linear.json").read_bytes())
    (tmp_path / "law.json").write_bytes((OLD / "controller.json").read_bytes())
    (tmp_path / "log.csv").write_text("time_s,q,t_degC\n0,0,20\n1,0,20\n", encoding="utf-8")
    (tmp_path / "notes.txt").write_text("notes", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("identify log.csv --network tc", ["tclab"]),
        ("identify log.csv --network no", ["none"]),
        ("identify log.csv --models arx,o", ["arx,oe"]),
        ("compare g.csv --classifiers lstm,bay", ["lstm,bayes"]),
        ("train g.csv --classifier pos", ["posterior"]),
        ("classify model g.csv --materials copper,woo", ["copper,wood"]),
        ("excite --kind st", ["staircase"]),
        ("compare g.csv --by b", ["block"]),
        ("init gu", ["guard"]),
        ("init network --like hot", ["hotend"]),
        ("virtual --protocol tc", ["tclab"]),
        ("rev", ["review"]),
        ("tune plant.json --out ", []),
        ("identify log.csv --network zzz", []),
    ],
)
def test_names_are_offered(line: str, names: list[str]) -> None:
    assert offered(line) == names


def test_files_of_the_kind_that_the_verb_takes_are_offered(folder: Path) -> None:
    assert offered("validate ") == ["plant.json"]
    assert offered("review ") == ["law.json"]
    assert offered("identify ") == ["log.csv"]
    assert offered("run law.json --twin ") == ["plant.json"]
    assert offered(f"review {folder}/l") == [f"{folder}/law.json"]
    assert offered("review nowhere/") == []


def test_a_place_that_takes_no_names_is_offered_none() -> None:
    assert completer("--out", "FILE.json")("") == []
    assert all(" " not in name for name in completer("--material", "NAME")(""))
