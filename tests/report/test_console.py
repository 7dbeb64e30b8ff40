"""What goes to stdout and stderr."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from thermogrip.report.console import Console, plain, short


@dataclass(frozen=True)
class Ends:
    low: float
    both: tuple[float, float]


def test_with_json_tables_and_words_are_silent(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)
    console.say("hello")
    console.table("t", ["a"], [[1]])
    console.answer({"a": 1})
    assert json.loads(capsys.readouterr().out) == {"a": 1}


def test_progress_never_goes_back(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().progress("demo") as progress:
        for k, fraction in enumerate((0.1, 0.6, 0.4, 0.7, 1.3)):
            progress(fraction, f"{k}: step")
    shares = [int(line.split()[1]) for line in capsys.readouterr().err.splitlines()]
    assert shares == [10, 60, 60, 70, 100]


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (0.123456, "0.1235"), (None, "-"), (1234567.0, "1.235e+06"), ("wood", "wood"), (float("nan"), "-"),
        (True, "yes"), (False, "no"), (np.float64(0.5), "0.5"), (np.int64(7), "7"), (12345, "12345"),
    ],
)  # fmt: skip
def test_a_cell_has_four_digits_and_a_dash_for_what_is_absent(cell: object, text: str) -> None:
    assert short(cell) == text


@pytest.mark.parametrize(
    ("value", "held"),
    [(Path("a") / "b", "a/b"), ((1, {2}), [1, [2]]), (frozenset({3}), [3]), ({4: None}, {"4": None}),
     (True, True), (5, 5), (2.5, 2.5), (1j, "1j"), ("x", "x"),
     (Ends(float("nan"), (1.0, float("inf"))), {"low": None, "both": [1.0, None]}), (float("inf"), None),
     (np.array([1.0, np.nan]), [1.0, None]), (np.bool_(True), True)],
)  # fmt: skip
def test_what_json_cannot_hold_is_text_and_collections_are_lists(value: object, held: object) -> None:
    assert plain(value) == held


def test_a_table_is_wide_enough_for_a_file_and_its_numbers_stand_to_the_right(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    Console().table("title", ["name", "value", "a" * 60], [["x", 1.5, "b"], ["long name", None, "c"]])
    shown = [line.rstrip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    title, head, _, first, second = shown
    assert title == "title"
    assert len(head) > 75
    assert head.index("value") + 5 == first.index("1.5") + 3 == second.index("-") + 1
    assert first.index("x") == head.index("name")
    Console().table("title", ["name"], [["x" * 300]])
    assert {len(line) for line in capsys.readouterr().out.splitlines() if line.strip()} == {140}


def test_progress_says_each_change_of_work_and_each_twentieth(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().progress("tune") as progress:
        for fraction, what in (
            (0.0, "a: 1"),
            (0.01, "a: 2"),
            (0.02, "b: 1"),
            (0.051, "b: 2"),
            (0.06, "b: 3"),
        ):
            progress(fraction, what)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" s ")[1] for line in lines] == ["a: 1", "b: 1", "b: 2"]


def test_the_first_progress_is_said_at_any_fraction_and_without_words(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Console().progress("tune") as progress:
        progress(0.05, "")
    assert capsys.readouterr().err.startswith("tune   5 %")
