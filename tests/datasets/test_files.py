"""Whole files or none, JSON that says what it is, and where it comes from."""

from __future__ import annotations

import errno
import json
import os
import pickle
import sys
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermogrip.datasets import files
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import (
    KEY,
    atomic_path,
    hash_file,
    note_seed,
    provenance,
    read_bytes,
    read_json,
    work,
    write_atomic,
    write_json,
)
from thermogrip.sysid.contact.materials import find_material

KEYS = {"schema": "thermogrip.test", "version": 2}


@pytest.mark.parametrize("reason", [KeyboardInterrupt, SystemExit, ValueError, ZeroDivisionError])
def test_whatever_stops_the_writer_the_old_file_stays_and_no_other(tmp_path, reason):
    path = tmp_path / "a.txt"
    write_atomic(path, "old")

    def interrupted():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise reason

    with pytest.raises(reason):
        interrupted()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EACCES, "permission denied"),
        (errno.EROFS, "read-only"),
        (errno.EDQUOT, "quota"),
    ],
)
def test_a_disk_that_refuses_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, code, words):
    def refuse(*_args):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(files.os, "fsync", refuse)
    with pytest.raises(UserError, match=words) as fault:
        write_atomic(tmp_path / "a.txt", "x")
    assert "a.txt" in str(fault.value)
    assert os.listdir(tmp_path) == []


def test_the_data_is_on_the_disk_before_the_name(tmp_path, monkeypatch):
    order = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(files.os, "fsync", lambda fd: (order.append("sync"), sync(fd)))
    monkeypatch.setattr(files.os, "replace", lambda a, b: (order.append("rename"), replace(a, b)))
    write_atomic(tmp_path / "a.txt", "x")
    assert order == ["sync", "rename", "sync"]
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_missing_folder_and_a_folder_are_named(tmp_path):
    with pytest.raises(UserError, match="no such file or folder; check the path"):
        write_atomic(tmp_path / "none" / "a.txt", "x")
    with pytest.raises(UserError, match="is a folder"):
        write_atomic(tmp_path, "x")
    write_atomic(tmp_path / "file", "x")
    with pytest.raises(UserError, match="not a folder"):
        write_atomic(tmp_path / "file" / "a.txt", "x")
    with pytest.raises(UserError, match="name is too long"):
        write_atomic(tmp_path / ("x" * 300), "x")


@pytest.mark.skipif(os.name == "nt", reason="permissions are POSIX here")
def test_permissions_are_those_a_plain_open_would_give(tmp_path):
    mask = os.umask(0o027)
    try:
        write_atomic(tmp_path / "new", "x")
        assert (tmp_path / "new").stat().st_mode & 0o777 == 0o640
        (tmp_path / "new").chmod(0o600)
        write_atomic(tmp_path / "new", "y")
        assert (tmp_path / "new").stat().st_mode & 0o777 == 0o600
    finally:
        os.umask(mask)


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
@pytest.mark.parametrize("there", [True, False])
def test_a_link_of_the_files_name_is_replaced_and_what_it_leads_to_left_alone(tmp_path, there):
    mask, elsewhere = os.umask(0o027), tmp_path / "elsewhere"
    try:
        if there:
            elsewhere.write_text("somebody's")
            elsewhere.chmod(0o666)
        (tmp_path / "a.txt").symlink_to(elsewhere)
        write_atomic(tmp_path / "a.txt", "ours")
    finally:
        os.umask(mask)
    assert (tmp_path / "a.txt").read_text() == "ours"
    assert (tmp_path / "a.txt").lstat().st_mode & 0o777 == 0o640  # neither the link's nor the other file's
    assert elsewhere.exists() == there
    assert not there or elsewhere.read_text() == "somebody's"


def test_the_hash_is_sha256(tmp_path):
    write_atomic(tmp_path / "a", b"abc")
    assert hash_file(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    with pytest.raises(UserError, match="no such file"):
        read_bytes(tmp_path / "b")


MOST = 1e100  # what a document may hold
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**100), 10**100) | st.floats(-MOST, MOST) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


@settings(deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.dictionaries(st.text(min_size=1).filter(lambda k: k not in KEYS), JSON, max_size=4))
def test_json_comes_back(tmp_path, content):
    path = write_json(tmp_path / "a.json", content, schema="thermogrip.test", version=2)
    for newest in (2, 3):
        back = read_json(path, "thermogrip.test", newest)
        assert back.pop("provenance")["written"]
        assert back == KEYS | content


def test_what_is_no_character_is_replaced(tmp_path):
    path = write_json(tmp_path / "a.json", {"file": "log\udcff.csv"}, schema="test", version=1)
    assert read_json(path, "test", 1)["file"] == "log?.csv"


def test_json_has_no_nan(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"x": float("nan")}, schema="s", version=1)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b'{"schema": "thermogrip.test",\n "version": 1,\n oops}', "line 3 column 2"),
        (b'{"schema": "thermogrip.test", "version": 1, "x": NaN}', "x is nan, not a finite number"),
        (b'{"schema": "thermogrip.test", "version": 1, "x": "\\ud800"}', "surrogates not allowed"),
        (b"\x80\x04\x95", "is not JSON ('utf-8'"),
        (pickle.dumps({"schema": "thermogrip.test", "version": 1}), "is not JSON ('utf-8'"),
        (b"cos\nsystem\n(S'true'\ntR.", "is not JSON"),
        (b"[1, 2]", "schema is 'list'"),
        (b"{}", "schema is None"),
        (b'{"schema": "plant", "version": 1}', "schema is 'plant', not 'thermogrip.test'"),
        (b'{"schema": "thermogrip.test"}', "version None"),
        (b'{"schema": "thermogrip.test", "version": 9}', "version 9 is not between 1 and 2"),
        (b'{"schema": "thermogrip.test", "version": 0}', "version 0"),
        (b'{"schema": "thermogrip.test", "version": true}', "version True"),
        (b'{"schema": "thermogrip.test", "version": "1"}', "version '1'"),
    ],
)
def test_what_is_not_the_expected_json_is_one_line(tmp_path, content, words):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(UserError) as fault:
        read_json(path, "thermogrip.test", 2)
    assert words in str(fault.value)
    assert "a.json" in str(fault.value)
    assert "\n" not in str(fault.value)


@pytest.fixture
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
