"""Anybody's text is text in every medium: terminal, CSV, Markdown."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.schema import make_grasps, make_log
from thermogrip.media.rendering import csv_cell, csv_text, from_csv, markdown, printable

HOSTILE = ["=cmd|'/c calc'!A0", "@SUM(1)", "+1+1", "-2+3", "'=1", "$\\frac{$", "a,b", 'a"b', "[red]x[/]"]


@given(st.text())
@example("\x1b[2J\x9b31m\u202e\x00\r")
def test_no_text_steers_a_terminal(text: str) -> None:
    shown = printable(text)
    assert not set(shown) & set("\x1b\x9b\r\x00\u202e\u2066\ufeff")
    assert printable(shown) == shown
    shown.encode("utf-8")


def test_control_characters_are_written_out() -> None:
    assert printable("a\x1b\x9f\u200e\u2028\xff\t\n") == "a\\x1b\\x9f\\u200e\\u2028\xff\t\n"


PLAIN = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cf", "Zl", "Zp"], include_characters="\t"))


@given(PLAIN)
@example("'''=1")
@example("-1e5")
def test_a_cell_is_no_formula_and_comes_back(text: str) -> None:
    cell = csv_cell(text)
    assert isinstance(cell, str)
    assert from_csv(cell) == text
    if cell[:1] in tuple("=+-@\t") and len(cell) > 1:
        float(cell)  # a number may have a sign
    assert csv_cell(-1.5) == -1.5


@given(st.lists(st.lists(PLAIN, min_size=2), min_size=1))
def test_a_table_comes_back_cell_by_cell(rows: list[list[str]]) -> None:
    text = csv_text([*rows, ["a\nb\rc", "\x00"]])
    assert text.splitlines()[-1] == r"a\nb\rc,\x00"
    read = csv.reader(io.StringIO(csv_text(rows), newline=""))
    assert [[from_csv(cell) for cell in row] for row in read] == rows


def test_markdown_is_no_link_and_no_tag() -> None:
    shown = markdown("[a](http://b) <img src=x> `c` |\n# d")
    for sign in "[]<>`|#":
        assert shown.count(sign) == shown.count("\\" + sign)
    assert "\n" not in shown
    assert markdown("t_tank 2") == "t_tank 2"


def test_labels_of_grasps_are_no_formulas_in_csv_and_come_back(tmp_path: Path) -> None:
    n = len(HOSTILE)
    time = np.array([-0.2, -0.1, 0.1, 0.2])
    t = 25.0 + np.arange(4.0) + np.zeros((n, 1))
    grasps = make_grasps(time, t, HOSTILE, name="g", material=HOSTILE, session=HOSTILE, block=HOSTILE)
    write_grasps(grasps, tmp_path / "g.csv")
    for name in ("g.csv", "g_meta.csv"):
        for row in csv.reader((tmp_path / name).read_text(encoding="utf-8").splitlines()):
            for cell in row:
                assert cell[:1] not in ("=", "@", "+"), cell
    again = read_grasps(tmp_path / "g.csv")
    for name in ("grasp", "material", "session", "block"):
        assert again[name].values.tolist() == HOSTILE


@pytest.mark.parametrize("name", ["=1+1", "@x", "-y", "+"])
def test_a_column_of_any_name_comes_back_from_csv(name: str, tmp_path: Path) -> None:
    log = make_log([0.0, 1.0], {name: ([1.0, 2.0], "V", "output")})
    text = write_log(log, tmp_path / "a.csv").read_text()
    assert text.splitlines()[0].split(",")[1][:1] not in tuple("=+-@")
    assert list(read_log(tmp_path / "a.csv", outputs=[name])) == [name]
