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


def test_a_sentence_is_as_wide_as_100_columns_of_a_pipe_and_breaks_no_word(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["    one", *["pca-lda"] * 30, "x" * 120]
    Console().say(" ".join(words))
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(lines).split() == " ".join(words).split()
    assert all(line.startswith("    ") for line in lines)
    assert 92 < len(lines[0]) <= 100
    Console().say("a = 1\n" + "b" * 120)  # a file that is shown stays as it is
    assert capsys.readouterr().out == "a = 1\n" + "b" * 120 + "\n"


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
        (63970.4, "63970"), (-12346.0, "-12350"),
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


def test_a_table_is_as_wide_as_its_terminal_or_100_columns_and_breaks_names_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    prose = "held-out readings of the whole day in one sentence that is longer than its column can be wide"
    rows: list[list[object]] = [["features-lda", 1.5, prose], ["long name", None, "c"]]
    for terminal, width in ((False, 100), (True, 60)):
        monkeypatch.setenv("COLUMNS", "60")
        monkeypatch.setattr("sys.stdout.isatty", lambda terminal=terminal: terminal)
        Console().table("title", ["name", "value", "what it says"], rows)
        title, head, _, first, *more, last = filter(None, capsys.readouterr().out.splitlines())
        assert title == "title"
        assert max(map(len, (head, first, *more, last))) <= width
        assert " ".join([first, *more]).split() == ["features-lda", "1.5", *prose.split()]
        assert head.index("value") + 5 == first.index("1.5") + 3 == last.index("-") + 1
    for name, broken in (("x" * 59, [f"name: {'x' * 59}", "2"]), ("x_" * 33, ["x_" * 28 + "   2", "x_" * 5])):
        Console().table("title", ["name", ""], [[name, 2.0]])
        assert capsys.readouterr().out.split("\n\n")[1].splitlines()[-2:] == broken


def test_what_is_known_so_far_is_a_table_on_a_terminal_and_a_line_elsewhere(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for as_json in (False, True):
        Console(as_json).early("a 1", "title", ["name", "value"], [["a", 1.0]])
        assert capsys.readouterr() == ("", "a 1\n")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    Console().early("a 1", "title", ["name", "value"], [["a", 1.0]])
    out, err = capsys.readouterr()
    assert (out, err.startswith("\r\x1b[Ktitle\n"), err.split()[-2:]) == ("", True, ["a", "1"])


def test_on_a_terminal_progress_is_one_line_with_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "70")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    clock = iter((0.0, 5.0, 30.0))
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with Console().progress("tune") as progress:
        progress(0.25, "a")
        progress(0.5, "b" * 80)
    *shown, last = capsys.readouterr().err.split("\r\x1b[K")[1:]
    assert shown[0] == "[#####...............] tune  25 %    5 s, 15 s left a"
    assert shown[1].startswith("[##########..........] tune  50 %   30 s, 30 s left bbb")
    assert (len(shown[1]), last) == (69, "")


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
