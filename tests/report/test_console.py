"""What goes to stdout and stderr."""

from __future__ import annotations

import json

import numpy as np
import pytest

from thermogrip.report.console import Console, part, plain


def test_a_number_that_json_cannot_hold_is_null() -> None:
    found = plain({"a": np.array([1.0, np.nan]), "b": float("inf"), "c": np.bool_(True)})
    assert json.loads(json.dumps(found, allow_nan=False)) == {"a": [1.0, None], "b": None, "c": True}


def test_with_json_tables_and_words_are_silent(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)
    console.say("hello")
    console.table("t", ["a"], [[1]])
    console.answer({"a": 1})
    assert json.loads(capsys.readouterr().out) == {"a": 1}


def test_markup_in_a_name_is_shown_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    Console().table("t", ["log"], [["[bold]run[/bold]"]])
    assert "[bold]run[/bold]" in capsys.readouterr().out


def test_progress_without_a_terminal_is_lines_on_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().progress("tune") as progress:
        for k in range(100):
            progress(k / 100, "run")
    out, err = capsys.readouterr()
    assert out == ""
    assert 15 <= err.count("\n") <= 25
    assert err.startswith("tune   0 %    0 s run")


def test_parts_of_parts_fill_the_whole() -> None:
    seen: list[float] = []
    outer = part(lambda fraction, what: seen.append(fraction), 0.2, 0.6)
    assert outer is not None
    for fraction in (0.0, 0.5, 1.0, 7.0):
        outer(fraction, "")
    assert seen == pytest.approx([0.2, 0.4, 0.6, 0.6])


def test_progress_never_goes_back(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().progress("demo") as progress:
        for k, fraction in enumerate((0.1, 0.6, 0.4, 0.7, 1.3)):
            progress(fraction, f"{k}: step")
    shares = [int(line.split()[1]) for line in capsys.readouterr().err.splitlines()]
    assert shares == [10, 60, 60, 70, 100]
