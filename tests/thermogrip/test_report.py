"""The report page: one file, no scripts, nothing from elsewhere, everything escaped."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from thermogrip.report.html import Commands, Picture, Section, Table, Text, html_page, write_report


def picture(points: int = 3) -> Picture:
    figure = Figure(figsize=(2, 1))
    figure.subplots().scatter(range(points), [k * 7919 % 1000 for k in range(points)])
    return Picture(figure, "a line")


def test_a_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    parts = (Text("words"), Commands(("thermogrip demo",)), Table(("n", "who"), ((1.0, "a"),)), picture())
    write_report(path, "title", "lead", [Section("one", parts, "fine", "good"), Section("two", ())])
    page = path.read_text()
    assert "<script" not in page
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    assert "data:image/svg+xml;base64," in page


def test_a_large_figure_goes_in_as_png() -> None:
    small, large = picture(3).data_uri, picture(9_000).data_uri
    assert small.startswith("data:image/svg+xml")
    assert large.startswith("data:image/png")


def test_every_text_is_escaped() -> None:
    evil = '<img src=x onerror="alert(1)">'
    part = Table((evil,), ((evil,),), evil)
    page = html_page(evil, evil, [Section(evil, (Text(evil), Commands((evil,)), part), evil)], footer=evil)
    assert "<img src=x" not in page


def test_an_unknown_tone_is_refused() -> None:
    with pytest.raises(ValueError, match="tone"):
        Section("a", (), "b", "rosy")


def test_a_number_that_is_missing_stands_under_the_others_and_words_do_not() -> None:
    table = Table(("model", "RMSE", "why"), (("arx", 1.0, None), ("neural", None, None)))
    assert [number for _, number in table.heads] == [False, True, False]
    assert table.cells[1] == [("neural", False), ("-", True), ("-", False)]
