"""The report page: one file, no scripts, nothing from elsewhere, everything escaped."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from xml.etree import ElementTree

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
    page = html_page(evil, evil, [Section(evil, (Text(evil), Commands((evil,)), part), evil)])
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x") >= 8


def test_an_unknown_tone_is_refused() -> None:
    with pytest.raises(ValueError, match="tone"):
        Section("a", (), "b", "rosy")


def test_a_number_that_is_missing_stands_under_the_others_and_words_do_not() -> None:
    table = Table(("model", "RMSE", "why"), (("arx", 1.0, None), ("neural", None, None)))
    assert [number for _, number in table.heads] == [False, True, False]
    assert table.cells[1] == [("neural", False), ("-", True), ("-", False)]


@pytest.mark.parametrize(
    "name", ["$\\frac{$", "$x$", "\x1b[31m", "a\u202eb", "_$", "%s {x} \\alpha", "$^{2}$"]
)
def test_a_figure_sets_any_name_as_it_stands(name: str) -> None:
    figure = Figure(figsize=(3, 2))
    axes = figure.subplots()
    axes.plot([1, 2], label=f"of {name}")
    axes.set(title=name, xlabel=f"{name} [W s$^{{0.5}}$]", ylabel=name, xscale="log")
    axes.set_yticks([1, 2], [name, name])
    axes.annotate(name, (1, 1))
    axes.legend(title=name)
    figure.suptitle(name)
    for kind in ("svg", "svg"):  # twice: what was made literal stays as it is
        uri = Picture(figure, name).data_uri
        page = base64.b64decode(uri.split(",")[1]).decode()
        assert uri.startswith(f"data:image/{kind}")
        ElementTree.fromstring(page)
    assert [text.get_text() for text in axes.get_yticklabels()] == [axes.get_title()] * 2
    assert axes.get_xlabel().endswith(" [W s$^{0.5}$]")


def test_a_page_has_no_control_characters() -> None:
    evil = "t\x1b[31m\u202e\x00"
    page = html_page(evil, evil, [Section(evil, (Text(evil), Table((evil,), ((evil,),), evil)), evil)])
    assert "t\\x1b[31m\\u202e\\x00" in page
    assert not set(page) & set("\x1b\u202e\x00")


def test_letters_that_the_font_has_not_are_no_warning(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().set_title("木")
    write_report(tmp_path / "r.html", "t", "l", [Section("s", (Picture(figure, "木"),), "v")])
    assert "木" in (tmp_path / "r.html").read_text(encoding="utf-8")
