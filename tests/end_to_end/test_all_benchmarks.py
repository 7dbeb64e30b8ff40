"""The list of benchmarks: each program is on it, and its words can be filled."""

from __future__ import annotations

import importlib.util
import string
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="no benchmarks beside the tests")


def listed():
    spec = importlib.util.spec_from_file_location("all_benchmarks", FOLDER / "all.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def test_every_program_is_on_the_list_once():
    programs = {
        path.relative_to(FOLDER).as_posix()
        for path in FOLDER.rglob("*.py")
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    } - {"all.py"}
    every = listed()
    named = [benchmark.program for benchmark in every.ALL]
    assert sorted([*named, *every.NOT_RUN]) == sorted(programs)


def test_what_a_command_names_is_made_or_given():
    every = listed()
    for benchmark in every.ALL:
        for words in (benchmark.full, benchmark.quick):
            fields = {field for _, field, _, _ in string.Formatter().parse(words) if field}
            assert fields <= {"data", "out"}, benchmark.program
