"""Provenance: every file says where it comes from, and that alone differs between two equal runs."""

from __future__ import annotations

import json
import sys
from hashlib import sha256
from pathlib import Path

import pytest

from thermogrip.datasets.atomic_files import read_json, write_json
from thermogrip.datasets.provenance import KEY, note_seed, provenance, work
from thermogrip.sysid.contact.materials import find_material


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_json_says_who_wrote_it_from_what_and_is_read_with_and_without_that(here: Path) -> None:
    old = here / "old.json"
    old.write_text(json.dumps({"schema": "thing", "version": 1, "a": 1}))
    outside = here.parent / f"{here.name}.json"
    outside.write_text(old.read_text())
    with work(["thermogrip", "identify", "a b.csv"]):
        note_seed(7)
        assert read_json(old, "thing", 1) == read_json(outside, "thing", 1)
        write_json(here / "new.json", {"a": 2}, schema="thing", version=1)
        read_json(here / "new.json", "thing", 1)  # what the command wrote itself is none of its inputs
        write_json(here / "next.json", {"a": 3}, schema="thing", version=1)
    outside.unlink()
    digest = sha256(old.read_bytes()).hexdigest()
    for name, a in (("new.json", 2), ("next.json", 3)):
        content = read_json(here / name, "thing", 1)
        found = content.pop(KEY)
        assert content == {"schema": "thing", "version": 1, "a": a}
        assert found.pop("written").endswith("Z")
        assert found.pop("thermogrip")
        inputs = {"old.json": digest, str(outside): digest}
        assert found == {"command": "thermogrip identify 'a b.csv'", "seed": 7, "inputs": inputs}


def test_what_the_package_brings_is_no_input() -> None:
    with work(["thermogrip"]):
        find_material("copper")
        assert provenance()["inputs"] == {}


def test_outside_of_a_command_there_are_the_program_s_words_and_no_inputs(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/night.py", "--fast"])
    write_json(here / "a.json", {}, schema="thing", version=1)
    read_json(here / "a.json", "thing", 1)
    found = provenance()
    assert (found["command"], found["seed"], found["inputs"]) == ("night.py --fast", None, {})


@pytest.mark.parametrize(
    ("epoch", "date"), [("0", "1970-01-01T00:00:00Z"), ("1700000000", "2023-11-14T22:13:20Z")]
)
def test_the_date_is_that_of_the_environment(epoch: str, date: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
    assert provenance()["written"] == date


@pytest.mark.parametrize("epoch", ["", "yesterday", "-1", "9" * 30])
def test_a_date_that_is_none_is_left_alone(epoch: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
    assert provenance()["written"] > "2024"


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX: a folder in use cannot be removed")
def test_a_working_folder_that_was_removed_costs_nothing_that_is_written(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = here / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with work(["thermogrip", "run"]):
        write_json(here / "run.json", {"a": 1}, schema="thing", version=1)
    assert json.loads((here / "run.json").read_text())[KEY]["command"] == "thermogrip run"


def test_a_file_that_is_gone_has_no_sum(here: Path) -> None:
    (here / "a.json").write_text(json.dumps({"schema": "thing", "version": 1}))
    with work(["thermogrip"]):
        read_json(here / "a.json", "thing", 1)
        (here / "a.json").unlink()
        assert provenance()["inputs"] == {"a.json": ""}
